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

"""The journal of a calibration: every accepted pose on disk before it is acknowledged."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from datetime import datetime, timezone
import fcntl
import json
import os
from pathlib import Path
import shutil
from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.files.atomic_write import atomic_path, sync

FORMAT = 1


class NotJournalError(UserError):
    """A line is none of a journal; `lines` are those before it."""

    def __init__(self, path: Path, number: int, why: object, lines: list[dict[str, Any]]) -> None:
        self.why, self.lines = f'line {number} is not of a journal ({why})', lines
        super().__init__(f'{path}:{number}: not a journal: {why}')


class Journal:
    """
    An append-only file of JSON lines: a head that says what is calibrated, then entries.

    The file is locked while it is open, so that two calibrations cannot share it.

    Parameters
    ----------
    path
        The file; made if it is not there.
    head
        What must be the same for entries to belong together: unit, mode, plan.
    anew
        Begin anew beside an interrupted calibration, which is kept under its time.

    Attributes
    ----------
    entries
        What an interrupted calibration with the same head left, in order.

    Raises
    ------
    UserError
        Locked by another calibration, of another head (says what differs), not a journal, or not
        writable.

    """

    def __init__(self, path: str | os.PathLike, head: dict[str, Any], anew: bool = False):
        self.path = Path(path)
        head = _written(head)
        try:
            self._file = open(self.path, 'a+b', buffering=0)  # noqa: SIM115 (kept open)
        except OSError as error:
            raise UserError(f'{path}: cannot write the journal: {error.strerror}; choose a '
                            'directory that exists and can be written') from None
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            self._file.close()
            raise UserError(f'{path}: another calibration is writing this journal; finish or '
                            'abort it, or choose another journal') from None
        try:
            self.entries = self._resume(head, anew)
        except UserError:
            self._file.close()
            raise

    def append(self, entry: dict[str, Any]) -> None:
        """
        Write one entry and wait until it is on the disk.

        Raises
        ------
        UserError
            The disk does not take it; the journal stays as it was.

        """
        before = self._file.seek(0, os.SEEK_END)
        line = json.dumps(entry).encode() + b'\n'
        try:
            if self._file.write(line) != len(line):
                raise OSError(0, 'the disk is full')
            os.fsync(self._file.fileno())
        except OSError as error:
            with suppress(OSError):
                self._file.truncate(before)
            raise UserError(f'{self.path}: cannot write the journal: {error.strerror}; make '
                            'room and try again') from None

    def close(self) -> None:
        """Let the file go, for others to lock."""
        self._file.close()

    def _resume(self, head: dict[str, Any], anew: bool) -> list[dict[str, Any]]:
        try:
            known, whole = _parse(self.path)
        except NotJournalError as error:
            if not anew:
                raise UserError(
                    f'{error}; {len(accepted_poses(error.lines))} poses before it can be read; '
                    'name another journal, or begin anew with resume:=anew (this file is kept)'
                ) from None
            known, whole = [{}], 0
        if known and (anew or _ended(known, head)):
            # A finished one is kept until the next is finished, all else for ever.
            name = 'previous' if known[-1].get('done') else \
                datetime.now(timezone.utc).strftime('%Y%m%dT%H%M%S.%fZ')
            with atomic_path(self.path.with_name(f'{self.path.name}.{name}')) as kept:
                shutil.copyfile(self.path, kept)
            known, whole = [], 0
        if known and (changed := differences(known[0], head)):
            raise UserError(f'{self.path}: holds an unfinished calibration of another kind: '
                            f'{changed}; go back, or begin anew with resume:=anew (it is kept)')
        self._file.truncate(whole)
        if not known:
            self.append(head)
            sync(self.path.parent)
            return []
        return known[1:]


def read(path: str | os.PathLike) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """
    Read the head and the entries of a journal.

    Raises
    ------
    UserError
        Not readable or not a journal.

    """
    try:
        lines, _ = _parse(Path(path))
    except OSError as error:
        raise UserError(f'{path}: cannot be read: {error.strerror}') from None
    if not lines:
        raise UserError(f'{path}: an empty journal')
    return lines[0], lines[1:]


def unfinished(path: str | os.PathLike, head: dict[str, Any]) -> tuple[int, str] | None:
    """
    Look for an interrupted calibration, without a lock.

    Returns
    -------
    poses, differences
        How many poses it has, and how its head differs from this one, or which line is none of a
        journal; None where there is none.

    Raises
    ------
    UserError
        Not readable.

    """
    if not Path(path).exists():
        return None
    try:
        lines, _ = _parse(Path(path))
    except NotJournalError as error:
        return len(accepted_poses(error.lines)), error.why
    except OSError as error:
        raise UserError(f'{path}: cannot be read: {error.strerror}') from None
    poses, head = len(accepted_poses(lines)), _written(head)
    if not poses or _ended(lines, head):
        return None
    return poses, differences(lines[0], head)


def differences(was: dict[str, Any], now: dict[str, Any]) -> str:
    """Say in which keys two heads differ, in the order of the present one: the unit first."""
    return ', '.join(f'{key} was {_short(was.get(key))}, is {_short(now.get(key))}'
                     for key in {**now, **was} if was.get(key) != now.get(key))


def _ended(lines: Sequence[dict[str, Any]], head: dict[str, Any]) -> bool:
    """
    Tell whether a calibration is over, so that another may begin.

    One that was fitted with poses left open (`done` is false) can go on, but is in nobody's way.
    """
    done = lines[-1].get('done')
    return bool(done) or (done is not None and bool(differences(lines[0], head)))


def skipped_poses(entries: Sequence[dict[str, Any]]) -> set[int]:
    """Return the poses that the operator left out and did not ask for again."""
    found: set[int] = set()
    for entry in entries:
        found.discard(entry.get('drop', -1))
        if 'skip' in entry:
            found.add(entry['skip'])
    return found


def accepted_poses(entries: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the accepted poses in order; one that was taken again replaces the earlier one."""
    poses: dict[int, dict[str, Any]] = {}
    for entry in entries:
        if 'pose' in entry:
            poses[entry['pose']] = entry
        poses.pop(entry.get('drop', -1), None)
    return [poses[number] for number in sorted(poses)]


def _parse(path: Path) -> tuple[list[dict[str, Any]], int]:
    """Return the whole lines and their length in bytes; a last line cut by a crash is left."""
    lines, whole = [], 0
    data = path.read_bytes()
    # A crash may have left the beginning of the head, or its length without its bytes.
    if b'\n' not in data and data.strip(b'\0') and not data.startswith(b'{'):
        raise NotJournalError(path, 1, 'it does not begin with {', lines)
    for number, raw in enumerate(_whole_lines(data), 1):
        try:
            entry = json.loads(raw)
            if not isinstance(entry, dict):
                raise ValueError('not an object')
        except ValueError as error:
            raise NotJournalError(path, number, error, lines) from None
        lines.append(entry)
        whole += len(raw) + 1
    if lines and lines[0].get('format') != FORMAT:
        raise NotJournalError(path, 1, f'format {lines[0].get("format")!r}, but this package '
                              f'reads version {FORMAT}', [])
    return lines, whole


def _whole_lines(data: bytes) -> Iterator[bytes]:
    yield from data.split(b'\n')[:-1]


def _written(head: dict[str, Any]) -> dict[str, Any]:
    """Return a head as it is read again."""
    return json.loads(json.dumps({'format': FORMAT, **head}))


def _short(value: Any) -> str:
    text = json.dumps(value)
    return text if len(text) < 60 else f'{text[:57]}...'
