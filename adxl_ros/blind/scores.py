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

"""The scores of a check with their intervals, and the bars that they should meet."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from adxl_ros.blind import diagnostic_utility, grading, reference_methods, score_statistics
from adxl_ros.blind.grading import Answer, UNKNOWN
from adxl_ros.blind.held_out_gap import NOISE_LIKE
from adxl_ros.blind.trials import Label
import numpy as np


@dataclass(frozen=True)
class Bar:
    """
    What a score should reach.

    Attributes
    ----------
    name
        Key of the score.
    words
        Its name for people.
    direction
        −1 for at most, 1 for at least, 0 for within.
    levels
        The bar, or both ends of the range.
    fourth_run
        The score of the fourth run (docs/blind-check-log.md), which a later run should reach.

    """

    name: str
    words: str
    direction: int
    levels: tuple[float, ...]
    fourth_run: float


BARS = (
    Bar('false_alarms', 'false alarms', -1, (0.05,), 0.0),
    Bar('top_1', 'top-1 where the oracle separates it', 1, (0.9,), 0.75),
    Bar('set_recall', 'recall of the named set where the oracle sees it', 1, (0.95,), 0.797),
    Bar('calibration_error', 'calibration error', -1, (0.05,), 0.0449),
    Bar('coverage', 'coverage of 90 % intervals', 0, (0.87, 0.93), 0.898),
    Bar('closed_by_oracle', 'gap closed ÷ oracle, median', 1, (0.95,), 0.998),
    Bar('harm', 'harm', -1, (0.01,), 0.02),
    Bar('unknown_recall', 'recall of unknown where a flexible model sees it', 1, (0.8,), 0.75),
)
"""What a diagnosis should reach; chosen."""
FEWEST_TRIALS = 10
"""Fewest trials of a score that is compared with its bar; chosen: the 90 % interval of a share
is about 0.5 wide there."""
_DIGITS = 3
"""Number of digits after the point in the scores of the fourth run."""
_HARM = 0.01
"""Smallest harm, as a share of the floor's mean square; chosen."""


@dataclass(frozen=True)
class Trial:
    """
    One graded trial.

    Attributes
    ----------
    label
        What is true.
    answer
        What the diagnosis answered.
    held_out
        Result of `held_out_gap.evaluate`.

    """

    label: Label
    answer: Answer
    held_out: dict[str, Any] | None


def scores(trials: Sequence[Trial], others: dict[str, list[Answer]] | None = None
           ) -> dict[str, Any]:
    """
    Return every score: `value`, its 90 % `ci`, and the `count` of trials behind it.

    Parameters
    ----------
    trials
        The graded trials.
    others
        Answers of other methods in the order of the trials, by name.

    Returns
    -------
    dict
        The scores by name; `comparison` has those of `naming_scores` by method.

    """
    real = [trial for trial in trials if trial.label.group != 'zero']
    methods = {name: [Trial(trial.label, answer, None) for trial, answer in zip(trials, answers)
                      if trial.label.group != 'zero'] for name, answers in (others or {}).items()}
    labels = [trial.label for trial in real]
    methods |= {name: [Trial(label, answer, None) for label, answer in zip(labels, answers)]
                for name, answers in reference_methods.answers(labels).items()}
    confidences = [(trial.answer.probability, grading.verdict_right(trial.answer, trial.label))
                   for trial in real]
    singles = _group(real, 'single')
    seen = _group(real, 'single', grading.visible)
    named = naming_scores(real)
    return {
        **named,
        'comparison': {name: naming_scores(rows) for name, rows in methods.items()},
        'detection': _detection(real, named['false_alarms']['value'] or 0.0),
        'top_1_all_singles': score_statistics.share([_top(trial) for trial in singles]),
        'leading': score_statistics.share([_effect(trial) in trial.answer.top for trial in seen]),
        'set_size': score_statistics.resampled([len(trial.answer.named) for trial in seen],
                                               np.mean),
        'inseparable_size': score_statistics.resampled(
            [1 + len(trial.label.faults[0]['inseparable']) for trial in seen], np.mean),
        'brier': score_statistics.resampled(
            [grading.brier(trial.answer, trial.label) for trial in real], np.mean),
        'calibration_error': score_statistics.resampled(confidences,
                                                        score_statistics.calibration_error),
        'reliability': score_statistics.reliability(confidences),
        'coverage': _coverage(real),
        'ranks': _ranks(real),
        **_held(real),
        'unknown_recall_all': score_statistics.share([_unknown(trial)
                                                      for trial in _group(real, 'outside')]),
        'unknown_wrongly': score_statistics.share([_unknown(trial) for trial in real
                                                   if trial.label.group != 'outside']),
        'pairs': _pairs(_group(real, 'pair')),
        'by_effect': _by_effect(real),
        'confusion': _confusion(real),
        'seconds': score_statistics.resampled([trial.answer.seconds for trial in trials],
                                              np.median),
        'longest_s': max((trial.answer.seconds for trial in trials), default=0.0),
        'status': dict(Counter(trial.answer.status for trial in real)),
    }


