# SPDX-License-Identifier: Apache-2.0

"""
The calibration store: a folder with one folder for each unit, and in it one file by id.

An id is serial number, date (UTC) and the beginning of the data's SHA-256, such as
`17-20261121T143000Z-5f3a09c1`. It names the file, so that the files of a unit sort by date. The
files are parameter files, written as a whole and never changed. Files that people add count by
the date inside.

A file of its own beside them has the population of a fleet.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, fields
from datetime import datetime, timezone
import hashlib
import math
import os
from pathlib import Path
import re
from typing import Any, NamedTuple
from urllib.parse import quote

from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file
from adxl_ros.files.atomic_write import write_text
from adxl_ros.files.parameter_file import compose
from adxl_ros.files.recording_columns import NO_UNIT
from adxl_ros.model.population import PooledCoefficient, Population
from adxl_ros.model.sensor import Sensor
from adxl_ros.process import package_version
import yaml

_DATE = '%Y%m%dT%H%M%SZ'
"""Date in file names, ISO 8601 basic format."""

_OLDEST = datetime.min.replace(tzinfo=timezone.utc)
"""Date of a calibration without a date, which sorts first."""

_HASH_DIGITS = 8
"""Digits of the data's SHA-256 in an id (chosen: enough for calibrations of one second)."""

_MAX_NAME = 120
"""Characters of a serial number in a file name (chosen: file systems permit 255 bytes)."""

_DATE_LETTERS = 16
"""Letters of such a date."""


class StoredCalibration(NamedTuple):
    """One calibration of a unit."""

    path: Path  # Its file
    sensor: Sensor  # The fitted sensor


class UnitHistory(NamedTuple):
    """All calibrations of a unit."""

    calibrations: list[StoredCalibration]  # Oldest first; those without a date come before them
    refused: list[str]  # Why further files cannot be used


class Choice(NamedTuple):
    """The calibration to use."""

    path: Path | None  # Its file; None if there is none
    refused: list[str]  # Why newer or unreadable files are not used


def default_folder() -> Path:
    """Return $ROS_HOME/adxl_ros/calibrations; $ROS_HOME is ~/.ros where it is not set."""
    home = os.environ.get('ROS_HOME') or os.path.join(os.path.expanduser('~'), '.ros')
    return Path(home) / 'adxl_ros' / 'calibrations'


def calibration_id(sensor: Sensor) -> str:
    """Return the id of a calibration; one without an id gets it from date and data."""
    return sensor.provenance.get('id') or f'{sensor.serial}-{_version(sensor)}'


def _version(sensor: Sensor) -> str:
    """Return date and hash, which differ between the calibrations of a unit and sort by date."""
    date = date_of(sensor)
    text = f'{date:{_DATE}}' if date else '00000000T000000Z'
    checksum = sensor.provenance.get('data_sha256', '')[:_HASH_DIGITS]
    return f'{text}-{checksum}' if checksum else text


def date_of(sensor: Sensor) -> datetime | None:
    """Return the date of a calibration, UTC; None where its file states none."""
    return date_in(sensor.provenance.get('date', ''))


def date_in(text: str) -> datetime | None:
    """Return the date of a provenance, UTC; None where the text is none."""
    try:
        date = datetime.fromisoformat(text.replace('Z', '+00:00').replace('+0000', '+00:00'))
    except ValueError:
        return None
    return date.astimezone(timezone.utc) if date.tzinfo else date.replace(tzinfo=timezone.utc)


def unit_folder(folder: str | os.PathLike, serial: str) -> Path:
    """Return the folder of a unit."""
    return Path(folder) / _name(serial)


def _name(serial: str) -> str:
    """Return a serial number as a file name: quoted by %, and hashed where it is too long."""
    quoted = quote(serial, safe=" #+,;=@()[]'")
    if not quoted.strip('.'):
        quoted = quoted.replace('.', '%2E')
    if len(quoted) <= _MAX_NAME:
        return quoted
    return f'{quoted[:_MAX_NAME]}-{hashlib.sha256(serial.encode()).hexdigest()[:16]}'


def put(folder: str | os.PathLike, sensor: Sensor, comments: Iterable[str] = ()) -> Path | None:
    """Store a calibration."""
    if sensor.serial == NO_UNIT:
        return None
    folder_of_unit = unit_folder(folder, sensor.serial)
    try:
        folder_of_unit.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f'{folder_of_unit}: cannot be made: {error.strerror}; name another store'
                        ) from None
    path = folder_of_unit / f'{_name(sensor.serial)}-{_version(sensor)}.yaml'
    parameter_file.save(path, sensor, comments)
    return path


def history(folder: str | os.PathLike, serial: str) -> UnitHistory:
    """Return the calibrations of a unit by date."""
    calibrations, refused = [], []
    for path in sorted(unit_folder(folder, serial).glob('*.yaml')):
        try:
            sensor = parameter_file.load(path)
            if sensor.serial != serial:
                raise UserError(f'{path}: is of the unit {sensor.serial}, not {serial}')
        except UserError as error:
            refused.append(str(error))
            continue
        calibrations.append(StoredCalibration(path, sensor))
    calibrations.sort(key=lambda stored: date_of(stored.sensor) or _OLDEST)
    return UnitHistory(calibrations, refused)


