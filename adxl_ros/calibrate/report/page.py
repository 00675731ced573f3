# SPDX-License-Identifier: Apache-2.0

"""The page of a calibration, one file that opens offline, and the figures of the paper."""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum
from pathlib import Path
import re
from typing import Any, NamedTuple

from adxl_ros.calibrate.fits import linear
from adxl_ros.calibrate.pose_model import reference_force
from adxl_ros.calibrate.poses import planes, Poses
from adxl_ros.calibrate.report import acceptance, gum, held_out
from adxl_ros.calibrate.report.acceptance import FAIL, NOT_SHOWN, PASS
from adxl_ros.calibrate.report.error_budget import rms_mg
from adxl_ros.calibrate.result import CalibrationResult, compare, history, rounded
from adxl_ros.errors import UserError
from adxl_ros.files import calibration_store, parameter_file
from adxl_ros.files.atomic_write import AnyPath, write_text
from adxl_ros.model import signal_chain
from adxl_ros.model.constants import G0_MPS2, Z_90
from adxl_ros.model.error_sizes import rms, stds
from adxl_ros.model.kinematics import unit_vectors
from adxl_ros.model.sensor import get, Sensor
from adxl_ros.process import command
from adxl_ros.report import figures, page as html_page
from adxl_ros.report.figures import AXIS_COLOURS, Figure, Whisker
from adxl_ros.report.quantities import mg, three_digits
from adxl_ros.report.screen import Tile
import numpy as np

PAGE = 'report.html'  # The file of a report
_COLOURS = {PASS: 'green', NOT_SHOWN: 'amber', FAIL: 'red'}  # Colour of the badge by outcome
_PART_COLOURS = {
    'noise': '#7b8794',
    'stage': '#d9930d',
    'coefficients': '#1f5fbf',
    'model': '#c0392b',
}
"""Colours of the parts of the error budget."""
_BEYOND_WHISKER = 1.08
"""Half of a whisker's range divided by the largest value in it. Chosen: no dot is cut."""
_VERTICAL = np.sin(np.radians(89))
"""Smallest sine of alpha in the plane alpha = 90°; chosen: stages are better than 1°."""


def write(folder: AnyPath, result: CalibrationResult, store: AnyPath = '') -> None:
    """Write the page."""
    html_page.check_libraries()
    past = (
        calibration_store.history(store, result.fitted.serial).calibrations if str(store) else []
    )
    write_text(Path(folder) / PAGE, page(result, [sensor for _, sensor in past]))


def paper_figure(result: CalibrationResult) -> Any:
    """Draw figures 2 to 8 of the paper for a sensor, by its model or at least the physical one."""
    if result.gravity_fit is not None:
        raise UserError('they need the angles of a stage')
    sensor = (
        result.fitted
        if result.fitted.model in ('physical', 'full')
        else linear.fit_physical(result.nominal, result.poses.subset(~result.poses.check))
    )
    return draw_sweep(result.nominal, sensor, result.poses)


def page(result: CalibrationResult, past: Sequence[Sensor]) -> str:
    """Lay out the page."""
    fitted = result.fitted
    limit_mps2, origin = acceptance.limit(fitted)
    file_name = re.sub(r'[^\w.-]+', '_', fitted.serial) + '.yaml'
    return html_page.render(
        'adxl_ros.calibrate.report',
        'calibration.html',
        {
            'result': result,
            'fitted': fitted,
            'badge': badge(fitted),
            'tiles': tiles(result),
            'limits': acceptance.LIMITS,
            'file_name': file_name,
            'apply_command': command('apply', f'RECORDING --params {file_name} -o tilt.csv'),
            'download': html_page.download_url(parameter_file.as_text(fitted, result.comments())),
            'figures': _figures(result),
            'sphere': _sphere(result),
            'coefficients': _coefficients(fitted),
            'errors_of': {errors.model: errors for errors in result.held_out},
            'row_of': {row.model: row for row in result.assessments},
            'digits': three_digits,
            'mg': rms_mg,
            'limit': f'{origin} ({mg(limit_mps2):.2g} mg)',
            'part_colours': _PART_COLOURS,
            'gum': gum.section(gum.uncertainty(result)),
            'history': history(fitted, past),
            'picture': _paper_picture(result),
            'provenance': [
                [key.replace('_', ' '), value] for key, value in fitted.provenance.items()
            ],
        },
    )


