# SPDX-License-Identifier: Apache-2.0

"""Continuous-time filters, exact for inputs that are polynomials between their samples."""

from __future__ import annotations

from functools import lru_cache
from math import ceil
from typing import Any

import numpy as np

ORDER = 6  # Newest samples of the polynomial; chosen: an error of order 6
_LINE = 2  # Newest samples of a straight line
_MOST_MISSED = 0.25  # Distance from the polynomial, by the change. Chosen: half of that of a step
_QUADRATURE_NODES = 24  # Nodes of Gauss-Legendre; chosen: exact for |z| < `_STIFF`
_FEW_INPUTS = 512  # Most inputs that are filtered one by one; chosen: 50 µs
_STIFF = 8.0  # |z| from which weights are integrated by parts; chosen: stable there only
_MOST_TURNS = 0.5
"""Largest share of the inputs at which one turns, for a play by these alone. Chosen: with more,
all inputs cost no more."""
_THRESHOLDS = (0.25, 0.5, 0.75, 1.0)  # Of stop operators, by the reach; chosen: four equal


def low_pass(
    x: np.ndarray,
    tau_s: float,
    dt_s: float,
    memory: dict[str, Any],
    may_step: bool = False,
    every: int = 1,
) -> np.ndarray:
    """
    Filter inputs, (n,), by 1/(1 + τ·s); τ = 0 passes them on.

    Before the first block, with an empty memory, the filter is at rest at its first input.
    may_step, every: see `pole`.
    """
    if not tau_s:
        return x[::every]
    return pole(x, -1 / tau_s, dt_s, memory, may_step, every) / tau_s


def resonator(
    x: np.ndarray, frequency_hz: float, damping_ratio: float, dt_s: float, memory: dict[str, Any]
) -> np.ndarray:
    """
    Filter inputs, (n,), by ω²/(s² + 2·ζ·ω·s + ω²), ζ < 1, by partial fractions.

    Before the first block, with an empty memory, the filter is at rest at its first input.
    """
    omega = 2 * np.pi * frequency_hz
    damped = omega * np.sqrt(1 - damping_ratio**2)
    mode = pole(x, complex(-damping_ratio * omega, damped), dt_s, memory)
    return omega**2 / damped * mode.imag


def pole(
    x: np.ndarray,
    rate: complex,
    dt_s: float,
    memory: dict[str, Any],
    may_step: bool = False,
    every: int = 1,
) -> np.ndarray:
    """
    Solve w' = rate·w + x, exactly for x a polynomial through the newest `ORDER` samples.

    The error is of order (ω·dt)^6 for an input of angular frequency ω. This is an exponential
    Adams-Moulton method (Hochbruck and Ostermann 2010, section 2.6). The polynomial uses past
    samples only, so that the filter does not look ahead. Inputs are (n,), or (n, k) for k filters;
    the real part of the rate is negative. With an empty memory w is at rest at the first input.

    may_step: whether inputs may step. A polynomial rings there, so that the newest two inputs are
    then joined by a straight line.
    every: of one series in a single block, each k-th output can be had alone, from the first on.
    """
    if not len(x):
        return x
    decay = np.exp(rate * dt_s)
    # What drives an output has decayed at the next one.
    weights = np.convolve(_weights(rate * dt_s, ORDER) * dt_s, decay ** np.arange(every))
    previous = memory['inputs'] if memory else np.repeat(x[:1], len(weights) - 1, axis=0)
    last_w = memory.get('w', -x[0] / rate)
    inputs = np.concatenate([previous, x])
    if may_step:
        drive = _stepping(inputs, _step_rows(rate * dt_s, dt_s))
    elif x.ndim == 1:
        drive = np.convolve(inputs, weights.real, 'valid')[::every]
        if rate.imag:
            # A complex convolution takes several times as long as one of each part.
            drive = drive + 1j * np.convolve(inputs, weights.imag, 'valid')[::every]
    else:
        drive = sum(
            weight * inputs[ORDER - 1 - j : len(inputs) - j] for j, weight in enumerate(weights)
        )
    w = first_order_recursion(1.0, decay**every, drive, last_w)
    memory['inputs'], memory['w'] = inputs[-(ORDER - 1) :], w[-1]
    return w


