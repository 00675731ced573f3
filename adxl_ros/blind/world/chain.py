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

"""The chain of this world, from the joints to the codes of the ADC."""

from __future__ import annotations

from collections.abc import Sequence
import math

from adxl_ros.blind.world.fault import Fault
from adxl_ros.blind.world.motion import Manoeuvre
from adxl_ros.blind.world.run import Place, Run
from adxl_ros.blind.world.signals import pink_noise
from adxl_ros.blind.world.unit import ADC_BITS, G0, LSB_V, Unit
import numpy as np
import scipy

FINE_HZ = 2000.0
"""Lowest rate of the simulation, Hz; chosen. Each sample has a whole number of its steps."""


def stamps(unit: Unit, manoeuvre: Manoeuvre) -> np.ndarray:
    """
    Return the stamps of a recording.

    Parameters
    ----------
    unit, manoeuvre
        The unit and its motion.

    Returns
    -------
    numpy.ndarray
        Stamps, s, (n,).

    """
    return np.arange(int(manoeuvre.seconds * unit.rate_hz)) / unit.rate_hz


def render(unit: Unit, manoeuvre: Manoeuvre, faults: Sequence[Fault], seed: int, *,
           noise: bool = True, fine_hz: float = FINE_HZ) -> np.ndarray:
    """
    Simulate a recording's volts.

    Parameters
    ----------
    unit, manoeuvre
        The unit and its motion.
    faults
        Any number of faults; each acts at its place.
    seed
        Seed of all random numbers.
    noise
        False for responses: no noise, no drift, no stage errors and no rounding by the ADC.
    fine_hz
        Lowest rate of the simulation, Hz.

    Returns
    -------
    numpy.ndarray
        Output of the axes, V, (m, n).

    """
    sampled = stamps(unit, manoeuvre)
    step = 1 / (unit.rate_hz * math.ceil(fine_hz / unit.rate_hz))
    # Late and early samples must lie within the grid.
    t = np.arange(-0.5, sampled[-1] + 1.0, step)
    joints = manoeuvre.joints(t)
    run = Run(unit, t, seed, joints['alpha'], joints['beta'], joints['shift'],
              *manoeuvre.climate(t), corner_hz=unit.corner_hz)

    if noise:
        _stage_errors(run)
    _act(faults, Place.STAGE, run)
    run.force = _force(run)
    _act(faults, Place.MOUNT, run)
    run.u = (run.directions @ run.force)[unit.axis_indices] / G0
    _act(faults, Place.ELEMENT, run)
    run.volts = unit.zero_v[:, None] + unit.scale_v_per_g[:, None] * run.u
    _act(faults, Place.ELECTRONICS, run)
    if noise:
        run.volts += unit.scale_v_per_g[:, None] * _sensor_noise(run)
    run.volts = _low_pass(_low_pass(run.volts, run.corner_hz, step), run.second_hz, step)
    _act(faults, Place.WIRE, run)
    late = run.late + run.skew * (sampled + 8 * np.sin(sampled / 25))
    run.volts = scipy.interpolate.CubicSpline(t, run.volts, axis=1)(
        np.clip(sampled - late, t[0], t[-1]))
    run.t = sampled
    _act(faults, Place.SAMPLES, run)
    if noise:
        run.volts = np.clip(np.floor(run.volts / LSB_V), 0, 2 ** ADC_BITS - 1) * LSB_V
    return run.volts


def _act(faults: Sequence[Fault], place: Place, run: Run) -> None:
    for fault in faults:
        if fault.kind.place is place:
            fault.kind.act(run, fault.size, fault.shape)


def references(unit: Unit, manoeuvre: Manoeuvre, seed: int) -> dict[str, np.ndarray]:
    """
    Return the other columns of a recording, by encoder, thermometer and voltmeter.

    Parameters
    ----------
    unit, manoeuvre
        The unit and its motion.
    seed
        Seed of all random numbers.

    Returns
    -------
    dict
        Columns by name, (n,) each.

    """
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
    """Add errors of the stage within its resolution, and of the encoder between its lines."""
    step, rng = run.unit.resolution_rad, run.random('encoder')
    for joint, (offset, sine, cosine) in zip((run.alpha, run.beta),
                                             run.unit.stage_rad.reshape(2, 3)):
        joint += offset + sine * np.sin(joint) + cosine * np.cos(joint) + 0.15 * step * np.sin(
            2 * np.pi * joint / (37 * step) + rng.uniform(0, 2 * np.pi))


def _rotate(run: Run, vector: np.ndarray) -> np.ndarray:
    """Rotate a vector of the base, (3,) or (3, n), into the sensor's frame, (3, n)."""
    ca, sa, cb, sb = np.cos(run.alpha), np.sin(run.alpha), np.cos(run.beta), np.sin(run.beta)
    x, y, z = vector
    x, z = ca * x + sa * z, -sa * x + ca * z
    return np.stack([cb * x + sb * y, -sb * x + cb * y, z])


def _force(run: Run) -> np.ndarray:
    force = run.gravity * _rotate(run, run.up)
    force[0] += _second_derivative(run.shift, run.dt)
    if run.arm.any():
        # The path of the sensor in the base is differentiated twice: no rotating frame is used.
        ca, sa, cb, sb = np.cos(run.alpha), np.sin(run.alpha), np.cos(run.beta), np.sin(run.beta)
        x, y = cb * run.arm[0] - sb * run.arm[1], sb * run.arm[0] + cb * run.arm[1]
        path = np.stack([ca * x - sa * run.arm[2], y, sa * x + ca * run.arm[2]])
        force += _rotate(run, _second_derivative(path, run.dt))
    return force


def _second_derivative(values: np.ndarray, dt: float) -> np.ndarray:
    return np.gradient(np.gradient(values, dt, axis=-1), dt, axis=-1)


def _low_pass(values: np.ndarray, corner_hz: float, dt: float) -> np.ndarray:
    """Filter by one pole, exactly for inputs that are linear between steps."""
    if math.isinf(corner_hz):
        return values
    x = 2 * np.pi * corner_hz * dt
    keep = math.exp(-x)
    now, before = 1 - (1 - keep) / x, (1 - keep) / x - keep
    first = values[..., :1]
    return first + scipy.signal.lfilter([now, before], [1, -keep], values - first)


def _sensor_noise(run: Run) -> np.ndarray:
    unit, rng = run.unit, run.random('noise')
    white = rng.normal(size=run.u.shape) * (
        unit.noise_g_per_rthz * math.sqrt(0.5 / run.dt))[:, None]
    slow = np.arange(run.t[0], run.t[-1] + 0.2, 0.1)
    rng = run.random('drift')
    for row, walk, size in zip(white, unit.walk_g_per_rts, unit.flicker_g):
        drift = walk * math.sqrt(0.1) * np.cumsum(rng.normal(size=len(slow)))
        row += np.interp(run.t, slow, drift + size * pink_noise(slow, rng))
    return white
