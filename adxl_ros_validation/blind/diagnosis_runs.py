# SPDX-License-Identifier: Apache-2.0
"""The diagnosis of each recording in its own process, its gap held out, and the score of all."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from datetime import date
import json
import os
from pathlib import Path
import resource
import subprocess
import sys
import tempfile
import time
from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.process import code_version, package_version
from adxl_ros.workers import Pool
from adxl_ros_validation.blind import grading, ideal_observer, scores, trials
from adxl_ros_validation.blind.faults import NOISE_LIKE
from adxl_ros_validation.blind.simulator import Fault, Scene
from adxl_ros_validation.blind.trials import kept, Label, Show
from adxl_ros_validation.kept_results import write
import numpy as np
import pandas as pd
import yaml

_ENVIRONMENT = (
    'PATH',
    'LD_LIBRARY_PATH',
    'PYTHONPATH',
    'AMENT_PREFIX_PATH',
    'VIRTUAL_ENV',
    '_ROS_WHEELS_BOOTSTRAP_COMPLETE',
    'ROS_DISTRO',
    'LANG',
    'SYSTEMROOT',
)
"""Variables that ROS 2 and Python need. None contains the folder of the check."""
_TIMEOUT_S = 1200.0
"""Longest time of one diagnosis, s; chosen."""
Result = dict[str, Any]
"""What a diagnosis left: `report`, `parameters`, `seconds`, `status` and `error`."""


def executable(name: str) -> list[str]:
    """Return the command line of an executable of the package."""
    return [
        sys.executable,
        '-c',
        f'import sys; from adxl_ros.tools.{name} import main; sys.exit(main())',
    ]


def call(folder: Path, name: str, *arguments: str) -> tuple[int, str]:
    """Run an executable in a folder, in an environment that names no other folder of the user."""
    environment = {name: os.environ[name] for name in _ENVIRONMENT if name in os.environ}
    # Each process uses one core: linear algebra must not use the others.
    environment |= {
        'HOME': str(folder),
        'OPENBLAS_NUM_THREADS': '1',
        'OMP_NUM_THREADS': '1',
        'MPLCONFIGDIR': str(folder),
    }
    try:
        done = subprocess.run(
            [*executable(name), *arguments],
            cwd=folder,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            timeout=_TIMEOUT_S,
        )
    except subprocess.TimeoutExpired:
        return 1, f'not finished after {_TIMEOUT_S:.0f} s'
    crashed = 'traceback: ' if 'Traceback (most recent' in done.stderr else ''
    return done.returncode, crashed + (done.stderr.strip().splitlines() or [''])[-1]


def diagnose(
    name: str, recording: bytes, parameters: bytes, sim: bytes | None = None
) -> tuple[str, Result]:
    """Diagnose a recording in a folder that has nothing but it, its parameters and its `sim`."""
    with tempfile.TemporaryDirectory(prefix='diagnose_') as temporary:
        folder = Path(temporary)
        for suffix, data in (('.csv', recording), ('.yaml', parameters), ('_sim.csv', sim)):
            if data is not None:
                (folder / f'{name}{suffix}').write_bytes(data)
                os.utime(folder / f'{name}{suffix}', (0, 0))
        start, used = time.monotonic(), resource.getrusage(resource.RUSAGE_CHILDREN)
        status, error = call(
            folder,
            'diagnose',
            f'{name}.csv',
            '--params',
            f'{name}.yaml',
            '-o',
            'out',
            '--json',
            '--seed',
            '0',
            *(['--sim', f'{name}_sim.csv'] if sim else []),
        )
        seconds, now = time.monotonic() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
        params = folder / 'out' / 'params.yaml'
        try:
            content = json.loads(params.with_name('report.json').read_bytes())
        except (OSError, ValueError) as problem:
            content, error = None, error or f'no report: {problem}'
        return name, {
            'report': content,
            'seconds': seconds,
            'cpu_s': now.ru_utime - used.ru_utime + now.ru_stime - used.ru_stime,
            'status': status,
            'error': error,
            'parameters': params.read_text() if params.exists() else None,
        }


def diagnose_all(folder: Path, pool: Pool, show: Callable[[float], None]) -> dict[str, Result]:
    """Diagnose all recordings of a folder that have no report yet."""
    reports, recordings = folder / 'reports', folder / 'recordings'
    code = code_version()
    stamp = reports / 'version.txt'
    if stamp.exists() and stamp.read_text() != code:
        raise UserError(
            f'{stamp}: earlier reports are of another version of the diagnosis '
            f'({stamp.read_text()[:12]}, now {code[:12]}); draw a new check '
            'into another folder'
        )
    write(stamp, code.encode())

    def job(name: str) -> tuple:
        paths = [recordings / f'{name}.{suffix}' for suffix in ('csv', 'yaml', 'sim')]
        return name, *(path.read_bytes() for path in paths if path.exists())

    results = kept(
        reports, sorted(path.stem for path in recordings.glob('*.csv')), diagnose, job, pool, show
    )
    if code_version() != code:
        raise UserError(
            'the code of the diagnosis changed while it ran; draw a new check into '
            'another folder, and do not change the package meanwhile'
        )
    return results


_BLOCK_S = 5.0
"""Length of the blocks of the bootstrap, s; chosen."""
_RESAMPLES = 400
"""Number of bootstrap samples; chosen."""


class Comparison:
    """Another recording of a unit, simulated with the stated and with the fitted parameters."""

    def __init__(self, scene: Scene, faults: list[Fault], stated: str, fitted: str | None) -> None:
        self._scene, self._force = scene, scene.force()
        self._measured, csv = scene.volts(faults), scene.recording(faults)
        self.baseline = simulated(csv, stated)
        self.before = self.after = self.squares(self.baseline)
        self.error: str | None = None
        if fitted is not None and changed(stated, fitted):
            try:
                self.after = self.squares(simulated(csv, fitted))
            except UserError as problem:
                # A parameter file that cannot be simulated closes nothing.
                self.error = str(problem)

    def squares(self, volts: np.ndarray) -> np.ndarray:
        """Return the squared gap beyond the stated calibration of each sample, (m/s²)², (n,)."""
        unit = self._scene.unit
        rest = ideal_observer.beyond_calibration(
            unit, (self._measured - volts) * unit.volts_to_mps2, self._force
        )
        return np.mean(rest**2, axis=0)

    def interval(self, values: np.ndarray) -> list[float]:
        """Return the 90 % interval of a mean by resampling blocks."""
        block = int(_BLOCK_S * self._scene.unit.rate_hz)
        means = np.array(
            [part.mean() for part in np.array_split(values, max(len(values) // block, 2))]
        )
        rng = np.random.default_rng(0)
        drawn = means[rng.integers(len(means), size=(_RESAMPLES, len(means)))].mean(axis=1)
        return [float(q) for q in np.quantile(drawn, (0.05, 0.95))]


def evaluate(label: Label, stated: str, fitted: str | None) -> tuple[str, dict[str, Any] | None]:
    """Simulate a held-out recording of a trial, with and without what the diagnosis found."""
    faults = [fault for fault in label.acting() if not fault.kind.random]
    if not changed(stated, fitted) and not faults:
        return label.name, None
    scene = trials.scene(label, held_out=True)
    compared = Comparison(scene, label.acting(), stated, fitted)
    without_faults = scene.volts([], noise=False)
    # The package's simulator follows the rounded encoder; the world's own effect is added to it.
    floor, oracle = (
        compared.squares(compared.baseline + scene.volts(acting, noise=False) - without_faults)
        for acting in (faults, _fitted(label, faults))
    )
    before, after = compared.before, compared.after
    return label.name, {
        'before': before.mean(),
        'after': after.mean(),
        'oracle': oracle.mean(),
        'floor': floor.mean(),
        'gap_ci': compared.interval(before - floor),
        'harm_ci': compared.interval(after - before),
        'error': compared.error,
    }


def changed(stated: str, fitted: str | None) -> bool:
    """Return whether a diagnosis changed what `simulate` makes without noise."""
    return fitted is not None and _without_noise(fitted) != _without_noise(stated)


def _without_noise(text: str) -> dict[str, Any]:
    """Read a parameter file without noise and without noise-like effects."""
    keys = yaml.safe_load(text)['/**']['ros__parameters']
    keys['effects'] = [name for name in keys.get('effects', []) if name not in NOISE_LIKE]
    keys['sensor']['noise_density_g_per_rthz'] = [0.0] * len(keys['sensor']['axes'])
    # The simulator does not use these keys, and they name removed effects.
    return {
        name: value
        for name, value in keys.items()
        if name not in (*NOISE_LIKE, 'covariance', 'covariance_names', 'provenance')
    }


def simulated(csv: str, parameters: str) -> np.ndarray:
    """Run the package's simulator along a recording; return volts, (m, n)."""
    with tempfile.TemporaryDirectory(prefix='simulate_') as temporary:
        folder = Path(temporary)
        (folder / 'held.csv').write_text(csv)
        (folder / 'held.yaml').write_text(
            yaml.safe_dump({'/**': {'ros__parameters': _without_noise(parameters)}})
        )
        status, error = call(
            folder, 'simulate', 'held.csv', '--params', 'held.yaml', '-o', 'again.csv'
        )
        if status:
            raise UserError(f'simulate: {error}')
        table = pd.read_csv(folder / 'again.csv', comment='#')
    return table[[name for name in ('x_v', 'y_v', 'z_v') if name in table]].to_numpy().T


