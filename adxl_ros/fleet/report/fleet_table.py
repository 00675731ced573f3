# SPDX-License-Identifier: Apache-2.0

"""
The table of a fleet as arrays, in the order of units and time, and what it says.

Each quantity has trends, a population and outliers.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
import os
from typing import Any

from adxl_ros.errors import install_hint, UserError
from adxl_ros.fleet.report.populations import (
    bad_batch,
    BadBatch,
    MIN_UNITS,
    random_effects,
    RandomEffects,
)
from adxl_ros.fleet.report.trends import (
    are_outliers,
    claimed,
    fit_trends,
    interval_factor,
    outlier_distances,
    Recordings,
    Trends,
)
from adxl_ros.model.constants import AXES, G0_MPS2, Z_90
from adxl_ros.model.population import Population
import numpy as np

_TEXTS = ('url', 'hash', 'serial', 'outcome', 'refusal', 'refused_by', 'calibration_id', 'status',
          'report', 'version')
"""Columns of texts that the page uses."""
_LISTS = ('effects', 'groups')
"""Columns of lists that the page uses."""
_NUMBERS = ('duration_s', 'size_bytes', 'calibration_age_days', 'gap_before_mps2',
            'gap_before_low_mps2', 'gap_before_high_mps2', 'gap_after_mps2', 'gap_floor_mps2',
            'seconds', 'memory_mb')
"""Columns of numbers that the page uses, beside those of the quantities."""
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
    std_column: str = ''  # Column of its standard deviation; empty where there is an interval
    # Columns of both ends of its 90 % interval; empty where there is a standard deviation
    interval_columns: tuple[str, ...] = ()
    is_coefficient: bool = True  # Whether the units of a fleet have a population of it

    @property
    def is_force(self) -> bool:
        """Whether the quantity is an error of specific force, which has a tolerance."""
        return self.shown_unit.startswith('mg')


@dataclass(frozen=True)
class FleetTable:
    """The recordings of n rows, in the order of serial numbers and dates."""

    # Values by column, (n,): numbers are float with NaN, texts are '' where there is none
    columns: dict[str, np.ndarray]
    serials: tuple[str, ...]  # Serial numbers of the units, (m,)
    unit: np.ndarray  # Number of the unit of each row, (n,); −1 without a serial number
    years: np.ndarray  # Dates in years since 1970, (n,); NaN without a date
    # Number of the period between calibrations, (n,), which rises along the rows
    period: np.ndarray
    first: np.ndarray  # Rows whose content the unit has not had before, (n,) bool

    def __len__(self) -> int:
        return len(self.unit)

    def __getitem__(self, column: str) -> np.ndarray:
        return self.columns[column]

    def rows_of(self, unit: int) -> np.ndarray:
        """Return the numbers of the rows of a unit, in the order of time."""
        begin, end = np.searchsorted(self.unit, [unit, unit + 1])
        return np.arange(begin, end)

    def recordings(self, quantity: Quantity) -> tuple[np.ndarray, Recordings]:
        """Return a quantity in the recordings that have it."""
        value = self[quantity.column]
        if quantity.std_column:
            std = self[quantity.std_column]
        else:
            low, high = (self[name] for name in quantity.interval_columns)
            std = (high - low) / (2 * Z_90)
        used = np.isfinite(value) & np.isfinite(self.years) & (self.unit >= 0) & self.first
        rows = np.flatnonzero(used & np.isfinite(std) & (std >= 0))
        table = Recordings(self.unit, self.period, self.years, value, std)
        return rows, table[rows]


def read(path: str | os.PathLike) -> FleetTable:
    """Read the columns of a table that the page uses."""
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError:
        raise UserError(f'{path}: Parquet needs pyarrow; {install_hint("pyarrow")}') from None
    names = [*_TEXTS, *_LISTS, *_NUMBERS, 'date', *_quantity_columns()]
    try:
        return from_arrow(pq.read_table(path, columns=list(dict.fromkeys(names))))
    except (OSError, KeyError, pa.ArrowException) as error:
        reason = str(error).splitlines()[0]
        raise UserError(f'{path}: not a table of `fleet`: {reason}') from None


def from_arrow(table: Any) -> FleetTable:
    """Return the recordings of a table of pyarrow."""
    columns: dict[str, np.ndarray] = {}
    for name in _TEXTS:
        columns[name] = np.array([text or '' for text in table[name].to_pylist()], object)
    for name in _LISTS:
        lists = table[name].to_pylist()
        columns[name] = np.empty(len(lists), object)
        columns[name][:] = [value or [] for value in lists]
    for name in dict.fromkeys((*_NUMBERS, *_quantity_columns())):
        columns[name] = np.asarray(table[name].to_numpy(zero_copy_only=False), float)
    date = table['date'].to_numpy().astype('datetime64[us]')
    serial = columns['serial'].astype(str) if len(table) else np.zeros(0, str)
    order = np.lexsort((date, serial))
    columns = {name: values[order] for name, values in columns.items()}
    date, serial = date[order], serial[order]
    serials, unit = np.unique(serial, return_inverse=True)
    if len(serials) and not serials[0]:
        serials, unit = serials[1:], unit - 1
    years = np.where(np.isnat(date), np.nan, (date - np.datetime64(0, 'us')) / _YEAR)
    return FleetTable(columns, tuple(map(str, serials)), unit, years,
                      _periods(unit, columns['calibration_id']),
                      _first_of_content(unit, columns['hash']))


def _periods(unit: np.ndarray, calibration: np.ndarray) -> np.ndarray:
    """Count the periods of units between changes of their calibration, (n,)."""
    begins = np.zeros(len(unit), bool)
    last_unit, last_calibration = -2, ''
    for i, (number, name) in enumerate(zip(unit, calibration)):
        begins[i] = number != last_unit or bool(name and last_calibration
                                                and name != last_calibration)
        if number != last_unit or name:
            last_calibration = name
        last_unit = number
    return np.cumsum(begins) - 1


def _first_of_content(unit: np.ndarray, content: np.ndarray) -> np.ndarray:
    """Mark rows whose content is new to the unit, (n,) bool; a copy says nothing twice."""
    seen: set[tuple[int, str]] = set()
    result = np.ones(len(unit), bool)
    for i, key in enumerate(zip(unit, content)):
        result[i] = not key[1] or key not in seen
        seen.add(key)
    return result


def _quantity_columns() -> Iterator[str]:
    """Name the columns of all quantities."""
    for quantity in quantities(None):
        yield from filter(None, (quantity.column, quantity.std_column,
                                 *quantity.interval_columns))


def quantities(table: FleetTable | None) -> tuple[Quantity, ...]:
    """Return all quantities of a table."""
    listed = [Quantity(
        'gap_before_mps2', 'gap', 'm/s²', 'mg', MG, is_coefficient=False,
        interval_columns=('gap_before_low_mps2', 'gap_before_high_mps2'))]
    for axis in AXES:
        mg_per_v = 1e3 / _median_scale(table, axis)
        listed.append(Quantity(f'zero_g_{axis}_v', f'zero-g {axis}', 'V', 'mg', mg_per_v,
                               f'zero_g_std_{axis}_v'))
        listed.append(Quantity(f'scale_{axis}_v_per_g', f'scale factor {axis}', 'V/g', 'mg/g',
                               mg_per_v, f'scale_std_{axis}_v_per_g'))
    for axis in AXES:
        listed.append(_noise_term('n', axis, f'white noise {axis}', 'mps2_per_rthz', '/√Hz'))
        listed.append(_noise_term('b', axis, f'bias instability {axis}', 'mps2', ''))
        listed.append(_noise_term('k', axis, f'random walk {axis}', 'mps2_per_rts', '/√s'))
    return tuple(listed)


def _median_scale(table: FleetTable | None, axis: str) -> float:
    """Return the usual scale factor of an axis, V/g; 1 where no recording has one."""
    values = np.zeros(0) if table is None else table[f'scale_{axis}_v_per_g']
    values = values[values > 0]
    return float(np.median(values)) if len(values) else 1.0


def _noise_term(letter: str, axis: str, label: str, unit_name: str, per: str) -> Quantity:
    interval = tuple(f'noise_{letter}_{end}_{axis}_{unit_name}' for end in ('low', 'high'))
    return Quantity(f'noise_{letter}_{axis}_{unit_name}', label, f'm/s²{per}', f'µg{per}',
                    1e6 / G0_MPS2, interval_columns=interval)


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
        distance, freedom = outlier_distances(recordings)
        is_outlier = are_outliers(distance, freedom, values)
        kept = recordings[~is_outlier]
        trends, units = fit_trends(kept), np.unique(table.unit[rows[~is_outlier]])
        population, batch = None, None
        if quantity.is_coefficient and len(units) >= MIN_UNITS:
            batch = bad_batch([table.serials[unit] for unit in units], trends.level,
                              TOLERANCE_MG / quantity.factor, len(measured)) \
                if quantity.is_force else None
            population = _population(trends, batch, coefficients)
        none = np.zeros(len(units), bool)
        results.append(QuantityResult(quantity, rows, recordings, distance, is_outlier, units,
                                      trends, none, np.zeros(len(units)), population, batch))
    return _with_claims(results)


def _population(trends: Trends, batch: BadBatch | None, tests: int) -> RandomEffects:
    """Return the population of the units without those of a bad batch, which are far out."""
    if batch is None:
        return random_effects(trends.level, trends.level_std, tests)
    others = ~batch.members
    of_others = random_effects(trends.level[others], trends.level_std[others], tests)
    is_far_out = batch.members.copy()
    is_far_out[others] = of_others.is_far_out
    return RandomEffects(of_others.pooled, trends.level, trends.level_std, is_far_out)


def _with_claims(results: Sequence[QuantityResult]) -> list[QuantityResult]:
    """Control the false discovery rate over all slopes together."""
    if not results:
        return []
    splits = np.cumsum([len(result.units) for result in results])[:-1]
    is_claimed = claimed(np.concatenate([result.trends.p_values for result in results]))
    factor = interval_factor(np.concatenate([r.trends.freedom for r in results]), is_claimed)
    return [replace(result, is_claimed=claims, half_width=factors * result.trends.slope_std)
            for result, claims, factors in zip(results, np.split(is_claimed, splits),
                                               np.split(factor, splits))]


def population_of(results: Sequence[QuantityResult], name: str) -> Population:
    """Return what the units of a fleet are like."""
    return Population(name, {
        result.quantity.column: result.population.pooled for result in results
        if result.population is not None and result.population.pooled.prediction_std > 0})


def far_out(results: Sequence[QuantityResult], serials: Sequence[str]
            ) -> list[dict[str, str | float]]:
    """
    Return the units that are not of the population, the farthest first.

    serials: serial numbers of the units, (m,).
    """
    units: list[dict[str, str | float]] = [
        {'serial': serials[result.units[i]], 'coefficient': result.quantity.column,
         'value': float(result.population.estimates[i]),
         'distance': float(result.population.distances()[i])}
        for result in results if result.population is not None
        for i in np.flatnonzero(result.population.is_far_out)]
    return sorted(units, key=lambda unit: -abs(float(unit['distance'])))
