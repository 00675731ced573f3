# SPDX-License-Identifier: Apache-2.0
"""
Recordings of real sensors into which this world puts a defect, or none.

The first part of a recording makes the parameters, with whatever gap that leaves. The trials are
parts of the rest. What the verdict names must be what was put in. What it names of the untouched
rest (the baseline) is there already, and no error.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import partial
import hashlib
import json
import math
from pathlib import Path
import tempfile
from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.workers import for_each, make_folder, write
from adxl_ros_validation.blind import diagnosis_runs, grading, report_html, scores, trials
from adxl_ros_validation.blind.grading import Answer, UNKNOWN
from adxl_ros_validation.blind.trials import Drawn, Label, Plan, Setup
from adxl_ros_validation.blind.world import fault_table, ideal_observer
from adxl_ros_validation.blind.world.simulator import Fault, FaultKind, G0, Place, Run, Unit
import numpy as np
import scipy
import yaml

_SHARES = (0.25, 0.2)
"""Shares of trials without a defect, and with one outside the library."""
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
_STILL_G = 0.05
"""Largest change of the force of a sensor that rests, g rms."""
_REST_S = 1.5
"""Shortest rest, s."""
_NO_PLACE = frozenset(['cogging', 'rate_pull', 'aftermath', 'motor_current', 'magnet', 'supply',
                       'bandwidth', 'saturation', 'flicker'])
"""Defects of joints, supply and filter, which need more than samples; sensors have flicker."""
_OF_TEMPERATURE = frozenset(['temperature_bias', 'temperature_scale', 'thermal_loop'])
_OF_MOTION = frozenset(['time_offset', 'clock_skew', 'vibration_rectification', 'creep'])
_OF_FORCE = frozenset(['scale_factor', 'misalignment', 'cross_axis', 'cross_axis_z',
                       'scale_factor_cross', 'scale_factor_z', 'nonlinearity', 'quadratic',
                       'hysteresis', 'ripple', 'dead_zone', 'product', 'loose_gain',
                       'fading_gain', 'adc_inl'])
Show = Callable[[str], AbstractContextManager[Callable[[float], None]]]


@dataclass(frozen=True)
class Half:
    """A part of a recording, with the parameters that an earlier part made."""

    name: str
    reference: str  # 'simulator', 'stage' or 'rests'
    columns: dict[str, np.ndarray]
    digits: dict[str, int]  # digits after the point of each column
    parameters: str
    sim: dict[str, np.ndarray] | None
    noise_mps2: float  # rms of the noise of one sample

    @property
    def axes(self) -> str:
        """Return the measured axes."""
        return ''.join(d for d in 'xyz' if f'a{d}_mps2' in self.columns
                       or f'{d}_v' in self.columns)

    def g(self) -> np.ndarray:
        """Return the samples, g, (m, n); volts by 2.5 V and 1 V/g."""
        return np.stack([self.columns[f'a{d}_mps2'] / G0 if f'a{d}_mps2' in self.columns
                         else self.columns[f'{d}_v'] - _ZERO_V for d in self.axes])

    def kinds(self, table: Mapping[str, FaultKind]) -> list[str]:
        """Return the defects that can be put into its samples and shown by its reference."""
        warm = self.columns.get('temperature_c', np.zeros(1))
        out = set(_NO_PLACE)
        out |= set() if np.ptp(warm) > 3 else _OF_TEMPERATURE
        out |= _OF_MOTION if self.reference == 'rests' else set()
        out |= _OF_FORCE | _OF_MOTION if np.std(self.g(), axis=1).max() < _STILL_G else set()
        return [name for name, kind in table.items() if name not in out and (
            kind.place not in (Place.STAGE, Place.MOUNT) or name in _OF_MOTION)]


def prepare(source: Path) -> tuple[list[Half], list[str]]:
    """Return the later parts of recordings, and why others are left out."""
    halves, left_out = [], []
    for path, sim, digest in _sources(source):
        try:
            if not path.exists():
                raise UserError('no such file; the manifest has its address')
            if digest and hashlib.sha256(path.read_bytes()).hexdigest() != digest:
                raise UserError('is not the file whose SHA-256 the manifest has')
            halves.append(_half(path, sim))
        except UserError as error:
            left_out.append(f'{path.name}: {error}')
    if not halves:
        raise UserError(f'{source}: no recording can be used: {"; ".join(left_out) or "no CSV"}')
    return halves, left_out


def _sources(source: Path) -> list[tuple[Path, Path | None, str]]:
    """List recordings, each with another simulator's force (NAME_sim.csv), and SHA-256."""
    if not source.exists():
        raise UserError(f'{source}: no such file or folder')
    if source.is_dir():
        paths = [(path, '') for path in sorted(source.glob('*.csv'))
                 if not path.stem.endswith('_sim')]
    else:
        try:
            rows = yaml.safe_load(source.read_text(encoding='utf-8'))['recordings']
            paths = [(source.parent / row['file'], row.get('sha256', '')) for row in rows]
        except (OSError, UnicodeError, yaml.YAMLError, KeyError, TypeError) as error:
            raise UserError(f'{source}: no folder, and no manifest: {error}') from None
    out = []
    for path, digest in paths:
        sim = path.with_name(path.stem.removesuffix('_real') + '_sim.csv')
        out.append((path, sim if sim.exists() else None, digest))
    return out


