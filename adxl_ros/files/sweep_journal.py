# SPDX-License-Identifier: Apache-2.0

"""The journal of a calibration: records of its poses, on disk before they are acknowledged."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import datetime, timezone
import fcntl
import json
import math
from pathlib import Path
import shutil
from typing import Any, NamedTuple, TypeAlias

from adxl_ros.errors import UserError
from adxl_ros.files.atomic_write import AnyPath, append_line, atomic_path, sync

FORMAT = 1
"""Version of the format, in the head of each journal; raised with each change of the lines."""


def _with_tuples(line: Mapping[str, Any]) -> dict[str, Any]:
    """Return keys and values of a line with tuples in place of lists."""
    return {key: tuple(value) if isinstance(value, list) else value for key, value in line.items()}


@dataclass(frozen=True, kw_only=True)
class PoseRecord:
    """One accepted pose: the mean output at rest and the joint angles."""

    pose: int  # Number of the pose in the pose plan, or of the rest of a hand-held sensor, from 0
    alpha_rad: float = math.nan  # Joint angles, rad; NaN without a stage
    beta_rad: float = math.nan
    # Numbers of the settings of the joints; None without a stage, or where only angles are known
    alpha_setting: int | None = None
    beta_setting: int | None = None
    check: bool = False  # Whether the pose is kept out of the fit
    start_ns: int  # Stamps of the first and the last sample, ns
    stop_ns: int
    samples: int  # Number of samples
    mean_v: tuple[float, ...]  # Mean output of each axis, and its standard deviation, V, (m,)
    std_v: tuple[float, ...]
    temperature_c: float = math.nan  # Means over the rest, °C and V; NaN without readings
    supply_v: float = math.nan

    def to_json(self) -> dict[str, Any]:
        """Return the keys and values of the record's line; NaN and None have no key."""
        return {
            key: value
            for key, value in asdict(self).items()
            if value is not None and value == value
        }  # NaN differs from itself

    @classmethod
    def from_json(cls, line: Mapping[str, Any]) -> PoseRecord:
        """Read the record of a line."""
        return cls(**_with_tuples(line))


@dataclass(frozen=True)
class PoseDropped:
    """A pose that does not count any more, because it is taken again."""

    pose: int


@dataclass(frozen=True)
class PoseSkipped:
    """A pose that the operator leaves out."""

    pose: int


@dataclass(frozen=True)
class MountingUnchecked:
    """A note that the operator skipped the check of the mounting."""


@dataclass(frozen=True)
class Fitted:
    """A note that a fit is written."""

    rests: tuple[PoseRecord, ...]  # Poses of the fit
    done: bool  # Whether no pose was open, so that the calibration is over


@dataclass(frozen=True, kw_only=True)
class NaturalRest:
    """A rest of a robot at work, by which its calibration is kept."""

    stay: int  # Number of the stay: between two rests of one stay the robot has not moved
    start_ns: int  # Stamps of the first and the last sample, ns
    stop_ns: int
    mean_v: tuple[float, ...]  # Mean output of each axis, and its standard deviation, V, (m,)
    std_v: tuple[float, ...]
    temperature_c: float  # Mean over the rest, °C


@dataclass(frozen=True, kw_only=True)
class Adopted:
    """A calibration that is in use from here on."""

    stamp_ns: int  # Stamp of the newest rest in it, ns
    values: tuple[float, ...]  # Its coefficients, in the order of the head's names


@dataclass(frozen=True)
class Undone:
    """A note that the newest adoption was undone."""

    undone_ns: int  # When, ns


JournalEntry: TypeAlias = (
    PoseRecord
    | PoseDropped
    | PoseSkipped
    | MountingUnchecked
    | Fitted
    | NaturalRest
    | Adopted
    | Undone
)
"""What a line of a journal after its head may hold."""


_LINES: Mapping[type, Callable[[Any], dict[str, Any]]] = {
    PoseRecord: PoseRecord.to_json,
    PoseDropped: lambda entry: {'drop': entry.pose},
    PoseSkipped: lambda entry: {'skip': entry.pose, 'drop': entry.pose},
    MountingUnchecked: lambda entry: {'mounting': 'not checked'},
    Fitted: lambda entry: {'rests': [rest.to_json() for rest in entry.rests], 'done': entry.done},
    NaturalRest: asdict,
    Adopted: asdict,
    Undone: asdict,
}
"""What makes the keys and values of the line of an entry."""

