# SPDX-License-Identifier: Apache-2.0

"""Check whether recordings are sound, and what the other tools can do with them."""

from __future__ import annotations

import argparse
from dataclasses import asdict, replace
import json
from pathlib import Path
import textwrap
from typing import Any

from adxl_ros.diagnose.data_checks import DataFault
from adxl_ros.diagnose.diagnosis import what_shows
from adxl_ros.diagnose.report import shows_row
from adxl_ros.errors import one_line, UserError
from adxl_ros.files import recording
from adxl_ros.files.atomic_write import write_text
from adxl_ros.files.column_mapping import ReadingOptions
from adxl_ros.process import command
from adxl_ros.report import page as html_page
from adxl_ros.report.quantities import column_unit, duration, short_time
from adxl_ros.report.screen import COLUMNS, row, wrapped
from adxl_ros.signals.findings import Ability, check_recording, Findings, RecordingContents
from adxl_ros.signals.recorded_sensor import load_sensor, measure_unstated
from adxl_ros.tools import command_line as cli

_NAME_COLUMNS = 20  # Columns of the name of a recording
_HEAD = ('recording', 'length', 'rate', 'missing', 'rest', 'axes', 'verdict')
_COLUMNS = (_NAME_COLUMNS, '>13', '>10', '>9', '>8', '>6', 11)
_SHOWS_HEAD = ('effect', 'from', 'typical', '')
_SHOWS_COLUMNS = (24, 16, 14)
_MOST_SHOWN = 1_000_000
"""Samples up to which it is listed what `diagnose` could show. Chosen: a minute, and 1 GB."""
_PAGE = 'check.html'  # Name of the page in the folder of the report
_LABEL_COLUMNS = 12  # Columns of the label of a line below a recording


def _lines(results: list[Findings]) -> list[str]:
    """Return a line for each recording, then the details of one, or of those with a fault."""
    rows = []
    for name, *cells, verdict in (_HEAD, *map(_cells, results)):
        short = name if len(name) < _NAME_COLUMNS else f'{name[:_NAME_COLUMNS - 2]}…'
        rows.append(' ' + row((short, *cells, f'  {verdict}'), _COLUMNS))
    for result in results:
        if len(results) == 1 or not result.is_sound:
            rows += ['', result.path, *_details(result)]
    return [*rows, '']


def _sentence(results: list[Findings]) -> str:
    if len(results) == 1:
        return f'The recording is {"" if results[0].is_sound else "not "}sound.'
    count = sum(result.is_sound for result in results)
    return f'{count} of {len(results)} recordings ' + ('is sound.' if count == 1 else 'are sound.')


def _cells(result: Findings) -> list[str]:
    name, contents = Path(result.path).name, result.contents
    if contents is None:
        return [name, *['–'] * 5, 'unreadable']
    return [name, duration(contents.span_s), f'{contents.rate_hz:.4g} Hz', str(contents.missing),
            f'{100 * contents.rest_share:.0f} %', 'xyz'[:len(contents.axes)],
            'sound' if result.is_sound else 'NOT SOUND']


def _entries(result: Findings) -> list[tuple[str, str]]:
    """Return faults, values, remarks and abilities of a recording, each with its label."""
    entries = [('NOT SOUND' if result.contents else 'unreadable', fault)
               for fault in result.faults]
    if result.contents is not None:
        entries += [('values', text) for text in _value_lines(result.contents)]
    entries += [('remark', remark) for remark in result.remarks]
    return entries + [(ability.tool, f'{"yes" if ability.is_able else "no"}: {ability.reason}')
                      for ability in result.abilities]


def _details(result: Findings) -> list[str]:
    """Return the lines below the name of a recording; options to paste are one line."""
    rows = []
    for label, text in _entries(result):
        paste = result.paste if result.paste and text.endswith(result.paste) else ''
        rows += textwrap.wrap(
            f'  {label:{_LABEL_COLUMNS - 3}} {text.removesuffix(paste).rstrip()}', COLUMNS,
            subsequent_indent=_LABEL_COLUMNS * ' ', break_on_hyphens=False)
        rows += [_LABEL_COLUMNS * ' ' + paste] if paste else []
    shown = [cells for cells in result.shows if not cells[3]]
    if result.shows:
        rows += ['', f'  {len(shown)} of {len(result.shows)} effects could show to diagnose',
                 *('  ' + row(cells, _SHOWS_COLUMNS) for cells in (_SHOWS_HEAD, *shown)),
                 '', '  the others cannot show']
    for missing in dict.fromkeys(cells[3] for cells in result.shows if cells[3]):
        effects = ', '.join(cells[0] for cells in result.shows if cells[3] == missing)
        rows += wrapped(f'  {missing}: {effects}', 4)
    return rows


def _value_lines(contents: RecordingContents) -> list[str]:
    texts = [f'{contents.samples} samples, jitter {short_time(contents.jitter_s)} rms',
             ', '.join(f'{axis.name} {axis.lowest_mps2:.3g} to {axis.highest_mps2:.3g} m/s²'
                       for axis in contents.axes),
             *(f'{name} {low:.4g} to {high:.4g} {column_unit(name)}'
               for name, (low, high) in contents.reference_ranges.items()),
             contents.gravity.text]
    if contents.log_delay_s is not None:
        texts.append(f'log time minus header time {short_time(contents.log_delay_s)}')
    return texts


