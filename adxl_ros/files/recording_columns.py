# SPDX-License-Identifier: Apache-2.0

"""What a recording holds: samples by column, stamps, references, what it states of its unit."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace
import os
from pathlib import Path
from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.files.atomic_write import require_own
from adxl_ros.files.stamp_check import BadStamps
from adxl_ros.files.stamps import stamped_rate_hz
from adxl_ros.files.stream_info import NOMINAL_KEYS, nominal_of, StreamInfo, uncalibrated
from adxl_ros.model.constants import AXES
from adxl_ros.model.sensor import Sensor, to_nominal_mps2, to_volts
from adxl_ros.report.quantities import column_unit
import numpy as np

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
        """Return the columns of the axes of a sensor, and what they hold, (n, m)."""
        names = self.sensor_columns
        if len(names) < len(sensor.axes):
            raise UserError(
                f'{self.path}: has the axes {self.axes}, but the sensor '
                f'{sensor.serial} has {sensor.axes}; name its own parameter file'
            )
        names = names[: len(sensor.axes)]
        return names, np.column_stack([self.columns[name] for name in names])

    def _nominal(self, sensor: Sensor) -> Sensor:
        """Return a sensor with the nominal values that the recording states."""
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


def recorded_nominal(sensor: Sensor, recording: Recording) -> Sensor:
    """Return the nominal sensor of a recording, with the sample rate of its stamps."""
    nominal = nominal_of(sensor, recording.stream_info, recording.axes, recording.rate_hz)
    return replace(
        nominal, provenance={**nominal.provenance, 'rate_from': Path(recording.path).name}
    )
