# SPDX-License-Identifier: Apache-2.0
"""Repeat the paper's experiments on simulated units, or its calibration on recordings."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import NamedTuple

from adxl_ros.calibrate import calibration, pose_extraction
from adxl_ros.calibrate.report import acceptance, page as unit_page
from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file, recording
from adxl_ros.files.atomic_write import write_text
from adxl_ros.files.recording_columns import recorded_unit
from adxl_ros.model.sensor import Sensor
from adxl_ros.process import package_version
from adxl_ros.tools.command_line import (
    argument_parser,
    command,
    make_folder,
    print_end,
    progress,
    quoted,
    report_reading,
    run,
)
from adxl_ros_validation import coverage, experiments, reproduction_report as report
from adxl_ros_validation.reproduction_report import FIGURES
import numpy as np

_EXAMPLES = {
    'the experiments on 20 simulated units': '-o reproduction',
    'the calibration of the paper on a recorded sweep': 'sweep.csv -o reproduction',
}
"""Examples of arguments, by their purpose."""


def parser() -> argparse.ArgumentParser:
    """Describe the command line."""
    parse = argument_parser('reproduce', __doc__, _EXAMPLES)
    parse.add_argument('recording', nargs='*',
                       help='sweeps of one unit; without any, units are simulated')
    parse.add_argument('--params', metavar='FILE', default=None,
                       help='values about which units are drawn, or one unit with its effects '
                            '(default: the nominal sensor)')
    parse.add_argument('--seed', type=int, default=0, help='seed of the units (default 0)')
    parse.add_argument('--units', type=int, default=20, help='units that are drawn (default 20)')
    parse.add_argument('--draws', type=int, default=0,
                       help='further units and stages that check the intervals '
                            '(default: none; 300 take about a minute on two cores)')
    parse.add_argument('-o', dest='output', metavar='DIR', required=True,
                       help='reproduction.md and its plots')
    return parse


def reproduce(options: argparse.Namespace) -> int:
    """Run the tool; see `parser`."""
    for name, least in (('draws', 0), ('seed', 0), ('units', 0 if options.draws else 1)):
        if getattr(options, name) < least:
            raise UserError(f'--{name} {getattr(options, name)}: must be at least {least}')
    sensor = parameter_file.load(options.params or parameter_file.nominal_path())
    folder = Path(options.output)
    make_folder(folder / FIGURES)
    made = _of_recordings(sensor, options.recording, folder) if options.recording \
        else _simulated(sensor, options, folder)
    write_text(folder / 'reproduction.md', made.page)
    print_end([*made.screen, ''], [folder / 'reproduction.md', folder / FIGURES],
              command('reproduce', f'--draws 300 --units 0 -o {quoted(f"{folder}_coverage")}')
              if not options.draws else '')
    return 0


class _Reproduction(NamedTuple):
    """What a reproduction shows."""

    page: str  # the page, Markdown
    screen: list[str]  # the most important of it as lines for a terminal


def _of_recordings(sensor: Sensor, paths: Sequence[str], folder: Path) -> _Reproduction:
    """Calibrate from recordings."""
    unit, recordings = sensor, []
    for path in paths:
        read = recording.read(path)
        report_reading('reproduce', read)
        unit = recorded_unit(unit, read)
        recordings.append(calibration.RecordedPoses(
            Path(path).name, pose_extraction.extract_poses(read, unit)))
    result = calibration.calibrate(unit, recordings, 'full')
    unit_page.draw(folder / FIGURES / 'sweep.png', result)
    lines = '\n'.join(result.comments())
    paper = (f'The paper: alpha {report.in_words("alpha")}; '
             f'beta {report.in_words("beta")}.')
    page = (f"# The paper's calibration of {', '.join(paths)}\n\n```\n{lines}\n```\n\n{paper}\n\n"
            f'## Figures\n\n![Figures 2 to 8]({FIGURES}/sweep.png)\n')
    return _Reproduction(page, [*acceptance.error_table(result.held_out), f' {paper}'])


def _simulated(sensor: Sensor, options: argparse.Namespace, folder: Path
               ) -> _Reproduction:
    """Repeat the experiments on simulated units and draw the figures."""
    if not sensor.axes.startswith('xy'):
        raise UserError(f'the paper has a sensor of the axes x and y, not {sensor.axes}')
    intervals = _coverage(sensor, options) if options.draws else _Reproduction('', [])
    if not options.units:
        return intervals
    with progress('reproduce') as show:
        results = experiments.evaluate_all(sensor, options.units, options.seed, show)
    first = 1000 * options.seed
    truth = experiments.draw(sensor, experiments.STAGES['paper'],
                             np.random.default_rng([first, 0]))
    unit = experiments.calibrated(truth, first)
    pictures = folder / FIGURES
    unit_page.draw_sweep(pictures / 'sweep.png', experiments.bare(truth),
                         unit.fitted['physical'], unit.poses)
    report.draw_misalignment(pictures / 'misalignment.png', results['paper'][0].directions)
    report.draw_tilt(pictures / 'tilt.png', results['paper'][0])
    report.draw_motion(pictures / 'motion.png', unit.fitted, experiments.shaken(truth, first))
    report.draw_components(pictures / 'components.png', truth, unit.fitted['physical'],
                           unit.fitted['linear'])
    drawn = 'one unit' if sensor.effects else f'{options.units} units'
    made = (f'adxl_ros {package_version()}, {date.today()}, {drawn} on each stage, '
            f'seed {options.seed}.')
    bound_mmps2 = experiments.motion_bound_mmps2(sensor)
    page = report.page(results, bound_mmps2, made, intervals.page)
    screen = [f"The paper's experiments, {drawn} on each stage, seed {options.seed}", '',
              *report.screen_lines(results, bound_mmps2)]
    return _Reproduction(report.wrap_prose(page),
                         screen + (['', *intervals.screen] if intervals.screen else []))


def _coverage(sensor: Sensor, options: argparse.Namespace) -> _Reproduction:
    """Count how often the intervals hold the truth."""
    with progress('coverage') as show:
        draws = coverage.draw_all(replace(sensor, effects=(), values={}), options.draws,
                                  options.seed, show)
    page = coverage.page(draws, f'adxl_ros {package_version()}, {date.today()}, seed '
                                f'{options.seed}; `make coverage`.')
    return _Reproduction(report.wrap_prose(page), coverage.screen_lines(draws))


def main() -> int:
    """Run the tool on the command line."""
    return run(parser(), reproduce)
