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

"""The library of effects: each file of this folder holds one."""

from __future__ import annotations

from difflib import get_close_matches
from functools import cache
from importlib import import_module
from importlib.metadata import entry_points
import pkgutil

from adxl_ros.errors import UserError
from adxl_ros.model.effects.base import Effect


@cache
def library() -> dict[str, Effect]:
    """
    Collect the effects of this folder and those of other packages.

    A package adds an effect by an entry point in the group `adxl_ros.effects` that names an
    `Effect`.

    Returns
    -------
    dict
        Effects by name.

    Raises
    ------
    UserError
        Two effects have one name.

    """
    collected = [import_module(f'{__name__}.{module.name}').EFFECT
                 for module in pkgutil.iter_modules(__path__) if module.name != 'base']
    collected += [point.load() for point in entry_points(group='adxl_ros.effects')]
    effects: dict[str, Effect] = {}
    for effect in collected:
        if effect.name in effects:
            raise UserError(f'two effects are named {effect.name}; rename one')
        effects[effect.name] = effect
    return effects


def effect_named(name: str) -> Effect:
    """
    Return the effect of that name.

    Raises
    ------
    UserError
        No effect has the name; the message suggests the nearest one.

    """
    effects = library()
    if name not in effects:
        near = get_close_matches(name, effects, 1)
        hint = f'did you mean {near[0]}?' if near else f'known: {", ".join(sorted(effects))}'
        raise UserError(f'unknown effect {name!r}; {hint}')
    return effects[name]
