# SPDX-License-Identifier: Apache-2.0

"""Recordings from the columns of a table: units, stamps and references become the package's."""

from __future__ import annotations

from collections.abc import Generator, Mapping
from dataclasses import dataclass
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
    roles = {**_NATIVE, **dict(zip(outputs, 2 * AXES))}
    stems = {column.rpartition('_')[0]: column for column in roles}
    for number, name in enumerate(names, 1):
        stem, _, unit = name.lower().rpartition('_')
        column = stems.get(stem, name)
        if column not in names and unit_name(unit, ROLES[roles[column]]):
            raise NotNativeError(f'{table.header}:{number}: column {name} is in another unit; '
                                 f'expected the column {column}')
    missing = [column for column in (TIME, *output) if column not in names]
    if missing:
        raise NotNativeError(f'{table.header}: no column {missing[0]}'
                             + f'; the columns are {listed(names)}' * bool(output))
    try:
        outputs = output or sensor_columns(names, table.header)
    except UserError as error:
        raise NotNativeError(str(error)) from None
    native = {role: name for name, role in _NATIVE.items() if name in names}
    return ColumnMapping({role: Source(name, name.rpartition('_')[2]) for role, name in {
        **native, **dict(zip(AXES, outputs))}.items()}, table.path)


def blocks(table: Table, mapping: ColumnMapping | None, reading: ReadingOptions, rows: int,
           output: tuple[str, ...] = ()) -> Generator[Recording, None, None]:
    """
    Read a table as a recording in blocks of at most `rows` samples.

    Without a mapping it must have the columns of the package, and further ones are kept, too.
    """
    stated = mapping or native_mapping(table, output)
    columns = _resolved(table, stated, reading)
    converter = _Converter(table, columns, stated, reading, mapping is None)
    names = list(dict.fromkeys(column.name for column in columns.values()))
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
    if bool(counts) != bool(reading.lsb_per_g):
        raise UserError(f'{mapping.where}: {counts[0]} is in LSB; add --lsb-per-g with the counts '
                        'of 1 g, as in the datasheet' if counts else
                        '--lsb-per-g: no column is in LSB; write for example '
                        f'x={outputs[0].name}:lsb')
    if not {len(reading.lsb_per_g), len(reading.lsb_at_0g)} <= {0, 1, len(outputs)}:
        raise UserError(f'--lsb-per-g, --lsb-at-0g: write one value for all {len(outputs)} axes, '
                        'or one for each')
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


