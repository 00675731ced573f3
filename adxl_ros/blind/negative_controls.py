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

"""Negative controls: their scores must be at chance, else the check itself leaks."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from adxl_ros.blind import grading
from adxl_ros.blind.grading import Answer
from adxl_ros.blind.trials import Label
import numpy as np
import scipy

_CHANCE = 0.002
"""Chance that one control reports a leak of a check that has none; chosen."""
_SHUFFLES = 2000
"""Number of permutations of the labels; chosen."""


def controls(folder: Path, labels: Sequence[Label],
             answers: Sequence[Answer]) -> dict[str, dict[str, Any]]:
    """
    Run all controls; `leaks` states whether a control is not at chance.

    Parameters
    ----------
    folder
        Folder of the check.
    labels, answers
        Of all trials.

    Returns
    -------
    dict
        Result by control.

    """
    return {'labels_permuted': permuted(labels, answers),
            'metadata_only': metadata(folder / 'recordings', labels),
            'strength_zero': strength_zero(labels, answers)}


def permuted(labels: Sequence[Label], answers: Sequence[Answer]) -> dict[str, Any]:
    """
    Score the answers against the labels of other trials.

    The score by chance follows from the frequencies of answers and labels. A higher score uses
    something besides the answers.

    Parameters
    ----------
    labels, answers
        Of all trials.

    Returns
    -------
    dict
        The result.

    """
    real = [(label, answer) for label, answer in zip(labels, answers) if label.group != 'zero']
    right = np.array([[answer.top in grading.right(label) for label, _ in real]
                      for _, answer in real], float)
    rng, n = np.random.default_rng(0), len(real)
    shuffled = np.array([right[np.arange(n), rng.permutation(n)].mean()
                         for _ in range(_SHUFFLES)]) if n else np.zeros(1)
    chance = float(right.mean()) if n else 0.0
    in_place = float(np.trace(right)) / max(n, 1)
    low, high = (float(q) for q in np.quantile(shuffled, (_CHANCE / 2, 1 - _CHANCE / 2)))
    return {'score': float(shuffled.mean()), 'chance': chance, 'labels_in_place': in_place,
            'by_chance_between': [low, high], 'leaks': not low <= chance <= high}


def metadata(recordings: Path, labels: Sequence[Label]) -> dict[str, Any]:
    """
    Guess labels from sizes, lengths, times and names of files only.

    The score is the share of the variance of a quantity's ranks that the labels explain (Kruskal
    and Wallis), for the quantity that they explain best. At chance is the same with permuted
    labels. Labels count in three ways: by group, by effect, and as some effect or none.

    Parameters
    ----------
    recordings
        Folder of the recordings.
    labels
        Of all trials.

    Returns
    -------
    dict
        The result.

    """
    facts = np.array([_facts(recordings, label.name) for label in labels], float)
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
        explained.append(_explained(members, ranks))
        chance.append([_explained(members[rng.permutation(count)], ranks)
                       for _ in range(_SHUFFLES)])
    above = np.sum(np.array(chance) >= np.array(explained)[:, None] - 1e-12, axis=1)
    p = float((1 + above.min()) / (1 + _SHUFFLES))
    return {'score': explained[0], 'chance': float(np.mean(chance[0])), 'p': p,
            'leaks': p < _CHANCE}


def _explained(members: np.ndarray, ranks: np.ndarray) -> float:
    """Return the largest share of a quantity's variance of ranks that is between groups."""
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
    """
    Compare trials whose effect has strength zero with trials without an effect.

    Parameters
    ----------
    labels, answers
        Of all trials.

    Returns
    -------
    dict
        The result.

    """
    pairs = list(zip(labels, answers))
    zero, none = ([answer.gap for label, answer in pairs if label.group == group]
                  for group in ('zero', 'none'))
    named = sum(label.effects[0] in answer.named for label, answer in pairs
                if label.group == 'zero')
    if not zero or not none:
        return {'score': None, 'chance': None, 'p': 1.0, 'leaks': False, 'named': named}
    p = float(scipy.stats.fisher_exact([[sum(zero), len(zero) - sum(zero)],
                                       [sum(none), len(none) - sum(none)]]).pvalue)
    return {'score': sum(zero) / len(zero), 'chance': sum(none) / len(none), 'p': p,
            'named': named, 'leaks': p < _CHANCE}
