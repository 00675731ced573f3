# SPDX-License-Identifier: Apache-2.0

"""The report of a calibration: a page in one file that opens offline, and its plots as PNG."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
import os
from pathlib import Path
import re
from typing import Any, NamedTuple

from adxl_ros.calibrate.calibration import CalibrationResult
from adxl_ros.calibrate.poses import reference_force
from adxl_ros.calibrate.report import cross_validation, page_figures, plots, text_tables
from adxl_ros.calibrate.report.acceptance import (
    Assessment,
    FAIL,
    nonlinearity_mps2,
    NOT_SHOWN,
    PASS,
)
from adxl_ros.calibrate.report.cross_validation import ErrorStatistic, HeldOutErrors
from adxl_ros.calibrate.report.error_budget import ErrorBudget, rms_mg, sample_noise_mps2
from adxl_ros.calibrate.report.page_figures import DriftHistory
from adxl_ros.calibrate.report.text_tables import compare
from adxl_ros.errors import UserError
from adxl_ros.files import calibration_store, parameter_file
from adxl_ros.files.atomic_write import write_bytes, write_text
from adxl_ros.model import signal_chain
from adxl_ros.model.coefficients import get
from adxl_ros.model.constants import G0_MPS2, Z_90
from adxl_ros.model.sensor import Sensor
from adxl_ros.report import page as html_page
from adxl_ros.report.figures import Figure, png, whisker
import numpy as np

_PANELS = ((0, 1), (2, 3), (4, 5))
"""Panels of `plots.sweep` that stand side by side on the page."""
_COLOURS = {PASS: 'green', NOT_SHOWN: 'amber', FAIL: 'red'}
"""Colour of the badge by outcome."""
_PART_COLOURS = {'noise': '#7b8794', 'stage': '#d9930d', 'coefficients': '#1f5fbf',
                 'model': '#c0392b'}
"""Colours of the parts of the error budget."""
_ADVICE = {
    'noise': 'Noise limits it most: longer rests at each pose reduce the error.',
    'stage': 'The stage limits it most: a finer encoder, or more poses, reduce the error.',
    'model': 'The model limits it most: a model with more terms reduces the error.',
    'stage or model': 'Stage or model limits it most: visit some poses twice to see which.',
}
"""How to get better, by the largest cause of error."""
_BEYOND = 'beyond the maximum'
"""Outcome of a coefficient whose whole interval exceeds the maximum of the datasheet."""
_BEYOND_WHISKER = 1.08
"""Half of a whisker's range divided by the largest value in it. Chosen: no dot is cut."""


class _SphereData(NamedTuple):
    """Errors over the sphere of k poses."""

    models: list[str]  # Names of the models
    quantities: list[list[str]]  # Label and unit of each quantity
    errors: list[np.ndarray]  # Errors of each model by pose and quantity, (k, q) each
    force: np.ndarray  # Specific force in the case, m/s², (k, 3)
    labels: list[str]  # Text of each pose


def write(folder: str | os.PathLike, result: CalibrationResult,
          store: str | os.PathLike = '') -> None:
    """Write `report.html`, and the plots of the unit as `calibration.png`."""
    html_page.check_libraries()
    past = calibration_store.history(store, result.fitted.serial).calibrations \
        if str(store) else []
    write_text(Path(folder) / 'report.html', page(result, [sensor for _, sensor in past]))
    # If the poses do not suffice for the figures of the paper, the page states the reason.
    with suppress(UserError):
        draw(Path(folder) / 'calibration.png', result)


def draw(path: str | os.PathLike, result: CalibrationResult) -> None:
    """Write the plots of a calibrated unit as PNG."""
    if result.gravity_fit is not None:
        write_bytes(path, png(plots.gravity_rests(result.name, result.gravity_fit)))
    else:
        plots.draw_sweep(path, result.nominal, result.paper_sensor, result.poses)


