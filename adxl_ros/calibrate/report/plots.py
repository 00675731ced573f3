# SPDX-License-Identifier: Apache-2.0

"""Plots of a calibration: figures 2 to 8 of the paper for one unit, and errors of fits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
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


@dataclass(frozen=True)
class _AxisData:
    """What the panels of one axis show; k poses."""

    d: int  # Index of the axis: 0 for x, 1 for y
    model: str  # Name of the model
    force_g: np.ndarray  # Reference along the measured axes, g, (k, m)
    poses: Poses  # The poses of the sweep
    # deviation_mv, model_mv: Measured and modelled output minus the linear model, mV, (k,)
    deviation_mv: np.ndarray
    model_mv: np.ndarray
    regression: linear.AxisRegression  # Coefficients of the sequential regression
    vertical: np.ndarray  # Whether the pose is in the plane alpha = 90°, (k,)

    @property
    def name(self) -> str:
        """Return the name of the axis."""
        return 'xy'[self.d]

    @property
    def other(self) -> str:
        """Return the name of the other axis."""
        return 'yx'[self.d]


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
    vertical = np.abs(np.sin(swept.alpha_rad)) > _VERTICAL
    figure, grid = pyplot().subplots(2, len(panels), figsize=(4.4 * len(panels), 9),
                                     layout='constrained', squeeze=False)
    for d, row in enumerate(grid):
        linear_v = line.zero_g_v[d] + line.scale_v_per_g[d] * force_g[:, d]
        data = _AxisData(d, fitted.model, force_g, swept,
                         1e3 * (swept.volts[:, d] - linear_v),
                         1e3 * (predicted[:, d] - linear_v), regressions[d], vertical)
        for axis, panel in zip(row, panels):
            _PANELS[panel](axis, data)
    if len(panels) > 4:
        figure.suptitle(f'{fitted.serial}: deviation from the linear model, measured and by the '
                        f'{fitted.model} model (Ang et al. 2007, figures 2 to 8)')
    return figure


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


def _vertical_paths(axis: Any, data: _AxisData) -> None:
    _paths(axis, data, data.vertical, paper_figure=2)


def _all_paths(axis: Any, data: _AxisData) -> None:
    _paths(axis, data, np.ones(len(data.poses), bool), paper_figure=3)


def _paths(axis: Any, data: _AxisData, chosen: np.ndarray, paper_figure: int) -> None:
    """Draw the deviation against the reference, plane by plane, beta forth and back."""
    alpha_deg = np.degrees(data.poses.alpha_rad)
    backward = np.gradient(data.poses.beta_rad) < 0
    force_g, deviation_mv = data.force_g[:, data.d], data.deviation_mv
    for plane in planes(data.poses.alpha_rad[chosen]):
        index = np.flatnonzero(chosen)[np.sort(plane)]
        line, = axis.plot(force_g[index], deviation_mv[index], lw=1,
                          label=f'{alpha_deg[index].mean():.0f}°')
        forth, back = index[~backward[index]], index[backward[index]]
        axis.plot(force_g[forth], deviation_mv[forth], 'o', ms=4, color=line.get_color())
        axis.plot(force_g[back], deviation_mv[back], '<', ms=4, color=line.get_color(),
                  mfc='none')
    axis.legend(title='alpha', fontsize=7)
    axis.set(xlabel=f'{data.name} reference, g', ylabel=f'{data.name} output minus linear, mV',
             title=f'fig. {paper_figure}: paths, forth ● and back ◁')


def _across(axis: Any, data: _AxisData) -> None:
    """Draw the deviation against the other axis in the plane alpha = 90°, with its quadratic."""
    vertical = data.vertical
    axis.plot(data.force_g[vertical, 1 - data.d], data.deviation_mv[vertical], 'o', ms=4,
              label='measured (10)')
    axis.plot(_FINE_G, 1e3 * np.polynomial.polynomial.polyval(_FINE_G, data.regression.p),
              label='quadratic (11)')
    axis.legend(fontsize=7)
    axis.set(xlabel=f'{data.other} reference, g', ylabel=f'{data.name} residual, mV',
             title=f'fig. 4: residual against {data.other}, alpha = 90°')


def _modelled(axis: Any, data: _AxisData) -> None:
    """Draw the measured and the modelled deviation against the reference, plane by plane."""
    alpha_rad, force_g = data.poses.alpha_rad, data.force_g[:, data.d]
    for plane in planes(alpha_rad):
        index = np.sort(plane)
        line, = axis.plot(force_g[index], data.deviation_mv[index], 'o', ms=3,
                          label=f'{np.degrees(alpha_rad[index]).mean():.0f}°')
        axis.plot(force_g[index], data.model_mv[index], lw=1, color=line.get_color())
    axis.legend(title='alpha', fontsize=7)
    axis.set(xlabel=f'{data.name} reference, g', ylabel=f'{data.name} output minus linear, mV',
             title=f'figs. 5, 7: measured ● and {data.model} model ─')


def _bias_along_z(axis: Any, data: _AxisData) -> None:
    regression = data.regression
    _along_z(axis, regression.plane_az_g, 1e3 * regression.plane_bias_v, 1e3 * regression.q)
    axis.set(xlabel='z reference, g', ylabel=f'{data.name} zero-g minus that at 90°, mV',
             title='fig. 6: zero-g against z (12, 13)')


def _scale_along_z(axis: Any, data: _AxisData) -> None:
    regression = data.regression
    _along_z(axis, regression.plane_az_g, regression.plane_scale_v_per_g, regression.r)
    axis.set(xlabel='z reference, g', ylabel=f'{data.name} scale factor, V/g',
             title='fig. 8: scale factor against z (15, 17)')


def _along_z(axis: Any, az_g: np.ndarray, values: np.ndarray, polynomial: np.ndarray) -> None:
    """Draw values of the planes against their force along z, with a polynomial."""
    fine_g = np.linspace(az_g.min(), az_g.max(), 101)
    axis.plot(az_g, values, 'o', ms=4)
    axis.plot(fine_g, np.polynomial.polynomial.polyval(fine_g, polynomial))


_PANELS = (_vertical_paths, _all_paths, _across, _modelled, _bias_along_z, _scale_along_z)
"""The panels of `sweep`, in order."""
