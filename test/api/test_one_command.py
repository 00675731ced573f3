# SPDX-License-Identifier: Apache-2.0

"""The one command of a package that pip has installed, and commands as a tool was started."""

import os
import subprocess
import sys

from adxl_ros.process import command, STARTED_BY
import pytest


def run(*words: str, **options: object) -> subprocess.CompletedProcess:
    environment = {key: value for key, value in os.environ.items() if key != STARTED_BY}
    return subprocess.run(
        [sys.executable, '-m', 'adxl_ros', *words],
        text=True,
        capture_output=True,
        env=environment,
        **options,
    )


def test_help_lists_the_tools_and_a_tool_has_its_own() -> None:
    listed = run().stdout
    assert listed == run('--help').stdout
    assert all(f'\n  {name} ' in listed for name in ('apply', 'check', 'diagnose', 'fit', 'noise'))
    of_tool = run('noise', '--help').stdout
    assert of_tool.startswith('usage: python3 -m adxl_ros noise')
    assert '    python3 -m adxl_ros noise still.mcap' in of_tool


def test_other_words_are_refused_by_name() -> None:
    refused = run('diagnos')
    assert (refused.returncode, refused.stdout) == (2, '')
    assert "'diagnos'" in refused.stderr and 'diagnose' in refused.stderr


def test_the_next_command_names_the_tool_as_it_was_started(tmp_path) -> None:
    done = run('simulate', 'tilt_both', '--rate', '50', '-o', 'tilt.csv', cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert ' next   python3 -m adxl_ros diagnose tilt.csv -o gap' in done.stdout


@pytest.mark.parametrize(
    'started_by, expected', [(None, 'ros2 run adxl_ros fit a.csv'), ('./run', './run fit a.csv')]
)
def test_a_command_of_ros_or_of_a_clone(
    started_by: str | None, expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv('AMENT_PREFIX_PATH', '/opt/ros/jazzy')
    monkeypatch.delenv(STARTED_BY, raising=False)
    if started_by:
        monkeypatch.setenv(STARTED_BY, started_by)
    assert command('fit', 'a.csv') == expected
