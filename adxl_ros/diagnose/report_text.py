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

"""The diagnosis as a screen of text for a terminal of 80 columns."""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import wrap
from typing import Any, NamedTuple

from adxl_ros.diagnose.diagnosis import Diagnosis
from adxl_ros.diagnose.noise_detectors import UNKNOWN
from adxl_ros.diagnose.report_json import as_json, notes, PROBABLE
from adxl_ros.diagnose.report_wording import (
    closed_text,
    closes,
    concern,
    floor_source,
    headline,
    is_only_noise,
    listed,
    lost_text,
    mg,
    mg_text,
    NOISE_STAYS,
    parameter_text,
    pose_is_compared,
    probability_text,
    range_text,
    remainder_rows,
    Row,
)
from adxl_ros.model.effects.base import Concern
import numpy as np

COLUMNS = 79
"""Columns of text. Chosen: a terminal of 80 columns."""
_BADGE_COLUMNS = 28
"""Columns of the verdict before the figures of the gap."""
_VALUE_COLUMNS = 26
"""Columns of the gap before and after."""
_LABEL_COLUMNS = 9
"""Columns of the words before rows of text."""
_SURE_COLUMNS = 8
"""Columns of a probability in the table of effects."""
_SHARE_COLUMNS = 7
"""Columns of a share of the gap in the table of effects."""
_MOST_CELLS = 3
"""Places of the gap that the screen names. Chosen: all of it fits on one screen."""
_MOST_OTHERS = 3
"""Further hypotheses on the screen. Chosen: all of it fits on one screen."""
_UNIT_SUFFIXES = ('m', 's', 'rad', 'v', 'hz', 'f', 'g')
"""Ends of parameter names that repeat the unit of the value."""
_DIMENSIONS = {
    'frequency_hz': '{} Hz', 'temperature_c': '{} °C', 'supply_v': 'supply {} V',
    'time_s': '{} s from the start', 'since_move_s': '{} s after a move',
    'alpha_rad': 'alpha {}°', 'beta_rad': 'beta {}°', 'rate_rad_s': '{} °/s'}
"""Text of a range by dimension; others have their names before it."""


class _EffectRow(NamedTuple):
    """
    An effect in the table.

    Attributes
    ----------
    name
        Its name.
    sure
        Its probability as text.
    sizes
        Its parameters, one line each.
    share
        Its share of the gap as text.

    """

    name: str
    sure: str
    sizes: list[str]
    share: str


def screen_lines(diagnosis: Diagnosis, subject: str) -> list[str]:
    """
    Return the diagnosis as lines: verdict, gap, effects, places and causes.

    Parameters
    ----------
    diagnosis
        The diagnosis.
    subject
        What is compared with what, for the first line.

    Returns
    -------
    list of str
        Lines of at most `COLUMNS` columns.

    """
    lines = [*_wrapped(subject), '']
    note_lines = [line for note in notes(diagnosis) for line in _row_lines('note', note)]
    if diagnosis.data_fault is not None:
        word = badge(diagnosis)
        return [*lines, *_wrapped(f'{word}  {diagnosis.data_fault.message}', len(word) + 2),
                *note_lines]
    report = as_json(diagnosis)
    lines += _gap_lines(diagnosis)
    table = _effect_table(diagnosis, report)
    if table:
        lines += ['', *table]
    if diagnosis.noise_remainders or report['where'] or note_lines:
        lines.append('')
    for i, row in enumerate(remainder_rows(diagnosis)):
        lines += _row_lines('' if i else 'noise', f'{row.label}: {row.text}')
    lines += _where_lines(report['where'])
    lines += _cause_lines(named_effects(diagnosis, report), report)
    return lines + note_lines


def _gap_lines(diagnosis: Diagnosis) -> list[str]:
    """Return verdict and gap, and what the verdict means where that is not plain."""
    assert diagnosis.verdict is not None and diagnosis.gap_closure is not None
    closure = diagnosis.gap_closure
    values = f'{mg_text(closure.before_mps2)} rms'
    further = []
    if closes(diagnosis):
        values = f'{mg_text(closure.before_mps2)} -> {mg_text(closure.after_mps2)} rms'
        further.append(f'{closed_text(diagnosis)} closed on held-out blocks')
    if diagnosis.lost_motion_mps2:
        further += wrap(f'the reference lacks {lost_text(diagnosis)}', COLUMNS - _BADGE_COLUMNS)
    parts = f'zero-g {mg_text(closure.zero_g_mps2)}, drift {mg_text(closure.drift_mps2)}; ' \
        if pose_is_compared(diagnosis) else 'the pose is unknown, so the mean is not compared; '
    further += wrap(f'{parts}floor {floor_source(diagnosis)}', COLUMNS - _BADGE_COLUMNS)
    lines = [f'{badge(diagnosis):{_BADGE_COLUMNS - 1}} {values:{_VALUE_COLUMNS - 1}} '
             f'noise floor {mg_text(closure.floor_mps2)}',
             *(f'{"":{_BADGE_COLUMNS}}{line}' for line in further)]
    concerns = concern(diagnosis.verdict) or ''
    if diagnosis.verdict.status in ('inseparable', 'unknown', 'insufficient') \
            or Concern.REFERENCE.value in concerns:
        lines += _wrapped(headline(diagnosis))
    if is_only_noise(diagnosis):
        lines += _wrapped(NOISE_STAYS)
    return lines


