# SPDX-License-Identifier: Apache-2.0
"""The scores of a check with their intervals, and the bars that they should meet."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
import math
from typing import Any

from adxl_ros_validation.blind import grading
from adxl_ros_validation.blind.diagnosis_runs import NOISE_LIKE
from adxl_ros_validation.blind.grading import Answer, UNKNOWN
from adxl_ros_validation.blind.trials import Label
import numpy as np
import scipy

LEVEL = 0.9
"""Probability of all intervals."""
RANK_BINS = 10
"""Number of bins of a rank histogram; chosen: some ten ranks fall into each."""
_RESAMPLES = 1000
"""Number of bootstrap samples; chosen."""


def share(hits: Sequence[bool] | np.ndarray) -> dict[str, Any]:
    """Return the share of hits with Wilson's interval; None without trials."""
    count, true = len(hits), int(np.sum(hits))
    if not count:
        return {'value': None, 'ci': None, 'count': 0}
    ci = scipy.stats.binomtest(true, count).proportion_ci(LEVEL, 'wilson')
    return {'value': true / count, 'ci': [float(ci.low), float(ci.high)], 'count': count}


def in_words(made: dict[str, Any]) -> str:
    """Return a share with its interval, in percent."""
    if made['value'] is None:
        return '-'
    low, high = made['ci']
    return f'{100 * made["value"]:.0f} % ({100 * low:.0f} to {100 * high:.0f}), n = ' \
           f'{made["count"]}'


def resampled(rows: Sequence[Any], statistic: Callable[[list[Any]], float]) -> dict[str, Any]:
    """Return a statistic of rows with its interval over resampled rows."""
    if not len(rows):
        return {'value': None, 'ci': None, 'count': 0}
    rng = np.random.default_rng(0)
    drawn = [statistic([rows[i] for i in rng.integers(len(rows), size=len(rows))])
             for _ in range(_RESAMPLES)]
    low, high = np.nanquantile(drawn, ((1 - LEVEL) / 2, (1 + LEVEL) / 2))
    return {'value': float(statistic(list(rows))), 'ci': [float(low), float(high)],
            'count': len(rows)}


def curve(strength: np.ndarray, detected: np.ndarray, by_chance: float) -> dict[str, Any]:
    """Fit detection against the logarithm of strength, and find where it reaches 50 and 90 %."""
    x, y = np.log(np.maximum(strength, 1e-9)), np.asarray(detected, float)
    if len(x) < 8 or y.all() or not y.any():
        return {'at_50': None, 'at_90': None, 'bins': bins(strength, detected)}
    rng = np.random.default_rng(0)
    fitted = _logistic(x, y, by_chance, [float(q) for q in np.quantile(x, (0.2, 0.5))])
    drawn = []
    for _ in range(200):
        take = rng.integers(len(x), size=len(x))
        drawn.append(_logistic(x[take], y[take], by_chance, fitted[:1]))
    result: dict[str, Any] = {'bins': bins(strength, detected), 'by_chance': by_chance,
                              'middle': fitted[0], 'width': fitted[1], 'missed': fitted[2]}
    for level in (0.5, 0.9):
        value = _reaches(fitted, by_chance, level)
        resampled_levels = [_reaches(fit, by_chance, level) for fit in drawn]
        low, high = np.quantile(resampled_levels, (0.05, 0.95), method='nearest')
        result[f'at_{round(100 * level)}'] = None if math.isinf(value) else {
            'value': value, 'ci': [float(low), None if math.isinf(high) else float(high)]}
    return result


def detection(x: np.ndarray, middle: float, width: float, missed: float,
              by_chance: float) -> np.ndarray:
    """Return the fitted probability of detection."""
    return by_chance + (1 - by_chance - missed) / (1 + np.exp(-(x - middle) / width))


