# SPDX-License-Identifier: Apache-2.0

"""
The next experiment: the manoeuvre that separates effects that the recordings cannot separate.

It is the manoeuvre of the menu with the largest expected information per minute, by the rule with
which an investigation chooses (`expectation`).
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import NamedTuple

from adxl_ros.diagnose.comparison import Reference
from adxl_ros.diagnose.expectation import leading, predict, rank_responses, unknown_dimensions
from adxl_ros.diagnose.linear_model import LinearModel
from adxl_ros.diagnose.verdict import Verdict
from adxl_ros.errors import UserError
from adxl_ros.model.coefficients import with_neutral
from adxl_ros.model.diagnosis_hints import Manoeuvre
from adxl_ros.model.effects import effect_named, library
from adxl_ros.model.effects.base import Effect
from adxl_ros.model.sensor import Sensor
from adxl_ros.simulate import trajectories
from adxl_ros.simulate.motion import Motion
import numpy as np

_OTHER_REFERENCE = 'ros2 run adxl_ros diagnose next.csv --sim next_simulated.csv -o next'
"""Command for another recording beside another reference."""


class ManoeuvreDescription(NamedTuple):
    """How a manoeuvre is made."""

    text: str  # What to do, for people
    trajectory: str  # Name of the trajectory of `simulate`
    robot_text: str  # What to do without a stage, for people
    remounted: bool = False  # Whether the sensor is remounted, turned by 180° about z


MENU = {
    Manoeuvre.SHAKE: ManoeuvreDescription(
        'shake along x from 2 to 40 Hz', 'shaker', 'shake from 2 to 40 Hz'),
    Manoeuvre.SPEEDS: ManoeuvreDescription(
        'turn two planes at two speeds, forth and back, with reversals', 'rich',
        'turn at two speeds, forth and back, with reversals'),
    Manoeuvre.PLANES: ManoeuvreDescription(
        'sweep a second plane', 'tilt_both', 'tilt slowly in all directions'),
    Manoeuvre.REMOUNT: ManoeuvreDescription(
        'remount the sensor turned by 180 deg about z, and sweep again', 'tilt_both',
        'remount the sensor turned by 180 deg about z, and tilt in all directions', True),
    Manoeuvre.HEAT: ManoeuvreDescription(
        'dwell, heat and cool', 'soak', 'rest, heat and cool'),
    Manoeuvre.SUPPLY: ManoeuvreDescription(
        'step the supply at rest', 'soak', 'step the supply at rest'),
}
"""All manoeuvres. An effect names the one that reveals it best in its own file."""


@dataclass(frozen=True)
class MenuManoeuvre:
    """A manoeuvre of the menu."""

    manoeuvre: Manoeuvre  # Its place in the menu
    motion: Motion  # Its motion, which begins at 0 s
    begin_s: float = 0.0  # Time at which it begins, s

    @property
    def name(self) -> str:
        """Return what to do, for people."""
        return MENU[self.manoeuvre].text

    @property
    def minutes(self) -> float:
        """Return the duration, min."""
        return self.motion.duration_s / 60


@dataclass(frozen=True)
class RecordedEvidence:
    """What recordings are compared with, and what they show."""

    sensor: Sensor  # The baseline
    linear_model: LinearModel | None  # Linear model of the recordings; None without any
    seed: int  # Seed of the manoeuvres of the menu

    @property
    def beside_simulator(self) -> bool:
        """Return whether the motion is that of another simulator, without a stage."""
        return self.linear_model is not None and all(
            c.reference is Reference.SIMULATOR for c in self.linear_model.comparisons)


class MenuWorth(NamedTuple):
    """What a manoeuvre of the menu is expected to tell."""

    text: str  # What to do, for people
    minutes: float  # Duration, min
    nats_per_minute: float  # Expected information on the hypotheses, nat/min


@dataclass(frozen=True)
class NextExperiment:
    """What to record next."""

    manoeuvre: str  # What to do, for people
    why: str  # The reason, for people
    command: str  # Command that simulates the manoeuvre, or that diagnoses its recording
    # What it is expected to tell; None where nothing has to be separated
    nats_per_minute: float | None = None
    # All manoeuvres that can be simulated, the best first; empty where nothing has to be separated
    menu: tuple[MenuWorth, ...] = ()
    # Whether the reference has to change, so that nothing can be simulated
    concerns_reference: bool = False
    beside_simulator: bool = False  # Whether another simulator makes its motion


def propose_next_experiment(verdict: Verdict, not_covered: Sequence[str],
                            evidence: RecordedEvidence) -> NextExperiment | None:
    """Propose the manoeuvre that separates most of what is not separated."""
    same = next((group for group in verdict.groups if _give_same_samples(group)), None)
    if same is not None:
        return NextExperiment(
            'another sensor beside the same reference',
            f'because {" and ".join(same)} give the same samples, and what stays is of the '
            'reference', _OTHER_REFERENCE, concerns_reference=True)
    named = [effect_named(effect) for effect in verdict.effects]
    if verdict.status == 'explained' and any(e.diagnosis.smooths_reference for e in named):
        return NextExperiment(
            'the motion with less smoothing of the reference',
            'because it lacks motion that the sensor has', _OTHER_REFERENCE,
            concerns_reference=True)
    if verdict.groups:
        return _separating_experiment(verdict, evidence)
    if verdict.status == 'no_gap' and not not_covered:
        return None
    if verdict.status == 'unknown':
        why = 'to show what the unknown part of the gap depends on'
    elif not_covered:
        why = f'because the recordings have no {", no ".join(not_covered)}'
    else:
        why = 'to confirm the verdict on another recording'
    return _experiment(_revealing_manoeuvre(verdict, bool(not_covered)), why,
                       evidence.beside_simulator)


def _give_same_samples(group: Sequence[str]) -> bool:
    """Determine whether a group has an error of the reference that another effect imitates."""
    return any(effect_named(effect).diagnosis.imitated_by in group for effect in group)


def _separating_experiment(verdict: Verdict, evidence: RecordedEvidence) -> NextExperiment:
    """Rank the whole menu by its expected information; propose the best manoeuvre."""
    hypotheses = leading(verdict.hypotheses)
    effects = sorted({effect for h in hypotheses for effect in h.effects})
    dimensions = unknown_dimensions(verdict)
    responses = []
    for planned in _menu(evidence.seed):
        # At rest the pose is unknown, so that a baseline with effects of the stage has no place.
        with suppress(UserError):
            responses.append(predict(
                planned, _as_mounted(evidence.sensor, planned.manoeuvre), effects, dimensions))
    of_text = {described.text: manoeuvre for manoeuvre, described in MENU.items()}
    ranked = [(worth, of_text[worth.manoeuvre.name]) for worth in rank_responses(
        responses, hypotheses, evidence.linear_model, dimensions)]
    group, has_no_stage = verdict.groups[0], evidence.beside_simulator
    why = f'to separate {", ".join(group[:-1])} and {group[-1]}'
    menu = tuple(MenuWorth(_text(manoeuvre, has_no_stage), float(worth.manoeuvre.minutes),
                           float(worth.per_minute)) for worth, manoeuvre in ranked)
    return replace(_experiment(ranked[0][1], why, has_no_stage), menu=menu,
                   nats_per_minute=menu[0].nats_per_minute)


def _menu(seed: int) -> list[MenuManoeuvre]:
    """Return the manoeuvres of the menu with their motions."""
    return [MenuManoeuvre(manoeuvre, trajectories.TRAJECTORIES[described.trajectory](
        np.random.default_rng(seed))) for manoeuvre, described in MENU.items()]


def _as_mounted(sensor: Sensor, manoeuvre: Manoeuvre) -> Sensor:
    """Return the sensor as it is mounted in a manoeuvre."""
    return _remounted(sensor) if MENU[manoeuvre].remounted else sensor


def _revealing_manoeuvre(verdict: Verdict, lacks_coverage: bool) -> Manoeuvre:
    """Return the manoeuvre that reveals most of the effects of a verdict."""
    revealed_by = [effect_named(e).diagnosis.revealed_by for e in verdict.effects]
    best = max(MENU, key=revealed_by.count)
    if best in revealed_by:
        return best
    return Manoeuvre.SPEEDS if verdict.status == 'unknown' or not lacks_coverage \
        else Manoeuvre.PLANES


def _text(manoeuvre: Manoeuvre, beside_simulator: bool) -> str:
    """Return what to do in a manoeuvre, for people."""
    described = MENU[manoeuvre]
    return described.robot_text if beside_simulator else described.text


def _experiment(manoeuvre: Manoeuvre, why: str, beside_simulator: bool) -> NextExperiment:
    """Describe a manoeuvre with its command."""
    described = MENU[manoeuvre]
    if beside_simulator:
        return NextExperiment(described.robot_text, why, _OTHER_REFERENCE, beside_simulator=True)
    option = ''
    if described.remounted:
        effect = _remounting_effect()
        option = f' --effect {effect.name}:{effect.diagnosis.half_turn}={np.pi:.6f}'
    return NextExperiment(
        described.text, why,
        f'ros2 run adxl_ros simulate {described.trajectory}{option} -o next.csv')


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
