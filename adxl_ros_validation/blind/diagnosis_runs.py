# SPDX-License-Identifier: Apache-2.0
"""The diagnosis of each recording in its own process, and its gap on a held-out recording."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial
import hashlib
from importlib.metadata import PackageNotFoundError, version
import io
import json
import os
from pathlib import Path
import resource
import signal
import subprocess
import sys
import tempfile
import time
from typing import Any, NamedTuple

import adxl_ros
from adxl_ros.errors import UserError
from adxl_ros.workers import for_each, make_folder, write
from adxl_ros_validation.blind import trials
from adxl_ros_validation.blind.trials import Label
from adxl_ros_validation.blind.world import ideal_observer
from adxl_ros_validation.blind.world.fault_table import KINDS
from adxl_ros_validation.blind.world.simulator import Fault, render
import numpy as np
import yaml

_ENVIRONMENT = ('PATH', 'LD_LIBRARY_PATH', 'PYTHONPATH', 'AMENT_PREFIX_PATH', 'VIRTUAL_ENV',
                '_ROS_WHEELS_BOOTSTRAP_COMPLETE', 'ROS_DISTRO', 'LANG', 'SYSTEMROOT')
"""Variables that ROS 2 and Python need. None contains the folder of the check."""
_TIMEOUT_S = 1200.0
"""Longest time of one diagnosis, s; chosen."""
Result = dict[str, Any]
"""What a diagnosis left: `report`, `parameters`, `seconds`, `status` and `error`."""


def executable(name: str) -> list[str]:
    """Return the command line of an executable of the package."""
    return [sys.executable, '-c',
            f'import sys; from adxl_ros.tools.{name} import main; sys.exit(main())']


def call(command: Sequence[str], folder: Path) -> tuple[int, str]:
    """Run a command in a folder, with an environment that names no other folder of the user."""
    environment = {name: os.environ[name] for name in _ENVIRONMENT if name in os.environ}
    # Each process uses one core: linear algebra must not use the others.
    environment |= {'HOME': str(folder), 'OPENBLAS_NUM_THREADS': '1', 'OMP_NUM_THREADS': '1',
                    'MPLCONFIGDIR': str(folder)}
    with subprocess.Popen(command, cwd=folder, env=environment, stdin=subprocess.DEVNULL,
                          stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
                          start_new_session=True) as process:
        try:
            error = process.communicate(timeout=_TIMEOUT_S)[1]
            crashed = 'traceback: ' if 'Traceback (most recent' in error else ''
            return process.returncode, crashed + (error.strip().splitlines() or [''])[-1]
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            return 1, f'not finished after {_TIMEOUT_S:.0f} s'
        except BaseException:
            os.killpg(process.pid, signal.SIGKILL)
            raise


def diagnose(name: str, recording: bytes, parameters: bytes, command: Sequence[str] | None,
             sim: bytes | None = None) -> tuple[str, Result]:
    """Diagnose a recording in a folder that has nothing but it, its parameters and its `sim`."""
    with tempfile.TemporaryDirectory(prefix='diagnose_') as temporary:
        folder = Path(temporary)
        csv, yaml, out = folder / f'{name}.csv', folder / f'{name}.yaml', folder / 'out'
        force = folder / f'{name}_sim.csv'
        for path, data in ((csv, recording), (yaml, parameters), (force, sim)):
            if data is not None:
                path.write_bytes(data)
                os.utime(path, (0, 0))
        arguments = [*(command or executable('diagnose')), csv.name, '--params', yaml.name,
                     '-o', out.name, '--json', '--seed', '0',
                     *(['--sim', force.name] if sim else [])]
        start, cpu = time.monotonic(), _children_cpu_s()
        status, error = call(arguments, folder)
        seconds, cpu = time.monotonic() - start, _children_cpu_s() - cpu
        report, params = out / 'report.json', out / 'params.yaml'
        try:
            content = json.loads(report.read_bytes())
        except (OSError, ValueError) as problem:
            content, error = None, error or f'no report: {problem}'
        return name, {'report': content, 'seconds': seconds, 'cpu_s': cpu,
                      'status': status, 'error': error,
                      'parameters': params.read_text() if params.exists() else None}


def _children_cpu_s() -> float:
    """Return the processor time of all ended children; of one diagnosis in a worker process."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def diagnose_all(folder: Path, command: Sequence[str] | None, pool: Executor,
                 show: Callable[[float], None]) -> dict[str, Result]:
    """Diagnose all recordings of a folder that have no report yet."""
    reports, code = make_folder(folder / 'reports'), code_version(command)
    stamp = reports / 'version.txt'
    if stamp.exists() and stamp.read_text() != code:
        raise UserError(f'{stamp}: earlier reports are of another version of the diagnosis '
                        f'({stamp.read_text()[:12]}, now {code[:12]}); draw a new check '
                        'into another folder')
    write(stamp, code.encode())
    names = sorted(path.stem for path in (folder / 'recordings').glob('*.csv'))
    todo = [name for name in names if not (reports / f'{name}.json').exists()]

    def job(name: str) -> tuple:
        source = folder / 'recordings' / name
        sim = source.with_suffix('.sim')
        return (name, source.with_suffix('.csv').read_bytes(),
                source.with_suffix('.yaml').read_bytes(), command,
                sim.read_bytes() if sim.exists() else None)

    def keep(name: str, result: Result) -> None:
        write(reports / f'{name}.json', json.dumps(result).encode())

    for_each(pool, diagnose, [partial(job, name) for name in todo], keep, show,
             len(names) - len(todo))
    if code_version(command) != code:
        raise UserError('the code of the diagnosis changed while it ran; draw a new check into '
                        'another folder, and do not change the package meanwhile')
    return {name: json.loads((reports / f'{name}.json').read_bytes()) for name in names}


