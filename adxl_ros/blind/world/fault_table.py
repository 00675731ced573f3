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

"""Every kind of fault of this world, in one table."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from adxl_ros.blind.world import element, noise_faults, stage, unlisted_faults
from adxl_ros.blind.world.fault_shapes import Act, Draw, Shape
from adxl_ros.blind.world.unit import Unit


@dataclass(frozen=True)
class Kind:
    """
    A fault: its name, its place in the chain, what it does there.

    `most` bounds its size, `start` is a size to begin a search at; `draw` gives the figures that
    stay when its size changes; `spread` the shapes that span its response, at so many times
    `start` as `sizes` has (an axis's own part counts by itself where `each`); `random` if it
    differs from run to run, `known` if the package's library has an effect of this name.
    """

    name: str
    place: str
    act: Act
    draw: Draw
    spread: Callable[[Unit], list[Shape]]
    start: float
    most: float
    each: bool = False
    random: bool = False
    known: bool = True
    sizes: tuple[float, ...] = (1.0,)


@dataclass(frozen=True)
class Fault:
    """A kind with its figures."""

    kind: Kind
    size: float
    shape: Shape


def _kinds() -> dict[str, Kind]:
    table: dict[str, Kind] = {}
    for module, known in ((stage, True), (element, True),
                          (noise_faults, True), (unlisted_faults, False)):
        for name, row in module.KINDS.items():
            table[name] = Kind(name, known=known, **row)
    return table


KINDS = _kinds()
KNOWN = tuple(name for name, kind in KINDS.items() if kind.known)
FOREIGN = tuple(name for name, kind in KINDS.items() if not kind.known)
