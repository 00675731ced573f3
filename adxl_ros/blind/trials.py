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

"""The cases of a check: the mix, the strengths, what is true of each, and its recording."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
import json
import math
import os
from pathlib import Path
from typing import Any

from adxl_ros.blind.world import ideal_observer, motion, unit
from adxl_ros.blind.world.chain import references, render, stamps
from adxl_ros.blind.world.fault_table import Fault, FOREIGN, KINDS, KNOWN
from adxl_ros.blind.world.unit import G0
import numpy as np

# Strength: rms beyond the stated calibration, m/s^2, log-uniform.
WEAKEST_MPS2, STRONGEST_MPS2 = 0.02e-3 * G0, 15e-3 * G0
SECONDS = (90.0, 200.0)


@dataclass(frozen=True)
class Plan:
    """What a case is to be: its group, effects and seed."""

    name: str
    group: str
    effects: tuple[str, ...]
    seed: tuple[int, ...]
    seconds: tuple[float, float] = SECONDS


@dataclass(frozen=True)
class Label:
    """
    What is true of a case.

    `group` is none, zero (an effect at strength zero), single, pair or outside; `faults` has for
    each effect its size and shape in the world, its strength, its visibility and the ideal
    observer's power to detect it and to tell it from every other effect, and the effects
    that the recording does not tell from it. `flexible` is the power of a flexible model.
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
        """Name the effects that the recording has."""
        return () if self.group == 'zero' else self.effects


def plans(seed: int, count: int, seconds: tuple[float, float] = SECONDS) -> list[Plan]:
    """
    Mix the cases, in an order that tells nothing.

    A quarter none, a fifth pairs, a fifth outside the library, the rest single effects, every kind
    in turn; and one more at strength zero for every twelve.
    """
    rng = np.random.default_rng([seed, 1])
    none, pairs, outside = (round(count * share) for share in (0.25, 0.2, 0.2))
    rows: list[tuple[str, tuple[str, ...]]] = [('none', ())] * none
    rows += [('single', (name,)) for name in _turns(KNOWN, count - none - pairs - outside, rng)]
    rows += [('outside', (name,)) for name in _turns(FOREIGN, outside, rng)]
    rows += [('pair', tuple(str(name) for name in rng.choice(KNOWN, 2, replace=False)))
             for _ in range(pairs)]
    rows += [('zero', (name,)) for name in _turns(KNOWN, math.ceil(count / 12), rng)]
    order = rng.permutation(len(rows))
    return [Plan(f'r{i:04d}', rows[k][0], rows[k][1], (seed, 2, int(k)), seconds)
            for i, k in enumerate(order)]


def _turns(names: tuple[str, ...], count: int, rng: np.random.Generator) -> list[str]:
    """Name each in turn, in a new order every time round."""
    out: list[str] = []
    while len(out) < count:
        out += [str(name) for name in rng.permutation(names)]
    return out[:count]


def scene(seed: tuple[int, ...], seconds: tuple[float, float],
          held_out: bool = False) -> ideal_observer.Scene:
    """Set the scene of a case, or the same unit in another manoeuvre of its kind."""
    drawn = unit.draw(np.random.default_rng([*seed, 0]))
    rng = np.random.default_rng([*seed, 1])
    seen = motion.draw(rng, seconds, drawn.rate_hz)
    if held_out:
        seen = motion.draw(rng, seconds, drawn.rate_hz, seen.kind)
    return ideal_observer.Scene(drawn, seen, _whole([*seed, 2 + held_out]))


def _whole(seed: list[int]) -> int:
    return int(np.random.SeedSequence(seed).generate_state(1)[0])


def faults_of(label: Label) -> list[Fault]:
    """Give the faults of a case as the world takes them."""
    if label.group == 'zero':
        return []
    return [Fault(KINDS[one['effect']], one['size'], one['shape']) for one in label.faults]


def draw(plan: Plan) -> Label:
    """Fix what is true of a case: sizes for the strengths drawn, and what can be seen."""
    at = scene(plan.seed, plan.seconds)
    floor = ideal_observer.rms(_noise(at))
    eye = ideal_observer.Eye(at)
    responses = eye.responses()
    label = Label(plan.name, plan.group, plan.effects, plan.seed, plan.seconds,
                  at.manoeuvre.kind, at.unit.axes, floor)
    if plan.effects and plan.group != 'zero':
        label = _with_faults(label, at, eye, responses)
    return replace(label, plain=eye.plain_choices(_residual(label, at, eye), responses))


def _with_faults(label: Label, at: ideal_observer.Scene, eye: ideal_observer.Eye,
                 responses: dict[str, list[np.ndarray]]) -> Label:
    rng = np.random.default_rng([*label.seed, 9])
    rivals = {name: eye.span(changes) for name, changes in responses.items()}
    rows, flexible = [], 0.0
    for name in label.effects:
        kind = KINDS[name]
        wanted = math.exp(rng.uniform(math.log(WEAKEST_MPS2), math.log(STRONGEST_MPS2)))
        fault, change = _sized(at, eye, Fault(kind, kind.start, kind.draw(rng, at.unit)), wanted)
        row, best = _sight(eye, rivals, fault, change)
        row['strength_mps2'] = ideal_observer.rms(
            ideal_observer.beyond_calibration(at.unit, change, eye.force))
        row['strength_floors'] = row['strength_mps2'] / label.floor_mps2
        rows.append(row)
        if not kind.known and row['power'] > 0.5:
            flexible = eye.flexible(rivals[best], eye.seen(change))
    return replace(label, faults=rows, flexible=flexible)


