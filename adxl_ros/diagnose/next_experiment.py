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
The next experiment: the manoeuvre that separates effects that the recordings cannot separate.

Each manoeuvre is simulated with the best hypothesis, noise included, and the inseparable effects
are fitted to the simulation. The worth of a manoeuvre is the log Bayes factor of the best effect
over the second one, per minute.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from adxl_ros.diagnose.baseline_comparison import (
    at_search_rate,
    BaselineComparison,
    Reference,
)
from adxl_ros.diagnose.decision import Verdict
from adxl_ros.diagnose.linear_model import build_linear_model
from adxl_ros.errors import UserError
from adxl_ros.model.coefficients import with_neutral
from adxl_ros.model.diagnosis_hints import Manoeuvre
from adxl_ros.model.effects import effect_named, library
from adxl_ros.model.effects.base import Effect
from adxl_ros.model.sensor import Sensor
from adxl_ros.simulate import trajectories
from adxl_ros.simulate.response import Response
import numpy as np

_RATE_HZ = 62.5
"""Sample rate of the simulated manoeuvres, Hz. Chosen: run time."""
_SMALLEST_LOG_BAYES_FACTOR = 3.0
"""Log Bayes factor below which a manoeuvre does not show an effect. Chosen: 20 to 1."""


class ManoeuvreDescription(NamedTuple):
    """
    How a manoeuvre is made.

    Attributes
    ----------
    text
        What to do, for people.
    trajectory
        Name of the trajectory of `simulate`.
    remounted
        Whether the sensor is remounted, turned by 180° about z.

    """

    text: str
    trajectory: str
    remounted: bool = False


MENU = {
    Manoeuvre.SHAKE: ManoeuvreDescription('shake along x from 2 to 40 Hz', 'shaker'),
    Manoeuvre.SPEEDS: ManoeuvreDescription(
        'turn two planes at two speeds, forth and back, with reversals', 'rich'),
    Manoeuvre.PLANES: ManoeuvreDescription('sweep a second plane', 'tilt_both'),
    Manoeuvre.REMOUNT: ManoeuvreDescription(
        'remount the sensor turned by 180 deg about z, and sweep again', 'tilt_both', True),
    Manoeuvre.HEAT: ManoeuvreDescription('dwell, heat and cool', 'soak'),
    Manoeuvre.SUPPLY: ManoeuvreDescription('step the supply at rest', 'soak'),
}
"""All manoeuvres. An effect names the one that reveals it best in its own file."""


class ManoeuvreWorth(NamedTuple):
    """
    What a manoeuvre is expected to show.

    Attributes
    ----------
    text
        What to do, for people.
    minutes
        Duration, min.
    log_bayes_factor_per_minute
        Log Bayes factor of the truth over its nearest rival, 1/min.

    """

    text: str
    minutes: float
    log_bayes_factor_per_minute: float


@dataclass(frozen=True)
class NextExperiment:
    """
    What to record next.

    Attributes
    ----------
    manoeuvre
        What to do, for people.
    why
        The reason, for people.
    command
        Command that simulates the manoeuvre.
    log_bayes_factor_per_minute
        What it is expected to show; None where nothing has to be separated.
    menu
        All manoeuvres, the best first; empty where nothing has to be separated.

    """

    manoeuvre: str
    why: str
    command: str
    log_bayes_factor_per_minute: float | None = None
    menu: tuple[ManoeuvreWorth, ...] = ()


def propose_next_experiment(verdict: Verdict, not_covered: Sequence[str], seed: int
                            ) -> NextExperiment | None:
    """
    Propose the manoeuvre that separates most of what is not separated.

    Parameters
    ----------
    verdict
        The verdict with its groups.
    not_covered
        What the recordings do not cover, for people.
    seed
        Seed of the simulated noise.

    Returns
    -------
    NextExperiment or None
        None where nothing more is needed.

    """
    if verdict.groups:
        return _separating_experiment(verdict, seed)
    if verdict.status == 'no_gap' and not not_covered:
        return None
    if verdict.status == 'unknown':
        why = 'to show what the unknown part of the gap depends on'
    elif not_covered:
        why = f'because the recordings have no {", no ".join(not_covered)}'
    else:
        why = 'to confirm the verdict on another recording'
    return _experiment(_revealing_manoeuvre(verdict, bool(not_covered)), why)


