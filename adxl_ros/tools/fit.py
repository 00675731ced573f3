# SPDX-License-Identifier: Apache-2.0

"""Fit a calibration to recordings, without a running graph."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from adxl_ros.api.calibration import fit as fit_unit
from adxl_ros.api.updating import update
from adxl_ros.calibrate.calibration import STAGE_FITS
from adxl_ros.calibrate.keep.update_report import PAGE as UPDATE_PAGE
from adxl_ros.calibrate.report import certificate_data
from adxl_ros.calibrate.report.gum import SCHEMA_VERSION
from adxl_ros.calibrate.report.page import PAGE
from adxl_ros.errors import UserError
from adxl_ros.files.calibration_store import default_folder, put
from adxl_ros.model.effects import library
from adxl_ros.model.effects.base import Place
from adxl_ros.process import command
from adxl_ros.report import page as html_page
from adxl_ros.tools import command_line as cli

_EXAMPLES = {
    'the richest model that a sweep determines, with a page': (
        'sweep.csv -o unit.yaml --report report'
    ),
    'two sweeps of one unit, the linear model': 'one.mcap two.mcap --model linear -o unit.yaml',
    'a calibration kept up to date by the days of a robot at work': (
        '--update unit.yaml day1.mcap day2.mcap -o updated.yaml --report report'
    ),
    'a further effect': 'sweep.csv --effect temperature_bias -o unit.yaml',
}
"""Examples of arguments, by their purpose."""
_MEANS_RATE_HZ = 1.0  # Stamps of a table of means, which have no meaning


def parser() -> argparse.ArgumentParser:
    """Describe the command line."""
    parse = cli.argument_parser('fit', __doc__, _EXAMPLES, _details)
    parse.add_argument('recording', nargs='+', help=f'{cli.RECORDING_HELP}; all of one unit')
    parse.add_argument(
        '--params',
        metavar='FILE',
        help='values that are not fitted (default: the nominal sensor; what '
        'a file leaves out is measured)',
    )
    parse.add_argument(
        '--update',
        metavar='FILE',
        help='keep this calibration up to date by the rests of the recordings, in the order of '
        'time, as the node keep_calibrated does',
    )
    parse.add_argument(
        '--model',
        choices=list(STAGE_FITS),
        help='model to fit to stage angles (default: the richest that the poses '
        'determine); a three-axis recording without angles is '
        'calibrated against gravity',
    )
    parse.add_argument(
        '--effect',
        metavar='NAME',
        action='append',
        default=[],
        help='a further effect that the full model fits; see the list below',
    )
    parse.add_argument(
        '--prior',
        metavar='FILE',
        help='the population.yaml of a fleet: few poses then give a smaller '
        'uncertainty; a unit that is not of the fleet is named',
    )
    parse.add_argument(
        '--journal', metavar='FILE', help='use the rests that the journal of this sweep names'
    )
    parse.add_argument(
        '--poses',
        metavar='FILE',
        help='table with alpha_deg and beta_deg, or roll_deg and pitch_deg of an inclinometer, of '
        'each rest: in their order, or between start_s and stop_s of the recording',
    )
    parse.add_argument(
        '--means',
        action='store_true',
        help='each row of the table is the mean of a rest, in any order; its stamps are not used',
    )
    parse.add_argument(
        '-o',
        dest='output',
        metavar='FILE.yaml',
        required=True,
        help='the parameter file of the calibrated sensor',
    )
    parse.add_argument('--report', metavar='DIR', help='write the page report.html there')
    parse.add_argument(
        '--dcc',
        metavar='FILE.xml',
        help='write a Digital Calibration Certificate of a calibration on a stage, '
        f'by the schema DCC {SCHEMA_VERSION} of PTB',
    )
    parse.add_argument(
        '--dcc-data',
        metavar='FILE.yaml',
        help='what the certificate states of laboratory, customer, person and device; its keys: '
        + ', '.join(certificate_data.DEFAULTS),
    )
    parse.add_argument(
        '--store',
        metavar='DIR',
        default=str(default_folder()),
        help='the calibration store, which gets a copy (default: %(default)s); empty for none',
    )
    cli.add_overwrite_option(parse)
    cli.add_robot_options(parse)
    cli.add_recording_options(parse)
    return parse


def _details() -> str:
    """Return the effects that a fit can have for the help text."""
    return cli.effect_list(
        effect for effect in library().values() if effect.invertible or effect.place is Place.STAGE
    )


def _update(options: argparse.Namespace) -> int:
    """Replay recordings of a robot at work."""
    of_a_fit = (
        'params',
        'model',
        'effect',
        'prior',
        'journal',
        'poses',
        'means',
        'dcc',
        'dcc_data',
        'urdf',
    )
    given = [name for name in of_a_fit if getattr(options, name)]
    if given:
        raise UserError(
            f'--update: changes a calibration; leave --{given[0].replace("_", "-")} out'
        )
    cli.check_outputs(
        options, options.output, options.report and Path(options.report, UPDATE_PAGE)
    )
    reading = cli.reading_options(options)
    with cli.progress('fit') as show:
        updated = update(
            (cli.read('fit', path, reading) for path in options.recording),
            options.update,
            progress=show,
        )
    pages = []
    if options.report:
        pages.append(updated.report(options.report, overwrite=options.overwrite))
    updated.save(options.output, overwrite=options.overwrite)
    if updated.adoptions and options.store:
        cli.note(f'fit: stored {put(options.store, updated.sensor)}')
    cli.print_end(
        [*updated.screen],
        [options.output, *pages],
        command('apply', f'NEW.mcap --params {cli.quoted(options.output)} -o tilt.csv'),
    )
    return 0


def fit(options: argparse.Namespace) -> int:
    """Run the tool; see `parser`."""
    if options.update:
        return _update(options)
    cli.check_outputs(
        options, options.output, options.dcc, options.report and Path(options.report, PAGE)
    )
    if options.dcc_data and not options.dcc:
        raise UserError(f'--dcc-data {options.dcc_data}: needs --dcc with the certificate')
    if options.report or options.dcc:
        html_page.check_libraries()
    reading = cli.reading_options(options)
    if options.means:
        reading = replace(reading, rate_hz=_MEANS_RATE_HZ)
    report: list[str | Path] = []
    with cli.progress('fit') as show:
        fitted = fit_unit(
            (cli.read('fit', path, reading) for path in options.recording),
            options.params,
            model=options.model,
            effects=options.effect,
            prior=options.prior,
            journal=options.journal,
            poses=options.poses,
            means=options.means,
            urdf=options.urdf,
            frame=options.frame,
            joints=options.joints,
            progress=show,
        )
        cli.report_notes('fit', fitted.notes)
        if options.report:
            show(0.6, 'report')
            report.append(
                fitted.report(options.report, options.store, overwrite=options.overwrite)
            )
        if options.dcc:
            fitted.certificate(options.dcc, options.dcc_data, overwrite=options.overwrite)
            report.append(options.dcc)
    fitted.save(options.output, overwrite=options.overwrite)
    cli.note(f'fit: {fitted.keep(options.store)}')
    # No samples of a table of means can be corrected.
    applied = (
        'RECORDING'
        if options.means
        else f'{cli.quoted(options.recording[0])}{cli.reading_text(options)}'
    )
    cli.print_end(
        [*fitted.screen, ''],
        [options.output, *report],
        command('apply', f'{applied} --params {cli.quoted(options.output)} -o tilt.csv'),
    )
    return 0


def main() -> int:
    """Run the tool on the command line."""
    return cli.run(parser(), fit)
