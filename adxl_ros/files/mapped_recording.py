# SPDX-License-Identifier: Apache-2.0

"""
Recordings from the columns of a table: units, stamps and references become the package's.

Where a table is not understood, `mapping_proposal` finds the mapping that it most likely needs.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
import re

from adxl_ros.errors import UserError
from adxl_ros.files.column_mapping import (
    ColumnMapping,
    drop_samples,
    first_names,
    GYRO_ROLES,
    is_sensor_step,
    Quantity,
    ReadingOptions,
    ROLES,
    Source,
    Table,
    TableBlock,
    time_unit_of_step,
    Unit,
    unit_in_name,
    unit_name,
    UNITS,
)
from adxl_ros.files.recording_columns import (
    ACCEL,
    GYRO,
    JOINTS,
    LIMIT,
    limits,
    Recording,
    sensor_columns,
    StampCheck,
    TIME,
    VOLTS,
)
from adxl_ros.files.stamps import describe_bursts, stamped_rate_hz
from adxl_ros.model.constants import AXES
from adxl_ros.model.kinematics import stage_angles
from adxl_ros.process import option, pasted
import numpy as np

_TIME_LIMIT_S = 9e9  # Largest magnitude of a time, s: in nanoseconds it fits into 64 bits (9.2e18)
_EPOCH_S = 1e8
"""First time from which times count from 1970, s: three years (chosen: no sensor runs so long)."""
_TURN_RAD = 2 * np.pi  # Largest roll and pitch, rad
_FEWEST_STAMPS = 8  # Stamps whose steps show their unit. Chosen: a lost sample hides no median
_WHOLE = 1e-3  # Largest distance of a stamp from a whole number by rounding, in its unit

_NATIVE = {
    TIME: 'time',
    **{column: joint for joint, column in JOINTS.items()},
    'temperature_c': 'temperature',
    'supply_v': 'supply',
    **dict(zip(GYRO, GYRO_ROLES)),
}
"""Role of the package's columns besides those of the sensor."""
_COLUMNS = {role: column for column, role in _NATIVE.items()}
"""Column of the package by its role."""


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
    outputs = next(
        (kind for kind in (output, VOLTS, ACCEL) if set(kind) & set(names)), (*VOLTS, *ACCEL)
    )
    roles = {**_NATIVE, **dict(zip(outputs, 2 * AXES))}
    stems = {column.rpartition('_')[0]: column for column in roles}
    for number, name in enumerate(names, 1):
        stem, _, unit = name.lower().rpartition('_')
        column = stems.get(stem, name)
        is_wrong = column not in names and roles[column] not in GYRO_ROLES
        if is_wrong and unit_name(unit, ROLES[roles[column]]):
            # Arrays in memory and the columns of binary files stand in no line.
            place = f'{table.header}:{number}' if table.header_line else table.path
            raise NotNativeError(
                f'{place}: column {name} is in another unit; expected the column {column}'
            )
    missing = [column for column in (TIME, *output) if column not in names]
    if missing:
        present = f'; the columns are {first_names(names)}' if output else ''
        raise NotNativeError(f'{table.header}: no column {missing[0]}{present}')
    try:
        outputs = output or sensor_columns(names, table.header)
    except UserError as error:
        raise NotNativeError(str(error)) from None
    sources = {
        role: Source(name, name.rpartition('_')[2])
        for name, role in {**_NATIVE, **dict(zip(outputs, AXES))}.items()
        if name in names
    }
    return ColumnMapping({**_gyro_sources(names), **sources}, table.path)


def _gyro_sources(names: Sequence[str]) -> dict[str, Source]:
    """Return the columns of a gyroscope in any unit; none where one of its axes is missing."""
    sources = {}
    for name in names:
        stem, _, unit = name.lower().rpartition('_')
        if stem in GYRO_ROLES and (known := unit_name(unit, Quantity.TURN)):
            sources[stem] = Source(name, known)
    return sources if len(sources) == len(GYRO_ROLES) else {}