def _page(results: list[Findings]) -> str:
    is_sound = all(result.is_sound for result in results)
    badge = {'colour': 'green' if is_sound else 'red', 'sentence': _sentence(results),
             'word': 'Sound.' if is_sound else 'Not sound.'}
    recordings = [{'path': result.path, 'entries': _entries(result), 'shows': result.shows}
                  for result in results]
    return html_page.render('adxl_ros.tools', 'check.html', {
        'title': 'Check of recordings', 'about': [], 'badge': badge,
        'figures': {}, 'columns': _HEAD, 'rows': list(map(_cells, results)),
        'recordings': recordings, 'shows_head': _SHOWS_HEAD})


_EXAMPLES = {
    'all recordings of a day, with a page': '*.mcap --report check',
    'a log of other software':
        'log.csv --columns time=t_ms:ms,x=accX:mg,y=accY:mg,z=accZ:mg',
}
"""Examples of arguments, by their purpose."""


def parser() -> argparse.ArgumentParser:
    """Describe the command line."""
    parse = cli.argument_parser('check', __doc__, _EXAMPLES)
    parse.add_argument('recording', nargs='+', metavar='RECORDING', help=cli.RECORDING_HELP)
    parse.add_argument('--params', metavar='FILE', default=None,
                       help='the sensor, for recordings in volts (default: the nominal sensor)')
    parse.add_argument('--report', metavar='DIR', help='write the page check.html there')
    cli.add_overwrite_option(parse)
    parse.add_argument('--json', action='store_true', help='print the result as JSON')
    cli.add_robot_options(parse)
    cli.add_recording_options(parse)
    return parse


def check(options: argparse.Namespace) -> int:
    """Run the tool; see `parser`."""
    reading = replace(cli.reading_options(options), drop_bad_stamps=True)
    cli.check_outputs(options, options.report and Path(options.report, _PAGE))
    if options.report:
        html_page.check_libraries()
    results, count = [], len(options.recording)
    with cli.progress('check') as show:
        for i, path in enumerate(options.recording):
            def step(done: float, i: int = i, name: str = Path(path).name) -> None:
                show((i + done) / count, name)

            results.append(check_recording(path, options.params, reading, step))
        if len(results) == 1:
            results = [_with_what_shows(results[0], options, reading)]
    page = []
    if options.report:
        cli.make_folder(Path(options.report))
        page = [Path(options.report, _PAGE)]
        write_text(page[0], _page(results))
    if options.json:
        print(json.dumps([_as_json(result) for result in results], indent=1))
    else:
        print('\n'.join(_lines(results)))
        cli.print_end([_sentence(results)], page, _next_command(results, options))
    return 0 if all(result.is_sound for result in results) else 1


def _with_what_shows(result: Findings, options: argparse.Namespace, reading: ReadingOptions
                     ) -> Findings:
    """Add which effects `diagnose` could show in a recording, and from which size."""
    if not result.is_sound or not (options.urdf or any(
            a.tool == 'diagnose' and a.is_able for a in result.abilities)):
        return result
    if result.contents is None or result.contents.samples > _MOST_SHOWN:
        return replace(result, remarks=(
            *result.remarks, 'what diagnose could show is listed for recordings of '
            f'{_MOST_SHOWN} samples at most; check a part'))
    reason, sim = 'against the joints of the robot', None
    try:
        read = recording.read(result.path, reading)
        sensor, _ = measure_unstated(load_sensor(options.params, read), read)
        if options.urdf:
            robot = cli.robot_path(options, read, sensor)
            result = replace(result, remarks=(*result.remarks, robot.text()))
            sim = robot.as_motion()
        shown = what_shows([read], sensor, sim)
        if isinstance(shown, DataFault):
            reason = shown.message
        else:
            result = replace(result, shows=tuple(
                shows_row(effect, float(sensor.scale_v_per_g.mean()))
                for effect in sorted(shown, key=lambda effect: not effect.shows)))
    except UserError as error:
        reason = one_line(error)
        if options.urdf:
            result = replace(result, faults=(*result.faults, reason))
    if options.urdf or not result.shows:
        ability = Ability('diagnose', bool(result.shows), reason)
        result = replace(result, abilities=tuple(
            ability if a.tool == ability.tool else a for a in result.abilities))
    return result


def _next_command(results: list[Findings], options: argparse.Namespace) -> str:
    able = [(result.path, ability.tool) for result in results if result.is_sound
            for ability in result.abilities if ability.is_able and ability.tool != 'diagnose']
    return command(able[0][1], f'{cli.quoted(able[0][0])}{cli.reading_text(options)} '
                       '-o unit.yaml') if able else ''


def _as_json(result: Findings) -> dict[str, Any]:
    values: dict[str, Any] = {}
    if result.contents is not None:
        values = {name: value for name, value in asdict(result.contents).items()
                  if name not in ('path', 'remarks', 'cut', 'gravity', 'neighbour_faults')}
        values['gravity'] = result.contents.gravity.as_json()
        values['bad_stamps'] = result.contents.bad_stamps._asdict()
    return {'schema': 1, 'recording': result.path, 'sound': result.is_sound,
            'faults': list(result.faults), 'remarks': list(result.remarks), 'contents': values,
            'can': {ability.tool: {'able': ability.is_able, 'reason': ability.reason}
                    for ability in result.abilities},
            'could_show': [dict(zip(('effect', 'from', 'typical', 'missing'), row))
                           for row in result.shows]}


def main() -> int:
    """Run the tool on the command line."""
    return cli.run(parser(), check)
