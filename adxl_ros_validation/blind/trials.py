# SPDX-License-Identifier: Apache-2.0
"""
The trials of a check: what each is to be, its label and recording, and the seal of all labels.

A published hash commits to the labels. The folder of a check has the recordings, the labels, and
reports as they are made.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict, dataclass, field, replace
from datetime import date
from functools import partial
import hashlib
import itertools
import json
import math
import os
from pathlib import Path
import secrets
import shutil
from typing import Any, NamedTuple

from adxl_ros.errors import UserError
from adxl_ros.workers import Pool
from adxl_ros_validation.blind import ideal_observer, motion, simulator
from adxl_ros_validation.blind.faults import KINDS, KNOWN, UNLISTED
from adxl_ros_validation.blind.ideal_observer import IdealObserver
from adxl_ros_validation.blind.simulator import Fault, G0, Kind, Scene, Unit
from adxl_ros_validation.kept_results import for_each, write
import numpy as np

STRENGTHS_MPS2 = (0.02e-3 * G0, 15e-3 * G0)
"""Lowest and highest strength: rms of an effect beyond the stated calibration, m/s²; log-uniform.

Chosen: the lowest is out of sight.
"""
SECONDS = (90.0, 200.0)
"""Shortest and longest recording, s; chosen."""
_SHARES = (0.25, 0.2, 0.2)
"""Shares of trials without an effect, with two effects and with an unlisted fault; chosen."""
_MAX_SIZE_STEPS = 9
"""Largest number of simulations to find the size for a strength; chosen."""
_SIZE_TOLERANCE = 0.05
"""Largest error of the logarithm of the strength; chosen."""
_SLOW_NOISE = ('flicker', 'bias_walk')
"""Faults that look like noise and can be mistaken for an effect that does not."""


@dataclass(frozen=True)
class Plan:
    """What a trial is to be."""

    name: str  # neutral name of its files
    # 'none', 'zero' (an effect at strength zero), 'single', 'pair' or 'outside' the library
    group: str
    effects: tuple[str, ...]
    seed: tuple[int, ...]  # seed of all its random numbers
    seconds: tuple[float, float] = SECONDS  # shortest and longest recording, s


@dataclass(frozen=True)
class Label(Plan):
    """What is true of a trial. Its fields are the keys of the label file."""

    manoeuvre: str = ''  # kind of the manoeuvre
    axes: str = ''  # measured axes
    floor_mps2: float = 0.0  # noise floor, m/s²
    # for each effect: size, shape, strength, visibility, the ideal observer's `power` to detect
    # it, its probability to separate it from other effects (`told`), and inseparable effects
    faults: list[dict[str, Any]] = field(default_factory=list)
    flexible: float = 0.0  # power of a flexible model to detect an effect outside the library

    @property
    def true(self) -> tuple[str, ...]:
        """Return the effects that the recording has."""
        return () if self.group == 'zero' else self.effects

    def acting(self) -> list[Fault]:
        """Return the faults of the recording."""
        rows = [] if self.group == 'zero' else self.faults
        return [Fault(KINDS[row['effect']], row['size'], row['shape']) for row in rows]


class Drawn(NamedTuple):
    """One drawn trial."""

    label: Label
    recording: str  # text of its recording (CSV) and of its parameter file (YAML)
    parameters: str
    sim: str | None = None  # text of another simulator's force (CSV)


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
    rows += [
        ('pair', tuple(str(name) for name in rng.choice(KNOWN, 2, replace=False)))
        for _ in range(pairs)
    ]
    rows += [('zero', (name,)) for name in _turns(KNOWN, math.ceil(count / 12), rng)]
    order = rng.permutation(len(rows)).tolist()
    return [
        Plan(f'r{i:04d}', rows[k][0], rows[k][1], (seed, 2, k), seconds)
        for i, k in enumerate(order)
    ]


def _turns(names: tuple[str, ...], count: int, rng: np.random.Generator) -> list[str]:
    """Return each name in turn, in a new random order in each round."""
    turns = (str(name) for _ in itertools.count() for name in rng.permutation(names))
    return list(itertools.islice(turns, count))


def scene(plan: Plan, held_out: bool = False) -> Scene:
    """Return unit and manoeuvre of a trial, or of its held-out recording."""
    unit = simulator.draw_unit(np.random.default_rng([*plan.seed, 0]))
    rng = np.random.default_rng([*plan.seed, 1])
    manoeuvre = motion.draw(rng, plan.seconds, unit.rate_hz)
    if held_out:
        manoeuvre = motion.draw(rng, plan.seconds, unit.rate_hz, manoeuvre.kind)
    return Scene(unit, manoeuvre, integer_seed(*plan.seed, 2 + held_out))


def integer_seed(*seed: int) -> int:
    """Return one number for several."""
    return int(np.random.SeedSequence(seed).generate_state(1)[0])


def draw_trial(plan: Plan) -> Drawn:
    """Draw a trial: its label, its recording and its parameter file."""
    drawn = scene(plan)
    clean, noisy = (drawn.volts([], noise=noise, fine_hz=800.0) for noise in (False, True))
    noise = (noisy - clean) * drawn.unit.volts_to_mps2
    label = Label(
        **asdict(plan),
        manoeuvre=drawn.manoeuvre.kind,
        axes=drawn.unit.axes,
        floor_mps2=ideal_observer.rms(noise - noise.mean(axis=1, keepdims=True)),
    )
    if label.true:
        label = _with_faults(label, IdealObserver(drawn))
    return Drawn(
        label, drawn.recording(label.acting()), simulator.parameter_file(drawn.unit, plan.name)
    )


def _with_faults(label: Label, observer: IdealObserver) -> Label:
    """Draw the faults of a label: sizes for strengths, and what the ideal observer sees."""
    rng = np.random.default_rng([*label.seed, 9])
    rivals = observer.rivals()
    rows, flexible = [], 0.0
    for name in label.effects:
        fault, _, found, change = sized(
            rng,
            KINDS[name],
            observer.scene.unit,
            STRENGTHS_MPS2,
            partial(measured, observer.scene, observer.force),
        )
        row = _visibility(observer, rivals, fault, change)
        rows.append(
            {**described(fault, found), **row, 'strength_floors': found / label.floor_mps2}
        )
        if name in UNLISTED and row['power'] > 0.5:
            flexible = observer.flexible_power(rivals[row['rival']], observer.project(change))
    return replace(label, faults=rows, flexible=flexible)


def sized(
    rng: np.random.Generator,
    kind: Kind,
    unit: Unit,
    bounds: tuple[float, float],
    measure: Callable[[Fault], tuple[float, np.ndarray]],
    per_mps2: float = 1.0,
) -> tuple[Fault, float, float, np.ndarray]:
    """
    Draw a fault of a strength, log-uniform within bounds; it has this or its largest size.

    The bounds are in units of `per_mps2`. `measure` returns the strength of a fault, m/s², and
    what it does. Return the fault, the drawn strength, and what was measured last.
    """
    strength = per_mps2 * math.exp(rng.uniform(*np.log(bounds)))
    fault = Fault(kind, kind.start, kind.draw(rng, unit))
    previous = math.nan, math.nan
    for steps in itertools.count(1):
        rms, change = measure(fault)
        here = math.log(fault.size), math.log(max(rms, 1e-12))
        missing = math.log(strength) - here[1]
        if (
            abs(missing) < _SIZE_TOLERANCE
            or steps == _MAX_SIZE_STEPS
            or (fault.size == fault.kind.largest and rms < strength)
        ):
            break
        slope = 1.0
        if steps > 1 and here[0] != previous[0]:
            slope = (here[1] - previous[1]) / (here[0] - previous[0])
        step = missing / min(max(slope, 0.7), 30.0)
        size = fault.size * math.exp(min(max(step, -3.0), 3.0))
        previous, fault = here, replace(fault, size=min(size, fault.kind.largest))
    return fault, strength, rms, change


def measured(scene: Scene, force: np.ndarray, fault: Fault) -> tuple[float, np.ndarray]:
    """Return strength and response of a fault; `force` is along the axes, m/s², (m, n)."""
    change = scene.response([fault], coarse=True)
    return ideal_observer.rms(ideal_observer.beyond_calibration(scene.unit, change, force)), change


def described(fault: Fault, strength_mps2: float) -> dict[str, Any]:
    """Return what a label says of a fault whose visibility is not known."""
    return {
        'effect': fault.kind.name,
        'noise_like': fault.kind.random,
        'size': fault.size,
        'shape': {name: np.asarray(value).tolist() for name, value in fault.shape.items()},
        'strength_mps2': strength_mps2,
        'power': 1.0,
        'told': 1.0,
        'inseparable': [],
    }


def _visibility(
    observer: IdealObserver, rivals: dict[str, np.ndarray], fault: Fault, change: np.ndarray
) -> dict[str, Any]:
    """Return how well the ideal observer detects a fault and separates it from others."""
    kind, vector = fault.kind, observer.project(change)
    squared = float(vector @ vector)
    visibility = (
        ideal_observer.noise_visibility(observer, kind, change) if kind.random else squared
    )
    rest_of = {
        name: squared - float(np.sum((columns.T @ vector) ** 2))
        for name, columns in rivals.items()
        if name != kind.name
    }
    rival = min(rest_of, key=rest_of.__getitem__)
    power = ideal_observer.power(visibility)
    # Only slow noise can be mistaken for an effect that does not look like noise.
    separable = kind.random and kind.name not in _SLOW_NOISE
    inseparable = (
        [name for name, squares in rest_of.items() if squares < ideal_observer.INSEPARABLE_BELOW]
        if power > 0.5 and not separable
        else []
    )
    return {
        'visibility': visibility,
        'power': power,
        'rival': rival,
        'told': ideal_observer.separation_probability(visibility if separable else rest_of[rival]),
        'inseparable': sorted(inseparable),
    }


_SEAL = 'seal.json'
"""File with the published hash."""


class Setup(NamedTuple):
    """What determines the trials of a check."""

    seed: int  # seed of all random numbers
    trials: int  # number of trials, without those at strength zero


Show = Callable[[str], AbstractContextManager[Callable[[float], None]]]
"""Receives the name of a stage; gives a context with what receives the finished fraction."""


def seal(
    folder: Path,
    plan_all: Callable[[int, int], list[Plan]],
    make: Callable[[Plan], Drawn],
    seed: int | None,
    count: int,
    pool: Pool,
    show: Show,
) -> str:
    """
    Draw trials into a folder and publish the hash of their labels.

    A call on a folder that has them returns the hash; an interrupted one continues.
    """
    drawn, is_sealed = folder / 'labels' / 'drawn', (folder / _SEAL).exists()
    known = (
        committed_labels(folder)[0]
        if is_sealed
        else Setup(*json.loads((drawn / 'setup').read_bytes()))
        if (drawn / 'setup').exists()
        else None
    )
    if known is None and any(folder.glob('*')):
        raise UserError(f'{folder}: is not empty and has no check; choose another folder')
    if seed is None:
        seed = known.seed if known else secrets.randbelow(2**31)
    setup = Setup(seed, count)
    if known not in (None, setup):
        raise UserError(
            f'{folder}: has a check of another seed or number of trials; repeat the '
            'same options to continue it, or choose another folder'
        )
    if not is_sealed:
        write(drawn / 'setup', json.dumps(setup).encode())
        plans = {plan.name: plan for plan in plan_all(*setup)}
        with show('draw') as advance:
            labels = kept(
                drawn,
                sorted(plans),
                partial(_made, make),
                lambda name: (plans[name],),
                pool,
                advance,
            )
        text = json.dumps(
            {'salt': secrets.token_hex(16), **setup._asdict(), 'labels': list(labels.values())},
            indent=1,
        ).encode()
        write(folder / 'labels' / 'labels.json', text)
        write(
            folder / _SEAL,
            json.dumps(
                {
                    'sha256_of_salt_and_labels': hashlib.sha256(text).hexdigest(),
                    'cases': len(labels),
                    'date': str(date.today()),
                },
                indent=1,
            ).encode(),
        )
    shutil.rmtree(drawn, ignore_errors=True)
    return published_hash(folder)


def _made(make: Callable[[Plan], Drawn], plan: Plan) -> tuple[str, dict[str, Any], list]:
    """Make a trial; return its name, its label and the texts of its files."""
    label, *texts = make(plan)
    return label.name, asdict(label), texts


def kept(
    folder: Path,
    names: Sequence[str],
    work: Callable[..., tuple],
    job: Callable[[str], tuple],
    pool: Pool,
    show: Callable[[float], None],
) -> dict[str, Any]:
    """
    Do the work that has no result in a folder yet, and return all results by name.

    `work` returns a name, its result, and the texts of the files of a trial that was drawn.
    """

    def keep(name: str, result: Any, texts: Iterable[str | None] = ()) -> None:
        save(folder.parents[1] / 'recordings', name, texts)
        write(folder / f'{name}.json', json.dumps(result).encode())

    todo = [name for name in names if not (folder / f'{name}.json').exists()]
    for_each(pool, work, [partial(job, name) for name in todo], keep, show, len(names) - len(todo))
    return {name: json.loads((folder / f'{name}.json').read_bytes()) for name in names}


def save(folder: Path, name: str, texts: Iterable[str | None]) -> None:
    """Write recording, parameters and another simulator's force, if any, with the time 0."""
    for suffix, text in zip(('csv', 'yaml', 'sim'), texts):
        if text is not None:
            write(folder / f'{name}.{suffix}', text.encode())
            # The time of writing would show how long the label took to draw.
            os.utime(folder / f'{name}.{suffix}', (0, 0))


