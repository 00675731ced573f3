# SPDX-License-Identifier: Apache-2.0

"""
Poses from recordings: rests, their means, angles and settings.

- Settings of a joint: the poses between which the stage has not moved it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence
from typing import Any

from adxl_ros.calibrate.poses import Poses
from adxl_ros.errors import UserError
from adxl_ros.files.recording_columns import COMMANDS, JOINTS, Recording
from adxl_ros.files.sweep_journal import PoseRecord
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals import recorded_sensor
from adxl_ros.signals.rest_detection import (
    datasheet_noise,
    recording_finder,
    Rest,
    rest_means,
    SAME_ANGLE_RAD,
)
import numpy as np

ENCODER_STEPS = 1.5
"""Largest change of an encoder at rest, in its steps. Chosen: it may flicker by one step."""
COMMAND_RAD = 1e-9
"""Commands that differ by less are equal, rad. Chosen: above the rounding of a message."""
_MAX_READINGS = 100_000
"""Largest number of readings in memory; older ones are forgotten. Chosen: 1000 s at 100 Hz."""


def angle_tolerance_rad(sensor: Sensor) -> float:
    """Return the largest change of an encoder's reading that is no move, rad."""
    return max(ENCODER_STEPS * sensor.stage_resolution_rad, SAME_ANGLE_RAD)


def _moved(readings_rad: np.ndarray, before_rad: Any, commands_rad: np.ndarray, held_rad: Any,
           tolerance_rad: float) -> Any:
    """
    Return whether joints have moved from one pose to the next, by their encoder or their command.

    readings_rad, before_rad: readings between the poses and the mean of the second one, rad, (n,)
    or (n, joints), and the mean of the first one; commands_rad, held_rad: commands between the
    poses, and the one before. NaN where there is none.
    """
    low, high = (extreme(readings_rad, axis=0) for extreme in (np.fmin.reduce, np.fmax.reduce))
    first, last = (extreme(commands_rad, axis=0, initial=np.nan)
                   for extreme in (np.fmin.reduce, np.fmax.reduce))
    return ((np.fmax(high - before_rad, before_rad - low) > tolerance_rad)
            | (np.fmax(last - held_rad, held_rad - first) > COMMAND_RAD)
            | (np.isnan(held_rad) & np.isfinite(last)))


