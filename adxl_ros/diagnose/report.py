# SPDX-License-Identifier: Apache-2.0
"""The words and figures of a diagnosis: the same for terminal, page and `report.json`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.effects import effect_named, library
from adxl_ros.model.effects.base import ActsOn, Concern
from adxl_ros.model.sensor import fitted_of, get, parameter_of, with_neutral
from adxl_ros.report import quantities
from adxl_ros.report.quantities import amplitude_text, listed, mg_text, percent, power_text
from adxl_ros.report.screen import Tile
import numpy as np

if TYPE_CHECKING:
    from adxl_ros.diagnose.diagnosis import Diagnosis, Report
    from adxl_ros.diagnose.verdict import Verdict

PROBABLE = 0.05
"""Smallest probability of an effect that the page shows first. Chosen: that of a rival."""
WITHOUT_GAP = ('no_gap', 'insufficient')  # Verdicts in which there is no gap to close
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
"""Dimensions of what remains, for people."""
_MOST_DIMENSIONS = 2  # Dimensions that a sentence names. Chosen: the strongest ones
_NOISE_STAYS = 'The effects are noise, which no simulation repeats sample by sample.'
_NOT_COMPARED = 'The samples that the effects change are left out.'
"""Why effects on the noise close nothing."""


def notes(diagnosis: Diagnosis) -> list[str]:
    """Return what was corrected or left out, with the file where there are several."""
    every: list[str] = []
    for comparison in diagnosis.comparisons:
        file = f'{Path(comparison.name).name}: ' if len(diagnosis.comparisons) > 1 else ''
        every += [file + note for note in comparison.notes]
    return every


def shares_of_gap(report: Report) -> dict[str, float]:
    """Split the closed share of the squared gap among the effects by what is lost without each."""
    verdict = report.verdict
    if not verdict.best & {*verdict.named}:
        return {}
    lost = {effect: max(power.value, 0.0) for effect, power in verdict.lost_without.items()}
    total = sum(lost.values()) or 1.0
    closed = float(np.clip(np.nan_to_num(report.closure.closed.value), 0.0, 1.0))
    return {effect: closed * power / total for effect, power in lost.items()}


def badge(diagnosis: Diagnosis) -> str:
    """Return the verdict in a few words."""
    if diagnosis.report is None:
        assert diagnosis.fault is not None
        return 'BAD DATA' if diagnosis.fault.status == 'bad_data' else 'TOO LITTLE DATA'
    verdict = diagnosis.report.verdict
    share = percent(verdict.explained_share)
    if is_of_reference(verdict):
        of_gap = f', {share}' if verdict.status == 'partly' else ''
        return f'ERROR OF THE REFERENCE{of_gap}'
    return {
        'no_gap': f'NO GAP above {mg_text(verdict.upper_limit_mps2)}',
        'insufficient': 'TOO LITTLE DATA',
        'unknown': 'UNKNOWN CAUSE',
        'inseparable': 'CAUSES NOT SEPARATED',
        'partly': f'PARTLY EXPLAINED, {share}',
        'explained': f'GAP EXPLAINED by {quantities.counted(len(verdict.effects), "effect")}',
    }[verdict.status]


def is_of_reference(verdict: Verdict) -> bool:
    """Determine whether all that a verdict names are errors of the reference."""
    explains = verdict.status in ('explained', 'partly')
    return explains and concern(verdict) == Concern.REFERENCE.value


def is_without_pose(diagnosis: Diagnosis) -> bool:
    """Determine whether no recording has a reference of its pose."""
    return not any(c.pose_known for c in diagnosis.comparisons)


def headline(diagnosis: Diagnosis) -> str:
    """Return the verdict in a sentence or two."""
    report = diagnosis.report
    if report is None:
        assert diagnosis.fault is not None
        return diagnosis.fault.message
    verdict = report.verdict
    sure = f'({percent(verdict.probability)} sure{_surest_text(report)})'
    if verdict.status == 'no_gap':
        limit = mg_text(verdict.upper_limit_mps2)
        sentence = f'No gap {sure}: one above {limit} would have shown.'
        if verdict.tolerated_mps2 > verdict.material_mps2:
            sentence += (
                f' {mg_text(verdict.tolerated_mps2)} of that is within the tolerances of zero-g, '
                'scale factor, filter and latency.'
            )
    elif verdict.status == 'insufficient':
        sentence = (
            'No verdict: neither motion nor temperature nor supply changes, so that '
            'no effect can show.'
        )
    elif verdict.status == 'unknown':
        sentence = f'Unknown {sure}: {_unknown_text(verdict)}'
    else:
        sentence = _explained_text(report, sure)
    return sentence + _left_out_text(report)


def _unknown_text(verdict: Verdict) -> str:
    """Say what no effect of the library explains, and what may be a part of it."""
    rest = amplitude_text(verdict.remaining)
    text = f'no effect of the library explains {rest}.{_follows_text(verdict)}'
    if verdict.best:
        possible = listed(sorted(verdict.best), 'and')
        text += f' {percent(verdict.explained_share)} of the gap may be {possible}.'
    return text


def _explained_text(report: Report, sure: str) -> str:
    """Say what explains the gap, or a part of it."""
    verdict = report.verdict
    named = listed([*verdict.effects, *(listed(group, 'or') for group in verdict.groups)], 'and')
    in_reference = [e for e in verdict.effects if effect_named(e).concern is Concern.REFERENCE]
    of_reference = ''
    if in_reference:
        in_words = listed(in_reference, 'and')
        of_reference = f' Error of the reference, not of the sensor: {in_words}.'
    if verdict.status == 'partly':
        share = verdict.explained_share
        return (
            f'Partly explained {sure}: {percent(share)} of the gap is {named}; '
            f'{percent(1 - share)} ({amplitude_text(verdict.remaining)}) is something else.'
            f'{_vibration_text(verdict)}{_follows_text(verdict)}{of_reference}'
        )
    separate = ': the data do not separate them' if verdict.groups else ''
    noise = f' {noise_text(report)}' if is_only_noise(report) else ''
    return f'Explained {sure} by {named}{separate}.{noise}{of_reference}'


def _vibration_text(verdict: Verdict) -> str:
    """Say that most of the remainder is vibration, after another sentence; empty if it is none."""
    vibration = verdict.vibration_mps2**2
    if vibration < verdict.remaining / 2:
        return ''
    return (
        f' {amplitude_text(vibration)} of it is vibration that shows only while joints move: of '
        'the motor or the mount.'
    )


def _follows_text(verdict: Verdict) -> str:
    """Say what the remainder follows, in a sentence after another one; empty for nothing."""
    where = [_DIMENSIONS[d] for d in verdict.remainder_follows[:_MOST_DIMENSIONS]]
    if not where or verdict.remainder.low <= 0:
        return ''
    return f' It follows {listed(where, "and")}.'


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
        f'{part.samples} samples ({size(part.rms_mps2)} rms), {part.reason}'
        for part in report.left_out
    ]
    return f' Not compared: {"; ".join(texts)}.' if texts else ''


def concern(verdict: Verdict) -> str | None:
    """Return what a verdict is about, joined by 'and', within a group by 'or'; None for none."""
    parts = set()
    for group in (*((e,) for e in verdict.effects), *verdict.groups):
        of_group = {effect_named(e).concern.value for e in group}
        parts.add(' or '.join(sorted(of_group)))
    return ' and '.join(sorted(parts)) or None


def summary(diagnosis: Diagnosis) -> str:
    """Return verdict and figures in a few sentences."""
    sentences = [headline(diagnosis)]
    if diagnosis.report is not None:
        for row in [*figure_rows(diagnosis), *remainder_rows(diagnosis.report)]:
            sentences.append(f'{row.label[0].upper()}{row.label[1:]}: {row.text}.')
    return ' '.join(sentences)


def figure_rows(diagnosis: Diagnosis) -> list[Tile]:
    """Return the figures from which the verdict follows; gap and noise floor come first."""
    report = diagnosis.report
    assert report is not None
    verdict = report.verdict
    rows = [
        *_gap_rows(report, is_without_pose(diagnosis)),
        _size_row(verdict),
        *beside_rows(report),
        Tile(
            'repeats, not explained',
            power_text(verdict.remainder),
            'by flexible functions, held out',
        ),
        Tile('material', f'from {mg_text(verdict.material_mps2)}', 'smaller is no gap'),
        Tile(
            'errors of the reference',
            mg_text(verdict.reference_mps2),
            'what follows the pose must exceed them, too',
        ),
    ]
    fading_hz = [c.fading_hz for c in diagnosis.comparisons if c.fading_hz is not None]
    lost_motion_mps2 = report.linear_model.lost_motion_mps2
    if lost_motion_mps2:
        above = f'motion above {min(fading_hz) / 2:.2g} Hz'
        rows.append(Tile('not in the reference', f'{mg_text(lost_motion_mps2)} rms', above))
    if len(verdict.lost_without) > 1 and closes(report):
        rows += [
            Tile(
                f'lost without {effect}',
                amplitude_text(power.value),
                f'{amplitude_text(power.low)} to {amplitude_text(power.high)}',
            )
            for effect, power in verdict.lost_without.items()
        ]
    return rows


def _gap_rows(report: Report, is_without_pose: bool) -> list[Tile]:
    """Return the gap, what is left with the effects if they change it, and the noise floor."""
    closure = report.closure
    note = 'recording minus simulation'
    if is_without_pose:
        note = 'without its mean, because the pose is unknown'
    rows = [Tile('gap', f'{mg_text(closure.before.value)} rms', note)]
    if closes(report):
        low = percent(closure.closed.low)
        high = percent(closure.closed.high)
        note = f'{percent(closure.closed.value)} closed, held out'
        if low != high:
            note += f', 90 % interval {low} to {high}'
        rows.append(Tile('with the effects', f'{mg_text(closure.after.value)} rms', note))
    source = _FLOOR_SOURCES[report.noise_floor.source]
    return [*rows, Tile('noise floor', f'{mg_text(closure.floor.value)} rms', source)]


def _size_row(verdict: Verdict) -> Tile:
    """Return what is explained, or which gap would have shown where there is none."""
    if verdict.status in WITHOUT_GAP:
        limit = mg_text(verdict.upper_limit_mps2)
        return Tile('upper limit', limit, 'a larger gap would have shown')
    note = 'no effect on the mean'
    if verdict.best:
        note = 'by ' + listed(sorted(verdict.best), 'and')
    return Tile('explained', power_text(verdict.explained), note)


def beside_rows(report: Report) -> list[Tile]:
    """
    Return how zero-g and scale factor changed beside the effects, where that is material.

    A calibration may have taken them up of the effects, so that both belong together.
    """
    verdict = report.verdict
    sensor = report.sensor
    if not verdict.closes:
        return []
    before = with_neutral(report.baseline, sensor.effects)
    texts = []
    for effect in library().values():
        is_beside = effect.name in sensor.effects and effect.name not in verdict.best
        if not effect.diagnosis.straight_line or not is_beside:
            continue
        names = fitted_of(effect, sensor.axes)
        changes_v = get(sensor, names) - get(before, names)
        scales = report.baseline.scale_v_per_g.tolist()
        for name, change_v, scale in zip(names, changes_v, scales):
            if abs(change_v) / scale * G0_MPS2 > verdict.material_mps2:
                change = {'value': change_v, 'unit': parameter_of(name).unit}
                size = quantities.parameter_text(change, scale)
                texts.append(f'{effect.name} {name.axis} {size}')
    if not texts:
        return []
    note = 'a calibration may have taken this up of them'
    return [Tile('with them', ', '.join(texts), note)]


def remainder_rows(report: Report) -> list[Tile]:
    """Return what remains of each noise-like effect."""
    rows = []
    for r in report.noise_remainders:
        label = f'{r.effect}, {r.quantity}'
        if r.axis:
            label += f' on {r.axis}'
        recorded = _noise_figure(r.recorded, r.unit)
        simulated = _noise_figure(r.simulated, r.unit)
        left = _noise_figure(r.left, r.unit)
        text = f'{recorded} recorded, {simulated} simulated, {left} left'
        rows.append(Tile(label, text))
    return rows


def _noise_figure(value: float, unit: str) -> str:
    """Return a figure of a noise-like effect in m/s², as a share, or by rate."""
    if unit == 'm/s^2':
        return mg_text(value)
    return f'{100 * value:.2g} %' if unit == '1' else f'{value:.2g} a second'


def is_only_noise(report: Report) -> bool:
    """Determine whether a verdict has effects, but none that acts on the mean."""
    return report.verdict.closes and not any(
        effect_named(e).acts_on is ActsOn.MEAN for e in report.verdict.best
    )


def noise_text(report: Report) -> str:
    """Say why effects that no model of the mean has do not make a gap smaller."""
    left_out = {detection.effect for detection in report.detections if detection.is_left_out}
    return _NOT_COMPARED if left_out >= {*report.verdict.named} else _NOISE_STAYS


def closes(report: Report) -> bool:
    """Determine whether there is a gap, and effects that change the mean."""
    return (
        report.verdict.closes
        and bool(np.isfinite(report.closure.closed.value))
        and not is_only_noise(report)
    )
