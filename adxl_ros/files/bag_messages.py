# SPDX-License-Identifier: Apache-2.0

"""
The messages of a rosbag2 recording, in any storage and compression.

The library rosbags reads the files. An MCAP file without its end, which a killed recorder leaves,
is read record by record up to the cut. metadata.yaml gives only the list of the files: a killed
recorder leaves none, and the bytes of files and messages show their compression.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import contextmanager, ExitStack
from dataclasses import replace
import os
from pathlib import Path
import re
import shutil
from tempfile import TemporaryDirectory
from typing import Any, Protocol

from adxl_ros.errors import install_hint, UserError
from adxl_ros.files import mcap_chunks, mcap_recovery
from adxl_ros.files.cdr import Raws
from adxl_ros.files.message_pieces import collected_pieces, Piece
import numpy as np
import yaml

_ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'
"""First bytes of data that zstd compressed (RFC 8878, section 3.1.1)."""

_ENDINGS = ('.mcap', '.db3', '.mcap.zstd', '.db3.zstd')
"""Ends of the names of files in a recording's directory."""


class Part(Protocol):
    """One file of a recording."""

    done: float  # Fraction of the file that has been read
    types: set[tuple[str, str]]  # Topics that hold messages, each with its type

    def messages(self, topics: Collection[str]) -> Iterator[tuple[str, bytes, int]]:
        """Yield topic, bytes and log time, ns, of each message, in the order of recording."""

    def pieces(self, topics: Collection[str]) -> Iterator[Piece]:
        """Yield the messages in pieces, in the order of recording."""


class Bag:
    """An open recording."""

    def __init__(self, path: str, parts: list[Part], cut: str) -> None:
        """Take the files of a recording."""
        self.path = path  # The file or directory, for messages
        self.cut = cut  # Where damaged files end; empty if all are whole
        # Topics that hold messages, each with its type
        self.types: set[tuple[str, str]] = set().union(*(part.types for part in parts))
        self._parts = parts
        self._read = 0

    @property
    def done(self) -> float:
        """Fraction of the recording that has been read."""
        if self._read == len(self._parts):
            return 1.0
        return (self._read + self._parts[self._read].done) / len(self._parts)

    def messages(self, topics: Collection[str]) -> Iterator[tuple[str, bytes]]:
        """Yield topic and CDR of each message of some topics, in the order of recording."""
        for topic, raw, _ in self.logged_messages(topics):
            yield topic, raw

    def logged_messages(self, topics: Collection[str]) -> Iterator[tuple[str, bytes, int]]:
        """Yield topic, CDR and log time, ns, of each message, in the order of recording."""
        self._read = 0
        for part in self._parts:
            for topic, raw, log_ns in part.messages(topics):
                # `--compression-mode message`: no CDR begins as compressed data does.
                raw = self._unpacked(topic, raw) if raw[:4] == _ZSTD_MAGIC else raw
                yield topic, raw, log_ns
            self._read += 1

    def pieces(self, topics: Collection[str]) -> Iterator[Piece]:
        """Yield the messages of some topics in pieces, in the order of recording."""
        self._read = 0
        for part in self._parts:
            for piece in part.pieces(topics):
                yield replace(piece, messages={topic: self._all_unpacked(topic, raws)
                                               for topic, raws in piece.messages.items()})
            self._read += 1

    def _all_unpacked(self, topic: str, raws: Raws) -> Raws:
        """Decompress the messages that are compressed one by one."""
        if isinstance(raws, np.ndarray):
            if not (raws[:, :len(_ZSTD_MAGIC)] == list(_ZSTD_MAGIC)).all(axis=1).any():
                return raws
            raws = [row.tobytes() for row in raws]
        return [self._unpacked(topic, raw) if raw[:4] == _ZSTD_MAGIC else raw for raw in raws]

    def _unpacked(self, topic: str, raw: bytes) -> bytes:
        try:
            return mcap_recovery.unpack('zstd', raw)
        except ValueError as error:
            raise UserError(f'{self.path}: topic {topic}: {error}') from None


class _RosbagsPart:
    """A file that rosbags reads."""

    def __init__(self, path: Path, reader: Any) -> None:
        self.done = 0.0
        self.types = {(c.topic, c.msgtype) for c in reader.connections if c.msgcount}
        self._path = path
        self._reader = reader

    def _connections(self, topics: Collection[str]) -> list[Any]:
        """Return the connections of some topics; refuse those without CDR."""
        connections = [c for c in self._reader.connections if c.topic in topics and c.msgcount]
        for connection in connections:
            if connection.ext.serialization_format != 'cdr':
                raise UserError(f'{self._path}: topic {connection.topic} is serialized as '
                                f'{connection.ext.serialization_format}, expected cdr')
        return connections

    def messages(self, topics: Collection[str]) -> Iterator[tuple[str, bytes, int]]:
        connections = self._connections(topics)
        if not connections:
            return  # for rosbags, an empty choice means all connections
        share = 1 / sum(c.msgcount for c in connections)
        count = 0
        try:
            for connection, log_ns, raw in self._reader.messages(connections):
                count += 1
                self.done = count * share
                yield connection.topic, raw, log_ns
        except Exception as error:
            # In a damaged file, rosbags can raise errors of any kind.
            raise _unreadable(self._path, error) from error

    def pieces(self, topics: Collection[str]) -> Iterator[Piece]:
        storage = self._reader.storage
        names = {c.id: c.topic for c in self._connections(topics)}
        chunks = mcap_chunks.in_order(storage, names)
        if not chunks:
            yield from collected_pieces(self.messages(topics))
        for number, chunk in enumerate(chunks):
            self.done = (number + 1) / len(chunks)
            try:
                yield mcap_chunks.read_chunk(storage.bio, chunk, names)
            except Exception as error:
                # In a damaged file, rosbags can raise errors of any kind.
                raise _unreadable(self._path, error) from error


