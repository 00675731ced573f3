# SPDX-License-Identifier: Apache-2.0

"""What a recording holds: samples by column, stamps, references, what it states of its unit."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
import os
from pathlib import Path
import re
from typing import Any, NamedTuple

from adxl_ros.errors import UserError
from adxl_ros.files.atomic_write import require_own
from adxl_ros.files.stamps import describe_bursts, stamped_rate_hz
from adxl_ros.model.constants import AXES
from adxl_ros.model.sensor import Sensor, to_nominal_mps2, to_volts, with_axes
from adxl_ros.process import option
from adxl_ros.report.quantities import column_unit
import numpy as np

FORMAT = '1'  # Version of the recording format, the key `format`

NO_SERIAL = 'nominal'  # Serial number that stands for no particular unit

NOMINAL_KEYS = ('nominal_zero_g_v', 'nominal_scale_v_per_g')
"""Keys of the nominal values, V and V/g; each is a field of `Sensor`, too."""

_HIGHEST_RATE_HZ = 1e6
"""Sample rates from here on are refused, Hz (chosen: ten times the limit of a parameter file)."""


@dataclass(frozen=True)
class StreamInfo:
    """What a stream states of its sensor; values are checked when they are asked for."""

    texts: Mapping[str, str]  # Values by key, as text
    where: str  # The file or topic, for messages

    @property
    def serial(self) -> str:
        """Return the serial number of the unit; `NO_SERIAL` where none is stated."""
        return self.texts.get('serial', NO_SERIAL)

    @property
    def axes(self) -> str | None:
        """Measured axes; None where they are not stated."""
        return self.texts.get('axes')

    @property
    def rate_hz(self) -> float | None:
        """Sample rate, Hz; None where it is not stated."""
        if 'rate_hz' not in self.texts:
            return None
        rate_hz = _numbers(self.texts['rate_hz'])
        if len(rate_hz) != 1 or not 0 < rate_hz[0] < _HIGHEST_RATE_HZ:
            raise UserError(
                f'{self.where}: rate_hz is {self.texts["rate_hz"]!r}, expected samples a second'
            )
        return float(rate_hz[0])

    def nominal_values(self, axes: str) -> dict[str, np.ndarray]:
        """Return the stated nominal values, (m,), by the name of the field of `Sensor`."""
        values = {}
        for key in NOMINAL_KEYS:
            if key in self.texts:
                numbers = _numbers(self.texts[key])
                if len(numbers) != len(axes) or not np.isfinite(numbers).all():
                    raise UserError(
                        f'{self.where}: {key} is {self.texts[key]!r}, expected '
                        f'{len(axes)} numbers, one for each axis'
                    )
                values[key] = numbers
        return values


def _numbers(text: str) -> np.ndarray:
    """Return the numbers of a list; none if one of them cannot be read."""
    try:
        return np.array([float(word) for word in re.split(r'[\s,;\[\]()]+', text) if word])
    except ValueError:
        return np.zeros(0)


def sensor_info(sensor: Sensor) -> dict[str, str]:
    """Return the keys and values that a stream of `sensor` states."""
    return {
        'serial': sensor.serial,
        'axes': sensor.axes,
        **{key: ', '.join(map(repr, getattr(sensor, key).tolist())) for key in NOMINAL_KEYS},
        'rate_hz': repr(float(sensor.rate_hz)),
        'format': FORMAT,
    }


def converted_info(texts: Mapping[str, str], sensor: Sensor) -> dict[str, str]:
    """Return what a recording states after a conversion by the nominal values of `sensor`."""
    unchanged = {key: texts[key] for key in ('serial', 'rate_hz') if key in texts}
    return {**texts, **sensor_info(sensor), **unchanged}


TIME = 'time_s'
VOLTS = ('x_v', 'y_v', 'z_v')  # Columns of the ADC volts by axis
ACCEL = ('ax_mps2', 'ay_mps2', 'az_mps2')
"""Columns of the specific force by axis after the nominal conversion."""
GYRO = ('gx_radps', 'gy_radps', 'gz_radps')
"""Columns of the gyroscope by axis, in the frame of the sensor; NaN where it was not sampled."""
JOINTS = {'alpha': 'alpha_rad', 'beta': 'beta_rad', 'shift': 'shift_m'}
"""Columns of the encoders by joint."""
REFERENCES = (*JOINTS.values(), 'temperature_c', 'supply_v')
COMMANDS = {'alpha': 'alpha_command_rad', 'beta': 'beta_command_rad'}
"""Columns of the commands of a stage, rad: no references, but they show when a joint moves."""

LIMIT = 1e6
"""Largest magnitude of a sensor's output or a reference, in the column's unit (chosen: beyond
every sensor, stage and reference of the package)."""
_REFERENCE_LIMITS = {'temperature_c': (-100.0, 230.0), 'supply_v': (-100.0, 100.0)}
"""Lowest and highest value of a reference; values beyond are in another unit. No accelerometer
works colder or hotter, and a room in kelvin is above it; millivolts of a supply are above 100."""


def limits(column: str) -> tuple[float, float]:
    """Return the lowest and highest value of a column, in its unit."""
    return _REFERENCE_LIMITS.get(column, (-LIMIT, LIMIT))


class BadStamps(NamedTuple):
    """Samples whose stamp does not increase."""

    duplicates: int  # Samples with the stamp of the sample before
    backward: int  # Samples whose stamp is earlier

    @property
    def texts(self) -> list[str]:
        """Return how many there are of each kind, for people."""
        kinds = ('samples with the stamp of the one before', 'samples whose stamp steps back')
        return [f'{kind}: {count}' for kind, count in zip(kinds, self) if count]


@dataclass(repr=False, eq=False)
class Recording:
    """Samples of one sensor, with references."""

    path: str  # The file that it was read from, or another name, for messages
    # Stamps of the samples, s since `epoch_ns`, (n,), strictly increasing. Missing samples are
    # gaps in it.
    time_s: np.ndarray
    # Arrays (n,) by column name. The sensor's output is `x_v ...`, V, or `ax_mps2 ...`, m/s²;
    # where a file has both, it is the volts. References are NaN where they were not sampled,
    # commands before the first one. A CSV file may have further columns of numbers.
    columns: dict[str, np.ndarray]
    # The keys and values of `sensor_info`, and other `# key: value` lines
    info: dict[str, str] = field(default_factory=dict)
    # Residual of the alignment of each reference by its stamps, in its unit, by column
    alignments: dict[str, float] = field(default_factory=dict)
    cut: str = ''  # Where a damaged recording ends; empty if it is whole
    # Origin of `time_s`, ns. Whole seconds near the first stamp where the stamps of a bag count
    # from 1970, because float64 seconds since then resolve only 0.2 µs; else 0.
    epoch_ns: int = 0
    done: float = 1.0  # Fraction of the file that has been read at the end of these samples
    remarks: tuple[str, ...] = ()  # What was assumed or left out so far, one line each, for people
    # Samples that were left out so far because their stamp does not increase
    bad_stamps: BadStamps = BadStamps(0, 0)

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.time_s)

    def __repr__(self) -> str:
        """Return name, length, rate, axes and references in one line."""
        rate = f', {self.rate_hz:.4g} Hz' if len(self) > 1 else ''
        references = [name for name in self.columns if name not in self.sensor_columns]
        further = f', with {", ".join(references)}' if references else ''
        axes = ' '.join(self.axes)
        return f'{Path(self.path).name}: {self.span_s:.4g} s{rate}, axes {axes}{further}'

    def save(self, path: str | os.PathLike, *, overwrite: bool = False) -> None:
        """
        Write a CSV file NAME.csv, a bag NAME.mcap, or a rosbag2 directory.

        overwrite: whether a file or a bag is replaced that this package did not write, or that
        was changed since; a folder with other files never is.
        """
        from adxl_ros.files import parameter_file, recording

        require_own(path, overwrite)
        nominal = uncalibrated(
            parameter_file.usual(self.is_of_nominal), self.stream_info, self.axes, self.rate_hz
        )
        recording.write(path, self, nominal)

    def to_pandas(self) -> Any:
        """Return a DataFrame with the stamps as index, s, and a column for each of `columns`."""
        from pandas import DataFrame, Index

        return DataFrame(self.columns, index=Index(self.time_s, name=TIME))

    def plot(self, ax: Any = None) -> Any:
        """Draw the sensor's output over time into axes of matplotlib, new ones for None."""
        from adxl_ros.report.figures import axes_for, AXIS_COLOURS

        ax = axes_for(ax)
        unit = 'V' if self.sensor_columns[0] in VOLTS else 'm/s²'
        for axis, name in zip(self.axes, self.sensor_columns):
            ax.plot(self.time_s, self.columns[name], lw=0.8, label=axis, color=AXIS_COLOURS[axis])
        ax.set(xlabel='time, s', ylabel=f'output, {unit}')
        ax.legend()
        return ax

    @property
    def notes(self) -> tuple[str, ...]:
        """Return what was assumed in reading, where it is cut, and how references are aligned."""
        # References with the stamps of the samples need no alignment.
        aligned = [
            f'{self.path}: {name} aligned by its stamps: residual {residual:.3g} '
            f'{column_unit(name)} rms'
            for name, residual in self.alignments.items()
            if residual
        ]
        cut = [self.cut] if self.cut else []
        return (*self.remarks, *cut, *aligned)

    def rows(self, start: int, stop: int) -> Recording:
        """Return a part of the samples."""
        part = slice(start, stop)
        return replace(
            self,
            time_s=self.time_s[part],
            columns={name: values[part] for name, values in self.columns.items()},
        )

    @property
    def sensor_columns(self) -> tuple[str, ...]:
        """Columns of the sensor's output, in the order of the axes."""
        return sensor_columns(self.columns, self.path)

    @property
    def is_of_nominal(self) -> bool:
        """Return whether it is in volts or states a conversion, as those of this package do."""
        return self.sensor_columns[0] in VOLTS or bool(self.stream_info.nominal_values(self.axes))

    @property
    def axes(self) -> str:
        """Return the measured axes: x, xy or xyz."""
        return AXES[: len(self.sensor_columns)]

    @property
    def gyro_radps(self) -> np.ndarray | None:
        """Return what the gyroscope reads, rad/s, (n, 3); None without one."""
        if not all(name in self.columns for name in GYRO):
            return None
        return np.column_stack([self.columns[name] for name in GYRO])

    @property
    def span_s(self) -> float:
        """Return the time from the first to the last sample, s; 0 without samples."""
        return float(self.time_s[-1] - self.time_s[0]) if len(self) else 0.0

    @property
    def stamp_ns(self) -> np.ndarray:
        """Stamps, ns, (n,) int64: exactly those of a bag's messages."""
        return self.epoch_ns + np.rint(self.time_s * 1e9).astype(np.int64)

    @property
    def stream_info(self) -> StreamInfo:
        """Return what the recording states about its sensor."""
        return StreamInfo(self.info, self.path)

    @property
    def rate_hz(self) -> float:
        """Sample rate by the stamps, Hz: samples over their time, without gaps."""
        if len(self) < 2:
            raise UserError(f'{self.path}: {len(self)} samples; at least 2 are needed')
        return stamped_rate_hz(self.time_s)

    @property
    def stage_angles(self) -> np.ndarray | None:
        """Angles alpha and beta, rad, (n, 2), NaN where not sampled; None without a stage."""
        names = (JOINTS['alpha'], JOINTS['beta'])
        if not all(name in self.columns for name in names):
            return None
        angles = np.column_stack([self.columns[name] for name in names])
        return None if np.isnan(angles).all(axis=0).any() else angles

    def volts(self, sensor: Sensor) -> np.ndarray:
        """
        Return the ADC volts of the axes of `sensor`, (n, m).

        Specific force is converted by the nominal values that the recording, or `sensor`, states.
        """
        names, data = self._output(sensor)
        return data if names[0] in VOLTS else to_volts(data, self._nominal(sensor))

    def accel_mps2(self, sensor: Sensor) -> np.ndarray:
        """Return the specific force by the nominal values of `sensor`, m/s², (n, m)."""
        names, data = self._output(sensor)
        if names[0] in ACCEL and all(
            np.array_equal(getattr(self._nominal(sensor), key), getattr(sensor, key))
            for key in NOMINAL_KEYS
        ):
            return data
        return to_nominal_mps2(self.volts(sensor), sensor)

    def _output(self, sensor: Sensor) -> tuple[tuple[str, ...], np.ndarray]:
        names = self.sensor_columns
        if len(names) < len(sensor.axes):
            raise UserError(
                f'{self.path}: has the axes {self.axes}, but the sensor '
                f'{sensor.serial} has {sensor.axes}; name its own parameter file'
            )
        names = names[: len(sensor.axes)]
        return names, np.column_stack([self.columns[name] for name in names])

    def _nominal(self, sensor: Sensor) -> Sensor:
        stated: dict[str, Any] = {
            name: values[: len(sensor.axes)]
            for name, values in self.stream_info.nominal_values(self.axes).items()
        }
        return replace(sensor, **stated)


