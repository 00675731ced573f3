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
"""Scores of working cases: shares that are right, and whether probabilities mean something."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, permutations

from adxl_ros.blind.grading import Answer, UNKNOWN
from adxl_ros.blind.score_statistics import share
from adxl_ros.working.cases import Label
import numpy as np

_LOWEST_MG, _HIGHEST_MG = 1.35, 9.0
"""Strengths of the effects that the shares count, mg: 1.5 to 8 with the errors of the search."""
_BINS = 10
"""Number of bins of probability; chosen: verdicts of 60 to 70 % are one bin."""


@dataclass(frozen=True)
class Graded:
    """
    A case and its answer.

    Attributes
    ----------
    label
        What is true.
    answer
        What the diagnosis answered.

    """

    label: Label
    answer: Answer

    @property
    def truth(self) -> frozenset[str]:
        """Return the effects of the right answer, with 'unknown' for those of no library."""
        return frozenset(self.label.effects) | ({UNKNOWN} if self.label.outside else set())

    @property
    def accepted(self) -> list[frozenset[str]]:
        """Return every right answer: without any of the effects that cannot be seen."""
        hidden = [name for name in self.truth if name in self.label.hidden
                  or (name == UNKNOWN and bool(self.label.hidden))]
        return [self.truth - set(missing) for k in range(len(hidden) + 1)
                for missing in combinations(hidden, k)]

    @property
    def failed(self) -> bool:
        """Return whether there is no verdict."""
        return self.answer.status in ('failed', 'insufficient', 'bad_data')

    @property
    def exact(self) -> bool:
        """Return whether the verdict names a right answer and nothing else."""
        return not self.failed and not self.answer.groups and self.answer.certain in self.accepted

    @property
    def contained(self) -> bool:
        """Return whether the verdict names every effect of a right answer, perhaps in groups."""
        return not self.failed and any(truth <= self.answer.named for truth in self.accepted
                                       if truth or not self.answer.gap)

    @property
    def right(self) -> bool:
        """Return whether the verdict holds: each group has one more effect that is true."""
        return not self.failed and any(_matches(self.answer, truth) for truth in self.accepted)

    @property
    def counted(self) -> bool:
        """Return whether all effects have a strength that the shares count."""
        return all(_LOWEST_MG < row['strength_mg'] < _HIGHEST_MG for row in self.label.faults)


def _matches(answer: Answer, truth: frozenset[str]) -> bool:
    """Determine whether a verdict states these effects, by certainty and groups."""
    rest = truth - answer.certain
    return answer.certain <= truth and len(rest) == len(answer.groups) and any(
        all(name in group for name, group in zip(order, answer.groups))
        for order in permutations(rest))


def table(graded: Sequence[Graded]) -> str:
    """Return the shares by group, the probabilities by bin, and the cases that are not exact."""
    lines = ['group      exactly               in the named set      cases',
             *(_row(name, graded) for name in ('none', 'single', 'pair', 'aged', 'outside')), '',
             'stated     mean   right                 cases', *_reliability(graded), '']
    missed = sorted((g for g in graded if not g.exact), key=lambda g: g.label.name)
    return '\n'.join([*lines, *(_miss(g) for g in missed)]) + '\n'


def temper_loss(graded: Sequence[Graded]) -> float:
    """Return the mean log loss of the stated probabilities."""
    p = np.clip([g.answer.probability for g in graded], 1e-3, 1 - 1e-3)
    right = np.array([g.right for g in graded])
    return float(-np.mean(np.where(right, np.log(p), np.log1p(-p))))


def _row(group: str, graded: Sequence[Graded]) -> str:
    """Return the shares of one group."""
    rows = [g for g in graded if g.label.group == group and g.counted]
    if group == 'none':
        clean = [not g.failed and not g.answer.gap for g in rows]
        return f'{group:10} {_percent(clean):21} {"":21} {len(rows)}'
    return f'{group:10} {_percent([g.exact for g in rows]):21} ' \
           f'{_percent([g.contained for g in rows]):21} {len(rows)}'


def _percent(hits: Sequence[bool]) -> str:
    """Return a share with its interval, in percent."""
    made = share(hits)
    if made['value'] is None:
        return '-'
    low, high = made['ci']
    return f'{100 * made["value"]:3.0f} % ({100 * low:.0f} to {100 * high:.0f})'


def _reliability(graded: Sequence[Graded]) -> list[str]:
    """Return stated and true shares by bin of probability."""
    lines = []
    for k in range(_BINS):
        low, high = k / _BINS, (k + 1) / _BINS
        rows = [g for g in graded if low <= g.answer.probability < high
                or (k == _BINS - 1 and g.answer.probability == 1.0)]
        if rows:
            mean = float(np.mean([g.answer.probability for g in rows]))
            lines.append(f'{100 * low:2.0f}-{100 * high:3.0f} %   {100 * mean:4.1f} '
                         f'{_percent([g.right for g in rows]):21} {len(rows)}')
    return [*lines, f'log loss {temper_loss(graded):.3f}']


def _miss(graded: Graded) -> str:
    """Return one case that is not exact."""
    label, answer = graded.label, graded.answer
    faults = ' and '.join(
        f'{row["kind"]} {row["strength_mg"]:.2f} mg{" calibrated" if row["calibrated"] else ""}'
        f'{" library form" if row["shape"].get("form") else ""}' for row in label.faults)
    named = ', '.join([*sorted(answer.certain), *(f'one of ({", ".join(sorted(group))})'
                                                  for group in answer.groups)])
    mark = 'in set' if graded.contained else 'wrong'
    return f'{label.name} {label.rate_hz:4.0f} Hz {label.axes:3} {label.manoeuvre:6} {mark:6} ' \
           f'{faults or "no effect"}: {answer.status} {answer.probability:.2f} {named}'
