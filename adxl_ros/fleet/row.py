# SPDX-License-Identifier: Apache-2.0

"""
A row of a fleet's table: its columns, and the recipe that it follows from.

A row is a dict with a value for each column; None stands for what is not known. Columns with
`_x_`, `_y_` or `_z_` in their name are of one axis of the sensor. The client sends the recipe to
each worker once, with the texts of all parameter files: a worker needs no access to them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import suppress
import csv
from dataclasses import dataclass
from datetime import datetime
from functools import lru_cache
import hashlib
import json
import math
from pathlib import Path
import re
from typing import Any, NamedTuple

from adxl_ros.errors import one_line, UserError
from adxl_ros.files import calibration_store, parameter_file
from adxl_ros.files.column_mapping import AS_IT_IS, ReadingOptions
from adxl_ros.process import code_version
import yaml

Row = dict[str, Any]  # The values of one recording by column

TABLE = 'fleet.parquet'  # Name of the table
PAGE = 'fleet.html'  # Name of the page beside the table
POPULATION = 'population.yaml'  # Name of the file of the population beside the table

OUTCOMES = ('done', 'refused', 'crashed')
"""Values of `outcome`: the tasks gave results; the recording was refused, and `refusal` has the
reason; the worker ended or failed at each attempt."""
NOISE = (
    ('n', 'white noise N', 'mps2_per_rthz', 'm/s²/√Hz'),
    ('b', 'bias instability B', 'mps2', 'm/s²'),
    ('k', 'random walk K', 'mps2_per_rts', 'm/s²/√s'),
)
"""Terms of the noise: letter, name, unit in the names of columns, and unit."""
TASKS = ('check', 'noise', 'fit', 'diagnose')  # All tasks, in the order in which they run


class Column(NamedTuple):
    """One column of the table."""

    name: str  # Its name, which ends in the unit where there is one
    # `text`, `float`, `integer`, `flag`, `time` (UTC), `texts` or `groups` (lists of texts)
    kind: str
    unit: str  # Its unit; empty for none
    meaning: str  # What it holds, for people


def _columns() -> Iterator[Column]:
    """Read the columns, whose table has the fields of `Column`."""
    text = Path(__file__).with_name('columns.csv').read_text(encoding='utf-8')
    for row in csv.DictReader(text.splitlines()):
        yield Column(**row)


COLUMNS = tuple(_columns())  # All columns, in the order of the table


def empty_row() -> Row:
    """Return a row without any value."""
    return {column.name: [] if column.kind in ('texts', 'groups') else None for column in COLUMNS}


def finite(value: Any) -> float | None:
    """Return a number as a float; None for NaN, infinity and None."""
    return float(value) if value is not None and math.isfinite(value) else None


def reason_kind(row: Row) -> str:
    """Return a refusal without the name of its recording and without numbers."""
    text = row['refusal'] or row['outcome']
    for part in (row['url'], row['url'].rpartition('/')[2]):
        text = text.replace(part, 'FILE') if part else text
    return re.sub(r'[-+]?\d[\d.,]*', '#', text)


@lru_cache(maxsize=1)
def arrow_schema() -> Any:
    """Return the columns as a schema of pyarrow, with unit and meaning as metadata."""
    import pyarrow as pa

    text = pa.string()
    types = {
        'text': text,
        'float': pa.float64(),
        'integer': pa.int64(),
        'flag': pa.bool_(),
        'time': pa.timestamp('us', 'UTC'),
        'texts': pa.list_(text),
        'groups': pa.list_(pa.list_(text)),
    }
    return pa.schema(
        [
            pa.field(
                column.name,
                types[column.kind],
                metadata={'unit': column.unit, 'meaning': column.meaning},
            )
            for column in COLUMNS
        ]
    )


def as_table(rows: Iterable[Row]) -> Any:
    """Return rows, whose times are texts of ISO 8601 with an offset, as a table of pyarrow."""
    import pyarrow as pa

    times = [column.name for column in COLUMNS if column.kind == 'time']
    return pa.Table.from_pylist(
        [
            {**row, **{name: datetime.fromisoformat(row[name]) for name in times if row[name]}}
            for row in rows
        ],
        arrow_schema(),
    )


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
    store: dict[str, list[ParameterText]]  # The stored calibrations, by serial number
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
        return max(
            (stored for stored in self.store.get(serial, ()) if '' < stored.date <= date),
            key=lambda stored: stored.date,
            default=_NOMINAL,
        )

    def digest(self, chosen: ParameterText, serial: str) -> str:
        """Return the SHA-256 of all that a row follows from, beside the content."""
        return sha256_of(chosen.text, serial, self.tasks, repr(self.reading), self.code)


def sha256_of(*values: object) -> str:
    """Return the SHA-256 of values as JSON."""
    return hashlib.sha256(json.dumps(values).encode()).hexdigest()


def as_date(text: str) -> str:
    """Return a date of ISO 8601 in UTC; empty if the text is none. UTC is the usual zone."""
    date = calibration_store.date_in(text.strip())
    return date.isoformat() if date else ''


def task_names(text: str) -> tuple[str, ...]:
    """Return the tasks that a text names with commas, in the order in which they run."""
    chosen = [name.strip() for name in text.split(',')]
    for name in chosen:
        if name not in TASKS:
            raise UserError(f'--do {text}: {name!r} is no task; tasks: {", ".join(TASKS)}')
    return tuple(name for name in TASKS if name in chosen)


def make_recipe(
    tasks: Iterable[str],
    params: str | None,
    stated: Iterable[str],
    store: str | None,
    reading: ReadingOptions,
) -> Recipe:
    """Read all parameter files of a run."""
    return Recipe(
        tasks=tuple(tasks),
        code=code_version(),
        params=_read(params) if params else None,
        stated={name: _read(name) for name in set(stated) if name},
        store=_stored(store) if store else {},
        reading=reading,
    )


def _read(name: str) -> ParameterText:
    """Read and check a parameter file."""
    path = parameter_file.installed_path(name)
    sensor = parameter_file.load(path, may_measure=True)
    date = calibration_store.date_of(sensor)
    return ParameterText(
        Path(name).name,
        Path(path).read_text(encoding='utf-8'),
        calibration_store.calibration_id(sensor) if sensor.effects else '',
        date.isoformat() if date else '',
    )


def _stored(folder: str) -> dict[str, list[ParameterText]]:
    """Return the calibrations of a store by serial number; a file without one is left out."""
    stored: dict[str, list[ParameterText]] = {}
    try:
        for path in sorted(Path(folder).glob('*/*.yaml')):
            text = path.read_text(encoding='utf-8')
            with suppress(yaml.YAMLError, KeyError, TypeError, AttributeError):
                keys = yaml.load(text, getattr(yaml, 'CSafeLoader', yaml.SafeLoader))['/**'][
                    'ros__parameters'
                ]
                made = keys['provenance']
                stored.setdefault(keys['sensor']['serial'], []).append(
                    ParameterText(path.name, text, made['id'], as_date(made['date']))
                )
    except (OSError, ValueError) as error:
        raise UserError(f'{folder}: cannot be read: {one_line(error)}') from None
    return stored
