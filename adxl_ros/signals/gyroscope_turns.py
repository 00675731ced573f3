# SPDX-License-Identifier: Apache-2.0

"""
Whether a gyroscope agrees with its accelerometer, while a recording is read.

Between two rests gravity turns in the frame of the sensor by dg/dt = −ω × g. The gyroscope's
angles, from one rest to the next, must therefore turn the gravity of the first rest into that of
the second. If they do not, the 48 ways to swap axes and signs are tried, in rad/s and in °/s. The
explanation with the fewest changes is named.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise, permutations, product
from typing import NamedTuple

from adxl_ros.files.recording_columns import Recording
from adxl_ros.model.constants import AXES
from adxl_ros.model.error_sizes import rms
from adxl_ros.signals.rest_search import Rest
from adxl_ros.wording import option
import numpy as np
import scipy

_CELL_S = 0.05  # Time over which angles are summed, s. Chosen: a hand turns its axis more slowly
_LONGEST_S = 3600.0  # Time from the begin that is looked at, s; it bounds the memory
_LONGEST_TURN_S = 60.0  # Longest time between two rests, s. Chosen: its drift is below 20°
_SMALLEST_TURN = 2 * np.sin(np.radians(20.0) / 2)  # Distance of two directions that differ by 20°
_MOST_TURNS = 12  # Largest turns that are looked at. Chosen: each axis turns several times
_WRONG = 0.3  # Error, in turns, from which angles may be wrong. Chosen: ten times a scale error
_BETTER = 0.5  # Error, in that of the readings as they are, of a way that explains them
_EQUAL = 1.2  # Ratio of the errors of two ways up to which the one with fewer changes counts
_LARGEST_BIAS_RADPS = float(np.radians(20.0))
"""Largest reading at rest, rad/s: the zero-rate output of an MPU-6050 (PS-MPU-6000A Rev. 3.4)."""
_LARGEST_RADPS = float(np.radians(4000.0))
"""Largest range of an IMU's gyroscope, rad/s: that of an ICM-45686 (DS-000577)."""
_ROUNDED = 1.01  # Ratio to a limit by which rounding and noise pass it


class _Way(NamedTuple):
    """How the readings of a gyroscope may be meant."""

    matrix: np.ndarray  # Turns readings into rad/s in the frame of the accelerometer, (3, 3)
    is_degrees: bool

    @property
    def changes(self) -> int:
        """Return how many axes are not as they should be."""
        return int((np.sign(self.matrix) != np.eye(3)).any(axis=1).sum())

    @property
    def text(self) -> str:
        """Return for each axis of the accelerometer the reading that turns about it."""
        axes = []
        for axis, weights in zip(AXES, self.matrix):
            column = int(np.abs(weights).argmax())
            sign = '-' if weights[column] < 0 else ''
            axes.append(f'{axis} is {sign}g{AXES[column]}')
        return ', '.join(axes)


def _ways() -> list[_Way]:
    """Return all ways, those with fewer changes first."""
    ways = []
    for is_degrees in (False, True):
        factor = np.pi / 180 if is_degrees else 1.0
        for order, signs in product(permutations(range(3)), product((1, -1), repeat=3)):
            matrix = np.eye(3)[list(order)] * np.array(signs)[:, None] * factor
            ways.append(_Way(matrix, is_degrees))
    return sorted(ways, key=lambda way: way.changes)


@dataclass(frozen=True)
class GyroFindings:
    """What a recording shows of its gyroscope."""

    bias_radps: tuple[float, ...]  # Median over the rests of its mean by axis; none without rests
    largest_radps: float  # Largest reading
    turns: int  # Turns between two rests that were compared with gravity
    # Rms angle by which it misses the direction of gravity after a turn, rad; NaN without turns
    error_rad: float
    faults: tuple[str, ...]  # What is wrong with it, one line each


class _Turn(NamedTuple):
    """A turn between two rests."""

    before: np.ndarray  # Direction of gravity before, (3,)
    after: np.ndarray  # The same after it, (3,)
    angles: np.ndarray  # Sums of the readings over short times, rad, (k, 3)

    @property
    def size(self) -> float:
        """Return the distance of both directions."""
        return float(np.linalg.norm(self.after - self.before))


