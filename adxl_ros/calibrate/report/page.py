# SPDX-License-Identifier: Apache-2.0

"""
The page of a calibration: one file that opens offline, with figures that plotly.js draws.

- Its pictures: figures 2 to 8 of the paper for one unit, and errors of fits.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
import os
from pathlib import Path
import re
from typing import Any

from adxl_ros.calibrate.fits import linear
from adxl_ros.calibrate.poses import planes, Poses, reference_force
from adxl_ros.calibrate.report import acceptance, gum, held_out
from adxl_ros.calibrate.report.acceptance import Assessment, FAIL, NOT_SHOWN, PASS
from adxl_ros.calibrate.result import CalibrationResult, compare, DriftHistory, rounded
from adxl_ros.errors import UserError
from adxl_ros.files import calibration_store, parameter_file
from adxl_ros.files.atomic_write import write_bytes, write_text
from adxl_ros.model import signal_chain
from adxl_ros.model.constants import G0_MPS2, Z_90
from adxl_ros.model.sensor import get, Sensor
from adxl_ros.report import figures, page as html_page
from adxl_ros.report.figures import AXIS_COLOURS, Figure
import numpy as np

FILES = ('report.html', 'calibration.png')
"""Files of a report."""
_PANELS = ((0, 1), (2, 3), (4, 5))
"""Panels of `_sweep` that stand side by side on the page."""
_COLOURS = {PASS: 'green', NOT_SHOWN: 'amber', FAIL: 'red'}
"""Colour of the badge by outcome."""
_PART_COLOURS = {'noise': '#7b8794', 'stage': '#d9930d', 'coefficients': '#1f5fbf',
                 'model': '#c0392b'}
"""Colours of the parts of the error budget."""
_BEYOND = 'beyond the maximum'
"""Outcome of a coefficient whose whole interval exceeds the maximum of the datasheet."""
_BEYOND_WHISKER = 1.08
"""Half of a whisker's range divided by the largest value in it. Chosen: no dot is cut."""


def write(folder: str | os.PathLike, result: CalibrationResult,
          store: str | os.PathLike = '', stated: Mapping[str, Any] | None = None) -> None:
    """
    Write `report.html`, and the plots of the unit as `calibration.png`.

    stated: standard uncertainties of the laboratory; see `gum.uncertainty`.
    """
    html_page.check_libraries()
    past = calibration_store.history(store, result.fitted.serial).calibrations \
        if str(store) else []
    page_path, plot_path = (Path(folder) / name for name in FILES)
    write_text(page_path, page(result, [sensor for _, sensor in past], stated))
    # If the poses do not suffice for the figures of the paper, the page states the reason.
    with suppress(UserError):
        draw(plot_path, result)


def draw(path: str | os.PathLike, result: CalibrationResult) -> None:
    """Write figures 2 to 8 of the paper for a unit as PNG."""
    draw_sweep(path, result.nominal, _paper_sensor(result), result.poses)


def _paper_sensor(result: CalibrationResult) -> Sensor:
    """Return the unit by a model that the paper's figures can show."""
    if result.gravity_fit is not None:
        raise UserError('they need the angles of a stage')
    return result.fitted if result.fitted.model in ('physical', 'full') else \
        linear.fit_physical(result.nominal, result.poses.subset(~result.poses.check))


