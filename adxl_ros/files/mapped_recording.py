# SPDX-License-Identifier: Apache-2.0

"""Recordings from the columns of a table: units, stamps and references become the package's."""

from __future__ import annotations

from collections.abc import Generator, Mapping
from dataclasses import dataclass, field
import re

from adxl_ros.errors import UserError
from adxl_ros.files.column_mapping import (
    ColumnMapping,
    is_sensor_step,
    likely_unit,
    listed,
    LSB,
    ReadingOptions,
    ROLES,
    shell_quoted,
    signed,
    Source,
    Table,
    TableBlock,
    time_unit_of_step,
    Unit,
    unit_in_name,
    unit_name,
    UNITS,
    UNSIGNED,
)
from adxl_ros.files.recording_columns import (
    ACCEL,
    describe_bursts,
    JOINTS,
    LIMIT,
    Recording,
    sensor_columns,
    StampCheck,
    stamped_rate_hz,
    TIME,
    VOLTS,
)
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.kinematics import stage_angles
import numpy as np

_TIME_LIMIT_S = 9e9
"""Largest magnitude of a time, s: in nanoseconds it fits into 64 bits (9.2e18)."""

_EPOCH_S = 1e8
"""First time from which times count from 1970, s: three years (chosen: no sensor runs so long)."""

_LENGTHS_G = (0.5, 2.0)
"""Bounds of the median length of the readings, g, within which their unit is right (chosen: a
sensor is mostly near 1 g)."""

_TURN_RAD = 2 * np.pi
"""Largest roll and pitch, rad."""

_FEWEST_STAMPS = 8
"""Stamps whose steps show their unit. Chosen: a lost sample hides no median."""

_WHOLE = 1e-3
"""Largest distance of a stamp from a whole number by rounding, in its unit."""

_SAME_RATE = 0.1
"""Largest relative difference of a stated sample rate from that of the stamps. Chosen."""

_NATIVE = {TIME: 'time', **{column: joint for joint, column in JOINTS.items()},
           'temperature_c': 'temperature', 'supply_v': 'supply'}
"""Role of the package's columns besides those of the sensor."""


@dataclass(frozen=True)
class _Column:
    """A column that is read."""

    name: str  # Its name in the table
    unit: Unit  # Its unit
    unit_name: str  # Name of the unit
    # Whether mapping, name or format state the unit; else it is that of the package
    is_stated: bool


class NotNativeError(UserError):
    """The columns are not those of a recording; a mapping may read them."""


def native_mapping(table: Table, output: tuple[str, ...] = ()) -> ColumnMapping:
    """
    Return the mapping of a table in the columns and units of the package.

    output: the columns of the sensor that must be there; else those that are.
    """
    names = table.names
    if table.repeated:
        raise NotNativeError(f'{table.header}: column {table.repeated} stands twice; keep one')
    # Where one form of output is there, the other may stand there in any unit.
    outputs = next((kind for kind in (output, VOLTS, ACCEL) if set(kind) & set(names)),
                   (*VOLTS, *ACCEL))
    roles = {**_NATIVE, **{column: AXES[i % len(AXES)] for i, column in enumerate(outputs)}}
    for column, role in roles.items():
        other = None if column in names else _in_other_unit(names, column, role)
        if other is not None:
            raise NotNativeError(f'{table.header}:{other + 1}: column {names[other]} is in '
                                 f'another unit; expected the column {column}')
    for column in (TIME, *output):
        if column not in names:
            raise NotNativeError(f'{table.header}: no column {column}'
                                 + f'; the columns are {listed(names)}' * bool(output))
    try:
        outputs = output or sensor_columns(names, table.header)
    except UserError as error:
        raise NotNativeError(str(error)) from None
    return ColumnMapping({
        **{role: Source(name, ROLES[role].value) for name, role in _NATIVE.items()
           if name in names},
        **{axis: Source(name, name.rpartition('_')[2]) for axis, name in zip(AXES, outputs)}},
        table.path)


def _in_other_unit(names: tuple[str, ...], column: str, role: str) -> int | None:
    """Return the index of a column of the same name with another unit."""
    stem = column.rpartition('_')[0]
    return next((i for i, name in enumerate(names) if re.match(f'(?i){stem}_', name)
                 and unit_name(name[len(stem) + 1:], ROLES[role])), None)


