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
from datetime import datetime, timezone
from importlib.metadata import PackageNotFoundError, version
import os

from adxl_ros.calibrate import figures, full_terms, full_words, gravity, linear, physical, verdict
from adxl_ros.calibrate.agree import require_one_mounting
from adxl_ros.calibrate.filter_noise import FilterNoise, with_filter
from adxl_ros.calibrate.poses import check_polarity, Poses, reference_force, together
from adxl_ros.errors import UserError
from adxl_ros.files import params
from adxl_ros.files.atomic import keep_previous
from adxl_ros.model import chain
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.effects import effect_named
from adxl_ros.model.sensor import Sensor
import numpy as np

STAGE_FITS = {'linear': linear.fit, 'physical': physical.fit, 'full': full_terms.fit}
"""Models that are fitted against the stage, simplest first."""


@dataclass(frozen=True)
class Result:
    """A fitted sensor, its verdict line by line, and the poses behind it."""

    nominal: Sensor
    fitted: Sensor
    verdict: list[str]
    poses: Poses
    gravity_fit: gravity.GravityFit | None = None

    def comments(self) -> list[str]:
        """Lay out coefficients and verdict for people: the head of the parameter file."""
        return [*coefficients(self.fitted), '', *self.verdict]

    def save(self, path: str | os.PathLike) -> None:
        """Write the parameter file, whole or not at all; one that was there is kept beside it."""
        keep_previous(path)
        params.save(path, self.fitted, self.comments())

    def draw(self, path: str | os.PathLike) -> None:
        """Write the figures of this unit as PNG."""
        if self.gravity_fit is not None:
            fit = self.gravity_fit
            name = f'{self.fitted.serial} ({self.fitted.provenance["source"]})'
            figures.draw_gravity(path, name, fit.before_mps2, fit.residual_mps2,
                                 fit.expected_mps2)
        else:
            fitted = self.fitted if self.fitted.model in ('physical', 'full') else \
                physical.fit(self.nominal, self.poses.subset(~self.poses.check))
            figures.draw_sweep(path, self.nominal, fitted, self.poses)


def calibrate(sensor: Sensor, parts: Sequence[Poses], model: str | None,
              sources: Sequence[str], effects: Sequence[str] = (),
              filters: Sequence[Sequence[FilterNoise | None]] = ()) -> Result:
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

    Raises
    ------
    UserError
        The poses do not determine the model, or the recordings contradict each other.

    """
    poses, source = together(list(parts)), ', '.join(sources)
    if np.isfinite(poses.alpha_rad).all():
        model = model or ('full' if effects else None)
        return _against_stage(sensor, parts, model, sources, effects, filters)
    if model not in (None, 'full'):
        raise UserError(f'{source}: the {model} model is fitted against stage angles (alpha_rad '
                        'and beta_rad), which are not there; leave --model out to calibrate a '
                        'three-axis sensor against gravity')
    if sensor.axes != 'xyz':
        raise UserError(f'{source}: no stage angles and only the axes {sensor.axes}: the '
                        'magnitude of gravity needs x, y and z; record alpha_rad and beta_rad')
    return _against_gravity(sensor, poses, source)


def _against_stage(sensor: Sensor, parts: Sequence[Poses], model: str | None,
                   sources: Sequence[str], effects: Sequence[str],
                   filters: Sequence[Sequence[FilterNoise | None]]) -> Result:
    poses = together(list(parts))
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
    scores = verdict.held_out({'nominal': lambda sensor, _: sensor,
                               **{name: STAGE_FITS[name] for name in simpler},
                               fitted.model: found.fit}, sensor, poses)
    predicted = np.column_stack(chain.static_response(fitted)(
        reference_force(fitting, fitted.local_gravity_mps2), fitting.environment))
    residual = (fitting.volts - predicted) / fitted.scale_v_per_g * 1e3
    said = found.said
    if fitted.model == 'full':
        fitted, more = with_filter(fitted, filters)
        said = [*said, *more]
    fitted = replace(fitted, provenance=_provenance(', '.join(sources), poses, {
        'reference': 'stage', 'residual_mg': f'{np.sqrt(np.mean(residual ** 2)):.4f}'}))
    return Result(sensor, fitted, [*refusals, *verdict.table(scores), *said], poses)


def _fit(model: str, sensor: Sensor, fitting: Poses, parts: Sequence[Poses],
         sources: Sequence[str], effects: Sequence[str]) -> _Found:
    """Fit one model; the full one with the terms more that poses held out ask for."""
    if model != 'full':
        return _Found(STAGE_FITS[model](sensor, fitting), STAGE_FITS[model], [])
    found, judged = full_terms.fit_judged(sensor, fitting, effects)
    if len(parts) > 1:
        require_one_mounting(found, parts, sources)
    return _Found(found.fitted, lambda sensor, poses: full_terms.fit_judged(
        sensor, poses, effects)[0].fitted, full_words.words(found, fitting, judged))


@dataclass(frozen=True)
class _Found:
    fitted: Sensor
    fit: verdict.Fit
    said: list[str]


def _against_gravity(sensor: Sensor, poses: Poses, source: str) -> Result:
    found = gravity.fit_gravity(poses.volts, poses.std_v, sensor)
    kept = np.setdiff1d(np.arange(len(poses)), found.outliers)
    before, after, out = (_rms_mg(values[kept]) for values in (
        found.before_mps2, found.residual_mps2, found.leave_one_out_mps2))
    lines = [f'magnitude of gravity over {len(kept)} rests, rms in mg: nominal {before:.2f}, '
             f'nine parameters {after:.3f}, leave-one-out {out:.3f}']
    if found.outliers:
        named = ', '.join(f'{i + 1} (from {poses.time_s[i, 0]:.1f} s)' for i in found.outliers)
        lines.append(f'left out, disturbed: rest {named}')
    fitted = replace(
        sensor, model='gravity', effects=('bias', 'scale_factor', 'misalignment'),
        values=found.values, covariance=found.covariance, covariance_names=gravity.NAMES,
        provenance=_provenance(source, poses, {'reference': 'gravity',
                                               'residual_mg': f'{after:.4f}',
                                               'leave_one_out_mg': f'{out:.4f}'}))
    return Result(sensor, fitted, lines, poses, found)


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
            entries = [f'{axis} {value:.6g} +- {verdict.NINETY * std[key]:.2g}'.lstrip()
                       for axis, value in zip(ends, np.ravel(shown))
                       if (key := f'{effect}.{parameter}.{axis}'.rstrip('.')) in std]
            if entries:
                lines.append(f'  {label:34} {"   ".join(entries)} {units[parameter]}')
    return lines


def package_version() -> str:
    """Return the version of this package; 'unknown' when it runs from its source."""
    try:
        return version('adxl_ros')
    except PackageNotFoundError:
        return 'unknown'


def _provenance(source: str, poses: Poses, more: dict[str, str]) -> dict[str, str]:
    return {'date': datetime.now(timezone.utc).isoformat(timespec='seconds'),
            'package_version': package_version(), 'source': source,
            'poses': str(int((~poses.check).sum())),
            'check_poses': str(int(poses.check.sum())), **more}


def _rms_mg(values_mps2: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values_mps2 ** 2)) / G0_MPS2 * 1e3)
