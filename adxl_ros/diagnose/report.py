# SPDX-License-Identifier: Apache-2.0
"""The diagnosis as `report.json`, as a screen of text, and the words that the page shares."""

from __future__ import annotations

from collections.abc import Sequence
import json
from pathlib import Path
from textwrap import wrap
from typing import Any, NamedTuple

from adxl_ros.diagnose.diagnosis import Diagnosis, Report
from adxl_ros.diagnose.next_experiment import CouldShow, MENU
from adxl_ros.diagnose.search import Hypothesis
from adxl_ros.diagnose.verdict import Verdict
from adxl_ros.model.constants import G0_MPS2, Z_90
from adxl_ros.model.effects import effect_named, library
from adxl_ros.model.effects.base import ActsOn, Coefficient, Concern, Effect, Need
from adxl_ros.model.sensor import fitted_of, get, parameter_of, with_neutral
from adxl_ros.process import option
from adxl_ros.report import quantities
from adxl_ros.report.quantities import amplitude_text, Interval, listed, mg_text, percent
from adxl_ros.report.screen import COLUMNS, wrapped
from adxl_ros.signals.findings import Shown
import numpy as np

_DIGITS = 6  # Significant digits of the report. Chosen: more than any of its numbers has
PROBABLE = 0.05
"""Smallest probability of an effect that the page shows first. Chosen: that of a rival."""
_WITHOUT_GAP = ('no_gap', 'insufficient')  # Verdicts in which there is no gap to close
_FLOOR_SOURCES = {
    'still': 'from rests',
    'repeats': 'from repeats of a trajectory',
    'assumed': 'assumed from the parameter file',
}
_DIMENSIONS = {
    'force': 'the force along the axis',
    'cross_force': 'the force across the axis',
    'direction': 'the direction of the last move',
    'rate': 'the rate of the joints',
    'alpha_rad': 'alpha',
    'beta_rad': 'beta',
    'temperature_c': 'the temperature',
    'warming': 'the history of the temperature',
    'supply_v': 'the supply',
    'time_s': 'the time',
    'ageing': 'force and time together',
    'since_move_s': 'the time since a move',
    'code': 'the code of the ADC',
    'lag': 'the recent history of the force',
}
"""Dimensions of the reproducible rest, for people."""
_MOST_DIMENSIONS = 2  # Dimensions that a sentence names. Chosen: the strongest ones
NOISE_STAYS = 'The effects are noise, which no simulation repeats sample by sample.'
_NOT_COMPARED = 'The samples that the effects change are left out.'
"""Why effects on the noise close nothing."""


class FigureRow(NamedTuple):
    """One row of figures: what it is, its figures with their units, and a remark."""

    label: str
    text: str
    note: str = ''


def as_json(diagnosis: Diagnosis) -> dict[str, Any]:
    """Return the report as the objects of JSON; docs/reference/report_json.md lists its keys."""
    fault = diagnosis.fault
    report = diagnosis.report
    if report is None:
        assert fault is not None
        return {
            'schema': 1,
            'verdict': {
                'status': fault.status,
                'effects': [],
                'groups': [],
                'of': None,
                'data_fault': fault.name if fault.status == 'bad_data' else None,
                'probability': 1.0,
                'surest': None,
            },
            'hypotheses': [],
            'gap': None,
            'where': [],
            'candidates': [],
            'notes': notes(diagnosis),
            'next_experiment': None,
            'summary': fault.message,
        }
    verdict = report.verdict
    proposal = report.next_experiment
    return _rounded(
        {
            'schema': 1,
            'verdict': {
                'status': verdict.status,
                'effects': verdict.effects,
                'groups': verdict.groups,
                'of': concern(verdict),
                'data_fault': None,
                'probability': verdict.probability,
                'surest': report.surest,
            },
            'hypotheses': [h._asdict() for h in verdict.hypotheses],
            'gap': _gap(report),
            'explained': _power(verdict.explained),
            'rest': _power(verdict.remainder),
            'rest_follows': verdict.remainder_follows,
            'material': verdict.material_mps2,
            'lost_without': {e: _power(p) for e, p in verdict.lost_without.items()},
            'where': [
                {
                    'axis': c.axis,
                    'dimension': c.dimension,
                    'range': (c.low, c.high),
                    'mean': c.mean_mps2,
                    'share': c.share,
                    'p': c.p,
                }
                for c in report.residual_cells
            ],
            'not_covered': report.not_covered,
            'notes': notes(diagnosis),
            'could_show': [
                {
                    'effect': r.name.effect,
                    'parameter': r.name.parameter,
                    'axis': r.name.axis or None,
                    'unit': r.unit,
                    'smallest': r.smallest,
                    'could_show': r.shows,
                }
                for r in report.could_show
            ],
            'candidates': _candidates(report),
            'noise_remainders': [
                {
                    'effect': r.effect,
                    'quantity': r.quantity,
                    'unit': r.unit,
                    'axis': r.axis or None,
                    'recorded': r.recorded,
                    'simulated': r.simulated,
                    'left': abs(r.recorded - r.simulated),
                }
                for r in report.noise_remainders
            ],
            'next_experiment': proposal
            and {
                'manoeuvre': proposal.manoeuvre,
                'why': proposal.why,
                'command': proposal.command,
                'menu': [
                    {'manoeuvre': w.name, 'minutes': w.minutes, 'nats_per_minute': w.per_minute}
                    for w in proposal.menu
                ],
            },
            'summary': summary(diagnosis),
        }
    )


