# SPDX-License-Identifier: Apache-2.0

"""
The inverse of the RC filter, and the paper's approximate inverse of the chain.

The filter is undone by u = v + RC·dv/dt, in amplitude and phase. The derivative is the maximally
flat central difference over `HALF` samples each way (Fornberg 1988). It is exact for polynomials
of degree 2·HALF, within 1 % of amplitude up to a third of the sample rate, and without phase. In a
stream a sample is available `HALF` samples later, and keeps its own stamp. The inversion also
amplifies noise; see `noise_variance_v2`.

The paper's inverse serves comparisons. The default is `signal_chain.inverse`, which is exact.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
import itertools
from math import factorial
from typing import Any, NamedTuple, TypeVar

from adxl_ros.model import noise
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.effects.base import (
    ARRAYS,
    Components,
    Environment,
    Maths,
    NOMINAL_ENVIRONMENT,
    Place,
    Value,
)
from adxl_ros.model.sensor import Sensor
from adxl_ros.model.signal_chain import gravity_mps2, static_chain
import numpy as np

Token = TypeVar('Token')

HALF = 8
"""Samples of the central difference each way. Its amplitude is right within 1 % to a third of the
rate; with four it is up to a quarter, and sixteen would delay a stream twice as long."""

MAX_GAP = 1.5
"""Distance of neighbours, in sample periods, that is a gap between them: halfway between
one period, with jitter, and two, where a sample is lost."""
_NEAR_ZERO_G = 1e-6
"""Input below which the scale factor is taken above it, g: it avoids 0/0, and the scale factor
differs there by 1e-8 of itself."""


def derivative_weights(half: int) -> np.ndarray:
    """Return the weights of the samples −half … half in a derivative by index, (2·half + 1,)."""
    one_side = [
        -((-1) ** k) * factorial(half) ** 2 / (k * factorial(half - k) * factorial(half + k))
        for k in range(1, half + 1)
    ]
    return np.array([*(-w for w in reversed(one_side)), 0.0, *one_side])


def undo_filter(
    volts: np.ndarray, time_s: np.ndarray, rc_s: np.ndarray, rate_hz: float
) -> np.ndarray:
    """
    Undo the filter of consecutive samples.

    Near the ends of the series, and near gaps, the difference uses as many neighbours as both
    sides have. A sample without a neighbour on one side stays as it is. Volts are (n, m), time
    constants (m,).
    """
    distance = np.diff(time_s) * rate_hz
    is_gap = ~((distance > 0) & (distance < MAX_GAP))
    edges = np.concatenate([[0], np.flatnonzero(is_gap) + 1, [len(time_s)]])
    row = np.arange(len(time_s))
    next_edge = np.searchsorted(edges, row, 'right')
    before, after = row - edges[next_edge - 1], edges[next_edge] - 1 - row
    reach = np.minimum(HALF, np.minimum(before, after))
    slope = np.zeros_like(volts, dtype=float)
    for half in range(1, HALF + 1):
        rows = np.flatnonzero(reach == half)
        if len(rows):
            near = volts[rows[:, None] + np.arange(-half, half + 1)]
            slope[rows] = np.einsum('nkm,k->nm', near, derivative_weights(half))
    return volts + rc_s * rate_hz * slope


def undo_filter_blocks(
    blocks: Iterable[tuple[Token, np.ndarray, np.ndarray]], rc_s: np.ndarray, rate_hz: float
) -> Iterator[tuple[Token, np.ndarray]]:
    """Undo the filter block by block (token, stamps, volts), as `undo_filter` of the whole."""
    none: tuple[Any, ...] = None, np.empty(0), np.empty((0, len(rc_s)))
    _, before_s, before_v = none
    for (token, time_s, volts), (_, after_s, after_v) in itertools.pairwise(
        itertools.chain(blocks, [none])
    ):
        near_s = np.concatenate([before_s, time_s, after_s[:HALF]])
        near_v = np.concatenate([before_v, volts, after_v[:HALF]])
        begin = len(before_s)
        end = len(before_s) + len(time_s)
        yield token, undo_filter(near_v, near_s, rc_s, rate_hz)[begin:end]
        before_s, before_v = near_s[:end][-HALF:], near_v[:end][-HALF:]


def noise_variance_v2(sensor: Sensor) -> np.ndarray:
    """
    Return the variance of one sample behind `undo_filter` by axis, V², (m,).

    The analog noise is an AR(1) sequence of correlation exp(−|lag|/RC), the ADC's is white.
    """
    rc_s = noise.electronics(sensor).rc_s
    lag = np.abs(np.subtract.outer(np.arange(2 * HALF + 1), np.arange(2 * HALF + 1)))
    variances = []
    for rc, std_v in zip(rc_s, noise.analog_std_v(sensor)):
        weights = rc * sensor.rate_hz * derivative_weights(HALF)
        weights[HALF] += 1
        correlation = np.exp(-lag / (rc * sensor.rate_hz)) if rc else np.eye(len(weights))
        variances.append(
            std_v**2 * weights @ correlation @ weights + sensor.lsb_v**2 / 12 * weights @ weights
        )
    return np.array(variances)


class FilteredSample(NamedTuple):
    """A sample of a stream."""

    time_s: float
    volts: list[float]  # By measured axis
    token: Any  # What a caller knows it by


class DelayedInversion:
    """`undo_filter` for a stream: returns a sample when it has `HALF` neighbours after it."""

    def __init__(self, rc_s: np.ndarray, rate_hz: float) -> None:
        """Prepare for time constants by axis, (m,)."""
        self._rate_hz = rate_hz
        self._near: deque[FilteredSample] = deque()
        self._index = 0
        gain = rc_s * rate_hz
        self._kernels = [
            [(gain * w).tolist() for w in derivative_weights(half)] for half in range(HALF + 1)
        ]

    def __call__(self, sample: FilteredSample) -> Iterator[FilteredSample]:
        """Take a sample; yield those that are ready, before a gap all, before the filter."""
        near = self._near
        if near and not 0 < (sample.time_s - near[-1].time_s) * self._rate_hz < MAX_GAP:
            while self._index < len(near):
                yield self._next()
            near.clear()
            self._index = 0
        near.append(sample)
        if len(near) - self._index > HALF:
            yield self._next()

    def _next(self) -> FilteredSample:
        near = self._near
        index = self._index
        half = min(index, len(near) - 1 - index, HALF)
        sample = near[index]
        kernel = self._kernels[half]
        undone_v = [
            v + sum(kernel[k][d] * near[index - half + k].volts[d] for k in range(2 * half + 1))
            for d, v in enumerate(sample.volts)
        ]
        if index >= HALF:
            near.popleft()
        else:
            self._index += 1
        return sample._replace(volts=undone_v)


class PaperInverse:
    """
    The paper's inverse, equations 14 to 21, which ignores the errors of the other axes.

    First each axis is linear (3), and z follows from equation 5 if it is not measured. Then the
    bias by the other axes is subtracted, and the result is divided by the scale factor at those
    inputs (14, 16). Finally the misalignment is removed, one axis after the other (20, 21).
    """

    def __init__(self, sensor: Sensor, maths: Maths = ARRAYS) -> None:
        """Prepare for a sensor."""
        self._maths = maths
        self._up = sensor.up
        self._measured = sensor.axis_indices
        self._gravity_g = gravity_mps2(sensor) / G0_MPS2
        self._chain = static_chain(sensor)
        mounted = self._chain.signals(NOMINAL_ENVIRONMENT, force=list(G0_MPS2 * np.eye(3)))
        self._chain(Place.MOUNTING, mounted)
        # Θ of (18) and (19)
        self._directions = [np.asarray(row).tolist() for row in mounted.sensed]

    def __call__(
        self, volts: Components, environment: Environment = NOMINAL_ENVIRONMENT
    ) -> Components:
        """Map the volts of each axis to specific force, m/s²."""
        linear = self._linear(volts, environment)
        force = list(linear)
        for d in self._measured:
            force[d] = self._sensed(d, linear)
        for d, direction in enumerate(self._directions):  # (20), (21)
            if d in self._measured:
                others = sum(direction[c] * force[c] for c in range(3) if c != d)
                force[d] = (force[d] - others) / direction[d]
        return [f * G0_MPS2 for f in force]

    def _linear(self, volts: Components, environment: Environment) -> Components:
        """Return the inputs of linear axes, g (3), and z by the others if it is not measured."""
        zero = 0.0 * volts[0]
        at_0_g = self._converted([zero] * 3, environment)
        at_1_g = self._converted([zero + 1.0] * 3, environment)
        linear = [zero] * 3
        for d, v, v0, v1 in zip(self._measured, volts, at_0_g, at_1_g):
            linear[d] = (v - v0) / (v1 - v0)
        if 2 not in self._measured:
            z2 = self._gravity_g**2 - linear[0] ** 2 - linear[1] ** 2
            linear[2] = self._up * self._maths.sqrt(self._maths.maximum(z2, 0.0))  # (5)
        return linear

    def _sensed(self, axis: int, linear: Components) -> Value:
        """Return the input of an axis, g, by its bias and scale factor at the others (14, 16)."""
        own = linear[axis]
        inputs = list(linear)
        inputs[axis] = 0.0 * own
        bias = self._respond(inputs)[axis]
        is_near_zero = abs(own) < _NEAR_ZERO_G
        inputs[axis] = self._maths.where(is_near_zero, own + 2 * _NEAR_ZERO_G, own)
        scale = (self._respond(inputs)[axis] - bias) / inputs[axis]
        return (own - bias) / scale

    def _respond(self, inputs: Components) -> Components:
        signals = self._chain.signals(NOMINAL_ENVIRONMENT, sensed=inputs)
        self._chain(Place.ELEMENT, signals)
        return signals.output

    def _converted(self, output: Components, environment: Environment) -> Components:
        signals = self._chain.signals(environment, output=output)
        return self._chain.volts(signals, Place.ELECTRONICS)
