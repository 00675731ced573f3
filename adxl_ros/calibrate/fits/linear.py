# SPDX-License-Identifier: Apache-2.0

"""The linear model, equations 1 to 3, and the paper's sequential fit, equations 4 to 19."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

from adxl_ros.calibrate.pose_model import angle_jacobian, reference_force
from adxl_ros.calibrate.poses import planes, Poses
from adxl_ros.errors import UserError
from adxl_ros.model import signal_chain
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.sensor import coefficients_of, get, Sensor
from adxl_ros.wording import usage
import numpy as np

AFFINE = ('bias', 'scale_factor', 'misalignment')
"""Terms of the twelve coefficients of a three-axis sensor that six known faces determine."""

_UPRIGHT_COS = np.cos(np.radians(0.5))
"""Smallest cosine of an axis at ±1 g: it is within 0.5° of the vertical, an error of 40 µg."""
_MIN_SPAN_G = 0.2
"""Smallest span of the reference that determines a scale factor, g. Over a smaller one, cross-axis
terms of 1 % of the other axes change the slope by more than a typical error of it, 4 %."""
EFFECTS = ('bias', 'scale_factor', 'misalignment', 'cross_axis', 'cross_axis_z', 'scale_factor_z')
"""Effects of the paper's model."""
_GAUGE = {('cross_axis', 'linear'), ('cross_axis_z', 'linear')}
"""Effect and parameter of the coefficients that stay 0."""
_OF_Z_AXIS = ('bias', 'scale_factor', 'misalignment')
"""Effects of a z axis: the paper has no model of it."""
_VERTICAL_SIN = np.sin(np.radians(89.0))  # Planes with a greater |sin α| count as vertical
_MIN_PLANE_SIN = 0.2  # Planes with |sin α| below this do not determine a scale factor (15)
_MIN_PLANE_SPAN_G = 0.1  # Smallest span of the reference in a plane that determines a scale factor
_MIN_INPUTS = 3  # Smallest number of distinct inputs that determine a quadratic
_MIN_INPUT_SPAN_G = 0.3  # Smallest span of the inputs that determine a quadratic, g
_REPLICAS = 200  # Sweeps of the parametric bootstrap: the standard deviations are known to 5 %


def fit(sensor: Sensor, poses: Poses) -> Sensor:
    """
    Fit scale factor and zero-g of each axis by least squares over the reference.

    Where an axis has been at +1 g and at −1 g, only those poses count, which is
    SF = (V₊ − V₋)/2 (1) and B = (V₊ + V₋)/2 (2), in g of 9.80665 m/s². Otherwise all poses count.
    The covariance is scaled to the residuals over all poses, so that it covers what the linear
    model leaves out. Poses that do not determine a scale factor are refused.
    """
    force = np.column_stack(reference_force(poses, sensor.local_gravity_mps2)) / G0_MPS2
    nominal = np.column_stack([sensor.nominal_zero_g_v, sensor.nominal_scale_v_per_g])
    count = len(sensor.axes)
    lines = np.zeros((count, 2))
    covariance = np.zeros((2 * count, 2 * count))
    for d, axis in enumerate(sensor.axes):
        reference_g = force[:, AXES.index(axis)]
        upright_g = sensor.local_gravity_mps2 / G0_MPS2 * _UPRIGHT_COS
        is_up, is_down = reference_g >= upright_g, reference_g <= -upright_g
        used = is_up | is_down
        if not (is_up.any() and is_down.any()):
            used = np.ones(len(poses), bool)
        span_g = np.ptp(reference_g[used])
        if used.sum() < 2 or span_g < _MIN_SPAN_G:
            raise UserError(
                f'{axis}: its reference spans {span_g:.2f} g over {used.sum()} poses, '
                'which does not determine the scale factor; add poses with the axis '
                'up and down'
            )
        design = np.column_stack([np.ones(len(poses)), reference_g])
        departure = poses.volts[:, d] - design @ nominal[d]
        change = np.linalg.lstsq(design[used], departure[used], rcond=None)[0]
        lines[d] = nominal[d] + change
        variance = max(
            np.sum((departure - design @ change) ** 2) / max(len(poses) - 2, 1),
            np.mean(poses.std_v[:, d] ** 2),
        )
        covariance[np.ix_([d, count + d], [d, count + d])] = np.linalg.inv(
            design[used].T @ design[used] / variance
        )
    values = {
        'bias': {'offset_v': lines[:, 0] - sensor.nominal_zero_g_v},
        'scale_factor': {'offset_v_per_g': lines[:, 1] - sensor.nominal_scale_v_per_g},
    }
    return replace(
        sensor,
        model='linear',
        effects=('bias', 'scale_factor'),
        values=values,
        covariance=covariance,
        covariance_names=tuple(coefficients_of(values, sensor.axes)),
    )


