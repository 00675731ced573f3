# SPDX-License-Identifier: Apache-2.0
"""Numbers as text: the digits that intervals allow, units that people use, and lists."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from typing import Any

from adxl_ros.model.constants import G0_MPS2
import numpy as np

_MOST_DECIMALS = 7
"""Largest number of decimals (chosen: a table of 79 columns has room for ten digits)."""
_UNKNOWN_DECIMALS = 4  # Number of decimals of a coefficient without an interval
_NEARLY_ALL = 0.995  # Share from which a percentage would be rounded to 100
_SMALLEST_MG = 0.005  # Acceleration, mg, that rounds to 0.00 below this
_UNIT_SUFFIXES = ('m', 's', 'rad', 'v', 'hz', 'f', 'g')
"""Ends of parameter names that repeat the unit of the value."""


@dataclass(frozen=True)
class Interval:
    """A value with its 90 % interval, in the unit of the field that has it, as `before_mps2`."""

    value: float  # The estimate
    low: float  # Low end of the interval
    high: float  # High end of the interval


def utc(stamp_ns: int) -> datetime:
    """Return a stamp, ns, as a date in UTC."""
    return datetime.fromtimestamp(stamp_ns * 1e-9, timezone.utc)


def decimals(half_width: float) -> int:
    """Return the number of decimals that shows two digits of an interval."""
    if not half_width > 0:
        return _UNKNOWN_DECIMALS
    exponent = int(f'{half_width:.1e}'.partition('e')[2])
    return min(max(1 - exponent, 0), _MOST_DECIMALS)


def fixed(value: float, places: int) -> str:
    """Write a value with a number of decimals; 0 has no sign."""
    return f'{round(value, places) + 0.0:.{places}f}'


def with_half_width(value: float, half_width: float) -> str:
    """Write a value and half of its interval, without an exponent."""
    places = decimals(half_width)
    return f'{fixed(value, places)} +- {half_width:.{places}f}'


def counted(number: int, noun: str) -> str:
    """Return a number of things."""
    return f'{number} {noun}{"" if number == 1 else "s"}'


def duration(seconds: float) -> str:
    """Return a time with two units at most, for people."""
    seconds = round(seconds, 3)
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
    text = (
        f'{abs(rounded):.0f}'
        if abs(rounded) >= 100
        else np.format_float_positional(abs(rounded), trim='-')
    )
    if rounded < 0:
        return '\N{MINUS SIGN}' + text
    return '+' + text if signed and rounded > 0 else text


def signed(value: float) -> str:
    """Return a value with two decimals and its sign."""
    return f'{value:+.2f}'.replace('-', '\N{MINUS SIGN}')


def two_digits(value: float) -> str:
    """Return a positive value with two digits, the last zero too."""
    return f'{value:.0f}' if value >= 10 else f'{value:#.2g}'


def three_digits(value: float) -> str:
    """Return a positive value with three digits at most, without an exponent."""
    if value >= 10:
        return f'{value:.1f}'
    if value >= 1:
        return f'{value:.2f}'
    return f'{value:.3f}' if value >= 5e-4 else '< 0.001'


def short_time(seconds: float) -> str:
    """Return a time that is mostly short."""
    if abs(seconds) >= 1:
        return f'{seconds:.4g} s'
    return f'{1e3 * seconds:.3g} ms' if abs(seconds) >= 1e-6 else '< 0.001 ms'


def listed(names: Sequence[str], word: str) -> str:
    """Return names separated by commas, with a word before the last one."""
    return f' {word} '.join(filter(None, [', '.join(names[:-1]), *names[-1:]]))


def column_unit(name: str) -> str:
    """Return the unit of a reference, which its column's name ends with."""
    return {'rad': 'rad', 'm': 'm', 'c': '°C', 'v': 'V'}[name.rsplit('_', 1)[1]]


def mg(value_mps2: Any) -> Any:
    """Convert m/s² to mg."""
    return 1e3 * value_mps2 / G0_MPS2


