# SPDX-License-Identifier: Apache-2.0

"""What a check found, for people: the screen, the page and the JSON of recordings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
import textwrap
from typing import Any

from adxl_ros.report import page as html_page
from adxl_ros.report.quantities import column_unit, counted, duration, short_time
from adxl_ros.report.screen import COLUMNS, row, wrapped
from adxl_ros.signals.axis_ranges import AxisRange
from adxl_ros.signals.findings import Findings
from adxl_ros.signals.gate import Outcome
from adxl_ros.signals.gyroscope_turns import GyroFindings
from adxl_ros.signals.recording_contents import RecordingContents
import numpy as np

PAGE = 'check.html'  # Name of the page in the folder of the report
_LABEL_COLUMNS = 12  # Columns of the label of a line below a recording
_NAME_COLUMNS = 20  # Columns of the name of a recording
HEAD = ('recording', 'length', 'rate', 'missing', 'rest', 'axes', 'verdict')
_COLUMNS = (_NAME_COLUMNS, '>12', '>12', '>8', '>8', '>6', 11)
_SHOWS_HEAD = ('effect', 'from', 'typical', '')
_SHOWS_COLUMNS = (24, 16, 14)
_NOT_IN_CONTENTS = ('path', 'remarks', 'cut', 'gravity', 'neighbour_faults', 'angle_fault')
"""Fields of the contents that have another place in the JSON."""


def screen_lines(results: Sequence[Findings]) -> list[str]:
    """Return a line for each recording, then the details of one, or of those with a fault."""
    rows = []
    for name, *cells, verdict in (HEAD, *map(table_row, results)):
        short = name if len(name) < _NAME_COLUMNS else f'{name[: _NAME_COLUMNS - 2]}…'
        rows.append(' ' + row((short, *cells, f'  {verdict}'), _COLUMNS))
    for result in results:
        if len(results) == 1 or not result.is_sound:
            rows += ['', result.path, *_details(result)]
    return [*rows, '']


def sentence(results: Sequence[Findings]) -> str:
    """Return the outcome of a check."""
    if len(results) == 1:
        return f'The recording is {"" if results[0].is_sound else "not "}sound.'
    count = sum(result.is_sound for result in results)
    return f'{count} of {len(results)} recordings ' + ('is sound.' if count == 1 else 'are sound.')


def table_row(result: Findings) -> list[str]:
    """Return name, figures and outcome of a recording, as `HEAD` names them."""
    name = Path(result.path).name
    contents = result.contents
    if contents is None:
        return [name, *['–'] * 5, 'unreadable']
    return [
        name,
        duration(contents.span_s),
        f'{contents.rate_hz:.4g} Hz',
        str(contents.missing),
        f'{100 * contents.rest_share:.0f} %',
        'xyz'[: len(contents.axes)],
        'sound' if result.is_sound else 'NOT SOUND',
    ]


def _entries(result: Findings) -> list[tuple[str, str]]:
    """Return faults, values, remarks and abilities of a recording, each with its label."""
    entries = [
        ('NOT SOUND' if result.contents else 'unreadable', fault) for fault in result.faults
    ]
    if result.contents is not None:
        entries += [('values', text) for text in _value_lines(result.contents)]
    entries += [('remark', remark) for remark in result.remarks]
    return entries + [
        (ability.tool, f'{"yes" if ability.is_able else "no"}: {ability.reason}')
        for ability in result.abilities
    ]


def _details(result: Findings) -> list[str]:
    """Return the lines below the name of a recording; options to paste are one line."""
    rows = []
    for label, text in _entries(result):
        paste = result.paste if result.paste and text.endswith(result.paste) else ''
        rows += textwrap.wrap(
            f'  {label:{_LABEL_COLUMNS - 3}} {text.removesuffix(paste).rstrip()}',
            COLUMNS,
            subsequent_indent=_LABEL_COLUMNS * ' ',
            break_on_hyphens=False,
        )
        if paste:
            rows.append(_LABEL_COLUMNS * ' ' + paste)
    if result.shows:
        shown = [effect for effect in result.shows if not effect.missing]
        rows += [
            '',
            f'  {len(shown)} of {len(result.shows)} effects could show to diagnose',
            *('  ' + row(cells, _SHOWS_COLUMNS) for cells in (_SHOWS_HEAD, *shown)),
            '',
            '  the others cannot show',
        ]
    for missing in dict.fromkeys(each.missing for each in result.shows if each.missing):
        effects = ', '.join(each.effect for each in result.shows if each.missing == missing)
        rows += wrapped(f'  {missing}: {effects}', 4)
    return rows


def gate_lines(outcomes: Sequence[Sequence[Outcome]], against: str) -> list[str]:
    """Return what was compared with another recording and with limits, a line each."""
    lines = []
    for rows in outcomes:
        compared = [row for row in rows if row.name != 'sound']
        if compared:
            lines.append(f'against {against}' if against else 'limits')
        for outcome in compared:
            mark = 'WORSE' if outcome.is_worse else 'ok'
            lines += wrapped(f'  {mark:7} {outcome.name}: {outcome.text}', 10)
    return [*lines, ''] if lines else []


def _value_lines(contents: RecordingContents) -> list[str]:
    """Return the figures of a recording, one line each."""
    texts = [
        f'{contents.samples} samples, jitter {short_time(contents.jitter_s)} rms',
        ', '.join(
            f'{axis.name} {axis.lowest:.3g} to {axis.highest:.3g} m/s²' for axis in contents.axes
        ),
        *(
            f'{name} {low:.4g} to {high:.4g} {column_unit(name)}'
            for name, (low, high) in contents.reference_ranges.items()
        ),
        contents.gravity.text,
    ]
    if contents.gyro:
        texts.append(_gyro_text(contents.gyro))
    if contents.log_delay_s is not None:
        texts.append(f'log time minus header time {short_time(contents.log_delay_s)}')
    return texts


def _gyro_text(gyro: GyroFindings) -> str:
    """Return what a gyroscope reads at rest, and whether it follows the turns, for people."""
    if not gyro.bias_radps:
        return 'gyroscope: not checked, nothing rests'
    bias = ', '.join(f'{np.degrees(bias):.3g}' for bias in gyro.bias_radps)
    turns = (
        f'it misses gravity by {np.degrees(gyro.error_rad):.3g}° rms after '
        f'{counted(gyro.turns, "turn")}'
        if gyro.turns
        else 'no turn between two rests shows its axes'
    )
    return f'gyroscope at rest {bias} °/s; {turns}'


def page(results: Sequence[Findings], badge: Mapping[str, Any]) -> str:
    """Return the page of a check; badge is its top."""
    recordings = [
        {'path': result.path, 'entries': _entries(result), 'shows': result.shows}
        for result in results
    ]
    return html_page.render(
        'adxl_ros.signals',
        PAGE,
        {
            'title': 'Check of recordings',
            'badge': badge,
            'columns': HEAD,
            'rows': list(map(table_row, results)),
            'recordings': recordings,
            'shows_head': _SHOWS_HEAD,
        },
    )


def _axis_as_json(axis: AxisRange) -> dict[str, Any]:
    """Return the range of an axis of the sensor's output."""
    return {
        'name': axis.name,
        'lowest_mps2': axis.lowest,
        'highest_mps2': axis.highest,
        'clipped': axis.clipped,
        'is_stuck': axis.is_stuck,
        'stuck_s': axis.stuck_s,
    }


def as_json(result: Findings, outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Return what was found in a recording, as `check --json` prints it."""
    values: dict[str, Any] = {}
    if result.contents is not None:
        values = {
            name: value
            for name, value in asdict(result.contents).items()
            if name not in _NOT_IN_CONTENTS
        }
        values['axes'] = [_axis_as_json(axis) for axis in result.contents.axes]
        values['gravity'] = result.contents.gravity.as_json()
        values['bad_stamps'] = result.contents.bad_stamps._asdict()
    return {
        'schema': 1,
        'recording': result.path,
        'sound': result.is_sound,
        'faults': list(result.faults),
        'remarks': list(result.remarks),
        'contents': values,
        'can': {
            ability.tool: {'able': ability.is_able, 'reason': ability.reason}
            for ability in result.abilities
        },
        'could_show': [
            dict(zip(('effect', 'from', 'typical', 'missing'), row)) for row in result.shows
        ],
        'outcomes': [
            {
                'name': outcome.name,
                'worse': outcome.is_worse,
                'text': outcome.text,
                'interval': outcome.interval,
            }
            for outcome in outcomes
        ],
    }
