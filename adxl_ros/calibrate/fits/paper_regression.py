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

"""
The paper's staged fit of its nonlinear regression model: equations 4 to 19.

The paper fits bias, g(V_c), h(V_z), SF(V_z) and misalignment one after another. As printed they
overlap, so the gauge is fixed here: p0 and q0 belong to the zero-g B, r0 is the scale factor SF,
and the linear terms p1 and q1, which are a misalignment to first order, go to Θ of (18) and (19)
and nowhere else. g and h are stated in centred accelerations instead of raw volts, so that they
do not depend on the zero-g of the unit.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from adxl_ros.calibrate.fits import linear
from adxl_ros.calibrate.poses import pose_variance, Poses, reference_force
from adxl_ros.errors import UserError
from adxl_ros.model import signal_chain
from adxl_ros.model.coefficients import get
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.kinematics import specific_force
from adxl_ros.model.sensor import Sensor
import numpy as np

EFFECTS = ('bias', 'scale_factor', 'misalignment', 'cross_axis', 'cross_axis_z',
           'scale_factor_z')
_VERTICAL = np.sin(np.radians(89.0))
_FLATTEST = 0.2
"""Planes with |sin α| below this tell no scale factor (15)."""
_SAME_PLANE_RAD = np.radians(1.0)
_REPLICAS = 200


@dataclass(frozen=True)
class AxisRegression:
    """
    What the stages of one axis found, for figures 4 to 8 of the paper.

    p, q, r are coefficients of 1, a, a² in V, V/g, V/g² (r: V/g, ...), before the gauge is
    fixed; `plane_*` have one entry a plane.
    """

    zero_g_v: float
    scale_v_per_g: float
    p: np.ndarray
    q: np.ndarray
    r: np.ndarray
    plane_az_g: np.ndarray
    plane_bias_v: np.ndarray
    plane_scale_v_per_g: np.ndarray


def fit(sensor: Sensor, poses: Poses) -> Sensor:
    """
    Fit the paper's model to the poses of a sweep through several planes alpha.

    Raises
    ------
    UserError
        The planes do not determine the model; says which are missing.

    """
    fitted = _assemble(sensor, poses, regress_axes(sensor, poses))
    return replace(fitted, covariance=_covariance(sensor, fitted, poses))


def regress_axes(sensor: Sensor, poses: Poses) -> list[AxisRegression]:
    """Run the stages for the x and y axes (equations 8 to 17); see `fit`."""
    if not sensor.axes.startswith('xy'):
        raise UserError(f'the physical model needs the axes x and y, not {sensor.axes}; '
                        'fit --model linear')
    start = linear.fit(sensor, poses)
    return [_one_axis(d, start, poses) for d in range(2)]


def planes(alpha_rad: np.ndarray) -> list[np.ndarray]:
    """Group poses by plane: indices of those whose alpha agree within 1°."""
    order = np.argsort(alpha_rad, kind='stable')
    cuts = np.flatnonzero(np.diff(alpha_rad[order]) > _SAME_PLANE_RAD) + 1
    return np.split(order, cuts)


def _one_axis(d: int, start: Sensor, poses: Poses) -> AxisRegression:
    force = np.column_stack(reference_force(poses, start.local_gravity_mps2)) / G0_MPS2
    zero, scale = start.zero_g_v, start.scale_v_per_g
    own, az, volts = force[:, d], force[:, 2], poses.volts[:, d]
    # The stage's V_c, not the measured one: that has misalignment of its own in it, which would
    # leak from p1 into q1 and q2.
    other = force[:, 1 - d]
    vertical = np.abs(np.sin(poses.alpha_rad)) > _VERTICAL
    residual = volts - zero[d] - scale[d] * own                              # (10)
    p = _quadratic(other[vertical], residual[vertical],
                   'the plane alpha = 90 deg', 'poses at steps of 30 deg in beta there')  # (11)
    rest = volts - _polynomial(p, other)
    found = []
    for chosen in planes(poses.alpha_rad):
        inclined = np.abs(np.sin(poses.alpha_rad[chosen]).mean()) >= _FLATTEST
        if inclined and np.ptp(own[chosen]) > 0.1:
            s, b = np.polyfit(own[chosen], rest[chosen], 1)
        else:
            s, b = np.nan, np.mean(rest[chosen] - scale[d] * own[chosen])
        found.append((az[chosen].mean(), b - zero[d], s))                    # (12), (15)
    plane_az, plane_bias, plane_scale = np.array(found).T
    wanted = 'planes alpha = 30, 60, 120 and 150 deg beside 90'
    known = np.isfinite(plane_scale)
    r = _quadratic(plane_az[known], plane_scale[known], 'the inclined planes', wanted)  # (15)
    # q1 is the misalignment's A_z, which the scale factor multiplies like any other force.
    growth = _polynomial(r / r[0], plane_az)
    q = _quadratic(plane_az, plane_bias, 'the planes', wanted, growth)       # (13)
    return AxisRegression(zero[d], scale[d], p, q, r, plane_az, plane_bias, plane_scale)


def _quadratic(a: np.ndarray, values: np.ndarray, where: str, add: str,
               growth: np.ndarray | float = 1.0) -> np.ndarray:
    """Fit the coefficients of 1, a·growth, a², or say what the data lack."""
    if len(planes(a)) < 3 or np.ptp(a) < 0.3:
        raise UserError(f'the physical model is not determined: {len(planes(a))} distinct '
                        f'inputs in {where}, at least 3 are needed; add {add}, or fit '
                        'the linear model')
    design = np.column_stack([np.ones_like(a), a * growth, a * a])
    return np.linalg.lstsq(design, values, rcond=None)[0]


def _polynomial(coefficients: np.ndarray, a: np.ndarray) -> np.ndarray:
    return np.polynomial.polynomial.polyval(a, coefficients)


def _assemble(sensor: Sensor, poses: Poses, of: list[AxisRegression]) -> Sensor:
    """Fix the gauge and state the result in the effects' parameters."""
    count = len(sensor.axes)
    values: dict[str, dict[str, np.ndarray]] = {name: {} for name in EFFECTS}
    zero, scale = sensor.nominal_zero_g_v.copy(), sensor.nominal_scale_v_per_g.copy()
    alpha, beta = np.zeros(count), np.zeros(count)
    terms = {name: np.zeros(count) for name in ('p2', 'q2', 'r1', 'r2')}
    for d, s in enumerate(of):
        slope = s.r[0]
        turn, tilt = np.arcsin(s.p[1] / slope), np.arcsin(s.q[1] / slope)
        beta[d], alpha[d] = (turn, -tilt) if d == 0 else (-turn, tilt)       # (18), (19)
        zero[d] = s.zero_g_v + s.p[0] + s.q[0]
        scale[d] = slope / (np.cos(turn) * np.cos(tilt))
        terms['p2'][d], terms['q2'][d] = s.p[2] / scale[d], s.q[2] / scale[d]
        terms['r1'][d], terms['r2'][d] = s.r[1:] / slope
    if count == 3:
        zero[2], scale[2], alpha[2], beta[2] = _out_of_plane(sensor, poses)
    values['bias']['offset_v'] = zero - sensor.nominal_zero_g_v
    values['scale_factor']['offset_v_per_g'] = scale - sensor.nominal_scale_v_per_g
    values['misalignment'] = {'alpha_rad': alpha, 'beta_rad': beta}
    values['cross_axis'] = {'linear': np.zeros(count), 'quadratic_per_g': terms['p2']}
    values['cross_axis_z'] = {'linear': np.zeros(count), 'quadratic_per_g': terms['q2']}
    values['scale_factor_z'] = {'linear_per_g': terms['r1'], 'quadratic_per_g2': terms['r2']}
    names = [Coefficient(effect, parameter, axis) for effect, of_effect in values.items()
             for parameter in of_effect if (effect, parameter) not in _GAUGE
             for axis in sensor.axes
             if axis != 'z' or effect in ('bias', 'scale_factor', 'misalignment')]
    return replace(sensor, model='physical', effects=EFFECTS, values=values,
                   covariance_names=tuple(names))


