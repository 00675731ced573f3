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

"""What the diagnosis answered, what would have been right, and whether it was."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations, permutations
import math
from typing import Any

from adxl_ros.blind import trials
from adxl_ros.blind.trials import Label
from adxl_ros.blind.world.unit import G0
import numpy as np

UNKNOWN = 'unknown'
# Below this power of the ideal observer an effect is out of sight: not naming it is right, too.
SEEN, SURE = 0.5, 0.9


@dataclass(frozen=True)
class Answer:
    """A report, read: `certain` effects, `groups` of which one each, and the hypotheses."""

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
        """Name every effect of the verdict, for certain or as one of a group."""
        return self.certain.union(*self.groups)

    @property
    def top(self) -> frozenset[str]:
        """Give the most probable hypothesis."""
        return max(self.hypotheses, key=lambda one: one[1])[0]

    @property
    def gap(self) -> bool:
        """Say whether the answer is that there is something."""
        return self.status in ('explained', 'inseparable', 'unknown', 'bad_data')


def answer(result: dict[str, Any]) -> Answer:
    """Read a result; what is no report of the fixed form counts as failed and says nothing."""
    try:
        report = result['report']
        verdict = report['verdict']
        hypotheses = tuple((frozenset(one['effects']), float(one['probability']))
                           for one in report['hypotheses'])
        parameters = {
            f'{one["effect"]}.{name}': (
                float(row['value']), float(row['ci'][0]), float(row['ci'][1]))
            for one in report['candidates'] for name, row in one['parameters'].items()
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
    """Give the answer that is wholly right."""
    return frozenset({UNKNOWN} if label.group == 'outside' else label.true)


def right(label: Label) -> list[frozenset[str]]:
    """Give every answer that is right: effects out of the ideal observer's sight may miss."""
    whole = truth(label)
    power = {UNKNOWN if label.group == 'outside' else one['effect']: one['power']
             for one in label.faults}
    hidden = [name for name in whole if power.get(name, 1.0) < SEEN]
    return [whole - set(some) for k in range(len(hidden) + 1) for some in combinations(hidden, k)]


def verdict_right(given: Answer, label: Label) -> bool:
    """Say whether a verdict is right: what is certain is true, and each group holds one more."""
    if given.status in ('failed', 'insufficient', 'bad_data'):
        return False
    return any(_fits(given, wanted) for wanted in right(label))


def _fits(given: Answer, wanted: frozenset[str]) -> bool:
    if not given.certain <= wanted:
        return False
    rest = wanted - given.certain
    return len(rest) == len(given.groups) and any(
        all(name in group for name, group in zip(order, given.groups))
        for order in permutations(rest))


def sure(label: Label) -> bool:
    """Say whether the ideal observer both sees every effect and tells it from all others."""
    return bool(label.faults) and all(
        one['power'] * one['told'] >= SURE for one in label.faults)


def visible(label: Label) -> bool:
    """Say whether the ideal observer sees every effect."""
    return bool(label.faults) and all(one['power'] >= SURE for one in label.faults)


def brier(given: Answer, label: Label) -> float:
    """Score the probabilities of all hypotheses; those that are right count together."""
    wanted = right(label)
    good = sum(p for effects, p in given.hypotheses if effects in wanted)
    wrong = sum(p * p for effects, p in given.hypotheses if effects not in wanted)
    return (1 - good) ** 2 + wrong


def true_parameters(label: Label) -> dict[str, float]:
    """
    Give true figures by the names that reports use, where both worlds mean the same by them.

    A coefficient of another functional form has no counterpart and is left out.
    """
    out: dict[str, float] = {}
    unit = trials.scene(label.seed, label.seconds).unit
    stage = unit.stage_rad
    for one in label.faults:
        name, size = one['effect'], one['size']
        w = size * np.asarray(one['shape'].get('w', [0.0]), float)
        by_axis = dict(zip(unit.axes, w))
        scale = dict(zip(unit.axes, unit.scale_v_per_g))
        zero = dict(zip(unit.axes, unit.zero_v))
        noise = dict(zip(unit.axes, zip(unit.noise_g_per_rthz, unit.stated_noise_g_per_rthz)))
        if name == 'bias':
            out |= {f'bias.offset_v.{d}': zero[d] + v * scale[d] - 2.5
                    for d, v in by_axis.items()}
        elif name == 'scale_factor':
            out |= {f'scale_factor.offset_v_per_g.{d}': scale[d] * (1 + v) - 1.0
                    for d, v in by_axis.items()}
        elif name == 'noise_excess':
            out |= {f'noise_excess.ratio.{d}': math.sqrt(
                noise[d][0] ** 2 + (v / scale[d]) ** 2 / 78.5) / noise[d][1] - 1
                for d, v in by_axis.items()}
        elif name == 'gravity':
            out['gravity.offset_mps2'] = G0 * w[0]
        elif name == 'time_offset':
            out['time_offset.offset_s'] = w[0]
        elif name == 'lever_arm':
            out |= {f'lever_arm.{d}_m': v for d, v in zip('xyz', w)}
        elif name == 'stage_offset':
            out |= {'stage_offset.alpha_rad': w[0] + stage[0],
                    'stage_offset.beta_rad': w[1] + stage[3]}
        elif name == 'base_tilt':
            out |= {'base_tilt.x_rad': -w[1], 'base_tilt.y_rad': w[0]}
        elif name == 'backlash':
            out |= {'backlash.alpha_rad': abs(w[0]), 'backlash.beta_rad': abs(w[1])}
        elif name == 'stage_eccentricity':
            out |= {f'stage_eccentricity.{part}_rad': v + stage[i] for part, v, i in zip(
                ('beta_sine', 'beta_cosine', 'alpha_sine', 'alpha_cosine'), w, (4, 5, 1, 2))}
        elif name == 'misalignment':
            # Equations 18 and 19, to first order, of the directions xy, xz, yx, yz, zx, zy.
            out |= {f'misalignment.{part}_rad.{d}': sign * v for part, d, sign, v in zip(
                ('beta', 'alpha', 'beta', 'alpha', 'beta', 'alpha'), 'xxyyzz',
                (1, -1, -1, 1, 1, -1), w)}
        elif name == 'mount_resonance':
            out['mount_resonance.frequency_hz'] = one['shape']['hertz']
    return out
