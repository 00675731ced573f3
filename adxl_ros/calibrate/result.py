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
from pathlib import Path

from adxl_ros.calibrate import figures, gravity, linear, physical, verdict
from adxl_ros.calibrate.poses import check_polarity, Poses, reference_force
from adxl_ros.errors import UserError
from adxl_ros.files import params
from adxl_ros.model import chain
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.effects import effect_named
from adxl_ros.model.sensor import Sensor
import numpy as np

STAGE_FITS = {'linear': linear.fit, 'physical': physical.fit}
"""Models that are fitted against the stage, simplest first."""
_NINETY = 1.6449


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
        """Write the parameter file, whole or not at all."""
        params.save(path, self.fitted, self.comments())

    def draw(self, path: str | os.PathLike) -> None:
        """Write the figures of this unit as PNG."""
        if self.gravity_fit is not None:
            fit = self.gravity_fit
            name = f'{self.fitted.serial} ({self.fitted.provenance["source"]})'
            figures.draw_gravity(path, name, fit.before_mps2, fit.residual_mps2,
                                 fit.expected_mps2)
        else:
            fitted = self.fitted if self.fitted.model == 'physical' else \
                physical.fit(self.nominal, self.poses.subset(~self.poses.check))
            figures.draw_sweep(path, self.nominal, fitted, self.poses)


def calibrate(sensor: Sensor, poses: Poses, model: str | None, source: str) -> Result:
    """
    Fit the poses of one unit: against the stage where there are angles, else gravity.

    Parameters
    ----------
    sensor
        The nominal sensor of the unit.
    poses
        Its rests, with angles or without.
    model
        'linear' or 'physical'; None is physical, or linear for a sensor of one axis.
    source
        Where the poses come from, for the provenance.

    Raises
    ------
    UserError
        The poses do not determine the model.

    """
    if np.isfinite(poses.alpha_rad).all():
        return _against_stage(sensor, poses, model, source)
    if model is not None:
        raise UserError(f'{source}: the {model} model is fitted against stage angles (alpha_rad '
                        'and beta_rad), which are not there; leave --model out to calibrate a '
                        'three-axis sensor against gravity')
    if sensor.axes != 'xyz':
        raise UserError(f'{source}: no stage angles and only the axes {sensor.axes}: the '
                        'magnitude of gravity needs x, y and z; record alpha_rad and beta_rad')
    return _against_gravity(sensor, poses, source)


def _against_stage(sensor: Sensor, poses: Poses, model: str | None, source: str) -> Result:
    check_polarity(sensor, poses)
    fitting = poses.subset(~poses.check)
    if model is None:
        model = 'physical' if sensor.axes != 'x' else 'linear'
    fitted = STAGE_FITS[model](sensor, fitting)
    fits: dict[str, verdict.Fit] = {'nominal': lambda sensor, _: sensor, **STAGE_FITS}
    tried = list(fits)[:list(fits).index(model) + 1]
    scores = verdict.held_out({name: fits[name] for name in tried}, sensor, poses)
    predicted = np.column_stack(chain.static_response(fitted)(
        reference_force(fitting, fitted.local_gravity_mps2)))
    residual = (fitting.volts - predicted) / fitted.scale_v_per_g * 1e3
    fitted = replace(fitted, provenance=_provenance(source, poses, {
        'reference': 'stage', 'residual_mg': f'{np.sqrt(np.mean(residual ** 2)):.4f}'}))
    return Result(sensor, fitted, verdict.table(scores), poses)


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
            entries = [f'{axis} {value:.6g} +- {_NINETY * std[key]:.2g}'.lstrip()
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


def name_of(paths: Sequence[str | os.PathLike]) -> str:
    """Join the names of recordings for the provenance, without their folders."""
    return ', '.join(Path(path).name for path in paths)


def _rms_mg(values_mps2: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values_mps2 ** 2)) / G0_MPS2 * 1e3)
