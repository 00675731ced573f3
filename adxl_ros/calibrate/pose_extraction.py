# SPDX-License-Identifier: Apache-2.0

"""Poses from recordings: rests, their means, angles and settings."""

from __future__ import annotations

from collections.abc import Sequence

from adxl_ros.calibrate import joint_settings
from adxl_ros.calibrate.poses import Poses
from adxl_ros.errors import UserError
from adxl_ros.files.recording_columns import COMMANDS, JOINTS, Recording
from adxl_ros.files.sweep_journal import PoseRecord
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals import recorded_sensor
from adxl_ros.signals.noise_limits import datasheet_noise
from adxl_ros.signals.rest_detection import recording_finder, Rest, rest_means
import numpy as np

_MAX_PERIODS = 1.5
"""Largest distance of neighbouring samples in a rest without gaps, sample periods."""
_MIN_SAMPLES = 0.9
"""Smallest share of the samples of a pose in the journal that its recording must have."""


def named_rests(recording: Recording, records: Sequence[PoseRecord]) -> list[Rest]:
    """Find the rows of the rests that a journal names by their first and last stamp."""
    stamps = recording.stamp_ns
    rests = []
    for number, record in enumerate(records, 1):
        start = int(np.searchsorted(stamps, record.start_ns, 'left'))
        stop = int(np.searchsorted(stamps, record.stop_ns, 'right'))
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
    noise = datasheet_noise(sensor)
    if records is None:
        finder = recording_finder(sensor, angles is not None)
        finder.feed(recording.time_s, volts, angles)
        rests = finder.rests()
    else:
        rests = named_rests(recording, records)
    if not rests:
        raise UserError(f'{recording.path}: the sensor is nowhere at rest; hold it still for at '
                        'least 1 s in each pose')
    mean, std = rest_means(recording.time_s, volts, rests, sensor.rate_hz, noise)
    if records is None:
        pose_angles = _rest_angles(angles, rests)
        check = np.zeros(len(rests), bool)
    else:
        pose_angles = np.array([[record.alpha_rad, record.beta_rad] for record in records])
        check = np.array([record.check for record in records], bool)
    return Poses(
        volts=mean, std_v=std, alpha_rad=pose_angles[:, 0], beta_rad=pose_angles[:, 1],
        time_s=np.array([[rest.time_start_s, rest.time_stop_s] for rest in rests]), check=check,
        temperature_c=_rest_means(recording.columns.get('temperature_c'), rests),
        supply_v=_rest_means(recording.columns.get('supply_v'), rests),
        alpha_setting=_settings(recording, sensor, rests, 'alpha', records),
        beta_setting=_settings(recording, sensor, rests, 'beta', records))


def _settings(recording: Recording, sensor: Sensor, rests: Sequence[Rest], joint: str,
              records: Sequence[PoseRecord] | None) -> np.ndarray:
    """
    Return the settings of a joint, (k,), by the journal, else by its encoder and commands.

    Without encoder and commands the result is None, and `Poses` numbers the settings by the
    angles.
    """
    name = f'{joint}_setting'
    if records is not None and all(getattr(record, name) is not None for record in records):
        return np.array([getattr(record, name) for record in records])
    readings, commands = (recording.columns.get(name) for name in (JOINTS[joint], COMMANDS[joint]))
    if readings is None and commands is None:
        return None  # type: ignore[return-value]
    return joint_settings.recorded_settings(
        np.array([[rest.start, rest.stop] for rest in rests]), readings, commands,
        joint_settings.angle_tolerance_rad(sensor))


def _rest_angles(angles: np.ndarray | None, rests: Sequence[Rest]) -> np.ndarray:
    """Average the encoder over each rest, rad, (k, 2); NaN without a stage."""
    if angles is None:
        return np.full((len(rests), 2), np.nan)
    return np.column_stack([_rest_means(angles[:, joint], rests) for joint in range(2)])


def _rest_means(values: np.ndarray | None, rests: Sequence[Rest]) -> np.ndarray:
    """Average the finite values of each rest, (k,); NaN where there are none."""
    if values is None:
        return np.full(len(rests), np.nan)
    return np.array([joint_settings.mean_of_finite(values[rest.start:rest.stop])
                     for rest in rests])


def estimate_filters(recording: Recording, sensor: Sensor, poses: Poses
                     ) -> list[recorded_sensor.FilterNoise | None]:
    """Estimate the output filter of each axis from the noise of the poses."""
    volts = recording.volts(sensor)
    first, last = np.searchsorted(recording.time_s, poses.time_s.T)
    gapless = []
    for begin, end in zip(first, last):
        steps_s = np.diff(recording.time_s[begin:end + 1])
        if steps_s.size and steps_s.max() * sensor.rate_hz < _MAX_PERIODS:
            gapless.append(volts[begin:end + 1])
    filters = []
    for d in range(len(sensor.axes)):
        rests = [rest[:, d] for rest in gapless]
        filters.append(recorded_sensor.estimate_filter(
            rests, sensor.rate_hz, sensor.rc_s, sensor.lsb_v))
    return filters
