# SPDX-License-Identifier: Apache-2.0

"""Calibration of a unit from poses: fit, assessment, provenance, and its report."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
import os

from adxl_ros.calibrate.fits import full_model, gravity_fit as gravity, linear, term_selection
from adxl_ros.calibrate.fits.full_model import FullFit
from adxl_ros.calibrate.poses import check_polarity, has_angles, join_poses, Poses, reference_force
from adxl_ros.calibrate.provenance import envelope, require_one_mounting, with_provenance
from adxl_ros.calibrate.report import acceptance, cross_validation, error_budget, text_tables
from adxl_ros.calibrate.report.acceptance import Assessment
from adxl_ros.calibrate.report.cross_validation import HeldOutErrors
from adxl_ros.errors import UserError
from adxl_ros.files import calibration_store, parameter_file
from adxl_ros.files.atomic_write import keep_previous
from adxl_ros.files.stream_info import NO_UNIT
from adxl_ros.model import signal_chain
from adxl_ros.model.coefficients import get, parameter_of
from adxl_ros.model.constants import AXES, G0_MPS2, Z_90
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.population import Population, posterior
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.recorded_sensor import FilterNoise, with_filter
import numpy as np

STAGE_FITS = {'linear': linear.fit, 'physical': linear.fit_physical, 'full': term_selection.fit}
"""Models that are fitted against the stage, simplest first."""
_LISTED_RESTS = 5
"""Largest number of rests that a line lists (chosen: fits into a line)."""
_SAME_FIT_TOLERANCE = 1e-6
"""Largest relative difference of coefficients of the same fit: the rounding in a file."""


@dataclass(frozen=True)
class RecordedPoses:
    """Poses of one recording."""

    source: str  # Name of the recording, for messages and the provenance
    poses: Poses  # Its poses, with angles or without
    # Estimate of the output filter of each axis; empty where there is none
    filters: Sequence[FilterNoise | None] = ()


@dataclass(frozen=True)
class CalibrationResult:
    """A calibrated unit with its assessment."""

    # nominal, fitted: The unit before and after the fit
    nominal: Sensor
    fitted: Sensor
    report_lines: list[str]  # Errors, acceptance and fit as text: the head of the parameter file
    # The same for a terminal of 80 columns, the most important lines first
    summary_lines: list[str]
    poses: Poses  # k poses, check poses among them
    # Acceptance of each model; the last one is that of `fitted`
    assessments: tuple[Assessment, ...] = ()
    # Errors of the models on held-out poses, the nominal sensor first
    held_out: tuple[HeldOutErrors, ...] = ()
    gravity_fit: gravity.GravityFit | None = None  # The fit of a calibration against gravity
    outliers: tuple[int, ...] = ()  # Indices of the outliers, which the fit leaves out
    # What is wrong with the poses or the fit, and why no richer model was fitted
    warnings: tuple[str, ...] = ()

    def comments(self) -> list[str]:
        """Return coefficients and assessment as text: the head of the parameter file."""
        return [*coefficient_lines(self.fitted), '', *self.report_lines]

    def save(self, path: str | os.PathLike) -> None:
        """
        Write the parameter file atomically; a file of another fit becomes NAME.previous.

        Parameters
        ----------
        path
            The file.

        Raises
        ------
        UserError
            The file cannot be written. The previous file is unchanged.

        """
        # A session that saves the same fit twice must not replace the previous calibration.
        if not self._is_in(path):
            keep_previous(path)
        parameter_file.save(path, self.fitted, self.comments())

    def keep(self, folder: str | os.PathLike) -> str:
        """
        Copy the calibration to the store. A store that cannot be written raises no error.

        Parameters
        ----------
        folder
            The store; empty for none.

        Returns
        -------
        str
            One line with the path, or with the reason why there is no copy.

        """
        if not str(folder):
            return 'not kept in a store'
        stored = calibration_store.history(folder, self.fitted.serial).calibrations
        existing = [path for path, _ in stored if self._is_in(path)]
        try:
            path = existing[0] if existing else \
                calibration_store.put(folder, self.fitted, self.comments())
        except UserError as error:
            return f'no copy in the store: {error}'
        return f'kept as {path}' if path else \
            f'not kept in {folder}: the serial number {NO_UNIT} names no unit; set ' \
            'sensor.serial'

    def _is_in(self, path: str | os.PathLike) -> bool:
        """Return whether a file holds this fit: the same data, model and coefficients."""
        try:
            saved = parameter_file.load(path)
        except UserError:
            return False
        fitted, names = self.fitted, self.fitted.covariance_names
        return (saved.model, saved.effects, saved.covariance_names) == (
            fitted.model, fitted.effects, names) and \
            saved.provenance.get('data_sha256') == fitted.provenance['data_sha256'] and \
            bool(np.allclose(get(saved, names), get(fitted, names), rtol=_SAME_FIT_TOLERANCE))

    @property
    def name(self) -> str:
        """Return the serial number and the sources of the poses."""
        return f'{self.fitted.serial} ({self.fitted.provenance["source"]})'

    @property
    def inliers(self) -> np.ndarray:
        """Mark the poses that are no outliers, (k,) bool; only these are in `held_out`."""
        return ~np.isin(np.arange(len(self.poses)), self.outliers)

    @property
    def paper_sensor(self) -> Sensor:
        """Return the unit by a model that the paper's figures can show."""
        return self.fitted if self.fitted.model in ('physical', 'full') else \
            linear.fit_physical(self.nominal, self.poses.subset(~self.poses.check))


