# SPDX-License-Identifier: Apache-2.0

"""
Coefficients of a unit as people read them.

- Comparison of fitted coefficients with the true ones of a simulated unit.
- Drift of a unit from one calibration to the next.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from adxl_ros.files import calibration_store
from adxl_ros.model.coefficients import get, parameter_of, with_neutral
from adxl_ros.model.constants import AXES, G0_MPS2, Z_90
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.effects.element import OTHER_AXIS
from adxl_ros.model.sensor import Sensor
from adxl_ros.report.quantities import decimals, mg_text
import numpy as np

_ABSOLUTE = {'bias.offset_v': 'nominal_zero_g_v',
             'scale_factor.offset_v_per_g': 'nominal_scale_v_per_g'}
"""Parameters that are departures from a nominal value, and the field of that value."""
_LABELS = {
    'bias.offset_v': 'zero-g',
    'scale_factor.offset_v_per_g': 'scale factor',
    'misalignment.alpha_rad': 'misalignment alpha',
    'misalignment.beta_rad': 'misalignment beta',
    'cross_axis.linear': 'zero-g, {other}',
    'cross_axis.quadratic_per_g': 'zero-g, {other}²',
    'cross_axis_z.linear': 'zero-g, {other}',
    'cross_axis_z.quadratic_per_g': 'zero-g, {other}²',
    'scale_factor_cross.linear_per_g': 'scale, {other}',
    'scale_factor_z.linear_per_g': 'scale, {other}',
    'scale_factor_z.quadratic_per_g2': 'scale, {other}²',
    'nonlinearity.cubic_per_g2': 'cubic',
}
"""Parameters in words; {other} is the axis that acts on the measured axis."""


@dataclass(frozen=True)
class Comparison:
    """A fitted coefficient and its true value."""

    name: str  # 'effect.parameter', as in the parameter file
    axis: str  # 'x', 'y' or 'z'; empty for a coefficient of all axes
    label: str  # The coefficient in words
    unit: str  # Unit of the values: degrees for an angle, else the unit of the parameter
    fitted: float  # The fitted value. Zero-g and scale factor are absolute, in V and V/g.
    half_width: float  # Half of the 90 % interval
    truth: float  # The true value; 0 for an effect that the unit does not have

    @property
    def inside(self) -> bool:
        """Return whether the 90 % interval contains the true value."""
        return abs(self.fitted - self.truth) <= self.half_width


def compare(fitted: Sensor, truth: Sensor) -> list[Comparison]:
    """
    Compare each fitted coefficient with the true one, in the order of the fit.

    A misalignment and a linear cross-axis term are the same to first order, so that the true unit
    must have the gauge of the fits: no linear cross-axis terms.
    """
    names, rows = fitted.covariance_names, []
    truth = with_neutral(truth, [name.effect for name in names])
    half_widths = Z_90 * np.sqrt(np.diag(fitted.covariance))
    for name, *values in zip(names, get(fitted, names), half_widths, get(truth, names)):
        key, unit, scale = str(name.without_axis), parameter_of(name).unit, 1.0
        if key in _ABSOLUTE:
            nominal = getattr(fitted, _ABSOLUTE[key])[fitted.axes.index(name.axis)]
            values[0], values[2] = values[0] + nominal, values[2] + nominal
        if unit == 'rad':
            unit, scale = '°', float(np.degrees(1.0))
        acts = name.axis and name.effect in OTHER_AXIS
        other = AXES[OTHER_AXIS[name.effect][AXES.index(name.axis)]] if acts else ''
        rows.append(Comparison(
            key, name.axis, _LABELS.get(key, key).format(other=other), unit.replace('^2', '²'),
            *(float(scale * value) for value in values)))
    return rows


def errors_in_words(fitted: Sensor) -> str:
    """Return the largest errors of the uncalibrated sensor, for people."""
    offset_g = (fitted.zero_g_v - fitted.nominal_zero_g_v) / fitted.nominal_scale_v_per_g
    gain = fitted.scale_v_per_g / fitted.nominal_scale_v_per_g - 1
    first, second = int(np.argmax(np.abs(offset_g))), int(np.argmax(np.abs(gain)))
    shift, slope = ('much' if error > 0 else 'little'
                    for error in (offset_g[first], gain[second]))
    return (f'Uncalibrated, {fitted.axes[first]} reads {mg_text(abs(offset_g[first]) * G0_MPS2)} '
            f'too {shift}, and {fitted.axes[second]} {abs(100 * gain[second]):.2g} % too '
            f'{slope}.')


_LONGEST_LABEL = 26
"""Columns that a coefficient's name may take, so that its line has at most 79."""
_COVERED = 0.9
"""Share of the 90 % intervals that contain the true value if the intervals are right."""