def _unreadable(path: Path, error: Exception) -> UserError:
    """Return the error of a file that rosbags cannot read."""
    reason = ' '.join(str(error).split()) or f'damaged ({type(error).__name__})'
    return UserError(f'{path}: cannot read it as a rosbag2 recording: {reason}')


def import_rosbags() -> Any:
    """Return the module rosbags.rosbag2."""
    try:
        import rosbags.rosbag2
    except ImportError:
        raise UserError('rosbag2 recordings need the Python package rosbags: '
                        + install_hint('rosbags>=0.11.8,<0.12')) from None
    return rosbags.rosbag2


@contextmanager
def open_bag(path: str | os.PathLike) -> Iterator[Bag]:
    """Open a rosbag2 directory, or one .mcap or .db3 file."""
    bag_path = Path(path)
    rosbag2 = import_rosbags()
    with ExitStack() as stack:
        parts: list[Part] = []
        cuts = []
        for name in _files(bag_path):
            file = _unzipped(stack, name) if name.suffix == '.zstd' else name
            part = _opened(stack, rosbag2, name, file)
            parts.append(part)
            if isinstance(part, mcap_recovery.ScannedMcap) and part.cut:
                cuts.append(f'{name}: {part.cut}')
        yield Bag(str(bag_path), parts, '; '.join(cuts))


def _opened(stack: ExitStack, rosbag2: Any, name: Path, file: Path) -> Part:
    """Open a file; `name` is its packed form, for messages. `stack` closes it."""
    is_mcap = file.suffix == '.mcap'
    if is_mcap and not mcap_recovery.is_whole(file):
        return stack.enter_context(mcap_recovery.open_scan(file))
    try:
        reader = stack.enter_context(rosbag2.Reader(file))
    except Exception as error:
        raise _unreadable(name, error) from error
    if is_mcap and not reader.storage.chunks:
        # Without an index, rosbags demands the messages of all topics in the order of time.
        return stack.enter_context(mcap_recovery.open_scan(file))
    return _RosbagsPart(name, reader)


def _unzipped(stack: ExitStack, path: Path) -> Path:
    """Unpack a file of `--compression-mode file`, up to its cut if it has one."""
    from backports import zstd
    folder = stack.enter_context(TemporaryDirectory())
    file = Path(folder, path.stem)
    try:
        with zstd.open(path, 'rb') as packed, open(file, 'wb') as unpacked:
            shutil.copyfileobj(packed, unpacked)
    except EOFError:
        pass  # the packed file is cut off; the unpacked one shows the cut again
    except (OSError, zstd.ZstdError) as error:
        raise _unreadable(path, error) from error
    return file


def _files(path: Path) -> list[Path]:
    """Return the files of a recording in the order of time."""
    if not path.is_dir():
        return [path]
    listed = _listed_files(path)
    files = sorted((file for file in path.iterdir() if file.name.endswith(_ENDINGS)),
                   key=_file_number) if listed is None else listed
    if not files:
        raise UserError(f'{path}: is a directory without metadata.yaml, .mcap or .db3 files; '
                        'expected a rosbag2 recording')
    for file in files:
        if not file.exists():
            raise UserError(f'{path}: metadata.yaml names {file.name}, which is not there')
    return files


def _listed_files(path: Path) -> list[Path] | None:
    """Return the files that metadata.yaml names; None where it does not exist."""
    metadata = path / 'metadata.yaml'
    try:
        with open(metadata, encoding='utf-8') as file:
            content = yaml.safe_load(file)
        names = content['rosbag2_bagfile_information']['relative_file_paths']
        return [path / Path(name).name for name in names]
    except FileNotFoundError:
        return None
    except (OSError, ValueError, TypeError, KeyError, yaml.YAMLError) as error:
        raise UserError(f'{metadata}: does not list the files of a recording: '
                        f'{" ".join(str(error).split())}; run ros2 bag reindex') from None


def _file_number(path: Path) -> tuple[int, str]:
    """Return a key that sorts name_10.mcap behind name_9.mcap, as ros2 bag numbers files."""
    number = re.search(r'_(\d+)\.(mcap|db3)', path.name)
    return (int(number[1]) if number else 0, path.name)
