# Copyright 2026 the adxl_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""From samples to poses: the same steps for a recording and for a live sweep."""

from __future__ import annotations

from collections.abc import Sequence

from adxl_ros.calibrate import joint_settings
from adxl_ros.calibrate.poses import Poses
from adxl_ros.errors import UserError
from adxl_ros.files.recording_columns import COMMANDS, JOINTS, Recording
from adxl_ros.files.sweep_journal import PoseRecord
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals import filter_time_constant
from adxl_ros.signals.noise_limits import datasheet_noise
from adxl_ros.signals.rest_detection import find_rests, Rest, rest_means
import numpy as np

_GAP = 1.5
"""Samples further apart than so many periods are not neighbours."""
_FINEST_ANGLE_RAD = 1e-5
"""An encoder is never taken to be better than this, so that rounding in a file is no motion."""


def named_rests(recording: Recording, records: Sequence[PoseRecord]) -> list[Rest]:
    """
    Find the rows of the rests that a journal names by their first and last stamp.

    Raises
    ------
    UserError
        The recording lacks more than a tenth of the samples of one of them.

    """
    stamps = recording.stamp_ns
    rests = []
    for number, record in enumerate(records, 1):
        start = int(np.searchsorted(stamps, record.start_ns, 'left'))
        stop = int(np.searchsorted(stamps, record.stop_ns, 'right'))
        if stop - start < 0.9 * record.samples:
            raise UserError(f'{recording.path}: has {stop - start} samples between the stamps of '
                            f'pose {number} of the journal, which has {record.samples}; give '
                            'the recording of that very run')
        rests.append(Rest(start, stop, float(recording.time_s[start]),
                          float(recording.time_s[stop - 1])))
    return rests


def extract_poses(recording: Recording, sensor: Sensor,
                  records: Sequence[PoseRecord] | None = None) -> Poses:
    """
    Find the rests of a recording, or take a journal's, and average each.

    Parameters
    ----------
    recording
        Read as a whole.
    sensor
        From `stream_unit.recorded_unit`.
    records
        Poses of the journal of the run, which name the rests, the angles, the settings of the
        joints and the check poses.

    Raises
    ------
    UserError
        There is no rest.

    """
    volts, angles = recording.volts(sensor), recording.stage_angles
    known = datasheet_noise(sensor)
    if records is None:
        tolerance = max(sensor.stage_resolution_rad, _FINEST_ANGLE_RAD)
        rests = find_rests(recording.time_s, volts, sensor.rate_hz, angles, known, learn=True,
                           angle_tolerance_rad=None if angles is None else tolerance)
    else:
        rests = named_rests(recording, records)
    if not rests:
        raise UserError(f'{recording.path}: the sensor is nowhere at rest; hold it still for at '
                        'least 1 s in each pose')
    mean, std = rest_means(recording.time_s, volts, rests, sensor.rate_hz, known)
    if records is None:
        middle = rest_angles(angles, rests)
        check = np.zeros(len(rests), bool)
    else:
        middle = np.array([[record.alpha_rad, record.beta_rad] for record in records])
        check = np.array([record.check for record in records], bool)
    times = np.array([[r.time_start_s, r.time_stop_s] for r in rests])
    settings = [_settings(recording, sensor, rests, joint, records) for joint in ('alpha', 'beta')]
    return Poses(mean, std, middle[:, 0], middle[:, 1], times, check,
                 *(_means(recording.columns.get(name), rests)
                   for name in ('temperature_c', 'supply_v')), *settings)


def _settings(recording: Recording, sensor: Sensor, rests: Sequence[Rest], joint: str,
              records: Sequence[PoseRecord] | None) -> np.ndarray | None:
    """Return the settings of a joint, (k,): by the journal, else by its encoder and commands."""
    name = f'{joint}_setting'
    if records is not None and all(getattr(record, name) is not None for record in records):
        return np.array([getattr(record, name) for record in records])
    readings, commands = (recording.columns.get(name) for name in (JOINTS[joint], COMMANDS[joint]))
    if readings is None and commands is None:
        return None
    return joint_settings.recorded_settings(
        np.array([[rest.start, rest.stop] for rest in rests]), readings, commands,
        joint_settings.angle_tolerance_rad(sensor))


def rest_angles(angles: np.ndarray | None, rests: Sequence[Rest]) -> np.ndarray:
    """Average the encoder over each rest, rad, (k, 2); NaN without a stage."""
    if angles is None:
        return np.full((len(rests), 2), np.nan)
    return np.column_stack([_means(angles[:, joint], rests) for joint in range(2)])


def _means(values: np.ndarray | None, rests: Sequence[Rest]) -> np.ndarray:
    if values is None:
        return np.full(len(rests), np.nan)
    return np.array([_mean_of_known(values[r.start:r.stop]) for r in rests])


def _mean_of_known(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else float('nan')


def estimate_filters(recording: Recording, sensor: Sensor, poses: Poses
                    ) -> list[filter_time_constant.FilterNoise | None]:
    """Estimate the filter of each axis from the noise of the poses; see `filter_time_constant`."""
    volts = recording.volts(sensor)
    first, last = np.searchsorted(recording.time_s, poses.time_s.T)
    rests = [volts[a:b + 1] for a, b in zip(first, last)
             if b > a and np.diff(recording.time_s[a:b + 1]).max() * sensor.rate_hz < _GAP]
    return [filter_time_constant.estimate_filter(
        [rest[:, d] for rest in rests], sensor.rate_hz, sensor.rc_s, sensor.lsb_v)
        for d in range(len(sensor.axes))]
