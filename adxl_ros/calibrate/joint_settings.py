# SPDX-License-Identifier: Apache-2.0

"""
Numbers of the settings of a joint: poses between which it did not move share its error.

A joint has moved if its encoder or its command says so. `recorded_settings` numbers the rests of a
recording afterwards, `SettingTracker` the poses of a sweep that runs.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from typing import Any

from adxl_ros.files.sweep_journal import PoseRecord
from adxl_ros.model.constants import SAME_ANGLE_RAD
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.block_statistics import held_values
import numpy as np

ENCODER_STEPS = 1.5
"""Largest change of an encoder at rest, in its steps. It may flicker by one step; a move of two is
seen."""
COMMAND_RAD = 1e-9
"""Commands that differ by less are equal, rad: above rounding in float64, below the step of any
encoder."""
_MAX_READINGS = 100_000
"""Largest number of readings in memory; older ones are forgotten. They are 1000 s at 100 Hz, more
than lies between two poses, and some 20 MB."""
_Stamped = tuple[float, tuple[float, ...]]
"""A stamp, ns, and the angles of both joints from then on, rad."""


def angle_tolerance_rad(sensor: Sensor) -> float:
    """Return the largest change of an encoder's reading that is no move, rad."""
    return max(ENCODER_STEPS * sensor.stage_resolution_rad, SAME_ANGLE_RAD)


def _moved(
    readings_rad: np.ndarray,
    before_rad: Any,
    commands_rad: np.ndarray,
    held_rad: Any,
    tolerance_rad: float,
) -> Any:
    """
    Return whether joints have moved from one pose to the next, by their encoder or their command.

    readings_rad, before_rad: readings between the poses with the mean of the second one, (n,) or
    (n, joints), and the mean of the first one; commands_rad, held_rad: commands between the poses,
    and the one before. NaN where there is none.
    """
    # fmin and fmax leave NaN out.
    lowest_rad = np.fmin.reduce(readings_rad, axis=0)
    highest_rad = np.fmax.reduce(readings_rad, axis=0)
    reading_change_rad = np.fmax(highest_rad - before_rad, before_rad - lowest_rad)
    lowest_command_rad = np.fmin.reduce(commands_rad, axis=0, initial=np.nan)
    highest_command_rad = np.fmax.reduce(commands_rad, axis=0, initial=np.nan)
    command_change_rad = np.fmax(highest_command_rad - held_rad, held_rad - lowest_command_rad)
    is_first_command = np.isnan(held_rad) & np.isfinite(highest_command_rad)
    return (
        (reading_change_rad > tolerance_rad)
        | (command_change_rad > COMMAND_RAD)
        | is_first_command
    )


def recorded_settings(
    rests: np.ndarray,
    readings_rad: np.ndarray | None,
    commands_rad: np.ndarray | None,
    tolerance_rad: float,
) -> np.ndarray:
    """
    Return the number of the setting of one joint in each rest of a recording, (k,) int.

    rests: first row and row after the last of each rest, (k, 2), in any order; readings_rad,
    commands_rad: encoder and command at each sample, (n,); NaN or None where there is none.
    """
    missing = np.full(int(rests.max(initial=0)), np.nan)
    if readings_rad is None:
        readings_rad = missing
    if commands_rad is None:
        commands_rad = missing
    order = np.argsort(rests[:, 0], kind='stable')
    start, stop = rests[order].T
    middle = (start + stop) // 2
    means_rad = np.array([mean_of_finite(readings_rad[a:b]) for a, b in zip(start, stop)])
    before_rad = held_values(means_rad, np.isfinite(means_rad))
    held_rad = held_values(commands_rad, np.isfinite(commands_rad))
    moved = [
        _moved(
            np.append(readings_rad[middle[i] : middle[i + 1]], means_rad[i + 1]),
            before_rad[i],
            commands_rad[start[i] + 1 : start[i + 1] + 1],
            held_rad[start[i]],
            tolerance_rad,
        )
        for i in range(len(rests) - 1)
    ]
    settings = np.zeros(len(rests), int)
    settings[order[1:]] = np.cumsum(moved)
    return settings


