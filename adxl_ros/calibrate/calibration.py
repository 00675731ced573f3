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

"""The outcome of a calibration: the sensor, the verdict and the words for people."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import os

from adxl_ros.calibrate.fits import (
    full_fit_text,
    gravity_fit as gravity,
    linear,
    paper_regression,
    term_selection,
)
from adxl_ros.calibrate.fits.full_model import FullFit
from adxl_ros.calibrate.poses import check_polarity, join_poses, Poses, reference_force
from adxl_ros.calibrate.provenance import envelope, with_provenance
from adxl_ros.calibrate.recording_consistency import require_one_mounting
from adxl_ros.calibrate.report import (
    acceptance,
    cross_validation,
    error_budget,
)
from adxl_ros.calibrate.report.acceptance import Assessment
from adxl_ros.calibrate.report.cross_validation import HeldOutErrors
from adxl_ros.errors import UserError
from adxl_ros.files import calibration_store, parameter_file
from adxl_ros.files.atomic_write import keep_previous
from adxl_ros.files.stream_info import NO_UNIT
from adxl_ros.model import signal_chain
from adxl_ros.model.coefficients import get
from adxl_ros.model.constants import G0_MPS2, Z_90
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.filter_time_constant import FilterNoise, with_filter
import numpy as np

STAGE_FITS = {'linear': linear.fit, 'physical': paper_regression.fit, 'full': term_selection.fit}
"""Models that are fitted against the stage, simplest first."""


@dataclass(frozen=True)
class CalibrationResult:
    """
    A fitted sensor and what is known of it.

    Attributes
    ----------
    nominal, fitted
        The unit as it was stated and as it is.
    report_lines
        How good it is, line by line.
    summary_lines
        The same for a terminal of 80 columns, what matters most first.
    poses
        What it was made of and judged by.
    assessments
        Acceptance of each model, the one that was taken last.
    held_out
        Errors of the models on held-out poses, the nominal sensor first.
    gravity_fit
        Of a calibration against gravity.
    outliers
        Numbers of the poses that were left out as disturbed.

    """

    nominal: Sensor
    fitted: Sensor
    report_lines: list[str]
    summary_lines: list[str]
    poses: Poses
    assessments: tuple[Assessment, ...] = ()
    held_out: tuple[HeldOutErrors, ...] = ()
    gravity_fit: gravity.GravityFit | None = None
    outliers: tuple[int, ...] = ()

    def comments(self) -> list[str]:
        """Lay out coefficients and verdict for people: the head of the parameter file."""
        return [*coefficients(self.fitted), '', *self.report_lines]

    def save(self, path: str | os.PathLike) -> None:
        """
        Write the parameter file, whole or not at all; one that it replaces is kept beside it.

        Parameters
        ----------
        path
            The file; an older one of another fit becomes NAME.previous.

        Raises
        ------
        UserError
            It cannot be written; the older one is as it was.

        """
        # A finish that was cut short and comes again must not push out the one before.
        if not self._is_in(path):
            keep_previous(path)
        parameter_file.save(path, self.fitted, self.comments())

    def keep(self, folder: str | os.PathLike) -> str:
        """
        Keep a copy in the store, and say in a line where it is, or why there is none.

        A store that cannot be written is no reason to lose a calibration that is saved.

        Parameters
        ----------
        folder
            The store; empty for none.

        """
        if not str(folder):
            return 'not kept in a store'
        stored = calibration_store.history(folder, self.fitted.serial).calibrations
        try:
            path = next(filter(self._is_in, (path for path, _ in stored)), None) or \
                calibration_store.put(folder, self.fitted, self.comments())
        except UserError as error:
            return f'no copy in the store: {error}'
        return f'kept as {path}' if path else \
            f'not kept in {folder}: the serial number {NO_UNIT} is no unit ' \
            'in particular'

    def _is_in(self, path: str | os.PathLike) -> bool:
        """Tell whether a file holds this very fit: the same data, model and coefficients."""
        try:
            there = parameter_file.load(path)
        except UserError:
            return False
        names, own = self.fitted.covariance_names, self.fitted
        return (there.model, there.effects, there.covariance_names) == (
            own.model, own.effects, names) and \
            there.provenance.get('data_sha256') == own.provenance['data_sha256'] and \
            bool(np.allclose(get(there, names), get(own, names), rtol=1e-6))

    @property
    def name(self) -> str:
        """Name the unit and where its poses come from."""
        return f'{self.fitted.serial} ({self.fitted.provenance["source"]})'

    @property
    def inliers(self) -> np.ndarray:
        """Tell the poses that were not knocked, which `held_out` counts, (k,)."""
        return ~np.isin(np.arange(len(self.poses)), self.outliers)

    @property
    def paper_sensor(self) -> Sensor:
        """Return the unit by a model that the paper's figures can show."""
        return self.fitted if self.fitted.model in ('physical', 'full') else \
            paper_regression.fit(self.nominal, self.poses.subset(~self.poses.check))


