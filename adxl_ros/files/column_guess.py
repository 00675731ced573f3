# SPDX-License-Identifier: Apache-2.0

"""The mapping that a table most likely needs, from the names and values of its columns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
import re

from adxl_ros.files.column_mapping import (
    ColumnMapping,
    GRAVITY,
    is_sensor_step,
    likely_unit,
    listed,
    LSB,
    Quantity,
    ROLES,
    shell_quoted,
    signed,
    Source,
    Table,
    time_unit_of_step,
    unit_in_name,
    UNITS,
    UNSIGNED,
)
from adxl_ros.files.recording_columns import burst_samples, stamped_rate_hz
from adxl_ros.model.constants import AXES
import numpy as np

_TIME_NAMES = re.compile(
    r'(?i)\W*(t|time|times|timestamp|timestamps|stamp|stamps|zeit|clock|elapsed|millis|micros|'
    r'seconds?|secs?|m?s|ms|us|ns|epoch|unix|dt_?sum|date_?time|header[._]stamp.*|.*time.*|'
    r'.*stamp.*|(t|sec)[_\W].*)\W*')
"""Names of a time."""

_INDEX_NAMES = re.compile(r'(?i)index|sample|frame|count|seq|^(n|i|id|no)$|#')
"""Names of a count."""

_OTHER_SENSORS = re.compile(
    r'(?i)gyr|mag(?!nit)|\bm[xyz]\b|compass|(?<![a-z])(pos|dist|height|alt|lat|lon|hum)|'
    r'angular|omega|rate|\bw[xyz]\b|g[xyz]r|rot|orient|quat|'
    r'press|baro|gps|vel|\bg[xyz]\b|abs|total|norm|std|cov|user|gravity|without|'
    r'\brad\b|dps|(deg|°)\s?/\s?s|angle')
"""Names of columns of other sensors."""

_ACCEL_NAMES = (
    re.compile(r'(?i)^acc(el(eration|erometer)?)?\b|acc'),
    re.compile(r'(?i)^(a|f|g_?f|ad)_?[xyz]'),
    re.compile(r'(?i)^[xyz](\b|_|$)'),
    re.compile(r'(?i)[xyz]'),
)
"""Names of acceleration, the surest first."""

_COUNT_NAMES = re.compile(r'(?i)acc|^(a|f|g_?f|ad)_?[xyz]|adc|raw|counts?|lsb|^a\d')
"""Names of an accelerometer's counts."""

_VOLT_NAMES = re.compile(r'(?i)volt|adc|analog|^a\d|(?<![a-z])m?v(?![a-z])|^v_?[xyz]|[xyz]_?v$')
"""Names of volts."""

_AXIS_WORD = re.compile(
    r'(?i)(a|acc|accel|g_?f|f|ad|adc|raw|gf|v)([xyz])|([xyz])(acc|accel|adc|raw|v)')
"""A word in which x, y or z is the axis."""

_REFERENCES = {
    'alpha': re.compile(r'(?i)^(alpha|angle(?!_?[xyz]\b)|winkel|tilt|inclination)'),
    'beta': re.compile(r'(?i)^(beta|azimuth)'),
    'roll': re.compile(r'(?i)^roll'),
    'pitch': re.compile(r'(?i)^pitch'),
    'temperature': re.compile(r'(?i)temp'),
    'supply': re.compile(r'(?i)^(supply|vcc|vdd|v_?bat|batt)'),
}
"""Names of references by role."""

_USUAL = {Quantity.ANGLE: (2 * np.pi, 'rad', 'deg'), Quantity.TEMPERATURE: (200.0, 'c', 'k'),
          Quantity.VOLTAGE: (100.0, 'v', 'mv')}
"""Largest usual value of a reference in a unit, that unit, and the unit of larger values."""

_ATTITUDE = re.compile(r'(?i)yaw|heading|quat')
"""Names beside an attitude that software has estimated."""

_EPOCHS = ((1e9, 'ns'), (1e6, 'us'), (1e3, 'ms'), (1.0, 'epoch'))
"""Counts of a second of each unit."""

_EPOCH_S = (9e8, 4e9)
"""Bounds of times since 1970, s: 1998 to 2096."""

_CONSTANT = 0.3
"""Largest relative scatter of a length that is that of gravity (chosen: a hand that turns a
sensor makes less)."""

_LENGTHS_G = (0.5, 2.0)
"""Bounds of the length of readings at rest in a unit that the name states, g."""

_REST_ROWS = 16
"""Rows of a window; the quietest quarter of them is at rest (chosen: short in every log)."""

_LARGEST = 1e30
"""Larger magnitudes are no readings and no stamps."""