def page(result: CalibrationResult, past: Sequence[Sensor],
         stated: Mapping[str, Any] | None = None) -> str:
    """Lay out the page."""
    fitted = result.fitted
    errors_of = {errors.model: errors for errors in result.held_out}
    row_of = {row.model: row for row in result.assessments}
    errors, assessment = errors_of.get(fitted.model), row_of.get(fitted.model)
    history, rows = DriftHistory.from_store(fitted, past), _coefficients(fitted)
    drawn: dict[str, Figure] = {}
    to_mg = 1e3 / G0_MPS2
    if (fit := result.gravity_fit) is not None:
        drawn['errors'] = _error_figure(
            result.inliers, to_mg * fit.held_out_mps2[:, None], Z_90 * to_mg * fit.expected_mps2,
            'x', 'rest', 'magnitude minus gravity, mg')
    elif assessment is not None and errors is not None:
        half_mg = np.full(errors.pose_count, Z_90 * to_mg * assessment.accel.expected ** 0.5)
        drawn['errors'] = _error_figure(
            held_out.determining_alpha(errors.errors), to_mg * errors.errors.accel_mps2, half_mg,
            fitted.axes, 'held-out pose', 'error of acceleration, mg')
    pictures, fault, paper_model = _paper_figures(result)
    temperature_c = fitted.envelope.temperature_c
    return html_page.render('adxl_ros.calibrate.report', 'calibration.html', {
        'title': f'Calibration of {fitted.serial}, {fitted.provenance["date"][:10]}',
        'about': [f'{fitted.model} model', f'{len(result.poses)} poses', f'axes {fitted.axes}'],
        'badge': _badge(fitted),
        'tiles': _tiles(result, assessment),
        'advice': f'Limited by {acceptance.LIMITS[assessment.limited_by]}.' if assessment else
        'Take more poses: too few were held out to assess this calibration.',
        'file_name': re.sub(r'[^\w.-]+', '_', fitted.serial) + '.yaml',
        'download': html_page.download_url(parameter_file.as_text(fitted, result.comments())),
        'figures': drawn,
        'sphere': _sphere(result),
        'coefficients': rows,
        'beyond': [row for row in rows if row['outcome'] == _BEYOND],
        'datasheet': fitted.datasheet_name,
        'models': list(errors_of or row_of), 'errors_of': errors_of, 'row_of': row_of,
        'poses': len(result.poses), 'digits': _digits, 'mg': held_out.rms_mg,
        'datasheet_mg': 1e3 * acceptance.nonlinearity_mps2(fitted) / G0_MPS2,
        'noise_mg': 1e3 * held_out.sample_noise_mps2(fitted) / G0_MPS2,
        'budget': assessment.accel if assessment and errors else None,
        'part_colours': _PART_COLOURS,
        'gum': gum.section(gum.uncertainty(result, stated)),
        'history': history.table() if history.sensors else None,
        'changes': history.changes() if history.sensors else '',
        'paper_model': paper_model,
        'pictures': pictures, 'pictures_fault': fault,
        'report_lines': result.report_lines,
        'provenance': [
            ['serial', fitted.serial], ['model', fitted.model],
            ['effects', ', '.join(fitted.effects)],
            *([key.replace('_', ' '), value] for key, value in fitted.provenance.items()),
            ['valid for temperatures', f'{temperature_c[0]:.1f} to {temperature_c[1]:.1f} °C'
             if temperature_c else 'not measured']]})


def _badge(fitted: Sensor) -> dict[str, str]:
    """Return the acceptance and its colour."""
    outcome, lines = acceptance.acceptance(fitted)
    sentence = '. '.join(line.rstrip('.') for line in lines)
    return {'colour': _COLOURS[outcome], 'word': outcome,
            'sentence': f'{sentence[0].upper()}{sentence[1:]}.'}


def _tiles(result: CalibrationResult, assessment: Assessment | None) -> list[dict[str, str]]:
    """Return tilt and acceleration error before and after, and what limits them."""
    tiles = []
    if (fit := result.gravity_fit) is not None:
        used = np.setdiff1d(np.arange(len(fit.before_mps2)), fit.outliers)
        before, after = (_digits(held_out.rms_mg(float(np.mean(v[used] ** 2))))
                         for v in (fit.before_mps2, fit.held_out_mps2))
        tiles = [{'label': 'error of the magnitude of gravity', 'text': f'{before} → {after} mg',
                  'note': f'rms over {len(used)} rests, held out'}]
    for label, unit, name in (('tilt error', '°', 'tilt_deg'),
                              ('acceleration error', 'mg', 'accel_mg')):
        statistics = [getattr(errors, name) for errors in result.held_out]
        if statistics and not np.isnan(statistics[-1].rms):
            before, after = (_digits(statistics[i].rms) for i in (0, -1))
            low, high = map(_digits, statistics[-1].interval)
            tiles.append({'label': label, 'text': f'{before} → {after} {unit}',
                          'note': f'rms on held-out poses, 90 %: {low} to {high} {unit}'})
    if assessment is not None:
        tiles.append({'label': 'limited by', 'text': assessment.limited_by,
                      'note': f'calibration error {_digits(assessment.error_mg)} mg, without '
                              'noise and stage error of the check'})
    return tiles


def _digits(value: float) -> str:
    """Write a positive value with three digits at most, without an exponent."""
    decimals = 1 if value >= 10 else 2 if value >= 1 else 3
    return f'{value:.{decimals}f}' if value >= 5e-4 else '< 0.001'


