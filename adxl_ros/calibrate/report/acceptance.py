# SPDX-License-Identifier: Apache-2.0

"""Acceptance of a calibration, PASS or FAIL against datasheet and noise, and its lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from adxl_ros.calibrate.fits.gravity_fit import GravityFit
from adxl_ros.calibrate.fits.linear import AFFINE
from adxl_ros.calibrate.report import error_budget, held_out
from adxl_ros.calibrate.report.error_budget import ErrorBudget, ErrorBudgets, rms_mg
from adxl_ros.calibrate.report.held_out import HeldOutErrors
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.covariance import force_covariance
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.error_sizes import rms
from adxl_ros.model.noise import sample_std_v
from adxl_ros.model.sensor import parameter_of, Sensor
from adxl_ros.report.quantities import duration, mg, three_digits, two_digits
import numpy as np
import scipy

PASS = 'PASS'  # Outcome: the whole 90 % interval of the error is within the limit
FAIL = 'FAIL'  # Outcome: the error exceeds the limit
NOT_SHOWN = 'NOT SHOWN'  # Outcome: the error is within the limit, but its 90 % interval is not
_UPPER_QUANTILE = 0.95  # Probability of the upper end of a 90 % interval
_NONLINEARITY = Coefficient('nonlinearity', 'cubic_per_g2')
"""Parameter whose typical datasheet value limits the error of acceleration."""
_ZERO_G = Coefficient('bias', 'offset_v')
_SCALE = Coefficient('scale_factor', 'offset_v_per_g')
_ANY_TOLERANCE = {_ZERO_G: 0.25, _SCALE: 0.1}
"""Tolerances of any accelerometer: of the zero-g, g, and of the scale factor, as a share. Chosen:
the widest ones of the datasheets of consumer parts."""
_FAR = 2.0
"""Multiple of a tolerance that is far outside. Chosen: solder, housing and age shift a sound one
beyond its datasheet, but by less than the datasheet's width."""
_OPEN = 0.9
"""Share of the variance of a prior above which it alone says what a coefficient is. Chosen: the
poses then determine its standard deviation by a twentieth at most."""
_CHECK_READINGS = (
    'Check the unit of the readings, the range setting, and the parameter file; do not use this '
    'file.'
)
"""Advice on an implausible unit."""
_MODELS = {
    'nominal': 'datasheet values',
    'linear': 'linear calibration',
    'physical': 'physical calibration',
    'full': 'full calibration',
}
"""Models in words."""
LIMITS = {
    'open': 'coefficients that the poses do not determine',
    'noise': 'the noise of the means; longer rests reduce it',
    'stage': 'the angles of the stage; further poses reduce it',
    'model': 'the model, which does not have the form of this unit',
    'noise or model': 'noise or model; a table of means does not separate them',
    'stage or model': 'the stage or the model; poses that are visited twice separate them',
}
"""What limits a calibration, and what helps, by cause."""


@dataclass(frozen=True)
class Assessment:
    """The outcomes of one model at the `limit`: PASS, FAIL or NOT SHOWN; '' without a limit."""

    model: str
    accel: ErrorBudget  # (m/s²)² per axis
    tilt: ErrorBudget  # rad²
    accel_outcome: str
    tilt_outcome: str

    @property
    def error_mg(self) -> float:
        """Return the error of the calibration itself, mg rms over the axes."""
        return rms_mg(self.accel.calibration)

    @property
    def error_deg(self) -> float:
        """Return the tilt error of the calibration itself, deg rms; NaN where no pose shows it."""
        return float(np.degrees(np.sqrt(self.tilt.calibration)))


def assess(
    model: str, budgets: ErrorBudgets, sensor: Sensor, is_certain: bool = True
) -> Assessment:
    """
    Compare the calibration error of one model, without noise and stage error, with its `limit`.

    The limit of tilt is the tilt error that such errors of each axis cause.

    is_certain: whether the fit has converged and determines its coefficients. Else its errors at
    the held-out poses show nothing of others, so that it cannot pass.
    """

    def outcome(budget: ErrorBudget, limit_square: float) -> str:
        if not limit_square > 0:
            return ''
        # Where stage and model are inseparable, the model part may be an error of the stage.
        certain = budget.calibration if budget.separable else budget.coefficients
        if certain > limit_square:
            return FAIL
        passes = is_certain and budget.calibration_high <= limit_square
        return PASS if passes else NOT_SHOWN

    accel = budgets.accel
    tilt = budgets.tilt
    square = limit(sensor).mps2 ** 2
    return Assessment(
        model, accel, tilt, outcome(accel, square), outcome(tilt, square * tilt.tilt_per_axis)
    )


