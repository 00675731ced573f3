# SPDX-License-Identifier: Apache-2.0

"""Correct a recording by a parameter file: acceleration and tilt from the sensor alone."""

from __future__ import annotations

import argparse
import itertools

from adxl_ros.api.correction import BLOCK_ROWS, Correction, INVERSES, writer
from adxl_ros.errors import UserError
from adxl_ros.files import recording
from adxl_ros.process import command
from adxl_ros.tools import command_line as cli

_EXAMPLES = {
    'acceleration and tilt by a calibration': 'recording.csv --params unit.yaml -o tilt.csv',
    'a bag with imu/data and tilt': 'recording.mcap --params unit.yaml -o tilt.mcap',
    'a moving sensor, without the lag of its filter': (
        'fast.csv --params unit.yaml --undo-filter -o a.csv'
    ),
}
"""Examples of arguments, by their purpose."""


def parser() -> argparse.ArgumentParser:
    """Describe the command line."""
    parse = cli.argument_parser('apply', __doc__, _EXAMPLES)
    parse.add_argument('recording', metavar='RECORDING', help=cli.RECORDING_HELP)
    parse.add_argument(
        '--params',
        metavar='FILE',
        help='the calibrated sensor (default: the nominal sensor)',
    )
    parse.add_argument(
        '--inverse',
        choices=INVERSES,
        default=INVERSES[0],
        help="inverse of the model: exact (default), or the paper's approximation, "
        'equations 14 to 21',
    )
    parse.add_argument(
        '--undo-filter',
        action='store_true',
        help='undo the RC filter, amplitude and phase, for a sensor that moves',
    )
    parse.add_argument(
        '-o',
        dest='output',
        metavar='OUT',
        required=True,
        help='acceleration and tilt, with standard deviations: OUT.csv is a table; '
        'OUT.mcap, or a folder OUT, is a bag with imu/data and tilt',
    )
    cli.add_overwrite_option(parse)
    cli.add_recording_options(parse)
    return parse


def apply(options: argparse.Namespace) -> int:
    """Run the tool; see `parser`."""
    cli.refuse_same_file(options.output, options.recording)
    cli.check_outputs(options, options.output)
    blocks = recording.blocks(options.recording, BLOCK_ROWS, cli.reading_options(options))
    first = next(blocks, None)
    if first is None:
        raise UserError(f'{options.recording}: has no samples to correct')
    correction = Correction(
        first, options.params, inverse=options.inverse, undo_filter=options.undo_filter
    )
    block = first
    with writer(options.output, correction.sensor) as write, cli.progress('apply') as show:
        for block, estimates in correction.blocks(itertools.chain([first], blocks)):
            write(block, estimates)
            show(block.done)
    cli.report_notes('apply', correction.notes)
    cli.report_notes('apply', block.notes)
    following = ('compensation', f'--ros-args -p calibration:={cli.quoted(options.params or "")}')
    cli.print_end(
        correction.screen,
        [options.output],
        command(*following if correction.sensor.effects else ('fit', 'SWEEP -o unit.yaml')),
    )
    return 0


def main() -> int:
    """Run the tool on the command line."""
    return cli.run(parser(), apply)
