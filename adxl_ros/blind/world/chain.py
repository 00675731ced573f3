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

"""The chain of this world: joints to force, element, electronics, clock and ADC."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
import math
from typing import TYPE_CHECKING
import zlib

from adxl_ros.blind.world.motion import Manoeuvre
from adxl_ros.blind.world.unit import ADC_BITS, ADC_VREF, G0, Unit
import numpy as np
from scipy.interpolate import CubicSpline
from scipy.signal import lfilter

if TYPE_CHECKING:
    from adxl_ros.blind.world.fault_table import Fault

# Steps of the simulation a second, at least; a whole number a sample.
FINE_HZ = 2000.0
LSB = ADC_VREF / 2 ** ADC_BITS
PLACES = ('stage', 'mount', 'element', 'electronics', 'wire', 'samples')


@dataclass
class Run:
    """
    A recording in the making; faults change it at their places.

    Joints, `up` and `force` (3, n) m/s^2 in the sensor's frame; `u` (axes, n) in g; `volts`
    (axes, n), on the fine grid `t` and from place `samples` on one a sample.
    """

    unit: Unit
    t: np.ndarray
    seed: int
    alpha: np.ndarray
    beta: np.ndarray
    shift: np.ndarray
    temperature: np.ndarray
    supply: np.ndarray
    up: np.ndarray = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    gravity: float = G0
    arm: np.ndarray = field(default_factory=lambda: np.zeros(3))
    late: float = 0.0
    skew: float = 0.0
    corner_hz: float = 0.0
    second_hz: float = math.inf
    force: np.ndarray = field(default_factory=lambda: np.zeros((3, 0)))
    directions: np.ndarray = field(default_factory=lambda: np.eye(3))
    u: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    volts: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))

    @property
    def dt(self) -> float:
        """Step of the fine grid, s."""
        return float(self.t[1] - self.t[0])

    def random(self, stream: str) -> np.random.Generator:
        """Give the generator of a stream, the same whatever other faults there are."""
        return np.random.default_rng([self.seed, zlib.crc32(stream.encode())])


def stamps(unit: Unit, manoeuvre: Manoeuvre) -> np.ndarray:
    """Give the stamps of a recording, s."""
    return np.arange(int(manoeuvre.seconds * unit.rate_hz)) / unit.rate_hz


def render(unit: Unit, manoeuvre: Manoeuvre, faults: Sequence[Fault], seed: int, *,
           noise: bool = True, fine_hz: float = FINE_HZ) -> np.ndarray:
    """
    Simulate a recording's volts.

    Parameters
    ----------
    unit, manoeuvre
        What is moved, and how.
    faults
        Of any number; each acts at its place.
    seed
        Of all that is random.
    noise
        Without, there is neither noise nor drift nor the rounding of the ADC: for responses.
    fine_hz
        Least rate of the simulation.

    Returns
    -------
    numpy.ndarray
        (axes, samples) V.

    """
    sampled = stamps(unit, manoeuvre)
    step = 1 / (unit.rate_hz * math.ceil(fine_hz / unit.rate_hz))
    # Samples that come late or early must still lie on the grid.
    t = np.arange(-0.5, sampled[-1] + 1.0, step)
    joints = manoeuvre.joints(t)
    run = Run(unit, t, seed, joints['alpha'], joints['beta'], joints['shift'],
              *manoeuvre.climate(t), corner_hz=unit.corner_hz)

    def act(place: str) -> None:
        for fault in faults:
            if fault.kind.place == place:
                fault.kind.act(run, fault.size, fault.shape)

    if noise:
        _stage_errors(run)
    act('stage')
    run.force = _force(run)
    act('mount')
    run.u = (run.directions @ run.force)[unit.which] / G0
    act('element')
    run.volts = unit.zero_v[:, None] + unit.scale_v_per_g[:, None] * run.u
    act('electronics')
    if noise:
        run.volts += unit.scale_v_per_g[:, None] * _sensor_noise(run)
    run.volts = _low_pass(_low_pass(run.volts, run.corner_hz, step), run.second_hz, step)
    act('wire')
    late = run.late + run.skew * (sampled + 8 * np.sin(sampled / 25))
    run.volts = CubicSpline(t, run.volts, axis=1)(np.clip(sampled - late, t[0], t[-1]))
    run.t = sampled
    act('samples')
    if noise:
        run.volts = np.clip(np.floor(run.volts / LSB), 0, 2 ** ADC_BITS - 1) * LSB
    return run.volts


def references(unit: Unit, manoeuvre: Manoeuvre, seed: int) -> dict[str, np.ndarray]:
    """Give the other columns of a recording: what encoder, thermometer and voltmeter say."""
    t = stamps(unit, manoeuvre)
    rng = np.random.default_rng([seed, 77])
    joints, (temperature, supply) = manoeuvre.joints(t), manoeuvre.climate(t)
    step = unit.resolution_rad
    return {'alpha_rad': np.round(joints['alpha'] / step) * step,
            'beta_rad': np.round(joints['beta'] / step) * step,
            'shift_m': joints['shift'],
            'temperature_c': temperature + 0.006 * rng.normal(size=len(t)),
            'supply_v': supply + 1e-4 * rng.normal(size=len(t))}


def _stage_errors(run: Run) -> None:
    """Add a stage's errors inside its stated resolution, and an encoder's between its lines."""
    step, rng = run.unit.resolution_rad, run.random('encoder')
    for joint, (offset, sine, cosine) in zip((run.alpha, run.beta),
                                             run.unit.stage_rad.reshape(2, 3)):
        joint += offset + sine * np.sin(joint) + cosine * np.cos(joint) + 0.15 * step * np.sin(
            2 * np.pi * joint / (37 * step) + rng.uniform(0, 2 * np.pi))


def _turn(run: Run, vector: np.ndarray) -> np.ndarray:
    """Turn a vector of the base, (3,) or (3, n), into the sensor's frame, (3, n)."""
    ca, sa, cb, sb = np.cos(run.alpha), np.sin(run.alpha), np.cos(run.beta), np.sin(run.beta)
    x, y, z = vector
    x, z = ca * x + sa * z, -sa * x + ca * z
    return np.stack([cb * x + sb * y, -sb * x + cb * y, z])


