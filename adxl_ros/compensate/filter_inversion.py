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

"""
The RC filter undone: u = v + RC·dv/dt, in amplitude and phase.

The derivative is the maximally flat central difference over `HALF` samples each way (Fornberg
1988): exact for polynomials of degree 2·HALF, within 1 % of amplitude up to a third of the sample
rate, and without phase. Off-line that is all; live, a sample is known `HALF` samples later, and
keeps its own stamp. What a filter takes of the noise comes back, too: see `noise_variance_v2`.
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
"""Samples each way."""
GAP = 1.5
"""Samples further apart than so many periods are not neighbours."""


def derivative_weights(half: int) -> np.ndarray:
    """Weights of the samples −half … half in a derivative by samples, (2·half + 1,)."""
    one_side = [-(-1) ** k * factorial(half) ** 2
                / (k * factorial(half - k) * factorial(half + k)) for k in range(1, half + 1)]
    return np.array([*(-w for w in reversed(one_side)), 0.0, *one_side])


def undo(volts: np.ndarray, time_s: np.ndarray, rc_s: np.ndarray, rate_hz: float) -> np.ndarray:
    """
    Undo the filter of a stretch, phase and all.

    Within `HALF` samples of its ends, and of gaps, the difference reaches as far as there are
    neighbours; a sample with none on one side stays as it is.

    Parameters
    ----------
    volts
        Behind the filter, (n, m).
    time_s
        Stamps, (n,).
    rc_s
        Time constants by axis, s, (m,).
    rate_hz
        Sample rate.

    Returns
    -------
    np.ndarray
        Before the filter, V, (n, m).

    """
    apart = np.diff(time_s) * rate_hz
    breaks = np.concatenate([[0], np.flatnonzero(~((apart > 0) & (apart < GAP))) + 1,
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
    Undo the filter block by block, as `undo` does of the whole.

    Parameters
    ----------
    blocks
        What is to come out with a block, its stamps, s, (n,), and volts, (n, m).
    rc_s, rate_hz
        As for `undo`.

    """
    before_s, before_v = np.empty(0), np.empty((0, len(rc_s)))
    held = None
    for block in itertools.chain(blocks, [None]):
        if held is not None:
            token, time_s, volts = held
            after_s, after_v = (x[:HALF] for x in (block or held)[1:])
            if not block:
                after_s, after_v = after_s[:0], after_v[:0]
            out = undo(np.concatenate([before_v, volts, after_v]),
                         np.concatenate([before_s, time_s, after_s]), rc_s, rate_hz)
            yield token, out[len(before_s):len(before_s) + len(time_s)]
            before_s = np.concatenate([before_s, time_s])[-HALF:]
            before_v = np.concatenate([before_v, volts])[-HALF:]
        held = block


def noise_variance_v2(sensor: Sensor) -> np.ndarray:
    """
    Variance of one sample behind `undo` by axis, V², (m,).

    The analog noise is an AR(1) sequence of correlation exp(−|lag|/RC), the ADC's is white.
    """
    rc_s = noise.electronics(sensor).rc_s
    lag = np.abs(np.subtract.outer(np.arange(2 * HALF + 1), np.arange(2 * HALF + 1)))
    out = []
    for rc, sigma in zip(rc_s, noise.analog_std_v(sensor)):
        weights = rc * sensor.rate_hz * derivative_weights(HALF)
        weights[HALF] += 1
        alike = np.exp(-lag / (rc * sensor.rate_hz)) if rc else np.eye(len(weights))
        out.append(sigma ** 2 * weights @ alike @ weights
                   + sensor.lsb_v ** 2 / 12 * weights @ weights)
    return np.array(out)


class DelayedInversion:
    """`undo` for a stream: gives a sample when it has `HALF` neighbours after it."""

    def __init__(self, rc_s: np.ndarray, rate_hz: float) -> None:
        self._rc_s, self._rate_hz = rc_s, rate_hz
        self._near: deque[tuple[float, list[float], object]] = deque()
        self._given = 0
        gain = rc_s * rate_hz
        self._kernels = [[(gain * w).tolist() for w in derivative_weights(half)]
                         for half in range(HALF + 1)]

    def __call__(self, time_s: float, volts: list[float], token: object
                 ) -> Iterator[tuple[float, list[float], object]]:
        """
        Take a sample, and give those that are ready: stamp, s, volts, and what came with it.

        A gap ends a stretch: what is left of it comes out at once.
        """
        near = self._near
        if near and not 0 < (time_s - near[-1][0]) * self._rate_hz < GAP:
            while self._given < len(near):
                yield self._give()
            near.clear()
            self._given = 0
        near.append((time_s, volts, token))
        if len(near) - self._given > HALF:
            yield self._give()

    def _give(self) -> tuple[float, list[float], object]:
        near, at = self._near, self._given
        half = min(at, len(near) - 1 - at, HALF)
        stamp, volts, token = near[at]
        kernel = self._kernels[half]
        undone_v = [v + sum(kernel[k][d] * near[at - half + k][1][d]
                            for k in range(2 * half + 1)) for d, v in enumerate(volts)]
        if at >= HALF:
            near.popleft()
        else:
            self._given += 1
        return stamp, undone_v, token
