# SPDX-License-Identifier: Apache-2.0

"""Recordings of the front door: from files, tables and arrays."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
import hashlib
import math
from numbers import Real
import os
from typing import Any, NamedTuple, TYPE_CHECKING, TypeAlias

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
from adxl_ros.wording import option
import numpy as np

if TYPE_CHECKING:
    from adxl_ros.simulate.robot import RobotPath
    from pandas import DataFrame

RecordingInput: TypeAlias = 'Recording | DataFrame | Mapping[str, Any] | str | os.PathLike'
"""A recording, a DataFrame or arrays by name in the columns of the package, or a path."""
Counts: TypeAlias = float | Sequence[float] | str
"""Counts of an ADC: one number for all axes, one for each, or their text with commas."""

_OUTPUTS = {*ACCEL, *VOLTS}  # Columns of the sensor's output
_KNOWN = (TIME, *ACCEL, *VOLTS, *GYRO, *REFERENCES)  # Columns of the package
_TIMES = 'mM'  # Kinds of numpy's types that are times or dates
_NUMBERS = 'iufb'  # Kinds that are numbers: int, unsigned, float, bool
_OBJECTS = 'O'  # Kind of arrays of any objects
_HIGHEST_RATE_HZ = 1e5  # Largest sample rate, Hz: that of a parameter file


def read(
    source: RecordingInput,
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
        A rosbag2 directory, .mcap, .db3, CSV, .npz, .parquet or .ulg; or a pandas DataFrame, or
        arrays by name.
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
    options = reading_options(
        topic=topic,
        columns=columns,
        unit=unit,
        rate=rate,
        axes=axes,
        lsb_per_g=lsb_per_g,
        lsb_at_0g=lsb_at_0g,
        drop_bad_stamps=drop_bad_stamps,
        drop_bad_samples=drop_bad_samples,
    )
    if isinstance(source, (str, os.PathLike)):
        return recording_files.read(source, options)
    name = 'arrays' if isinstance(source, Mapping) else 'DataFrame'
    return _of_memory(_columns_of(source, 'read'), name, options)


def reading_options(
    *,
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
    is_number = isinstance(rate, Real)
    if rate is not None and not 0 < (rate if is_number else math.nan) <= _HIGHEST_RATE_HZ:
        given = option(rate=f'{rate:g}' if is_number else rate)
        raise UserError(f'{given}: expected samples a second, at most {_HIGHEST_RATE_HZ:g}')
    return ReadingOptions(
        topic=topic,
        mapping=parse_mapping(_mapping_text(columns)) if columns else None,
        unit=parse_unit(unit),
        lsb_per_g=_counts('lsb_per_g', lsb_per_g, above=0.0),
        lsb_at_0g=_counts('lsb_at_0g', lsb_at_0g, above=-math.inf),
        rate_hz=rate,
        drop_bad_stamps=drop_bad_stamps,
        drop_bad_samples=drop_bad_samples,
        mounting=parse_mounting(axes) if axes else None,
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


def _counts(argument: str, stated: Counts, above: float) -> tuple[float, ...]:
    """Return counts by axis; none where none are given."""
    given: Any = stated
    if isinstance(stated, str):
        given = stated.split(',') if stated else ()
    try:
        values = tuple(float(count) for count in np.atleast_1d(given))
        if all(above < value < math.inf for value in values):
            return values
    except ValueError:
        pass
    raise UserError(
        f'{option(**{argument: stated})}: expected counts, for example 16384 or 16384,16384,16500'
    )


def from_arrays(
    table: Mapping[str, Any] | DataFrame | None = None,
    /,
    *unnamed: Any,
    rate: float | None = None,
    unit: str = '',
    columns: str | Mapping[str, str | tuple[str, str]] | None = None,
    axes: str | None = None,
    lsb_per_g: Counts = (),
    lsb_at_0g: Counts = (),
    serial: str = '',
    name: str = 'arrays',
    drop_bad_stamps: bool = False,
    drop_bad_samples: bool = False,
    **arrays: Any,
) -> Recording:
    """
    Make a recording of arrays.

    Parameters
    ----------
    table
        Arrays by name, or a pandas DataFrame, with the names below; others of numbers are kept,
        too. An index that has a name is a column, and one of dates is the time.
    rate
        Sample rate, Hz, in place of `time_s`; a row without a reading is a gap.
    unit
        Unit of the output where it is another one than its names say: `ax_mps2=ax, unit='g'`.
    columns, axes, lsb_per_g, lsb_at_0g, drop_bad_stamps, drop_bad_samples
        As in `read`. With `columns`, arrays may have any names.
    serial
        Serial number of the sensor; '' for an unnamed one.
    name
        What messages call it.
    *unnamed
        None: arrays have names.
    **arrays
        Arrays (n,): `time_s`, s or dates, rising; the output `ax_mps2, ay_mps2, az_mps2`, m/s², or
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
    if unnamed:
        raise UserError(
            f'from_arrays: {1 + len(unnamed)} arrays have no names; write for example '
            'from_arrays(time_s=t, ax_mps2=x)'
        )
    given = arrays if table is None else {**_columns_of(table, 'from_arrays'), **arrays}
    # Without an output that is known, the reader proposes what the others may be.
    is_native = not columns and not _OUTPUTS.isdisjoint(given)
    unknown = arrays.keys() - _KNOWN
    if is_native and unknown:
        raise UserError(f'{name}: no array {min(unknown)!r} is known, but {", ".join(_KNOWN)}')
    options = reading_options(
        columns=columns,
        unit=unit,
        rate=rate,
        axes=axes,
        lsb_per_g=lsb_per_g,
        lsb_at_0g=lsb_at_0g,
        drop_bad_stamps=drop_bad_stamps,
        drop_bad_samples=drop_bad_samples,
    )
    return _of_memory(given, name, options, serial)


