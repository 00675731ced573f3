# SPDX-License-Identifier: Apache-2.0
"""The scores of a check with their intervals, the bars that they should meet, and controls."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
import math
from pathlib import Path
from typing import Any, NamedTuple

from adxl_ros_validation.blind import grading
from adxl_ros_validation.blind.faults import NOISE_LIKE
from adxl_ros_validation.blind.grading import Answer, UNKNOWN
from adxl_ros_validation.blind.ideal_observer import separation_probability
from adxl_ros_validation.blind.trials import Label
import numpy as np
import pandas as pd
import scipy
import yaml

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

    def row(self) -> dict[str, Any]:
        """Return what is known of it, and what the scores count."""
        label, answer, gaps = self
        truth, named, top = grading.truth(label), answer.named, sorted(answer.top)
        groups = grading.answered_group(answer), grading.true_group(label)
        right = grading.verdict_right(answer, label)
        rivals = label.faults[0]['inseparable'] if label.faults else ()
        return {
            **{
                key: [fault[key] for fault in label.faults]
                for key in ('strength_mps2', 'power', 'told', 'inseparable')
            },
            'name': label.name,
            'group': label.group,
            'effects': list(label.effects),
            'flexible': label.flexible,
            'manoeuvre': label.manoeuvre,
            'axes': label.axes,
            'status': answer.status,
            'top': top,
            'named': sorted(named),
            'probability': answer.probability,
            'right': right,
            'stated': (answer.probability, right),
            'seconds': answer.seconds,
            'held': gaps,
            'gap': answer.gap,
            'flexible_sees': label.flexible >= grading.CERTAIN_POWER,
            'effect': label.effects[0] if label.effects else 'none',
            'said': answer.status
            if answer.status in ('failed', 'bad_data')
            else 'none'
            if not top
            else 'several'
            if len(top) > 1
            else top[0],
            'is_top': answer.top == truth,
            'leads': truth <= answer.top,
            'names': len(named & truth),
            'names_all': truth <= named,
            'set_size': len(named),
            'inseparable_size': 1 + len(rivals),
            'unknown': UNKNOWN in named | answer.top,
            'seen': grading.visible(label),
            'separable': bool(label.faults)
            and all(
                fault['power'] * fault['told'] >= grading.CERTAIN_POWER for fault in label.faults
            ),
            'material': grading.material(answer, label),
            'limit_holds': grading.limit_holds(answer, label),
            'brier': grading.brier(answer, label),
            'utility': grading.utility(*groups),
            'has_effect': any(groups[1]),
            **self._ideal(),
            'harm': gaps is not None and gaps['harm_ci'][0] > _HARM * gaps['floor'],
            'inside': self._inside(),
            **self._closed(),
        }

    def _ideal(self) -> dict[str, float]:
        """Return how probably, at most, an ideal observer names all effects, or sees them."""
        seen = [separation_probability(f.get('visibility', math.inf)) for f in self.label.faults]
        told = [min(f['told'], one) for f, one in zip(self.label.faults, seen)]
        return {'ideal_names': min(told, default=1.0), 'ideal_sees': min(seen, default=1.0)}

    def _inside(self) -> tuple[int, int] | None:
        """Count intervals with the truth, and all, of effects that are rightly named for sure."""
        label, answer, _ = self
        if (
            label.group not in ('single', 'pair')
            or answer.groups
            or answer.certain != grading.truth(label)
        ):
            return None
        true = grading.true_parameters(label)
        inside = [
            low <= true[name] <= high
            for name, (_, low, high) in answer.parameters.items()
            if name in true
        ]
        return (sum(inside), len(inside)) if inside else None

    def _closed(self) -> dict[str, float | None]:
        """Return the share closed of a visible gap on a held-out recording, by the oracle's."""
        label, _, gaps = self
        if (
            gaps is None
            or label.group not in ('single', 'pair')
            or gaps['gap_ci'][0] <= 0
            or not grading.visible(label)
        ):
            return {'closed': None, 'by_oracle': None}
        gap = gaps['before'] - gaps['floor']
        part, oracle = (1 - (gaps[name] - gaps['floor']) / gap for name in ('after', 'oracle'))
        return {'closed': part, 'by_oracle': part / oracle if oracle > 0 else None}


def share(hits: Sequence[bool] | np.ndarray | pd.Series) -> Score:
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


