# SPDX-License-Identifier: Apache-2.0

"""
A table, and how it is read as a recording: columns, units, stamps and the mounting.

Where a table is not understood, `propose` finds the mapping that it most likely needs.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path
import re
import shlex
from typing import NamedTuple

from adxl_ros.errors import UserError
from adxl_ros.files.recording_columns import burst_samples, stamped_rate_hz
from adxl_ros.model.constants import AXES, G0_MPS2, MEASURED_AXES
import numpy as np

_EXAMPLE = 'time=t_ms:ms,x=accX:mg,y=accY:mg,z=accZ:mg'  # A mapping, for messages

_ENTRY = re.compile(r"""\s*([^=,\s]+)\s*=\s*(?:"([^"]*)"|'([^']*)'|([^,"'\n]*?))\s*"""
                    r"""(?::\s*([^:,"'\n]*?))?\s*(?:,|\n|$)""")
"""An entry of a mapping: a role, its column in double, single or no quotes, and a unit."""


@dataclass(frozen=True)
class TableBlock:
    """Rows of a table."""

    columns: Mapping[str, np.ndarray]  # Arrays (n,) by column name; an empty cell is NaN
    # Returns file and place of a cell for messages, by its row in the block and its column
    where: Callable[[int, str], str]
    info: Mapping[str, str] = field(default_factory=dict)  # Keys and values that the file states
    done: float = 1.0  # Fraction of the file that has been read at the end of the rows
    cut: str = ''  # Where a damaged file ends; empty if it is whole


@dataclass(frozen=True)
class Table:
    """A file with columns."""

    path: str
    names: tuple[str, ...]  # Its columns, each once
    # Yields the rows of some columns, in the order of the file. In a column of the second
    # argument, a cell that is no number is an error; another such column is left out.
    blocks: Callable[[Collection[str], Collection[str]], Iterator[TableBlock]]
    units: Mapping[str, str] = field(default_factory=dict)  # Units that the format states
    default_mapping: str = ''  # Mapping that the definition of the format states
    header_line: int | None = None  # Line of a text file with the names; 0 where it has none
    repeated: str = ''  # A name that stands twice; empty for none

    @property
    def has_names(self) -> bool:
        """Return whether the file names its columns; else they are numbers from 1."""
        return self.header_line != 0

    @property
    def header(self) -> str:
        """Return file and line of the names for messages."""
        return f'{self.path}:{self.header_line}' if self.header_line else self.path

    def read(self, names: Collection[str]) -> dict[str, np.ndarray]:
        """Return all rows of columns that must hold numbers."""
        blocks = list(self.blocks(names, names))
        return {name: np.concatenate([block.columns[name] for block in blocks]) for name in names}


class Source(NamedTuple):
    """Where a quantity comes from."""

    column: str  # Name of the column, or its number from 1
    unit: str = ''  # Name of its unit; empty where none is stated


@dataclass(frozen=True)
class ColumnMapping:
    """Which columns of a file hold a recording."""

    sources: Mapping[str, Source]  # Column and unit by role, a key of `ROLES`
    where: str = '--columns'  # What states the mapping, for messages

    def __str__(self) -> str:
        """Return the text that states the mapping."""
        return ','.join(f'{role}={_quoted(column)}{":" * bool(unit)}{unit}'
                        for role, (column, unit) in self.sources.items())


def _quoted(column: str) -> str:
    """Return the name of a column as a mapping writes it."""
    if not re.search('[,:=\'"#]|^$|^\\s|\\s$', column):
        return column
    return f"'{column}'" if '"' in column else f'"{column}"'


