# SPDX-License-Identifier: Apache-2.0

"""Find the noise parameters of a sensor in a recording at rest."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
import json
from pathlib import Path

from adxl_ros.api.noise import noise as find_noise, PLOT, TABLE
from adxl_ros.files import recording
from adxl_ros.files.recording_columns import Recording
from adxl_ros.files.tables import BLOCK_ROWS
from adxl_ros.process import command
from adxl_ros.tools import command_line as cli

_EXAMPLES = {
    'noise of each axis, with its Allan deviation': 'still.mcap --report noise',
    'a parameter file for compensation and diagnose': (
        'still.csv --params my_sensor.yaml -o my_noise.yaml'
    ),
    "a camera's IMU in a bag": 'bag --topic /camera/imu',
}
"""Examples of arguments, by their purpose."""


def parser() -> argparse.ArgumentParser:
    """Describe the command line."""
    parse = cli.argument_parser('noise', __doc__, _EXAMPLES)
    parse.add_argument(
        'recording',
        metavar='RECORDING',
        help=f'{cli.RECORDING_HELP}; of a sensor that nobody touches',
    )
    parse.add_argument(
        '--params',
        metavar='FILE',
        help='the other values of the sensor (default: the nominal sensor; for a '
        'recording in m/s² that names no sensor, any IMU)',
    )
    parse.add_argument(
        '-o', dest='output', metavar='FILE.yaml', help='a parameter file with the measured noise'
    )
    parse.add_argument(
        '--report', metavar='DIR', help='write the curve there, allan.png and allan.csv'
    )
    cli.add_overwrite_option(parse)
    parse.add_argument(
        '--json', action='store_true', help='print figures and curve as JSON, in SI units'
    )
    cli.add_recording_options(parse)
    return parse


def noise(options: argparse.Namespace) -> int:
    """Run the tool; see `parser`."""
    curves = [Path(options.report, name) for name in (PLOT, TABLE)] if options.report else []
    cli.check_outputs(options, options.output, *curves)
    reading = cli.reading_options(options)
    newest: list[Recording] = []
    with cli.progress('noise') as show:

        def blocks() -> Iterator[Recording]:
            for block in recording.blocks(options.recording, BLOCK_ROWS, reading):
                newest[:] = [block]
                yield block
                show(block.done, 'read')

        found = find_noise(blocks, options.params, progress=show)
    cli.report_notes('noise', newest[-1].notes)
    if options.report:
        found.report(options.report, overwrite=options.overwrite)
    lines = found.screen
    files = curves
    if options.output:
        found.save(options.output, overwrite=options.overwrite)
        files = [Path(options.output), *curves]
        lines += [f'WARNING {text}' for text in found.refuted_filter]
    if options.json:
        print(json.dumps(found.to_dict(), indent=1))
        return 0
    read = f'{cli.quoted(options.recording)}{cli.reading_text(options)}'
    following = command('noise', f'{read} -o noise.yaml')
    if options.output:
        params = cli.quoted(options.output)
        following = command('diagnose', f'RECORDING --params {params} -o gap')
    cli.print_end(lines, files, following)
    return 0


def main() -> int:
    """Run the tool on the command line."""
    return cli.run(parser(), noise)
