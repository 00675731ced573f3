# SPDX-License-Identifier: Apache-2.0

"""
The columns of a fleet's table: name, kind, unit and meaning, and the file that holds them.

A row is a dict with a value for each column; None stands for what is not known. Columns with
`_x_`, `_y_` or `_z_` in their name are of one axis of the sensor.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from datetime import datetime
from functools import lru_cache
import math
import re
from typing import Any

from adxl_ros.model.constants import AXES

Row = dict[str, Any]
"""The values of one recording by column."""

TABLE = 'fleet.parquet'
"""Name of the table."""
PAGE = 'fleet.html'
"""Name of the page beside the table."""
POPULATION = 'population.yaml'
"""Name of the file of the population beside the table."""
UNITS = 'units.csv'
"""Name of the file with the estimates of each unit, beside the table."""

OUTCOMES = ('done', 'refused', 'crashed')
"""Values of `outcome`: the tasks gave results; the recording was refused, and `refusal` has the
reason; the worker ended or failed at each attempt."""

COEFFICIENT_FIELDS = {'name': 'text', 'unit': 'text', 'value': 'float', 'std': 'float',
                      'source': 'text'}
"""Types of the fields of one coefficient, by their names. `name` is `effect.parameter.axis` or
`effect.parameter`; `source` is the task, `fit` or `diagnose`; `std` is a standard deviation."""


@dataclass(frozen=True)
class Column:
    """One column of the table."""

    name: str  # Its name, which ends in the unit where there is one
    # `text`, `float`, `integer`, `flag`, `time` (UTC), `texts`, `groups` (lists of texts) or
    # `coefficients` (see `COEFFICIENT_FIELDS`)
    kind: str
    meaning: str  # What it holds, for people
    unit: str = ''  # Its unit; empty for none
    # Whether it depends on where and when the task ran, and not on the recording
    is_timing: bool = False


def _with_interval(name: str, unit_name: str, meaning: str, unit: str, note: str = ''
                   ) -> list[Column]:
    """Return the columns of a quantity of the gap and of its interval."""
    return [Column(f'{name}{unit_name}', 'float', meaning, unit),
            *(Column(f'{name}_{end}{unit_name}', 'float',
                     f'{word} end of its 90 % interval{note}', unit)
              for end, word in (('low', 'lower'), ('high', 'upper')))]


COLUMNS: tuple[Column, ...] = (
    Column('url', 'text', 'the recording, as it was found'),
    Column('hash', 'text', 'SHA-256 of its content; as sha256sum for a single file'),
    Column('key', 'text', 'SHA-256 of content, parameters, options and code version'),
    Column('size_bytes', 'integer', 'size of the recording', 'byte'),
    Column('serial', 'text', 'serial number of the unit'),
    Column('date', 'time', 'begin of the recording'),
    Column('date_source', 'text', 'where the date is from: manifest, stamps, header or file'),
    Column('tasks', 'texts', 'the tasks that were asked for: check, noise, fit, diagnose'),
    Column('outcome', 'text', f'one of {", ".join(OUTCOMES)}'),
    Column('refusal', 'text', 'why there is no result, in one line'),
    Column('refused_by', 'text', 'the task that refused; stage or read before the first one'),
    Column('skipped', 'texts', 'tasks that do not fit the recording, with the reason'),
    Column('axes', 'text', 'measured axes: x, xy or xyz'),
    Column('duration_s', 'float', 'time from the first to the last sample', 's'),
    Column('samples', 'integer', 'samples in the recording'),
    Column('rate_hz', 'float', 'usual sample rate', 'Hz'),
    Column('jitter_s', 'float', 'rms deviation of the steps of the stamps, without gaps', 's'),
    Column('missing', 'integer', 'missing samples'),
    Column('longest_gap_s', 'float', 'longest gap; 0 for none', 's'),
    Column('temperature_c', 'float', 'mean temperature', '°C'),
    Column('temperature_low_c', 'float', 'lowest temperature', '°C'),
    Column('temperature_high_c', 'float', 'highest temperature', '°C'),
    Column('is_sound', 'flag', 'whether check finds no fault'),
    Column('faults', 'texts', 'what check finds wrong, one line each'),
    Column('calibration_id', 'text', 'calibration that was valid at the date'),
    Column('calibration_age_days', 'float', 'its age at the date', 'day'),
    Column('validity', 'text', 'valid, or why the calibration is not known to be valid'),
    *(Column(f'noise_{letter}{end}_{axis}_{unit_name}', 'float', f'{meaning}{note}, axis {axis}',
             unit)
      for letter, meaning, unit_name, unit in (
          ('n', 'white noise N', 'mps2_per_rthz', 'm/s²/√Hz'),
          ('b', 'bias instability B', 'mps2', 'm/s²'),
          ('k', 'random walk K', 'mps2_per_rts', 'm/s²/√s'))
      for end, note in (('', ''), ('_low', ': lower end of the 90 % interval'),
                        ('_high', ': upper end of the 90 % interval'))
      for axis in AXES),
    *(Column(f'{name}_{axis}_{unit_name}', 'float', f'{meaning}, axis {axis}', unit)
      for name, unit_name, meaning, unit in (
          ('zero_g', 'v', 'fitted zero-g', 'V'),
          ('zero_g_std', 'v', 'standard deviation of the zero-g', 'V'),
          ('scale', 'v_per_g', 'fitted scale factor', 'V/g'),
          ('scale_std', 'v_per_g', 'standard deviation of the scale factor', 'V/g'))
      for axis in AXES),
    Column('fit_model', 'text', 'model that was fitted'),
    Column('fit_poses', 'integer', 'poses that were fitted'),
    *_with_interval('gap_before', '_mps2', 'rms of recording minus simulation', 'm/s²'),
    *_with_interval('gap_after', '_mps2', 'rms with the named effects, on held-out blocks',
                    'm/s²'),
    *_with_interval('gap_floor', '_mps2', 'noise floor', 'm/s²', '; none if assumed'),
    Column('gap_floor_source', 'text', 'where the floor is from: still, repeats or assumed'),
    *_with_interval('gap_closed', '', 'closed share of the squared gap above the floor', ''),
    Column('status', 'text',
           'no_gap, explained, partly, inseparable, unknown, insufficient or bad_data'),
    Column('effects', 'texts', 'effects that are named for certain'),
    Column('groups', 'groups', 'sets of inseparable effects, one of each acts'),
    Column('probability', 'float', 'probability of the verdict'),
    Column('data_fault', 'text', 'name of the fault of the data, with the status bad_data'),
    Column('coefficients', 'coefficients',
           'estimates of fit and diagnose with standard deviations, baseline included'),
    Column('report', 'text', "folder of the recording's single reports, relative to the table"),
    Column('version', 'text', 'version of the package'),
    Column('code', 'text', 'SHA-256 of the code that made the row'),
    Column('seconds', 'float', 'run time of the tasks', 's', is_timing=True),
    Column('memory_mb', 'float', 'largest memory of the worker meanwhile', 'MB', is_timing=True),
    Column('worker', 'text', 'host and process of the worker', is_timing=True),
    Column('attempts', 'integer', 'attempts until the row was made', is_timing=True),
    Column('written', 'time', 'when the row was made', is_timing=True),
)
"""All columns, in the order of the table."""

TIMING = tuple(column.name for column in COLUMNS if column.is_timing)
"""Columns that differ from run to run."""


def empty_row() -> Row:
    """Return a row without any value."""
    return {column.name: [] if column.kind in ('texts', 'groups', 'coefficients') else None
            for column in COLUMNS}


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
    coefficient = pa.struct([(name, pa.float64() if kind == 'float' else pa.string())
                             for name, kind in COEFFICIENT_FIELDS.items()])
    types = {'text': pa.string(), 'float': pa.float64(), 'integer': pa.int64(),
             'flag': pa.bool_(), 'time': pa.timestamp('us', 'UTC'),
             'texts': pa.list_(pa.string()), 'groups': pa.list_(pa.list_(pa.string())),
             'coefficients': pa.list_(coefficient)}
    return pa.schema([
        pa.field(column.name, types[column.kind],
                 metadata={'unit': column.unit, 'meaning': column.meaning})
        for column in COLUMNS])


def as_table(rows: Iterable[Row]) -> Any:
    """Return rows, whose times are texts of ISO 8601 with an offset, as a table of pyarrow."""
    import pyarrow as pa
    times = [column.name for column in COLUMNS if column.kind == 'time']
    return pa.Table.from_pylist([
        {**row, **{name: datetime.fromisoformat(row[name]) for name in times if row[name]}}
        for row in rows], arrow_schema())