def _read(path: Path) -> tuple[dict[str, np.ndarray], dict[str, int]]:
    """Read the columns of a CSV file, and their digits after the point."""
    lines = [row for row in path.read_text(encoding='utf-8').splitlines()
             if row and not row.startswith('#')]
    names = lines[0].split(',')
    table = np.genfromtxt(lines[1:], delimiter=',', ndmin=2)
    cells = [row.split(',') for row in lines[1:200]]
    if table.shape[1] != len(names) or 'time_s' not in names:
        raise UserError('is no recording of this project: its first line names no time_s')
    return dict(zip(names, table.T)), {
        name: max(len(row[i].partition('.')[2]) for row in cells) for i, name in enumerate(names)}


def _text(columns: dict[str, np.ndarray], digits: dict[str, int]) -> str:
    """Return columns as CSV; what is not known is empty."""
    formats = ','.join(f'%.{digits.get(name, 6)}f' for name in columns)
    rows = [formats % tuple(row) for row in np.stack(list(columns.values()), axis=1).tolist()]
    return '\n'.join([','.join(columns), *rows, '']).replace('nan', '')


def _part(columns: dict[str, np.ndarray], start: float, stop: float) -> dict[str, np.ndarray]:
    """Return the rows of a time span, whose time begins at 0."""
    t = columns['time_s']
    part = {name: column[(t >= start) & (t < stop)] for name, column in columns.items()}
    return {**part, 'time_s': part['time_s'] - start}


def _half(path: Path, sim_path: Path | None) -> Half:
    """Make the parameters of the first part of a recording, and the reference of the later one."""
    columns, digits = _read(path)
    sim = _read(sim_path)[0] if sim_path else None
    t = columns['time_s']
    if t[-1] - t[0] < _SHORTEST_S:
        raise UserError(f'has {t[-1] - t[0]:.0f} s; at least {_SHORTEST_S:.0f} s are needed')
    cut = t[0] + _FIRST * (t[-1] - t[0])
    kind = 'simulator' if sim else 'stage' if 'alpha_rad' in columns else 'rests'
    first, second = (Half(path.stem, kind, _part(columns, *span), digits, '',
                          _part(sim, *span) if sim else None, 0.0)
                     for span in ((t[0], cut), (cut, math.inf)))
    second = replace(second, noise_mps2=_noise(second))
    if sim:
        return replace(second, parameters=_against_force(first))
    with tempfile.TemporaryDirectory(prefix='half_') as temporary:
        folder = Path(temporary)
        for name, half in (('first', first), ('second', second)):
            (folder / f'{name}.csv').write_text(_text(half.columns, digits))
        second = replace(second, parameters=_fitted(folder, 'temperature_c' in columns))
        if kind == 'rests':
            angles = _angles_at_rest(_applied(folder), second.columns['time_s'])
            second = replace(second, columns={**second.columns, **angles},
                             digits={**digits, 'alpha_rad': 7, 'beta_rad': 7})
    return second


def _fitted(folder: Path, warm: bool) -> str:
    """Return the parameters that `fit` makes of the first part."""
    error = ''
    for words in ([], ['--effect', 'temperature_bias']) if warm else ([],):
        status, error = diagnosis_runs.call(
            [*diagnosis_runs.executable('fit'), 'first.csv', *words, '--store', '', '-o',
             'unit.yaml'], folder)
        if not status:
            return (folder / 'unit.yaml').read_text()
    raise UserError(f'its first part makes no parameters: {error}')


