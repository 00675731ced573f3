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

"""Small files that are written as a whole or not at all."""

from __future__ import annotations

import os
from pathlib import Path

from adxl_ros.errors import UserError


def write(path: Path, data: bytes) -> None:
    """
    Write a file as a whole or not at all; several processes may write the same one at once.

    Parameters
    ----------
    path
        The file.
    data
        Its content.

    Raises
    ------
    UserError
        It cannot be written.

    """
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
