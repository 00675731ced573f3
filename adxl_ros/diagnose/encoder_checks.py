# SPDX-License-Identifier: Apache-2.0
"""
Whether the angles of a stage have the sign and the unit that the output of the sensor shows.

At rest f = g·[sin α·cos β, −sin α·sin β, cos α]: a wrong sign of β looks like an inverted y, and
one of α like inverted x and y. The explanation with fewer changes is named.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

from adxl_ros.diagnose.comparison import SMALLEST_MOTION_G
from adxl_ros.diagnose.data_faults import DataFault
from adxl_ros.files.recording_columns import JOINTS, Recording
from adxl_ros.model.kinematics import specific_force
from adxl_ros.model.sensor import Sensor
import numpy as np

_SAMPLES = 4000
"""Largest number of samples that are compared with angles. Chosen: a few for each second."""
_WRONG = 0.2
"""Share of the output's variance that angles do not explain, from which they may be wrong. Chosen:
it is 0.03 where the sensor is mounted 10° off."""
_RIGHT = 0.1
"""The same share up to which changed angles are right. Chosen: half of that of wrong ones."""
_SIGNS = ((1, 1), (1, -1), (-1, 1), (-1, -1))
"""Signs of both angles that are tried. The fewest changes come first."""
_AS_RECORDED = (1.0, 1.0)
"""Factors of both angles that change nothing."""
_RAD_PER_DEG = np.pi / 180
_AGED_ZERO_G = 0.01
"""Zero-g, g, from which its sign tells an inverted axis from a wrong angle. Chosen: that of a
healthy unit ages by less."""
_FEWEST_CHANGES = 100
"""Fewest changes of a reading that show the step of its encoder. Chosen: two turns by hand."""
_LARGEST_STEP_RAD = 0.02  # Largest step of an encoder, rad. Chosen: 1°
_COARSER_STEP_RATIO = 1.05
"""Ratio to the stated step from which one counts. Chosen: 1/12° may be stated as 0.083°."""
_WHOLE_STEPS_TOLERANCE = 0.2
"""Deviation of a change from whole steps, in steps, up to which it is one. Chosen: above the
rounding of written angles, and exact readings stay distinct."""
_FEWEST_WHOLE_SHARE = 0.9
"""Share of such changes by encoders. Chosen: 40 % of the changes of exact readings are such."""


@dataclass(frozen=True)
class _StageReadings:
    """Angles of a stage and outputs of a sensor, which is moved."""

    angles_rad: np.ndarray  # (n, 2)
    measured_g: np.ndarray  # (n, m)

    @classmethod
    def of(cls, recording: Recording, sensor: Sensor) -> _StageReadings | None:
        """Return some readings of a recording; None where the sensor does not move."""
        angles_rad = recording.stage_angles
        if angles_rad is None:
            return None
        measured_g = (recording.volts(sensor) - sensor.zero_g_v) / sensor.scale_v_per_g
        rows = np.flatnonzero(np.isfinite(np.hstack([angles_rad, measured_g])).all(axis=1))
        rows = rows[:: max(1, len(rows) // _SAMPLES)]
        readings = cls(angles_rad[rows], measured_g[rows])
        moves = len(rows) > 1 and readings.variance_g2 >= SMALLEST_MOTION_G**2
        return readings if moves else None

    @property
    def variance_g2(self) -> float:
        """Variance of the output, summed over axes, g²."""
        return float(np.var(self.measured_g, axis=0).sum())

    @property
    def reached_rad(self) -> np.ndarray:
        """Largest size of each angle, rad, (2,)."""
        return np.abs(self.angles_rad).max(axis=0)

    def force_g(self, factors: Sequence[float]) -> np.ndarray:
        """Return the force at angles times factors, g, (n, m)."""
        alpha_rad, beta_rad = (self.angles_rad * factors).T
        force_g = np.column_stack(specific_force(alpha_rad, beta_rad, 1.0))
        return force_g[:, : self.measured_g.shape[1]]

    def unexplained(self, factors: Sequence[float]) -> float:
        """Return the share of the variance that angles times factors do not explain."""
        left_g2 = np.var(self.measured_g - self.force_g(factors), axis=0).sum()
        return float(left_g2) / self.variance_g2

    def best_factors(self) -> tuple[float, float]:
        """Return the factors of alpha and beta, signs and units, that explain most."""
        # Angles beyond a turn may be in degrees.
        units = [(1.0, _RAD_PER_DEG) if rad > 2 * np.pi else (1.0,) for rad in self.reached_rad]
        tried = []
        for of_alpha, of_beta in product(*units):
            tried += [(alpha * of_alpha, beta * of_beta) for alpha, beta in _SIGNS]
        return min(tried, key=self.unexplained)

    def mirrored_axes(self, factors: Sequence[float]) -> np.ndarray:
        """Return the numbers of the axes whose force changes with the signs of the angles."""
        change_g = self.force_g(factors) - self.force_g(_AS_RECORDED)
        return np.flatnonzero(np.std(change_g, axis=0) > SMALLEST_MOTION_G)


def check_encoder(recording: Recording, sensor: Sensor) -> None:
    """Refuse an angle with the wrong sign, or in degrees."""
    readings = _StageReadings.of(recording, sensor)
    if readings is None:
        return
    factors = readings.best_factors()
    recorded = readings.unexplained(_AS_RECORDED)
    changed = readings.unexplained(factors)
    if recorded < _WRONG or changed > min(_RIGHT, recorded / 2):
        return
    correlation = f'correlation {np.sqrt(1 - changed):.2f}'
    in_degrees = {
        name: f'{reached_rad:.4g}'
        for name, factor, reached_rad in zip(JOINTS.values(), factors, readings.reached_rad)
        if abs(factor) != 1
    }
    if in_degrees:
        joined = ' and '.join(in_degrees)
        raise DataFault(
            'unit',
            f'{joined}: up to {" and ".join(in_degrees.values())}: degrees in '
            f'a column of radians (as degrees it fits the output, {correlation}); multiply '
            f'{joined} by π/180',
        )
    inverted = [name for name, factor in zip(JOINTS.values(), factors) if factor < 0]
    mirrored = readings.mirrored_axes(factors)
    if len(inverted) > len(mirrored):
        return
    # As many axes as angles may be inverted instead, and their zero-g is then mirrored.
    if len(inverted) == len(mirrored) and _zero_g_is_mirrored(readings, factors, sensor):
        return
    joined = ' and '.join(inverted)
    axes = ' and '.join(sensor.axes[d] for d in mirrored)
    raise DataFault(
        'encoder_sign',
        f'{joined}: opposite sign of the encoder ({correlation} with the sign changed); change '
        f'the sign of {joined}, unless the axis {axes} is inverted',
    )


def _zero_g_is_mirrored(
    readings: _StageReadings, factors: Sequence[float], sensor: Sensor
) -> bool:
    """Determine whether an axis is inverted, not an angle: its zero-g is mirrored, too."""
    axis = readings.mirrored_axes(factors)[0]
    aged_v = sensor.zero_g_v - sensor.nominal_zero_g_v
    zero_g = float((aged_v / sensor.scale_v_per_g)[axis])
    offset_g = float(np.mean(readings.measured_g - readings.force_g(factors), axis=0)[axis])
    return abs(zero_g) > _AGED_ZERO_G and abs(offset_g + 2 * zero_g) < abs(offset_g)


def seen_step_rad(recording: Recording, sensor: Sensor) -> float:
    """Return the step that the encoders show, where it exceeds the stated one, rad."""
    largest_rad = sensor.stage_resolution_rad
    for name in ('alpha_rad', 'beta_rad'):
        changes = np.abs(np.diff(recording.columns.get(name, np.zeros(0))))
        changes = changes[changes > 1e-9]
        if len(changes) < _FEWEST_CHANGES:
            continue
        step_rad = float(np.median(changes[changes < 1.5 * changes.min()]))
        few = changes[changes < 4.5 * step_rad]
        # Readings with decimals differ by one step more or less exactly.
        step_rad = float(few.sum() / np.rint(few / step_rad).sum())
        whole = np.abs(few / step_rad - np.rint(few / step_rad)) < _WHOLE_STEPS_TOLERANCE
        has_steps = whole.sum() >= _FEWEST_CHANGES and whole.mean() > _FEWEST_WHOLE_SHARE
        if has_steps and _COARSER_STEP_RATIO * largest_rad < step_rad < _LARGEST_STEP_RAD:
            largest_rad = step_rad
    return largest_rad
