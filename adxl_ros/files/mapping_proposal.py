# SPDX-License-Identifier: Apache-2.0

"""
The mapping that a table of other software most likely needs, by the names and values of columns.

It is a proposal for a message: nothing is read by it unless the user states it.
"""

from __future__ import annotations

from collections.abc import Sequence
import re
from typing import Any, NamedTuple

from adxl_ros.files.column_mapping import (
    ColumnMapping,
    Columns,
    first_names,
    GRAVITY,
    is_sensor_step,
    likely_unit,
    LSB,
    Quantity,
    ROLES,
    signed,
    Source,
    Table,
    time_unit_of_step,
    unit_in_name,
    UNITS,
    UNSIGNED,
)
from adxl_ros.files.stamps import burst_samples, stamped_rate_hz
from adxl_ros.model.constants import AXES
from adxl_ros.wording import option, pasted
import numpy as np

_TIME_NAMES = re.compile(
    r'(?i).*(time|stamp|zeit|date|clock|elapsed|epoch|millis|micros).*|'
    r'\W*(t|m?s|ms|us|ns|secs?|seconds?|(t|sec)[_\W].*)\W*'
)
"""Names of a time."""

_COUNTER_WORDS = {
    'packet',
    'pkt',
    'index',
    'idx',
    'count',
    'counter',
    'number',
    'num',
    'nr',
    'no',
    'seq',
    'sequence',
    'sample',
    'frame',
    'row',
    'line',
    'id',
}
"""Words in the name of a counter, which is no time."""

_OTHER_SENSORS = re.compile(
    r'(?i)gyr|mag(?!nit)|\bm[xyz]\b|(?<![a-z])(pos|dist|height|alt|lat|lon|hum)|'
    r'angular|omega|rate|\bw[xyz]\b|g[xyz]r|rot|orient|quat|press|baro|vel|\bg[xyz]\b|'
    r'abs|total|norm|std|cov|user|gravity|without|\brad\b|dps|(deg|°)\s?/\s?s|angle'
)
"""Names of columns of other sensors."""

_ACCEL_NAMES = tuple(
    map(
        re.compile,
        (
            r'(?i)^acc(el(eration|erometer)?)?\b|acc',
            r'(?i)^(a|f|g_?f|ad)_?[xyz]',
            r'(?i)^[xyz](\b|_|$)',
            r'(?i)[xyz]|^a\d',
        ),
    )
)
"""Names of acceleration, the surest first."""

_VOLT_NAMES = re.compile(r'(?i)volt|analog|(?<![a-z])m?v(?![a-z])|^v_?[xyz]|[xyz]_?v$')
"""Names of volts."""

_AXIS_WORD = re.compile(
    r'(?i)(?:a|acc|accel|g_?f|f|ad|adc|raw|gf|v)?([xyz])|([xyz])(?:acc|accel|adc|raw|v)'
)
"""A word in which x, y or z is the axis."""

_REFERENCES = {
    'alpha': r'(?i)^(alpha|angle(?!_?[xyz]\b)|winkel|tilt|inclination)',
    'beta': r'(?i)^(beta|azimuth)',
    'roll': r'(?i)^roll',
    'pitch': r'(?i)^pitch',
    'temperature': r'(?i)temp',
    'supply': r'(?i)^(supply|vcc|vdd|v_?bat|batt)',
}
"""Names of references by role."""

_CONSTANT = 0.3
"""Largest relative scatter of a length that is that of gravity. A hand that turns a sensor makes
less; the columns of another sensor, such as a gyroscope, have more."""

_LARGEST = 1e30  # Larger magnitudes are no readings and no stamps

_AT_REST = 0.05
"""Largest spread of a sensor that rests, as a share of its readings. Chosen: noise is far below
it, and 1 g of an analog sensor that is read about the middle of its supply above it."""

_TURNED = 0.3
"""Smallest spread of an axis in that of another one of a sensor that is turned about all axes."""

_NEVER_BACK = 0.99  # Smallest share of steps of a time that are not back. Chosen: a few are wrong
_FORWARD = 0.05  # Smallest share of steps forward. Chosen: stamps of a host come in bursts
_LARGEST_VOLTS = 9.0  # Readings of an analog sensor are below this, V: supplies have 5 V
_SMALLEST_COUNTS = 40.0  # Readings in counts are larger: the coarsest sensors have 64 a g

_COUNTS = (64, 100, 128, 256, 512, 1000, 1024, 1365, 2048, 4096, 8192, 16384, 32768)
"""Usual counts of 1 g."""

_SIGN_GAP = (24576, 40960)
"""Counts of 16 bits that are beyond the range, 1.5 times ±16384, where their sign was lost."""