def parse_mapping(text: str) -> ColumnMapping:
    """Parse a mapping, or the file that holds it."""
    where = '--columns'
    if '=' not in text:
        where = f'--columns {text}'
        try:
            text = re.sub('#.*', '', Path(text).read_text(encoding='utf-8'))
        except (OSError, UnicodeDecodeError):
            raise UserError(f'{where}: is neither a mapping nor a file that can be read; '
                            f'write for example {_EXAMPLE}') from None
    sources: dict[str, Source] = {}
    text = text.strip().rstrip(',')
    while text:
        entry = _ENTRY.match(text)
        if entry is None:
            raise UserError(f'{where}: {text[:40]!r} is no role=column:unit; '
                            f'write for example {_EXAMPLE}')
        text = text[entry.end():]
        role, *columns, unit = entry.groups(default='')
        column = ''.join(columns).strip()
        if role not in ROLES:
            raise UserError(f'{where}: no role {role!r}; the roles are {", ".join(ROLES)}')
        if role in sources or not column:
            raise UserError(f'{where}: {role} must name one column, once')
        name = unit_name(unit, ROLES[role]) if unit else ''
        if name is None:
            raise UserError(f'{where}: {role}={column}:{unit}: unknown unit {unit!r}; write one '
                            f'of {", ".join(UNITS[ROLES[role]])}, or quote a name that has a '
                            'colon')
        sources[role] = Source(column, name)
    axes = ''.join(axis for axis in AXES if axis in sources)
    if axes not in MEASURED_AXES:
        raise UserError(f'{where}: names the axes {axes or "none"}, expected x, x and y, or x, y '
                        f'and z; write for example {_EXAMPLE}')
    given = {'roll', 'pitch', 'alpha', 'beta'} & set(sources)
    if given & {'roll', 'pitch'} and given != {'roll', 'pitch'}:
        raise UserError(f'{where}: {", ".join(sorted(given))} are no reference; name roll and '
                        'pitch, or alpha and beta')
    return ColumnMapping(sources, where)


Mounting = tuple[tuple[int, int], ...]
"""For each axis of the sensor frame, the index of an axis of the file, and its sign, 1 or −1."""


def parse_mounting(text: str) -> Mounting:
    """Parse a documented mounting, as in `x=-y,y=x,z=z`: x of the frame is −y of the file."""
    entries = re.findall(r'(?:^|,)\s*([xyz])\s*=\s*([-+]?)\s*([xyz])\s*(?=,|$)', text)
    axes = AXES[:text.count(',') + 1]
    mounting = {axis: (AXES.index(of), -1 if sign == '-' else 1) for axis, sign, of in entries}
    if set(mounting) != set(axes) or {AXES[index] for index, _ in mounting.values()} != set(axes):
        raise UserError(f'--axes {text}: each axis of the sensor must stand once on both sides; '
                        'write for example x=-y,y=x,z=z')
    return tuple(mounting[axis] for axis in axes)


class Quantity(Enum):
    """What a column measures; the value names the unit of the package."""

    TIME = 's'
    OUTPUT = 'mps2'
    ANGLE = 'rad'
    LENGTH = 'm'
    TEMPERATURE = 'c'
    VOLTAGE = 'v'


ROLES: Mapping[str, Quantity] = {
    'time': Quantity.TIME,
    **dict.fromkeys(AXES, Quantity.OUTPUT),
    **dict.fromkeys(('alpha', 'beta', 'roll', 'pitch'), Quantity.ANGLE),
    'shift': Quantity.LENGTH,
    'temperature': Quantity.TEMPERATURE,
    'supply': Quantity.VOLTAGE,
}
"""Quantity of each role that a column can have."""

LSB, UNSIGNED = 'lsb', 'u16'
"""Units of counts, which need the counts of 1 g: the second lost its sign, so that 65535 is −1."""


def signed(values: np.ndarray) -> np.ndarray:
    """Return counts of 16 bits with their sign, (n,)."""
    return np.where(values >= 1 << 15, values - (1 << 16), values)