@dataclass(frozen=True)
class AxisRegression:
    """Regressions of one axis before the gauge is fixed, for figures 4 to 8 of the paper."""

    zero_g_v: float  # Of the linear model
    scale_v_per_g: float
    # p, q: Coefficients of 1, a, a² in g(V_c) (11) and h(V_z) (13): V, V/g, V/g², (3,)
    p: np.ndarray
    q: np.ndarray
    r: np.ndarray  # Coefficients of 1, a, a² in SF(V_z) (15): V/g, V/g², V/g³, (3,)
    plane_az_g: np.ndarray  # Mean reference of z in each of n planes, g, (n,)
    plane_bias_v: np.ndarray  # Bias of each plane minus the zero-g, V, (n,)
    # Scale factor of each plane, V/g, (n,); NaN where the plane does not determine it
    plane_scale_v_per_g: np.ndarray


def fit_physical(sensor: Sensor, poses: Poses) -> Sensor:
    """Fit the paper's model to a sweep through several planes alpha; name missing planes."""
    fitted = _assemble(sensor, poses, regress_axes(sensor, poses))
    return replace(fitted, covariance=_covariance(sensor, fitted, poses))


def regress_axes(sensor: Sensor, poses: Poses) -> list[AxisRegression]:
    """Fit the regressions of the x and y axes (equations 8 to 17)."""
    if not sensor.axes.startswith('xy'):
        raise UserError(
            f'the physical model needs the axes x and y, not {sensor.axes}; '
            + usage('fit', model='linear')
        )
    start = fit(sensor, poses)
    return [_regress_axis(d, start, poses) for d in range(2)]


def _regress_axis(d: int, start: Sensor, poses: Poses) -> AxisRegression:
    force = np.column_stack(reference_force(poses, start.local_gravity_mps2)) / G0_MPS2
    zero, scale = start.zero_g_v[d], start.scale_v_per_g[d]
    along = force[:, d]
    az = force[:, 2]
    volts = poses.volts[:, d]
    # The measured value of the other axis would add its misalignment to q1 and q2.
    across = force[:, 1 - d]
    vertical = np.abs(np.sin(poses.alpha_rad)) > _VERTICAL_SIN
    residual = volts - zero - scale * along  # (10)
    p = _quadratic(
        across[vertical],
        residual[vertical],
        'the plane alpha = 90 deg',
        'poses at steps of 30 deg in beta there',
    )  # (11)
    corrected = volts - np.polynomial.polynomial.polyval(across, p)
    # Mean reference of z, offset and slope of each plane: (12), (15)
    rows = []
    for plane in planes(poses.alpha_rad):
        is_inclined = np.abs(np.sin(poses.alpha_rad[plane]).mean()) >= _MIN_PLANE_SIN
        if is_inclined and np.ptp(along[plane]) > _MIN_PLANE_SPAN_G:
            slope, offset = np.polyfit(along[plane], corrected[plane], 1)
        else:
            slope = np.nan
            offset = np.mean(corrected[plane] - scale * along[plane])
        rows.append([az[plane].mean(), offset, slope])
    plane_az, plane_offset, plane_scale = np.array(rows).T
    plane_bias = plane_offset - zero
    missing = 'planes alpha = 30, 60, 120 and 150 deg beside 90'
    has_scale = np.isfinite(plane_scale)
    r = _quadratic(plane_az[has_scale], plane_scale[has_scale], 'the inclined planes', missing)
    # q1 is the misalignment's A_z, which the scale factor multiplies like any other force.
    growth = np.polynomial.polynomial.polyval(plane_az, r / r[0])
    q = _quadratic(plane_az, plane_bias, 'the planes', missing, growth)  # (13)
    return AxisRegression(
        zero_g_v=zero,
        scale_v_per_g=scale,
        p=p,
        q=q,
        r=r,
        plane_az_g=plane_az,
        plane_bias_v=plane_bias,
        plane_scale_v_per_g=plane_scale,
    )


def _quadratic(
    a: np.ndarray, values: np.ndarray, where: str, missing: str, growth: np.ndarray | float = 1.0
) -> np.ndarray:
    """Fit the coefficients of 1, a·growth, a², (3,), for inputs a, g; refuse too few inputs."""
    # Inputs within 0.017 g are one, as angles within 1° are.
    if len(planes(a)) < _MIN_INPUTS or np.ptp(a) < _MIN_INPUT_SPAN_G:
        raise UserError(
            f'the physical model is not determined: {len(planes(a))} distinct '
            f'inputs in {where}, at least {_MIN_INPUTS} are needed; add {missing}, '
            'or fit the linear model'
        )
    design = np.column_stack([np.ones_like(a), a * growth, a * a])
    return np.linalg.lstsq(design, values, rcond=None)[0]


