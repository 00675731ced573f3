# SPDX-License-Identifier: Apache-2.0

"""
Formats of a sensor for other software, one file each.

A format is a module with `HOLDS`, the parts of a sensor that it holds with their places in the
file, and `text(export)`. It is found by its file,
whose name may end in an underscore.
"""

from __future__ import annotations

from importlib import import_module
import pkgutil
from typing import cast

from adxl_ros.files.exports.base import ExportFormat


def format_names() -> list[str]:
    """Return the names of the formats."""
    return [module.rstrip('_') for module in _modules()]


def format_named(name: str) -> ExportFormat:
    """Return the format of that name, one of `format_names`."""
    module = next(module for module in _modules() if module.rstrip('_') == name)
    return cast(ExportFormat, import_module(f'{__name__}.{module}'))


def _modules() -> list[str]:
    """Return the modules of the formats; `json_` must not hide that of Python."""
    return [module.name for module in pkgutil.iter_modules(__path__) if module.name != 'base']
