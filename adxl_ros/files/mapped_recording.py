# SPDX-License-Identifier: Apache-2.0

"""
Recordings from the columns of a table: units, stamps and references become the package's.

Where a table is not understood, `propose` finds the mapping that it most likely needs.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
import re
from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.files.column_mapping import (
    ColumnMapping,
    Columns,
    drop_samples,
    GRAVITY,
    GYRO_ROLES,
    is_sensor_step,
    likely_unit,
    listed,
    LSB,
    Quantity,
    ReadingOptions,
    ROLES,
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
from adxl_ros.files.stamps import burst_samples, describe_bursts, stamped_rate_hz
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
            raise NotNativeError(
                f'{table.header}:{number}: column {name} is in another unit; '
                f'expected the column {column}'
            )
    missing = [column for column in (TIME, *output) if column not in names]
    if missing:
        raise NotNativeError(
            f'{table.header}: no column {missing[0]}'
            + f'; the columns are {listed(names)}' * bool(output)
        )
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
        self._path, self._where, self._reading = table.path, mapping.where, reading
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
        name, names = source.column, table.names
        if name not in names:
            if not name.isdecimal() or not 1 <= int(name) <= len(names):
                raise UserError(
                    f'{self._where}: {table.path} has no column {name!r} for {role}; '
                    f'the columns are {listed(names)}'
                )
            name = names[int(name) - 1]
        unit = (
            (self._reading.unit if role in AXES else '')
            or source.unit
            or table.units.get(name)
            or unit_in_name(name, ROLES[role])
        )
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
        if (
            self._is_native
            and self._reading.unit
            and self._is_volts != (self._axes[0].column in VOLTS)
        ):
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
        is_sample = (
            is_row & self._is_complete(block, outputs)
            if self._reading.drop_bad_samples
            else is_row
        )
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
        info = {key: text for key, text in block.info.items() if key != 'epoch_ns'}
        left_out = {
            'lines without a reading of the sensor': self._empty,
            'samples without a number on each axis, or without a time': self._incomplete,
        }
        return Recording(
            self._path,
            time_s[is_kept],
            columns,
            info,
            cut=block.cut,
            epoch_ns=self._epoch_ns or 0,
            done=block.done,
            remarks=(
                *self._remarks,
                *(
                    f'{self._path}: left out, {kind}: {count}'
                    for kind, count in left_out.items()
                    if count
                ),
                *self._stamps.remarks,
            ),
            bad_stamps=self._stamps.bad,
        )

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
            turned = np.unwrap(np.concatenate([[self._last_beta_rad], beta_rad[known]]))
            beta_rad[known], self._last_beta_rad = turned[1:], float(turned[-1])
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
        source, unit = self.sources['time'], self._unit('time')
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
            text = block.info.get('epoch_ns', '0')
            if not re.fullmatch(r'-?\d{1,18}|-?[1-8]\d{18}', text):
                raise UserError(f'{self._path}: epoch_ns is {text!r}, expected whole nanoseconds')
            self._epoch_ns = int(text)
            first_s = float(unit.convert(stamps[is_sample][:1])[0])
            if first_s > _EPOCH_S and not self._is_native and not self._epoch_ns:
                self._epoch_ns = int(first_s) * 1_000_000_000
                self._begin = int(first_s) * unit.divisor
        time_s = unit.convert(stamps - self._begin)
        return time_s, self._stamps.increasing(
            time_s, is_sample, lambda row: block.where(row, source.column)
        )

    def _look_at_first(self, time_s: np.ndarray) -> None:
        """Refuse stamps that are in another unit, and note those in bursts."""
        if len(time_s) <= _FEWEST_STAMPS or self._reading.rate_hz is not None:
            return
        self._check_step(time_s)
        if bursts := describe_bursts(time_s):
            self._remarks.append(
                f'{self._path}: {bursts.removeprefix("; ")}; this rate is '
                f'used, and {option(rate="HZ")} stamps by index'
            )

    def _check_step(self, time_s: np.ndarray) -> None:
        """Refuse stamps whose steps no sensor has."""
        source, divisor = self.sources['time'], self._unit('time').divisor
        rate_hz = stamped_rate_hz(time_s)
        stamps, step = time_s * divisor, divisor / rate_hz
        is_whole = bool((np.abs(stamps - np.rint(stamps)) < _WHOLE).all())
        if not is_sensor_step(1 / rate_hz, is_whole):
            unit = time_unit_of_step(step, is_whole)
            fitting = ColumnMapping({**self.sources, 'time': Source(source.column, unit)})
            raise UserError(
                f'{self._path}: {source.column} has steps of {step:.4g}, which as '
                f'{source.unit} are {rate_hz:.3g} Hz; if that is right, give '
                f'{option(rate=f"{rate_hz:.3g}")}, and if they are {unit}:',
                pasted(columns=str(fitting)),
            )


def _refuse(
    block: TableBlock, source: Source, wrong: np.ndarray, reason: str, reason_of_none: str = ''
) -> None:
    """Refuse cells of a column, (n,): for a reason, or for another one where they are empty."""
    if wrong.any():
        row = int(wrong.argmax())
        value = block.columns[source.column][row]
        text = (
            f'empty or NaN; {reason_of_none}'
            if np.isnan(value)
            else f'{value:g}, {reason}; delete the line, or correct the unit'
        )
        raise UserError(f'{block.where(row, source.column)} is {text}')


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
"""Largest relative scatter of a length that is that of gravity (chosen: a hand that turns a
sensor makes less)."""

_LARGEST = 1e30  # Larger magnitudes are no readings and no stamps

_AT_REST = 0.05
"""Largest spread of a sensor that rests, as a share of its readings. Chosen: noise is far below
it, and 1 g of an analog sensor that is read about the middle of its supply above it."""
_TURNED = 0.3  # Smallest spread of an axis in that of another one of a sensor that is turned

_COUNTS = (64, 100, 128, 256, 512, 1000, 1024, 1365, 2048, 4096, 8192, 16384, 32768)
"""Usual counts of 1 g."""

_SIGN_GAP = (24576, 40960)
"""Counts of 16 bits that are beyond the range, 1.5 times ±16384, where their sign was lost."""


def propose(table: Table) -> tuple[str, str]:
    """Describe the columns of a table, and the options that most likely read it."""
    seen = f'the columns are {listed(table.names)}'
    sample = next((block.columns for block in table.blocks(table.names, ())), {})
    values = {
        name: np.where(np.abs(column) < _LARGEST, column, np.nan)
        for name, column in sample.items()
        if np.isfinite(column).any()
    }
    time = _time_column(table, values)
    outputs = _outputs(table, [name for name in values if name != time], values)
    readings = np.column_stack([values[name] for name in outputs]) if outputs else np.zeros((0, 1))
    unit, zero, length = _unit(table, outputs, readings[np.isfinite(readings).all(axis=1)])
    if not unit:
        return (
            f'{seen}; none looks like an accelerometer: name the columns, for example',
            pasted(columns='time=COLUMN:s,x=COLUMN:g,y=COLUMN:g,z=COLUMN:g'),
        )
    sources = {axis: Source(name, unit) for axis, name in zip(AXES, outputs)}
    stamps: dict[str, Any] = {'rate': 'HZ'}
    note = ' (write the sample rate for HZ)'
    if time:
        source = _time_source(table, time, values[time])
        sources = {'time': source, **sources}
        stamps = _stamp_options(values[time], source)
        note = ''
        if unit in ('v', 'mv'):
            note = f' (add {option("sensor")} with the parameter file of the sensor)'
    sources |= _references(values, {*outputs, time}) if table.has_names else {}
    options = {'columns': str(ColumnMapping(sources)), **stamps}
    if unit in (LSB, UNSIGNED):
        options['lsb_per_g'] = round(length) if zero else _usual_counts(length)
        if zero:
            options['lsb_at_0g'] = f'{zero:.0f}'
    return f'{seen}; the best guess{note}:', pasted(**options)


def _unit(table: Table, outputs: Sequence[str], readings: np.ndarray) -> tuple[str, float, float]:
    """
    Return the unit of readings, (n, m); empty where they are not those of an accelerometer.

    Also the reading at 0 g and the length of gravity about it.
    """
    if not len(readings):
        return '', 0.0, 0.0
    unit = table.units.get(outputs[0]) or unit_in_name(outputs[0], Quantity.OUTPUT)
    is_whole = bool((readings == np.rint(readings)).all())
    if unit in (None, LSB) and is_whole and _have_lost_sign(readings):
        unit, readings = UNSIGNED, signed(readings)
    low, spread = readings.min(axis=0), np.ptp(readings, axis=0)
    zero = 0.0
    is_turned = spread.min() > max(_TURNED * spread.max(), _AT_REST * readings.max())
    if low.min() > 0 and is_turned:
        zero = float(np.mean(low + spread / 2))
    lengths = np.linalg.norm(readings - zero, axis=1)
    length = float(np.median(lengths))
    if not unit:
        is_volts = table.has_names and all(map(_VOLT_NAMES.search, outputs))
        unit = ('' if zero else _gravity_unit(length, is_whole)) or (
            'v' if is_volts and length < 9 else LSB
        )
        unit = '' if unit == LSB and length + zero < 40 else unit
    is_gravity = (
        np.median(np.abs(lengths - length)) <= _CONSTANT * length
        and 0.5 < length / GRAVITY.get(unit, length) < 2
    )
    return (unit if is_gravity or len(outputs) < len(AXES) else ''), zero, length


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
    """Return the option that stamps need which stand still or step back; empty for none."""
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
        if len(steps) > 2 and np.mean(steps >= 0) > 0.99 and np.mean(steps > 0) > 0.05:
            rising.append(name)
    named = [name for name in rising if table.has_names and _TIME_NAMES.fullmatch(name)]
    others = [name for name in rising if not _is_counter(name, values[name])]
    return next(iter([*named, *others]), None)


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
        length = np.linalg.norm([values[name] for name in triple], axis=0)
        median = np.nanmedian(length)
        return float(np.nanmedian(np.abs(length - median)) / max(median, 1e-12))

    return min((names[i : i + 3] for i in range(len(names) - 2)), key=scatter, default=[])


def _by_axis(names: Sequence[str]) -> list[str]:
    """Return the names of x, y and z in this order, as far as there are any; or acc[0] ..."""
    by_letter: dict[str, str] = {}
    for name in names:
        bare = re.sub(r'[(\[{].*?[)\]}]', '', name).strip()
        matches = list(filter(None, map(_AXIS_WORD.fullmatch, _words(bare))))
        if matches:
            by_letter.setdefault((matches[-1][1] or matches[-1][2]).lower(), name)
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
    if not {'roll', 'pitch'} <= set(sources) or 'alpha' in sources or is_estimate:
        sources.pop('roll', None), sources.pop('pitch', None)
    return sources
