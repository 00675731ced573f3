# SPDX-License-Identifier: Apache-2.0
"""Repeat the paper's experiments on simulated units, or its calibration on recordings."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any

from adxl_ros.calibrate import calibration
from adxl_ros.calibrate.recorded_poses import extract_poses
from adxl_ros.calibrate.report import acceptance, page as unit_page
from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file
from adxl_ros.files.atomic_write import make_folder, write_bytes, write_text
from adxl_ros.files.recording_columns import recorded_nominal
from adxl_ros.model import signal_chain
from adxl_ros.model.constants import G0_MPS2, Z_90
from adxl_ros.model.sensor import Sensor
from adxl_ros.process import command, package_version
from adxl_ros.report.figures import new_figure, png
from adxl_ros.tools import command_line as cli
from adxl_ros_validation import coverage, experiments
from adxl_ros_validation.blind.report import filled, markdown_table, terminal_table
from adxl_ros_validation.experiments import MODELS, RUNS, Unit
import numpy as np
import pandas as pd


def parser() -> argparse.ArgumentParser:
    """Describe the command line."""
    parse = cli.argument_parser(
        'reproduce',
        __doc__,
        {
            'the experiments on 20 simulated units': '-o reproduction',
            'the calibration of the paper on a recorded sweep': 'sweep.csv -o reproduction',
        },
    )
    parse.add_argument(
        'recording', nargs='*', help='sweeps of one unit; without any, units are simulated'
    )
    parse.add_argument(
        '--params',
        metavar='FILE',
        default=None,
        help='values about which units are drawn, or one unit with its effects '
        '(default: the nominal sensor)',
    )
    parse.add_argument('--seed', type=int, default=0, help='seed of the units (default 0)')
    parse.add_argument('--units', type=int, default=20, help='units that are drawn (default 20)')
    parse.add_argument(
        '--draws',
        type=int,
        default=0,
        help='further units and stages that check the intervals '
        '(default: none; 300 take about a minute on two cores)',
    )
    parse.add_argument(
        '-o', dest='output', metavar='DIR', required=True, help='reproduction.md and its plots'
    )
    return parse


def reproduce(options: argparse.Namespace) -> int:
    """Run the tool; see `parser`."""
    cli.check_least(options, draws=0, seed=0, units=0 if options.draws else 1)
    sensor = parameter_file.load(options.params or parameter_file.nominal_path())
    folder = Path(options.output)
    page, screen = (
        _of_recordings(sensor, options.recording, folder)
        if options.recording
        else _simulated(sensor, options, folder)
    )
    make_folder(folder)
    write_text(folder / 'reproduction.md', page)
    further = cli.quoted(f'{folder}_coverage')
    cli.print_end(
        [*screen, ''],
        [folder / 'reproduction.md', folder / FIGURES],
        '' if options.draws else command('reproduce', f'--draws 300 --units 0 -o {further}'),
    )
    return 0


_Reproduction = tuple[str, list[str]]
"""The page, Markdown, and the most important of it as lines for a terminal."""


def _of_recordings(sensor: Sensor, paths: Sequence[str], folder: Path) -> _Reproduction:
    """Calibrate from recordings."""
    unit, recordings = sensor, []
    for path in paths:
        read = cli.read('reproduce', path)
        unit = recorded_nominal(unit, read)
        recordings.append(calibration.RecordedPoses(Path(path).name, extract_poses(read, unit)))
    result = calibration.calibrate(unit, recordings, 'full')
    make_folder(folder / FIGURES)
    write_bytes(folder / FIGURES / 'sweep.png', png(unit_page.paper_figure(result)))
    lines = '\n'.join(result.comments())
    paper = f'The paper: alpha {in_words("alpha")}; beta {in_words("beta")}.'
    page = (
        f"# The paper's calibration of {', '.join(paths)}\n\n```\n{lines}\n```\n\n{paper}\n\n"
        f'## Figures\n\n![Figures 2 to 8]({FIGURES}/sweep.png)\n'
    )
    return page, [*acceptance.screen_table(result.held_out), f' {paper}']


def _simulated(sensor: Sensor, options: argparse.Namespace, folder: Path) -> _Reproduction:
    """Repeat the experiments on simulated units and draw the figures."""
    if not sensor.axes.startswith('xy'):
        raise UserError(f'the paper has a sensor of the axes x and y, not {sensor.axes}')
    coverage_page, coverage_lines = _coverage(sensor, options) if options.draws else ('', [])
    if not options.units:
        return coverage_page, coverage_lines
    with cli.progress('reproduce') as show:
        results = experiments.evaluate_all(sensor, options.units, options.seed, show)
    first = 1000 * options.seed
    truth = experiments.draw(
        sensor, experiments.STAGES['paper'], np.random.default_rng([first, 0])
    )
    unit = experiments.calibrated(truth, first)
    pictures = folder / FIGURES
    make_folder(pictures)
    for name, figure in (
        (
            'sweep',
            unit_page.draw_sweep(experiments.bare(truth), unit.fitted['physical'], unit.poses),
        ),
        ('misalignment', draw_misalignment(*results['paper'][0].directions)),
        ('tilt', draw_tilt(results['paper'][0])),
        ('motion', draw_motion(unit.fitted, experiments.shaken(truth, first))),
        ('components', draw_components(truth, unit.fitted)),
    ):
        write_bytes(pictures / f'{name}.png', png(figure))
    drawn = 'one unit' if sensor.effects else f'{options.units} units'
    made = (
        f'adxl_ros {package_version()}, {date.today()}, {drawn} on each stage, '
        f'seed {options.seed}.'
    )
    bound_mmps2 = experiments.motion_bound_mmps2(sensor)
    page = filled(
        'reproduction.md',
        {
            'made': made,
            'coverage': coverage_page,
            'directions': _directions(results['paper']),
            'step': np.degrees(experiments.SEARCH_RAD[1] - experiments.SEARCH_RAD[0]),
            **{stage: _of_stage(units, bound_mmps2) for stage, units in results.items()},
        },
    )
    return page, [
        f"The paper's experiments, {drawn} on each stage, seed {options.seed}",
        '',
        *screen_lines(results, bound_mmps2),
        *[''] * bool(coverage_lines),
        *coverage_lines,
    ]


def _coverage(sensor: Sensor, options: argparse.Namespace) -> _Reproduction:
    """Count how often the intervals hold the truth."""
    with cli.progress('coverage') as show:
        errors = coverage.draw_all(
            replace(sensor, effects=(), values={}), options.draws, options.seed, show
        )
    page = coverage.page(
        errors,
        f'adxl_ros {package_version()}, {date.today()}, seed {options.seed}; `make coverage`.',
    )
    return page, coverage.screen_lines(errors)


_COLOURS = {'linear': 'tab:red', 'physical': 'tab:orange', 'full': 'tab:green'}
_SHOWN_S = (2.0, 2.5)
"""Interval of figure 12, s; chosen."""


def draw_misalignment(found_rad: dict[str, float], output_g: np.ndarray) -> Any:
    """Draw the search for β_x of (18) and the results of its three methods, as figure 9."""
    figure = new_figure(figsize=(7, 4.5))
    axis = figure.subplots()
    axis.plot(
        np.degrees(experiments.SEARCH_RAD),
        1e3 * (output_g - output_g.max()),
        'o',
        ms=4,
        label='output, means of 5 s',
    )
    for (label, value), colour in zip(
        found_rad.items(), ('k', 'tab:red', 'tab:orange', 'tab:green')
    ):
        axis.axvline(
            -np.degrees(value), color=colour, lw=1, label=f'{label}: {-np.degrees(value):+.2f}°'
        )
    axis.set(
        xlabel='beta of the stage, °',
        ylabel='x output minus its largest, mg',
        title='Direction of the x axis (18): the maximum is flat',
    )
    axis.legend(fontsize=8)
    return figure


def draw_tilt(unit: Unit) -> Any:
    """Draw figure 10: errors of alpha and beta in the three tilt experiments."""
    figure = new_figure(figsize=(16, 8))
    grid = figure.subplots(2, 3, sharex=True)
    for column, (run, asked_deg) in enumerate(RUNS.items()):
        turned = asked_deg[:, 1 if run == 'beta' else 0]
        for row, angle in enumerate(('alpha', 'beta')):
            axis = grid[row, column]
            for name, errors in unit.angles[
                (unit.angles.run == run) & (unit.angles.angle == angle)
            ].groupby('model', sort=False):
                shown = np.degrees(errors[['error', 'bound']]).where(errors.counts)
                axis.plot(turned, shown.error, 'o-', ms=4, lw=1, color=_COLOURS[name], label=name)
            axis.fill_between(
                turned,
                -Z_90 * shown.bound,
                Z_90 * shown.bound,
                color='0.8',
                label='90 % by the bound',
            )
            axis.axhline(0, color='0.5', lw=0.8)
            axis.set_yscale('symlog', linthresh=0.1)
            axis.set(
                ylabel=f'error of {angle}, °',
                title=f'fig. 10 ({"abc"[column]}): {run} turned' if not row else '',
            )
        grid[1, column].set(xlabel='turned angle, °')
    grid[0, 0].legend(fontsize=8)
    figure.suptitle(
        'Tilt; gaps are poses whose bound exceeds 1° '
        '(linear scale within ±0.1°, logarithmic beyond)'
    )
    return figure


def draw_motion(
    units: dict[str, Sensor], shaken: tuple[np.ndarray, np.ndarray, np.ndarray]
) -> Any:
    """
    Draw figure 12: the acceleration of the shaken sensor and of the interferometer.

    shaken: stamps, s, (n,); volts, (n, m); acceleration along x, m/s², (n,).
    """
    figure = new_figure(figsize=(16, 4.5))
    row = figure.subplots(1, len(units), sharey=True)
    time_s = shaken[0]
    part = (time_s >= _SHOWN_S[0]) & (time_s <= _SHOWN_S[1])
    for axis, (name, unit) in zip(row, units.items()):
        (rmse, offset), estimate, reference = experiments.motion_errors(unit, *shaken)
        axis.plot(time_s[part], 1e3 * reference[part], ':', color='k', label='interferometer')
        axis.plot(time_s[part], 1e3 * estimate[part], color=_COLOURS[name], label=name)
        axis.set(
            xlabel='time, s',
            title=f'fig. 12, {name}: rmse {rmse:.1f} mm/s² about an offset of {offset:.1f}',
        )
        axis.legend(fontsize=8, loc='upper right')
    row[0].set(ylabel='acceleration along x, mm/s²')
    return figure


def draw_components(truth: Sensor, units: dict[str, Sensor]) -> Any:
    """Draw figure 13: what each part of the model does to the response at alpha 45°, beta 90°."""
    reach, linear, fitted = np.linspace(-0.4, 0.4, 81), units['linear'], units['physical']
    pose = [
        reach * G0_MPS2,
        np.full(81, -np.sqrt(0.5) * truth.local_gravity_mps2),
        np.full(81, np.sqrt(0.5) * truth.local_gravity_mps2),
    ]
    bias = ('bias', 'scale_factor', 'cross_axis', 'cross_axis_z')
    steps = (
        ('linear model', linear, linear.effects),
        ('+ bias (10 to 13)', fitted, bias),
        ('+ scale factor (15)', fitted, (*bias, 'scale_factor_z')),
        ('+ misalignment (18)', fitted, fitted.effects),
        ('actual response', truth, truth.effects),
    )
    actual = signal_chain.static_response(truth)(pose)[0]
    figure = new_figure(figsize=(14, 5))
    response, difference = figure.subplots(1, 2)
    for label, unit, effects in steps:
        part = replace(unit, effects=effects, values={e: unit.values[e] for e in effects})
        volts = signal_chain.static_response(part)(pose)[0]
        style: dict[str, Any] = {'color': 'k', 'ls': ':'} if unit is truth else {}
        response.plot(reach, volts, label=label, **style)
        difference.plot(reach, 1e3 * (volts - actual), label=label, **style)
    response.set(
        xlabel='acceleration along x, g',
        ylabel='x output, V',
        title='fig. 13: response at alpha = 45°, beta = 90°',
    )
    difference.set(
        xlabel='acceleration along x, g',
        ylabel='minus the actual response, mV',
        title='the same, minus the actual response',
    )
    response.legend(fontsize=8)
    return figure


TABLE_I = {
    ('alpha', 'linear'): (2.88, 3.95),
    ('alpha', 'physical'): (0.32, 0.82),
    ('beta', 'linear'): (1.64, 2.36),
    ('beta', 'physical'): (0.60, 0.82),
}
"""The paper's rms and largest error, deg."""
MOTION_MMPS2 = {'linear': 299.8, 'physical': 20.8}
"""The paper's residuals of the motion experiment, mm/s²."""
_MOTION = ', '.join(f'{name} {value}' for name, value in MOTION_MMPS2.items())
_STAGE_NAMES = {'perfect': 'perfect stage', 'paper': "the paper's stage"}
FIGURES = 'reproduction'
"""Folder of the plots, in the folder of the page."""


