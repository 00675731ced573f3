# SPDX-License-Identifier: Apache-2.0
"""The diagnosis as a screen of text."""

from __future__ import annotations

from collections.abc import Sequence
from textwrap import wrap
from typing import Any, TYPE_CHECKING

from adxl_ros.diagnose import report as words
from adxl_ros.diagnose.could_show import CouldShow
from adxl_ros.diagnose.next_experiment import MENU
from adxl_ros.diagnose.report_json import as_json, named_effects
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Coefficient, Concern, Effect, Need
from adxl_ros.model.sensor import parameter_of
from adxl_ros.process import option
from adxl_ros.report import quantities
from adxl_ros.report.quantities import mg_text, percent
from adxl_ros.report.screen import COLUMNS, wrapped
from adxl_ros.signals.findings import Shown

if TYPE_CHECKING:
    from adxl_ros.diagnose.diagnosis import Diagnosis, Report

_BADGE_COLUMNS = 29  # Columns of the verdict
_GAP_COLUMNS = 24  # Columns of the gap before and after
_LABEL_COLUMNS = 9  # Columns of the words before rows of text
_SURE_COLUMNS = 8  # Columns of the probability in the table of effects
_SHARE_COLUMNS = 7  # Columns of the share of the gap there


def screen_lines(diagnosis: Diagnosis, subject: str) -> list[str]:
    """Return the diagnosis as lines of at most `COLUMNS` columns; the first one is the subject."""
    lines = [*wrapped(subject), '']
    report = diagnosis.report
    notes = [('note', note) for note in words.notes(diagnosis)]
    if report is None:
        word = words.badge(diagnosis)
        lines += wrapped(f'{word}  {words.headline(diagnosis)}', len(word) + 2)
        return lines + _laid_out(notes)
    objects = as_json(diagnosis)
    named = named_effects(report)
    # The gap, with the effects, and the floor stand in the first line.
    rows = words.figure_rows(diagnosis)[2 + words.closes(report) :]
    labelled = [('figures', '; '.join(f'{row.label} {row.text}' for row in rows))]
    labelled += [('noise', f'{row.label}: {row.text}') for row in words.remainder_rows(report)]
    labelled.append(('shows', _what_shows(report.could_show)))
    labelled += [('cause', f'{name}: {effect_named(name).cause}') for name in named]
    return [
        *lines,
        *_head(diagnosis, report),
        *_effect_table(report, objects, named),
        '',
        *_laid_out([*labelled, *notes]),
    ]


def _head(diagnosis: Diagnosis, report: Report) -> list[str]:
    """Lay out verdict, gap and noise floor, and the sentence where it says more."""
    word = words.badge(diagnosis)
    closure = report.closure
    note_of = {row.label: row.note for row in words.figure_rows(diagnosis)}
    gap = mg_text(closure.before.value)
    remark = f'gap {note_of["gap"]}' if words.is_without_pose(diagnosis) else ''
    if words.closes(report):
        gap += f' -> {mg_text(closure.after.value)}'
        remark = note_of['with the effects']
    floor = f'noise floor {mg_text(closure.floor.value)}'
    lines = [f'{word:{_BADGE_COLUMNS - 1}} {f"{gap} rms":{_GAP_COLUMNS - 1}} {floor}']
    for text in (remark, f'noise floor {note_of["noise floor"]}'):
        beside = wrapped(text, columns=COLUMNS - _BADGE_COLUMNS)
        lines += [' ' * _BADGE_COLUMNS + part for part in beside]
    is_explained = report.verdict.status == 'explained'
    if not is_explained or words.is_of_reference(report.verdict) or report.surest:
        lines += wrapped(words.headline(diagnosis))
    elif words.is_only_noise(report):
        lines += wrapped(words.noise_text(report))
    return lines


def _what_shows(could_show: Sequence[CouldShow]) -> str:
    """Say how many effects could show, and which ones could not."""
    hidden = [row.name.effect for row in could_show if not row.shows]
    text = f'{len(could_show) - len(hidden)} of {len(could_show)} effects could show'
    return f'{text}; could not: {", ".join(hidden)}' if hidden else text


