# SPDX-License-Identifier: Apache-2.0

"""Tables of any format: delimited text, arrays of NumPy and MATLAB, Parquet, logs of PX4."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout, suppress
from functools import partial
from io import StringIO
from itertools import chain
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from adxl_ros.errors import install_hint, one_line, UserError
from adxl_ros.files.atomic_write import AnyPath
from adxl_ros.files.column_mapping import Table, TableBlock
from adxl_ros.files.csv_file import find_form, read_blocks
from adxl_ros.model.kinematics import stage_angles
from adxl_ros.wording import option
import numpy as np

BLOCK_ROWS = 65536  # Rows that are read at a time (chosen: some MB)

_SIGNATURES = {
    b'MATLAB': 'is a MATLAB file; name it .mat',
    b'\x93NUMPY': 'is an array of NumPy; name it .npy',
    b'PAR1': 'is a Parquet file; name it .parquet',
    b'ULog': 'is a log of PX4; name it .ulg',
    b'\x89MCAP': 'is a bag; name it .mcap',
    b'SQLite': 'is a database; a bag is named .db3',
    b'PK\x03\x04': 'is an archive; name arrays of NumPy .npz, and save a sheet as CSV',
    b'\x89HDF': 'is HDF5; save its columns as CSV or .npz',
    b'\x1f\x8b': 'is compressed; unpack it',
    b'\x80': 'is a pickle of Python; save its columns as CSV or .npz',
}
"""First bytes of files that are no text, and what to do with them."""
_SIGNATURE_BYTES = max(map(len, _SIGNATURES))

_MAPPINGS = {
    'sensor_accel': 'time={time}:us,x=x:mps2,y=y:mps2,z=z:mps2,temperature=temperature:c',
    'sensor_combined': 'time=timestamp:us,x=accelerometer_m_s2[0]:mps2,'
    'y=accelerometer_m_s2[1]:mps2,z=accelerometer_m_s2[2]:mps2,'
    'gx=gyro_rad[0]:radps,gy=gyro_rad[1]:radps,gz=gyro_rad[2]:radps',
    'vehicle_acceleration': 'time={time}:us,x=xyz[0]:mps2,y=xyz[1]:mps2,z=xyz[2]:mps2',
}
"""Columns and units of messages by the definitions of PX4 (msg/*.msg), the raw readings first."""
_MATLAB = (
    "save plain vectors with save('run.mat', 't', 'x', 'y', 'z', '-v7'), or a "
    "table with writetable(T, 'run.csv')"
)
"""How MATLAB writes what can be read, for messages: no struct, timetable or HDF5 (-v7.3)."""
_POSE_COLUMNS = ('alpha_deg', 'beta_deg')  # Columns of a table of poses
_TILT_COLUMNS = ('roll_deg', 'pitch_deg')  # The same by an inclinometer
_SPAN_COLUMNS = ('start_s', 'stop_s')  # When a pose rests; a table may have both or none
_LEVEL_RAD = 1e-9  # Largest sine of alpha at which beta does not matter


def open_table(path: AnyPath, topic: str = '') -> Table:
    """Open a table of any format, by the end of its name; `topic` is the message of a log."""
    path = str(path)
    ending = Path(path).suffix.lower()
    if ending == '.ulg':
        return _open_ulog(path, topic)
    if topic:
        raise UserError(f'{option(topic=topic)}: {path} is no bag; leave {option("topic")} out')
    if ending in _FORMATS:
        return _FORMATS[ending](path)
    with suppress(OSError), open(path, 'rb') as file:
        head = file.read(_SIGNATURE_BYTES)
        for signature, what in _SIGNATURES.items():
            if head.startswith(signature):
                raise UserError(f'{path}: {what}')
    form = find_form(path)
    return Table(
        path,
        form.names,
        partial(read_blocks, path, form),
        header_line=form.header_line,
        repeated=form.repeated,
    )


def in_memory(
    path: str,
    columns: Mapping[str, np.ndarray],
    cut: str = '',
    info: Mapping[str, str] = MappingProxyType({}),
    **about: Any,
) -> Table:
    """
    Return a table of arrays (n,) by name.

    cut: where a damaged file ends; info: keys and values that it states.
    """

    def blocks(names: Collection[str], _: Collection[str]) -> Iterator[TableBlock]:
        rows = len(next(iter(columns.values())))
        for start in range(0, rows, BLOCK_ROWS):
            stop = min(start + BLOCK_ROWS, rows)
            yield TableBlock(
                {name: np.asarray(columns[name][start:stop], float) for name in names},
                _row_places(path, start),
                info,
                stop / rows,
                cut,
            )

    return Table(path, tuple(columns), blocks, **about)


def _row_places(path: str, first: int) -> Callable[[int, str], str]:
    """Return what names the place of a cell in a file without lines."""
    return lambda row, column: f'{path}: row {first + row + 1} of {column}'


@contextmanager
def _library(path: str, kind: str, package: str) -> Iterator[None]:
    """Name a package that is missing, and refuse a file that it cannot read."""
    try:
        yield
    except UserError:
        raise
    except ImportError:
        raise UserError(
            f'{path}: {kind} needs the Python package {package}: {install_hint(package)}'
        ) from None
    except Exception as error:
        # In a damaged file, a library can raise errors of any kind.
        raise UserError(
            f'{path}: cannot read it as {kind}: {one_line(error) or type(error).__name__}'
        ) from None


def _open_numpy(path: str) -> Table:
    """Open an array, or a file of arrays, of NumPy."""
    with _library(path, 'plain arrays of NumPy', 'numpy'):
        loaded = np.load(path, allow_pickle=False)
        names = getattr(loaded, 'files', None) or loaded.dtype.names
        arrays = {name: loaded[name] for name in names} if names else {'column': loaded}
        return _of_arrays(path, arrays, 'save each column as an array')


def _open_mat(path: str) -> Table:
    with _library(path, f'a MATLAB file; {_MATLAB}; its format', 'scipy'):
        from scipy.io import loadmat

        return _of_arrays(path, loadmat(path), f'in MATLAB, {_MATLAB}')


def _of_arrays(path: str, arrays: Mapping[str, Any], advice: str) -> Table:
    """Return the arrays of numbers of a file; those of another length than most are left out."""
    columns: dict[str, np.ndarray] = {}
    for name, values in arrays.items():
        values = np.asarray(values)
        is_table = values.ndim in (1, 2) and values.size > 1
        if is_table and values.dtype.kind in 'iuf':
            series = np.atleast_2d(values)
            if series.shape[0] > series.shape[1]:
                series = series.T  # MATLAB and others keep a vector as a row
            columns |= {
                f'{name}[{i}]' if len(series) > 1 else name: each for i, each in enumerate(series)
            }
    if not columns:
        raise UserError(f'{path}: holds no array of numbers with several rows; {advice}')
    [(rows, _)] = Counter(map(len, columns.values())).most_common(1)
    return in_memory(
        path, {name: values for name, values in columns.items() if len(values) == rows}
    )


def _open_parquet(path: str) -> Table:
    """Open a Parquet file with the library pyarrow: its columns of numbers and of times."""
    with _library(path, 'Parquet', 'pyarrow'):
        import pyarrow.parquet

        schema = pyarrow.parquet.read_schema(path)
        kinds = pyarrow.types

    def blocks(names: Collection[str], _: Collection[str]) -> Iterator[TableBlock]:
        first = 0
        with _library(path, 'Parquet', 'pyarrow'), pyarrow.parquet.ParquetFile(path) as file:
            for batch in file.iter_batches(BLOCK_ROWS, columns=list(names)):
                last = first + batch.num_rows
                yield TableBlock(
                    {name: numbers(batch.column(name)) for name in names},
                    _row_places(path, first),
                    done=last / file.metadata.num_rows,
                )
                first = last

    def numbers(column: Any) -> np.ndarray:
        """Return a column as floats; an empty cell is NaN."""
        if kinds.is_temporal(column.type):
            column = column.cast(pyarrow.int64())
        return np.asarray(
            column.cast(pyarrow.float64(), safe=False).to_numpy(zero_copy_only=False), float
        )

    units = {
        each.name: each.type.unit
        for each in schema
        if kinds.is_timestamp(each.type) or kinds.is_duration(each.type)
    }
    names = tuple(
        each.name
        for each in schema
        if each.name in units or kinds.is_integer(each.type) or kinds.is_floating(each.type)
    )
    if not names:
        raise UserError(f'{path}: has no column of numbers')
    return Table(path, names, blocks, units)


def _open_ulog(path: str, topic: str) -> Table:
    """Read one message of a log of PX4 with the library pyulog: it is a table."""
    # The library prints its warnings.
    with _library(path, 'a log of PX4', 'pyulog'), redirect_stdout(StringIO()):
        from pyulog import ULog

        log = ULog(path)
    # The first instance of a message has no number.
    messages = {
        f'{data.name}_{data.multi_id}' if data.multi_id else str(data.name): data
        for data in log.data_list
    }
    # The messages of accelerometers, by kind; those of the first kind are the raw readings.
    of_kinds = [
        [name for name, data in messages.items() if data.name == kind] for kind in _MAPPINGS
    ]
    raw = next(filter(None, of_kinds), [])
    accelerations = list(chain.from_iterable(of_kinds))
    name = topic.removesuffix('_0') or ', '.join(raw)
    if name not in messages and topic:
        raise UserError(f'{path}: no message {topic}')
    if name not in messages:
        raise UserError(
            f'{path}: {len(raw) or "no"} accelerometers; choose one with {option("topic")}: '
            f'{", ".join(accelerations or messages)}'
        )
    data = messages[name]
    columns = {
        name: values
        for name, values in data.data.items()
        if getattr(values, 'dtype', None) is not None and values.dtype.kind in 'iuf'
    }
    time = 'timestamp_sample' if columns.get('timestamp_sample', [0])[0] else 'timestamp'
    mapping = _MAPPINGS.get(data.name, '').format(time=time)
    if 'temperature' not in columns:
        mapping = mapping.partition(',temperature=')[0]
    if 'gyro_rad[0]' not in columns:
        mapping = mapping.partition(',gx=')[0]
    is_damaged = log.file_corruption
    cut = f'{path}: is damaged; what can be read of it is used' if is_damaged else ''
    return in_memory(
        path,
        columns,
        cut,
        default_mapping=mapping,
        units={'timestamp': 'us', 'timestamp_sample': 'us'},
    )


_FORMATS: Mapping[str, Callable[[str], Table]] = {
    '.npz': _open_numpy,
    '.npy': _open_numpy,
    '.mat': _open_mat,
    '.parquet': _open_parquet,
    '.pq': _open_parquet,
}
"""Formats besides text and logs by the ends of their files' names."""

TABLE_ENDINGS = (*_FORMATS, '.ulg')  # Ends of the names of tables that are no text


class PoseTable(NamedTuple):
    """A table of poses."""

    path: str
    angles_rad: np.ndarray  # alpha and beta, rad, (k, 2); NaN where a pose has none
    spans_s: np.ndarray | None  # First and last stamp of each rest, s, (k, 2); None without them


def read_pose_table(path: AnyPath) -> PoseTable:
    """Read a table of poses: angles of a stage, or of an inclinometer, and when they rest."""
    table = open_table(path)
    pairs = [pair for pair in (_POSE_COLUMNS, _TILT_COLUMNS) if set(pair) <= set(table.names)]
    if len(pairs) != 1:
        raise UserError(
            f'{path}: has {"two" if pairs else "no"} kinds of angles of the poses; expected '
            f'the columns {" and ".join(_POSE_COLUMNS)}, or {" and ".join(_TILT_COLUMNS)}; '
            f'the columns are {", ".join(table.names)}'
        )
    spans = [name for name in _SPAN_COLUMNS if name in table.names]
    if len(spans) == 1:
        raise UserError(f'{path}: has {spans[0]}; expected both {" and ".join(_SPAN_COLUMNS)}')
    values = table.read([*pairs[0], *spans])
    angles_rad = [np.radians(values[name]) for name in pairs[0]]
    alpha_rad, beta_rad = stage_angles(*angles_rad) if pairs[0] is _TILT_COLUMNS else angles_rad
    # At alpha 0 and 180 degrees beta does not matter, and people leave its cell empty.
    is_open = np.isnan(beta_rad) & (np.abs(np.sin(alpha_rad)) < _LEVEL_RAD)
    return PoseTable(
        str(path),
        np.column_stack([alpha_rad, np.where(is_open, 0.0, beta_rad)]),
        np.column_stack([values[name] for name in spans]) if spans else None,
    )