class GyroLook:
    """Looks at the gyroscope of a recording while it is read."""

    def __init__(self, first: Recording) -> None:
        self._period_s = 1 / first.rate_hz
        self._rows = max(round(_CELL_S / self._period_s), 1)
        self._first_s = float(first.time_s[0])
        self._time_s: list[np.ndarray] = []  # Time of each cell, s
        self._angles: list[np.ndarray] = []  # Sum of the readings in it, rad, (k, 3)
        self._spans_s: list[np.ndarray] = []  # Length of each, s
        self._largest_radps = 0.0

    def feed(self, block: Recording) -> None:
        """Add a block of the recording."""
        gyro_radps = block.gyro_radps
        if gyro_radps is None:
            return
        is_taken = np.isfinite(gyro_radps).all(axis=1)
        if not is_taken.any():
            return
        gyro_radps = gyro_radps[is_taken]
        time_s = block.time_s[is_taken]
        self._largest_radps = max(self._largest_radps, float(np.abs(gyro_radps).max()))
        if time_s[0] - self._first_s > _LONGEST_S:
            return
        steps_s = np.diff(time_s, append=time_s[-1] + self._period_s)
        edges = np.arange(0, len(time_s), self._rows)
        self._time_s.append(time_s[edges])
        self._angles.append(np.add.reduceat(gyro_radps * steps_s[:, None], edges))
        self._spans_s.append(np.add.reduceat(steps_s, edges))

    def result(self, rests: Sequence[Rest], means_mps2: Sequence[np.ndarray]) -> GyroFindings:
        """Compare with rests and the accelerometer's means, m/s², (3,) each."""
        if not self._time_s:
            return GyroFindings((), 0.0, 0, np.nan, ())
        time_s, angles, spans_s = map(np.concatenate, (self._time_s, self._angles, self._spans_s))
        within = [
            (time_s >= rest.time_start_s) & (time_s + spans_s <= rest.time_stop_s)
            for rest in rests
        ]
        rates = [angles[rows].sum(axis=0) / spans_s[rows].sum() for rows in within if rows.any()]
        bias = np.median(rates, axis=0) if rates else np.zeros(3)
        left = angles - bias * spans_s[:, None]
        turns = []
        for (rest, before), (later, after) in pairwise(zip(rests, means_mps2)):
            rows = (time_s >= rest.time_stop_s) & (time_s < later.time_start_s)
            is_short = later.time_start_s - rest.time_stop_s < _LONGEST_TURN_S
            has_direction = len(before) == len(AXES)
            is_usable = is_short and has_direction
            if is_usable and not self._has_gap(spans_s[rows]):
                turns.append(_Turn(_direction(before), _direction(after), left[rows]))
        largest = sorted(turns, key=lambda turn: -turn.size)[:_MOST_TURNS]
        turns = [turn for turn in largest if turn.size > _SMALLEST_TURN]
        error_rad, faults = _disagreement(turns)
        return GyroFindings(
            bias_radps=tuple(bias.tolist()) if rates else (),
            largest_radps=self._largest_radps,
            turns=len(turns),
            error_rad=error_rad,
            faults=tuple(faults or self._alone(bias)),
        )

    def _has_gap(self, spans_s: np.ndarray) -> bool:
        """Return whether samples are missing in cells of some lengths, s, (k,)."""
        return bool(spans_s.max(initial=0.0) > _CELL_S + 2 * self._period_s * self._rows)

    def _alone(self, bias: np.ndarray) -> list[str]:
        """Return what is wrong with the readings themselves."""
        faults = []
        if self._largest_radps > _ROUNDED * _LARGEST_RADPS:
            faults.append(
                f'the gyroscope reads up to {self._largest_radps:.3g} rad/s, and none measures '
                f'more than {_LARGEST_RADPS:.3g} rad/s; if it is in °/s, state dps '
                f'by {option("columns")}, '
                'or convert it to rad/s'
            )
        worst = int(np.abs(bias).argmax())
        if abs(bias[worst]) > _LARGEST_BIAS_RADPS:
            faults.append(
                f'the gyroscope turns at rest: g{AXES[worst]} reads {bias[worst]:.3g} rad/s '
                f'({np.degrees(bias[worst]):.3g} °/s), expected '
                f'{_LARGEST_BIAS_RADPS:.2g} rad/s at most; check its zero, and its unit'
            )
        return faults


def _direction(mean: np.ndarray) -> np.ndarray:
    """Return the direction of a force, (3,)."""
    return mean / np.linalg.norm(mean)


def _disagreement(turns: Sequence[_Turn]) -> tuple[float, list[str]]:
    """Return the rms error of the readings after turns, rad, and why it is large."""
    if not turns:
        return np.nan, []
    ways = _ways()
    squares = np.zeros(len(ways))
    for turn in turns:
        predicted = _turned(turn, np.stack([way.matrix for way in ways]))
        squares += np.sum((predicted - turn.after) ** 2, axis=1) / len(turns)
    errors = np.sqrt(squares)
    size = rms([turn.size for turn in turns])
    # The ways with the fewest changes come first, and of them those in rad/s: as it should be.
    as_stated = errors[0]
    error = float(2 * np.arcsin(min(as_stated / 2, 1.0)))
    if as_stated < _WRONG * size:
        return error, []
    least = errors.min()
    least_deg = np.degrees(2 * np.arcsin(least / 2))
    best = ways[int((errors <= _EQUAL * least).argmax())]
    compared = (
        f'over {len(turns)} turns between rests it misses the direction of gravity by '
        f'{np.degrees(error):.0f}° rms'
    )
    if least > _BETTER * as_stated:
        return error, [
            f'the gyroscope does not follow the accelerometer: {compared}; check its scale '
            'factor and range, and that both are of one sensor, at one time'
        ]
    if best.is_degrees and not best.changes:
        return error, [
            f'the gyroscope is in °/s: {compared}, and as °/s by {least_deg:.0f}°; state dps by '
            f'{option("columns")}, or convert it to rad/s'
        ]
    unit = ' in °/s' if best.is_degrees else ''
    return error, [
        f'the gyroscope has its axes or signs against those of the accelerometer: {compared}, '
        f'and by {least_deg:.0f}° if the rotation about {best.text}{unit}; correct the driver'
    ]


def _turned(turn: _Turn, matrices: np.ndarray) -> np.ndarray:
    """Return the direction of gravity after a turn by readings in k ways, (k, 3)."""
    direction = np.tile(turn.before, (len(matrices), 1))
    # By cell and way, (c, k, 3).
    for rotation in -np.einsum('kij,cj->cki', matrices, turn.angles):
        direction = scipy.spatial.transform.Rotation.from_rotvec(rotation).apply(direction)
    return direction