def naming_scores(trials: Sequence[Trial]) -> dict[str, Any]:
    """Return the scores that any method has which names effects; no trial has strength zero."""
    outside = _group(trials, 'outside', lambda label: label.flexible >= grading.CERTAIN_POWER)
    groups = [(diagnostic_utility.answered_group(trial.answer),
               diagnostic_utility.true_group(trial.label)) for trial in trials]
    faulty = [(group, true) for group, true in groups if any(true)]
    return {
        'false_alarms': score_statistics.share([trial.answer.gap
                                                for trial in _group(trials, 'none')]),
        'top_1': score_statistics.share([
            _top(trial) for trial in _group(trials, 'single', grading.separable)]),
        'set_recall': score_statistics.share([
            _effect(trial) in trial.answer.named
            for trial in _group(trials, 'single', grading.visible)]),
        'unknown_recall': score_statistics.share([_unknown(trial) for trial in outside]),
        'verdict_right': score_statistics.share([
            grading.verdict_right(trial.answer, trial.label) for trial in trials]),
        'utility': score_statistics.resampled(
            [diagnostic_utility.utility(*pair) for pair in groups], np.mean),
        'utility_of_effects': score_statistics.resampled(
            [diagnostic_utility.utility(*pair) for pair in faulty], np.mean),
    }


def bars(made: dict[str, Any]) -> list[dict[str, Any]]:
    """
    Compare the scores with the bars and with the fourth run.

    `met` states whether the score does not refute its bar, see `outcome`. It is None without a
    trial. `no_worse` is 'yes' where the score is at least that of the
    fourth run, 'open' where it is worse but its interval reaches the fourth run, and 'no' else.
    """
    rows = []
    for bar in BARS:
        score, met, no_worse = made[bar.name], None, None
        if score['value'] is not None:
            low, high = score['ci']
            met = _within(bar, score['value'], score['value']) or _within(bar, low, high)
            no_worse = _no_worse(bar, score['value'], low, high)
        rows.append({'name': bar.name, 'words': bar.words, 'way': bar.direction,
                     'bar': list(bar.levels), 'met': met, 'fourth_run': bar.fourth_run,
                     'no_worse': no_worse,
                     **{key: score[key] for key in ('value', 'ci', 'count')}})
    return rows


def _within(bar: Bar, low: float, high: float) -> bool:
    """Return whether some value between `low` and `high` meets the bar."""
    return (bar.direction > 0 or low <= bar.levels[-1]) and \
        (bar.direction < 0 or high >= bar.levels[0])


def outcome(row: dict[str, Any]) -> str:
    """
    Compare a score with its bar in words.

    Parameters
    ----------
    row
        A row of `bars`: `met`, `value`, `ci`, `count`, `way` and `bar`.

    Returns
    -------
    str
        'yes' where score and interval meet the bar, 'NO' where neither reaches it, and else 'not
        refuted'. 'too few' for fewer than `FEWEST_TRIALS` trials, and 'no trial' without one.

    """
    if row['met'] is None:
        return 'no trial'
    if row['count'] < FEWEST_TRIALS:
        return 'too few'
    bar = Bar('', '', row['way'], tuple(row['bar']), 0.0)
    # The interval of resampled trials may lie beside a score that is biased.
    values = (row['value'], *row['ci'])
    if all(_within(bar, value, value) for value in values):
        return 'yes'
    reached = _within(bar, row['value'], row['value']) or _within(bar, *row['ci'])
    return 'not refuted' if reached else 'NO'


def _no_worse(bar: Bar, value: float, low: float, high: float) -> str:
    """Compare a score and the ends of its interval with the fourth run; see `bars`."""
    def distance(score: float) -> float:
        """Return by how much a score misses the bar; it has no lower end if better is enough."""
        if bar.direction:
            return -bar.direction * score
        return max(bar.levels[0] - score, score - bar.levels[-1], 0.0)

    # The digits that the log states are the precision of the fourth run's scores.
    limit = distance(bar.fourth_run) + 0.5 * 10.0 ** -_DIGITS
    if distance(value) <= limit:
        return 'yes'
    nearest = min(max(bar.levels[0], low), high) if not bar.direction else \
        high if bar.direction > 0 else low
    return 'open' if distance(nearest) <= limit else 'no'


def _group(trials: Sequence[Trial], name: str,
           test: Callable[[Label], bool] = lambda label: True) -> list[Trial]:
    """Return the trials of a group that pass a test."""
    return [trial for trial in trials if trial.label.group == name and test(trial.label)]


def _effect(trial: Trial) -> str:
    return trial.label.effects[0]


def _top(trial: Trial) -> bool:
    return trial.answer.top == grading.truth(trial.label)


def _unknown(trial: Trial) -> bool:
    return UNKNOWN in trial.answer.named or UNKNOWN in trial.answer.top