_ENTRIES: Mapping[str, Callable[[Any], JournalEntry]] = {
    'pose': PoseRecord.from_json,
    'skip': lambda line: PoseSkipped(line['skip']),
    'drop': lambda line: PoseDropped(line['drop']),
    'mounting': lambda line: MountingUnchecked(),
    'rests': lambda line: Fitted(tuple(map(PoseRecord.from_json, line['rests'])), line['done']),
    'stay': lambda line: NaturalRest(**_with_tuples(line)),
    'values': lambda line: Adopted(**_with_tuples(line)),
    'undone_ns': lambda line: Undone(**line),
}
"""What makes an entry of a line, by the first of these keys that the line has."""


def _entry(line: Mapping[str, Any]) -> JournalEntry:
    """Return the entry of a line."""
    for key, make in _ENTRIES.items():
        if key in line:
            return make(line)
    raise ValueError('no pose, drop, skip, mounting or fit')


class JournalContents(NamedTuple):
    """What a journal holds."""

    head: dict[str, Any]  # What must be the same for poses to belong together; empty without one
    entries: list[JournalEntry]  # All entries, in the order in which they were written
    size: int  # Size of the lines, bytes, without one that a crash has cut
    damage: str  # Which line is none of a journal, and why; empty if all are

    @property
    def has_fit(self) -> bool:
        """Whether the last entry is a fit."""
        return bool(self.entries) and isinstance(self.entries[-1], Fitted)

    @property
    def is_finished(self) -> bool:
        """Whether the last entry is a fit without open poses, and no line is damaged."""
        last = self.entries[-1] if self.entries else None
        return isinstance(last, Fitted) and last.done and not self.damage

    def is_over(self, head: Mapping[str, Any]) -> bool:
        """
        Return whether the calibration is over, so that another may begin.

        One that was fitted with open poses can be resumed. For another head it is over.
        """
        is_of_other = self.has_fit and bool(differences(self.head, head))
        return self.is_finished or is_of_other


class Unfinished(NamedTuple):
    """An interrupted calibration."""

    poses: int  # Number of its accepted poses
    # Why it cannot be resumed: how its head differs, or which line is damaged; '' if it can
    obstacle: str


class Journal:
    """An append-only file of JSON lines, locked while it is open: a head, then entries."""

    def __init__(self, path: AnyPath, head: Mapping[str, Any], start_over: bool = False) -> None:
        self.path = Path(path)
        try:
            self._file = open(self.path, 'a+b', buffering=0)  # noqa: SIM115 (kept open)
        except OSError as error:
            raise UserError(
                f'{path}: cannot write the journal: {error.strerror}; choose a '
                'directory that exists and can be written'
            ) from None
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            self._file.close()
            raise UserError(
                f'{path}: another calibration is writing this journal; finish or '
                'abort it, or choose another journal'
            ) from None
        try:
            # Entries of an interrupted calibration with the same head, in order
            self.entries = self._resume(_as_read(head), start_over)
        except UserError:
            self._file.close()
            raise

    def append(self, entry: JournalEntry) -> None:
        """Write one entry and wait until it is on the disk."""
        self._append_line(_LINES[type(entry)](entry))

    def close(self) -> None:
        """Close the file, so that others can lock it."""
        self._file.close()

    def _append_line(self, line: Mapping[str, Any]) -> None:
        try:
            append_line(self._file, json.dumps(line))
        except OSError as error:
            raise UserError(
                f'{self.path}: cannot write the journal: {error.strerror}; make room and try again'
            ) from None

    def _resume(self, head: dict[str, Any], start_over: bool) -> list[JournalEntry]:
        """Return the entries of an interrupted calibration, or begin a new file with the head."""
        found = _parse(self.path)
        if found.damage and not start_over:
            raise UserError(
                f'{self.path}: {found.damage}; {len(accepted_poses(found.entries))} poses before '
                'it can be read; name another journal, or begin again with resume:=anew (this '
                'file is kept)'
            )
        is_new = not found.head and not found.damage
        is_over = start_over or found.is_over(head)
        if is_over and not is_new:
            # A finished journal is kept until the next one is finished, others for ever.
            name = datetime.now(timezone.utc).strftime('%Y%m%dT%H%M%S.%fZ')
            if found.is_finished:
                name = 'previous'
            with atomic_path(self.path.with_name(f'{self.path.name}.{name}')) as copy:
                shutil.copyfile(self.path, copy)
            is_new = True
        if is_new:
            self._file.truncate(0)
            self._append_line(head)
            sync(self.path.parent)
            return []
        if changed := differences(found.head, head):
            raise UserError(
                f'{self.path}: holds an unfinished calibration of another kind: '
                f'{changed}; go back, or begin again with resume:=anew (it is kept)'
            )
        self._file.truncate(found.size)
        return found.entries


