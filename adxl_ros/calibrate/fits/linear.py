# SPDX-License-Identifier: Apache-2.0

"""The manufacturer's linear model: equations 1 to 3."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from adxl_ros.calibrate.poses import Poses, reference_force
from adxl_ros.errors import UserError
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.sensor import Sensor
import numpy as np

_UPRIGHT_COS = np.cos(np.radians(0.5))
"""Smallest cosine of an axis at ±1 g: it is within 0.5° of the vertical, an error of 40 µg."""
_MIN_SPAN_G = 0.2
"""Smallest span of the reference that determines a scale factor, g. Chosen: over a smaller span
cross-axis terms dominate the slope."""


_OPEN_STD_V = 0.5
"""Prior standard deviation of a zero-g that may be open, V. Chosen: far wider than any unit."""
_OPEN_STD_V_PER_G = 0.2
"""Prior standard deviation of a scale factor that may be open, V/g. Chosen: as above."""


class _Line(NamedTuple):
    """A line fitted to one axis."""

    zero_g_v: float  # Volts at 0 g
    scale_v_per_g: float  # Volts per g
    covariance: np.ndarray  # Covariance of both, (2, 2)


def fit(sensor: Sensor, poses: Poses, may_be_open: bool = False) -> Sensor:
    """
    Fit scale factor and zero-g of each axis by least squares over the reference.

    Where an axis has been at +1 g and at −1 g, only those poses count, which is
    SF = (V₊ − V₋)/2 (1) and B = (V₊ + V₋)/2 (2), in g of 9.80665 m/s². Otherwise all poses count.
    The covariance is scaled to the residuals over all poses, so that it covers what the linear
    model leaves out.

    Parameters
    ----------
    sensor
        Nominal values and local gravity of the unit.
    poses
        Poses on the stage.
    may_be_open
        Whether an axis may leave its scale factor open. It is nominal then, with an uncertainty
        that any prior reduces.

    Returns
    -------
    Sensor
        The fitted unit with its covariance.

    Raises
    ------
    UserError
        An axis has not been turned far enough to determine its scale factor.

    """
    gravity_g = sensor.local_gravity_mps2 / G0_MPS2
    force = np.column_stack(reference_force(poses, sensor.local_gravity_mps2)) / G0_MPS2
    lines = [_fit_line(axis, force[:, AXES.index(axis)], poses.volts[:, d], poses.std_v[:, d],
                       gravity_g, _open_line(sensor, d) if may_be_open else None)
             for d, axis in enumerate(sensor.axes)]
    count = len(sensor.axes)
    covariance = np.zeros((2 * count, 2 * count))
    for d, line in enumerate(lines):
        covariance[np.ix_([d, count + d], [d, count + d])] = line.covariance
    zero_g_v = np.array([line.zero_g_v for line in lines])
    scale_v_per_g = np.array([line.scale_v_per_g for line in lines])
    values = {'bias': {'offset_v': zero_g_v - sensor.nominal_zero_g_v},
              'scale_factor': {'offset_v_per_g': scale_v_per_g - sensor.nominal_scale_v_per_g}}
    names = [Coefficient(effect, parameter, axis) for effect, by_parameter in values.items()
             for parameter in by_parameter for axis in sensor.axes]
    return replace(sensor, model='linear', effects=('bias', 'scale_factor'), values=values,
                   covariance=covariance, covariance_names=tuple(names))


def _is_upright(reference_g: np.ndarray, gravity_g: float) -> np.ndarray:
    """Mark the poses that have an axis within 0.5° of the vertical, (k,) bool."""
    return np.abs(reference_g) >= gravity_g * _UPRIGHT_COS


def _fit_line(axis: str, reference_g: np.ndarray, volts: np.ndarray, std_v: np.ndarray,
              gravity_g: float, prior: _Line | None) -> _Line:
    used = _is_upright(reference_g, gravity_g)
    if not ((reference_g[used] > 0).any() and (reference_g[used] < 0).any()):
        used = np.ones(len(volts), bool)
    if prior is not None and np.ptp(reference_g[used]) < _MIN_SPAN_G:
        return _fit_open_line(reference_g, volts, std_v, prior)
    if used.sum() < 2 or np.ptp(reference_g[used]) < _MIN_SPAN_G:
        raise UserError(f'{axis}: its reference spans {np.ptp(reference_g[used]):.2f} g over '
                        f'{used.sum()} poses, which does not determine the scale factor; add '
                        'poses with the axis up and down')
    design = np.column_stack([np.ones(used.sum()), reference_g[used]])
    (zero, scale), *_ = np.linalg.lstsq(design, volts[used], rcond=None)
    residual = volts - zero - scale * reference_g
    variance = max(np.sum(residual ** 2) / max(len(volts) - 2, 1), np.mean(std_v ** 2))
    return _Line(zero, scale, variance * np.linalg.inv(design.T @ design))


def _open_line(sensor: Sensor, axis: int) -> _Line:
    """Return the nominal line of an axis, whose uncertainty is far wider than that of units."""
    return _Line(float(sensor.nominal_zero_g_v[axis]), float(sensor.nominal_scale_v_per_g[axis]),
                 np.diag([_OPEN_STD_V ** 2, _OPEN_STD_V_PER_G ** 2]))


def _fit_open_line(reference_g: np.ndarray, volts: np.ndarray, std_v: np.ndarray, prior: _Line
                   ) -> _Line:
    """Fit a line that its poses do not determine, by its prior."""
    design = np.column_stack([np.ones(len(volts)), reference_g])
    nominal = np.array([prior.zero_g_v, prior.scale_v_per_g])
    residual = volts - design @ nominal
    variance = max(float(np.var(residual, ddof=min(1, len(volts) - 1))),
                   float(np.mean(std_v ** 2)))
    covariance = np.linalg.inv(design.T @ design / variance + np.linalg.inv(prior.covariance))
    zero_g_v, scale_v_per_g = nominal + covariance @ (design.T @ residual) / variance
    return _Line(float(zero_g_v), float(scale_v_per_g), covariance)