class _Picture(NamedTuple):
    """The figures of the paper, or why they cannot be drawn; the other one is ''."""

    url: str
    fault: str = ''


def _paper_picture(result: CalibrationResult) -> _Picture:
    try:
        return _Picture(html_page.picture_url(paper_figure(result)))
    except UserError as error:
        return _Picture('', str(error))


def _figures(result: CalibrationResult) -> dict[str, Figure]:
    """Draw the errors of the poses that the fit has not seen; nothing without such poses."""
    if (fit := result.gravity_fit) is not None:
        errors = _error_figure(
            result.inliers,
            mg(fit.held_out_mps2[:, None]),
            Z_90 * mg(fit.expected_mps2),
            'x',
            'rest',
            'magnitude minus gravity, mg',
        )
    elif result.held_out and result.assessments:
        held = result.held_out[-1]
        expected_mg = rms_mg(result.assessments[-1].accel.expected)
        errors = _error_figure(
            held_out.determining_alpha(held.pose_errors),
            mg(held.pose_errors.accel_mps2),
            np.full(held.pose_count, Z_90 * expected_mg),
            result.fitted.axes,
            'held-out pose',
            'error of acceleration, mg',
        )
    else:
        return {}
    return {'errors': errors}


def badge(fitted: Sensor) -> dict[str, str]:
    """Return the acceptance and its colour."""
    accepted = acceptance.acceptance(fitted)
    sentence = '. '.join(line.rstrip('.') for line in accepted.lines)
    return {
        'colour': _COLOURS[accepted.outcome],
        'word': accepted.outcome,
        'sentence': f'{sentence[0].upper()}{sentence[1:]}.',
    }


def tiles(result: CalibrationResult) -> list[Tile]:
    """Return tilt and acceleration error before and after, and what limits them."""
    found = []
    if (fit := result.gravity_fit) is not None:
        used = np.setdiff1d(np.arange(len(fit.before_mps2)), fit.outliers)
        before = three_digits(mg(rms(fit.before_mps2[used])))
        after = three_digits(mg(rms(fit.held_out_mps2[used])))
        found = [
            Tile(
                'error of the magnitude of gravity',
                f'{before} → {after} mg',
                f'rms over {len(used)} rests, held out',
            )
        ]
    for label, unit, name in (
        ('tilt error', '°', 'tilt_deg'),
        ('acceleration error', 'mg', 'accel_mg'),
    ):
        statistics = [getattr(errors, name) for errors in result.held_out]
        if statistics and not np.isnan(statistics[-1].rms):
            before = three_digits(statistics[0].rms)
            after = three_digits(statistics[-1].rms)
            low, high = map(three_digits, statistics[-1].interval)
            found.append(
                Tile(
                    label,
                    f'{before} → {after} {unit}',
                    f'rms on held-out poses, 90 %: {low} to {high} {unit}',
                )
            )
    if result.assessments:
        assessment = result.assessments[-1]
        found.append(
            Tile(
                'limited by',
                assessment.accel.limited_by,
                f'calibration error {three_digits(assessment.error_mg)} mg, without '
                'noise and stage error of the check',
            )
        )
    return found


