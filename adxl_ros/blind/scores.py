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

"""The scores of a check, each with its interval, beside the bars."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from adxl_ros.blind import grading, score_statistics
from adxl_ros.blind.grading import Answer, UNKNOWN
from adxl_ros.blind.held_out_gap import NOISE_LIKE
from adxl_ros.blind.trials import Label
import numpy as np

# Bars: name, words, at most (-1) or at least (+1) or within (0), figures.
BARS = (
    ('false_alarms', 'false alarms', -1, (0.05,)),
    ('top_1', 'top-1 where the oracle tells it', 1, (0.9,)),
    ('set_recall', 'recall of the named set where the oracle sees it', 1, (0.95,)),
    ('calibration_error', 'calibration error', -1, (0.05,)),
    ('coverage', 'coverage of 90 % intervals', 0, (0.87, 0.93)),
    ('closed_by_oracle', 'gap closed ÷ oracle, median', 1, (0.95,)),
    ('harm', 'harm', -1, (0.01,)),
    ('unknown_recall', 'recall of unknown where a flexible model sees it', 1, (0.8,)),
)

# What is made worse by less than this part of the floor's mean square is not harm.
_HARM = 0.01


@dataclass(frozen=True)
class Trial:
    """A case, what was answered, and how the held-out recording fared."""

    label: Label
    given: Answer
    held: dict[str, Any] | None


def scores(trials: Sequence[Trial]) -> dict[str, Any]:
    """Make every score; a figure is `value`, its 90 % `ci` and the `count` it stands on."""
    real = [trial for trial in trials if trial.label.group != 'zero']

    def group(name: str, test: Callable[[Label], bool] = lambda label: True) -> list[Trial]:
        return [trial for trial in real if trial.label.group == name and test(trial.label)]

    alarms = score_statistics.share([trial.given.gap for trial in group('none')])
    confidences = [(trial.given.probability, grading.verdict_right(trial.given, trial.label))
                   for trial in real]
    seen = group('single', grading.visible)
    return {
        'false_alarms': alarms,
        'detection': _detection(real, alarms['value'] or 0.0),
        'top_1': score_statistics.share([_top(trial) for trial in group('single', grading.sure)]),
        'top_1_all_singles': score_statistics.share([_top(trial) for trial in group('single')]),
        'leading': score_statistics.share([_effect(trial) in trial.given.top for trial in seen]),
        'set_recall': score_statistics.share([_effect(trial) in trial.given.named
                                              for trial in seen]),
        'set_size': score_statistics.resampled([len(trial.given.named) for trial in seen],
                                               np.mean),
        'inseparable_size': score_statistics.resampled(
            [1 + len(trial.label.faults[0]['inseparable']) for trial in seen], np.mean),
        'verdict_right': score_statistics.share([right for _, right in confidences]),
        'brier': score_statistics.resampled(
            [grading.brier(trial.given, trial.label) for trial in real], np.mean),
        'calibration_error': score_statistics.resampled(confidences,
                                                        score_statistics.calibration_error),
        'reliability': score_statistics.reliability(confidences),
        'coverage': _coverage(real),
        **_held(real),
        'unknown_recall': score_statistics.share([
            _unknown(trial) for trial in group('outside', lambda label: label.flexible >= 0.9)]),
        'unknown_recall_all': score_statistics.share([_unknown(trial)
                                                      for trial in group('outside')]),
        'unknown_wrongly': score_statistics.share([_unknown(trial) for trial in real
                                                   if trial.label.group != 'outside']),
        'pairs': _pairs(group('pair')),
        'by_effect': _by_effect(real),
        'confusion': _confusion(real),
        'baselines': _baselines(real),
        'seconds': score_statistics.resampled([trial.given.seconds for trial in trials],
                                              np.median),
        'longest_s': max((trial.given.seconds for trial in trials), default=0.0),
        'status': dict(Counter(trial.given.status for trial in real)),
    }


def bars(made: dict[str, Any]) -> list[dict[str, Any]]:
    """
    Hold the scores against the bars.

    A bar is met where it lies inside the figure's interval or the figure is better; `met` is
    None where no trial bears on it.
    """
    rows = []
    for name, words, way, level in BARS:
        figure, met = made[name], None
        if figure['value'] is not None:
            low, high = figure['ci']
            met = (way > 0 or low <= level[-1]) and (way < 0 or high >= level[0])
        rows.append({'name': name, 'words': words, 'way': way, 'bar': list(level), 'met': met,
                     **{key: figure[key] for key in ('value', 'ci', 'count')}})
    return rows


def _effect(trial: Trial) -> str:
    return trial.label.effects[0]


def _top(trial: Trial) -> bool:
    return trial.given.top == grading.truth(trial.label)


def _unknown(trial: Trial) -> bool:
    return UNKNOWN in trial.given.named or UNKNOWN in trial.given.top


def _detection(real: Sequence[Trial], alarms: float) -> dict[str, Any]:
    singles = [trial for trial in real if trial.label.group in ('single', 'outside')]
    parts = {'every': singles,
             'of_the_mean': [trial for trial in singles if trial.label.group == 'single'
                             and _effect(trial) not in NOISE_LIKE],
             'noise_like': [trial for trial in singles if _effect(trial) in NOISE_LIKE],
             'outside': [trial for trial in singles if trial.label.group == 'outside']}
    out = {}
    for name, some in parts.items():
        strength = np.array([trial.label.faults[0]['strength_mps2'] for trial in some])
        out[name] = score_statistics.curve(strength, np.array(
            [trial.given.gap for trial in some]), alarms)
        out[name]['oracle'] = score_statistics.bins(strength, np.array(
            [trial.label.faults[0]['power'] > 0.5 for trial in some]))
    return out


def _coverage(real: Sequence[Trial]) -> dict[str, Any]:
    """Cover by intervals of effects that were rightly named for certain; cases are resampled."""
    rows: list[tuple[int, int]] = []
    for trial in real:
        if trial.label.group not in ('single', 'pair') or \
                trial.given.certain != grading.truth(trial.label) or trial.given.groups:
            continue
        true = grading.true_parameters(trial.label)
        inside = [low <= true[name] <= high
                  for name, (_, low, high) in trial.given.parameters.items() if name in true]
        if inside:
            rows.append((sum(inside), len(inside)))

    def covered(some: list[tuple[int, int]]) -> float:
        table = np.array(some)
        return float(table[:, 0].sum() / table[:, 1].sum())
    return score_statistics.resampled(rows, covered)


def _held(real: Sequence[Trial]) -> dict[str, Any]:
    """Judge on held-out recordings: share closed beside the oracle's, and harm."""
    closed, ratio, harm = [], [], []
    for trial in real:
        held = trial.held
        harm.append(held is not None and held['harm_ci'][0] > _HARM * held['floor'])
        if held is None or trial.label.group not in ('single', 'pair') \
                or held['gap_ci'][0] <= 0 or not grading.visible(trial.label):
            continue
        gap = held['before'] - held['floor']
        own, oracle = (1 - (held[name] - held['floor']) / gap for name in ('after', 'oracle'))
        closed.append(own)
        if oracle > 0:
            ratio.append(own / oracle)
    return {'closed': score_statistics.resampled(closed, np.median),
            'closed_by_oracle': score_statistics.resampled(ratio, np.median),
            'harm': score_statistics.share(harm)}