def calibrate(sensor: Sensor, recordings: Sequence[RecordedPoses], model: str | None = None,
              effects: Sequence[str] = (), data_sha256: str = '',
              population: Population | None = None) -> CalibrationResult:
    """
    Fit the poses of one unit: against the stage where there are angles, else against gravity.

    Parameters
    ----------
    sensor
        The nominal sensor of the unit.
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
        The calibrated unit with its assessment.

    Raises
    ------
    UserError
        The poses do not determine the model, or the recordings contradict each other.

    """
    result = _calibrated(sensor, recordings, model, effects, data_sha256, population)
    lines = text_tables.turn_on_lines(result.fitted, [item.poses for item in recordings])
    return _with_warnings(result, lines)


def _with_warnings(result: CalibrationResult, lines: Sequence[str]) -> CalibrationResult:
    """Add warnings, which the report has, too."""
    return replace(result, warnings=(*result.warnings, *lines),
                   report_lines=[*result.report_lines, *lines])


def _calibrated(sensor: Sensor, recordings: Sequence[RecordedPoses], model: str | None,
                effects: Sequence[str], data_sha256: str, population: Population | None
                ) -> CalibrationResult:
    """Fit against the stage, or against gravity; see `calibrate`."""
    poses = join_poses([recording.poses for recording in recordings])
    source = ', '.join(recording.source for recording in recordings)
    if has_angles(poses).any():
        model = model or ('full' if effects else None)
        referenced = [replace(recording, poses=recording.poses.subset(has_angles(recording.poses)))
                      for recording in recordings]
        result = _against_stage(sensor, referenced, model, effects, data_sha256, population)
        return _with_warnings(result, _without_angles_lines(poses))
    if model not in (None, 'full'):
        raise UserError(f'{source}: the {model} model is fitted against stage angles (alpha_rad '
                        'and beta_rad), which are missing; leave --model out to calibrate a '
                        'three-axis sensor against gravity')
    if sensor.axes != AXES:
        raise UserError(f'{source}: no stage angles and only the axes {sensor.axes}: the '
                        'magnitude of gravity needs x, y and z; record alpha_rad and beta_rad')
    span_s = sum(float(np.ptp(recording.poses.time_s)) for recording in recordings)
    return _against_gravity(sensor, poses, source, span_s, data_sha256, population)


def _without_angles_lines(poses: Poses) -> list[str]:
    """Return which rests have no angles, as text; none where all have."""
    starts_s = poses.time_s[~has_angles(poses), 0]
    if not len(starts_s):
        return []
    listed = ', '.join(f'{start_s:.1f}' for start_s in starts_s[:_LISTED_RESTS])
    further = ' ...' * (len(starts_s) > _LISTED_RESTS)
    return [f'rests without angles, left out: {len(starts_s)} (from {listed}{further} s)']


@dataclass(frozen=True)
class _StageFit:
    """A fit against the stage."""

    fitted: Sensor  # The fitted unit
    # Function that makes the same fit to other poses, for cross-validation
    refit: cross_validation.Fit
    report_lines: Sequence[str] = ()  # Report of a full fit
    refusals: Sequence[str] = ()  # Reasons why richer models are not fitted
    warnings: Sequence[str] = ()  # What is wrong with the poses or a full fit
    full: FullFit | None = None  # The full fit; None for other models