@dataclass(frozen=True)
class Unit:
    """A unit: value in the unit of the package = value · factor / divisor + offset."""

    # A division by a power of ten is exact where a product is not.
    divisor: float = 1.0
    factor: float = 1.0
    offset: float = 0.0
    is_volts: bool = False  # Whether the output of a sensor stays in volts

    def convert(self, values: np.ndarray) -> np.ndarray:
        """Return values in the unit of the package."""
        with np.errstate(over='ignore'):  # such a value is refused afterwards
            converted = values * self.factor / self.divisor
            return converted + self.offset if self.offset else converted  # keeps -0.0


UNITS: Mapping[Quantity, Mapping[str, Unit]] = {
    Quantity.TIME: {'s': Unit(), 'ms': Unit(1e3), 'us': Unit(1e6), 'ns': Unit(1e9),
                    'epoch': Unit()},
    Quantity.OUTPUT: {'g': Unit(factor=G0_MPS2), 'mg': Unit(1e3, G0_MPS2), 'mps2': Unit(),
                      LSB: Unit(factor=G0_MPS2), UNSIGNED: Unit(factor=G0_MPS2),
                      'v': Unit(is_volts=True), 'mv': Unit(1e3, is_volts=True)},
    Quantity.ANGLE: {'rad': Unit(), 'deg': Unit(180.0, np.pi)},
    Quantity.LENGTH: {'m': Unit(), 'mm': Unit(1e3)},
    Quantity.TEMPERATURE: {'c': Unit(), 'k': Unit(offset=-273.15),
                           'f': Unit(9.0, 5.0, -160.0 / 9.0)},
    Quantity.VOLTAGE: {'v': Unit(), 'mv': Unit(1e3)},
}
"""Units by quantity and name."""

GRAVITY = {name: G0_MPS2 * unit.divisor / unit.factor
           for name, unit in UNITS[Quantity.OUTPUT].items()
           if name not in (LSB, UNSIGNED) and not unit.is_volts}
"""Length of gravity in each unit of acceleration."""

_SPELLINGS = {
    's': 'sec secs second seconds', 'ms': 'msec millis milliseconds',
    'us': 'µs μs usec micros microseconds', 'ns': 'nsec nanoseconds', 'epoch': 'unix posix',
    'mps2': 'm/s^2 m/s² m/s2 ms2 ms^2 m/s/s ms-2 ms^-2 m_s2 mss m·s⁻² m.s-2 m_s^-2 m_s-2',
    'mg': 'millig', 'g': 'gs', LSB: 'counts count raw digits',
    'v': 'volt volts', 'mv': 'millivolt millivolts',
    'deg': '° degree degrees', 'rad': 'radian radians',
    'c': '°c degc celsius deg_c', 'f': '°f degf fahrenheit', 'k': 'kelvin',
}
_ALIASES = {word: name for name, words in _SPELLINGS.items() for word in words.split()}
"""Names of units by their other spellings, in lower case, with _ for a blank."""

_BRACKETS = re.compile(r'[(\[{]\s*([^()\[\]{}]+?)\s*[)\]}]')
"""A part of a column's name in brackets."""

_WORD_ENDS = re.compile(r'[_\s.]+|\[\d+\]|[(\[{].*[)\]}]|(?<=[a-z])(?=[A-Z])')
"""Ends of the words in a column's name; an index or a part in brackets is none."""


def unit_name(text: str, quantity: Quantity) -> str | None:
    """Return the name of a unit that is written in any way."""
    word = '_'.join(text.lower().split())
    name = _ALIASES.get(word, word)
    return name if name in UNITS[quantity] else None


def unit_in_name(column: str, quantity: Quantity) -> str | None:
    """Return the unit that the name of a column states: in brackets, or as one of its words."""
    parts = [part for part in _WORD_ENDS.split(column.strip()) if part]
    # The first word names the quantity: a column `g` or `C` may be anything.
    words = [*_BRACKETS.findall(column), '_'.join(parts[-2:]), *reversed(parts[1:])]
    if quantity is Quantity.TIME:
        words += parts
    return next((name for name in (unit_name(word, quantity) for word in words) if name), None)