def truth_table(comparisons: Sequence[Comparison]) -> list[str]:
    """Lay out each fitted coefficient beside the true one, in 79 columns."""
    longest = max((len(row.label) for row in comparisons), default=0)
    width = max(min(longest + 1, _LONGEST_LABEL), len('coefficient'))
    lines = [f' {"coefficient":{width}}     fitted (90 %) {"":16}true']
    for row in comparisons:
        truth = '0' if row.truth == 0 else rounded(row, row.truth)
        lines.append(f' {row.label[:width]:{width}} {row.axis:1} {rounded(row, row.fitted):>10} ± '
                     f'{rounded(row, row.half_width):8} {row.unit:5} {truth:>10}   '
                     f'{"ok" if row.inside else "MISSED"}')
    inside = sum(row.inside for row in comparisons)
    return [*lines, f' ({inside} of {len(comparisons)} inside their 90 % intervals; about '
            f'{_COVERED * len(comparisons):.0f} are expected)']


def rounded(row: Comparison, value: float) -> str:
    """Write a value with the decimals that show two digits of the interval."""
    places = decimals(row.half_width)
    return f'{round(value, places) + 0.0:.{places}f}'


_QUANTITIES = {
    'zero-g': ('zero_g_v', Coefficient('bias', 'offset_v'), 'mg'),
    'scale factor': ('scale_v_per_g', Coefficient('scale_factor', 'offset_v_per_g'), 'permille')}
"""Field of a sensor, fitted parameter, and unit of a change of what calibrations compare."""


@dataclass(frozen=True)
class DriftHistory:
    """Calibrations of one unit, oldest first."""

    # The stored calibrations, then the newest. Empty where the newest is the only one.
    sensors: tuple[Sensor, ...]

    @staticmethod
    def from_store(newest: Sensor, stored: Sequence[Sensor]) -> DriftHistory:
        """Append the newest calibration to the stored ones of other data and the same axes."""
        by_data: dict[str, Sensor] = {}
        for sensor in (*stored, newest):
            # Two fits of the same data show no drift: only the last one counts.
            if sensor.axes == newest.axes:
                data = sensor.provenance.get('data_sha256') or \
                    calibration_store.calibration_id(sensor)
                by_data.pop(data, None)
                by_data[data] = sensor
        return DriftHistory(tuple(by_data.values()) if len(by_data) > 1 else ())

    def table(self) -> tuple[list[str], list[list[str]]]:
        """Return head and rows, a row for each calibration."""
        head = ['date', 'id', 'model', 'temperature, °C', *(
            f'{label} {axis}' for label in _QUANTITIES for axis in self.sensors[-1].axes)]
        return head, [
            [date, calibration_store.calibration_id(sensor), sensor.model,
             sensor.provenance.get('temperature_c', '-'),
             *(f'{value:.5f}' for value in (*sensor.zero_g_v, *sensor.scale_v_per_g))]
            for date, sensor in zip(self.dates, self.sensors)]

    def changes(self) -> str:
        """State the changes since the calibration before that exceed their intervals."""
        before, now = self.sensors[-2:]
        changes = []
        for label, (field, parameter, unit) in _QUANTITIES.items():
            differences = getattr(now, field) - getattr(before, field)
            for d, axis in enumerate(now.axes):
                name, scale = replace(parameter, axis=axis), 1e3 / now.scale_v_per_g[d]
                variance = sum(float(sensor.covariance[i, i]) for sensor in (before, now)
                               for i, own in enumerate(sensor.covariance_names) if own == name)
                change, half_width = scale * differences[d], scale * Z_90 * variance ** 0.5
                if abs(change) > half_width:
                    changes.append(f'{label} of {axis} changed by {change:+.2f} +- '
                                   f'{half_width:.2f} {unit}')
        since = f'Since {calibration_store.calibration_id(before)}, {self.dates[-2]}'
        return f'{since}: {"; ".join(changes)}.' if changes else \
            f'{since}, nothing has changed beyond the 90 % intervals.'

    @property
    def dates(self) -> list[str]:
        """Return the dates of the calibrations, as text."""
        return [sensor.provenance.get('date', f'no. {i}')[:16].replace('T', ' ')
                for i, sensor in enumerate(self.sensors, 1)]
