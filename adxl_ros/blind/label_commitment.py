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
Recordings in one folder, labels in another, sealed by the hash of labels and salt.

While the labels are sealed they lie encrypted in DIR/labels; the key is in the user's own state
folder, not in DIR, so that neither a look around nor a known path gives them away. A program of
the same user that searches that folder could still find it: who must rule that out seals on one
machine and diagnoses DIR/recordings on another.
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
from typing import Any

from adxl_ros.blind import parallel_io, trials as cases
from adxl_ros.blind.trials import Label, Plan
from adxl_ros.errors import UserError

Draw = Callable[[Plan], tuple[Label, str, str]]


@dataclass(frozen=True)
class Sealed:
    """What the seal closes over: how the check was drawn, and its labels."""

    seed: int
    trials: int
    labels: list[Label]


def draw(plan: Plan) -> tuple[Label, str, str]:
    """Draw a case: its label, its recording and its parameter file."""
    label = cases.draw(plan)
    return label, cases.recording(label), cases.parameter_file(label)


def seal(folder: Path, seed: int, plans: list[Plan], trials: int, pool: Executor,
         show: Callable[[float], None], make: Draw = draw) -> str:
    """
    Draw cases into a folder and seal their labels; go on where an earlier call was cut short.

    Parameters
    ----------
    folder
        Gets `recordings`, `labels` and `seal.json`.
    seed, plans, trials
        Of the check.
    pool
        Draws in parallel.
    show
        Takes the fraction that is done.
    make
        Draws a case.

    Returns
    -------
    str
        SHA-256 of salt and labels.

    """
    recordings = parallel_io.make(folder / 'recordings')
    drawn = parallel_io.make(folder / 'labels' / 'drawn')

    def keep(label: Label, recording: str, parameters: str) -> None:
        name = label.name
        for suffix, text in (('csv', recording), ('yaml', parameters)):
            path = recordings / f'{name}.{suffix}'
            parallel_io.write(path, text.encode('ascii'))
            # When it was drawn would tell of the work that its label made.
            os.utime(path, (0, 0))
        row = {'seed': seed, 'trials': trials, 'label': json.loads(cases.as_json([label]))[0]}
        parallel_io.write(drawn / f'{name}.json', json.dumps(row).encode())

    todo = [plan for plan in plans if not (drawn / f'{plan.name}.json').exists()]
    parallel_io.each(pool, make, [partial(_only, plan) for plan in todo], keep, show,
                     len(plans) - len(todo))
    rows = [json.loads((drawn / f'{plan.name}.json').read_bytes())['label'] for plan in plans]
    text = json.dumps({'salt': secrets.token_hex(16), 'seed': seed, 'trials': trials,
                       'labels': rows}, indent=1).encode()
    digest = hashlib.sha256(text).hexdigest()
    key = secrets.token_bytes(32)
    key_path = _key_path(digest)
    parallel_io.make(key_path.parent)
    parallel_io.write(key_path, key)
    key_path.chmod(0o600)
    parallel_io.write(folder / 'labels' / 'labels.sealed', _crypt(text, key))
    parallel_io.write(folder / 'seal.json', json.dumps({
        'sha256_of_salt_and_labels': digest, 'cases': len(plans), 'date': str(date.today()),
    }, indent=1).encode())
    close(folder)
    return digest


def close(folder: Path) -> None:
    """Take away what drawing left beside the sealed labels, also where it was cut short there."""
    shutil.rmtree(folder / 'labels' / 'drawn', ignore_errors=True)


def _only(plan: Plan) -> tuple[Plan]:
    return (plan,)


def published(folder: Path) -> str | None:
    """Give the hash that a folder's labels are sealed with, None before that."""
    path = folder / 'seal.json'
    try:
        return str(json.loads(path.read_bytes())['sha256_of_salt_and_labels'])
    except FileNotFoundError:
        return None
    except (ValueError, KeyError, TypeError):
        raise UserError(f'{path}: is no seal; seal anew into another folder') from None


def begun(folder: Path) -> tuple[int, int] | None:
    """Give seed and trials of a check that was cut short while it was drawn."""
    for path in (folder / 'labels' / 'drawn').glob('*.json'):
        row = json.loads(path.read_bytes())
        return row['seed'], row['trials']
    return None


def unseal(folder: Path, leave_open: bool = True) -> Sealed:
    """
    Open the labels, check them against the published hash, and leave them in the open or not.

    Raises
    ------
    UserError
        The key is not here, or the labels are not those that were sealed.

    """
    digest = published(folder)
    if digest is None:
        raise UserError(f'{folder}: nothing is sealed there; use --seal {folder} first')
    plain, sealed = folder / 'labels' / 'labels.json', folder / 'labels' / 'labels.sealed'
    if plain.exists():
        text = plain.read_bytes()
    else:
        key = _key_path(digest)
        try:
            text = _crypt(sealed.read_bytes(), key.read_bytes())
        except OSError as error:
            raise UserError(f'{error.filename}: {error.strerror}; it is needed to open the '
                            f'labels: copy it from where {folder} was sealed') from None
    if hashlib.sha256(text).hexdigest() != digest:
        raise UserError(f'{folder / "labels"}: the labels are not those whose hash {digest} was '
                        'published; they have been changed since')
    if leave_open and not plain.exists():
        parallel_io.write(plain, text)
    what: dict[str, Any] = json.loads(text)
    return Sealed(what['seed'], what['trials'], cases.from_json(json.dumps(what['labels'])))


def _key_path(digest: str) -> Path:
    home = os.environ.get('XDG_STATE_HOME') or Path.home() / '.local' / 'state'
    return Path(home) / 'adxl_ros' / 'blind' / f'{digest}.key'


def _crypt(data: bytes, key: bytes) -> bytes:
    """Encrypt or decrypt: a key is used once, so its SHAKE-256 stream is a one-time pad."""
    stream = hashlib.shake_256(key).digest(len(data))
    return (int.from_bytes(data, 'little') ^ int.from_bytes(stream, 'little')).to_bytes(
        len(data), 'little')