@dataclass(frozen=True)
class ReadingOptions:
    """How a recording is to be read."""

    topic: str = ''  # Samples in a bag, or message of a ULog file; empty for the only one
    mapping: ColumnMapping | None = None  # Columns of a table; None for those of the package
    lsb_per_g: tuple[float, ...] = ()  # Counts of 1 g: one for all axes, or one each
    lsb_at_0g: tuple[float, ...] = ()  # Counts at 0 g by axis; none for 0
    rate_hz: float | None = None  # Sample rate, Hz, that replaces the stamps; None keeps them
    drop_bad_stamps: bool = False  # Whether samples are left out whose stamp does not increase
    mounting: Mounting | None = None  # How the axes of the file are those of the sensor frame


AS_IT_IS = ReadingOptions()


_LISTED_NAMES = 12
"""Largest number of columns that a message names (chosen: some lines of a terminal)."""
_NEAR = 0.25
"""Largest logarithm of the ratio of a length to gravity (chosen: above bias and scale errors)."""
_SHORTEST_STEP_S, _LONGEST_STEP_S = 5e-5, 1.05
"""Bounds of steps of stamps, s. Chosen: twice the fastest rate; 1 Hz, the slowest, with jitter."""


def listed(names: Sequence[str]) -> str:
    """Return the first names of columns for a message."""
    further = len(names) - _LISTED_NAMES
    return ', '.join(names[:_LISTED_NAMES]) + f' and {further} more' * (further > 0)


def likely_unit(length: float) -> str:
    """Return the unit in which readings have the length of gravity; empty where none fits."""
    return next((unit for unit, gravity in GRAVITY.items()
                 if abs(np.log(max(length, 1e-12) / gravity)) < _NEAR), '')


def is_sensor_step(step_s: float, is_whole: bool) -> bool:
    """Return whether samples come at such steps; at whole seconds they hardly do."""
    return _SHORTEST_STEP_S <= step_s <= _LONGEST_STEP_S and not (is_whole and step_s >= 1)


def time_unit_of_step(step: float, is_whole: bool) -> str:
    """Return the likely unit of stamps."""
    return next((unit for unit in ('s', 'ms', 'us', 'ns') if is_sensor_step(
        step / UNITS[Quantity.TIME][unit].divisor, is_whole)), 's')


def shell_quoted(text: str) -> str:
    """Return a word for a shell, in quotes even where it needs none."""
    quoted = shlex.quote(text)
    return quoted if quoted != text else f"'{text}'"


_TIME_NAMES = re.compile(r'(?i).*(time|stamp|zeit|date|clock|elapsed|epoch|millis|micros).*|'
                         r'\W*(t|m?s|ms|us|ns|secs?|seconds?|(t|sec)[_\W].*)\W*')
"""Names of a time."""

_OTHER_SENSORS = re.compile(
    r'(?i)gyr|mag(?!nit)|\bm[xyz]\b|(?<![a-z])(pos|dist|height|alt|lat|lon|hum)|'
    r'angular|omega|rate|\bw[xyz]\b|g[xyz]r|rot|orient|quat|press|baro|vel|\bg[xyz]\b|'
    r'abs|total|norm|std|cov|user|gravity|without|\brad\b|dps|(deg|°)\s?/\s?s|angle')
"""Names of columns of other sensors."""

_ACCEL_NAMES = tuple(map(re.compile, (
    r'(?i)^acc(el(eration|erometer)?)?\b|acc', r'(?i)^(a|f|g_?f|ad)_?[xyz]',
    r'(?i)^[xyz](\b|_|$)', r'(?i)[xyz]|^a\d')))
"""Names of acceleration, the surest first."""

_VOLT_NAMES = re.compile(r'(?i)volt|analog|(?<![a-z])m?v(?![a-z])|^v_?[xyz]|[xyz]_?v$')
"""Names of volts."""

