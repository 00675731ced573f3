# SPDX-License-Identifier: Apache-2.0
"""
Recordings of real sensors into which this world puts a defect, or none.

The first part of a recording makes the parameters, with whatever gap that leaves. The trials are
parts of the rest. What the verdict names must be what was put in. What it names of the untouched
rest (the baseline) is there already, and no error.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
import json
import math
from pathlib import Path
import tempfile
from typing import Any, NamedTuple

from adxl_ros.errors import UserError
from adxl_ros.workers import Pool
from adxl_ros_validation.blind import diagnosis_runs, grading, scores, simulator as sim, trials
from adxl_ros_validation.blind.faults import KINDS, KNOWN
from adxl_ros_validation.blind.grading import Answer, UNKNOWN
from adxl_ros_validation.blind.ideal_observer import line, rms
from adxl_ros_validation.blind.report import reliability, Report, Table
from adxl_ros_validation.blind.simulator import Fault, G0, Unit
from adxl_ros_validation.blind.trials import Drawn, Label, Plan, Show
from adxl_ros_validation.kept_results import write
import numpy as np
import pandas as pd
import scipy

_NOISES = (1.0, 20.0)
"""Weakest and strongest defect, in the recording's own noise; log-uniform."""
_FIRST = 0.4
"""Share of a recording that makes the parameters."""
_PART = 0.9
"""Share of the rest that a trial has."""
_SHORTEST_S = 59.0
"""Shortest recording that takes part, s."""
_ZERO_V = 2.5
"""Zero-g of the volts in which defects act, V; their scale factor is 1 V/g."""
_MOTION_HZ = 8.0
"""Corner of the low-pass that separates the motion from the noise, Hz."""


@dataclass(frozen=True)
class Half:
    """A part of a recording, with the parameters that an earlier part made."""

    name: str
    reference: str  # 'simulator', 'stage' or 'rests'
    columns: pd.DataFrame
    sim: pd.DataFrame | None  # the force by another simulator
    digits: dict[str, int]  # digits after the point of each column
    parameters: str = ''
    noise_mps2: float = 0.0  # rms of the noise of one sample

    @property
    def samples(self) -> dict[str, tuple[float, float]]:
        """Return the columns of samples, each with the value at 0 g and the step of 1 g."""
        return {
            name: scale
            for d in 'xyz'
            for name, scale in ((f'a{d}_mps2', (0.0, G0)), (f'{d}_v', (_ZERO_V, 1.0)))
            if name in self.columns
        }

    @property
    def axes(self) -> str:
        """Return the measured axes."""
        return ''.join(name.lstrip('a')[0] for name in self.samples)

    def g(self) -> np.ndarray:
        """Return the samples, g, (m, n); volts by 2.5 V and 1 V/g."""
        return np.stack(
            [
                (self.columns[name].to_numpy() - zero) / step
                for name, (zero, step) in self.samples.items()
            ]
        )

    @property
    def known(self) -> np.ndarray:
        """Return where the reference is known, (n,)."""
        if self.reference != 'rests':
            return np.ones(len(self.columns), bool)
        return self.columns['alpha_rad'].notna().to_numpy()

    def texts(self) -> tuple[str, str, str | None]:
        """Return recording, parameters and another simulator's force as texts of files."""
        return (
            sim.csv_text(dict(self.columns), self.digits),
            self.parameters,
            None if self.sim is None else sim.csv_text(dict(self.sim), self.digits),
        )

    def unit(self) -> Unit:
        """Return a unit of 2.5 V and 1 V/g with the axes of the recording."""
        one = np.ones(len(self.axes))
        rate_hz = 1 / float(self.columns['time_s'].diff().median())
        return Unit(
            self.axes,
            _ZERO_V * one,
            one,
            _ZERO_V * one,
            one,
            one,
            one,
            math.inf,
            one,
            one,
            0.0,
            np.zeros(6),
            rate_hz,
        )

    def kinds(self) -> list[str]:
        """Return the defects that can be put into its samples and shown by its reference."""
        is_still = np.std(self.g(), axis=1).max() < 0.05
        has = {
            '': True,
            'chain': False,
            'force': not is_still,
            'heat': np.ptp(self.columns.get('temperature_c', np.zeros(1))) > 3,
            'motion': not is_still and self.reference != 'rests',
        }
        return [
            name
            for name, kind in KINDS.items()
            if has[kind.needs]
            and (kind.needs == 'motion' or kind.place not in (sim.Place.STAGE, sim.Place.MOUNT))
        ]


