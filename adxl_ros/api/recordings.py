# SPDX-License-Identifier: Apache-2.0

"""Recordings of the front door: from files, tables and arrays."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
import hashlib
import math
import os
import re
from typing import Any, NamedTuple, TYPE_CHECKING

from adxl_ros.errors import UserError
from adxl_ros.files import recording as recording_files
from adxl_ros.files.column_mapping import (
    ColumnMapping,
    GRAVITY,
    parse_mapping,
    parse_mounting,
    parse_unit,
    ReadingOptions,
    Source,
)
from adxl_ros.files.recording_columns import ACCEL, GYRO, Recording, REFERENCES, TIME, VOLTS
from adxl_ros.files.tables import in_memory
from adxl_ros.model.sensor import Sensor
import numpy as np

if TYPE_CHECKING:
    from adxl_ros.simulate.robot import RobotPath

RecordingInput = Any
"""A Recording, a DataFrame in the columns of the package, or the path of a file."""
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
        Sample rate, Hz, which replaces the stamps; None keeps them. In a DataFrame, a row
        without a reading is a gap.
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
    with _arguments_for_options():
        options = reading_options(
            topic,
            columns,
            unit,
            rate,
            axes,
            lsb_per_g,
            lsb_at_0g,
            drop_bad_stamps,
            drop_bad_samples,
        )
        if isinstance(source, (str, os.PathLike)):
            recording = recording_files.read(source, options)
            return replace(recording, remarks=tuple(map(_as_arguments, recording.remarks)))
        return _of_memory(_columns_of(source, 'read'), 'DataFrame', options)


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
    is_number = isinstance(rate, (float, int, np.number))
    if rate is not None and not (is_number and 0 < rate <= _HIGHEST_RATE_HZ):
        given = f'{rate:g}' if is_number else repr(rate)
        raise UserError(f'--rate {given}: expected samples a second, at most {_HIGHEST_RATE_HZ:g}')
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
    drop_bad_samples: bool = False,
    **columns: Any,
) -> Recording:
    """
    Make a recording of arrays.

    Parameters
    ----------
    table
        Arrays by name, or a pandas DataFrame, with the names below; others of numbers are kept,
        too. An index that has a name is a column.
    rate
        Sample rate, Hz, in place of `time_s`; a row without a reading is a gap.
    serial
        Serial number of the sensor; '' for an unnamed one.
    name
        What messages call it.
    drop_bad_stamps
        Whether samples are left out whose stamp does not increase; else they are refused.
    drop_bad_samples
        Whether samples are left out that have no number as their stamp or on an axis.
    **columns
        Arrays (n,): `time_s`, s, rising; the output `ax_mps2, ay_mps2, az_mps2`, m/s², or
        `x_v, y_v, z_v`, V, of one, two or three axes; the references `alpha_rad, beta_rad` of a
        stage, rad, `shift_m`, m, `temperature_c`, °C, `supply_v`, V; a gyroscope's `gx_radps,
        gy_radps, gz_radps`, rad/s. NaN or masked where not measured.

    Returns
    -------
    Recording
        The samples; see `read`.

    Raises
    ------
    UserError
        There is no time or no output, lengths differ, or values are no readings of a sensor.

    """
    arrays = {} if table is None else _columns_of(table, 'from_arrays')
    for key in columns:
        if key not in _KNOWN:
            raise UserError(f'{name}: no array {key!r} is known, but {", ".join(_KNOWN)}')
    with _arguments_for_options():
        options = reading_options(
            rate=rate, drop_bad_stamps=drop_bad_stamps, drop_bad_samples=drop_bad_samples
        )
        return _of_memory({**arrays, **columns}, name, options, serial)


_KNOWN = (TIME, *ACCEL, *VOLTS, *GYRO, *REFERENCES)  # Columns of the package


def is_frame(given: Any) -> bool:
    """Return whether an object is a DataFrame, without the package pandas."""
    return hasattr(given, 'columns') and hasattr(given, 'index')


def _columns_of(table: Any, verb: str) -> dict[str, Any]:
    """Return the columns of a table by name, a named index among them."""
    if not isinstance(table, Mapping) and not is_frame(table):
        raise UserError(
            f'{verb}: {type(table).__name__} is no table; expected arrays by name, '
            'for example {"time_s": t, "ax_mps2": x}, or a pandas DataFrame'
        )
    index = getattr(table, 'index', None)
    name = getattr(index, 'name', None)
    columns = {} if name is None else {str(name): index}
    return columns | {str(key): table[key] for key in table}


def _of_memory(
    given: Mapping[str, Any], name: str, options: ReadingOptions, serial: str = ''
) -> Recording:
    """Return the recording that arrays hold; those that are no numbers are left out and noted."""
    arrays = {key: _floats(values) for key, values in given.items()}
    columns = {key: values for key, values in arrays.items() if values is not None}
    others = [key for key in arrays if key not in columns]
    if refused := [key for key in others if key in _KNOWN]:
        raise UserError(
            f'{name}: {refused[0]} is no array of numbers; give floats, NaN where not measured'
        )
    if not columns:
        raise UserError(f'{name}: holds no array of numbers')
    shapes = {key: values.shape for key, values in columns.items()}
    if len(set(shapes.values())) > 1 or any(len(shape) != 1 for shape in shapes.values()):
        raise UserError(
            f'{name}: arrays must have one dimension and the same length, but have '
            + ', '.join(f'{key} {shape}' for key, shape in shapes.items())
        )
    if options.mapping is None and not {*ACCEL, *VOLTS}.isdisjoint(columns):
        if options.rate_hz is not None:
            (rows,) = next(iter(shapes.values()))
            columns[TIME] = np.arange(rows) / options.rate_hz
        elif TIME not in columns:
            raise UserError(f'{name}: has no time; give time_s or rate')
    table = in_memory(
        name, columns, info={'serial': serial} if serial else {}, is_every_row_a_step=True
    )
    recording = recording_files.of_table(table, options)
    left_out = f'{name}: left out, columns without numbers: {", ".join(others)}'
    remarks = map(_as_arguments, recording.remarks)
    return replace(recording, remarks=(*remarks, *[left_out] * bool(others)))


def _floats(given: Any) -> np.ndarray | None:
    """Return numbers as floats and times as ns, NaN where masked or missing; None for others."""
    try:
        values: Any = np.ma.asarray(given)
        if hasattr(given, 'isna'):
            values = np.ma.array(values, mask=given.isna())
        if values.dtype.kind in 'mM':
            values = values.astype(f'{values.dtype.kind}8[ns]').astype(np.int64)
        is_text = values.dtype.kind == 'O' and any(
            isinstance(each, (str, bytes)) for each in values.flat
        )
        if values.dtype.kind not in 'iufbO' or is_text:
            return None
        if values.dtype.kind != 'O':
            values = values.astype(float)
        return np.asarray(values.filled(np.nan), float)
    except (TypeError, ValueError):
        return None


_OPTION = re.compile(
    r"""(?<!\S)--([a-z][a-z0-9-]*)(?:\ (HZ|'[^']*'|"[^"]*"|[-+]?\d[\d.]*(?:e[-+]?\d+)?))?"""
)
"""An option of a tool in a message, with its value if that is a number or quoted."""
_BETWEEN_OPTIONS = re.compile(r"""(--\S+ (?:'[^']*'|\S+)) (?=--)""")


def _as_arguments(text: str) -> str:
    """Return a message that names arguments of Python for the options of a tool."""

    def argument(option: re.Match) -> str:
        name, value = option[1].replace('-', '_'), option[2]
        is_switch = name.startswith('drop_bad')
        return f'{name}={value or True}' if value or is_switch else name

    return _OPTION.sub(argument, _BETWEEN_OPTIONS.sub(r'\1, ', text))


@contextmanager
def _arguments_for_options() -> Iterator[None]:
    """Name arguments of Python, for options of a tool, in the errors of a block."""
    try:
        yield
    except UserError as error:
        raise UserError(_as_arguments(str(error))) from None


def is_several(given: Any) -> bool:
    """Return whether recordings are given in a series, and not one alone."""
    is_one = isinstance(given, (str, Mapping, np.ndarray)) or is_frame(given)
    return isinstance(given, Iterable) and not is_one


def one_recording(given: RecordingInput) -> Recording:
    """Return a recording; one that is named by its path is read as it is."""
    if isinstance(given, (str, os.PathLike)):
        return recording_files.read(given)
    if is_frame(given):
        return read(given)
    if not isinstance(given, Recording):
        raise UserError(
            f'{type(given).__name__} is no recording; expected a Recording, a pandas '
            'DataFrame, or the path of a file'
        )
    for name, values in _samples(given).items():
        numbers = _floats(values)
        if numbers is None or numbers.shape != (len(given),) or not np.isfinite(numbers).all():
            raise UserError(
                f'{given.path}: {name} is masked or no finite number in some of the {len(given)} '
                'samples; leave these out by from_arrays(..., drop_bad_samples=True)'
            )
    return given


def _samples(recording: Recording) -> dict[str, np.ndarray]:
    """Return the stamps and the output of the sensor."""
    outputs = {name: recording.columns[name] for name in recording.sensor_columns}
    return {TIME: recording.time_s, **outputs}


def each_recording(given: RecordingInput | Iterable[RecordingInput]) -> Iterator[Recording]:
    """Yield recordings, those that are named by their path read as they are; each only once."""
    known: dict[bytes, str] = {}  # Number and name of each recording by the hash of its samples
    for number, each in enumerate(given if is_several(given) else [given], 1):
        recording = one_recording(each)
        digest = hashlib.blake2b()
        for values in _samples(recording).values():
            digest.update(np.ascontiguousarray(values, float).data)
        key = digest.digest()
        if key in known:
            raise UserError(
                f'recording {number} ({recording.path}) has the same samples as recording '
                f'{known[key]}, which would count twice; leave one of them out'
            )
        known[key] = f'{number} ({recording.path})'
        yield recording


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


def read_ideal(given: RecordingInput, epoch_ns: int, unit: str = '') -> Recording:
    """
    Return the ideal specific force of a simulator; its times count from `epoch_ns`.

    unit: that of the samples of a file; '' for m/s².
    """
    if isinstance(given, (str, os.PathLike)):
        unit = parse_unit(unit, '--sim-unit', GRAVITY)
        return recording_files.read_ideal(given, epoch_ns, unit)
    ideal = one_recording(given)
    missing = [name for name in ACCEL if name not in ideal.columns]
    if missing:
        raise UserError(f'{ideal.path}: no column {missing[0]}')
    return recording_files.at_epoch(ideal, epoch_ns)
