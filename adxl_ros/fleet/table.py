# SPDX-License-Identifier: Apache-2.0

"""
The table of a fleet in the order of units and time, and what it says.

Each quantity has trends, a population and outliers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import os
from typing import NamedTuple

from adxl_ros.errors import UserError
from adxl_ros.fleet.populations import (
    bad_batch,
    BadBatch,
    MIN_UNITS,
    random_effects,
    RandomEffects,
)
from adxl_ros.fleet.row import NOISE
from adxl_ros.fleet.trends import claims, fit_trends, interval_factor, outliers, Recordings, Trends
from adxl_ros.model.constants import AXES, G0_MPS2, Z_90
from adxl_ros.report.quantities import number
import numpy as np
import pandas as pd

_TEXTS = ['url', 'hash', 'serial', 'outcome', 'refusal', 'refused_by', 'calibration_id', 'status',
          'report', 'version']
"""Columns of texts that the page uses."""
_OTHERS = ['date', 'effects', 'calibration_age_days', 'gap_floor_mps2', 'seconds']
"""Columns that the page uses, beside those of the quantities."""
_YEAR = np.timedelta64(31_557_600_000_000, 'us')
"""A year of 365.25 days."""
TOLERANCE_MG = 3.5
"""Largest gap of a unit that is in order, mg. Chosen: an error of 0.2° in tilt."""
MG = 1e3 / G0_MPS2
"""Milli-g in 1 m/s²."""


@dataclass(frozen=True)
class Quantity:
    """A quantity of the table."""

    column: str  # Column of its value; the quantity is named by it
    label: str  # Its name for people
    unit: str  # Unit of the column
    shown_unit: str  # Unit on the page
    factor: float  # Factor from the column's unit to that of the page
    # Column of its standard deviation, or columns of both ends of its 90 % interval
    error_columns: tuple[str, ...]
    is_coefficient: bool = True  # Whether the units of a fleet have a population of it

    @property
    def is_force(self) -> bool:
        """Whether the quantity is an error of specific force, which has a tolerance."""
        return self.shown_unit.startswith('mg')

    def text(self, value: float, low: float, high: float) -> str:
        """Return a difference with its interval, in the unit of the page."""
        middle, below, above = (number(self.factor * x, True) for x in (value, low, high))
        return f'{middle} ({below} to {above}) {self.shown_unit}'


@dataclass(frozen=True)
class FleetTable:
    """The recordings of n rows, in the order of serial numbers and dates."""

    frame: pd.DataFrame  # The columns that the page uses; a text is '' where there is none
    serials: tuple[str, ...]  # Serial numbers of the units, (m,)
    unit: np.ndarray  # Number of the unit of each row, (n,); −1 without a serial number
    years: np.ndarray  # Dates in years since 1970, (n,); NaN without a date
    # Number of the period between calibrations, (n,), which rises along the rows
    period: np.ndarray
    first: np.ndarray  # Rows whose content the unit has not had before, (n,) bool

    def __len__(self) -> int:
        return len(self.unit)

    def __getitem__(self, column: str) -> np.ndarray:
        return self.frame[column].to_numpy()

    def rows_of(self, unit: int) -> np.ndarray:
        """Return the numbers of the rows of a unit, in the order of time."""
        begin, end = np.searchsorted(self.unit, [unit, unit + 1])
        return np.arange(begin, end)

    def recordings(self, quantity: Quantity) -> tuple[np.ndarray, Recordings]:
        """Return a quantity in the recordings that have it."""
        value = self[quantity.column]
        low, *high = (self[name] for name in quantity.error_columns)
        std = (high[0] - low) / (2 * Z_90) if high else low
        used = np.isfinite(value) & np.isfinite(self.years) & (self.unit >= 0) & self.first
        rows = np.flatnonzero(used & np.isfinite(std) & (std >= 0))
        return rows, Recordings(self.unit, self.period, self.years, value, std)[rows]


def read(path: str | os.PathLike) -> FleetTable:
    """Read the columns of a table that the page uses."""
    import pyarrow as pa
    import pyarrow.parquet as pq
    numbers = [name for quantity in quantities(None)
               for name in (quantity.column, *quantity.error_columns)]
    try:
        frame = pq.read_table(path, columns=[*_TEXTS, *_OTHERS, *numbers]).to_pandas()
    except (OSError, KeyError, pa.ArrowException) as error:
        reason = str(error).splitlines()[0]
        raise UserError(f'{path}: not a table of `fleet`: {reason}') from None
    frame[_TEXTS] = frame[_TEXTS].astype(object).fillna('')
    frame['effects'] = [[] if names is None else list(names) for names in frame['effects']]
    frame = frame.sort_values(['serial', 'date'], kind='stable', ignore_index=True)
    serials, unit = np.unique(frame['serial'].to_numpy(str), return_inverse=True)
    if len(serials) and not serials[0]:
        serials, unit = serials[1:], unit - 1
    date = frame['date'].dt.tz_localize(None).to_numpy('datetime64[us]')
    # A period ends where the unit is calibrated again, and lasts where none is stated.
    named = frame['calibration_id'].mask(frame['calibration_id'] == '').groupby(unit).ffill()
    last = named.shift()
    begins = (np.diff(unit, prepend=-2) != 0) | (
        named.notna() & last.notna() & (named != last)).to_numpy(bool)
    # A copy says nothing twice.
    first = ~frame.assign(unit=unit).duplicated(['unit', 'hash']) | (frame['hash'] == '')
    return FleetTable(frame, tuple(map(str, serials)), unit,
                      (date - np.datetime64(0, 'us')) / _YEAR, np.cumsum(begins) - 1,
                      first.to_numpy(bool))


def quantities(table: FleetTable | None) -> tuple[Quantity, ...]:
    """Return all quantities of a table."""
    listed = [Quantity('gap_before_mps2', 'gap', 'm/s²', 'mg', MG,
                       ('gap_before_low_mps2', 'gap_before_high_mps2'), is_coefficient=False)]
    for axis in AXES:
        scales = np.zeros(0) if table is None else table[f'scale_{axis}_v_per_g']
        scales = scales[scales > 0]
        mg_per_v = 1e3 / float(np.median(scales)) if len(scales) else 1e3
        listed += [
            Quantity(f'zero_g_{axis}_v', f'zero-g {axis}', 'V', 'mg', mg_per_v,
                     (f'zero_g_std_{axis}_v',)),
            Quantity(f'scale_{axis}_v_per_g', f'scale factor {axis}', 'V/g', 'mg/g', mg_per_v,
                     (f'scale_std_{axis}_v_per_g',))]
    listed += [
        Quantity(f'noise_{letter}_{axis}_{name}', f'{label[:-2]} {axis}', unit,
                 unit.replace('m/s²', 'µg'), 1e6 / G0_MPS2,
                 tuple(f'noise_{letter}_{end}_{axis}_{name}' for end in ('low', 'high')))
        for axis in AXES for letter, label, name, unit in NOISE]
    return tuple(listed)


@dataclass(frozen=True)
class QuantityResult:
    """A quantity over the k units that have it, in n recordings."""

    quantity: Quantity  # The quantity
    rows: np.ndarray  # Rows of the recordings in the table, (n,)
    recordings: Recordings  # Its values in the unit of its column
    # Distance of each recording from those of its unit, robust standard deviations, (n,)
    distance: np.ndarray
    # Recordings that are too far from the others of their unit, (n,) bool. They do not count.
    is_outlier: np.ndarray
    units: np.ndarray  # Numbers of the units, (k,)
    trends: Trends  # Levels and slopes of the units
    # Slopes that survive the control of the false discovery rate over all units and quantities,
    # (k,) bool
    is_claimed: np.ndarray
    half_width: np.ndarray  # Half of the interval of each slope, (k,)
    population: RandomEffects | None  # Mean and spread over the units; None where they are too few
    # Units of one batch that are not of this population; None for none
    batch: BadBatch | None = None

    def place_of(self, unit: int) -> int | None:
        """Return where a unit stands among those of the quantity; None if it is not there."""
        place = int(np.searchsorted(self.units, unit))
        return place if place < len(self.units) and self.units[place] == unit else None


def analyse(table: FleetTable) -> list[QuantityResult]:
    """Return the results of all quantities that the table has."""
    measured = [(quantity, *table.recordings(quantity)) for quantity in quantities(table)]
    measured = [item for item in measured if len(item[1])]
    values = sum(len(rows) for _, rows, _ in measured)
    # Each unit has each coefficient: the chance of a false outlier is shared by them all.
    coefficients = sum(item[0].is_coefficient for item in measured) * len(table.serials)
    results = []
    for quantity, rows, recordings in measured:
        distance, is_outlier = outliers(recordings, values)
        trends = fit_trends(recordings[~is_outlier])
        units = np.unique(table.unit[rows[~is_outlier]])
        population, batch = None, None
        if quantity.is_coefficient and len(units) >= MIN_UNITS:
            batch = bad_batch([table.serials[unit] for unit in units], trends.level,
                              TOLERANCE_MG / quantity.factor, len(measured)) \
                if quantity.is_force else None
            population = _population(trends, batch, coefficients)
        none = np.zeros(len(units), bool)
        results.append(QuantityResult(quantity, rows, recordings, distance, is_outlier, units,
                                      trends, none, np.zeros(len(units)), population, batch))
    if not results:
        return []
    # The false discovery rate is controlled over all slopes together.
    is_claimed = claims(np.concatenate([result.trends.p_values for result in results]))
    factor = interval_factor(np.concatenate([r.trends.freedom for r in results]), is_claimed)
    splits = np.cumsum([len(result.units) for result in results])[:-1]
    return [replace(result, is_claimed=claimed, half_width=factors * result.trends.slope_std)
            for result, claimed, factors in zip(
                results, np.split(is_claimed, splits), np.split(factor, splits))]


def _population(trends: Trends, batch: BadBatch | None, tests: int) -> RandomEffects:
    """Return the population of the units without those of a bad batch, which are far out."""
    if batch is None:
        return random_effects(trends.level, trends.level_std, tests)
    others = ~batch.members
    of_others = random_effects(trends.level[others], trends.level_std[others], tests)
    is_far_out = batch.members.copy()
    is_far_out[others] = of_others.is_far_out
    return RandomEffects(of_others.pooled, trends.level, trends.level_std, is_far_out)


class FarOut(NamedTuple):
    """A unit that is not of the population."""

    serial: str
    quantity: Quantity
    value: float
    distance: float  # Distance from the mean, standard deviations


def far_out(results: Sequence[QuantityResult], serials: Sequence[str]) -> list[FarOut]:
    """Return the units that are not of the population, the farthest first."""
    units = [FarOut(serials[result.units[i]], result.quantity,
                    float(result.population.estimates[i]), float(result.population.distances()[i]))
             for result in results if result.population is not None
             for i in np.flatnonzero(result.population.is_far_out)]
    return sorted(units, key=lambda unit: -abs(unit.distance))
