# SPDX-License-Identifier: Apache-2.0

"""
The magnitude of specific force that a three-axis sensor reads at rest, by nine parameters.

- Directions in which a sensor is held by hand: their information and their names.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.sensor import Sensor
import numpy as np

NAMES = (*(Coefficient('bias', 'offset_v', axis) for axis in AXES),
         *(Coefficient('scale_factor', 'offset_v_per_g', axis) for axis in AXES),
         Coefficient('misalignment', 'beta_rad', 'y'),
         Coefficient('misalignment', 'alpha_rad', 'z'),
         Coefficient('misalignment', 'beta_rad', 'z'))
"""The nine coefficients. In the fits of gravity they are zero-g shifts in g, relative changes of
the scale factor and angles in rad: the "parameters" below, (9,)."""
PRIOR_STD = 0.1
"""Prior standard deviation of each parameter. Chosen: ten times the tolerances of datasheets."""
DETERMINED_STD = 0.01
"""Standard deviation below which a parameter counts as determined: 10 mg, 1 % or 0.6°, the usual
tolerances of datasheets."""
TRIAL_STD_G = 1e-4
"""Standard deviation of a rest's magnitude before the excess is estimated, g."""
_ROUNDING_STD_G = 1e-9
"""Standard deviation of a mean by rounding alone, g, so that no weight is infinite."""
_MAX_VALUE = 0.5
"""Largest magnitude of a parameter in an iteration. Chosen: five prior standard deviations."""
_PRIOR_INFORMATION = np.eye(len(NAMES)) / PRIOR_STD ** 2
"""Inverse covariance of the prior about 0, (9, 9)."""


@dataclass(frozen=True)
class NominalRests:
    """k rests, converted by the nominal zero-g and scale factor."""

    mean: np.ndarray  # Means, g, (k, 3)
    variance: np.ndarray  # Variances of the means, g², (k, 3)
    gravity_g: float  # Local gravity, g

    def __getitem__(self, part: np.ndarray) -> NominalRests:
        return NominalRests(self.mean[part], self.variance[part], self.gravity_g)


def nominal_rests(mean_v: np.ndarray, std_v: np.ndarray, sensor: Sensor) -> NominalRests:
    """Convert means of rests and their standard deviations, V, (k, 3), by nominal values."""
    scale = sensor.nominal_scale_v_per_g
    return NominalRests((mean_v - sensor.nominal_zero_g_v) / scale,
                        (std_v / scale) ** 2 + _ROUNDING_STD_G ** 2,
                        sensor.local_gravity_mps2 / G0_MPS2)


def effect_values(parameters: np.ndarray, sensor: Sensor
                  ) -> tuple[dict[str, dict[str, np.ndarray]], np.ndarray]:
    """Return the values of the effects, and the factor from each parameter to its coefficient."""
    scale = sensor.nominal_scale_v_per_g
    units = np.concatenate([scale, scale, np.ones(3)])
    values = parameters * units
    return {'bias': {'offset_v': values[:3]}, 'scale_factor': {'offset_v_per_g': values[3:6]},
            'misalignment': {'alpha_rad': np.array([0.0, 0.0, values[7]]),
                             'beta_rad': np.array([0.0, values[6], values[8]])}}, units


def _sensing_axes(parameters: np.ndarray) -> np.ndarray:
    """Return the directions of the sensing axes in the gauge, rows Θx, Θy, Θz, (3, 3)."""
    (sy, sa, sb), (cy, ca, cb) = np.sin(parameters[6:]), np.cos(parameters[6:])
    return np.array([[1.0, 0.0, 0.0], [-sy, cy, 0.0], [sb, -sa * cb, ca * cb]])


def force_g(mean: np.ndarray, parameters: np.ndarray) -> np.ndarray:
    """Return the specific force of rests in the case, g, (k, 3), by their means, g, (k, 3)."""
    sensed = (mean - parameters[:3]) / (1 + parameters[3:6])
    return np.asarray(sensed @ np.linalg.inv(_sensing_axes(parameters)).T)


def magnitude(mean: np.ndarray, parameters: np.ndarray) -> np.ndarray:
    """Return the magnitudes of rests, g, (k,), by their means, g, (k, 3)."""
    return np.linalg.norm(force_g(mean, parameters), axis=1)


class Linearised(NamedTuple):
    """Magnitudes of k rests to first order."""

    magnitude: np.ndarray  # Magnitudes, g, (k,)
    by_output: np.ndarray  # Derivatives by the means, (k, 3)
    jacobian: np.ndarray  # Derivatives by the parameters, (k, 9)