def _logistic(x: np.ndarray, y: np.ndarray, by_chance: float,
              starts: Sequence[float]) -> tuple[float, float, float]:
    def cost(p: np.ndarray) -> float:
        chance = np.clip(detection(x, p[0], math.exp(p[1]), p[2], by_chance), 1e-6, 1 - 1e-6)
        return float(-np.sum(y * np.log(chance) + (1 - y) * np.log(1 - chance)))

    best = min((scipy.optimize.minimize(
        cost, [middle, math.log(0.5), 0.02], method='L-BFGS-B',
        bounds=[(x.min() - 2, x.max() + 2), (math.log(0.05), math.log(5)), (0, 0.5)])
        for middle in starts), key=lambda fit: fit.fun)
    return float(best.x[0]), math.exp(best.x[1]), float(best.x[2])


def _reaches(fit: tuple[float, float, float], by_chance: float, level: float) -> float:
    middle, width, missed = fit
    part = (level - by_chance) / (1 - by_chance - missed)
    return math.exp(middle + width * math.log(part / (1 - part))) if 0 < part < 1 else math.inf


def bins(strength: np.ndarray, detected: np.ndarray, count: int = 8) -> list[dict[str, Any]]:
    """Return the share detected in bins of strength with equal numbers of trials."""
    order = np.argsort(strength)
    return [{'strength': float(np.median(strength[part])), **share(detected[part])}
            for part in np.array_split(order, min(count, max(len(order) // 3, 1))) if len(part)]


def calibration_error(rows: Sequence[tuple[float, bool]]) -> float:
    """Return the mean distance of confidence and share right, over the bins of `reliability`."""
    return sum(row['count'] * abs(row['right'] - row['confidence'])
               for row in reliability(rows)) / max(len(rows), 1)


def reliability(rows: Sequence[tuple[float, bool]]) -> list[dict[str, Any]]:
    """Return the share right in bins of confidence, from pairs (confidence, right)."""
    table = np.asarray(rows, float).reshape(-1, 2)
    edges = np.array([0.0, 0.5, 0.7, 0.8, 0.9, 0.95, 0.98, 1.0 + 1e-9])
    index = np.digitize(table[:, 0], edges) - 1
    return [{'confidence': float(table[index == k, 0].mean()),
             'right': float(table[index == k, 1].mean()), 'count': int(np.sum(index == k)),
             'ci': share(table[index == k, 1] > 0.5)['ci'],
             'bin': [float(edges[k]), min(float(edges[k + 1]), 1.0)]}
            for k in range(len(edges) - 1) if np.any(index == k)]


def rank_histogram(groups: Sequence[Sequence[float]]) -> dict[str, Any]:
    """
    Return the histogram of ranks, and whether it is uniform.

    Talts and others show how ranks of the truth reveal posteriors that are too narrow (a high
    count at both ends), too wide (in the middle) or biased (at one end) ("Validating Bayesian
    inference algorithms with simulation-based calibration", arXiv:1804.06788, 2018). The ranks of
    one trial are not independent. Each trial therefore has the same weight in the distance of
    Kolmogorov and Smirnov, and the number of trials is its sample size.
    """
    groups = [group for group in groups if len(group)]
    ranks = np.concatenate([np.asarray(group, float) for group in groups] or [np.zeros(0)])
    bins = np.histogram(ranks, RANK_BINS, (0, 1))[0].tolist()
    if not len(ranks):
        return {'bins': bins, 'count': 0, 'trials': 0, 'distance': None, 'p': None}
    weights = np.concatenate([np.full(len(group), 1 / len(group) / len(groups))
                              for group in groups])
    order = np.argsort(ranks)
    above = np.cumsum(weights[order])
    distance = max(np.max(above - ranks[order]), np.max(ranks[order] - above + weights[order]))
    return {'bins': bins, 'count': len(ranks), 'trials': len(groups),
            'distance': float(distance), 'p': float(scipy.stats.kstwo.sf(distance, len(groups)))}


@dataclass(frozen=True)
class Bar:
    """What a score should reach."""

    name: str  # key of the score
    words: str  # its name for people
    direction: int  # −1 for at most, 1 for at least, 0 for within
    levels: tuple[float, ...]  # the bar, or both ends of the range


BARS = (
    Bar('false_alarms', 'false alarms', -1, (0.05,)),
    Bar('top_1', 'top-1 where the oracle separates it', 1, (0.9,)),
    Bar('set_recall', 'recall of the named set where the oracle sees it', 1, (0.95,)),
    Bar('calibration_error', 'calibration error', -1, (0.05,)),
    Bar('coverage', 'coverage of 90 % intervals', 0, (0.87, 0.93)),
    Bar('closed_by_oracle', 'gap closed ÷ oracle, median', 1, (0.95,)),
    Bar('limit_held', 'upper limit of no gap holds the effect', 1, (0.9,)),
    Bar('harm', 'harm', -1, (0.01,)),
    Bar('unknown_recall', 'recall of unknown where a flexible model sees it', 1, (0.8,)),
)
"""What a diagnosis should reach; chosen."""
FEWEST_TRIALS = 10
"""Fewest trials of a score that is compared with its bar; chosen: the 90 % interval of a share
is about 0.5 wide there."""
_HARM = 0.01
"""Smallest harm, as a share of the floor's mean square; chosen."""


@dataclass(frozen=True)
class Trial:
    """One graded trial."""

    label: Label  # what is true
    answer: Answer  # what the diagnosis answered
    held_out: dict[str, Any] | None  # result of `held_out_gap.evaluate`


def scores(trials: Sequence[Trial]) -> dict[str, Any]:
    """Return every score: `value`, its 90 % `ci`, and the `count` of trials behind it."""
    real = [trial for trial in trials if trial.label.group != 'zero']
    labels = [trial.label for trial in real]
    methods = {name: [Trial(label, answer, None) for label, answer in zip(labels, answers)]
               for name, answers in grading.answers(labels).items()}
    confidences = [(trial.answer.probability, grading.verdict_right(trial.answer, trial.label))
                   for trial in real]
    singles = _group(real, 'single')
    seen = _group(real, 'single', grading.visible)
    named = naming_scores(real)
    return {
        **named,
        'comparison': {name: naming_scores(rows) for name, rows in methods.items()},
        'detection': _detection(real, named['false_alarms']['value'] or 0.0),
        'top_1_all_singles': share([_top(trial) for trial in singles]),
        'leading': share([_effect(trial) in trial.answer.top for trial in seen]),
        'set_size': resampled([len(trial.answer.named) for trial in seen],
                              np.mean),
        'inseparable_size': resampled(
            [1 + len(trial.label.faults[0]['inseparable']) for trial in seen], np.mean),
        'brier': resampled(
            [grading.brier(trial.answer, trial.label) for trial in real], np.mean),
        'calibration_error': resampled(confidences,
                                       calibration_error),
        'reliability': reliability(confidences),
        'coverage': _coverage(real),
        'ranks': _ranks(real),
        **_held(real),
        'unknown_recall_all': share([_unknown(trial)
                                     for trial in _group(real, 'outside')]),
        'unknown_wrongly': share([_unknown(trial) for trial in real
                                  if trial.label.group != 'outside']),
        'pairs': _pairs(_group(real, 'pair')),
        'by_effect': _by_effect(real),
        'limit_held': share([held for held in (
            grading.limit_holds(trial.answer, trial.label) for trial in real)
            if held is not None]),
        'confusion': _confusion(real),
        'seconds': resampled([trial.answer.seconds for trial in trials],
                             np.median),
        'longest_s': max((trial.answer.seconds for trial in trials), default=0.0),
        'status': dict(Counter(trial.answer.status for trial in real)),
    }


def naming_scores(trials: Sequence[Trial]) -> dict[str, Any]:
    """Return the scores that any method has which names effects; no trial has strength zero."""
    outside = _group(trials, 'outside', lambda label: label.flexible >= grading.CERTAIN_POWER)
    groups = [(grading.answered_group(trial.answer),
               grading.true_group(trial.label)) for trial in trials]
    faulty = [(group, true) for group, true in groups if any(true)]
    return {
        'false_alarms': share([trial.answer.gap
                               for trial in _group(trials, 'none')]),
        'top_1': share([
            _top(trial) for trial in _group(trials, 'single', grading.separable)]),
        'set_recall': share([
            _effect(trial) in trial.answer.named
            for trial in _group(trials, 'single', grading.visible)]),
        'unknown_recall': share([_unknown(trial) for trial in outside]),
        'verdict_right': share([
            grading.verdict_right(trial.answer, trial.label) for trial in trials]),
        'utility': resampled(
            [grading.utility(*pair) for pair in groups], np.mean),
        'utility_of_effects': resampled(
            [grading.utility(*pair) for pair in faulty], np.mean),
    }


def bars(made: dict[str, Any]) -> list[dict[str, Any]]:
    """
    Compare the scores with the bars.

    `met` states whether the score does not refute its bar, see `outcome`; None without a trial.
    """
    rows = []
    for bar in BARS:
        score, met = made[bar.name], None
        if score['value'] is not None:
            low, high = score['ci']
            met = _within(bar, score['value'], score['value']) or _within(bar, low, high)
        rows.append({'name': bar.name, 'words': bar.words, 'way': bar.direction,
                     'bar': list(bar.levels), 'met': met,
                     **{key: score[key] for key in ('value', 'ci', 'count')}})
    return rows


def _within(bar: Bar, low: float, high: float) -> bool:
    """Return whether some value between `low` and `high` meets the bar."""
    return (bar.direction > 0 or low <= bar.levels[-1]) and \
        (bar.direction < 0 or high >= bar.levels[0])


def outcome(row: dict[str, Any]) -> str:
    """Compare a score with its bar in words."""
    if row['met'] is None:
        return 'no trial'
    if row['count'] < FEWEST_TRIALS:
        return 'too few'
    bar = Bar('', '', row['way'], tuple(row['bar']))
    # The interval of resampled trials may lie beside a score that is biased.
    values = (row['value'], *row['ci'])
    if all(_within(bar, value, value) for value in values):
        return 'yes'
    reached = _within(bar, row['value'], row['value']) or _within(bar, *row['ci'])
    return 'not refuted' if reached else 'NO'


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
        out[name] = curve(strength, np.array(
            [trial.answer.gap for trial in subset]), alarms)
        out[name]['oracle'] = bins(strength, np.array(
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
    return resampled(rows, covered)


def _rightly_named(real: Sequence[Trial]) -> list[Trial]:
    """Return the trials whose effects of the library are named for certain, and no others."""
    return [trial for trial in real if trial.label.group in ('single', 'pair')
            and trial.answer.certain == grading.truth(trial.label) and not trial.answer.groups]


def _ranks(real: Sequence[Trial]) -> dict[str, dict[str, Any]]:
    """Return rank histograms of all parameters, and of the parameters of each effect."""
    every = [grading.ranks(trial.answer, trial.label) for trial in _rightly_named(real)]
    effects = sorted({name.split('.')[0] for ranks in every for name in ranks})
    out = {'all': rank_histogram([list(ranks.values()) for ranks in every])}
    for effect in effects:
        out[effect] = rank_histogram([
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
        part, oracle = (1 - (gaps[name] - gaps['floor']) / gap for name in ('after', 'oracle'))
        closed.append(part)
        if oracle > 0:
            ratio.append(part / oracle)
    return {'closed': resampled(closed, np.median),
            'closed_by_oracle': resampled(ratio, np.median),
            'harm': share(harm)}


def _pairs(pairs: Sequence[Trial]) -> dict[str, Any]:
    seen = [trial for trial in pairs if grading.visible(trial.label)]
    named = [len(trial.answer.named & grading.truth(trial.label)) for trial in seen]
    return {'whole': share([n == 2 for n in named]),
            'in_part': share([n == 1 for n in named]),
            'exactly': share([_top(trial) for trial in seen])}


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
