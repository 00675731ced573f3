# SPDX-License-Identifier: Apache-2.0
"""The folder of a check: its recordings, and labels to which a published hash commits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from datetime import date
from functools import partial
import hashlib
import json
import os
from pathlib import Path
import secrets
import shutil
from typing import Any, NamedTuple

from adxl_ros.errors import UserError
from adxl_ros.workers import for_each, make_folder, Pool, write
from adxl_ros_validation.blind.trials import Drawn, Label, Plan


class Setup(NamedTuple):
    """What determines the trials of a check."""

    seed: int  # seed of all random numbers
    trials: int  # number of trials, without those at strength zero


def seal(folder: Path, seed: int | None, count: int, plan_all: Callable[[int, int], list[Plan]],
         make: Callable[[Plan], Drawn], pool: Pool, show: Callable[[float], None]) -> str:
    """
    Draw trials into a folder and publish the hash of their labels.

    A call on a folder that has them returns the hash; an interrupted one continues.
    """
    digest, drawn = published_hash(folder), folder / 'labels' / 'drawn'
    existing = None
    if digest is not None:
        existing = committed_labels(folder)[0]
    elif (drawn / 'setup').exists():
        existing = Setup(*json.loads((drawn / 'setup').read_bytes()))
    elif any(folder.glob('*')):
        raise UserError(f'{folder}: is not empty and has no check; choose another folder')
    if seed is None:
        seed = existing.seed if existing else secrets.randbelow(2 ** 31)
    setup = Setup(seed, count)
    if existing not in (None, setup):
        raise UserError(f'{folder}: has a check of another seed or number of trials; repeat the '
                        'same options to continue it, or choose another folder')
    if digest is None:
        write(make_folder(drawn) / 'setup', json.dumps(setup).encode())
        plans, recordings = plan_all(*setup), make_folder(folder / 'recordings')

        def keep(label: Label, *texts: str | None) -> None:
            for suffix, text in zip(('csv', 'yaml', 'sim'), texts):
                if text is not None:
                    path = recordings / f'{label.name}.{suffix}'
                    write(path, text.encode())
                    # The time of writing would show how long the label took to draw.
                    os.utime(path, (0, 0))
            write(drawn / f'{label.name}.json', json.dumps(asdict(label)).encode())

        todo = [plan for plan in plans if not (drawn / f'{plan.name}.json').exists()]
        for_each(pool, make, [partial(tuple, (plan,)) for plan in todo], keep, show,
                 len(plans) - len(todo))
        rows = [json.loads(path.read_bytes()) for path in sorted(drawn.glob('*.json'))]
        text = json.dumps({'salt': secrets.token_hex(16), **setup._asdict(), 'labels': rows},
                          indent=1).encode()
        digest = hashlib.sha256(text).hexdigest()
        write(folder / 'labels' / 'labels.json', text)
        write(folder / 'seal.json', json.dumps({
            'sha256_of_salt_and_labels': digest, 'cases': len(rows), 'date': str(date.today()),
        }, indent=1).encode())
    shutil.rmtree(drawn, ignore_errors=True)
    return digest




def published_hash(folder: Path) -> str | None:
    """Return the published hash of a folder's labels; None before it is published."""
    path = folder / 'seal.json'
    try:
        return str(json.loads(path.read_bytes())['sha256_of_salt_and_labels'])
    except FileNotFoundError:
        return None
    except (ValueError, KeyError, TypeError):
        raise UserError(f'{path}: has no hash; draw a new check into another folder') from None


def committed_labels(folder: Path) -> tuple[Setup, list[Label]]:
    """Read the labels and compare them with the published hash."""
    digest, path = published_hash(folder), folder / 'labels' / 'labels.json'
    if digest is None:
        raise UserError(f'{folder}: no labels are committed there; use --seal {folder} first')
    try:
        text = path.read_bytes()
    except FileNotFoundError:
        raise UserError(f'{path}: no such file; copy it from where the check was drawn') from None
    if hashlib.sha256(text).hexdigest() != digest:
        raise UserError(f'{path}: these are not the labels whose hash {digest} was published; '
                        'they were changed since')
    try:
        content: dict[str, Any] = json.loads(text)
        return Setup(content['seed'], content['trials']), [Label(**row | {
            name: tuple(row[name]) for name in ('effects', 'seed', 'seconds')})
            for row in content['labels']]
    except (ValueError, KeyError, TypeError):
        raise UserError(f'{path}: is of another version; draw a new check into another folder'
                        ) from None
