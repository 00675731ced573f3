# SPDX-License-Identifier: Apache-2.0
"""The scores of a check with their intervals, the bars that they should meet, and controls."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
import math
from pathlib import Path
from typing import Any, NamedTuple

from adxl_ros_validation.blind import grading
from adxl_ros_validation.blind.faults import NOISE_LIKE
from adxl_ros_validation.blind.grading import Answer, UNKNOWN
from adxl_ros_validation.blind.trials import Label
import numpy as np
import scipy

LEVEL = 0.9
"""Probability of all intervals."""
_RESAMPLES = 1000
"""Number of bootstrap samples; chosen."""
_CONFIDENCES = np.array([0.0, 0.5, 0.7, 0.8, 0.9, 0.95, 0.98, 1.0])
"""Edges of the bins of the probability that a verdict states."""
_HARM = 0.01
"""Smallest harm, as a share of the floor's mean square; chosen."""
Score = dict[str, Any]
"""A score: its `value`, its interval `ci`, and the `count` of trials behind it."""
_NO_SCORE: Score = {'value': None, 'ci': None, 'count': 0}


class Trial(NamedTuple):
    """One graded trial."""

    label: Label  # what is true
    answer: Answer  # what the diagnosis answered
    held_out: dict[str, Any] | None  # result of `diagnosis_runs.evaluate`


def share(hits: Sequence[bool] | np.ndarray) -> Score:
    """Return the share of hits with Wilson's interval; None without trials."""
    count, true = len(hits), int(np.sum(hits))
    if not count:
        return _NO_SCORE
    ci = scipy.stats.binomtest(true, count).proportion_ci(LEVEL, 'wilson')
    return {'value': true / count, 'ci': [float(ci.low), float(ci.high)], 'count': count}


def in_words(made: Score) -> str:
    """Return a share with its interval, in percent."""
    if made['value'] is None:
        return '-'
    value, low, high = (100 * part for part in (made['value'], *made['ci']))
    return f'{value:.0f} % ({low:.0f} to {high:.0f}), n = {made["count"]}'


def resampled(rows: Sequence[Any], statistic: Callable[[list[Any]], float] = np.mean) -> Score:
    """Return a statistic of rows with its interval over resampled rows."""
    if not len(rows):
        return _NO_SCORE
    rng = np.random.default_rng(0)
    drawn = [statistic([rows[i] for i in rng.integers(len(rows), size=len(rows))])
             for _ in range(_RESAMPLES)]
    low, high = np.nanquantile(drawn, ((1 - LEVEL) / 2, (1 + LEVEL) / 2))
    return {'value': float(statistic(list(rows))), 'ci': [float(low), float(high)],
            'count': len(rows)}