def _sphere(result: CalibrationResult) -> dict[str, Any]:
    """Return the data of the sphere's script: errors of each model by pose and quantity."""
    fitted = result.fitted
    poses = result.poses
    fit = result.gravity_fit
    if fit is not None:
        force = np.column_stack(
            signal_chain.inverse(fitted)(list(poses.volts.T), poses.environment)
        )
        errors = {
            'nominal': mg(fit.before_mps2[:, None]),
            'gravity': mg(fit.residual_mps2[:, None]),
        }
        quantities = [['magnitude minus gravity', 'mg']]
        labels = [f'rest {i + 1}' for i in range(len(poses))]
    else:
        force = np.column_stack(reference_force(poses, fitted.local_gravity_mps2))
        sensors = {row.model: row.fitted[0] for row in result.held_out} | {fitted.model: fitted}
        errors = {}
        for model, sensor in sensors.items():
            of_unit = held_out.pose_errors(sensor, poses)
            errors[model] = np.column_stack([np.degrees(of_unit.tilt_rad), mg(of_unit.accel_mps2)])
        quantities = [['tilt error', '°'], *([f'error of {a}', 'mg'] for a in fitted.axes)]
        labels = [
            f'pose {i}, alpha {alpha:.1f}°, beta {beta:.1f}°'
            for i, (alpha, beta) in enumerate(np.degrees([poses.alpha_rad, poses.beta_rad]).T, 1)
        ]
    up = unit_vectors(force)
    values = np.stack(list(errors.values()), axis=1)
    return {
        'models': list(errors),
        'quantities': quantities,
        'poses': [
            {
                'u': np.round(up[i], 5).tolist(),
                'label': label,
                'held_out': bool(poses.check[i]),
                'values': [
                    [float(f'{v:.4g}') if np.isfinite(v) else None for v in of_model]
                    for of_model in values[i]
                ],
            }
            for i, label in enumerate(labels)
        ],
    }


class _Outcome(Enum):
    """A coefficient's whole interval against its range by the datasheet; texts for people."""

    NO_RANGE = ''
    WITHIN = 'within'
    BEYOND_TYPICAL = 'beyond typical'
    BEYOND_MAXIMUM = 'beyond the maximum'

    @classmethod
    def of(cls, least: float, typical: float, maximum: float) -> _Outcome:
        """Compare the least magnitude in an interval with figures, 0 where none is stated."""
        if 0 < maximum < least:
            return cls.BEYOND_MAXIMUM
        if 0 < typical < least:
            return cls.BEYOND_TYPICAL
        return cls.WITHIN if typical or maximum else cls.NO_RANGE

    @property
    def is_beyond(self) -> bool:
        """Return whether it is beyond a figure."""
        return self in (_Outcome.BEYOND_TYPICAL, _Outcome.BEYOND_MAXIMUM)


class _Row(NamedTuple):
    """A coefficient on the page."""

    label: str  # In words
    name: str
    text: str  # Its value with the interval and the unit
    datasheet: str  # Its ranges by the datasheet
    outcome: _Outcome
    mark: Whisker


def _coefficients(fitted: Sensor) -> list[_Row]:
    """Return the coefficients with their intervals within the range of the datasheet."""
    half_widths = Z_90 * stds(fitted.covariance)
    departures = get(fitted, fitted.covariance_names)
    rows = []
    for row, name, value, half_width in zip(
        compare(fitted, fitted), fitted.covariance_names, departures, half_widths
    ):
        typical, maximum = fitted.datasheet.get(name.without_axis, (0.0, 0.0))
        outcome = _Outcome.of(abs(value) - half_width, typical, maximum)
        largest = max(typical, maximum, abs(value) + half_width, 1e-12) * _BEYOND_WHISKER
        unit = '' if row.unit == '1' else f' {row.unit}'
        text = f'{rounded(row, row.fitted)} ± {rounded(row, row.half_width)}{unit}'
        factor = float(np.degrees(1.0)) if row.unit == '°' else 1.0
        ranges = [
            f'{word} ±{factor * figure:.2g}'
            for word, figure in (('typical', typical), ('maximum', maximum))
            if figure
        ]
        mark = figures.whisker(
            value,
            value - half_width,
            value + half_width,
            (-largest, largest),
            text,
            typical or maximum,
            outcome.is_beyond,
        )
        label = f'{row.label} {row.axis}'
        rows.append(_Row(label, str(name), text, ', '.join(ranges) or '-', outcome, mark))
    return rows


def _error_figure(
    used: np.ndarray,
    errors_mg: np.ndarray,
    half_mg: np.ndarray,
    names: str,
    x_label: str,
    y_label: str,
) -> Figure:
    """Draw the held-out errors, (k, m), of the poses used with bars of the expected 90 %."""
    traces = [
        figures.points(
            np.flatnonzero(used) + 1,
            errors_mg[used, d],
            half_mg[used],
            name,
            AXIS_COLOURS[name[0]],
        )
        for d, name in enumerate(names)
    ]
    return figures.figure(
        traces,
        320,
        margin={'l': 8, 'r': 12, 't': 36, 'b': 8},
        xaxis={'title': {'text': x_label}},
        yaxis={'title': {'text': y_label}},
    )


