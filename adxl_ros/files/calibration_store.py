# SPDX-License-Identifier: Apache-2.0

"""
The calibration store: a folder for each sensor, and in it a parameter file for each calibration.

Its name is serial number, date (UTC) and the beginning of the data's SHA-256, such as
`17-20261121T143000Z-5f3a09c1`, so that the files of a sensor sort by date. Files that people add
count by the date inside. The population of a fleet is a file of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, fields
from datetime import datetime, timezone
import hashlib
import math
import os
from pathlib import Path
import re
from typing import NamedTuple
from urllib.parse import quote

from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file
from adxl_ros.files.atomic_write import AnyPath, write_text
from adxl_ros.files.parameter_file import compose
from adxl_ros.files.stream_info import NO_SERIAL
from adxl_ros.model.population import PooledCoefficient, Population
from adxl_ros.model.sensor import Sensor
from adxl_ros.process import command, package_version
import yaml

_DATE = '%Y%m%dT%H%M%SZ'  # Date in file names, ISO 8601 basic format
_DATE_LETTERS = 16  # Length of such a date
_OLDEST = datetime.min.replace(tzinfo=timezone.utc)
"""Date of a calibration without a date, which sorts first."""
_MAX_NAME = 120
"""Characters of a serial number in a file name (chosen: file systems permit 255 bytes)."""
_HASH_DIGITS = 8
"""Digits of the data's SHA-256 in an id (chosen: enough for calibrations of one second)."""
FORMAT = 1  # Version of the format. A file of another version is refused
_DIGITS = 9  # Significant digits of the values (chosen: far below any uncertainty)
_HEAD = """\
# Mean and spread of each coefficient over the units of a fleet, written by fleet.
# prediction_std is the standard deviation of a further unit about the mean.
# Use it: {command}
"""
"""Comments at the begin of the file."""


class StoredCalibration(NamedTuple):
    """One calibration of a sensor."""

    path: Path
    sensor: Sensor


class SensorHistory(NamedTuple):
    """All calibrations of a sensor."""

    calibrations: list[StoredCalibration]  # Oldest first; those without a date come before them
    refused: list[str]  # Why further files cannot be used


class Choice(NamedTuple):
    """The calibration to use."""

    path: Path | None  # Its file; None if there is none
    refused: list[str]  # Why newer or unreadable files are not used


def default_folder() -> Path:
    """Return $ROS_HOME/adxl_ros/calibrations; $ROS_HOME is ~/.ros where it is not set."""
    return Path(os.environ.get('ROS_HOME') or '~/.ros').expanduser() / 'adxl_ros' / 'calibrations'


def calibration_id(sensor: Sensor) -> str:
    """Return the id of a calibration; one without an id gets it from date and data."""
    return sensor.provenance.get('id') or f'{sensor.serial}-{_version(sensor)}'


def _version(sensor: Sensor) -> str:
    """Return date and hash, which differ between the calibrations of a sensor and sort by date."""
    date = date_of(sensor)
    text = f'{date:{_DATE}}' if date else '00000000T000000Z'
    checksum = sensor.provenance.get('data_sha256', '')[:_HASH_DIGITS]
    return f'{text}-{checksum}' if checksum else text


def date_of(sensor: Sensor) -> datetime | None:
    """Return the date of a calibration, UTC; None without one."""
    return date_in(sensor.provenance.get('date', ''))


def date_in(text: str) -> datetime | None:
    """Return the date of a provenance, UTC; None where the text is none."""
    try:
        date = datetime.fromisoformat(text.replace('Z', '+00:00').replace('+0000', '+00:00'))
    except ValueError:
        return None
    return date.astimezone(timezone.utc) if date.tzinfo else date.replace(tzinfo=timezone.utc)


def sensor_folder(folder: AnyPath, serial: str) -> Path:
    """Return the folder of a sensor."""
    return Path(folder) / file_name(serial)


def file_name(text: str) -> str:
    """Return a text as the name of a file: quoted by %, and hashed where it is too long."""
    quoted = quote(text, safe=" #+,;=@()[]'")
    if not quoted.strip('.'):
        quoted = quoted.replace('.', '%2E')
    if len(quoted) <= _MAX_NAME:
        return quoted
    return f'{quoted[:_MAX_NAME]}-{hashlib.sha256(text.encode()).hexdigest()[:16]}'


