# SPDX-License-Identifier: Apache-2.0

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
    """Rows of a table."""

    columns: Mapping[str, np.ndarray]  # Arrays (n,) by column name; an empty cell is NaN
    # Returns file and place of a cell for messages, by its row in the block and its column
    where: Callable[[int, str], str]
    info: Mapping[str, str] = field(default_factory=dict)  # Keys and values that the file states
    done: float = 1.0  # Fraction of the file that has been read at the end of the rows
    cut: str = ''  # Where a damaged file ends; empty if it is whole


class Table(Protocol):
    """A file with columns."""

    path: str  # The file
    names: tuple[str, ...]  # The columns, each once
    # Whether the file names its columns; otherwise their names are their numbers from 1
    has_names: bool
    form: str  # How the file is written, for messages; empty where nothing is special
    units: Mapping[str, str]  # Units that the format states, by column
    # The mapping that the definition of the format states; empty where there is none
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
    """A table whose columns are in memory; the attributes are those of `Table`."""

    path: str  # The file
    columns: Mapping[str, np.ndarray]  # Arrays (n,) by name
    # Units that the format states, by column
    units: Mapping[str, str] = field(default_factory=dict)
    default_mapping: str = ''  # The mapping that the definition of the format states
    has_names: bool = True
    form: str = ''
    cut: str = ''  # Where a damaged file ends; empty if it is whole

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
    """Names the place of a cell in a file without lines."""

    path: str  # The file
    first: int  # Row of the file that is the first of the block, from 0

    def __call__(self, row: int, column: str) -> str:
        """Return the place of a cell."""
        return f'{self.path}: row {self.first + row + 1} of {column}'
