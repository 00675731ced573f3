# SPDX-License-Identifier: Apache-2.0
"""
Working cases: draw recordings with known causes, diagnose them, and score the verdicts.

    make working ARGS='--count 40 --seed 7'         one line as each case ends, then the scores
    make working ARGS='--count 20 --only single'    one group only

A case that has been looked at is a development case: draw a fresh seed for a score that counts.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from functools import partial
from itertools import chain
import json
import math
from operator import attrgetter
from pathlib import Path
import sys
from typing import Any, NamedTuple

from adxl_ros.tools import command_line as cli
from adxl_ros.workers import open_pool
from adxl_ros_validation import working_world as world
from adxl_ros_validation.blind import diagnosis_runs, grading, scores, simulator, trials
from adxl_ros_validation.blind.grading import Answer
from adxl_ros_validation.blind.ideal_observer import (
    alone,
    beyond_calibration,
    Bracket,
    IdealObserver,
    line,
    rms,
    Told,
    told_apart,
)
from adxl_ros_validation.blind.report import reliability, terminal_table
from adxl_ros_validation.blind.simulator import Fault, G0, Scene
from adxl_ros_validation.blind.trials import Label
from adxl_ros_validation.kept_results import for_each, write
from adxl_ros_validation.library_forms import library_forms, library_rivals
import numpy as np

GROUPS = ('null', 'single', 'pair', 'outside')
_SHARES = (0.2, 0.4, 0.2, 0.2)
"""Shares of the groups."""
_STRENGTHS_MG = (0.5, 8.0)
"""Lowest and highest strength, mg rms beyond zero-g and scale factor; log-uniform."""
_DIGITS = {**simulator.DIGITS, 'shift_m': 8}
"""Digits of the columns of a recording."""
_NOTICED = 1.05
"""Ratio of true and stated noise from which a verdict may name the noise, too."""
_HARM = 0.01
"""Smallest harm, as a share of the mean square before."""
ONLY = 'only'
"""Value of `--limit` that leaves the diagnosis out."""


class Case(NamedTuple):
    """A drawn case."""

    label: Label
    scene: Scene
    faults: list[Fault]
    recording: str
    parameters: str


class Limits(NamedTuple):
    """What an ideal observer could have said of a case."""

    by_world: Told  # by the forms of this world
    by_library: Told  # by those of the library, of which filter and latency are free, too


def draw(seed: int, number: int, only: str | None = None) -> Case:
    """Draw a case; singles take the kinds in turn."""
    rng = np.random.default_rng([7_000_001, seed, number])
    group = only or str(rng.choice(GROUPS, p=_SHARES))
    names = _drawn_names(rng, group, seed, number)
    kinds = [world.KINDS[name] for name in names]
    unit = world.draw_unit(rng)
    moves = world.draw_motion(rng, unit, {kind.needs for kind in kinds if kind.needs})
    scene = Scene(unit, moves, int(rng.integers(2**31)))
    force = scene.force()
    noise_g = float(np.mean(unit.noise_g_per_rthz)) * math.sqrt(
        min(unit.corner_hz * math.pi / 2, unit.rate_hz / 2)
    )
    # 3 to 12 % of the noise are coloured.
    background = Fault(
        world.COLOUR, noise_g * rng.uniform(0.03, 0.12), world.COLOUR.draw(rng, unit)
    )
    faults, rows, at_rest = [], [], []
    for kind in kinds:
        fault, strength, _, change = trials.sized(
            rng, kind, unit, _STRENGTHS_MG, partial(trials.measured, scene, force), 1e-3 * G0
        )
        # Half of the faults that show at rest were there when the unit was calibrated.
        calibrated = kind.at_rest and bool(rng.random() < 0.5)
        stated = unit
        if calibrated:
            left = _strength(unit, world.recalibrated(unit, [fault]), change, force)
            fault = replace(
                fault, size=min(fault.size * min(strength / max(left, 1e-9), 5.0), kind.largest)
            )
            change = scene.response([fault], coarse=True)
            stated = world.recalibrated(unit, [fault])
            at_rest.append(fault)
        faults.append(fault)
        rows.append(
            {
                **trials.described(fault, _strength(unit, stated, change, force)),
                'calibrated': calibrated,
            }
        )
    if at_rest:
        scene = replace(scene, unit=world.recalibrated(unit, at_rest))
    label = Label(
        f'w{seed}_{number:04d}',
        {'null': 'none'}.get(group, group),
        tuple(names),
        (seed, number),
        (moves.seconds, moves.seconds),
        moves.kind,
        unit.axes,
        noise_g * G0,
        rows,
    )
    acting = [background, *faults]
    return Case(
        label,
        scene,
        acting,
        scene.recording(acting, _DIGITS),
        simulator.parameter_file(scene.unit, label.name),
    )


def _drawn_names(rng: np.random.Generator, group: str, seed: int, number: int) -> list[str]:
    """Draw the effects of a case of a group; what other groups have is drawn, too."""
    turn = np.random.default_rng([7_000_001, seed, number // len(world.LISTED)]).permutation(
        world.LISTED
    )
    first = str(turn[number % len(turn)])
    unlisted = str(rng.choice(world.UNLISTED))
    second = str(rng.choice([name for name in world.LISTED if name != first]))
    by_group = {'null': [], 'single': [first], 'outside': [unlisted], 'pair': [first, second]}
    return by_group[group]


def _strength(
    unit: simulator.Unit, stated: simulator.Unit, change: np.ndarray, force: np.ndarray
) -> float:
    """Return the rms of a change, m/s², beyond what a calibration has taken up of it."""
    zero = (stated.stated_zero_v - unit.stated_zero_v) / unit.stated_scale_v_per_g
    scale = stated.stated_scale_v_per_g / unit.stated_scale_v_per_g - 1
    left = change - zero[:, None] * G0 - scale[:, None] * force
    return rms(beyond_calibration(unit, left, force))


def _harm(case: Case, fitted: str | None) -> bool:
    """Return whether another recording of the unit is simulated worse than before."""
    if not diagnosis_runs.changed(case.parameters, fitted):
        return False
    rng = np.random.default_rng([7_000_002, *case.label.seed])
    needs = {world.KINDS[name].needs for name in case.label.effects} - {''}
    scene = replace(
        case.scene,
        seed=case.scene.seed + 1,
        manoeuvre=world.draw_motion(rng, case.scene.unit, needs),
    )
    compared = diagnosis_runs.Comparison(scene, case.faults, case.parameters, fitted)
    before, after = compared.before, compared.after
    return compared.interval(after - before)[0] > _HARM * float(before.mean())


def limits(case: Case, folder: Path) -> Limits:
    """
    Return how probably an ideal observer is right about a case, whose files are in a folder.

    It knows the noise and the motion, and the forms of this world, or those of the library. What a
    calibration took up of a fault is not counted. Without a fault it tells none from those of the
    least strength that is drawn.
    """
    known = {name: world.KINDS[name] for name in world.LISTED}
    observer = IdealObserver(case.scene, known)
    library = library_forms(folder / f'{case.label.name}.csv')
    # A healthy unit has the filter and the latency of its file to a tolerance only.
    less_certain = observer.less_certain(library.tolerated.values())
    if not case.label.faults:
        least = _STRENGTHS_MG[0] * 1e-3 * G0
        by_world, by_library = (
            alone(observer, observer.forms(), least),
            alone(less_certain, {e: [*chain(*s)] for e, s in library.by_effect.items()}, least),
        )
        return Limits(Told(by_world, by_world), Told(by_library, by_library))
    faults = [fault for fault in case.faults if fault.kind is not world.COLOUR]

    def changes(coarse: bool) -> list[np.ndarray]:
        rows = zip(faults, case.label.faults)
        return [_left_by_calibration(case.scene, observer, *row, coarse) for row in rows]

    # The observer's own forms are as coarse as its changes; those of the library are exact.
    return Limits(
        told_apart(observer, faults, changes(True)),
        told_apart(less_certain, faults, changes(False), library_rivals(library, less_certain)),
    )


def _left_by_calibration(
    scene: Scene, observer: IdealObserver, fault: Fault, row: dict[str, Any], coarse: bool
) -> np.ndarray:
    """Return what a fault changes, m/s², (m, n), beyond what its calibration took up, if any."""
    change = scene.response([fault], coarse)
    return change - _straight_line(change, observer.force) if row['calibrated'] else change


def _straight_line(change: np.ndarray, force: np.ndarray) -> np.ndarray:
    """Return the zero-g and scale factor that are nearest to a change, m/s², (m, n)."""
    return np.array(
        [np.polyval(line(along, row)[::-1], along) for row, along in zip(change, force)]
    )


class Row(NamedTuple):
    """A diagnosed case."""

    label: Label
    result: dict[str, Any]
    tolerated: frozenset[str]  # effects that a verdict may name, too
    harm: bool

    @property
    def answer(self) -> Answer:
        """Return the answer without the effects that it may name, too."""
        given = grading.answer(self.result)
        certain = given.certain - self.tolerated
        if (
            given.certain
            and not certain
            and not given.groups
            and given.status in ('explained', 'partly')
        ):
            return replace(given, certain=certain, status='no_gap', limit_mps2=None)
        return replace(given, certain=certain)


class Observed(NamedTuple):
    """A case as it was diagnosed, and as an ideal observer sees it; None where nobody asked."""

    group: str
    row: Row | None
    limits: Limits | None


def observed(
    seed: int, number: int, only: str | None, folder: Path, limit: str
) -> tuple[Observed]:
    """Draw a case, keep its files, and diagnose it or find its limits as it is asked for."""
    case = draw(seed, number, only)
    place = folder / case.label.name
    trials.save(place, case.label.name, (case.recording, case.parameters))
    write(place / f'{case.label.name}.json', json.dumps(asdict(case.label), indent=1).encode())
    return (
        Observed(
            case.label.group,
            None if limit == ONLY else _diagnosed(case, place),
            limits(case, place) if limit else None,
        ),
    )


def _diagnosed(case: Case, place: Path) -> Row:
    """Diagnose a case, keep the result and measure the harm."""
    result = diagnosis_runs.diagnose(
        case.label.name, case.recording.encode(), case.parameters.encode()
    )[1]
    write(place / 'result.json', json.dumps(result).encode())
    unit = case.scene.unit
    noisy = bool(np.any(unit.noise_g_per_rthz > _NOTICED * unit.stated_noise_g_per_rthz))
    return Row(
        case.label,
        result,
        frozenset(['noise_excess'] if noisy else []) - frozenset(case.label.effects),
        _harm(case, result['parameters']),
    )


def line_of(row: Row) -> str:
    """Return truth, verdict, figures and time of a case in one line."""
    answer, label = row.answer, row.label
    report = row.result['report'] or {}
    gap = report.get('gap') or {}
    figures = ' '.join(
        f'{name} {1e3 * gap[key] / G0:.3f}'
        for name, key in (
            ('gap', 'before'),
            ('left', 'after'),
            ('floor', 'floor'),
            ('P', 'explained'),
            ('U', 'rest'),
            ('limit', 'upper_limit'),
        )
        if isinstance(gap.get(key), (int, float))
    )
    truth = (
        ' + '.join(
            f'{fault["effect"]} {1e3 * fault["strength_mps2"] / G0:.2f} mg'
            f'{" calibrated" if fault.get("calibrated") else ""}'
            for fault in label.faults
        )
        or 'nothing'
    )
    said = ', '.join(
        [
            *sorted(grading.answer(row.result).certain),
            *(f'({" | ".join(sorted(group))})' for group in answer.groups),
        ]
    )
    mark = 'ok  ' if right(row) else 'set ' if in_set(row) else 'MISS'
    return (
        f'{mark} {label.name} {label.axes:3} {label.manoeuvre:6} {truth}: {answer.status} '
        f'{answer.probability:.2f} {said or row.result["error"] or "-"}; {figures} mg; '
        f'{row.result["cpu_s"]:.1f} s{" HARM" if row.harm else ""}'
    )


def right(row: Row) -> bool:
    """Return whether a verdict is exact; one `partly` or unknown is, outside the library."""
    if row.label.group == 'outside' and row.answer.status == 'partly':
        return True
    return not row.answer.groups and grading.verdict_right(row.answer, row.label)


def in_set(row: Row) -> bool:
    """Return whether a verdict names every true effect, perhaps in groups."""
    return right(row) or any(
        effects and effects <= row.answer.named
        for effects in grading.right(row.label, row.answer.material_mps2)
    )


SCORES: dict[str, tuple[str, Callable[[Row], bool], Callable[[Told], Bracket]]] = {
    'no gap where there is none': ('none', right, attrgetter('exactly')),
    'single effect, exactly': ('single', right, attrgetter('exactly')),
    'single effect, in the named set': ('single', in_set, attrgetter('in_set')),
    'pair, exactly': ('pair', right, attrgetter('exactly')),
    'pair, in the named set': ('pair', in_set, attrgetter('in_set')),
    'outside the library: unknown or partly': ('outside', right, attrgetter('exactly')),
}
"""Scores by name: the group of cases, what is a hit, and what an ideal observer could reach."""


def table(cases: Sequence[Observed]) -> str:
    """Return the scores with Wilson's intervals, each above what could be reached."""
    lines = []
    for name, (group, hit, reached) in SCORES.items():
        of_group = [case for case in cases if case.group == group]
        hits = [hit(case.row) for case in of_group if case.row]
        if of_group:
            lines.append(f'{name:40} {scores.in_words(scores.share(hits))}' if hits else name)
        told = [case.limits for case in of_group if case.limits]
        for forms, found in zip(('world', 'library'), zip(*told)):
            low, high = 100 * np.mean([reached(each) for each in found], axis=0)
            lines.append(
                f'{f"    limit by the forms of the {forms}":40} {low:.0f} to {high:.0f} %, '
                f'n = {len(found)}'
            )
    rows = [case.row for case in cases if case.row]
    return '\n'.join([*lines, *(_further(rows) if rows else ())])


