# SPDX-License-Identifier: Apache-2.0
"""The diagnosis as a screen of text for a terminal of 80 columns."""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import wrap
from typing import Any

from adxl_ros.diagnose import report as words
from adxl_ros.diagnose.diagnosis import Diagnosis, Report
from adxl_ros.diagnose.noise_detectors import UNKNOWN
from adxl_ros.diagnose.visibility import by_effect

COLUMNS = 79
"""Columns of text. Chosen: a terminal of 80 columns."""
_BADGE_COLUMNS, _GAP_COLUMNS, _LABEL_COLUMNS = 29, 24, 9
"""Columns of the verdict, of the gap before and after, and of the words before rows of text."""
_SURE_COLUMNS, _SHARE_COLUMNS = 8, 7
"""Columns of the table of effects."""
_MOST_SHOWN, _MOST_HIDDEN, _MOST_OTHERS = 4, 4, 3
"""Effects that the screen lists; the page has all of them."""


def screen_lines(diagnosis: Diagnosis, subject: str) -> list[str]:
    """Return the diagnosis as lines of at most `COLUMNS` columns; the first one is the subject."""
    lines, word, report = [*_wrapped(subject), ''], words.badge(diagnosis), diagnosis.report
    note_lines = [line for note in words.notes(diagnosis) for line in _row_lines('note', note)]
    if report is None:
        lines += _wrapped(f'{word}  {words.headline(diagnosis)}', len(word) + 2)
        return lines + note_lines
    objects = words.as_json(diagnosis)
    rows = words.figure_rows(diagnosis)
    lines += _verdict_lines(diagnosis, report)
    lines += _effect_table(report, objects)
    # The gap, with the effects, and the floor stand in the first line.
    first = 3 if words.closes(report) else 2
    figures = [f'{row.label} {row.text}' for row in rows[first:]]
    lines += ['', *_row_lines('figures', '; '.join(figures))]
    lines += [line for i, row in enumerate(words.remainder_rows(report))
              for line in _row_lines('' if i else 'noise', f'{row.label}: {row.text}')]
    lines += _row_lines('shows', shown_text(report))
    named, causes = named_effects(report, objects), {
        c['effect']: c['cause'] for c in objects['candidates']}
    width = max(map(len, named), default=0) + 2
    lines += [line for i, name in enumerate(named)
              for line in _row_lines('' if i else 'cause', f'{name:{width}}{causes[name]}',
                                     _LABEL_COLUMNS + width)]
    return lines + note_lines


def _verdict_lines(diagnosis: Diagnosis, report: Report) -> list[str]:
    """Return verdict and gap, and what the verdict means where that is not plain."""
    closure, verdict = report.closure, report.verdict
    gap = f'{words.mg_text(closure.before_mps2)} rms'
    if words.closes(report):
        gap = f'{words.mg_text(closure.before_mps2)} -> {words.mg_text(closure.after_mps2)} rms'
    rows = {row.label: row for row in words.figure_rows(diagnosis)}
    lines = [f'{words.badge(diagnosis):{_BADGE_COLUMNS - 1}} {gap:{_GAP_COLUMNS - 1}} '
             f'noise floor {words.mg_text(closure.floor_mps2)}']
    remarks = [rows['with the effects'].note] if words.closes(report) else \
        [] if 'sim' in rows['gap'].note else [f'gap {rows["gap"].note}']
    remarks.append(f'noise floor {rows["noise floor"].note}')
    lines += [f'{"":{_BADGE_COLUMNS}}{line}' for remark in remarks
              for line in wrap(remark, COLUMNS - _BADGE_COLUMNS)]
    if verdict.status != 'explained' or 'REFERENCE' in words.badge(diagnosis):
        lines += _wrapped(words.headline(diagnosis))
    elif words.is_only_noise(report):
        lines += _wrapped(words.NOISE_STAYS)
    return lines


def shown_text(report: Report) -> str:
    """Return how many effects would have shown, some of them, and some that could not."""
    rows = by_effect(report.could_show)
    scale = float(report.baseline.scale_v_per_g.mean())
    named = {*report.verdict.effects, *sum(report.verdict.groups, ())}
    shown = [f'{name} from {words.shown_row(row, scale)[2]}' for name, row in rows.items()
             if row.shows and name not in named]
    hidden = [name for name, row in rows.items() if not row.shows]
    text = f'{sum(r.shows for r in rows.values())} of {len(rows)} effects could show'
    if shown:
        text += f': {", ".join(shown[:_MOST_SHOWN])}, ...'
    if hidden:
        more = ', ...' if len(hidden) > _MOST_HIDDEN else ''
        text += f'; could not: {", ".join(hidden[:_MOST_HIDDEN])}{more}'
    return text


