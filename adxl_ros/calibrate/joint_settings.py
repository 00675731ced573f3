# SPDX-License-Identifier: Apache-2.0

"""
Settings of a joint: the poses between which the stage has not moved it.

A joint that has not moved between two poses keeps its position error; a move draws a new error.
Every pose has the number of the setting of each joint. A joint has moved between two successive
poses when its encoder or its command has moved:

- The encoder has moved when a reading, or the mean of the later pose, is farther from the mean of
  the earlier pose than `angle_tolerance_rad`. A joint that moves away and back has moved.
- The command has moved when a commanded angle differs from the one in force at the earlier pose.
  A command that is repeated is no move. The first command of all is a move.

Readings count from the middle of the earlier rest to the middle of the later rest. A rest that is
found in a recording may end shortly after the next move has begun, and begin shortly before the
last move has ended: its middle is clear of both. Commands count from the beginning of the earlier
rest to the beginning of the later rest. A controller takes its time, so that the next command may
come long before the rest ends, but the command that the joint obeys comes before the rest begins.

`recorded_settings` numbers the rests of a recording, `SettingTracker` the poses of a live sweep.
"""

from __future__ import annotations

from collections import deque
from itertools import islice, pairwise, takewhile

from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.rest_detection import SAME_ANGLE_RAD
import numpy as np

ENCODER_STEPS = 1.5
"""Largest change of an encoder at rest, in its steps. Chosen: it may flicker by one step."""
COMMAND_RAD = 1e-9
"""Commands that differ by less are equal, rad. Chosen: above the rounding of a message."""
_MAX_READINGS = 20_000
"""Largest number of readings in memory; older readings are reduced to their extremes. Chosen:
200 s at 100 Hz."""


def angle_tolerance_rad(sensor: Sensor) -> float:
    """Return the largest change of an encoder's reading that is no move, rad."""
    return max(ENCODER_STEPS * sensor.stage_resolution_rad, SAME_ANGLE_RAD)


def encoder_moved(low_rad: np.ndarray, high_rad: np.ndarray, mean_rad: np.ndarray,
                  tolerance_rad: float) -> np.ndarray:
    """Return whether the encoder has moved between poses; False without readings."""
    return np.fmax(high_rad - mean_rad, mean_rad - low_rad) > tolerance_rad


def command_moved(low_rad: np.ndarray, high_rad: np.ndarray, held_rad: np.ndarray) -> np.ndarray:
    """Return whether the command has moved between poses."""
    changed = np.fmax(high_rad - held_rad, held_rad - low_rad) > COMMAND_RAD
    return changed | (np.isnan(held_rad) & np.isfinite(high_rad))


