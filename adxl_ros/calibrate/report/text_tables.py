# SPDX-License-Identifier: Apache-2.0

"""
Results of a calibration as lines of a terminal with 79 columns.

- Comparison of fitted coefficients with the true ones of a simulated unit.
- Errors of a unit in plain words: of its datasheet values, and from turn-on to turn-on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from adxl_ros.calibrate.fits import full_model
from adxl_ros.calibrate.fits.gravity_fit import GravityFit
from adxl_ros.calibrate.poses import has_angles, Poses, reference_force
from adxl_ros.calibrate.report import acceptance
from adxl_ros.calibrate.report.cross_validation import HeldOutErrors
from adxl_ros.calibrate.report.error_budget import sample_noise_mps2
from adxl_ros.errors import UserError
from adxl_ros.model import signal_chain
from adxl_ros.model.coefficients import get, parameter_of, put, with_neutral
from adxl_ros.model.constants import AXES, G0_MPS2, Z_90
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.effects.element import OTHER_AXIS
from adxl_ros.model.effects.mounting import direction
from adxl_ros.model.sensor import Sensor
from adxl_ros.report.quantities import decimals, duration
import numpy as np

_SCALE = Coefficient('scale_factor', 'offset_v_per_g')
"""Parameter that takes the length of a direction."""
_ABSOLUTE = {Coefficient('bias', 'offset_v'): 'nominal_zero_g_v',
             _SCALE: 'nominal_scale_v_per_g'}
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
_ANGLES = (Coefficient('misalignment', 'alpha_rad'), Coefficient('misalignment', 'beta_rad'))
"""Parameters of the direction of an axis."""
_LINEAR = (Coefficient('cross_axis', 'linear'), Coefficient('cross_axis_z', 'linear'))
"""Parameters that act as a misalignment does, to first order."""


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

    A misalignment and a linear cross-axis term are the same to first order. Where the fit has no
    linear cross-axis term, the true one counts as part of the true misalignment.
    """
    if fitted.axes != truth.axes:
        raise UserError(f'the fitted unit has the axes {fitted.axes}, the true unit has '
                        f'{truth.axes}; compare parameter files of one unit')
    names = fitted.covariance_names
    truth = _in_gauge_of_fit(truth, names)
    half_widths = Z_90 * np.sqrt(np.diag(fitted.covariance))
    return [_compared(name, *values) for name, *values in zip(
        names, _absolute(fitted, names), half_widths, _absolute(truth, names))]


def added_effects(fitted: Sensor, truth: Sensor) -> list[str]:
    """Return the effects of the fit that neither the full model nor the unit has."""
    expected = {*full_model.default_terms(fitted.axes), *truth.effects}
    return [effect for effect in fitted.effects if effect not in expected]


def _compared(name: Coefficient, fitted: float, half_width: float, truth: float) -> Comparison:
    """Compare one coefficient, with its label in words and angles in degrees."""
    key = str(name.without_axis)
    acts = name.axis and name.effect in OTHER_AXIS
    other = AXES[OTHER_AXIS[name.effect][AXES.index(name.axis)]] if acts else ''
    unit, scale = parameter_of(name).unit, 1.0
    if unit == 'rad':
        unit, scale = '°', float(np.degrees(1.0))
    return Comparison(key, name.axis, _LABELS.get(key, key).format(other=other),
                      unit.replace('^2', '²'), *(float(scale * value) for value in (
                          fitted, half_width, truth)))


def _absolute(sensor: Sensor, names: tuple[Coefficient, ...]) -> np.ndarray:
    """Return coefficients; zero-g and scale factor include their nominal values, (p,)."""
    values = get(sensor, names)
    for i, name in enumerate(names):
        nominal = _ABSOLUTE.get(name.without_axis)
        if nominal:
            values[i] += getattr(sensor, nominal)[sensor.axes.index(name.axis)]
    return values


def _in_gauge_of_fit(truth: Sensor, names: tuple[Coefficient, ...]) -> Sensor:
    """Return the true unit with the terms of the fit, other linear terms as misalignment."""
    effects = [name.effect for name in (*names, *_LINEAR, *_ANGLES, _SCALE)]
    equivalent = truth = with_neutral(truth, effects)
    for axis in truth.axes:
        moved = [name for name in _on(axis, _LINEAR) if name not in names]
        if moved and all(name in names for name in _on(axis, _ANGLES)):
            equivalent = put(equivalent, *_as_misalignment(truth, axis, moved))
    return equivalent


def _on(axis: str, parameters: Sequence[Coefficient]) -> list[Coefficient]:
    """Name the coefficients of parameters on one axis."""
    return [replace(parameter, axis=axis) for parameter in parameters]


