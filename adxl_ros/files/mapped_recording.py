# SPDX-License-Identifier: Apache-2.0

"""Recordings from the columns of a table: units, stamps and references become the package's."""

from __future__ import annotations

from collections.abc import Generator, Iterator, Mapping
from dataclasses import dataclass, field

from adxl_ros.errors import UserError
from adxl_ros.files.column_mapping import (
    ColumnMapping,
    LSB,
    ReadingOptions,
    ROLES,
    signed,
    Source,
    Unit,
    unit_in_name,
    UNITS,
    UNSIGNED,
)
from adxl_ros.files.csv_file import epoch_ns, TIME_LIMIT_S
from adxl_ros.files.recording_columns import (
    ACCEL,
    BadStamps,
    describe_bursts,
    JOINTS,
    LIMIT,
    Recording,
    TIME,
    VOLTS,
)
from adxl_ros.files.tables import Table, TableBlock
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.kinematics import stage_angles
import numpy as np

_EPOCH_S = 1e8
"""First time from which times count from 1970, s: three years (chosen: no sensor runs so long)."""

_LENGTHS_G = (0.5, 2.0)
"""Bounds of the median length of the readings, g, within which their unit is right (chosen: a
sensor is mostly near 1 g)."""

_TURN_RAD = 2 * np.pi
"""Largest roll and pitch, rad."""

_LISTED_NAMES = 12
"""Largest number of columns that a message names (chosen: some lines of a terminal)."""

_NEAR = 0.25
"""Largest logarithm of the ratio of a length to that of gravity in its unit (chosen: bias and
scale errors are smaller, and the units are further apart)."""

_NATIVE = {TIME: ('time', 's'), 'alpha_rad': ('alpha', 'rad'), 'beta_rad': ('beta', 'rad'),
           'shift_m': ('shift', 'm'), 'temperature_c': ('temperature', 'c'),
           'supply_v': ('supply', 'v')}
"""Role and unit of the package's columns besides those of the sensor."""


@dataclass(frozen=True)
class _Column:
    """A column that is read."""

    name: str  # Its name in the table
    unit: Unit  # Its unit
    unit_name: str  # Name of the unit
    # Whether mapping, name or format state the unit; else it is that of the package
    is_stated: bool


def native_mapping(names: tuple[str, ...], where: str) -> ColumnMapping | None:
    """Return the mapping of a table that has the columns of the package; None where it has not."""
    sources = {role: Source(name, unit) for name, (role, unit) in _NATIVE.items()
               if name in names}
    for columns, unit in ((VOLTS, 'v'), (ACCEL, 'mps2')):
        axes = {axis: Source(name, unit) for axis, name in zip(AXES, columns) if name in names}
        if axes:
            return ColumnMapping({**sources, **axes}, where) if 'x' in axes else None
    return None


def blocks(table: Table, mapping: ColumnMapping, reading: ReadingOptions, rows: int
           ) -> Generator[Recording, None, None]:
    """Read a table as a recording in blocks of at most `rows` samples."""
    converter = _Converter(table, _resolved(table, mapping, reading), mapping, reading)
    count = 0
    for block in table.blocks(converter.names):
        recording = converter.convert(block)
        for start in range(0, len(recording), rows):
            yield recording.rows(start, start + rows)
        count += len(recording)
    if not count:
        raise UserError(f'{table.path}: has no samples')


def _resolved(table: Table, mapping: ColumnMapping, reading: ReadingOptions
              ) -> dict[str, _Column]:
    """Return the column of each role."""
    if 'time' not in mapping.sources and reading.rate_hz is None:
        raise UserError(f'{mapping.where}: has no time; add time=COLUMN:UNIT, or give --rate HZ '
                        'to stamp by index')
    columns = {role: _column(table, mapping, role) for role in mapping.sources}
    outputs = [columns[axis] for axis in AXES if axis in columns]
    if len({column.unit.is_volts for column in outputs}) > 1:
        raise UserError(f'{mapping.where}: some axes are in volts and others are not; state one '
                        'kind')
    lsb = [column.unit_name in (LSB, UNSIGNED) for column in outputs]
    for option, values in (('--lsb-per-g', reading.lsb_per_g), ('--lsb-at-0g', reading.lsb_at_0g)):
        if values and len(values) not in (1, len(outputs)):
            raise UserError(f'{option}: has {len(values)} values for {len(outputs)} axes; write '
                            'one for all, or one for each')
    if (reading.lsb_per_g or reading.lsb_at_0g) and not any(lsb):
        raise UserError(f'--lsb-per-g: no column is in LSB; write for example '
                        f'x={outputs[0].name}:lsb')
    if any(lsb) and not reading.lsb_per_g:
        raise UserError(f'{mapping.where}: {outputs[lsb.index(True)].name} is in LSB; add '
                        '--lsb-per-g with the counts of 1 g, as in the datasheet')
    return columns


