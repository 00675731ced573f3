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
"""Coefficients as text, with the digits that their intervals allow."""

_MOST_DECIMALS = 7
"""Largest number of decimals (chosen: a table of 79 columns has room for ten digits)."""
_UNKNOWN_DECIMALS = 4
"""Number of decimals of a coefficient without an interval."""


def decimals(half_width: float) -> int:
    """Return the number of decimals that shows two digits of an interval."""
    if not half_width > 0:
        return _UNKNOWN_DECIMALS
    exponent = int(f'{half_width:.1e}'.partition('e')[2])
    return min(max(1 - exponent, 0), _MOST_DECIMALS)


def with_half_width(value: float, half_width: float) -> str:
    """
    Write a value and half of its interval, without an exponent.

    Parameters
    ----------
    value
        The value.
    half_width
        Half of its interval, in the same unit.

    Returns
    -------
    str
        Both with two digits of the interval.

    """
    places = decimals(half_width)
    return f'{round(value, places) + 0.0:.{places}f} +- {half_width:.{places}f}'


def counted(number: int, noun: str) -> str:
    """
    Return a number of things.

    Parameters
    ----------
    number
        The number.
    noun
        Its noun, whose plural ends in s.

    Returns
    -------
    str
        Both.

    """
    return f'{number} {noun}{"" if number == 1 else "s"}'


def duration(seconds: float) -> str:
    """Return a time with two units at most, for people."""
    seconds = round(seconds, 3)
    for unit_s, unit, smaller_s, smaller in ((86400, 'd', 3600, 'h'), (3600, 'h', 60, 'min')):
        if round(seconds) >= unit_s:
            count, rest = divmod(round(seconds / smaller_s), round(unit_s / smaller_s))
            return f'{count} {unit} {rest} {smaller}' if rest else f'{count} {unit}'
    return f'{seconds / 60:.3g} min' if seconds >= 120 else f'{seconds:.3g} s'
