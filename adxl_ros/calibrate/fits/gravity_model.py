# Copyright 2026 the adxl_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The magnitude that a three-axis sensor reads at rest, and what rests tell of its parameters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

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
PRIOR = 0.1
"""Coefficients can be this far from nominal, in g, of the scale factor and in rad."""
DETERMINED = 0.01
"""A coefficient counts as determined below this: 10 mg, 1 %, 0.6°, what datasheets promise."""
ROUNDING = 1e-9
"""Error of a mean without noise, g."""
_LARGEST = 0.5
"""Largest departure from nominal in a step, in g, of the scale factor and in rad."""
_SHORTEST_STEP = 1e-12
"""A step with no larger component is not taken, in g, of the scale factor and in rad."""
TRIAL_STD_G = 1e-4
"""Excess of a rest's magnitude, g, to begin with."""


@dataclass(frozen=True)
class Rests:
    """Rests by nominal figures, g, (k, 3): means, variances of the means, and gravity, g."""

    mean: np.ndarray
    variance: np.ndarray
    gravity: float

    def __getitem__(self, part: np.ndarray) -> Rests:
        return Rests(self.mean[part], self.variance[part], self.gravity)


def nominal_rests(mean_v: np.ndarray, standard_error_v: np.ndarray, sensor: Sensor) -> Rests:
    """
    Take means of rests by the nominal figures.

    Parameters
    ----------
    mean_v, standard_error_v
        Mean of each rest and its standard error, V, (k, 3).
    sensor
        Whose nominal figures and local gravity apply.

    """
    scale = sensor.nominal_scale_v_per_g
    return Rests((mean_v - sensor.nominal_zero_g_v) / scale,
                 (standard_error_v / scale) ** 2 + ROUNDING ** 2,
                 sensor.local_gravity_mps2 / G0_MPS2)


def effect_values(found: np.ndarray, sensor: Sensor
             ) -> tuple[dict[str, dict[str, np.ndarray]], np.ndarray]:
    """Return what was found in the effects' parameters, and the units of NAMES in it, (9,)."""
    scale = sensor.nominal_scale_v_per_g
    to_units = np.concatenate([scale, scale, np.ones(3)])
    values = found * to_units
    return {'bias': {'offset_v': values[:3]},
            'scale_factor': {'offset_v_per_g': values[3:6]},
            'misalignment': {'alpha_rad': np.array([0.0, 0.0, values[7]]),
                             'beta_rad': np.array([0.0, values[6], values[8]])}}, to_units


def sensing_axes(found: np.ndarray) -> np.ndarray:
    """Directions of the sensing axes in the gauge, rows Θx, Θy, Θz, (3, 3)."""
    sy, cy = np.sin(found[6]), np.cos(found[6])
    sa, ca, sb, cb = np.sin(found[7]), np.cos(found[7]), np.sin(found[8]), np.cos(found[8])
    return np.array([[1.0, 0.0, 0.0], [-sy, cy, 0.0], [sb, -sa * cb, ca * cb]])


def force_g(mean: np.ndarray, found: np.ndarray) -> np.ndarray:
    """Specific force of each rest in the case frame, g, (k, 3)."""
    sensed = (mean - found[:3]) / (1 + found[3:6])
    return np.linalg.solve(sensing_axes(found), sensed.T).T


def magnitude(mean: np.ndarray, found: np.ndarray) -> np.ndarray:
    """Magnitude of each rest's specific force, g, (k,)."""
    return np.linalg.norm(force_g(mean, found), axis=1)


def output_gradient(force: np.ndarray, found: np.ndarray) -> np.ndarray:
    """Differentiate each magnitude by what the axes sense: Θ⁻ᵀ·f/|f|, (k, 3)."""
    along = force / np.linalg.norm(force, axis=1, keepdims=True)
    return np.linalg.solve(sensing_axes(found).T, along.T).T


def magnitude_jacobian(mean: np.ndarray, found: np.ndarray) -> np.ndarray:
    """Differentiate each magnitude by the nine parameters, (k, 9)."""
    force = force_g(mean, found)
    by_sensed = output_gradient(force, found)
    by_output = by_sensed / (1 + found[3:6])
    sensed = (mean - found[:3]) / (1 + found[3:6])
    sy, cy = np.sin(found[6]), np.cos(found[6])
    sa, ca, sb, cb = np.sin(found[7]), np.cos(found[7]), np.sin(found[8]), np.cos(found[8])
    turns = ((1, [-cy, -sy, 0.0]), (2, [0.0, -ca * cb, -sa * cb]), (2, [cb, sa * sb, -ca * sb]))
    by_angles = [by_sensed[:, axis] * (force @ np.array(row)) for axis, row in turns]
    return -np.column_stack([by_output, by_output * sensed, *by_angles])


def magnitude_variance(rests: Rests, found: np.ndarray) -> np.ndarray:
    """Variance of each magnitude that the noise of the means explains, g², (k,)."""
    by_output = output_gradient(force_g(rests.mean, found), found) / (1 + found[3:6])
    return (by_output ** 2 * rests.variance).sum(axis=1)


def iterated(rests: Rests | Callable[[np.ndarray], Rests], start: np.ndarray, steps: int
             ) -> np.ndarray:
    """
    Take Gauss-Newton steps of a fit that the prior holds where the rests do not.

    Parameters
    ----------
    rests
        The rests to fit, or a function that selects them by the parameters.
    start
        First values of the nine parameters, (9,).
    steps
        Largest count of steps.

    Returns
    -------
    np.ndarray
        The nine parameters, (9,).

    """
    def linearise(values: np.ndarray) -> Iterate:
        values = np.clip(values, -_LARGEST, _LARGEST)
        part = rests if isinstance(rests, Rests) else rests(values)
        rows = magnitude_jacobian(part.mean, values)
        weight = 1 / (magnitude_variance(part, values).mean() + TRIAL_STD_G ** 2)
        gradient = (weight * rows.T @ (magnitude(part.mean, values) - part.gravity)
                    + values / PRIOR ** 2)
        information = weight * rows.T @ rows + np.eye(len(NAMES)) / PRIOR ** 2
        return Iterate(values, -np.linalg.solve(information, gradient), 0.0)

    return gauss_newton(
        linearise, start,
        lambda _, __, present: bool(np.abs(present.step).max() < _SHORTEST_STEP),
        steps + 1).last.values


def fisher_information(rests: Rests, found: np.ndarray, excess: float) -> np.ndarray:
    """Information of the rests about the nine parameters, with that of the prior, (9, 9)."""
    information = np.eye(len(NAMES)) / PRIOR ** 2
    if len(rests.mean):
        rows = magnitude_jacobian(rests.mean, found)
        variance = magnitude_variance(rests, found) + excess
        information += rows.T @ (rows / variance[:, None])
    return information


def undetermined(information: np.ndarray) -> list[Coefficient]:
    """Name the coefficients that the information does not determine."""
    sigma = np.sqrt(np.diag(np.linalg.inv(information)))
    return [name for name, s in zip(NAMES, sigma) if s > DETERMINED]
