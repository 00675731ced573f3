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

"""Grading of answers: what the diagnosis answered, and whether it is right."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations, permutations
import math
from typing import Any

from adxl_ros.blind import trials
from adxl_ros.blind.trials import Label
from adxl_ros.blind.world.unit import G0
import numpy as np
import scipy

UNKNOWN = 'unknown'
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
    """
    What a report answers.

    Attributes
    ----------
    status
        Status of the verdict; 'failed' without a report.
    certain
        Effects that the verdict names for certain.
    groups
        Groups of which the verdict names one effect each.
    probability
        Probability of the verdict by the report.
    hypotheses
        Effects and probability of each hypothesis.
    parameters : dict
        Value, and ends of the 90 % interval, by parameter.
    seconds
        Run time, s.
    closed
        Share of the gap that is closed; None without one.

    """

    status: str
    certain: frozenset[str]
    groups: tuple[frozenset[str], ...]
    probability: float
    hypotheses: tuple[tuple[frozenset[str], float], ...]
    parameters: dict[str, tuple[float, float, float]]
    seconds: float
    closed: float | None = None

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
        return self.status in ('explained', 'inseparable', 'unknown', 'bad_data')


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
                      parameters, float(result['seconds']), report['gap'].get('closed'))
    except (KeyError, TypeError, ValueError, AttributeError):
        return Answer('failed', frozenset(), (), 0.0, ((frozenset(), 0.0),), {},
                      float(result['seconds']))


def truth(label: Label) -> frozenset[str]:
    """Return the effects of the true answer."""
    return frozenset({UNKNOWN} if label.group == 'outside' else label.true)


def right(label: Label) -> list[frozenset[str]]:
    """Return every right answer: effects that the ideal observer does not see may be missing."""
    true = truth(label)
    power = {UNKNOWN if label.group == 'outside' else fault['effect']: fault['power']
             for fault in label.faults}
    hidden = [name for name in true if power.get(name, 1.0) < VISIBLE_POWER]
    subsets = [combinations(hidden, k) for k in range(len(hidden) + 1)]
    return [true - set(missing) for subset in subsets for missing in subset]


def verdict_right(answer: Answer, label: Label) -> bool:
    """
    Return whether a verdict is right: certain effects are true, and each group has one more.

    Parameters
    ----------
    answer, label
        The answer, and what is true.

    Returns
    -------
    bool
        Whether it is right.

    """
    if answer.status in ('failed', 'insufficient', 'bad_data'):
        return False
    return any(_matches(answer, effects) for effects in right(label))


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
    """
    Return the Brier score of all hypotheses; right hypotheses count together.

    Parameters
    ----------
    answer, label
        The answer, and what is true.

    Returns
    -------
    float
        The score, 0 for a certain right answer.

    """
    accepted = right(label)
    correct = sum(p for effects, p in answer.hypotheses if effects in accepted)
    wrong = sum(p * p for effects, p in answer.hypotheses if effects not in accepted)
    return (1 - correct) ** 2 + wrong


def ranks(answer: Answer, label: Label) -> dict[str, float]:
    """
    Return the rank of the truth in the posterior of each parameter that means the same.

    The rank is the probability that the report gives to values below the truth. Its 90 % interval
    is that of a normal posterior, whose halves may have different widths.

    Parameters
    ----------
    answer, label
        The answer, and what is true.

    Returns
    -------
    dict
        Ranks from 0 to 1 by the name of the parameter.

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
        by_axis = dict(zip(unit.axes, w))
        scale = dict(zip(unit.axes, unit.scale_v_per_g))
        zero = dict(zip(unit.axes, unit.zero_v))
        noise = dict(zip(unit.axes, zip(unit.noise_g_per_rthz, unit.stated_noise_g_per_rthz)))
        if name == 'bias':
            true |= {f'bias.offset_v.{d}': zero[d] + v * scale[d] - 2.5
                     for d, v in by_axis.items()}
        elif name == 'scale_factor':
            true |= {f'scale_factor.offset_v_per_g.{d}': scale[d] * (1 + v) - 1.0
                     for d, v in by_axis.items()}
        elif name == 'noise_excess':
            true |= {f'noise_excess.ratio.{d}': math.sqrt(
                noise[d][0] ** 2 + (v / scale[d]) ** 2 / _NOISE_BAND_HZ) / noise[d][1] - 1
                for d, v in by_axis.items()}
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
