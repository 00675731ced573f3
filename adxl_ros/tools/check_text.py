# SPDX-License-Identifier: Apache-2.0

"""The text and the page of `check`."""

from __future__ import annotations

from pathlib import Path
import textwrap

from adxl_ros.calibrate.value_text import duration
from adxl_ros.check.findings import Findings
from adxl_ros.files import html_page
from adxl_ros.signals.recording_contents import RecordingContents
from adxl_ros.tools.command_line import COLUMNS

_NAME_COLUMNS = 21
"""Columns of the name of a recording."""
_WIDTHS = (13, 10, 9, 8, 6)
"""Columns of length, rate, missing samples, share at rest and axes."""
_HEAD = ('length', 'rate', 'missing', 'rest', 'axes')
SHOWS_HEAD = ('effect', 'from', 'typical', '')
_MOST_DETAILED = 3
"""Recordings up to which the details of sound ones are printed, too. Chosen: a screen."""
_LABEL_COLUMNS = 12
"""Columns of the label of a line below a recording."""


def lines(results: list[Findings]) -> list[str]:
    """Return a line for each recording, then why some are not sound, 79 columns at most."""
    head = ''.join(f'{name:>{width}}' for name, width in zip(_HEAD, _WIDTHS))
    rows = [f' {"recording":{_NAME_COLUMNS - 1}}{head}  verdict']
    for result in results:
        cells = _cells(result.contents)
        text = ''.join(f'{cell:>{width}}' for cell, width in zip(cells, _WIDTHS))
        rows.append(f' {_short(result.path):{_NAME_COLUMNS - 1}}{text}  {_verdict(result)}')
    detailed = results if len(results) <= _MOST_DETAILED else \
        [result for result in results if not result.is_sound]
    for result in detailed:
        rows += ['', result.path, *_details(result)]
        if result.shows:
            count = sum(not missing for *_, missing in result.shows)
            rows += ['', f'  {count} of {len(result.shows)} effects could show to diagnose',
                     *(f'  {a:24}{b:16}{c:14}{d}'.rstrip()
                       for a, b, c, d in (SHOWS_HEAD, *result.shows))]
    if len(detailed) < len(results):
        rows += ['', '--report DIR and --json have the details of all recordings.']
    return [*rows, '']


def verdict(results: list[Findings]) -> str:
    """Return how many recordings are sound."""
    if len(results) == 1:
        return f'The recording is {"" if results[0].is_sound else "not "}sound.'
    count = sum(result.is_sound for result in results)
    return f'{count} of {len(results)} recordings ' + ('is sound.' if count == 1 else 'are sound.')


def _cells(contents: RecordingContents | None) -> list[str]:
    """Return length, rate, missing samples, share at rest and axes."""
    if contents is None:
        return ['–'] * len(_WIDTHS)
    return [duration(contents.span_s), f'{contents.rate_hz:.4g} Hz', str(contents.missing),
            f'{100 * contents.rest_share:.0f} %', 'xyz'[:len(contents.axes)]]


def _verdict(result: Findings) -> str:
    """Return the verdict in one or two words."""
    return 'sound' if result.is_sound else 'NOT SOUND' if result.contents else 'unreadable'


def _short(path: str) -> str:
    """Return the name of a recording, with its end cut where it is long."""
    name = Path(path).name
    return name if len(name) < _NAME_COLUMNS - 1 else f'{name[:_NAME_COLUMNS - 3]}…'


def _entries(result: Findings) -> list[tuple[str, str]]:
    """Return faults, values, remarks and abilities of a recording, each with its label."""
    entries = [('NOT SOUND' if result.contents else 'unreadable', fault)
               for fault in result.faults]
    if result.contents is not None:
        entries += [('values', text) for text in values(result.contents)]
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
    return rows


def values(contents: RecordingContents) -> list[str]:
    """Return stamps, ranges and references of a recording, for people."""
    texts = [f'{contents.samples} samples, jitter {_milliseconds(contents.jitter_s)} rms']
    texts.append(', '.join(f'{axis.name} {axis.lowest_mps2:.3g} to {axis.highest_mps2:.3g} m/s²'
                           for axis in contents.axes))
    units = {'rad': 'rad', 'm': 'm', 'c': '°C', 'v': 'V'}
    texts += [f'{name} {low:.4g} to {high:.4g} {units[name.rsplit("_", 1)[1]]}'
              for name, (low, high) in contents.reference_ranges.items()]
    if contents.delay is not None:
        texts.append(f'log time minus header time {_milliseconds(contents.delay.median_s)}, '
                     f'spread {_milliseconds(contents.delay.spread_s)}')
    return texts


def _milliseconds(seconds: float) -> str:
    """Return a time that is mostly short."""
    if abs(seconds) >= 1:
        return f'{seconds:.4g} s'
    return f'{1e3 * seconds:.3g} ms' if abs(seconds) >= 1e-6 else '< 0.001 ms'


def page(results: list[Findings]) -> str:
    """Return the page."""
    is_sound = all(result.is_sound for result in results)
    badge = {'colour': 'green' if is_sound else 'red', 'sentence': verdict(results),
             'word': 'Sound.' if is_sound else 'Not sound.'}
    rows = [[Path(result.path).name, *_cells(result.contents), _verdict(result)]
            for result in results]
    recordings = [{'path': result.path, 'entries': _entries(result), 'shows': result.shows}
                  for result in results]
    return html_page.render('adxl_ros.tools', 'check.html', {
        'title': 'Check of recordings', 'about': [], 'badge': badge,
        'figures': {}, 'columns': ('recording', *_HEAD, 'verdict'), 'rows': rows,
        'recordings': recordings, 'shows_head': SHOWS_HEAD})
