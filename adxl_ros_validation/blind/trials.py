# SPDX-License-Identifier: Apache-2.0
"""The trials of a check, their labels, and the commitment to the labels by a published hash."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, field, replace
from datetime import date
from functools import partial
import hashlib
import json
import math
import os
from pathlib import Path
import secrets
import shutil
from typing import Any, NamedTuple

from adxl_ros.errors import UserError
from adxl_ros.workers import for_each, make_folder, write
from adxl_ros_validation.blind.world import ideal_observer, motion, simulator
from adxl_ros_validation.blind.world.fault_table import KINDS, KNOWN, UNLISTED
from adxl_ros_validation.blind.world.simulator import Fault, G0, references, render, stamps
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
    """What a trial is to be."""

    name: str  # neutral name of its files
    # 'none', 'zero' (an effect at strength zero), 'single', 'pair' or 'outside' the library
    group: str
    effects: tuple[str, ...]  # its effects
    seed: tuple[int, ...]  # seed of all its random numbers
    seconds: tuple[float, float] = SECONDS  # shortest and longest recording, s


@dataclass(frozen=True)
class Label:
    """What is true of a trial. Its fields are the keys of the label file."""

    name: str  # as in `Plan`
    group: str
    effects: tuple[str, ...]
    seed: tuple[int, ...]
    seconds: tuple[float, float]
    manoeuvre: str  # kind of the manoeuvre
    axes: str  # measured axes
    floor_mps2: float  # noise floor, m/s²
    # for each effect: size, shape, strength, visibility, the ideal observer's `power` to detect
    # it, its probability to separate it from other effects (`told`), and inseparable effects
    faults: list[dict[str, Any]] = field(default_factory=list)
    flexible: float = 0.0  # power of a flexible model to detect an effect outside the library
    plain: dict[str, str] = field(default_factory=dict)  # effects that simple methods choose

    @property
    def true(self) -> tuple[str, ...]:
        """Return the effects that the recording has."""
        return () if self.group == 'zero' else self.effects


def plans(seed: int, count: int, seconds: tuple[float, float] = SECONDS) -> list[Plan]:
    """
    Plan the trials of a check in random order.

    A quarter has no effect, a fifth has two, and a fifth has a fault outside the library. The rest
    has one effect, each kind in turn. For every twelve there is one more at strength zero.
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
    """Return unit and manoeuvre of a trial."""
    drawn = simulator.draw_unit(np.random.default_rng([*seed, 0]))
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


def draw_label(plan: Plan) -> Label:
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
        fault, change = sized(partial(measured, drawn, observer.force),
                              Fault(kind, kind.start, kind.draw(rng, drawn.unit)), strength)
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


def sized(measure: Callable[[Fault], tuple[float, np.ndarray]], fault: Fault, strength: float
          ) -> tuple[Fault, np.ndarray]:
    """
    Find the size of a fault that has a strength, or its largest; return what it measured last.

    `measure` returns the strength of a fault, m/s², and what it does.
    """
    sizes: list[float] = []
    strengths: list[float] = []
    while True:
        rms, change = measure(fault)
        sizes.append(math.log(fault.size))
        strengths.append(math.log(max(rms, 1e-12)))
        if abs(strengths[-1] - math.log(strength)) < _SIZE_TOLERANCE or len(
                sizes) == _MAX_SIZE_STEPS or (
                fault.size == fault.kind.largest and rms < strength):
            return fault, change
        slope = 1.0
        if len(sizes) > 1 and sizes[-1] != sizes[-2]:
            slope = (strengths[-1] - strengths[-2]) / (sizes[-1] - sizes[-2])
        step = (math.log(strength) - strengths[-1]) / min(max(slope, 0.7), 30.0)
        size = fault.size * math.exp(min(max(step, -3.0), 3.0))
        fault = replace(fault, size=min(size, fault.kind.largest))


def measured(scene: ideal_observer.Scene, force: np.ndarray, fault: Fault
             ) -> tuple[float, np.ndarray]:
    """Return strength and response of a fault; `force` is along the axes, m/s², (m, n)."""
    change = scene.response([fault], coarse=True)
    return ideal_observer.rms(
        ideal_observer.beyond_calibration(scene.unit, change, force)), change


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
    return {'effect': kind.name, 'noise_like': kind.random,
            'size': fault.size, 'shape': shape,
            'visibility': visibility, 'power': power, 'rival': rival,
            'told': ideal_observer.separation_probability(rest),
            'inseparable': sorted(inseparable)}


def recording(label: Label, held_out: bool = False) -> str:
    """Return the recording of a trial as CSV."""
    drawn = scene(label.seed, label.seconds, held_out)
    volts = render(drawn.unit, drawn.manoeuvre, faults_of(label), drawn.seed)
    columns = {'time_s': stamps(drawn.unit, drawn.manoeuvre)}
    columns |= {f'{axis}_v': row for axis, row in zip(drawn.unit.axes, volts)}
    columns |= references(drawn.unit, drawn.manoeuvre, drawn.seed)
    return csv_text(columns)


def csv_text(columns: dict[str, np.ndarray]) -> str:
    """Return columns as CSV; a column has the same number of digits in each recording."""
    digits = {'shift_m': 10, 'temperature_c': 3, 'supply_v': 5}
    formats = ','.join(f'%.{digits.get(name, 7)}f' for name in columns)
    rows = np.stack(list(columns.values()), axis=1)
    return '\n'.join([','.join(columns), *(formats % tuple(row) for row in rows.tolist()), ''])


def parameter_file(label: Label) -> str:
    """Return the parameter file that the user has for the unit of a trial."""
    return simulator.parameter_file(scene(label.seed, label.seconds).unit, label.name)