def by_strength(trials: Sequence[Trial], count: int = 8) -> list[dict[str, Any]]:
    """Return the share detected, and that which the oracle sees, in bins of equal numbers."""
    order = sorted(trials, key=lambda trial: trial.label.faults[0]['strength_mps2'])
    parts = np.array_split(np.arange(len(order)), min(count, max(len(order) // 3, 1)))
    rows = []
    for part in ([order[i] for i in index] for index in parts if len(index)):
        faults = [trial.label.faults[0] for trial in part]
        rows.append({'strength': float(np.median([row['strength_mps2'] for row in faults])),
                     **share([trial.answer.gap for trial in part]),
                     'oracle': float(np.mean([row['power'] > 0.5 for row in faults]))})
    return rows


def reliability(rows: Sequence[tuple[float, bool]]) -> list[dict[str, Any]]:
    """Return the share right in bins of confidence, from pairs (confidence, right)."""
    table = np.asarray(rows, float).reshape(-1, 2)
    index = np.searchsorted(_CONFIDENCES[1:-1], table[:, 0], 'right')
    parts = [(k, table[index == k]) for k in np.unique(index)]
    return [{'confidence': float(part[:, 0].mean()), 'right': float(part[:, 1].mean()),
             'count': len(part), 'ci': share(part[:, 1] > 0.5)['ci'],
             'bin': _CONFIDENCES[[k, k + 1]].tolist()} for k, part in parts]


def calibration_error(rows: Sequence[tuple[float, bool]]) -> float:
    """Return the mean distance of confidence and share right, over the bins of `reliability`."""
    return sum(row['count'] * abs(row['right'] - row['confidence'])
               for row in reliability(rows)) / max(len(rows), 1)


class Bar(NamedTuple):
    """What a score should reach; `low` or `high` may be infinite."""

    words: str
    low: float
    high: float

    def in_words(self) -> str:
        """Return the bar in words."""
        if math.isinf(self.low):
            return f'at most {self.high:g}'
        return f'at least {self.low:g}' if math.isinf(self.high) else \
            f'{self.low:g} to {self.high:g}'


BARS = {
    'false_alarms': Bar('false alarms', -math.inf, 0.05),
    'top_1': Bar('top-1 where the oracle separates it', 0.9, math.inf),
    'set_recall': Bar('recall of the named set where the oracle sees it', 0.95, math.inf),
    'calibration_error': Bar('calibration error', -math.inf, 0.05),
    'coverage': Bar('coverage of 90 % intervals', 0.87, 0.93),
    'closed_by_oracle': Bar('gap closed ÷ oracle, median', 0.95, math.inf),
    'limit_held': Bar('upper limit of no gap holds the effect', 0.9, math.inf),
    'harm': Bar('harm', -math.inf, 0.01),
    'unknown_recall': Bar('recall of unknown where a flexible model sees it', 0.8, math.inf),
}
"""What a diagnosis should reach, by score; chosen."""
FEWEST_TRIALS = 10
"""Fewest trials of a score that is compared with its bar; chosen: the 90 % interval of a share
is about 0.5 wide there."""


def outcome(bar: Bar, score: Score) -> str:
    """Compare a score with its bar in words."""
    if score['value'] is None:
        return 'no trial'
    if score['count'] < FEWEST_TRIALS:
        return 'too few'
    # The interval of resampled trials may lie beside a score that is biased.
    value, (low, high) = score['value'], score['ci']
    if bar.low <= min(value, low) and max(value, high) <= bar.high:
        return 'yes'
    reached = bar.low <= value <= bar.high or (low <= bar.high and high >= bar.low)
    return 'not refuted' if reached else 'NO'


def bars(made: dict[str, Any]) -> list[dict[str, Any]]:
    """Compare the scores with the bars."""
    return [{'name': name, 'words': bar.words, 'bar': bar.in_words(),
             'met': outcome(bar, made[name]), **made[name]} for name, bar in BARS.items()]


def scores(trials: Sequence[Trial]) -> dict[str, Any]:
    """Return every score."""
    real = [trial for trial in trials if trial.label.group != 'zero']
    confidences = [(trial.answer.probability, grading.verdict_right(trial.answer, trial.label))
                   for trial in real]
    singles = _group(real, 'single')
    seen = _group(real, 'single', grading.visible)
    pairs = [trial for trial in _group(real, 'pair') if grading.visible(trial.label)]
    named_of_pair = [len(trial.answer.named & grading.truth(trial.label)) for trial in pairs]
    limits = [grading.limit_holds(trial.answer, trial.label) for trial in real]
    outside = _group(real, 'outside', lambda label: label.flexible >= grading.CERTAIN_POWER)
    groups = [(grading.answered_group(trial.answer), grading.true_group(trial.label))
              for trial in real]
    return {
        'false_alarms': share([trial.answer.gap for trial in _group(real, 'none')]),
        'top_1': share([_top(trial) for trial in _group(real, 'single', grading.separable)]),
        'set_recall': share([_effect(trial) in trial.answer.named for trial in seen]),
        'unknown_recall': share([_unknown(trial) for trial in outside]),
        'verdict_right': share([right for _, right in confidences]),
        'utility': resampled([grading.utility(*pair) for pair in groups]),
        'utility_of_effects': resampled([grading.utility(group, true) for group, true in groups
                                         if any(true)]),
        'detection': {
            'of the mean': by_strength([t for t in singles if _effect(t) not in NOISE_LIKE]),
            'noise like': by_strength([t for t in singles if _effect(t) in NOISE_LIKE]),
            'outside': by_strength(_group(real, 'outside'))},
        'top_1_all_singles': share([_top(trial) for trial in singles]),
        'leading': share([_effect(trial) in trial.answer.top for trial in seen]),
        'set_size': resampled([len(trial.answer.named) for trial in seen]),
        'inseparable_size': resampled(
            [1 + len(trial.label.faults[0]['inseparable']) for trial in seen]),
        'brier': resampled([grading.brier(trial.answer, trial.label) for trial in real]),
        'calibration_error': resampled(confidences, calibration_error),
        'reliability': reliability(confidences),
        'coverage': _coverage(real),
        **_held(real),
        'unknown_recall_all': share([_unknown(trial) for trial in _group(real, 'outside')]),
        'unknown_wrongly': share([_unknown(trial) for trial in real
                                  if trial.label.group != 'outside']),
        'pairs': {'whole': share([n == 2 for n in named_of_pair]),
                  'in_part': share([n == 1 for n in named_of_pair]),
                  'exactly': share([_top(trial) for trial in pairs])},
        'by_effect': _by_effect(real),
        'limit_held': share([held for held in limits if held is not None]),
        'confusion': _confusion(real),
        'seconds': resampled([trial.answer.seconds for trial in trials], np.median),
        'longest_s': max((trial.answer.seconds for trial in trials), default=0.0),
        'status': dict(Counter(trial.answer.status for trial in real)),
    }


def _group(trials: Sequence[Trial], name: str,
           test: Callable[[Label], bool] | None = None) -> list[Trial]:
    """Return the trials of a group; with a test those that pass it with material effects."""
    return [trial for trial in trials if trial.label.group == name and (
        test is None or (test(trial.label) and grading.material(trial.answer, trial.label)))]


def _effect(trial: Trial) -> str:
    return trial.label.effects[0]


def _top(trial: Trial) -> bool:
    return trial.answer.top == grading.truth(trial.label)


def _unknown(trial: Trial) -> bool:
    return UNKNOWN in trial.answer.named or UNKNOWN in trial.answer.top


def _coverage(real: Sequence[Trial]) -> Score:
    """Return the coverage by intervals of effects that are rightly named for certain."""
    rows: list[tuple[int, int]] = []
    for trial in real:
        if trial.label.group not in ('single', 'pair') or trial.answer.groups \
                or trial.answer.certain != grading.truth(trial.label):
            continue
        true = grading.true_parameters(trial.label)
        inside = [low <= true[name] <= high
                  for name, (_, low, high) in trial.answer.parameters.items() if name in true]
        if inside:
            rows.append((sum(inside), len(inside)))
    return resampled(rows, lambda counts: float(np.divide(*np.sum(counts, axis=0))))


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
        part, oracle = (1 - (gaps[name] - gaps['floor']) / gap for name in ('after', 'oracle'))
        closed.append(part)
        if oracle > 0:
            ratio.append(part / oracle)
    return {'closed': resampled(closed, np.median),
            'closed_by_oracle': resampled(ratio, np.median), 'harm': share(harm)}


def _by_effect(real: Sequence[Trial]) -> dict[str, dict[str, int]]:
    """Count trials, detected, named and top for each effect that the ideal observer sees."""
    table: dict[str, Counter] = {}
    for trial in real:
        if trial.label.group in ('single', 'outside') and grading.visible(trial.label):
            true = grading.truth(trial.label)
            table.setdefault(_effect(trial), Counter()).update({
                'trials': 1, 'detected': int(trial.answer.gap),
                'named': int(true <= trial.answer.named), 'top': int(_top(trial))})
    return {name: dict(row) for name, row in sorted(table.items())}


def _confusion(real: Sequence[Trial]) -> dict[str, dict[str, int]]:
    """Count top answers by true effect, without pairs."""
    table: dict[str, Counter] = {}
    for trial in real:
        label, top = trial.label, trial.answer.top
        if label.group == 'pair':
            continue
        row = {'none': 'none', 'outside': UNKNOWN}.get(label.group) or _effect(trial)
        column = trial.answer.status if trial.answer.status in ('failed', 'bad_data') \
            else 'none' if not top else 'several' if len(top) > 1 else next(iter(top))
        table.setdefault(row, Counter())[column] += 1
    return {name: dict(row) for name, row in sorted(table.items())}


_CHANCE = 0.002
"""Chance that one control reports a leak of a check that has none; chosen."""
_SHUFFLES = 2000
"""Number of permutations of the labels; chosen."""


def permuted(trials: Sequence[Trial]) -> dict[str, Any]:
    """
    Score the answers against the labels of other trials.

    The score by chance follows from the frequencies of answers and labels. A higher score uses
    something besides the answers.
    """
    real = [trial for trial in trials if trial.label.group != 'zero']
    accepted = [grading.right(trial.label) for trial in real]
    right = np.array([[trial.answer.top in effects for effects in accepted]
                      for trial in real], float)
    rng, n = np.random.default_rng(0), len(real)
    shuffled = np.array([right[np.arange(n), rng.permutation(n)].mean()
                         for _ in range(_SHUFFLES)])
    chance = float(right.mean())
    low, high = (float(q) for q in np.quantile(shuffled, (_CHANCE / 2, 1 - _CHANCE / 2)))
    return {'score': float(shuffled.mean()), 'chance': chance,
            'labels_in_place': float(np.trace(right)) / n,
            'by_chance_between': [low, high], 'leaks': not low <= chance <= high}


def metadata(recordings: Path, labels: Sequence[Label]) -> dict[str, Any]:
    """
    Guess labels from sizes, lengths, times and names of files only.

    The score is the share of the variance of a quantity's ranks that the labels explain (Kruskal
    and Wallis), for the quantity that they explain best. At chance is the same with permuted
    labels. Labels count in three ways: by group, by effect, and as some effect or none.
    """
    def facts_of(name: str) -> tuple[float, ...]:
        csv, yaml = (recordings / f'{name}.{suffix}' for suffix in ('csv', 'yaml'))
        data, size, about = csv.read_bytes(), csv.stat().st_size, yaml.stat()
        rows, last = data.count(b'\n'), data.rstrip().rsplit(b'\n', 1)[-1]
        return (size, rows, size - rows * len(last), csv.stat().st_mtime, about.st_size,
                about.st_mtime, float(last.split(b',')[0]))

    def explained_by(members: np.ndarray) -> float:
        sums = members.T @ ranks
        between = np.sum(sums ** 2 / members.sum(axis=0)[:, None], axis=0)
        return float(np.max(between / np.maximum(np.sum(ranks ** 2, axis=0), 1e-12)))

    facts = np.array([facts_of(label.name) for label in labels], float)
    ranks = scipy.stats.rankdata(np.column_stack([facts, np.arange(len(labels))]), axis=0)
    ranks -= ranks.mean(axis=0)
    groupings = [[label.group for label in labels],
                 ['+'.join(label.effects) for label in labels],
                 ['something' if label.effects else 'nothing' for label in labels]]
    rng, count = np.random.default_rng(0), len(labels)
    explained, chance = [], []
    for grouping in groupings:
        index = np.unique(grouping, return_inverse=True)[1]
        members = np.eye(index.max() + 1)[index]
        explained.append(explained_by(members))
        chance.append([explained_by(members[rng.permutation(count)]) for _ in range(_SHUFFLES)])
    above = np.sum(np.array(chance) >= np.array(explained)[:, None] - 1e-12, axis=1)
    p = float((1 + above.min()) / (1 + _SHUFFLES))
    return {'score': explained[0], 'chance': float(np.mean(chance[0])), 'p': p,
            'leaks': p < _CHANCE}


def strength_zero(trials: Sequence[Trial]) -> dict[str, Any]:
    """Compare trials whose effect has strength zero with trials without an effect."""
    zero, none = ([trial.answer.gap for trial in trials if trial.label.group == group]
                  for group in ('zero', 'none'))
    named = sum(trial.label.effects[0] in trial.answer.named for trial in trials
                if trial.label.group == 'zero')
    if not zero or not none:
        return {'score': None, 'chance': None, 'p': 1.0, 'leaks': False, 'named': named}
    p = float(scipy.stats.fisher_exact([[sum(zero), len(zero) - sum(zero)],
                                       [sum(none), len(none) - sum(none)]]).pvalue)
    return {'score': sum(zero) / len(zero), 'chance': sum(none) / len(none), 'p': p,
            'named': named, 'leaks': p < _CHANCE}