def prepare(folder: Path) -> tuple[list[Half], list[str]]:
    """Return the later parts of the recordings of a folder, and why others are left out."""
    if not folder.is_dir():
        raise UserError(f'{folder}: no such folder')
    halves, left_out = [], []
    for path in sorted(folder.glob('*.csv')):
        if path.match('*_sim.csv'):
            continue
        try:
            halves.append(later_part(path))
        except UserError as error:
            left_out.append(f'{path.name}: {error}')
    if not halves:
        raise UserError(f'{folder}: no recording can be used: {"; ".join(left_out) or "no CSV"}')
    return halves, left_out


def _read(path: Path) -> tuple[pd.DataFrame, dict[str, int]]:
    """Read the columns of a CSV file, and their digits after the point."""
    try:
        cells = pd.read_csv(path, comment='#', dtype=str, keep_default_na=False)
        columns = cells.replace('', 'nan').astype(float)
    except ValueError as error:
        raise UserError(f'is no recording of this project: {error}') from None
    if 'time_s' not in columns:
        raise UserError('is no recording of this project: its first line names no time_s')
    return columns, {
        name: int(cells[name][:200].str.partition('.')[2].str.len().max()) for name in cells
    }


def _part(columns: pd.DataFrame | None, start: float, stop: float) -> pd.DataFrame | None:
    """Return the rows of a time span, whose time begins at 0."""
    if columns is None:
        return None
    part = columns[columns['time_s'].between(start, stop, 'left')].reset_index(drop=True)
    return part.assign(time_s=part['time_s'] - start)


def later_part(path: Path) -> Half:
    """
    Make the parameters of the first part of a recording, and the reference of the later one.

    NAME_sim.csv beside it is another simulator's force.
    """
    columns, digits = _read(path)
    sim_path = path.with_name(path.stem.removesuffix('_real') + '_sim.csv')
    force = _read(sim_path)[0] if sim_path.exists() else None
    begin, end = columns['time_s'].iloc[[0, -1]]
    if end - begin < _SHORTEST_S:
        raise UserError(f'has {end - begin:.0f} s; at least {_SHORTEST_S:.0f} s are needed')
    cut = begin + _FIRST * (end - begin)
    kind = 'simulator' if force is not None else 'stage' if 'alpha_rad' in columns else 'rests'
    first, second = (
        Half(path.stem, kind, _part(columns, *span), _part(force, *span), digits)
        for span in ((begin, cut), (cut, math.inf))
    )
    second = replace(second, noise_mps2=_noise(second))
    if force is not None:
        return replace(second, parameters=_against_force(first))
    with tempfile.TemporaryDirectory(prefix='half_') as temporary:
        folder = Path(temporary)
        for name, half in (('first', first), ('second', second)):
            (folder / f'{name}.csv').write_text(half.texts()[0])
        second = replace(second, parameters=_fitted(folder, 'temperature_c' in columns))
        if kind == 'rests':
            status, error = diagnosis_runs.call(
                folder, 'apply', 'second.csv', '--params', 'unit.yaml', '-o', 'force.csv'
            )
            if status:
                raise UserError(error)
            angles = _angles_at_rest(_read(folder / 'force.csv')[0], second.unit().rate_hz)
            second = replace(
                second,
                columns=second.columns.assign(**angles),
                digits=digits | dict.fromkeys(angles, 7),
            )
    return second


def _fitted(folder: Path, warm: bool) -> str:
    """Return the parameters that `fit` makes of the first part."""
    error = ''
    for words in ([], ['--effect', 'temperature_bias']) if warm else ([],):
        status, error = diagnosis_runs.call(
            folder, 'fit', 'first.csv', *words, '--store', '', '-o', 'unit.yaml'
        )
        if not status:
            return (folder / 'unit.yaml').read_text()
    raise UserError(f'its first part makes no parameters: {error}')


