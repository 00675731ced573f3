# SPDX-License-Identifier: Apache-2.0
"""Run the arm in a simulator, and diagnose its accelerometer against its own joints."""

from __future__ import annotations

from collections.abc import Callable
from datetime import date
from importlib.metadata import version
from pathlib import Path

import adxl_ros as adxl
from adxl_ros.diagnose.screen import as_shown, size_lines
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.process import package_version
from adxl_ros.simulate.robot import Robot
from adxl_ros_validation.simulators import arm
from adxl_ros_validation.simulators.base import Checked, MOVED, Simulator
import numpy as np
import scipy

IDEAL = Path(__file__).parents[1] / 'pages' / 'ideal_imu.yaml'
"""Parameters of the sensor that a simulator simulates."""
_NOISE_MG = 0.3
"""Noise that is added to a sample, mg, as IDEAL states it: intervals need one. Chosen: below that
of most sensors."""
_FIRST = 25
"""Steps after a reset that are compared with those of a fresh start; chosen: 50 ms."""
_EDGE = 250
"""Samples at each end whose joints have no neighbours for their derivatives; chosen: 1 s."""
_BLOCKS = 18
"""Blocks of time that are left out in turn; chosen: 2 s each."""
_LATE_S = 1e-4
"""Delay whose effect is taken, s; chosen: linear."""
_ASKED = ('scale_factor', 'reference_frame', 'lever_arm', 'time_offset')
"""Effects whose smallest size that would have shown is stated."""


def _first_readings(simulator: Simulator) -> np.ndarray:
    """Restart, and return the readings before and after the first steps, m/s², (n, 3)."""
    simulator.restart()
    readings = [simulator.accelerometer()]
    for _ in range(_FIRST):
        simulator.step()
        readings.append(simulator.accelerometer())
    return np.array(readings)


def run(simulator: Simulator, advance: Callable[[float], None]) -> tuple[np.ndarray, np.ndarray]:
    """
    Return stamps, readings and joints, (n, 7), and the first readings of both starts, (2, k, 3).

    The second start is a reset in mid-run.
    """
    fresh = _first_readings(simulator)
    simulator.restart()
    rows, count = [], round(arm.SECONDS / arm.STEP_S)
    for step in range(1, count + 1):
        simulator.step()
        if step % arm.EVERY == 0:
            rows.append([step * arm.STEP_S, *simulator.accelerometer(), *simulator.angles()])
            advance(step / count)
    return np.array(rows), np.array([fresh, _first_readings(simulator)])


def check(
    simulator: Simulator, path: Path, seed: int, advance: Callable[[float], None]
) -> Checked:
    """Run a simulator, write its recording, and diagnose it."""
    table, starts = run(simulator, advance)
    force_mps2, late_mps2 = _stated(table)
    left = table[_EDGE:-_EDGE, 1:4] - force_mps2
    late_ms, explained = _lateness(left, late_mps2)
    noise = np.random.default_rng(seed).normal(size=(len(table), 3)) * _NOISE_MG
    head = 'time_s,ax_mps2,ay_mps2,az_mps2,joint1_rad,joint2_rad,joint3_rad'
    noisy = table + np.pad(noise * 1e-3 * G0_MPS2, ((0, 0), (1, 3)))
    np.savetxt(path, noisy, '%.12g', ',', header=head, comments='')
    gap = adxl.diagnose(adxl.read(path), IDEAL, urdf=arm.URDF, frame=arm.FRAME)
    asked = [as_shown(row, 1.0) for row in gap.could_show if row.name.effect in _ASKED]
    away_mg = np.linalg.norm(starts[1] - starts[0], axis=1) / G0_MPS2 * 1e3
    return Checked(
        f'{date.today()}, adxl_ros {package_version()}',
        f'{simulator.library} {version(simulator.library)}',
        simulator.reads,
        float(np.sqrt(np.mean(left**2)) / G0_MPS2 * 1e3),
        gap.first_screen.word,
        _named(gap),
        [f'{each.effect} {each.smallest}' for each in asked],
        late_ms,
        explained,
        float(np.linalg.norm(starts[0][0])),
        float(away_mg[0]),
        float(away_mg[1:].max()),
    )


def _named(gap: adxl.Gap) -> list[str]:
    """Return the effects of a verdict with their sizes, or the fault, in words."""
    report = gap.diagnosis.report
    if report is None:
        return [gap.fault]
    candidates = {each['effect']: each for each in gap.to_dict()['candidates']}
    sizes = {effect.name: size_lines(report, candidates[effect.name]) for effect in gap.effects}
    return [f'{name}: {", ".join(lines)}' for name, lines in sizes.items()]


def _stated(table: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Return what the joints say the sensor reads, and its change by what is late.

    The angles of a simulator are exact, so that a spline through them has their derivatives. The
    attitude turns gravity and acceleration into the sensor; rates make the centripetal part.
    returns: m/s², (n, 3), and m/s² for a delay of 1 s of each of MOVED, (3, n, 3)
    """
    spline = scipy.interpolate.make_interp_spline(table[:, 0], table[:, 4:], 7)
    time_s = table[_EDGE:-_EDGE, 0]
    joints = np.array([spline(time_s, order) for order in range(3)])
    robot = Robot(arm.URDF, arm.FRAME)
    force, rate = robot.motion(joints, None, G0_MPS2)[:2]
    turned = np.cross(rate, force)
    jerk = scipy.interpolate.make_interp_spline(time_s, force, 5)(time_s, 1) + turned
    joints[1] -= _LATE_S * joints[2]
    slower = (robot.motion(joints, None, G0_MPS2)[0] - force) / _LATE_S
    return force, np.array([turned, -jerk, slower])


def _lateness(left: np.ndarray, changes: np.ndarray) -> tuple[dict[str, list[float]], float]:
    """Fit how late each of MOVED is, ms, with 90 % intervals by a jackknife."""
    columns = changes.transpose(1, 2, 0)

    def fit(rows: np.ndarray) -> np.ndarray:
        return np.linalg.lstsq(columns[rows].reshape(-1, 3), left[rows].ravel())[0]

    every = np.arange(len(left))
    whole = fit(every)
    parts = np.array([fit(np.setdiff1d(every, p)) for p in np.array_split(every, _BLOCKS)])
    std = np.sqrt((_BLOCKS - 1) * np.mean((parts - parts.mean(axis=0)) ** 2, axis=0))
    reach = scipy.stats.t.ppf(0.95, _BLOCKS - 1) * std
    ends = np.array([whole, whole - reach, whole + reach]).T * 1e3
    after = np.mean((left - columns @ whole) ** 2)
    return dict(zip(MOVED, ends.tolist())), float(1 - after / np.mean(left**2))
