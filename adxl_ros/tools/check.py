# SPDX-License-Identifier: Apache-2.0

"""Check whether recordings are sound, and what the other tools can do with them."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial
import json
from pathlib import Path

from adxl_ros.api import gate
from adxl_ros.api.checking import check as check_recordings, PAGE
from adxl_ros.errors import UserError
from adxl_ros.process import command
from adxl_ros.report import page as html_page
from adxl_ros.report.screen import wrapped
from adxl_ros.signals.findings import Findings
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
        default=None,
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
    fail_on, minima = _fail_on(options.fail_on), _minima(options.minima)
    if options.report:
        html_page.check_libraries()
    check_like = partial(
        check_recordings,
        sensor=options.params,
        urdf=options.urdf,
        frame=options.frame,
        joints=options.joints,
        reading=cli.reading_options(options),
    )
    with cli.progress('check') as show:
        checked = check_like(options.recording, progress=show)
    failing = [*fail_on, *(f'min {name}' for name in minima)]
    earlier = None
    if options.against:
        # The recording that all others are compared with
        (found,) = check_like(options.against).recordings
        earlier = gate.Earlier(found, options.params, cli.reading_options(options))
    outcomes = [_outcomes(each, earlier, minima) for each in checked.recordings]
    if options.junit:
        gate.write_junit(options.junit, list(zip(checked.recordings, outcomes)), failing)
    page = [checked.save(options.report, overwrite=options.overwrite)] if options.report else []
    if options.json:
        recordings = checked.to_dict()['recordings']
        for entry, rows in zip(recordings, outcomes):
            entry['outcomes'] = [gate.as_json(row) for row in rows]
        print(json.dumps(recordings, indent=1))
    else:
        *lines, sentence = checked.screen
        print('\n'.join([*lines, *_gate_lines(outcomes, earlier)]))
        cli.print_end([sentence], page, _next_command(checked.recordings, options))
    is_failed = any(row.is_worse and row.name in failing for rows in outcomes for row in rows)
    return int(is_failed)


def _fail_on(text: str) -> list[str]:
    kinds = [kind for kind in text.split(',') if kind]
    if unknown := [kind for kind in kinds if kind not in gate.KINDS]:
        raise UserError(f'--fail-on {unknown[0]}: expected some of {", ".join(gate.KINDS)}')
    return kinds


def _minima(texts: Sequence[str]) -> dict[str, float]:
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


def _outcomes(
    findings: Findings, earlier: gate.Earlier | None, minima: dict[str, float]
) -> list[gate.Outcome]:
    """Return whether a recording is sound, its limits, and what became worse."""
    text = 'sound' if findings.is_sound else findings.faults[0]
    outcomes = [gate.Outcome('sound', not findings.is_sound, text)]
    if earlier is not None:
        outcomes += earlier.compare(findings)
    if findings.contents is not None:
        outcomes += gate.limits(findings.contents, minima)
    return outcomes


def _gate_lines(
    outcomes: Sequence[Sequence[gate.Outcome]], earlier: gate.Earlier | None
) -> list[str]:
    """Return what was compared, a line each."""
    head = 'limits'
    if earlier is not None:
        head = f'against {earlier.found.path}'
        head += f', not sound: {earlier.found.faults[0]}' if earlier.found.faults else ''
    lines = []
    for rows in outcomes:
        compared = [row for row in rows if row.name != 'sound']
        if compared:
            lines += wrapped(head, 10)
        for row in compared:
            lines += wrapped(f'  {"WORSE" if row.is_worse else "ok":7} {row.name}: {row.text}', 10)
    return [*lines, *[''] * bool(lines)]


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
