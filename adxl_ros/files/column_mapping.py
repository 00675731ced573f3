# SPDX-License-Identifier: Apache-2.0

"""A table, and how it is read as a recording: columns, units, stamps and the mounting."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from functools import partial
from pathlib import Path
import re
from typing import NamedTuple

from adxl_ros.errors import UserError
from adxl_ros.model.constants import AXES, G0_MPS2, MEASURED_AXES
from adxl_ros.wording import option
import numpy as np

_EXAMPLE = 'time=t_ms:ms,x=accX:mg,y=accY:mg,z=accZ:mg'  # A mapping, for messages

_ENTRY = re.compile(
    r"""\s*([^=,\s]+)\s*=\s*(?:"([^"]*)"|'([^']*)'|([^,"'\n]*?))\s*"""
    r"""(?::\s*([^:,"'\n]*?))?\s*(?:,|\n|$)"""
)
"""An entry of a mapping: a role, its column in double, single or no quotes, and a unit."""


Columns = Mapping[str, np.ndarray]  # Arrays (n,) by the name of their column or field
_TILT = {'roll', 'pitch'}  # Roles of the angles of an inclinometer
GYRO_ROLES = ('gx', 'gy', 'gz')  # Roles of the axes of a gyroscope
LSB = 'lsb'  # Unit of counts, which needs the counts of 1 g
UNSIGNED = 'u16'  # Unit of counts that lost their sign, so that 65535 is −1
_SPELLINGS = {
    's': 'sec secs second seconds',
    'ms': 'msec millis milliseconds',
    'us': 'µs μs usec micros microseconds',
    'ns': 'nsec nanoseconds',
    'epoch': 'unix posix',
    'mps2': 'm/s^2 m/s² m/s2 ms2 ms^2 m/s/s ms-2 ms^-2 m_s2 mss m·s⁻² m.s-2 m_s^-2 m_s-2',
    'mmps2': 'mm/s^2 mm/s² mm/s2 mms2 mm/s/s mms-2 mm_s2',
    'mg': 'millig',
    'g': 'gs',
    LSB: 'counts count raw digits',
    'v': 'volt volts',
    'mv': 'millivolt millivolts',
    'deg': '° degree degrees',
    'rad': 'radian radians',
    'radps': 'rad/s rad_s rad_per_s rad·s⁻¹ rad.s-1',
    'dps': 'deg/s °/s deg_s degps deg_per_s',
    'mdps': 'mdeg/s m°/s',
    'c': '°c degc celsius deg_c',
    'f': '°f degf fahrenheit',
    'k': 'kelvin',
}
_ALIASES: dict[str, str] = {}
for _name, _words in _SPELLINGS.items():
    _ALIASES |= dict.fromkeys(_words.split(), _name)
"""Names of units by their other spellings, in lower case, with _ for a blank."""
_BRACKETS = re.compile(r'[(\[{]\s*([^()\[\]{}]+?)\s*[)\]}]')
"""A part of a column's name in brackets."""
_WORD_ENDS = re.compile(r'[_\s.]+|\[\d+\]|[(\[{].*[)\]}]|(?<=[a-z])(?=[A-Z])')
"""Ends of the words in a column's name; an index or a part in brackets is none."""
_LISTED_NAMES = 12
"""Largest number of columns that a message names (chosen: some lines of a terminal)."""
_NEAR = 0.25
"""Largest logarithm of the ratio of a length to gravity (chosen: above bias and scale errors)."""
_SHORTEST_STEP_S = 2.5e-5  # Shortest step of stamps, s. Chosen: an IIS3DWB has steps of 3.75e-5 s
_LONGEST_STEP_S = 1.05  # Longest step of stamps, s. Chosen: 1 Hz, the slowest, with jitter


