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

"""
The utility of a diagnosis with several candidates, as the diagnosis competition scores it.

The competition of the DX conferences scores the effort of repair that a diagnosis wastes. Feldman,
Kurtoglu, Narasimhan, Poll, Garcia, de Kleer, Kuhn and van Gemund define it for one diagnosis
("Empirical evaluation of diagnostic algorithm performance using a generic framework",
International Journal of Prognostics and Health Management 1, 2010). The competition of 2026
extends it to ambiguity groups (github.com/jdekleer/dxc26synth: README.md and RunDiagnoser.py).
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from itertools import product

from adxl_ros.blind.grading import Answer, UNKNOWN, VISIBLE_POWER
from adxl_ros.blind.trials import Label
from adxl_ros.blind.world.fault_table import KNOWN

COMPONENTS = (*KNOWN, UNKNOWN)
"""What can be named: the library's effects, and an effect outside the library."""

Diagnosis = frozenset[str]
"""Components that one diagnosis calls faulty."""


def pair_utility(diagnosis: Diagnosis, true: Diagnosis) -> float:
    """
    Return the utility of one diagnosis ω where ω* is true.

    It is 1 − n(N + 1)/(f(n + 1)) − n̄(N̄ + 1)/(f(n̄ + 1)). Of the f components, n are in ω alone,
    n̄ in ω* alone, N in ω, and N̄ = f − N not in ω. Each term is the share of the components that
    a repair tests in vain: among those in ω, and then among the others.

    Parameters
    ----------
    diagnosis, true
        The components ω and ω*.

    Returns
    -------
    float
        The utility: 1 for the true diagnosis, 0 for the reverse.

    """
    f, size = len(COMPONENTS), len(diagnosis)
    blamed, missed = len(diagnosis - true), len(true - diagnosis)
    return 1 - blamed * (size + 1) / (f * (blamed + 1)) \
        - missed * (f - size + 1) / (f * (missed + 1))


def utility(group: Collection[Diagnosis], true: Collection[Diagnosis]) -> float:
    """
    Return the normalised utility of an ambiguity group D where T is the true one.

    It is m(D, T) / m(T, T), where m is the mean of `pair_utility` over all pairs of a diagnosis of
    the first group and one of the second.

    Parameters
    ----------
    group, true
        The groups D and T; no diagnosis in D is a failure, which has the utility 0.

    Returns
    -------
    float
        The utility: 1 for the true group.

    """
    if not group:
        return 0.0

    def mean(first: Collection[Diagnosis]) -> float:
        return sum(pair_utility(a, b) for a in first for b in true) / (len(first) * len(true))

    return mean(group) / mean(true)


def answered_group(answer: Answer) -> set[Diagnosis]:
    """Return the diagnoses of a verdict: its certain effects with one effect of each group."""
    if answer.status == 'failed':
        return set()
    return {answer.certain | set(choice) for choice in product(*answer.groups)}


def true_group(label: Label) -> set[Diagnosis]:
    """
    Return the smallest diagnoses that a recording supports, by the ideal observer.

    Each effect can be replaced by one that the recording cannot separate from it. Effects that the
    ideal observer does not see are missing, as the competition uses diagnoses of the least size.
    """
    visible = [fault for fault in label.faults if fault['power'] >= VISIBLE_POWER] \
        if label.group != 'zero' else []
    choices: list[Iterable[str]] = [
        [UNKNOWN if label.group == 'outside' else fault['effect'], *fault['inseparable']]
        for fault in visible]
    diagnoses = {frozenset(choice) for choice in product(*choices)}
    return {diagnosis for diagnosis in diagnoses if len(diagnosis) == len(visible)}