def _further(rows: Sequence[Row]) -> list[str]:
    """Return the scores of all groups, and how often verdicts of a probability hold."""
    held = [grading.limit_holds(row.answer, row.label) for row in rows]
    cells: dict[str, Sequence[bool]] = {
        'upper limit of no gap holds': [each for each in held if each is not None],
        'harm: another recording made worse': [row.harm for row in rows],
        'no verdict': [row.answer.status == 'failed' for row in rows],
        'tracebacks': [str(row.result['error']).startswith('traceback') for row in rows],
    }
    cpu = [row.result['cpu_s'] for row in rows]
    right_by_probability = scores.reliability(
        [(row.answer.probability, grading.verdict_right(row.answer, row.label)) for row in rows]
    )
    return [
        *(
            f'{name:40} {scores.in_words(scores.share(hits))}'
            for name, hits in cells.items()
            if hits
        ),
        f'{"processor time, s":40} median {np.median(cpu):.1f}, longest {max(cpu):.1f}',
        '',
        *terminal_table(*reliability(right_by_probability)),
    ]


def parser() -> argparse.ArgumentParser:
    """Describe the command line."""
    parse = cli.argument_parser(
        'working', __doc__, {'a development loop of one group': '--count 20 --seed 3 --only pair'}
    )
    parse.add_argument(
        '-o',
        dest='output',
        metavar='DIR',
        default='working_output',
        help='files of the cases (default: working_output)',
    )
    parse.add_argument('--count', type=int, default=80, help='number of cases (default 80)')
    parse.add_argument(
        '--first', type=int, default=0, metavar='N', help='number of the first case (default 0)'
    )
    parse.add_argument('--seed', type=int, default=1, help='seed of the cases (default 1)')
    parse.add_argument('--only', choices=GROUPS, help='cases of one group only')
    parse.add_argument(
        '--limit',
        choices=('beside', ONLY),
        default='',
        help='what an ideal observer could reach, beside the scores, or only that: about twice '
        'the time of a diagnosis',
    )
    parse.add_argument('--jobs', type=int, default=2, help='processes at once (default 2)')
    return parse


def working(options: argparse.Namespace) -> int:
    """Run the tool; see `parser`."""
    cli.check_least(options, count=1, jobs=1, first=0, seed=0)
    numbers = range(options.first, options.first + options.count)
    folder = Path(options.output)
    cases: list[Observed] = []

    def keep(case: Observed) -> None:
        cases.append(case)
        if case.row:
            print(line_of(case.row), flush=True)

    jobs = [
        partial(tuple, (options.seed, number, options.only, folder, options.limit))
        for number in numbers
    ]
    with open_pool(None, options.jobs) as pool:
        for_each(pool, observed, jobs, keep, lambda done: None)
    print(f'\n{table(cases)}')
    return 0


def main() -> int:
    """Run the tool on the command line."""
    return cli.run(parser(), working)


if __name__ == '__main__':
    sys.exit(main())
