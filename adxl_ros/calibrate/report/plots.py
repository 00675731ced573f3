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

from collections.abc import Callable, Sequence
import os
from typing import Any

from adxl_ros.calibrate.fits import linear, paper_regression
from adxl_ros.calibrate.fits.gravity_fit import GravityFit
from adxl_ros.calibrate.poses import Poses, reference_force
from adxl_ros.calibrate.report.cross_validation import Score
from adxl_ros.files.plot_file import pyplot, write_plot
from adxl_ros.model import signal_chain
from adxl_ros.model.constants import G0_MPS2, Z_90
from adxl_ros.model.sensor import Sensor
import numpy as np

_FINE_G = np.linspace(-1, 1, 201)


def draw_sweep(path: str | os.PathLike, sensor: Sensor, fitted: Sensor, poses: Poses) -> None:
    """Draw `sweep` as PNG."""
    write_plot(sweep(sensor, fitted, poses), path)


def sweep(sensor: Sensor, fitted: Sensor, poses: Poses, panels: Sequence[int] = range(6)) -> Any:
    """
    Draw figures 2 to 8 of the paper for the x and y axes, one row an axis.

    Parameters
    ----------
    sensor
        The nominal figures that the fit started from.
    fitted
        The physical model of the unit.
    poses
        The sweep, check poses among them.
    panels
        Which: figures 2, 3, 4, 5 with 7, 6 and 8, counted from 0.

    """
    swept = poses.subset(~poses.check)
    start, of = linear.fit(sensor, swept), paper_regression.regress_axes(sensor, swept)
    force = np.column_stack(reference_force(swept, sensor.local_gravity_mps2)) / G0_MPS2
    predicted = np.column_stack(signal_chain.static_response(fitted)(
        reference_force(swept, sensor.local_gravity_mps2)))
    figure, grid = pyplot().subplots(2, len(panels), figsize=(4.4 * len(panels), 9),
                                     layout='constrained', squeeze=False)
    for d, row in enumerate(grid):
        straight = start.zero_g_v[d] + start.scale_v_per_g[d] * force[:, d]
        draw = _panels(d, force, swept, 1e3 * (swept.volts[:, d] - straight),
                       1e3 * (predicted[:, d] - straight), of[d])
        for axis, panel in zip(row, panels):
            draw[panel](axis)
    if len(panels) > 4:
        figure.suptitle(f'{fitted.serial}: deviation from the linear model, and what the physical '
                        'model makes of it (Ang et al. 2007, figures 2 to 8)')
    return figure


def _panels(d: int, force: np.ndarray, swept: Poses, deviation: np.ndarray, after: np.ndarray,
            of: paper_regression.AxisRegression) -> list[Callable[[Any], None]]:
    vertical = np.abs(np.sin(swept.alpha_rad)) > np.sin(np.radians(89))
    return [
        lambda axis: _paths(axis, d, force, swept, deviation, vertical),
        lambda axis: _paths(axis, d, force, swept, deviation, np.ones(len(swept), bool)),
        lambda axis: _across(axis, d, force, deviation, of, vertical),
        lambda axis: _modelled(axis, d, force, swept, deviation, after),
        lambda axis: _along_z(axis, d, of.plane_az_g, 1e3 * of.plane_bias_v, 1e3 * of.q,
                              'bias minus bias at 90°, mV', 'fig. 6: bias against z (12, 13)'),
        lambda axis: _along_z(axis, d, of.plane_az_g, of.plane_scale_v_per_g, of.r,
                              'scale factor, V/g', 'fig. 8: scale factor against z (15, 17)')]


def gravity_rests(name: str, fit: GravityFit) -> Any:
    """
    Draw the error of the magnitude of gravity over the rests, before and after.

    Parameters
    ----------
    name
        Of the unit.
    fit
        Of its rests.

    """
    figure, axes = pyplot().subplots(1, 2, figsize=(12, 4.5), layout='constrained')
    rests = np.arange(1, len(fit.residual_mps2) + 1)
    for axis, values, title in ((axes[0], fit.before_mps2, 'nominal'),
                                (axes[1], fit.residual_mps2, 'calibrated')):
        mg = values / G0_MPS2 * 1e3
        axis.axhline(0, color='0.7', lw=0.8)
        axis.errorbar(rests, mg, yerr=Z_90 * fit.expected_mps2 / G0_MPS2 * 1e3, fmt='o', ms=4,
                      lw=1)
        axis.set(title=f'{title}: rms {np.sqrt(np.mean(mg ** 2)):.2f} mg', xlabel='rest',
                 ylabel='magnitude minus gravity, mg')
    figure.suptitle(f'{name}: {len(rests)} rests (bars: 90 %, expected)')
    return figure


