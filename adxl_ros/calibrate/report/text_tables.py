# SPDX-License-Identifier: Apache-2.0

"""Results of a calibration as lines of a terminal with 79 columns."""

from __future__ import annotations

from collections.abc import Sequence

from adxl_ros.calibrate.fits.gravity_fit import GravityFit
from adxl_ros.calibrate.report import acceptance
from adxl_ros.calibrate.report.against_truth import Comparison
from adxl_ros.calibrate.report.cross_validation import HeldOutErrors
from adxl_ros.calibrate.report.error_budget import sample_noise_mps2
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.sensor import Sensor
from adxl_ros.report.numbers import decimals, duration
import numpy as np

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