_SPHERE_ROWS = 20
"""Smallest number of rows to which a sphere is fitted."""

_SPHERE_SCATTER = 0.2
"""Largest scatter of the distances from the centre, in radii: noise alone makes a third."""

_TURNED = 0.3
"""Smallest spread of an axis in that of another one of a sensor that is turned."""

_NOMINAL_V = 2.5
"""Output at 0 g of the nominal sensor, V (ADXL203 data sheet, table 1)."""

_NEAR_NOMINAL = 0.1
"""Largest relative difference from it (chosen: units of one kind differ by less)."""

_NEAR_COUNTS = 0.1
"""Largest logarithm of the ratio of a length to usual counts of 1 g (chosen: tolerances are)."""

_COUNTS = (64, 100, 128, 256, 512, 1000, 1024, 1365, 2048, 4096, 8192, 16384, 32768)
"""Usual counts of 1 g."""


def describe(table: Table) -> tuple[str, str]:
    """Describe the columns of a table, and the options that most likely read it."""
    seen = f'the columns are {listed(table.names)}' + f' ({table.form})' * bool(table.form)
    values = {name: np.where(np.abs(column) < _LARGEST, column, np.nan)
              for name, column in table.sample().items()}
    time = _time_column(table, values)
    outputs = _outputs(table, {name: column for name, column in values.items() if name != time})
    readings = np.column_stack([values[name] for name in outputs]) if outputs else np.zeros((0, 1))
    readings = readings[np.isfinite(readings).all(axis=1)]
    unit, zero, length, is_stated = _unit(table, outputs, readings)
    if not unit:
        return (f'{seen}; none looks like an accelerometer: name the columns, for example',
                "--columns 'time=COLUMN:s,x=COLUMN:g,y=COLUMN:g,z=COLUMN:g'")
    about = f' about {zero:.4g}' * (zero != 0)
    reason = f'the readings have a length of {length:.4g}{about}'
    reason += f', so {unit}' * (not is_stated)
    sources = {axis: Source(name, unit) for axis, name in zip(AXES, outputs)}
    stamps, note = '--rate HZ', ' (write the sample rate for HZ)'
    if time:
        source, time_reason = _time_source(table, time, values[time])
        reason, sources = f'{time_reason} and {reason}', {'time': source, **sources}
        stamps, note = _stamp_options(values[time], source), _note(unit, zero)
    sources |= _references(table, values, {*outputs, time or ''})
    options = f'--columns {shell_quoted(str(ColumnMapping(sources)))}'
    options += f' {stamps}' * bool(stamps)
    if unit in (LSB, UNSIGNED):
        options += f' --lsb-per-g {round(length) if zero else _counts(length):.0f}'
        options += f' --lsb-at-0g {zero:.0f}' * bool(zero)
    return f'{seen}; the best guess, because {reason}{note}:', options


def _unit(table: Table, outputs: Sequence[str], readings: np.ndarray
          ) -> tuple[str, float, float, bool]:
    """
    Return the unit of readings, (n, m); empty where they are not those of an accelerometer.

    Also the reading at 0 g, the length of gravity about it, and whether the table states the unit.
    """
    if not len(readings):
        return '', 0.0, 0.0, False
    stated = table.units.get(outputs[0]) or unit_in_name(outputs[0], Quantity.OUTPUT)
    is_unsigned = stated in (None, LSB) and _has_lost_sign(readings)
    zero, length = _zero_and_length(signed(readings) if is_unsigned else readings)
    unit = UNSIGNED if is_unsigned else stated or ('' if zero else likely_unit(length)) or \
        _count_or_volts(zero or length, readings, outputs if table.has_names else [])
    if unit and len(outputs) == len(AXES) and not _is_gravity(readings, unit, zero, length):
        unit = ''
    return unit, zero, length, bool(stated)


def _note(unit: str, zero: float) -> str:
    """Return what the user has to add to the options, in brackets."""
    output = UNITS[Quantity.OUTPUT][unit]
    ratio = float(output.convert(np.array(zero))) / _NOMINAL_V
    is_other = output.is_volts and zero != 0 and abs(ratio - 1) > _NEAR_NOMINAL
    return ' (add --params with the parameter file of the sensor)' * is_other


def _stamp_options(values: np.ndarray, source: Source) -> str:
    """Return the option that stamps need which stand still or step back; empty for none."""
    time_s = UNITS[Quantity.TIME][source.unit].convert(values[np.isfinite(values)] - values[0])
    if (np.diff(time_s) > 0).all():
        return ''
    if burst_samples(time_s) > 1:
        return f'--rate {stamped_rate_hz(time_s):.4g}'
    return '--drop-bad-stamps'


