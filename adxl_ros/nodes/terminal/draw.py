# Copyright 2026 the adxl_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""What the screen looks like: figures in, lines out, as many as the terminal has."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import re
from textwrap import wrap
from typing import Any, TYPE_CHECKING

if TYPE_CHECKING:
    from rich.console import ConsoleDimensions, Group
    from rich.text import Text

_COLOURS = {'dwell': 'green', 'refused': 'red', 'silent': 'red', 'question': 'yellow',
            'rest': 'yellow', 'stage': 'yellow', 'operator': 'bold cyan', 'fit': 'green'}
_PREFIX = re.compile(r'^\[(\w+)\] \[[\d.]+\] \[[^]]*\]: ')
_LABEL = 10
_MESSAGES = 3
_LEAST_NAME = 24


def draw(figures: Mapping[str, Any], log: Sequence[str], size: ConsoleDimensions) -> Group:
    """
    Lay the figures out.

    Parameters
    ----------
    figures
        As `nodes.support.calibration_console` sends them; what is missing is left out.
    log
        Lines that were logged, newest last.
    size
        Of the terminal.

    """
    from rich.console import Group

    width = max(size.width, 20)
    top = [*_head(figures, width), *_pose(figures, width), *_reading(figures, width),
           *_progress(figures, width)]
    bottom = [*_log(log), _keys(figures)]
    room = size.height - len(top) - len(bottom)
    middle = _outcome(figures, width) or _learned(figures, width)
    lines = [*top, *middle[:max(room, 0)]]
    lines += [_text('')] * (size.height - len(lines) - len(bottom))
    # In a small terminal the keys and what is to be done stay.
    return Group(*lines[:max(size.height - len(bottom), 4)], *bottom)


def _head(figures: Mapping[str, Any], width: int) -> list[Text]:
    unit = figures.get('unit') or 'no sensor yet'
    title = f' calibration of {unit} into {figures.get("output", "")}'
    style = _COLOURS.get(figures['phase'], 'bold')
    return [_text(f'{title:{width}}', 'reverse'),
            *(_text(line, style) for line in wrap(figures['text'], width - 1)[:5])]


def _pose(figures: Mapping[str, Any], width: int) -> list[Text]:
    if 'where' not in figures:
        return []
    number, total = figures['number'], figures['total']
    lines = [_row('pose', f'{number} of {total}: {figures["where"]}'
                  if figures.get('left_s') is not None else f'{number}: {figures["where"]}')]
    if figures.get('off') or figures.get('now'):
        lines.append(_row('now', figures['off'] or figures['now']))
    return lines


def _reading(figures: Mapping[str, Any], width: int) -> list[Text]:
    if not figures.get('live'):
        return []
    shown = '  '.join(f'{axis} {mean:+.3f} ± {rms:.3f}' for axis, mean, rms in figures['live'])
    lines = [_row('reads', f'{shown} m/s²  {figures["rate_hz"]:.0f} Hz')]
    rest = figures.get('rest')
    if rest:
        share = rest['value'] / rest['limit'] if rest['limit'] else 1.0
        what = 'at rest' if rest['still'] else \
            {'rms': 'moving', 'drift': 'drifting'}[rest['figure']]
        lines.append(_row('rest', f'{_bar(share, 12)} {what}: {rest["value"]:.2g} m/s² '
                          f'{rest["figure"]} on {rest["axis"]}, must be below '
                          f'{rest["limit"]:.2g}', 'green' if rest['still'] else 'yellow'))
    if figures.get('dwell'):
        done, wanted = figures['dwell']
        lines.append(_row('dwell', f'{_bar(done / wanted, 12)} {done:.1f} of {wanted:g} s'))
    return lines


def _progress(figures: Mapping[str, Any], width: int) -> list[Text]:
    if 'done' not in figures:
        return []
    done, total, out = figures['done'], figures['total'], figures['skipped']
    left = max(total - done - out, 0)
    time = figures.get('left_s')
    text = f'{_bar((done + out) / total, 12)} {done} done, ' + (
        f'{out} left out, ' if out else '') + f'{left} left' + (
        f', about {_span(time)}' if time is not None else ' for a good fit')
    lines = [_row('poses', text)]
    covered = ', '.join(f'{name} {n}/{of}' for name, n, of in figures['coverage'])
    if figures.get('covered'):
        covered += f' ({figures["covered"]} up)'
    lines += _wrapped('coverage', covered, width)
    end = figures.get('tilt_end_deg')
    if figures['tilt_deg'] is None:
        return [*lines, _row('tilt error', 'no pose shows both angles to one axis')]
    lines.append(_row('tilt error', f'{_degrees(figures["tilt_deg"])} expected now' + (
        '' if end is None else f', {_degrees(end)} after all poses'), 'bold'))
    return lines


def _learned(figures: Mapping[str, Any], width: int) -> list[Text]:
    rows = figures.get('coefficients', ())
    between, bar, values = '  ', 6, [list(shown) for _, shown, _ in rows]

    def room() -> int:
        longest = max((len(between.join(shown)) for shown in values), default=0)
        return min(width - bar - 2 - longest, 36)

    if room() < _LEAST_NAME:
        # Of three axes: what is left out is less than the interval of the last.
        between, bar = ' ', 3
        values = [[one.replace(' ± ', '±') for one in shown] for shown in values]
    name_width = max(room(), 8)
    return [_text(f'{_cut(name, name_width):{name_width}} {_bar(share, bar)} '
                  f'{between.join(shown)}') for (name, _, share), shown in zip(rows, values)]


def _cut(name: str, width: int) -> str:
    return name if len(name) <= width else f'{name[:width - 1]}…'


def _outcome(figures: Mapping[str, Any], width: int) -> list[Text]:
    return [_text(part) for line in figures.get('outcome', ())
            for part in (wrap(line, width - 1) if len(line) >= width else [line])]


def _log(log: Sequence[str]) -> list[Text]:
    lines = []
    for line in log[-_MESSAGES:]:
        found = _PREFIX.match(line)
        level = found[1] if found else 'INFO'
        style = {'WARN': 'yellow', 'ERROR': 'red', 'FATAL': 'red'}.get(level, 'dim')
        lines.append(_text(_PREFIX.sub('', line), style))
    return lines


def _keys(figures: Mapping[str, Any]) -> Text:
    from rich.text import Text

    line = Text(no_wrap=True, overflow='ellipsis')
    for key, action in figures.get('keys', {}).items():
        line.append(f' {key} ', 'reverse')
        line.append(f' {action}  ')
    return line


def _row(label: str, text: str, style: str = '') -> Text:
    return _text(f'{label:{_LABEL}} {text}', style)


def _wrapped(label: str, text: str, width: int) -> list[Text]:
    first, *more = wrap(text, max(width - _LABEL - 1, 10)) or ['']
    return [_row(label, first), *(_row('', line) for line in more[:2])]


def _text(text: str, style: str = '') -> Text:
    from rich.text import Text

    return Text(text, style=style, no_wrap=True, overflow='ellipsis')


def _bar(share: float, width: int) -> str:
    full = round(min(max(share, 0.0), 1.0) * width)
    return '█' * full + '░' * (width - full)


def _degrees(value: float) -> str:
    return f'{value:.2g}°'


def _span(seconds: float) -> str:
    if seconds < 90:
        return f'{seconds:.0f} s'
    return f'{seconds / 60:.0f} min' if seconds < 5400 else f'{seconds / 3600:.1f} h'
