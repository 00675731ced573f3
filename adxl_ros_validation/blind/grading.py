# SPDX-License-Identifier: Apache-2.0
"""What a diagnosis answered, whether it is right, and answers of reference methods."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations, permutations, product
import math
from typing import Any

from adxl_ros_validation.blind import trials
from adxl_ros_validation.blind.trials import Label
from adxl_ros_validation.blind.world.fault_table import KNOWN
from adxl_ros_validation.blind.world.simulator import G0, Unit
import numpy as np
import scipy

UNKNOWN = 'unknown'
MATERIAL_MPS2 = 0.1e-3 * G0
"""Material amplitude of an answer that states none, m/s²."""
VISIBLE_POWER = 0.5
"""Power of the ideal observer below which an effect may be missing in a right answer; chosen."""
CERTAIN_POWER = 0.9
"""Power of the ideal observer from which scores count an effect; chosen."""
_NOISE_BAND_HZ = 78.5
"""Noise bandwidth of the 50 Hz output filter, Hz: π/2 of its corner."""

_SMALLEST_WIDTH = 1e-30
"""Smallest width of an interval, in any unit, so that an interval of one value divides by it."""


@dataclass(frozen=True)
class Answer:
    """What a report answers."""

    status: str  # status of the verdict; 'failed' without a report
    certain: frozenset[str]  # effects that the verdict names for certain
    groups: tuple[frozenset[str], ...]  # groups of which the verdict names one effect each
    probability: float  # probability of the verdict by the report
    # effects and probability of each hypothesis
    hypotheses: tuple[tuple[frozenset[str], float], ...]
    # value, and ends of the 90 % interval, by parameter
    parameters: dict[str, tuple[float, float, float]]
    seconds: float  # run time, s
    closed: float | None = None  # share of the gap that is closed; None without one
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
        hypotheses = tuple((frozenset(row['effects']), float(row['probability']))
                           for row in report['hypotheses'])
        parameters = {
            f'{candidate["effect"]}.{name}': (
                float(row['value']), float(row['ci'][0]), float(row['ci'][1]))
            for candidate in report['candidates'] for name, row in candidate['parameters'].items()
            if isinstance(row, dict) and row.get('ci')}
        certain = frozenset(verdict['effects'])
        if verdict['status'] == 'unknown':
            certain |= {UNKNOWN}
        return Answer(verdict['status'], certain,
                      tuple(frozenset(group) for group in verdict['groups']),
                      float(verdict['probability']), hypotheses or ((frozenset(), 0.0),),
                      parameters, float(result['seconds']), report['gap'].get('closed'),
                      float(report.get('material') or MATERIAL_MPS2),
                      report['gap'].get('upper_limit'))
    except (KeyError, TypeError, ValueError, AttributeError):
        return Answer('failed', frozenset(), (), 0.0, ((frozenset(), 0.0),), {},
                      float(result['seconds']))


def truth(label: Label) -> frozenset[str]:
    """Return the effects of the true answer."""
    return frozenset({UNKNOWN} if label.group == 'outside' else label.true)


def right(label: Label, material_mps2: float = MATERIAL_MPS2) -> list[frozenset[str]]:
    """
    Return every right answer.

    Effects that the ideal observer does not see, or that are not material, may be missing.
    """
    true = truth(label)
    rows = {UNKNOWN if label.group == 'outside' else fault['effect']: fault
            for fault in label.faults}
    hidden = [name for name in true if name in rows and (
        rows[name]['power'] < VISIBLE_POWER or rows[name]['strength_mps2'] < material_mps2)]
    subsets = [combinations(hidden, k) for k in range(len(hidden) + 1)]
    return [true - set(missing) for subset in subsets for missing in subset]


def verdict_right(answer: Answer, label: Label) -> bool:
    """
    Return whether a verdict is right: certain effects are true, and each group has one more.

    The upper limit of "no gap" must hold the effects that are there. The effects that a verdict
    `partly` names must be the true ones.
    """
    if answer.status in ('failed', 'insufficient', 'bad_data') or limit_holds(
            answer, label) is False:
        return False
    accepted = right(label, answer.material_mps2)
    if answer.status == 'partly':
        accepted = [effects - {UNKNOWN} for effects in accepted if effects - {UNKNOWN}]
    return any(_matches(answer, effects) for effects in accepted)


def limit_holds(answer: Answer, label: Label) -> bool | None:
    """
    Return whether the upper limit of "no gap" holds the effects; None without a limit.

    Effects like noise have no power that a simulation explains, and do not count.
    """
    if answer.status != 'no_gap' or answer.limit_mps2 is None or label.group == 'zero':
        return None
    return math.hypot(*(fault['strength_mps2'] for fault in label.faults
                        if not fault.get('noise_like'))) <= answer.limit_mps2


def material(answer: Answer, label: Label) -> bool:
    """Return whether every effect of a trial is material."""
    return all(fault['strength_mps2'] >= answer.material_mps2 for fault in label.faults)


def _matches(answer: Answer, effects: frozenset[str]) -> bool:
    if not answer.certain <= effects:
        return False
    rest = effects - answer.certain
    return len(rest) == len(answer.groups) and any(
        all(name in group for name, group in zip(order, answer.groups))
        for order in permutations(rest))


def separable(label: Label) -> bool:
    """Return whether the ideal observer detects every effect and separates it from all others."""
    return bool(label.faults) and all(
        fault['power'] * fault['told'] >= CERTAIN_POWER for fault in label.faults)


def visible(label: Label) -> bool:
    """Return whether the ideal observer detects every effect."""
    return bool(label.faults) and all(
        fault['power'] >= CERTAIN_POWER for fault in label.faults)


def brier(answer: Answer, label: Label) -> float:
    """Return the Brier score of all hypotheses; right hypotheses count together."""
    accepted = right(label, answer.material_mps2)
    correct = sum(p for effects, p in answer.hypotheses if effects in accepted)
    wrong = sum(p * p for effects, p in answer.hypotheses if effects not in accepted)
    return (1 - correct) ** 2 + wrong


def ranks(answer: Answer, label: Label) -> dict[str, float]:
    """
    Return the rank of the truth in the posterior of each parameter that means the same.

    The rank is the probability that the report gives to values below the truth. Its 90 % interval
    is that of a normal posterior, whose halves may have different widths.
    """
    rank_by_name = {}
    for name, true in true_parameters(label).items():
        if name in answer.parameters:
            value, low, high = answer.parameters[name]
            half_width = high - value if true > value else value - low
            z = (true - value) * scipy.stats.norm.ppf(0.95) / max(half_width, _SMALLEST_WIDTH)
            rank_by_name[name] = float(scipy.stats.norm.cdf(z))
    return rank_by_name


def true_parameters(label: Label) -> dict[str, float]:
    """
    Return the true values of parameters that mean the same in both worlds, by name of the report.

    A coefficient of another functional form has no counterpart.
    """
    true: dict[str, float] = {}
    unit = trials.scene(label.seed, label.seconds).unit
    stage = unit.stage_rad
    for fault in label.faults:
        name, size = fault['effect'], fault['size']
        w = size * np.asarray(fault['shape'].get('w', [0.0]), float)
        if name in _BY_AXIS:
            true |= _true_by_axis(name, unit, w)
        elif name == 'gravity':
            true['gravity.offset_mps2'] = G0 * w[0]
        elif name == 'time_offset':
            true['time_offset.offset_s'] = w[0]
        elif name == 'lever_arm':
            true |= {f'lever_arm.{d}_m': v for d, v in zip('xyz', w)}
        elif name == 'stage_offset':
            true |= {'stage_offset.alpha_rad': w[0] + stage[0],
                     'stage_offset.beta_rad': w[1] + stage[3]}
        elif name == 'base_tilt':
            true |= {'base_tilt.x_rad': -w[1], 'base_tilt.y_rad': w[0]}
        elif name == 'backlash':
            true |= {'backlash.alpha_rad': abs(w[0]), 'backlash.beta_rad': abs(w[1])}
        elif name == 'stage_eccentricity':
            true |= {f'stage_eccentricity.{part}_rad': v + stage[i] for part, v, i in zip(
                ('beta_sine', 'beta_cosine', 'alpha_sine', 'alpha_cosine'), w, (4, 5, 1, 2))}
        elif name == 'misalignment':
            # Equations 18 and 19, to first order, of the directions xy, xz, yx, yz, zx, zy.
            true |= {f'misalignment.{part}_rad.{d}': sign * v for part, d, sign, v in zip(
                ('beta', 'alpha', 'beta', 'alpha', 'beta', 'alpha'), 'xxyyzz',
                (1, -1, -1, 1, 1, -1), w)}
        elif name == 'mount_resonance':
            true['mount_resonance.frequency_hz'] = fault['shape']['hertz']
    return true


_BY_AXIS = ('bias', 'scale_factor', 'noise_excess')


def _true_by_axis(name: str, unit: Unit, w: np.ndarray) -> dict[str, float]:
    """Return the true values of a parameter that each axis has."""
    w = w[:len(unit.axes)]
    if name == 'bias':
        values, parameter = unit.zero_v + w * unit.scale_v_per_g - 2.5, 'offset_v'
    elif name == 'scale_factor':
        values, parameter = unit.scale_v_per_g * (1 + w) - 1.0, 'offset_v_per_g'
    else:
        noise = np.hypot(unit.noise_g_per_rthz, w / unit.scale_v_per_g / _NOISE_BAND_HZ ** 0.5)
        values, parameter = noise / unit.stated_noise_g_per_rthz - 1, 'ratio'
    return {f'{name}.{parameter}.{axis}': value for axis, value in zip(unit.axes, values)}


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
    return 1 - blamed * (size + 1) / (f * (blamed + 1)) \
        - missed * (f - size + 1) / (f * (missed + 1))


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
    visible = [fault for fault in label.faults if fault['power'] >= VISIBLE_POWER] \
        if label.group != 'zero' else []
    choices: list[Iterable[str]] = [
        [UNKNOWN if label.group == 'outside' else fault['effect'], *fault['inseparable']]
        for fault in visible]
    diagnoses = {frozenset(choice) for choice in product(*choices)}
    return {diagnosis for diagnosis in diagnoses if len(diagnosis) == len(visible)}


def answers(labels: Sequence[Label]) -> dict[str, list[Answer]]:
    """
    Return the answers of all reference methods.

    `Null` never names an effect, `Random` names one at random, and `Worst` names all together.
    They are the references of the diagnosis competition (github.com/jdekleer/dxc26synth,
    RandomDiagnoser.py).
    Guessing draws from the mix of the check. The others choose by the smallest residual or by the
    smallest BIC for white noise, with the responses of the check's own world.
    """
    rng = np.random.default_rng(0)
    effects: dict[str, list[frozenset[str]]] = {
        'BIC, white noise': [frozenset(filter(None, [label.plain['bic']])) for label in labels],
        'smallest RMSE': [frozenset({label.plain['rmse']}) for label in labels],
        'guess by the mix': [truth(labels[i]) for i in rng.permutation(len(labels))],
        'Null': [frozenset()] * len(labels),
        'Random': [frozenset({str(name)}) for name in rng.choice(COMPONENTS, len(labels))],
        'Worst': [frozenset(COMPONENTS)] * len(labels),
    }
    return {name: [certain(row) for row in rows] for name, rows in effects.items()}


def certain(effects: frozenset[str]) -> Answer:
    """Return an answer that names effects for certain."""
    status = 'no_gap' if not effects else 'unknown' if UNKNOWN in effects else 'explained'
    return Answer(status, effects, (), 1.0, ((effects, 1.0),), {}, 0.0)
