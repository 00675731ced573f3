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
"""Faults that the library does not have."""

from __future__ import annotations

from math import pi

from adxl_ros.model.effects.base import Place, Signals
from adxl_ros.model.filters import low_pass
from adxl_ros.working.fault import Act, by_axis_with, Draw, Kind, Shape
import numpy as np


def _add(signals: Signals, size: float, shape: Shape, law: np.ndarray) -> None:
    """Add a law, (n,), to the output of each axis by its weight, g."""
    for d, w in enumerate(shape['w']):
        signals.output[d] = signals.output[d] + size * w * law


def _beat(signals: Signals, size: float, shape: Shape) -> None:
    """Add a slow sine in time, g, as of a radio carrier that beats with the clock."""
    t = signals.environment.time_s
    _add(signals, size, shape, np.sin(2 * pi * t / shape['period_s'] + shape['phase']))


def _ripple(signals: Signals, size: float, shape: Shape) -> None:
    """Add a ripple over the axis's own force, g, as of a servo loop with a limit cycle."""
    for d, w in enumerate(shape['w']):
        x = signals.sensed[d]
        signals.output[d] = signals.output[d] + size * w * np.sin(
            2 * pi * x / shape['period_g'] + shape['phase'])


def _aftermath(signals: Signals, size: float, shape: Shape) -> None:
    """Shift the zero-g by motion and recover slowly, g, as charge on a mass does."""
    moving = _moving(signals)
    charged = low_pass(moving, shape['late_s'], signals.dt_s, signals.memory)
    _add(signals, size, shape, charged)


def _motor_current(signals: Signals, size: float, shape: Shape) -> None:
    """Shift the zero-g while a joint turns, g, whatever its direction."""
    law = _moving(signals)
    _add(signals, size, shape, low_pass(law, 0.05, signals.dt_s, signals.memory))


def _moving(signals: Signals) -> np.ndarray:
    """Return how fast the joints turn, 0 to 1, (n,)."""
    rate = np.hypot(signals.alpha.velocity, signals.beta.velocity)
    return 1 - np.exp(-(rate / 0.3) ** 2)


def _magnet(signals: Signals, size: float, shape: Shape) -> None:
    """Shift the zero-g by the direction in the room, g, beyond its first harmonics."""
    law = np.sin(3 * np.asarray(signals.beta.position) + shape['phase']) * (
        1 + 0.5 * np.cos(2 * np.asarray(signals.alpha.position)))
    _add(signals, size, shape, law)


def _two_levels(signals: Signals, size: float, shape: Shape) -> None:
    """Switch the zero-g between two levels at uneven times, g, as popcorn noise does."""
    t = signals.environment.time_s
    phase = 2 * pi * t / shape['period_s'] + shape['phase']
    law = np.where(np.sin(phase) + 0.7 * np.sin(2.718 * phase) > 0.4, 1.0, 0.0)
    _add(signals, size, shape, law)


def _warming_rate(signals: Signals, size: float, shape: Shape) -> None:
    """Shift the zero-g by how fast the temperature changes, g, as a gradient does."""
    warm = np.asarray(signals.environment.temperature_c, float)
    if warm.ndim:
        late = low_pass(warm, 8.0, signals.dt_s, signals.memory)
        _add(signals, size, shape, warm - late)


def _fading_gain(signals: Signals, size: float, shape: Shape) -> None:
    """Change the scale factor with time, as leakage into a reference does."""
    t = signals.environment.time_s / 100.0
    for d, w in enumerate(shape['w']):
        signals.scale_v_per_g[d] = signals.scale_v_per_g[d] * (1 + size * w * t)


def _unlisted(name: str, act: Act, draw: Draw, place: Place = Place.ELEMENT, needs: str = ''
              ) -> Kind:
    """Return a kind that the library does not have."""
    return Kind(name, place, act, 3e-3, 0.1, draw, needs=needs, listed=False)


_PHASE = (0.0, 2 * pi)
"""Bounds of a phase, rad."""

KINDS = (
    _unlisted('beat', _beat, by_axis_with(period_s=(6.0, 40.0), phase=_PHASE)),
    _unlisted('ripple', _ripple, by_axis_with(period_g=(0.2, 0.5), phase=_PHASE)),
    _unlisted('aftermath', _aftermath, by_axis_with(late_s=(4.0, 15.0)), needs='fast'),
    _unlisted('motor_current', _motor_current, by_axis_with(), needs='fast'),
    _unlisted('magnet', _magnet, by_axis_with(phase=_PHASE)),
    _unlisted('two_levels', _two_levels, by_axis_with(period_s=(15.0, 60.0), phase=_PHASE)),
    _unlisted('warming_rate', _warming_rate, by_axis_with(), needs='heat'),
    _unlisted('fading_gain', _fading_gain, by_axis_with(), Place.ELECTRONICS),
)
"""The kinds of this file."""
