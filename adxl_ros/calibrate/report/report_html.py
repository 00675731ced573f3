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

"""The page of a calibration: one file that opens offline."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from importlib.resources import files
import os
from pathlib import Path
from typing import Any, TYPE_CHECKING

from adxl_ros.calibrate.poses import reference_force
from adxl_ros.calibrate.report import cross_validation, drift_history, plots
from adxl_ros.calibrate.report.acceptance import beyond_datasheet, FAIL, Judged, NOT_SHOWN, PASS
from adxl_ros.errors import UserError
from adxl_ros.files import html_page
from adxl_ros.files.atomic_write import atomic_path
from adxl_ros.files.plot_file import pyplot
from adxl_ros.model import signal_chain
from adxl_ros.model.coefficients import get, parameter_of
from adxl_ros.model.constants import G0_MPS2, Z_90
from adxl_ros.model.sensor import Sensor
import numpy as np

if TYPE_CHECKING:
    from adxl_ros.calibrate.calibration import CalibrationResult

_PANELS = ((0, 1), (2, 3), (4, 5))
"""Figures of the paper that stand beside each other on a page."""


def write(path: str | os.PathLike, result: CalibrationResult,
          past: Sequence[tuple[Path, Sensor]]) -> None:
    """
    Write the page, whole or not at all.

    Parameters
    ----------
    path
        The file.
    result
        What was found.
    past
        Calibrations of the unit in the store, oldest first.

    Raises
    ------
    UserError
        matplotlib is not installed, or the file cannot be written.

    """
    fitted = result.fitted
    title = f'Calibration of {fitted.serial}, {fitted.provenance["date"][:10]}'
    earlier = drift_history.Past.of(fitted, [sensor for _, sensor in past])
    parts = [f'<h1>{escape(title)}</h1>', _said(result), '<h2>Verdict</h2>', _verdict(result),
             '<h2>Residuals over the sphere of poses</h2>', _sphere(result),
             '<h2>Coefficients</h2>', _coefficients(fitted),
             '<h2>History of this unit</h2>', _history(earlier, fitted),
             '<h2>Figures</h2>', *_figures(result),
             '<h2>In words</h2>', f'<pre>{escape(chr(10).join(result.report_lines))}</pre>',
             '<h2>Provenance</h2>', _provenance(fitted),
             html_page.script(
                 (files('adxl_ros.calibrate.report') / 'sphere.js').read_text('utf-8'))]
    with atomic_path(path) as fresh:
        fresh.write_text(html_page.document(title, parts), encoding='utf-8')


def _said(result: CalibrationResult) -> str:
    """Say in a few lines whether it is good, and what limits it."""
    fitted = result.fitted
    own = next((one for one in result.assessments if one.model == fitted.model), None)
    if own is None:
        return ('<p class="said open">Too few poses were held out to judge this calibration. Take '
                'more.</p>')
    beyond = beyond_datasheet(fitted)
    outcomes = {"its error against the datasheet's linearity": own.datasheet,
                'its error against the noise': own.noise,
                'its tilt against what those make of it': ', '.join(filter(
                    None, (own.tilt_datasheet, own.tilt_noise))),
                'the unit against the datasheet': (FAIL if beyond else PASS)
                if fitted.datasheet else ''}
    said = ' '.join(outcomes.values())
    kind = 'bad' if FAIL in said else 'open' if NOT_SHOWN in said else 'good'
    score = next((s for s in result.held_out if s.model == fitted.model), None)
    lines = ['; '.join(f'{name}: {text}' for name, text in outcomes.items() if text) + '.']
    lines[0] = lines[0][0].upper() + lines[0][1:]
    if score is not None:
        tilt = '' if np.isnan(score.tilt_rms_deg) else \
            f'{_with(score.tilt_rms_deg, score.intervals["tilt"])} deg of tilt and '
        lines.append(f'On {score.poses} poses held out the {fitted.model} model errs by {tilt}'
                     f'{_with(score.accel_rms_mg, score.intervals["accel"])} mg rms (90 %).')
    lines.append('By itself, noise and stage of the check taken out, it errs by '
                 f'{own.own_mg:.3g} mg' + ('' if np.isnan(own.own_deg) else
                                           f' and {own.own_deg:.2g} deg of tilt')
                 + f'. What limits it: {own.limit}.')
    lines += [f'Beyond the datasheet: {one}.' for one in beyond]
    return f'<p class="said {kind}">' + '<br>'.join(map(escape, lines)) + '</p>'


def _with(rms: float, ends: tuple[float, float]) -> str:
    return f'{rms:.3g} ({ends[0]:.2g} to {ends[1]:.2g})'


def _verdict(result: CalibrationResult) -> str:
    of: dict[str, Judged] = {one.model: one for one in result.assessments}
    rows = []
    for score in result.held_out:
        own = of.get(score.model)
        rows.append([score.model, str(score.poses), *(
            '-' if np.isnan(rms) else f'{_with(rms, score.intervals[name])}, max {most:.3g}'
            for name, rms, most in (
                ('tilt', score.tilt_rms_deg, score.tilt_max_deg),
                ('alpha', score.alpha_rms_deg, score.alpha_max_deg),
                ('beta', score.beta_rms_deg, score.beta_max_deg),
                ('accel', score.accel_rms_mg, score.accel_max_mg))),
            *(_judged(own) if own else ['-'] * 4)])
    if not rows:
        return f'<pre>{escape(chr(10).join(result.report_lines))}</pre>'
    return html_page.table(['model', 'poses', 'tilt, deg', 'alpha, deg', 'beta, deg',
                            'acceleration, mg', 'own, mg', 'datasheet', 'noise', 'limited by'],
                           rows) + (
        '<p>rms with its 90 % interval, errors of neighbouring poses not taken as independent; '
        'own: noise and stage of the check taken out; against datasheet and noise: acceleration, '
        'then tilt.</p>')


def _judged(own: Judged) -> list[str]:
    return [f'{own.own_mg:.3g}', *(', '.join(filter(None, said)) or '-' for said in (
        (own.datasheet, own.tilt_datasheet), (own.noise, own.tilt_noise))), own.limit]


def _sphere(result: CalibrationResult) -> str:
    poses, fitted = result.poses, result.fitted
    if result.gravity_fit is not None:
        force = np.column_stack(
            signal_chain.inverse(fitted)(list(poses.volts.T), poses.environment))
        models, quantities = ['nominal', 'gravity'], [['magnitude less gravity', 'mg']]
        values = [np.column_stack([1e3 * one / G0_MPS2]) for one in (
            result.gravity_fit.before_mps2, result.gravity_fit.residual_mps2)]
        says = [f'rest {i + 1}' for i in range(len(poses))]
    else:
        force = np.column_stack(reference_force(poses, fitted.local_gravity_mps2))
        units = {s.model: s.fitted[0] for s in result.held_out} | {fitted.model: fitted}
        models = list(units)
        quantities = [['error of tilt', 'deg'], *([f'error of {a}', 'mg'] for a in fitted.axes)]
        values = []
        for unit in units.values():
            of = cross_validation.errors(unit, poses)
            values.append(np.column_stack([np.degrees(of.tilt_rad),
                                           1e3 * of.accel_mps2 / G0_MPS2]))
        says = [f'pose {i + 1}, alpha {np.degrees(a):.1f}, beta {np.degrees(b):.1f} deg'
                for i, (a, b) in enumerate(zip(poses.alpha_rad, poses.beta_rad))]
    up = force / np.linalg.norm(force, axis=1, keepdims=True)
    found = {'models': models, 'quantities': quantities, 'poses': [
        {'u': [round(float(c), 5) for c in up[i]], 'says': says[i],
         'held': bool(poses.check[i]),
         'values': [[_number(v) for v in of[i]] for of in values]} for i in range(len(poses))]}
    return (html_page.data('sphere-data', found)
            + '<figure><p class="screen"><label>model <select id="sphere-model"></select></label> '
            '<label>shows <select id="sphere-quantity"></select></label></p><canvas id="sphere" '
            'width="900" height="520" style="width:900px;aspect-ratio:900/520;touch-action:none;'
            'cursor:grab" tabindex="0" role="img" aria-label="residuals over the sphere of '
            'poses"></canvas><figcaption id="sphere-about">Drag to turn, wheel to zoom, point at '
            'a pose.</figcaption></figure><p>Each point is the direction of the vertical in the '
            'case of the sensor; its colour is the error of the model at that pose.</p>')


def _number(value: float) -> float | None:
    return float(f'{value:.4g}') if np.isfinite(value) else None


def _coefficients(fitted: Sensor) -> str:
    std = np.sqrt(np.diag(fitted.covariance))
    rows = []
    for name, value, s in zip(fitted.covariance_names, get(fitted, fitted.covariance_names), std):
        half = Z_90 * s
        typical, most = fitted.datasheet.get(name.without_axis, (0.0, 0.0))
        place = '' if not (typical or most) else 'beyond the maximum' if most and \
            abs(value) - half > most else 'beyond typical' if typical and \
            abs(value) - half > typical else 'within'
        rows.append([str(name), f'{value:.5g}', f'{value - half:.5g} to {value + half:.5g}',
                     f'{typical:g}' if typical else '-', f'{most:g}' if most else '-',
                     parameter_of(name).unit, place])
    absolute = [[f'{name} {axis}', f'{value:.6g}', '', f'nominal {nominal:g}', '', unit, '']
                for name, values, of, unit in (
                    ('zero-g', fitted.zero_g_v, fitted.nominal_zero_g_v, 'V'),
                    ('scale factor', fitted.scale_v_per_g, fitted.nominal_scale_v_per_g, 'V/g'))
                for axis, value, nominal in zip(fitted.axes, values, of)]
    source = escape(fitted.datasheet_name) or 'none in the parameter file'
    return html_page.table(['coefficient', 'value', '90 % interval', 'typical ±', 'maximum ±',
                            'unit', 'datasheet'], absolute + rows) + (
        f'<p>Below zero-g and scale factor: departures from nominal. Datasheet: {source}.</p>')


def _history(earlier: drift_history.Past, fitted: Sensor) -> str:
    if not earlier.sensors:
        return '<p>No earlier calibration of this unit is in the store.</p>'
    head, rows = earlier.table()
    parts = [html_page.table(head, rows), *(f'<p>{escape(line)}</p>' for line in earlier.words())]
    parts.append(_picture(plots.drift(*earlier.series()), 'drift of zero-g and scale factor'))
    return ''.join(parts)


def _figures(result: CalibrationResult) -> list[str]:
    if result.gravity_fit is not None:
        return [_picture(plots.gravity_rests(result.name, result.gravity_fit),
                         'magnitude of gravity over the rests')]
    sound = result.poses.subset(result.inliers)
    found = ['<p>Errors of tilt on poses held out, as in figure 10 of Ang, Khosla and Riviere '
             '(2007); figures 2 to 8 for this unit: deviation from the linear model, and what '
             'the physical model makes of it.</p>']
    if result.held_out:
        found.append(_picture(plots.held_out(result.held_out, sound), 'errors on poses held out'))
    try:
        return found + [_picture(
            plots.sweep(result.nominal, result.paper_sensor, result.poses, two),
            'figures 2 to 8 of the paper') for two in _PANELS]
    except UserError as error:
        return [*found, f'<p>Figures 2 to 8 of the paper cannot be drawn: {escape(str(error))}'
                '</p>']


def _picture(figure: Any, about: str) -> str:
    shown = html_page.picture(figure, about)
    pyplot().close(figure)
    return shown


def _provenance(fitted: Sensor) -> str:
    low_high = fitted.envelope.temperature_c
    rows = [['serial', fitted.serial], ['model', fitted.model], ['effects', ', '.join(
        fitted.effects)], *([key.replace('_', ' '), value]
                            for key, value in fitted.provenance.items()),
            ['holds for temperatures', f'{low_high[0]:.1f} to {low_high[1]:.1f} degC'
             if low_high else 'not measured']]
    return html_page.table(['', ''], rows)