def page(result: CalibrationResult, past: Sequence[Sensor]) -> str:
    """Lay out the page."""
    fitted = result.fitted
    assessment = next((row for row in result.assessments if row.model == fitted.model), None)
    errors = next((row for row in result.held_out if row.model == fitted.model), None)
    history, coefficients = DriftHistory.from_store(fitted, past), _coefficients(fitted)
    pictures, fault = _paper_figures(result)
    return html_page.render('adxl_ros.calibrate.report', 'calibration.html', {
        'title': f'Calibration of {fitted.serial}, {fitted.provenance["date"][:10]}',
        'about': [f'{fitted.model} model', f'{len(result.poses)} poses', f'axes {fitted.axes}'],
        'badge': _badge(fitted),
        'tiles': _tiles(result, assessment),
        'advice': _ADVICE.get(assessment.limited_by, '') if assessment else
        'Take more poses: too few were held out to assess this calibration.',
        'file_name': re.sub(r'[^\w.-]+', '_', fitted.serial) + '.yaml',
        'download': html_page.download_url(parameter_file.as_text(fitted, result.comments())),
        'figures': _figures(result, assessment, errors, history),
        'open_circles': errors.poses_without_alpha if errors else 0,
        'sphere': _sphere(result),
        'coefficients': coefficients,
        'beyond': [row for row in coefficients if row['outcome'] == _BEYOND],
        'datasheet': fitted.datasheet_name,
        'limit_head': _limit_head(fitted),
        'limits': _limits(result),
        'budget': _budget(assessment.accel) if assessment and errors else None,
        'history': history.table() if history.sensors else None,
        'changes': history.changes() if history.sensors else [],
        'paper_model': '' if result.gravity_fit else result.paper_sensor.model,
        'pictures': pictures, 'pictures_fault': fault,
        'report_lines': result.report_lines,
        'provenance': _provenance(fitted)})


def _badge(fitted: Sensor) -> dict[str, str]:
    """Return the acceptance as the terminal shows it, and its colour."""
    first, *others = (line.strip() for line in text_tables.acceptance_lines(fitted))
    outcome = next(outcome for outcome in (NOT_SHOWN, PASS, FAIL) if first.startswith(outcome))
    sentence = '. '.join([first.removeprefix(outcome).strip(), *others])
    return {'colour': _COLOURS[outcome], 'word': outcome,
            'sentence': f'{sentence[:1].upper()}{sentence[1:].rstrip(".")}.'}


def _tiles(result: CalibrationResult, assessment: Assessment | None) -> list[dict[str, str]]:
    """Return tilt and acceleration error before and after, and what limits them."""
    if result.gravity_fit is not None:
        fit = result.gravity_fit
        used = np.setdiff1d(np.arange(len(fit.before_mps2)), fit.outliers)
        before, after = (1e3 * float(np.sqrt(np.mean(v[used] ** 2))) / G0_MPS2
                         for v in (fit.before_mps2, fit.held_out_mps2))
        tiles = [{'label': 'error of the magnitude of gravity',
                  'text': f'{_digits(before)} → {_digits(after)} mg',
                  'note': f'rms over {len(used)} rests, held out'}]
    elif result.held_out:
        first, last = result.held_out[0], result.held_out[-1]
        tiles = [_before_after('tilt error', first.tilt_deg, last.tilt_deg, '°'),
                 _before_after('acceleration error', first.accel_mg, last.accel_mg, 'mg')]
        tiles = [tile for tile in tiles if tile]
    else:
        tiles = []
    if assessment is not None:
        tiles.append({'label': 'limited by', 'text': assessment.limited_by,
                      'note': f'calibration error {_digits(assessment.error_mg)} mg, without '
                              'noise and stage error of the check'})
    return tiles


def _before_after(label: str, before: ErrorStatistic, after: ErrorStatistic, unit: str
                  ) -> dict[str, str]:
    """Return an error by the datasheet values and by the calibration; empty where not known."""
    if np.isnan(after.rms):
        return {}
    low, high = after.interval
    return {'label': label, 'text': f'{_digits(before.rms)} → {_digits(after.rms)} {unit}',
            'note': f'rms on held-out poses, 90 %: {_digits(low)} to {_digits(high)} {unit}'}


