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

"""
Real sensors: an effect is deleted from calibrated parameters, and the diagnosis should add it.

A recording may have neither a stage nor another simulator's force. Then its own calibrated force,
smoothed, is the reference. Noise and motion are real, but an error of the calibration cannot show.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
import json
from pathlib import Path
import tempfile
from typing import Any

from adxl_ros.blind import diagnosis_runs, grading
from adxl_ros.errors import UserError
from adxl_ros.jobs.run import for_each
import numpy as np
import scipy
import yaml

_SMOOTH_HZ = 15.0
"""Corner of the low-pass of the reference, Hz; chosen."""


@dataclass(frozen=True)
class Arm:
    """
    A real recording with the calibrated parameters of its unit.

    Attributes
    ----------
    recording
        The recording.
    parameters : dict
        Content of the parameter file.
    sim
        Recording of another simulator's force; None without.
    itself
        Whether its own smoothed force is the reference.

    """

    recording: Path
    parameters: dict[str, Any]
    sim: Path | None
    itself: bool = False


def read_arm(option: str) -> Arm:
    """
    Read the option RECORDING:PARAMS[:SIM].

    Raises
    ------
    UserError
        A file is missing, or the parameters have no effect to delete.

    """
    paths = [Path(word) for word in option.split(':')]
    if len(paths) not in (2, 3):
        raise UserError(f'--real {option}: RECORDING:PARAMS or RECORDING:PARAMS:SIM is needed')
    for path in paths:
        if not path.exists():
            raise UserError(f'{path}: no such file')
    try:
        keys = yaml.safe_load(paths[1].read_text(encoding='utf-8'))
        effects = keys['/**']['ros__parameters']['effects']
    except (OSError, UnicodeError, yaml.YAMLError, KeyError, TypeError) as error:
        raise UserError(f'{paths[1]}: no parameter file with effects: {error}') from None
    if not effects:
        raise UserError(f'{paths[1]}: has no effect to delete; calibrate the unit first')
    sim = paths[2].resolve() if len(paths) == 3 else None
    return Arm(paths[0].resolve(), keys, sim, sim is None and _without_stage(paths[0]))


def _without_stage(recording: Path) -> bool:
    """Return whether a CSV recording has no angles of a stage."""
    if recording.suffix != '.csv':
        return False
    with open(recording, encoding='utf-8') as lines:
        head = next((line for line in lines if not line.startswith('#')), '')
    return 'alpha_rad' not in head


def _smoothed_force(arm: Arm, folder: Path) -> Path:
    """Calibrate a recording by its full parameters and smooth it, without delay."""
    (folder / 'full.yaml').write_text(yaml.safe_dump(arm.parameters))
    status, error = diagnosis_runs.call(
        [*diagnosis_runs.executable('apply'), str(arm.recording), '--params', 'full.yaml',
         '-o', 'force.csv'], folder)
    if status:
        raise UserError(error)
    lines = [line for line in (folder / 'force.csv').read_text().splitlines()
             if not line.startswith('#')]
    names = ['time_s', 'ax_mps2', 'ay_mps2', 'az_mps2']
    columns = [lines[0].split(',').index(name) for name in names]
    rows = np.genfromtxt(lines[1:], delimiter=',', usecols=columns)
    rate = 1 / np.median(np.diff(rows[:, 0]))
    smooth = scipy.signal.butter(4, min(_SMOOTH_HZ, rate / 4), fs=rate, output='sos')
    rows[:, 1:] = scipy.signal.sosfiltfilt(smooth, np.nan_to_num(rows[:, 1:]), axis=0)
    path = folder / 'sim.csv'
    np.savetxt(path, rows, delimiter=',', header=','.join(names), comments='', fmt='%.9g')
    return path


def without(content: dict[str, Any], effect: str | None) -> dict[str, Any]:
    """
    Delete an effect from parameters, with its rows of the covariance.

    Parameters
    ----------
    content
        Content of the parameter file.
    effect
        The effect; None deletes nothing.

    Returns
    -------
    dict
        Content of the new parameter file.

    """
    keys = dict(content['/**']['ros__parameters'])
    keys['effects'] = [name for name in keys['effects'] if name != effect]
    keys.pop(effect, None)
    names = keys.get('covariance_names', [])
    kept = [i for i, name in enumerate(names) if name.split('.')[0] != effect]
    flat = keys.get('covariance', [])
    keys['covariance_names'] = [names[i] for i in kept]
    keys['covariance'] = [flat[i * len(names) + j] for i in kept for j in kept]
    if not kept:
        del keys['covariance_names'], keys['covariance']
    return {'/**': {'ros__parameters': keys}}


def put_back(arms: Sequence[Arm], command: Sequence[str] | None, pool: Executor,
             show: Callable[[float], None]) -> list[dict[str, Any]]:
    """
    Delete each effect of each recording's parameters in turn, or none, and diagnose.

    Parameters
    ----------
    arms
        The recordings with their parameters.
    command
        The diagnosis; None for that of the package.
    pool
        Works in parallel.
    show
        Receives the fraction that is finished.

    Returns
    -------
    list
        A row each: `recording`, `against` what, `deleted` (None for nothing), `put_back`,
        `status`, `top`, `probability`, `gap_mps2` before anything is added, and `parameters`:
        deleted and found.

    """
    rows: dict[tuple[int, str | None], dict[str, Any]] = {}

    def keep(i: int, effect: str | None, result: diagnosis_runs.Result) -> None:
        rows[i, effect] = _row(arms[i], effect, result)

    jobs = [(i, effect) for i, entry in enumerate(arms)
            for effect in (None, *entry.parameters['/**']['ros__parameters']['effects'])]
    for_each(pool, _diagnose, [partial(_job, arms[i], i, effect, command)
                               for i, effect in jobs], keep, show)
    return [rows[job] for job in jobs]


def _job(arm: Arm, i: int, effect: str | None, command: Sequence[str] | None) -> tuple:
    return arm, i, effect, command


def _diagnose(arm: Arm, i: int, effect: str | None,
              command: Sequence[str] | None) -> tuple[int, str | None, diagnosis_runs.Result]:
    with tempfile.TemporaryDirectory(prefix='diagnose_') as temporary:
        folder = Path(temporary)
        (folder / 'unit.yaml').write_text(yaml.safe_dump(without(arm.parameters, effect)))
        sim = _smoothed_force(arm, folder) if arm.itself else arm.sim
        arguments = [*(command or diagnosis_runs.executable('diagnose')), str(arm.recording),
                     '--params', 'unit.yaml', '-o', 'out', '--seed', '0']
        status, error = diagnosis_runs.call(
            [*arguments, *(['--sim', str(sim)] if sim else [])], folder)
        try:
            report = json.loads((folder / 'out' / 'report.json').read_bytes())
        except (OSError, ValueError):
            report = None
        return i, effect, {'report': report, 'seconds': 0.0, 'status': status, 'error': error}


def _row(arm: Arm, effect: str | None, result: diagnosis_runs.Result) -> dict[str, Any]:
    answer = grading.answer(result)
    coefficients: dict[str, Any] = {}
    keys = arm.parameters['/**']['ros__parameters']
    for name, values in (keys.get(effect) or {}).items():
        by_axis = dict(zip(keys['sensor']['axes'], values)) if isinstance(values, list) else {}
        rows = {f'{effect}.{name}.{axis}': value for axis, value in by_axis.items()} or {
            f'{effect}.{name}': values}
        coefficients |= {key: {'deleted': value, 'found': answer.parameters.get(key)}
                         for key, value in rows.items()}
    report = result['report'] or {}
    against = 'itself, calibrated and smoothed' if arm.itself else \
        arm.sim.name if arm.sim else 'the stage'
    return {'recording': arm.recording.name, 'against': against, 'deleted': effect,
            'status': answer.status,
            'put_back': None if effect is None else effect in answer.named,
            'top': sorted(answer.top), 'named': sorted(answer.named),
            'probability': answer.probability, 'error': result['error'],
            'gap_mps2': (report.get('gap') or {}).get('before'), 'parameters': coefficients}