def code_version(command: Sequence[str] | None) -> str:
    """Hash the code of the diagnosis: the package, or the command's files."""
    hashed = hashlib.sha256()
    if command is None:
        files = sorted(Path(adxl_ros.__file__).parent.rglob('*.py'))
    else:
        files = [Path(word) for word in command[1:] if Path(word).is_file()]
        hashed.update(repr(list(command)).encode())
    for path in files:
        hashed.update(path.name.encode() + path.read_bytes())
    return hashed.hexdigest()


def package_version() -> str:
    """Return the version of this package; 'unknown' when it runs from its source."""
    try:
        return version('adxl_ros')
    except PackageNotFoundError:
        return 'unknown'


NOISE_LIKE = frozenset(name for name, kind in KINDS.items() if kind.random and name != 'adc_inl')
"""Effects that are removed before a recording is simulated again, as noise does not repeat."""
_BLOCK_S = 5.0
"""Length of the blocks of the bootstrap, s; chosen."""
_RESAMPLES = 400
"""Number of bootstrap samples; chosen."""


def evaluate(label: Label, stated: str, fitted: str | None
             ) -> tuple[str, dict[str, Any] | None]:
    """Simulate a held-out recording of a trial, with and without what the diagnosis found."""
    faults = [fault for fault in trials.faults_of(label) if fault.kind.name not in NOISE_LIKE]
    if not changed(stated, fitted) and not faults:
        return label.name, None
    held_out = trials.scene(label.seed, label.seconds, held_out=True)
    unit = held_out.unit
    measured = render(unit, held_out.manoeuvre, trials.faults_of(label), held_out.seed)
    compared = Comparison(held_out, held_out.force(), measured,
                          trials.recording(label, held_out=True))

    def clean(acting: list[Fault]) -> np.ndarray:
        return render(unit, held_out.manoeuvre, acting, held_out.seed, noise=False)

    baseline, without_faults = simulated(compared.csv, stated), clean([])
    before = compared.squares(baseline)
    after, error = compared.after(before, stated, fitted)
    # The package's simulator follows the rounded encoder; the world's own effect is added to it.
    floor, oracle = (compared.squares(baseline + clean(acting) - without_faults)
                     for acting in (faults, _fitted(label, faults)))
    gap_ci, harm_ci = (compared.interval(row) for row in (before - floor, after - before))
    return label.name, {'before': before.mean(), 'after': after.mean(), 'oracle': oracle.mean(),
                        'floor': floor.mean(), 'gap_ci': gap_ci, 'harm_ci': harm_ci,
                        'error': error}


class Comparison(NamedTuple):
    """A held-out recording, to compare simulations with it."""

    scene: ideal_observer.Scene
    force: np.ndarray  # specific force along each axis, m/s², (m, n)
    measured: np.ndarray  # volts, (m, n)
    csv: str

    def squares(self, volts: np.ndarray) -> np.ndarray:
        """Return the squared gap beyond the stated calibration of each sample, (m/s²)², (n,)."""
        gap = (self.measured - volts) * self.scene.unit.volts_to_mps2
        rest = ideal_observer.beyond_calibration(self.scene.unit, gap, self.force)
        return np.mean(rest ** 2, axis=0)

    def after(self, before: np.ndarray, stated: str, fitted: str | None
              ) -> tuple[np.ndarray, str | None]:
        """Return the squares with the fitted parameters, and why they cannot be simulated."""
        if fitted is None or not changed(stated, fitted):
            return before, None
        try:
            return self.squares(simulated(self.csv, fitted)), None
        except UserError as problem:
            # A parameter file that cannot be simulated closes nothing.
            return before, str(problem)

    def interval(self, values: np.ndarray) -> list[float]:
        """Return the 90 % interval of a mean by resampling blocks."""
        return _interval(values, int(_BLOCK_S * self.scene.unit.rate_hz))


def changed(stated: str, fitted: str | None) -> bool:
    """Return whether a diagnosis changed what `simulate` makes without noise."""
    return fitted is not None and _without_noise(fitted) != _without_noise(stated)


def _without_noise(text: str) -> dict[str, Any]:
    """Read a parameter file without noise and without noise-like effects."""
    keys = yaml.safe_load(text)['/**']['ros__parameters']
    keys['effects'] = [name for name in keys.get('effects', []) if name not in NOISE_LIKE]
    keys['sensor']['noise_density_g_per_rthz'] = [0.0] * len(keys['sensor']['axes'])
    # The simulator does not use these keys, and they name removed effects.
    return {name: value for name, value in keys.items()
            if name not in (*NOISE_LIKE, 'covariance', 'covariance_names', 'provenance')}


def simulated(csv: str, parameters: str) -> np.ndarray:
    """Run the package's simulator along a recording; return volts, (m, n)."""
    with tempfile.TemporaryDirectory(prefix='simulate_') as temporary:
        folder = Path(temporary)
        (folder / 'held.csv').write_text(csv)
        (folder / 'held.yaml').write_text(yaml.safe_dump(
            {'/**': {'ros__parameters': _without_noise(parameters)}}))
        status, error = call(
            [*executable('simulate'), 'held.csv', '--params', 'held.yaml',
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