def held_out(scores: Sequence[Score], poses: Poses) -> Any:
    """
    Draw the errors of tilt on poses held out, model by model, as figure 10 of the paper does.

    Parameters
    ----------
    scores
        With their errors.
    poses
        All of them, as they were scored.

    """
    figure, axes = pyplot().subplots(1, 3, figsize=(13, 4), layout='constrained')
    for i, score in enumerate(scores):
        if score.errors is None:
            continue
        alpha = np.degrees(poses.alpha_rad[score.index])
        mg = np.sqrt(np.mean(score.errors.accel_mps2 ** 2, axis=1)) / G0_MPS2 * 1e3
        for axis, values in zip(axes, (np.degrees(score.errors.alpha_rad),
                                       np.degrees(score.errors.beta_rad), mg)):
            axis.plot(alpha, np.abs(values), 'os^D'[i % 4], ms=4, mfc='none', color=f'C{i}',
                      label=score.model)
    for axis, label in zip(axes, ('|error of alpha|, deg', '|error of beta|, deg',
                                  'error of acceleration, mg')):
        axis.set(xlabel='alpha of the pose, deg', ylabel=label, yscale='log')
        # A pose that is right by chance must not squeeze the others.
        axis.set_ylim(bottom=1e-6 * axis.get_ylim()[1])
        axis.grid(alpha=0.3)
    axes[0].legend(fontsize=8)
    return figure


def drift(dates: Sequence[Any], axes: str, zero_mg: np.ndarray, scale_permille: np.ndarray,
          zero_std_mg: np.ndarray, scale_std_permille: np.ndarray) -> Any:
    """
    Draw zero-g and scale factor of a unit over its calibrations, relative to the newest.

    Parameters
    ----------
    dates
        Of the calibrations, (k,).
    axes
        Measured axes.
    zero_mg, scale_permille
        Less those of the newest, (k, m).
    zero_std_mg, scale_std_permille
        Their standard deviations, (k, m).

    """
    figure, row = pyplot().subplots(1, 2, figsize=(12, 3.6), layout='constrained')
    for axis, values, std, label in ((row[0], zero_mg, zero_std_mg, 'zero-g, mg'),
                                     (row[1], scale_permille, scale_std_permille,
                                      'scale factor, ‰')):
        for d, name in enumerate(axes):
            axis.errorbar(dates, values[:, d], yerr=Z_90 * std[:, d], fmt='-' + 'os^'[d], ms=5,
                          lw=1, capsize=3, label=name)
        axis.axhline(0, color='0.7', lw=0.8)
        axis.set(ylabel=f'{label}, less the newest')
        axis.tick_params(axis='x', rotation=20)
        axis.legend(fontsize=8)
    return figure


def _paths(axis: Any, d: int, force: np.ndarray, poses: Poses, deviation: np.ndarray,
           chosen: np.ndarray) -> None:
    alpha = np.degrees(poses.alpha_rad)
    turn = np.gradient(poses.beta_rad) < 0
    for plane in paper_regression.planes(poses.alpha_rad[chosen]):
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


def _across(axis: Any, d: int, force: np.ndarray, deviation: np.ndarray,
            of: paper_regression.AxisRegression, vertical: np.ndarray) -> None:
    axis.plot(force[vertical, 1 - d], deviation[vertical], 'o', ms=4, label='measured (10)')
    axis.plot(_FINE_G, 1e3 * np.polynomial.polynomial.polyval(_FINE_G, of.p),
              label='quadratic (11)')
    axis.legend(fontsize=7)
    axis.set(xlabel=f'{"yx"[d]} reference, g', ylabel=f'{"xy"[d]} residual, mV',
             title=f'fig. 4: residual against {"yx"[d]}, alpha = 90°')


def _modelled(axis: Any, d: int, force: np.ndarray, poses: Poses, deviation: np.ndarray,
              after: np.ndarray) -> None:
    for plane in paper_regression.planes(poses.alpha_rad):
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