def mg_text(value_mps2: float) -> str:
    """Return an acceleration, m/s², in mg with three digits at most."""
    value = float(mg(value_mps2))
    if abs(value) < _SMALLEST_MG:
        return '< 0.01 mg'
    if abs(value) < 10:
        return f'{value:.2f} mg'
    return f'{value:.1f} mg' if abs(value) < 100 else f'{value:.0f} mg'


def acceleration_text(value_mps2: float) -> str:
    """Return an acceleration, m/s², in mg, or in g where it is large."""
    value_g = abs(value_mps2) / G0_MPS2
    return f'{value_g:.3g} g' if value_g >= 1 else mg_text(value_mps2)


def amplitude_text(power: float) -> str:
    """Return the root of a power, (m/s²)², in mg; a negative power counts as 0."""
    return mg_text(float(np.sqrt(max(power, 0.0))))


def power_text(power: Interval) -> str:
    """Return the root of a power with its 90 % interval in mg."""
    value, low, high = map(amplitude_text, (power.value, power.low, power.high))
    return value if value == high else f'{value[:-3]} ({low[:-3]} to {high[:-3]}) mg'


def percent(share: float) -> str:
    """Return a share in per cent; only certainty by definition would be 0 or 100 %."""
    if share >= _NEARLY_ALL:
        return '> 99 %'
    return '< 1 %' if 0 < share < 1 - _NEARLY_ALL else f'{100 * share:.0f} %'


def parameter_label(key: str, is_single: bool) -> str:
    """Return the name of a parameter without its unit, or its axis where that is enough."""
    name, _, axis = key.partition('.')
    stem, _, suffix = name.rpartition('_')
    short = stem if stem and suffix in _UNIT_SUFFIXES else name
    return axis if axis and is_single else f'{short} {axis}'.rstrip()


def parameter_text(
    parameter: Mapping[str, Any], scale_v_per_g: float = 1.0, digits: int = 3
) -> str:
    """Return a parameter of a report with its interval, in a unit that people use."""
    if not parameter.get('determined', True):
        return 'not determined'
    ci = parameter.get('ci')
    plain = np.array([*np.atleast_1d(parameter['value']), *(ci or ())], float)
    values, unit = _for_people(plain, parameter['unit'], scale_v_per_g)
    if ci:
        width = max((values[2] - values[1]) / 4, 1e-12)
        places = int(np.clip(np.ceil(-np.log10(width)), 0, 6))
        value, low, high = [fixed(v, places) for v in values]
        return f'{value} ({low} to {high}) {unit}'.rstrip()
    texts = dict.fromkeys(
        np.format_float_positional(v, digits, fractional=False, trim='-')
        if abs(v) < 100
        else f'{v:.0f}'
        for v in values
    )
    return f'{", ".join(texts)} {unit}'.rstrip()


def _for_people(values: np.ndarray, unit: str, scale_v_per_g: float) -> tuple[np.ndarray, str]:
    """Return values in a unit with prefix; volts of the output as an acceleration."""
    if unit == 'rad':
        return np.degrees(values), 'deg'
    if unit in ('V', 'V/g'):
        values = values / scale_v_per_g
        unit = 'g' if unit == 'V' else '1'
    if unit == 'm/s^2':
        values = values / G0_MPS2
        unit = 'g'
    base, slash, per = unit.replace('s/s', '1').partition('/')
    per = per.replace('^2', '²').replace('sqrt(', '√').replace(')', '')
    largest = float(np.abs(values).max())
    if base in ('g', 'm', 's', 'V', '1') and 0 < largest < 0.1:
        if base == '1':
            factor, base = (1e6, 'ppm') if largest < 1e-4 else (1e2, '%')
        else:
            factor, prefix = (1e6, 'µ') if largest < 1e-4 else (1e3, 'm')
            base = prefix + base
        values = factor * values
    return values, (base + slash + per).removeprefix('1' if not per else '')