def with_open(assessment: Assessment, determined: ErrorBudgets, sensor: Sensor) -> Assessment:
    """
    Return the outcomes where further coefficients are known by their prior alone.

    Only the determined ones can fail. The errors of the others are in the figures, and show that
    nothing passes.
    """
    outcomes = assess(assessment.model, determined, sensor, is_certain=False)
    return replace(
        assessment, accel_outcome=outcomes.accel_outcome, tilt_outcome=outcomes.tilt_outcome
    )


def judged(assessment: Assessment, fitted: Sensor) -> Assessment:
    """Return an assessment that fails for an implausible sensor, however well it fits."""
    return replace(assessment, accel_outcome=FAIL) if implausible(fitted) else assessment


def gravity_error_budgets(
    fit: GravityFit, fitted: Sensor, force: np.ndarray, kept: np.ndarray
) -> ErrorBudgets:
    """
    Split the held-out errors of the magnitude of gravity; there is no stage part.

    The part of the coefficients is that of the force by their covariance. It includes directions
    that a magnitude does not show.

    force: specific force in all rests by the fit, m/s², (k, 3).
    """
    errors = fit.held_out_mps2[kept]
    excess = fit.excess_mps2**2
    by_noise = float(np.mean(fit.expected_mps2[kept] ** 2)) - excess
    covariance = force_covariance(fitted, list(force[kept].T), np.zeros(len(fitted.axes)))
    gravity = fitted.local_gravity_mps2
    used = np.ones(len(kept), bool)
    measured = float(np.mean(errors**2))
    nu = held_out.degrees_of_freedom(errors)
    quantile = float(scipy.special.chdtri(nu, _UPPER_QUANTILE))
    upper = max(measured * nu / quantile - by_noise, excess)
    accel = error_budget.axis_variance(covariance, [0, 1, 2], used)
    tilt = error_budget.tilt_variance(covariance, force[kept], gravity, used)
    spread = error_budget.coefficient_spread(fitted, list(force[kept].T))
    # Each of three axes has the error of a magnitude; two of the three turn the vertical.
    return ErrorBudgets(
        ErrorBudget(
            measured=measured,
            noise=by_noise,
            stage=0.0,
            coefficients=accel,
            model=excess,
            calibration_high=spread * accel + upper,
        ),
        ErrorBudget(
            measured=3 * measured / gravity**2,
            noise=2 * by_noise / gravity**2,
            stage=0.0,
            coefficients=tilt,
            model=2 * excess / gravity**2,
            calibration_high=spread * tilt + 2 * upper / gravity**2,
            tilt_per_axis=2 / gravity**2,
        ),
    )


class Limit(NamedTuple):
    """Limit of the error of acceleration."""

    mps2: float
    origin: str  # Where it comes from, for people


def limit(sensor: Sensor) -> Limit:
    """
    Return the limit of the error of acceleration.

    It is the typical nonlinearity at full scale by the datasheet, the only error that the
    manufacturer's own calibration leaves; where none is stated, the noise of one sample.
    """
    typical, _ = sensor.datasheet.get(_NONLINEARITY, (0.0, 0.0))
    if typical:
        return Limit(typical * sensor.range_g**3 * G0_MPS2, 'datasheet')
    noise_g = sample_std_v(sensor) / sensor.scale_v_per_g
    return Limit(G0_MPS2 * rms(noise_g), 'noise of one sample')


def summary_lines(
    fitted: Sensor, assessment: Assessment | None, errors: Sequence[str]
) -> list[str]:
    """Return verdict, errors as given, and limits: what a terminal and the head of a file show."""
    lines = [*acceptance_lines(fitted), '', *errors]
    if assessment is not None:
        if open_coefficients(fitted):
            cause = 'open'
        elif limit(fitted).mps2:
            cause = assessment.accel.limited_by
        else:
            cause = 'noise or model'
        lines += [
            '',
            *limit_table(assessment, fitted),
            f' limited by               {LIMITS[cause]}',
        ]
    return lines


