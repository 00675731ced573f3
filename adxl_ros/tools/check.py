# SPDX-License-Identifier: Apache-2.0

"""Check whether recordings are sound, and what the other tools can do with them."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
import json
from pathlib import Path

from adxl_ros.api.checking import check as check_recordings, PAGE
from adxl_ros.process import command
from adxl_ros.report import page as html_page
from adxl_ros.signals.findings import Findings
from adxl_ros.tools import command_line as cli

_EXAMPLES = {
    'all recordings of a day, with a page': '*.mcap --report check',
    'a log of other software': 'log.csv --columns time=t_ms:ms,x=accX:mg,y=accY:mg,z=accZ:mg',
}
"""Examples of arguments, by their purpose."""


def parser() -> argparse.ArgumentParser:
    """Describe the command line."""
    parse = cli.argument_parser('check', __doc__, _EXAMPLES)
    parse.add_argument('recording', nargs='+', metavar='RECORDING', help=cli.RECORDING_HELP)
    parse.add_argument(
        '--params',
        metavar='FILE',
        default=None,
        help='the sensor, for recordings in volts (default: the nominal sensor)',
    )
    parse.add_argument('--report', metavar='DIR', help='write the page check.html there')
    cli.add_overwrite_option(parse)
    parse.add_argument('--json', action='store_true', help='print the result as JSON')
    cli.add_robot_options(parse)
    cli.add_recording_options(parse)
    return parse


def check(options: argparse.Namespace) -> int:
    """Run the tool; see `parser`."""
    cli.check_outputs(options, options.report and Path(options.report, PAGE))
    if options.report:
        html_page.check_libraries()
    with cli.progress('check') as show:
        checked = check_recordings(
            options.recording,
            options.params,
            urdf=options.urdf,
            frame=options.frame,
            joints=options.joints,
            reading=cli.reading_options(options),
            progress=show,
        )
    page = [checked.save(options.report, overwrite=options.overwrite)] if options.report else []
    if options.json:
        print(json.dumps(checked.to_dict()['recordings'], indent=1))
    else:
        *lines, sentence = checked.screen
        print('\n'.join(lines))
        cli.print_end([sentence], page, _next_command(checked.recordings, options))
    return 0 if checked.is_sound else 1


def _next_command(results: Sequence[Findings], options: argparse.Namespace) -> str:
    able = [
        (result.path, ability.tool)
        for result in results
        if result.is_sound
        for ability in result.abilities
        if ability.is_able and ability.tool != 'diagnose'
    ]
    return (
        command(able[0][1], f'{cli.quoted(able[0][0])}{cli.reading_text(options)} -o unit.yaml')
        if able
        else ''
    )


def main() -> int:
    """Run the tool on the command line."""
    return cli.run(parser(), check)