def _is_frame(given: Any) -> bool:
    """Return whether an object is a DataFrame, without the package pandas."""
    return hasattr(given, 'columns') and hasattr(given, 'index')


def _columns_of(table: Any, verb: str) -> dict[str, Any]:
    """Return the columns of a table by name, a named index among them."""
    if not isinstance(table, Mapping) and not _is_frame(table):
        raise UserError(
            f'{verb}: {type(table).__name__} is no table; expected arrays by name, '
            'for example {"time_s": t, "ax_mps2": x}, or a pandas DataFrame'
        )
    index = getattr(table, 'index', None)
    name = getattr(index, 'name', None)
    columns = {} if name is None else {str(name): index}
    if _are_dates(index):
        columns[TIME] = index
    return columns | {str(key): table[key] for key in table}


def _are_dates(given: Any) -> bool:
    return getattr(getattr(given, 'dtype', None), 'kind', '') == 'M'


def _since_first(dates: Any) -> tuple[np.ndarray, int]:
    """Return dates as seconds, NaN where missing, since a whole second, and that second in ns."""
    stamps = np.asarray(dates, 'M8[ns]')
    stamps_ns = stamps.astype(np.int64)
    is_date = ~np.isnat(stamps)
    epoch_ns = int(stamps_ns[is_date][0]) // 10**9 * 10**9 if is_date.any() else 0
    return np.where(is_date, (stamps_ns - epoch_ns) * 1e-9, np.nan), epoch_ns


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
    rows = _rows_of(columns, name)
    info = {'serial': serial} if serial else {}
    is_native = options.mapping is None and not _OUTPUTS.isdisjoint(columns)
    if options.rate_hz is None and _are_dates(given.get(TIME)):
        columns[TIME], epoch_ns = _since_first(given[TIME])
        info['epoch_ns'] = str(epoch_ns)
    elif is_native and options.rate_hz is not None:
        columns[TIME] = np.arange(rows) / options.rate_hz
    elif is_native and TIME not in columns:
        raise UserError(f'{name}: has no time; give time_s or rate')
    table = in_memory(name, columns, info=info, is_every_row_a_step=True)
    recording = recording_files.of_table(table, options)
    if not others:
        return recording
    left_out = f'{name}: left out, columns without numbers: {", ".join(others)}'
    return replace(recording, remarks=(*recording.remarks, left_out))


