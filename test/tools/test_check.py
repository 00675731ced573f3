# SPDX-License-Identifier: Apache-2.0

"""The tool `check`: faults of stamps and samples, what other tools can do, and damaged files."""

from collections.abc import Callable
from dataclasses import replace
import json
from pathlib import Path
import shlex
import subprocess

import adxl_ros as adxl
from adxl_ros.calibrate.fits import gravity_fit
from adxl_ros.diagnose import motion_shifts
from adxl_ros.signals import findings
from bags import bag_of, imu, stamps
import numpy as np
from processes import run_in_process
import pytest
from still_noise import write_csv

RATE_HZ = 100.0
G = 9.80665


def samples(seconds: float = 60.0) -> tuple[np.ndarray, np.ndarray]:
    time_s = np.arange(int(seconds * RATE_HZ)) / RATE_HZ
    rng = np.random.default_rng(1)
    directions = rng.normal(size=(int(seconds // 5) + 2, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    place = time_s / 5
    moved = np.clip((place % 1) * 5, 0, 1)[:, None]
    first = place.astype(int)
    force = directions[first] * (1 - moved) + directions[first + 1] * moved
    return time_s, G * force + rng.normal(0, 0.02, force.shape)


def test_the_needs_of_other_tools_are_theirs() -> None:
    assert gravity_fit.SIX.min_rests == findings.FEWEST_GRAVITY_POSES
    assert findings.SHORTEST_MOTION_S == motion_shifts.SHORTEST_S


def run(folder: Path, *arguments: str) -> subprocess.CompletedProcess:
    done = run_in_process('check', *arguments, cwd=folder)
    assert done.stderr == ''
    return done


def checked(folder: Path, *arguments: str) -> dict:
    done = run(folder, *arguments, '--json')
    (result,) = json.loads(done.stdout)
    assert done.returncode == (0 if result['sound'] else 1)
    return result


def test_a_sound_recording(tmp_path: Path) -> None:
    time_s, accel = samples()
    write_csv(
        tmp_path / 'turned.csv',
        time_s,
        accel,
        temperature_c=25 + time_s / 60,
        supply_v=np.full(len(time_s), 5.0),
    )
    result = checked(tmp_path, 'turned.csv')
    contents = result['contents']
    assert result['faults'] == []
    assert contents['rate_hz'] == pytest.approx(RATE_HZ)
    assert (contents['samples'], contents['missing'], contents['gaps']) == (6000, 0, 0)
    assert contents['rests'] >= 10
    assert 0.5 < contents['rest_share'] < 0.9
    assert contents['gravity']['length_mps2'] == pytest.approx(9.81, abs=0.1)
    assert contents['reference_ranges']['temperature_c'] == pytest.approx([25.0, 26.0], abs=0.01)
    assert contents['reference_ranges']['supply_v'] == [5.0, 5.0]
    assert result['can']['fit']['able']
    assert not result['can']['diagnose']['able']
    assert 'stage angles' in result['can']['diagnose']['reason']


def clipped(time_s: np.ndarray, accel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    shaken = 3 * G * np.sin(2 * np.pi * 2 * time_s) * ((time_s > 10) & (time_s < 20))
    accel[:, 0] = np.clip(accel[:, 0] + shaken, -2 * G, 2 * G)
    return time_s, accel


def clipped_slowly(time_s: np.ndarray, accel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Change so slowly from sample to sample that no single step is large."""
    is_moved = (time_s > 10) & (time_s < 30)
    swing = 3 * G * np.sin(np.pi * time_s / 2.5)
    accel[is_moved, 0] = np.clip(swing[is_moved], -2 * G, 2 * G)
    accel[is_moved, 1] = G * np.sin(20 * time_s[is_moved])
    return time_s, accel


ROW = np.arange(6000)


@pytest.mark.parametrize(
    ('change', 'count', 'fault'),
    [
        (
            lambda t, a: (t[abs(t - 21.5) > 1.5], a[abs(t - 21.5) > 1.5]),
            1,
            '301 samples are missing',
        ),
        (
            lambda t, a: (t[np.where((ROW >= 100) & (ROW < 103), 99, ROW)], a),
            1,
            'samples with the stamp of the one before: 3',
        ),
        (
            lambda t, a: (t - 2.0 * ((ROW >= 1000) & (ROW < 1005)), a),
            1,
            'samples whose stamp steps back: 5',
        ),
        (
            lambda t, a: (np.sort(t + np.random.default_rng(2).uniform(0, 0.02, len(t))), a),
            1,
            'stamps scatter by',
        ),
        (lambda t, a: (t, a * [1, 0, 1]), None, 'ay_mps2 never changes'),
        (clipped, 1, 'ax_mps2 stays at its extreme value'),
        (clipped_slowly, 1, 'ax_mps2 stays at its extreme value'),
        (
            lambda t, a: (t, np.c_[a[:, :2], a[np.minimum(ROW, 4499), 2]]),
            1,
            'az_mps2 does not change for 15 s',
        ),
        (
            lambda t, a: (t, a[np.where(ROW // 600 == 5, 2999, ROW)]),
            3,
            'ay_mps2 does not change for 6 s',
        ),
        (lambda t, a: (t, a / G), None, 'values in g'),
    ],
)
def test_each_fault_is_named(
    tmp_path: Path, change: Callable, count: int | None, fault: str
) -> None:
    write_csv(tmp_path / 'faulty.csv', *change(*samples()))
    faults = checked(tmp_path, 'faulty.csv')['faults']
    assert any(fault in text for text in faults), faults
    assert count in (None, len(faults)), faults


@pytest.mark.parametrize('rate_hz', [0.0012345, 0.05, 100_000.0])
def test_the_columns_of_the_table_stay_apart(rate_hz: float) -> None:
    ax, ay, az = samples()[1].T
    recorded = adxl.from_arrays(rate=rate_hz, ax_mps2=ax, ay_mps2=ay, az_mps2=az)
    assert f' {rate_hz:.4g} Hz ' in adxl.check(recorded).screen[1]


def test_a_coarse_sensor_at_rest_is_sound(tmp_path: Path) -> None:
    """Equal samples at an extreme value and for a second are no fault where the steps are wide."""
    time_s, accel = samples()
    accel = np.round(accel / 0.3) * 0.3
    write_csv(tmp_path / 'coarse.csv', time_s, accel)
    assert checked(tmp_path, 'coarse.csv')['faults'] == []


def test_a_damaged_file_does_not_stop_the_others(tmp_path: Path) -> None:
    write_csv(tmp_path / 'good.csv', *samples())
    (tmp_path / 'damaged.mcap').write_bytes(b'\x89MCAP0\r\n' + bytes(100))
    (tmp_path / 'text.csv').write_text('time_s,ax_mps2\n1.0,none\n')
    done = run(tmp_path, 'damaged.mcap', 'good.csv', 'text.csv', 'missing.csv', '--report', 'page')
    assert done.returncode == 1
    assert max(map(len, done.stdout.splitlines())) <= 79
    rows = {line.split()[0]: line for line in done.stdout.splitlines() if line.startswith(' ')}
    assert rows['good.csv'].endswith('sound')
    for name in ('damaged.mcap', 'text.csv', 'missing.csv'):
        assert rows[name].endswith('unreadable')
    assert '1 of 4 recordings is sound.' in done.stdout
    page = (tmp_path / 'page' / 'check.html').read_text()
    assert all(name in page for name in ('good.csv', 'damaged.mcap', 'missing.csv'))


def test_wrong_usage_is_status_2(tmp_path: Path) -> None:
    assert run_in_process('check', cwd=tmp_path).returncode == 2


def test_log_time_against_header_time(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    sent = [
        imu(stamp, (*rng.normal(0, 0.02, 2), G + rng.normal(0, 0.02)), variance=[1e-4] * 3)
        for stamp in stamps(1000, 10_000_000)
    ]
    late = [replace(item, log_ns=item.stamp_ns + 250_000_000) for item in sent]
    bag_of(tmp_path / 'late', late)
    result = checked(tmp_path, 'late')
    assert result['contents']['log_delay_s'] == pytest.approx(0.25)
    assert result['sound']
    assert any('log time is 0.25 s after header time' in text for text in result['remarks'])


def test_the_mapping_of_a_foreign_log_is_one_line(tmp_path: Path) -> None:
    """A name with blanks is not broken, so that the options can be pasted."""
    time_s, accel = samples()
    names = ';'.join(f'Acceleration {axis} [m/s^2]' for axis in 'xyz')
    np.savetxt(
        tmp_path / 'log.csv',
        np.column_stack([time_s, accel]),
        fmt='%.6g',
        delimiter=';',
        header=f'Time [s];{names}',
        comments='',
    )
    done = run(tmp_path, 'log.csv')
    line = next(line for line in done.stdout.splitlines() if '--columns' in line)
    assert checked(tmp_path, 'log.csv', *shlex.split(line))['sound']


def test_effects_that_a_recording_could_show_are_listed(tmp_path: Path) -> None:
    assert (
        run_in_process(
            'simulate', 'tilt_both', '--rate', '100', '-o', 'moves.csv', cwd=tmp_path
        ).returncode
        == 0
    )
    rows = {row['effect']: row for row in checked(tmp_path, 'moves.csv')['could_show']}
    assert rows['bias']['missing'] == ''
    assert rows['bias']['from'].endswith('mg')
    assert rows['supply']['missing'] == 'needs: step the supply at rest'
    assert rows['reference_delay']['missing'] == 'needs --sim'
    assert 'needs: step the supply at rest' in run(tmp_path, 'moves.csv').stdout