def sensor_columns(names: Iterable[str], where: str) -> tuple[str, ...]:
    """Return which columns are the sensor's output: volts where there are any, else m/s²."""
    names = tuple(names)
    kind = VOLTS if any(name in names for name in VOLTS) else ACCEL
    present = tuple(name for name in kind if name in names)
    if not present:
        raise UserError(
            f'{where}: no column of a sensor: needs x_v[, y_v][, z_v] or '
            'ax_mps2[, ay_mps2][, az_mps2]'
        )
    expected = kind[: len(present)]
    if present != expected:
        missing = next(name for name in expected if name not in present)
        raise UserError(f'{where}: no column {missing} beside {", ".join(present)}')
    return present


def concatenate(parts: Iterable[Recording]) -> Recording:
    """Join the blocks of a recording; its columns, info and cut are those of the last one."""
    blocks = list(parts)
    last = blocks[-1]
    columns = {
        name: np.concatenate([block.columns[name] for block in blocks]) for name in last.columns
    }
    return replace(
        last, time_s=np.concatenate([block.time_s for block in blocks]), columns=columns
    )


class StampCheck:
    """Finds samples whose stamp does not increase: they are refused, or left out and counted."""

    def __init__(self, path: str, may_drop: bool) -> None:
        self.bad = BadStamps(0, 0)  # What was left out so far
        self._path = path
        self._may_drop = may_drop
        self._last_s = -np.inf

    def increasing(
        self, time_s: np.ndarray, is_sample: np.ndarray, where: Callable[[int], str]
    ) -> np.ndarray:
        """Return which samples among rows, (n,), increase; `where` names the place of a row."""
        latest = np.maximum.accumulate(
            np.concatenate([[self._last_s], np.where(is_sample, time_s, -np.inf)])
        )
        self._last_s = latest[-1]
        latest = latest[:-1]
        wrong = is_sample & ~(time_s > latest)
        stands = wrong & (time_s == latest)
        if wrong.any() and not self._may_drop:
            row = int(wrong.argmax())
            early_s = latest[row] - time_s[row]
            fault = f'time runs backwards, {early_s:.3g} s before the newest sample'
            if stands[row]:
                fault = 'time stands still'
            clauses = (
                fault,
                describe_bursts(time_s[is_sample]),
                f'{option(drop_bad_stamps=True)} leaves such samples out, {option(rate="HZ")} '
                'stamps by index',
            )
            raise UserError(f'{where(row)}: {"; ".join(filter(None, clauses))}')
        duplicates = int(stands.sum())
        self.bad = BadStamps(
            self.bad.duplicates + duplicates, self.bad.backward + int(wrong.sum()) - duplicates
        )
        return is_sample & ~wrong

    @property
    def remarks(self) -> tuple[str, ...]:
        """Return what was left out, for people."""
        return tuple(f'{self._path}: left out, {text}' for text in self.bad.texts)


