# SPDX-License-Identifier: Apache-2.0
"""The methods that take part: those of the package, and any by `--method MODULE:FUNCTION`."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from importlib.metadata import entry_points

from adxl_ros.errors import UserError
from adxl_ros_validation.benchmark.case import Method

_OWN = 'adxl_ros_validation.benchmark.methods'
"""Package of the methods below."""
GROUP = 'adxl_ros.benchmark_methods'
"""Entry points by which other packages add methods."""
METHODS = {
    'diagnose': f'{_OWN}.diagnose:method',
    'nine_parameters': f'{_OWN}.nine_parameters:method',
    'mujoco_sysid': f'{_OWN}.mujoco_sysid:method',
    'bic': f'{_OWN}.bic:method',
    'random_forest': f'{_OWN}.random_forest:method',
    'always_bias': f'{_OWN}.always_bias:method',
}
"""Methods of the package by name; each is MODULE:FUNCTION."""


def chosen(names: Sequence[str]) -> tuple[dict[str, str], list[str]]:
    """
    Return methods by name, each as MODULE:FUNCTION, and why others are left out.

    names: those that are asked for, MODULE:FUNCTION or a name; none for all.
    """
    known = METHODS | {point.name: point.value for point in entry_points(group=GROUP)}
    asked = {name: known.get(name, name) for name in names} or known
    usable, left_out = {}, []
    for name, place in asked.items():
        try:
            method_at(place)
            usable[name.replace(':', '.')] = place
        except ImportError as error:
            if names and place not in known.values():
                raise UserError(f'--method {name}: cannot be imported: {error}') from None
            left_out.append(f'{name}: needs a library that is not installed: {error}')
    return usable, left_out


def method_at(place: str) -> Method:
    """Import MODULE:FUNCTION."""
    module, _, name = place.partition(':')
    if not name:
        raise UserError(
            f'--method {place}: is no method; write MODULE:FUNCTION, or one of '
            f'{", ".join(METHODS)}'
        )
    try:
        return getattr(import_module(module), name)
    except AttributeError:
        raise UserError(f'--method {place}: {module} has no {name}') from None
