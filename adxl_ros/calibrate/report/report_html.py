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

"""The report of a calibration: a page in one file that opens offline, and its plots as PNG."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from html import escape
from importlib.resources import files
import os
from pathlib import Path
from typing import Any, NamedTuple

from adxl_ros.calibrate.calibration import CalibrationResult
from adxl_ros.calibrate.poses import reference_force
from adxl_ros.calibrate.report import cross_validation, plots
from adxl_ros.calibrate.report.acceptance import (
    Assessment,
    beyond_datasheet,
    FAIL,
    NOT_SHOWN,
    PASS,
)
from adxl_ros.calibrate.report.cross_validation import ErrorStatistic
from adxl_ros.calibrate.report.drift_history import DriftHistory
from adxl_ros.errors import UserError
from adxl_ros.files import calibration_store, html_page, plot_file
from adxl_ros.files.atomic_write import atomic_path
from adxl_ros.model import signal_chain
from adxl_ros.model.coefficients import get, parameter_of
from adxl_ros.model.constants import G0_MPS2, Z_90
from adxl_ros.model.sensor import Sensor
import numpy as np

_PANELS = ((0, 1), (2, 3), (4, 5))
"""Panels of `plots.sweep` that stand side by side on the page."""
_ERROR_TABLE_HEAD = ('model', 'poses', 'tilt, deg', 'alpha, deg', 'beta, deg', 'acceleration, mg',
                     'calibration error, mg', 'datasheet', 'noise', 'limited by')
_COEFFICIENT_TABLE_HEAD = ('coefficient', 'value', '90 % interval', 'typical ±', 'maximum ±',
                           'unit', 'datasheet')
_SPHERE = (
    '<figure><p class="screen"><label>model <select id="sphere-model"></select></label> '
    '<label>shows <select id="sphere-quantity"></select></label></p><canvas id="sphere" '
    'width="900" height="520" style="width:900px;aspect-ratio:900/520;touch-action:none;'
    'cursor:grab" tabindex="0" role="img" aria-label="residuals over the sphere of '
    'poses"></canvas><figcaption id="sphere-about">Drag to turn, wheel to zoom, point at a pose.'
    '</figcaption></figure><p>Each point is the direction of the vertical in the case of the '
    'sensor. Its colour is the error of the model at that pose.</p>')


class _SphereData(NamedTuple):
    """
    Errors over the sphere of k poses.

    Attributes
    ----------
    models
        Names of the models.
    quantities
        Label and unit of each quantity.
    errors
        Errors of each model by pose and quantity, (k, q) each.
    force
        Specific force in the case, m/s², (k, 3).
    labels
        Text of each pose.

    """

    models: list[str]
    quantities: list[list[str]]
    errors: list[np.ndarray]
    force: np.ndarray
    labels: list[str]


def write(folder: str | os.PathLike, result: CalibrationResult,
          store: str | os.PathLike = '') -> None:
    """
    Write `report.html`, and the plots of the unit as `calibration.png`.

    Parameters
    ----------
    folder
        An existing folder.
    result
        The calibration.
    store
        The calibration store with the history of the unit; empty for none.

    Raises
    ------
    UserError
        matplotlib is not installed, or a file cannot be written.

    """
    past = calibration_store.history(store, result.fitted.serial).calibrations \
        if str(store) else []
    _write_page(Path(folder) / 'report.html', result, [sensor for _, sensor in past])
    # If the poses do not suffice for the figures of the paper, the page states the reason.
    with suppress(UserError):
        draw(Path(folder) / 'calibration.png', result)


def draw(path: str | os.PathLike, result: CalibrationResult) -> None:
    """
    Write the plots of a calibrated unit as PNG.

    Parameters
    ----------
    path
        The file.
    result
        The calibration.

    Raises
    ------
    UserError
        The poses do not suffice for the plots.

    """
    if result.gravity_fit is not None:
        plot_file.write_plot(plots.gravity_rests(result.name, result.gravity_fit), path)
    else:
        plots.draw_sweep(path, result.nominal, result.paper_sensor, result.poses)


def _write_page(path: Path, result: CalibrationResult, past: Sequence[Sensor]) -> None:
    fitted = result.fitted
    title = f'Calibration of {fitted.serial}, {fitted.provenance["date"][:10]}'
    script = (files('adxl_ros.calibrate.report') / 'sphere.js').read_text('utf-8')
    parts = [f'<h1>{escape(title)}</h1>', _summary(result), '<h2>Acceptance</h2>',
             _error_table(result),
             '<h2>Residuals over the sphere of poses</h2>', _sphere(result),
             '<h2>Coefficients</h2>', _coefficients(fitted),
             '<h2>History of this unit</h2>', _history(DriftHistory.from_store(fitted, past)),
             '<h2>Plots</h2>', *_plots(result),
             '<h2>Details</h2>', _preformatted(result.report_lines),
             '<h2>Provenance</h2>', _provenance(fitted), html_page.script(script)]
    with atomic_path(path) as temporary:
        temporary.write_text(html_page.document(title, parts), encoding='utf-8')


def _preformatted(lines: Sequence[str]) -> str:
    text = '\n'.join(lines)
    return f'<pre>{escape(text)}</pre>'


def _summary(result: CalibrationResult) -> str:
    """Return the outcomes, the errors and the largest cause of error, as a paragraph."""
    fitted = result.fitted
    assessment = next((row for row in result.assessments if row.model == fitted.model), None)
    if assessment is None:
        return ('<p class="summary open">Too few poses were held out to assess this calibration. '
                'Take more poses.</p>')
    beyond = beyond_datasheet(fitted)
    outcomes = {
        'acceleration error against the datasheet': assessment.accel_datasheet,
        'acceleration error against the noise': assessment.accel_noise,
        'tilt error against datasheet and noise': ', '.join(filter(
            None, (assessment.tilt_datasheet, assessment.tilt_noise))),
        'unit against the datasheet': (FAIL if beyond else PASS) if fitted.datasheet else ''}
    text = '; '.join(f'{name}: {outcome}' for name, outcome in outcomes.items() if outcome)
    lines = [f'{text[0].upper()}{text[1:]}.']
    errors = next((row for row in result.held_out if row.model == fitted.model), None)
    if errors is not None:
        tilt = '' if np.isnan(errors.tilt_deg.rms) else \
            f'{_with_interval(errors.tilt_deg)} deg of tilt and '
        lines.append(f'On {errors.pose_count} held-out poses the {fitted.model} model has an '
                     f'error of {tilt}{_with_interval(errors.accel_mg)} mg rms (90 %).')
    tilt = '' if np.isnan(assessment.error_deg) else \
        f' and {assessment.error_deg:.2g} deg of tilt'
    lines.append('Without noise and stage error of the check, the calibration error is '
                 f'{assessment.error_mg:.3g} mg{tilt}. Limited by: {assessment.limited_by}.')
    lines += [f'Beyond the datasheet: {line}.' for line in beyond]
    joined = ' '.join(outcomes.values())
    kind = 'bad' if FAIL in joined else 'open' if NOT_SHOWN in joined else 'good'
    return f'<p class="summary {kind}">' + '<br>'.join(map(escape, lines)) + '</p>'


def _with_interval(statistic: ErrorStatistic) -> str:
    low, high = statistic.interval
    return f'{statistic.rms:.3g} ({low:.2g} to {high:.2g})'


def _error_table(result: CalibrationResult) -> str:
    row_of = {row.model: row for row in result.assessments}
    rows = []
    for errors in result.held_out:
        statistics = (errors.tilt_deg, errors.alpha_deg, errors.beta_deg, errors.accel_mg)
        assessment = row_of.get(errors.model)
        rows.append([errors.model, str(errors.pose_count), *map(_error_cell, statistics),
                     *(_outcome_cells(assessment) if assessment else ['-'] * 4)])
    if not rows:
        return _preformatted(result.report_lines)
    return html_page.table(_ERROR_TABLE_HEAD, rows) + (
        '<p>Errors: rms with its 90 % interval, which allows for correlated errors of '
        'neighbouring poses. Calibration error: without noise and stage error of the check. '
        'Datasheet and noise: outcome of acceleration, then of tilt.</p>')


def _error_cell(statistic: ErrorStatistic) -> str:
    if np.isnan(statistic.rms):
        return '-'
    return f'{_with_interval(statistic)}, max {statistic.largest:.3g}'


def _outcome_cells(row: Assessment) -> list[str]:
    pairs = (row.accel_datasheet, row.tilt_datasheet), (row.accel_noise, row.tilt_noise)
    return [f'{row.error_mg:.3g}', *(', '.join(filter(None, pair)) or '-' for pair in pairs),
            row.limited_by]


def _sphere(result: CalibrationResult) -> str:
    data = _stage_sphere(result) if result.gravity_fit is None else _gravity_sphere(result)
    up = data.force / np.linalg.norm(data.force, axis=1, keepdims=True)

    def point(i: int) -> dict[str, Any]:
        return {'u': [round(float(c), 5) for c in up[i]], 'label': data.labels[i],
                'held_out': bool(result.poses.check[i]),
                'values': [list(map(_number, errors[i])) for errors in data.errors]}

    return html_page.data('sphere-data', {
        'models': data.models, 'quantities': data.quantities,
        'poses': [point(i) for i in range(len(data.labels))]}) + _SPHERE


def _gravity_sphere(result: CalibrationResult) -> _SphereData:
    fit, poses = result.gravity_fit, result.poses
    assert fit is not None
    inverse = signal_chain.inverse(result.fitted)
    force = np.column_stack(inverse(list(poses.volts.T), poses.environment))
    errors = [np.column_stack([1e3 * values / G0_MPS2])
              for values in (fit.before_mps2, fit.residual_mps2)]
    return _SphereData(['nominal', 'gravity'], [['magnitude minus gravity', 'mg']], errors, force,
                       [f'rest {i + 1}' for i in range(len(poses))])


def _stage_sphere(result: CalibrationResult) -> _SphereData:
    poses, fitted = result.poses, result.fitted
    force = np.column_stack(reference_force(poses, fitted.local_gravity_mps2))
    units = {row.model: row.fitted[0] for row in result.held_out} | {fitted.model: fitted}
    errors = []
    for unit in units.values():
        unit_errors = cross_validation.pose_errors(unit, poses)
        errors.append(np.column_stack([np.degrees(unit_errors.tilt_rad),
                                       1e3 * unit_errors.accel_mps2 / G0_MPS2]))
    labels = [f'pose {i + 1}, alpha {np.degrees(a):.1f}, beta {np.degrees(b):.1f} deg'
              for i, (a, b) in enumerate(zip(poses.alpha_rad, poses.beta_rad))]
    quantities = [['error of tilt', 'deg'], *([f'error of {a}', 'mg'] for a in fitted.axes)]
    return _SphereData(list(units), quantities, errors, force, labels)


def _number(value: float) -> float | None:
    return float(f'{value:.4g}') if np.isfinite(value) else None


def _coefficients(fitted: Sensor) -> str:
    stds = np.sqrt(np.diag(fitted.covariance))
    rows = _absolute_rows('zero-g', 'V', fitted, fitted.zero_g_v, fitted.nominal_zero_g_v)
    rows += _absolute_rows('scale factor', 'V/g', fitted, fitted.scale_v_per_g,
                           fitted.nominal_scale_v_per_g)
    values = get(fitted, fitted.covariance_names)
    for name, value, std in zip(fitted.covariance_names, values, stds):
        half_width = Z_90 * std
        typical, maximum = fitted.datasheet.get(name.without_axis, (0.0, 0.0))
        rows.append([str(name), f'{value:.5g}',
                     f'{value - half_width:.5g} to {value + half_width:.5g}',
                     f'{typical:g}' if typical else '-', f'{maximum:g}' if maximum else '-',
                     parameter_of(name).unit,
                     _against_datasheet(abs(value) - half_width, typical, maximum)])
    source = escape(fitted.datasheet_name) or 'none in the parameter file'
    return html_page.table(_COEFFICIENT_TABLE_HEAD, rows) + (
        '<p>The rows below zero-g and scale factor are departures from nominal. '
        f'Datasheet: {source}.</p>')


def _absolute_rows(label: str, unit: str, fitted: Sensor, values: Sequence[float] | np.ndarray,
                   nominal: Sequence[float] | np.ndarray) -> list[list[str]]:
    return [[f'{label} {axis}', f'{value:.6g}', '', f'nominal {stated:g}', '', unit, '']
            for axis, value, stated in zip(fitted.axes, values, nominal)]


def _against_datasheet(magnitude: float, typical: float, maximum: float) -> str:
    """Compare the lower end of a magnitude's interval with datasheet values, 0 if not stated."""
    if not (typical or maximum):
        return ''
    if maximum and magnitude > maximum:
        return 'beyond the maximum'
    return 'beyond typical' if typical and magnitude > typical else 'within'