def check_same_sensor(info: StreamInfo, axes: str, sensor: Sensor) -> None:
    """Refuse samples of another sensor, or with other axes or nominal values."""
    version = info.texts.get('format', FORMAT)
    if version != FORMAT:
        raise UserError(
            f'{info.where}: format version {version}, but this package reads version '
            f'{FORMAT}; update the package'
        )
    _check_serial(info, sensor)
    if axes != sensor.axes:
        raise UserError(
            f'{info.where}: samples of the axes {axes}, but the parameters of '
            f'{sensor.serial} are for {sensor.axes}; name the file of this sensor'
        )
    for key, stated in info.nominal_values(axes).items():
        expected = getattr(sensor, key)
        if not np.array_equal(stated, expected):
            raise UserError(
                f'{info.where}: {key} is {stated.tolist()}, but {expected.tolist()} '
                f'in the parameters of {sensor.serial}; name the parameter file that '
                'the samples were made with'
            )


def _check_serial(info: StreamInfo, sensor: Sensor) -> None:
    if info.serial != sensor.serial and NO_SERIAL not in (info.serial, sensor.serial):
        raise UserError(
            f'{info.where}: is of the sensor {info.serial}, but the parameters are of '
            f'{sensor.serial}; give the parameters of that sensor, or nominal ones'
        )