def _against_stage(sensor: Sensor, recordings: Sequence[RecordedPoses], model: str | None,
                   effects: Sequence[str], data_sha256: str, population: Population | None
                   ) -> CalibrationResult:
    poses = join_poses([recording.poses for recording in recordings])
    check_polarity(sensor, poses)
    fit = _richest_fit(sensor, recordings, model, effects, population)
    if population is not None:
        fit = _with_population(fit, population)
    full, fitted = fit.full, fit.fitted
    fitting = np.flatnonzero(~poses.check)
    outliers = tuple(fitting[list(full.outliers)].tolist()) if full else ()
    inliers = poses.subset(~np.isin(np.arange(len(poses)), outliers))
    held_out, assessments = _assessed(sensor, inliers, fit)
    assessment = next((row for row in assessments if row.model == fitted.model), None)
    residual_mg = _rms_residual_mg(fitted, poses.subset(fitting))
    fit_lines = list(fit.report_lines)
    if fitted.model == 'full':
        fitted, filter_lines = with_filter(
            fitted, [recording.filters for recording in recordings if recording.filters])
        fit_lines += filter_lines
    force = np.column_stack(reference_force(poses, fitted.local_gravity_mps2))
    error_mps2 = np.nan_to_num(np.sqrt(assessment.accel.calibration)).item() if assessment else 0.0
    fitted = replace(fitted, envelope=envelope(fitted, force, poses, error_mps2))
    fitted = with_provenance(
        fitted, ', '.join(recording.source for recording in recordings), poses, data_sha256,
        {'reference': 'stage', **_prior_entry(population), 'residual_mg': f'{residual_mg:.4f}',
         **({'converged': _yes_or_no(full.converged)} if full else {}),
         **acceptance.provenance_entries(assessment, held_out)})
    explanation = acceptance.explanation(assessment, fitted) if assessment else []
    unit_lines = acceptance.unit_line(fitted)
    return CalibrationResult(
        nominal=sensor, fitted=fitted, poses=poses, assessments=assessments,
        held_out=held_out, outliers=outliers, warnings=(*fit.warnings, *fit.refusals),
        report_lines=[*fit.refusals, *cross_validation.table(held_out),
                      *acceptance.table(assessments, held_out), *explanation, *unit_lines,
                      *fit_lines],
        summary_lines=[*acceptance.headline(assessment, held_out), *unit_lines,
                       *acceptance.narrow_table(assessments, held_out), *explanation,
                       *fit_lines, *fit.refusals])


def _with_population(fit: _StageFit, population: Population) -> _StageFit:
    """Combine a fit with the population of the unit, those of cross-validation as well."""
    combined = posterior(fit.fitted, population)

    def refit(sensor: Sensor, poses: Poses) -> Sensor:
        fitted = fit.refit(sensor, poses)
        return fitted if combined.is_stranger else posterior(fitted, population).sensor

    line = f'prior: {combined.line}'
    return replace(fit, fitted=combined.sensor, refit=refit, warnings=[*fit.warnings, line],
                   report_lines=[*fit.report_lines, line])


def _assessed(sensor: Sensor, inliers: Poses, fit: _StageFit
              ) -> tuple[tuple[HeldOutErrors, ...], tuple[Assessment, ...]]:
    """Return held-out errors and acceptance of the fit and of all simpler models."""
    # The reference of all models is the stage with its fitted errors.
    stage = fit.full.unit if fit.full else None
    models = list(STAGE_FITS)
    simpler = {name: STAGE_FITS[name] for name in models[:models.index(fit.fitted.model)]}
    held_out = cross_validation.cross_validate(
        {'nominal': lambda sensor, _: sensor, **simpler, fit.fitted.model: fit.refit},
        sensor, inliers, stage)
    assessments = tuple(
        acceptance.assess(errors.model, error_budget.error_budgets(errors, inliers, stage), sensor)
        for errors in held_out if errors.model != 'nominal')
    return tuple(held_out), assessments


