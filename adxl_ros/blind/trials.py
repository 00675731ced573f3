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

"""The trials of a check: their mix, their strengths, their labels and their recordings."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
import json
import math
from typing import Any

from adxl_ros.blind.world import ideal_observer, motion, unit
from adxl_ros.blind.world.chain import references, render, stamps
from adxl_ros.blind.world.fault import Fault
from adxl_ros.blind.world.fault_table import KINDS, KNOWN, UNLISTED
from adxl_ros.blind.world.unit import G0
import numpy as np

WEAKEST_MPS2 = 0.02e-3 * G0
"""Lowest strength: rms of an effect beyond the stated calibration, m/s²; chosen: out of sight."""
STRONGEST_MPS2 = 15e-3 * G0
"""Highest strength, m/s²; chosen. Strengths are log-uniform."""
SECONDS = (90.0, 200.0)
"""Shortest and longest recording, s; chosen."""
_SHARES = (0.25, 0.2, 0.2)
"""Shares of trials without an effect, with two effects and with an unlisted fault; chosen."""
_TRIALS_PER_ZERO = 12
"""Number of trials for each further trial at strength zero; chosen."""
_MAX_SIZE_STEPS = 9
"""Largest number of simulations to find the size for a strength; chosen."""
_SIZE_TOLERANCE = 0.05
"""Largest error of the logarithm of the strength; chosen."""
_SLOW_NOISE = ('flicker', 'bias_walk', 'adc_inl')
"""Faults that look like noise and can be mistaken for an effect that does not."""


@dataclass(frozen=True)
class Plan:
    """
    What a trial is to be.

    Attributes
    ----------
    name
        Neutral name of its files.
    group
        'none', 'zero' (an effect at strength zero), 'single', 'pair' or 'outside' the library.
    effects
        Its effects.
    seed
        Seed of all its random numbers.
    seconds
        Shortest and longest recording, s.

    """

    name: str
    group: str
    effects: tuple[str, ...]
    seed: tuple[int, ...]
    seconds: tuple[float, float] = SECONDS


@dataclass(frozen=True)
class Label:
    """
    What is true of a trial. Its fields are the keys of the label file.

    Attributes
    ----------
    name, group, effects, seed, seconds
        As in `Plan`.
    manoeuvre
        Kind of the manoeuvre.
    axes
        Measured axes.
    floor_mps2
        Noise floor, m/s².
    faults
        For each effect: size, shape, strength, visibility, the ideal observer's `power` to detect
        it, its probability to separate it from other effects (`told`), and inseparable effects.
    flexible
        Power of a flexible model to detect an effect outside the library.
    plain
        Effects that simple methods choose.

    """

    name: str
    group: str
    effects: tuple[str, ...]
    seed: tuple[int, ...]
    seconds: tuple[float, float]
    manoeuvre: str
    axes: str
    floor_mps2: float
    faults: list[dict[str, Any]] = field(default_factory=list)
    flexible: float = 0.0
    plain: dict[str, str] = field(default_factory=dict)

    @property
    def true(self) -> tuple[str, ...]:
        """Return the effects that the recording has."""
        return () if self.group == 'zero' else self.effects


def plans(seed: int, count: int, seconds: tuple[float, float] = SECONDS) -> list[Plan]:
    """
    Plan the trials of a check in random order.

    A quarter has no effect, a fifth has two, and a fifth has a fault outside the library. The rest
    has one effect, each kind in turn. For every twelve there is one more at strength zero.

    Parameters
    ----------
    seed
        Seed of the check.
    count
        Number of trials, without those at strength zero.
    seconds
        Shortest and longest recording, s.

    Returns
    -------
    list of Plan
        The plans.

    """
    rng = np.random.default_rng([seed, 1])
    none, pairs, outside = (round(count * share) for share in _SHARES)
    rows: list[tuple[str, tuple[str, ...]]] = [('none', ())] * none
    rows += [('single', (name,)) for name in _turns(KNOWN, count - none - pairs - outside, rng)]
    rows += [('outside', (name,)) for name in _turns(UNLISTED, outside, rng)]
    rows += [('pair', tuple(str(name) for name in rng.choice(KNOWN, 2, replace=False)))
             for _ in range(pairs)]
    rows += [('zero', (name,)) for name in _turns(KNOWN, math.ceil(count / _TRIALS_PER_ZERO), rng)]
    order = rng.permutation(len(rows))
    return [Plan(f'r{i:04d}', rows[k][0], rows[k][1], (seed, 2, int(k)), seconds)
            for i, k in enumerate(order)]


def _turns(names: tuple[str, ...], count: int, rng: np.random.Generator) -> list[str]:
    """Return each name in turn, in a new random order in each round."""
    rounds: list[str] = []
    while len(rounds) < count:
        rounds += [str(name) for name in rng.permutation(names)]
    return rounds[:count]


def scene(seed: tuple[int, ...], seconds: tuple[float, float],
          held_out: bool = False) -> ideal_observer.Scene:
    """
    Return unit and manoeuvre of a trial.

    Parameters
    ----------
    seed
        Seed of the trial.
    seconds
        Shortest and longest recording, s.
    held_out
        Whether to return the same unit in another manoeuvre of the same kind.

    Returns
    -------
    Scene
        The scene.

    """
    drawn = unit.draw(np.random.default_rng([*seed, 0]))
    rng = np.random.default_rng([*seed, 1])
    manoeuvre = motion.draw(rng, seconds, drawn.rate_hz)
    if held_out:
        manoeuvre = motion.draw(rng, seconds, drawn.rate_hz, manoeuvre.kind)
    return ideal_observer.Scene(drawn, manoeuvre, _integer_seed([*seed, 2 + held_out]))


def _integer_seed(seed: list[int]) -> int:
    return int(np.random.SeedSequence(seed).generate_state(1)[0])


def faults_of(label: Label) -> list[Fault]:
    """Return the faults of a trial."""
    if label.group == 'zero':
        return []
    return [Fault(KINDS[row['effect']], row['size'], row['shape']) for row in label.faults]


def draw(plan: Plan) -> Label:
    """Draw a label: sizes for the drawn strengths, and what the ideal observer sees."""
    drawn = scene(plan.seed, plan.seconds)
    floor = ideal_observer.rms(_noise(drawn))
    observer = ideal_observer.IdealObserver(drawn)
    responses = observer.responses()
    label = Label(plan.name, plan.group, plan.effects, plan.seed, plan.seconds,
                  drawn.manoeuvre.kind, drawn.unit.axes, floor)
    if plan.effects and plan.group != 'zero':
        label = _with_faults(label, observer, responses)
    return replace(label, plain=observer.simple_choices(_residual(label, observer), responses))


def _with_faults(label: Label, observer: ideal_observer.IdealObserver,
                 responses: dict[str, list[np.ndarray]]) -> Label:
    rng = np.random.default_rng([*label.seed, 9])
    drawn = observer.scene
    rivals = {name: observer.span(changes) for name, changes in responses.items()}
    rows, flexible = [], 0.0
    for name in label.effects:
        kind = KINDS[name]
        strength = math.exp(rng.uniform(math.log(WEAKEST_MPS2), math.log(STRONGEST_MPS2)))
        fault, change = _sized(observer, Fault(kind, kind.start, kind.draw(rng, drawn.unit)),
                               strength)
        row = _visibility(observer, rivals, fault, change)
        row['strength_mps2'] = ideal_observer.rms(
            ideal_observer.beyond_calibration(drawn.unit, change, observer.force))
        row['strength_floors'] = row['strength_mps2'] / label.floor_mps2
        rows.append(row)
        if not kind.in_library and row['power'] > 0.5:
            flexible = observer.flexible_power(rivals[row['rival']], observer.project(change))
    return replace(label, faults=rows, flexible=flexible)


def _residual(label: Label, observer: ideal_observer.IdealObserver) -> np.ndarray:
    """Return the recording of a trial minus the stated nominal response, m/s², (m, n)."""
    drawn = observer.scene
    volts = render(drawn.unit, drawn.manoeuvre, faults_of(label), drawn.seed)
    return (volts - drawn.unit.stated_zero_v[:, None]) * drawn.unit.volts_to_mps2 - observer.force


def _noise(drawn: ideal_observer.Scene) -> np.ndarray:
    """Return the noise of a recording without its mean, m/s², (m, n)."""
    clean, noisy = (render(drawn.unit, drawn.manoeuvre, [], drawn.seed, noise=noise,
                           fine_hz=800.0) for noise in (False, True))
    difference = (noisy - clean) * drawn.unit.volts_to_mps2
    return difference - difference.mean(axis=1, keepdims=True)


def _sized(observer: ideal_observer.IdealObserver, fault: Fault, strength: float
           ) -> tuple[Fault, np.ndarray]:
    """Find the size of a fault that has a strength, or its largest; return its response, too."""
    kind, drawn = fault.kind, observer.scene
    sizes: list[float] = []
    strengths: list[float] = []
    while True:
        change = drawn.response([fault], coarse=True)
        rms = ideal_observer.rms(
            ideal_observer.beyond_calibration(drawn.unit, change, observer.force))
        sizes.append(math.log(fault.size))
        strengths.append(math.log(max(rms, 1e-12)))
        if abs(strengths[-1] - math.log(strength)) < _SIZE_TOLERANCE or \
                len(sizes) == _MAX_SIZE_STEPS or (fault.size == kind.largest and rms < strength):
            return fault, change
        slope = 1.0
        if len(sizes) > 1 and sizes[-1] != sizes[-2]:
            slope = (strengths[-1] - strengths[-2]) / (sizes[-1] - sizes[-2])
        step = (math.log(strength) - strengths[-1]) / min(max(slope, 0.7), 30.0)
        size = fault.size * math.exp(min(max(step, -3.0), 3.0))
        fault = replace(fault, size=min(size, kind.largest))


def _visibility(observer: ideal_observer.IdealObserver, rivals: dict[str, np.ndarray],
                fault: Fault, change: np.ndarray) -> dict[str, Any]:
    """Return how well the ideal observer detects a fault and separates it from others."""
    kind, vector = fault.kind, observer.project(change)
    visibility = ideal_observer.noise_visibility(observer, kind, change) if kind.random \
        else float(vector @ vector)
    rest_of = {name: float(vector @ vector - np.sum((columns.T @ vector) ** 2))
               for name, columns in rivals.items() if name != kind.name}
    rival = min(rest_of, key=rest_of.__getitem__)
    power = ideal_observer.power(visibility)
    # Only slow noise can be mistaken for an effect that does not look like noise.
    separable = kind.random and kind.name not in _SLOW_NOISE
    rest = visibility if separable else rest_of[rival]
    inseparable = [name for name, squares in rest_of.items()
                   if squares < ideal_observer.INSEPARABLE_BELOW] \
        if power > 0.5 and not separable else []
    shape = {name: np.asarray(value).tolist() for name, value in fault.shape.items()}
    return {'effect': kind.name, 'size': fault.size, 'shape': shape, 'visibility': visibility,
            'power': power, 'told': ideal_observer.separation_probability(rest), 'rival': rival,
            'inseparable': sorted(inseparable)}


def recording(label: Label, held_out: bool = False) -> str:
    """
    Return the recording of a trial as CSV.

    Parameters
    ----------
    label
        Label of the trial.
    held_out
        Whether to return the held-out recording of the same unit.

    Returns
    -------
    str
        The text of the file.

    """
    drawn = scene(label.seed, label.seconds, held_out)
    volts = render(drawn.unit, drawn.manoeuvre, faults_of(label), drawn.seed)
    columns = {'time_s': stamps(drawn.unit, drawn.manoeuvre)}
    columns |= {f'{axis}_v': row for axis, row in zip(drawn.unit.axes, volts)}
    columns |= references(drawn.unit, drawn.manoeuvre, drawn.seed)
    digits = {'shift_m': 10, 'temperature_c': 3, 'supply_v': 5}
    formats = ','.join(f'%.{digits.get(name, 7)}f' for name in columns)
    rows = np.stack(list(columns.values()), axis=1)
    return '\n'.join([','.join(columns), *(formats % tuple(row) for row in rows.tolist()), ''])


def parameter_file(label: Label) -> str:
    """Return the parameter file that the user has for the unit of a trial."""
    return unit.parameter_file(scene(label.seed, label.seconds).unit, label.name)


def as_json(labels: list[Label]) -> str:
    """Return labels as JSON."""
    return json.dumps([asdict(label) for label in labels], indent=1) + '\n'


def from_json(text: str) -> list[Label]:
    """Read labels from JSON."""
    lists = ('effects', 'seed', 'seconds')
    rows: list[dict[str, Any]] = json.loads(text)
    return [Label(**{**row, **{name: tuple(row[name]) for name in lists}}) for row in rows]
