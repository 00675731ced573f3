# Copyright 2026 the adxl_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""What a recording holds: samples by named column, and the figures that make them readable."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
import re

from adxl_ros.errors import UserError
from adxl_ros.model.constants import AXES
from adxl_ros.model.sensor import Sensor, to_nominal_mps2, to_volts
import numpy as np

TIME = 'time_s'
VOLTS = ('x_v', 'y_v', 'z_v')
ACCEL = ('ax_mps2', 'ay_mps2', 'az_mps2')
JOINTS = {'alpha': 'alpha_rad', 'beta': 'beta_rad', 'shift': 'shift_m'}
REFERENCES = (*JOINTS.values(), 'temperature_c', 'supply_v')
COMMANDS = {'alpha': 'alpha_command_rad', 'beta': 'beta_command_rad'}
"""Where a stage has been told to go: no reference, but it tells when a joint has been moved."""

FORMAT = '1'
"""Version of the recording format, the `format` of sensor_info."""

LIMIT = 1e6
"""Largest magnitude, in the column's unit, of a sensor's output or a reference."""


@dataclass
class Recording:
    """
    Samples of one sensor and of the references beside it.

    Attributes
    ----------
    path
        Where it was read from, for messages.
    time_s
        Stamps of the samples, s since `epoch_ns`, (n,), strictly increasing. Missing samples are
        gaps in it.
    columns
        Arrays (n,) by column name: `x_v ...` in V or `ax_mps2 ...` in m/s² (nominal conversion),
        the references `alpha_rad`, `beta_rad`, `shift_m`, `temperature_c`, `supply_v` with NaN
        where the reference was not sampled, the commands in force `alpha_command_rad`,
        `beta_command_rad` with NaN before the first one, and the other numeric columns of a CSV
        file. Where a file has both, the volts are the sensor's output and m/s² is one of the other
        columns.
    info
        The keys of `sensor_info` and other `# key: value` lines.
    notes : dict
        What reading it showed: `<column>_residual` and `<column>_gap_s` of references that were
        aligned (see `reference_alignment.Track`), `cut` where a damaged recording ended.
    epoch_ns
        What `time_s` counts from, ns. Whole seconds near the first stamp where the stamps of a
        bag count from 1970, because float64 seconds since then resolve only 0.2 µs; else 0.
    done
        Fraction of the file that has been read at the end of these samples.

    """

    path: str
    time_s: np.ndarray
    columns: dict[str, np.ndarray]
    info: dict[str, str] = field(default_factory=dict)
    notes: dict[str, float | str] = field(default_factory=dict)
    epoch_ns: int = 0
    done: float = 1.0

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.time_s)

    @property
    def sensor_columns(self) -> tuple[str, ...]:
        """Names of the columns with the sensor's output, in the order of the axes."""
        return sensor_columns(self.columns, self.path)

    @property
    def axes(self) -> str:
        """Measured axes: x, xy or xyz."""
        return AXES[:len(self.sensor_columns)]

    @property
    def stamp_ns(self) -> np.ndarray:
        """Stamps, ns, (n,) int64: exactly those of a bag's messages."""
        return self.epoch_ns + np.rint(self.time_s * 1e9).astype(np.int64)

    def volts(self, sensor: Sensor) -> np.ndarray:
        """
        Return the ADC volts of the axes of `sensor`, V, (n, m).

        m/s² are converted back by the nominal figures that the recording carries, and by those
        of `sensor` where it carries none.

        Raises
        ------
        UserError
            An axis is missing, or a figure of the recording cannot be read.

        """
        names, data = self._output(sensor)
        return data if names[0] in VOLTS else to_volts(data, self._nominal(sensor))

    def accel_mps2(self, sensor: Sensor) -> np.ndarray:
        """
        Return the specific force by the nominal figures of `sensor`, m/s², (n, m).

        Raises
        ------
        UserError
            An axis is missing, or a figure of the recording cannot be read.

        """
        names, data = self._output(sensor)
        if names[0] in ACCEL and _same_figures(self._nominal(sensor), sensor):
            return data
        return to_nominal_mps2(self.volts(sensor), sensor)

    def _output(self, sensor: Sensor) -> tuple[tuple[str, ...], np.ndarray]:
        names = self.sensor_columns
        if len(names) < len(sensor.axes):
            raise UserError(f'{self.path}: has the axes {self.axes}, but the sensor '
                            f'{sensor.serial} has {sensor.axes}; name its own parameter file')
        names = names[:len(sensor.axes)]
        return names, np.column_stack([self.columns[name] for name in names])

    def _nominal(self, sensor: Sensor) -> Sensor:
        figures = nominal_figures(self.info, self.axes, self.path)
        return replace(sensor, **{name: of_all[:len(sensor.axes)]
                                  for name, of_all in figures.items()})