def as_json(labels: list[Label]) -> str:
    """Return labels as JSON."""
    return json.dumps([asdict(label) for label in labels], indent=1) + '\n'


def from_json(text: str) -> list[Label]:
    """Read labels from JSON."""
    lists = ('effects', 'seed', 'seconds')
    rows: list[dict[str, Any]] = json.loads(text)
    return [Label(**{**row, **{name: tuple(row[name]) for name in lists}}) for row in rows]


class Drawn(NamedTuple):
    """One drawn trial."""

    label: Label  # its label
    recording: str  # text of its recording (CSV) and of its parameter file (YAML)
    parameters: str
    sim: str | None = None  # text of another simulator's force (CSV)


class Setup(NamedTuple):
    """What determines the trials of a check."""

    seed: int  # seed of all random numbers
    trials: int  # number of trials, without those at strength zero


@dataclass(frozen=True)
class CommittedLabels:
    """The content of the label file that the hash covers."""

    setup: Setup  # how the trials were drawn
    labels: list[Label]  # the label of each trial


def draw_trial(plan: Plan) -> Drawn:
    """Draw a trial: its label, its recording and its parameter file."""
    label = draw_label(plan)
    return Drawn(label, recording(label), parameter_file(label))


def commit(folder: Path, setup: Setup, plans: list[Plan], pool: Executor,
           show: Callable[[float], None], make: Callable[[Plan], Drawn] = draw_trial) -> str:
    """
    Draw trials into a folder and publish the hash of their labels.

    An interrupted call continues where it was.
    """
    recordings = make_folder(folder / 'recordings')
    drawn = make_folder(_drawn(folder))

    def keep(label: Label, recording: str, parameters: str, sim: str | None = None) -> None:
        for suffix, text in (('csv', recording), ('yaml', parameters), ('sim', sim)):
            if text is None:
                continue
            path = recordings / f'{label.name}.{suffix}'
            write(path, text.encode())
            # The time of writing would show how long the label took to draw.
            os.utime(path, (0, 0))
        row = {**setup._asdict(), 'label': json.loads(as_json([label]))[0]}
        write(drawn / f'{label.name}.json', json.dumps(row).encode())

    todo = [plan for plan in plans if not (drawn / f'{plan.name}.json').exists()]
    for_each(pool, make, [partial(_arguments, plan) for plan in todo], keep, show,
             len(plans) - len(todo))
    rows = [_read_drawn(drawn / f'{plan.name}.json')['label'] for plan in plans]
    text = json.dumps({'salt': secrets.token_hex(16), **setup._asdict(), 'labels': rows},
                      indent=1).encode()
    digest = hashlib.sha256(text).hexdigest()
    write(_label_file(folder), text)
    write(_seal(folder), json.dumps({
        'sha256_of_salt_and_labels': digest, 'cases': len(plans), 'date': str(date.today()),
    }, indent=1).encode())
    remove_drawn(folder)
    return digest


def remove_drawn(folder: Path) -> None:
    """Remove what drawing left beside the labels, also after an interruption."""
    shutil.rmtree(_drawn(folder), ignore_errors=True)


def published_hash(folder: Path) -> str | None:
    """Return the published hash of a folder's labels; None before it is published."""
    path = _seal(folder)
    try:
        return str(json.loads(path.read_bytes())['sha256_of_salt_and_labels'])
    except FileNotFoundError:
        return None
    except (ValueError, KeyError, TypeError):
        raise UserError(f'{path}: has no hash; draw a new check into another folder') from None


def interrupted_setup(folder: Path) -> Setup | None:
    """Return seed and number of trials of an interrupted drawing; None without one."""
    for path in _drawn(folder).glob('*.json'):
        row = _read_drawn(path)
        return Setup(row['seed'], row['trials'])
    return None


def committed_labels(folder: Path) -> CommittedLabels:
    """Read the labels and compare them with the published hash."""
    digest = published_hash(folder)
    if digest is None:
        raise UserError(f'{folder}: no labels are committed there; use --seal {folder} first')
    path = _label_file(folder)
    try:
        text = path.read_bytes()
    except FileNotFoundError:
        refuse_encrypted(folder)
        raise UserError(f'{path}: no such file; copy it from where the check was drawn') from None
    if hashlib.sha256(text).hexdigest() != digest:
        raise UserError(f'{path}: these are not the labels whose hash {digest} was published; '
                        'they were changed since')
    try:
        content: dict[str, Any] = json.loads(text)
        return CommittedLabels(Setup(content['seed'], content['trials']),
                               from_json(json.dumps(content['labels'])))
    except (ValueError, KeyError, TypeError):
        raise _other_form(path) from None


def refuse_encrypted(folder: Path) -> None:
    """Refuse a folder whose labels an older version encrypted."""
    older = _label_file(folder).with_name('labels.sealed')
    if older.exists() and not _label_file(folder).exists():
        raise UserError(f'{older}: an older version encrypted these labels, which this version '
                        'cannot read; draw a new check into another folder')


def _read_drawn(path: Path) -> dict[str, Any]:
    try:
        row = json.loads(path.read_bytes())
        from_json(json.dumps([row['label']]))
        return {'seed': int(row['seed']), 'trials': int(row['trials']), 'label': row['label']}
    except (ValueError, KeyError, TypeError):
        raise _other_form(path) from None


def _other_form(path: Path) -> UserError:
    return UserError(f'{path}: is damaged or of another version; draw a new check into another '
                     'folder')


def _drawn(folder: Path) -> Path:
    return folder / 'labels' / 'drawn'


def _label_file(folder: Path) -> Path:
    return folder / 'labels' / 'labels.json'


def _seal(folder: Path) -> Path:
    return folder / 'seal.json'


def _arguments(plan: Plan) -> tuple[Plan]:
    return (plan,)
