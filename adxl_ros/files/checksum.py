# SPDX-License-Identifier: Apache-2.0

"""The checksum that states which recordings a calibration was made from."""

from __future__ import annotations

from collections.abc import Sequence
import hashlib
import os
from pathlib import Path

from adxl_ros.errors import UserError

_READ_BYTES = 1 << 20
"""Bytes that are read at a time (chosen: bounds the memory for files of any size)."""


def sha256(paths: Sequence[str | os.PathLike]) -> str:
    """
    Return the SHA-256 of recordings, hexadecimal; for one file, that of `sha256sum`.

    For several files it is the SHA-256 of their own checksums, one a line, in the given order.
    The files of a bag's directory are in the order of their names. Paths do not enter.
    """
    files: list[Path] = []
    for path in map(Path, paths):
        files += sorted(p for p in path.rglob('*') if p.is_file()) if path.is_dir() else [path]
    checksums = [_file_sha256(path) for path in files]
    if len(checksums) == 1:
        return checksums[0]
    return hashlib.sha256(''.join(f'{line}\n' for line in checksums).encode()).hexdigest()


def _file_sha256(path: Path) -> str:
    try:
        with open(path, 'rb') as file:
            checksum = hashlib.sha256()
            while block := file.read(_READ_BYTES):
                checksum.update(block)
    except OSError as error:
        raise UserError(f'{path}: cannot be read: {error.strerror}') from None
    return checksum.hexdigest()