@dataclass(frozen=True)
class TableBlock:
    """Rows of a table."""

    columns: Columns  # Arrays (n,) by column name; an empty cell is NaN
    # Returns file and place of a cell for messages, by its row in the block and its column
    where: Callable[[int, str], str]
    info: Mapping[str, str] = field(default_factory=dict)  # Keys and values that the file states
    done: float = 1.0  # Fraction of the file that has been read at the end of the rows
    cut: str = ''  # Where a damaged file ends; empty if it is whole

    def refuse(
        self, column: str, wrong: np.ndarray, reason: str, reason_of_none: str = ''
    ) -> None:
        """Refuse cells of a column, (n,): for a reason, or another one where they are empty."""
        if wrong.any():
            row = int(wrong.argmax())
            value = self.columns[column][row]
            text = f'{value:g}, {reason}; delete the line, or correct the unit'
            if np.isnan(value):
                text = f'empty or NaN; {reason_of_none}'
            raise UserError(f'{self.where(row, column)} is {text}')


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
    # Whether a row without a reading is a lost sample, and no row of something else
    is_every_row_a_step: bool = False

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
    # What states the mapping, for messages
    where: str = field(default_factory=partial(option, 'columns'))

    def __str__(self) -> str:
        """Return the text that states the mapping."""
        entries = []
        for role, (column, unit) in self.sources.items():
            of_unit = f':{unit}' if unit else ''
            entries.append(f'{role}={_quoted(column)}{of_unit}')
        return ','.join(entries)


def _quoted(column: str) -> str:
    """Return the name of a column as a mapping writes it."""
    if not re.search('[,:=\'"#]|^$|^\\s|\\s$', column):
        return column
    return f"'{column}'" if '"' in column else f'"{column}"'


def parse_mapping(text: str) -> ColumnMapping:
    """Parse a mapping, or the file that holds it."""
    where = option('columns')
    if '=' not in text:
        where = option(columns=text)
        try:
            text = re.sub('#.*', '', Path(text).read_text(encoding='utf-8'))
        except (OSError, UnicodeDecodeError):
            raise UserError(
                f'{where}: is neither a mapping nor a file that can be read; '
                f'write for example {_EXAMPLE}'
            ) from None
    sources: dict[str, Source] = {}
    text = text.strip().rstrip(',')
    while text:
        entry = _ENTRY.match(text)
        if entry is None:
            raise UserError(
                f'{where}: {text[:40]!r} is no role=column:unit; write for example {_EXAMPLE}'
            )
        text = text[entry.end() :]
        role, *columns, unit = entry.groups(default='')
        column = ''.join(columns).strip()
        if role not in ROLES:
            raise UserError(f'{where}: no role {role!r}; the roles are {", ".join(ROLES)}')
        if role in sources or not column:
            raise UserError(f'{where}: {role} must name one column, once')
        name = unit_name(unit, ROLES[role]) if unit else ''
        if name is None:
            raise UserError(
                f'{where}: {role}={column}:{unit}: unknown unit {unit!r}; write one '
                f'of {", ".join(UNITS[ROLES[role]])}, or quote a name that has a '
                'colon'
            )
        sources[role] = Source(column, name)
    _require_whole_groups(where, sources)
    return ColumnMapping(sources, where)


def _require_whole_groups(where: str, roles: Collection[str]) -> None:
    """Refuse axes, gyroscopes and tilts of which a part is named."""
    axes = ''.join(axis for axis in AXES if axis in roles)
    if axes not in MEASURED_AXES:
        raise UserError(
            f'{where}: names the axes {axes or "none"}, expected x, x and y, or x, y '
            f'and z; write for example {_EXAMPLE}'
        )
    turns = [role for role in GYRO_ROLES if role in roles]
    if len(turns) not in (0, len(GYRO_ROLES)):
        raise UserError(
            f'{where}: names {", ".join(turns)} of a gyroscope; name {", ".join(GYRO_ROLES)}'
        )
    angles = {'roll', 'pitch', 'alpha', 'beta'} & set(roles)
    if not angles.isdisjoint(_TILT) and angles != _TILT:
        raise UserError(
            f'{where}: {", ".join(sorted(angles))} are no reference; name roll and '
            'pitch, or alpha and beta'
        )


SignedAxes = tuple[tuple[int, int], ...]
"""For each axis of the sensor frame, the index of an axis of the file, and its sign, 1 or −1."""


