# SPDX-License-Identifier: Apache-2.0

"""
The result of a calibration: the fitted unit with its provenance, validity range and report.

- Its coefficients as lines of text, and its files.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from datetime import datetime, timezone
import hashlib
import os

from adxl_ros.calibrate.fits.gravity_fit import GravityFit
from adxl_ros.calibrate.poses import planes, Poses
from adxl_ros.calibrate.report.acceptance import Assessment
from adxl_ros.calibrate.report.coefficients import compare
from adxl_ros.calibrate.report.held_out import HeldOutErrors
from adxl_ros.errors import UserError
from adxl_ros.files import calibration_store, parameter_file
from adxl_ros.files.atomic_write import keep_previous
from adxl_ros.files.recording_columns import NO_UNIT
from adxl_ros.model.coefficients import get
from adxl_ros.model.covariance import leverage
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.sensor import Envelope, Sensor, STRETCH
from adxl_ros.process import package_version
import numpy as np

_SAME_BETA_RAD = 1e-3
"""Smaller changes of beta are no step of the sweep, rad. Chosen: below any step of a plan."""
_SAME_FIT_TOLERANCE = 1e-6
"""Largest relative difference of coefficients of the same fit: the rounding in a file."""


@dataclass(frozen=True)
class CalibrationResult:
    """A calibrated unit with its assessment."""

    # nominal, fitted: The unit before and after the fit
    nominal: Sensor
    fitted: Sensor
    summary: Sequence[str]  # Verdict, errors and limits as text
    poses: Poses  # k poses, check poses among them
    # Acceptance of each model; the last one is that of `fitted`
    assessments: tuple[Assessment, ...] = ()
    # Errors of the models on held-out poses, the nominal sensor first
    held_out: tuple[HeldOutErrors, ...] = ()
    gravity_fit: GravityFit | None = None  # The fit of a calibration against gravity
    outliers: tuple[int, ...] = ()  # Indices of the outliers, which the fit leaves out
    # What is wrong with the poses or the fit, and why no richer model was fitted
    warnings: Sequence[str] = ()
    details: Sequence[str] = ()  # What else the fit shows, as text

    @property
    def report_lines(self) -> list[str]:
        """Return all lines, the most important first."""
        return [*self.summary, *self.warnings, *self.details]

    def comments(self) -> list[str]:
        """Return coefficients and assessment as text: the head of the parameter file."""
        return [*coefficient_lines(self.fitted), '', *self.report_lines]

    def save(self, path: str | os.PathLike) -> None:
        """Write the parameter file atomically; a file of another fit becomes NAME.previous."""
        # A session that saves the same fit twice must not replace the previous calibration.
        if not self._is_in(path):
            keep_previous(path)
        parameter_file.save(path, self.fitted, self.comments())

    def keep(self, folder: str | os.PathLike) -> str:
        """
        Copy the calibration to the store, unless it is '' or cannot be written.

        returns: one line with the path, or with the reason why there is no copy.
        """
        if not str(folder):
            return 'not kept in a store'
        stored = calibration_store.history(folder, self.fitted.serial).calibrations
        try:
            path = next((path for path, _ in stored if self._is_in(path)), None) or \
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


def coefficient_lines(sensor: Sensor) -> list[str]:
    """Return the fitted coefficients with their 90 % intervals as text."""
    by_name: dict[str, list[str]] = {}
    for row in compare(sensor, sensor):
        # After a comma stands the other axis, which differs from axis to axis.
        by_name.setdefault(row.name if ', ' in row.label else row.label, []).append(
            f'{row.axis} {row.fitted:.6g} +- {row.half_width:.2g} {row.unit}'.strip())
    return [f'{sensor.serial}: {sensor.model} model, coefficient +- half of its 90 % interval',
            *(f'  {name:34} {"   ".join(by_axis)}' for name, by_axis in by_name.items())]


def with_provenance(fitted: Sensor, source: str, poses: Poses, data_sha256: str,
                    results: Mapping[str, str]) -> Sensor:
    """Add date, sources, sweep, data hash, results and id to a fitted unit."""
    entries = {
        **{key: text for key, text in fitted.provenance.items() if key.endswith('_from')},
        # A text of YAML, where +00:00 makes a date, which ros2 param cannot set.
        'date': f'{datetime.now(timezone.utc):%Y-%m-%dT%H:%M:%S}+0000',
        'package_version': package_version(), 'source': source,
        'data_sha256': data_sha256 or _sha256(poses),
        'poses': str(int((~poses.check).sum())), 'check_poses': str(int(poses.check.sum())),
        'sweep': _sweep_text(poses), 'temperature_c': _mean_text(poses.temperature_c, '.2f'),
        'supply_v': _mean_text(poses.supply_v, '.4f'), **results}
    calibration_id = calibration_store.calibration_id(replace(fitted, provenance=entries))
    return replace(fitted, provenance={'id': calibration_id, **entries})


def _sha256(poses: Poses) -> str:
    """Return the SHA-256 of all fields of poses, hexadecimal."""
    digest = hashlib.sha256()
    for field in fields(poses):
        values = np.ascontiguousarray(getattr(poses, field.name), dtype='<f8')
        digest.update(f'{field.name} {values.shape}'.encode())
        digest.update(values.tobytes())
    return digest.hexdigest()


def _sweep_text(poses: Poses) -> str:
    """Describe the fitted poses: planes, range and steps of beta, directions."""
    fitted = poses.subset(~poses.check)
    if not np.isfinite(fitted.alpha_rad).all():
        return f'{len(fitted)} rests in directions of its own, against gravity'
    first, last, lowest, highest = np.degrees([
        fitted.alpha_rad.min(), fitted.alpha_rad.max(), fitted.beta_rad.min(),
        fitted.beta_rad.max()])
    changes = np.diff(fitted.beta_rad)
    steps = np.abs(changes)[np.abs(changes) > _SAME_BETA_RAD]
    step = np.degrees(np.median(steps)) if steps.size else 0.0
    both_ways = (changes > _SAME_BETA_RAD).any() and (changes < -_SAME_BETA_RAD).any()
    # Without a colon: ros2 param reads the text as YAML again.
    return (f'{len(fitted)} poses, {len(planes(fitted.alpha_rad))} planes alpha from '
            f'{first:.0f} to {last:.0f} deg; beta {lowest:.0f} to {highest:.0f} '
            f'deg, steps of {step:.0f}, {"both directions" if both_ways else "one direction"}')


def _mean_text(values: np.ndarray, digits: str) -> str:
    finite = values[np.isfinite(values)]
    return f'{finite.mean():{digits}}' if finite.size else 'not measured'


def envelope(fitted: Sensor, force: np.ndarray, poses: Poses, misfit_mps2: float) -> Envelope:
    """
    Return the validity range of a calibration.

    force: specific force of k poses, check poses among them, m/s², (k, 3).
    """
    finite_c = poses.temperature_c[np.isfinite(poses.temperature_c)]
    rest_leverage = leverage(fitted)
    largest = max(float(rest_leverage(list(stretch * force.T)).max())
                  for stretch in (1.0, STRETCH))
    return Envelope((float(finite_c.min()), float(finite_c.max())) if finite_c.size else None,
                    zero_g_per_k=_unmodelled_slope(fitted, 'temperature_bias'),
                    scale_per_k=_unmodelled_slope(fitted, 'temperature_scale'),
                    leverage=largest, misfit_mps2=misfit_mps2,
                    force_low_mps2=tuple(force.min(axis=0).tolist()),
                    force_high_mps2=tuple(force.max(axis=0).tolist()))


def _unmodelled_slope(fitted: Sensor, effect: str) -> float:
    """Return the typical slope of an effect by the datasheet, else by the library; 0 if fitted."""
    if effect in fitted.effects:
        return 0.0
    typical, _ = fitted.datasheet.get(Coefficient(effect, 'per_k'), (0.0, 0.0))
    return typical or effect_named(effect).parameters[0].scale
