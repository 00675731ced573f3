# SPDX-License-Identifier: Apache-2.0

"""The gap in the unit of a user: an angle, a velocity, or any function."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib import import_module
from typing import NamedTuple

from adxl_ros.diagnose.comparison import BaselineComparison
from adxl_ros.errors import one_line, UserError
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.error_sizes import rms
from adxl_ros.model.sensor import Sensor
from adxl_ros.wording import option
import numpy as np
import scipy

INTEGRATED_S = 10.0
"""Time over which the acceleration is integrated, s. Chosen: a short loss of other sensors."""

GapFunction = Callable[[np.ndarray, np.ndarray, np.ndarray], float]
"""Size of a gap by times, s, (n,), and recorded and simulated acceleration, m/s², (n, 3)."""


class GapQuantity(NamedTuple):
    """A quantity in which a gap is stated."""

    name: str
    unit: str
    size: GapFunction


class GapInUnit(NamedTuple):
    """The gap in the unit of a quantity, root mean square over recordings."""

    quantity: str  # Its name
    unit: str  # Its unit
    before: float  # Recording and simulation by the sensor that was given, in `unit`
    after: float  # Recording and simulation by params.yaml, in `unit`
    floor: float  # Two simulations, one with noise, in `unit`

    @property
    def text(self) -> str:
        """Return it for people."""
        return (
            f'{self.quantity} {self.before:.3g} -> {self.after:.3g} {self.unit}; noise alone '
            f'{self.floor:.3g}'
        )


def tilt_deg(time_s: np.ndarray, recorded: np.ndarray, simulated: np.ndarray) -> float:
    """Return the rms angle between the recorded and the simulated vector, deg."""
    cross = np.linalg.norm(np.cross(recorded, simulated), axis=1)
    angle = np.arctan2(cross, np.sum(recorded * simulated, axis=1))
    return float(np.degrees(rms(angle)))


def velocity_mps(time_s: np.ndarray, recorded: np.ndarray, simulated: np.ndarray) -> float:
    """Return the rms velocity, m/s, that the difference has become after `INTEGRATED_S`."""
    # Over a gap the difference counts as the mean of both sides.
    velocity = scipy.integrate.cumulative_trapezoid(
        recorded - simulated, time_s, axis=0, initial=0
    )
    later = np.searchsorted(time_s, time_s + INTEGRATED_S)
    within = later < len(time_s)
    if not within.any():
        raise UserError(
            f'{option(quantity="velocity")}: integrates for {INTEGRATED_S:g} s, but the recording '
            f'has {np.ptp(time_s):.3g} s'
        )
    gained = velocity[later[within]] - velocity[: len(time_s)][within]
    return rms(np.linalg.norm(gained, axis=1))


_QUANTITIES = {
    'tilt': GapQuantity('tilt', 'deg', tilt_deg),
    'velocity': GapQuantity('velocity', f'm/s after {INTEGRATED_S:g} s', velocity_mps),
}


def quantity(text: str) -> GapQuantity:
    """Return tilt, velocity, or that of MODULE:FUNCTION, whose attribute `unit` is shown."""
    if text in _QUANTITIES:
        return _QUANTITIES[text]
    module, _, name = text.partition(':')
    try:
        size = getattr(import_module(module), name)
        return GapQuantity(name, getattr(size, 'unit', ''), size)
    except (ImportError, AttributeError, ValueError) as error:
        raise UserError(
            f'{option(quantity=text)}: {one_line(error)}; give {", ".join(_QUANTITIES)}, or '
            'MODULE:FUNCTION of a module that Python can import'
        ) from None


def gap_in(
    chosen: GapQuantity,
    comparisons: Sequence[BaselineComparison],
    baseline: Sensor,
    found: Sensor,
    seed: int,
) -> GapInUnit:
    """Return the gap before and after what was found, and the same figure of noise alone."""

    def size(comparison: BaselineComparison, recorded_v: np.ndarray, sensor: Sensor) -> float:
        used = comparison.used & np.isfinite(recorded_v).all(axis=1)
        recorded = _acceleration(recorded_v[used], baseline)
        simulated = _acceleration(comparison.simulated_v(sensor)[used], baseline)
        try:
            return float(chosen.size(comparison.time_s[used], recorded, simulated))
        except UserError:
            raise
        except Exception as error:
            raise UserError(
                f'{option(quantity=chosen.name)}: {type(error).__name__}: {one_line(error)}'
            ) from None

    before = [size(c, c.volts, baseline) for c in comparisons]
    after = [size(c, c.volts, found) for c in comparisons]
    noise = []
    for c in comparisons:
        drawn_v = c.simulated_v(found) + c.simulated_noise_v(found, seed)
        noise.append(size(c, drawn_v, found))
    return GapInUnit(chosen.name, chosen.unit, rms(before), rms(after), rms(noise))


def _acceleration(volts: np.ndarray, sensor: Sensor) -> np.ndarray:
    """
    Convert volts by zero-g and scale factor of the baseline, m/s², (n, 3).

    Of two axes, gravity gives the third; of one, the others are 0.
    """
    out = np.zeros((len(volts), 3))
    for d, axis in enumerate(sensor.axes):
        out[:, AXES.index(axis)] = (volts[:, d] - sensor.zero_g_v[d]) / sensor.scale_v_per_g[d]
    if len(sensor.axes) == 2:
        out[:, 2] = np.sqrt(np.maximum(1 - out[:, 0] ** 2 - out[:, 1] ** 2, 0.0))
    return out * G0_MPS2
