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

"""How far the gap closes on a recording that the diagnosis never saw, beside an oracle."""

from __future__ import annotations

from dataclasses import replace
import io
from pathlib import Path
import tempfile
from typing import Any

from adxl_ros.blind import diagnosis_runs, trials
from adxl_ros.blind.trials import Label
from adxl_ros.blind.world import ideal_observer
from adxl_ros.blind.world.chain import render
from adxl_ros.blind.world.fault_table import Fault, KINDS
from adxl_ros.errors import UserError
import numpy as np
import yaml

# Noise does not repeat: these effects are left out where a recording is simulated again.
NOISE_LIKE = frozenset(name for name, kind in KINDS.items() if kind.random and name != 'adc_inl')
_BLOCK_S, _RESAMPLES = 5.0, 400


def judge(label: Label, stated: str, found: str | None) -> tuple[str, dict[str, Any] | None]:
    """
    Simulate a held-out recording of a case, with and without what the diagnosis found.

    Parameters
    ----------
    label
        The case.
    stated, found
        Parameter files: the user's, and what the diagnosis left (None for nothing).

    Returns
    -------
    tuple
        The case's name, and mean squares `before`, `after`, `oracle` and `floor`, (m/s^2)^2, with
        the 90 % intervals `gap_ci` of before less floor and `harm_ci` of after less before; None
        where there is nothing to close and nothing was changed.

    """
    changed = found is not None and _mean_only(found) != _mean_only(stated)
    faults = [fault for fault in trials.faults_of(label) if fault.kind.name not in NOISE_LIKE]
    if not changed and not faults:
        return label.name, None
    at = trials.scene(label.seed, label.seconds, held_out=True)
    unit = at.unit
    eye = ideal_observer.Eye(at)
    measured = render(unit, at.manoeuvre, trials.faults_of(label), at.seed)
    csv = trials.recording(label, held_out=True)

    def squares(simulated: np.ndarray) -> np.ndarray:
        off = (measured - simulated) * unit.volts_to_mps2
        return np.mean(ideal_observer.beyond_calibration(unit, off, eye.force) ** 2, axis=0)

    def clean(some: list[Fault]) -> np.ndarray:
        return render(unit, at.manoeuvre, some, at.seed, noise=False)

    plain, nothing = _simulate(csv, stated), clean([])
    before = squares(plain)
    after, error = before, None
    if changed and found:
        try:
            after = squares(_simulate(csv, found))
        except UserError as problem:
            # What was found cannot be simulated: it closes nothing.
            error = str(problem)
    # The same simulator, which follows the encoder's rounded angles, with the world's own effect.
    floor, oracle = (squares(plain + clean(some) - nothing)
                     for some in (faults, _fitted(label, faults)))
    block = int(_BLOCK_S * unit.rate_hz)
    gap_ci, harm_ci = (_interval(row, block) for row in (before - floor, after - before))
    return label.name, {'before': before.mean(), 'after': after.mean(), 'oracle': oracle.mean(),
                        'floor': floor.mean(), 'gap_ci': gap_ci, 'harm_ci': harm_ci,
                        'error': error}


def _mean_only(text: str) -> dict[str, Any]:
    """Read a parameter file without noise and without what noise-like effects add."""
    keys = yaml.safe_load(text)['/**']['ros__parameters']
    keys['effects'] = [name for name in keys.get('effects', []) if name not in NOISE_LIKE]
    keys['sensor']['noise_density_g_per_rthz'] = [0.0] * len(keys['sensor']['axes'])
    # Of no use to the simulator, and not of the effects that are left.
    return {name: value for name, value in keys.items()
            if name not in (*NOISE_LIKE, 'covariance', 'covariance_names', 'provenance')}


def _simulate(csv: str, parameters: str) -> np.ndarray:
    """Run the package's simulator along a recording; give volts, (axes, n)."""
    with tempfile.TemporaryDirectory(prefix='simulate_') as made:
        folder = Path(made)
        (folder / 'held.csv').write_text(csv)
        (folder / 'held.yaml').write_text(yaml.safe_dump(
            {'/**': {'ros__parameters': _mean_only(parameters)}}))
        status, error = diagnosis_runs.call(
            [*diagnosis_runs.executable('simulate'), 'held.csv', '--params', 'held.yaml',
             '-o', 'again.csv'], folder)
        if status:
            raise UserError(f'simulate: {error}')
        lines = [line for line in (folder / 'again.csv').read_text().splitlines()
                 if not line.startswith('#')]
    names = lines[0].split(',')
    rows = np.loadtxt(io.StringIO('\n'.join(lines[1:])), delimiter=',', ndmin=2, usecols=[
        names.index(name) for name in ('x_v', 'y_v', 'z_v') if name in names])
    return rows.T


def _fitted(label: Label, faults: list[Fault]) -> list[Fault]:
    """Fit the sizes of the true faults, in their true forms, to the case's own recording."""
    if not faults:
        return []
    at = trials.scene(label.seed, label.seconds)
    eye = ideal_observer.Eye(at)
    volts = render(at.unit, at.manoeuvre, trials.faults_of(label), at.seed)
    off = (volts - at.unit.stated_zero_v[:, None]) * at.unit.volts_to_mps2 - eye.force
    columns = np.stack([eye.seen(at.response([fault])) for fault in faults], axis=1)
    sizes = np.linalg.lstsq(columns, eye.seen(off), rcond=None)[0]
    return [replace(fault, size=fault.size * float(np.clip(size, 0, 2)))
            for fault, size in zip(faults, sizes)]


def _interval(values: np.ndarray, block: int) -> list[float]:
    """Give the 90 % interval of a mean by resampling blocks."""
    means = np.array([part.mean() for part in np.array_split(
        values, max(len(values) // block, 2))])
    rng = np.random.default_rng(0)
    drawn = means[rng.integers(len(means), size=(_RESAMPLES, len(means)))].mean(axis=1)
    return [float(q) for q in np.quantile(drawn, (0.05, 0.95))]