def put(folder: AnyPath, sensor: Sensor, comments: Iterable[str] = ()) -> Path | None:
    """Store a calibration."""
    if sensor.serial == NO_SERIAL:
        return None
    folder_of_sensor = sensor_folder(folder, sensor.serial)
    try:
        folder_of_sensor.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(
            f'{folder_of_sensor}: cannot be made: {error.strerror}; name another store'
        ) from None
    path = folder_of_sensor / f'{file_name(sensor.serial)}-{_version(sensor)}.yaml'
    parameter_file.save(path, sensor, comments)
    return path


def history(folder: AnyPath, serial: str) -> SensorHistory:
    """Return the calibrations of a sensor by date."""
    calibrations = []
    refused = []
    for path in sorted(sensor_folder(folder, serial).glob('*.yaml')):
        try:
            sensor = parameter_file.load(path)
            if sensor.serial != serial:
                raise UserError(f'{path}: is of the unit {sensor.serial}, not {serial}')
        except UserError as error:
            refused.append(str(error))
            continue
        calibrations.append(StoredCalibration(path, sensor))
    calibrations.sort(key=lambda stored: date_of(stored.sensor) or _OLDEST)
    return SensorHistory(calibrations, refused)


def newest(folder: AnyPath, serial: str, check: Callable[[Sensor], None]) -> Choice:
    """Return the newest calibration of a sensor that can be used."""
    calibrations, refused = history(folder, serial)
    for path, sensor in reversed(calibrations):
        try:
            check(sensor)
        except UserError as error:
            refused.append(f'{path}: {error}')
            continue
        return Choice(path, refused)
    return Choice(None, refused)


def newer(folder: AnyPath, sensor: Sensor) -> Path | None:
    """Return the newest file of a sensor if its name has a later date; no file is read."""
    begin = f'{file_name(sensor.serial)}-'
    files = [
        path
        for path in sensor_folder(folder, sensor.serial).glob('*.yaml')
        if re.match(r'\d{8}T\d{6}Z', path.name.removeprefix(begin))
    ]
    last = max(files, default=None)
    date = date_of(sensor)
    is_newer = last and (
        not date or last.name.removeprefix(begin)[:_DATE_LETTERS] > f'{date:{_DATE}}'
    )
    return last if is_newer else None


def sha256(paths: Sequence[AnyPath]) -> str:
    """
    Return the SHA-256 of recordings, hexadecimal; for one file, that of `sha256sum`.

    For several files, those of a directory by name, it is that of their checksums, one a line.
    """
    files: list[Path] = []
    for path in map(Path, paths):
        files += sorted(p for p in path.rglob('*') if p.is_file()) if path.is_dir() else [path]
    checksums = []
    for path in files:
        checksum = hashlib.sha256()
        try:
            with open(path, 'rb') as file:
                while block := file.read(1 << 20):
                    checksum.update(block)
        except OSError as error:
            raise UserError(f'{path}: cannot be read: {error.strerror}') from None
        checksums.append(checksum.hexdigest())
    return (
        checksums[0]
        if len(checksums) == 1
        else hashlib.sha256(''.join(f'{line}\n' for line in checksums).encode()).hexdigest()
    )


def write_population(path: AnyPath, population: Population) -> None:
    """Write a population."""
    contents = {
        'format': FORMAT,
        'version': package_version(),
        'coefficients': {
            name: {
                **{key: float(f'{value:.{_DIGITS}g}') for key, value in asdict(pooled).items()},
                'units': pooled.units,
            }
            for name, pooled in population.coefficients.items()
        },
    }
    text = yaml.safe_dump(contents, sort_keys=False, allow_unicode=True, default_flow_style=None)
    use = command('fit', f'NEW.mcap --prior {Path(path).name} -o unit.yaml')
    write_text(path, _HEAD.format(command=use) + text)


def read_population(path: AnyPath) -> Population:
    """Read and check a population."""
    node = compose(path)
    contents = yaml.constructor.SafeConstructor().construct_document(node) if node else None
    keys = contents if isinstance(contents, dict) else {}
    coefficients = keys.get('coefficients')
    if keys.get('format') != FORMAT or not isinstance(coefficients, dict):
        raise UserError(
            f'{path}: no population of format {FORMAT}; give the population.yaml that fleet writes'
        )
    pooled = {}
    for name, values in coefficients.items():
        try:
            pooled[str(name)] = PooledCoefficient(**values)
            is_right = all(map(math.isfinite, values.values())) and values['prediction_std'] > 0
        except TypeError:
            is_right = False
        if not is_right:
            raise UserError(
                f'{path}: coefficients.{name}: {values!r} is no set of numbers '
                f'{", ".join(each.name for each in fields(PooledCoefficient))}, with '
                'a positive prediction_std'
            )
    return Population(Path(path).name, pooled)
