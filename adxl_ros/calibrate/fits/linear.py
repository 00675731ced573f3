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

"""The manufacturer's linear model: equations 1 to 3."""

from __future__ import annotations

from dataclasses import replace

from adxl_ros.calibrate.poses import Poses, reference_force
from adxl_ros.errors import UserError
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.sensor import Sensor
import numpy as np

_UPRIGHT = np.cos(np.radians(0.5))
"""Within 0.5° an axis counts as at ±1 g: the cosine errs by 40 µg at most."""


def fit(sensor: Sensor, poses: Poses) -> Sensor:
    """
    Fit scale factor and zero-g of each axis by least squares over the reference.

    Where an axis has been at +1 g and at −1 g, those poses alone count, which is
    SF = (V₊ − V₋)/2 (1) and B = (V₊ + V₋)/2 (2), in g of 9.80665 m/s²; else all poses do. The
    covariance is scaled to the residuals over all poses, so that it covers what the linear
    model leaves out.

    Raises
    ------
    UserError
        An axis has not been turned far enough to tell its scale factor.

    """
    force = np.column_stack(reference_force(poses, sensor.local_gravity_mps2)) / G0_MPS2
    zero, scale, covariance = [], [], []
    for d, axis in enumerate(sensor.axes):
        b, s, c = _one_axis(axis, force[:, AXES.index(axis)], poses.volts[:, d],
                            poses.std_v[:, d], sensor.local_gravity_mps2 / G0_MPS2)
        zero.append(b)
        scale.append(s)
        covariance.append(c)
    count = len(sensor.axes)
    full = np.zeros((2 * count, 2 * count))
    for d, c in enumerate(covariance):
        full[np.ix_([d, count + d], [d, count + d])] = c
    values = {'bias': {'offset_v': np.array(zero) - sensor.nominal_zero_g_v},
              'scale_factor': {'offset_v_per_g': np.array(scale) - sensor.nominal_scale_v_per_g}}
    names = [Coefficient('bias', 'offset_v', axis) for axis in sensor.axes] + \
            [Coefficient('scale_factor', 'offset_v_per_g', axis) for axis in sensor.axes]
    return replace(sensor, model='linear', effects=('bias', 'scale_factor'), values=values,
                   covariance=full, covariance_names=tuple(names))


def upright(reference_g: np.ndarray, gravity_g: float) -> np.ndarray:
    """Tell which poses have the axis at ±1 g, (k,) of its reference in g."""
    return np.abs(reference_g) >= gravity_g * _UPRIGHT


def _one_axis(axis: str, reference_g: np.ndarray, volts: np.ndarray, std_v: np.ndarray,
              gravity_g: float) -> tuple[float, float, np.ndarray]:
    used = upright(reference_g, gravity_g)
    if not ((reference_g[used] > 0).any() and (reference_g[used] < 0).any()):
        used = np.ones(len(volts), bool)
    if used.sum() < 2 or np.ptp(reference_g[used]) < 0.2:
        raise UserError(f'{axis}: its reference spans {np.ptp(reference_g[used]):.2f} g over '
                        f'{used.sum()} poses, which does not determine the scale factor; add '
                        'poses with the axis up and down')
    design = np.column_stack([np.ones(used.sum()), reference_g[used]])
    (zero, scale), *_ = np.linalg.lstsq(design, volts[used], rcond=None)
    residual = volts - zero - scale * reference_g
    spread = max(np.sum(residual ** 2) / max(len(volts) - 2, 1), np.mean(std_v ** 2))
    return zero, scale, spread * np.linalg.inv(design.T @ design)
