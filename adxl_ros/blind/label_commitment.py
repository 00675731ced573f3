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
Commitment to labels: recordings in one folder, labels in another, and a published hash.

The hash of salt and labels is published before the diagnosis starts. It proves that the labels
did not change since. The diagnosis gets neither the folder of the labels nor a path to it: it
runs in a folder of its own (`diagnosis_runs`). The labels are not encrypted. To keep them from a
program that searches the disk, diagnose a copy of DIR/recordings on another machine.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass
from datetime import date
from functools import partial
import hashlib
import json
import os
from pathlib import Path
import secrets
import shutil
from typing import Any, NamedTuple

from adxl_ros.blind import trials
from adxl_ros.blind.trials import Label, Plan
from adxl_ros.errors import UserError
from adxl_ros.jobs.run import for_each
from adxl_ros.jobs.whole_files import make_folder, write


class Drawn(NamedTuple):
    """
    One drawn trial.

    Attributes
    ----------
    label
        Its label.
    recording, parameters
        Text of its recording (CSV) and of its parameter file (YAML).

    """

    label: Label
    recording: str
    parameters: str


class Setup(NamedTuple):
    """
    What determines the trials of a check.

    Attributes
    ----------
    seed
        Seed of all random numbers.
    trials
        Number of trials, without those at strength zero.

    """

    seed: int
    trials: int


@dataclass(frozen=True)
class CommittedLabels:
    """
    The content of the label file that the hash covers.

    Attributes
    ----------
    setup
        How the trials were drawn.
    labels
        The label of each trial.

    """

    setup: Setup
    labels: list[Label]


def draw(plan: Plan) -> Drawn:
    """Draw a trial: its label, its recording and its parameter file."""
    label = trials.draw(plan)
    return Drawn(label, trials.recording(label), trials.parameter_file(label))


def commit(folder: Path, setup: Setup, plans: list[Plan], pool: Executor,
           show: Callable[[float], None], make: Callable[[Plan], Drawn] = draw) -> str:
    """
    Draw trials into a folder and publish the hash of their labels.

    An interrupted call continues where it was.

    Parameters
    ----------
    folder
        Gets `recordings`, `labels` and `seal.json`.
    setup, plans
        Seed and size of the check, and its trials.
    pool
        Draws in parallel.
    show
        Receives the fraction that is finished.
    make
        Draws one trial.

    Returns
    -------
    str
        SHA-256 of salt and labels.

    """
    recordings = make_folder(folder / 'recordings')
    drawn = make_folder(_drawn(folder))

    def keep(label: Label, recording: str, parameters: str) -> None:
        for suffix, text in (('csv', recording), ('yaml', parameters)):
            path = recordings / f'{label.name}.{suffix}'
            write(path, text.encode('ascii'))
            # The time of writing would show how long the label took to draw.
            os.utime(path, (0, 0))
        row = {**setup._asdict(), 'label': json.loads(trials.as_json([label]))[0]}
        write(drawn / f'{label.name}.json', json.dumps(row).encode())

    todo = [plan for plan in plans if not (drawn / f'{plan.name}.json').exists()]
    for_each(pool, make, [partial(_arguments, plan) for plan in todo], keep, show,
             len(plans) - len(todo))
    rows = [_read_drawn(drawn / f'{plan.name}.json')['label'] for plan in plans]
    text = json.dumps({'salt': secrets.token_hex(16), **setup._asdict(), 'labels': rows},
                      indent=1).encode()
    digest = hashlib.sha256(text).hexdigest()
    write(_label_file(folder), text)
    write(_seal(folder), json.dumps({
        'sha256_of_salt_and_labels': digest, 'cases': len(plans), 'date': str(date.today()),
    }, indent=1).encode())
    remove_drawn(folder)
    return digest


def remove_drawn(folder: Path) -> None:
    """Remove what drawing left beside the labels, also after an interruption."""
    shutil.rmtree(_drawn(folder), ignore_errors=True)


def published_hash(folder: Path) -> str | None:
    """
    Return the published hash of a folder's labels; None before it is published.

    Raises
    ------
    UserError
        The file of the hash is damaged.

    """
    path = _seal(folder)
    try:
        return str(json.loads(path.read_bytes())['sha256_of_salt_and_labels'])
    except FileNotFoundError:
        return None
    except (ValueError, KeyError, TypeError):
        raise UserError(f'{path}: has no hash; draw a new check into another folder') from None


def interrupted_setup(folder: Path) -> Setup | None:
    """
    Return seed and number of trials of a check whose drawing was interrupted; None without one.

    Raises
    ------
    UserError
        A drawn label is damaged, or of an older version.

    """
    for path in _drawn(folder).glob('*.json'):
        row = _read_drawn(path)
        return Setup(row['seed'], row['trials'])
    return None


def committed_labels(folder: Path) -> CommittedLabels:
    """
    Read the labels and compare them with the published hash.

    Raises
    ------
    UserError
        There is no hash, the labels differ from it, or an older version encrypted them.

    """
    digest = published_hash(folder)
    if digest is None:
        raise UserError(f'{folder}: no labels are committed there; use --seal {folder} first')
    path = _label_file(folder)
    try:
        text = path.read_bytes()
    except FileNotFoundError:
        refuse_encrypted(folder)
        raise UserError(f'{path}: no such file; copy it from where the check was drawn') from None
    if hashlib.sha256(text).hexdigest() != digest:
        raise UserError(f'{path}: these are not the labels whose hash {digest} was published; '
                        'they were changed since')
    try:
        content: dict[str, Any] = json.loads(text)
        return CommittedLabels(Setup(content['seed'], content['trials']),
                               trials.from_json(json.dumps(content['labels'])))
    except (ValueError, KeyError, TypeError):
        raise _other_form(path) from None


def refuse_encrypted(folder: Path) -> None:
    """
    Refuse a folder whose labels an older version encrypted.

    Raises
    ------
    UserError
        There are encrypted labels and no others.

    """
    older = _label_file(folder).with_name('labels.sealed')
    if older.exists() and not _label_file(folder).exists():
        raise UserError(f'{older}: an older version encrypted these labels, which this version '
                        'cannot read; draw a new check into another folder')


def _read_drawn(path: Path) -> dict[str, Any]:
    try:
        row = json.loads(path.read_bytes())
        trials.from_json(json.dumps([row['label']]))
        return {'seed': int(row['seed']), 'trials': int(row['trials']), 'label': row['label']}
    except (ValueError, KeyError, TypeError):
        raise _other_form(path) from None


def _other_form(path: Path) -> UserError:
    return UserError(f'{path}: is damaged or of another version; draw a new check into another '
                     'folder')


def _drawn(folder: Path) -> Path:
    return folder / 'labels' / 'drawn'


def _label_file(folder: Path) -> Path:
    return folder / 'labels' / 'labels.json'


def _seal(folder: Path) -> Path:
    return folder / 'seal.json'


def _arguments(plan: Plan) -> tuple[Plan]:
    return (plan,)
