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

"""Real sensors: an effect is deleted from calibrated parameters, and should be put back."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from functools import partial
import json
from pathlib import Path
import tempfile
from typing import Any

from adxl_ros.blind import marks, run, store
from adxl_ros.errors import UserError
import yaml


@dataclass(frozen=True)
class Arm:
    """A real recording, its unit's calibrated parameters, and the other simulator's force."""

    recording: Path
    parameters: dict[str, Any]
    sim: Path | None


def arm(words: str) -> Arm:
    """
    Read RECORDING:PARAMS[:SIM].

    Raises
    ------
    UserError
        A file is missing, or the parameters hold no effect to delete.

    """
    paths = [Path(word) for word in words.split(':')]
    if len(paths) not in (2, 3):
        raise UserError(f'--real {words}: RECORDING:PARAMS or RECORDING:PARAMS:SIM is needed')
    for path in paths:
        if not path.exists():
            raise UserError(f'{path}: no such file')
    try:
        keys = yaml.safe_load(paths[1].read_text(encoding='utf-8'))
        effects = keys['/**']['ros__parameters']['effects']
    except (OSError, UnicodeError, yaml.YAMLError, KeyError, TypeError) as error:
        raise UserError(f'{paths[1]}: no parameter file with effects: {error}') from None
    if not effects:
        raise UserError(f'{paths[1]}: holds no effect to delete; calibrate the unit first')
    return Arm(paths[0].resolve(), keys, paths[2].resolve() if len(paths) == 3 else None)


def without(parameters: dict[str, Any], effect: str | None) -> dict[str, Any]:
    """Delete an effect from parameters, with its rows of the covariance."""
    keys = dict(parameters['/**']['ros__parameters'])
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
    Delete each effect of each arm in turn and diagnose; also with nothing deleted.

    Returns
    -------
    list
        A row each: `recording`, `deleted` (None for nothing), `put_back`, `status`, `top`,
        `probability`, `gap_mps2` before anything is added, and `parameters`: deleted and found.

    """
    rows: dict[tuple[int, str | None], dict[str, Any]] = {}

    def keep(i: int, effect: str | None, result: run.Result) -> None:
        rows[i, effect] = _row(arms[i], effect, result)

    jobs = [(i, effect) for i, one in enumerate(arms)
            for effect in (None, *one.parameters['/**']['ros__parameters']['effects'])]
    store.each(pool, _diagnose, [partial(_job, arms[i], i, effect, command)
                                 for i, effect in jobs], keep, show)
    return [rows[job] for job in jobs]


def _job(one: Arm, i: int, effect: str | None, command: Sequence[str] | None) -> tuple:
    return one, i, effect, command


def _diagnose(one: Arm, i: int, effect: str | None,
              command: Sequence[str] | None) -> tuple[int, str | None, run.Result]:
    with tempfile.TemporaryDirectory(prefix='diagnose_') as made:
        folder = Path(made)
        (folder / 'unit.yaml').write_text(yaml.safe_dump(without(one.parameters, effect)))
        words = [*(command or run.executable('diagnose')), str(one.recording), '--params',
                 'unit.yaml', '-o', 'out', '--seed', '0']
        status, error = run.call([*words, *(['--sim', str(one.sim)] if one.sim else [])], folder)
        try:
            report = json.loads((folder / 'out' / 'report.json').read_bytes())
        except (OSError, ValueError):
            report = None
        return i, effect, {'report': report, 'seconds': 0.0, 'status': status, 'error': error}


def _row(one: Arm, effect: str | None, result: run.Result) -> dict[str, Any]:
    given = marks.answer(result)
    figures: dict[str, Any] = {}
    keys = one.parameters['/**']['ros__parameters']
    for name, values in (keys.get(effect) or {}).items():
        by_axis = dict(zip(keys['sensor']['axes'], values)) if isinstance(values, list) else {}
        rows = {f'{effect}.{name}.{axis}': value for axis, value in by_axis.items()} or {
            f'{effect}.{name}': values}
        figures |= {key: {'deleted': value, 'found': given.parameters.get(key)}
                    for key, value in rows.items()}
    report = result['report'] or {}
    return {'recording': one.recording.name, 'deleted': effect, 'status': given.status,
            'put_back': None if effect is None else effect in given.named,
            'top': sorted(given.top), 'named': sorted(given.named),
            'probability': given.probability, 'error': result['error'],
            'gap_mps2': (report.get('gap') or {}).get('before'), 'parameters': figures}