def parse_mounting(text: str) -> SignedAxes:
    """Parse a documented mounting, as in `x=-y,y=x,z=z`: x of the frame is −y of the file."""
    entries = re.findall(r'(?:^|,)\s*([xyz])\s*=\s*([-+]?)\s*([xyz])\s*(?=,|$)', text)
    axes = AXES[: text.count(',') + 1]
    mounting = {axis: (AXES.index(of), -1 if sign == '-' else 1) for axis, sign, of in entries}
    if set(mounting) != set(axes) or {AXES[index] for index, _ in mounting.values()} != set(axes):
        raise UserError(
            f'{option(axes=text)}: each axis of the sensor must stand once on both sides; '
            'write for example x=-y,y=x,z=z'
        )
    signed_axes = tuple(mounting[axis] for axis in axes)
    if len(axes) == len(AXES) and _is_mirror(signed_axes):
        raise UserError(
            f'{option(axes=text)}: no rotation of the sensor gives this, because it turns a '
            'right-handed frame into a left-handed one; correct one sign, or the '
            'order of two axes'
        )
    return signed_axes


def _is_mirror(mounting: SignedAxes) -> bool:
    """Return whether a map of three axes has the determinant -1."""
    matrix = np.zeros((len(AXES), len(AXES)))
    for row, (column, sign) in enumerate(mounting):
        matrix[row, column] = sign
    return bool(np.linalg.det(matrix) < 0)


class Quantity(Enum):
    """What a column measures; the value names the unit of the package."""

    TIME = 's'
    OUTPUT = 'mps2'
    ANGLE = 'rad'
    LENGTH = 'm'
    TEMPERATURE = 'c'
    VOLTAGE = 'v'
    TURN = 'radps'


ROLES: Mapping[str, Quantity] = {
    'time': Quantity.TIME,
    **dict.fromkeys(AXES, Quantity.OUTPUT),
    **dict.fromkeys(('alpha', 'beta', 'roll', 'pitch'), Quantity.ANGLE),
    'shift': Quantity.LENGTH,
    'temperature': Quantity.TEMPERATURE,
    'supply': Quantity.VOLTAGE,
    **dict.fromkeys(GYRO_ROLES, Quantity.TURN),
}
"""Quantity of each role that a column can have."""


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
    Quantity.TIME: {
        's': Unit(),
        'ms': Unit(1e3),
        'us': Unit(1e6),
        'ns': Unit(1e9),
        'epoch': Unit(),
    },
    Quantity.OUTPUT: {
        'g': Unit(factor=G0_MPS2),
        'mg': Unit(1e3, G0_MPS2),
        'mps2': Unit(),
        'mmps2': Unit(1e3),
        LSB: Unit(factor=G0_MPS2),
        UNSIGNED: Unit(factor=G0_MPS2),
        'v': Unit(is_volts=True),
        'mv': Unit(1e3, is_volts=True),
    },
    Quantity.ANGLE: {'rad': Unit(), 'deg': Unit(180.0, np.pi)},
    Quantity.LENGTH: {'m': Unit(), 'mm': Unit(1e3)},
    Quantity.TEMPERATURE: {
        'c': Unit(),
        'k': Unit(offset=-273.15),
        'f': Unit(9.0, 5.0, -160.0 / 9.0),
    },
    Quantity.VOLTAGE: {'v': Unit(), 'mv': Unit(1e3)},
    Quantity.TURN: {
        'radps': Unit(),
        'dps': Unit(180.0, np.pi),
        'mdps': Unit(180e3, np.pi),
    },
}
"""Units by quantity and name."""

GRAVITY = {
    name: G0_MPS2 * unit.divisor / unit.factor
    for name, unit in UNITS[Quantity.OUTPUT].items()
    if name not in (LSB, UNSIGNED) and not unit.is_volts
}
"""Length of gravity in each unit of acceleration."""


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


def drop_samples() -> str:
    """Return advice for messages."""
    return f'{option(drop_bad_samples=True)} leaves such samples out'


