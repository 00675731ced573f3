# SPDX-License-Identifier: Apache-2.0

"""
Coefficients of a unit as people read them.

- Comparison of fitted coefficients with the true ones of a simulated unit.
- Drift of a unit from one calibration to the next.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from adxl_ros.calibrate.fits import full_model
from adxl_ros.files import calibration_store
from adxl_ros.model.coefficients import get, parameter_of, with_neutral
from adxl_ros.model.constants import AXES, Z_90
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.effects.element import OTHER_AXIS
from adxl_ros.model.sensor import Sensor
from adxl_ros.report.quantities import decimals
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


_NEGLIGIBLE_MG = 0.01
"""Error below which only this limit is shown, mg. Chosen: no sensor repeats that well."""
_SMALL_MG = 10.0
"""Error below which mg is the unit, and above which g is. Chosen: two digits read as 9.9 mg."""


def errors_in_words(fitted: Sensor) -> str:
    """Return the largest errors of the uncalibrated sensor, for people."""
    offset_g = (fitted.zero_g_v - fitted.nominal_zero_g_v) / fitted.nominal_scale_v_per_g
    gain = fitted.scale_v_per_g / fitted.nominal_scale_v_per_g - 1
    first, second = int(np.argmax(np.abs(offset_g))), int(np.argmax(np.abs(gain)))
    return (f'Uncalibrated, {fitted.axes[first]} is {_force_text(offset_g[first])} off, and '
            f'{fitted.axes[second]} reads {abs(100 * gain[second]):.2g} % too '
            f'{"much" if gain[second] > 0 else "little"}.')


def _force_text(force_g: float) -> str:
    """Return a specific force with two digits, small ones in mg."""
    force_mg = 1e3 * force_g
    if abs(force_mg) < _NEGLIGIBLE_MG:
        return f'less than {_NEGLIGIBLE_MG:g} mg'
    return f'{force_g:+.2g} g' if abs(force_mg) >= _SMALL_MG else f'{force_mg:+.2g} mg'


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


def added_effect_lines(fitted: Sensor, truth: Sensor) -> list[str]:
    """Name each effect of the fit that neither the full model nor the simulated unit has."""
    expected = {*full_model.default_terms(fitted.axes), *truth.effects}
    return [f'       The fit has the term {effect}, which this unit does not have.'
            for effect in fitted.effects if effect not in expected]


_TEMPERATURE_SLOPE = Coefficient('temperature_bias', 'per_k')
"""Parameter whose typical datasheet value predicts the drift by temperature."""
_MIN_WARMING_C = 1.0
"""Smallest difference of temperature that is reported, °C; chosen."""
_TYPICAL_SLOPE_PER_K = 1e-4
"""Typical slope of zero-g where the datasheet states none, g/K; ADXL203 datasheet: 0.1 mg/K."""


class _Quantity(NamedTuple):
    """A quantity that is compared between calibrations."""

    label: str  # Its name for people
    field: str  # Field of a sensor that holds it
    parameter: Coefficient  # The fitted parameter
    unit: str  # Unit of a change


_QUANTITIES = (
    _Quantity('zero-g', 'zero_g_v', Coefficient('bias', 'offset_v'), 'mg'),
    _Quantity('scale factor', 'scale_v_per_g', Coefficient('scale_factor', 'offset_v_per_g'),
              'permille'))


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
        identity = calibration_store.calibration_id(before)
        earlier, later = map(calibration_store.date_of, (before, now))
        since = f'Since {identity}' if earlier is None or later is None else \
            f'In {(later - earlier).total_seconds() / 86400:.1f} days since {identity}'
        lines = [f'{since}: {"; ".join(changes)}.' if changes else
                 f'{since} nothing has changed beyond the 90 % intervals.']
        warming = _temperature_c(now) - _temperature_c(before)
        if abs(warming) > _MIN_WARMING_C and changes:
            slope, _ = now.datasheet.get(_TEMPERATURE_SLOPE, (_TYPICAL_SLOPE_PER_K, 0.0))
            lines.append(f"The temperature differs by {warming:+.1f} °C. With the datasheet's "
                         'typical slope, zero-g changes by '
                         f'{1e3 * slope * abs(warming):.2f} mg from that.')
        return lines

    @property
    def dates(self) -> list[str]:
        """Return the dates of the calibrations, as text."""
        return [_date(sensor, f'no. {i}') for i, sensor in enumerate(self.sensors, 1)]

    def series(self, quantity: int) -> tuple[np.ndarray, np.ndarray]:
        """
        Return the drift of a quantity relative to the newest calibration.

        quantity: 0 for zero-g, mg, 1 for scale factor, permille; returns: differences and
        standard deviations of the values, (k, m) each.
        """
        chosen, newest = _QUANTITIES[quantity], self.sensors[-1]
        return (np.array([_change(newest, sensor, chosen)[0] for sensor in self.sensors]),
                np.array([_std(sensor, chosen) for sensor in self.sensors]))


def _row(before: Sensor | None, now: Sensor) -> list[str]:
    """Return one calibration as cells of a table, with its change from the one before."""
    cells = []
    for quantity in _QUANTITIES:
        for d in range(len(now.axes)):
            change = '' if before is None else \
                f' ({_change(before, now, quantity)[0][d]:+.2f} {quantity.unit})'
            cells.append(f'{getattr(now, quantity.field)[d]:.5f}{change}')
    return [_date(now), calibration_store.calibration_id(now), now.model,
            now.provenance.get('temperature_c', '-'), *cells]


def _change(before: Sensor, now: Sensor, quantity: _Quantity) -> tuple[np.ndarray, np.ndarray]:
    """Return the change of a quantity and its standard deviation, mg or permille, (m,)."""
    change = getattr(now, quantity.field) - getattr(before, quantity.field)
    return change / now.scale_v_per_g * 1e3, np.hypot(_std(before, quantity), _std(now, quantity))


def _std(sensor: Sensor, quantity: _Quantity) -> np.ndarray:
    """Return the standard deviation of a quantity, mg or permille, (m,)."""
    std = dict(zip(sensor.covariance_names, np.sqrt(np.diag(sensor.covariance))))
    return np.array([std.get(replace(quantity.parameter, axis=axis), 0.0)
                     for axis in sensor.axes]) / sensor.scale_v_per_g * 1e3


def _date(sensor: Sensor, unknown: str = '') -> str:
    return sensor.provenance.get('date', unknown)[:16].replace('T', ' ')


def _temperature_c(sensor: Sensor) -> float:
    try:
        return float(sensor.provenance.get('temperature_c', 'nan'))
    except ValueError:
        return float('nan')
