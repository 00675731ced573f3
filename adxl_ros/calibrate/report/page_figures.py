# SPDX-License-Identifier: Apache-2.0

"""
Figures of the page of a calibration, as plotly.js draws them.

- Drift of a unit from one calibration to the next.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from adxl_ros.calibrate.fits.gravity_fit import GravityFit
from adxl_ros.calibrate.poses import Poses
from adxl_ros.calibrate.report.acceptance import Assessment
from adxl_ros.calibrate.report.cross_validation import determining_alpha, HeldOutErrors
from adxl_ros.files import calibration_store
from adxl_ros.model.constants import G0_MPS2, Z_90
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.sensor import Sensor
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

_TEMPERATURE_SLOPE = Coefficient('temperature_bias', 'per_k')
"""Parameter whose typical datasheet value predicts the drift by temperature."""
_MIN_WARMING_C = 1.0
"""Smallest difference of temperature that is reported, °C; chosen."""
_TYPICAL_SLOPE_PER_K = 1e-4
"""Typical slope of zero-g where the datasheet states none, g/K; ADXL203 datasheet: 0.1 mg/K."""


class _Quantity(NamedTuple):
    """A quantity that is compared between calibrations."""

    label: str  # Its name for people
    parameter: Coefficient  # The fitted parameter
    unit: str  # Unit of a change


_ZERO_G = _Quantity('zero-g', Coefficient('bias', 'offset_v'), 'mg')
_SCALE_FACTOR = _Quantity('scale factor', Coefficient('scale_factor', 'offset_v_per_g'),
                          'permille')
_QUANTITIES = (_ZERO_G, _SCALE_FACTOR)


@dataclass(frozen=True)
class DriftSeries:
    """Zero-g and scale factor of k calibrations minus those of the newest."""

    dates: list[str]  # Dates of the calibrations, as text, (k,)
    axes: str  # Measured axes, m of them
    # zero_g_mg, scale_permille: Differences, (k, m)
    zero_g_mg: np.ndarray
    scale_permille: np.ndarray
    # zero_g_std_mg, scale_std_permille: Standard deviations of the values, (k, m)
    zero_g_std_mg: np.ndarray
    scale_std_permille: np.ndarray


@dataclass(frozen=True)
class DriftHistory:
    """Calibrations of one unit, oldest first."""

    # The stored calibrations, then the newest. Empty where the newest is the only one.
    sensors: tuple[Sensor, ...]

    @staticmethod
    def from_store(newest: Sensor, stored: Sequence[Sensor]) -> DriftHistory:
        """Append the newest calibration to the stored ones of other data and the same axes."""
        data = newest.provenance.get('data_sha256')
        by_data: dict[str, Sensor] = {}
        for sensor in stored:
            # Two fits of the same data show no drift: only the last one counts.
            if sensor.axes == newest.axes and (
                    data is None or sensor.provenance.get('data_sha256') != data):
                by_data[sensor.provenance.get('data_sha256')
                        or calibration_store.calibration_id(sensor)] = sensor
        return DriftHistory((*by_data.values(), newest) if by_data else ())

    def table(self) -> tuple[list[str], list[list[str]]]:
        """Return head and rows: each calibration, and its change from the one before."""
        axes = self.sensors[-1].axes
        head = ['date', 'id', 'model', 'temperature, °C', *(
            f'{quantity.label} {axis}' for quantity in _QUANTITIES for axis in axes)]
        return head, [_row(*pair) for pair in zip((None, *self.sensors), self.sensors)]

    def changes(self) -> list[str]:
        """Return lines on the changes since the calibration before that exceed their intervals."""
        before, now = self.sensors[-2:]
        changes = []
        for quantity in _QUANTITIES:
            change, std = _change(before, now, quantity)
            for axis, difference, half_width in zip(now.axes, change, Z_90 * std):
                if abs(difference) > half_width:
                    changes.append(f'{quantity.label} of {axis} changed by {difference:+.2f} +- '
                                   f'{half_width:.2f} {quantity.unit}')
        days = _days(before, now)
        identity = calibration_store.calibration_id(before)
        since = f'In {days:.1f} days since {identity}' if days is not None else \
            f'Since {identity}'
        lines = [f'{since}: {"; ".join(changes)}.' if changes else
                 f'{since} nothing has changed beyond the 90 % intervals.']
        warming = _temperature_c(now) - _temperature_c(before)
        if abs(warming) > _MIN_WARMING_C and changes:
            slope, _ = now.datasheet.get(_TEMPERATURE_SLOPE, (_TYPICAL_SLOPE_PER_K, 0.0))
            lines.append(f"The temperature differs by {warming:+.1f} °C. With the datasheet's "
                         'typical slope, zero-g changes by '
                         f'{1e3 * slope * abs(warming):.2f} mg from that.')
        return lines

    def series(self) -> DriftSeries:
        """Return the drift relative to the newest calibration."""
        newest = self.sensors[-1]

        def changes(quantity: _Quantity) -> np.ndarray:
            return np.array([_change(newest, sensor, quantity)[0] for sensor in self.sensors])

        def stds(quantity: _Quantity) -> np.ndarray:
            return np.array([_std(sensor, quantity) for sensor in self.sensors])

        dates = [_date(sensor, f'no. {i}') for i, sensor in enumerate(self.sensors, 1)]
        return DriftSeries(dates, newest.axes, changes(_ZERO_G), changes(_SCALE_FACTOR),
                           stds(_ZERO_G), stds(_SCALE_FACTOR))


def _row(before: Sensor | None, now: Sensor) -> list[str]:
    """Return one calibration as cells of a table, with its change from the one before."""
    cells = []
    for quantity in _QUANTITIES:
        for d in range(len(now.axes)):
            change = '' if before is None else \
                f' ({_change(before, now, quantity)[0][d]:+.2f} {quantity.unit})'
            cells.append(f'{_values(now, quantity)[d]:.5f}{change}')
    return [_date(now), calibration_store.calibration_id(now), now.model,
            now.provenance.get('temperature_c', '-'), *cells]


def _values(sensor: Sensor, quantity: _Quantity) -> np.ndarray:
    """Return a quantity of each axis, V or V/g, (m,)."""
    return sensor.zero_g_v if quantity is _ZERO_G else sensor.scale_v_per_g


def _change(before: Sensor, now: Sensor, quantity: _Quantity) -> tuple[np.ndarray, np.ndarray]:
    """Return the change of a quantity and its standard deviation, mg or permille, (m,)."""
    change = (_values(now, quantity) - _values(before, quantity)) / now.scale_v_per_g * 1e3
    return change, np.hypot(_std(before, quantity), _std(now, quantity))


def _std(sensor: Sensor, quantity: _Quantity) -> np.ndarray:
    """Return the standard deviation of a quantity, mg or permille, (m,)."""
    std = dict(zip(sensor.covariance_names, np.sqrt(np.diag(sensor.covariance))))
    return np.array([std.get(replace(quantity.parameter, axis=axis), 0.0)
                     for axis in sensor.axes]) \
        / sensor.scale_v_per_g * 1e3


def _date(sensor: Sensor, unknown: str = '') -> str:
    return sensor.provenance.get('date', unknown)[:16].replace('T', ' ')


def _temperature_c(sensor: Sensor) -> float:
    try:
        return float(sensor.provenance.get('temperature_c', 'nan'))
    except ValueError:
        return float('nan')


def _days(before: Sensor, now: Sensor) -> float | None:
    earlier, later = calibration_store.date_of(before), calibration_store.date_of(now)
    return None if earlier is None or later is None else (later - earlier).total_seconds() / 86400


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