@dataclass(frozen=True)
class ReadingOptions:
    """How a recording is to be read."""

    topic: str = ''  # Samples in a bag, or message of a ULog file; empty for the only one
    mapping: ColumnMapping | None = None  # Columns of a table; None for those of the package
    unit: str = ''  # Unit of the sensor's output, a key of `UNITS`; empty for what is stated
    lsb_per_g: tuple[float, ...] = ()  # Counts of 1 g: one for all axes, or one each
    lsb_at_0g: tuple[float, ...] = ()  # Counts at 0 g by axis; none for 0
    rate_hz: float | None = None  # Sample rate, Hz, that replaces the stamps; None keeps them
    drop_bad_stamps: bool = False  # Whether samples are left out whose stamp does not increase
    # Whether samples are left out that have no number as their stamp or on an axis
    drop_bad_samples: bool = False
    mounting: SignedAxes | None = None  # How the axes of the file are those of the sensor frame

    def __post_init__(self) -> None:
        """Refuse two statements of the unit."""
        sources = self.mapping.sources if self.mapping else {}
        stated = {sources[axis].unit for axis in AXES if axis in sources}
        if self.unit and stated - {'', self.unit}:
            raise UserError(
                f'{option(unit=self.unit)}: {option("columns")} states another unit; '
                'leave one of them out'
            )

    def check_counts(self, where: str, units: Mapping[str, str]) -> None:
        """
        Refuse counts of 1 g without a column in LSB, or such a column without them.

        where: file or option for messages; units: the unit of each axis by its column.
        """
        counts = [column for column, unit in units.items() if unit in (LSB, UNSIGNED)]
        if counts and not self.lsb_per_g:
            raise UserError(
                f'{where}: {counts[0]} is in LSB; add {option("lsb_per_g")} with the counts of '
                '1 g, as in the datasheet'
            )
        is_stated = bool(self.lsb_per_g or self.lsb_at_0g)
        if is_stated and not counts:
            raise UserError(
                f'{option("lsb_per_g")}: no column is in LSB; add {option(unit=LSB)}, or leave '
                f'{option("lsb_per_g")} and {option("lsb_at_0g")} out'
            )
        if not {len(self.lsb_per_g), len(self.lsb_at_0g)} <= {0, 1, len(units)}:
            raise UserError(
                f'{option("lsb_per_g")}, {option("lsb_at_0g")}: write one value '
                f'for all {len(units)} '
                'axes, or one for each'
            )

    def outputs(self, readings: np.ndarray, units: Sequence[str]) -> np.ndarray:
        """Return the output of the axes, (n, m), V or m/s², of readings in units, one an axis."""
        per_g = np.broadcast_to(np.array(self.lsb_per_g or 1.0), len(units))
        zero = np.broadcast_to(np.array(self.lsb_at_0g or 0.0), len(units))
        outputs = []
        for values, unit, scale, offset in zip(readings.T, units, per_g, zero):
            if unit == UNSIGNED:
                values = signed(values)
            if unit in (LSB, UNSIGNED):
                values = (values - offset) / scale
            outputs.append(UNITS[Quantity.OUTPUT][unit].convert(values))
        return np.column_stack(outputs)


AS_IT_IS = ReadingOptions()


def first_names(names: Sequence[str]) -> str:
    """Return the first names of columns for a message."""
    more = len(names) - _LISTED_NAMES
    return ', '.join(names[:_LISTED_NAMES]) + (f' and {more} more' if more > 0 else '')


def likely_unit(length: float) -> str:
    """Return the unit in which readings have the length of gravity; empty where none fits."""
    return next(
        (
            unit
            for unit, gravity in GRAVITY.items()
            if abs(np.log(max(length, 1e-12) / gravity)) < _NEAR
        ),
        '',
    )


def is_sensor_step(step_s: float, is_whole: bool) -> bool:
    """Return whether samples come at such steps; at whole seconds they hardly do."""
    return _SHORTEST_STEP_S <= step_s <= _LONGEST_STEP_S and not (is_whole and step_s >= 1)


def time_unit_of_step(step: float, is_whole: bool) -> str:
    """Return the likely unit of stamps."""
    return next(
        (
            unit
            for unit in ('s', 'ms', 'us', 'ns')
            if is_sensor_step(step / UNITS[Quantity.TIME][unit].divisor, is_whole)
        ),
        's',
    )


def parse_unit(
    text: str, argument: str = 'unit', known: Iterable[str] = UNITS[Quantity.OUTPUT]
) -> str:
    """Return the name of a unit of the sensor's output, one of the known; '' for no text."""
    if not text:
        return ''
    name = unit_name(text, Quantity.OUTPUT)
    if name is None or name not in known:
        raise UserError(
            f'{option(**{argument: text})}: unknown unit; write one of {", ".join(known)}'
        )
    return name
