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

"""The play operator: what backlash and hysteresis are made of."""

from __future__ import annotations

from typing import Any

import numpy as np


def play(x: np.ndarray, half_width: float, memory: dict[str, Any]) -> np.ndarray:
    """
    Follow the input with a dead band: yₙ = max(xₙ − r, min(xₙ + r, yₙ₋₁)).

    Between two turning points of the input, the output is known in closed form from its value
    at the first of them, so that only turning points are visited one by one (Krejčí,
    "Hysteresis, Convexity and Dissipation in Hyperbolic Equations", 1996, section II.2).

    Parameters
    ----------
    x
        Input, (n,).
    half_width
        r, in the unit of the input.
    memory
        Keeps the last input and output from one block to the next; empty before the first,
        when the output is in the middle of its dead band.

    Returns
    -------
    ndarray
        Output, (n,).

    """
    if not half_width or not len(x):
        return x
    inputs = np.concatenate([[memory.get('input', x[0])], x])
    steps = np.diff(inputs)
    rising = steps > 0
    moves = np.flatnonzero(steps)
    # A stretch begins where the sign of the motion changes; those at rest belong to the last.
    turns = moves[np.flatnonzero(np.diff(rising[moves])) + 1] if len(moves) else moves
    begins = np.concatenate([[0], turns]).astype(np.intp)
    ends = np.concatenate([turns, [len(x)]]).astype(np.intp)
    upward = np.zeros(len(begins), bool)
    if len(moves):
        upward[0], upward[1:] = rising[moves[0]], rising[turns]
    at = memory.get('output', float(x[0]))
    start = []
    for last, up in zip(inputs[ends].tolist(), upward.tolist()):
        start.append(at)
        at = max(at, last - half_width) if up else min(at, last + half_width)
    counts = ends - begins
    held = np.repeat(start, counts)
    up = np.repeat(upward, counts)
    out = np.where(up, np.maximum(held, x - half_width), np.minimum(held, x + half_width))
    memory['input'], memory['output'] = x[-1], at
    return out
