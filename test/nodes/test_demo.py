# SPDX-License-Identifier: Apache-2.0

"""The demonstration: its titles, its steps, and a live run."""

import io
import os
from pathlib import Path
import re
import signal
import sys
import time

from adxl_ros.errors import UserError
from adxl_ros.files import sweep_journal
from adxl_ros.nodes import demo, jobs
from processes import children, executable, REPO
import pytest
from terminal import Terminal


def test_steps_without_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    out = io.StringIO()
    monkeypatch.setattr(sys, 'stdout', out)
    with jobs.Step('1/2 sweep', 'starting', 146) as step:
        for count in range(1, 147):
            step.show(f'{count} of 146 poses', count)
    with jobs.Step('2/2 fit', '130 poses') as step:
        step.show('130 poses, full model')
    with pytest.raises(UserError), jobs.Step('3/3 check', '16 poses'):
        raise UserError('it fails')
    lines = out.getvalue().splitlines()
    assert lines[0].split() == ['1/2', 'sweep', '146', 'of', '146', 'poses', '0', 's']
    assert lines[1].split() == ['2/2', 'fit', '130', 'poses,', 'full', 'model', '0', 's']
    assert len(lines) == 2 and max(map(len, lines)) <= 79
    assert '\x1b' not in out.getvalue()


def suspend_calibration(demo_pid: int) -> None:
    """Stop the calibration of a demonstration for half a second, as a busy machine does."""
    (pid,) = (
        pid
        for pid in children(demo_pid)
        if b'calibration' in Path(f'/proc/{pid}/cmdline').read_bytes()
    )
    os.kill(pid, signal.SIGSTOP)
    time.sleep(0.5)
    os.kill(pid, signal.SIGCONT)


def test_live(ros_env, tmp_path) -> None:
    """No line wraps; no sample is lost although the calibration stops for 20 s of sensor time."""
    terminal = Terminal([executable('demo')], ros_env, tmp_path, lines=60, columns=80)
    try:
        terminal.wait_for('1/3 sweep', 'of 146 poses', '━', timeout_s=60.0)
        suspend_calibration(terminal.popen.pid)
        screen = terminal.wait_for('Next  your own sensor:', timeout_s=600.0)
        assert terminal.wait(30.0) == 0
        restored = terminal.restored()
    finally:
        terminal.close()
    lines = screen.splitlines()
    assert max(map(len, lines)) <= 79 and restored
    assert re.search(r'coefficients are known   \(\d', lines[0])
    assert (REPO / demo.NEXT_PAGE).is_file()
    assert re.search(r'1/3 sweep +146 of 146 poses +━+ +100 %', screen)
    assert re.search(r'2/3 fit +130 poses, full model', screen)
    assert re.search(r'3/3 check +16 poses that the fit has not seen', screen)
    for model in ('datasheet values', 'linear calibration', 'full calibration'):
        assert re.search(rf'{model} +[\d.]+ +° +[\d.]+ +mg', screen)
    rows = [line for line in lines if line.endswith(('  ok', '  MISSED'))]
    assert len(rows) >= 18 and all('±' in row for row in rows)
    assert f'of {len(rows)} inside their 90 % intervals' in screen
    assert re.search(r' PASS  calibration error 0\.\d+ mg; the datasheet allows 3\.4 mg', screen)
    assert '\x1b[32mPASS' in terminal.raw.decode()
    for name in ('sweep/report.html', 'adxl203_demo.yaml'):
        assert f' demo_output/{name}' in screen and (tmp_path / 'demo_output' / name).is_file()
    poses = sweep_journal.accepted_poses(
        sweep_journal.read(tmp_path / 'demo_output' / 'adxl203_demo.yaml.journal').entries
    )
    # 5 s at 125 Hz, from the first to the last sample.
    assert {pose.stop_ns - pose.start_ns for pose in poses} == {4_992_000_000}
