# SPDX-License-Identifier: Apache-2.0
"""What a diagnosis answered, whether it is right, and answers of reference methods."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from itertools import combinations, permutations, product
import math
from typing import Any

from adxl_ros_validation.blind import trials
from adxl_ros_validation.blind.faults import KINDS, KNOWN
from adxl_ros_validation.blind.simulator import G0
from adxl_ros_validation.blind.trials import Label
import numpy as np

UNKNOWN = 'unknown'
MATERIAL_MPS2 = 0.1e-3 * G0
"""Material amplitude of an answer that states none, m/s²."""
VISIBLE_POWER = 0.5
"""Power of the ideal observer below which an effect may be missing in a right answer; chosen."""
CERTAIN_POWER = 0.9
"""Power of the ideal observer from which scores count an effect; chosen."""


@dataclass(frozen=True)
class Answer:
    """What a report answers."""

    status: str  # status of the verdict; 'failed' without a report
    certain: frozenset[str] = frozenset()  # effects that the verdict names for certain
    groups: tuple[frozenset[str], ...] = ()  # of each of which the verdict names one effect
    probability: float = 0.0  # probability of the verdict by the report
    # effects and probability of each hypothesis
    hypotheses: tuple[tuple[frozenset[str], float], ...] = ((frozenset(), 0.0),)
    # value, and ends of the 90 % interval, by parameter
    parameters: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    seconds: float = 0.0  # run time, s
    material_mps2: float = MATERIAL_MPS2  # amplitude from which an effect counts
    limit_mps2: float | None = None  # upper limit of the gap; None where none is stated

    @property
    def named(self) -> frozenset[str]:
        """Return every effect that the verdict names, for certain or in a group."""
        return self.certain.union(*self.groups)

    @property
    def top(self) -> frozenset[str]:
        """Return the effects of the most probable hypothesis."""
        return max(self.hypotheses, key=lambda hypothesis: hypothesis[1])[0]

    @property
    def gap(self) -> bool:
        """Return whether the answer states a gap."""
        return self.status in ('explained', 'partly', 'inseparable', 'unknown', 'bad_data')


def answer(result: dict[str, Any]) -> Answer:
    """Read a result of `diagnosis_runs`; anything but a report of the fixed form is a failure."""
    try:
        report = result['report']
        verdict = report['verdict']
        hypotheses = tuple(
            (frozenset(row['effects']), float(row['probability'])) for row in report['hypotheses']
        )
        parameters = {
            f'{candidate["effect"]}.{name}': (
                float(row['value']),
                float(row['ci'][0]),
                float(row['ci'][1]),
            )
            for candidate in report['candidates']
            for name, row in candidate['parameters'].items()
            if isinstance(row, dict) and row.get('ci')
        }
        certain = frozenset(verdict['effects'])
        if verdict['status'] == 'unknown':
            certain |= {UNKNOWN}
        return Answer(
            verdict['status'],
            certain,
            tuple(frozenset(group) for group in verdict['groups']),
            float(verdict['probability']),
            hypotheses or ((frozenset(), 0.0),),
            parameters,
            float(result['seconds']),
            float(report.get('material') or MATERIAL_MPS2),
            report['gap'].get('upper_limit'),
        )
    except (KeyError, TypeError, ValueError, AttributeError):
        return Answer('failed', seconds=float(result['seconds']))


def truth(label: Label) -> frozenset[str]:
    """Return the effects of the true answer."""
    return frozenset({UNKNOWN} if label.group == 'outside' else label.true)


def right(label: Label, material_mps2: float = MATERIAL_MPS2) -> list[frozenset[str]]:
    """
    Return every right answer.

    Effects that the ideal observer does not see, or that are not material, may be missing.
    """
    true = truth(label)
    rows = {
        UNKNOWN if label.group == 'outside' else fault['effect']: fault for fault in label.faults
    }
    hidden = [
        name
        for name in true
        if name in rows
        and (rows[name]['power'] < VISIBLE_POWER or rows[name]['strength_mps2'] < material_mps2)
    ]
    subsets = [combinations(hidden, k) for k in range(len(hidden) + 1)]
    return [true - set(missing) for subset in subsets for missing in subset]


def verdict_right(answer: Answer, label: Label) -> bool:
    """
    Return whether a verdict is right: certain effects are true, and each group has one more.

    The upper limit of "no gap" must hold the effects that are there. The effects that a verdict
    `partly` names must be the true ones.
    """
    if (
        answer.status in ('failed', 'insufficient', 'bad_data')
        or limit_holds(answer, label) is False
    ):
        return False
    accepted = right(label, answer.material_mps2)
    if answer.status == 'partly':
        accepted = [effects - {UNKNOWN} for effects in accepted if effects - {UNKNOWN}]
    # One effect of each group is left, in some order.
    return any(
        all(name in group for name, group in zip(order, answer.groups))
        for effects in accepted
        if answer.certain <= effects and len(effects - answer.certain) == len(answer.groups)
        for order in permutations(effects - answer.certain)
    )


def limit_holds(answer: Answer, label: Label) -> bool | None:
    """
    Return whether the upper limit of "no gap" holds the effects; None without a limit.

    Effects like noise have no power that a simulation explains, and do not count.
    """
    if answer.status != 'no_gap' or answer.limit_mps2 is None or label.group == 'zero':
        return None
    return (
        math.hypot(
            *(fault['strength_mps2'] for fault in label.faults if not fault.get('noise_like'))
        )
        <= answer.limit_mps2
    )


def material(answer: Answer, label: Label) -> bool:
    """Return whether every effect of a trial is material."""
    return all(fault['strength_mps2'] >= answer.material_mps2 for fault in label.faults)


def visible(label: Label) -> bool:
    """Return whether the ideal observer detects every effect."""
    return bool(label.faults) and all(fault['power'] >= CERTAIN_POWER for fault in label.faults)


def brier(answer: Answer, label: Label) -> float:
    """Return the Brier score of all hypotheses; right hypotheses count together."""
    accepted = right(label, answer.material_mps2)
    correct = sum(p for effects, p in answer.hypotheses if effects in accepted)
    wrong = sum(p * p for effects, p in answer.hypotheses if effects not in accepted)
    return (1 - correct) ** 2 + wrong


def true_parameters(label: Label) -> dict[str, float]:
    """
    Return the true values of parameters that mean the same in both worlds, by name of the report.

    A coefficient of another functional form has no counterpart.
    """
    true: dict[str, float] = {}
    unit = trials.scene(label).unit
    for fault in label.faults:
        name = fault['effect']
        w = fault['size'] * np.asarray(fault['shape'].get('w', []), float)
        true |= {
            f'{name}.{part}': float(factor * w[i] + unit.stage_rad[own].sum())
            for part, (i, factor, *own) in KINDS[name].same.items()
            if i < len(w)
        }
        m = w[: len(unit.axes)]
        if name == 'mount_resonance':
            true['mount_resonance.frequency_hz'] = fault['shape']['hertz']
        elif name in ('bias', 'scale_factor', 'noise_excess'):
            # The noise bandwidth of the filter is 78.5 Hz, π/2 of its corner.
            part, values = {
                'bias': ('offset_v', unit.zero_v + m * unit.scale_v_per_g - 2.5),
                'scale_factor': ('offset_v_per_g', unit.scale_v_per_g * (1 + m) - 1.0),
                'noise_excess': (
                    'ratio',
                    np.hypot(unit.noise_g_per_rthz, m / unit.scale_v_per_g / 78.5**0.5)
                    / unit.stated_noise_g_per_rthz
                    - 1,
                ),
            }[name]
            true |= {
                f'{name}.{part}.{axis}': float(value) for axis, value in zip(unit.axes, values)
            }
    return true


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
    """
    f, size = len(COMPONENTS), len(diagnosis)
    blamed, missed = len(diagnosis - true), len(true - diagnosis)
    return (
        1 - blamed * (size + 1) / (f * (blamed + 1)) - missed * (f - size + 1) / (f * (missed + 1))
    )


def utility(group: Collection[Diagnosis], true: Collection[Diagnosis]) -> float:
    """
    Return the normalised utility of an ambiguity group D where T is the true one.

    It is m(D, T) / m(T, T), where m is the mean of `pair_utility` over all pairs of a diagnosis of
    the first group and one of the second.
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
    choices = [
        [UNKNOWN if label.group == 'outside' else fault['effect'], *fault['inseparable']]
        for fault in label.faults
        if fault['power'] >= VISIBLE_POWER and label.group != 'zero'
    ]
    diagnoses = map(frozenset, product(*choices))
    return {diagnosis for diagnosis in diagnoses if len(diagnosis) == len(choices)}
