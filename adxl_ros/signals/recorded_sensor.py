# SPDX-License-Identifier: Apache-2.0

"""The sensor of a recording: its parameter file, and what is measured where the file is silent."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from adxl_ros.files import parameter_file
from adxl_ros.files.recording_columns import Recording, VOLTS
from adxl_ros.model.sensor import Sensor, with_axes
from adxl_ros.signals import measured_values
import numpy as np


def load_sensor(params: str | None, read: Recording) -> Sensor:
    """Load the parameter file of a recording."""
    if params is None:
        is_of_nominal = read.sensor_columns[0] in VOLTS or \
            read.stream_info.nominal_values(read.axes)
        params = str(parameter_file.nominal_path() if is_of_nominal
                     else parameter_file.any_imu_path())
    return parameter_file.load(params, may_measure=True)


def measure_unstated(sensor: Sensor, read: Recording) -> tuple[Sensor, list[str]]:
    """Measure from a recording its rate and what the parameter file leaves out."""
    name = Path(read.path).name
    if len(read) > 1:
        sensor = replace(sensor, rate_hz=round(read.rate_hz, 6),
                         provenance={**sensor.provenance, 'rate_from': name})
    if not sensor.unstated:
        return sensor, []
    unit = sensor if sensor.effects else with_axes(sensor, read.axes)
    if 'noise_density_g_per_rthz' in sensor.unstated:
        unit = replace(unit, provenance={**unit.provenance, 'noise_from': name})
    values = measured_values.measure(read.time_s, read.volts(unit), unit)
    return (measured_values.with_measured_values(unit, values),
            measured_values.describe(unit, values))


def listed(measured: list[str]) -> list[str]:
    """Return the lines of `measure_unstated` below a heading; none where nothing is measured."""
    if not measured:
        return []
    return ['', 'Measured, as no parameter file states it:', *(f'  {line}' for line in measured)]


class BeyondRange:
    """Counts the readings of a recording that are beyond the stated range of its sensor."""

    def __init__(self) -> None:
        self._samples, self._largest_g = 0, 0.0

    def add(self, volts: np.ndarray, sensor: Sensor) -> None:
        """
        Count further samples.

        volts: samples, V, (n, m).
        """
        readings_g = np.abs(volts - sensor.nominal_zero_g_v) / sensor.nominal_scale_v_per_g
        beyond = readings_g > sensor.range_g
        if beyond.any():
            self._samples += int(beyond.any(axis=1).sum())
            self._largest_g = max(self._largest_g, float(readings_g[beyond].max()))

    def describe(self, sensor: Sensor) -> str:
        """Return the count for people; '' where no reading is beyond the range."""
        if not self._samples:
            return ''
        return (f'{self._samples} samples are beyond the stated range of ±{sensor.range_g:g} g '
                f'(largest reading {self._largest_g:.3g} g); check sensor.range_g')