def _time_column(table: Table, values: Mapping[str, np.ndarray]) -> str | None:
    """Return the column that is a time: it does not decrease, and its name or place says so."""
    rising = [name for name, column in values.items() if _is_rising(column)]
    named = [name for name in rising if table.has_names and _TIME_NAMES.fullmatch(name)]
    # A count of the samples is no time, and the name of an index says so.
    others = [name for name in rising if not _is_count(values[name])
              and not (table.has_names and _INDEX_NAMES.search(name))]
    return next(iter([*named, *others]), None)


def _is_rising(values: np.ndarray) -> bool:
    """Return whether values hardly ever decrease, and change."""
    finite = values[np.isfinite(values)]
    steps = np.diff(finite)
    return len(steps) > 2 and float(np.mean(steps >= 0)) > 0.99 and finite[-1] > finite[0] and \
        float(np.mean(steps > 0)) > 0.05


def _is_count(values: np.ndarray) -> bool:
    """Return whether values count by one."""
    return bool((np.diff(values) == 1).all()) and abs(values[0]) <= 1


def _time_source(table: Table, name: str, values: np.ndarray) -> tuple[Source, str]:
    """Return a time with its unit, and the reason."""
    finite = values[np.isfinite(values)]
    steps = np.diff(finite)
    step = float(np.median(steps[steps > 0])) if (steps > 0).any() else 1.0
    stated = table.units.get(name) or (unit_in_name(name, Quantity.TIME) if table.has_names
                                       else None)
    # A unit in the name counts unless no sensor has samples at such steps.
    if stated and is_sensor_step(step / UNITS[Quantity.TIME][stated].divisor, False):
        return Source(name, stated), f'{name} has steps of {step:.4g} {stated}'
    for second, unit in _EPOCHS:
        if _EPOCH_S[0] < finite[0] / second < _EPOCH_S[1] and \
                is_sensor_step(step / second, False):
            return Source(name, unit), f'{name} counts from 1970'
    unit = time_unit_of_step(step, bool((finite == np.rint(finite)).all()))
    return Source(name, unit), f'{name} has steps of {step:.4g}, so {unit}'


def _outputs(table: Table, values: Mapping[str, np.ndarray]) -> list[str]:
    """Return the columns of the axes, as many as there are."""
    if table.has_names:
        names = [name for name in values if not _OTHER_SENSORS.search(name)]
        stated = [name for name in names
                  if unit_in_name(name, Quantity.OUTPUT) in GRAVITY]
        groups = [stated, *([name for name in names if pattern.search(name)]
                            for pattern in _ACCEL_NAMES)]
        outputs = next(filter(None, map(_by_axis, groups)), None)
        if outputs:
            return outputs
    others = [_OTHER_SENSORS, *_REFERENCES.values()] if table.has_names else []
    return _by_length({name: column for name, column in values.items()
                       if not any(pattern.search(name) for pattern in others)})


def _by_axis(names: Sequence[str]) -> list[str]:
    """Return the names of x, y and z in this order, as far as there are any."""
    by_letter = {_axis(name): name for name in reversed(names)}
    axes = [by_letter[axis] for axis in AXES if axis in by_letter]
    if axes:
        return axes if tuple(axes) == tuple(map(by_letter.get, AXES[:len(axes)])) else []
    # Names with numbers in place of letters, as acc_0 or acc[1].
    numbered = [name for name in names if re.search(r'(?<!\d)[0-3]\]?$', name)]
    return numbered[:len(AXES)] if len(numbered) >= len(AXES) else []


def _axis(name: str) -> str | None:
    """Return the axis that a name states; None without one."""
    bare = re.sub(r'[(\[{].*?[)\]}]', '', name).strip()
    words = [word for word in re.split(r'[_\W]+|(?<=[a-z])(?=[A-Z])', bare) if word]
    for word in reversed(words):
        if word.lower() in AXES:
            return word.lower()
    for word in words:
        match = _AXIS_WORD.fullmatch(word)
        if match:
            return (match[2] or match[3]).lower()
    return None


def _by_length(values: Mapping[str, np.ndarray]) -> list[str]:
    """Return three neighbouring columns whose length is the most constant, if it is so."""
    names = [name for name, column in values.items() if not _is_rising(column)]
    best: tuple[float, list[str]] = (_CONSTANT, [])
    for triple in combinations(names, 3):
        if names.index(triple[2]) - names.index(triple[0]) > 2:
            continue
        data = np.column_stack([values[name] for name in triple])
        length = np.linalg.norm(data[np.isfinite(data).all(axis=1)], axis=1)
        median = np.median(length) if len(length) else 0.0
        spread = float(np.median(np.abs(length - median)) / median) if median > 0 else np.inf
        # Counts about an offset also have a constant length, as has a unit quaternion.
        unit_fits = bool(likely_unit(float(median)))
        best = min(best, (spread + 0.1 * (not unit_fits), list(triple)))
    return best[1]