def screen_lines(results: dict[str, list[Unit]], bound_mmps2: float) -> list[str]:
    """Return Table I and the motion experiment as lines for a terminal."""
    rows = [
        [f'{_STAGE_NAMES[stage]}, {angle}', *cells]
        for stage, units in results.items()
        for angle, _, *cells in _tilt(units)
    ]
    rows += [
        [f'{_STAGE_NAMES[stage]}, motion', *cells]
        for stage, units in results.items()
        for _, _, *cells in _motion(units, bound_mmps2)[-1:]
    ]
    return [
        *terminal_table(['Table I, rms / largest', *MODELS, 'bound'], rows),
        f' The paper: alpha {in_words("alpha")}; beta {in_words("beta")}; motion {_MOTION}.',
        ' Tilt in °, motion in mm/s²; bound: Cramér-Rao, or the noise floor.',
    ]


def in_words(angle: str) -> str:
    """Return the paper's rms and largest error of an angle by model."""
    return ', '.join(
        f'{name} {rms} / {largest}°' for (a, name), (rms, largest) in TABLE_I.items() if a == angle
    )


def _counted(units: Sequence[Unit]) -> pd.DataFrame:
    """Return the angle errors that count, of all units."""
    errors = pd.concat([unit.angles.assign(unit=i) for i, unit in enumerate(units)])
    return errors[errors.counts]