class _Converter:
    """Converts the blocks of one table; the arguments are those of `blocks`."""

    def __init__(self, table: Table, columns: Mapping[str, _Column], mapping: ColumnMapping,
                 reading: ReadingOptions, is_native: bool) -> None:
        self._path = table.path
        self._columns, self._mapping, self._reading = columns, mapping, reading
        self._axes = [columns[axis] for axis in AXES if axis in columns]
        self._is_native = is_native  # Whether the columns are those of the package
        self._stamps = StampCheck(table.path, reading.drop_bad_stamps)
        self._remarks: list[str] = []
        self._epoch_ns: int | None = None
        self._begin = 0.0  # Origin of the times in the unit of the stamps
        self._count = 0  # Samples so far
        self._empty = 0  # Rows without a reading
        self._last_beta_rad = 0.0

    def convert(self, block: TableBlock) -> Recording:
        """Return the samples of a block."""
        outputs = self._outputs(block)
        # In the package's own recordings, every line is a sample.
        is_sample = ~np.isnan(outputs).all(axis=1) | (
            self._is_native and not self._reading.drop_bad_stamps)
        self._empty += int((~is_sample).sum())
        for column, values in zip(self._axes, outputs.T):
            _refuse(block, column, is_sample & ~(np.abs(values) <= LIMIT),
                    f'no reading of a sensor in {column.unit_name}', 'every sample needs it')
        time_s, is_kept = self._times(block, is_sample)
        columns = dict(zip(VOLTS if self._axes[0].unit.is_volts else ACCEL, outputs.T))
        columns |= self._references(block)
        if self._is_native:
            columns |= {name: values for name, values in block.columns.items()
                        if name not in columns and name != TIME}
        columns = {name: np.ascontiguousarray(values[is_kept])
                   for name, values in columns.items()}
        if not self._count and is_kept.any():
            self._look_at_first(outputs[is_kept], time_s[is_kept])
        self._count += int(is_kept.sum())
        info = {key: text for key, text in block.info.items() if key != 'epoch_ns'}
        left_out = f'{self._path}: left out, lines without a reading of the sensor: {self._empty}'
        return Recording(self._path, time_s[is_kept], columns, info, cut=block.cut,
                         epoch_ns=self._epoch_ns or 0, done=block.done,
                         remarks=(*self._remarks, *[left_out] * bool(self._empty),
                                  *self._stamps.remarks), bad_stamps=self._stamps.bad)

    def _outputs(self, block: TableBlock) -> np.ndarray:
        """Return the output of the sensor, (n, m), V or m/s²."""
        count = len(self._axes)
        per_g = np.broadcast_to(np.array(self._reading.lsb_per_g or 1.0), count)
        zero = np.broadcast_to(np.array(self._reading.lsb_at_0g or 0.0), count)
        outputs = []
        for index, column in enumerate(self._axes):
            values = block.columns[column.name]
            if column.unit_name == UNSIGNED:
                values = signed(values)
            if column.unit_name in (LSB, UNSIGNED):
                values = (values - zero[index]) / per_g[index]
            outputs.append(column.unit.convert(values))
        return np.column_stack(outputs)

    def _references(self, block: TableBlock) -> dict[str, np.ndarray]:
        """Return the columns of references by name, (n,) each; NaN where not sampled."""
        values = {}
        for role, column in self._columns.items():
            if role == 'time' or role in AXES:
                continue
            stated = block.columns[column.name]
            is_tilt = role in ('roll', 'pitch') and column.unit_name == 'rad'
            _refuse(block, column, np.abs(stated) > (_TURN_RAD if is_tilt else LIMIT),
                    f'no {role} in {column.unit_name}')
            values[role] = column.unit.convert(stated)
        if 'roll' in values:
            values['alpha'], beta_rad = stage_angles(values['roll'], values['pitch'])
            values['beta'] = self._unwrapped(beta_rad)
        return {name: values[role] for name, role in _NATIVE.items() if role in values}

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
        if self._reading.rate_hz is not None:
            number = self._count + np.cumsum(is_sample) - 1
            return number / self._reading.rate_hz, is_sample
        column = self._columns['time']
        stamps = block.columns[column.name]
        _refuse(block, column, is_sample & ~(np.abs(column.unit.convert(stamps)) < _TIME_LIMIT_S),
                f'no time in {column.unit_name} (200 years at most)',
                'every sample needs a time: delete the line, or give --rate HZ to stamp by index')
        if self._epoch_ns is None and is_sample.any():
            self._find_epoch(block, float(column.unit.convert(stamps[is_sample][:1])[0]))
        time_s = column.unit.convert(stamps - self._begin)
        return time_s, self._stamps.increasing(time_s, is_sample,
                                               lambda row: block.where(row, column.name))

    def _find_epoch(self, block: TableBlock, first_s: float) -> None:
        """Find the origin of the times: as comments state it, or near the first one."""
        text = block.info.get('epoch_ns', '0')
        if not re.fullmatch(r'-?\d{1,18}|-?[1-8]\d{18}', text):
            raise UserError(f'{self._path}: epoch_ns is {text!r}, expected whole nanoseconds')
        self._epoch_ns = int(text)
        if first_s > _EPOCH_S and not self._is_native and not self._epoch_ns:
            self._epoch_ns = int(first_s) * 1_000_000_000
            self._begin = int(first_s) * self._columns['time'].unit.divisor

    def _look_at_first(self, outputs: np.ndarray, time_s: np.ndarray) -> None:
        """Note what is assumed; refuse readings and stamps that are in another unit."""
        if len(time_s) > _FEWEST_STAMPS and self._reading.rate_hz is None:
            self._check_step(time_s)
        if len(self._axes) == len(AXES) and not self._axes[0].unit.is_volts:
            self._check_length(outputs)
        assumed = [f'{column.name} in {column.unit_name}' for column in self._columns.values()
                   if not column.is_stated]
        if assumed:
            self._remarks.append(f'{self._path}: columns without a unit are read as '
                                 f'{", ".join(assumed)}')
        bursts = describe_bursts(time_s) if len(time_s) > _FEWEST_STAMPS else ''
        if bursts:
            self._remarks.append(f'{self._path}: {bursts.removeprefix("; ")}; this rate is '
                                 'used, and --rate HZ stamps by index')

    def _check_step(self, time_s: np.ndarray) -> None:
        """Refuse stamps whose steps no sensor has."""
        column = self._columns['time']
        rate_hz = stamped_rate_hz(time_s)
        stamps, step = time_s * column.unit.divisor, column.unit.divisor / rate_hz
        is_whole = bool((np.abs(stamps - np.rint(stamps)) < _WHOLE).all())
        if not is_sensor_step(1 / rate_hz, is_whole):
            unit = time_unit_of_step(step, is_whole)
            fitting = {**self._mapping.sources, 'time': Source(column.name, unit)}
            raise UserError(
                f'{self._path}: {column.name} has steps of {step:.4g}, which as '
                f'{column.unit_name} are {rate_hz:.3g} Hz; if that is right, give --rate '
                f'{rate_hz:.3g}, and if they are {unit}:',
                f'--columns {shell_quoted(str(ColumnMapping(fitting)))}')

    def _check_length(self, outputs: np.ndarray) -> None:
        """Compare the length of the readings with gravity: a wrong unit shows in it."""
        first = self._axes[0]
        length_g = float(np.median(np.linalg.norm(outputs, axis=1))) / G0_MPS2
        if not _LENGTHS_G[0] < length_g < _LENGTHS_G[1]:
            names = ', '.join(column.name for column in self._axes)
            text = f'{self._path}: {names} have a length of {length_g:.3g} g in ' \
                   f'{first.unit_name}, where gravity has 1 g'
            if not first.is_stated:
                raise UserError(f'{text}; state their unit, for example x={first.name}:'
                                f'{likely_unit(length_g * G0_MPS2) or "UNIT"}')
            self._remarks.append(f'{text}: check the unit')


def _refuse(block: TableBlock, column: _Column, wrong: np.ndarray, reason: str,
            reason_of_none: str = '') -> None:
    """Refuse cells of a column, (n,): for a reason, or for another one where they are empty."""
    if wrong.any():
        row = int(wrong.argmax())
        value = block.columns[column.name][row]
        text = f'empty or NaN; {reason_of_none}' if np.isnan(value) else \
            f'{value:g}, {reason}; delete the line, or correct the unit'
        raise UserError(f'{block.where(row, column.name)} is {text}')