def calibrate(sensor: Sensor, parts: Sequence[Poses], model: str | None,
              sources: Sequence[str], effects: Sequence[str] = (),
              filters: Sequence[Sequence[FilterNoise | None]] = (),
              data_sha256: str = '') -> CalibrationResult:
    """
    Fit the poses of one unit: against the stage where there are angles, else gravity.

    Parameters
    ----------
    sensor
        The nominal sensor of the unit.
    parts
        Its rests by recording, with angles or without.
    model
        'linear', 'physical' or 'full'; None is the richest that the poses determine.
    sources
        Where the poses come from, by recording, for messages and the provenance.
    effects
        What the full model is to hold beside its terms.
    filters
        What the noise says of the filter, by recording and axis, for the full model.
    data_sha256
        Of the recordings' files; empty takes the hash of the poses.

    Raises
    ------
    UserError
        The poses do not determine the model, or the recordings contradict each other.

    """
    poses, source = join_poses(list(parts)), ', '.join(sources)
    if np.isfinite(poses.alpha_rad).all():
        model = model or ('full' if effects else None)
        return _against_stage(sensor, parts, model, sources, effects, filters, data_sha256)
    if model not in (None, 'full'):
        raise UserError(f'{source}: the {model} model is fitted against stage angles (alpha_rad '
                        'and beta_rad), which are not there; leave --model out to calibrate a '
                        'three-axis sensor against gravity')
    if sensor.axes != 'xyz':
        raise UserError(f'{source}: no stage angles and only the axes {sensor.axes}: the '
                        'magnitude of gravity needs x, y and z; record alpha_rad and beta_rad')
    return _against_gravity(sensor, poses, source, data_sha256)


def _against_stage(sensor: Sensor, parts: Sequence[Poses], model: str | None,
                   sources: Sequence[str], effects: Sequence[str],
                   filters: Sequence[Sequence[FilterNoise | None]], data_sha256: str
                   ) -> CalibrationResult:
    poses = join_poses(list(parts))
    check_polarity(sensor, poses)
    fitting = poses.subset(~poses.check)
    refusals: list[str] = []
    for name in ([model] if model else reversed(STAGE_FITS)):
        try:
            found = _fit(name, sensor, fitting, parts, sources, effects)
            break
        except UserError as error:
            if name in (model, 'linear'):
                raise
            refusals.append(f'not {name}: {error}')
    fitted = found.fitted
    simpler = list(STAGE_FITS)[:list(STAGE_FITS).index(fitted.model)]
    # What was knocked says nothing of the models.
    knocked = tuple(np.flatnonzero(~poses.check)[list(found.full.outliers)].tolist()) \
        if found.full else ()
    sound = poses.subset(~np.isin(np.arange(len(poses)), knocked))
    # What the full model found of the stage is no error of the sensor, by any model.
    stage = found.full.unit if found.full else None
    held_out = cross_validation.cross_validate({'nominal': lambda sensor, _: sensor,
                                                **{name: STAGE_FITS[name] for name in simpler},
                                                fitted.model: found.fit}, sensor, sound, stage)
    assessments = tuple(
        acceptance.assess(errors.model, error_budget.error_budgets(errors, sound, stage), sensor)
        for errors in held_out if errors.model != 'nominal')
    predicted = np.column_stack(signal_chain.static_response(fitted)(
        reference_force(fitting, fitted.local_gravity_mps2), fitting.environment))
    residual = (fitting.volts - predicted) / fitted.scale_v_per_g * 1e3
    said = found.said
    if fitted.model == 'full':
        fitted, more = with_filter(fitted, filters)
        said = [*said, *more]
    own = [row for row in assessments if row.model == fitted.model]
    force = np.column_stack(reference_force(poses, fitted.local_gravity_mps2))
    error_mps2 = np.nan_to_num(np.sqrt(own[0].accel.calibration)).item() if own else 0.0
    fitted = replace(fitted, envelope=envelope(fitted, force, poses, error_mps2))
    fitted = with_provenance(fitted, ', '.join(sources), poses, data_sha256, {
        'reference': 'stage', 'residual_mg': f'{np.sqrt(np.mean(residual ** 2)):.4f}',
        **({'converged': _yes(found.full.converged)} if found.full else {}),
        **acceptance.provenance_entries(own[0] if own else None, held_out)})
    words, unit = acceptance.explanation(own[0], fitted) if own else [], \
        acceptance.unit_line(fitted)
    lines = [*refusals, *cross_validation.table(held_out),
             *acceptance.table(assessments, held_out),
             *words, *unit, *said]
    brief = [*acceptance.headline(own[0] if own else None, held_out), *unit,
             *acceptance.narrow_table(assessments, held_out), *words, *said, *refusals]
    return CalibrationResult(sensor, fitted, lines, brief, poses, assessments, tuple(held_out),
                             None, knocked)


