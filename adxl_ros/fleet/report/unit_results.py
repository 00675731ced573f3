# SPDX-License-Identifier: Apache-2.0

"""What the recordings of a fleet say of each quantity: trends, population and outliers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from adxl_ros.fleet.report import outliers
from adxl_ros.fleet.report.batches import bad_batch, BadBatch
from adxl_ros.fleet.report.fleet_table import FleetTable, quantities, Quantity, TOLERANCE_MG
from adxl_ros.fleet.report.random_effects import MIN_UNITS, random_effects, RandomEffects
from adxl_ros.fleet.report.trends import (
    claimed,
    fit_trends,
    interval_factor,
    Recordings,
    Trends,
)
from adxl_ros.model.population import Population
import numpy as np


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
        distance, freedom = outliers.outlier_distances(recordings)
        is_outlier = outliers.are_outliers(distance, freedom, values)
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