def _richest_fit(sensor: Sensor, recordings: Sequence[RecordedPoses], model: str | None,
                 effects: Sequence[str], population: Population | None) -> _StageFit:
    """Fit the given model, or the richest one that the poses and the population determine."""
    if model == 'linear' and population is not None:
        return _fit_open(sensor, recordings, population)
    if model:
        return _fit(model, sensor, recordings, effects)
    refusals: list[str] = []
    for name in ('full', 'physical'):
        try:
            return replace(_fit(name, sensor, recordings, effects), refusals=refusals)
        except UserError as error:
            refusals.append(f'not {name}: {error}')
    if sensor.axes == AXES and not effects:
        with suppress(UserError):
            return _fit_affine(sensor, recordings)
    if population is not None:
        return replace(_fit_open(sensor, recordings, population), refusals=refusals)
    return replace(_fit('linear', sensor, recordings, effects), refusals=refusals)


def _fit_affine(sensor: Sensor, recordings: Sequence[RecordedPoses]) -> _StageFit:
    """Fit the twelve coefficients of a three-axis unit to poses that determine no more."""
    poses = join_poses([recording.poses for recording in recordings])
    poses = poses.subset(~poses.check)
    full = term_selection.fit_affine(sensor, poses)
    std = np.sqrt(np.diag(np.linalg.inv(full.information)))
    still_open = [name for name, value in zip(full.names, std)
                  if not full_model.belongs_to_stage(name) and value > parameter_of(name).scale]
    lines = [f'{len(poses)} poses determine zero-g, scale factor and misalignment, no further '
             'terms; more poses show those']
    if still_open:
        lines.append(f'open, by its prior alone: {", ".join(map(str, still_open))}; add poses '
                     'with this axis up and down')

    def refit(sensor: Sensor, poses: Poses) -> Sensor:
        return term_selection.fit_affine(sensor, poses).fitted

    return _StageFit(full.fitted, refit, [*lines, *term_selection.report_lines(full, poses, [])],
                     warnings=[*lines, *term_selection.warnings(full, poses)], full=full)


def _fit_open(sensor: Sensor, recordings: Sequence[RecordedPoses], population: Population
              ) -> _StageFit:
    """Fit the linear model to poses that may leave to the population what it has."""
    poses = join_poses([recording.poses for recording in recordings])
    axes = {name.axis for name in population.prior(sensor).names if name.effect == 'scale_factor'}
    fit_line = partial(linear.fit, may_be_open=set(sensor.axes) <= axes)
    fitted = fit_line(sensor, poses.subset(~poses.check))
    combined = posterior(fitted, population)
    if not combined.is_stranger:
        return _StageFit(fitted, fit_line)
    try:
        return _fit('linear', sensor, recordings, ())
    except UserError as error:
        raise UserError(f'{error}; {combined.line}') from None


def _fit(model: str, sensor: Sensor, recordings: Sequence[RecordedPoses], effects: Sequence[str]
         ) -> _StageFit:
    """Fit one model to all poses except the check poses."""
    poses = join_poses([recording.poses for recording in recordings])
    poses = poses.subset(~poses.check)
    if model != 'full':
        return _StageFit(STAGE_FITS[model](sensor, poses), STAGE_FITS[model])

    def fit_full(sensor: Sensor, poses: Poses) -> Sensor:
        return term_selection.fit_selected(sensor, poses, effects).full.fitted

    full, terms = term_selection.fit_selected(sensor, poses, effects)
    if len(recordings) > 1:
        require_one_mounting(full, [recording.poses for recording in recordings],
                             [recording.source for recording in recordings])
    return _StageFit(full.fitted, fit_full, term_selection.report_lines(full, poses, terms),
                     warnings=term_selection.warnings(full, poses), full=full)


def _rms_residual_mg(fitted: Sensor, poses: Poses) -> float:
    predicted = np.column_stack(signal_chain.static_response(fitted)(
        reference_force(poses, fitted.local_gravity_mps2), poses.environment))
    residual = (poses.volts - predicted) / fitted.scale_v_per_g * 1e3
    return float(np.sqrt(np.mean(residual ** 2)))


