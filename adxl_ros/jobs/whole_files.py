# SPDX-License-Identifier: Apache-2.0

"""Small files that are written as a whole or not at all."""

from __future__ import annotations

import os
from pathlib import Path

from adxl_ros.errors import UserError


def write(path: Path, data: bytes) -> None:
    """Write a file as a whole or not at all; several processes may write the same one at once."""
    temporary = path.with_name(f'.{path.name}.{os.uname().nodename}.{os.getpid()}')
    try:
        temporary.write_bytes(data)
        os.replace(temporary, path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise UserError(f'{path}: cannot be written: {error.strerror}') from None


def make_folder(folder: Path) -> Path:
    """Make a folder and return it."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f'{folder}: cannot be made: {error.strerror}') from None
    return folder