_AXIS_WORD = re.compile(
    r'(?i)(?:a|acc|accel|g_?f|f|ad|adc|raw|gf|v)?([xyz])|([xyz])(?:acc|accel|adc|raw|v)')
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
"""Largest relative scatter of a length that is that of gravity (chosen: a hand that turns a
sensor makes less)."""

_LARGEST = 1e30  # Larger magnitudes are no readings and no stamps

_TURNED = 0.3  # Smallest spread of an axis in that of another one of a sensor that is turned

_COUNTS = (64, 100, 128, 256, 512, 1000, 1024, 1365, 2048, 4096, 8192, 16384, 32768)
"""Usual counts of 1 g."""

_SIGN_GAP = (24576, 40960)
"""Counts of 16 bits that are beyond the range, 1.5 times ±16384, where their sign was lost."""


def propose(table: Table) -> tuple[str, str]:
    """Describe the columns of a table, and the options that most likely read it."""
    seen = f'the columns are {listed(table.names)}'
    sample = next((block.columns for block in table.blocks(table.names, ())), {})
    values = {name: np.where(np.abs(column) < _LARGEST, column, np.nan)
              for name, column in sample.items() if np.isfinite(column).any()}
    time = _time_column(table, values)
    outputs = _outputs(table, [name for name in values if name != time], values)
    readings = np.column_stack([values[name] for name in outputs]) if outputs else np.zeros((0, 1))
    unit, zero, length = _unit(table, outputs, readings[np.isfinite(readings).all(axis=1)])
    if not unit:
        return (f'{seen}; none looks like an accelerometer: name the columns, for example',
                "--columns 'time=COLUMN:s,x=COLUMN:g,y=COLUMN:g,z=COLUMN:g'")
    sources = {axis: Source(name, unit) for axis, name in zip(AXES, outputs)}
    stamps, note = '--rate HZ', ' (write the sample rate for HZ)'
    if time:
        source = _time_source(table, time, values[time])
        sources = {'time': source, **sources}
        stamps = _stamp_options(values[time], source)
        note = ' (add --params with the parameter file of the sensor)' * (unit in ('v', 'mv'))
    sources |= _references(values, {*outputs, time}) if table.has_names else {}
    options = f'--columns {shell_quoted(str(ColumnMapping(sources)))} {stamps}'.rstrip()
    if unit in (LSB, UNSIGNED):
        usual = min(_COUNTS, key=lambda count: abs(np.log(count / length)))
        options += f' --lsb-per-g {round(length) if zero else usual}'
        options += f' --lsb-at-0g {zero:.0f}' * bool(zero)
    return f'{seen}; the best guess{note}:', options


def _unit(table: Table, outputs: Sequence[str], readings: np.ndarray) -> tuple[str, float, float]:
    """
    Return the unit of readings, (n, m); empty where they are not those of an accelerometer.

    Also the reading at 0 g and the length of gravity about it.
    """
    if not len(readings):
        return '', 0.0, 0.0
    unit = table.units.get(outputs[0]) or unit_in_name(outputs[0], Quantity.OUTPUT)
    middle = (readings > _SIGN_GAP[0]) & (readings < _SIGN_GAP[1])
    if unit in (None, LSB) and (readings == np.rint(readings)).all() and readings.min() >= 0 \
            and not middle.any() and _SIGN_GAP[1] < readings.max() < 1 << 16:
        unit, readings = UNSIGNED, signed(readings)
    low, spread = readings.min(axis=0), np.ptp(readings, axis=0)
    zero = 0.0
    if low.min() > 0 and spread.min() > _TURNED * spread.max():
        zero = float(np.mean(low + spread / 2))
    lengths = np.linalg.norm(readings - zero, axis=1)
    length = float(np.median(lengths))
    if not unit:
        is_volts = table.has_names and all(map(_VOLT_NAMES.search, outputs))
        unit = ('' if zero else likely_unit(length)) or ('v' if is_volts and length < 9 else LSB)
        unit = '' if unit == LSB and length + zero < 40 else unit
    is_gravity = np.median(np.abs(lengths - length)) <= _CONSTANT * length and \
        0.5 < length / GRAVITY.get(unit, length) < 2
    return (unit if is_gravity or len(outputs) < len(AXES) else ''), zero, length