def _zero_and_length(readings: np.ndarray) -> tuple[float, float]:
    """
    Return the reading at 0 g and the length of gravity about it.

    The zero is 0 where an axis reads on both sides of it, or where the readings do not turn.
    """
    length = float(np.median(np.linalg.norm(_at_rest(readings), axis=1)))
    spread = np.ptp(readings, axis=0)
    if len(readings) < _SPHERE_ROWS or (readings.min(axis=0) < 0).any() or \
            spread.min() < _TURNED * spread.max():
        return 0.0, length
    if readings.shape[1] < len(AXES):
        return float(np.mean(readings.min(axis=0) + spread / 2)), float(spread.max() / 2)
    # A sphere: |r|^2 = 2 r.c + radius^2 - |c|^2 is linear in its centre.
    terms = np.column_stack([2 * readings, np.ones(len(readings))])
    solution = np.linalg.lstsq(terms, (readings ** 2).sum(axis=1), rcond=None)[0]
    radius = float(np.sqrt(max(solution[3] + solution[:3] @ solution[:3], 0.0)))
    centre = float(np.mean(solution[:3]))
    scatter = np.std(np.linalg.norm(readings - solution[:3], axis=1))
    is_sphere = scatter < _SPHERE_SCATTER * radius and radius < centre * len(AXES)
    return (centre, radius) if is_sphere else (0.0, length)


def _at_rest(readings: np.ndarray) -> np.ndarray:
    """Return the means of the quietest quarter of the windows, (k, m)."""
    count = len(readings) // _REST_ROWS
    if count < 4:
        return readings
    windows = readings[:count * _REST_ROWS].reshape(count, _REST_ROWS, -1)
    variance = windows.var(axis=1).sum(axis=1)
    return np.asarray(windows.mean(axis=1)[variance <= np.quantile(variance, 0.25)])


def _is_gravity(readings: np.ndarray, unit: str, zero: float, length: float) -> bool:
    """Return whether readings have the constant length of gravity at rest."""
    values = signed(readings) if unit == UNSIGNED else readings
    lengths = np.linalg.norm(_at_rest(values) - zero, axis=1)
    if np.median(np.abs(lengths - length)) > _CONSTANT * length:
        return False
    if unit not in GRAVITY:
        return True
    return _LENGTHS_G[0] < length / GRAVITY[unit] < _LENGTHS_G[1]


def _has_lost_sign(readings: np.ndarray) -> bool:
    """Return whether readings are counts of 16 bits that have lost their sign."""
    if not (readings.min() >= 0 and 1 << 15 <= readings.max() < 1 << 16 and
            (readings == np.rint(readings)).all()):
        return False
    length = float(np.median(np.linalg.norm(_at_rest(signed(readings)), axis=1)))
    return abs(np.log(length / _counts(length))) < _NEAR_COUNTS and \
        _is_gravity(readings, UNSIGNED, 0.0, length)


def _count_or_volts(length: float, readings: np.ndarray, names: Sequence[str]) -> str:
    """Return counts or volts where values and names allow them; empty where they do not."""
    if length > 40:
        is_whole = bool((readings == np.rint(readings)).all())
        return LSB if not names or is_whole or all(map(_COUNT_NAMES.search, names)) else ''
    return 'v' if length < 9 and names and all(map(_VOLT_NAMES.search, names)) else ''


def _counts(length: float) -> float:
    """Return the usual counts of 1 g nearest to a length."""
    return float(min(_COUNTS, key=lambda count: abs(np.log(count / length))))


def _references(table: Table, values: Mapping[str, np.ndarray], used: set[str]
                ) -> dict[str, Source]:
    """Return the columns of references, with their units."""
    sources: dict[str, Source] = {}
    for role, pattern in _REFERENCES.items() if table.has_names else ():
        name = next((name for name in values if name not in used and pattern.search(name)), None)
        if name:
            limit, usual, other = _USUAL[ROLES[role]]
            likely = other if (np.abs(values[name]) > limit).any() else usual
            sources[role] = Source(name, unit_in_name(name, ROLES[role]) or likely)
    # An estimate of attitude, which has a yaw, is made of the readings and is no reference.
    is_estimate = any(_ATTITUDE.search(name) for name in values)
    if not {'roll', 'pitch'} <= set(sources) or 'alpha' in sources or is_estimate:
        sources.pop('roll', None), sources.pop('pitch', None)
    return sources
