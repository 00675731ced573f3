# SPDX-License-Identifier: Apache-2.0

"""
Inversion of the RC filter: u = v + RC·dv/dt, in amplitude and phase.

The derivative is the maximally flat central difference over `HALF` samples each way (Fornberg
1988). It is exact for polynomials of degree 2·HALF, within 1 % of amplitude up to a third of the
sample rate, and without phase. In a stream a sample is available `HALF` samples later, and keeps
its own stamp. The inversion also amplifies noise; see `noise_variance_v2`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
import itertools
from math import factorial
from typing import TypeVar

from adxl_ros.model import noise
from adxl_ros.model.sensor import Sensor
import numpy as np

Token = TypeVar('Token')

HALF = 8
"""Samples of the central difference each way; chosen: within 1 % up to a third of the rate."""

MAX_GAP = 1.5
"""Distance of neighbours, in sample periods, from which there is a gap between them; chosen:
between one and two periods."""


def derivative_weights(half: int) -> np.ndarray:
    """Return the weights of the samples −half … half in a derivative by index, (2·half + 1,)."""
    one_side = [-(-1) ** k * factorial(half) ** 2
                / (k * factorial(half - k) * factorial(half + k)) for k in range(1, half + 1)]
    return np.array([*(-w for w in reversed(one_side)), 0.0, *one_side])


def undo(volts: np.ndarray, time_s: np.ndarray, rc_s: np.ndarray, rate_hz: float) -> np.ndarray:
    """
    Undo the filter of consecutive samples.

    Near the ends of the series, and near gaps, the difference uses as many neighbours as both
    sides have. A sample without a neighbour on one side stays as it is.

    volts: volts behind the filter, V, (n, m); time_s: stamps, s, (n,); rc_s: time constants of the
    filter by axis, s, (m,); returns: volts before the filter, V, (n, m).
    """
    distance = np.diff(time_s) * rate_hz
    breaks = np.concatenate([[0], np.flatnonzero(~((distance > 0) & (distance < MAX_GAP))) + 1,
                             [len(time_s)]])
    run = np.searchsorted(breaks, np.arange(len(time_s)), 'right')
    row = np.arange(len(time_s))
    reach = np.minimum(HALF, np.minimum(row - breaks[run - 1], breaks[run] - 1 - row))
    slope = np.zeros_like(volts, dtype=float)
    for half in range(1, HALF + 1):
        rows = np.flatnonzero(reach == half)
        if len(rows):
            near = volts[rows[:, None] + np.arange(-half, half + 1)]
            slope[rows] = np.einsum('nkm,k->nm', near, derivative_weights(half))
    return volts + rc_s * rate_hz * slope


def undo_blocks(blocks: Iterable[tuple[Token, np.ndarray, np.ndarray]], rc_s: np.ndarray,
                rate_hz: float) -> Iterator[tuple[Token, np.ndarray]]:
    """
    Undo the filter block by block, with the result of `undo` for the whole.

    blocks: for each block: a token, stamps, s, (n,), and volts behind the filter, V, (n, m); rc_s:
    time constants of the filter by axis, s, (m,); yields: for each block: its token, and volts
    before the filter, V, (n, m).
    """
    previous_s, previous_v = np.empty(0), np.empty((0, len(rc_s)))
    current = None
    for following in itertools.chain(blocks, [None]):
        if current is not None:
            token, time_s, volts = current
            following_s, following_v = np.empty(0), np.empty((0, len(rc_s)))
            if following is not None:
                following_s, following_v = following[1][:HALF], following[2][:HALF]
            undone_v = undo(np.concatenate([previous_v, volts, following_v]),
                            np.concatenate([previous_s, time_s, following_s]), rc_s, rate_hz)
            yield token, undone_v[len(previous_s):len(previous_s) + len(time_s)]
            previous_s = np.concatenate([previous_s, time_s])[-HALF:]
            previous_v = np.concatenate([previous_v, volts])[-HALF:]
        current = following


def noise_variance_v2(sensor: Sensor) -> np.ndarray:
    """
    Return the variance of one sample behind `undo` by axis, V², (m,).

    The analog noise is an AR(1) sequence of correlation exp(−|lag|/RC), the ADC's is white.
    """
    rc_s = noise.electronics(sensor).rc_s
    lag = np.abs(np.subtract.outer(np.arange(2 * HALF + 1), np.arange(2 * HALF + 1)))
    variances = []
    for rc, std_v in zip(rc_s, noise.analog_std_v(sensor)):
        weights = rc * sensor.rate_hz * derivative_weights(HALF)
        weights[HALF] += 1
        correlation = np.exp(-lag / (rc * sensor.rate_hz)) if rc else np.eye(len(weights))
        variances.append(std_v ** 2 * weights @ correlation @ weights
                         + sensor.lsb_v ** 2 / 12 * weights @ weights)
    return np.array(variances)


class DelayedInversion:
    """`undo` for a stream: returns a sample when it has `HALF` neighbours after it."""

    def __init__(self, rc_s: np.ndarray, rate_hz: float) -> None:
        """
        Prepare for a stream.

        rc_s: time constants of the filter by axis, s, (m,).
        """
        self._rate_hz = rate_hz
        self._near: deque[tuple[float, list[float], object]] = deque()
        self._index = 0
        gain = rc_s * rate_hz
        self._kernels = [[(gain * w).tolist() for w in derivative_weights(half)]
                         for half in range(HALF + 1)]

    def __call__(self, time_s: float, volts: list[float], token: object
                 ) -> Iterator[tuple[float, list[float], object]]:
        """
        Take a sample. At a gap, all samples before it become ready.

        volts: volts behind the filter by axis, V; yields: each sample that is ready: its stamp, s,
        volts before the filter, V, and its token.
        """
        near = self._near
        if near and not 0 < (time_s - near[-1][0]) * self._rate_hz < MAX_GAP:
            while self._index < len(near):
                yield self._next()
            near.clear()
            self._index = 0
        near.append((time_s, volts, token))
        if len(near) - self._index > HALF:
            yield self._next()

    def _next(self) -> tuple[float, list[float], object]:
        near, index = self._near, self._index
        half = min(index, len(near) - 1 - index, HALF)
        stamp_s, volts, token = near[index]
        kernel = self._kernels[half]
        undone_v = [v + sum(kernel[k][d] * near[index - half + k][1][d]
                            for k in range(2 * half + 1)) for d, v in enumerate(volts)]
        if index >= HALF:
            near.popleft()
        else:
            self._index += 1
        return stamp_s, undone_v, token