def _assemble(sensor: Sensor, poses: Poses, regressions: list[AxisRegression]) -> Sensor:
    """Fix the gauge and convert the regressions into parameters of effects."""
    count = len(sensor.axes)
    zero = sensor.nominal_zero_g_v.copy()
    scale = sensor.nominal_scale_v_per_g.copy()
    alpha, beta, p2, q2, r1, r2 = np.zeros((6, count))
    for d, axis in enumerate(regressions):
        slope = axis.r[0]
        if max(abs(axis.p[1]), abs(axis.q[1])) >= abs(slope):
            raise UserError(
                f'the physical model does not hold: {sensor.axes[d]} follows another '
                'axis more than its own; check wiring, mounting and poses'
            )
        turn, tilt = np.arcsin(axis.p[1] / slope), np.arcsin(axis.q[1] / slope)
        beta[d], alpha[d] = (turn, -tilt) if d == 0 else (-turn, tilt)  # (18), (19)
        zero[d] = axis.zero_g_v + axis.p[0] + axis.q[0]
        scale[d] = slope / (np.cos(turn) * np.cos(tilt))
        p2[d], q2[d] = axis.p[2] / scale[d], axis.q[2] / scale[d]
        r1[d], r2[d] = axis.r[1:] / slope
    if count == 3:
        fitted = _fit_z_axis(sensor, poses)
        zero[2] = fitted.zero_g_v
        scale[2] = fitted.scale_v_per_g
        alpha[2] = fitted.alpha_rad
        beta[2] = fitted.beta_rad
    values = {
        'bias': {'offset_v': zero - sensor.nominal_zero_g_v},
        'scale_factor': {'offset_v_per_g': scale - sensor.nominal_scale_v_per_g},
        'misalignment': {'alpha_rad': alpha, 'beta_rad': beta},
        'cross_axis': {'linear': np.zeros(count), 'quadratic_per_g': p2},
        'cross_axis_z': {'linear': np.zeros(count), 'quadratic_per_g': q2},
        'scale_factor_z': {'linear_per_g': r1, 'quadratic_per_g2': r2},
    }
    names = [
        name
        for name in coefficients_of(EFFECTS, sensor.axes)
        if (name.effect, name.parameter) not in _GAUGE
        and (name.axis != 'z' or name.effect in _OF_Z_AXIS)
    ]
    return replace(
        sensor, model='physical', effects=EFFECTS, values=values, covariance_names=tuple(names)
    )


class _ZAxis(NamedTuple):
    """Coefficients of a z axis."""

    zero_g_v: float
    scale_v_per_g: float
    # Misalignment
    alpha_rad: float
    beta_rad: float


def _fit_z_axis(sensor: Sensor, poses: Poses) -> _ZAxis:
    """Fit zero-g, scale factor and direction of a z axis."""
    force = np.column_stack(reference_force(poses, sensor.local_gravity_mps2)) / G0_MPS2
    design = np.column_stack([np.ones(len(poses)), force])
    zero, tx, ty, tz = np.linalg.lstsq(design, poses.volts[:, 2], rcond=None)[0]
    scale = np.sqrt(tx * tx + ty * ty + tz * tz)
    beta = np.arcsin(tx / scale)
    return _ZAxis(zero, scale, np.arcsin(-ty / scale / np.cos(beta)), beta)


def _covariance(sensor: Sensor, fitted: Sensor, poses: Poses) -> np.ndarray:
    """
    Return the covariance of the sequential estimates by parametric bootstrap, (p, p).

    Each step of the fit weights the poses differently, so that no formula of least squares
    holds. Sweeps are drawn from the fitted model and fitted again, with the noise of the means and
    an encoder error uniform within its step for each setting of a joint. Deviations are widened
    where the residuals exceed noise and encoder step (effects that the model does not hold).
    """
    respond = signal_chain.static_response(fitted)
    predicted = np.column_stack(respond(reference_force(poses, fitted.local_gravity_mps2)))
    # An encoder of step r leaves the true angle uniform within it: its variance is r²/12.
    variance = poses.std_v**2 + np.sum(
        angle_jacobian(fitted, poses) ** 2 * fitted.stage_std_rad**2, axis=2
    )
    chi2 = np.sum((poses.volts - predicted) ** 2 / variance)
    widening = np.sqrt(max(chi2 / max(poses.volts.size - len(fitted.covariance_names), 1), 1.0))
    rng = np.random.default_rng(0)

    def encoder_error_rad(setting: np.ndarray) -> np.ndarray:
        by_setting = rng.uniform(-0.5, 0.5, int(setting.max()) + 1)
        return widening * fitted.stage_resolution_rad * by_setting[setting]

    drawn = []
    for _ in range(_REPLICAS):
        turned = replace(
            poses,
            alpha_rad=poses.alpha_rad + encoder_error_rad(poses.alpha_setting),
            beta_rad=poses.beta_rad + encoder_error_rad(poses.beta_setting),
        )
        volts = np.column_stack(respond(reference_force(turned, fitted.local_gravity_mps2)))
        volts += widening * poses.std_v * rng.standard_normal(volts.shape)
        replica = replace(poses, volts=volts)
        refitted = _assemble(sensor, replica, regress_axes(sensor, replica))
        drawn.append(get(refitted, fitted.covariance_names))
    return np.cov(np.array(drawn).T)
