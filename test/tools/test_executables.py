# SPDX-License-Identifier: Apache-2.0

"""The installed executables of the tools: exit status, stdout and stderr."""

import os
import subprocess
import sys

from processes import executable, run_executable
import pytest

TOOLS = ('apply', 'blind', 'check', 'diagnose', 'fit', 'noise', 'reproduce', 'simulate')


@pytest.mark.parametrize('name', TOOLS)
def test_help_and_wrong_usage(name: str) -> None:
    described = run_executable(name, '--help')
    assert (described.returncode, described.stderr) == (0, '')
    assert described.stdout.startswith(f'usage: {name}')
    refused = run_executable(name, '--no-such-option')
    assert (refused.returncode, refused.stdout) == (2, '')
    assert refused.stderr.startswith(f'usage: {name}')


@pytest.mark.parametrize('name', ['apply', 'diagnose', 'fit'])
def test_a_recording_that_is_missing_is_one_line_and_status_1(name: str, tmp_path) -> None:
    refused = run_executable(name, 'missing.csv', '-o', 'out', cwd=tmp_path)
    assert (refused.returncode, refused.stdout) == (1, '')
    assert refused.stderr.startswith(f'{name}: missing.csv')
    assert refused.stderr.count('\n') == 1
    assert not list(tmp_path.iterdir())


def test_a_recording_is_simulated_and_fitted(tmp_path) -> None:
    simulated = run_executable('simulate', 'sweep', '--rate', '50', '-o', 'sweep.csv',
                               cwd=tmp_path)
    assert simulated.returncode == 0
    fitted = run_executable('fit', 'sweep.csv', '-o', 'unit.yaml', '--store', '', cwd=tmp_path)
    assert fitted.returncode == 0
    assert 'full model' in fitted.stdout
    assert '#   scale factor ' in (tmp_path / 'unit.yaml').read_text()


@pytest.mark.parametrize('name', ['simulate', 'driver', 'demo', 'bench'])
def test_output_that_nobody_reads_ends_an_executable_without_a_message(name: str) -> None:
    """A tool, a node, and the programs that start nodes, as before `| head -1`."""
    reader, writer = os.pipe()
    os.close(reader)
    try:
        # argparse ignores the pipe where nothing is buffered.
        piped = subprocess.run([executable(name), '--help'], text=True, stdout=writer,
                               stdin=subprocess.DEVNULL, stderr=subprocess.PIPE, timeout=60,
                               env=os.environ | {'PYTHONUNBUFFERED': ''})
    finally:
        os.close(writer)
    assert (piped.returncode, piped.stderr) == (1, '')


def test_a_pipe_between_processes_that_breaks_is_not_hidden() -> None:
    code = ('from adxl_ros.closed_output import ended_by_closed_output\n'
            'with ended_by_closed_output():\n    raise BrokenPipeError')
    done = subprocess.run([sys.executable, '-c', code], text=True, capture_output=True, timeout=60)
    assert done.returncode == 1 and 'BrokenPipeError' in done.stderr