def mean_of_finite(values: np.ndarray) -> float:
    """Return the mean of the finite values; NaN without any."""
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if finite.size else float('nan')


class SettingTracker:
    """Numbers the settings of alpha and beta while a sweep runs, after those of its poses."""

    def __init__(self, tolerance_rad: float, taken: Sequence[PoseRecord] = ()) -> None:
        self._tolerance_rad = tolerance_rad
        # Numbers of the newest settings of alpha and beta; −1 before the first
        self._settings = np.array([-1, -1])
        for record in taken:
            numbers = (record.alpha_setting, record.beta_setting)
            known = [-1 if number is None else number for number in numbers]
            self._settings = np.maximum(self._settings, known)
        self._mean_rad = np.full(2, np.nan)  # Angles of the newest pose
        self._readings: deque[_Stamped] = deque(maxlen=_MAX_READINGS)
        self._commands: deque[_Stamped] = deque(maxlen=_MAX_READINGS)
        # First and last stamp of the newest pose, ns; None if the stage may have moved unseen
        self._newest_ns: tuple[int, int] | None = None

    def read(self, stamp_ns: int, alpha_rad: float, beta_rad: float) -> None:
        """Add an encoder reading."""
        self._readings.append((stamp_ns, (alpha_rad, beta_rad)))

    def between(self, first_ns: int, last_ns: int) -> np.ndarray:
        """Return the encoder's angles alpha and beta between two stamps, rad, (n, 2)."""
        return _between(self._readings, first_ns - 1, last_ns)

    def command(self, stamp_ns: int, alpha_rad: float, beta_rad: float) -> None:
        """Add a command, which is in force from its stamp on."""
        before = self._commands[-1][1] if self._commands else (np.nan, np.nan)
        # A joint without a command keeps the one before.
        new = tuple(a if np.isfinite(a) else b for a, b in zip((alpha_rad, beta_rad), before))
        if new != before:
            self._commands.append((stamp_ns, new))

    def lose_track(self) -> None:
        """Count both joints as moved before the next pose; stamps may begin again."""
        self._newest_ns = None
        self._readings.clear()
        held = [angles for _, angles in self._commands][-1:]
        self._commands.clear()
        self._commands.extend((-np.inf, angles) for angles in held)

    def settings(
        self, start_ns: int, stop_ns: int, alpha_rad: float, beta_rad: float
    ) -> tuple[int, int]:
        """Return the numbers of the settings of alpha and beta in the next pose."""
        if self._newest_ns is None:
            moved = np.ones(2, bool)
        else:
            first_ns, last_ns = self._newest_ns
            seen = _between(self._readings, (first_ns + last_ns) // 2, (start_ns + stop_ns) // 2)
            given = _between(self._commands, -np.inf, first_ns)
            moved = _moved(
                np.vstack([seen, (alpha_rad, beta_rad)]),
                self._mean_rad,
                _between(self._commands, first_ns, start_ns),
                given[-1] if len(given) else np.full(2, np.nan),
                self._tolerance_rad,
            )
        alpha, beta = self._settings + moved
        return int(alpha), int(beta)

    def take(self, start_ns: int, stop_ns: int, alpha_rad: float, beta_rad: float) -> None:
        """Make a pose the newest one."""
        self._settings = np.array(self.settings(start_ns, stop_ns, alpha_rad, beta_rad))
        mean_rad = np.array([alpha_rad, beta_rad])
        self._mean_rad = np.where(np.isfinite(mean_rad), mean_rad, self._mean_rad)
        self._newest_ns = start_ns, stop_ns


def _between(kept: Iterable[_Stamped], after_ns: float, last_ns: float) -> np.ndarray:
    """Return the angles after a stamp, up to another one, rad, (n, 2)."""
    return np.array(
        [angles for stamp_ns, angles in kept if after_ns < stamp_ns <= last_ns]
    ).reshape(-1, 2)
