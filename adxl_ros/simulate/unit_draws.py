# SPDX-License-Identifier: Apache-2.0

"""Units that differ: coefficients drawn from a fleet, a datasheet or a calibration."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike

from adxl_ros.errors import UserError
from adxl_ros.files import population_file
from adxl_ros.model.coefficients import get, names_of, parameter_of
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.population import Population
from adxl_ros.model.sensor import Sensor
import numpy as np
from scipy.special import ndtr, ndtri

_STDS_OF_MAXIMUM = 3.0
"""Standard deviations in the largest departure of a datasheet that states no typical one. Chosen:
one part in 370 of a normal distribution is beyond."""


@dataclass(frozen=True)
class UnitDraws:
    """The distribution of the coefficients of a unit: normal, cut off where there is a limit."""

    names: tuple[Coefficient, ...]  # Coefficients that differ from unit to unit, (k,)
    mean: np.ndarray  # (k,), each in the unit of its parameter
    root: np.ndarray  # Square root of the covariance by independent numbers, (k, l)
    limit_stds: np.ndarray  # Largest absolute value of each of these numbers, (l,); inf for none
    held: tuple[str, ...] = ()  # Effects of the source that do not differ here

    def draw(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Return the coefficients of further units, (count, k)."""
        low = ndtr(-self.limit_stds)
        normal = ndtri(low + (1 - 2 * low) * rng.random((count, self.root.shape[1])))
        values = self.mean + normal @ self.root.T
        bounds = [(p.lower, p.upper) for p in map(parameter_of, self.names)]
        return np.clip(values, *np.array(bounds).reshape(-1, 2).T)


def unit_draws(sensor: Sensor, units: str | PathLike | Population) -> UnitDraws:
    """
    Return how units differ.

    Parameters
    ----------
    sensor
        The unit, or the nominal sensor.
    units
        'datasheet' for the tolerances of the parameter file, 'calibration' for the covariance of
        the unit's own coefficients, else the population.yaml of a fleet.

    Returns
    -------
    UnitDraws
        The distribution. Only effects that are functions of one sample are in it.

    Raises
    ------
    UserError
        The parameter file states no tolerance or covariance, or the population cannot be read.

    """
    limit: float | np.ndarray
    if units == 'datasheet':
        names, std, limit = _datasheet(sensor)
        mean = np.array([parameter_of(name).neutral for name in names])
        root = np.diag(std)
    elif units == 'calibration':
        names, limit = list(sensor.covariance_names), np.inf
        size, vectors = np.linalg.eigh(sensor.covariance)
        mean, root = get(sensor, names), vectors * np.sqrt(np.maximum(size, 0.0))
    else:
        population = units if isinstance(units, Population) else population_file.read(units)
        prior = population.prior(sensor)
        names, limit = list(prior.names), np.inf
        mean, root = prior.mean, np.diag(prior.std)
    if not names:
        raise UserError(f'units {str(units)!r}: {sensor.serial} has no coefficients to draw from '
                        'it; give datasheet tolerances, a calibration with a covariance, or the '
                        'population.yaml of a fleet')
    drawn = [effect_named(name.effect).invertible for name in names]
    return UnitDraws(tuple(name for name, is_drawn in zip(names, drawn) if is_drawn),
                     mean[drawn], root[drawn], np.broadcast_to(limit, len(names)),
                     tuple(dict.fromkeys(name.effect for name, is_drawn in zip(names, drawn)
                                         if not is_drawn)))


def _datasheet(sensor: Sensor) -> tuple[list[Coefficient], np.ndarray, np.ndarray]:
    """Return coefficients, standard deviations, and limits in these, of a datasheet."""
    names: list[Coefficient] = []
    std, limit = [], []
    for parameter, (typical, maximum) in sensor.datasheet.items():
        of_axes = [name for name in names_of(effect_named(parameter.effect), sensor.axes)
                   if name.without_axis == parameter]
        names += of_axes
        std += [typical or maximum / _STDS_OF_MAXIMUM] * len(of_axes)
        limit += [maximum / std[-1] if maximum and of_axes else np.inf] * len(of_axes)
    return names, np.array(std), np.array(limit)
