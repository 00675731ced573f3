# SPDX-License-Identifier: Apache-2.0

"""
Minutes to a verdict over sealed units: chosen manoeuvres, random ones, and the fixed rich one.

    make investigate                                 60 units, about two hours on one core
    make investigate ARGS='--units 5 --seed 100'     other units
    make investigate ARGS='--beyond -o beyond.jsonl' faults that the library does not have

The units are drawn from the seed before anything is recorded. All strategies have the same units,
limits, diagnosis and stop rule; they differ only in what is recorded next.
"""

from __future__ import annotations

import argparse
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
import json
from pathlib import Path
import time

from adxl_ros.diagnose.verdict import UNKNOWN
from adxl_ros.files import parameter_file
from adxl_ros.files.recording_columns import Recording
from adxl_ros.investigate.investigation import Question, RoundOutcome, run_round
from adxl_ros.investigate.manoeuvres import plan, plan_all, Pose, StageLimits
from adxl_ros.model.effects import effect_named, library
from adxl_ros.model.effects.base import Effect, Place
from adxl_ros.model.sensor import fitted_of, parameter_of, put, with_neutral
from adxl_ros.simulate.motion import Motion
from adxl_ros.simulate.response import simulate
from adxl_ros.simulate.trajectories import rich
import numpy as np

LIMITS = StageLimits((-np.radians(120), np.pi), (0.0, 2 * np.pi), np.radians(60))
"""Limits of the stage: those that the rich manoeuvre needs."""
LONGEST_MINUTES = 12.0
"""Largest time of all manoeuvres together, min."""
ROUND_S = 10.0
"""Rest of the stage during a diagnosis, s: its time on an idle core."""
RICH_BEGIN_S = 30.0
"""Time of the first diagnosis of the rich manoeuvre, s: no shorter recording has a verdict."""
RICH_STEP_S = 15.0
"""Time between two diagnoses of the rich manoeuvre, s; it does not wait for them."""
RATE_HZ = 200.0
"""Sample rate, Hz."""
EFFECTS = (
    'backlash',
    'base_tilt',
    'bias',
    'clock_skew',
    'cross_axis',
    'gravity',
    'hysteresis',
    'lever_arm',
    'misalignment',
    'nonlinearity',
    'quadratic',
    'scale_factor',
    'scale_factor_cross',
    'stage_eccentricity',
    'stage_offset',
    'time_offset',
    'vibration_rectification',
    'warm_up',
)
"""Effects that a stage at rest or in motion excites."""
COUNTS = (0.15, 0.6, 0.25)
"""Probabilities of no, one and two effects."""
UNLISTED = (
    lambda signals, d: np.sin(2 * np.pi * signals.environment.time_s / 15.0),
    lambda signals, d: np.sin(2 * np.pi * signals.sensed[d] / 0.3),
    lambda signals, d: np.tanh(5 * np.hypot(signals.alpha.velocity, signals.beta.velocity)),
    lambda signals, d: np.sin(3 * np.asarray(signals.beta.position) + 1.0),
)
"""Laws of each axis that the library does not have."""
UNLISTED_G = (2e-3, 1e-2)
"""Range of their sizes, g; they are log-uniform."""
SIZES = (2.0, 10.0)
"""Range of the sizes of an effect, in typical values; they are log-uniform."""
STRATEGIES = ('chosen', 'random', 'rich')
"""All strategies."""


class Joined:
    """A path that consists of the paths of several manoeuvres."""

    def __init__(self, begins_s, paths):
        self._begins_s, self._paths = np.array(begins_s), paths

    def __call__(self, time_s, order=0):
        values = np.empty(len(time_s))
        parts = np.clip(np.searchsorted(self._begins_s, time_s, 'right') - 1, 0, None)
        for part in np.unique(parts):
            values[parts == part] = self._paths[part](time_s[parts == part], order)
        return values


@dataclass(frozen=True)
class Unit:
    """A sealed unit: its seed, its withheld effects and faults, and its sensor."""

    seed: int
    effects: tuple
    sensor: object
    faults: tuple = ()