def recorded_settings(rests: np.ndarray, readings_rad: np.ndarray | None,
                      commands_rad: np.ndarray | None, tolerance_rad: float) -> np.ndarray:
    """
    Return the number of the setting of one joint in each rest of a recording, (k,) int.

    rests: first row and row after the last of each rest, (k, 2), in any order; readings_rad,
    commands_rad: encoder and command at each sample, rad, (n,); NaN where there is none. None for
    a joint without them. A command stays in force until the next one.; returns: numbers from 0 in
    the order of time, (k,) int.
    """
    missing = np.full(int(rests.max(initial=0)), np.nan)
    readings = missing if readings_rad is None else readings_rad
    commands = missing if commands_rad is None else commands_rad
    settings, number = np.zeros(len(rests), int), 0
    before_rad = held_rad = np.nan
    middle, begin = None, -1
    for i in np.argsort(rests[:, 0], kind='stable'):
        start, stop = rests[i]
        mean_rad = _mean_of_finite(readings[start:stop])
        given = commands[begin + 1:start + 1]
        given = given[np.isfinite(given)]
        if middle is not None:
            number += int(_moved(np.append(readings[middle:(start + stop) // 2], mean_rad),
                                 before_rad, given, held_rad, tolerance_rad))
        settings[i], middle, begin = number, (start + stop) // 2, start
        before_rad = mean_rad if np.isfinite(mean_rad) else before_rad
        held_rad = given[-1] if len(given) else held_rad
    return settings


def _mean_of_finite(values: np.ndarray) -> float:
    """Return the mean of the finite values; NaN without any."""
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if finite.size else float('nan')


class SettingTracker:
    """Numbers the settings of alpha and beta while a sweep runs, after those of its poses."""

    def __init__(self, tolerance_rad: float, taken: Sequence[PoseRecord] = ()) -> None:
        self._tolerance_rad = tolerance_rad
        numbers = [[-1 if number is None else number for number in (
            record.alpha_setting, record.beta_setting)] for record in taken]
        self._settings = np.max([[-1, -1], *numbers], axis=0)
        self._mean_rad = np.full(2, np.nan)
        self._readings, self._commands = (deque[_Stamped](maxlen=_MAX_READINGS) for _ in range(2))
        # First and last stamp of the newest pose, ns; None if the stage may have moved unseen
        self._newest_ns: tuple[int, int] | None = None

    def read(self, stamp_ns: int, alpha_rad: float, beta_rad: float) -> None:
        """Add an encoder reading."""
        self._readings.append((stamp_ns, (alpha_rad, beta_rad)))

    def command(self, stamp_ns: int, alpha_rad: float, beta_rad: float) -> None:
        """Add a command, which is in force from its stamp on."""
        before = self._commands[-1][1] if self._commands else (np.nan, np.nan)
        new = tuple(a if np.isfinite(a) else b for a, b in zip((alpha_rad, beta_rad), before))
        if new != before:
            self._commands.append((stamp_ns, new))

    def lose_track(self) -> None:
        """
        Count both joints as moved before the next pose: the stage may have moved unseen.

        Later stamps may be smaller than the former ones, since a clock may have been set.
        """
        self._newest_ns = None
        self._readings.clear()
        held = [(-np.inf, angles) for _, angles in self._commands][-1:]
        self._commands.clear()
        self._commands.extend(held)

    def settings(self, start_ns: int, stop_ns: int, alpha_rad: float, beta_rad: float
                 ) -> tuple[int, int]:
        """Return the numbers of the settings of alpha and beta in the next pose."""
        moved = np.ones(2, bool)
        if self._newest_ns is not None:
            first_ns = self._newest_ns[0]
            seen = _between(self._readings, sum(self._newest_ns) // 2, (start_ns + stop_ns) // 2)
            seen = np.vstack([seen, (alpha_rad, beta_rad)])
            held = np.vstack([(np.nan, np.nan), _between(self._commands, -np.inf, first_ns)])[-1]
            moved = _moved(seen, self._mean_rad, _between(self._commands, first_ns, start_ns),
                           held, self._tolerance_rad)
        alpha, beta = self._settings + moved
        return int(alpha), int(beta)

    def take(self, start_ns: int, stop_ns: int, alpha_rad: float, beta_rad: float) -> None:
        """Make a pose the newest one."""
        self._settings = np.array(self.settings(start_ns, stop_ns, alpha_rad, beta_rad))
        mean = np.array([alpha_rad, beta_rad])
        self._mean_rad = np.where(np.isfinite(mean), mean, self._mean_rad)
        self._newest_ns = start_ns, stop_ns


_Stamped = tuple[float, tuple[float, ...]]
"""A stamp, ns, and the angles of both joints from then on, rad."""


def _between(kept: Iterable[_Stamped], after_ns: float, last_ns: float) -> np.ndarray:
    """Return the angles after a stamp, up to another one, rad, (n, 2)."""
    return np.array([angles for stamp_ns, angles in kept
                     if after_ns < stamp_ns <= last_ns]).reshape(-1, 2)


_MAX_PERIODS = 1.5
"""Largest distance of neighbouring samples in a rest without gaps, sample periods."""
_MIN_SAMPLES = 0.9
"""Smallest share of the samples of a pose in the journal that its recording must have."""


def _named_rests(recording: Recording, records: Sequence[PoseRecord]) -> list[Rest]:
    """Find the rows of the rests that a journal names by their first and last stamp."""
    rests, stamps_ns = [], recording.stamp_ns
    for number, record in enumerate(records, 1):
        start = int(np.searchsorted(stamps_ns, record.start_ns, 'left'))
        stop = int(np.searchsorted(stamps_ns, record.stop_ns, 'right'))
        if stop - start < _MIN_SAMPLES * record.samples:
            raise UserError(f'{recording.path}: has {stop - start} samples between the stamps of '
                            f'pose {number} of the journal, which has {record.samples}; give '
                            'the recording of the same run')
        rests.append(Rest(start, stop, float(recording.time_s[start]),
                          float(recording.time_s[stop - 1])))
    return rests


def extract_poses(recording: Recording, sensor: Sensor,
                  records: Sequence[PoseRecord] | None = None) -> Poses:
    """Find the rests of a recording, or take those of a journal, and average each."""
    volts, angles = recording.volts(sensor), recording.stage_angles
    if records is None:
        finder = recording_finder(sensor, angles is not None)
        finder.feed(recording.time_s, volts, angles)
        rests = finder.rests()
    else:
        rests = _named_rests(recording, records)
    if not rests:
        raise UserError(f'{recording.path}: the sensor is nowhere at rest; hold it still for at '
                        'least 1 s in each pose')

    def means(values: np.ndarray | None) -> np.ndarray:
        return np.array([np.nan if values is None else
                         _mean_of_finite(values[rest.start:rest.stop]) for rest in rests])

    def settings(joint: str) -> np.ndarray:
        numbers = [getattr(record, f'{joint}_setting') for record in records or ()]
        if records is not None and None not in numbers:
            return np.array(numbers)
        readings, commands = (recording.columns.get(name)
                              for name in (JOINTS[joint], COMMANDS[joint]))
        if readings is None and commands is None:
            return None  # type: ignore[return-value]  # `Poses` numbers them by the angles
        return recorded_settings(np.array([[rest.start, rest.stop] for rest in rests]), readings,
                                 commands, angle_tolerance_rad(sensor))

    mean, std = rest_means(recording.time_s, volts, rests, sensor.rate_hz,
                           datasheet_noise(sensor))
    if records is None:
        alpha_rad, beta_rad = (means(None if angles is None else angles[:, joint])
                               for joint in range(2))
        check = np.zeros(len(rests), bool)
    else:
        alpha_rad, beta_rad = (np.array([getattr(record, name) for record in records])
                               for name in ('alpha_rad', 'beta_rad'))
        check = np.array([record.check for record in records], bool)
    return Poses(
        volts=mean, std_v=std, alpha_rad=alpha_rad, beta_rad=beta_rad,
        time_s=np.array([[rest.time_start_s, rest.time_stop_s] for rest in rests]), check=check,
        temperature_c=means(recording.columns.get('temperature_c')),
        supply_v=means(recording.columns.get('supply_v')),
        alpha_setting=settings('alpha'), beta_setting=settings('beta'))


def estimate_filters(recording: Recording, sensor: Sensor, poses: Poses
                     ) -> list[recorded_sensor.FilterNoise | None]:
    """Estimate the output filter of each axis from the noise of the poses."""
    volts, gapless = recording.volts(sensor), []
    for begin, end in zip(*np.searchsorted(recording.time_s, poses.time_s.T)):
        steps_s = np.diff(recording.time_s[begin:end + 1])
        if steps_s.size and steps_s.max() * sensor.rate_hz < _MAX_PERIODS:
            gapless.append(volts[begin:end + 1])
    return [recorded_sensor.estimate_filter([rest[:, d] for rest in gapless], sensor.rate_hz,
                                            sensor.rc_s, sensor.lsb_v)
            for d in range(len(sensor.axes))]