def _rows_of(columns: Mapping[str, np.ndarray], name: str) -> int:
    """Return the common length of arrays; refuse those of other shapes."""
    shapes = {key: values.shape for key, values in columns.items()}
    shape = next(iter(shapes.values()))
    if len(shape) != 1 or set(shapes.values()) != {shape}:
        raise UserError(
            f'{name}: arrays must have one dimension and the same length, but have '
            + ', '.join(f'{key} {shape}' for key, shape in shapes.items())
        )
    return shape[0]


def _floats(given: Any) -> np.ndarray | None:
    """Return numbers as floats and times as ns, NaN where masked or missing; None for others."""
    try:
        values: Any = np.ma.asarray(given)
        if hasattr(given, 'isna'):
            values = np.ma.array(values, mask=given.isna())
        if values.dtype.kind in _TIMES:
            values = values.astype(f'{values.dtype.kind}8[ns]').astype(np.int64)
        if values.dtype.kind in _NUMBERS:
            return np.asarray(values.astype(float).filled(np.nan))
        is_text = any(isinstance(each, (str, bytes)) for each in values.flat)
        if values.dtype.kind != _OBJECTS or is_text:
            return None
        return np.asarray(values.filled(np.nan), float)
    except (TypeError, ValueError):
        return None


def as_series(given: RecordingInput | Iterable[RecordingInput]) -> Iterable[RecordingInput]:
    """Return recordings that are given in a series; one that is given alone is a series, too."""
    if isinstance(given, (str, os.PathLike, Mapping)) or _is_frame(given):
        return [given]
    if isinstance(given, np.ndarray):
        raise _no_recording(given)
    return given if isinstance(given, Iterable) else [given]


def _no_recording(given: Any) -> UserError:
    return UserError(
        f'{type(given).__name__} is no recording; expected a Recording, a pandas '
        'DataFrame, arrays by name, or the path of a file'
    )


def one_recording(given: RecordingInput) -> Recording:
    """Return a recording; one that is named by its path, or a table, is read as it is."""
    if isinstance(given, (str, os.PathLike, Mapping)) or _is_frame(given):
        return read(given)
    if not isinstance(given, Recording):
        raise _no_recording(given)
    for name, values in _samples(given).items():
        numbers = _floats(values)
        is_whole = (
            numbers is not None
            and numbers.shape == (len(given),)
            and bool(np.isfinite(numbers).all())
        )
        if not is_whole:
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
    """Yield one or more recordings, each only once; those of paths are read as they are."""
    known: dict[bytes, str] = {}  # Number and name of each recording by the hash of its samples
    for number, each in enumerate(as_series(given), 1):
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
    if not known:
        raise UserError('no recording is given')


class RobotInput(NamedTuple):
    """A robot in place of a stage."""

    urdf: str | os.PathLike  # Path of the robot
    frame: str  # Its frame that carries the sensor
    joints: str  # Topic of its joints; '' for the only one

    def path(self, read: Recording, sensor: Sensor) -> RobotPath:
        """Return the motion of the robot in a recording."""
        from adxl_ros.simulate import robot

        is_file = os.path.exists(read.path)
        return robot.robot_path(
            self.urdf,
            self.frame,
            read.path,
            read.epoch_ns,
            sensor.local_gravity_mps2,
            self.joints,
            None if is_file else {TIME: read.time_s, **read.columns},
        )


def read_ideal(given: RecordingInput, epoch_ns: int, unit: str = '') -> Recording:
    """
    Return the ideal specific force of a simulator; its times count from `epoch_ns`.

    unit: that of the samples of a file; '' for m/s².
    """
    if isinstance(given, (str, os.PathLike)):
        unit = parse_unit(unit, 'sim_unit', GRAVITY)
        return recording_files.read_ideal(given, epoch_ns, unit)
    ideal = one_recording(given)
    missing = [name for name in ACCEL if name not in ideal.columns]
    if missing:
        raise UserError(f'{ideal.path}: no column {missing[0]}')
    return recording_files.at_epoch(ideal, epoch_ns)