def _against_force(first: Half) -> str:
    """Return zero-g and scale factor by least squares over another simulator's force."""
    assert first.sim is not None
    lines = []
    for d, row in zip(first.axes, first.g()):
        force = np.interp(first.columns['time_s'], first.sim['time_s'], first.sim[f'a{d}_mps2'])
        lines.append(np.linalg.lstsq(np.column_stack([np.ones_like(force), force / G0]), row,
                                     rcond=None)[0])
    zero, scale = np.transpose(lines)
    rate = _unit(first).rate_hz
    n, density = len(first.axes), _noise(first) / G0 / math.sqrt(rate / 2)
    return yaml.safe_dump({'/**': {'ros__parameters': {
        'format': 1, 'units': 'V, V/g, 1/g, rad', 'model': 'linear',
        'sensor': {
            'serial': 'unit', 'axes': first.axes, 'nominal_zero_g_v': [0.0] * n,
            'nominal_scale_v_per_g': [1.0] * n, 'noise_density_g_per_rthz': [density] * n,
            'rc_resistance_ohm': 10000.0, 'rc_capacitance_f': 0.0, 'adc_bits': 0,
            'adc_vref_v': 100.0, 'rate_hz': rate, 'range_g': 16.0, 'local_gravity_mps2': G0,
            'z_sign': 1},
        'stage': {'resolution_rad': 1e-3}, 'effects': ['bias', 'scale_factor'],
        'bias': {'offset_v': zero.tolist()},
        'scale_factor': {'offset_v_per_g': (scale - 1).tolist()}}}})


def _applied(folder: Path) -> np.ndarray:
    """Return the calibrated force of the later part, m/s², (3, n)."""
    status, error = diagnosis_runs.call(
        [*diagnosis_runs.executable('apply'), 'second.csv', '--params', 'unit.yaml', '-o',
         'force.csv'], folder)
    if status:
        raise UserError(error)
    columns = _read(folder / 'force.csv')[0]
    return np.stack([columns[f'a{d}_mps2'] for d in 'xyz'])


def _angles_at_rest(force: np.ndarray, t: np.ndarray) -> dict[str, np.ndarray]:
    """
    Return the angles that a stage with these rests would have; they are empty in motion.

    They are those of the mean force of each rest. So the noise and the error of the magnitude of
    gravity are real, and the direction is known, as from a table that was indexed by hand.
    """
    rate = 1 / float(np.median(np.diff(t)))
    width = max(int(0.5 * rate), 3)
    spread = np.sqrt(np.maximum(scipy.ndimage.uniform_filter1d(force ** 2, width)
                                - scipy.ndimage.uniform_filter1d(force, width) ** 2, 0)).max(0)
    still = spread < 2 * np.quantile(spread, 0.2)
    alpha, beta = np.full(len(t), np.nan), np.full(len(t), np.nan)
    edges = np.flatnonzero(np.diff(np.r_[False, still, False]))
    for start, stop in zip(edges[::2], edges[1::2]):
        if stop - start >= _REST_S * rate:
            x, y, z = force[:, start:stop].mean(axis=1)
            alpha[start:stop], beta[start:stop] = math.atan2(math.hypot(x, y), z), math.atan2(
                -y, x)
    if np.isnan(alpha).all():
        raise UserError('its later part has no rest, no stage and no other simulator')
    return {'alpha_rad': alpha, 'beta_rad': beta}