def named_effects(report: Report, objects: dict[str, Any]) -> list[str]:
    """Return the effects of the verdict by their share of the gap."""
    named = [*report.verdict.effects, *sum(report.verdict.groups, ())]
    shares = {c['effect']: c['share'] or 0.0 for c in objects['candidates']}
    return sorted((name for name in dict.fromkeys(named) if name in shares),
                  key=lambda name: -shares[name])


def _effect_table(report: Report, objects: dict[str, Any]) -> list[str]:
    """Lay out the named effects, and the probable ones that are not named."""
    named = named_effects(report, objects)
    candidates = {c['effect']: c for c in objects['candidates']}
    others = [(c['probability'], name) for name, c in candidates.items()
              if name not in named and c['probability'] >= words.PROBABLE]
    unknown = sum(h['probability'] for h in objects['hypotheses'] if UNKNOWN in h['effects'])
    if unknown >= words.PROBABLE and report.verdict.status != 'unknown':
        others.append((unknown, 'something unknown'))
    lines = []
    if named:
        width = max(map(len, ('effect', *named))) + 2
        size_columns = COLUMNS - 1 - width - _SURE_COLUMNS - _SHARE_COLUMNS
        lines = ['', f' {"effect":{width}}{"sure":{_SURE_COLUMNS}}'
                 f'{"size (90 % interval)":{size_columns - 6}} share of gap']
    for name in named:
        share, sure = candidates[name]['share'], words.percent(candidates[name]['probability'])
        sizes = [line for size in size_lines(report, candidates[name])
                 for line in wrap(size, size_columns - 1, subsequent_indent='  ')] or ['']
        lines.append(f' {name:{width}}{sure:{_SURE_COLUMNS}}{sizes[0]:{size_columns}}'
                     f'{"" if share is None else words.percent(share):>{_SHARE_COLUMNS}}'.rstrip())
        lines += [f'{"":{1 + width + _SURE_COLUMNS}}{size}' for size in sizes[1:]]
    if others:
        texts = [f'{name} ({words.percent(p)})' for p, name in sorted(others, reverse=True)]
        lines += [] if named else ['']
        lines += _row_lines('', 'also possible: ' + words.listed(texts[:_MOST_OTHERS], 'and'), 1)
    return lines


def size_lines(report: Report, candidate: dict[str, Any]) -> list[str]:
    """Return one line for each parameter; those that may be 0 share the last line."""
    parameters = candidate['parameters']
    is_single = len({key.partition('.')[0] for key in parameters}) == 1
    lines, zeros = [], []
    for key, parameter in parameters.items():
        label, ci = words.parameter_label(key, is_single), parameter.get('ci')
        if ci and ci[0] <= 0 <= ci[1]:
            zeros.append(label)
        else:
            text = words.parameter_text(parameter, axis_scale(report, key))
            lines.append(f'{label} {text}'.strip())
    return lines + ([f'{", ".join(zeros)}: not different from 0'.removeprefix(': ')]
                    if zeros else [])


def axis_scale(report: Report, key: str) -> float:
    """Return the scale factor, V/g, of the axis of a parameter; the mean one without an axis."""
    axis = key.partition('.')[2]
    scales = dict(zip(report.baseline.axes, report.baseline.scale_v_per_g))
    return float(scales.get(axis, report.baseline.scale_v_per_g.mean()))


def _row_lines(label: str, text: str, indent: int = _LABEL_COLUMNS) -> list[str]:
    """Return a text behind its label, wrapped between words."""
    start = f' {label:{min(indent, _LABEL_COLUMNS) - 1}}'
    return wrap(text, COLUMNS, initial_indent=start, subsequent_indent=indent * ' ',
                break_long_words=False, break_on_hyphens=False)


def _wrapped(text: str, indent: int = 0) -> list[str]:
    """Wrap a text between words; further lines have an indent."""
    texts: Sequence[str] = wrap(text, COLUMNS, subsequent_indent=indent * ' ',
                                break_long_words=False, break_on_hyphens=False)
    return list(texts)