def _sphere(result: CalibrationResult) -> dict[str, Any]:
    """Return the data of the sphere's script: errors of each model by pose and quantity."""
    fitted, poses, fit = result.fitted, result.poses, result.gravity_fit
    if fit is not None:
        force = np.column_stack(signal_chain.inverse(fitted)(
            list(poses.volts.T), poses.environment))
        errors = {'nominal': 1e3 * fit.before_mps2[:, None] / G0_MPS2,
                  'gravity': 1e3 * fit.residual_mps2[:, None] / G0_MPS2}
        quantities = [['magnitude minus gravity', 'mg']]
        labels = [f'rest {i + 1}' for i in range(len(poses))]
    else:
        force = np.column_stack(reference_force(poses, fitted.local_gravity_mps2))
        units = {row.model: row.fitted[0] for row in result.held_out} | {fitted.model: fitted}
        errors = {}
        for model, unit in units.items():
            of_unit = held_out.pose_errors(unit, poses)
            errors[model] = np.column_stack([np.degrees(of_unit.tilt_rad),
                                             1e3 * of_unit.accel_mps2 / G0_MPS2])
        quantities = [['tilt error', '°'], *([f'error of {a}', 'mg'] for a in fitted.axes)]
        labels = [f'pose {i}, alpha {alpha:.1f}°, beta {beta:.1f}°' for i, (alpha, beta) in
                  enumerate(np.degrees([poses.alpha_rad, poses.beta_rad]).T, 1)]
    up = force / np.linalg.norm(force, axis=1, keepdims=True)
    return {'models': list(errors), 'quantities': quantities, 'poses': [
        {'u': [round(float(c), 5) for c in up[i]], 'label': label,
         'held_out': bool(poses.check[i]),
         'values': [list(map(_number, values[i])) for values in errors.values()]}
        for i, label in enumerate(labels)]}


def _number(value: float) -> float | None:
    return float(f'{value:.4g}') if np.isfinite(value) else None


def _coefficients(fitted: Sensor) -> list[dict[str, Any]]:
    """Return the coefficients with their intervals within the range of the datasheet."""
    half_widths = Z_90 * np.sqrt(np.diag(fitted.covariance))
    departures = get(fitted, fitted.covariance_names)
    rows = []
    for row, name, value, half_width in zip(
            compare(fitted, fitted), fitted.covariance_names, departures, half_widths):
        typical, maximum = fitted.datasheet.get(name.without_axis, (0.0, 0.0))
        largest = max(typical, maximum, abs(value) + half_width, 1e-12) * _BEYOND_WHISKER
        unit = '' if row.unit == '1' else f' {row.unit}'
        text = f'{rounded(row, row.fitted)} ± {rounded(row, row.half_width)}{unit}'
        # The lower end of the interval decides.
        lower = abs(value) - half_width
        beyond = '' if not (typical or maximum) else _BEYOND if 0 < maximum < lower else \
            'beyond typical' if 0 < typical < lower else 'within'
        factor = float(np.degrees(1.0)) if row.unit == '°' else 1.0
        ranges = [f'{word} ±{factor * figure:.2g}' for word, figure in (
            ('typical', typical), ('maximum', maximum)) if figure]
        rows.append({
            'label': f'{row.label} {row.axis}', 'name': str(name), 'text': text,
            'datasheet': ', '.join(ranges) or '-', 'outcome': beyond,
            'mark': figures.whisker(
                value, value - half_width, value + half_width, (-largest, largest), text,
                typical or maximum, beyond.startswith('beyond'))})
    return rows


def _paper_figures(result: CalibrationResult) -> tuple[list[str], str, str]:
    """Return the figures of the paper as URLs, else why there are none, and their model."""
    try:
        unit = _paper_sensor(result)
        return [html_page.picture_url(_sweep(result.nominal, unit, result.poses, pair))
                for pair in _PANELS], '', unit.model
    except UserError as error:
        return [], str(error), 'physical'


def _error_figure(used: np.ndarray, errors_mg: np.ndarray, half_mg: np.ndarray, names: str,
                  x_label: str, y_label: str) -> Figure:
    """Draw the held-out errors, (k, m), of the poses used with bars of the expected 90 %."""
    traces = [figures.points(np.flatnonzero(used) + 1, errors_mg[used, d], half_mg[used], name,
                             AXIS_COLOURS[name[0]]) for d, name in enumerate(names)]
    return figures.figure(traces, 320, margin={'l': 8, 'r': 12, 't': 36, 'b': 8},
                          xaxis={'title': {'text': x_label}}, yaxis={'title': {'text': y_label}})


_FINE_G = np.linspace(-1, 1, 201)
"""Specific force at which curves are drawn, g."""
_VERTICAL = np.sin(np.radians(89))
"""Smallest sine of alpha in the plane alpha = 90°; chosen: stages are better than 1°."""


def draw_sweep(path: str | os.PathLike, sensor: Sensor, fitted: Sensor, poses: Poses) -> None:
    """Write figures 2 to 8 of the paper as PNG."""
    write_bytes(path, figures.png(_sweep(sensor, fitted, poses)))


