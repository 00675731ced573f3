# SPDX-License-Identifier: Apache-2.0

"""CSV recordings, written block by block, whole or not at all."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
import os
from types import TracebackType
from typing import BinaryIO

from adxl_ros.files.atomic_write import atomic_path
from adxl_ros.files.csv_text import exact_rows, rounded_rows
from adxl_ros.files.page_cache import release_written
from adxl_ros.files.recording_columns import Recording, TIME
import numpy as np

_NUMBERS_AT_ONCE = 8192
"""Numbers that are made into text at a time (chosen: their arrays stay in the cache)."""


class CsvWriter:
    """
    Write columns to a CSV file, block by block.

    A context manager: the file appears under its name when the block ends without an error.
    Floats are written with as many digits as bring back the same float64; NaN is written empty.
    """

    def __init__(self, path: str | os.PathLike, digits: int | None = None) -> None:
        """Prepare to write."""
        self._path = path
        self._digits = digits
        self._names: list[str] = []

    def __enter__(self) -> CsvWriter:
        """Open a new file next to the one to replace."""
        with ExitStack() as stack:
            fresh = stack.enter_context(atomic_path(self._path))
            self._file: BinaryIO = stack.enter_context(open(fresh, 'wb'))
            self._stack = stack.pop_all()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None,
                 trace: TracebackType | None) -> None:
        """Close the file and, if all went well, put it in its place."""
        self._stack.__exit__(kind, error, trace)

    def write(self, columns: Mapping[str, np.ndarray],
              info: Mapping[str, str] | None = None) -> None:
        """
        Append rows.

        columns: arrays (n,) by column name, in the order of the file; the same names every time.
        """
        if not self._names:
            self._names = list(columns)
            self._file.writelines(f'# {key}: {" ".join(value.split())}\n'.encode()
                                  for key, value in (info or {}).items())
            self._file.write((','.join(self._names) + '\n').encode())
        arrays = [np.asarray(columns[name]) for name in self._names]
        rows = max(_NUMBERS_AT_ONCE // len(arrays), 1)
        for start in range(0, len(arrays[0]), rows):
            part = [array[start:start + rows] for array in arrays]
            self._file.write(exact_rows(part) if self._digits is None else
                             rounded_rows(part, self._digits))
        release_written(self._file)


def recording_info(recording: Recording) -> dict[str, str]:
    """Return the `# key: value` lines of a recording's CSV file."""
    info = {key: value for key, value in recording.info.items() if key != 'epoch_ns'}
    return {**info, 'epoch_ns': str(recording.epoch_ns)} if recording.epoch_ns else info


def recording_columns(recording: Recording) -> dict[str, np.ndarray]:
    """Return the columns of a recording's CSV file."""
    return {TIME: recording.time_s, **recording.columns}