def recorded_settings(rests: np.ndarray, readings_rad: np.ndarray | None,
                      commands_rad: np.ndarray | None, tolerance_rad: float) -> np.ndarray:
    """
    Return the number of the setting of one joint in each rest of a recording, (k,) int.

    rests: first row and row after the last of each rest, (k, 2), in any order; readings_rad,
    commands_rad: encoder and command at each sample, rad, (n,); NaN where there is none. None for
    a joint without them. A command stays in force until the next one.; returns: numbers from 0 in
    the order of time, (k,) int.
    """
    order = np.argsort(rests[:, 0], kind='stable')
    start, stop = rests[order].T
    moved = np.zeros(max(len(start) - 1, 0), bool)
    if readings_rad is not None and len(moved):
        mean = np.array([mean_of_finite(readings_rad[a:b]) for a, b in zip(start, stop)])
        low, high = _extremes(readings_rad, (start + stop) // 2)
        moved |= encoder_moved(np.fmin(low, mean[1:]), np.fmax(high, mean[1:]),
                               _last_finite(mean)[:-1], tolerance_rad)
    if commands_rad is not None and len(moved):
        commands = np.where(np.isfinite(commands_rad), commands_rad, np.nan)
        moved |= command_moved(*_extremes(commands, start + 1), _in_force(commands, start[:-1]))
    settings = np.zeros(len(start), int)
    settings[order[1:]] = np.cumsum(moved)
    return settings


def _extremes(values: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the least and the greatest value from each row to the next, (k - 1,) each."""
    parts = [values[first:stop] for first, stop in pairwise(rows)]
    return (np.array([np.fmin.reduce(part, initial=np.nan) for part in parts]),
            np.array([np.fmax.reduce(part, initial=np.nan) for part in parts]))


def _in_force(commands: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return the last command given up to each row; NaN before the first one."""
    given = np.flatnonzero(np.isfinite(commands))
    values = np.concatenate([[np.nan], commands[given]])
    return values[np.searchsorted(given, rows, 'right')]


def _last_finite(values: np.ndarray) -> np.ndarray:
    """Replace each NaN by the last finite value before it; NaN stays where there is none."""
    last = np.maximum.accumulate(np.where(np.isfinite(values), np.arange(len(values)), -1))
    return np.where(last < 0, np.nan, values[last])


def mean_of_finite(values: np.ndarray) -> float:
    """Return the mean of the finite values; NaN without any."""
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if finite.size else float('nan')


class SettingTracker:
    """
    Numbers the settings of alpha and beta while a sweep runs.

    Memory is bounded: since the last pose, readings older than the newest 20 000 are reduced to
    their extremes.
    """

    def __init__(self, tolerance_rad: float, highest: tuple[int, int] = (-1, -1)) -> None:
        self._tolerance_rad = tolerance_rad
        self._settings = np.array(highest)
        self._mean_rad = np.full(2, np.nan)
        self._readings, self._commands = _Window(), _Window()
        self._unseen = True

    def read(self, stamp_ns: int, alpha_rad: float, beta_rad: float) -> None:
        """Add an encoder reading."""
        self._readings.add(stamp_ns, (alpha_rad, beta_rad))

    def command(self, stamp_ns: int, alpha_rad: float, beta_rad: float) -> None:
        """Add a command, which is in force from its stamp on."""
        before = self._commands.newest
        new = tuple(a if np.isfinite(a) else b for a, b in zip((alpha_rad, beta_rad), before))
        if new != before:
            self._commands.add(stamp_ns, new)

    def lose_track(self) -> None:
        """
        Count both joints as moved before the next pose: the stage may have moved unseen.

        Later stamps may be smaller than the former ones, since a clock may have been set.
        """
        self._unseen = True
        for window in (self._readings, self._commands):
            window.begin(None)

    def settings(self, start_ns: int, stop_ns: int, alpha_rad: float, beta_rad: float
                 ) -> tuple[int, int]:
        """Return the numbers of the settings of alpha and beta in the next pose."""
        middle_ns, mean = (start_ns + stop_ns) // 2, np.array([alpha_rad, beta_rad])
        low, high = self._readings.extremes(middle_ns)
        moved = encoder_moved(np.fmin(low, mean), np.fmax(high, mean), self._mean_rad,
                              self._tolerance_rad)
        moved |= command_moved(*self._commands.extremes(start_ns),
                               np.array(self._commands.before))
        alpha, beta = self._settings + (moved | self._unseen)
        return int(alpha), int(beta)

    def take(self, start_ns: int, stop_ns: int, alpha_rad: float, beta_rad: float) -> None:
        """Make a pose the newest one."""
        self._settings = np.array(self.settings(start_ns, stop_ns, alpha_rad, beta_rad))
        mean = np.array([alpha_rad, beta_rad])
        self._mean_rad = np.where(np.isfinite(mean), mean, self._mean_rad)
        self._unseen = False
        self._readings.begin((start_ns + stop_ns) // 2)
        self._commands.begin(start_ns)


class _Window:
    """Angles of two joints since the last pose."""

    def __init__(self) -> None:
        # The last angles up to that pose, rad; NaN without any
        self.before: tuple[float, ...] = (float('nan'), float('nan'))
        self.newest: tuple[float, ...] = self.before  # The newest angles, rad
        self._recent: deque[tuple[int, tuple[float, ...]]] = deque()
        self._older = np.full((2, 2), np.nan)

    def add(self, stamp_ns: int, angles_rad: tuple[float, ...]) -> None:
        """
        Append angles.

        angles_rad: angles of both joints, rad, (2,).
        """
        self.newest = angles_rad
        self._recent.append((stamp_ns, angles_rad))
        if len(self._recent) > _MAX_READINGS:
            _, oldest = self._recent.popleft()
            self._older = np.array([np.fmin(self._older[0], oldest),
                                    np.fmax(self._older[1], oldest)])

    def extremes(self, stamp_ns: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the least and the greatest angles up to a stamp, rad, (2,) each."""
        recent = [angles for _, angles in islice(self._recent, self._count(stamp_ns))]
        angles_rad = np.vstack([self._older, *recent])
        return np.fmin.reduce(angles_rad), np.fmax.reduce(angles_rad)

    def begin(self, stamp_ns: int | None) -> None:
        """Forget the angles up to a stamp, or all of them."""
        for _ in range(len(self._recent) if stamp_ns is None else self._count(stamp_ns)):
            _, self.before = self._recent.popleft()
        self._older = np.full((2, 2), np.nan)

    def _count(self, stamp_ns: int) -> int:
        """Count the stored angles up to the last one whose stamp is not later."""
        later = takewhile(lambda kept: kept[0] > stamp_ns, reversed(self._recent))
        return len(self._recent) - sum(1 for _ in later)