def _digits(value: float) -> str:
    """Write a positive value with three digits at most, without an exponent."""
    decimals = 1 if value >= 10 else 2 if value >= 1 else 3
    return f'{value:.{decimals}f}' if value >= 5e-4 else '< 0.001'


def _figures(result: CalibrationResult, assessment: Assessment | None,
             errors: HeldOutErrors | None, history: DriftHistory
             ) -> dict[str, Figure]:
    """Return the figures of the page by name."""
    figures = {}
    if result.gravity_fit is not None:
        figures['errors'] = page_figures.gravity_errors(result.gravity_fit)
    elif assessment is not None and errors is not None:
        figures['errors'] = page_figures.pose_errors(
            errors, assessment, result.poses.subset(result.inliers), result.fitted.axes)
    if history.sensors:
        figures['drift'] = page_figures.drift(history.series())
    return figures


def _limit_head(fitted: Sensor) -> list[str]:
    """Return the head of the table of limits."""
    datasheet_mps2 = nonlinearity_mps2(fitted)
    datasheet = f'datasheet ({1e3 * datasheet_mps2 / G0_MPS2:.2g} mg)' if datasheet_mps2 \
        else 'datasheet'
    noise = f'noise ({1e3 * sample_noise_mps2(fitted) / G0_MPS2:.2g} mg)'
    return ['model', 'poses', 'tilt error, °', 'alpha, °', 'beta, °', 'acceleration error, mg',
            'calibration error, mg', f'acceleration, {datasheet}', f'acceleration, {noise}',
            'tilt, datasheet', 'tilt, noise', 'limited by']


def _limits(result: CalibrationResult) -> list[list[str]]:
    """Return the errors of each model, and one outcome for each limit."""
    row_of = {row.model: row for row in result.assessments}
    rows = []
    for errors in result.held_out:
        statistics = (errors.tilt_deg, errors.alpha_deg, errors.beta_deg, errors.accel_mg)
        row = [errors.model, str(errors.pose_count), *map(_error_cell, statistics)]
        assessed = row_of.get(errors.model)
        rows.append(row + (['-'] * 6 if assessed is None else _outcome_cells(assessed)))
    if not rows:
        rows = [[row.model, str(len(result.poses)), *['-'] * 4, *_outcome_cells(row)]
                for row in result.assessments]
    return rows


def _outcome_cells(row: Assessment) -> list[str]:
    return [_digits(row.error_mg), *(outcome or '-' for outcome in (
        row.accel_datasheet, row.accel_noise, row.tilt_datasheet, row.tilt_noise)),
        row.limited_by]


def _error_cell(statistic: ErrorStatistic) -> str:
    if np.isnan(statistic.rms):
        return '-'
    return f'{_digits(statistic.rms)} (max {_digits(statistic.largest)})'


def _budget(budget: ErrorBudget) -> dict[str, Any]:
    """Return the parts of the acceleration error as parts of a bar, and in words."""
    squares = {name: float(getattr(budget, name)) for name in _PART_COLOURS}
    total = max(sum(squares.values()), 1e-30)
    return {'expected': f'{_digits(rms_mg(budget.expected))} mg',
            'measured': f'{_digits(rms_mg(budget.measured))} mg',
            'separable': budget.separable,
            'parts': [{'name': name, 'text': f'{_digits(rms_mg(square))} mg',
                       'percent': round(100 * square / total, 2), 'colour': _PART_COLOURS[name]}
                      for name, square in squares.items()]}