def uncalibrated(sensor: Sensor, info: StreamInfo, axes: str, rate_hz: float) -> Sensor:
    """Return the nominal sensor that a stream states, without a fitted coefficient."""
    measured = {key: text for key, text in sensor.provenance.items() if key == 'noise_from'}
    bare = with_axes(
        replace(
            sensor.without_covariance(),
            model='nominal',
            effects=(),
            values={},
            provenance=measured,
        ),
        axes,
    )
    stated: dict[str, Any] = dict(info.nominal_values(axes))
    return replace(bare, serial=info.texts.get('serial', sensor.serial), rate_hz=rate_hz, **stated)


def nominal_of(
    sensor: Sensor, info: StreamInfo, axes: str | None = None, rate_hz: float | None = None
) -> Sensor:
    """Return the nominal sensor of a stream, whose serial number must not contradict `sensor`."""
    _check_serial(info, sensor)
    axes = axes or info.axes or sensor.axes
    nominal = uncalibrated(sensor, info, axes, rate_hz or info.rate_hz or sensor.rate_hz)
    return replace(nominal, serial=sensor.serial) if info.serial == NO_SERIAL else nominal


def recorded_nominal(sensor: Sensor, recording: Recording) -> Sensor:
    """Return the nominal sensor of a recording, with the sample rate of its stamps."""
    nominal = nominal_of(sensor, recording.stream_info, recording.axes, recording.rate_hz)
    return replace(
        nominal, provenance={**nominal.provenance, 'rate_from': Path(recording.path).name}
    )


