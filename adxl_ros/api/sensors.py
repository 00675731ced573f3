# SPDX-License-Identifier: Apache-2.0

"""Sensors of the front door: datasheets, parameter files, and what a recording shows of them."""

from __future__ import annotations

from collections.abc import Sequence
import os
from typing import Any, NamedTuple

from adxl_ros.files import parameter_file
from adxl_ros.files.recording_columns import NO_UNIT, Recording
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.recorded_sensor import load_sensor, measure_unstated

SensorInput = Any
"""A Sensor, a result that has one (`Fit`, `Gap`), a datasheet's name or the path of a file."""


def load(name: str | os.PathLike) -> Sensor:
    """
    Load a sensor.

    Parameters
    ----------
    name
        Name of a datasheet, such as 'adxl203' or 'mpu6050', or the path of a parameter file.

    Returns
    -------
    Sensor
        The sensor. Rate, noise, filter and range that the file leaves out are measured by the
        verbs, and their results say so.

    Raises
    ------
    UserError
        The file cannot be read, or a value is missing or out of bounds.

    """
    return parameter_file.load(name, may_measure=True)


class GivenSensor(NamedTuple):
    """The sensor of a recording."""

    sensor: Sensor  # With the rate of the recording, and with what was measured
    file: str  # What names it on a command line; '' for the nominal sensor
    file_name: str  # Name of its parameter file, that of the nominal sensor or any IMU, too
    measured: Sequence[str]  # What was measured, as no parameter file states it, for people


def sensor_of(given: SensorInput | None, read: Recording, has_noise: bool = True) -> GivenSensor:
    """
    Return the sensor of a recording; None is the one that the recording most likely has.

    has_noise: whether what is not stated can be measured; else it stays unstated.
    """
    stated = as_input(given)
    sensor = load_sensor(stated, read)
    measured: Sequence[str] = []
    if has_noise:
        sensor, measured = measure_unstated(sensor, read)
    if isinstance(stated, Sensor):
        stated = '' if sensor.serial == NO_UNIT else f'{sensor.serial}.yaml'
    usual = parameter_file.usual_path(read.is_of_nominal)
    return GivenSensor(sensor, stated or '', os.path.basename(stated or usual), measured)


def as_input(given: SensorInput | None) -> Sensor | str | None:
    """Return a sensor itself, or the name of its file; results hold their sensor."""
    sensor = getattr(given, 'sensor', given)
    return sensor if sensor is None or isinstance(sensor, Sensor) else os.fspath(sensor)
