# SPDX-License-Identifier: Apache-2.0

"""Tables in NumPy's .npz: each array of numbers is a column, or several."""

from __future__ import annotations

from collections import Counter
import zipfile
import zlib

from adxl_ros.errors import UserError
from adxl_ros.files.tables.base import ArrayTable
import numpy as np

ENDINGS = ('.npz',)
"""Ends of the names of such files."""


def open_table(path: str, topic: str = '') -> ArrayTable:
    """
    Read the arrays of a file; those of another length than most are left out.

    returns: columns by the names of the arrays; `acc[0]` is the first column of an array (n, k).
    """
    if topic:
        raise UserError(f'--topic {topic}: {path} is no bag; leave --topic out')
    columns: dict[str, np.ndarray] = {}
    try:
        with np.load(path, allow_pickle=False) as arrays:
            for name in arrays.files:
                columns |= _columns(name, arrays[name])
    except (OSError, ValueError, EOFError, NotImplementedError, zipfile.BadZipFile,
            zlib.error) as error:
        raise UserError(f'{path}: cannot read it as .npz: {" ".join(str(error).split())}; save '
                        'plain arrays of numbers with numpy.savez') from None
    if not columns:
        raise UserError(f'{path}: holds no array of numbers with several rows')
    rows = Counter(map(len, columns.values())).most_common(1)[0][0]
    return ArrayTable(path, {name: values for name, values in columns.items()
                             if len(values) == rows})


def _columns(name: str, values: np.ndarray) -> dict[str, np.ndarray]:
    """Return the columns of an array; none where it is no table of numbers."""
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
