# SPDX-License-Identifier: Apache-2.0

"""Comparison of fitted coefficients with the true ones of a simulated unit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from adxl_ros.calibrate.fits import full_model
from adxl_ros.errors import UserError
from adxl_ros.model.coefficients import get, parameter_of, put, with_neutral
from adxl_ros.model.constants import AXES, Z_90
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.effects.element import OTHER_AXIS
from adxl_ros.model.effects.mounting import direction
from adxl_ros.model.sensor import Sensor
import numpy as np

_SCALE = Coefficient('scale_factor', 'offset_v_per_g')
"""Parameter that takes the length of a direction."""
_ABSOLUTE = {Coefficient('bias', 'offset_v'): 'nominal_zero_g_v',
             _SCALE: 'nominal_scale_v_per_g'}
"""Parameters that are departures from a nominal value, and the field of that value."""
_LABELS = {
    'bias.offset_v': 'zero-g',
    'scale_factor.offset_v_per_g': 'scale factor',
    'misalignment.alpha_rad': 'misalignment alpha',
    'misalignment.beta_rad': 'misalignment beta',
    'cross_axis.linear': 'zero-g, {other}',
    'cross_axis.quadratic_per_g': 'zero-g, {other}²',
    'cross_axis_z.linear': 'zero-g, {other}',
    'cross_axis_z.quadratic_per_g': 'zero-g, {other}²',
    'scale_factor_cross.linear_per_g': 'scale, {other}',
    'scale_factor_z.linear_per_g': 'scale, {other}',
    'scale_factor_z.quadratic_per_g2': 'scale, {other}²',
    'nonlinearity.cubic_per_g2': 'cubic',
}
"""Parameters in words; {other} is the axis that acts on the measured axis."""
_ANGLES = (Coefficient('misalignment', 'alpha_rad'), Coefficient('misalignment', 'beta_rad'))
"""Parameters of the direction of an axis."""
_LINEAR = (Coefficient('cross_axis', 'linear'), Coefficient('cross_axis_z', 'linear'))
"""Parameters that act as a misalignment does, to first order."""


@dataclass(frozen=True)
class Comparison:
    """A fitted coefficient and its true value."""

    name: str  # 'effect.parameter', as in the parameter file
    axis: str  # 'x', 'y' or 'z'; empty for a coefficient of all axes
    label: str  # The coefficient in words
    unit: str  # Unit of the values: degrees for an angle, else the unit of the parameter
    fitted: float  # The fitted value. Zero-g and scale factor are absolute, in V and V/g.
    half_width: float  # Half of the 90 % interval
    truth: float  # The true value; 0 for an effect that the unit does not have

    @property
    def inside(self) -> bool:
        """Return whether the 90 % interval contains the true value."""
        return abs(self.fitted - self.truth) <= self.half_width


def compare(fitted: Sensor, truth: Sensor) -> list[Comparison]:
    """
    Compare each fitted coefficient with the true one, in the order of the fit.

    A misalignment and a linear cross-axis term are the same to first order. Where the fit has no
    linear cross-axis term, the true one counts as part of the true misalignment.
    """
    if fitted.axes != truth.axes:
        raise UserError(f'the fitted unit has the axes {fitted.axes}, the true unit has '
                        f'{truth.axes}; compare parameter files of one unit')
    names = fitted.covariance_names
    truth = _in_gauge_of_fit(truth, names)
    half_widths = Z_90 * np.sqrt(np.diag(fitted.covariance))
    return [_compared(name, *values) for name, *values in zip(
        names, _absolute(fitted, names), half_widths, _absolute(truth, names))]


def added_effects(fitted: Sensor, truth: Sensor) -> list[str]:
    """Return the effects of the fit that neither the full model nor the unit has."""
    expected = {*full_model.default_terms(fitted.axes), *truth.effects}
    return [effect for effect in fitted.effects if effect not in expected]


def _compared(name: Coefficient, fitted: float, half_width: float, truth: float) -> Comparison:
    """Compare one coefficient, with its label in words and angles in degrees."""
    key = str(name.without_axis)
    acts = name.axis and name.effect in OTHER_AXIS
    other = AXES[OTHER_AXIS[name.effect][AXES.index(name.axis)]] if acts else ''
    unit, scale = parameter_of(name).unit, 1.0
    if unit == 'rad':
        unit, scale = '°', float(np.degrees(1.0))
    return Comparison(key, name.axis, _LABELS.get(key, key).format(other=other),
                      unit.replace('^2', '²'), *(float(scale * value) for value in (
                          fitted, half_width, truth)))


def _absolute(sensor: Sensor, names: tuple[Coefficient, ...]) -> np.ndarray:
    """Return coefficients; zero-g and scale factor include their nominal values, (p,)."""
    values = get(sensor, names)
    for i, name in enumerate(names):
        nominal = _ABSOLUTE.get(name.without_axis)
        if nominal:
            values[i] += getattr(sensor, nominal)[sensor.axes.index(name.axis)]
    return values


def _in_gauge_of_fit(truth: Sensor, names: tuple[Coefficient, ...]) -> Sensor:
    """Return the true unit with the terms of the fit, other linear terms as misalignment."""
    effects = [name.effect for name in (*names, *_LINEAR, *_ANGLES, _SCALE)]
    equivalent = truth = with_neutral(truth, effects)
    for axis in truth.axes:
        moved = [name for name in _on(axis, _LINEAR) if name not in names]
        if moved and all(name in names for name in _on(axis, _ANGLES)):
            equivalent = put(equivalent, *_as_misalignment(truth, axis, moved))
    return equivalent


def _on(axis: str, parameters: Sequence[Coefficient]) -> list[Coefficient]:
    """Name the coefficients of parameters on one axis."""
    return [replace(parameter, axis=axis) for parameter in parameters]


def _as_misalignment(truth: Sensor, axis: str, moved: list[Coefficient]
                     ) -> tuple[list[Coefficient], list[float]]:
    """
    Move linear cross-axis terms of one axis into its misalignment and its scale factor.

    A_d + p·A_c = (Θ_d + p·Θ_c)·f is again a projection of the specific force, along another
    direction and scaled by its length. Products of p with the other terms are neglected.
    """
    case_axis = AXES.index(axis)
    along = _direction(truth, case_axis)
    for name in moved:
        linear, = get(truth, [name])
        along = along + linear * _direction(truth, OTHER_AXIS[name.effect][case_axis])
    length = float(np.linalg.norm(along))
    d = truth.axes.index(axis)
    scale = truth.scale_v_per_g[d] * length - truth.nominal_scale_v_per_g[d]
    changed = [*_on(axis, (*_ANGLES, _SCALE)), *moved]
    return changed, [*_alpha_beta(case_axis, along / length), float(scale), *[0.0] * len(moved)]


def _direction(sensor: Sensor, axis: int) -> np.ndarray:
    """Return the direction of an axis in the case; an unmeasured axis is aligned."""
    if AXES[axis] not in sensor.axes:
        return np.eye(3)[axis]
    return np.array(direction(axis, *get(sensor, _on(AXES[axis], _ANGLES))))


def _alpha_beta(axis: int, along: np.ndarray) -> tuple[float, float]:
    """Return alpha and beta of a unit vector, rad: the inverse of `misalignment.direction`."""
    x, y, z = along
    alpha, sine = [(np.arctan2(-z, x), y), (np.arctan2(z, y), -x), (np.arctan2(-y, z), x)][axis]
    return float(alpha), float(np.arcsin(sine))
