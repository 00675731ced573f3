# SPDX-License-Identifier: Apache-2.0

"""The installed tools: help, version, exit status, and what a run prints for people."""

from collections.abc import Callable
import os
from pathlib import Path
import re
import subprocess
import sys

from adxl_ros.model.effects import library
from processes import executable, PATIENCE, run_executable, run_in_process, TOOLS
import pytest
from terminal import Terminal

COLUMNS = 79
COLOUR = '\x1b['


@pytest.mark.parametrize('name', TOOLS)
def test_help_version_and_wrong_usage(name: str, help_of: Callable, tmp_path: Path) -> None:
    text = help_of(name)
    assert text.startswith(f'usage: {name}')
    assert f'    ros2 run adxl_ros {name} ' in text.split('examples:')[1]
    assert max(map(len, text.splitlines())) <= COLUMNS
    done = run_in_process(name, '--version', cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, '')
    assert re.fullmatch(r'adxl_ros \d+\.\d+\.\d+( \(\w+\))?\n', done.stdout)
    refused = run_in_process(name, '--no-such-option', cwd=tmp_path)
    assert (refused.returncode, refused.stdout) == (2, '')
    assert refused.stderr.startswith(f'usage: {name}')


@pytest.mark.parametrize('name', ['diagnose', 'fit', 'simulate'])
def test_help_lists_the_effects(name: str, help_of: Callable) -> None:
    listed = help_of(name).split('\neffects:\n')[1]
    names = set(re.findall(r'^  ([a-z_]+) ', listed, re.MULTILINE))
    assert names <= set(library())
    assert {'bias', 'temperature_bias', 'stage_offset'} <= names
    assert (names == set(library())) == (name != 'fit')


def end_of(text: str) -> tuple[str, str]:
    assert max(map(len, text.splitlines())) <= COLUMNS, text
    assert COLOUR not in text
    end = re.search(r'^ wrote  (.*?)^ next   (.*)\Z', text, re.DOTALL | re.MULTILINE)
    assert end, text
    return end[1], ' '.join(end[2].replace('\\\n', ' ').split())


@pytest.mark.long
def test_each_tool_names_its_files_and_the_next_command(tmp_path: Path) -> None:
    """The next command of one tool is what a user runs then."""
    done = run_executable(
        'simulate',
        'sweep',
        '--rate',
        '50',
        '--effect',
        'misalignment',
        '-o',
        'sweep.csv',
        cwd=tmp_path,
    )
    assert 'misalignment' in done.stdout
    assert end_of(done.stdout) == ('sweep.csv\n', 'ros2 run adxl_ros fit sweep.csv -o unit.yaml')
    done = run_executable(
        'fit', 'sweep.csv', '-o', 'unit.yaml', '--store', '', '--report', '.', cwd=tmp_path
    )
    files, following = end_of(done.stdout)
    assert files.split()[:2] == ['unit.yaml', 'report.html']
    assert all((tmp_path / name).exists() for name in files.split()[:2])
    assert re.search('^ (PASS|NOT SHOWN|FAIL) ', done.stdout, re.MULTILINE)
    assert following == 'ros2 run adxl_ros apply sweep.csv --params unit.yaml -o tilt.csv'
    done = run_executable(
        'apply', 'sweep.csv', '--params', 'unit.yaml', '-o', 'tilt.csv', cwd=tmp_path
    )
    assert end_of(done.stdout) == (
        'tilt.csv\n',
        'ros2 run adxl_ros compensation --ros-args -p calibration:=unit.yaml',
    )


@pytest.mark.long
def test_diagnose_in_a_terminal_of_80_columns(tmp_path: Path) -> None:
    """Stages while it runs; then a coloured verdict, files and steps, none wrapped in a word."""
    run_executable('simulate', 'tilt_both', '--rate', '100', '-o', 'tilt.csv', cwd=tmp_path)
    terminal = Terminal(
        [executable('diagnose'), 'tilt.csv', '-o', 'gap'],
        dict(os.environ),
        tmp_path,
        lines=60,
        columns=80,
    )
    try:
        screen = terminal.wait_for('next', 'ros2 run adxl_ros simulate', timeout_s=120.0)
        assert terminal.wait(30.0) == 0
        raw = terminal.raw.decode()
    finally:
        terminal.close()
    lines = screen.splitlines()
    assert max(map(len, lines)) <= COLUMNS
    assert re.match(
        r'tilt\.csv \(\d+ s, 100 Hz, x y\) +minus +simulation of the nominal sensor$', lines[0]
    )
    assert re.search(
        r'^(NO GAP|GAP EXPLAINED|UNKNOWN CAUSE).* mg rms +noise floor ', screen, re.MULTILINE
    )
    assert re.search(r'\x1b\[3\dm(NO GAP|GAP EXPLAINED|UNKNOWN CAUSE)\x1b\[0m', raw)
    assert '1/5 checks' in raw and '2/5 library of effects' in raw
    assert re.search(
        r'^ wrote +gap/report\.html +gap/params\.yaml +gap/report\.json', screen, re.MULTILINE
    )


def test_an_error_wraps_between_words_in_a_terminal_only(tmp_path: Path) -> None:
    name = 'a' * 30
    words = ('apply', f'{name}.csv', '--params', f'{name}.yaml', '-o', 'out.csv')
    done = run_executable(*words, cwd=tmp_path)
    assert len(done.stderr.splitlines()) == 1 and len(done.stderr) > COLUMNS
    terminal = Terminal([executable(words[0]), *words[1:]], dict(os.environ), tmp_path, columns=80)
    try:
        screen = terminal.wait_for(' '.join(done.stderr.split()))
        assert terminal.wait(30.0) == 1
    finally:
        terminal.close()
    assert max(map(len, screen.splitlines())) <= COLUMNS


@pytest.mark.parametrize('name', ['apply', 'diagnose', 'fit'])
def test_a_recording_that_is_missing_is_one_line_and_status_1(name: str, tmp_path: Path) -> None:
    refused = run_executable(name, 'missing.csv', '-o', 'out', cwd=tmp_path)
    assert (refused.returncode, refused.stdout) == (1, '')
    assert refused.stderr.startswith(f'{name}: missing.csv')
    assert refused.stderr.count('\n') == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize('name', ['simulate', 'driver', 'demo', 'bench'])
def test_output_that_nobody_reads_ends_an_executable_without_a_message(name: str) -> None:
    """A tool, a node, and the programs that start nodes, as before `| head -1`."""
    reader, writer = os.pipe()
    os.close(reader)
    try:
        # argparse ignores the pipe where nothing is buffered.
        piped = subprocess.run(
            [executable(name), '--help'],
            text=True,
            stdout=writer,
            stdin=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            timeout=60 * PATIENCE,
            env=os.environ | {'PYTHONUNBUFFERED': ''},
        )
    finally:
        os.close(writer)
    assert (piped.returncode, piped.stderr) == (1, '')


def test_a_pipe_between_processes_that_breaks_is_not_hidden() -> None:
    code = (
        'from adxl_ros.process import ended_by_closed_output\n'
        'with ended_by_closed_output():\n    raise BrokenPipeError'
    )
    done = subprocess.run(
        [sys.executable, '-c', code], text=True, capture_output=True, timeout=60 * PATIENCE
    )
    assert done.returncode == 1 and 'BrokenPipeError' in done.stderr
