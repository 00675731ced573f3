# Copyright 2026 the adxl_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The diagnosis of every recording, each in a process that is given no more than that."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from functools import partial
import hashlib
from importlib.metadata import PackageNotFoundError, version
import json
from multiprocessing import get_context
import os
from pathlib import Path
import signal
import subprocess
import sys
import tempfile
import time
from typing import Any

from adxl_ros.blind import parallel_io
from adxl_ros.errors import UserError
from ament_index_python.packages import get_package_prefix

# What ROS 2 and Python need; nothing of where the check lies or what it is about.
_ENVIRONMENT = ('PATH', 'LD_LIBRARY_PATH', 'PYTHONPATH', 'AMENT_PREFIX_PATH', 'VIRTUAL_ENV',
                '_ROS_WHEELS_BOOTSTRAP_COMPLETE', 'ROS_DISTRO', 'LANG', 'SYSTEMROOT')
_LONGEST_S = 1200.0
Result = dict[str, Any]


def executable(name: str) -> list[str]:
    """Say how to run an executable of the package."""
    return [sys.executable, str(Path(get_package_prefix('adxl_ros'), 'lib', 'adxl_ros', name))]


def call(command: Sequence[str], folder: Path) -> tuple[int, str]:
    """Run a command in a folder, with nothing else known to it; give status and stderr."""
    environment = {name: os.environ[name] for name in _ENVIRONMENT if name in os.environ}
    # One process a core: linear algebra must not take the others.
    environment |= {'HOME': str(folder), 'OPENBLAS_NUM_THREADS': '1', 'OMP_NUM_THREADS': '1',
                    'MPLCONFIGDIR': str(folder)}
    with subprocess.Popen(command, cwd=folder, env=environment, stdin=subprocess.DEVNULL,
                          stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
                          start_new_session=True) as process:
        try:
            error = process.communicate(timeout=_LONGEST_S)[1]
            return process.returncode, (error.strip().splitlines() or [''])[-1]
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            return 1, f'not done after {_LONGEST_S:.0f} s'
        except BaseException:
            os.killpg(process.pid, signal.SIGKILL)
            raise


def diagnose(name: str, recording: bytes, parameters: bytes,
             command: Sequence[str] | None) -> tuple[str, Result]:
    """
    Diagnose a recording in a folder that holds it and its parameter file alone.

    Parameters
    ----------
    name
        Neutral, of both files.
    recording, parameters
        The files' bytes.
    command
        What to run; the package's own `diagnose` where this runs if None.

    Returns
    -------
    tuple
        The name, and `report` and `parameters` as they were left, None without; `seconds`,
        `status`, `error`.

    """
    with tempfile.TemporaryDirectory(prefix='diagnose_') as made:
        folder = Path(made)
        csv, yaml, out = folder / f'{name}.csv', folder / f'{name}.yaml', folder / 'out'
        for path, data in ((csv, recording), (yaml, parameters)):
            path.write_bytes(data)
            os.utime(path, (0, 0))
        words = [*(command or executable('diagnose')), csv.name, '--params', yaml.name,
                 '-o', out.name, '--json', '--seed', '0']
        start = time.monotonic()
        status, error = call(words, folder)
        seconds = time.monotonic() - start
        report, left = out / 'report.json', out / 'params.yaml'
        try:
            found = json.loads(report.read_bytes())
        except (OSError, ValueError) as problem:
            found, error = None, error or f'no report: {problem}'
        return name, {'report': found, 'seconds': seconds, 'status': status, 'error': error,
                      'parameters': left.read_text() if left.exists() else None}


def diagnose_all(folder: Path, command: Sequence[str] | None, pool: Executor,
                 show: Callable[[float], None]) -> dict[str, Result]:
    """
    Diagnose all recordings of a folder that are not diagnosed yet, and give all results.

    Raises
    ------
    UserError
        Earlier results are of another version of the diagnosis.

    """
    reports, code = parallel_io.make(folder / 'reports'), code_version(command)
    stamp = reports / 'version.txt'
    if stamp.exists() and stamp.read_text() != code:
        raise UserError(f'{stamp}: earlier reports are of another version of the diagnosis '
                        f'({stamp.read_text()[:12]}, now {code[:12]}); seal anew into another '
                        'folder, a check is of one version')
    parallel_io.write(stamp, code.encode())
    names = sorted(path.stem for path in (folder / 'recordings').glob('*.csv'))
    todo = [name for name in names if not (reports / f'{name}.json').exists()]

    def job(name: str) -> tuple:
        source = folder / 'recordings' / name
        return (name, source.with_suffix('.csv').read_bytes(),
                source.with_suffix('.yaml').read_bytes(), command)

    def keep(name: str, result: Result) -> None:
        parallel_io.write(reports / f'{name}.json', json.dumps(result).encode())

    parallel_io.each(pool, diagnose, [partial(job, name) for name in todo], keep, show,
                     len(names) - len(todo))
    if code_version(command) != code:
        raise UserError('the code of the diagnosis was changed while it ran: seal anew into '
                        'another folder, and leave the package alone meanwhile')
    return {name: json.loads((reports / f'{name}.json').read_bytes()) for name in names}


def code_version(command: Sequence[str] | None) -> str:
    """Hash the code that diagnoses: the package without this check, or the command's files."""
    hashed = hashlib.sha256()
    if command is None:
        root = Path(__file__).parents[1]
        files = [path for path in sorted(root.rglob('*.py'))
                 if path.relative_to(root).parts[0] != 'blind' and path.name != 'blind.py']
    else:
        files = [Path(word) for word in command[1:] if Path(word).is_file()]
        hashed.update(repr(list(command)).encode())
    for path in files:
        hashed.update(path.name.encode() + path.read_bytes())
    return hashed.hexdigest()


def package_version() -> str:
    """Return the version of this package; 'unknown' when it runs from its source."""
    try:
        return version('adxl_ros')
    except PackageNotFoundError:
        return 'unknown'


@contextmanager
def workers(scheduler: str | None) -> Iterator[Executor]:
    """
    Give a pool: a process for each core, or a Dask cluster.

    Raises
    ------
    UserError
        Dask is not installed, or its scheduler does not answer.

    """
    if scheduler is None:
        # Each takes one core; what is spawned reads this before it loads numpy.
        os.environ['OPENBLAS_NUM_THREADS'] = '1'
        pool = ProcessPoolExecutor(cores(), get_context('spawn'), _deaf)
        try:
            yield pool
        finally:
            pool.shutdown(cancel_futures=True)
        return
    try:
        from distributed import Client
    except ImportError:
        raise UserError("--scheduler needs Dask: pip install 'distributed'") from None
    try:
        client = Client(scheduler, timeout='20s')
    except (OSError, ValueError) as error:
        raise UserError(f'--scheduler {scheduler}: no scheduler answers: {error}') from None
    with client, client.get_executor(pure=False) as pool:
        yield pool


def _deaf() -> None:
    """Leave Ctrl-C to the parent: it stops giving work, and what is under way ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def cores() -> int:
    """Count the cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, 'sched_getaffinity') else \
        os.cpu_count() or 1
