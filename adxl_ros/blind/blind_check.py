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

"""A whole check: trials are drawn and committed, diagnosed, and scored."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from contextlib import AbstractContextManager
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
    scores,
    trials,
)
from adxl_ros.blind.grading import Answer
from adxl_ros.blind.label_commitment import Setup
from adxl_ros.blind.scores import Trial
from adxl_ros.blind.trials import Label
from adxl_ros.errors import UserError
from adxl_ros.jobs.run import for_each
from adxl_ros.jobs.whole_files import make_folder, write

OtherMethod = Callable[[Path, Executor, Callable[[float], None]], dict[str, Answer]]
"""Receives the folder of recordings and parameter files, a pool, and what receives the finished
fraction; returns answers by the names of the recordings."""
Show = Callable[[str], AbstractContextManager[Callable[[float], None]]]
"""Receives the name of a stage; gives a context with what receives the finished fraction."""


def draw(folder: Path, seed: int | None, count: int, pool: Executor,
         show: Callable[[float], None]) -> str:
    """
    Draw a check and commit to its labels, or continue the check of the folder.

    Parameters
    ----------
    folder
        Empty, or with an interrupted check.
    seed
        Seed of the trials; None draws one.
    count
        Number of trials, without those at strength zero.
    pool
        Draws in parallel.
    show
        Receives the fraction that is finished.

    Returns
    -------
    str
        The published hash.

    Raises
    ------
    UserError
        The folder has a check of another seed or size, or something else.

    """
    digest = label_commitment.published_hash(folder)
    if digest is not None:
        existing: Setup | None = label_commitment.committed_labels(folder).setup
    else:
        existing = label_commitment.interrupted_setup(folder)
        if existing is None and any(folder.glob('*')):
            raise UserError(f'{folder}: is not empty and has no check; choose another folder')
    if seed is None:
        seed = existing.seed if existing else secrets.randbelow(2 ** 31)
    setup = Setup(seed, count)
    if existing not in (None, setup):
        raise UserError(f'{folder}: has a check of another seed or number of trials; repeat the '
                        'same options to continue it, or choose another folder')
    if digest is not None:
        return digest
    return label_commitment.commit(folder, setup, trials.plans(seed, count), pool, show)


def score(folder: Path, command: Sequence[str] | None, pool: Executor, show: Show,
          others: dict[str, OtherMethod] | None = None) -> dict[str, Any]:
    """
    Diagnose all recordings that have no report yet, read the labels and score.

    Parameters
    ----------
    folder
        Has a committed check.
    command
        The diagnosis; None for that of the package.
    pool
        Works in parallel.
    show
        Receives the name of a stage; gives a context with what receives the finished fraction.
    others
        Other methods to compare with, by name.

    Returns
    -------
    dict
        The content of blind.json.

    Raises
    ------
    UserError
        No labels are committed, they were changed, or recordings are missing.

    """
    digest = label_commitment.published_hash(folder)
    if digest is None:
        raise UserError(f'{folder}: no labels are committed there; use --seal {folder} first')
    label_commitment.remove_drawn(folder)
    label_commitment.refuse_encrypted(folder)
    # Labels may be on another machine: the diagnosis does not need them.
    with show('diagnose') as advance:
        results = diagnosis_runs.diagnose_all(folder, command, pool, advance)
    compared = {}
    for name, method in (others or {}).items():
        with show(name) as advance:
            compared[name] = method(folder / 'recordings', pool, advance)
    version = (folder / 'reports' / 'version.txt').read_text()
    committed = label_commitment.committed_labels(folder)
    labels = committed.labels
    missing = [label.name for label in labels if label.name not in results]
    if missing:
        raise UserError(f'{folder / "recordings"}: {missing[0]}.csv is missing, {len(missing)} '
                        'of the committed recordings in all; a check needs all of them')
    with show('held out') as advance:
        held_out = _held_out(folder, labels, results, pool, advance)
    answers = [grading.answer(results[label.name]) for label in labels]
    graded = [Trial(label, answer, held_out[label.name])
              for label, answer in zip(labels, answers)]
    made = scores.scores(graded, {name: [given[label.name] for label in labels]
                                  for name, given in compared.items()})
    controls = negative_controls.controls(folder, labels, answers)
    return {
        'schema': 1, 'hash': digest, 'seed': committed.setup.seed,
        'trials': committed.setup.trials, 'cases': len(labels), 'date': str(date.today()),
        'version': diagnosis_runs.package_version(), 'diagnose_code': version,
        'failed': {label.name: results[label.name]['error'] for label, answer
                   in zip(labels, answers) if answer.status == 'failed'},
        'bars': scores.bars(made), 'controls': controls,
        'leaks': any(control['leaks'] for control in controls.values()),
        'scores': made, 'rows': [_row(trial) for trial in graded]}


def _held_out(folder: Path, labels: Sequence[Label], results: dict[str, diagnosis_runs.Result],
              pool: Executor, show: Callable[[float], None]) -> dict[str, dict[str, Any] | None]:
    done = make_folder(folder / 'labels' / 'held')

    def keep(name: str, gap: dict[str, Any] | None) -> None:
        write(done / f'{name}.json', json.dumps(gap).encode())

    def job(label: Label) -> tuple:
        stated = (folder / 'recordings' / f'{label.name}.yaml').read_text()
        return label, stated, results[label.name]['parameters']

    todo = [label for label in labels if not (done / f'{label.name}.json').exists()]
    for_each(pool, held_out_gap.evaluate, [partial(job, label) for label in todo],
             keep, show, len(labels) - len(todo))
    return {label.name: json.loads((done / f'{label.name}.json').read_bytes())
            for label in labels}


def _row(trial: Trial) -> dict[str, Any]:
    """Return the data of one trial from which the scores follow."""
    label, answer = trial.label, trial.answer
    return {'name': label.name, 'group': label.group, 'effects': list(label.effects),
            'strength_mps2': [fault['strength_mps2'] for fault in label.faults],
            'power': [fault['power'] for fault in label.faults],
            'told': [fault['told'] for fault in label.faults],
            'inseparable': [fault['inseparable'] for fault in label.faults],
            'flexible': label.flexible, 'manoeuvre': label.manoeuvre, 'axes': label.axes,
            'status': answer.status, 'top': sorted(answer.top), 'named': sorted(answer.named),
            'probability': answer.probability,
            'right': grading.verdict_right(answer, label), 'seconds': answer.seconds,
            'ranks': grading.ranks(answer, label),
            'held': trial.held_out}