def drawn_unit(seed, base, is_beyond=False):
    """Draw a unit with withheld effects, or with a fault that the library does not have."""
    rng = np.random.default_rng([seed, 1])
    count = rng.choice(len(COUNTS), p=COUNTS)
    if is_beyond:
        law = UNLISTED[rng.integers(len(UNLISTED))]
        sizes = np.exp(rng.uniform(*np.log(UNLISTED_G), len(base.axes)))
        return Unit(seed, (UNKNOWN,), base, ((law, sizes),))
    effects = tuple(sorted(map(str, rng.choice(EFFECTS, count, replace=False))))
    sensor = with_neutral(base, effects)
    for effect in effects:
        names = fitted_of(effect_named(effect), base.axes)
        values = []
        for p in map(parameter_of, names):
            if p.is_size:
                size = p.scale * np.exp(rng.uniform(*np.log(SIZES)))
                value = size * (1 if p.lower == p.neutral else rng.choice([-1, 1]))
            else:
                starts = p.starts or (p.scale,)
                value = np.exp(rng.uniform(*np.log([min(starts), max(starts)])))
            values.append(np.clip(value, p.lower, p.upper))
        sensor = put(sensor, names, np.array(values))
    return Unit(seed, effects, sensor)


class Bench:
    """One unit on a simulated stage, and what was recorded there."""

    def __init__(self, unit, base):
        self.unit, self.base = unit, base
        self.pose, self.now_s = Pose(0.0, 0.0), 0.0
        self._manoeuvres = []

    def record(self, manoeuvre, rest_s=0.0):
        """Append a manoeuvre that begins now, and a rest."""
        self._manoeuvres.append(manoeuvre)
        self.now_s = manoeuvre.begin_s + manoeuvre.motion.duration_s + rest_s
        self.pose = manoeuvre.end

    def recording(self):
        """Return all samples so far."""
        begins_s = [m.begin_s for m in self._manoeuvres]
        return sampled(
            self.unit,
            Motion(
                self.now_s,
                Joined(begins_s, [m.motion.alpha for m in self._manoeuvres]),
                Joined(begins_s, [m.motion.beta for m in self._manoeuvres]),
            ),
        )


@contextmanager
def in_library(faults):
    """Add faults to the library of this process for a while, so that the simulator runs them."""

    def effect(name, law, sizes):
        def act(signals, parameters):
            for d, size in enumerate(sizes):
                signals.output[d] = signals.output[d] + size * law(signals, d)

        return Effect(name, Place.ELEMENT, (), act, '')

    added = {f'fault_{i}': effect(f'fault_{i}', *fault) for i, fault in enumerate(faults)}
    library().update(added)
    try:
        yield tuple(added)
    finally:
        for name in added:
            del library()[name]


def sampled(unit, motion):
    """Return the recording of a unit."""
    with in_library(unit.faults) as names:
        sensor = replace(
            unit.sensor,
            effects=(*unit.sensor.effects, *names),
            values={**unit.sensor.values, **{name: {} for name in names}},
        )
        columns = simulate(sensor, motion, unit.seed)
    return Recording(f'unit {unit.seed}', columns.pop('time_s'), columns)


@cache
def first_answer():
    """Return the answer before the first sample, which is the same for all units."""
    base = nominal_sensor()
    return run_round(Question(Pose(0.0, 0.0), 0.0, LONGEST_MINUTES, False), [], base, LIMITS)[0]


def nominal_sensor():
    return replace(parameter_file.load(parameter_file.nominal_path()), rate_hz=RATE_HZ)


def investigated(unit, base, is_random):
    """Return the last answer, and the minutes that were recorded."""
    bench, rng = Bench(unit, base), np.random.default_rng([unit.seed, 2])
    moved_s, has_samples, recorded, verdict = 0.0, False, (), ''
    while True:
        question = Question(
            bench.pose,
            bench.now_s / 60,
            LONGEST_MINUTES - moved_s / 60,
            has_samples,
            recorded,
            verdict,
        )
        answer = (
            run_round(question, [bench.recording()], base, LIMITS)[0]
            if has_samples
            else first_answer()
        )
        if answer.outcome is not RoundOutcome.GO_ON:
            return answer, bench.now_s / 60
        name = answer.manoeuvre
        if is_random:
            fitting = [
                m.name
                for m in plan_all(LIMITS, bench.pose)
                if m.minutes <= question.remaining_minutes
            ]
            name = str(rng.choice(fitting))
        manoeuvre = plan(name, LIMITS, bench.pose, bench.now_s)
        moved_s += manoeuvre.motion.duration_s
        bench.record(manoeuvre, ROUND_S)
        has_samples, recorded, verdict = True, (*recorded, name), answer.verdict


