# SPDX-License-Identifier: Apache-2.0
"""Figures of the page of a calibration, as plotly.js draws them."""

from __future__ import annotations

from adxl_ros.calibrate.fits.gravity_fit import GravityFit
from adxl_ros.calibrate.poses import Poses
from adxl_ros.calibrate.report.acceptance import Assessment
from adxl_ros.calibrate.report.cross_validation import determining_alpha, HeldOutErrors
from adxl_ros.calibrate.report.drift_history import DriftSeries
from adxl_ros.model.constants import G0_MPS2, Z_90
from adxl_ros.report.figures import (
    AXIS_COLOURS,
    axis_number,
    Figure,
    figure,
    line,
    points,
    QUIET_COLOUR,
    rounded,
)
import numpy as np

_BAND_COLOUR = 'rgba(31,95,191,0.12)'
_ROOM = {'l': 8, 'r': 12, 't': 36, 'b': 8}
"""Margins with room for a legend, pixels."""
_DATES = 4
"""Largest number of dates at an axis. Chosen: they fit beside each other on a phone."""


def pose_errors(errors: HeldOutErrors, assessment: Assessment, poses: Poses, axes: str) -> Figure:
    """Draw the errors at the held-out poses with the band that 90 % of them should be in."""
    number = np.arange(1, errors.pose_count + 1)
    held = poses.subset(errors.pose_index)
    angles_deg = np.degrees([held.alpha_rad, held.beta_rad])
    labels = [f'pose {i}, alpha {alpha:.1f}°, beta {beta:.1f}°'
              for i, (alpha, beta) in enumerate(angles_deg.T, 1)]
    accel_mg = errors.errors.accel_mps2 / G0_MPS2 * 1e3
    half_mg = Z_90 * 1e3 * float(np.sqrt(assessment.accel.expected)) / G0_MPS2
    traces = [_band(len(number), -half_mg, half_mg, 1)]
    symbols = np.where(determining_alpha(errors.errors), 'circle', 'circle-open').tolist()
    traces += [_dots(number, accel_mg[:, d], f'{axis}', AXIS_COLOURS[axis], labels, 'mg', 1)
               for d, axis in enumerate(axes)]
    for trace in traces[1:]:
        trace['marker']['symbol'] = symbols
    tilt_deg = np.degrees(errors.errors.tilt_rad)
    if not np.isfinite(tilt_deg).any():
        return figure(traces, 320, margin=_ROOM, xaxis={'title': {'text': 'held-out pose'}},
                      yaxis={'title': {'text': 'acceleration, mg'}})
    # The error of tilt has two components: 90 % of its lengths are within √(ln 10) of the rms.
    high_deg = float(np.degrees(np.sqrt(assessment.tilt.expected * np.log(10))))
    traces += [_band(len(number), 0.0, high_deg, 2),
               _dots(number, tilt_deg, 'tilt', '#6b46a8', labels, '°', 2)]
    return figure(traces, 440, margin=_ROOM,
                  xaxis={'title': {'text': 'held-out pose'}, 'anchor': 'y2'},
                  yaxis={'title': {'text': 'acceleration, mg'}, 'domain': [0.54, 1]},
                  yaxis2={'title': {'text': 'tilt, °'}, 'domain': [0, 0.46],
                          'rangemode': 'tozero'})


def gravity_errors(fit: GravityFit) -> Figure:
    """Draw the error of the magnitude of gravity at each rest, and its expected 90 % bars."""
    used = np.setdiff1d(np.arange(len(fit.before_mps2)), fit.outliers)
    scale = 1e3 / G0_MPS2
    traces = [points(used + 1, scale * fit.held_out_mps2[used],
                     Z_90 * scale * fit.expected_mps2[used], 'held out', AXIS_COLOURS['x'])]
    return figure(traces, 320, margin=_ROOM, xaxis={'title': {'text': 'rest'}},
                  yaxis={'title': {'text': 'magnitude minus gravity, mg'}})


def drift(series: DriftSeries) -> Figure:
    """Draw zero-g and scale factor of a unit over its calibrations, relative to the newest."""
    traces, layout = [], {}
    number_of = np.arange(len(series.dates))
    labelled = np.unique(np.linspace(0, len(series.dates) - 1, _DATES).astype(int))
    panels = (('zero-g, mg', series.zero_g_mg, series.zero_g_std_mg),
              ('scale factor, ‰', series.scale_permille, series.scale_std_permille))
    for number, (label, values, std) in enumerate(panels, 1):
        for d, axis in enumerate(series.axes):
            trace = points(number_of, values[:, d], Z_90 * std[:, d], axis,
                           AXIS_COLOURS[axis])
            traces.append(trace | {'mode': 'lines+markers', 'text': series.dates,
                                   'hovertemplate': '%{text}: %{y:.3~g}',
                                   'showlegend': number == 1, 'legendgroup': axis,
                                   'yaxis': axis_number('y', number)})
        layout[axis_number('yaxis', number)] = {
            'title': {'text': label}, 'domain': [0.54, 1] if number == 1 else [0, 0.46]}
    return figure(traces, 340, margin=_ROOM, **layout,
                  xaxis={'anchor': 'y2', 'tickvals': labelled.tolist(),
                         'ticktext': [series.dates[i][:10] for i in labelled]})


def _band(count: int, low: float, high: float, panel: int) -> Figure:
    """Draw the band of the expected errors in a panel."""
    edges = [0.5, count + 0.5]
    return line([*edges, *edges[::-1]], [low, low, high, high], 'expected 90 %', QUIET_COLOUR,
                fill='toself', fillcolor=_BAND_COLOUR, hoverinfo='skip',
                line={'color': QUIET_COLOUR, 'width': 0.5}, xaxis='x',
                yaxis=axis_number('y', panel), showlegend=panel == 1)


def _dots(number: np.ndarray, values: np.ndarray, name: str, colour: str, labels: list[str],
          unit: str, panel: int) -> Figure:
    """Draw one error of each pose in a panel."""
    return {'type': 'scatter', 'mode': 'markers', 'x': number.tolist(), 'y': rounded(values),
            'name': name, 'text': labels, 'xaxis': 'x', 'yaxis': axis_number('y', panel),
            'hovertemplate': '%{text}: %{y:.3~g} ' + unit + '<extra>' + name + '</extra>',
            'marker': {'color': colour, 'size': 7}}