def as_text(values: dict[str, Any]) -> str:
    """Return values as JSON."""
    return json.dumps(values, indent=1, allow_nan=False) + '\n'


def notes(diagnosis: Diagnosis) -> list[str]:
    """Return what was corrected or left out, with the file where there are several."""
    every: list[str] = []
    for comparison in diagnosis.comparisons:
        file = f'{Path(comparison.name).name}: ' if len(diagnosis.comparisons) > 1 else ''
        every += [file + note for note in comparison.notes]
    return every


def _rounded(value: Any) -> Any:
    """Round all numbers to the digits of the report; None for NaN and infinity."""
    if isinstance(value, dict):
        return {key: _rounded(v) for key, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [_rounded(v) for v in value]
    if not isinstance(value, float):
        return value
    return float(f'{value:.{_DIGITS}g}') if np.isfinite(value) else None


def _power(power: Interval) -> dict[str, Any]:
    """Return a power, (m/s²)², with its interval."""
    return {'value': power.value, 'ci': (power.low, power.high), 'unit': '(m/s^2)^2'}


def _gap(report: Report) -> dict[str, Any]:
    """Return the gap before and after, and the noise recording by recording."""
    closure = report.closure
    verdict = report.verdict
    figures: dict[str, Any] = {'unit': 'm/s^2'}
    for name, figure in closure._asdict().items():
        figures |= {name: figure.value, f'{name}_ci': (figure.low, figure.high)}
    if verdict.status in _WITHOUT_GAP:
        figures['closed'] = None
    if not np.isfinite(closure.floor.low):
        figures['floor_ci'] = None
    return {
        **figures,
        'floor_source': report.noise_floor.source,
        'upper_limit': verdict.upper_limit_mps2,
        'tolerated': verdict.tolerated_mps2,
        'reference': verdict.reference_mps2,
        'not_in_reference': report.linear_model.lost_motion_mps2,
        'noise': report.noise,
    }


def shares_of_gap(report: Report) -> dict[str, float]:
    """Split the closed share of the squared gap among the effects by what is lost without each."""
    verdict = report.verdict
    closure = report.closure
    if not verdict.best & {*verdict.named}:
        return {}
    lost = {effect: max(power.value, 0.0) for effect, power in verdict.lost_without.items()}
    total = sum(lost.values())
    closed = float(np.clip(np.nan_to_num(closure.closed.value), 0.0, 1.0))
    return {effect: closed * power / total if total else 0.0 for effect, power in lost.items()}


def _candidates(report: Report) -> list[dict[str, Any]]:
    """Return the effects of all hypotheses and detections, the most probable first."""
    verdict = report.verdict
    shown = {row.name.effect: row for row in report.could_show}
    detected = {d.effect: d for d in report.detections}
    shares = shares_of_gap(report)
    out = []
    for name, effect in library().items():
        sets = [h for h in verdict.hypotheses if name in h.effects]
        hypothesis = next((h for h in report.hypotheses if name in h.effects), None)
        if not sets and hypothesis is None:
            continue
        if name in detected:
            values = detected[name].values
            parameters = {
                p.name: {'value': np.asarray(values[p.name]).tolist(), 'unit': p.unit}
                for p in effect.parameters
                if p.name in values
            }
        else:
            parameters = _parameters(report, hypothesis, name)
        group = next((g for g in reversed(verdict.groups) if name in g), ())
        out.append(
            {
                'effect': name,
                'of': effect.concern.value,
                'probability': min(sum(h.probability for h in sets), 1.0),
                'closed': report.closure.closed.value if name in verdict.best else None,
                # The rule weighs held-out figures, and no effect has a p of its own.
                'p': None,
                'parameters': parameters,
                'share': shares.get(name),
                'visibility': shown[name].share if name in shown else 1.0,
                'inseparable_from': [other for other in group if other != name],
                'cause': effect.cause,
            }
        )
    return sorted(out, key=lambda c: (-c['probability'], c['effect']))


def _parameters(report: Report, hypothesis: Hypothesis | None, effect: str) -> dict[str, Any]:
    """
    Return the parameters of an effect as the parameter file has them, baseline included.

    A parameter that the recordings do not determine has no value.
    """
    names = fitted_of(effect_named(effect), report.sensor.axes)
    sensor = report.sensor
    if effect_named(effect).diagnosis.drift and effect in sensor.effects:
        # The density of a drift is chosen with the noise, on a grid.
        return {
            _key(name): {'value': float(get(sensor, [name])[0]), 'unit': parameter_of(name).unit}
            for name in names
        }
    if hypothesis is None:
        return {}
    parameters = dict[str, dict[str, Any]]()
    values = get(hypothesis.sensor, hypothesis.names)
    for name, value, std, is_open in zip(
        hypothesis.names, values.tolist(), hypothesis.std, hypothesis.undetermined
    ):
        if name in names:
            ci = value - Z_90 * std, value + Z_90 * std
            parameters[_key(name)] = {
                'value': None if is_open else value,
                'ci': None if is_open else ci,
                'unit': parameter_of(name).unit,
                'determined': not is_open,
            }
    return parameters


def _key(name: Coefficient) -> str:
    """Return the name of a parameter with its axis, as the keys of the report have it."""
    return f'{name.parameter}.{name.axis}' if name.axis else name.parameter


def badge(diagnosis: Diagnosis) -> str:
    """Return the verdict in a few words."""
    if diagnosis.report is None:
        assert diagnosis.fault is not None
        return 'BAD DATA' if diagnosis.fault.status == 'bad_data' else 'TOO LITTLE DATA'
    verdict = diagnosis.report.verdict
    if verdict.status in ('explained', 'partly') and concern(verdict) == Concern.REFERENCE.value:
        share = f', {percent(verdict.explained_share)}' if verdict.status == 'partly' else ''
        return f'ERROR OF THE REFERENCE{share}'
    return {
        'no_gap': f'NO GAP above {mg_text(verdict.upper_limit_mps2)}',
        'insufficient': 'TOO LITTLE DATA',
        'unknown': 'UNKNOWN CAUSE',
        'inseparable': 'CAUSES NOT SEPARATED',
        'partly': f'PARTLY EXPLAINED, {percent(verdict.explained_share)}',
        'explained': f'GAP EXPLAINED by {quantities.counted(len(verdict.effects), "effect")}',
    }[verdict.status]


def headline(diagnosis: Diagnosis) -> str:
    """Return the verdict in a sentence or two."""
    if diagnosis.report is None:
        assert diagnosis.fault is not None
        return diagnosis.fault.message
    verdict = diagnosis.report.verdict
    sure = f'({percent(verdict.probability)} sure{_surest_text(diagnosis.report)})'
    share = verdict.explained_share
    named = listed([*verdict.effects, *(listed(group, 'or') for group in verdict.groups)], 'and')
    rest = amplitude_text(verdict.remaining)
    where = [_DIMENSIONS[d] for d in verdict.remainder_follows[:_MOST_DIMENSIONS]]
    follows = f' It follows {listed(where, "and")}.' if where and verdict.remainder.low > 0 else ''
    separate = ': the data do not separate them' if verdict.groups else ''
    noise = f' {_noise_text(diagnosis.report)}' if is_only_noise(diagnosis.report) else ''
    in_reference = [e for e in verdict.effects if effect_named(e).concern is Concern.REFERENCE]
    in_words = listed(in_reference, 'and')
    of_reference = f' Error of the reference, not of the sensor: {in_words}.' if in_words else ''
    explained = f'Explained {sure} by {named}{separate}.{noise}{of_reference}'
    limit, tolerated = map(mg_text, (verdict.upper_limit_mps2, verdict.tolerated_mps2))
    within = (
        f' {tolerated} of that is within the tolerances of zero-g, scale '
        'factor, filter and latency.'
        if verdict.tolerated_mps2 > verdict.material_mps2
        else ''
    )
    possible = listed(sorted(verdict.best), 'and')
    part = f' {percent(share)} of the gap may be {possible}.' if verdict.best else ''
    sentence = {
        'no_gap': f'No gap {sure}: one above {limit} would have shown.{within}',
        'insufficient': 'No verdict: neither motion nor temperature nor supply changes, so that '
        'no effect can show.',
        'unknown': f'Unknown {sure}: no effect of the library explains {rest}.{follows}{part}',
        'partly': f'Partly explained {sure}: {percent(share)} of the gap is {named}; '
        f'{percent(1 - share)} ({rest}) is something else.{follows}{of_reference}',
    }.get(verdict.status, explained)
    return sentence + _left_out_text(diagnosis.report)


def _surest_text(report: Report) -> str:
    """Say how sure an ideal observer could be; empty where nobody asked."""
    if report.surest is None:
        return ''
    high = percent(report.surest.high)
    if high.startswith('>'):
        return f'; an ideal observer {high}'
    return f'; on this recording nobody could be surer than {high}'


def _left_out_text(report: Report) -> str:
    """Say which samples a verdict is not about, where they would matter; empty for none."""
    size = quantities.acceleration_text
    texts = [
        f'{part.samples} samples ({size(part.rms_mps2)} rms), {part.why}'
        for part in report.left_out
    ]
    return f' Not compared: {"; ".join(texts)}.' if texts else ''


def concern(verdict: Verdict) -> str | None:
    """Return what a verdict is about, joined by 'and', within a group by 'or'; None for none."""
    groups = (*((e,) for e in verdict.effects), *verdict.groups)
    return (
        ' and '.join(
            sorted(
                {' or '.join(sorted({effect_named(e).concern.value for e in g})) for g in groups}
            )
        )
        or None
    )


def summary(diagnosis: Diagnosis) -> str:
    """Return verdict and figures in a few sentences."""
    report = diagnosis.report
    rows = [] if report is None else [*figure_rows(diagnosis), *remainder_rows(report)]
    return ' '.join(
        [
            headline(diagnosis),
            *(f'{row.label[0].upper()}{row.label[1:]}: {row.text}.' for row in rows),
        ]
    )


def figure_rows(diagnosis: Diagnosis) -> list[FigureRow]:
    """Return the figures from which the verdict follows: the same for terminal, page and JSON."""
    report = diagnosis.report
    assert report is not None
    closure = report.closure
    verdict = report.verdict
    compared = any(c.pose_known for c in diagnosis.comparisons)
    rows = [
        FigureRow(
            'gap',
            f'{mg_text(closure.before.value)} rms',
            'recording minus simulation'
            if compared
            else 'without its mean, because the pose is unknown',
        )
    ]
    if closes(report):
        low = percent(closure.closed.low)
        high = percent(closure.closed.high)
        ci = '' if low == high else f', 90 % interval {low} to {high}'
        rows.append(
            FigureRow(
                'with the effects',
                f'{mg_text(closure.after.value)} rms',
                f'{percent(closure.closed.value)} closed, held out{ci}',
            )
        )
    rows.append(
        FigureRow(
            'noise floor',
            f'{mg_text(closure.floor.value)} rms',
            _FLOOR_SOURCES[report.noise_floor.source],
        )
    )
    if verdict.status in _WITHOUT_GAP:
        rows.append(
            FigureRow(
                'upper limit', mg_text(verdict.upper_limit_mps2), 'a larger gap would have shown'
            )
        )
    else:
        rows.append(
            FigureRow(
                'explained',
                quantities.power_text(verdict.explained),
                'by ' + listed(sorted(verdict.best), 'and')
                if verdict.best
                else 'no effect on the mean',
            )
        )
    rows += beside_rows(report)
    rows.append(
        FigureRow(
            'repeats, not explained',
            quantities.power_text(verdict.remainder),
            'by flexible functions, held out',
        )
    )
    rows += [
        FigureRow('material', f'from {mg_text(verdict.material_mps2)}', 'smaller is no gap'),
        FigureRow(
            'errors of the reference',
            mg_text(verdict.reference_mps2),
            'what follows the pose must exceed them, too',
        ),
    ]
    fading_hz = [c.fading_hz for c in diagnosis.comparisons if c.fading_hz is not None]
    if report.linear_model.lost_motion_mps2:
        rows.append(
            FigureRow(
                'not in the reference',
                f'{mg_text(report.linear_model.lost_motion_mps2)} rms',
                f'motion above {min(fading_hz) / 2:.2g} Hz',
            )
        )
    if len(verdict.lost_without) > 1 and closes(report):
        rows += [
            FigureRow(
                f'lost without {effect}',
                amplitude_text(power.value),
                ' to '.join(amplitude_text(p) for p in (power.low, power.high)),
            )
            for effect, power in verdict.lost_without.items()
        ]
    return rows


def beside_rows(report: Report) -> list[FigureRow]:
    """
    Return how zero-g and scale factor changed beside the effects, where that is material.

    A calibration may have taken them up of the effects, so that both belong together.
    """
    verdict = report.verdict
    sensor = report.sensor
    texts = []
    straight = [
        e
        for e in library().values()
        if e.diagnosis.straight_line and e.name in sensor.effects and e.name not in verdict.best
    ]
    for effect in straight if verdict.closes else ():
        names = fitted_of(effect, sensor.axes)
        before = get(with_neutral(report.baseline, sensor.effects), names)
        for name, change_v, scale in zip(
            names, get(sensor, names) - before, report.baseline.scale_v_per_g.tolist()
        ):
            if abs(change_v) / scale * G0_MPS2 > verdict.material_mps2:
                size = quantities.parameter_text(
                    {'value': change_v, 'unit': parameter_of(name).unit}, scale
                )
                texts.append(f'{effect.name} {name.axis} {size}')
    return (
        [FigureRow('with them', ', '.join(texts), 'a calibration may have taken this up of them')]
        if texts
        else []
    )


def remainder_rows(report: Report) -> list[FigureRow]:
    """Return what remains of each noise-like effect."""

    def text(value: float, unit: str) -> str:
        if unit == 'm/s^2':
            return mg_text(value)
        return f'{100 * value:.2g} %' if unit == '1' else f'{value:.2g} a second'

    return [
        FigureRow(
            f'{r.effect}, {r.quantity}{f" on {r.axis}" if r.axis else ""}',
            '{} recorded, {} simulated, {} left'.format(
                *(
                    text(v, r.unit)
                    for v in (r.recorded, r.simulated, abs(r.recorded - r.simulated))
                )
            ),
        )
        for r in report.noise_remainders
    ]


def is_only_noise(report: Report) -> bool:
    """Determine whether a verdict has effects, but none that acts on the mean."""
    return report.verdict.closes and not any(
        effect_named(e).acts_on is ActsOn.MEAN for e in report.verdict.best
    )


def _noise_text(report: Report) -> str:
    """Say why effects that no model of the mean has do not make a gap smaller."""
    left_out = {detection.effect for detection in report.detections if detection.is_left_out}
    return _NOT_COMPARED if left_out >= {*report.verdict.named} else NOISE_STAYS


def closes(report: Report) -> bool:
    """Determine whether there is a gap, and effects that change the mean."""
    return (
        report.verdict.closes
        and bool(np.isfinite(report.closure.closed.value))
        and not is_only_noise(report)
    )


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


_BADGE_COLUMNS = 29  # Columns of the verdict
_GAP_COLUMNS = 24  # Columns of the gap before and after
_LABEL_COLUMNS = 9  # Columns of the words before rows of text
_SURE_COLUMNS = 8  # Columns of the probability in the table of effects
_SHARE_COLUMNS = 7  # Columns of the share of the gap there


def screen_lines(diagnosis: Diagnosis, subject: str) -> list[str]:
    """Return the diagnosis as lines of at most `COLUMNS` columns; the first one is the subject."""
    lines = [*wrapped(subject), '']
    word = badge(diagnosis)
    report = diagnosis.report
    labelled = [('note', note) for note in notes(diagnosis)]
    if report is None:
        return (
            lines + wrapped(f'{word}  {headline(diagnosis)}', len(word) + 2) + _labelled(labelled)
        )
    objects = as_json(diagnosis)
    rows = figure_rows(diagnosis)
    closure = report.closure
    note_of = {row.label: row.note for row in rows}
    # The gap, with the effects, and the floor stand in the first line.
    after = f' -> {mg_text(closure.after.value)}' if closes(report) else ''
    gap = f'{mg_text(closure.before.value)}{after} rms'
    lines.append(
        f'{word:{_BADGE_COLUMNS - 1}} {gap:{_GAP_COLUMNS - 1}} noise floor '
        f'{mg_text(closure.floor.value)}'
    )
    without_effects = '' if 'sim' in note_of['gap'] else f'gap {note_of["gap"]}'
    remark = note_of.get('with the effects', without_effects)
    for text in (remark, f'noise floor {note_of["noise floor"]}'):
        beside = wrapped(text, columns=COLUMNS - _BADGE_COLUMNS)
        lines += [' ' * _BADGE_COLUMNS + part for part in beside]
    if report.verdict.status != 'explained' or 'REFERENCE' in word or report.surest:
        lines += wrapped(headline(diagnosis))
    elif is_only_noise(report):
        lines += wrapped(_noise_text(report))
    could_show = report.could_show
    shows = f'{sum(row.shows for row in could_show)} of {len(could_show)} effects could show'
    hidden = ', '.join(row.name.effect for row in could_show if not row.shows)
    if hidden:
        shows += f'; could not: {hidden}'
    return [
        *lines,
        *_effect_table(report, objects),
        '',
        *_labelled(
            [
                (
                    'figures',
                    '; '.join(f'{row.label} {row.text}' for row in rows[2 + closes(report) :]),
                ),
                *(('noise', f'{row.label}: {row.text}') for row in remainder_rows(report)),
                ('shows', shows),
                *(
                    ('cause', f'{name}: {effect_named(name).cause}')
                    for name in named_effects(report, objects)
                ),
                *labelled,
            ]
        ),
    ]


def named_effects(report: Report, objects: dict[str, Any]) -> list[str]:
    """Return the effects of the verdict by their share of the gap."""
    shares = {c['effect']: c['share'] or 0.0 for c in objects['candidates']}
    return sorted(
        (name for name in report.verdict.named if name in shares), key=lambda name: -shares[name]
    )


def _effect_table(report: Report, objects: dict[str, Any]) -> list[str]:
    """Lay out the named effects; the page has other probable hypotheses."""
    named = named_effects(report, objects)
    candidates = {c['effect']: c for c in objects['candidates']}
    width = max(map(len, ('effect', *named))) + 2
    size_columns = COLUMNS - 1 - width - _SURE_COLUMNS - _SHARE_COLUMNS
    lines = []
    if named:
        lines = [
            '',
            f' {"effect":{width}}{"sure":{_SURE_COLUMNS}}'
            f'{"size (90 % interval)":{size_columns - 6}} share of gap',
        ]
    for name in named:
        share = candidates[name]['share']
        sure = percent(candidates[name]['probability'])
        sizes: list[str] = []
        for size in size_lines(report, candidates[name]):
            sizes += wrap(size, size_columns - 1, subsequent_indent='  ')
        first, *more = sizes or ['']
        lines.append(
            f' {name:{width}}{sure:{_SURE_COLUMNS}}{first:{size_columns}}'
            f'{"" if share is None else percent(share):>{_SHARE_COLUMNS}}'.rstrip()
        )
        lines += [f'{"":{1 + width + _SURE_COLUMNS}}{size}' for size in more]
    return lines


def size_lines(report: Report, candidate: dict[str, Any]) -> list[str]:
    """Return one line for each parameter; those that may be 0 share the last line."""
    parameters: dict[str, Any] = {}
    for key, parameter in candidate['parameters'].items():
        neutral = parameter_of(Coefficient(candidate['effect'], key.partition('.')[0])).neutral
        if isinstance(parameter['value'], list):
            for axis, value in zip(report.baseline.axes, parameter['value']):
                if value != neutral:
                    parameters[f'{key}.{axis}'] = {**parameter, 'value': value}
        else:
            parameters[key] = parameter
    is_single = len({key.partition('.')[0] for key in parameters}) == 1
    lines = []
    zeros = []
    all_v_per_g = report.baseline.scale_v_per_g
    for key, parameter in parameters.items():
        label = quantities.parameter_label(key, is_single)
        ci = parameter.get('ci')
        if ci and ci[0] <= 0 <= ci[1]:
            zeros.append(label)
        else:
            scale = dict(zip(report.baseline.axes, all_v_per_g)).get(
                key.partition('.')[2], all_v_per_g.mean()
            )
            lines.append(f'{label} {quantities.parameter_text(parameter, float(scale))}'.strip())
    if zeros:
        lines.append(f'{", ".join(zeros)}: not different from 0'.removeprefix(': '))
    return lines


def _labelled(rows: Sequence[tuple[str, str]]) -> list[str]:
    """Return texts behind their labels, wrapped between words; equal labels stand once."""
    lines = []
    last = ''
    for label, text in rows:
        shown = '' if label == last else label
        lines += wrapped(f' {shown:{_LABEL_COLUMNS - 1}}{text}', _LABEL_COLUMNS)
        last = label
    return lines
