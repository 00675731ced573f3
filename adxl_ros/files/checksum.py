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

"""Which data a calibration was made of."""

from __future__ import annotations

from collections.abc import Sequence
import hashlib
import os
from pathlib import Path

from adxl_ros.errors import UserError


def sha256(paths: Sequence[str | os.PathLike]) -> str:
    """
    Return the SHA-256 of recordings, hexadecimal; of one file that of `sha256sum`.

    Of several files it is that of their own sums, a line each, in the order that is given, those
    of a bag's directory by name: their place on the disk does not matter.

    Raises
    ------
    UserError
        One cannot be read.

    """
    files: list[Path] = []
    for path in map(Path, paths):
        files += sorted(p for p in path.rglob('*') if p.is_file()) if path.is_dir() else [path]
    sums = [_of_file(path) for path in files]
    return sums[0] if len(sums) == 1 else \
        hashlib.sha256(''.join(f'{one}\n' for one in sums).encode()).hexdigest()


def _of_file(path: Path) -> str:
    try:
        with open(path, 'rb') as file:
            found = hashlib.sha256()
            while block := file.read(1 << 20):
                found.update(block)
    except OSError as error:
        raise UserError(f'{path}: cannot be read: {error.strerror}') from None
    return found.hexdigest()