def propose(table: Table) -> tuple[str, str]:
    """Describe the columns of a table, and the options that most likely read it."""
    seen = f'the columns are {first_names(table.names)}'
    sample = next((block.columns for block in table.blocks(table.names, ())), {})
    values = {
        name: np.where(np.abs(column) < _LARGEST, column, np.nan)
        for name, column in sample.items()
        if np.isfinite(column).any()
    }
    time = _time_column(table, values)
    outputs = _outputs(table, [name for name in values if name != time], values)
    readings = np.column_stack([values[name] for name in outputs]) if outputs else np.zeros((0, 1))
    known = readings[np.isfinite(readings).all(axis=1)]
    guess = _guess_output(table, outputs, known) if len(known) else None
    if guess is None:
        return (
            f'{seen}; none looks like an accelerometer: name the columns, for example',
            pasted(columns='time=COLUMN:s,x=COLUMN:g,y=COLUMN:g,z=COLUMN:g'),
        )
    sources = {axis: Source(name, guess.unit) for axis, name in zip(AXES, outputs)}
    stamps: dict[str, Any] = {'rate': 'HZ'}
    note = ' (write the sample rate for HZ)'
    if time:
        source = _time_source(table, time, values[time])
        sources = {'time': source, **sources}
        stamps = _stamp_options(values[time], source)
        note = ''
        if guess.unit in ('v', 'mv'):
            note = f' (then {option("sensor")} takes the parameter file of the sensor)'
    if table.has_names:
        sources |= _references(values, {*outputs, time})
    options = {'columns': str(ColumnMapping(sources)), **stamps, **guess.count_options}
    return f'{seen}; the best guess{note}:', pasted(**options)


class _Guess(NamedTuple):
    """The likely meaning of readings."""

    unit: str  # A name in `UNITS`
    zero: float  # Reading at 0 g
    length: float  # Length of gravity about it

    @property
    def count_options(self) -> dict[str, Any]:
        """Options that counts need, by name; none for other units."""
        if self.unit not in (LSB, UNSIGNED):
            return {}
        if not self.zero:
            return {'lsb_per_g': _usual_counts(self.length)}
        return {'lsb_per_g': round(self.length), 'lsb_at_0g': f'{self.zero:.0f}'}


def _guess_output(table: Table, outputs: Sequence[str], readings: np.ndarray) -> _Guess | None:
    """Guess what readings, (n, m), mean; None where they are not those of an accelerometer."""
    unit = table.units.get(outputs[0]) or unit_in_name(outputs[0], Quantity.OUTPUT)
    is_whole = bool((readings == np.rint(readings)).all())
    may_be_counts = is_whole and unit in (None, LSB)
    if may_be_counts and _have_lost_sign(readings):
        unit = UNSIGNED
        readings = signed(readings)
    # A sensor that was turned and never reads below 0 has its 0 g in the middle.
    low = readings.min(axis=0)
    spread = np.ptp(readings, axis=0)
    zero = 0.0
    is_turned = spread.min() > max(_TURNED * spread.max(), _AT_REST * readings.max())
    if low.min() > 0 and is_turned:
        zero = float(np.mean(low + spread / 2))
    lengths = np.linalg.norm(readings - zero, axis=1)
    length = float(np.median(lengths))
    if not unit and not zero:
        unit = _gravity_unit(length, is_whole)
    if not unit:
        is_volts = table.has_names and all(map(_VOLT_NAMES.search, outputs))
        if is_volts and length < _LARGEST_VOLTS:
            unit = 'v'
        elif length + zero >= _SMALLEST_COUNTS:
            unit = LSB
        else:
            return None
    is_constant = np.median(np.abs(lengths - length)) <= _CONSTANT * length
    is_gravity = is_constant and 0.5 < length / GRAVITY.get(unit, length) < 2
    # One or two axes show no length.
    return _Guess(unit, zero, length) if is_gravity or len(outputs) < len(AXES) else None


def _have_lost_sign(readings: np.ndarray) -> bool:
    """Return whether counts of 16 bits, (n, m), are in both parts of their range, not between."""
    is_between = (readings > _SIGN_GAP[0]) & (readings < _SIGN_GAP[1])
    is_beyond = _SIGN_GAP[1] < readings.max() < 1 << 16
    return bool(readings.min() >= 0 and is_beyond and not is_between.any())


def _usual_counts(length: float) -> int:
    """Return the usual counts of 1 g that are nearest to a length of gravity."""
    return min(_COUNTS, key=lambda count: abs(np.log(count / length)))


def _gravity_unit(length: float, is_whole: bool) -> str:
    """Return the unit in which a length is that of gravity; none where counts fit better."""
    unit = likely_unit(length)
    if not unit or not is_whole:
        return unit
    departure = abs(np.log(length / GRAVITY[unit]))
    return unit if departure <= abs(np.log(length / _usual_counts(length))) else ''