def _column(table: Table, mapping: ColumnMapping, role: str) -> _Column:
    """Return the column of a role, by its name or number."""
    source = mapping.sources[role]
    name = source.column
    if name not in table.names:
        if not name.isdecimal() or not 1 <= int(name) <= len(table.names):
            raise UserError(f'{mapping.where}: {table.path} has no column {name!r} for {role}; '
                            f'the columns are {listed(table.names)}')
        name = table.names[int(name) - 1]
    stated = source.unit or table.units.get(name) or unit_in_name(name, ROLES[role])
    unit = stated or ROLES[role].value
    return _Column(name, UNITS[ROLES[role]][unit], unit, bool(stated))


def listed(names: tuple[str, ...]) -> str:
    """Return the first names of columns for a message."""
    further = len(names) - _LISTED_NAMES
    return ', '.join(names[:_LISTED_NAMES]) + f' and {further} more' * (further > 0)


def likely_unit(length: float) -> str:
    """Return the unit in which readings have the length of gravity; empty where none fits."""
    lengths = {'g': 1.0, 'mps2': G0_MPS2, 'mg': 1e3}
    return next((unit for unit, gravity in lengths.items()
                 if abs(np.log(max(length, 1e-12) / gravity)) < _NEAR), '')


@dataclass
class _Converter:
    """Converts the blocks of one table."""

    table: Table  # The table
    columns: Mapping[str, _Column]  # Its columns by role
    mapping: ColumnMapping  # What states them
    reading: ReadingOptions  # See `ReadingOptions`
    _remarks: list[str] = field(default_factory=list)
    _epoch_ns: int | None = None
    _begin: float = 0.0
    _last_s: float = -np.inf
    _count: int = 0
    _empty: int = 0
    _duplicates: int = 0
    _backward: int = 0
    _last_beta_rad: float = 0.0

    @property
    def names(self) -> list[str]:
        """Return the columns of the table that are read."""
        return list(dict.fromkeys(column.name for column in self.columns.values()))

    def convert(self, block: TableBlock) -> Recording:
        """Return the samples of a block."""
        is_first = self._epoch_ns is None
        outputs = self._outputs(block)
        is_sample = ~np.isnan(outputs).all(axis=1)
        self._empty += int((~is_sample).sum())
        self._check_outputs(block, outputs, is_sample)
        time_s, is_kept = self._times(block, is_sample)
        columns = dict(zip(self._output_names(), outputs[is_kept].T.copy()))
        references = {role: self._reference(block, role)[is_kept] for role in self.columns
                      if role != 'time' and role not in AXES}
        columns.update(self._references(references))
        if is_first and is_kept.any():
            self._begin_remarks(outputs[is_kept], time_s[is_kept])
        self._count += int(is_kept.sum())
        info = {key: text for key, text in block.info.items() if key != 'epoch_ns'}
        return Recording(self.table.path, time_s[is_kept], columns, info, cut=block.cut,
                         epoch_ns=self._epoch_ns or 0, done=block.done,
                         remarks=(*self._remarks, *self._counts()),
                         bad_stamps=BadStamps(self._duplicates, self._backward))

    def _reference(self, block: TableBlock, role: str) -> np.ndarray:
        """Return a reference in the unit of the package, (n,); NaN where it was not sampled."""
        column = self.columns[role]
        values = block.columns[column.name]
        wrong = np.abs(values) > LIMIT
        is_tilt = role in ('roll', 'pitch') and column.unit_name == 'rad'
        if is_tilt and (np.abs(values) > _TURN_RAD).any():
            row = int((np.abs(values) > _TURN_RAD).argmax())
            raise UserError(f'{block.where(row, column.name)} is {values[row]:g} rad, more than a '
                            f'turn; if it is in degrees, write {role}={column.name}:deg')
        if wrong.any():
            row = int(wrong.argmax())
            raise UserError(f'{block.where(row, column.name)} is {values[row]:g}, no {role}; '
                            'delete the line')
        return column.unit.convert(values)

    def _outputs(self, block: TableBlock) -> np.ndarray:
        """Return the output of the sensor, (n, m), V or m/s²."""
        axes = [axis for axis in AXES if axis in self.columns]
        per_g = np.broadcast_to(np.array(self.reading.lsb_per_g or 1.0), len(axes))
        zero = np.broadcast_to(np.array(self.reading.lsb_at_0g or 0.0), len(axes))
        outputs = []
        for index, axis in enumerate(axes):
            column = self.columns[axis]
            values = block.columns[column.name]
            if column.unit_name == UNSIGNED:
                values = signed(values)
            if column.unit_name in (LSB, UNSIGNED):
                values = (values - zero[index]) / per_g[index]
            outputs.append(column.unit.convert(values))
        return np.column_stack(outputs)

    def _output_names(self) -> tuple[str, ...]:
        return VOLTS if self.columns['x'].unit.is_volts else ACCEL

    def _check_outputs(self, block: TableBlock, outputs: np.ndarray, is_sample: np.ndarray
                       ) -> None:
        """Refuse a sample with a reading that is empty, not finite or too large."""
        wrong = ~(np.abs(outputs) <= LIMIT) & is_sample[:, None]
        if wrong.any():
            row, index = np.argwhere(wrong)[0].tolist()
            column = self.columns[AXES[index]]
            value = block.columns[column.name][row]
            reason = 'is empty; every sample needs it' if np.isnan(value) else \
                f'is {value:g}, no reading of a sensor in {column.unit_name}; delete the line, ' \
                'or correct the unit'
            raise UserError(f'{block.where(row, column.name)} {reason}')

    def _times(self, block: TableBlock, is_sample: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return stamps, s, (n,), and which rows are kept, (n,)."""
        if self.reading.rate_hz is not None:
            self._epoch_ns = self._epoch_ns or 0
            number = self._count + np.cumsum(is_sample) - 1
            return number / self.reading.rate_hz, is_sample
        column = self.columns['time']
        stamps = block.columns[column.name]
        missing = is_sample & ~np.isfinite(stamps)
        if missing.any():
            row = int(missing.argmax())
            text = 'empty' if np.isnan(stamps[row]) else 'not finite'
            raise UserError(f'{block.where(row, column.name)} is {text}; every sample needs a '
                            'time: delete the line, or give --rate HZ to stamp by index')
        time_s = self._since_epoch(block, stamps, is_sample, column)
        is_kept = is_sample & self._increasing(block, time_s, is_sample, column)
        if is_kept.any():
            self._last_s = float(time_s[is_kept][-1])
        return time_s, is_kept

    def _since_epoch(self, block: TableBlock, stamps: np.ndarray, is_sample: np.ndarray,
                     column: _Column) -> np.ndarray:
        """Return times since the origin, s, (n,); the origin is found in the first block."""
        unit = column.unit
        if self._epoch_ns is None and is_sample.any():
            first_s = float(unit.convert(stamps[is_sample][:1])[0])
            if abs(first_s) > TIME_LIMIT_S:
                raise UserError(f'{block.where(int(is_sample.argmax()), column.name)} is '
                                f'{first_s:g} s as {column.unit_name}, more than 200 years; '
                                'state its unit, for example ms, us or ns')
            stated = epoch_ns(self.table.path, dict(block.info))
            whole_s = int(first_s) if first_s > _EPOCH_S and not stated else 0
            self._epoch_ns = stated or whole_s * 1_000_000_000
            self._begin = whole_s * unit.divisor / unit.factor
        return unit.convert(stamps - self._begin)

    def _increasing(self, block: TableBlock, time_s: np.ndarray, is_sample: np.ndarray,
                    column: _Column) -> np.ndarray:
        """Return which stamps increase, (n,); refuse the others unless they are left out."""
        times = np.where(is_sample, time_s, -np.inf)
        latest = np.maximum.accumulate(np.concatenate([[self._last_s], times]))[:-1]
        wrong = is_sample & ~(time_s > latest)
        if not wrong.any():
            return is_sample
        stands = wrong & (time_s == latest)
        self._duplicates += int(stands.sum())
        self._backward += int((wrong & ~stands).sum())
        if not self.reading.drop_bad_stamps:
            row = int(wrong.argmax())
            verb = 'stands still' if stands[row] else 'runs backwards'
            raise UserError(
                f'{block.where(row, column.name)}: time {verb}, {latest[row] - time_s[row]:.3g} s '
                f'before the newest sample{describe_bursts(time_s[is_sample])}; --drop-bad-stamps '
                'leaves such samples out, --rate HZ stamps by index')
        return ~wrong

    def _references(self, values: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Return the columns of references by name, (n,) each."""
        columns = {JOINTS[role]: values[role] for role in JOINTS if role in values}
        if 'roll' in values:
            alpha_rad, beta_rad = stage_angles(values['roll'], values['pitch'])
            columns[JOINTS['alpha']] = alpha_rad
            columns[JOINTS['beta']] = self._unwrapped(beta_rad)
        if 'temperature' in values:
            columns['temperature_c'] = values['temperature']
        if 'supply' in values:
            columns['supply_v'] = values['supply']
        return columns

    def _unwrapped(self, beta_rad: np.ndarray) -> np.ndarray:
        """Return beta without steps of a turn, rad, (n,); rows without it stay NaN."""
        sampled = np.isfinite(beta_rad)
        turned = beta_rad.copy()
        turned[sampled] = np.unwrap(np.concatenate([[self._last_beta_rad], beta_rad[sampled]]))[1:]
        if sampled.any():
            self._last_beta_rad = float(turned[sampled][-1])
        return turned

    def _begin_remarks(self, outputs: np.ndarray, time_s: np.ndarray) -> None:
        """Note what is assumed, and what the first stamps show."""
        self._check_length(outputs)
        assumed = [f'{column.name} in {column.unit_name}' for column in self.columns.values()
                   if not column.is_stated]
        if assumed:
            self._remarks.append(f'{self.table.path}: columns without a unit are read as '
                                 f'{", ".join(assumed)}')
        bursts = describe_bursts(time_s)
        if bursts:
            self._remarks.append(f'{self.table.path}: {bursts.removeprefix("; ")}; this rate is '
                                 'used, and --rate HZ stamps by index')

    def _check_length(self, outputs: np.ndarray) -> None:
        """Compare the length of the readings with gravity: a wrong unit shows in it."""
        columns = [self.columns[axis] for axis in AXES if axis in self.columns]
        if len(columns) < len(AXES) or columns[0].unit.is_volts:
            return
        length_g = float(np.median(np.linalg.norm(outputs, axis=1))) / G0_MPS2
        if _LENGTHS_G[0] < length_g < _LENGTHS_G[1]:
            return
        names = ', '.join(column.name for column in columns)
        text = f'{self.table.path}: {names} have a length of {length_g:.3g} g in ' \
               f'{columns[0].unit_name}, where gravity has 1 g'
        if not columns[0].is_stated:
            raise UserError(f'{text}; state their unit, for example x={columns[0].name}:'
                            f'{likely_unit(length_g * G0_MPS2) or "UNIT"}')
        self._remarks.append(f'{text}: check the unit')

    def _counts(self) -> Iterator[str]:
        """Yield how many rows were left out so far."""
        path = self.table.path
        if self._empty:
            yield f'{path}: left out, lines without a reading of the sensor: {self._empty}'
        if self._duplicates:
            yield f'{path}: left out, samples with the stamp of the one before: ' \
                  f'{self._duplicates}'
        if self._backward:
            yield f'{path}: left out, samples whose stamp steps back: {self._backward}'
