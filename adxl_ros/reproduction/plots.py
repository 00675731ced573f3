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

"""Figures 9, 10, 12 and 13 of the paper; 2 to 8 are those of any calibration."""

from __future__ import annotations

from dataclasses import replace
import os
from typing import Any

from adxl_ros.files.plot_file import pyplot, write_plot
from adxl_ros.model import signal_chain
from adxl_ros.model.constants import G0_MPS2, Z_90
from adxl_ros.model.sensor import Sensor
from adxl_ros.reproduction import error_statistics
from adxl_ros.reproduction.misalignment import DirectionSearch
from adxl_ros.reproduction.units import RUNS, Unit
import numpy as np

_COLOURS = {'linear': 'tab:red', 'physical': 'tab:orange', 'full': 'tab:green'}
_SHOWN_S = (2.0, 2.5)
"""Interval of figure 12, s; chosen."""


def draw_misalignment(path: str | os.PathLike, search: DirectionSearch) -> None:
    """
    Draw the search for β_x of (18) and the results of its three methods, as figure 9.

    Parameters
    ----------
    path
        The PNG file.
    search
        The search for the direction.

    """
    figure, axis = pyplot().subplots(figsize=(7, 4.5), layout='constrained')
    turned = np.degrees(search.turned_rad)
    axis.plot(turned, 1e3 * (search.output_g - search.output_g.max()), 'o', ms=4,
              label='output, means of 5 s')
    for value, colour, label in (
            (search.truth_rad, 'k', 'truth'), (search.largest_rad, 'tab:red', 'largest output'),
            (search.parabola_rad, 'tab:orange', 'parabola through the outputs'),
            (search.null_rad, 'tab:green', 'null crossings at ±90°')):
        axis.axvline(-np.degrees(value), color=colour, lw=1,
                     label=f'{label}: {-np.degrees(value):+.2f}°')
    axis.set(xlabel='beta of the stage, °', ylabel='x output minus its largest, mg',
             title='Direction of the x axis (18): the maximum is flat')
    axis.legend(fontsize=8)
    write_plot(figure, path)


def draw_tilt(path: str | os.PathLike, unit: Unit) -> None:
    """
    Draw figure 10: errors of alpha and beta in the three tilt experiments.

    Parameters
    ----------
    path
        The PNG file.
    unit
        One unit with its errors by model.

    """
    figure, grid = pyplot().subplots(2, 3, figsize=(16, 8), layout='constrained', sharex=True)
    for column, (run, asked_deg) in enumerate(RUNS.items()):
        turned = asked_deg[:, 1 if run == 'beta' else 0]
        for row, angle in enumerate(('alpha', 'beta')):
            axis = grid[row, column]
            for name, errors in unit.models.items():
                angles = errors.runs[run]
                counts = angles.determined[:, row]
                error = np.where(counts, np.degrees(angles.error[:, row]), np.nan)
                axis.plot(turned, error, 'o-', ms=4, lw=1, color=_COLOURS[name], label=name)
            bound = np.where(counts, np.degrees(angles.bound[:, row]), np.nan)
            axis.fill_between(turned, -Z_90 * bound, Z_90 * bound, color='0.8',
                              label='90 % by the bound')
            axis.axhline(0, color='0.5', lw=0.8)
            axis.set_yscale('symlog', linthresh=0.1)
            axis.set(ylabel=f'error of {angle}, °',
                     title=f'fig. 10 ({"abc"[column]}): {run} turned' if not row else '')
        grid[1, column].set(xlabel='turned angle, °')
    grid[0, 0].legend(fontsize=8)
    figure.suptitle('Tilt; gaps are poses whose bound exceeds 1° '
                    '(linear scale within ±0.1°, logarithmic beyond)')
    write_plot(figure, path)


def draw_motion(path: str | os.PathLike, fitted: dict[str, Sensor],
                shaken: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
    """
    Draw figure 12: the acceleration of the shaken sensor and of the interferometer.

    Parameters
    ----------
    path
        The PNG file.
    fitted
        The calibrated unit by model.
    shaken
        Stamps, s, (n,); volts, (n, m); acceleration along x, m/s², (n,).

    """
    figure, row = pyplot().subplots(1, len(fitted), figsize=(16, 4.5), layout='constrained',
                                    sharey=True)
    time_s = shaken[0]
    part = (time_s >= _SHOWN_S[0]) & (time_s <= _SHOWN_S[1])
    for axis, (name, unit) in zip(row, fitted.items()):
        errors, estimate, reference = error_statistics.motion_errors(unit, *shaken)
        axis.plot(time_s[part], 1e3 * reference[part], ':', color='k', label='interferometer')
        axis.plot(time_s[part], 1e3 * estimate[part], color=_COLOURS[name], label=name)
        axis.set(xlabel='time, s', title=f'fig. 12, {name}: rmse {errors.rmse_mmps2:.1f} mm/s² '
                                         f'about an offset of {errors.offset_mmps2:.1f}')
        axis.legend(fontsize=8, loc='upper right')
    row[0].set(ylabel='acceleration along x, mm/s²')
    write_plot(figure, path)


def draw_components(path: str | os.PathLike, truth: Sensor, fitted: Sensor,
                    linear: Sensor) -> None:
    """
    Draw figure 13: what each part of the model does to the response at alpha 45°, beta 90°.

    Parameters
    ----------
    path
        The PNG file.
    truth, fitted, linear
        The unit: true, by the physical model, and by the linear model.

    """
    reach = np.linspace(-0.4, 0.4, 81)
    pose = [reach * G0_MPS2, np.full(81, -np.sqrt(0.5) * truth.local_gravity_mps2),
            np.full(81, np.sqrt(0.5) * truth.local_gravity_mps2)]
    steps = (('linear model', linear, None),
             ('+ bias (10 to 13)', fitted, ('bias', 'scale_factor', 'cross_axis',
                                            'cross_axis_z')),
             ('+ scale factor (15)', fitted, ('bias', 'scale_factor', 'cross_axis',
                                              'cross_axis_z', 'scale_factor_z')),
             ('+ misalignment (18)', fitted, tuple(fitted.effects)),
             ('actual response', truth, None))
    actual = _volts(truth, None, pose)
    figure, (response, difference) = pyplot().subplots(1, 2, figsize=(14, 5), layout='constrained')
    for label, unit, effects in steps:
        volts = _volts(unit, effects, pose)
        style: dict[str, Any] = {'color': 'k', 'ls': ':'} if unit is truth else {}
        response.plot(reach, volts, label=label, **style)
        difference.plot(reach, 1e3 * (volts - actual), label=label, **style)
    response.set(xlabel='acceleration along x, g', ylabel='x output, V',
                 title='fig. 13: response at alpha = 45°, beta = 90°')
    difference.set(xlabel='acceleration along x, g', ylabel='minus the actual response, mV',
                   title='the same, minus the actual response')
    response.legend(fontsize=8)
    write_plot(figure, path)


def _volts(unit: Sensor, effects: tuple[str, ...] | None, pose: list[np.ndarray]) -> np.ndarray:
    if effects is not None:
        unit = replace(unit, effects=effects, values={e: unit.values[e] for e in effects})
    return signal_chain.static_response(unit)(pose)[0]
