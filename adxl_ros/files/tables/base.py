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

"""What all formats of tables share."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Protocol

from adxl_ros.errors import UserError
import numpy as np

BLOCK_ROWS = 65536
"""Rows that are read at a time (chosen: some MB)."""


class NoNumbers(UserError):
    """A table holds no numbers; it may be a list of something."""


@dataclass(frozen=True)
class TableBlock:
    """
    Rows of a table.

    Attributes
    ----------
    columns
        Arrays (n,) by column name; an empty cell is NaN.
    where
        Returns file and place of a cell for messages, by its row in the block and its column.
    info
        Keys and values that the file states.
    done
        Fraction of the file that has been read at the end of the rows.
    cut
        Where a damaged file ends; empty if it is whole.

    """

    columns: Mapping[str, np.ndarray]
    where: Callable[[int, str], str]
    info: Mapping[str, str] = field(default_factory=dict)
    done: float = 1.0
    cut: str = ''


class Table(Protocol):
    """
    A file with columns.

    Attributes
    ----------
    path
        The file.
    names
        The columns, each once.
    has_names
        Whether the file names its columns; otherwise their names are their numbers from 1.
    form
        How the file is written, for messages; empty where nothing is special.
    units
        Units that the format states, by column.
    default_mapping
        The mapping that the definition of the format states; empty where there is none.

    """

    path: str
    names: tuple[str, ...]
    has_names: bool
    form: str
    units: Mapping[str, str]
    default_mapping: str

    def blocks(self, names: Collection[str]) -> Iterator[TableBlock]:
        """
        Yield the rows with some columns of numbers, in the order of the file.

        A column in which a cell is no number is refused.
        """

    def sample(self) -> Mapping[str, np.ndarray]:
        """Return the first rows of all columns of numbers."""


@dataclass(frozen=True)
class ArrayTable:
    """
    A table whose columns are in memory; the attributes are those of `Table`.

    Attributes
    ----------
    path
        The file.
    columns
        Arrays (n,) by name.
    units
        Units that the format states, by column.
    default_mapping
        The mapping that the definition of the format states.
    cut
        Where a damaged file ends; empty if it is whole.

    """

    path: str
    columns: Mapping[str, np.ndarray]
    units: Mapping[str, str] = field(default_factory=dict)
    default_mapping: str = ''
    has_names: bool = True
    form: str = ''
    cut: str = ''

    @property
    def names(self) -> tuple[str, ...]:
        """Return the columns."""
        return tuple(self.columns)

    def blocks(self, names: Collection[str]) -> Iterator[TableBlock]:
        """Yield blocks of rows; see `Table`."""
        rows = len(next(iter(self.columns.values())))
        for start in range(0, rows, BLOCK_ROWS):
            stop = min(start + BLOCK_ROWS, rows)
            yield TableBlock({name: np.asarray(self.columns[name][start:stop], float)
                              for name in names},
                             RowPlaces(self.path, start), done=stop / rows, cut=self.cut)

    def sample(self) -> Mapping[str, np.ndarray]:
        """Return the first rows; see `Table`."""
        return {name: np.asarray(values[:BLOCK_ROWS], float)
                for name, values in self.columns.items()}


@dataclass(frozen=True)
class RowPlaces:
    """
    Names the place of a cell in a file without lines.

    Attributes
    ----------
    path
        The file.
    first
        Row of the file that is the first of the block, from 0.

    """

    path: str
    first: int

    def __call__(self, row: int, column: str) -> str:
        """Return the place of a cell."""
        return f'{self.path}: row {self.first + row + 1} of {column}'