def _fit(model: str, sensor: Sensor, fitting: Poses, parts: Sequence[Poses],
         sources: Sequence[str], effects: Sequence[str]) -> _Found:
    """Fit one model; the full one with the terms more that poses held out ask for."""
    if model != 'full':
        return _Found(STAGE_FITS[model](sensor, fitting), STAGE_FITS[model], [])
    found, terms = term_selection.fit_selected(sensor, fitting, effects)
    if len(parts) > 1:
        require_one_mounting(found, parts, sources)
    lines = full_fit_text.report_lines(found, fitting, terms)
    return _Found(found.fitted, lambda sensor, poses: term_selection.fit_selected(
        sensor, poses, effects).full.fitted, lines, found)


@dataclass(frozen=True)
class _Found:
    fitted: Sensor
    fit: cross_validation.Fit
    said: list[str]
    full: FullFit | None = None


def _against_gravity(sensor: Sensor, poses: Poses, source: str, data_sha256: str
                     ) -> CalibrationResult:
    found = gravity.fit_gravity(poses.volts, poses.std_v, sensor)
    kept = np.setdiff1d(np.arange(len(poses)), found.outliers)
    before, after, out = (_rms_mg(values[kept]) for values in (
        found.before_mps2, found.residual_mps2, found.leave_one_out_mps2))
    lines = [f'magnitude of gravity over {len(kept)} rests, rms in mg: nominal {before:.2f}, '
             f'nine parameters {after:.3f}, leave-one-out {out:.3f}']
    if not found.converged:
        lines.append(full_fit_text.NOT_CONVERGED)
    if found.outliers:
        named = ', '.join(f'{i + 1} (from {poses.time_s[i, 0]:.1f} s)' for i in found.outliers)
        lines.append(f'left out, disturbed: rest {named}')
    fitted = replace(
        sensor, model='gravity', effects=('bias', 'scale_factor', 'misalignment'),
        values=found.values, covariance=found.covariance, covariance_names=gravity.NAMES)
    force = np.column_stack(signal_chain.inverse(fitted)(list(poses.volts.T), poses.environment))
    budgets = error_budget.gravity_error_budgets(found, fitted, force, kept)
    own = acceptance.assess('gravity', budgets, fitted)
    fitted = replace(fitted, envelope=envelope(fitted, force[kept], poses,
                                               float(np.sqrt(budgets.accel.model))))
    fitted = with_provenance(fitted, source, poses, data_sha256, {
        'reference': 'gravity', 'residual_mg': f'{after:.4f}', 'leave_one_out_mg': f'{out:.4f}',
        'converged': _yes(found.converged),
        **acceptance.provenance_entries(own, ())})
    lines += [acceptance.gravity_line(own, found.leave_one_out_mps2[kept]),
              *acceptance.explanation(own, fitted), *acceptance.unit_line(fitted)]
    return CalibrationResult(sensor, fitted, lines, [*acceptance.headline(own, ()), *lines], poses,
                             (own,), (), found)


def coefficients(sensor: Sensor) -> list[str]:
    """Lay out the fitted coefficients with their 90 % intervals."""
    std = dict(zip(sensor.covariance_names, np.sqrt(np.diag(sensor.covariance))))
    lines = [f'{sensor.serial}: {sensor.model} model, coefficient +- half of its 90 % interval']
    absolute = {('bias', 'offset_v'): ('zero-g', sensor.zero_g_v),
                ('scale_factor', 'offset_v_per_g'): ('scale factor', sensor.scale_v_per_g)}
    for effect, of_effect in sensor.values.items():
        units = {p.name: p.unit for p in effect_named(effect).parameters}
        for parameter, values in of_effect.items():
            label, shown = absolute.get((effect, parameter), (f'{effect}.{parameter}', values))
            ends = list(sensor.axes) if np.ndim(values) else ['']
            entries = [f'{axis} {value:.6g} +- {Z_90 * std[key]:.2g}'.lstrip()
                       for axis, value in zip(ends, np.ravel(shown))
                       if (key := Coefficient(effect, parameter, axis)) in std]
            if entries:
                lines.append(f'  {label:34} {"   ".join(entries)} {units[parameter]}')
    return lines


def _yes(whether: bool) -> str:
    return 'yes' if whether else 'no'


def _rms_mg(values_mps2: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values_mps2 ** 2)) / G0_MPS2 * 1e3)