def newest(folder: str | os.PathLike, serial: str, check: Callable[[Sensor], None]) -> Choice:
    """Return the newest calibration of a unit that can be used."""
    calibrations, refused = history(folder, serial)
    for path, sensor in reversed(calibrations):
        try:
            check(sensor)
        except UserError as error:
            refused.append(f'{path}: {error}')
            continue
        return Choice(path, refused)
    return Choice(None, refused)


def newer(folder: str | os.PathLike, sensor: Sensor) -> Path | None:
    """
    Return the newest file of a unit if its name has a later date than a calibration.

    This is quick, because no file is read: files that people add count at the next start.
    """
    begin = f'{_name(sensor.serial)}-'
    names = [path.name for path in unit_folder(folder, sensor.serial).glob('*.yaml')
             if re.match(r'\d{8}T\d{6}Z', path.name.removeprefix(begin))]
    last = max(names, default='').removeprefix(begin)
    date = date_of(sensor)
    is_newer = bool(last) and (not date or last[:_DATE_LETTERS] > f'{date:{_DATE}}')
    return unit_folder(folder, sensor.serial) / f'{begin}{last}' if is_newer else None


_READ_BYTES = 1 << 20
"""Bytes that are read at a time (chosen: bounds the memory for files of any size)."""


def sha256(paths: Sequence[str | os.PathLike]) -> str:
    """
    Return the SHA-256 of recordings, hexadecimal; for one file, that of `sha256sum`.

    For several files it is the SHA-256 of their own checksums, one a line, in the given order.
    The files of a bag's directory are in the order of their names. Paths do not enter.
    """
    files: list[Path] = []
    for path in map(Path, paths):
        files += sorted(p for p in path.rglob('*') if p.is_file()) if path.is_dir() else [path]
    checksums = [_file_sha256(path) for path in files]
    if len(checksums) == 1:
        return checksums[0]
    return hashlib.sha256(''.join(f'{line}\n' for line in checksums).encode()).hexdigest()


def _file_sha256(path: Path) -> str:
    try:
        with open(path, 'rb') as file:
            checksum = hashlib.sha256()
            while block := file.read(_READ_BYTES):
                checksum.update(block)
    except OSError as error:
        raise UserError(f'{path}: cannot be read: {error.strerror}') from None
    return checksum.hexdigest()


FORMAT = 1
"""Version of the format. A file of another version is refused."""
_DIGITS = 9
"""Significant digits of the values (chosen: far below any uncertainty)."""
_HEAD = """\
# Mean and spread of each coefficient over the units of a fleet, written by fleet.
# The name of a coefficient is its column of fleet.parquet, which ends in its unit.
# prediction_std is the standard deviation of a further unit about the mean.
# Use it: ros2 run adxl_ros fit NEW.mcap --prior {name} -o unit.yaml
"""
"""Comments at the begin of the file."""


def write_population(path: str | os.PathLike, population: Population,
                     far_out: Sequence[Mapping[str, Any]]) -> None:
    """Write a population."""
    contents = {
        'format': FORMAT, 'version': package_version(),
        'coefficients': {name: {key: _rounded(value) for key, value in asdict(pooled).items()}
                         for name, pooled in population.coefficients.items()},
        'far_out': [{key: _rounded(value) for key, value in unit.items()} for unit in far_out]}
    text = yaml.safe_dump(contents, sort_keys=False, allow_unicode=True, default_flow_style=None)
    write_text(path, _HEAD.format(name=Path(path).name) + text)


def _rounded(value: Any) -> Any:
    return float(f'{value:.{_DIGITS}g}') if isinstance(value, float) else value


def read_population(path: str | os.PathLike) -> Population:
    """Read and check a population."""
    node = compose(path)
    contents = yaml.constructor.SafeConstructor().construct_document(node) if node else None
    if not isinstance(contents, dict) or contents.get('format') != FORMAT \
            or not isinstance(contents.get('coefficients'), dict):
        raise UserError(f'{path}: no population of format {FORMAT}; give the population.yaml '
                        'that fleet writes')
    names = [field.name for field in fields(PooledCoefficient)]
    pooled = {}
    for name, values in contents['coefficients'].items():
        numbers: list[Any] = [values.get(key) if isinstance(values, dict) else None
                              for key in names]
        if not all(type(each) in (int, float) and math.isfinite(each) for each in numbers) \
                or not values['prediction_std'] > 0:
            raise UserError(f'{path}: coefficients.{name}: {values!r} is no set of numbers '
                            f'{", ".join(names)}, with a positive prediction_std')
        pooled[str(name)] = PooledCoefficient(*numbers)
    return Population(Path(path).name, pooled)
