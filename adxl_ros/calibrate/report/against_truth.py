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

"""A fitted unit beside its true coefficients, which are known of a simulated unit alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from adxl_ros.calibrate.fits import full_model
from adxl_ros.errors import UserError
from adxl_ros.model.coefficients import get, parameter_of, put, with_neutral
from adxl_ros.model.constants import AXES, Z_90
from adxl_ros.model.effects import cross_axis, cross_axis_z, scale_factor_cross, scale_factor_z
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.effects.misalignment import direction
from adxl_ros.model.sensor import Sensor
import numpy as np

_SCALE = Coefficient('scale_factor', 'offset_v_per_g')
_ABSOLUTE = {Coefficient('bias', 'offset_v'): 'nominal_zero_g_v',
             _SCALE: 'nominal_scale_v_per_g'}
"""Coefficients that are departures from a nominal figure, and that figure."""
_LABELS = {
    'bias.offset_v': 'zero-g',
    'scale_factor.offset_v_per_g': 'scale factor',
    'misalignment.alpha_rad': 'misalignment alpha',
    'misalignment.beta_rad': 'misalignment beta',
    'cross_axis.linear': 'bias, {other}',
    'cross_axis.quadratic_per_g': 'bias, {other}²',
    'cross_axis_z.linear': 'bias, {other}',
    'cross_axis_z.quadratic_per_g': 'bias, {other}²',
    'scale_factor_cross.linear_per_g': 'scale, {other}',
    'scale_factor_z.linear_per_g': 'scale, {other}',
    'scale_factor_z.quadratic_per_g2': 'scale, {other}²',
    'nonlinearity.cubic_per_g2': 'cubic',
}
"""Coefficients in words; {other} is the axis that acts on the own axis."""
_OTHER = {effect.EFFECT.name: effect.OTHER
          for effect in (cross_axis, cross_axis_z, scale_factor_cross, scale_factor_z)}
_ANGLES = (Coefficient('misalignment', 'alpha_rad'), Coefficient('misalignment', 'beta_rad'))
_LINEAR = (Coefficient('cross_axis', 'linear'), Coefficient('cross_axis_z', 'linear'))


@dataclass(frozen=True)
class Comparison:
    """
    One fitted coefficient beside the true one.

    Attributes
    ----------
    name
        'effect.parameter', as in the parameter file.
    axis
        'x', 'y' or 'z'; empty for a coefficient of the whole unit.
    label
        The coefficient in words.
    unit
        Unit of the values: that of the parameter, but degrees for an angle.
    fitted
        The fitted value. Zero-g and scale factor are absolute, in V and V/g.
    half_width
        Half of the 90 % interval.
    truth
        The true value; 0 for what the unit does not have.

    """

    name: str
    axis: str
    label: str
    unit: str
    fitted: float
    half_width: float
    truth: float

    @property
    def inside(self) -> bool:
        """Tell whether the 90 % interval holds the true value."""
        return abs(self.fitted - self.truth) <= self.half_width


def compare(fitted: Sensor, truth: Sensor) -> list[Comparison]:
    """
    Compare each fitted coefficient with the true one, in the order of the fit.

    A misalignment and a linear cross-axis term are the same to first order. Where the fit has no
    linear cross-axis term, the true one counts as part of the true misalignment.

    Parameters
    ----------
    fitted
        With the covariance of its coefficients.
    truth
        The same unit with its true coefficients.

    Raises
    ------
    UserError
        The two have other axes.

    """
    if fitted.axes != truth.axes:
        raise UserError(f'the fitted unit has the axes {fitted.axes}, the true one {truth.axes}; '
                        'compare parameter files of one unit')
    names = fitted.covariance_names
    truth = _in_gauge_of_fit(truth, names)
    half_widths = Z_90 * np.sqrt(np.diag(fitted.covariance))
    return [_compared(name, *values) for name, *values in zip(
        names, _absolute(fitted, names), half_widths, _absolute(truth, names))]


def added_effects(fitted: Sensor, truth: Sensor) -> list[str]:
    """Name the effects that the fit has beyond the full model and that the unit does not have."""
    expected = {*full_model.default_terms(fitted.axes), *truth.effects}
    return [effect for effect in fitted.effects if effect not in expected]


def _compared(name: Coefficient, fitted: float, half_width: float, truth: float) -> Comparison:
    key = str(name.without_axis)
    acts = name.axis and name.effect in _OTHER
    other = AXES[_OTHER[name.effect][AXES.index(name.axis)]] if acts else ''
    unit, scale = parameter_of(name).unit, 1.0
    if unit == 'rad':
        unit, scale = '°', float(np.degrees(1.0))
    return Comparison(key, name.axis, _LABELS.get(key, key).format(other=other),
                      unit.replace('^2', '²'), *(float(scale * value) for value in (
                          fitted, half_width, truth)))


def _absolute(sensor: Sensor, names: tuple[Coefficient, ...]) -> np.ndarray:
    """Return coefficients, zero-g and scale factor with their nominal figures, (p,)."""
    values = get(sensor, names)
    for i, name in enumerate(names):
        nominal = _ABSOLUTE.get(name.without_axis)
        if nominal:
            values[i] += getattr(sensor, nominal)[sensor.axes.index(name.axis)]
    return values


def _in_gauge_of_fit(truth: Sensor, names: tuple[Coefficient, ...]) -> Sensor:
    """Return the true unit with every effect of the fit, and no linear term that it lacks."""
    effects = [name.effect for name in (*names, *_LINEAR, *_ANGLES, _SCALE)]
    same = truth = with_neutral(truth, effects)
    for axis in truth.axes:
        moved = [name for name in _on(axis, _LINEAR) if name not in names]
        if moved and all(name in names for name in _on(axis, _ANGLES)):
            same = put(same, *_as_misalignment(truth, axis, moved))
    return same


def _on(axis: str, parameters: Sequence[Coefficient]) -> list[Coefficient]:
    """Name the coefficients of parameters on one axis."""
    return [replace(parameter, axis=axis) for parameter in parameters]


def _as_misalignment(truth: Sensor, axis: str, moved: list[Coefficient]
                     ) -> tuple[list[Coefficient], list[float]]:
    """
    Move linear cross-axis terms of one axis into its misalignment and its scale factor.

    A_d + p·A_c = (Θ_d + p·Θ_c)·f is again a projection of the specific force, along another
    direction and by its length. Products of p with the other terms are left out.

    Returns
    -------
    tuple
        Names of the coefficients that change, and their new values.

    """
    own = AXES.index(axis)
    along = _direction(truth, own)
    for name in moved:
        linear, = get(truth, [name])
        along = along + linear * _direction(truth, _OTHER[name.effect][own])
    length = float(np.linalg.norm(along))
    d = truth.axes.index(axis)
    scale = truth.scale_v_per_g[d] * length - truth.nominal_scale_v_per_g[d]
    changed = [*_on(axis, (*_ANGLES, _SCALE)), *moved]
    return changed, [*_alpha_beta(own, along / length), float(scale), *[0.0] * len(moved)]


def _direction(sensor: Sensor, axis: int) -> np.ndarray:
    """Return the direction of an axis in the case; one that is not measured is aligned."""
    if AXES[axis] not in sensor.axes:
        return np.eye(3)[axis]
    return np.array(direction(axis, *get(sensor, _on(AXES[axis], _ANGLES))))


def _alpha_beta(axis: int, along: np.ndarray) -> tuple[float, float]:
    """Return alpha and beta of a unit vector, rad: the inverse of `misalignment.direction`."""
    x, y, z = along
    alpha, sine = [(np.arctan2(-z, x), y), (np.arctan2(z, y), -x), (np.arctan2(-y, z), x)][axis]
    return float(alpha), float(np.arcsin(sine))