def _against_gravity(sensor: Sensor, poses: Poses, source: str, span_s: float, data_sha256: str,
                     population: Population | None) -> CalibrationResult:
    fit = gravity.fit_gravity(poses.volts, poses.std_v, sensor)
    kept = np.setdiff1d(np.arange(len(poses)), fit.outliers)
    before, after, held_out = (_rms_mg(values[kept]) for values in (
        fit.before_mps2, fit.residual_mps2, fit.held_out_mps2))
    fitted = replace(
        sensor, model='gravity', effects=('bias', 'scale_factor', 'misalignment'),
        values=fit.values, covariance=fit.covariance, covariance_names=gravity.NAMES)
    prior_lines: list[str] = []
    if population is not None:
        combined = posterior(fitted, population)
        fitted, prior_lines = combined.sensor, [f'prior: {combined.line}']
    force = np.column_stack(signal_chain.inverse(fitted)(list(poses.volts.T), poses.environment))
    budgets = error_budget.gravity_error_budgets(fit, fitted, force, kept)
    assessment = acceptance.assess('gravity', budgets, fitted)
    fitted = replace(fitted, envelope=envelope(fitted, force[kept], poses,
                                               float(np.sqrt(budgets.accel.model))))
    fitted = with_provenance(fitted, source, poses, data_sha256, {
        'reference': 'gravity', **_prior_entry(population), 'residual_mg': f'{after:.4f}',
        'held_out_mg': f'{held_out:.4f}', 'span_s': f'{span_s:.1f}',
        'converged': _yes_or_no(fit.converged),
        **acceptance.provenance_entries(assessment, ())})
    lines = [f'magnitude of gravity over {len(kept)} rests, rms in mg: nominal {before:.2f}, '
             f'nine parameters {after:.3f}, held out {held_out:.3f}',
             *_gravity_fit_lines(fit, poses),
             acceptance.gravity_line(assessment, fit.held_out_mps2[kept]),
             *acceptance.explanation(assessment, fitted), *acceptance.unit_line(fitted),
             *prior_lines]
    return CalibrationResult(
        nominal=sensor, fitted=fitted, poses=poses, assessments=(assessment,), gravity_fit=fit,
        warnings=(*_gravity_fit_lines(fit, poses), *prior_lines),
        report_lines=lines, summary_lines=[*acceptance.headline(assessment, ()), *lines])


def _gravity_fit_lines(fit: gravity.GravityFit, poses: Poses) -> list[str]:
    lines = [] if fit.converged else [term_selection.NOT_CONVERGED]
    if fit.outliers:
        rests = ', '.join(f'{i + 1} (from {poses.time_s[i, 0]:.1f} s)' for i in fit.outliers)
        lines.append(f'outliers, left out: rest {rests}')
    return lines


def coefficient_lines(sensor: Sensor) -> list[str]:
    """Return the fitted coefficients with their 90 % intervals as text."""
    std = dict(zip(sensor.covariance_names, np.sqrt(np.diag(sensor.covariance))))
    lines = [f'{sensor.serial}: {sensor.model} model, coefficient +- half of its 90 % interval']
    for effect in sensor.values:
        for parameter in effect_named(effect).parameters:
            if parameter.name not in sensor.values[effect]:
                continue
            label, values = _labelled(sensor, effect, parameter.name)
            axes = list(sensor.axes) if np.ndim(values) else ['']
            names = [Coefficient(effect, parameter.name, axis) for axis in axes]
            entries = [f'{name.axis} {value:.6g} +- {Z_90 * std[name]:.2g}'.lstrip()
                       for name, value in zip(names, np.ravel(values)) if name in std]
            if entries:
                lines.append(f'  {label:34} {"   ".join(entries)} {parameter.unit}')
    return lines


def _labelled(sensor: Sensor, effect: str, parameter: str) -> tuple[str, np.ndarray]:
    """Return label and values of a parameter; zero-g and scale factor are absolute."""
    if (effect, parameter) == ('bias', 'offset_v'):
        return 'zero-g', sensor.zero_g_v
    if (effect, parameter) == ('scale_factor', 'offset_v_per_g'):
        return 'scale factor', sensor.scale_v_per_g
    return f'{effect}.{parameter}', sensor.values[effect][parameter]


def _prior_entry(population: Population | None) -> dict[str, str]:
    """Return the entry of the provenance that names a prior; none without one."""
    return {} if population is None else {'prior': population.name}


def _yes_or_no(condition: bool) -> str:
    return 'yes' if condition else 'no'


def _rms_mg(values_mps2: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values_mps2 ** 2)) / G0_MPS2 * 1e3)