def held_out_lines(models: Sequence[HeldOutErrors], inliers: int) -> list[str]:
    """Return the errors of the models, and the poses that show them."""
    if not models:
        return []
    count = models[-1].pose_count
    folds = ': a fifth is left out at a time' if count >= inliers else ''
    return [f' on {count} poses that the fit has not seen{folds}', *screen_table(models)]


def screen_table(models: Sequence[HeldOutErrors]) -> list[str]:
    """Lay out the errors of the models on held-out poses for people; the last one is saved."""
    lines = [f' {"":24}tilt error     acceleration error     (rms)']
    for errors in models:
        tilt = _padded(errors.tilt_deg.rms)
        accel = _padded(errors.accel_mg.rms)
        lines.append(f' {_MODELS[errors.model]:22} {tilt:>9} ° {accel:>18} mg')
    lines[-1] += '           <- saved'
    return lines


def _padded(value: float) -> str:
    """Write a value so that the decimal points of a column stand in one line."""
    return '-   ' if np.isnan(value) else three_digits(value).ljust(len(f'{value:.3f}'))


def limit_table(assessment: Assessment, sensor: Sensor) -> list[str]:
    """Lay out the error of the calibration above its limit, with one outcome for each figure."""

    def row(name: str, size_mg: float, size_deg: float, accel: str = '', tilt: str = '') -> str:
        degrees = '-' if np.isnan(size_deg) else two_digits(size_deg)
        return f' {name:24} {degrees:>7} ° {tilt:9} {two_digits(size_mg):>8} mg {accel}'.rstrip()

    lines = [row('calibration error', assessment.error_mg, assessment.error_deg)]
    limit_mps2 = limit(sensor).mps2
    if limit_mps2:
        limit_deg = float(np.degrees(limit_mps2 * np.sqrt(assessment.tilt.tilt_per_axis)))
        outcomes = assessment.accel_outcome, assessment.tilt_outcome
        lines.append(row('limit', mg(limit_mps2), limit_deg, *outcomes))
    return lines


def gravity_lines(fit: GravityFit, time_s: np.ndarray) -> list[str]:
    """State the errors against gravity of rests that begin at times, (k,), and the outliers."""
    kept = np.setdiff1d(np.arange(len(fit.before_mps2)), fit.outliers)
    before = held_out.statistic(mg(fit.before_mps2[kept]))
    after = held_out.statistic(mg(fit.residual_mps2[kept]))
    unseen = held_out.statistic(mg(fit.held_out_mps2[kept]))
    low, high = unseen.interval
    lines = [
        f'magnitude of gravity over {len(kept)} rests, rms in mg: nominal {before.rms:.2f}, '
        f'{fit.rung.text} {after.rms:.3f}, held-out stretches of time {unseen.rms:.3f} '
        f'({low:.3f} to {high:.3f}), {unseen.largest:.3f} max'
    ]
    if fit.outliers:
        rests = ', '.join(f'{i + 1} (from {time_s[i]:.1f} s)' for i in fit.outliers)
        lines.append(f'outliers, left out: rest {rests}')
    return lines


def provenance_entries(
    assessment: Assessment | None, models: Sequence[HeldOutErrors], doubts: Sequence[str] = ()
) -> dict[str, str]:
    """Return the entries about the saved model, and why it cannot pass, without NaN."""
    doubt = {'doubt': doubts[0]} if doubts else {}
    if assessment is None:
        return doubt
    numbers: dict[str, float] = {
        'own_accel_mg': assessment.error_mg,
        'own_tilt_deg': assessment.error_deg,
    }
    if models:
        numbers |= {
            'held_out_poses': models[-1].pose_count,
            'held_out_tilt_rms_deg': models[-1].tilt_deg.rms,
            'held_out_accel_rms_mg': models[-1].accel_mg.rms,
        }
    entries = {
        **{key: f'{value:.4g}' for key, value in numbers.items() if np.isfinite(value)},
        'verdict': assessment.accel_outcome,
        'verdict_tilt': assessment.tilt_outcome,
        'limited_by': assessment.accel.limited_by,
    }
    return {key: entry for key, entry in entries.items() if entry} | doubt