def draw_sweep(sensor: Sensor, fitted: Sensor, poses: Poses) -> Any:
    """Draw figures 2 to 8 of the paper for the x and y axes, one row per axis."""
    swept = poses.subset(~poses.check)
    line = linear.fit(sensor, swept)
    regressions = linear.regress_axes(sensor, swept)
    reference = reference_force(swept, sensor.local_gravity_mps2)
    force_g = np.column_stack(reference) / G0_MPS2
    predicted = np.column_stack(signal_chain.static_response(fitted)(reference, swept.environment))
    figure = figures.new_figure(figsize=(17.6, 9))
    grid = figure.subplots(2, 4)
    vertical = np.abs(np.sin(swept.alpha_rad)) > _VERTICAL
    for d, (row, regression) in enumerate(zip(grid, regressions)):
        linear_v = line.zero_g_v[d] + line.scale_v_per_g[d] * force_g[:, d]
        deviation_mv = 1e3 * (swept.volts[:, d] - linear_v)
        model_mv = 1e3 * (predicted[:, d] - linear_v)
        name, other = ('x', 'y') if d == 0 else ('y', 'x')
        row[0].set(
            title='figs. 2, 3, 5, 7: forth ●, back ◁, model ─',
            xlabel=f'{name} reference, g',
            ylabel=f'{name} output minus linear, mV',
        )
        _draw_planes(row[0], swept, force_g[:, d], deviation_mv, model_mv)
        row[1].set(
            title=f'fig. 4: residual against {other} (10, 11)',
            xlabel=f'{other} reference, g',
            ylabel=f'{name} residual, mV',
        )
        _draw_regression(
            row[1], force_g[vertical, 1 - d], deviation_mv[vertical], 1e3 * regression.p
        )
        az_g = regression.plane_az_g
        row[2].set(
            title='fig. 6: zero-g against z (12, 13)',
            xlabel='z reference, g',
            ylabel=f'{name} zero-g minus that at 90°, mV',
        )
        _draw_regression(row[2], az_g, 1e3 * regression.plane_bias_v, 1e3 * regression.q)
        row[3].set(
            title='fig. 8: scale factor against z (15, 17)',
            xlabel='z reference, g',
            ylabel=f'{name} scale factor, V/g',
        )
        _draw_regression(row[3], az_g, regression.plane_scale_v_per_g, regression.r)
    figure.suptitle(
        f'{fitted.serial}: deviation from the linear model, measured and by the '
        f'{fitted.model} model (Ang et al. 2007, figures 2 to 8)'
    )
    return figure


def _draw_planes(
    plot: Any, swept: Poses, force_g: np.ndarray, measured_mv: np.ndarray, model_mv: np.ndarray
) -> None:
    """Draw what an output departs from a line over its force, (k,), in a colour by plane."""
    is_back = np.gradient(swept.beta_rad) < 0
    for plane in map(np.sort, planes(swept.alpha_rad)):
        alpha_deg = np.degrees(swept.alpha_rad[plane]).mean()
        (curve,) = plot.plot(force_g[plane], model_mv[plane], lw=1, label=f'{alpha_deg:.0f}°')
        style = {'ms': 3, 'color': curve.get_color()}
        forth, back = plane[~is_back[plane]], plane[is_back[plane]]
        plot.plot(force_g[forth], measured_mv[forth], 'o', **style)
        plot.plot(force_g[back], measured_mv[back], '<', mfc='none', **style)
    plot.legend(title='alpha', fontsize=7)


def _draw_regression(plot: Any, x: np.ndarray, y: np.ndarray, coefficients: np.ndarray) -> None:
    """Draw points, (n,), and a polynomial, its lowest power first."""
    fine = np.linspace(x.min(), x.max(), 101)
    plot.plot(x, y, 'o', ms=4)
    plot.plot(fine, np.polynomial.polynomial.polyval(fine, coefficients))