def _fitted(label: Label, faults: list[Fault]) -> list[Fault]:
    """Fit the sizes of the true faults, in their true forms, to the recording of the trial."""
    if not faults:
        return []
    drawn = trials.scene(label)
    observer = ideal_observer.IdealObserver(drawn)
    columns = np.stack([observer.project(drawn.response([fault])) for fault in faults], axis=1)
    gap = observer.project(drawn.gap(label.acting()))
    sizes = np.linalg.lstsq(columns, gap, rcond=None)[0]
    return [
        replace(fault, size=fault.size * float(np.clip(size, 0, 2)))
        for fault, size in zip(faults, sizes)
    ]


def diagnosed(
    folder: Path, pool: Pool, show: Show
) -> tuple[dict[str, Any], list[Label], dict[str, Result]]:
    """Diagnose all recordings that have no report yet; return check, labels and results."""
    digest = trials.published_hash(folder)
    # Labels may be on another machine: the diagnosis does not need them.
    with show('diagnose') as advance:
        results = diagnose_all(folder, pool, advance)
    setup, labels = trials.committed_labels(folder)
    missing = [label.name for label in labels if label.name not in results]
    if missing:
        raise UserError(
            f'{folder / "recordings"}: {missing[0]}.csv is missing, {len(missing)} '
            'of the committed recordings in all; a check needs all of them'
        )
    return (
        {
            'hash': digest,
            **setup._asdict(),
            'diagnose_code': (folder / 'reports' / 'version.txt').read_text(),
        },
        labels,
        results,
    )


