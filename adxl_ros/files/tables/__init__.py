# SPDX-License-Identifier: Apache-2.0

"""
Formats of tables, one file each.

A format is a module with `ENDINGS`, the ends of its files' names, and `open_table(path, topic)`.
It is found by its file. A name with any other end is delimited text.
"""

from __future__ import annotations

from importlib import import_module
import os
from pathlib import Path
import pkgutil

from adxl_ros.files.tables import delimited_text
from adxl_ros.files.tables.base import Table


def is_text(path: str | os.PathLike) -> bool:
    """Return whether a file is delimited text, by the end of its name."""
    return not any(_is_named(path, format_name) for format_name in _formats())


def open_table(path: str | os.PathLike, topic: str = '') -> Table:
    """Open a table of any format."""
    name = next((name for name in _formats() if _is_named(path, name)), delimited_text.NAME)
    return import_module(f'{__name__}.{name}').open_table(str(path), topic)


def _formats() -> list[str]:
    """Return the formats besides text."""
    return [module.name for module in pkgutil.iter_modules(__path__)
            if module.name not in ('base', delimited_text.NAME)]


def _is_named(path: str | os.PathLike, format_name: str) -> bool:
    """Return whether the end of a file's name is that of a format."""
    endings = import_module(f'{__name__}.{format_name}').ENDINGS
    return Path(path).suffix.lower() in endings


def table_endings() -> tuple[str, ...]:
    """Return the ends of the names of tables that are no text."""
    return tuple(ending for name in _formats()
                 for ending in import_module(f'{__name__}.{name}').ENDINGS)
