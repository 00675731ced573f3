# SPDX-License-Identifier: Apache-2.0

"""The result of a calibration, compared with the truth and with earlier calibrations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from datetime import datetime, timezone
import hashlib
from itertools import product

from adxl_ros.calibrate.fits.extrapolation import next_degree, NextDegree
from adxl_ros.calibrate.fits.gravity_fit import GravityFit
from adxl_ros.calibrate.pose_model import residual_g
from adxl_ros.calibrate.poses import planes, Poses
from adxl_ros.calibrate.report.acceptance import Assessment
from adxl_ros.calibrate.report.held_out import HeldOutErrors
from adxl_ros.errors import UserError
from adxl_ros.files import calibration_store, parameter_file
from adxl_ros.files.atomic_write import AnyPath, keep_previous
from adxl_ros.files.stream_info import NO_SERIAL
from adxl_ros.model.constants import AXES, G0_MPS2, Z_90
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.accelerometer import OTHER_AXIS
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.gyroscope import Gyroscope, NO_TURN
from adxl_ros.model.sensor import Envelope, get, parameter_of, Sensor, with_neutral
from adxl_ros.process import package_version
from adxl_ros.report.quantities import decimals, fixed, mg_text, with_half_width
import numpy as np

_SAME_FIT_TOLERANCE = 1e-6
"""Largest relative difference of coefficients of the same fit: the rounding in a file."""


@dataclass(frozen=True)
class CalibrationResult:
    """A calibrated sensor with its assessment."""

    nominal: Sensor  # The sensor before the fit
    fitted: Sensor  # The sensor after the fit
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
        return [
            *coefficient_lines(self.fitted),
            *gyro_lines(self.fitted.gyro),
            '',
            *self.report_lines,
        ]

    def save(self, path: AnyPath) -> None:
        """Write the parameter file atomically; a file of another fit becomes NAME.previous."""
        # A session that saves the same fit twice must not replace the previous calibration.
        if not self._is_in(path):
            keep_previous(path)
        parameter_file.save(path, self.fitted, self.comments())

    def keep(self, folder: AnyPath) -> str:
        """Copy the calibration to the store, if one is named; return one line on it."""
        if not str(folder):
            return 'not kept in a store'
        stored = calibration_store.history(folder, self.fitted.serial).calibrations
        try:
            path = next(
                (path for path, _ in stored if self._is_in(path)), None
            ) or calibration_store.put(folder, self.fitted, self.comments())
        except UserError as error:
            return f'no copy in the store: {error}'
        return (
            f'kept as {path}'
            if path
            else f'not kept in {folder}: the serial number {NO_SERIAL} names no unit; set '
            'sensor.serial'
        )

    def _is_in(self, path: AnyPath) -> bool:
        """Return whether a file holds this fit: the same data, model and coefficients."""
        try:
            saved = parameter_file.load(path)
        except UserError:
            return False
        fitted = self.fitted
        names = self.fitted.covariance_names
        return (
            (saved.model, saved.effects, saved.covariance_names)
            == (fitted.model, fitted.effects, names)
            and saved.provenance.get('data_sha256') == fitted.provenance['data_sha256']
            and bool(np.allclose(get(saved, names), get(fitted, names), rtol=_SAME_FIT_TOLERANCE))
        )

    @property
    def inliers(self) -> np.ndarray:
        """Mark the poses that are no outliers, (k,) bool; only these are in `held_out`."""
        return ~np.isin(np.arange(len(self.poses)), self.outliers)


def coefficient_lines(sensor: Sensor) -> list[str]:
    """Return the fitted coefficients with their 90 % intervals as text."""
    return [
        f'{sensor.serial}: {sensor.model} model, coefficient +- half of its 90 % interval',
        *(
            f'  {row.label:{_LONGEST_LABEL}} {row.axis:1} {rounded(row, row.fitted):>10} +- '
            f'{rounded(row, row.half_width)} {row.unit}'
            for row in compare(sensor, sensor)
        ),
    ]


def gyro_lines(gyro: Gyroscope) -> list[str]:
    """Return the bias of a gyroscope with its 90 % interval as text; none without one."""
    if not gyro.is_calibrated:
        return []
    rows = [('gyroscope, bias at rest', gyro.bias_radps, gyro.bias_std_radps, '°/s')]
    if gyro.follows_temperature:
        rows.append(
            (
                f'  its change, {gyro.temperature_c[0]:.0f} to {gyro.temperature_c[2]:.0f} °C',
                gyro.bias_per_k_radps,
                gyro.bias_per_k_std_radps,
                '°/s/K',
            )
        )
    lines = []
    for label, values, stds, unit in rows:
        for axis, value, std in zip(AXES, values, stds or NO_TURN):
            text = with_half_width(np.degrees(value), Z_90 * np.degrees(std))
            lines.append(f'  {label:{_LONGEST_LABEL}} {axis:1} {text} {unit}')
    return lines


def with_provenance(
    fitted: Sensor, source: str, poses: Poses, data_sha256: str, results: Mapping[str, str]
) -> Sensor:
    """Add date, sources, sweep, data hash, results and id to a fitted sensor."""
    alpha_rad = poses.alpha_rad[~poses.check]
    sweep = f'{len(planes(alpha_rad))} planes alpha' if np.isfinite(alpha_rad).all() else 'rests'
    entries = {
        **{key: text for key, text in fitted.provenance.items() if key.endswith('_from')},
        # A text of YAML, where +00:00 makes a date, which ros2 param cannot set.
        'date': f'{datetime.now(timezone.utc):%Y-%m-%dT%H:%M:%S}+0000',
        'package_version': package_version(),
        'source': source,
        'data_sha256': data_sha256 or _sha256(poses),
        'poses': str(int((~poses.check).sum())),
        'check_poses': str(int(poses.check.sum())),
        'sweep': sweep,
        'temperature_c': _mean_text(poses.temperature_c, '.2f'),
        'supply_v': _mean_text(poses.supply_v, '.4f'),
        **results,
    }
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


def _mean_text(values: np.ndarray, digits: str) -> str:
    finite = values[np.isfinite(values)]
    return f'{finite.mean():{digits}}' if finite.size else 'not measured'


def envelope(fitted: Sensor, force: np.ndarray, poses: Poses, misfit_mps2: float) -> Envelope:
    """Return the validity range by the specific force of all poses, m/s², (k, 3)."""
    finite_c = poses.temperature_c[np.isfinite(poses.temperature_c)]
    further = _next_degree(fitted, poses)
    nodes_c = further.nodes_c.tolist() if further else [0.0]
    return Envelope(
        (float(finite_c.min()), float(finite_c.max())) if finite_c.size else None,
        zero_g_per_k=_unmodelled_slope(fitted, 'temperature_bias'),
        scale_per_k=_unmodelled_slope(fitted, 'temperature_scale'),
        zero_g_nodes_c=tuple(nodes_c) if further else (),
        zero_g_next=tuple(further.size.tolist()) if further else (),
        # The zero-g is that of all poses, which agree at each of the nodes.
        zero_g_at_c=nodes_c[0],
        misfit_mps2=misfit_mps2,
        force_low_mps2=tuple(force.min(axis=0).tolist()),
        force_high_mps2=tuple(force.max(axis=0).tolist()),
    )


def _next_degree(fitted: Sensor, poses: Poses) -> NextDegree | None:
    """Return what a fit lacks that follows temperature by slope and curvature; else None."""
    known = poses.with_temperature()
    if (
        'temperature_bias' not in fitted.effects
        or not len(known)
        or not np.ptp(known.temperature_c)
    ):
        return None
    curvature_k2 = fitted.values['temperature_bias']['per_k2']
    return next_degree(known.temperature_c, residual_g(fitted, known), curvature_k2)


def _unmodelled_slope(fitted: Sensor, effect: str) -> float:
    """Return the typical slope of an effect by the datasheet, else by the library; 0 if fitted."""
    if effect in fitted.effects:
        return 0.0
    typical, _ = fitted.datasheet.get(Coefficient(effect, 'per_k'), (0.0, 0.0))
    return typical or effect_named(effect).parameters[0].scale


_ABSOLUTE = {
    'bias.offset_v': 'nominal_zero_g_v',
    'scale_factor.offset_v_per_g': 'nominal_scale_v_per_g',
}
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
    truth: float  # The true value; 0 for an effect that the sensor does not have

    @property
    def inside(self) -> bool:
        """Return whether the 90 % interval contains the true value."""
        return abs(self.fitted - self.truth) <= self.half_width


def compare(fitted: Sensor, truth: Sensor) -> list[Comparison]:
    """
    Compare each fitted coefficient with the true one, in the order of the fit.

    A misalignment and a linear cross-axis term are the same to first order: the true sensor
    must have the gauge of the fits: no linear cross-axis terms.
    """
    names = fitted.covariance_names
    rows = []
    truth = with_neutral(truth, [name.effect for name in names])
    half_widths = Z_90 * np.sqrt(np.diag(fitted.covariance))
    for name, *values in zip(names, get(fitted, names), half_widths, get(truth, names)):
        key = str(name.without_axis)
        unit = parameter_of(name).unit
        scale = 1.0
        if key in _ABSOLUTE:
            nominal = getattr(fitted, _ABSOLUTE[key])[fitted.axes.index(name.axis)]
            values[0], values[2] = values[0] + nominal, values[2] + nominal
        if unit == 'rad':
            unit = '°'
            scale = float(np.degrees(1.0))
        acts = name.axis and name.effect in OTHER_AXIS
        other = AXES[OTHER_AXIS[name.effect][AXES.index(name.axis)]] if acts else ''
        rows.append(
            Comparison(
                key,
                name.axis,
                _LABELS.get(key, key).format(other=other),
                unit.replace('^2', '²'),
                *(float(scale * value) for value in values),
            )
        )
    return rows


def errors_in_words(fitted: Sensor) -> str:
    """Return the largest zero-g error of the uncalibrated sensor, for people."""
    offset_g = (fitted.zero_g_v - fitted.nominal_zero_g_v) / fitted.nominal_scale_v_per_g
    axis = int(np.argmax(np.abs(offset_g)))
    return (
        f'Uncalibrated, {fitted.axes[axis]} reads {mg_text(abs(offset_g[axis]) * G0_MPS2)} '
        f'too {"much" if offset_g[axis] > 0 else "little"}.'
    )


_LONGEST_LABEL = 26  # Columns that a coefficient's name may take, so that its line has at most 79
_COVERED = 0.9
"""Share of the 90 % intervals that contain the true value if the intervals are right."""


def truth_table(comparisons: Sequence[Comparison]) -> list[str]:
    """Lay out each fitted coefficient beside the true one, in 79 columns."""
    longest = max((len(row.label) for row in comparisons), default=0)
    width = max(min(longest + 1, _LONGEST_LABEL), len('coefficient'))
    lines = [f' {"coefficient":{width}}     fitted (90 %) {"":16}true']
    for row in comparisons:
        truth = '0' if row.truth == 0 else rounded(row, row.truth)
        lines.append(
            f' {row.label[:width]:{width}} {row.axis:1} {rounded(row, row.fitted):>10} ± '
            f'{rounded(row, row.half_width):8} {row.unit:5} {truth:>10}   '
            f'{"ok" if row.inside else "MISSED"}'
        )
    inside = sum(row.inside for row in comparisons)
    return [
        *lines,
        f' ({inside} of {len(comparisons)} inside their 90 % intervals; about '
        f'{_COVERED * len(comparisons):.0f} are expected)',
    ]


def rounded(row: Comparison, value: float) -> str:
    """Write a value with the decimals that show two digits of the interval."""
    return fixed(value, decimals(row.half_width))


def history(newest: Sensor, stored: Sequence[Sensor]) -> tuple[list[str], list[list[str]]] | None:
    """Return head and rows of the calibrations of a sensor; None without an earlier one."""
    rows = [
        [
            sensor.provenance.get('date', '-')[:16].replace('T', ' '),
            calibration_store.calibration_id(sensor),
            sensor.model,
            sensor.provenance.get('temperature_c', '-'),
            *(f'{value:.5f}' for value in (*sensor.zero_g_v, *sensor.scale_v_per_g)),
        ]
        for sensor in (*stored, newest)
        if sensor.axes == newest.axes
    ]
    if len(rows) < 2:
        return None
    head = [
        'date',
        'id',
        'model',
        'temperature, °C',
        *map(' '.join, product(('zero-g', 'scale factor'), newest.axes)),
    ]
    return head, rows
