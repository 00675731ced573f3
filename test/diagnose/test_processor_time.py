# SPDX-License-Identifier: Apache-2.0

"""Processor time and memory of `diagnose` as a command."""

from dataclasses import replace
import os
import subprocess
import sys

from adxl_ros.files import parameter_file, recording
from adxl_ros.files.recording_columns import Recording
from adxl_ros.files.stream_info import sensor_info
from adxl_ros.simulate.response import simulate
from adxl_ros.simulate.trajectories import rich
import numpy as np
from pace import STANDARD_S, standard_work
import pytest
from units import nominal, with_effects

pytestmark = pytest.mark.perf
_DIAGNOSE = """
import sys
from pathlib import Path
from adxl_ros.tools.diagnose import main
status = main()
lines = Path('/proc/self/status').read_text().splitlines()
print(*(line for line in lines if line.startswith('VmHWM')))
sys.exit(status)
"""
"""Diagnose, and print the highest memory: that of `wait4` is never below the one of the parent."""


def used_by(folder, rate_hz, duration_s, *effects):
    """Diagnose a simulation; return processor time of a standard core, s, and memory, GB."""
    sensor = replace(nominal('xyz'), rate_hz=rate_hz, stage_resolution_rad=1e-4)
    motion = rich(np.random.default_rng(1))

    def back_and_forth(path):
        """Return a path that turns round at its end."""
        if path is None:
            return None

        def folded(time_s, order=0):
            """Return a derivative at times on the way there or back."""
            place_s = np.mod(time_s, 2 * motion.duration_s)
            back = place_s > motion.duration_s
            return path(
                np.where(back, 2 * motion.duration_s - place_s, place_s), order
            ) * np.where(back, (-1.0) ** order, 1.0)

        return folded

    longer = replace(
        motion,
        duration_s=duration_s,
        **{
            name: back_and_forth(getattr(motion, name))
            for name in ('alpha', 'beta', 'shift', 'temperature_c', 'supply_v')
        },
    )
    columns = simulate(with_effects(sensor, list(effects)), longer, 1)
    time_s = columns.pop('time_s')
    path, params = folder / 'recording.csv', folder / 'params.yaml'
    parameter_file.save(params, sensor, [])
    with recording.writer(path, sensor) as write:
        write(Recording(str(path), time_s, columns, sensor_info(sensor)))
    before = standard_work()
    process = subprocess.Popen(
        [
            sys.executable,
            '-c',
            _DIAGNOSE,
            str(path),
            '--params',
            str(params),
            '-o',
            str(folder / 'report'),
        ],
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    )
    shown = process.stdout.read()
    _, _, used = os.wait4(process.pid, 0)
    highest_kib = int(shown.split()[-2])
    assert (folder / 'report' / 'report.json').exists()
    slower = max(before, standard_work()) / STANDARD_S
    return (used.ru_utime + used.ru_stime) / slower, highest_kib / 2**20


def test_five_minutes_at_250_hz_take_eight_seconds(tmp_path):
    seconds = [
        used_by(tmp_path, 250.0, 300.0, *effects)[0]
        for effects in (
            (),
            ('hysteresis',),
            ('lever_arm', 'temperature_bias'),
            ('bias_walk', 'nonlinearity'),
        )
    ]
    assert np.median(seconds) < 8.0
    assert max(seconds) < 12.0


def test_ten_minutes_at_1_khz_take_25_s_and_1_gb(tmp_path):
    seconds, gigabytes = used_by(tmp_path, 1000.0, 600.0, 'backlash', 'cross_axis')
    assert seconds < 25.0
    assert gigabytes < 1.0
