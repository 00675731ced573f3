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

"""Controls that must come out at chance; where one does not, the check itself leaks."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from adxl_ros.blind import grading
from adxl_ros.blind.grading import Answer
from adxl_ros.blind.trials import Label
import numpy as np
from scipy.stats import fisher_exact, rankdata

# A check of some thousand would be called leaky for nothing by each control.
_CHANCE = 0.002
_SHUFFLES = 2000


def controls(folder: Path, labels: Sequence[Label],
             answers: Sequence[Answer]) -> dict[str, dict[str, Any]]:
    """Run all controls; `leaks` says of each whether it is off chance."""
    return {'labels_permuted': permuted(labels, answers),
            'metadata_only': metadata(folder / 'recordings', labels),
            'strength_zero': strength_zero(labels, answers)}


def permuted(labels: Sequence[Label], answers: Sequence[Answer]) -> dict[str, Any]:
    """
    Score the answers against labels of other cases.

    What is right by chance follows from how often each answer and each label occurs; scores that
    exceed it use something besides the answers.
    """
    real = [(label, given) for label, given in zip(labels, answers) if label.group != 'zero']
    right = np.array([[given.top in grading.right(label) for label, _ in real]
                      for _, given in real], float)
    rng, n = np.random.default_rng(0), len(real)
    shuffled = np.array([right[np.arange(n), rng.permutation(n)].mean()
                         for _ in range(_SHUFFLES)]) if n else np.zeros(1)
    chance, own = float(right.mean()) if n else 0.0, float(np.trace(right)) / max(n, 1)
    low, high = (float(q) for q in np.quantile(shuffled, (_CHANCE / 2, 1 - _CHANCE / 2)))
    return {'score': float(shuffled.mean()), 'chance': chance, 'labels_in_place': own,
            'by_chance_between': [low, high], 'leaks': not low <= chance <= high}


def metadata(recordings: Path, labels: Sequence[Label]) -> dict[str, Any]:
    """
    Guess labels from files' sizes, lengths, times and names alone.

    The score is the share of the variance of a figure's ranks that the labels explain (Kruskal
    and Wallis), for the figure that they explain best; at chance is the same with labels permuted.
    Labels are taken three ways: by group, by effect, and as something or nothing.
    """
    facts = np.array([_facts(recordings, label.name) for label in labels], float)
    ranks = rankdata(np.column_stack([facts, np.arange(len(labels))]), axis=0)
    ranks -= ranks.mean(axis=0)
    ways = [[label.group for label in labels], ['+'.join(label.effects) for label in labels],
            ['something' if label.effects else 'nothing' for label in labels]]
    rng, count = np.random.default_rng(0), len(labels)
    own, chance = [], []
    for way in ways:
        which = np.unique(way, return_inverse=True)[1]
        members = np.eye(which.max() + 1)[which]
        own.append(_explained(members, ranks))
        chance.append([_explained(members[rng.permutation(count)], ranks)
                       for _ in range(_SHUFFLES)])
    above = np.sum(np.array(chance) >= np.array(own)[:, None] - 1e-12, axis=1)
    p = float((1 + above.min()) / (1 + _SHUFFLES))
    return {'score': own[0], 'chance': float(np.mean(chance[0])), 'p': p, 'leaks': p < _CHANCE}


def _explained(members: np.ndarray, ranks: np.ndarray) -> float:
    """Give the share of ranks' variance between groups, of the figure where it is largest."""
    sums = members.T @ ranks
    between = np.sum(sums ** 2 / members.sum(axis=0)[:, None], axis=0)
    return float(np.max(between / np.maximum(np.sum(ranks ** 2, axis=0), 1e-12)))


def _facts(recordings: Path, name: str) -> tuple[float, ...]:
    csv, yaml = recordings / f'{name}.csv', recordings / f'{name}.yaml'
    data, about = csv.read_bytes(), csv.stat()
    rows, last = data.count(b'\n'), data.rstrip().rsplit(b'\n', 1)[-1]
    return (about.st_size, rows, about.st_size - rows * len(last), about.st_mtime,
            yaml.stat().st_size, yaml.stat().st_mtime, float(last.split(b',')[0]))


def strength_zero(labels: Sequence[Label], answers: Sequence[Answer]) -> dict[str, Any]:
    """Compare cases whose effect has strength zero with those that have none."""
    said = {group: [given.gap for label, given in zip(labels, answers) if label.group == group]
            for group in ('zero', 'none')}
    zero, none = said['zero'], said['none']
    found = sum(label.effects[0] in given.named for label, given in zip(labels, answers)
                if label.group == 'zero')
    if not zero or not none:
        return {'score': None, 'chance': None, 'p': 1.0, 'leaks': False, 'named': found}
    p = float(fisher_exact([[sum(zero), len(zero) - sum(zero)],
                            [sum(none), len(none) - sum(none)]]).pvalue)
    return {'score': sum(zero) / len(zero), 'chance': sum(none) / len(none), 'p': p,
            'named': found, 'leaks': p < _CHANCE}