def _against_force(first: Half) -> str:
    """Return zero-g and scale factor by least squares over another simulator's force."""
    assert first.sim is not None
    zero, scale = np.transpose(
        [
            line(
                np.interp(first.columns['time_s'], first.sim['time_s'], first.sim[f'a{d}_mps2'])
                / G0,
                row,
            )
            for d, row in zip(first.axes, first.g())
        ]
    )
    unit = first.unit()
    density = np.full(len(first.axes), _noise(first) / G0 / math.sqrt(unit.rate_hz / 2))
    return sim.parameter_file(
        replace(
            unit,
            stated_zero_v=zero,
            stated_scale_v_per_g=scale,
            stated_noise_g_per_rthz=density,
            resolution_rad=1e-3,
        ),
        'unit',
        nominal_zero_v=0.0,
        is_certain=True,
        adc_bits=0,
        adc_vref_v=100.0,
        range_g=16.0,
    )


def _angles_at_rest(applied: pd.DataFrame, rate: float) -> pd.DataFrame:
    """
    Return the angles that a stage with these rests would have; they are empty in motion.

    They are those of the mean force of each rest of 1.5 s and more. So the noise and the error of
    the magnitude of gravity are real, and the direction is known, as from a table that was indexed
    by hand.
    """
    force = applied[['ax_mps2', 'ay_mps2', 'az_mps2']].to_numpy().T
    width = max(int(0.5 * rate), 3)
    spread = np.sqrt(
        np.maximum(
            scipy.ndimage.uniform_filter1d(force**2, width)
            - scipy.ndimage.uniform_filter1d(force, width) ** 2,
            0,
        )
    ).max(0)
    still = spread < 2 * np.quantile(spread, 0.2)
    angles = pd.DataFrame(np.nan, applied.index, ['alpha_rad', 'beta_rad'])
    span = np.cumsum(np.diff(still, prepend=False))
    for _, part in applied[still].groupby(span[still]):
        if len(part) >= 1.5 * rate:
            x, y, z = force[:, part.index].mean(axis=1)
            angles.loc[part.index] = math.atan2(math.hypot(x, y), z), math.atan2(-y, x)
    if angles.isna().all(axis=None):
        raise UserError('its later part has no rest, no stage and no other simulator')
    return angles


