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

"""Figures 2 to 8 of the paper for one unit, and the magnitudes of a gravity calibration."""

from __future__ import annotations

import os
from typing import Any

from adxl_ros.calibrate import linear, physical
from adxl_ros.calibrate.poses import Poses, reference_force
from adxl_ros.errors import UserError
from adxl_ros.files.atomic import atomic_path
from adxl_ros.model import chain
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.sensor import Sensor
import numpy as np

_FINE_G = np.linspace(-1, 1, 201)


def draw_sweep(path: str | os.PathLike, sensor: Sensor, fitted: Sensor, poses: Poses) -> None:
    """
    Draw figures 2 to 8 of the paper for the x and y axes, one row an axis, as PNG.

    Parameters
    ----------
    path
        The file to write.
    sensor
        The nominal figures that the fit started from.
    fitted
        The physical model of the unit.
    poses
        The sweep, check poses among them.

    """
    swept = poses.subset(~poses.check)
    start, of = linear.fit(sensor, swept), physical.stages(sensor, swept)
    force = np.column_stack(reference_force(swept, sensor.local_gravity_mps2)) / G0_MPS2
    predicted = np.column_stack(chain.static_response(fitted)(
        reference_force(swept, sensor.local_gravity_mps2)))
    figure, grid = pyplot().subplots(2, 6, figsize=(26, 9), layout='constrained')
    for d, row in enumerate(grid):
        straight = start.zero_g_v[d] + start.scale_v_per_g[d] * force[:, d]
        deviation = 1e3 * (swept.volts[:, d] - straight)
        after = 1e3 * (predicted[:, d] - straight)
        vertical = np.abs(np.sin(swept.alpha_rad)) > np.sin(np.radians(89))
        _paths(row[0], d, force, swept, deviation, vertical)
        _paths(row[1], d, force, swept, deviation, np.ones(len(swept), bool))
        _across(row[2], d, force, deviation, of[d], vertical)
        _modelled(row[3], d, force, swept, deviation, after)
        _along_z(row[4], d, of[d].plane_az_g, 1e3 * of[d].plane_bias_v, 1e3 * of[d].q,
                 'bias minus bias at 90°, mV', 'fig. 6: bias against z (12, 13)')
        _along_z(row[5], d, of[d].plane_az_g, of[d].plane_scale_v_per_g, of[d].r,
                 'scale factor, V/g', 'fig. 8: scale factor against z (15, 17)')
    figure.suptitle(f'{fitted.serial}: deviation from the linear model, and what the physical '
                    'model makes of it (Ang et al. 2007, figures 2 to 8)')
    write(figure, path)


def draw_gravity(path: str | os.PathLike, name: str, before_mps2: np.ndarray,
                 after_mps2: np.ndarray, std_mps2: np.ndarray) -> None:
    """
    Draw the error of the magnitude of gravity over the rests, before and after, as PNG.

    Parameters
    ----------
    path
        The file to write.
    name
        Of the unit.
    before_mps2, after_mps2
        |f| − g of each rest by the nominal figures and by the fit, m/s², (k,).
    std_mps2
        Standard deviation of the rest's mean, m/s², (k,).

    """
    figure, axes = pyplot().subplots(1, 2, figsize=(12, 4.5), layout='constrained')
    rests = np.arange(1, len(after_mps2) + 1)
    for axis, values, title in ((axes[0], before_mps2, 'nominal'),
                                (axes[1], after_mps2, 'calibrated')):
        mg = values / G0_MPS2 * 1e3
        axis.axhline(0, color='0.7', lw=0.8)
        axis.errorbar(rests, mg, yerr=1.645 * std_mps2 / G0_MPS2 * 1e3, fmt='o', ms=4, lw=1)
        axis.set(title=f'{title}: rms {np.sqrt(np.mean(mg ** 2)):.2f} mg', xlabel='rest',
                 ylabel='magnitude minus gravity, mg')
    figure.suptitle(f'{name}: {len(rests)} rests (bars: 90 %, expected)')
    write(figure, path)


def _paths(axis: Any, d: int, force: np.ndarray, poses: Poses, deviation: np.ndarray,
           chosen: np.ndarray) -> None:
    alpha = np.degrees(poses.alpha_rad)
    turn = np.gradient(poses.beta_rad) < 0
    for plane in physical.planes(poses.alpha_rad[chosen]):
        index = np.flatnonzero(chosen)[np.sort(plane)]
        line, = axis.plot(force[index, d], deviation[index], lw=1,
                          label=f'{alpha[index].mean():.0f}°')
        for back, marker in ((False, 'o'), (True, '<')):
            part = index[turn[index] == back]
            axis.plot(force[part, d], deviation[part], marker, ms=4, color=line.get_color(),
                      mfc='none' if back else None)
    number = 3 if chosen.all() else 2
    axis.legend(title='alpha', fontsize=7)
    axis.set(xlabel=f'{"xy"[d]} reference, g', ylabel=f'{"xy"[d]} output minus linear, mV',
             title=f'fig. {number}: paths, forth ● and back ◁')


def _across(axis: Any, d: int, force: np.ndarray, deviation: np.ndarray, of: physical.Stages,
            vertical: np.ndarray) -> None:
    axis.plot(force[vertical, 1 - d], deviation[vertical], 'o', ms=4, label='measured (10)')
    axis.plot(_FINE_G, 1e3 * np.polynomial.polynomial.polyval(_FINE_G, of.p),
              label='quadratic (11)')
    axis.legend(fontsize=7)
    axis.set(xlabel=f'{"yx"[d]} reference, g', ylabel=f'{"xy"[d]} residual, mV',
             title=f'fig. 4: residual against {"yx"[d]}, alpha = 90°')


def _modelled(axis: Any, d: int, force: np.ndarray, poses: Poses, deviation: np.ndarray,
              after: np.ndarray) -> None:
    for plane in physical.planes(poses.alpha_rad):
        index = np.sort(plane)
        line, = axis.plot(force[index, d], deviation[index], 'o', ms=3,
                          label=f'{np.degrees(poses.alpha_rad[index]).mean():.0f}°')
        axis.plot(force[index, d], after[index], lw=1, color=line.get_color())
    axis.legend(title='alpha', fontsize=7)
    axis.set(xlabel=f'{"xy"[d]} reference, g', ylabel=f'{"xy"[d]} output minus linear, mV',
             title='figs. 5, 7: measured ● and physical model ─')


def _along_z(axis: Any, d: int, az_g: np.ndarray, values: np.ndarray, curve: np.ndarray,
             label: str, title: str) -> None:
    fine = np.linspace(az_g.min(), az_g.max(), 101)
    axis.plot(az_g, values, 'o', ms=4)
    axis.plot(fine, np.polynomial.polynomial.polyval(fine, curve))
    axis.set(xlabel='z reference, g', ylabel=f'{"xy"[d]} {label}', title=title)


def pyplot() -> Any:
    """Return matplotlib's drawing functions, without a display."""
    try:
        import matplotlib
    except ImportError:
        raise UserError('plots need matplotlib; pip install matplotlib') from None
    matplotlib.use('Agg')
    import matplotlib.pyplot
    return matplotlib.pyplot


def write(figure: Any, path: str | os.PathLike) -> None:
    """Write a figure as PNG, whole or not at all."""
    with atomic_path(path) as fresh:
        figure.savefig(fresh, dpi=80, format='png')
    pyplot().close(figure)
