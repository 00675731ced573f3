# SPDX-License-Identifier: Apache-2.0

"""
The magnitude of specific force that a three-axis sensor reads at rest, by nine parameters.

- Directions in which a sensor is held by hand: their information and their names.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
import math
from typing import Any, NamedTuple

from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.gauss_newton import gauss_newton, Iterate
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
_MIN_STEP = 1e-12
"""The iteration ends at a step whose largest component is smaller."""
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


def _sines(parameters: np.ndarray) -> list[tuple[Any, Any]]:
    """
    Return sine and cosine of each angle: beta of y, alpha of z and beta of z.

    Those of several sets of parameters, (s, 9), are arrays, (s, 1).
    """
    if parameters.ndim > 1:
        return [(np.sin(angle), np.cos(angle)) for angle in parameters.T[6:, :, None]]
    return [(math.sin(angle), math.cos(angle)) for angle in parameters[6:].tolist()]


def force_g(mean: np.ndarray, parameters: np.ndarray) -> np.ndarray:
    """Return the specific force of rests in the case, g, (k, 3), by their means, g, (k, 3)."""
    return _components(mean, parameters, _sines(parameters)).T


def _components(mean: np.ndarray, parameters: np.ndarray, sines: list[tuple[Any, Any]]
                ) -> np.ndarray:
    """Return the components of the force, g, (3, k) or (3, s, k); `sines` as of `_sines`."""
    (sy, cy), (sa, ca), (sb, cb) = sines
    sensed = (mean - parameters[..., None, :3]) / (1 + parameters[..., None, 3:6])
    x, y, z = sensed[..., 0], sensed[..., 1], sensed[..., 2]
    # The matrix of the sensing axes is triangular.
    y = (y + sy * x) / cy
    return np.array([x, y, (z - sb * x + sa * cb * y) / (ca * cb)])


def magnitude(mean: np.ndarray, parameters: np.ndarray) -> np.ndarray:
    """Return the magnitudes of rests, g, (k,), or (s, k); see `linearised`."""
    return _length(_components(mean, parameters, _sines(parameters)))


def _length(components: np.ndarray) -> np.ndarray:
    """Return the length of vectors, (3, ...), as (...)."""
    x, y, z = components
    return np.sqrt(x * x + y * y + z * z)


def _sensed_gradient(direction: np.ndarray, sines: list[tuple[Any, Any]]) -> np.ndarray:
    """Differentiate magnitudes by the force along the sensing axes: Θ⁻ᵀ·f/|f|, (3, ...)."""
    (sy, cy), (sa, ca), (sb, cb) = sines
    x, y, z = direction
    z = z / (ca * cb)
    y = (y + sa * cb * z) / cy
    return np.array([x + sy * y - sb * z, y, z])


class Linearised(NamedTuple):
    """Magnitudes of k rests to first order; s sets of parameters put an axis s in front."""

    magnitude: np.ndarray  # Magnitudes, g, (k,)
    by_output: np.ndarray  # Derivatives by the means, (k, 3)
    jacobian: np.ndarray  # Derivatives by the parameters, (k, 9)


def linearised(mean: np.ndarray, parameters: np.ndarray) -> Linearised:
    """
    Return the magnitudes with their derivatives.

    mean, parameters: means by nominal values, g, (k, 3), and the nine parameters, (9,). There may
    be s sets of parameters, (s, 9), and a set of rests for each, (s, k, 3).
    """
    (sy, cy), (sa, ca), (sb, cb) = sines = _sines(parameters)
    force = _components(mean, parameters, sines)
    length = _length(force)
    by_sensed = _sensed_gradient(force / length, sines)
    scale = 1 + parameters[..., None, 3:6]
    by_output = np.moveaxis(by_sensed, 0, -1) / scale
    x, y, z = force
    jacobian = np.empty((*length.shape, len(NAMES)))
    jacobian[..., :3] = -by_output
    jacobian[..., 3:6] = -by_output * ((mean - parameters[..., None, :3]) / scale)
    # Rows of ∂Θ/∂angle: of Θy by its angle, of Θz by both of its angles.
    jacobian[..., 6] = by_sensed[1] * (cy * x + sy * y)
    jacobian[..., 7] = by_sensed[2] * (ca * cb * y + sa * cb * z)
    jacobian[..., 8] = -by_sensed[2] * (cb * x + sa * sb * y - ca * sb * z)
    return Linearised(length, by_output, jacobian)


def magnitude_jacobian(mean: np.ndarray, parameters: np.ndarray) -> np.ndarray:
    """Differentiate the magnitudes by the parameters, (k, 9)."""
    return linearised(mean, parameters).jacobian


def magnitude_variance(rests: NominalRests, parameters: np.ndarray) -> np.ndarray:
    """Return the variance of each magnitude by the noise of the means, g², (k,)."""
    return _variance(rests, linearised(rests.mean, parameters).by_output)


def _variance(rests: NominalRests, by_output: np.ndarray) -> np.ndarray:
    """Return the variance of each magnitude, g², (..., k), by its derivatives, (..., k, 3)."""
    return np.einsum('...kd,...kd,...kd->...k', by_output, by_output, rests.variance)


def regularised_fit(rests: NominalRests, start: np.ndarray, steps: int,
                    closest: int | None = None) -> np.ndarray:
    """
    Fit rests with the prior, by Gauss-Newton steps.

    There may be s sets of rests with an axis of length s in front, and s starts, (s, 9), for fits
    side by side. closest: count of the rests that a step uses, those that fit best; None for all.
    """
    def linearise(parameters: np.ndarray) -> Iterate:
        parameters = np.clip(parameters, -_MAX_VALUE, _MAX_VALUE)
        length, by_output, rows = linearised(rests.mean, parameters)
        residual, variance = rests.gravity_g - length, _variance(rests, by_output)
        if closest is not None:
            part = np.argsort(residual * residual)[..., :closest]
            residual = np.take_along_axis(residual, part, -1)
            variance = np.take_along_axis(variance, part, -1)
            rows = np.take_along_axis(rows, part[..., None], -2)
        weight = 1 / (variance.mean(axis=-1)[..., None, None] + TRIAL_STD_G ** 2)
        weighted = weight * np.swapaxes(rows, -1, -2)
        gradient = weighted @ residual[..., None] - parameters[..., None] / PRIOR_STD ** 2
        step = np.linalg.solve(weighted @ rows + _PRIOR_INFORMATION, gradient)
        return Iterate(parameters, step[..., 0], 0.0)

    return gauss_newton(
        linearise, start, lambda _, __, present: bool(np.abs(present.step).max() < _MIN_STEP),
        steps + 1).last.values


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
_NEARLY_BEST = 0.5
"""Share of the greatest gain from which a direction is as good as the best; the nearest of them
is chosen."""


def information_gain(information: np.ndarray, parameters: np.ndarray, gravity_g: float
                     ) -> tuple[np.ndarray, np.ndarray]:
    """
    Return what a further rest in each candidate would add to the information of the rests so far.

    returns: gain, (26,), and derivatives of the magnitudes by the parameters, (26, 9). The gain is
    the variance of the predicted magnitude, g², by the number of axes that are not horizontal:
    with one or two axes along gravity a pose is easier to hold.
    """
    (sy, cy), (sa, ca), (sb, cb) = _sines(parameters)
    # The directions of the sensing axes in the gauge, rows Θx, Θy, Θz.
    axes = np.array([[1.0, 0.0, 0.0], [-sy, cy, 0.0], [sb, -sa * cb, ca * cb]])
    outputs = parameters[:3] + (1 + parameters[3:6]) * (gravity_g * UP @ axes.T)
    rows = magnitude_jacobian(outputs, parameters)
    variance = np.einsum('ki,ij,kj->k', rows, np.linalg.inv(information), rows)
    return variance / np.count_nonzero(CANDIDATES, axis=1), rows


def rests_to_add(count: int, information: np.ndarray, parameters: np.ndarray, gravity_g: float,
                 variance_g2: float) -> list[str]:
    """
    Name the rests with the greatest gain, one by one, until all coefficients are determined.

    count: smallest count of rests; variance_g2: variance of the magnitude of a rest, g².
    """
    rests: list[str] = []
    available = np.ones(len(UP), bool)
    while (len(rests) < count or undetermined(information)) and len(rests) <= len(NAMES):
        gain, rows = information_gain(information, parameters, gravity_g)
        best = int(np.argmax(np.where(available, gain, -np.inf)))
        information = information + np.outer(rows[best], rows[best]) / variance_g2
        available[best] = False
        rests.append(' and '.join(f'{axis} {"up" if sign > 0 else "down"}' for axis, sign
                                  in zip(AXES, CANDIDATES[best]) if sign))
    return rests


def covered(up: np.ndarray) -> np.ndarray:
    """Mark the candidates that rests in the directions `up`, (k, 3), cover, (26,) bool."""
    return np.any(up @ UP.T > _COVERED_COS, axis=0) if len(up) else np.zeros(len(UP), bool)


def next_up(gain: np.ndarray, available: np.ndarray, now: np.ndarray | None) -> int | None:
    """
    Choose the candidate to turn to: the nearest of those with nearly the greatest gain.

    gain, available: gain of each candidate, and whether it may be chosen, (26,); now: direction
    that points up at present, (3,), if known.
    """
    if not available.any():
        return None
    worth = np.where(available, gain, 0.0)
    best = np.flatnonzero(worth >= _NEARLY_BEST * worth.max())
    return int(best[np.argmax(worth[best])] if now is None else best[np.argmax(UP[best] @ now)])


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
