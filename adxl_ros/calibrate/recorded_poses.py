# SPDX-License-Identifier: Apache-2.0

"""Poses from a recording: its rests, found or named by a journal or a table, each averaged."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from adxl_ros.calibrate.joint_settings import (
    angle_tolerance_rad,
    mean_of_finite,
    recorded_settings,
)
from adxl_ros.calibrate.poses import NOT_GIVEN, Poses
from adxl_ros.errors import UserError
from adxl_ros.files.recording_columns import COMMANDS, JOINTS, Recording
from adxl_ros.files.sweep_journal import PoseRecord
from adxl_ros.files.tables import PoseTable
from adxl_ros.model.noise import sample_std_v
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals import filter_noise
from adxl_ros.signals.rest_detection import recording_finder
from adxl_ros.signals.rest_limits import datasheet_noise
from adxl_ros.signals.rest_means import rest_means
from adxl_ros.signals.rest_search import Rest
from adxl_ros.wording import option
import numpy as np

_MAX_PERIODS = 1.5
"""Largest distance of neighbouring samples in a rest without gaps, sample periods."""
_MIN_SAMPLES = 0.9
"""Smallest share of the samples of a pose in the journal that its recording must have."""
_SHORTEST_SPAN_S = 0.5
"""Shortest rest of a table, s: ten blocks, whose scatter shows the error of the mean within a
quarter. Half of them would show it within a third."""

_MOST_MEANS = 2000
"""Largest number of rows of a table of means. Chosen: a sweep of a working day, 15 s a pose."""


def _named_rests(recording: Recording, records: Sequence[PoseRecord]) -> list[Rest]:
    """Find the rows of the rests that a journal names by their first and last stamp."""
    rests = []
    stamps_ns = recording.stamp_ns
    for number, record in enumerate(records, 1):
        start = int(np.searchsorted(stamps_ns, record.start_ns, 'left'))
        stop = int(np.searchsorted(stamps_ns, record.stop_ns, 'right'))
        if stop - start < _MIN_SAMPLES * record.samples:
            raise UserError(
                f'{recording.path}: has {stop - start} samples between the stamps of '
                f'pose {number} of the journal, which has {record.samples}; give '
                'the recording of the same run'
            )
        rests.append(
            Rest(start, stop, float(recording.time_s[start]), float(recording.time_s[stop - 1]))
        )
    return rests


def _rests_of_table(recording: Recording, path: str, spans_s: np.ndarray) -> list[Rest]:
    """Return the rests between stamps of a recording, s, (k, 2), that a table names."""
    rests = []
    fewest = _SHORTEST_SPAN_S * recording.rate_hz
    # The stamps as the recording states them
    time_s = recording.time_s + recording.epoch_ns * 1e-9
    for number, (start_s, stop_s) in enumerate(spans_s.tolist(), 1):
        start, stop = np.searchsorted(time_s, start_s), np.searchsorted(time_s, stop_s, 'right')
        if not stop - start >= fewest:
            raise UserError(
                f'{path}: pose {number} is from {start_s:.6g} to {stop_s:.6g} s, in which '
                f'{recording.path} has {max(stop - start, 0)} samples, expected {fewest:.0f} at '
                f'least; its stamps are {time_s[0]:.6g} to {time_s[-1]:.6g} s'
            )
        first_s, last_s = recording.time_s[[start, stop - 1]].tolist()
        rests.append(Rest(int(start), int(stop), first_s, last_s))
    return rests


def extract_poses(
    recording: Recording,
    sensor: Sensor,
    records: Sequence[PoseRecord] | None = None,
    table: PoseTable | None = None,
) -> Poses:
    """Find the rests of a recording, or take those of a journal or a table, and average each."""
    if table is not None and table.spans_s is not None:
        rests = _rests_of_table(recording, table.path, table.spans_s)
    elif records is not None:
        rests = _named_rests(recording, records)
    else:
        rests = _found_rests(recording, sensor)
    if not rests:
        raise UserError(
            f'{recording.path}: the sensor is nowhere at rest; hold it still for at '
            'least 1 s in each pose'
        )
    volts, std_v = rest_means(
        recording.time_s,
        recording.volts(sensor),
        rests,
        sensor.rate_hz,
        datasheet_noise(sensor),
    )
    measured = {
        'volts': volts,
        'std_v': std_v,
        'time_s': np.array([[rest.time_start_s, rest.time_stop_s] for rest in rests]),
        'temperature_c': _surroundings(recording, 'temperature_c', rests),
        'supply_v': _surroundings(recording, 'supply_v', rests),
    }
    if records is not None:
        return replace(Poses.from_records(records), **measured)
    alpha_rad = beta_rad = np.full(len(rests), np.nan)
    if recording.stage_angles is not None:
        alpha_rad = _means(recording.stage_angles[:, 0], rests)
        beta_rad = _means(recording.stage_angles[:, 1], rests)
    return Poses(
        alpha_rad=alpha_rad,
        beta_rad=beta_rad,
        check=np.zeros(len(rests), bool),
        alpha_setting=_settings(recording, sensor, rests, 'alpha'),
        beta_setting=_settings(recording, sensor, rests, 'beta'),
        **measured,
    )


def _found_rests(recording: Recording, sensor: Sensor) -> list[Rest]:
    """Find the rests in the samples and, where there are any, in the angles of the stage."""
    angles = recording.stage_angles
    finder = recording_finder(sensor, angles is not None)
    finder.feed(recording.time_s, recording.volts(sensor), angles)
    return finder.rests()


def _settings(
    recording: Recording, sensor: Sensor, rests: Sequence[Rest], joint: str
) -> np.ndarray:
    """Return the settings of a joint in the rests, (k,), where readings or commands show them."""
    readings_rad = recording.columns.get(JOINTS[joint])
    commands_rad = recording.columns.get(COMMANDS[joint])
    if readings_rad is None and commands_rad is None:
        return NOT_GIVEN
    rows = np.array([[rest.start, rest.stop] for rest in rests])
    return recorded_settings(rows, readings_rad, commands_rad, angle_tolerance_rad(sensor))


def _means(values: np.ndarray, rests: Sequence[Rest]) -> np.ndarray:
    """Return the mean of a column in each rest, (k,); NaN where a rest has no value."""
    return np.array([mean_of_finite(values[rest.start : rest.stop]) for rest in rests])


def _surroundings(recording: Recording, name: str, rests: Sequence[Rest]) -> np.ndarray:
    """Return the mean of a column at each rest, (k,); between others where a rest has none."""
    values = recording.columns.get(name)
    if values is None:
        return np.full(len(rests), np.nan)
    at_rest = _means(values, rests)
    is_missing = np.isnan(at_rest)
    is_known = np.isfinite(values)
    if is_known.any():
        middle_s = np.array([(rest.time_start_s + rest.time_stop_s) / 2 for rest in rests])
        at_rest[is_missing] = np.interp(
            middle_s[is_missing], recording.time_s[is_known], values[is_known]
        )
    return at_rest


def poses_of_means(recording: Recording, sensor: Sensor) -> Poses:
    """
    Return the poses of a table of which each row is the mean of a rest.

    The noise of the means is not known. Against gravity, 0 stands for it, and the residuals show
    it; against a stage, it is at most that of a sample.
    """
    if len(recording) > _MOST_MEANS:
        raise UserError(
            f'{recording.path}: has {len(recording)} rows, more than {_MOST_MEANS} rests: its '
            f'rows are samples, and no means; leave {option("means")} out'
        )
    volts = recording.volts(sensor)
    columns = recording.columns
    missing = np.full(len(recording), np.nan)
    std_v = np.zeros_like(volts)
    alpha_rad = beta_rad = missing
    angles = recording.stage_angles
    if angles is not None:
        alpha_rad, beta_rad = angles.T
        std_v += sample_std_v(sensor)
        if not std_v.any():
            raise UserError(
                f'{recording.path}: nothing states the noise of means with stage angles; '
                'state sensor.noise_density_g_per_rthz in the file of '
                f'{option("sensor")}, or leave alpha and beta out'
            )
    return Poses(
        volts=volts,
        std_v=std_v,
        alpha_rad=alpha_rad,
        beta_rad=beta_rad,
        time_s=np.zeros((len(recording), 2)),
        check=np.zeros(len(recording), bool),
        temperature_c=columns.get('temperature_c', missing),
        supply_v=columns.get('supply_v', missing),
    )


def with_table_angles(poses: Poses, table: PoseTable) -> Poses:
    """Give rests the angles of a table of poses, in their order."""
    angles = table.angles_rad
    path = table.path
    if len(angles) != len(poses):
        starts = ', '.join(f'{start_s:.1f}' for start_s in poses.time_s[:, 0]) + ' s'
        raise UserError(
            f'{path}: has {len(angles)} poses, but the recording has {len(poses)} rests, which '
            f'begin at {starts}; write a row for each rest (with empty angles where they are not '
            'known)'
        )
    # Another pose is then set by other angles: the settings are numbered anew.
    return replace(
        poses,
        alpha_rad=angles[:, 0],
        beta_rad=angles[:, 1],
        alpha_setting=NOT_GIVEN,
        beta_setting=NOT_GIVEN,
    )


def estimate_filters(
    recording: Recording, sensor: Sensor, poses: Poses
) -> list[filter_noise.FilterNoise | None]:
    """Estimate the output filter of each axis from the noise of the poses."""
    volts = recording.volts(sensor)
    gapless = []
    for begin, end in zip(*np.searchsorted(recording.time_s, poses.time_s.T)):
        steps_s = np.diff(recording.time_s[begin : end + 1])
        if steps_s.size and steps_s.max() * sensor.rate_hz < _MAX_PERIODS:
            gapless.append(volts[begin : end + 1])
    return [
        filter_noise.estimate_filter(
            [rest[:, d] for rest in gapless], sensor.rate_hz, sensor.rc_s, sensor.lsb_v
        )
        for d in range(len(sensor.axes))
    ]