def read(path: AnyPath) -> JournalContents:
    """Read the head and the entries of a journal."""
    found = _parse(Path(path))
    if found.damage or not found.head:
        raise UserError(f'{path}: {found.damage or "an empty journal"}')
    return found


def unfinished(path: AnyPath, head: Mapping[str, Any]) -> Unfinished | None:
    """Look for an interrupted calibration, without a lock."""
    if not Path(path).exists():
        return None
    found = _parse(Path(path))
    new_head = _as_read(head)
    poses = len(accepted_poses(found.entries))
    if found.damage:
        return Unfinished(poses, found.damage)
    return (
        Unfinished(poses, differences(found.head, new_head))
        if poses and not found.is_over(new_head)
        else None
    )


def differences(old: Mapping[str, Any], new: Mapping[str, Any]) -> str:
    """Return in which keys two heads differ."""
    return ', '.join(
        f'{key} was {json.dumps(old.get(key))}, is {json.dumps(new.get(key))}'
        for key in {**new, **old}
        if old.get(key) != new.get(key)
    )


def skipped_poses(entries: Sequence[JournalEntry]) -> set[int]:
    """Return the numbers of the poses that are left out and not asked for again."""
    skipped: set[int] = set()
    for entry in entries:
        if isinstance(entry, PoseSkipped):
            skipped.add(entry.pose)
        elif isinstance(entry, PoseDropped):
            skipped.discard(entry.pose)
    return skipped


def accepted_poses(entries: Sequence[JournalEntry]) -> list[PoseRecord]:
    """Return the accepted poses by number; a pose that is taken again replaces the earlier."""
    poses: dict[int, PoseRecord] = {}
    for entry in entries:
        if isinstance(entry, PoseRecord):
            poses[entry.pose] = entry
        elif isinstance(entry, PoseDropped | PoseSkipped):
            poses.pop(entry.pose, None)
    return [poses[number] for number in sorted(poses)]


def poses_to_fit(entries: Sequence[JournalEntry]) -> list[PoseRecord]:
    """Return the poses of the last fit, or the accepted ones if the sweep went on since."""
    for entry in reversed(entries):
        if isinstance(entry, Fitted):
            return list(entry.rests)
        if isinstance(entry, PoseRecord | PoseDropped | PoseSkipped):
            break
    return accepted_poses(entries)


def _parse(path: Path) -> JournalContents:
    """Return the contents up to the end, or to a damaged line."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UserError(f'{path}: cannot be read: {error.strerror}') from None
    head: dict[str, Any] = {}
    entries: list[JournalEntry] = []
    # A crash may have left the beginning of the head, or its length without its bytes.
    begins_otherwise = data.strip(b'\0') and not data.startswith(b'{')
    if b'\n' not in data and begins_otherwise:
        return JournalContents(
            head, entries, 0, 'line 1 is not of a journal (it does not begin with {)'
        )
    size = 0
    # The text after the last newline is a line that a crash has cut.
    for number, raw in enumerate(data.split(b'\n')[:-1], 1):
        try:
            line = json.loads(raw)
            if not isinstance(line, dict):
                raise ValueError('not an object')
            if number > 1:
                entries.append(_entry(line))
            elif line.get('format') == FORMAT:
                head = line
            else:
                raise ValueError(
                    f'format {line.get("format")!r}, but this package reads version {FORMAT}'
                )
        except (ValueError, TypeError, KeyError) as error:
            return JournalContents(
                head, entries, size, f'line {number} is not of a journal ({error})'
            )
        size += len(raw) + 1
    return JournalContents(head, entries, size, '')


def _as_read(head: Mapping[str, Any]) -> dict[str, Any]:
    """Return a head as it is read from a file: with its format, and tuples as lists."""
    return json.loads(json.dumps({'format': FORMAT, **head}))
