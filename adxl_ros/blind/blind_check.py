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

"""A whole check: sealed, diagnosed, opened, scored."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from datetime import date
from functools import partial
import json
from pathlib import Path
import secrets
from typing import Any

from adxl_ros.blind import (
    diagnosis_runs,
    grading,
    held_out_gap,
    label_commitment,
    negative_controls,
    parallel_io,
    scores,
    trials as cases,
)
from adxl_ros.blind.scores import Trial
from adxl_ros.blind.trials import Label
from adxl_ros.errors import UserError

Show = Callable[[str], Callable[[float], None]]


def sealed(folder: Path, seed: int | None, trials: int, pool: Executor,
           show: Callable[[float], None]) -> str:
    """
    Draw and seal a check, or go on with the folder's; give the published hash.

    Parameters
    ----------
    folder
        Empty, or with a check that was cut short.
    seed
        Of the cases; any if None.
    trials
        How many, beside those at strength zero.
    pool
        Draws in parallel.
    show
        Takes the fraction that is done.

    Raises
    ------
    UserError
        The folder has a check of another seed or size, or something else.

    """
    digest, has = label_commitment.published(folder), label_commitment.begun(folder)
    if digest is not None:
        opened = label_commitment.unseal(folder, leave_open=False)
        has = opened.seed, opened.trials
    elif has is None and any(folder.glob('*')):
        raise UserError(f'{folder}: is not empty and holds no check; choose another folder')
    seed = (has[0] if has else secrets.randbelow(2 ** 31)) if seed is None else seed
    if has not in (None, (seed, trials)):
        raise UserError(f'{folder}: holds a check of another seed or number of trials; say the '
                        'same again to go on with it, or choose another folder')
    if digest is not None:
        return digest
    return label_commitment.seal(folder, seed, cases.plans(seed, trials), trials, pool, show)


def scored(folder: Path, command: Sequence[str] | None, pool: Executor,
           show: Show) -> dict[str, Any]:
    """
    Diagnose what is not diagnosed yet, open the labels and score.

    Parameters
    ----------
    folder
        Holds a sealed check.
    command
        The diagnosis; None for the package's own.
    pool
        Works in parallel.
    show
        Takes the name of a stage; gives what takes the fraction that is done.

    Returns
    -------
    dict
        What blind.json holds.

    """
    digest = label_commitment.published(folder)
    if digest is None:
        raise UserError(f'{folder}: nothing is sealed there; use --seal {folder} first')
    label_commitment.close(folder)
    results = diagnosis_runs.diagnose_all(folder, command, pool, show('diagnose'))
    version = (folder / 'reports' / 'version.txt').read_text()
    opened = label_commitment.unseal(folder)
    labels = opened.labels
    missing = [label.name for label in labels if label.name not in results]
    if missing:
        raise UserError(f'{folder / "recordings"}: {missing[0]}.csv is missing, of {len(missing)}'
                        ' that were sealed; a check is of all of them')
    kept = _held(folder, labels, results, pool, show('held out'))
    answers = [grading.answer(results[label.name]) for label in labels]
    trials = [Trial(label, given, kept[label.name]) for label, given in zip(labels, answers)]
    made = scores.scores(trials)
    tested = negative_controls.controls(folder, labels, answers)
    return {
        'schema': 1, 'hash': digest, 'seed': opened.seed, 'trials': opened.trials,
        'cases': len(labels), 'date': str(date.today()),
        'version': diagnosis_runs.package_version(), 'diagnose_code': version,
        'failed': {label.name: results[label.name]['error'] for label, given
                   in zip(labels, answers) if given.status == 'failed'},
        'bars': scores.bars(made), 'controls': tested,
        'leaks': any(one['leaks'] for one in tested.values()),
        'scores': made, 'rows': [_row(trial) for trial in trials]}


def _held(folder: Path, labels: Sequence[Label], results: dict[str, diagnosis_runs.Result],
          pool: Executor, show: Callable[[float], None]) -> dict[str, dict[str, Any] | None]:
    done = parallel_io.make(folder / 'labels' / 'held')

    def keep(name: str, found: dict[str, Any] | None) -> None:
        parallel_io.write(done / f'{name}.json', json.dumps(found).encode())

    def job(label: Label) -> tuple:
        stated = (folder / 'recordings' / f'{label.name}.yaml').read_text()
        return label, stated, results[label.name]['parameters']

    todo = [label for label in labels if not (done / f'{label.name}.json').exists()]
    parallel_io.each(pool, held_out_gap.judge, [partial(job, label) for label in todo], keep, show,
                     len(labels) - len(todo))
    return {label.name: json.loads((done / f'{label.name}.json').read_bytes())
            for label in labels}


def _row(trial: Trial) -> dict[str, Any]:
    """Tell of one trial what the scores are made of."""
    label, given = trial.label, trial.given
    return {'name': label.name, 'group': label.group, 'effects': list(label.effects),
            'strength_mps2': [one['strength_mps2'] for one in label.faults],
            'power': [one['power'] for one in label.faults],
            'told': [one['told'] for one in label.faults],
            'inseparable': [one['inseparable'] for one in label.faults],
            'flexible': label.flexible, 'manoeuvre': label.manoeuvre, 'axes': label.axes,
            'status': given.status, 'top': sorted(given.top), 'named': sorted(given.named),
            'probability': given.probability,
            'right': grading.verdict_right(given, label), 'seconds': given.seconds,
            'held': trial.held}
