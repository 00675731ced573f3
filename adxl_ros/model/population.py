# SPDX-License-Identifier: Apache-2.0

"""
The population of sensors that a sensor is from, as a prior of its zero-g and scale factor.

A fleet determines the mean of each coefficient and its std over sensors. A sensor of
the same population has both as a normal prior. The estimate of a calibration and its covariance
then have a normal posterior in closed form, because the chain is nearly linear in them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.sensor import get, put, Sensor, with_neutral
import numpy as np
import scipy

STRANGER_CHANCE = 1e-3  # Probability of a false stranger. Chosen: one fit in 1000
_EFFECTS = ('bias', 'scale_factor')  # Effects of the coefficients that a population can have


@dataclass(frozen=True)
class PooledCoefficient:
    """A coefficient over the units of a fleet, in the unit of its column."""

    # mean, mean_std: Mean over the sensors and its standard deviation
    mean: float
    mean_std: float
    spread: float  # Standard deviation of the sensors about the mean, without their own errors
    # spread_low, spread_high: 90 % interval of the spread
    spread_low: float
    spread_high: float
    # Standard deviation of the coefficient of a further sensor about the mean
    prediction_std: float
    units: int  # Number of sensors


@dataclass(frozen=True)
class Population:
    """Coefficients over the units of a fleet."""

    name: str  # What messages call it
    # Coefficients by their column of the fleet's table: `zero_g_x_v`, `scale_x_v_per_g`, ..
    coefficients: Mapping[str, PooledCoefficient]

    def prior(self, sensor: Sensor) -> Prior:
        """Return the prior of a sensor's departures from its nominal values."""
        zero_g_v = sensor.nominal_zero_g_v
        scale_v_per_g = sensor.nominal_scale_v_per_g
        names = []
        means = []
        stds = []
        for effect, parameter, column, nominal in (
            ('bias', 'offset_v', 'zero_g_{}_v', zero_g_v),
            ('scale_factor', 'offset_v_per_g', 'scale_{}_v_per_g', scale_v_per_g),
        ):
            for axis, value in zip(sensor.axes, nominal.tolist()):
                pooled = self.coefficients.get(column.format(axis))
                if pooled:
                    names.append(Coefficient(effect, parameter, axis))
                    means.append(pooled.mean - value)
                    stds.append(pooled.prediction_std)
        return Prior(tuple(names), np.array(means), np.array(stds))


class Prior(NamedTuple):
    """A normal prior of coefficients."""

    names: tuple[Coefficient, ...]  # The coefficients, (k,)
    # mean, std: Their means and standard deviations, (k,) each
    mean: np.ndarray
    std: np.ndarray

    def among(self, names: Sequence[Coefficient]) -> Prior:
        """Return the prior of those that are among some coefficients."""
        used = [i for i, name in enumerate(self.names) if name in names]
        return Prior(tuple(self.names[i] for i in used), self.mean[used], self.std[used])


class Posterior(NamedTuple):
    """A sensor as one of a population."""

    sensor: Sensor  # The sensor; unchanged if it is a stranger
    line: str  # How the population is used, or why it is not, for people
    is_stranger: bool = False  # Whether the sensor is not of the population


def posterior(sensor: Sensor, population: Population) -> Posterior:
    """
    Combine the coefficients of a sensor with its population, unless they contradict each other.

    A sensor without zero-g and scale factor of its own takes those of the population.
    """
    prior = population.prior(sensor)
    if not prior.names:
        return Posterior(
            sensor,
            f'{population.name} has no zero-g or scale factor of the axes '
            f'{sensor.axes}; it is not used',
        )
    if not set(_EFFECTS) & set(sensor.effects):
        return _drawn_from(prior, sensor, population)
    known = prior.among(sensor.covariance_names)
    if not known.names:
        return Posterior(
            sensor,
            f'{population.name} is not used: zero-g and scale factor of '
            'the unit have no uncertainty',
        )
    return _combined(known, sensor, population)


def _drawn_from(prior: Prior, sensor: Sensor, population: Population) -> Posterior:
    """Return a sensor without coefficients of its own, with those of the prior."""
    unit = replace(
        put(with_neutral(sensor, _EFFECTS), prior.names, prior.mean),
        covariance=np.diag(prior.std**2),
        covariance_names=prior.names,
    )
    return Posterior(
        unit,
        f'zero-g and scale factor are those of {population.name}: the unit has none of its own',
    )


def _combined(prior: Prior, sensor: Sensor, population: Population) -> Posterior:
    """Return a sensor whose coefficients have a normal prior, unless it contradicts them."""
    count = len(prior.names)
    places = [sensor.covariance_names.index(name) for name in prior.names]
    departure = prior.mean - get(sensor, prior.names)
    # The covariance of the estimates with all coefficients, and that of the departures
    cross = sensor.covariance[places]
    total = cross[:, places] + np.diag(prior.std**2)
    square = float(departure @ np.linalg.solve(total, departure))
    chance = float(scipy.special.chdtrc(count, square))
    if chance < STRANGER_CHANCE:
        return Posterior(
            sensor,
            f'{sensor.serial} is not of {population.name}: χ² {square:.3g} for {count} '
            f'coefficients, probability {chance:.2g}. The prior is not used',
            is_stranger=True,
        )
    gain = np.linalg.solve(total, cross).T
    covariance = sensor.covariance - gain @ cross
    values = get(sensor, sensor.covariance_names) + gain @ departure
    unit = replace(
        put(sensor, sensor.covariance_names, values), covariance=(covariance + covariance.T) / 2
    )
    return Posterior(
        unit,
        f'{population.name} is the prior of {count} coefficients: χ² {square:.3g}, '
        f'probability {chance:.2g}',
    )