def _stamp_options(values: np.ndarray, source: Source) -> dict[str, Any]:
    """Return the option that stamps need which stand still or step back; none otherwise."""
    known = values[np.isfinite(values)]
    time_s = UNITS[Quantity.TIME][source.unit].convert(known - known[0])
    if (np.diff(time_s) > 0).all():
        return {}
    if burst_samples(time_s) > 1:
        return {'rate': f'{stamped_rate_hz(time_s):.4g}'}
    return {'drop_bad_stamps': True}


def _time_column(table: Table, values: Columns) -> str | None:
    """Return the column that is a time: it hardly ever decreases, and is no count of samples."""
    rising = []
    for name, column in values.items():
        steps = np.diff(column[np.isfinite(column)])
        if len(steps) > 2 and _rises(steps):
            rising.append(name)
    likely = [name for name in rising if not _is_counter(name, values[name])]
    if table.has_names:
        likely = [name for name in rising if _TIME_NAMES.fullmatch(name)] + likely
    return likely[0] if likely else None


def _rises(steps: np.ndarray) -> bool:
    """Return whether steps, (n,), are those of a time: hardly any steps back, and some forward."""
    return bool(np.mean(steps >= 0) > _NEVER_BACK and np.mean(steps > 0) > _FORWARD)


def _is_counter(name: str, column: np.ndarray) -> bool:
    """Return whether a column numbers the samples: by its name, or because it rises by one."""
    known = column[np.isfinite(column)]
    steps = np.diff(known)
    rises_by_one = (known == np.rint(known)).all() and np.median(steps[steps != 0]) == 1
    return bool(rises_by_one) or not _COUNTER_WORDS.isdisjoint(map(str.lower, _words(name)))


def _words(name: str) -> list[str]:
    """Return the words in the name of a column."""
    return re.split(r'[_\W]+|(?<=[a-z])(?=[A-Z])', name)


def _time_source(table: Table, name: str, values: np.ndarray) -> Source:
    """Return a time with the unit that its name states, or in which its steps are usual."""
    finite = values[np.isfinite(values)]
    steps = np.diff(finite)
    step = float(np.median(steps[steps > 0]))
    unit = table.units.get(name) or unit_in_name(name, Quantity.TIME)
    if not unit or not is_sensor_step(step / UNITS[Quantity.TIME][unit].divisor, False):
        unit = time_unit_of_step(step, bool((finite == np.rint(finite)).all()))
    return Source(name, unit)


def _outputs(table: Table, names: list[str], values: Columns) -> list[str]:
    """Return the columns of the axes: by their names, or three whose length is constant."""
    if table.has_names:
        own = [name for name in names if not _OTHER_SENSORS.search(name)]
        stated = [name for name in own if unit_in_name(name, Quantity.OUTPUT) in GRAVITY]
        groups = [
            stated,
            *([name for name in own if pattern.search(name)] for pattern in _ACCEL_NAMES),
        ]
        return next(filter(None, map(_by_axis, groups)), [])

    def scatter(triple: list[str]) -> float:
        """Return the relative scatter of the length of three columns."""
        length = np.linalg.norm([values[name] for name in triple], axis=0)
        median = np.nanmedian(length)
        return float(np.nanmedian(np.abs(length - median)) / max(median, 1e-12))

    return min((names[i : i + 3] for i in range(len(names) - 2)), key=scatter, default=[])


def _by_axis(names: Sequence[str]) -> list[str]:
    """Return the names of x, y and z in this order, as far as there are any; or acc[0] ..."""
    by_letter: dict[str, str] = {}
    for name in names:
        bare = re.sub(r'[(\[{].*?[)\]}]', '', name).strip()
        *_, last = (None, *filter(None, map(_AXIS_WORD.fullmatch, _words(bare))))
        if last:
            by_letter.setdefault((last[1] or last[2]).lower(), name)
    if by_letter:
        axes = AXES[: len(by_letter)]
        return [by_letter[axis] for axis in axes] if set(axes) == set(by_letter) else []
    numbered = [name for name in names if re.search(r'(?<!\d)[0-3]\]?$', name)]
    return numbered[: len(AXES)] if len(numbered) >= len(AXES) else []


def _references(values: Columns, used: set[str | None]) -> dict[str, Source]:
    """Return the columns of references, with their units."""
    sources: dict[str, Source] = {}
    for role, pattern in _REFERENCES.items():
        name = next((name for name in values if name not in used and re.search(pattern, name)), '')
        if name:
            usual = ROLES[role].value
            if usual == 'rad' and (np.abs(values[name]) > 2 * np.pi).any():
                usual = 'deg'
            sources[role] = Source(name, unit_in_name(name, ROLES[role]) or usual)
    # An estimate of attitude, which has a yaw, is made of the readings and is no reference.
    is_estimate = any(re.search('(?i)yaw|heading|quat', name) for name in values)
    is_attitude = {'roll', 'pitch'} <= set(sources) and not is_estimate
    if 'alpha' in sources or not is_attitude:
        sources.pop('roll', None)
        sources.pop('pitch', None)
    return sources