def blocks(table: Table, mapping: ColumnMapping | None, reading: ReadingOptions, rows: int,
           output: tuple[str, ...] = ()) -> Generator[Recording, None, None]:
    """
    Read a table as a recording in blocks of at most `rows` samples.

    Without a mapping it must have the columns of the package, and further ones are kept, too.
    """
    stated = mapping or native_mapping(table, output)
    converter = _Converter(table, _resolved(table, stated, reading), stated, reading,
                           mapping is None)
    names = list(dict.fromkeys(column.name for column in converter.columns.values()))
    count = 0
    for block in table.blocks(table.names if mapping is None else names, names):
        recording = converter.convert(block)
        for start in range(0, len(recording), rows):
            yield recording.rows(start, start + rows)
        count += len(recording)
    if not count:
        raise UserError(f'{table.path}: has a header, but no samples')


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
    counts = [column.name for column in outputs if column.unit_name in (LSB, UNSIGNED)]
    for option, values in (('--lsb-per-g', reading.lsb_per_g), ('--lsb-at-0g', reading.lsb_at_0g)):
        if values and len(values) not in (1, len(outputs)):
            raise UserError(f'{option}: has {len(values)} values for {len(outputs)} axes; write '
                            'one for all, or one for each')
    if (reading.lsb_per_g or reading.lsb_at_0g) and not counts:
        raise UserError(f'--lsb-per-g: no column is in LSB; write for example '
                        f'x={outputs[0].name}:lsb')
    if counts and not reading.lsb_per_g:
        raise UserError(f'{mapping.where}: {counts[0]} is in LSB; add --lsb-per-g with the counts '
                        'of 1 g, as in the datasheet')
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