def _noise(half: Half) -> float:
    """Return the rms of the noise of one sample, of all axes, in the quietest tenth, m/s²."""
    rows = np.diff(half.g(), axis=1) / math.sqrt(2)
    blocks = np.array_split(rows, max(rows.shape[1] // 50, 4), axis=1)
    quiet = np.quantile([np.mean(block**2, axis=1) for block in blocks], 0.1, axis=0)
    return float(np.sqrt(np.mean(quiet)) * G0)


class PlanRule(NamedTuple):
    """How trials on recordings are planned."""

    shares: Mapping[str, float]  # Share of each group; 'pair' puts in two defects, 'none' none
    stream: int  # Part of the seed that is this rule's; the trials have the next one
    letter: str  # First letter of the names of trials


REAL_TRIALS = PlanRule({'none': 0.25, 'outside': 0.2, 'single': 0.55}, 3, 'r')


def plans(
    halves: Sequence[Half], seed: int, count: int, rule: PlanRule = REAL_TRIALS
) -> list[Plan]:
    """Plan trials: recordings in turn, and of the defects those that were drawn least."""
    rng = np.random.default_rng([seed, rule.stream])
    rows: list[tuple[str, tuple[str, ...], tuple[int, ...]]] = []
    used: Counter[str] = Counter()
    for k in range(count):
        half = k % len(halves)
        group = str(rng.choice(list(rule.shares), p=list(rule.shares.values())))
        kinds = [name for name in halves[half].kinds() if (name in KNOWN) is (group != 'outside')]
        effects: list[str] = []
        for _ in range({'none': 0, 'pair': 2}.get(group, 1)):
            others = [name for name in kinds if name not in effects]
            fewest = min((used[name] for name in others), default=0)
            rarest = [name for name in others if used[name] == fewest]
            effects += [str(rng.choice(rarest))] if rarest else []
        used.update(effects)
        trial_seed = (seed, rule.stream + 1, k, half)
        rows.append((group if effects else 'none', tuple(effects), trial_seed))
    return [Plan(f'{rule.letter}{i:04d}', *rows[k]) for i, k in enumerate(rng.permutation(count))]


def draw(halves: Sequence[Half], plan: Plan) -> Drawn:
    """Cut a part of a later part and put the defect of a plan into it."""
    half, rng = halves[plan.seed[-1]], np.random.default_rng([*plan.seed, 0])
    half = trial_part(half, rng)
    faults = []
    for name in plan.effects:
        fault, _, strength, changed = trials.sized(
            rng,
            KINDS[name],
            half.unit(),
            _NOISES,
            partial(_with_fault, half, plan.seed),
            half.noise_mps2,
        )
        faults.append(trials.described(fault, strength))
        half = with_samples(half, changed)
    return Drawn(
        Label(
            **asdict(plan),
            manoeuvre=f'{half.name} by {half.reference}',
            axes=half.axes,
            floor_mps2=half.noise_mps2,
            faults=faults,
        ),
        *half.texts(),
    )


def trial_part(half: Half, rng: np.random.Generator) -> Half:
    """Draw the part of a later part that a trial has."""
    end = float(half.columns['time_s'].iloc[-1])
    start = float(rng.uniform(0, (1 - _PART) * end))
    columns, force = (
        _part(whole, start, start + _PART * end) for whole in (half.columns, half.sim)
    )
    return replace(half, columns=columns, sim=force)


def with_samples(half: Half, samples_g: np.ndarray) -> Half:
    """Return a part with other samples, g, (m, n)."""
    columns = {
        name: step * row + zero
        for (name, (zero, step)), row in zip(half.samples.items(), samples_g)
    }
    return replace(half, columns=half.columns.assign(**columns))


def acted_on(half: Half, seed: tuple[int, ...], fault: Fault) -> np.ndarray:
    """Let a fault act on recorded samples; return samples, g, (m, n)."""
    unit, before = half.unit(), half.g()
    # The force without its noise; an axis that is not measured has 0.
    force = np.zeros((3, len(half.columns)))
    force[unit.axis_indices] = (
        before * G0
        if unit.rate_hz <= 3 * _MOTION_HZ
        else scipy.signal.sosfiltfilt(
            scipy.signal.butter(2, _MOTION_HZ, fs=unit.rate_hz, output='sos'), before * G0, axis=1
        )
    )
    t = np.arange(before.shape[1]) / unit.rate_hz
    still = np.zeros_like(t)
    warm = np.asarray(half.columns.get('temperature_c', still + 25.0))
    run = sim.Run(
        unit,
        t,
        trials.integer_seed(*seed),
        still,
        still,
        still,
        warm,
        still + 5.0,
        corner_hz=math.inf,
        force=force,
    )
    run.u = run.force[unit.axis_indices] / G0
    run.volts = before + _ZERO_V
    sensed = run.u.copy()
    fault.kind.act(run, fault.size, fault.shape)
    run.volts = run.volts + run.u - sensed
    if run.late or run.skew:
        run.volts = np.stack([np.interp(t - run.late_s(t), t, row) for row in run.volts])
    return run.volts - _ZERO_V


def _with_fault(half: Half, seed: tuple[int, ...], fault: Fault) -> tuple[float, np.ndarray]:
    """Let a fault act on recorded samples; return its strength, m/s², and samples, g."""
    before, after = half.g(), acted_on(half, seed, fault)
    # The rms counts where the reference is known; zero-g and scale factor are free.
    rest = G0 * (after - before)[:, half.known]
    if fault.kind.name not in ('bias', 'scale_factor'):
        for row, along in zip(rest, before[:, half.known]):
            zero, scale = line(along, row)
            row -= zero + scale * along
    return rms(rest), after


def seal(folder: Path, source: Path, seed: int | None, count: int, pool: Pool, show: Show) -> str:
    """Draw the trials of a folder or manifest into a folder; return the published hash."""
    base = folder / 'baseline' / 'recordings'
    if base.exists():
        return trials.published_hash(folder)
    with show('first parts'):
        halves, left_out = prepare(source)
    digest = trials.seal(
        folder, partial(plans, halves), partial(draw, halves), seed, count, pool, show
    )
    write(folder / 'left_out.json', json.dumps(left_out).encode())
    for half in halves:
        trials.save(base, half.name, half.texts())
    return digest


def right(answer: Answer, base: Answer, label: Label) -> tuple[bool, bool]:
    """
    Return whether a verdict is exactly right, and whether its named set has the truth.

    What the verdict of the untouched part names, too, is no error. A defect that is not material
    may be missing; one outside the library is right as unknown or partly.
    """
    if answer.status in ('failed', 'insufficient', 'bad_data'):
        return False, False
    truth, new = grading.truth(label), answer.certain - base.named
    groups = [group for group in answer.groups if not group & base.named]
    if not new and not groups and not grading.material(answer, label):
        return True, True
    if label.group == 'outside':
        found = certain = answer.status == 'partly' or UNKNOWN in answer.named
    else:
        found, certain = truth <= answer.named, truth <= answer.certain
    return certain and not new - truth and not groups, found


def score(folder: Path, pool: Pool, show: Show) -> dict[str, Any]:
    """Diagnose what has no report yet, compare labels with the hash, and score."""
    with show('untouched') as advance:
        untouched = diagnosis_runs.diagnose_all(folder / 'baseline', pool, advance)
    check, labels, results = diagnosis_runs.diagnosed(folder, pool, show)
    base = {name: grading.answer(result) for name, result in untouched.items()}
    rows = []
    for label in labels:
        answer = grading.answer(results[label.name])
        source = label.manoeuvre.split(' by ')[0]
        exact, found = right(answer, base[source], label)
        # How often the verdict is right by the labels of other trials of its recording
        by_chance = [
            right(answer, base[source], other)[0]
            for other in labels
            if other.manoeuvre == label.manoeuvre and other is not label
        ]
        rows.append(
            {
                'name': label.name,
                'recording': label.manoeuvre,
                'group': label.group,
                'effects': list(label.effects),
                'exact': exact,
                'in_set': found,
                'noises': max(
                    [row['strength_mps2'] / label.floor_mps2 for row in label.faults], default=0.0
                ),
                'status': answer.status,
                'named': sorted(answer.named),
                'already': sorted(base[source].named),
                'probability': answer.probability,
                'seconds': answer.seconds,
                'error': results[label.name]['error'],
                'by_chance': float(np.mean(by_chance or [False])),
            }
        )
    return {
        **check,
        'left_out': json.loads((folder / 'left_out.json').read_text()),
        'rows': rows,
        'baseline': {name: [answer.status, sorted(answer.named)] for name, answer in base.items()},
    }


def report(made: dict[str, Any]) -> Report:
    """Return the report of a check on real sensors."""
    rows = made['rows']
    groups = {
        'none': 'no defect: nothing new is named',
        'single': 'a defect of the library',
        'outside': 'a defect outside it: unknown or partly',
    }

    def parts(names: Sequence[str]) -> Table:
        """Return the shares of rows by a name of each row; rows without a name do not count."""
        return (
            ['trials', 'exactly right (90 % interval)', 'in the named set', 'labels permuted'],
            [
                [
                    name,
                    *(scores.in_words(scores.share(part[key])) for key in ('exact', 'in_set')),
                    f'{part["by_chance"].mean():.2f}',
                ]
                for name, part in pd.DataFrame(rows).groupby(np.array(names))
                if name
            ],
        )

    strengths = pd.cut(
        [row['noises'] for row in rows],
        [-1, 3, 8, math.inf],
        right=False,
        labels=[f'{words} times the noise' for words in ('0 to 3', '3 to 8', 'more than 8')],
    )
    return Report(
        'Blind check on real sensors',
        [
            f'{made["trials"]} trials on recordings of real sensors, seed {made["seed"]}; SHA-256 '
            f'of salt and labels {made["hash"]}; code of the diagnosis '
            f'{made["diagnose_code"][:16]}.'
        ],
        {
            'Result': parts([groups[row['group']] for row in rows]),
            'By strength': parts(
                [
                    strength if row['group'] == 'single' else ''
                    for strength, row in zip(strengths, rows)
                ]
            ),
            'By recording': parts([row['recording'] for row in rows]),
            'By defect': parts([''.join(row['effects']) for row in rows]),
            'How often verdicts of a probability are right': reliability(
                scores.reliability([(row['probability'], row['exact']) for row in rows])
            ),
            'Untouched parts': (
                ['recording', 'verdict', 'named'],
                [
                    [name, status, ', '.join(named) or '-']
                    for name, (status, named) in made['baseline'].items()
                ],
            ),
            'Left out': (['recording'], [[text] for text in made['left_out']]),
        },
    )
