# SPDX-License-Identifier: Apache-2.0

"""Check whether recordings are sound, and what the other tools can do with them."""

from __future__ import annotations

import argparse
from dataclasses import asdict, replace
import json
from pathlib import Path
from typing import Any

from adxl_ros.check.findings import Findings
from adxl_ros.check.recording_check import check_recording
from adxl_ros.diagnose.data_checks import DataFault
from adxl_ros.diagnose.diagnosis import what_shows
from adxl_ros.diagnose.report import shows_row
from adxl_ros.diagnose.visibility import by_effect
from adxl_ros.errors import one_line, UserError
from adxl_ros.files import html_page, recording
from adxl_ros.files.atomic_write import write_text
from adxl_ros.files.reading_options import ReadingOptions
from adxl_ros.signals.recorded_sensor import load_sensor, measure_unstated
from adxl_ros.tools import check_text
from adxl_ros.tools.closing_lines import print_end, quoted
from adxl_ros.tools.command_line import argument_parser, command
from adxl_ros.tools.common import make_folder, progress, run, ShowDone
from adxl_ros.tools.recording_options import (
    add_recording_options,
    reading_options,
    reading_text,
    RECORDING_HELP,
)

_EXAMPLES = {
    'all recordings of a day, with a page': '*.mcap --report check',
    'a log of other software':
        'log.csv \\\n        --columns time=t_ms:ms,x=accX:mg,y=accY:mg,z=accZ:mg',
}
"""Examples of arguments, by their purpose."""


def parser() -> argparse.ArgumentParser:
    """Describe the command line."""
    parse = argument_parser('check', __doc__, _EXAMPLES)
    parse.add_argument('recording', nargs='+', metavar='RECORDING', help=RECORDING_HELP)
    parse.add_argument('--params', metavar='FILE', default=None,
                       help='the sensor, for recordings in volts (default: the nominal sensor)')
    parse.add_argument('--report', metavar='DIR', help='write the page check.html there')
    parse.add_argument('--json', action='store_true', help='print the result as JSON')
    add_recording_options(parse)
    return parse


def check(options: argparse.Namespace) -> int:
    """Run the tool; see `parser`."""
    reading = replace(reading_options(options), drop_bad_stamps=True)
    if options.report:
        html_page.check_libraries()
    results = []
    with progress('check') as show:
        for i, path in enumerate(options.recording):
            step = _Step(show, i, len(options.recording), Path(path).name)
            results.append(check_recording(path, options.params, reading, step))
        if len(results) == 1:
            results = [_with_what_shows(results[0], options.params, reading)]
    page = []
    if options.report:
        make_folder(Path(options.report))
        page = [Path(options.report) / 'check.html']
        write_text(page[0], check_text.page(results))
    if options.json:
        print(json.dumps([_as_json(result) for result in results], indent=1))
    else:
        print('\n'.join(check_text.lines(results)))
        print_end([check_text.verdict(results)], page, _next_command(results, options))
    return 0 if all(result.is_sound for result in results) else 1


def _with_what_shows(result: Findings, params: str | None, reading: ReadingOptions) -> Findings:
    """Add which effects `diagnose` could show in a recording, and from which size."""
    if not result.is_sound or not any(a.tool == 'diagnose' and a.is_able
                                      for a in result.abilities):
        return result
    try:
        read = recording.read(result.path, reading)
        sensor, _ = measure_unstated(load_sensor(params, read), read)
        shown = what_shows([read], sensor)
    except UserError as error:
        return replace(result, remarks=(*result.remarks, one_line(error)))
    if isinstance(shown, DataFault):
        return replace(result, remarks=(*result.remarks, f'diagnose: {shown.message}'))
    scale_v_per_g = float(sensor.scale_v_per_g.mean())
    return replace(result, shows=tuple(
        shows_row(row, scale_v_per_g) for row in sorted(
            by_effect(shown).values(), key=lambda row: (not row.shows, row.effect))))


class _Step:
    """Shows how much of one recording among several is done."""

    def __init__(self, show: ShowDone, number: int, count: int, name: str) -> None:
        self._show, self._number, self._count, self._name = show, number, count, name

    def __call__(self, done: float) -> None:
        """Show the fraction of this recording that is done."""
        self._show((self._number + done) / self._count, self._name)


def _next_command(results: list[Findings], options: argparse.Namespace) -> str:
    """Return the command that a sound recording allows; empty for none."""
    for result in results:
        able = {ability.tool for ability in result.abilities if ability.is_able}
        words = f'{quoted(result.path)}{reading_text(options)}'
        if result.is_sound and 'fit' in able:
            return command('fit', f'{words} -o unit.yaml --report report')
        if result.is_sound and 'noise' in able:
            return command('noise', f'{words} -o noise.yaml --report noise')
    return ''


def _as_json(result: Findings) -> dict[str, Any]:
    """Return the findings for programs, in SI units."""
    values: dict[str, Any] = {}
    if result.contents is not None:
        values = asdict(result.contents)
        values['bad_stamps'] = result.contents.bad_stamps._asdict()
        for name in ('path', 'remarks', 'cut'):
            values.pop(name)
    return {'schema': 1, 'recording': result.path, 'sound': result.is_sound,
            'faults': list(result.faults), 'remarks': list(result.remarks), 'contents': values,
            'can': {ability.tool: {'able': ability.is_able, 'reason': ability.reason}
                    for ability in result.abilities},
            'could_show': [dict(zip(('effect', 'from', 'typical', 'missing'), row))
                           for row in result.shows]}


def main() -> int:
    """Run the tool on the command line."""
    return run(parser(), check)
