# SPDX-License-Identifier: Apache-2.0

"""Fit a calibration to recordings, without a running graph."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from adxl_ros.calibrate import calibration
from adxl_ros.calibrate.fits import thermal_fit
from adxl_ros.calibrate.poses import estimate_filters, extract_poses, Poses, with_table_angles
from adxl_ros.calibrate.report import gum, page
from adxl_ros.calibrate.result import errors_in_words
from adxl_ros.errors import UserError
from adxl_ros.files import calibration_store, sweep_journal
from adxl_ros.files.calibration_store import sha256
from adxl_ros.files.recording_columns import recorded_unit, Recording
from adxl_ros.files.surroundings import Surroundings
from adxl_ros.model.effects import library
from adxl_ros.model.effects.base import Place
from adxl_ros.model.sensor import Sensor, with_axes
from adxl_ros.report import page as html_page
from adxl_ros.signals.recorded_sensor import BeyondRange, listed, load_sensor, measure_unstated
from adxl_ros.tools import command_line as cli

_EXAMPLES = {
    'the richest model that a sweep determines, with a page':
        'sweep.csv -o unit.yaml --report report',
    'two sweeps of one unit, the linear model': 'one.mcap two.mcap --model linear -o unit.yaml',
    'a further effect': 'sweep.csv --effect temperature_bias -o unit.yaml',
}
"""Examples of arguments, by their purpose."""


def parser() -> argparse.ArgumentParser:
    """Describe the command line."""
    parse = cli.argument_parser('fit', __doc__, _EXAMPLES, _details)
    parse.add_argument('recording', nargs='+',
                       help=f'{cli.RECORDING_HELP}; all of one unit')
    parse.add_argument('--params', metavar='FILE', default=None,
                       help='values that are not fitted (default: the nominal sensor; what '
                            'a file leaves out is measured)')
    parse.add_argument('--model', choices=list(calibration.STAGE_FITS),
                       help='model to fit to stage angles (default: the richest that the poses '
                            'determine); a three-axis recording without angles is '
                            'calibrated against gravity')
    parse.add_argument('--effect', metavar='NAME', action='append', default=[],
                       help='a further effect that the full model fits; see the list below')
    parse.add_argument('--prior', metavar='FILE',
                       help='the population.yaml of a fleet: few poses then give a smaller '
                            'uncertainty; a unit that is not of the fleet is named')
    parse.add_argument('--journal', metavar='FILE',
                       help='use the rests that the journal of this sweep names')
    parse.add_argument('--poses', metavar='FILE',
                       help='table with alpha_deg and beta_deg of each rest, in their order')
    parse.add_argument('-o', dest='output', metavar='FILE.yaml', required=True,
                       help='the parameter file of the calibrated sensor')
    parse.add_argument('--report', metavar='DIR',
                       help='write the page report.html there')
    parse.add_argument('--dcc', metavar='FILE.xml',
                       help='write a Digital Calibration Certificate of a calibration on a stage, '
                            f'by the schema DCC {gum.SCHEMA_VERSION} of PTB')
    parse.add_argument('--store', metavar='DIR', default=str(calibration_store.default_folder()),
                       help='the calibration store, which gets a copy (default: %(default)s); '
                            'empty for none')
    cli.add_overwrite_option(parse)
    cli.add_robot_options(parse)
    cli.add_recording_options(parse)
    return parse


def _details() -> str:
    """Return the effects that a fit can have for the help text."""
    return cli.effect_list(effect for effect in library().values()
                           if effect.invertible or effect.place is Place.STAGE)


def fit(options: argparse.Namespace) -> int:
    """Run the tool; see `parser`."""
    if sum(map(bool, (options.journal, options.poses, options.recording[1:]))) > 1:
        raise UserError('--journal and --poses: one of them names the rests of one recording')
    cli.check_outputs(options, options.output, options.dcc,
                      options.report and Path(options.report, page.PAGE))
    if options.report or options.dcc:
        html_page.check_libraries()
    population = calibration_store.read_population(options.prior) if options.prior else None
    records = sweep_journal.poses_to_fit(sweep_journal.read(options.journal).entries) \
        if options.journal else None
    unit: Sensor | None = None
    recordings: list[calibration.RecordedPoses] = []
    thermal: Poses | None = None
    surroundings: list[Surroundings] = []  # Those of each recording
    reading = cli.reading_options(options)
    with cli.progress('fit') as show:
        for number, path in enumerate(options.recording):
            read = cli.read('fit', path, reading)
            if unit is None:
                unit, lines = measure_unstated(load_sensor(options.params, read), read)
                base, measured = unit, listed(lines)
            unit = recorded_unit(unit, read)
            surroundings.append(Surroundings())
            surroundings[-1](read)
            if options.urdf:
                robot = cli.robot_path(options, read, unit)
                read = robot.with_angles(read)
                unit = replace(unit, stage_resolution_rad=max(
                    unit.stage_resolution_rad, robot.step_rad))
            beyond = BeyondRange()
            beyond.add(read.volts(unit), unit)
            text = beyond.describe(unit)
            if text and 'range_g' not in unit.measured:  # but stated by the parameter file
                cli.note(f'fit: {read.path}: {text}')
            show(0.3 * (number + 0.5) / len(options.recording), 'reading')
            thermal = _thermal_blocks(options, read, unit)
            if thermal is not None:
                if population is not None:
                    raise UserError(f'--prior {options.prior}: a fit over temperature takes '
                                    'none; leave it out')
                break
            poses = extract_poses(read, unit, records)
            if options.poses:
                poses = with_table_angles(poses, options.poses)
            recordings.append(calibration.RecordedPoses(
                Path(path).name, poses, estimate_filters(read, unit, poses)))
        assert unit is not None, 'argparse asks for a recording'
        show(0.3, 'fit')
        sha = sha256(options.recording)
        result = calibration.calibrate(unit, recordings, options.model, options.effect, sha,
                                       population) \
            if thermal is None else calibration.calibrate_thermal(
                with_axes(base, unit.axes), thermal, Path(options.recording[0]).name, sha)
        effects = result.fitted.effects
        assumed = [line for each in surroundings for line in each.interpolated(effects)]
        result = replace(result, warnings=[*result.warnings, *assumed],
                         details=[*result.details, *measured])
        if options.dcc:
            gum.write(options.dcc, result)
        if options.report:
            show(0.6, 'report')
            cli.make_folder(Path(options.report))
            page.write(options.report, result, options.store)
    result.save(options.output)
    cli.note(f'fit: {result.keep(options.store)}')
    report = [Path(options.report) / page.PAGE] if options.report else []
    report += [Path(options.dcc)] if options.dcc else []
    fitted = result.fitted
    # What was wrong with the unit, and what is fitted
    head = [errors_in_words(fitted), '',
            f'{fitted.serial}: {fitted.model} model of {result.inliers.sum()} poses, '
            f'{len(fitted.covariance_names)} coefficients', ''] if thermal is None else []
    lines = [*head, *result.summary, *result.warnings, *measured, '']
    cli.print_end(lines, [options.output, *report], cli.command(
        'apply', f'{cli.quoted(options.recording[0])}{cli.reading_text(options)} --params '
        f'{cli.quoted(options.output)} -o tilt.csv'))
    return 0


def _thermal_blocks(options: argparse.Namespace, read: Recording, unit: Sensor) -> Poses | None:
    """Return the blocks of a resting sensor whose temperature effects are asked for, else None."""
    if len(options.recording) > 1 or options.model or options.journal or options.poses \
            or not options.effect or not set(options.effect) <= set(thermal_fit.EFFECTS):
        return None
    blocks = thermal_fit.rest_blocks(read, unit)
    if blocks is not None and options.report:
        raise UserError(f'--report {options.report}: a fit over temperature has no page; leave '
                        'it out')
    return blocks


def main() -> int:
    """Run the tool on the command line."""
    return cli.run(parser(), fit)
