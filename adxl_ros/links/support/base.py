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

"""What a link is: where the samples come from. One file a link, found by being in `links`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib import import_module
import pkgutil
from typing import Any, Protocol

from adxl_ros.model.sensor import Sensor
import numpy as np

_LINKS = 'adxl_ros.links'
"""Package whose modules are the links; its folder `support` is none."""


@dataclass(frozen=True)
class Option:
    """
    One parameter `link.<name>` of the driver; the type of the default is its type.

    An empty tuple stands for a list of strings, or one string with commas.
    """

    name: str
    default: bool | int | float | str | tuple[()]
    doc: str
    unit: str = ''
    lower: float | None = None
    upper: float | None = None


@dataclass(frozen=True)
class State:
    """
    How a link is.

    Attributes
    ----------
    level
        `ok`, `warn` or `error`.
    text
        One or two words, or a line of reasons; it changes when the state does, and only then.
    values : mapping
        Figures for diagnostics.

    """

    level: str
    text: str
    values: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Samples:
    """
    What a link gives at once.

    Attributes
    ----------
    stamp_ns
        Times of the samples, ns, (n,) int64, ascending.
    volts
        Output of the sensor by axis, V, (n, m), finite.
    until_ns
        Time up to which the link has nothing more to give.
    missing
        Samples lost since the last call.
    references : mapping or tuple
        What was recorded beside the sensor, by the column names of a recording, (n,); NaN where
        it was not sampled.
    estimated
        How many of `missing` are estimated by time, not counted.

    """

    stamp_ns: np.ndarray
    volts: np.ndarray
    until_ns: int
    missing: int = 0
    references: Mapping[str, np.ndarray] = field(default_factory=dict)
    estimated: int = 0


def nothing(sensor: Sensor, until_ns: int) -> Samples:
    """Return no samples of a sensor."""
    return Samples(np.zeros(0, np.int64), np.zeros((0, len(sensor.axes))), until_ns)


class Link(Protocol):
    """
    A source of samples.

    A module of `links` that is a link has `OPTIONS`, a tuple of `Option`, and
    `open_link(sensor, options)`, which returns one of these and raises `UserError` for options
    that it cannot work with. A link that simulates has a method `feel`, too; see `links.sim`.

    Attributes
    ----------
    sensor
        Whose figures make the samples readable; None until the device has said.
    live
        Whether samples come when a device sends them. Then `read` waits for them, 50 ms or so,
        and their stamps are the link's; else it gives at once what is due.
    references : mapping or tuple
        Names of the references that its samples come with.
    waits
        Whether it has a beginning that nobody should miss: it starts with its first listener.
    start_ns
        Time of its first sample, ns, where it has one of its own; else None.

    """

    sensor: Sensor | None
    live: bool
    references: tuple[str, ...]
    waits: bool
    start_ns: int | None

    def begin(self, now_ns: int) -> int:
        """
        Let the next sample be due now; return how many samples are lost by that.

        Called once before the first `read`, and again when the clock has jumped.
        """

    def read(self, now_ns: int) -> Samples:
        """Return the samples that are due; raises `UserError` when there will be no more."""

    def state(self) -> State:
        """Say how the link is."""

    def close(self) -> None:
        """Let go of what the link holds open."""


def names() -> tuple[str, ...]:
    """Name the links, `sim` first."""
    found = [module.name for module in pkgutil.iter_modules(import_module(_LINKS).__path__)
             if not module.ispkg]
    return tuple(sorted(found, key=lambda name: (name != 'sim', name)))


def module_of(name: str) -> Any:
    """Import a link by its name."""
    return import_module(f'{_LINKS}.{name}')