def _detection(real: Sequence[Trial], alarms: float) -> dict[str, Any]:
    singles = [trial for trial in real if trial.label.group in ('single', 'outside')]
    parts = {'every': singles,
             'of_the_mean': [trial for trial in singles if trial.label.group == 'single'
                             and _effect(trial) not in NOISE_LIKE],
             'noise_like': [trial for trial in singles if _effect(trial) in NOISE_LIKE],
             'outside': [trial for trial in singles if trial.label.group == 'outside']}
    out = {}
    for name, subset in parts.items():
        strength = np.array([trial.label.faults[0]['strength_mps2'] for trial in subset])
        out[name] = score_statistics.curve(strength, np.array(
            [trial.answer.gap for trial in subset]), alarms)
        out[name]['oracle'] = score_statistics.bins(strength, np.array(
            [trial.label.faults[0]['power'] > 0.5 for trial in subset]))
    return out


def _coverage(real: Sequence[Trial]) -> dict[str, Any]:
    """Return the coverage by intervals of effects that are rightly named for certain."""
    rows: list[tuple[int, int]] = []
    for trial in _rightly_named(real):
        true = grading.true_parameters(trial.label)
        inside = [low <= true[name] <= high
                  for name, (_, low, high) in trial.answer.parameters.items() if name in true]
        if inside:
            rows.append((sum(inside), len(inside)))

    def covered(counts: list[tuple[int, int]]) -> float:
        table = np.array(counts)
        return float(table[:, 0].sum() / table[:, 1].sum())
    return score_statistics.resampled(rows, covered)


def _rightly_named(real: Sequence[Trial]) -> list[Trial]:
    """Return the trials whose effects of the library are named for certain, and no others."""
    return [trial for trial in real if trial.label.group in ('single', 'pair')
            and trial.answer.certain == grading.truth(trial.label) and not trial.answer.groups]


def _ranks(real: Sequence[Trial]) -> dict[str, dict[str, Any]]:
    """Return rank histograms of all parameters, and of the parameters of each effect."""
    every = [grading.ranks(trial.answer, trial.label) for trial in _rightly_named(real)]
    effects = sorted({name.split('.')[0] for ranks in every for name in ranks})
    out = {'all': score_statistics.rank_histogram([list(ranks.values()) for ranks in every])}
    for effect in effects:
        out[effect] = score_statistics.rank_histogram([
            [rank for name, rank in ranks.items() if name.split('.')[0] == effect]
            for ranks in every])
    return out


def _held(real: Sequence[Trial]) -> dict[str, Any]:
    """Return the share closed on held-out recordings, its ratio to the oracle's, and the harm."""
    closed, ratio, harm = [], [], []
    for trial in real:
        gaps = trial.held_out
        harm.append(gaps is not None and gaps['harm_ci'][0] > _HARM * gaps['floor'])
        if gaps is None or trial.label.group not in ('single', 'pair') \
                or gaps['gap_ci'][0] <= 0 or not grading.visible(trial.label):
            continue
        gap = gaps['before'] - gaps['floor']
        share, oracle = (1 - (gaps[name] - gaps['floor']) / gap for name in ('after', 'oracle'))
        closed.append(share)
        if oracle > 0:
            ratio.append(share / oracle)
    return {'closed': score_statistics.resampled(closed, np.median),
            'closed_by_oracle': score_statistics.resampled(ratio, np.median),
            'harm': score_statistics.share(harm)}


def _pairs(pairs: Sequence[Trial]) -> dict[str, Any]:
    seen = [trial for trial in pairs if grading.visible(trial.label)]
    named = [len(trial.answer.named & grading.truth(trial.label)) for trial in seen]
    return {'whole': score_statistics.share([n == 2 for n in named]),
            'in_part': score_statistics.share([n == 1 for n in named]),
            'exactly': score_statistics.share([_top(trial) for trial in seen])}


def _by_effect(real: Sequence[Trial]) -> dict[str, dict[str, int]]:
    """Count trials, detected, named and top for each effect that the ideal observer sees."""
    table: dict[str, Counter] = {}
    for trial in real:
        if trial.label.group in ('single', 'outside') and grading.visible(trial.label):
            row = table.setdefault(_effect(trial), Counter(trials=0, detected=0, named=0, top=0))
            true = grading.truth(trial.label)
            row.update(trials=1, detected=int(trial.answer.gap), top=int(_top(trial)),
                       named=int(true <= trial.answer.named))
    return {name: dict(row) for name, row in sorted(table.items())}


def _confusion(real: Sequence[Trial]) -> dict[str, dict[str, int]]:
    """Count top answers by true effect, without pairs."""
    table: dict[str, Counter] = {}
    for trial in real:
        if trial.label.group == 'pair':
            continue
        row = 'none' if trial.label.group == 'none' else UNKNOWN \
            if trial.label.group == 'outside' else _effect(trial)
        top = trial.answer.top
        column = trial.answer.status if trial.answer.status in ('failed', 'bad_data') \
            else 'none' if not top else 'several' if len(top) > 1 else next(iter(top))
        table.setdefault(row, Counter())[column] += 1
    return {name: dict(row) for name, row in sorted(table.items())}
