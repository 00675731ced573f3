# SPDX-License-Identifier: Apache-2.0

"""
Rows of numbers as text.

The library orjson formats most of the numbers, if it is installed. Python formats the others, and
all of them without orjson. The text is the same, character by character.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache

import numpy as np

_SMALLEST = 1e-4
"""Smaller magnitudes have an exponent in Python's text."""

_LARGEST = 1e15
"""Larger magnitudes may have an exponent; Python's text has it from 1e16."""

_MOST_DIGITS = 15
"""Significant digits that float64 always keeps. Up to them, the shortest text of a rounded number
is the rounded text."""

_TIE_EPS = 1.0
"""Distance from a tie, in units of eps of the largest scaled number, below which Python rounds.
The scaled number has an error of at most half a unit."""

_POWERS = 10.0 ** np.arange(_MOST_DIGITS + 4)
"""Powers of ten, all of them exact."""


def exact_rows(columns: Sequence[np.ndarray]) -> bytes:
    """Return rows with all digits of the columns, (n,) each; NaN is empty."""
    dumps = _dumps()
    if dumps is None or any(column.dtype != np.float64 for column in columns):
        return ('\n'.join(map(','.join, zip(*map(_fields, columns)))) + '\n').encode()
    values = np.array(columns)
    return _joined(dumps, values.copy(), values, _is_plain(values),
                   lambda value, column: _exact(value))


def rounded_rows(columns: Sequence[np.ndarray], digits: int) -> bytes:
    """
    Return rows with all digits of the first column, and some digits of the others.

    columns: two or more columns, (n,) each; NaN is empty.
    """
    values = np.array(columns, float)
    dumps = _dumps()
    if dumps is None or digits > _MOST_DIGITS:
        row = ','.join(['%r', *[f'%.{digits}g'] * (len(columns) - 1)]) + '\n'
        return ((row * len(values.T)) % tuple(values.T.ravel().tolist())).replace(
            'nan', '').encode()
    rounded, is_plain = _rounded(values, digits)
    rounded[0], is_plain[0] = values[0], _is_plain(values[0])

    def other(value: float, column: int) -> str:
        is_exact = column == 0 or value != value
        return _exact(value) if is_exact else f'{value:.{digits}g}'

    return _joined(dumps, rounded, values, is_plain, other)


def _fields(values: np.ndarray) -> list[str]:
    """Return numbers as text; NaN is empty."""
    return list(map(_exact, values.tolist()))


def _exact(value: float) -> str:
    """Return a number as text with all its digits; NaN is empty."""
    return '' if value != value else repr(value)


@cache
def _dumps() -> Callable[[np.ndarray], bytes] | None:
    """Return the function that makes text of an array; None where orjson is not installed."""
    try:
        import orjson
    except ImportError:
        return None
    return lambda values: orjson.dumps(values, option=orjson.OPT_SERIALIZE_NUMPY)


def _is_plain(values: np.ndarray) -> np.ndarray:
    """Return where the text of orjson is that of Python."""
    magnitude = np.abs(values)
    return ((magnitude >= _SMALLEST) & (magnitude < _LARGEST)) | (magnitude == 0)


def _rounded(values: np.ndarray, digits: int) -> tuple[np.ndarray, np.ndarray]:
    """Return rounded numbers, and where their shortest text is certainly the rounded text."""
    first = 10.0 ** (digits - 1)
    # Below `_SMALLEST` the greatest power leaves a number below the first of all digits.
    powers = _POWERS[:digits + 4]
    with np.errstate(all='ignore'):  # zero, NaN and infinity are not plain
        exponent = np.floor(np.log10(np.abs(values)))
        scale = powers.take((digits - 1 - exponent).astype(np.int64), mode='clip')
        scaled = values * scale
        integral = np.rint(scaled)
        rounded = integral / scale
        is_plain = np.abs(scaled - integral) < 0.5 - _TIE_EPS * np.finfo(float).eps * 10 * first
        magnitude = np.abs(scaled, out=scaled)
        is_plain &= magnitude >= first
        is_plain &= magnitude < 10 * first - 0.5
        is_plain &= rounded != np.rint(rounded)
    return rounded, is_plain


def _joined(dumps: Callable[[np.ndarray], bytes], plain: np.ndarray, values: np.ndarray,
            is_plain: np.ndarray, other: Callable[[float, int], str]) -> bytes:
    """
    Return rows of text.

    plain: what it formats, by column, (m, n); numbers that are not plain are overwritten; values:
    the numbers before they were rounded, (m, n); is_plain: which of them are plain, (m, n).
    """
    others = []
    places = np.flatnonzero(~is_plain)
    if len(places):
        columns, rows = np.divmod(places, values.shape[1])
        order = np.lexsort((columns, rows))
        others = list(map(other, values.ravel()[places[order]].tolist(), columns[order].tolist()))
        # NaN becomes null, which holds the place of another text.
        plain.ravel()[places] = np.nan
    text = bytearray(dumps(np.ascontiguousarray(plain.T)))
    characters = np.frombuffer(text, np.uint8)
    # A row ends with `],[`, the last one with `]]`; the end of the line takes their place.
    brackets = np.flatnonzero(characters == ord(']'))[:-1]
    characters[brackets] = ord('\n')
    characters[brackets + 1] = ord('[')
    lines = text.replace(b'[', b'')
    # One character is found faster than four; no number holds an n.
    pieces: list[bytes | memoryview] = []
    begin, view = 0, memoryview(lines)
    for piece in others:
        end = lines.index(b'n', begin)
        pieces += (view[begin:end], piece.encode())
        begin = end + len(b'null')
    return b''.join([*pieces, view[begin:]])