def badge(diagnosis: Diagnosis) -> str:
    """Return the verdict in a few words."""
    if diagnosis.data_fault is not None:
        return 'BAD DATA' if diagnosis.data_fault.status == 'bad_data' else 'TOO LITTLE DATA'
    assert diagnosis.verdict is not None
    verdict = diagnosis.verdict
    count = len(verdict.effects) + len(verdict.groups)
    sure = probability_text(verdict.probability)
    if verdict.status == 'no_gap':
        return f'NO GAP ({sure} sure)'
    if verdict.status == 'insufficient':
        return 'TOO LITTLE DATA'
    if verdict.status == 'unknown':
        return f'UNKNOWN CAUSE ({sure})'
    if verdict.status == 'inseparable':
        return 'CAUSES NOT SEPARATED'
    if concern(verdict) == Concern.REFERENCE.value:
        return 'ERROR OF THE REFERENCE'
    return f'GAP EXPLAINED by {count} effect{"" if count == 1 else "s"}'


def named_effects(diagnosis: Diagnosis, report: dict[str, Any]) -> list[str]:
    """
    Return the effects of the verdict, or the nearest ones to something unknown, by share.

    Parameters
    ----------
    diagnosis
        The diagnosis.
    report
        Its objects of JSON.

    Returns
    -------
    list of str
        Names of effects.

    """
    assert diagnosis.verdict is not None
    verdict = diagnosis.verdict
    named = [*verdict.effects, *(effect for group in verdict.groups for effect in group)]
    if verdict.status == 'unknown':
        named = list(verdict.best.effects)
    shares = {c['effect']: c['share'] or 0.0 for c in report['candidates']}
    return sorted((name for name in dict.fromkeys(named) if name in shares),
                  key=lambda name: -shares[name])


def _effect_table(diagnosis: Diagnosis, report: dict[str, Any]) -> list[str]:
    """Lay out the named effects, and the probable ones that are not named."""
    assert diagnosis.verdict is not None
    named = named_effects(diagnosis, report)
    candidates = {c['effect']: c for c in report['candidates']}
    named_rows = [_effect_row(candidates[name]) for name in named]
    others = _others(diagnosis, report, named)
    if not named_rows:
        return _other_lines(others)
    width = max(map(len, named)) + 2
    title = 'nearest effect' if diagnosis.verdict.status == 'unknown' else 'effect'
    width = max(width, len(title) + 2)
    size_columns = COLUMNS - 1 - width - _SURE_COLUMNS - _SHARE_COLUMNS
    head = (f' {title:{width}}{"sure":{_SURE_COLUMNS}}{"size (90 % interval)":{size_columns - 6}}'
            ' share of gap')
    lines = [head]
    for row in named_rows:
        sizes = [line for size in row.sizes
                 for line in wrap(size, size_columns - 1, subsequent_indent='  ')] or ['']
        lines.append(f' {row.name:{width}}{row.sure:{_SURE_COLUMNS}}{sizes[0]:{size_columns}}'
                     f'{row.share:>{_SHARE_COLUMNS}}'.rstrip())
        lines += [f'{"":{1 + width + _SURE_COLUMNS}}{size}' for size in sizes[1:]]
    return lines + _other_lines(others)


def _effect_row(candidate: dict[str, Any]) -> _EffectRow:
    """Return the row of an effect."""
    share = candidate['share']
    return _EffectRow(candidate['effect'], probability_text(candidate['probability'] or 0.0),
                      _sizes(candidate['parameters']),
                      '' if share is None else f'{100 * share:.0f} %')


