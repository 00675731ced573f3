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

from adxl_ros.blind import marks
from adxl_ros.blind.cases import Label
from adxl_ros.blind.marks import Answer
import numpy as np
from scipy.stats import fisher_exact

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
    right = np.array([[given.top in marks.right(label) for label, _ in real]
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

    The largest share of correctly guessed groups (or effects) over all figures of a file, each
    cut into bins by rank, beside the same with labels permuted.
    """
    facts = np.array([_facts(recordings, label.name) for label in labels], float)
    facts = np.column_stack([facts, np.arange(len(labels))])
    groups = [np.unique([label.group for label in labels], return_inverse=True)[1],
              np.unique([label.group not in ('none', 'zero') for label in labels],
                        return_inverse=True)[1],
              np.unique(['+'.join(label.effects) for label in labels], return_inverse=True)[1]]
    rng = np.random.default_rng(0)
    columns = [_ranks(column) for column in facts.T]

    def informed(order: np.ndarray) -> np.ndarray:
        return np.array([max(_guessed(bins, group[order]) for bins in columns)
                         for group in groups])

    own = informed(np.arange(len(labels)))
    chance = np.array([informed(rng.permutation(len(labels))) for _ in range(_SHUFFLES // 4)])
    # Each of the three against the permuted ones; it leaks where none of those comes up to it.
    p = (1 + np.sum(chance >= own - 1e-12, axis=0)) / (1 + len(chance))
    return {'score': float(own[0]), 'chance': float(chance[:, 0].mean()), 'p': float(p.min()),
            'leaks': bool(p.min() < 1.5 / len(chance))}


def _facts(recordings: Path, name: str) -> tuple[float, ...]:
    csv, yaml = recordings / f'{name}.csv', recordings / f'{name}.yaml'
    data, about = csv.read_bytes(), csv.stat()
    rows = data.count(b'\n')
    last = data.rstrip().rsplit(b'\n', 1)[-1].split(b',')[0]
    return (about.st_size, rows, about.st_size / max(rows, 1), about.st_mtime,
            yaml.stat().st_size, yaml.stat().st_mtime, float(last))


def _ranks(column: np.ndarray) -> np.ndarray:
    """Cut a figure into at most eight bins, equal values together."""
    edges = np.unique(np.quantile(column, np.linspace(0, 1, 9)[1:-1]))
    return np.searchsorted(edges, column, 'right')


def _guessed(bins: np.ndarray, group: np.ndarray) -> float:
    """Give the share that is guessed by saying the commonest group of each bin."""
    table = np.zeros((bins.max() + 1, group.max() + 1))
    np.add.at(table, (bins, group), 1)
    return float(table.max(axis=1).sum() / len(group))


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