def _stepping(inputs: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """
    Return what inputs, (n + ORDER − 1, ...), drive a pole with, by the sums of `_step_rows`.

    It is the line where the newest input is far from the polynomial through those before it. That
    of a sine of 10 samples a period is near; the first input after a step misses it by the step.
    """
    drive = np.empty(inputs[ORDER - 1 :].shape)
    for newest in range(len(drive)):
        smooth, straight, missed, slope, bend = rows @ inputs[newest : newest + ORDER]
        change = np.abs(slope) + np.abs(bend)
        drive[newest] = np.where(np.abs(missed) <= _MOST_MISSED * change, smooth, straight)
    return drive


@lru_cache(maxsize=64)
def _step_rows(z: float, dt_s: float) -> np.ndarray:
    """
    Return weights of inputs, oldest first, (5, ORDER).

    They give the drive by a polynomial and by a line, the distance of the newest input from the
    polynomial through the others, and the change of the inputs, straight and bent.
    """
    line = np.zeros(ORDER)
    line[-_LINE:] = _weights(z, _LINE)[::-1]
    missed = np.poly(np.ones(ORDER - 1))[::-1]
    return np.array(
        [
            _weights(z, ORDER)[::-1] * dt_s,
            line * dt_s,
            missed,
            [-1, 0, 0, 0, 0, 1],
            [1, 0, -1, -1, 0, 1],
        ]
    )


def first_order_recursion(
    gain: float, decay: complex, inputs: np.ndarray, previous: complex | np.ndarray
) -> np.ndarray:
    """Filter inputs, (n,) or (n, k), by y[i] = decay · y[i − 1] + gain · inputs[i]."""
    if len(inputs) <= _FEW_INPUTS:
        # scipy.signal takes 0.5 s to import, and a live sensor has short blocks only.
        outputs = []
        for driven in (gain * inputs).tolist() if inputs.ndim == 1 else gain * inputs:
            previous = driven + decay * previous
            outputs.append(previous)
        return np.array(outputs)
    from scipy.signal import lfilter

    state = np.broadcast_to(decay * previous, (1, *inputs.shape[1:]))
    outputs, _ = lfilter([gain], [1.0, -decay], inputs, axis=0, zi=state)
    return outputs


@lru_cache(maxsize=64)
def _weights(z: complex, order: int) -> np.ndarray:
    """Return weights of the newest inputs, newest first: ∫ exp(z·(1 − s))·Lⱼ(s) ds, 0 to 1."""
    nodes = 1.0 - np.arange(order)
    lagrange = [
        np.poly(np.delete(nodes, j)) / np.prod(nodes[j] - np.delete(nodes, j))
        for j in range(order)
    ]
    if abs(z) < _STIFF:
        s, weight = np.polynomial.legendre.leggauss(_QUADRATURE_NODES)
        s, weight = (s + 1) / 2, weight / 2
        growth = weight * np.exp(z * (1 - s))
        return np.array([np.sum(growth * np.polyval(c, s)) for c in lagrange])
    # Integrals of exp(z·(1 − s))·s^k, by parts.
    moments = [(np.exp(z) - 1) / z]
    for k in range(1, order):
        moments.append((k * moments[-1] - 1) / z)
    return np.array([np.dot(c[::-1], moments) for c in lagrange])


def stop(x: np.ndarray, reach: float, memory: dict[Any, Any]) -> np.ndarray:
    """
    Return the mean of stop operators, x − play(x), each divided by its threshold.

    It is at most 1. It reaches that when the input has changed by 2·`reach` after a reversal
    (Prandtl-Ishlinskii; Brokate and Sprekels, "Hysteresis and Phase Transitions", 1996). The
    input is (n,), or (n, k) for k independent operators, as in `play`.
    """
    lag = np.zeros(x.shape)
    turns = _turns(x)
    for i, fraction in enumerate(_THRESHOLDS):
        threshold = fraction * reach
        lag += (x - play(x, threshold, memory.setdefault(i, {}), turns)) / threshold
    return lag / len(_THRESHOLDS)


def loop(x: np.ndarray, reach: float, memory: dict[Any, Any]) -> np.ndarray:
    """
    Return the stop operator minus its first branch, which is 0 until the input turns back.

    The first branch is a function of the input alone, and no hysteresis. See `stop`.
    """
    if not len(x):
        return x
    change = x - memory.setdefault('start', x[0].copy())
    first_branch = sum(np.clip(change / (fraction * reach), -1, 1) for fraction in _THRESHOLDS)
    return stop(x, reach, memory) - first_branch / len(_THRESHOLDS)


def play(
    x: np.ndarray, half_width: float, memory: dict[str, Any], turns: np.ndarray | None = None
) -> np.ndarray:
    """
    Follow the input with a dead band: yₙ = max(xₙ − r, min(xₙ + r, yₙ₋₁)).

    The input is (n,), or (n, k) for k operators. With an empty memory the output is in the middle
    of its dead band. While the input rises or falls, a step clamps the output before the stretch:
    only the few inputs at which it turns follow each other. `turns` are those of `_turns`.
    """
    if not half_width or not len(x):
        return x
    turns = _turns(x) if turns is None else turns
    if len(turns) > _MOST_TURNS * len(x):
        return _stepwise_play(x, half_width, memory)
    at_turns = _stepwise_play(x[turns], half_width, memory)
    before = np.repeat(at_turns[:-1], np.diff(turns), axis=0)
    outputs = np.concatenate([before, at_turns[-1:]])
    np.minimum(outputs, x + half_width, out=outputs)
    return np.maximum(outputs, x - half_width, out=outputs)


def _turns(x: np.ndarray) -> np.ndarray:
    """Return the first and the last input of each stretch that only rises, or never does."""
    if len(x) < 2:
        return np.arange(len(x))
    rises = (x[1:] > x[:-1]).reshape(len(x) - 1, -1)
    changes = (rises[1:] != rises[:-1]).any(axis=1)
    return np.concatenate([[0], np.flatnonzero(changes) + 1, [len(x) - 1]])


def _stepwise_play(x: np.ndarray, half_width: float, memory: dict[str, Any]) -> np.ndarray:
    """
    Run `play` over all inputs.

    A step clamps the output between xₙ − r and xₙ + r. Consecutive clamps combine to one clamp.
    The input is therefore split into stretches, which run in parallel and are joined afterwards.
    """
    rows = x.reshape(len(x), -1)
    length = ceil(np.sqrt(len(x)) / 3)
    padded = np.concatenate([rows, np.repeat(rows[-1:], -len(x) % length, axis=0)])
    stretches = np.ascontiguousarray(padded.reshape(-1, length, rows.shape[1]).swapaxes(0, 1))
    # low[n] and high[n] are the clamp that the first n + 1 steps of each stretch combine to.
    low, high = stretches - half_width, stretches + half_width
    for n in range(1, length):
        np.maximum(low[n], np.minimum(high[n], high[n - 1]), out=high[n])
        np.maximum(low[n], np.minimum(high[n], low[n - 1]), out=low[n])
    output = memory.get('output', rows[0])
    starts = []
    for bottom, top in zip(low[-1], high[-1]):
        starts.append(output)
        output = np.maximum(bottom, np.minimum(top, output))
    memory['output'] = output
    outputs = np.maximum(low, np.minimum(high, starts)).swapaxes(0, 1)
    return outputs.reshape(-1, rows.shape[1])[: len(x)].reshape(x.shape)