def _as_misalignment(truth: Sensor, axis: str, moved: list[Coefficient]
                     ) -> tuple[list[Coefficient], list[float]]:
    """
    Move linear cross-axis terms of one axis into its misalignment and its scale factor.

    A_d + p·A_c = (Θ_d + p·Θ_c)·f is again a projection of the specific force, along another
    direction and scaled by its length. Products of p with the other terms are neglected.
    """
    case_axis = AXES.index(axis)
    along = _direction(truth, case_axis)
    for name in moved:
        linear, = get(truth, [name])
        along = along + linear * _direction(truth, OTHER_AXIS[name.effect][case_axis])
    length = float(np.linalg.norm(along))
    d = truth.axes.index(axis)
    scale = truth.scale_v_per_g[d] * length - truth.nominal_scale_v_per_g[d]
    changed = [*_on(axis, (*_ANGLES, _SCALE)), *moved]
    return changed, [*_alpha_beta(case_axis, along / length), float(scale), *[0.0] * len(moved)]


def _direction(sensor: Sensor, axis: int) -> np.ndarray:
    """Return the direction of an axis in the case; an unmeasured axis is aligned."""
    if AXES[axis] not in sensor.axes:
        return np.eye(3)[axis]
    return np.array(direction(axis, *get(sensor, _on(AXES[axis], _ANGLES))))


def _alpha_beta(axis: int, along: np.ndarray) -> tuple[float, float]:
    """Return alpha and beta of a unit vector, rad: the inverse of `misalignment.direction`."""
    x, y, z = along
    alpha, sine = [(np.arctan2(-z, x), y), (np.arctan2(z, y), -x), (np.arctan2(-y, z), x)][axis]
    return float(alpha), float(np.arcsin(sine))


_RIDGE = 1e-3
"""Weight of a change of 0, relative to a rest, for a direction that no rest of a recording has.
Chosen: small beside one rest."""
_NEGLIGIBLE_MG = 0.01
"""Error or scatter below which only this limit is shown, mg. Chosen: no sensor repeats that
well."""
_SMALL_MG = 10.0
"""Error below which mg is the unit, and above which g is. Chosen: two digits read as 9.9 mg."""


def turn_on_lines(fitted: Sensor, recordings: Sequence[Poses]) -> list[str]:
    """Report the scatter of the zero-g over recordings of one unit."""
    if len(recordings) < 2:
        return []
    changes_mg = np.array([_zero_g_change_mg(fitted, poses) for poses in recordings])
    scatter_mg = np.std(changes_mg, axis=0, ddof=1)
    texts = [f'{value:.2g}' if value > _NEGLIGIBLE_MG else f'< {_NEGLIGIBLE_MG:g}'
             for value in scatter_mg]
    by_axis = ', '.join(f'{axis} {text}' for axis, text in zip(fitted.axes, texts))
    return [f'turn-on to turn-on: the zero-g scatters by {by_axis} mg (standard deviation over '
            f'{len(recordings)} recordings)']


def _zero_g_change_mg(fitted: Sensor, poses: Poses) -> np.ndarray:
    """Return the zero-g of a recording minus that of the fit by axis, mg, (m,)."""
    if has_angles(poses).any():
        poses = poses.subset(has_angles(poses))
        force = list(reference_force(poses, fitted.local_gravity_mps2))
        predicted = signal_chain.static_response(fitted)(force, poses.environment)
        residual_v = poses.volts - np.column_stack(predicted)
        return np.asarray(1e3 * np.mean(residual_v / fitted.scale_v_per_g, axis=0))
    # Against gravity a change shows along the direction of each rest only.
    force_mps2 = np.column_stack(signal_chain.inverse(fitted)(
        list(poses.volts.T), poses.environment))
    magnitude_mps2 = np.linalg.norm(force_mps2, axis=1)
    direction = force_mps2 / magnitude_mps2[:, None]
    excess_mg = 1e3 * (magnitude_mps2 / fitted.local_gravity_mps2 - 1)
    normal = direction.T @ direction + _RIDGE * np.eye(direction.shape[1])
    return np.asarray(np.linalg.solve(normal, direction.T @ excess_mg))


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


_MODELS = {'nominal': 'datasheet values', 'linear': 'linear calibration',
           'physical': 'physical calibration', 'full': 'full calibration'}
"""Models in words."""
_LONGEST_LABEL = 26
"""Columns that a coefficient's name may take, so that its line has at most 79."""
_COVERED = 0.9
"""Share of the 90 % intervals that contain the true value if the intervals are right."""


def error_table(models: Sequence[HeldOutErrors]) -> list[str]:
    """Lay out the errors of the models on held-out poses; the file holds the last model."""
    lines = [f' {"":24}tilt error     acceleration error     (rms)']
    lines += [f' {_MODELS[errors.model]:22} {_three_digits(errors.tilt_deg.rms):>9} ° '
              f'{_three_digits(errors.accel_mg.rms):>18} mg' for errors in models]
    lines[-1] += '           <- saved'
    return lines