def _force(run: Run) -> np.ndarray:
    force = run.gravity * _turn(run, run.up)
    force[0] += _twice(run.shift, run.dt)
    if run.arm.any():
        # The arm's path in the base, differentiated there: no formula of rotating frames.
        ca, sa, cb, sb = np.cos(run.alpha), np.sin(run.alpha), np.cos(run.beta), np.sin(run.beta)
        x, y = cb * run.arm[0] - sb * run.arm[1], sb * run.arm[0] + cb * run.arm[1]
        path = np.stack([ca * x - sa * run.arm[2], y, sa * x + ca * run.arm[2]])
        force += _turn(run, _twice(path, run.dt))
    return force


def _twice(values: np.ndarray, dt: float) -> np.ndarray:
    return np.gradient(np.gradient(values, dt, axis=-1), dt, axis=-1)


def _low_pass(values: np.ndarray, corner_hz: float, dt: float) -> np.ndarray:
    """Filter by one pole, exactly for inputs that are straight between steps."""
    if math.isinf(corner_hz):
        return values
    x = 2 * np.pi * corner_hz * dt
    keep = math.exp(-x)
    now, before = 1 - (1 - keep) / x, (1 - keep) / x - keep
    first = values[..., :1]
    return first + lfilter([now, before], [1, -keep], values - first)


def _sensor_noise(run: Run) -> np.ndarray:
    unit, rng = run.unit, run.random('noise')
    white = rng.normal(size=run.u.shape) * (
        unit.noise_g_per_rthz * math.sqrt(0.5 / run.dt))[:, None]
    slow = np.arange(run.t[0], run.t[-1] + 0.2, 0.1)
    rng = run.random('drift')
    for row, walk, size in zip(white, unit.walk_g_per_rts, unit.flicker_g):
        drift = walk * math.sqrt(0.1) * np.cumsum(rng.normal(size=len(slow)))
        row += np.interp(run.t, slow, drift + size * pink(slow, rng))
    return white


def pink(t: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Draw 1/f noise: relaxations at half-decade steps, each of variance 1."""
    out = np.zeros_like(t)
    dt = t[1] - t[0]
    for lag in dt * 10 ** np.arange(0.5, math.log10(2 * (t[-1] - t[0]) / dt), 0.5):
        keep = math.exp(-dt / lag)
        out += lfilter([math.sqrt(1 - keep * keep)], [1, -keep], rng.normal(size=len(t)),
                       zi=[keep * rng.normal()])[0]
    return out