def _separating_experiment(verdict: Verdict, seed: int) -> NextExperiment:
    """Simulate the whole menu for the first group of the verdict; propose the best manoeuvre."""
    group = verdict.groups[0]
    worth = {m: _worth(m, verdict.best.sensor, group, seed) for m in MENU}
    order = sorted(MENU, key=lambda m: -worth[m].log_bayes_factor_per_minute)
    return replace(_experiment(order[0], f'to separate {", ".join(group[:-1])} and {group[-1]}'),
                   log_bayes_factor_per_minute=worth[order[0]].log_bayes_factor_per_minute,
                   menu=tuple(worth[m] for m in order))


def _revealing_manoeuvre(verdict: Verdict, lacks_coverage: bool) -> Manoeuvre:
    """Return the manoeuvre that reveals most of the effects of a verdict."""
    revealed_by = [effect_named(e).diagnosis.revealed_by for e in verdict.effects]
    best = max(MENU, key=revealed_by.count)
    if best in revealed_by:
        return best
    return Manoeuvre.SPEEDS if verdict.status == 'unknown' or not lacks_coverage \
        else Manoeuvre.PLANES


def _experiment(manoeuvre: Manoeuvre, why: str) -> NextExperiment:
    """Describe a manoeuvre with its command."""
    described = MENU[manoeuvre]
    option = ''
    if described.remounted:
        effect = _remounting_effect()
        option = f' --effect {effect.name}:{effect.diagnosis.half_turn}={np.pi:.6f}'
    return NextExperiment(
        described.text, why,
        f'ros2 run adxl_ros simulate {described.trajectory}{option} -o next.csv')


def _worth(manoeuvre: Manoeuvre, sensor: Sensor, group: Sequence[str], seed: int
           ) -> ManoeuvreWorth:
    """Simulate a manoeuvre, and fit each effect of a group to it."""
    described = MENU[manoeuvre]
    motion = trajectories.TRAJECTORIES[described.trajectory](np.random.default_rng(seed))
    minutes = motion.duration_s / 60
    truth = replace(sensor, rate_hz=_RATE_HZ)
    baseline = replace(truth, effects=tuple(e for e in truth.effects if e not in group))
    if described.remounted:
        truth, baseline = _remounted(truth), _remounted(baseline)
    time_s = np.arange(round(motion.duration_s * _RATE_HZ)) / _RATE_HZ
    try:
        volts = Response(truth, motion, seed)(time_s)
    except UserError:
        return ManoeuvreWorth(described.text, minutes, 0.0)
    comparison = BaselineComparison(
        described.text, time_s, volts, motion, baseline, Reference.STAGE, True,
        np.zeros(len(time_s), bool), np.ones(len(time_s), bool))
    linear_model = build_linear_model([at_search_rate(comparison)], only=group)
    null_fit = linear_model.fit_variants([])
    gains = []
    for effect in group:
        fits = [linear_model.fit_variants([i], null_fit)
                for i, v in enumerate(linear_model.variants) if v.effect == effect]
        gains.append(max((fit.log_evidence - null_fit.log_evidence for fit in fits),
                         default=0.0))
    *_, second, first = sorted(gains)
    separated = first - max(second, 0.0) if first > _SMALLEST_LOG_BAYES_FACTOR else 0.0
    return ManoeuvreWorth(described.text, minutes, separated / minutes)


def _remounting_effect() -> Effect:
    """Return the effect that turns the sensor on its stage."""
    return next(e for e in library().values() if e.diagnosis.half_turn)


def _remounted(sensor: Sensor) -> Sensor:
    """Turn the sensor on its stage by half a turn: the encoder's zero changes by π."""
    effect = _remounting_effect()
    turned = with_neutral(sensor, [effect.name])
    values = dict(turned.values[effect.name])
    parameter = effect.diagnosis.half_turn
    values[parameter] = np.asarray(values[parameter]) + np.pi
    return replace(turned, values={**turned.values, effect.name: values})
