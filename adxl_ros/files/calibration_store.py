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

"""
The store of calibrations: one folder, in it one a unit by serial number, in it one file by id.

An id is serial, date (UTC) and the beginning of the data's hash, `17-20261121T143000Z-5f3a09c1`,
and names its file, so that the files of a unit sort by date. They are parameter files, written
as a whole and never changed; others that are put beside them count by the date inside.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from datetime import datetime, timezone
from functools import lru_cache
import hashlib
import os
from pathlib import Path
from urllib.parse import quote

from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file
from adxl_ros.files.stream_info import NO_UNIT
from adxl_ros.model.sensor import Sensor

_DATE = '%Y%m%dT%H%M%SZ'
_OLDEST = datetime.min.replace(tzinfo=timezone.utc)
_LONGEST = 120
"""Characters of a serial number in names, which file systems end at 255."""


def default_folder() -> Path:
    """Return $ROS_HOME/adxl_ros/calibrations; $ROS_HOME is ~/.ros where it is not set."""
    home = os.environ.get('ROS_HOME') or os.path.join(os.path.expanduser('~'), '.ros')
    return Path(home) / 'adxl_ros' / 'calibrations'


def calibration_id(sensor: Sensor) -> str:
    """Return the id of a calibration; of one of an older version what serves for it."""
    return sensor.provenance.get('id') or f'{sensor.serial}-{_version(sensor)}'


def _version(sensor: Sensor) -> str:
    """Return date and hash, which tell the calibrations of a unit apart and sort by date."""
    made = date_of(sensor)
    when = f'{made:{_DATE}}' if made else '00000000T000000Z'
    return '-'.join(filter(None, (when, sensor.provenance.get('data_sha256', '')[:8])))


def date_of(sensor: Sensor) -> datetime | None:
    """Return when a calibration was made, UTC; None where its file does not say."""
    try:
        made = datetime.fromisoformat(sensor.provenance.get('date', '').replace('Z', '+00:00'))
    except ValueError:
        return None
    return made.astimezone(timezone.utc) if made.tzinfo else made.replace(tzinfo=timezone.utc)


def unit_folder(folder: str | os.PathLike, serial: str) -> Path:
    """Return the folder of a unit."""
    return Path(folder) / _name(serial)


def _name(serial: str) -> str:
    """Quote by % what a name cannot have; a serial number that is too long is cut and hashed."""
    quoted = quote(serial, safe=" #+,;=@()[]'")
    if not quoted.strip('.'):
        quoted = quoted.replace('.', '%2E')
    if len(quoted) <= _LONGEST:
        return quoted
    return f'{quoted[:_LONGEST]}-{hashlib.sha256(serial.encode()).hexdigest()[:16]}'


def put(folder: str | os.PathLike, sensor: Sensor, comments: Iterable[str] = ()) -> Path | None:
    """
    Keep a calibration.

    Parameters
    ----------
    folder
        The store; made if it is not there.
    sensor
        A fitted unit with provenance.
    comments
        Lines for people, put before the parameters.

    Returns
    -------
    Path
        The file; None for the serial number `nominal`, which is no unit in particular.

    Raises
    ------
    UserError
        The store cannot be written.

    """
    if sensor.serial == NO_UNIT:
        return None
    own = unit_folder(folder, sensor.serial)
    try:
        own.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f'{own}: cannot be made: {error.strerror}; name another store') from None
    path = own / _file_name(sensor)
    parameter_file.save(path, sensor, comments)
    return path


def history(folder: str | os.PathLike, serial: str) -> tuple[list[tuple[Path, Sensor]], list[str]]:
    """
    Return the calibrations of a unit by date, oldest first, and why others cannot be read.

    Files whose date is missing come first.
    """
    found, refused = [], []
    for path in sorted(unit_folder(folder, serial).glob('*.yaml')):
        try:
            sensor = parameter_file.load(path)
            if sensor.serial != serial:
                raise UserError(f'{path}: is of the unit {sensor.serial}, not {serial}')
        except UserError as error:
            refused.append(str(error))
            continue
        found.append((path, sensor))
    return sorted(found, key=lambda one: date_of(one[1]) or _OLDEST), refused


def newest(folder: str | os.PathLike, serial: str, fits: Callable[[Sensor], None]
           ) -> tuple[Path | None, list[str]]:
    """
    Find the newest calibration of a unit.

    Parameters
    ----------
    folder, serial
        Where, and of which unit.
    fits
        Raises `UserError` for one that cannot be used.

    Returns
    -------
    tuple
        Its file, None if there is none; and why newer ones, or unreadable ones, were passed over.

    """
    found, refused = history(folder, serial)
    for path, sensor in reversed(found):
        try:
            fits(sensor)
        except UserError as error:
            refused.append(f'{path}: {error}')
            continue
        return path, refused
    return None, refused


def newer(folder: str | os.PathLike, sensor: Sensor) -> Path | None:
    """
    Return the newest file of a unit if it is of a later date than a calibration.

    This is quick: the names that the store gives say the date, other files are read once.
    """
    dated = {path: _dated(path, sensor.serial)
             for path in unit_folder(folder, sensor.serial).glob('*.yaml')}
    last = max(dated, key=lambda path: (dated[path], path), default=None)
    return last if last is not None and dated[last] > _second_of(sensor) else None


def _dated(path: Path, serial: str) -> datetime:
    named = path.name.removeprefix(f'{_name(serial)}-').split('-')[0].removesuffix('.yaml')
    with suppress(ValueError):
        return datetime.strptime(named, _DATE).replace(tzinfo=timezone.utc)
    try:
        return _date_inside(path, path.stat().st_mtime_ns, serial)
    except OSError:
        return _OLDEST


@lru_cache(maxsize=256)
def _date_inside(path: Path, _: int, serial: str) -> datetime:
    """Return the date of a file that was named by hand; it is read again when it has changed."""
    try:
        sensor = parameter_file.load(path)
    except UserError:
        return _OLDEST
    return _second_of(sensor) if sensor.serial == serial else _OLDEST


def _second_of(sensor: Sensor) -> datetime:
    """Return the date as names have it, which end at seconds."""
    return (date_of(sensor) or _OLDEST).replace(microsecond=0)


def _file_name(sensor: Sensor) -> str:
    return f'{_name(sensor.serial)}-{_version(sensor)}.yaml'
