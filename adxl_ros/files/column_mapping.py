# SPDX-License-Identifier: Apache-2.0

"""Which column of a foreign file holds which quantity in which unit, and the mounting."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
import re

from adxl_ros.errors import UserError
from adxl_ros.files.column_units import ROLES, unit_name, UNITS
from adxl_ros.model.constants import AXES
import numpy as np

_EXAMPLE = 'time=t_ms:ms,x=accX:mg,y=accY:mg,z=accZ:mg'
"""A mapping, for messages."""

_ENTRY = re.compile(r"""\s*([^=,\s]+)\s*=\s*((?:"[^"]*"|'[^']*'|[^,"'])+?)\s*(?:,|\n|$)""")
"""An entry of a mapping: a role, and its column with an optional unit."""


@dataclass(frozen=True)
class Source:
    """Where a quantity comes from."""

    column: str  # Name of the column, or its number from 1
    unit: str = ''  # Name of its unit; empty where none is stated


@dataclass(frozen=True)
class ColumnMapping:
    """Which columns of a file hold a recording."""

    sources: Mapping[str, Source]  # Column and unit by role, a key of `column_units.ROLES`
    where: str = '--columns'  # What states the mapping, for messages

    def __str__(self) -> str:
        """Return the text that states the mapping."""
        return ','.join(f'{role}={_quoted(source.column)}{":" * bool(source.unit)}{source.unit}'
                        for role, source in self.sources.items())


def _quoted(column: str) -> str:
    """Return the name of a column as a mapping writes it."""
    if not re.search('[,:=\'"#]|^$|^\\s|\\s$', column):
        return column
    return f"'{column}'" if '"' in column else f'"{column}"'


def parse_mapping(text: str) -> ColumnMapping:
    """Parse a mapping, or the file that holds it."""
    where = '--columns'
    if '=' not in text:
        where, text = f'--columns {text}', _content(text)
    sources: dict[str, Source] = {}
    place = 0
    text = text.strip().rstrip(',')
    while place < len(text):
        entry = _ENTRY.match(text, place)
        if entry is None:
            raise UserError(f'{where}: {text[place:place + 40].strip()!r} is no role=column:unit; '
                            f'write for example {_EXAMPLE}')
        role = entry[1]
        if role not in ROLES:
            raise UserError(f'{where}: no role {role!r}; the roles are {", ".join(ROLES)}')
        if role in sources:
            raise UserError(f'{where}: {role} stands twice; keep one')
        sources[role] = _source(where, role, entry[2].strip())
        place = entry.end()
    _check_roles(where, sources)
    return ColumnMapping(sources, where)


def _content(path: str) -> str:
    """Return the entries of a mapping file on one line."""
    try:
        lines = Path(path).read_text(encoding='utf-8').splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f'--columns {path}: is neither a mapping nor a file that can be read '
                        f'({getattr(error, "strerror", None) or error}); write for example '
                        f'{_EXAMPLE}') from None
    entries = [line.partition('#')[0].strip().rstrip(',') for line in lines]
    text = ','.join(entry for entry in entries if entry)
    if '=' not in text:
        raise UserError(f'--columns {path}: holds no mapping; write for example {_EXAMPLE}')
    return text


def _source(where: str, role: str, text: str) -> Source:
    """Return column and unit of an entry."""
    quoted = re.fullmatch(r"""(?:"([^"]*)"|'([^']*)')\s*(?::\s*(.*))?""", text)
    if quoted:
        column, unit = quoted[1] or quoted[2] or '', quoted[3] or ''
    else:
        column, _, unit = text.rpartition(':') if ':' in text else (text, '', '')
    column = column.strip()
    if not column:
        raise UserError(f'{where}: {role} names no column')
    if not unit:
        return Source(column)
    name = unit_name(unit, ROLES[role])
    if name is None:
        raise UserError(f'{where}: {role}={text}: unknown unit {unit!r}; write one of '
                        f'{", ".join(UNITS[ROLES[role]])}, or quote a name that has a colon')
    return Source(column, name)


def _check_roles(where: str, sources: Mapping[str, Source]) -> None:
    """Refuse roles that contradict each other, and missing axes."""
    axes = ''.join(axis for axis in AXES if axis in sources)
    if not axes or axes != AXES[:len(axes)]:
        raise UserError(f'{where}: names the axes {axes or "none"}, expected x, x and y, or x, y '
                        f'and z; write for example {_EXAMPLE}')
    tilts = [role for role in ('roll', 'pitch') if role in sources]
    stage = [role for role in ('alpha', 'beta') if role in sources]
    if tilts and stage:
        raise UserError(f'{where}: {tilts[0]} and {stage[0]} are two references; keep roll and '
                        'pitch, or alpha and beta')
    if len(tilts) == 1:
        other = 'pitch' if tilts == ['roll'] else 'roll'
        raise UserError(f'{where}: {tilts[0]} without {other} is no reference; add {other}')


@dataclass(frozen=True)
class Mounting:
    """How the axes of a file are the axes of the sensor frame."""

    columns: tuple[int, ...]  # For each axis of the frame, the index of the axis in the file
    signs: tuple[int, ...]  # For each axis of the frame, 1 or −1

    def turn(self, values: np.ndarray) -> np.ndarray:
        """Return outputs about zero, (n, m), along the axes of the frame."""
        return values[:, list(self.columns)] * np.array(self.signs, float)


def parse_mounting(text: str) -> Mounting:
    """Parse a documented mounting, as in `x=-y,y=x,z=z`: x of the frame is −y of the file."""
    entries: dict[str, tuple[int, int]] = {}
    for entry in text.split(','):
        match = re.fullmatch(r'\s*([xyz])\s*=\s*([-+]?)\s*([xyz])\s*', entry)
        if match is None or match[1] in entries:
            raise UserError(f'--axes {text}: {entry.strip()!r} is wrong; write for example '
                            'x=-y,y=x,z=z')
        entries[match[1]] = AXES.index(match[3]), -1 if match[2] == '-' else 1
    axes = AXES[:len(entries)]
    if set(entries) != set(axes) or sorted(index for index, _ in entries.values()) != \
            list(range(len(axes))):
        raise UserError(f'--axes {text}: each axis of the sensor must stand once on both sides; '
                        'write for example x=-y,y=x,z=z')
    return Mounting(tuple(entries[axis][0] for axis in axes),
                    tuple(entries[axis][1] for axis in axes))
