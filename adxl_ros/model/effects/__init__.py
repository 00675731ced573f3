# SPDX-License-Identifier: Apache-2.0

"""The library of effects, a file for stage and reference, accelerometer, ADC with noise."""

from __future__ import annotations

from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
from itertools import chain
import pkgutil

from adxl_ros.errors import UserError
from adxl_ros.model.effects.base import Effect


@cache
def library() -> dict[str, Effect]:
    """
    Collect the effects of this folder and those of other packages.

    A package adds an effect by an entry point in the group `adxl_ros.effects` that names an
    `Effect`.
    """
    modules = [
        import_module(f'{__name__}.{module.name}') for module in pkgutil.iter_modules(__path__)
    ]
    values = chain.from_iterable(vars(module).values() for module in modules)
    own = [value for value in values if isinstance(value, Effect)]
    collected = sorted(own, key=lambda effect: effect.name)
    collected += [point.load() for point in entry_points(group='adxl_ros.effects')]
    effects: dict[str, Effect] = {}
    for effect in collected:
        if effect.name in effects:
            raise UserError(f'two effects are named {effect.name}; rename one')
        effects[effect.name] = effect
    return effects


def effect_named(name: str) -> Effect:
    """Return the effect of that name."""
    effects = library()
    if name not in effects:
        raise UserError(f'unknown effect {name!r}; known: {", ".join(sorted(effects))}')
    return effects[name]