def _pairs(pairs: Sequence[Trial]) -> dict[str, Any]:
    seen = [trial for trial in pairs if grading.visible(trial.label)]
    found = [len(trial.given.named & grading.truth(trial.label)) for trial in seen]
    return {'whole': score_statistics.share([n == 2 for n in found]),
            'in_part': score_statistics.share([n == 1 for n in found]),
            'exactly': score_statistics.share([_top(trial) for trial in seen])}


def _by_effect(real: Sequence[Trial]) -> dict[str, dict[str, int]]:
    """Count for each effect that the ideal observer sees: trials, detected, in the set, top."""
    table: dict[str, Counter] = {}
    for trial in real:
        if trial.label.group in ('single', 'outside') and grading.visible(trial.label):
            row = table.setdefault(_effect(trial), Counter(trials=0, detected=0, named=0, top=0))
            wanted = grading.truth(trial.label)
            row.update(trials=1, detected=int(trial.given.gap), top=int(_top(trial)),
                       named=int(wanted <= trial.given.named))
    return {name: dict(row) for name, row in sorted(table.items())}


def _confusion(real: Sequence[Trial]) -> dict[str, dict[str, int]]:
    """Count top answers by what is true; pairs count apart."""
    table: dict[str, Counter] = {}
    for trial in real:
        if trial.label.group == 'pair':
            continue
        row = 'none' if trial.label.group == 'none' else UNKNOWN \
            if trial.label.group == 'outside' else _effect(trial)
        top = trial.given.top
        column = trial.given.status if trial.given.status in ('failed', 'bad_data') \
            else 'none' if not top else 'several' if len(top) > 1 else next(iter(top))
        table.setdefault(row, Counter())[column] += 1
    return {name: dict(row) for name, row in sorted(table.items())}


def _baselines(real: Sequence[Trial]) -> dict[str, dict[str, Any]]:
    """Score what is simpler: wholly right answers of all cases, and false alarms."""
    mix = Counter('+'.join(sorted(grading.truth(trial.label))) for trial in real)
    out = {'guess by prior': {
        'right': {'value': sum(n * n for n in mix.values()) / max(len(real), 1) ** 2, 'ci': None,
                  'count': len(real)},
        'false_alarms': {'value': 1 - mix[''] / max(len(real), 1), 'ci': None,
                         'count': mix['']}}}
    chosen: dict[str, Callable[[Trial], frozenset[str]]] = {
        'smallest RMSE': lambda trial: frozenset({trial.label.plain['rmse']}),
        'BIC, white noise': lambda trial: frozenset(
            {trial.label.plain['bic']} if trial.label.plain['bic'] else ()),
        'diagnose': lambda trial: trial.given.top}
    for name, choose in chosen.items():
        out[name] = {
            'right': score_statistics.share([choose(trial) in grading.right(trial.label)
                                             for trial in real]),
            'false_alarms': score_statistics.share([bool(choose(trial)) for trial in real
                                                    if trial.label.group == 'none'])}
    return out
