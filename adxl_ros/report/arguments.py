# SPDX-License-Identifier: Apache-2.0

"""Checks of what a user gives, which say what is expected."""

from __future__ import annotations

from numbers import Integral, Real
import os
from pathlib import Path

from adxl_ros.errors import UserError
from adxl_ros.wording import option


def require_number(argument: str, value: object) -> None:
    """Refuse what is no number, in words of an argument; None is not given."""
    if value is not None and not isinstance(value, Real):
        raise UserError(f'{argument}: must be a number')


def require_least(name: str, value: float | None, least: float) -> None:
    """Refuse what is no number, or too small; None is not given."""
    argument = option(**{name: value})
    require_number(argument, value)
    if value is not None and not value >= least:
        raise UserError(f'{argument}: must be at least {least:g}')


def require_whole(name: str, value: object) -> None:
    """Refuse what is no whole number from 0 on, as a seed is."""
    if not isinstance(value, Integral) or value < 0:
        raise UserError(f'{option(**{name: value})}: must be a whole number, at least 0')


def require_path(given: object) -> Path:
    """Return a path, or refuse what is none."""
    if not isinstance(given, (str, os.PathLike)):
        raise UserError(f'{given!r}: is no path; expected a text or a pathlib.Path')
    return Path(given)