def _sweep(sensor: Sensor, fitted: Sensor, poses: Poses, panels: Sequence[int] = range(6)) -> Any:
    """Draw figures 2 to 8 of the paper for the x and y axes, one row per axis."""
    swept = poses.subset(~poses.check)
    line, regressions = linear.fit(sensor, swept), linear.regress_axes(sensor, swept)
    reference = reference_force(swept, sensor.local_gravity_mps2)
    force_g = np.column_stack(reference) / G0_MPS2
    predicted = np.column_stack(signal_chain.static_response(fitted)(
        reference, swept.environment))
    figure, grid = figures.pyplot().subplots(
        2, len(panels), figsize=(4.4 * len(panels), 9), layout='constrained', squeeze=False)
    for d, row in enumerate(grid):
        linear_v = line.zero_g_v[d] + line.scale_v_per_g[d] * force_g[:, d]
        deviation_mv, model_mv = (1e3 * (volts[:, d] - linear_v)
                                  for volts in (swept.volts, predicted))
        for axis, panel in zip(row, panels):
            _draw_panel(axis, panel, d, fitted.model, swept, force_g, deviation_mv, model_mv,
                        regressions[d])
    if len(panels) > 4:
        figure.suptitle(f'{fitted.serial}: deviation from the linear model, measured and by the '
                        f'{fitted.model} model (Ang et al. 2007, figures 2 to 8)')
    return figure


def _draw_panel(axis: Any, panel: int, d: int, model: str, poses: Poses, force_g: np.ndarray,
                deviation_mv: np.ndarray, model_mv: np.ndarray, regression: linear.AxisRegression
                ) -> None:
    """
    Draw one panel for the axis x or y, given by d: figures 2, 3, 4, 5 with 7, 6, or 8.

    force_g, deviation_mv, model_mv: reference of k poses, g, (k, 3), and measured and modelled
    output minus the linear model, mV, (k,).
    """
    vertical = np.abs(np.sin(poses.alpha_rad)) > _VERTICAL
    name, other = ('x', 'y') if d == 0 else ('y', 'x')
    along_g, x_label = force_g[:, d], f'{name} reference, g'
    if panel in (0, 1, 3):
        y_label = f'{name} output minus linear, mV'
        title = f'figs. 5, 7: measured ● and {model} model ─' if panel == 3 else \
            f'fig. {panel + 2}: paths, forth ● and back ◁'
        backward = np.gradient(poses.beta_rad) < 0
        chosen = np.flatnonzero(vertical | (panel > 0))
        for plane in planes(poses.alpha_rad[chosen]):
            index = chosen[np.sort(plane)]
            label = f'{np.degrees(poses.alpha_rad[index]).mean():.0f}°'
            if panel == 3:
                line, = axis.plot(along_g[index], deviation_mv[index], 'o', ms=3, label=label)
                axis.plot(along_g[index], model_mv[index], lw=1, color=line.get_color())
                continue
            line, = axis.plot(along_g[index], deviation_mv[index], lw=1, label=label)
            for part, marker, fill in ((index[~backward[index]], 'o', None),
                                       (index[backward[index]], '<', 'none')):
                axis.plot(along_g[part], deviation_mv[part], marker, ms=4,
                          color=line.get_color(), mfc=fill)
        axis.legend(title='alpha', fontsize=7)
    elif panel == 2:
        axis.plot(force_g[vertical, 1 - d], deviation_mv[vertical], 'o', ms=4,
                  label='measured (10)')
        axis.plot(_FINE_G, 1e3 * np.polynomial.polynomial.polyval(_FINE_G, regression.p),
                  label='quadratic (11)')
        axis.legend(fontsize=7)
        x_label, y_label = f'{other} reference, g', f'{name} residual, mV'
        title = f'fig. 4: residual against {other}, alpha = 90°'
    else:
        values, polynomial = (1e3 * regression.plane_bias_v, 1e3 * regression.q) \
            if panel == 4 else (regression.plane_scale_v_per_g, regression.r)
        az_g = regression.plane_az_g
        fine_g = np.linspace(az_g.min(), az_g.max(), 101)
        axis.plot(az_g, values, 'o', ms=4)
        axis.plot(fine_g, np.polynomial.polynomial.polyval(fine_g, polynomial))
        x_label = 'z reference, g'
        y_label, title = (f'{name} zero-g minus that at 90°, mV',
                          'fig. 6: zero-g against z (12, 13)') if panel == 4 else \
            (f'{name} scale factor, V/g', 'fig. 8: scale factor against z (15, 17)')
    axis.set(xlabel=x_label, ylabel=y_label, title=title)
