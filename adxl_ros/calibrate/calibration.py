# SPDX-License-Identifier: Apache-2.0

"""Calibration of a sensor from poses: fit, assessment, provenance, and its report."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

from adxl_ros.calibrate.fits import full_model, gravity_fit, linear, term_selection, thermal_fit
from adxl_ros.calibrate.fits.pose_covariance import volts_covariance
from adxl_ros.calibrate.pose_model import predicted_volts, reference_force, residual_g
from adxl_ros.calibrate.poses import Poses
from adxl_ros.calibrate.report import acceptance, held_out
from adxl_ros.calibrate.report.acceptance import Assessment
from adxl_ros.calibrate.report.error_causes import error_budgets
from adxl_ros.calibrate.report.held_out import HeldOutErrors
from adxl_ros.calibrate.result import CalibrationResult, envelope, with_provenance
from adxl_ros.errors import UserError
from adxl_ros.model import signal_chain
from adxl_ros.model.constants import AXES, G0_MPS2, Z_90
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.error_sizes import rms, stds
from adxl_ros.model.noise import means_at_a_rail
from adxl_ros.model.population import Population, posterior
from adxl_ros.model.sensor import Sensor
from adxl_ros.report.quantities import mg, with_half_width
from adxl_ros.signals import filter_noise, polarity
from adxl_ros.signals.gravity_at_rest import of_volts, require_unit
from adxl_ros.signals.stage_angles import StageReadings
from adxl_ros.wording import option
import numpy as np

STAGE_FITS = {'linear': linear.fit, 'physical': linear.fit_physical, 'full': term_selection.fit}
"""Models that are fitted against the stage, simplest first."""
_MAX_TURN_RAD = np.radians(0.3)
"""Largest turn of the case between recordings, rad. Chosen: above the 0.1° of the stage's level in
either recording, far below a new mounting."""
_MAX_ZERO_G_SHIFT_G = 0.02
"""Largest shift of the zero-g between recordings, g. Chosen: a healthy sensor may shift by so much
between two days."""
_MIN_DEVIATIONS = 6.0  # Smallest turn or shift that counts, in its stds; chosen: never by chance
_MIN_EIGENVALUE_RATIO = 1e-10
"""Smallest relative eigenvalue of the information whose direction counts as determined."""
_MIN_VARIANCE = 1e-30
"""Lower bound of the variance of a turn, rad², or shift, g², so that it can be a divisor."""


@dataclass(frozen=True)
class RecordedPoses:
    """Poses of one recording."""

    source: str  # Name of the recording, for messages and the provenance
    poses: Poses  # With angles or without
    # Estimated output filter of each axis
    filters: Sequence[filter_noise.FilterNoise | None] = ()
    faults: Sequence[str] = ()  # What is wrong between the samples, one line each


def calibrate(
    sensor: Sensor,
    recordings: Sequence[RecordedPoses],
    model: str | None = None,
    effects: Sequence[str] = (),
    data_sha256: str = '',
    population: Population | None = None,
) -> CalibrationResult:
    """
    Fit the poses of one sensor: against the stage where there are angles, else against gravity.

    Parameters
    ----------
    sensor
        The nominal sensor.
    recordings
        Poses of each recording.
    model
        'linear', 'physical' or 'full'. None is the richest model that the poses determine.
    effects
        Further terms of the full model.
    data_sha256
        Hash of the recordings' files. Empty takes the hash of the poses.
    population
        Prior of zero-g and scale factor; None for the fit's own.

    Returns
    -------
    CalibrationResult
        The calibrated sensor with its assessment.

    Raises
    ------
    UserError
        The poses do not determine the model, or the recordings contradict each other.

    """
    source = ', '.join(recording.source for recording in recordings)
    poses = Poses.joined([recording.poses for recording in recordings])
    lines: list[str] = []
    at_rail = means_at_a_rail(sensor, poses.volts)
    if at_rail.any():
        starts_s = poses.time_s[at_rail, 0]
        text = f'ADC at a rail in {len(starts_s)} poses (the first one from {starts_s[0]:.1f} s)'
        if at_rail.all():
            raise UserError(f'{source}: {text}: no other is left; check supply and wiring')
        lines = [f'{text}, left out: check supply and wiring']
        recordings = [
            replace(each, poses=each.poses.subset(~means_at_a_rail(sensor, each.poses.volts)))
            for each in recordings
        ]
        poses = poses.subset(~at_rail)
    doubts = require_unit(of_volts(poses.volts, poses.std_v, sensor), source, True)
    for recording in recordings:
        doubts += recording.faults
    given = _Given(sensor, source, data_sha256, population, doubts)
    if poses.has_angles.any():
        with_angles = [
            replace(recording, poses=recording.poses.subset(recording.poses.has_angles))
            for recording in recordings
        ]
        model = model or ('full' if effects else None)
        result = _against_stage(given, with_angles, model, effects)
        starts_s = poses.time_s[~poses.has_angles, 0]
        if len(starts_s):
            lines.append(
                f'rests without angles, left out: {len(starts_s)} (the first one from '
                f'{starts_s[0]:.1f} s)'
            )
    elif model not in (None, 'full'):
        raise UserError(
            f'{source}: the {model} model is fitted against stage angles (alpha_rad '
            f'and beta_rad), which are missing; leave {option("model")} out to calibrate a '
            'three-axis sensor against gravity'
        )
    elif effects:
        raise UserError(
            f'{source}: {", ".join(effects)} cannot be fitted against gravity; record stage '
            'angles (alpha_rad and beta_rad), or leave the effects out'
        )
    elif sensor.axes != AXES:
        raise UserError(
            f'{source}: no stage angles and only the axes {sensor.axes}: the '
            'magnitude of gravity needs x, y and z; record alpha_rad and beta_rad'
        )
    else:
        span_s = sum(float(np.ptp(recording.poses.time_s)) for recording in recordings)
        result = _against_gravity(given, poses, span_s)
    lines += _turn_on_lines(result.fitted, [recording.poses for recording in recordings])
    return replace(result, warnings=(*result.warnings, *lines))


class _Given(NamedTuple):
    """What each fit of some recordings is given beside the poses."""

    sensor: Sensor  # The nominal sensor
    source: str  # Names of the recordings
    data_sha256: str
    population: Population | None
    doubts: list[str]  # What is wrong with the recordings, one line each


@dataclass(frozen=True)
class _StageFit:
    fitted: Sensor
    refit: held_out.Fit  # The same fit to other poses, for cross-validation
    full: full_model.FullFit | None = None  # The full fit; None for other models
    terms: Sequence[term_selection.Term] = ()  # Evidence for the terms of a full fit
    notes: Sequence[str] = ()  # What to know about the choice of the model


def _against_stage(
    given: _Given,
    recordings: Sequence[RecordedPoses],
    model: str | None,
    effects: Sequence[str],
) -> CalibrationResult:
    sensor, source, data_sha256, population, doubts = given
    poses = Poses.joined([recording.poses for recording in recordings])
    for recording in recordings:
        _require_radians(sensor, recording)
    _check_polarity(sensor, poses)
    fit = _richest_fit(sensor, poses.subset(~poses.check), recordings, model, effects)
    if population is not None:
        fit = _with_population(fit, population)
    fitting = np.flatnonzero(~poses.check)
    outliers = tuple(fitting[list(fit.full.outliers)].tolist()) if fit.full else ()
    inliers = poses.subset(~np.isin(np.arange(len(poses)), outliers))
    judgement = _judged(sensor, inliers, fit, not doubts)
    fitted = fit.fitted
    residual_mps2 = G0_MPS2 * residual_g(fitted, poses)[fitting]
    details: list[str] = []
    warnings = list(doubts)
    if fit.full:
        details += term_selection.report_lines(fit.full, poses.subset(fitting), fit.terms)
        warnings += term_selection.warnings(fit.full, poses.subset(fitting))
    if fitted.model == 'full':
        fitted, filter_lines = filter_noise.with_filter(
            fitted, [recording.filters for recording in recordings if recording.filters]
        )
        details += filter_lines
    force = np.column_stack(reference_force(poses, fitted.local_gravity_mps2))
    fitted = replace(fitted, envelope=envelope(fitted, force, poses, judgement.error_mps2))
    entries = {'reference': 'stage'}
    if population:
        entries['prior'] = population.name
    entries['residual_mg'] = f'{mg(rms(residual_mps2)):.4f}'
    if fit.full:
        entries['converged'] = 'yes' if fit.full.converged else 'no'
    entries |= acceptance.provenance_entries(judgement.of_fit, judgement.held_out, doubts)
    fitted = with_provenance(fitted, source, poses, data_sha256, entries)
    return CalibrationResult(
        nominal=sensor,
        fitted=fitted,
        summary=acceptance.summary_lines(
            fitted,
            judgement.of_fit,
            acceptance.held_out_lines(judgement.held_out, len(inliers)),
        ),
        poses=poses,
        assessments=judgement.assessments,
        held_out=judgement.held_out,
        outliers=outliers,
        warnings=[*warnings, *fit.notes],
        details=details,
    )


def _require_radians(sensor: Sensor, recording: RecordedPoses) -> None:
    """Refuse stage angles in degrees."""
    poses = recording.poses
    angles_rad = np.column_stack([poses.alpha_rad, poses.beta_rad])
    if fault := StageReadings.of(angles_rad, poses.volts, sensor).degrees_fault():
        raise UserError(f'{recording.source}: {fault}')


def _check_polarity(sensor: Sensor, poses: Poses) -> None:
    """Refuse a sensor with an inverted axis or with swapped axes."""
    if len(poses) < 2:
        return
    reference = reference_force(poses, sensor.local_gravity_mps2)
    with np.errstate(invalid='ignore', divide='ignore'):
        correlation = np.array(
            [[np.corrcoef(volts, force)[0, 1] for force in reference] for volts in poses.volts.T]
        )
    fault = polarity.find_polarity_fault(
        correlation, sensor.axis_indices, polarity.CERTAIN_CORRELATION
    )
    if fault is not None:
        raise UserError(fault.describe(sensor.axes[fault.axis], AXES[fault.follows]))


def _with_population(fit: _StageFit, population: Population) -> _StageFit:
    """Combine a fit with the population of the sensor, those of cross-validation as well."""
    combined = posterior(fit.fitted, population)

    def refit(sensor: Sensor, poses: Poses) -> Sensor:
        fitted = fit.refit(sensor, poses)
        return fitted if combined.is_stranger else posterior(fitted, population).sensor

    return replace(
        fit, fitted=combined.sensor, refit=refit, notes=[f'prior: {combined.line}', *fit.notes]
    )


class _Judgement(NamedTuple):
    """Held-out errors and acceptance of a fit and of all simpler models, the fit the last."""

    held_out: tuple[HeldOutErrors, ...] = ()
    assessments: tuple[Assessment, ...] = ()

    @property
    def of_fit(self) -> Assessment | None:
        """Return the acceptance of the fit itself."""
        return self.assessments[-1] if self.assessments else None

    @property
    def error_mps2(self) -> float:
        """Return the error of the calibration, m/s²; 0 where it is not known."""
        calibration = self.of_fit.accel.calibration if self.of_fit else 0.0
        return float(np.nan_to_num(np.sqrt(calibration)))


def _judged(sensor: Sensor, inliers: Poses, fit: _StageFit, is_sound: bool) -> _Judgement:
    """Judge the fit and all simpler models by poses that they have not seen."""
    # The reference of all models is the stage with its fitted errors.
    stage = fit.full.with_stage if fit.full else None
    model = fit.fitted.model
    models = list(STAGE_FITS)
    simpler = {name: STAGE_FITS[name] for name in models[: models.index(model)]}
    errors = held_out.cross_validate(
        {'nominal': lambda sensor, _: sensor, **simpler, model: fit.refit},
        sensor,
        inliers,
        stage,
    )
    if not errors or errors[-1].model != model:
        return _Judgement()
    is_certain = (
        is_sound
        and (fit.full is None or fit.full.converged)
        and not acceptance.open_coefficients(fit.fitted)
    )
    assessments = [
        acceptance.assess(
            row.model,
            error_budgets(row, inliers, stage),
            sensor,
            is_certain or (is_sound and row.model != model),
        )
        for row in errors
        if row.model != 'nominal'
    ]
    assessments[-1] = acceptance.judged(assessments[-1], fit.fitted)
    return _Judgement(tuple(errors), tuple(assessments))


def _richest_fit(
    sensor: Sensor,
    poses: Poses,
    recordings: Sequence[RecordedPoses],
    model: str | None,
    effects: Sequence[str],
) -> _StageFit:
    """Fit a model, or the richest one that the poses determine; also note why no richer one."""

    def fitted(name: str) -> _StageFit:
        if name != 'full':
            return _StageFit(STAGE_FITS[name](sensor, poses), STAGE_FITS[name])
        selected = term_selection.fit_selected(sensor, poses, effects)
        full = selected.fit
        if len(recordings) > 1:
            _require_one_mounting(full, recordings)
        refit = partial(term_selection.fit, effects=effects)
        return _StageFit(full.fitted, refit, full, selected.terms)

    if model:
        return fitted(model)
    refusals: list[str] = []
    for name in ('full', 'physical'):
        try:
            return replace(fitted(name), notes=refusals)
        except _ContradictionError:
            raise
        except UserError as error:
            refusals.append(f'not {name}: {error}')
    if sensor.axes == AXES and not effects:
        # The fit of the twelve coefficients states for itself what is open.
        with suppress(UserError):
            return _fit_affine(sensor, poses)
    return replace(fitted('linear'), notes=refusals)


def _fit_affine(sensor: Sensor, poses: Poses) -> _StageFit:
    """Fit the twelve coefficients of a three-axis sensor to poses that determine no more."""
    full = full_model.fit_full(sensor, poses, linear.AFFINE, full_model.MAX_OPEN)
    still_open = acceptance.open_coefficients(full.fitted)
    notes = [
        f'{len(poses)} poses determine zero-g, scale factor and misalignment, no further '
        'terms; more poses show those'
    ]
    if still_open:
        notes.append(
            f'open, by its prior alone: {", ".join(map(str, still_open))}; add poses '
            'with this axis up and down'
        )

    def refit(sensor: Sensor, poses: Poses) -> Sensor:
        # With more open coefficients it would be another fit, whose errors are not those of this.
        return full_model.fit_full(sensor, poses, linear.AFFINE, len(still_open)).fitted

    return _StageFit(full.fitted, refit, full, notes=notes)


class _ContradictionError(UserError):
    """Recordings contradict each other, so that no model holds for all of them."""


def _require_one_mounting(full: full_model.FullFit, recordings: Sequence[RecordedPoses]) -> None:
    """Refuse recordings if a turn of the case or a shift of the zero-g shows in one of them."""
    axes = full.with_stage.axes
    limits = np.repeat([_MAX_TURN_RAD, _MAX_ZERO_G_SHIFT_G], [3, len(axes)])
    for recording in recordings:
        changes, std = _turn_and_shifts(full, recording.poses)
        deviations = np.where(np.abs(changes) > limits, np.abs(changes) / std, 0.0)
        worst = int(np.argmax(deviations))
        if deviations[worst] <= _MIN_DEVIATIONS:
            continue
        if worst < 3:
            change = f'case is turned by {np.degrees(changes[worst]):.2f} deg about {AXES[worst]}'
        else:
            change = (
                f'zero-g of {axes[worst - 3]} is shifted by {mg(changes[worst] * G0_MPS2):.2f} mg'
            )
        raise _ContradictionError(
            f'{recording.source}: {change} from the fit of all recordings '
            f'({deviations[worst]:.0f} standard deviations): another unit or another '
            'mounting; fit this recording separately'
        )


def _turn_and_shifts(full: full_model.FullFit, poses: Poses) -> tuple[np.ndarray, np.ndarray]:
    """Fit turn, rad, (3,), and zero-g shifts, g, (m,), to residuals; return values and std."""
    sensor = full.with_stage
    force = reference_force(poses, sensor.local_gravity_mps2)
    by_force = np.moveaxis(
        signal_chain.jacobian(signal_chain.analog_response(sensor), force, poses.environment), 2, 0
    )
    turned = np.stack([np.cross(axis, np.column_stack(force)) for axis in np.eye(3)], axis=2)
    shifted = np.broadcast_to(
        np.diag(sensor.scale_v_per_g), (len(poses), len(sensor.axes), len(sensor.axes))
    )
    information, gradient = volts_covariance(sensor, poses, full.stage).normal_equations(
        np.concatenate([by_force @ turned, shifted], axis=2),
        poses.volts - predicted_volts(sensor, poses),
    )
    covariance = np.linalg.pinv(information, rcond=_MIN_EIGENVALUE_RATIO)
    return covariance @ gradient, np.sqrt(np.maximum(np.diag(covariance), _MIN_VARIANCE))


def _against_gravity(given: _Given, poses: Poses, span_s: float) -> CalibrationResult:
    """Fit rests that last for a time, s, to the magnitude of gravity."""
    sensor, source, data_sha256, population, doubts = given
    fit = gravity_fit.fit_gravity(poses.volts, poses.std_v, sensor)
    kept = np.setdiff1d(np.arange(len(poses)), fit.outliers)
    after_mg = mg(rms(fit.residual_mps2[kept]))
    unseen_mg = mg(rms(fit.held_out_mps2[kept]))
    fitted = replace(
        sensor,
        model='gravity',
        effects=('bias', 'scale_factor', 'misalignment'),
        values=fit.values,
        covariance=fit.covariance,
        covariance_names=gravity_fit.NAMES,
    )
    warnings = list(doubts)
    if not fit.converged:
        warnings.append(term_selection.NOT_CONVERGED)
    if fit.note:
        warnings.append(fit.note)
    if population is not None:
        combined = posterior(fitted, population)
        fitted = combined.sensor
        warnings.append(f'prior: {combined.line}')
    force = np.column_stack(signal_chain.inverse(fitted)(list(poses.volts.T), poses.environment))
    budgets = acceptance.gravity_error_budgets(fit, fitted, force, kept)
    assessment = acceptance.assess('gravity', budgets, fitted, fit.converged and not doubts)
    if fit.rung.left_out:
        determined = [name not in fit.rung.left_out for name in fitted.covariance_names]
        assessment = acceptance.with_open(
            assessment,
            acceptance.gravity_error_budgets(
                fit, fitted.with_covariance_of(determined), force, kept
            ),
            fitted,
        )
    assessment = acceptance.judged(assessment, fitted)
    fitted = replace(
        fitted, envelope=envelope(fitted, force[kept], poses, float(np.sqrt(budgets.accel.model)))
    )
    fitted = with_provenance(
        fitted,
        source,
        poses,
        data_sha256,
        {
            'reference': 'gravity',
            **({'prior': population.name} if population else {}),
            'residual_mg': f'{after_mg:.4f}',
            'held_out_mg': f'{unseen_mg:.4f}',
            **({'span_s': f'{span_s:.1f}'} if span_s else {}),
            'converged': 'yes' if fit.converged else 'no',
            **acceptance.provenance_entries(assessment, (), doubts),
        },
    )
    summary = acceptance.summary_lines(
        fitted, assessment, acceptance.gravity_lines(fit, poses.time_s[:, 0])
    )
    return CalibrationResult(
        nominal=sensor,
        fitted=fitted,
        summary=summary,
        poses=poses,
        assessments=(assessment,),
        gravity_fit=fit,
        warnings=warnings,
    )


def _turn_on_lines(fitted: Sensor, recordings: Sequence[Poses]) -> list[str]:
    """Report the scatter of the zero-g over recordings of one sensor on the stage."""
    on_stage = [poses.subset(poses.has_angles) for poses in recordings if poses.has_angles.any()]
    if len(on_stage) < 2:
        return []
    changes_mg = [mg(G0_MPS2 * np.mean(residual_g(fitted, poses), axis=0)) for poses in on_stage]
    by_axis = ', '.join(
        f'{axis} {value:.2g}'
        for axis, value in zip(fitted.axes, np.std(changes_mg, axis=0, ddof=1))
    )
    return [
        f'turn-on to turn-on: the zero-g scatters by {by_axis} mg (standard deviation over '
        f'{len(on_stage)} recordings)'
    ]


def calibrate_thermal(
    base: Sensor,
    poses: Poses,
    source: str,
    data_sha256: str = '',
    range_c: tuple[float, float] | None = None,
) -> CalibrationResult:
    """Fit zero-g over temperature, and the slope of the scale factor where orientations allow."""
    doubts = require_unit(of_volts(poses.volts, poses.std_v, base), source, True)
    blocks = poses.with_temperature()
    fit = thermal_fit.fit(base, blocks)
    calibrated_c = thermal_fit.calibrated_temperature_c(base)
    fitted = thermal_fit.applied(base, fit, calibrated_c)
    has_scale = any(name.effect == 'temperature_scale' for name in fit.names)
    low_c, high_c = range_c or fit.span_c
    misfit_mps2 = rms(fit.rms_g) * G0_MPS2
    fitted = replace(
        fitted,
        envelope=replace(
            base.envelope,
            temperature_c=fit.span_c,
            zero_g_per_k=0.0,
            scale_per_k=0.0 if has_scale else base.envelope.scale_per_k,
            misfit_mps2=float(np.hypot(base.envelope.misfit_mps2, misfit_mps2)),
            zero_g_nodes_c=tuple(fit.further.nodes_c.tolist()),
            zero_g_next=tuple(fit.further.size.tolist()),
            zero_g_at_c=calibrated_c,
        ),
    )
    fitted = with_provenance(
        fitted,
        source,
        poses,
        data_sha256,
        {
            'reference': 'rest over temperature',
            'base': base.provenance.get('id', base.serial),
            'residual_mg': f'{mg(misfit_mps2):.4f}',
        },
    )
    covered = thermal_fit.passed(blocks.temperature_c, (low_c, high_c))
    error_mg = thermal_fit.expected_error_mg(fit, covered, calibrated_c)
    lines = [
        f'zero-g over temperature: {len(blocks)} blocks at rest, '
        f'{fit.span_c[0]:.1f} to {fit.span_c[1]:.1f} °C',
        *_thermal_lines(fit, base.axes),
        f'expected error of the zero-g over {low_c:.0f} to {high_c:.0f} °C: {error_mg:.2g} mg',
        f'zero-g stays as calibrated at {calibrated_c:.1f} °C',
    ]
    if not has_scale:
        lines.append('scale factor over temperature: not fitted, it needs a second orientation')
    return CalibrationResult(
        nominal=base, fitted=fitted, summary=lines, poses=poses, warnings=doubts
    )


def _thermal_lines(fit: thermal_fit.ThermalFit, axes: str) -> list[str]:
    """Return slope and curvature of each axis, the residuals, and the effect of the history."""
    halves = Z_90 * stds(fit.covariance)
    intervals = dict(zip(fit.names, zip(fit.values, halves)))
    lines = []
    for axis in axes:
        value_k, half_k = intervals[Coefficient('temperature_bias', 'per_k', axis)]
        value_k2, half_k2 = intervals[Coefficient('temperature_bias', 'per_k2', axis)]
        lines.append(
            f'  {axis}  {with_half_width(value_k * 1e3, half_k * 1e3)} mg/K at 25 °C, '
            f'{with_half_width(value_k2 * 1e6, half_k2 * 1e6)} µg/K²'
        )
    rms = ', '.join(f'{axis} {value * 1e3:.2g}' for axis, value in zip(axes, fit.rms_g))
    unit = 's' if fit.history == 'thermal_lag' else 'K'
    return [
        *lines,
        f'residual {rms} mg rms',
        f'warming and cooling differ: {fit.history} ({fit.shape:.3g} {unit})'
        if fit.history
        else 'no thermal_lag or thermal_hysteresis shows',
    ]