def _sizes(parameters: dict[str, Any]) -> list[str]:
    """Return one line for each parameter; those that may be 0 share the last line."""
    names = {key.partition('.')[0] for key in parameters}
    lines, zeros = [], []
    for key, parameter in parameters.items():
        label = parameter_label(key, len(names) == 1)
        ci = parameter.get('ci')
        if ci and ci[0] <= 0 <= ci[1]:
            zeros.append(label)
        else:
            lines.append(f'{label} {parameter_text(parameter)}'.strip())
    if zeros:
        label = ', '.join(filter(None, zeros))
        lines.append(f'{label}: not different from 0' if label else 'not different from 0')
    return lines


def parameter_label(key: str, is_single: bool) -> str:
    """
    Return the name of a parameter without its unit, or its axis where that is enough.

    Parameters
    ----------
    key
        Name of the parameter, with its axis.
    is_single
        Whether the effect has no other parameter.

    Returns
    -------
    str
        The label.

    """
    name, _, axis = key.partition('.')
    stem, _, suffix = name.rpartition('_')
    short = stem if stem and suffix in _UNIT_SUFFIXES else name
    return axis if axis and is_single else f'{short} {axis}'.rstrip()


def _others(diagnosis: Diagnosis, report: dict[str, Any], named: Sequence[str]) -> list[Row]:
    """Return the probabilities of what the verdict does not name, where they are not small."""
    assert diagnosis.verdict is not None
    rows = []
    for candidate in report['candidates']:
        probability = candidate['probability'] or 0.0
        if candidate['effect'] not in named and probability >= PROBABLE:
            rows.append((probability, candidate['effect']))
    unknown = sum(h['probability'] for h in report['hypotheses'] if UNKNOWN in h['effects'])
    if unknown >= PROBABLE and diagnosis.verdict.status != 'unknown':
        rows.append((unknown, 'something unknown'))
    return [Row(name, probability_text(probability))
            for probability, name in sorted(rows, reverse=True)[:_MOST_OTHERS]]


def _other_lines(others: Sequence[Row]) -> list[str]:
    """Return what else is possible as one row of text."""
    if not others:
        return []
    return _row_lines('', 'also possible: ' + listed([f'{row.label} ({row.text})'
                                                      for row in others], 'and'), 1)


def _where_lines(cells: Sequence[dict[str, Any]]) -> list[str]:
    """Return where the gap shows, the largest shares first; one line for each range."""
    axes_of_place: dict[str, list[str]] = {}
    statistics: dict[str, str] = {}
    for cell in cells:
        place = _place_text(cell)
        # The variance says little where the mean of the same range shows.
        if statistics.setdefault(place, cell['statistic']) == cell['statistic']:
            axes_of_place.setdefault(place, []).append(f'{cell["axis"]} {_size_text(cell)}')
    places = list(axes_of_place.items())[:_MOST_CELLS]
    return [line for i, (place, axes) in enumerate(places)
            for line in _row_lines('' if i else 'where', f'{place}: {", ".join(axes)}')]


def _place_text(cell: dict[str, Any]) -> str:
    """Return the range of a cell with its dimension, angles in degrees."""
    dimension, (low, high) = cell['dimension'], cell['range']
    if 'rad' in dimension:
        low, high = np.degrees([low, high])
    return _DIMENSIONS.get(dimension, dimension.replace('_', ' ') + ' {}').format(
        range_text(low, high))


def _size_text(cell: dict[str, Any]) -> str:
    """Return the size of a cell: a mean has a sign, variance and power are rms."""
    size = float(mg(cell['mean']))
    return f'{size:+.2f} mg' if cell['statistic'] == 'mean' else f'{size:.2f} mg rms'


def _cause_lines(named: Sequence[str], report: dict[str, Any]) -> list[str]:
    """Return the causes of effects, and what to do about them."""
    causes = {c['effect']: c['cause'] for c in report['candidates']}
    width = max(map(len, named), default=0) + 2
    return [line for i, name in enumerate(named)
            for line in _row_lines('' if i else 'cause', f'{name:{width}}{causes[name]}',
                                   _LABEL_COLUMNS + width)]


def _row_lines(label: str, text: str, indent: int = _LABEL_COLUMNS) -> list[str]:
    """Return a text behind its label, wrapped between words."""
    start = f' {label:{min(indent, _LABEL_COLUMNS) - 1}}'
    return wrap(text, COLUMNS, initial_indent=start, subsequent_indent=indent * ' ',
                break_long_words=False, break_on_hyphens=False)


def _wrapped(text: str, indent: int = 0) -> list[str]:
    """Wrap a text between words; further lines have an indent."""
    return wrap(text, COLUMNS, subsequent_indent=indent * ' ', break_long_words=False,
                break_on_hyphens=False)
