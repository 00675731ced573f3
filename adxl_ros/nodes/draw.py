# SPDX-License-Identifier: Apache-2.0

"""What the screen looks like: contents go in, lines come out, as many as the terminal has."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from textwrap import wrap
from typing import NamedTuple

from adxl_ros.calibrate.guided import screen_contents as screen

Line = list[tuple[str, str]]
"""A line of the screen: styles of prompt_toolkit, each with its text."""
Row = tuple[str, str, str]
"""Label, text and style of a row."""

_COLOURS = {'dwell': 'ansigreen', 'refused': 'ansired', 'silent': 'ansired',
            'question': 'ansiyellow', 'rest': 'ansiyellow', 'stage': 'ansiyellow',
            'operator': 'bold ansicyan', 'fit': 'ansigreen'}
"""Styles by phase."""
_MOTIONS = {'rms': 'moving', 'drift': 'drifting'}
"""What a sensor does that is not at rest, by the quantity that shows it."""
_LEAST_WIDTH = 20
"""A narrower terminal is drawn as if it had this width, columns."""
_LEAST_LINES = 4
"""Lines that a low terminal keeps beside log and keys: title, text, pose and angles."""
_TEXT_LINES = 5
"""Largest number of lines of the text at the top."""
_LABEL_WIDTH = 10
"""Width of the labels, columns: the longest is 'tilt error'."""
_BAR_WIDTH = 12
"""Width of a bar, columns."""
_COEFFICIENT_BAR_WIDTH = 6
"""Width of the bar of a coefficient, columns."""
_NARROW_BAR_WIDTH = 3
"""Width of the bar of a coefficient where a row has little room, columns."""
_SHORTEST_NAME = 8
"""Smallest width of the name of a coefficient, columns."""
_LOG_LINES = 3
"""Largest number of lines of the log."""
_LABELLED_LINES = 3
"""Largest number of lines of a text with a label."""
_LEAST_TEXT_WIDTH = 10
"""Smallest width of a text with a label, columns."""
_LONGEST_IN_S = 90
"""Times below this are shown in seconds, s."""
_LONGEST_IN_MIN_S = 5400
"""Times below this are shown in minutes, s."""


class LogLine(NamedTuple):
    """A line of the log."""

    text: str  # The line
    style: str = 'ansibrightblack'  # Its style


def draw(contents: screen.ScreenContents, log: Sequence[LogLine], columns: int, rows: int
         ) -> list[Line]:
    """Lay the contents out."""
    width = max(columns - 1, _LEAST_WIDTH)
    rows_of_text = chain(_readings(contents.progress, contents.live),
                         _progress(contents.progress, contents.estimate))
    top = [*_head(contents, width),
           *(line for row in rows_of_text for line in _labelled(width, *row))]
    bottom = [*_log(log, width), _keys(contents.keys)]
    middle = _outcome(contents.outcome, width) or _coefficients(contents.estimate, width)
    lines = [*top, *_shorten(middle, rows - len(top) - len(bottom))]
    lines += [_text('')] * (rows - len(lines) - len(bottom))
    # A small terminal keeps the keys and the first lines, which say what to do.
    return [_cut_line(line, width)
            for line in (*lines[:max(rows - len(bottom), _LEAST_LINES)], *bottom)]


def _shorten(lines: list[Line], room: int) -> list[Line]:
    """Return as many lines as there is room for; the last one counts those that are missing."""
    if len(lines) <= room:
        return lines
    kept = max(room - 1, 0)
    return [*lines[:kept], _text(f'… {len(lines) - kept} more lines in a taller window')][:room]


def _head(contents: screen.ScreenContents, width: int) -> list[Line]:
    task = f' of {contents.unit or "no sensor yet"} into {contents.output}'
    title = f' calibration{task if contents.output else ""}'
    style = _COLOURS.get(contents.phase, 'bold')
    return [_text(f'{title:{width}}', 'reverse'),
            *(_text(line, style) for line in wrap(contents.text, width)[:_TEXT_LINES])]


def _readings(progress: screen.Progress | None, live: screen.LiveReading | None) -> Iterator[Row]:
    """Yield the pose, where the stage is, and what the sensor reads."""
    if progress is not None:
        total = '' if progress.remaining_s is None else f' of {progress.total}'
        yield 'pose', f'{progress.number}{total}: {progress.destination}', ''
        if progress.position:
            yield 'now', progress.position, ''
    if live is None:
        return
    axes = '  '.join(f'{axis.axis} {axis.mean_mps2:+.3f} ± {axis.rms_mps2:.3f}'
                     for axis in live.axes)
    rate = '' if live.rate_hz is None else f'  {live.rate_hz:.0f} Hz'
    yield 'reads', f'{axes} m/s²{rate}', ''
    if (rest := live.rest) is not None:
        share = rest.value_mps2 / rest.limit_mps2 if rest.limit_mps2 else 1.0
        motion = 'at rest' if rest.at_rest else _MOTIONS[rest.quantity]
        yield 'rest', (
            f'{_bar(share)} {motion}: {rest.value_mps2:.2g} m/s² {rest.quantity} on {rest.axis}, '
            f'must be below {rest.limit_mps2:.2g}'), 'green' if rest.at_rest else 'yellow'
    if progress is not None and progress.dwell_s is not None and progress.dwelt_s is not None:
        bar = _bar(progress.dwelt_s / progress.dwell_s)
        yield 'dwell', f'{bar} {progress.dwelt_s:.1f} of {progress.dwell_s:g} s', ''


def _progress(progress: screen.Progress | None, estimate: screen.Estimate | None) -> Iterator[Row]:
    """Yield how many poses are done, what they cover, and how good the fit will be."""
    if progress is None or estimate is None:
        return
    closed = progress.accepted + progress.skipped
    skipped = f'{progress.skipped} left out, ' if progress.skipped else ''
    time = ' for a good fit' if progress.remaining_s is None else \
        f', about {_span(progress.remaining_s)}'
    yield 'parts' if estimate.range_error else 'poses', (
        f'{_bar(closed / progress.total)} {progress.accepted} done, {skipped}'
        f'{max(progress.total - closed, 0)} left{time}'), ''
    covered = ', '.join(f'{row.group} {row.accepted}/{row.total}' for row in estimate.coverage)
    faces = f' ({estimate.covered_faces} up)' if estimate.covered_faces else ''
    yield 'coverage', covered + faces, ''
    if estimate.range_error:
        yield 'error', estimate.range_error, ''
    elif estimate.tilt_error_deg is None:
        yield 'tilt error', 'no pose shows both angles to one axis', ''
    else:
        final = '' if estimate.final_tilt_error_deg is None else \
            f', {estimate.final_tilt_error_deg:.2g}° after all poses'
        yield 'tilt error', f'{estimate.tilt_error_deg:.2g}° expected now{final}', 'bold'


def _coefficients(estimate: screen.Estimate | None, width: int) -> list[Line]:
    """Return a row for each coefficient: name, bar and intervals, shortened to the width."""
    if estimate is None:
        return []
    rows, bar_width = estimate.coefficients, _COEFFICIENT_BAR_WIDTH
    texts = {row.name: '  '.join(row.intervals) for row in rows}
    if any(len(name) > _name_room(text, bar_width, width) for name, text in texts.items()):
        # Intervals of three axes are long. The name of a parameter has its unit, too.
        bar_width = _NARROW_BAR_WIDTH
        texts = {row.name.split(',')[0]: ' '.join(row.intervals).replace(' ± ', '±')
                 for row in rows}
    widest = max(map(len, texts), default=0)
    rooms = [min(_name_room(text, bar_width, width), widest) for text in texts.values()]
    return [_text(f'{_cut(name, room):{room}} {_bar(row.determined, bar_width)} {text}')
            for row, (name, text), room in zip(rows, texts.items(), rooms)]


def _name_room(text: str, bar_width: int, width: int) -> int:
    """Return the columns that a name has beside bar and text in a row of a width."""
    return max(width - bar_width - 2 - len(text), _SHORTEST_NAME)


def _cut(text: str, width: int) -> str:
    """Return a text in at most a number of columns; an ellipsis stands for the cut part."""
    return text if len(text) <= width else f'{text[:max(width - 1, 0)]}…'[:width]


def _outcome(outcome: Sequence[str], width: int) -> list[Line]:
    # A line that fits keeps its spaces.
    return [_text(line) for text in outcome
            for line in ([text] if len(text) <= width else wrap(text, width))]


def _log(log: Sequence[LogLine], width: int) -> list[Line]:
    """Return the newest messages that have room as a whole, and always the newest one."""
    lines: list[Line] = []
    for message in reversed(log):
        wrapped = [_text(line, message.style) for line in wrap(message.text, width)]
        if lines and len(lines) + len(wrapped) > _LOG_LINES:
            break
        lines = wrapped[:_LOG_LINES] + lines
    return lines


def _keys(keys: Iterable[screen.KeyAction]) -> Line:
    actions = [(key.key, key.action) for key in keys] + [('q', 'quit')]
    return [part for key, action in actions
            for part in (('reverse', f' {key} '), ('', f' {action}  '))]


def _labelled(width: int, label: str, text: str, style: str) -> list[Line]:
    """Return the first lines of a text beside its label."""
    lines = wrap(text, max(width - _LABEL_WIDTH - 1, _LEAST_TEXT_WIDTH)) or ['']
    return [_text(f'{first:{_LABEL_WIDTH}} {line}', style)
            for first, line in zip((label, *[''] * (_LABELLED_LINES - 1)), lines)]


def _text(text: str, style: str = '') -> Line:
    return [(style, text)]


def _cut_line(line: Line, width: int) -> Line:
    """Return a line in at most a number of columns."""
    room, parts = width, []
    for style, text in line:
        parts.append((style, _cut(text, room)))
        room -= len(parts[-1][1])
    return parts


def _bar(share: float, width: int = _BAR_WIDTH) -> str:
    """Return a bar of a width in columns, of which a share from 0 to 1 is full."""
    full = round(min(max(share, 0.0), 1.0) * width)
    return '█' * full + '░' * (width - full)


def _span(seconds: float) -> str:
    """Return a duration, s, in seconds, minutes or hours."""
    if seconds < _LONGEST_IN_S:
        return f'{seconds:.0f} s'
    if seconds < _LONGEST_IN_MIN_S:
        return f'{seconds / 60:.0f} min'
    return f'{seconds / 3600:.1f} h'