_GAUGE = {('cross_axis', 'linear'), ('cross_axis_z', 'linear')}


def _out_of_plane(sensor: Sensor, poses: Poses) -> tuple[float, float, float, float]:
    """Zero-g, scale and direction of a z axis by least squares: the paper has no model of it."""
    force = np.column_stack(reference_force(poses, sensor.local_gravity_mps2)) / G0_MPS2
    design = np.column_stack([np.ones(len(poses)), force])
    (zero, tx, ty, tz), *_ = np.linalg.lstsq(design, poses.volts[:, 2], rcond=None)
    scale = np.sqrt(tx * tx + ty * ty + tz * tz)
    beta = np.arcsin(tx / scale)
    return zero, scale, np.arcsin(-ty / scale / np.cos(beta)), beta


def _covariance(sensor: Sensor, fitted: Sensor, poses: Poses) -> np.ndarray:
    """
    Covariance of the staged estimates by parametric bootstrap, (k, k).

    The stages weigh the poses in their own way, so that no least-squares formula holds: the
    sweep is drawn anew from the fitted model, with the noise of the means and an encoder error
    uniform within its step for each setting of a joint, and fitted again. Deviations are widened
    by what the residuals show beyond noise and encoder (effects that the model does not hold).
    """
    respond = signal_chain.static_response(fitted)
    predicted = np.column_stack(respond(reference_force(poses, fitted.local_gravity_mps2)))
    chi2 = np.sum((poses.volts - predicted) ** 2 / pose_variance(fitted, poses))
    freedom = max(poses.volts.size - len(fitted.covariance_names), 1)
    widen = np.sqrt(max(chi2 / freedom, 1.0))
    rng = np.random.default_rng(0)
    drawn = []
    for _ in range(_REPLICAS):
        slack = [widen * fitted.stage_resolution_rad * rng.uniform(
            -0.5, 0.5, int(setting.max()) + 1)[setting]
            for setting in (poses.alpha_setting, poses.beta_setting)]
        volts = np.column_stack(respond(specific_force(
            poses.alpha_rad + slack[0], poses.beta_rad + slack[1], fitted.local_gravity_mps2)))
        volts += widen * poses.std_v * rng.standard_normal(volts.shape)
        again = replace(poses, volts=volts)
        drawn.append(get(_assemble(sensor, again, regress_axes(sensor, again)),
                         fitted.covariance_names))
    return np.cov(np.array(drawn).T)