def _effect_table(report: Report, objects: dict[str, Any], named: Sequence[str]) -> list[str]:
    """Lay out the named effects; the page has other probable hypotheses."""
    if not named:
        return []
    candidates = {c['effect']: c for c in objects['candidates']}
    width = max(map(len, ('effect', *named))) + 2
    size_columns = COLUMNS - 1 - width - _SURE_COLUMNS - _SHARE_COLUMNS
    lines = [
        '',
        f' {"effect":{width}}{"sure":{_SURE_COLUMNS}}'
        f'{"size (90 % interval)":{size_columns - 6}} share of gap',
    ]
    for name in named:
        candidate = candidates[name]
        sure = percent(candidate['probability'])
        share = '' if candidate['share'] is None else percent(candidate['share'])
        sizes: list[str] = []
        for size in size_lines(report, candidate):
            sizes += wrap(size, size_columns - 1, subsequent_indent='  ')
        first, *more = sizes or ['']
        line = f' {name:{width}}{sure:{_SURE_COLUMNS}}{first:{size_columns}}'
        lines.append(f'{line}{share:>{_SHARE_COLUMNS}}'.rstrip())
        lines += [f'{"":{1 + width + _SURE_COLUMNS}}{size}' for size in more]
    return lines


def size_lines(report: Report, candidate: dict[str, Any]) -> list[str]:
    """Return one line for each parameter; those that may be 0 share the last line."""
    axes = report.baseline.axes
    scale_v_per_g = dict(zip(axes, report.baseline.scale_v_per_g))
    mean_v_per_g = report.baseline.scale_v_per_g.mean()
    parameters = _of_each_axis(candidate, axes)
    is_single = len({key.partition('.')[0] for key in parameters}) == 1
    lines = []
    zeros = []
    for key, parameter in parameters.items():
        axis = key.partition('.')[2]
        label = quantities.parameter_label(key, is_single)
        ci = parameter.get('ci')
        if ci and ci[0] <= 0 <= ci[1]:
            zeros.append(label)
            continue
        scale = scale_v_per_g.get(axis, mean_v_per_g)
        text = quantities.parameter_text(parameter, float(scale))
        lines.append(f'{label} {text}'.strip())
    if zeros:
        lines.append(f'{", ".join(zeros)}: not different from 0'.removeprefix(': '))
    return lines


def _of_each_axis(candidate: dict[str, Any], axes: str) -> dict[str, dict[str, Any]]:
    """Return the parameters of an effect, those with a value for each axis one by one."""
    parameters = {}
    for key, parameter in candidate['parameters'].items():
        if not isinstance(parameter['value'], list):
            parameters[key] = parameter
            continue
        neutral = parameter_of(Coefficient(candidate['effect'], key)).neutral
        for axis, value in zip(axes, parameter['value']):
            if value != neutral:
                parameters[f'{key}.{axis}'] = {**parameter, 'value': value}
    return parameters


def _laid_out(rows: Sequence[tuple[str, str]]) -> list[str]:
    """Return texts behind their labels, wrapped between words; equal labels stand once."""
    lines = []
    last = ''
    for label, text in rows:
        shown = '' if label == last else label
        lines += wrapped(f' {shown:{_LABEL_COLUMNS - 1}}{text}', _LABEL_COLUMNS)
        last = label
    return lines


def as_shown(row: CouldShow, scale_v_per_g: float) -> Shown:
    """Return smallest and typical size of an effect, and what is missing to show it."""
    effect = effect_named(row.name.effect)
    parameter = parameter_of(row.name)

    def text(size: float) -> str:
        return quantities.parameter_text({'value': size, 'unit': parameter.unit}, scale_v_per_g, 2)

    typical = text(parameter.scale)
    if row.shows:
        return Shown(effect.name, text(row.smallest), typical, '')
    return Shown(effect.name, 'cannot show', typical, _missing(effect))


def _missing(effect: Effect) -> str:
    """Return what is missing to show an effect."""
    if effect.concern is Concern.REFERENCE:
        return f'needs {option("urdf" if Need.ROBOT in effect.needs else "sim")}'
    revealed_by = effect.diagnosis.revealed_by
    return f'needs: {MENU[revealed_by].text}' if revealed_by else 'no manoeuvre shows it'
