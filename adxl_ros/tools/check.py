# SPDX-License-Identifier: Apache-2.0

"""Check whether recordings are sound, and what the other tools can do with them."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
import json
from pathlib import Path

from adxl_ros.api.checking import check as check_recordings
from adxl_ros.errors import UserError
from adxl_ros.process import command
from adxl_ros.report import page as html_page
from adxl_ros.signals import gate
from adxl_ros.signals.findings import Findings
from adxl_ros.signals.findings_report import PAGE
from adxl_ros.tools import command_line as cli

_EXAMPLES = {
    'all recordings of a day, with a page': '*.mcap --report check',
    'a gate: what became worse since an earlier log': (
        'new.mcap --against old.mcap --fail-on gaps,noise --min rate_hz=95 --junit check.xml'
    ),
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
        help='the sensor, for recordings in volts (default: the nominal sensor)',
    )
    parse.add_argument('--report', metavar='DIR', help='write the page check.html there')
    cli.add_overwrite_option(parse)
    parse.add_argument('--json', action='store_true', help='print the result as JSON')
    parse.add_argument(
        '--against',
        metavar='RECORDING',
        help='an earlier recording of the same task: what became worse is named',
    )
    parse.add_argument(
        '--fail-on',
        metavar='KINDS',
        default=','.join(gate.KINDS),
        help='what makes the status 1, of %(default)s (default: all of them)',
    )
    parse.add_argument(
        '--min',
        dest='minima',
        metavar='NAME=VALUE',
        action='append',
        default=[],
        help=f'smallest value of {", ".join(gate.MINIMA)}',
    )
    parse.add_argument(
        '--junit', metavar='FILE.xml', help='write the outcomes as a report of JUnit'
    )
    cli.add_robot_options(parse)
    cli.add_recording_options(parse)
    return parse


def check(options: argparse.Namespace) -> int:
    """Run the tool; see `parser`."""
    cli.check_outputs(options, options.report and Path(options.report, PAGE), options.junit)
    fail_on = [kind for kind in options.fail_on.split(',') if kind]
    gate.require_kinds(fail_on)
    if options.report:
        html_page.check_libraries()
    with cli.progress('check') as show:
        checked = check_recordings(
            options.recording,
            options.params,
            against=options.against,
            minima=_minima(options.minima),
            urdf=options.urdf,
            frame=options.frame,
            joints=options.joints,
            progress=show,
            **cli.reading_arguments(options),
        )
    if options.junit:
        checked.junit(options.junit, fail_on, overwrite=options.overwrite)
    page = [checked.save(options.report, overwrite=options.overwrite)] if options.report else []
    if options.json:
        print(json.dumps(checked.to_dict()['recordings'], indent=1))
    else:
        *lines, sentence = checked.screen
        print('\n'.join(lines))
        cli.print_end([sentence], page, _next_command(checked.recordings, options))
    return 1 if checked.failures(fail_on) else 0


def _minima(texts: Sequence[str]) -> dict[str, float]:
    """Return minima by name of texts NAME=VALUE."""
    minima = {}
    for text in texts:
        name, _, value = text.partition('=')
        try:
            minima[name] = float(value)
        except ValueError:
            name = ''
        if name not in gate.MINIMA:
            raise UserError(
                f'--min {text}: expected NAME=VALUE with one of {", ".join(gate.MINIMA)}'
            )
    return minima


def _next_command(results: Sequence[Findings], options: argparse.Namespace) -> str:
    """Return the command of the first tool that can use a sound recording; '' for none."""
    for result in filter(lambda result: result.is_sound, results):
        for ability in result.abilities:
            if ability.is_able and ability.tool != 'diagnose':
                reading = cli.reading_text(options)
                return command(ability.tool, f'{cli.quoted(result.path)}{reading} -o unit.yaml')
    return ''


def main() -> int:
    """Run the tool on the command line."""
    return cli.run(parser(), check)
