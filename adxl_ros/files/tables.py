# SPDX-License-Identifier: Apache-2.0

"""Tables of any format: delimited text, NumPy's .npz, Apache Parquet, and logs of PX4 (.ulg)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import redirect_stdout
from dataclasses import dataclass, field
from io import StringIO
import os
from pathlib import Path
import re
from typing import Any, Protocol
import zipfile
import zlib

from adxl_ros.errors import install_hint, one_line, UserError
from adxl_ros.files.column_mapping import Quantity, unit_in_name, UNITS
from adxl_ros.files.delimited_text import NoNumbers, open_text, TableBlock
from adxl_ros.model.kinematics import stage_angles
import numpy as np

_BLOCK_ROWS = 65536
"""Rows that are read at a time (chosen: some MB)."""

_MAPPINGS = {
    'sensor_accel': 'time={time}:us,x=x:mps2,y=y:mps2,z=z:mps2,temperature=temperature:c',
    'sensor_combined': 'time=timestamp:us,x=accelerometer_m_s2[0]:mps2,'
                       'y=accelerometer_m_s2[1]:mps2,z=accelerometer_m_s2[2]:mps2',
    'vehicle_acceleration': 'time={time}:us,x=xyz[0]:mps2,y=xyz[1]:mps2,z=xyz[2]:mps2',
    'vehicle_imu': '',
}
"""Columns and units of messages by the definitions of PX4 (msg/*.msg), the raw readings first. A
vehicle_imu has changes of velocity, so that it is only named."""


class Table(Protocol):
    """A file with columns."""

    @property
    def path(self) -> str:
        """Return the file."""

    @property
    def names(self) -> tuple[str, ...]:
        """Return the columns, each once."""

    @property
    def has_names(self) -> bool:
        """Return whether the file names its columns; else their names are their numbers from 1."""

    @property
    def form(self) -> str:
        """Describe how the file is written, for messages; empty where nothing is special."""

    @property
    def units(self) -> Mapping[str, str]:
        """Return the units that the format states, by column."""

    @property
    def default_mapping(self) -> str:
        """Return the mapping that the definition of the format states; empty for none."""

    def blocks(self, names: Collection[str]) -> Iterator[TableBlock]:
        """
        Yield the rows with some columns of numbers, in the order of the file.

        A column in which a cell is no number is refused.
        """

    def sample(self) -> Mapping[str, np.ndarray]:
        """Return the first rows of all columns of numbers."""


def open_table(path: str | os.PathLike, topic: str = '') -> Table:
    """Open a table of any format, by the end of its name; `topic` is the message of a log."""
    path = str(path)
    ending = Path(path).suffix.lower()
    if ending == '.ulg':
        return _open_ulog(path, topic)
    if topic:
        raise UserError(f'--topic {topic}: {path} is no bag; leave --topic out')
    return _FORMATS.get(ending, open_text)(path)


def is_text(path: str | os.PathLike) -> bool:
    """Return whether a file is delimited text, by the end of its name."""
    return Path(path).suffix.lower() not in TABLE_ENDINGS


def _row_places(path: str, first: int) -> Callable[[int, str], str]:
    """Return what names the place of a cell in a file without lines."""
    return lambda row, column: f'{path}: row {first + row + 1} of {column}'


@dataclass(frozen=True)
class _ArrayTable:
    """A table whose columns are in memory."""

    path: str  # The file
    columns: Mapping[str, np.ndarray]  # Arrays (n,) by name
    units: Mapping[str, str] = field(default_factory=dict)
    default_mapping: str = ''
    has_names: bool = True
    form: str = ''
    cut: str = ''  # Where a damaged file ends; empty if it is whole

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(self.columns)

    def blocks(self, names: Collection[str]) -> Iterator[TableBlock]:
        rows = len(next(iter(self.columns.values())))
        for start in range(0, rows, _BLOCK_ROWS):
            stop = min(start + _BLOCK_ROWS, rows)
            yield TableBlock({name: np.asarray(self.columns[name][start:stop], float)
                              for name in names},
                             _row_places(self.path, start), done=stop / rows, cut=self.cut)

    def sample(self) -> Mapping[str, np.ndarray]:
        return {name: np.asarray(values[:_BLOCK_ROWS], float)
                for name, values in self.columns.items()}


def _open_npz(path: str) -> _ArrayTable:
    """Read the arrays of a file; those of another length than most are left out."""
    columns: dict[str, np.ndarray] = {}
    try:
        with np.load(path, allow_pickle=False) as arrays:
            for name in arrays.files:
                columns |= _array_columns(name, arrays[name])
    except (OSError, ValueError, EOFError, NotImplementedError, zipfile.BadZipFile,
            zlib.error) as error:
        raise UserError(f'{path}: cannot read it as .npz: {one_line(error)}; save '
                        'plain arrays of numbers with numpy.savez') from None
    if not columns:
        raise UserError(f'{path}: holds no array of numbers with several rows')
    rows = Counter(map(len, columns.values())).most_common(1)[0][0]
    return _ArrayTable(path, {name: values for name, values in columns.items()
                              if len(values) == rows})


def _array_columns(name: str, values: np.ndarray) -> dict[str, np.ndarray]:
    """Return the columns of an array, `acc[0]` the first of (n, k); none where it is no table."""
    if values.dtype.kind not in 'iuf' or values.ndim not in (1, 2) or len(values) < 2:
        return {}
    if values.ndim == 1:
        return {name: values}
    # MATLAB and others keep a vector as a row.
    if values.shape[0] < values.shape[1]:
        values = values.T
    if values.shape[1] == 1:
        return {name: values[:, 0]}
    return {f'{name}[{i}]': values[:, i] for i in range(values.shape[1])}


@dataclass(frozen=True)
class _ParquetTable:
    """A Parquet file, read with the library pyarrow."""

    path: str  # The file
    names: tuple[str, ...]  # Its columns of numbers and of times
    units: Mapping[str, str]  # Units of the columns of times, which are given in ns
    has_names: bool = True
    form: str = ''
    default_mapping: str = ''

    def blocks(self, names: Collection[str]) -> Iterator[TableBlock]:
        import pyarrow
        with _opened_parquet(self.path) as file:
            total, first = max(file.metadata.num_rows, 1), 0
            batches = file.iter_batches(_BLOCK_ROWS, columns=list(names))
            while True:
                try:
                    batch = next(batches)
                except StopIteration:
                    return
                except (OSError, pyarrow.ArrowException) as error:
                    raise _no_parquet(self.path, error) from None
                columns = {name: _parquet_numbers(batch.column(name)) for name in names}
                last = first + batch.num_rows
                yield TableBlock(columns, _row_places(self.path, first), done=last / total)
                first = last

    def sample(self) -> Mapping[str, np.ndarray]:
        return next((block.columns for block in self.blocks(self.names)), {})


def _open_parquet(path: str) -> _ParquetTable:
    with _opened_parquet(path) as file:
        import pyarrow.types as kinds
        times = {field.name: 'ns' for field in file.schema_arrow
                 if kinds.is_timestamp(field.type) or kinds.is_duration(field.type)}
        names = tuple(field.name for field in file.schema_arrow if field.name in times
                      or kinds.is_integer(field.type) or kinds.is_floating(field.type))
    if not names:
        raise NoNumbers(f'{path}: has no column of numbers')
    return _ParquetTable(path, names, times)


def _opened_parquet(path: str) -> Any:
    """Open a file; the library closes it at the end of a block `with`."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise UserError(f'{path}: Parquet needs the Python package pyarrow: '
                        f'{install_hint("pyarrow")}') from None
    try:
        return pyarrow.parquet.ParquetFile(path)
    except (OSError, pyarrow.ArrowException) as error:
        raise _no_parquet(path, error) from None


def _no_parquet(path: str, error: Exception) -> UserError:
    return UserError(f'{path}: cannot read it as Parquet: {one_line(error)}')


def _parquet_numbers(column: Any) -> np.ndarray:
    """Return a column as floats; an empty cell is NaN, a time is in ns."""
    import pyarrow as arrow
    kind = column.type
    if arrow.types.is_timestamp(kind):
        column = column.cast(arrow.timestamp('ns', tz=kind.tz)).cast(arrow.int64())
    elif arrow.types.is_duration(kind):
        column = column.cast(arrow.duration('ns')).cast(arrow.int64())
    return np.asarray(column.cast(arrow.float64(), safe=False).to_numpy(zero_copy_only=False),
                      float)


def _open_ulog(path: str, topic: str) -> _ArrayTable:
    """Read one message of a log of PX4 with the library pyulog: it is a table."""
    log = _read_ulog(path)
    # The first instance of a message has no number.
    messages = {f'{data.name}_{data.multi_id}' if data.multi_id else str(data.name): data
                for data in log.data_list}
    accelerations = [name for kind in _MAPPINGS for name in messages
                     if messages[name].name == kind and _MAPPINGS[kind]]
    name = topic.removesuffix('_0')
    if name and name not in messages:
        raise UserError(f'{path}: no message {topic}; name one of '
                        f'{", ".join(accelerations or sorted(messages))}')
    if not name:
        if not accelerations:
            raise UserError(f'{path}: holds no acceleration; name a message with --topic: '
                            f'{", ".join(sorted(messages)) or "it has none"}')
        name = accelerations[0]
        raw = [each for each in accelerations if messages[each].name == messages[name].name]
        if len(raw) > 1:
            raise UserError(f'{path}: several accelerometers: {", ".join(raw)}; choose one: '
                            f'--topic {name}')
    data = messages[name]
    columns = {name: values for name, values in data.data.items()
               if getattr(values, 'dtype', None) is not None and values.dtype.kind in 'iuf'}
    time = 'timestamp_sample' if columns.get('timestamp_sample', [0])[0] else 'timestamp'
    mapping = _MAPPINGS.get(data.name, '').format(time=time)
    if 'temperature' not in columns:
        mapping = mapping.partition(',temperature=')[0]
    return _ArrayTable(path, columns, {'timestamp': 'us', 'timestamp_sample': 'us'}, mapping,
                       cut=f'{path}: is damaged; what can be read of it is used'
                       if log.file_corruption else '')


def _read_ulog(path: str) -> Any:
    """Return the parsed log."""
    try:
        from pyulog import ULog
    except ImportError:
        raise UserError(f'{path}: logs of PX4 need the Python package pyulog: '
                        f'{install_hint("pyulog")}') from None
    try:
        # The library prints its warnings.
        with redirect_stdout(StringIO()):
            return ULog(path)
    except OSError as error:
        raise UserError(f'{path}: cannot read: {error.strerror or error}') from None
    except Exception as error:
        # In a damaged file, pyulog can raise errors of any kind.
        raise UserError(f'{path}: cannot read it as a log of PX4: '
                        f'{one_line(error) or type(error).__name__}') from None


_FORMATS: Mapping[str, Callable[[str], Table]] = {
    '.npz': _open_npz, '.parquet': _open_parquet, '.pq': _open_parquet}
"""Formats besides text and logs by the ends of their files' names."""

TABLE_ENDINGS = (*_FORMATS, '.ulg')
"""Ends of the names of tables that are no text."""


_ANGLES = ('alpha', 'beta', 'roll', 'pitch')
"""Begin of the names of columns with angles."""

_LEVEL_RAD = 1e-9
"""Largest sine of alpha at which beta does not matter."""


@dataclass(frozen=True)
class PoseTable:
    """Angles of k poses."""

    path: str  # The file, for messages
    angles_rad: np.ndarray  # Stage angles alpha and beta, rad, (k, 2); NaN where a pose has none
    # First and last time of each pose, s by the clock of the recording, (k, 2); None where the
    # rows are the rests in their order
    span_s: np.ndarray | None


def read_pose_table(path: str | os.PathLike) -> PoseTable:
    """
    Read a table with a row for each pose.

    Its columns are `alpha` and `beta`, or `roll` and `pitch`, each with its unit (`alpha_deg`),
    and `start_s` and `stop_s`, or `time_s`, where the rows are not the rests in their order.
    """
    table = open_table(path)
    columns = {role: name for role in _ANGLES for name in table.names
               if re.match(rf'(?i){role}(\b|_|$)', name)}
    pair = next((pair for pair in (('alpha', 'beta'), ('roll', 'pitch'))
                 if set(pair) <= set(columns)), None)
    if pair is None:
        raise UserError(f'{path}: has no angles of the poses; expected the columns alpha_deg and '
                        f'beta_deg, or roll_deg and pitch_deg; the columns are '
                        f'{", ".join(table.names)}')
    choices: tuple[tuple[str, ...], ...] = (('start_s', 'stop_s'), ('time_s', 'time_s'), ())
    times = next(names for names in choices if set(names) <= set(table.names))
    names = list(dict.fromkeys([columns[role] for role in pair] + [*times]))
    blocks = list(table.blocks(names))
    values = {name: np.concatenate([block.columns[name] for block in blocks]) for name in names}
    angles = [_radians(table.path, columns[role], values[columns[role]]) for role in pair]
    if pair == ('roll', 'pitch'):
        angles = list(stage_angles(*angles))
    # At alpha 0 and 180 degrees beta does not matter, and people leave its cell empty.
    angles[1] = np.where(np.isnan(angles[1]) & (np.abs(np.sin(angles[0])) < _LEVEL_RAD), 0.0,
                         angles[1])
    return PoseTable(table.path, np.column_stack(angles),
                     np.column_stack([values[name] for name in times]) if times else None)


def _radians(path: str, name: str, values: np.ndarray) -> np.ndarray:
    """Return a column of angles in radians, by the unit in its name."""
    unit = unit_in_name(name, Quantity.ANGLE)
    if unit is None:
        raise UserError(f'{path}: column {name} states no unit; name it {name}_deg or {name}_rad')
    return UNITS[Quantity.ANGLE][unit].convert(values)