class Acceptance(NamedTuple):
    """Whether a calibration is good enough, for people."""

    outcome: str  # PASS, FAIL or NOT SHOWN
    reason: str  # Its figures
    advice: Sequence[str] = ()  # What to do, or what the figures leave out, one line each

    @property
    def lines(self) -> list[str]:
        """Return reason and advice."""
        return [self.reason, *self.advice]


def acceptance(fitted: Sensor) -> Acceptance:
    """Compare the error with the datasheet, or with the noise where it states none."""
    provenance = fitted.provenance
    if fault := implausible(fitted):
        return Acceptance(FAIL, f'{fault}.', [_CHECK_READINGS])
    if 'own_accel_mg' not in provenance:
        return Acceptance(NOT_SHOWN, 'no pose was kept out of the fit to assess it')
    reason = f'calibration error {two_digits(float(provenance["own_accel_mg"]))} mg'
    limit_mps2, origin = limit(fitted)
    if not limit_mps2:
        return Acceptance(
            NOT_SHOWN, f'{reason}; neither a datasheet nor the noise of a sample states a limit'
        )
    limit_text = f'{two_digits(mg(limit_mps2))} mg'
    reason += f'; the {origin} {"allows" if origin == "datasheet" else "is"} {limit_text}'
    accel = provenance.get('verdict', '')
    outcomes = accel, provenance.get('verdict_tilt', '')
    outcome = PASS
    advice = []
    if FAIL in outcomes:
        outcome = FAIL
        if accel != FAIL:
            tilt_deg = float(provenance['own_tilt_deg'])
            reason = f'tilt error {tilt_deg:.2g}°, more than {limit_text} causes'
        advice.append('Take more poses or a richer model; else do not use this file.')
    elif 'doubt' in provenance:
        outcome = NOT_SHOWN
        advice.append('The recording is not sound: see the warning.')
    elif NOT_SHOWN in outcomes:
        outcome = NOT_SHOWN
        open_names = ', '.join(map(str, open_coefficients(fitted)))
        advice.append(
            f'Other poses may have a larger error: {open_names} not determined.'
            if open_names
            else 'The poses are too few to show that it is within.'
        )
    if 'span_s' in provenance:
        span = duration(float(provenance['span_s']))
        advice.append(f'By rests within {span}; a longer drift is not in this figure.')
    return Acceptance(outcome, reason, advice)


def implausible(fitted: Sensor) -> str:
    """Return a fitted zero-g or scale factor that no sound sensor has, for people; '' if none."""
    for what, unit, name, nominal in (
        ('zero-g', 'V', _ZERO_G, fitted.nominal_zero_g_v),
        ('scale factor', 'V/g', _SCALE, fitted.nominal_scale_v_per_g),
    ):
        typical, largest = fitted.datasheet.get(name, (0.0, 0.0))
        stated = largest or 2 * typical
        tolerances = np.full(len(nominal), stated)
        origin = 'its datasheet'
        if not stated:
            tolerances = _ANY_TOLERANCE[name] * fitted.nominal_scale_v_per_g
            origin = 'the width of any accelerometer'
        shifts = fitted.values.get(name.effect, {}).get(name.parameter, np.zeros(0))
        for axis, shift, middle, tolerance in zip(fitted.axes, shifts, nominal, tolerances):
            if abs(shift) > _FAR * tolerance:
                return (
                    f'the {what} of {axis} is {middle + shift:.3g} {unit}, far outside of '
                    f'{middle - tolerance:.3g} to {middle + tolerance:.3g} {unit} by {origin}'
                )
    return ''


def open_coefficients(fitted: Sensor) -> list[Coefficient]:
    """Return zero-g, scale factors and misalignments that are known by their prior alone."""
    return [
        name
        for name, variance in zip(fitted.covariance_names, np.diag(fitted.covariance))
        if name.effect in AFFINE and variance > _OPEN * parameter_of(name).scale ** 2
    ]


def acceptance_lines(fitted: Sensor) -> list[str]:
    """Return the acceptance as lines of a terminal."""
    accepted = acceptance(fitted)
    further = [f'       {line}' for line in accepted.advice]
    return [f' {accepted.outcome}  {accepted.reason}', *further]