def _noise(half: Half) -> float:
    """Return the rms of the noise of one sample, of all axes, in the quietest tenth, m/s²."""
    rows = np.diff(half.g(), axis=1) / math.sqrt(2)
    blocks = np.array_split(rows, max(rows.shape[1] // 50, 4), axis=1)
    quiet = np.quantile([np.mean(block ** 2, axis=1) for block in blocks], 0.1, axis=0)
    return float(np.sqrt(np.mean(quiet)) * G0)


def plans(seed: int, count: int, halves: Sequence[Half], table: Mapping[str, FaultKind]
          ) -> list[Plan]:
    """Plan trials: recordings and defects in turn, a quarter without any."""
    rng = np.random.default_rng([seed, 3])
    rows: list[tuple[int, str, int, tuple[str, ...]]] = []
    used = dict.fromkeys(table, 0)
    for k in range(count):
        half = k % len(halves)
        group = str(rng.choice(['none', 'outside', 'single'], p=(*_SHARES, 1 - sum(_SHARES))))
        names = [name for name in halves[half].kinds(table)
                 if table[name].in_library == (group == 'single')]
        if group == 'none' or not names:
            rows.append((k, 'none', half, ()))
            continue
        fewest = min(used[name] for name in names)
        name = str(rng.choice([name for name in names if used[name] == fewest]))
        used[name] += 1
        rows.append((k, group, half, (name,)))
    order = rng.permutation(count)
    return [Plan(f'r{i:04d}', rows[k][1], rows[k][3], (seed, 4, int(k), rows[k][2]))
            for i, k in enumerate(order)]


def draw(halves: Sequence[Half], table: Mapping[str, FaultKind], plan: Plan) -> Drawn:
    """Cut a part of a later part and put the defect of a plan into it."""
    half, rng = halves[plan.seed[-1]], np.random.default_rng([*plan.seed, 0])
    end = float(half.columns['time_s'][-1])
    start = float(rng.uniform(0, (1 - _PART) * end))
    half = replace(half, columns=_part(half.columns, start, start + _PART * end),
                   sim=_part(half.sim, start, start + _PART * end) if half.sim else None)
    label = Label(plan.name, plan.group, plan.effects, plan.seed, plan.seconds,
                  f'{half.name} by {half.reference}', half.axes, half.noise_mps2)
    changed = half.g()
    for name in plan.effects:
        kind = table[name]
        wanted = half.noise_mps2 * math.exp(rng.uniform(*np.log(_NOISES)))
        shape = kind.draw(rng, _unit(half))
        fault, changed = trials.sized(partial(_with_fault, half, plan.seed),
                                      Fault(kind, kind.start, shape), wanted)
        label = replace(label, faults=[{
            'effect': name, 'size': fault.size, 'noise_like': kind.random, 'power': 1.0,
            'told': 1.0, 'inseparable': [], 'shape': {
                key: np.asarray(value).tolist() for key, value in shape.items()},
            'strength_mps2': _strength(half, changed - half.g(), kind)}])
    columns = dict(half.columns)
    for d, row in zip(half.axes, changed):
        columns |= {f'a{d}_mps2': row * G0} if f'a{d}_mps2' in columns else {
            f'{d}_v': row + _ZERO_V}
    sim = _text(half.sim, half.digits) if half.sim else None
    return Drawn(label, _text(columns, half.digits), half.parameters, sim)


def _unit(half: Half) -> Unit:
    """Return a unit of 2.5 V and 1 V/g with the axes of a recording."""
    one = np.ones(len(half.axes))
    return Unit(half.axes, _ZERO_V * one, one, _ZERO_V * one, one, one, one, math.inf, one, one,
                0.0, np.zeros(6), 1 / float(np.median(np.diff(half.columns['time_s']))))


def _motion(half: Half) -> np.ndarray:
    """Return the force without its noise, m/s², (3, n); an axis that is not measured has 0."""
    rate = _unit(half).rate_hz
    force = np.zeros((3, len(half.columns['time_s'])))
    rows = half.g() * G0
    if rate > 3 * _MOTION_HZ:
        low = scipy.signal.butter(2, _MOTION_HZ, fs=rate, output='sos')
        rows = scipy.signal.sosfiltfilt(low, rows, axis=1)
    force[['xyz'.index(d) for d in half.axes]] = rows
    return force


def _with_fault(half: Half, seed: tuple[int, ...], fault: Fault) -> tuple[float, np.ndarray]:
    """Let a fault act on recorded samples; return its strength, m/s², and samples, g."""
    unit, before = _unit(half), half.g()
    t = np.arange(before.shape[1]) / unit.rate_hz
    still = np.zeros_like(t)
    run = Run(unit, t, int(np.random.SeedSequence(seed).generate_state(1)[0]), still, still,
              still, half.columns.get('temperature_c', still + 25.0), still + 5.0,
              corner_hz=math.inf, force=_motion(half))
    run.u = run.force[unit.axis_indices] / G0
    run.volts = before + _ZERO_V
    sensed = run.u.copy()
    fault.kind.act(run, fault.size, fault.shape)
    run.volts = run.volts + run.u - sensed
    if run.late or run.skew:
        late = run.late + run.skew * (t + 8 * np.sin(t / 25))
        run.volts = np.stack([np.interp(t - late, t, row) for row in run.volts])
    after = run.volts - _ZERO_V
    return _strength(half, after - before, fault.kind), after


def _strength(half: Half, change: np.ndarray, kind: FaultKind) -> float:
    """Return the rms of a change where the reference is known; zero-g and scale are free."""
    known = ~np.isnan(half.columns['alpha_rad']) if half.reference == 'rests' else slice(None)
    rest, force = G0 * change[:, known], half.g()[:, known]
    if kind.name not in ('bias', 'scale_factor'):
        for row, along in zip(rest, force):
            line = np.column_stack([np.ones_like(along), along])
            row -= line @ np.linalg.lstsq(line, row, rcond=None)[0]
    return ideal_observer.rms(rest)


def seal(folder: Path, source: Path, seed: int, count: int, pool: Executor, show: Show) -> str:
    """Draw the trials of a folder or manifest into a folder; return the published hash."""
    digest = trials.published_hash(folder)
    if digest is not None:
        return digest
    with show('first parts'):
        halves, left_out = prepare(source)
    base = make_folder(folder / 'baseline' / 'recordings')
    for half in halves:
        drawn = {'csv': _text(half.columns, half.digits), 'yaml': half.parameters,
                 **({'sim': _text(half.sim, half.digits)} if half.sim else {})}
        for suffix, text in drawn.items():
            write(base / f'{half.name}.{suffix}', text.encode())
    write(folder / 'left_out.json', json.dumps(left_out).encode())
    with show('draw') as advance:
        return trials.commit(folder, Setup(seed, count),
                             plans(seed, count, halves, fault_table.KINDS), pool, advance,
                             partial(draw, halves, fault_table.KINDS))


def right(answer: Answer, base: Answer, label: Label) -> tuple[bool, bool]:
    """
    Return whether a verdict is exactly right, and whether its named set has the truth.

    What the verdict of the untouched part names, too, is no error. A defect that is not material
    may be missing; one outside the library is right as unknown or partly.
    """
    if answer.status in ('failed', 'insufficient', 'bad_data'):
        return False, False
    known = base.named
    new = answer.certain - known
    groups = [group for group in answer.groups if not group & known]
    if label.group == 'outside':
        found = answer.status == 'partly' or UNKNOWN in answer.named
        exact = found and not (new - {UNKNOWN}) and not groups
    else:
        truth = frozenset(label.true)
        found = truth <= answer.named
        exact = truth <= answer.certain and not new - truth and not groups
    small = label.faults and not grading.material(answer, label)
    if small and not new and not groups:
        return True, True
    return exact, found


def score(folder: Path, command: Sequence[str] | None, pool: Executor, show: Show
          ) -> dict[str, Any]:
    """Diagnose what has no report yet, compare labels with the hash, and score."""
    with show('untouched') as advance:
        untouched = diagnosis_runs.diagnose_all(folder / 'baseline', command, pool, advance)
    with show('diagnose') as advance:
        results = diagnosis_runs.diagnose_all(folder, command, pool, advance)
    committed = trials.committed_labels(folder)
    base = {name: grading.answer(result) for name, result in untouched.items()}
    rows = []
    for label in committed.labels:
        answer = grading.answer(results[label.name])
        source = label.manoeuvre.split(' by ')[0]
        exact, found = right(answer, base[source], label)
        rows.append({'name': label.name, 'recording': label.manoeuvre, 'group': label.group,
                     'effects': list(label.effects), 'exact': exact, 'in_set': found,
                     'noises': max([row['strength_mps2'] / label.floor_mps2
                                    for row in label.faults], default=0.0),
                     'status': answer.status, 'named': sorted(answer.named),
                     'already': sorted(base[source].named),
                     'probability': answer.probability, 'seconds': answer.seconds,
                     'error': results[label.name]['error'],
                     'by_chance': _by_chance(label, committed.labels, base[source], answer)})
    return {'hash': trials.published_hash(folder), 'seed': committed.setup.seed,
            'trials': len(rows), 'diagnose_code': (folder / 'reports' / 'version.txt').read_text(),
            'left_out': json.loads((folder / 'left_out.json').read_text()), 'rows': rows,
            'baseline': {name: [answer.status, sorted(answer.named)]
                         for name, answer in base.items()}}


def _by_chance(label: Label, labels: Sequence[Label], base: Answer, answer: Answer) -> float:
    """Return how often a verdict is right by the labels of other trials of its recording."""
    others = [other for other in labels
              if other.manoeuvre == label.manoeuvre and other is not label]
    return float(np.mean([right(answer, base, other)[0] for other in others])) if others else 0.0


def tables(made: dict[str, Any]) -> dict[str, report_html.Table]:
    """Return the tables of a run."""
    rows = made['rows']

    def part(name: str, chosen: Sequence[dict[str, Any]]) -> list[str]:
        return [name, *(scores.in_words(scores.share([row[key] for row in chosen]))
                        for key in ('exact', 'in_set')),
                f'{np.mean([row["by_chance"] for row in chosen]):.2f}' if chosen else '-']

    groups = {'no defect: nothing new is named': 'none', 'a defect of the library': 'single',
              'a defect outside it: unknown or partly': 'outside'}
    head = ['trials', 'exactly right (90 % interval)', 'in the named set', 'labels permuted']
    defects = [row for row in rows if row['group'] == 'single']
    edges = ((0, 3), (3, 8), (8, 1e9))
    pairs = [(row['probability'], row['exact']) for row in rows]
    return {
        'Result': (head, [part(words, [row for row in rows if row['group'] == name])
                          for words, name in groups.items()]),
        'By strength': (head, [part(f'{low:g} to {high:g} times the noise' if high < 1e6 else
                                    f'more than {low:g} times the noise', [
                                        row for row in defects if low <= row['noises'] < high])
                               for low, high in edges]),
        'By recording': (head, [part(name, [row for row in rows if row['recording'] == name])
                                for name in sorted({row['recording'] for row in rows})]),
        'By defect': (head, [part(name, [row for row in rows if row['effects'] == [name]])
                             for name in sorted({row['effects'][0] for row in rows
                                                 if row['effects']})]),
        'How often verdicts of a probability are right': report_html.reliability_table(
            scores.reliability(pairs)),
        'Untouched parts': (['recording', 'verdict', 'named'], [
            [name, status, ', '.join(named) or '-']
            for name, (status, named) in made['baseline'].items()]),
        'Left out': (['recording'], [[text] for text in made['left_out']])}


def said(made: dict[str, Any]) -> str:
    """Return how the trials were drawn."""
    return (f'{made["trials"]} trials on recordings of real sensors, seed {made["seed"]}; SHA-256 '
            f'of salt and labels {made["hash"]}; code of the diagnosis '
            f'{made["diagnose_code"][:16]}.')


def working(source: Path, seed: int, count: int, table: Mapping[str, FaultKind], pool: Executor,
            show: Callable[[str], None]) -> str:
    """Draw, diagnose and grade trials with other defects; show one line each; return a table."""
    halves, left_out = prepare(source)
    for text in left_out:
        show(f'left out: {text}')
    base = [grading.answer(diagnosis_runs.diagnose(
        'half', _text(half.columns, half.digits).encode(), half.parameters.encode(), None,
        _text(half.sim, half.digits).encode() if half.sim else None)[1]) for half in halves]
    for half, answer in zip(halves, base):
        show(f'untouched {half.name}: {answer.status} {", ".join(sorted(answer.named))}')
    hits: dict[str, list[tuple[bool, bool]]] = {}

    def keep(label: Label, result: dict[str, Any]) -> None:
        answer = grading.answer(result)
        good = right(answer, base[label.seed[-1]], label)
        hits.setdefault(label.group, []).append(good)
        truth = ', '.join(f'{row["effect"]} {row["strength_mps2"] / label.floor_mps2:.1f} noises'
                          for row in label.faults) or 'nothing'
        show(f'{"ok  " if good[0] else "set " if good[1] else "MISS"} {label.name} '
             f'{label.manoeuvre} {truth}: {answer.status} {answer.probability:.2f} '
             f'{", ".join(sorted(answer.named)) or result["error"] or "-"}; '
             f'{result["cpu_s"]:.1f} s')

    for_each(pool, _drawn_and_diagnosed, [partial(_job, halves, table, plan)
                                          for plan in plans(seed, count, halves, table)], keep,
             lambda done: None)
    return '\n'.join(f'{group:10} exactly {scores.in_words(scores.share([a for a, _ in rows]))}, '
                     f'in the named set {scores.in_words(scores.share([b for _, b in rows]))}'
                     for group, rows in sorted(hits.items()))


def _job(*arguments: Any) -> tuple:
    return arguments


def _drawn_and_diagnosed(halves: Sequence[Half], table: Mapping[str, FaultKind], plan: Plan
                         ) -> tuple[Label, dict[str, Any]]:
    drawn = draw(halves, table, plan)
    return drawn.label, diagnosis_runs.diagnose(
        plan.name, drawn.recording.encode(), drawn.parameters.encode(), None,
        drawn.sim.encode() if drawn.sim else None)[1]
