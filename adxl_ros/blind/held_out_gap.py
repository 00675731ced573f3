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

"""The gap on a held-out recording with what the diagnosis found, and with the true faults."""

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
from adxl_ros.blind.world.fault import Fault
from adxl_ros.blind.world.fault_table import KINDS
from adxl_ros.errors import UserError
import numpy as np
import yaml

NOISE_LIKE = frozenset(name for name, kind in KINDS.items() if kind.random and name != 'adc_inl')
"""Effects that are removed before a recording is simulated again, as noise does not repeat."""
_BLOCK_S = 5.0
"""Length of the blocks of the bootstrap, s; chosen."""
_RESAMPLES = 400
"""Number of bootstrap samples; chosen."""


def evaluate(label: Label, stated: str, fitted: str | None
             ) -> tuple[str, dict[str, Any] | None]:
    """
    Simulate a held-out recording of a trial, with and without what the diagnosis found.

    Parameters
    ----------
    label
        Label of the trial.
    stated, fitted
        Text of parameter files: of the user, and of the diagnosis (None without one).

    Returns
    -------
    tuple
        Name of the trial, and mean squares `before`, `after`, `oracle` and `floor`, (m/s²)², with
        the 90 % intervals `gap_ci` of before minus floor and `harm_ci` of after minus before. None
        where the trial has no gap and the diagnosis changed nothing.

    """
    changed = fitted is not None and _without_noise(fitted) != _without_noise(stated)
    faults = [fault for fault in trials.faults_of(label) if fault.kind.name not in NOISE_LIKE]
    if not changed and not faults:
        return label.name, None
    held_out = trials.scene(label.seed, label.seconds, held_out=True)
    unit = held_out.unit
    observer = ideal_observer.IdealObserver(held_out)
    measured = render(unit, held_out.manoeuvre, trials.faults_of(label), held_out.seed)
    csv = trials.recording(label, held_out=True)

    def squares(simulated: np.ndarray) -> np.ndarray:
        gap = (measured - simulated) * unit.volts_to_mps2
        rest = ideal_observer.beyond_calibration(unit, gap, observer.force)
        return np.mean(rest ** 2, axis=0)

    def clean(acting: list[Fault]) -> np.ndarray:
        return render(unit, held_out.manoeuvre, acting, held_out.seed, noise=False)

    baseline, without_faults = _simulate(csv, stated), clean([])
    before = squares(baseline)
    after, error = before, None
    if changed and fitted:
        try:
            after = squares(_simulate(csv, fitted))
        except UserError as problem:
            # A parameter file that cannot be simulated closes nothing.
            error = str(problem)
    # The package's simulator follows the rounded encoder; the world's own effect is added to it.
    floor, oracle = (squares(baseline + clean(acting) - without_faults)
                     for acting in (faults, _fitted(label, faults)))
    block = int(_BLOCK_S * unit.rate_hz)
    gap_ci, harm_ci = (_interval(row, block) for row in (before - floor, after - before))
    return label.name, {'before': before.mean(), 'after': after.mean(), 'oracle': oracle.mean(),
                        'floor': floor.mean(), 'gap_ci': gap_ci, 'harm_ci': harm_ci,
                        'error': error}


def _without_noise(text: str) -> dict[str, Any]:
    """Read a parameter file without noise and without noise-like effects."""
    keys = yaml.safe_load(text)['/**']['ros__parameters']
    keys['effects'] = [name for name in keys.get('effects', []) if name not in NOISE_LIKE]
    keys['sensor']['noise_density_g_per_rthz'] = [0.0] * len(keys['sensor']['axes'])
    # The simulator does not use these keys, and they name removed effects.
    return {name: value for name, value in keys.items()
            if name not in (*NOISE_LIKE, 'covariance', 'covariance_names', 'provenance')}


def _simulate(csv: str, parameters: str) -> np.ndarray:
    """Run the package's simulator along a recording; return volts, (m, n)."""
    with tempfile.TemporaryDirectory(prefix='simulate_') as temporary:
        folder = Path(temporary)
        (folder / 'held.csv').write_text(csv)
        (folder / 'held.yaml').write_text(yaml.safe_dump(
            {'/**': {'ros__parameters': _without_noise(parameters)}}))
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
    """Fit the sizes of the true faults, in their true forms, to the recording of the trial."""
    if not faults:
        return []
    drawn = trials.scene(label.seed, label.seconds)
    observer = ideal_observer.IdealObserver(drawn)
    volts = render(drawn.unit, drawn.manoeuvre, trials.faults_of(label), drawn.seed)
    gap = (volts - drawn.unit.stated_zero_v[:, None]) * drawn.unit.volts_to_mps2 - observer.force
    columns = np.stack([observer.project(drawn.response([fault])) for fault in faults], axis=1)
    sizes = np.linalg.lstsq(columns, observer.project(gap), rcond=None)[0]
    return [replace(fault, size=fault.size * float(np.clip(size, 0, 2)))
            for fault, size in zip(faults, sizes)]


def _interval(values: np.ndarray, block: int) -> list[float]:
    """Return the 90 % interval of a mean by resampling blocks."""
    means = np.array([part.mean() for part in np.array_split(
        values, max(len(values) // block, 2))])
    rng = np.random.default_rng(0)
    drawn = means[rng.integers(len(means), size=(_RESAMPLES, len(means)))].mean(axis=1)
    return [float(q) for q in np.quantile(drawn, (0.05, 0.95))]