def _history(history: DriftHistory) -> str:
    if not history.sensors:
        return '<p>No earlier calibration of this unit is in the store.</p>'
    head, rows = history.table()
    return ''.join([html_page.table(head, rows),
                    *(f'<p>{escape(line)}</p>' for line in history.changes()),
                    _picture(plots.drift(history.series()), 'drift of zero-g and scale factor')])


def _plots(result: CalibrationResult) -> list[str]:
    if result.gravity_fit is not None:
        return [_picture(plots.gravity_rests(result.name, result.gravity_fit),
                         'magnitude of gravity over the rests')]
    inliers = result.poses.subset(result.inliers)
    parts = ['<p>The first plot has the errors on held-out poses, as figure 10 of Ang, Khosla and '
             'Riviere (2007). The others are figures 2 to 8 of the paper for this unit: the '
             f'deviation from the linear model, measured and by the {result.paper_sensor.model} '
             'model.</p>']
    if result.held_out:
        parts.append(_picture(plots.held_out(result.held_out, inliers),
                              'errors on held-out poses'))
    try:
        return parts + [_picture(
            plots.sweep(result.nominal, result.paper_sensor, result.poses, pair),
            'figures 2 to 8 of the paper') for pair in _PANELS]
    except UserError as error:
        return [*parts, f'<p>Figures 2 to 8 of the paper cannot be drawn: {escape(str(error))}'
                '</p>']


def _picture(figure: Any, description: str) -> str:
    html = html_page.picture(figure, description)
    plot_file.pyplot().close(figure)
    return html


def _provenance(fitted: Sensor) -> str:
    temperature_c = fitted.envelope.temperature_c
    rows = [['serial', fitted.serial], ['model', fitted.model],
            ['effects', ', '.join(fitted.effects)],
            *([key.replace('_', ' '), value] for key, value in fitted.provenance.items()),
            ['valid for temperatures', f'{temperature_c[0]:.1f} to {temperature_c[1]:.1f} degC'
             if temperature_c else 'not measured']]
    return html_page.table(['', ''], rows)