def resampled(
    rows: Sequence[Any] | pd.Series, statistic: Callable[[list[Any]], float] = np.mean
) -> Score:
    """Return a statistic of rows with its interval over resampled rows."""
    if not len(rows):
        return _NO_SCORE
    rows = list(rows)
    rng = np.random.default_rng(0)
    drawn = [
        statistic([rows[i] for i in rng.integers(len(rows), size=len(rows))])
        for _ in range(_RESAMPLES)
    ]
    low, high = np.nanquantile(drawn, ((1 - LEVEL) / 2, (1 + LEVEL) / 2))
    return {'value': float(statistic(rows)), 'ci': [float(low), float(high)], 'count': len(rows)}


def by_strength(rows: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the share detected, and that which the oracle sees, in eight bins or fewer."""
    rows = rows.assign(strength=rows.strength_mps2.str[0]).sort_values('strength', kind='stable')
    parts = np.array_split(np.arange(len(rows)), min(8, max(len(rows) // 3, 1)))
    return [
        {
            'strength': float(part.strength.median()),
            **share(part.gap),
            'oracle': float((part.power.str[0] > 0.5).mean()),
        }
        for part in (rows.iloc[index] for index in parts)
        if len(part)
    ]


def reliability(rows: Sequence[tuple[float, bool]]) -> list[dict[str, Any]]:
    """Return the share right in bins of confidence, from pairs (confidence, right)."""
    table = np.asarray(rows, float).reshape(-1, 2)
    index = np.searchsorted(_CONFIDENCES[1:-1], table[:, 0], 'right')
    parts = [(k, table[index == k]) for k in np.unique(index)]
    return [
        {
            'confidence': float(part[:, 0].mean()),
            'right': float(part[:, 1].mean()),
            'count': len(part),
            'ci': share(part[:, 1] > 0.5)['ci'],
            'bin': _CONFIDENCES[[k, k + 1]].tolist(),
        }
        for k, part in parts
    ]


def calibration_error(rows: Sequence[tuple[float, bool]]) -> float:
    """Return the mean distance of confidence and share right, over the bins of `reliability`."""
    return sum(
        row['count'] * abs(row['right'] - row['confidence']) for row in reliability(rows)
    ) / max(len(rows), 1)


@dataclass(frozen=True)
class Bar:
    """A score: what it is of, in words, and what it should reach; see scores.yaml."""

    words: str
    low: float = -math.inf  # `low` and `high` may be infinite
    high: float = math.inf
    result: bool = False  # stands with the bars though it has none
    of: str = 'group == group'  # rows that count
    zero: bool = False  # whether trials at strength zero count
    statistic: tuple[str, str] = ('', '')  # its name and column

    def in_words(self) -> str:
        """Return the bar in words."""
        if math.isinf(self.low):
            return f'at most {self.high:g}'
        return (
            f'at least {self.low:g}' if math.isinf(self.high) else f'{self.low:g} to {self.high:g}'
        )


def _table(text: str) -> dict[str, Bar]:
    """Read the table of scores."""
    return {
        name: Bar(
            **{key: row.pop(key) for key in [*row] if key not in _STATISTICS},
            statistic=row.popitem(),
        )
        for name, row in yaml.safe_load(text).items()
    }


_STATISTICS: dict[str, Callable[[pd.Series], Score]] = {
    'share': share,
    'mean': resampled,
    'median': partial(resampled, statistic=np.median),
    'ratio': partial(
        resampled, statistic=lambda counts: float(np.divide(*np.sum(counts, axis=0)))
    ),
    'calibration': partial(resampled, statistic=calibration_error),
}
_SCORES = _table(Path(__file__).with_suffix('.yaml').read_text(encoding='utf-8'))
BARS = {name: bar for name, bar in _SCORES.items() if (bar.low, bar.high) != (-math.inf, math.inf)}
"""What a diagnosis should reach, by score."""
WITHOUT_BAR = {name: bar for name, bar in _SCORES.items() if name not in BARS}
"""The other scores."""
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
    return [
        {
            'name': name,
            'words': bar.words,
            'bar': bar.in_words(),
            'met': outcome(bar, made[name]),
            **made[name],
        }
        for name, bar in BARS.items()
    ]


def scores(trials: Sequence[Trial]) -> dict[str, Any]:
    """Return every score."""
    rows = pd.DataFrame([trial.row() for trial in trials])
    real = rows[rows.group != 'zero']
    single, pairs, outside = (real[real.group == group] for group in ('single', 'pair', 'outside'))
    pairs, is_noise = pairs[pairs.seen], single.effect.isin(NOISE_LIKE)
    true = real.effect.where(
        real.group == 'single', real.group.map({'none': 'none', 'outside': UNKNOWN})
    )
    return {
        **{
            name: _STATISTICS[bar.statistic[0]](
                (rows if bar.zero else real).query(bar.of)[bar.statistic[1]].dropna()
            )
            for name, bar in _SCORES.items()
        },
        'detection': {
            'of the mean': by_strength(single[~is_noise]),
            'noise like': by_strength(single[is_noise]),
            'outside': by_strength(outside),
        },
        'reliability': reliability(real.stated.tolist()),
        'pairs': {
            'whole': share(pairs.names == 2),
            'in_part': share(pairs.names == 1),
            'exactly': share(pairs.is_top),
        },
        'by_effect': {
            name: {
                'trials': len(part),
                'detected': int(part.gap.sum()),
                'named': int(part.names_all.sum()),
                'top': int(part.is_top.sum()),
            }
            for name, part in real[real.seen & real.group.isin(['single', 'outside'])].groupby(
                'effect'
            )
        },
        'confusion': {name: dict(Counter(part)) for name, part in real.said.groupby(true)},
        'longest_s': float(rows.seconds.max()),
        'status': dict(Counter(real.status)),
    }


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
    right = np.array(
        [[trial.answer.top in effects for effects in accepted] for trial in real], float
    )
    rng, n = np.random.default_rng(0), len(real)
    shuffled = np.array([right[np.arange(n), rng.permutation(n)].mean() for _ in range(_SHUFFLES)])
    chance = float(right.mean())
    low, high = (float(q) for q in np.quantile(shuffled, (_CHANCE / 2, 1 - _CHANCE / 2)))
    return {
        'score': float(shuffled.mean()),
        'chance': chance,
        'labels_in_place': float(np.trace(right)) / n,
        'by_chance_between': [low, high],
        'leaks': not low <= chance <= high,
    }


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
        return (
            size,
            rows,
            size - rows * len(last),
            csv.stat().st_mtime,
            about.st_size,
            about.st_mtime,
            float(last.split(b',')[0]),
        )

    def explained_by(members: np.ndarray) -> float:
        sums = members.T @ ranks
        between = np.sum(sums**2 / members.sum(axis=0)[:, None], axis=0)
        return float(np.max(between / np.maximum(np.sum(ranks**2, axis=0), 1e-12)))

    facts = np.array([facts_of(label.name) for label in labels], float)
    ranks = scipy.stats.rankdata(np.column_stack([facts, np.arange(len(labels))]), axis=0)
    ranks -= ranks.mean(axis=0)
    groupings = [
        [label.group for label in labels],
        ['+'.join(label.effects) for label in labels],
        ['something' if label.effects else 'nothing' for label in labels],
    ]
    rng, count = np.random.default_rng(0), len(labels)
    explained, chance = [], []
    for grouping in groupings:
        members = pd.get_dummies(pd.Series(grouping), dtype=float).to_numpy()
        explained.append(explained_by(members))
        chance.append([explained_by(members[rng.permutation(count)]) for _ in range(_SHUFFLES)])
    above = np.sum(np.array(chance) >= np.array(explained)[:, None] - 1e-12, axis=1)
    p = float((1 + above.min()) / (1 + _SHUFFLES))
    return {
        'score': explained[0],
        'chance': float(np.mean(chance[0])),
        'p': p,
        'leaks': p < _CHANCE,
    }


def strength_zero(trials: Sequence[Trial]) -> dict[str, Any]:
    """Compare trials whose effect has strength zero with trials without an effect."""
    zero, none = (
        [trial.answer.gap for trial in trials if trial.label.group == group]
        for group in ('zero', 'none')
    )
    named = sum(
        trial.label.effects[0] in trial.answer.named
        for trial in trials
        if trial.label.group == 'zero'
    )
    if not zero or not none:
        return {'score': None, 'chance': None, 'p': 1.0, 'leaks': False, 'named': named}
    p = float(
        scipy.stats.fisher_exact(
            [[sum(gaps), len(gaps) - sum(gaps)] for gaps in (zero, none)]
        ).pvalue
    )
    return {
        'score': sum(zero) / len(zero),
        'chance': sum(none) / len(none),
        'p': p,
        'named': named,
        'leaks': p < _CHANCE,
    }
