# SPDX-License-Identifier: Apache-2.0

"""
Fixtures that the tests share: a private ROS domain, the installed executables, the shared files.

The ament index locates the executables, as for `ros2 run`. They communicate over DDS on the
loopback interface, in a domain that no other test run and no other graph uses.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
import fcntl
from functools import cache, partial
import os
from pathlib import Path
import shutil
import signal
import subprocess
import sys

from adxl_ros.wording import NAMES_OPTIONS
from domain import BY_UDP, own_domain
from hypothesis import settings
import needs
from pages import opener, running_browser
from processes import executable, REPO, run_in_process, Started
import pytest

# Each run has the same examples. New ones: make test ARGS='--hypothesis-profile search'
settings.register_profile('same', deadline=None, derandomize=True)
settings.register_profile('search', deadline=None, max_examples=2000)
settings.load_profile('same')


SHARED = {'committed_check', 'evaluations', 'report_folder', 'two_effects'}
"""Fixtures that take long to make: the tests that use one run in one worker of xdist."""


def pytest_configure(config: pytest.Config) -> None:
    # Nodes state this folder in their help as they are loaded; it can hold no file.
    os.environ['ROS_HOME'] = os.devnull
    # After SIGTERM a run stops the processes that it has started, as after Ctrl-C.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    # A background job of a shell ignores SIGINT, and its processes would inherit this.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    # And nohup ignores SIGHUP.
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark tests of a graph; keep the results that a module shares in one worker of xdist."""
    for item in items:
        fixtures = set(getattr(item, 'fixturenames', ()))
        if 'ros_env' in fixtures:
            item.add_marker(pytest.mark.live)
        for fixture in SHARED & fixtures:
            item.add_marker(pytest.mark.xdist_group(fixture))
    # The longest first, so that no worker waits for the others at the end.
    items.sort(
        key=lambda item: [
            item.get_closest_marker(mark) is None for mark in ('xdist_group', 'long')
        ]
    )


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    for line in needs.summary(
        report.longrepr[2].removeprefix('Skipped: ')
        for report in terminalreporter.stats.get('skipped', ())
    ):
        terminalreporter.write_line(line)


@pytest.fixture(scope='module')
def browser() -> Iterator[object]:
    with running_browser() as launched:
        yield launched


@pytest.fixture
def opened(browser: object) -> Iterator[Callable]:
    with opener(browser) as begin:
        yield begin


@pytest.fixture(autouse=True)
def private_store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Keep the calibration store and other files of the user out of the tests."""
    monkeypatch.setenv('ROS_HOME', str(tmp_path / 'ros_home'))


@pytest.fixture(autouse=True)
def words_of_tools(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let texts name options, as tools and nodes do; the tests of the library see arguments."""
    if request.path.parent.name != 'api':
        monkeypatch.setenv(NAMES_OPTIONS, '1')


@pytest.fixture
def ros_env(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[dict[str, str]]:
    """Set the environment of a private graph, and give the environment of its processes."""
    kills = 'kill' in request.fixturenames
    with own_domain() as domain, pytest.MonkeyPatch.context() as patch:
        patch.setenv('ROS_DOMAIN_ID', str(domain))
        patch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
        patch.delenv('ROS_LOCALHOST_ONLY', raising=False)
        patch.setenv('ROS_LOG_DIR', str(tmp_path / 'ros_log'))
        yield os.environ | (BY_UDP if kills else {})


@pytest.fixture
def kill(ros_env: dict[str, str]) -> Callable[[int], None]:
    """Give a function that kills a process by its id; all processes of the test talk by UDP."""
    return lambda pid: os.kill(pid, signal.SIGKILL)


@pytest.fixture
def start(ros_env: dict[str, str], tmp_path: Path) -> Iterator[Callable[..., Started]]:
    """Give a function that starts an executable, by name or path, in the graph of the test."""
    started: list[Started] = []

    def begin(name: str, *args: object) -> Started:
        log = tmp_path / f'{len(started)}_{Path(name).name}.log'
        with open(log, 'wb') as file:
            popen = subprocess.Popen(
                [executable(name), *map(str, args)],
                env=ros_env,
                cwd=tmp_path,
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        started.append(Started(name, popen, log))
        return started[-1]

    yield begin
    # They end at the same time, and the wait is that of the slowest.
    for process in started:
        process.interrupt()
    for process in reversed(started):
        process.end()
        print(f'--- {process.name}:\n{process.output()}')


@pytest.fixture
def in_terminal(ros_env: dict[str, str], tmp_path: Path) -> Iterator[Callable]:
    """Give a function that starts an executable, as `start` does, in a terminal of its own."""
    from terminal import Terminal

    opened: list[Terminal] = []

    def begin(name: str, *args: object, **size: int) -> Terminal:
        opened.append(Terminal([executable(name), *map(str, args)], ros_env, tmp_path, **size))
        return opened[-1]

    yield begin
    for program in opened:
        print(program.text())
        program.close()


@pytest.fixture
def refusal(
    ros_env: dict[str, str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture,
) -> Iterator[Callable[..., str]]:
    """Give a function that runs a node in this process, which must refuse to start."""
    import rclpy

    def started(*_: object) -> None:
        raise AssertionError('the node has started')

    def run(name: str, *args: object, status: int = 1) -> str:
        monkeypatch.setattr('adxl_ros.nodes.run_node._spin', started)
        interval_s = sys.getswitchinterval()
        try:
            done = run_in_process(name, *args, cwd=tmp_path)
        finally:
            rclpy.try_shutdown()
            sys.setswitchinterval(interval_s)
        # What C++ logs goes by the file descriptor.
        output = done.stderr + ''.join(capfd.readouterr())
        assert (done.returncode, done.stdout) == (status, '') and 'Traceback' not in output, output
        # A wrong usage is shown, too.
        assert status == 2 or output.count('\n') == 1, output
        return output

    return run


@pytest.fixture
def run_tool(tmp_path: Path) -> Callable[..., subprocess.CompletedProcess]:
    """Give a function of a name and arguments that runs a tool in `tmp_path`, in this process."""
    return partial(run_in_process, cwd=tmp_path)


@pytest.fixture(scope='session')
def made_once(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Give a function that fills a folder once for all workers of xdist, and returns its path."""
    base = tmp_path_factory.getbasetemp()
    shared = base.parent if 'PYTEST_XDIST_WORKER' in os.environ else base

    def make(name: str, fill: Callable[[Path], object]) -> Path:
        folder, done = shared / name, shared / f'{name}.done'
        with open(shared / f'{name}.lock', 'w') as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not done.exists():
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir()
                fill(folder)
                done.touch()
        return folder

    return make


@pytest.fixture(scope='session')
def help_of() -> Callable[[str], str]:
    """Give a function that returns the help of an executable, made in this process."""

    @cache
    def text(name: str) -> str:
        done = run_in_process(name, '--help', cwd=REPO)
        assert (done.returncode, done.stderr) == (0, '')
        return done.stdout

    return text


@pytest.fixture(scope='session')
def shared_dir() -> Path:
    """Return the folder of real recordings and samples beside the repository."""
    path = REPO.parent / 'shared'
    if not path.is_dir():
        pytest.skip(needs.lack('../shared'))
    return path
