# SPDX-License-Identifier: Apache-2.0

"""
What all tasks of a run share, and the calibration and key of each recording.

The client sends it to each worker once, with the texts of all parameter files. A worker needs no
access to them.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime, timedelta
from functools import lru_cache
import hashlib
import json
from pathlib import Path
from typing import NamedTuple

from adxl_ros.errors import one_line, UserError
from adxl_ros.files import calibration_store, parameter_file
from adxl_ros.files.column_mapping import AS_IT_IS, ReadingOptions
from adxl_ros.files.stream_info import NO_UNIT
from adxl_ros.package_version import package_version
import yaml

TASKS = ('check', 'noise', 'fit', 'diagnose')
"""All tasks, in the order in which they run."""

_NOT_OF_TASKS = ('links', 'nodes', 'tools', 'workers.py')
"""Folders and files of the package whose code changes no row."""
_CODE_OF_TASKS = ('recipe', 'row', 'staging', 'task')
"""Files of this folder whose code changes a row."""
_CACHED_CALIBRATIONS = 8192
"""Stored calibrations that are kept after they were read. Chosen: 200 units for years."""


class ParameterText(NamedTuple):
    """A parameter file by its content."""

    name: str  # Its name, for messages
    text: str  # Its content; empty for the nominal sensor
    calibration_id: str = ''  # Id of the calibration; empty for none
    date: str = ''  # Date of the calibration, ISO 8601, UTC; empty if unknown


_NOMINAL = ParameterText('the nominal sensor', '')
"""Stands for the sensor that a tool takes without a parameter file."""


@dataclass(frozen=True)
class Recipe:
    """What all tasks of a run share."""

    tasks: tuple[str, ...]  # Names of the tasks
    code: str  # SHA-256 of the code
    # Parameter file of all recordings; None takes the calibration of each
    params: ParameterText | None
    stated: dict[str, ParameterText]  # Parameter files that a manifest names, by their names there
    # Names and texts of the calibrations, by the folder of the unit in the store
    store: dict[str, tuple[tuple[str, str], ...]]
    reading: ReadingOptions = AS_IT_IS  # How recordings are to be read

    def parameters_of(self, serial: str, date: str, stated: str) -> ParameterText:
        """
        Return the parameter file of a recording.

        It is that of the manifest, else that of the command line, else the newest calibration of
        the unit that is not younger than the recording, else the nominal sensor.
        """
        if stated:
            return self.stated[stated]
        if self.params is not None:
            return self.params
        if not date:
            return _NOMINAL
        files = self.store.get(calibration_store.unit_folder('', serial).name, ()) \
            if serial not in ('', NO_UNIT) else ()
        read = [entry for name, text in files if (entry := _stored_parameters(name, text))]
        valid = [parameters for unit, parameters in read
                 if unit == serial and parameters.date and parameters.date <= date]
        return max(valid, key=lambda parameters: parameters.date, default=_NOMINAL)

    def digest(self, chosen: ParameterText, serial: str) -> str:
        """Return the SHA-256 of all that a row follows from, beside the content."""
        return sha256_of(chosen.text, serial, self.tasks, repr(self.reading), self.code)


def sha256_of(*values: object) -> str:
    """Return the SHA-256 of values as JSON."""
    return hashlib.sha256(json.dumps(values).encode()).hexdigest()


def age_days(chosen: ParameterText, date: str) -> float | None:
    """Return the age of a calibration at a date, days."""
    if not (chosen.date and date):
        return None
    begun, calibrated = map(datetime.fromisoformat, (date, chosen.date))
    return (begun - calibrated) / timedelta(days=1)


def task_names(text: str) -> tuple[str, ...]:
    """Return the tasks that a text names with commas, in the order in which they run."""
    chosen = [name.strip() for name in text.split(',')]
    for name in chosen:
        if name not in TASKS:
            raise UserError(f'--do {text}: {name!r} is no task; tasks: {", ".join(TASKS)}')
    return tuple(name for name in TASKS if name in chosen)


def make_recipe(tasks: Iterable[str], params: str | None, stated: Iterable[str],
                store: str | None, reading: ReadingOptions) -> Recipe:
    """Read all parameter files of a run."""
    return Recipe(tuple(tasks), code_version(),
                  _read(params) if params else None,
                  {name: _read(name) for name in set(stated) if name},
                  _stored(store) if store else {}, reading)


def _read(name: str) -> ParameterText:
    """Read and check a parameter file."""
    path = parameter_file.installed_path(name)
    sensor = parameter_file.load(path, may_measure=True)
    date = calibration_store.date_of(sensor)
    return ParameterText(Path(name).name, Path(path).read_text(encoding='utf-8'),
                         calibration_store.calibration_id(sensor) if sensor.effects else '',
                         date.isoformat() if date else '')


def _stored(folder: str) -> dict[str, tuple[tuple[str, str], ...]]:
    """Return names and texts of all calibrations of a store, by the folder of the unit."""
    root = Path(folder)
    try:
        return {unit.name: tuple((path.name, path.read_text(encoding='utf-8'))
                                 for path in sorted(unit.glob('*.yaml')))
                for unit in sorted(root.iterdir()) if unit.is_dir()} if root.is_dir() else {}
    except (OSError, ValueError) as error:
        raise UserError(f'{folder}: cannot be read: {one_line(error)}') from None


@lru_cache(maxsize=_CACHED_CALIBRATIONS)
def _stored_parameters(name: str, text: str) -> tuple[str, ParameterText] | None:
    """Return serial number and content of a stored file; None for one that cannot be used."""
    try:
        keys = yaml.load(text, getattr(yaml, 'CSafeLoader', yaml.SafeLoader)
                         )['/**']['ros__parameters']
        provenance = keys['provenance']
        date = calibration_store.date_in(provenance['date'])
        return keys['sensor']['serial'], ParameterText(
            name, text, provenance['id'], date.isoformat() if date else '')
    except (yaml.YAMLError, KeyError, TypeError, AttributeError):
        return None


@lru_cache(maxsize=1)
def code_version() -> str:
    """Return the SHA-256 of the version, the code and the parameter files that make a row."""
    root = Path(__file__).resolve().parents[1]
    hashed = hashlib.sha256(package_version().encode())
    for path in sorted(root.rglob('*.py')):
        folder = path.relative_to(root).parts[0]
        if folder in _NOT_OF_TASKS or (folder == 'fleet' and path.stem not in _CODE_OF_TASKS):
            continue
        hashed.update(str(path.relative_to(root)).encode() + path.read_bytes())
    for path in (parameter_file.nominal_path(), parameter_file.any_imu_path()):
        hashed.update(path.read_bytes())
    return hashed.hexdigest()
