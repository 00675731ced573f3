# SPDX-License-Identifier: Apache-2.0

"""
The paper's compensation, equations 14 to 21, which ignores the errors of the other axes.

It serves comparisons. The default inverse is `signal_chain.inverse`, which is exact. Both use the
same effects.
"""

from __future__ import annotations

from collections.abc import Callable

from adxl_ros.model import analog_stages, signal_chain
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.effects.base import (
    Components,
    Environment,
    NOMINAL_ENVIRONMENT,
    Place,
    Signals,
    Value,
)
from adxl_ros.model.scalar_or_array import ARRAYS, Maths
from adxl_ros.model.sensor import Sensor
import numpy as np

_NEAR_ZERO_G = 1e-6
"""Input below which the scale factor is taken at `_NEAR_ZERO_G`, g; chosen: it avoids 0/0."""


def inverse(sensor: Sensor, z_sign: np.ndarray | None = None, maths: Maths = ARRAYS
            ) -> Callable[..., Components]:
    """
    Prepare the paper's approximate inverse, which has no iterations.

    First each axis is linear (3), and z follows from equation 5 if it is not measured. Then the
    bias by the other axes is subtracted, and the result is divided by the scale factor at those
    inputs (14, 16). Finally the misalignment is removed, one axis after the other (20, 21).

    z_sign: sign of z by sample, (n,), where it is known better than by `sensor.z_sign`; returns:
    maps the volts of each axis, and an `Environment` (the nominal one unless given), to three
    components of specific force, m/s².
    """
    measured = [AXES.index(axis) for axis in sensor.axes]
    gravity_g = signal_chain.gravity_mps2(sensor) / G0_MPS2
    up: Value = sensor.z_sign if z_sign is None else z_sign
    directions = _directions(sensor)
    element = analog_stages.effects_at(sensor, Place.ELEMENT, True)
    electronics = analog_stages.effects_at(sensor, Place.ELECTRONICS, True)
    zero_g_v = sensor.nominal_zero_g_v.tolist()
    scale_v_per_g = sensor.nominal_scale_v_per_g.tolist()

    def respond(inputs: Components) -> Components:
        signals = Signals(NOMINAL_ENVIRONMENT, sensed=inputs, output=list(inputs))
        for apply, values in element:
            apply(signals, values)
        return signals.output

    def converted(output: Components, environment: Environment) -> Components:
        signals = Signals(environment, output=output, zero_g_v=list(zero_g_v),
                          scale_v_per_g=list(scale_v_per_g))
        for apply, values in electronics:
            apply(signals, values)
        return analog_stages.output_volts(signals)

    def invert(volts: Components, environment: Environment = NOMINAL_ENVIRONMENT) -> Components:
        at_0_g = converted([0.0 * volts[0]] * 3, environment)
        at_1_g = converted([0.0 * volts[0] + 1.0] * 3, environment)
        linear = [0.0 * volts[0]] * 3
        for d, v, v0, v1 in zip(measured, volts, at_0_g, at_1_g):
            linear[d] = (v - v0) / (v1 - v0)                                        # (3)
        if 2 not in measured:
            z2 = gravity_g ** 2 - linear[0] ** 2 - linear[1] ** 2
            linear[2] = up * maths.sqrt(maths.maximum(z2, 0.0))                     # (5)
        sensed = list(linear)
        for d in measured:
            inputs = list(linear)
            inputs[d] = 0.0 * linear[d]
            bias = respond(inputs)[d]
            inputs[d] = _away_from_zero(linear[d])
            scale = (respond(inputs)[d] - bias) / inputs[d]
            sensed[d] = (linear[d] - bias) / scale                                  # (14), (16)
        force = list(sensed)
        for d in measured:                                                          # (20), (21)
            others = sum(directions[d][c] * force[c] for c in range(3) if c != d)
            force[d] = (sensed[d] - others) / directions[d][d]
        return [f * G0_MPS2 for f in force]

    return invert


def _away_from_zero(value: Value) -> Value:
    """Return the value, moved away from 0 if it is smaller than `_NEAR_ZERO_G`."""
    small = abs(value) < _NEAR_ZERO_G
    return value + _NEAR_ZERO_G * 2 * small


def _directions(sensor: Sensor) -> list[list[float]]:
    """Return the rows Θ of the sensing axes, (18) and (19), by the effects of the mounting."""
    signals = Signals(NOMINAL_ENVIRONMENT, sensed=[np.array(row) for row in np.eye(3)])
    for apply, values in analog_stages.effects_at(sensor, Place.MOUNTING, True):
        apply(signals, values)
    return [np.asarray(row).tolist() for row in signals.sensed]
