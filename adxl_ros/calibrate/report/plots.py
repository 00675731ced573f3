# SPDX-License-Identifier: Apache-2.0

"""Plots of a calibration: figures 2 to 8 of the paper for one unit, and errors of fits."""

from __future__ import annotations

from collections.abc import Sequence
import os
from typing import Any

from adxl_ros.calibrate.fits import linear
from adxl_ros.calibrate.fits.gravity_fit import GravityFit
from adxl_ros.calibrate.poses import planes, Poses, reference_force
from adxl_ros.calibrate.report.held_out import HeldOutErrors
from adxl_ros.files.atomic_write import write_bytes
from adxl_ros.model import signal_chain
from adxl_ros.model.constants import G0_MPS2, Z_90
from adxl_ros.model.sensor import Sensor
from adxl_ros.report.figures import png, pyplot
import numpy as np

_FINE_G = np.linspace(-1, 1, 201)
"""Specific force at which curves are drawn, g."""
_VERTICAL = np.sin(np.radians(89))
"""Smallest sine of alpha in the plane alpha = 90°; chosen: stages are better than 1°."""
_MARKERS = 'os^D'
"""Markers of models, in order."""


def draw_sweep(path: str | os.PathLike, sensor: Sensor, fitted: Sensor, poses: Poses) -> None:
    """Write the plot of `sweep` as PNG."""
    write_bytes(path, png(sweep(sensor, fitted, poses)))


def sweep(sensor: Sensor, fitted: Sensor, poses: Poses, panels: Sequence[int] = range(6)) -> Any:
    """Draw figures 2 to 8 of the paper for the x and y axes, one row per axis."""
    swept = poses.subset(~poses.check)
    line, regressions = linear.fit(sensor, swept), linear.regress_axes(sensor, swept)
    reference = reference_force(swept, sensor.local_gravity_mps2)
    force_g = np.column_stack(reference) / G0_MPS2
    predicted = np.column_stack(signal_chain.static_response(fitted)(
        reference, swept.environment))
    figure, grid = pyplot().subplots(2, len(panels), figsize=(4.4 * len(panels), 9),
                                     layout='constrained', squeeze=False)
    for d, row in enumerate(grid):
        linear_v = line.zero_g_v[d] + line.scale_v_per_g[d] * force_g[:, d]
        deviation_mv, model_mv = (1e3 * (volts[:, d] - linear_v)
                                  for volts in (swept.volts, predicted))
        for axis, panel in zip(row, panels):
            _draw_panel(axis, panel, d, fitted.model, swept, force_g, deviation_mv, model_mv,
                        regressions[d])
    if len(panels) > 4:
        figure.suptitle(f'{fitted.serial}: deviation from the linear model, measured and by the '
                        f'{fitted.model} model (Ang et al. 2007, figures 2 to 8)')
    return figure


def _draw_panel(axis: Any, panel: int, d: int, model: str, poses: Poses, force_g: np.ndarray,
                deviation_mv: np.ndarray, model_mv: np.ndarray, regression: linear.AxisRegression
                ) -> None:
    """
    Draw one panel for the axis x or y, given by d: figures 2, 3, 4, 5 with 7, 6, or 8.

    force_g, deviation_mv, model_mv: reference of k poses, g, (k, 3), and measured and modelled
    output minus the linear model, mV, (k,).
    """
    vertical = np.abs(np.sin(poses.alpha_rad)) > _VERTICAL
    name, other = ('x', 'y') if d == 0 else ('y', 'x')
    along_g, x_label = force_g[:, d], f'{name} reference, g'
    if panel in (0, 1, 3):
        everything = np.ones(len(poses), bool)
        y_label = f'{name} output minus linear, mV'
        title = f'figs. 5, 7: measured ● and {model} model ─' if panel == 3 else \
            f'fig. {panel + 2}: paths, forth ● and back ◁'
        backward = np.gradient(poses.beta_rad) < 0
        chosen = np.flatnonzero(everything if panel else vertical)
        for plane in planes(poses.alpha_rad[chosen]):
            index = chosen[np.sort(plane)]
            label = f'{np.degrees(poses.alpha_rad[index]).mean():.0f}°'
            if panel == 3:
                line, = axis.plot(along_g[index], deviation_mv[index], 'o', ms=3, label=label)
                axis.plot(along_g[index], model_mv[index], lw=1, color=line.get_color())
                continue
            line, = axis.plot(along_g[index], deviation_mv[index], lw=1, label=label)
            for part, marker, fill in ((index[~backward[index]], 'o', None),
                                       (index[backward[index]], '<', 'none')):
                axis.plot(along_g[part], deviation_mv[part], marker, ms=4,
                          color=line.get_color(), mfc=fill)
        axis.legend(title='alpha', fontsize=7)
    elif panel == 2:
        axis.plot(force_g[vertical, 1 - d], deviation_mv[vertical], 'o', ms=4,
                  label='measured (10)')
        axis.plot(_FINE_G, 1e3 * np.polynomial.polynomial.polyval(_FINE_G, regression.p),
                  label='quadratic (11)')
        axis.legend(fontsize=7)
        x_label, y_label = f'{other} reference, g', f'{name} residual, mV'
        title = f'fig. 4: residual against {other}, alpha = 90°'
    else:
        values, polynomial = (1e3 * regression.plane_bias_v, 1e3 * regression.q) \
            if panel == 4 else (regression.plane_scale_v_per_g, regression.r)
        az_g = regression.plane_az_g
        fine_g = np.linspace(az_g.min(), az_g.max(), 101)
        axis.plot(az_g, values, 'o', ms=4)
        axis.plot(fine_g, np.polynomial.polynomial.polyval(fine_g, polynomial))
        x_label = 'z reference, g'
        y_label, title = (f'{name} zero-g minus that at 90°, mV',
                          'fig. 6: zero-g against z (12, 13)') if panel == 4 else \
            (f'{name} scale factor, V/g', 'fig. 8: scale factor against z (15, 17)')
    axis.set(xlabel=x_label, ylabel=y_label, title=title)


def gravity_rests(name: str, fit: GravityFit) -> Any:
    """Draw the error of the magnitude of gravity in each rest, before and after the fit."""
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


def held_out(models: Sequence[HeldOutErrors], poses: Poses) -> Any:
    """Draw the errors on held-out poses, model by model, as in figure 10 of the paper."""
    figure, axes = pyplot().subplots(1, 3, figsize=(13, 4), layout='constrained')
    for i, model in enumerate(models):
        errors = model.errors
        alpha_deg = np.degrees(poses.alpha_rad[model.pose_index])
        accel_mg = np.sqrt(np.mean(errors.accel_mps2 ** 2, axis=1)) / G0_MPS2 * 1e3
        for axis, values in zip(axes, (np.degrees(errors.alpha_rad), np.degrees(errors.beta_rad),
                                       accel_mg)):
            axis.plot(alpha_deg, np.abs(values), _MARKERS[i % 4], ms=4, mfc='none', color=f'C{i}',
                      label=model.model)
    for axis, label in zip(axes, ('|error of alpha|, deg', '|error of beta|, deg',
                                  'error of acceleration, mg')):
        axis.set(xlabel='alpha of the pose, deg', ylabel=label, yscale='log')
        # A tiny error by chance must not compress the scale.
        axis.set_ylim(bottom=1e-6 * axis.get_ylim()[1])
        axis.grid(alpha=0.3)
    axes[0].legend(fontsize=8)
    return figure