def _tilt(units: Sequence[Unit]) -> list[list[str]]:
    """Return the rows of Table I."""
    counted = np.degrees(
        _counted(units).query('run != "random"').set_index(['angle', 'model'])[['error', 'bound']]
    )
    return [
        [
            angle,
            in_words(angle),
            *(
                f'{_rms(error):.3f} / {error.abs().max():.3f}'
                for error in (counted.error[angle, model] for model in MODELS)
            ),
            f'{_rms(counted.bound[angle, "full"]):.4f}',
        ]
        for angle in ('alpha', 'beta')
    ]


def _of_stage(units: Sequence[Unit], bound_mmps2: float) -> str:
    """Lay out the tables of a stage."""
    counts = np.concatenate(
        [unit.angles.query('model == "full" and angle == "alpha"').counts for unit in units]
    )
    return filled(
        'reproduction_stage.md',
        {
            'tilt': markdown_table(['', 'paper', *MODELS, 'Cramér-Rao bound, rms'], _tilt(units)),
            'reached': _to_reach(units),
            'poses': len(counts),
            'undetermined': np.sum(~counts),
            'motion': markdown_table(
                ['motion, mm/s²', 'paper', *MODELS, 'bound'], _motion(units, bound_mmps2)
            ),
        },
    )


def _to_reach(units: Sequence[Unit]) -> str:
    of_model = dict(iter(_counted(units).groupby('model')))
    rows = [
        [
            f'angle error ÷ bound {text}, rms',
            *(
                _interval(of_model[model].error / of_model[model][bound], of_model[model].unit)
                for model in MODELS
            ),
        ]
        for bound, text in (
            ('pose_bound', 'of the noise of one pose'),
            ('bound', 'of pose and calibration'),
        )
    ]
    before, *after = (
        _rms(of_model[model].query('angle == "alpha" and not near_vertical').error)
        for model in MODELS
    )
    rows.append(
        [
            'reduction of the rms error of alpha, 15° and more from ±90°, %',
            '–',
            *(f'{100 * (1 - rms / before):.2f}' for rms in after),
        ]
    )
    for text in ('acceleration', 'coefficients'):
        zs = [
            np.concatenate([np.ravel(getattr(unit, text)[model]) for unit in units])
            for model in MODELS
        ]
        rows.append(
            [
                f'coverage of 90 % intervals, {text}, %',
                *(
                    f'{100 * np.mean(np.abs(z) < Z_90):.1f} (of {len(z)})' if len(z) else '–'
                    for z in zs
                ),
            ]
        )
    return markdown_table(['random poses and the three runs, none fitted', *MODELS], rows)


