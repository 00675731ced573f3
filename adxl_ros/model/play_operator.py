# SPDX-License-Identifier: Apache-2.0

"""The operators of play and stop, which backlash and hysteresis consist of."""

from __future__ import annotations

from math import ceil
from typing import Any

import numpy as np

_THRESHOLDS = (0.25, 0.5, 0.75, 1.0)
"""Thresholds of the stop operators, divided by the reach; chosen: four of equal weight."""


def stop(x: np.ndarray, reach: float, memory: dict[Any, Any]) -> np.ndarray:
    """
    Return the mean of stop operators, x − play(x), each divided by its threshold.

    It is at most 1. It reaches that when the input has changed by 2·`reach` after a reversal
    (Prandtl-Ishlinskii; Brokate and Sprekels, "Hysteresis and Phase Transitions", 1996).

    Parameters
    ----------
    x
        Input, (n,), or (n, k) for k independent operators.
    reach
        Largest threshold, in the unit of the input.
    memory
        Keeps the state from one block to the next. It is empty before the first block.

    Returns
    -------
    ndarray
        Lag behind the input, −1 to 1, (n,).

    """
    lag = np.zeros(x.shape)
    for i, fraction in enumerate(_THRESHOLDS):
        threshold = fraction * reach
        lag = lag + (x - play(x, threshold, memory.setdefault(i, {}))) / threshold
    return lag / len(_THRESHOLDS)


def loop(x: np.ndarray, reach: float, memory: dict[Any, Any]) -> np.ndarray:
    """
    Return the stop operator minus its first branch, which is 0 until the input turns back.

    The first branch is a function of the input alone, and no hysteresis.

    Parameters
    ----------
    x
        Input, (n,), or (n, k) for k independent operators.
    reach
        Largest threshold, in the unit of the input.
    memory
        Keeps the state from one block to the next. It is empty before the first block.

    Returns
    -------
    ndarray
        Difference of the branches, −2 to 2, in the shape of the input.

    """
    if not len(x):
        return x
    change = x - memory.setdefault('start', x[0].copy())
    first_branch = sum(np.clip(change / (fraction * reach), -1, 1) for fraction in _THRESHOLDS)
    return stop(x, reach, memory) - first_branch / len(_THRESHOLDS)


def play(x: np.ndarray, half_width: float, memory: dict[str, Any]) -> np.ndarray:
    """
    Follow the input with a dead band: yₙ = max(xₙ − r, min(xₙ + r, yₙ₋₁)).

    A step clamps the output between xₙ − r and xₙ + r. Consecutive clamps combine to one clamp.
    The input is therefore split into stretches, which run in parallel and are joined afterwards.

    Parameters
    ----------
    x
        Input, (n,), or (n, k) for k independent operators.
    half_width
        r, in the unit of the input.
    memory
        Keeps the last output from one block to the next. It is empty before the first block,
        when the output is in the middle of its dead band.

    Returns
    -------
    ndarray
        Output, in the shape of the input.

    """
    if not half_width or not len(x):
        return x
    if x.ndim > 1:
        return _play_side_by_side(x, half_width, memory)
    length = ceil(np.sqrt(len(x)) / 3)
    padded = np.concatenate([x, np.full(-len(x) % length, x[-1])])
    stretches = np.ascontiguousarray(padded.reshape(-1, length).T)
    # low[n] and high[n] are the clamp that the first n + 1 steps of each stretch combine to.
    low, high = stretches - half_width, stretches + half_width
    for n in range(1, length):
        np.maximum(low[n], np.minimum(high[n], high[n - 1]), out=high[n])
        np.maximum(low[n], np.minimum(high[n], low[n - 1]), out=low[n])
    output = memory.get('output', float(x[0]))
    starts = []
    for bottom, top in zip(low[-1].tolist(), high[-1].tolist()):
        starts.append(output)
        output = max(bottom, min(top, output))
    memory['output'] = output
    return np.maximum(low, np.minimum(high, starts)).T.ravel()[:len(x)]


def _play_side_by_side(x: np.ndarray, half_width: float, memory: dict[str, Any]) -> np.ndarray:
    """Run operators side by side, step by step; see `play`."""
    output = memory.get('output', x[0])
    outputs = np.empty_like(x)
    for n, inputs in enumerate(x):
        output = outputs[n] = np.maximum(inputs - half_width,
                                         np.minimum(inputs + half_width, output))
    memory['output'] = output
    return outputs
