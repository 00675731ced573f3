# SPDX-License-Identifier: Apache-2.0

"""Recordings of the front door: from files, tables and arrays."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
import math
import os
from typing import Any, NamedTuple, TYPE_CHECKING

from adxl_ros.errors import UserError
from adxl_ros.files import recording as recording_files
from adxl_ros.files.column_mapping import (
    ColumnMapping,
    parse_mapping,
    parse_mounting,
    parse_unit,
    ReadingOptions,
    Source,
    Table,
)
from adxl_ros.files.recording_columns import ACCEL, Recording, REFERENCES, TIME, VOLTS
from adxl_ros.files.tables import in_memory
from adxl_ros.model.sensor import Sensor
import numpy as np

if TYPE_CHECKING:
    from adxl_ros.simulate.robot import RobotPath

RecordingInput = Recording | str | os.PathLike
"""A recording, or the path of one that is read as it is."""
Counts = float | Sequence[float] | str
"""Counts of an ADC: one number for all axes, one for each, or their text with commas."""

_HIGHEST_RATE_HZ = 1e5  # Largest sample rate, Hz: that of a parameter file


def read(
    source: str | os.PathLike | Any,
    *,
    topic: str = '',
    columns: str | Mapping[str, str | tuple[str, str]] | None = None,
    unit: str = '',
    rate: float | None = None,
    axes: str | None = None,
    lsb_per_g: Counts = (),
    lsb_at_0g: Counts = (),
    drop_bad_stamps: bool = False,
    drop_bad_samples: bool = False,
) -> Recording:
    """
    Read a recording.

    Parameters
    ----------
    source
        A rosbag2 directory, .mcap, .db3, CSV, .npz, .parquet or .ulg; or a pandas DataFrame.
    topic
        Topic of type sensor_msgs/Imu in a bag, or message of a .ulg; '' for `imu/data_raw`, or
        the only one.
    columns
        Columns and units of a table: `'time=t_ms:ms,x=accX:mg,y=accY:mg,z=accZ:mg'`, a dict
        `{'time': 't_ms:ms', 'x': 'accX:mg', ...}`, or the path of a file that holds them. None
        for the columns of this package: `time_s`, and `x_v, ...` or `ax_mps2, ...`.
    unit
        Unit of the samples of a topic, or of all axes of a table: g, mg, mps2, mmps2, lsb, v or
        mv; '' for what `columns`, the names or the type of the topic state.
    rate
        Sample rate, Hz, which replaces the stamps; None keeps them.
    axes
        Axes of the sensor by those of the file, for a documented mounting: `'x=-y,y=x,z=z'`.
    lsb_per_g, lsb_at_0g
        Counts of 1 g, and at 0 g, of columns in LSB: one number, or one for each axis.
    drop_bad_stamps
        Whether samples are left out whose stamp does not increase; else they are refused.
    drop_bad_samples
        Whether samples are left out that have no number as their stamp or on an axis.

    Returns
    -------
    Recording
        Stamps `time_s`, s, (n,), and `columns`, (n,) each: output in V or m/s² in the frame of
        the sensor, references in rad, m, °C and V. `notes` says what was assumed.

    Raises
    ------
    UserError
        The file cannot be read, or is not understood; the message proposes `columns`.

    """
    options = reading_options(
        topic, columns, unit, rate, axes, lsb_per_g, lsb_at_0g, drop_bad_stamps, drop_bad_samples
    )
    if isinstance(source, (str, os.PathLike)):
        return recording_files.read(source, options)
    return recording_files.of_table(_table(_numbers(source), 'DataFrame'), options)


def reading_options(
    topic: str = '',
    columns: str | Mapping[str, Any] | None = None,
    unit: str = '',
    rate: float | None = None,
    axes: str | None = None,
    lsb_per_g: Counts = (),
    lsb_at_0g: Counts = (),
    drop_bad_stamps: bool = False,
    drop_bad_samples: bool = False,
) -> ReadingOptions:
    """Check how a recording is to be read; see `read`."""
    if rate is not None and not 0 < rate <= _HIGHEST_RATE_HZ:
        raise UserError(
            f'--rate {rate:g}: expected samples a second, at most {_HIGHEST_RATE_HZ:g}'
        )
    return ReadingOptions(
        topic,
        parse_mapping(_mapping_text(columns)) if columns else None,
        parse_unit(unit),
        _counts('--lsb-per-g', lsb_per_g, 0.0),
        _counts('--lsb-at-0g', lsb_at_0g, -math.inf),
        rate,
        drop_bad_stamps,
        drop_bad_samples,
        parse_mounting(axes) if axes else None,
    )


def _mapping_text(columns: str | Mapping[str, str | tuple[str, str]]) -> str:
    """Return a mapping as text; a tuple is column and unit."""
    if isinstance(columns, str):
        return columns
    return ','.join(
        f'{role}={source}'
        if isinstance(source, str)
        else str(ColumnMapping({role: Source(*source)}))
        for role, source in columns.items()
    )


def _counts(option: str, given: Counts, above: float) -> tuple[float, ...]:
    """Return counts by axis; none where none are given."""
    words = given.split(',') if isinstance(given, str) and given else given or ()
    try:
        values = tuple(float(word) for word in np.atleast_1d(words))
    except ValueError:
        values = (math.nan,)
    if not all(above < value < math.inf for value in values):
        raise UserError(
            f'{option} {given}: expected counts, for example 16384 or 16384,16384,16500'
        )
    return values


def from_arrays(
    table: Mapping[str, Any] | Any = None,
    /,
    *,
    rate: float | None = None,
    serial: str = '',
    name: str = 'arrays',
    drop_bad_stamps: bool = False,
    **columns: Any,
) -> Recording:
    """
    Make a recording of arrays.

    Parameters
    ----------
    table
        Arrays by name, or a pandas DataFrame, with the names below; others are kept, too.
    rate
        Sample rate, Hz, in place of `time_s`.
    serial
        Serial number of the sensor; '' for an unnamed one.
    name
        What messages call it.
    drop_bad_stamps
        Whether samples are left out whose stamp does not increase; else they are refused.
    **columns
        Arrays (n,): `time_s`, s, rising; the output `ax_mps2, ay_mps2, az_mps2`, m/s², or
        `x_v, y_v, z_v`, V, of one, two or three axes; the references `alpha_rad, beta_rad` of a
        stage, rad, `shift_m`, m, `temperature_c`, °C, `supply_v`, V. NaN where not measured.

    Returns
    -------
    Recording
        The samples; see `read`.

    Raises
    ------
    UserError
        There is no time or no output, lengths differ, or values are no readings of a sensor.

    """
    arrays = _numbers({} if table is None else table)
    for key, values in columns.items():
        if key not in (TIME, *VOLTS, *ACCEL, *REFERENCES):
            raise UserError(
                f'{name}: no array {key!r} is known, but '
                f'{", ".join((TIME, *ACCEL, *VOLTS, *REFERENCES))}'
            )
        arrays[key] = np.asarray(values, float)
    lengths = {key: values.shape for key, values in arrays.items()}
    if len(set(lengths.values())) > 1 or any(len(shape) != 1 for shape in lengths.values()):
        raise UserError(
            f'{name}: arrays must have one dimension and the same length, but have '
            + ', '.join(f'{key} {shape}' for key, shape in lengths.items())
        )
    if rate is not None and arrays:
        arrays = {TIME: np.arange(next(iter(arrays.values())).size) / rate, **arrays}
    return recording_files.of_table(
        _table(arrays, name, serial), reading_options(rate=rate, drop_bad_stamps=drop_bad_stamps)
    )


def _numbers(table: Any) -> dict[str, np.ndarray]:
    """Return the columns of numbers and times of a table, (n,) each; times as ns."""
    columns = {}
    for key in table:
        values = np.asarray(table[key])
        if values.dtype.kind == 'M':
            values = values.astype('datetime64[ns]').astype(np.int64)
        if values.dtype.kind in 'iufb':
            columns[str(key)] = values
    return columns


def _table(columns: Mapping[str, np.ndarray], name: str, serial: str = '') -> Table:
    """Return arrays as a table."""
    if not columns:
        raise UserError(f'{name}: holds no array of numbers')
    return in_memory(name, columns, info={'serial': serial} if serial else {})


def each_recording(given: RecordingInput | Iterable[RecordingInput]) -> Iterator[Recording]:
    """Yield recordings, those that are named by their path read as they are."""
    for each in [given] if isinstance(given, (Recording, str, os.PathLike)) else given:
        yield each if isinstance(each, Recording) else recording_files.read(each)


def as_recordings(given: RecordingInput | Iterable[RecordingInput]) -> list[Recording]:
    """Return one or more recordings."""
    several = list(each_recording(given))
    if not several:
        raise UserError('no recording is given')
    return several


class RobotInput(NamedTuple):
    """A robot in place of a stage."""

    urdf: str | os.PathLike  # Path of the robot
    frame: str  # Its frame that carries the sensor
    joints: str  # Topic of its joints; '' for the only one

    def path(self, read: Recording, sensor: Sensor) -> RobotPath:
        """Return the motion of the robot in a recording."""
        from adxl_ros.simulate import robot

        return robot.robot_path(
            self.urdf, self.frame, read.path, read.epoch_ns, sensor.local_gravity_mps2, self.joints
        )


def read_ideal(given: RecordingInput, epoch_ns: int) -> Recording:
    """Return the ideal specific force of a simulator; its times count from `epoch_ns`."""
    if not isinstance(given, Recording):
        return recording_files.read_ideal(given, epoch_ns)
    missing = [name for name in ACCEL if name not in given.columns]
    if missing:
        raise UserError(f'{given.path}: no column {missing[0]}')
    return recording_files.at_epoch(given, epoch_ns)