def _residual(label: Label, at: ideal_observer.Scene, eye: ideal_observer.Eye) -> np.ndarray:
    volts = render(at.unit, at.manoeuvre, faults_of(label), at.seed)
    return (volts - at.unit.stated_zero_v[:, None]) * at.unit.volts_to_mps2 - eye.force


def _noise(at: ideal_observer.Scene) -> np.ndarray:
    clean, noisy = (render(at.unit, at.manoeuvre, [], at.seed, noise=noise, fine_hz=800.0)
                    for noise in (False, True))
    off = (noisy - clean) * at.unit.volts_to_mps2
    return off - off.mean(axis=1, keepdims=True)


def _sized(at: ideal_observer.Scene, eye: ideal_observer.Eye, fault: Fault,
           wanted: float) -> tuple[Fault, np.ndarray]:
    """Find the size of a fault that has the wanted strength, or the most it can have."""
    kind, tried = fault.kind, []
    while True:
        change = at.response([fault], coarse=True)
        found = ideal_observer.rms(ideal_observer.beyond_calibration(at.unit, change, eye.force))
        tried.append((math.log(fault.size), math.log(max(found, 1e-12))))
        if abs(tried[-1][1] - math.log(wanted)) < 0.05 or len(tried) == 9 or (
                fault.size == kind.most and found < wanted):
            return fault, change
        slope = 1.0
        if len(tried) > 1 and tried[-1][0] != tried[-2][0]:
            slope = (tried[-1][1] - tried[-2][1]) / (tried[-1][0] - tried[-2][0])
        step = (math.log(wanted) - tried[-1][1]) / min(max(slope, 0.7), 30.0)
        size = fault.size * math.exp(min(max(step, -3.0), 3.0))
        fault = replace(fault, size=min(size, kind.most))


def _sight(eye: ideal_observer.Eye, rivals: dict[str, np.ndarray], fault: Fault,
           change: np.ndarray) -> tuple[dict[str, Any], str]:
    """Say how well the ideal observer sees a fault and tells it from others."""
    kind, vector = fault.kind, eye.seen(change)
    visible = ideal_observer.noise_visibility(eye, kind, change) if kind.random \
        else float(vector @ vector)
    left = {name: float(vector @ vector - np.sum((columns.T @ vector) ** 2))
            for name, columns in rivals.items() if name != kind.name}
    best = min(left, key=left.__getitem__)
    power = ideal_observer.power(visible)
    # A fault that differs from run to run is mistaken for one of the mean only where it is slow.
    apart = kind.random and kind.name not in ('flicker', 'bias_walk', 'adc_inl')
    rest = visible if apart else left[best]
    alike = [name for name, some in left.items() if some < ideal_observer.LEFT] \
        if power > 0.5 and not apart else []
    shape = {name: np.asarray(value).tolist() for name, value in fault.shape.items()}
    return {'effect': kind.name, 'size': fault.size, 'shape': shape, 'visibility': visible,
            'power': power, 'told': ideal_observer.told(rest), 'rival': best,
            'inseparable': sorted(alike)}, best


def recording(label: Label, held_out: bool = False) -> str:
    """Make a case's recording, or one kept out, as CSV."""
    at = scene(label.seed, label.seconds, held_out)
    volts = render(at.unit, at.manoeuvre, faults_of(label), at.seed)
    columns = {'time_s': stamps(at.unit, at.manoeuvre)}
    columns |= {f'{axis}_v': row for axis, row in zip(at.unit.axes, volts)}
    columns |= references(at.unit, at.manoeuvre, at.seed)
    digits = {'shift_m': 10, 'temperature_c': 3, 'supply_v': 5}
    widths = ','.join(f'%.{digits.get(name, 7)}f' for name in columns)
    rows = np.stack(list(columns.values()), axis=1)
    return '\n'.join([','.join(columns), *(widths % tuple(row) for row in rows.tolist()), ''])


def parameter_file(label: Label) -> str:
    """Write what the user has for a case's unit."""
    return unit.parameter_file(scene(label.seed, label.seconds).unit, label.name)


def write(label: Label, folder: Path) -> None:
    """Write NAME.csv and NAME.yaml, with times that tell nothing."""
    for suffix, text in (('csv', recording(label)), ('yaml', parameter_file(label))):
        path = folder / f'{label.name}.{suffix}'
        path.write_text(text, encoding='ascii')
        os.utime(path, (0, 0))


def as_json(labels: list[Label]) -> str:
    """Write labels as JSON."""
    return json.dumps([asdict(label) for label in labels], indent=1) + '\n'


def from_json(text: str) -> list[Label]:
    """Read labels from JSON."""
    lists = ('effects', 'seed', 'seconds')
    rows: list[dict[str, Any]] = json.loads(text)
    return [Label(**{**row, **{name: tuple(row[name]) for name in lists}}) for row in rows]


def write_all(seed: int, count: int, folder: Path) -> list[Label]:
    """
    Draw a check in the open, for work on the diagnosis: never for a score.

    FOLDER/recordings has NAME.csv and NAME.yaml, FOLDER/labels/labels.json what is true.
    """
    for name in ('recordings', 'labels'):
        (folder / name).mkdir(parents=True, exist_ok=True)
    labels = []
    for plan in plans(seed, count):
        labels.append(draw(plan))
        write(labels[-1], folder / 'recordings')
        (folder / 'labels' / 'labels.json').write_text(as_json(labels), encoding='utf-8')
    return labels