@contextmanager
def _explained(path: Path, missing: str) -> Iterator[None]:
    """Say in one line why a file of a check cannot be used."""
    try:
        yield
    except FileNotFoundError:
        raise UserError(f'{path}: no such file; {missing}') from None
    except (ValueError, KeyError, TypeError):
        raise UserError(
            f'{path}: is damaged or of another version; draw a new check into another folder'
        ) from None


def published_hash(folder: Path) -> str:
    """Return the published hash of a folder's labels."""
    with _explained(folder / _SEAL, f'commit labels by --seal {folder} first'):
        return str(json.loads((folder / _SEAL).read_bytes())['sha256_of_salt_and_labels'])


def committed_labels(folder: Path) -> tuple[Setup, list[Label]]:
    """Read the labels and compare them with the published hash."""
    digest, path = published_hash(folder), folder / 'labels' / 'labels.json'
    with _explained(path, 'copy it from where the check was drawn'):
        text = path.read_bytes()
        if hashlib.sha256(text).hexdigest() != digest:
            raise UserError(
                f'{path}: these are not the labels whose hash {digest} was published; '
                'they were changed since'
            )
        content: dict[str, Any] = json.loads(text)
        return Setup(content['seed'], content['trials']), [
            Label(**row | {name: tuple(row[name]) for name in ('effects', 'seed', 'seconds')})
            for row in content['labels']
        ]