def score(folder: Path, pool: Pool, show: Show) -> dict[str, Any]:
    """Diagnose all recordings that have no report yet, read the labels and score."""
    check, labels, results = diagnosed(folder, pool, show)
    by_name = {label.name: label for label in labels}

    def job(name: str) -> tuple:
        stated = (folder / 'recordings' / f'{name}.yaml').read_text()
        return by_name[name], stated, results[name]['parameters']

    with show('held out') as advance:
        held_out = kept(folder / 'labels' / 'held', list(by_name), evaluate, job, pool, advance)
    graded = [
        scores.Trial(label, grading.answer(results[label.name]), held_out[label.name])
        for label in labels
    ]
    made = scores.scores(graded)
    negative = {
        'labels_permuted': scores.permuted(graded),
        'metadata_only': scores.metadata(folder / 'recordings', labels),
        'strength_zero': scores.strength_zero(graded),
    }
    return {
        'schema': 1,
        **check,
        'cases': len(labels),
        'date': str(date.today()),
        'version': package_version(),
        'failed': {
            trial.label.name: results[trial.label.name]['error']
            for trial in graded
            if trial.answer.status == 'failed'
        },
        'bars': scores.bars(made),
        'controls': negative,
        'leaks': any(control['leaks'] for control in negative.values()),
        'scores': made,
        'rows': [trial.row() for trial in graded],
    }