def recorded_richly(unit, base):
    """Return the first answer that ends the fixed manoeuvre, and the minutes up to it."""
    full = rich(np.random.default_rng(0))
    end_s = RICH_BEGIN_S
    while True:
        end_s = min(end_s, full.duration_s)
        motion = Motion(end_s, full.alpha, full.beta)
        pose = LIMITS.nearest(*(float(p(np.array([end_s]))[0]) for p in (full.alpha, full.beta)))
        remaining_minutes = LONGEST_MINUTES if end_s < full.duration_s else 0.0
        answer, _ = run_round(
            Question(pose, end_s / 60, remaining_minutes, True),
            [sampled(unit, motion)],
            base,
            LIMITS,
        )
        if answer.outcome is not RoundOutcome.GO_ON:
            return answer, end_s / 60
        end_s += RICH_STEP_S


def row_of(unit, base, strategy):
    """Return the result of a strategy on a unit, as values of JSON."""
    begin_s = time.process_time()
    answer, minutes = (
        recorded_richly(unit, base)
        if strategy == 'rich'
        else investigated(unit, base, strategy == 'random')
    )
    best = answer.hypotheses[0]
    return {
        'seed': unit.seed,
        'strategy': strategy,
        'effects': unit.effects,
        'faults': [UNLISTED.index(law) for law, _ in unit.faults],
        'minutes': round(minutes, 2),
        'outcome': answer.outcome.value,
        'best': best.effects,
        'probability': round(best.probability, 4),
        'is_right': set(best.effects) == set(unit.effects)
        or (UNKNOWN in best.effects and bool(unit.faults)),
        'cpu_s': round(time.process_time() - begin_s, 1),
    }


def table(rows):
    """Return the lines of the table of docs/measurements/investigate.md."""
    lines = [
        '| strategy | units | with a verdict | wrong | median minutes | mean minutes |',
        '|---|---|---|---|---|---|',
    ]
    for strategy in STRATEGIES:
        results = [r for r in rows if r['strategy'] == strategy]
        ended = [r for r in results if r['outcome'] in ('certain', 'no_visible_gap')]
        wrong = sum(not r['is_right'] for r in ended)
        minutes = [r['minutes'] if r in ended else np.inf for r in results]
        if results:
            lines.append(
                f'| {strategy} | {len(results)} | {len(ended)} | {wrong} | '
                f'{np.median(minutes):.1f} | '
                f'{np.mean([r["minutes"] for r in results]):.1f} |'
            )
    return lines


def main():
    parse = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parse.add_argument('--units', type=int, default=60, help='number of units (default 60)')
    parse.add_argument('--seed', type=int, default=0, help='seed of the first unit (default 0)')
    parse.add_argument('--strategy', choices=STRATEGIES, action='append', help='default: all')
    parse.add_argument(
        '--beyond', action='store_true', help='units with a fault that the library does not have'
    )
    parse.add_argument(
        '-o',
        dest='output',
        type=Path,
        default=Path('investigate_units.jsonl'),
        help='a line of JSON for each run; runs that it has are not repeated',
    )
    options = parse.parse_args()
    base = nominal_sensor()
    units = [drawn_unit(options.seed + i, base, options.beyond) for i in range(options.units)]
    rows = (
        [json.loads(line) for line in options.output.read_text().splitlines()]
        if options.output.exists()
        else []
    )
    done = {(row['seed'], row['strategy']) for row in rows}
    with open(options.output, 'a', encoding='utf-8') as file:
        for unit in units:
            for strategy in options.strategy or STRATEGIES:
                if (unit.seed, strategy) not in done:
                    rows.append(row_of(unit, base, strategy))
                    file.write(json.dumps(rows[-1]) + '\n')
                    file.flush()
    print('\n'.join(table(rows)))


if __name__ == '__main__':
    main()