LONGEST_MOVE_NS = 1e8
"""Longest time between two messages in which a joint moves, ns, that is interpolated. Chosen: an
acceleration of 1 rad/s² then bends the path by 1 mrad, which is the noise of an ADXL203."""
USUAL_GAPS = 3.0
"""Gap between messages, in usual ones, that is bridged, however long. Chosen: a slow reference
loses single messages."""


def seconds(stamp_ns: int) -> str:
    """Return a stamp, ns, as text in seconds with all nanoseconds."""
    whole_s, rest_ns = divmod(int(stamp_ns), 1_000_000_000)
    return f'{whole_s}.{rest_ns:09d} s'


class Track:
    """
    One reference over time.

    Between two messages the value is on the straight line between theirs; angles are not
    wrapped. Before the first and after the last message their value is held for one period of the
    reference; beyond that the reference is NaN. So it is in a long gap over which it has changed:
    nobody knows how.
    """

    def __init__(
        self, where: str, stamp_ns: np.ndarray, value: np.ndarray, longest_ns: float = np.inf
    ) -> None:
        """
        Take the messages.

        stamp_ns: stamps, ns, (k,). Of messages with the same stamp the last one counts; value:
        values, (k,); NaN where it was not sampled; longest_ns: gap that is bridged, ns.
        """
        stamps = stamp_ns[~np.isnan(value)]
        values = value[~np.isnan(value)]
        step = np.diff(stamps)
        if (step < 0).any():
            i = int((step < 0).argmax())
            raise UserError(
                f'{where}: time runs backwards: {seconds(stamps[i + 1])} comes '
                f'after {seconds(stamps[i])}'
            )
        is_last = np.append(step > 0, True)[: len(stamps)]
        self._stamp_ns = stamps[is_last]
        self._value = values[is_last]
        step = step[step > 0]
        self._usual_ns = float(np.median(step)) if len(step) else 0.0
        self._longest_ns = max(longest_ns, USUAL_GAPS * self._usual_ns)
        self._is_exact = True  # Whether each sample so far has a message with its own stamp

    def interpolate(self, stamp_ns: np.ndarray) -> np.ndarray:
        """Return the reference at ascending stamps, ns, (n,): (n,), NaN where it is unknown."""
        if not len(self._stamp_ns) or not len(stamp_ns):
            return np.full(len(stamp_ns), np.nan)
        first, last = np.searchsorted(self._stamp_ns, stamp_ns[[0, -1]])
        part = slice(max(first - 1, 0), last + 1)  # The messages around the samples
        values = self._value[part]
        begin_ns = self._stamp_ns[part][0]
        sample_ns = stamp_ns - begin_ns
        message_ns = self._stamp_ns[part] - begin_ns
        result = np.interp(sample_ns, message_ns, values)
        is_known = (sample_ns >= -self._usual_ns) & (sample_ns <= message_ns[-1] + self._usual_ns)
        after = np.searchsorted(message_ns, sample_ns).clip(max=len(message_ns) - 1)
        is_long = np.append(
            False, (np.diff(message_ns) > self._longest_ns) & (np.diff(values) != 0)
        )
        is_inside = (sample_ns > message_ns[0]) & (sample_ns < message_ns[after])
        result[~is_known | (is_inside & is_long[after])] = np.nan
        self._is_exact &= bool((sample_ns == message_ns[after])[is_known].all())
        return result

    @property
    def alignment(self) -> float:
        """
        How well the reference was aligned so far: its residual, in its unit.

        It is the rms difference between each message and the straight line between its
        neighbours. Interpolation over twice the period misses it, so that it bounds the error
        over one period. It is 0 where every sample has a message with its own stamp.
        """
        if self._is_exact or len(self._value) < 3:
            return 0.0
        time_ns = self._stamp_ns - self._stamp_ns[0]
        value = self._value
        share = (time_ns[1:-1] - time_ns[:-2]) / (time_ns[2:] - time_ns[:-2])
        residual = value[1:-1] - (value[:-2] + share * (value[2:] - value[:-2]))
        return float(np.sqrt(np.mean(residual**2)))