def _stamp_options(values: np.ndarray, source: Source) -> str:
    """Return the option that stamps need which stand still or step back; empty for none."""
    time_s = UNITS[Quantity.TIME][source.unit].convert(values[np.isfinite(values)] - values[0])
    if (np.diff(time_s) > 0).all():
        return ''
    if burst_samples(time_s) > 1:
        return f'--rate {stamped_rate_hz(time_s):.4g}'
    return '--drop-bad-stamps'


def _time_column(table: Table, values: Mapping[str, np.ndarray]) -> str | None:
    """Return the column that is a time: it hardly ever decreases, and is no count of samples."""
    rising = []
    for name, column in values.items():
        steps = np.diff(column[np.isfinite(column)])
        if len(steps) > 2 and np.mean(steps >= 0) > 0.99 and np.mean(steps > 0) > 0.05:
            rising.append(name)
    named = [name for name in rising if table.has_names and _TIME_NAMES.fullmatch(name)]
    others = [name for name in rising if not (np.diff(values[name]) == 1).all()]
    return next(iter([*named, *others]), None)


def _time_source(table: Table, name: str, values: np.ndarray) -> Source:
    """Return a time with the unit that its name states, or in which its steps are usual."""
    finite = values[np.isfinite(values)]
    steps = np.diff(finite)
    step = float(np.median(steps[steps > 0]))
    unit = table.units.get(name) or unit_in_name(name, Quantity.TIME)
    if not unit or not is_sensor_step(step / UNITS[Quantity.TIME][unit].divisor, False):
        unit = time_unit_of_step(step, bool((finite == np.rint(finite)).all()))
    return Source(name, unit)


def _outputs(table: Table, names: list[str], values: Mapping[str, np.ndarray]) -> list[str]:
    """Return the columns of the axes: by their names, or three whose length is constant."""
    if table.has_names:
        own = [name for name in names if not _OTHER_SENSORS.search(name)]
        stated = [name for name in own if unit_in_name(name, Quantity.OUTPUT) in GRAVITY]
        groups = [stated, *([name for name in own if pattern.search(name)]
                            for pattern in _ACCEL_NAMES)]
        return next(filter(None, map(_by_axis, groups)), [])

    def scatter(triple: list[str]) -> float:
        length = np.linalg.norm([values[name] for name in triple], axis=0)
        median = np.nanmedian(length)
        return float(np.nanmedian(np.abs(length - median)) / max(median, 1e-12))

    return min((names[i:i + 3] for i in range(len(names) - 2)), key=scatter, default=[])


def _by_axis(names: Sequence[str]) -> list[str]:
    """Return the names of x, y and z in this order, as far as there are any; or acc[0] ..."""
    by_letter: dict[str, str] = {}
    for name in names:
        bare = re.sub(r'[(\[{].*?[)\]}]', '', name).strip()
        words = re.split(r'[_\W]+|(?<=[a-z])(?=[A-Z])', bare)
        matches = list(filter(None, map(_AXIS_WORD.fullmatch, words)))
        if matches:
            by_letter.setdefault((matches[-1][1] or matches[-1][2]).lower(), name)
    if by_letter:
        axes = AXES[:len(by_letter)]
        return [by_letter[axis] for axis in axes] if set(axes) == set(by_letter) else []
    numbered = [name for name in names if re.search(r'(?<!\d)[0-3]\]?$', name)]
    return numbered[:len(AXES)] if len(numbered) >= len(AXES) else []


def _references(values: Mapping[str, np.ndarray], used: set[str | None]) -> dict[str, Source]:
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
    if not {'roll', 'pitch'} <= set(sources) or 'alpha' in sources or is_estimate:
        sources.pop('roll', None), sources.pop('pitch', None)
    return sources