def linearised(mean: np.ndarray, parameters: np.ndarray) -> Linearised:
    """Return the magnitudes with their derivatives; `mean` by nominal values, g, (k, 3)."""
    scale = 1 + parameters[3:6]
    sensed = (mean - parameters[:3]) / scale
    inverse = np.linalg.inv(_sensing_axes(parameters))
    force = sensed @ inverse.T
    length = np.linalg.norm(force, axis=1)
    by_sensed = force / length[:, None] @ inverse
    by_output = by_sensed / scale
    # ∂Θ/∂angle: of Θy by its angle, of Θz by both of its angles.
    (sy, sa, sb), (cy, ca, cb) = np.sin(parameters[6:]), np.cos(parameters[6:])
    turned = np.array([[-cy, -sy, 0.0], [0.0, -ca * cb, -sa * cb], [cb, sa * sb, -ca * sb]])
    by_angle = -by_sensed[:, [1, 2, 2]] * (force @ turned.T)
    return Linearised(length, by_output, np.hstack([-by_output, -by_output * sensed, by_angle]))


def magnitude_jacobian(mean: np.ndarray, parameters: np.ndarray) -> np.ndarray:
    """Differentiate the magnitudes by the parameters, (k, 9)."""
    return linearised(mean, parameters).jacobian


def magnitude_variance(rests: NominalRests, parameters: np.ndarray) -> np.ndarray:
    """Return the variance of each magnitude by the noise of the means, g², (k,)."""
    return np.sum(linearised(rests.mean, parameters).by_output ** 2 * rests.variance, axis=1)


def regularised_fit(rests: NominalRests, steps: int) -> np.ndarray:
    """Fit rests with the prior by Gauss-Newton steps from 0; return the parameters."""
    parameters = np.zeros(len(NAMES))
    for _ in range(steps):
        length, _, rows = linearised(rests.mean, parameters)
        weighted = rows.T / (magnitude_variance(rests, parameters).mean() + TRIAL_STD_G ** 2)
        gradient = weighted @ (rests.gravity_g - length) - parameters / PRIOR_STD ** 2
        step = np.linalg.solve(weighted @ rows + _PRIOR_INFORMATION, gradient)
        parameters = np.clip(parameters + step, -_MAX_VALUE, _MAX_VALUE)
    return parameters


def fisher_information(rests: NominalRests, parameters: np.ndarray, excess_g2: float
                       ) -> np.ndarray:
    """
    Return the Fisher information of rests about the parameters, without the prior, (9, 9).

    excess_g2: variance of the magnitudes beyond the noise of the means, g².
    """
    if not len(rests.mean):
        return np.zeros((len(NAMES), len(NAMES)))
    rows = magnitude_jacobian(rests.mean, parameters)
    return rows.T @ (rows / (magnitude_variance(rests, parameters) + excess_g2)[:, None])


def posterior_information(rests: NominalRests, parameters: np.ndarray, excess_g2: float
                          ) -> np.ndarray:
    """Return the information of prior and rests about the parameters, (9, 9)."""
    return _PRIOR_INFORMATION + fisher_information(rests, parameters, excess_g2)


def undetermined(information: np.ndarray) -> list[Coefficient]:
    """Name the coefficients that the information, (9, 9), does not determine."""
    std = np.sqrt(np.diag(np.linalg.inv(information)))
    return [name for name, parameter_std in zip(NAMES, std) if parameter_std > DETERMINED_STD]


CANDIDATES = np.array([signs for signs in product((0, 1, -1), repeat=3) if any(signs)])
"""Faces, edges and corners of a cube, one of which points up, (26, 3)."""
UP = CANDIDATES / np.linalg.norm(CANDIDATES, axis=1, keepdims=True)
"""The candidates as unit vectors, (26, 3)."""
_COVERED_COS = np.cos(np.radians(22.0))
"""Cosine of the angle up to which a rest covers a direction: half of the 45° to the next one."""
AXES_UP = np.count_nonzero(CANDIDATES, axis=1)
"""Number of axes that are not horizontal, (26,): 1 for a face, 2 for an edge, 3 for a corner."""


def covered(up: np.ndarray) -> np.ndarray:
    """Mark the candidates that rests in the directions `up`, (k, 3), cover, (26,) bool."""
    return np.any(up @ UP.T > _COVERED_COS, axis=0) if len(up) else np.zeros(len(UP), bool)


def next_up(available: np.ndarray, now: np.ndarray | None) -> int | None:
    """
    Choose the candidate to turn to: the nearest face, without one the nearest edge, then corner.

    available: whether a candidate may be chosen, (26,); now: direction that points up at present,
    (3,), if known.
    """
    nearness = UP @ (np.zeros(3) if now is None else now)
    cost = np.where(available, AXES_UP - 0.4 * nearness, np.inf)
    return int(cost.argmin()) if available.any() else None


def name_up(candidate: int) -> str:
    """Name what points up: '+x', or '+x and −y equally' for an edge."""
    axes = [('+' if sign > 0 else '−') + axis for axis, sign in zip(AXES, CANDIDATES[candidate])
            if sign]
    return axes[0] if len(axes) == 1 else f'{" and ".join(axes)} equally'


def points_up(candidate: int) -> str:
    """Return a sentence: '+x points up', '+x and −y point up equally'."""
    name = name_up(candidate)
    return f'{name.removesuffix(" equally")} point up equally' if ' and ' in name else \
        f'{name} points up'