def blocks(
    table: Table,
    mapping: ColumnMapping | None,
    reading: ReadingOptions,
    rows: int,
    output: tuple[str, ...] = (),
) -> Generator[Recording, None, None]:
    """
    Read a table as a recording in blocks of at most `rows` samples.

    Without a mapping it must have the columns of the package, and further ones are kept, too.
    """
    converter = _Converter(
        table, mapping or native_mapping(table, output), reading, mapping is None
    )
    names = list(dict.fromkeys(source.column for source in converter.sources.values()))
    for block in table.blocks(table.names if mapping is None else names, names):
        recording = converter.convert(block)
        for start in range(0, len(recording), rows):
            yield recording.rows(start, start + rows)
    if not converter.count:
        raise UserError(f'{table.path}: has a header, but no samples')


class _Converter:
    """Converts the blocks of one table; the arguments are those of `blocks`."""

    def __init__(
        self, table: Table, mapping: ColumnMapping, reading: ReadingOptions, is_native: bool
    ) -> None:
        self.count = 0  # Samples so far
        self._path = table.path
        self._where = mapping.where
        self._reading = reading
        self._is_native = is_native  # Whether the columns are those of the package
        if 'time' not in mapping.sources and reading.rate_hz is None:
            raise UserError(
                f'{mapping.where}: has no time; add time=COLUMN:UNIT, or give '
                f'{option(rate="HZ")} to stamp by index'
            )
        # Column and unit by role
        self.sources = {
            role: self._source(table, role, source) for role, source in mapping.sources.items()
        }
        self._axes = [self.sources[axis] for axis in AXES if axis in self.sources]
        self._is_volts = self._unit(AXES[0]).is_volts
        self._check_axes()
        self._stamps = StampCheck(table.path, reading.drop_bad_stamps)
        self._remarks: list[str] = []
        self._epoch_ns: int | None = None
        self._begin = 0.0  # Origin of the times in the unit of the stamps
        self._empty = self._incomplete = 0  # Rows without a reading, and with a part of one
        self._is_every_row_a_step = table.is_every_row_a_step
        self._rows = 0  # Steps of the sample rate so far
        self._last_beta_rad = 0.0

    def _source(self, table: Table, role: str, source: Source) -> Source:
        """Return the column of a role, by its name or number, and its unit."""
        name = source.column
        names = table.names
        if name not in names:
            if not name.isdecimal() or not 1 <= int(name) <= len(names):
                raise UserError(
                    f'{self._where}: {table.path} has no column {name!r} for {role}; '
                    f'the columns are {first_names(names)}'
                )
            name = names[int(name) - 1]
        unit = source.unit or table.units.get(name) or unit_in_name(name, ROLES[role])
        if role in AXES and self._reading.unit:
            unit = self._reading.unit
        if not unit:
            raise UserError(
                f'{self._where}: nothing states the unit of {name}; write for example '
                f'{role}={source.column}:{ROLES[role].value}'
            )
        return Source(name, unit)

    def _unit(self, role: str) -> Unit:
        return UNITS[ROLES[role]][self.sources[role].unit]

    def _check_axes(self) -> None:
        """Refuse units of the axes that do not fit each other, or the options."""
        if any(self._unit(axis).is_volts != self._is_volts for axis in AXES[: len(self._axes)]):
            raise UserError(
                f'{self._where}: some axes are in volts and others are not; state one kind'
            )
        is_named_volts = self._axes[0].column in VOLTS
        if self._is_native and self._reading.unit and self._is_volts != is_named_volts:
            raise UserError(
                f'{option(unit=self._reading.unit)}: {self._axes[0].column} of '
                f'{self._path} says another quantity; name the columns by {option("columns")}'
            )
        self._reading.check_counts(self._where, {axis.column: axis.unit for axis in self._axes})

    def convert(self, block: TableBlock) -> Recording:
        """Return the samples of a block."""
        outputs = self._outputs(block)
        is_row = ~np.isnan(outputs).all(axis=1)
        self._empty += int((~is_row).sum())
        is_sample = is_row
        if self._reading.drop_bad_samples:
            is_sample = is_row & self._is_complete(block, outputs)
        self._incomplete += int((is_row & ~is_sample).sum())
        for source, values in zip(self._axes, outputs.T):
            _refuse(
                block,
                source,
                is_sample & ~(np.abs(values) <= LIMIT),
                f'no reading of a sensor in {source.unit}',
                f'every sample needs it; {drop_samples()}',
            )
        time_s, is_kept = self._times(block, is_row, is_sample)
        columns = dict(zip(VOLTS if self._is_volts else ACCEL, outputs.T))
        columns |= self._references(block)
        if self._is_native:
            columns = {**block.columns, **columns}
            del columns[TIME]
        columns = {name: np.ascontiguousarray(values[is_kept]) for name, values in columns.items()}
        if not self.count and is_kept.any():
            self._look_at_first(time_s[is_kept])
        self.count += int(is_kept.sum())
        return Recording(
            self._path,
            time_s[is_kept],
            columns,
            {key: text for key, text in block.info.items() if key != 'epoch_ns'},
            cut=block.cut,
            epoch_ns=self._epoch_ns or 0,
            done=block.done,
            remarks=(*self._remarks, *self._left_out(), *self._stamps.remarks),
            bad_stamps=self._stamps.bad,
        )

    def _left_out(self) -> list[str]:
        """Return what was left out so far, for people."""
        counts = {
            'lines without a reading of the sensor': self._empty,
            'samples without a number on each axis, or without a time': self._incomplete,
        }
        return [
            f'{self._path}: left out, {kind}: {count}' for kind, count in counts.items() if count
        ]

    def _is_complete(self, block: TableBlock, outputs: np.ndarray) -> np.ndarray:
        """Return which rows have a number on each axis, and a time where stamps are used, (n,)."""
        is_complete = np.isfinite(outputs).all(axis=1)
        if self._reading.rate_hz is None:
            is_complete &= np.isfinite(block.columns[self.sources['time'].column])
        return np.asarray(is_complete)

    def _outputs(self, block: TableBlock) -> np.ndarray:
        """Return the output of the sensor, (n, m), V or m/s²."""
        readings = np.column_stack([block.columns[axis.column] for axis in self._axes])
        return self._reading.outputs(readings, [axis.unit for axis in self._axes])

    def _references(self, block: TableBlock) -> dict[str, np.ndarray]:
        """Return the columns of references by name, (n,) each; NaN where not sampled."""
        values = {}
        for role, source in self.sources.items():
            if role == 'time' or role in AXES:
                continue
            stated = block.columns[source.column]
            is_tilt = role in ('roll', 'pitch') and source.unit == 'rad'
            converted = self._unit(role).convert(stated)
            lowest, highest = (
                (-_TURN_RAD, _TURN_RAD) if is_tilt else limits(_COLUMNS.get(role, role))
            )
            is_wrong = (converted < lowest) | (converted > highest)
            _refuse(block, source, is_wrong, f'no {role} in {source.unit}')
            values[role] = converted
        if 'roll' in values:
            values['alpha'], beta_rad = stage_angles(values['roll'], values['pitch'])
            # Without steps of a turn; rows without an angle stay NaN.
            known = np.isfinite(beta_rad)
            turned = np.unwrap(np.append(self._last_beta_rad, beta_rad[known]))
            beta_rad[known] = turned[1:]
            self._last_beta_rad = float(turned[-1])
            values['beta'] = beta_rad
        return {name: values[role] for name, role in _NATIVE.items() if role in values}

    def _times(
        self, block: TableBlock, is_row: np.ndarray, is_sample: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return stamps, s, (n,), and which rows are kept, (n,); a part of a reading has one."""
        if self._reading.rate_hz is not None:
            is_step = is_row | self._is_every_row_a_step
            number = self._rows + np.cumsum(is_step) - 1
            self._rows += int(is_step.sum())
            return number / self._reading.rate_hz, is_sample
        source = self.sources['time']
        unit = self._unit('time')
        stamps = block.columns[source.column]
        _refuse(
            block,
            source,
            is_sample & ~(np.abs(unit.convert(stamps)) < _TIME_LIMIT_S),
            f'no time in {source.unit} (200 years at most)',
            f'every sample needs a time: give {option(rate="HZ")} to stamp by index, or delete '
            f'the line; {drop_samples()}',
        )
        if self._epoch_ns is None and is_sample.any():
            first_s = float(unit.convert(stamps[is_sample][:1])[0])
            self._set_epoch(block.info.get('epoch_ns', '0'), first_s)
        time_s = unit.convert(stamps - self._begin)
        return time_s, self._stamps.increasing(
            time_s, is_sample, lambda row: block.where(row, source.column)
        )

    def _set_epoch(self, stated: str, first_s: float) -> None:
        """Take the epoch that a file states, or the first time where it counts from 1970."""
        if not re.fullmatch(r'-?\d{1,18}|-?[1-8]\d{18}', stated):
            raise UserError(f'{self._path}: epoch_ns is {stated!r}, expected whole nanoseconds')
        self._epoch_ns = int(stated)
        if first_s > _EPOCH_S and not self._is_native and not self._epoch_ns:
            self._epoch_ns = int(first_s) * 1_000_000_000
            self._begin = int(first_s) * self._unit('time').divisor

    def _look_at_first(self, time_s: np.ndarray) -> None:
        """Refuse stamps that are in another unit, and note those in bursts."""
        if len(time_s) <= _FEWEST_STAMPS or self._reading.rate_hz is not None:
            return
        self._check_step(time_s)
        if bursts := describe_bursts(time_s):
            self._remarks.append(
                f'{self._path}: {bursts}; this rate is '
                f'used, and {option(rate="HZ")} stamps by index'
            )

    def _check_step(self, time_s: np.ndarray) -> None:
        """Refuse stamps whose steps no sensor has."""
        source = self.sources['time']
        divisor = self._unit('time').divisor
        rate_hz = stamped_rate_hz(time_s)
        stamps = time_s * divisor
        step = divisor / rate_hz
        is_whole = bool((np.abs(stamps - np.rint(stamps)) < _WHOLE).all())
        if not is_sensor_step(1 / rate_hz, is_whole):
            unit = time_unit_of_step(step, is_whole)
            fitting = ColumnMapping({**self.sources, 'time': Source(source.column, unit)})
            right = f'if that is right, give {option(rate=f"{rate_hz:.6g}")}'
            if is_whole and step == 1:
                right = f'if it counts samples, give {option(rate="HZ")}'
            paste = ''
            if unit != source.unit:
                right += f', and if they are {unit}:'
                paste = pasted(columns=str(fitting))
            raise UserError(
                f'{self._path}: {source.column} has steps of {step:.4g}, which as {source.unit} '
                f'are {rate_hz:.6g} Hz; {right}',
                paste,
            )


def _refuse(
    block: TableBlock, source: Source, wrong: np.ndarray, reason: str, reason_of_none: str = ''
) -> None:
    """Refuse cells of a column, (n,): for a reason, or for another one where they are empty."""
    if wrong.any():
        row = int(wrong.argmax())
        value = block.columns[source.column][row]
        text = f'{value:g}, {reason}; delete the line, or correct the unit'
        if np.isnan(value):
            text = f'empty or NaN; {reason_of_none}'
        raise UserError(f'{block.where(row, source.column)} is {text}')