@dataclass
class _Converter:
    """Converts the blocks of one table."""

    table: Table  # The table
    columns: Mapping[str, _Column]  # Its columns by role
    mapping: ColumnMapping  # What states them
    reading: ReadingOptions  # See `ReadingOptions`
    is_native: bool  # Whether the columns are those of the package
    _remarks: list[str] = field(default_factory=list)
    _epoch_ns: int | None = None
    _begin: float = 0.0  # Origin of the times in the unit of the stamps
    _count: int = 0
    _empty: int = 0
    _last_beta_rad: float = 0.0

    def __post_init__(self) -> None:
        self._stamps = StampCheck(self.table.path, self.reading.drop_bad_stamps)

    def convert(self, block: TableBlock) -> Recording:
        """Return the samples of a block."""
        outputs = self._outputs(block)
        # In the package's own recordings, every line is a sample.
        is_sample = ~np.isnan(outputs).all(axis=1) | (
            self.is_native and not self.reading.drop_bad_stamps)
        self._empty += int((~is_sample).sum())
        self._check_outputs(block, outputs, is_sample)
        time_s, is_kept = self._times(block, is_sample)
        kinds = VOLTS if self.columns['x'].unit.is_volts else ACCEL
        columns = dict(zip(kinds, outputs.T)) | self._references(block)
        if self.is_native:
            columns = {**columns, **{name: values for name, values in block.columns.items()
                                     if name not in columns and name != TIME}}
        columns = {name: np.ascontiguousarray(values[is_kept])
                   for name, values in columns.items()}
        if not self._count and is_kept.any():
            self._look_at_first(block, outputs[is_kept], time_s[is_kept])
        self._count += int(is_kept.sum())
        info = {key: text for key, text in block.info.items() if key != 'epoch_ns'}
        left_out = f'{self.table.path}: left out, lines without a reading of the sensor: ' \
                   f'{self._empty}'
        return Recording(self.table.path, time_s[is_kept], columns, info, cut=block.cut,
                         epoch_ns=self._epoch_ns or 0, done=block.done,
                         remarks=(*self._remarks, *[left_out] * bool(self._empty),
                                  *self._stamps.remarks), bad_stamps=self._stamps.bad)

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

    def _check_outputs(self, block: TableBlock, outputs: np.ndarray, is_sample: np.ndarray
                       ) -> None:
        """Refuse a sample with a reading that is empty, not finite or too large."""
        wrong = ~(np.abs(outputs) <= LIMIT) & is_sample[:, None]
        if wrong.any():
            row, index = np.argwhere(wrong)[0].tolist()
            column = self.columns[AXES[index]]
            value = block.columns[column.name][row]
            reason = 'is empty or NaN; every sample needs it' if np.isnan(value) else \
                f'is {value:g}, no reading of a sensor in {column.unit_name}; delete the line, ' \
                'or correct the unit'
            raise UserError(f'{block.where(row, column.name)} {reason}')

    def _references(self, block: TableBlock) -> dict[str, np.ndarray]:
        """Return the columns of references by name, (n,) each; NaN where not sampled."""
        values = {role: self._reference(block, role) for role in self.columns
                  if role != 'time' and role not in AXES}
        if 'roll' in values:
            values['alpha'], beta_rad = stage_angles(values['roll'], values['pitch'])
            values['beta'] = self._unwrapped(beta_rad)
        return {name: values[role] for name, role in _NATIVE.items() if role in values}

    def _reference(self, block: TableBlock, role: str) -> np.ndarray:
        """Return a reference in the unit of the package, (n,); NaN where it was not sampled."""
        column = self.columns[role]
        values = block.columns[column.name]
        is_tilt = role in ('roll', 'pitch') and column.unit_name == 'rad'
        for limit, reason in ((_TURN_RAD if is_tilt else np.inf,
                               f'rad, more than a turn; if it is in degrees, write '
                               f'{role}={column.name}:deg'),
                              (LIMIT, f'{column.unit_name}, no {role}; delete the line')):
            wrong = np.abs(values) > limit
            if wrong.any():
                row = int(wrong.argmax())
                raise UserError(f'{block.where(row, column.name)} is {values[row]:g} {reason}')
        return column.unit.convert(values)

    def _unwrapped(self, beta_rad: np.ndarray) -> np.ndarray:
        """Return beta without steps of a turn, rad, (n,); rows without it stay NaN."""
        sampled = np.isfinite(beta_rad)
        turned = beta_rad.copy()
        turned[sampled] = np.unwrap(np.concatenate([[self._last_beta_rad], beta_rad[sampled]]))[1:]
        if sampled.any():
            self._last_beta_rad = float(turned[sampled][-1])
        return turned

    def _times(self, block: TableBlock, is_sample: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return stamps, s, (n,), and which rows are kept, (n,)."""
        if self.reading.rate_hz is not None:
            number = self._count + np.cumsum(is_sample) - 1
            return number / self.reading.rate_hz, is_sample
        column = self.columns['time']
        stamps = block.columns[column.name]
        missing = is_sample & ~np.isfinite(stamps)
        if missing.any():
            row = int(missing.argmax())
            text = 'empty or NaN' if np.isnan(stamps[row]) else 'not finite'
            raise UserError(f'{block.where(row, column.name)} is {text}; every sample needs a '
                            'time: delete the line, or give --rate HZ to stamp by index')
        if self._epoch_ns is None and is_sample.any():
            self._find_epoch(block, float(column.unit.convert(stamps[is_sample][:1])[0]))
        time_s = column.unit.convert(stamps - self._begin)
        wrong = is_sample & (np.abs(time_s) > _TIME_LIMIT_S)
        if wrong.any():
            row = int(wrong.argmax())
            raise UserError(f'{block.where(row, column.name)} is {time_s[row]:g} s as '
                            f'{column.unit_name}, more than 200 years; state its unit, for '
                            'example ms, us or ns')
        return time_s, self._stamps.increasing(time_s, is_sample,
                                               lambda row: block.where(row, column.name))

    def _find_epoch(self, block: TableBlock, first_s: float) -> None:
        """Find the origin of the times: as comments state it, or near the first one."""
        text = block.info.get('epoch_ns', '0')
        if not re.fullmatch(r'-?\d{1,19}', text) or abs(int(text)) >= 1 << 63:
            raise UserError(f'{self.table.path}: epoch_ns is {text!r}, expected whole nanoseconds')
        is_since_1970 = _EPOCH_S < first_s <= _TIME_LIMIT_S and not self.is_native
        whole_s = int(first_s) if is_since_1970 and not int(text) else 0
        self._epoch_ns = int(text) or whole_s * 1_000_000_000
        unit = self.columns['time'].unit
        self._begin = whole_s * unit.divisor / unit.factor

    def _look_at_first(self, block: TableBlock, outputs: np.ndarray, time_s: np.ndarray) -> None:
        """Note what is assumed; refuse readings and stamps that are in another unit."""
        if len(time_s) > _FEWEST_STAMPS and self.reading.rate_hz is None:
            self._check_step(block, time_s)
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

    def _check_step(self, block: TableBlock, time_s: np.ndarray) -> None:
        """Refuse stamps whose steps no sensor has, unless the file states their rate."""
        column = self.columns['time']
        rate_hz = stamped_rate_hz(time_s)
        stated_hz = Recording(self.table.path, time_s, {}, dict(block.info)).stream_info.rate_hz
        if stated_hz and abs(stated_hz / rate_hz - 1) < _SAME_RATE:
            return
        stamps, step = time_s * column.unit.divisor, column.unit.divisor / rate_hz
        is_whole = bool((np.abs(stamps - np.rint(stamps)) < _WHOLE).all())
        if is_sensor_step(1 / rate_hz, is_whole):
            return
        unit = time_unit_of_step(step, is_whole)
        fitting = {**self.mapping.sources, 'time': Source(column.name, unit)}
        raise UserError(
            f'{self.table.path}: {column.name} has steps of {step:.4g}, which as '
            f'{column.unit_name} are {rate_hz:.3g} Hz; if that is right, give --rate '
            f'{rate_hz:.3g}, and if they are {unit}:',
            f'--columns {shell_quoted(str(ColumnMapping(fitting)))}')

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