def _sphere(result: CalibrationResult) -> dict[str, Any]:
    """Return the data of the sphere's script."""
    data = _stage_sphere(result) if result.gravity_fit is None else _gravity_sphere(result)
    up = data.force / np.linalg.norm(data.force, axis=1, keepdims=True)

    def point(i: int) -> dict[str, Any]:
        return {'u': [round(float(c), 5) for c in up[i]], 'label': data.labels[i],
                'held_out': bool(result.poses.check[i]),
                'values': [list(map(_number, errors[i])) for errors in data.errors]}

    return {'models': data.models, 'quantities': data.quantities,
            'poses': [point(i) for i in range(len(data.labels))]}


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
    labels = [f'pose {i + 1}, alpha {np.degrees(a):.1f}°, beta {np.degrees(b):.1f}°'
              for i, (a, b) in enumerate(zip(poses.alpha_rad, poses.beta_rad))]
    quantities = [['error of tilt', '°'], *([f'error of {a}', 'mg'] for a in fitted.axes)]
    return _SphereData(list(units), quantities, errors, force, labels)


def _number(value: float) -> float | None:
    return float(f'{value:.4g}') if np.isfinite(value) else None


def _coefficients(fitted: Sensor) -> list[dict[str, Any]]:
    """Return the coefficients with their intervals within the range of the datasheet."""
    half_widths = Z_90 * np.sqrt(np.diag(fitted.covariance))
    departures = get(fitted, fitted.covariance_names)
    rows = []
    for row, name, value, half_width in zip(compare(fitted, fitted), fitted.covariance_names,
                                            departures, half_widths):
        typical, maximum = fitted.datasheet.get(name.without_axis, (0.0, 0.0))
        largest = max(typical, maximum, abs(value) + half_width, 1e-12) * _BEYOND_WHISKER
        unit = '' if row.unit == '1' else f' {row.unit}'
        text = f'{text_tables.rounded(row, row.fitted)} ± ' \
            f'{text_tables.rounded(row, row.half_width)}{unit}'
        beyond = _against_datasheet(abs(value) - half_width, typical, maximum)
        rows.append({
            'label': f'{row.label} {row.axis}', 'name': str(name), 'text': text,
            'datasheet': _range_text(typical, maximum, row.unit), 'outcome': beyond,
            'mark': whisker(
                value, value - half_width, value + half_width, (-largest, largest), text,
                typical or maximum, beyond.startswith('beyond'))})
    return rows


def _range_text(typical: float, maximum: float, unit: str) -> str:
    """Return the departures that the datasheet permits."""
    factor = float(np.degrees(1.0)) if unit == '°' else 1.0
    texts = [f'{word} ±{factor * value:.2g}'
             for word, value in (('typical', typical), ('maximum', maximum)) if value]
    return ', '.join(texts) or '-'


def _against_datasheet(magnitude: float, typical: float, maximum: float) -> str:
    """Compare the lower end of a magnitude's interval with datasheet values, 0 if not stated."""
    if not (typical or maximum):
        return ''
    if maximum and magnitude > maximum:
        return _BEYOND
    return 'beyond typical' if typical and magnitude > typical else 'within'


def _paper_figures(result: CalibrationResult) -> tuple[list[str], str]:
    """Return the figures of the paper as URLs of pictures, or the reason why there are none."""
    if result.gravity_fit is not None:
        return [_picture(plots.gravity_rests(result.name, result.gravity_fit))], ''
    pictures = [_picture(plots.held_out(
        result.held_out, result.poses.subset(result.inliers)))] if result.held_out else []
    try:
        return pictures + [
            _picture(plots.sweep(result.nominal, result.paper_sensor, result.poses, pair))
            for pair in _PANELS], ''
    except UserError as error:
        return pictures, str(error)


def _picture(figure: Any) -> str:
    return html_page.picture_url(figure)


def _provenance(fitted: Sensor) -> list[list[str]]:
    temperature_c = fitted.envelope.temperature_c
    return [['serial', fitted.serial], ['model', fitted.model],
            ['effects', ', '.join(fitted.effects)],
            *([key.replace('_', ' '), value] for key, value in fitted.provenance.items()),
            ['valid for temperatures', f'{temperature_c[0]:.1f} to {temperature_c[1]:.1f} °C'
             if temperature_c else 'not measured']]