def nominal_figures(info: Mapping[str, str], axes: str, where: str) -> dict[str, np.ndarray]:
    """
    Read the nominal figures that `info` carries, by the names of `Sensor`'s fields, (m,) each.

    Parameters
    ----------
    info
        The keys of `sensor_info`.
    axes
        The axes that it should have figures of.
    where
        The file or topic, for messages.

    Raises
    ------
    UserError
        A figure cannot be read, or there is not one an axis.

    """
    found = {}
    for key in ('nominal_zero_g_v', 'nominal_scale_v_per_g'):
        if key not in info:
            continue
        words = [word for word in re.split(r'[\s,;\[\]()]+', info[key]) if word]
        try:
            figures = np.array([float(word) for word in words])
        except ValueError:
            figures = np.zeros(0)
        if len(figures) != len(axes) or not np.isfinite(figures).all():
            raise UserError(f'{where}: {key} is {info[key]!r}, expected {len(axes)} numbers, '
                            'one an axis')
        found[key] = figures
    return found


def _same_figures(one: Sensor, other: Sensor) -> bool:
    return (np.array_equal(one.nominal_zero_g_v, other.nominal_zero_g_v)
            and np.array_equal(one.nominal_scale_v_per_g, other.nominal_scale_v_per_g))


def sensor_columns(names: Iterable[str], where: str) -> tuple[str, ...]:
    """
    Return which of `names` are the sensor's output: volts where there are any, else m/s².

    Raises
    ------
    UserError
        There is none, or an axis before the last one is missing.

    """
    names = tuple(names)
    kind = VOLTS if any(name in names for name in VOLTS) else ACCEL
    found = tuple(name for name in kind if name in names)
    listed = ', '.join(names) or 'none'
    if not found:
        raise UserError(f'{where}: no column of a sensor: needs x_v[, y_v][, z_v] or '
                        f'ax_mps2[, ay_mps2][, az_mps2]; the columns are {listed}')
    expected = kind[:len(found)]
    if found != expected:
        lost = next(name for name in expected if name not in found)
        raise UserError(f'{where}: no column {lost} beside {", ".join(found)}; '
                        f'the columns are {listed}')
    return found


def sensor_info(sensor: Sensor) -> dict[str, str]:
    """Return the keys and values of the topic `sensor_info` and of a CSV file's head."""
    return {
        'serial': sensor.serial,
        'axes': sensor.axes,
        'nominal_zero_g_v': _listed(sensor.nominal_zero_g_v),
        'nominal_scale_v_per_g': _listed(sensor.nominal_scale_v_per_g),
        'rate_hz': repr(float(sensor.rate_hz)),
        'format': FORMAT,
    }


def _listed(values: np.ndarray) -> str:
    return ', '.join(map(repr, np.asarray(values, dtype=float).tolist()))


def converted_info(info: Mapping[str, str], sensor: Sensor) -> dict[str, str]:
    """
    Return the info of a recording with `info` after conversion by the figures of `sensor`.

    The nominal figures become the sensor's; whose output it is and how fast stays.
    """
    kept = {key: info[key] for key in ('serial', 'rate_hz') if key in info}
    return {**info, **sensor_info(sensor), **kept}


def concatenate(parts: Iterable[Recording]) -> Recording:
    """
    Join the blocks of one recording; what the last block says of the whole stands.

    A column that only some of the blocks have (text further down in a CSV column) is left out.
    """
    blocks = list(parts)
    last = blocks[-1]
    columns = {name: np.concatenate([block.columns[name] for block in blocks])
               for name in last.columns}
    return replace(last, time_s=np.concatenate([block.time_s for block in blocks]),
                   columns=columns)