def _three_digits(value: float) -> str:
    """Write a value so that the decimal points of a right-aligned column stand in one line."""
    if np.isnan(value):
        return '-   '
    decimals = 1 if value >= 10 else 2 if value >= 1 else 3
    return f'{value:.{decimals}f}'.ljust(len(f'{value:.3f}'))


def truth_table(comparisons: Sequence[Comparison]) -> list[str]:
    """Lay out each fitted coefficient beside the true one, in 79 columns."""
    width = _label_width(comparisons)
    inside = sum(row.inside for row in comparisons)
    return [f' {"coefficient":{width}}     fitted (90 %) {"":16}true',
            *(_truth_row(row, width) for row in comparisons),
            f' ({inside} of {len(comparisons)} inside their 90 % intervals; about '
            f'{_COVERED * len(comparisons):.0f} are expected)']


def _truth_row(row: Comparison, width: int) -> str:
    """Lay out one coefficient, with a label of the given width."""
    truth = '0' if row.truth == 0 else rounded(row, row.truth)
    return (f'{_fitted_row(row, width)} {truth:>10}   {"ok" if row.inside else "MISSED"}')


def _label_width(rows: Sequence[Comparison]) -> int:
    longest = max((len(row.label) for row in rows), default=0)
    return max(min(longest + 1, _LONGEST_LABEL), len('coefficient'))


def _fitted_row(row: Comparison, width: int) -> str:
    """Lay out the fitted value of a coefficient, with a label of the given width."""
    return (f' {row.label[:width]:{width}} {row.axis:1} {rounded(row, row.fitted):>10} ± '
            f'{rounded(row, row.half_width):8} {row.unit:5}')


def rounded(row: Comparison, value: float) -> str:
    """Write a value with the decimals that show two digits of the interval."""
    places = decimals(row.half_width)
    return f'{round(value, places) + 0.0:.{places}f}'


def acceptance_lines(fitted: Sensor) -> list[str]:
    """
    Return whether the calibration error is within its limit, as lines.

    The limit is that of the datasheet, or the noise of one sample where no datasheet states one.
    """
    provenance = fitted.provenance
    span = [f'       By rests within {duration(float(provenance["span_s"]))}; a longer drift is '
            'not in this figure.'] if 'span_s' in provenance else []
    if 'own_accel_mg' not in provenance:
        return [f' {acceptance.NOT_SHOWN}  no pose was kept out of the fit to assess it']
    error_mg = float(provenance['own_accel_mg'])
    limit_mps2, kind, allows = acceptance.nonlinearity_mps2(fitted), 'datasheet', \
        'the datasheet allows'
    if not limit_mps2:
        limit_mps2, kind, allows = sample_noise_mps2(fitted), 'noise', 'the noise of one sample is'
    limit = f'{acceptance.two_digits(1e3 * limit_mps2 / G0_MPS2)} mg'
    accel = provenance.get(f'verdict_{kind}', '')
    tilt = provenance.get(f'verdict_tilt_{kind}', '')
    result = f'calibration error {acceptance.two_digits(error_mg)} mg; {allows} {limit}'
    if acceptance.FAIL in (accel, tilt):
        if accel != acceptance.FAIL:
            tilt_deg = float(provenance['own_tilt_deg'])
            result = f'tilt error {tilt_deg:.2g}°, more than {limit} causes'
        advice = 'More poses, or longer ones, reduce it.'
        if len(fitted.axes) == 1:
            advice = 'One axis does not see the force across it: align it, or accept this error.'
        elif kind == 'datasheet':
            advice = 'The sensor is worse than its datasheet states: do not use this file.'
        return [f' {acceptance.FAIL}  {result}', f'       {advice}', *span]
    if acceptance.NOT_SHOWN in (accel, tilt):
        return [f' {acceptance.NOT_SHOWN}  {result}',
                '            The check poses are too few to show that the error is within it.',
                *span]
    return [f' {acceptance.PASS}  {result}', *span]


def added_effect_lines(effects: Sequence[str]) -> list[str]:
    """Name each effect that the fit has and the simulated unit does not have."""
    return [f'       The fit has the term {effect}, which this unit does not have.'
            for effect in effects]


def gravity_lines(fit: GravityFit) -> list[str]:
    """Lay out the errors of a calibration against gravity, before and after."""
    used = np.setdiff1d(np.arange(len(fit.before_mps2)), fit.outliers)
    before, after, held_out = (
        _three_digits(1e3 * float(np.sqrt(np.mean(values[used] ** 2))) / G0_MPS2)
        for values in (fit.before_mps2, fit.residual_mps2, fit.held_out_mps2))
    lines = [f' error of the magnitude of gravity, rms over {len(used)} rests',
             f' {"datasheet values":22} {before:>9} mg',
             f' {"gravity calibration":22} {after:>9} mg    <- saved',
             f' {"a fifth of time held out":22}{held_out:>8} mg']
    if fit.outliers:
        count = len(fit.outliers)
        lines.append(f' {count} {"outlier was" if count == 1 else "outliers were"} left out')
    return lines