def _motion(units: Sequence[Unit], bound_mmps2: float) -> list[list[str]]:
    """Return the rows of the motion experiment."""
    errors = [np.array([unit.motion[model] for unit in units]).T for model in MODELS]
    number, bound = pd.Series(range(len(units))), f'{bound_mmps2:.2f}'
    return [
        [
            'rmse about the offset',
            '–',
            *(_interval(pd.Series(rmse), number) for rmse, _ in errors),
            bound,
        ],
        [
            "offset, rms, the stage's part included",
            '–',
            *(f'{_rms(offset):.1f}' for _, offset in errors),
            '–',
        ],
        ['both together', _MOTION, *(f'{_rms(np.hypot(*both)):.1f}' for both in errors), bound],
    ]


def _directions(units: Sequence[Unit]) -> str:
    found = pd.DataFrame([unit.directions[0] for unit in units])
    errors = np.degrees(found.iloc[:, 1:].sub(found.truth, axis=0))
    return markdown_table(
        ['largest output', 'parabola through the outputs', 'null crossings'],
        [[f'{_rms(errors[name]):.3f}' for name in errors]],
    )


def _interval(values: pd.Series, groups: pd.Series) -> str:
    """Write an rms with its 90 % interval by bootstrap over units."""
    mean, low, high = np.sqrt(coverage.mean_with_interval(values**2, groups))
    return f'{mean:.3f} ({low:.3f} to {high:.3f})'


def _rms(values: np.ndarray | pd.Series) -> float:
    return float(np.sqrt(np.mean(values**2)))


def main() -> int:
    """Run the tool on the command line."""
    return cli.run(parser(), reproduce)
