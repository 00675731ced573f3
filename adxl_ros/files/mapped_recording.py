# SPDX-License-Identifier: Apache-2.0

"""
Recordings from the columns of a table: units, stamps and references become the package's.

Where a table is not understood, `mapping_proposal` finds the mapping that it most likely needs.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence

from adxl_ros.errors import UserError
from adxl_ros.files.column_mapping import (
    ColumnMapping,
    drop_samples,
    first_names,
    GYRO_ROLES,
    Quantity,
    ReadingOptions,
    ROLES,
    Source,
    Table,
    TableBlock,
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
    TIME,
    VOLTS,
)
from adxl_ros.files.stamp_check import StampCheck
from adxl_ros.files.table_stamps import CountedStamps, StampColumn
from adxl_ros.model.constants import AXES
from adxl_ros.model.kinematics import stage_angles
from adxl_ros.wording import option
import numpy as np

_TURN_RAD = 2 * np.pi  # Largest roll and pitch, rad
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
    _refuse_other_units(table, output)
    missing = [column for column in (TIME, *output) if column not in names]
    if missing:
        present = f'; the columns are {first_names(names)}' if output else ''
        raise NotNativeError(f'{table.header}: no column {missing[0]}{present}')
    try:
        axes = output or sensor_columns(names, table.header)
    except UserError as error:
        raise NotNativeError(str(error)) from None
    sources = {
        role: Source(name, name.rpartition('_')[2])
        for name, role in {**_NATIVE, **dict(zip(axes, AXES))}.items()
        if name in names
    }
    return ColumnMapping({**_gyro_sources(names), **sources}, table.path)


def _refuse_other_units(table: Table, output: tuple[str, ...]) -> None:
    """Refuse a column that is one of the package but for its unit; a gyroscope may have any."""
    names = table.names
    quantities = {column: ROLES[role] for column, role in _NATIVE.items() if column not in GYRO}
    # Where one form of output is there, the other may stand there in any unit.
    forms = [form for form in (output, VOLTS, ACCEL) if not set(form).isdisjoint(names)]
    quantities |= dict.fromkeys(forms[0] if forms else (*VOLTS, *ACCEL), Quantity.OUTPUT)
    columns = {column.rpartition('_')[0]: column for column in quantities}
    for number, name in enumerate(names, 1):
        stem, _, unit = name.lower().rpartition('_')
        column = columns.get(stem, name)
        if column not in names and unit_name(unit, quantities[column]):
            # Arrays in memory and the columns of binary files stand in no line.
            place = f'{table.header}:{number}' if table.header_line else table.path
            raise NotNativeError(
                f'{place}: column {name} is in another unit; expected the column {column}'
            )


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
        self._check = StampCheck(table.path, reading.drop_bad_stamps)
        self._stamps: CountedStamps | StampColumn
        if reading.rate_hz is not None:
            self._stamps = CountedStamps(reading.rate_hz, table.is_every_row_a_step)
        else:
            self._stamps = StampColumn(table.path, self.sources, self._check, not is_native)
        self._remarks: list[str] = []
        self._empty = self._incomplete = 0  # Rows without a reading, and with a part of one
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
        is_contradicted = self._is_volts != (self._axes[0].column in VOLTS)
        has_both = self._is_native and bool(self._reading.unit)
        if has_both and is_contradicted:
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
            block.refuse(
                source.column,
                is_sample & ~(np.abs(values) <= LIMIT),
                f'no reading of a sensor in {source.unit}',
                f'every sample needs it; {drop_samples()}',
            )
        time_s, is_kept = self._stamps(block, is_row, is_sample)
        columns = dict(zip(VOLTS if self._is_volts else ACCEL, outputs.T))
        columns |= self._references(block)
        if self._is_native:
            columns = {**block.columns, **columns}
            del columns[TIME]
        columns = {name: np.ascontiguousarray(values[is_kept]) for name, values in columns.items()}
        if not self.count and is_kept.any():
            self._remarks += self._stamps.look_at_first(time_s[is_kept])
        self.count += int(is_kept.sum())
        return Recording(
            self._path,
            time_s[is_kept],
            columns,
            {key: text for key, text in block.info.items() if key != 'epoch_ns'},
            cut=block.cut,
            epoch_ns=self._stamps.epoch_ns or 0,
            done=block.done,
            remarks=(*self._remarks, *self._left_out(), *self._check.remarks),
            bad_stamps=self._check.bad,
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
        return is_complete

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
            block.refuse(source.column, is_wrong, f'no {role} in {source.unit}')
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
