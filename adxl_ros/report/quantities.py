# SPDX-License-Identifier: Apache-2.0
"""Values with their intervals, and as text with the digits that these allow."""

from dataclasses import dataclass

import numpy as np

_MOST_DECIMALS = 7
"""Largest number of decimals (chosen: a table of 79 columns has room for ten digits)."""
_UNKNOWN_DECIMALS = 4
"""Number of decimals of a coefficient without an interval."""


@dataclass(frozen=True)
class Interval:
    """A value with its 90 % interval."""

    value: float
    low: float
    high: float


def decimals(half_width: float) -> int:
    """Return the number of decimals that shows two digits of an interval."""
    if not half_width > 0:
        return _UNKNOWN_DECIMALS
    exponent = int(f'{half_width:.1e}'.partition('e')[2])
    return min(max(1 - exponent, 0), _MOST_DECIMALS)


def with_half_width(value: float, half_width: float) -> str:
    """Write a value and half of its interval, without an exponent."""
    places = decimals(half_width)
    return f'{round(value, places) + 0.0:.{places}f} +- {half_width:.{places}f}'


def counted(number: int, noun: str) -> str:
    """Return a number of things."""
    return f'{number} {noun}{"" if number == 1 else "s"}'


def duration(seconds: float, digits: int = 0) -> str:
    """Return a time with two units at most, for people, with so many digits of its unit if any."""
    seconds = round(seconds, 3)
    if digits:
        unit_s = next((unit_s for unit_s in (86400.0, 3600.0, 60.0) if seconds >= 2 * unit_s), 1.0)
        seconds = float(f'{seconds / unit_s:.{digits}g}') * unit_s
    for unit_s, unit, smaller_s, smaller in ((86400, 'd', 3600, 'h'), (3600, 'h', 60, 'min')):
        if round(seconds) >= unit_s:
            count, rest = divmod(round(seconds / smaller_s), round(unit_s / smaller_s))
            return f'{count} {unit} {rest} {smaller}' if rest else f'{count} {unit}'
    return f'{seconds / 60:.3g} min' if seconds >= 120 else f'{seconds:.3g} s'


def number(value: float, signed: bool = False, digits: int = 3) -> str:
    """Return a number with a few digits and no exponent."""
    if not np.isfinite(value):
        return '-'
    rounded = float(f'{value:.{digits}g}')
    text = f'{abs(rounded):.0f}' if abs(rounded) >= 100 else \
        np.format_float_positional(abs(rounded), trim='-')
    sign = '\N{MINUS SIGN}' if rounded < 0 else '+' if signed and rounded > 0 else ''
    return sign + text


def short_time(seconds: float) -> str:
    """Return a time that is mostly short."""
    if abs(seconds) >= 1:
        return f'{seconds:.4g} s'
    return f'{1e3 * seconds:.3g} ms' if abs(seconds) >= 1e-6 else '< 0.001 ms'


def file_size(count: int) -> str:
    """Return a number of bytes with its prefix."""
    for factor, unit in ((1e9, 'GB'), (1e6, 'MB'), (1e3, 'kB')):
        if count >= factor:
            return f'{count / factor:.3g} {unit}'
    return f'{count} B'
