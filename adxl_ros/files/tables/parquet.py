# SPDX-License-Identifier: Apache-2.0

"""Tables in Apache Parquet, read with the library pyarrow."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from adxl_ros.errors import install_hint, one_line, UserError
from adxl_ros.files.tables.base import BLOCK_ROWS, NoNumbers, RowPlaces, TableBlock
import numpy as np

ENDINGS = ('.parquet', '.pq')
"""Ends of the names of such files."""


@dataclass(frozen=True)
class ParquetTable:
    """A Parquet file; the attributes are those of `Table`."""

    path: str  # The file
    names: tuple[str, ...]  # Its columns of numbers and of times
    units: Mapping[str, str]  # Units of the columns of times, which are given in ns
    has_names: bool = True
    form: str = ''
    default_mapping: str = ''

    def blocks(self, names: Collection[str]) -> Iterator[TableBlock]:
        """Yield blocks of rows; see `Table`."""
        with _opened(self.path) as file:
            total, first = max(file.metadata.num_rows, 1), 0
            for batch in self._batches(file, names):
                columns = {name: _numbers(batch.column(batch.schema.get_field_index(name)))
                           for name in names}
                yield TableBlock(columns, RowPlaces(self.path, first),
                                 done=(first + batch.num_rows) / total)
                first += batch.num_rows

    def _batches(self, file: Any, names: Collection[str]) -> Iterator[Any]:
        """Yield the batches of an open file."""
        import pyarrow
        try:
            yield from file.iter_batches(BLOCK_ROWS, columns=list(names))
        except (OSError, pyarrow.ArrowException) as error:
            raise _unreadable(self.path, error) from None

    def sample(self) -> Mapping[str, np.ndarray]:
        """Return the first rows; see `Table`."""
        return next((block.columns for block in self.blocks(self.names)), {})


def open_table(path: str, topic: str = '') -> ParquetTable:
    """Open a Parquet file."""
    if topic:
        raise UserError(f'--topic {topic}: {path} is no bag; leave --topic out')
    with _opened(path) as file:
        import pyarrow.types as kinds
        fields = [field for field in file.schema_arrow
                  if kinds.is_integer(field.type) or kinds.is_floating(field.type)
                  or kinds.is_timestamp(field.type) or kinds.is_duration(field.type)]
        times = {field.name: 'ns' for field in fields
                 if kinds.is_timestamp(field.type) or kinds.is_duration(field.type)}
    if not fields:
        raise NoNumbers(f'{path}: has no column of numbers')
    return ParquetTable(path, tuple(field.name for field in fields), times)


def _opened(path: str) -> Any:
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
        raise _unreadable(path, error) from None


def _unreadable(path: str, error: Exception) -> UserError:
    """Return the error of a file that the library cannot read."""
    return UserError(f'{path}: cannot read it as Parquet: {one_line(error)}')


def _numbers(column: Any) -> np.ndarray:
    """Return a column as floats; an empty cell is NaN, a time is in ns."""
    import pyarrow as arrow
    kind = column.type
    if arrow.types.is_timestamp(kind):
        column = column.cast(arrow.timestamp('ns', tz=kind.tz)).cast(arrow.int64())
    elif arrow.types.is_duration(kind):
        column = column.cast(arrow.duration('ns')).cast(arrow.int64())
    return np.asarray(column.cast(arrow.float64(), safe=False).to_numpy(zero_copy_only=False),
                      float)
