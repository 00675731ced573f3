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
Where the gap lies: the mean residual over axis and dimension, tested as a whole.

Cells are judged by the largest of all their statistics under a bootstrap of whole blocks with
random signs (max-T; Westfall and Young 1993), so that 200 cells do not give ten false ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from adxl_ros.gap.series import Series
from adxl_ros.gap.unknown import _direction, _since
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.stage import specific_force
import numpy as np

_CELLS = 8
_DRAWS = 500
_BLOCK_S = 2.0
_FEWEST = 3
BANDS_HZ = (0.0, 0.1, 1.0, 5.0, 15.0, 40.0)


@dataclass(frozen=True)
class Cell:
    """
    The residual in one range of one dimension on one axis.

    Attributes
    ----------
    mean_mps2, floor_units
        Mean residual, and by the floor.
    share
        Of the squares of the gap: those of the means of the cells of this axis and dimension.
    p
        Family-wise probability under no gap.

    """

    axis: str
    dimension: str
    low: float
    high: float
    mean_mps2: float
    floor_units: float
    share: float
    p: float


def dimensions(series: Series) -> dict[str, np.ndarray]:
    """Return what the residual is mapped over, (n,) by name; what does not vary is left out."""
    time_s, motion = series.time_s, series.motion
    out = {'time_s': time_s - time_s[0]}
    if series.reference == 'stage':
        alpha, beta = motion.alpha(time_s), motion.beta(time_s)
        out |= {'alpha_rad': alpha, 'beta_rad': beta % (2 * np.pi)}
        force = specific_force(alpha, beta, 1.0)
        out |= {f'force_{axis}_g': f for axis, f in zip(AXES, force)}
        rates = [motion.alpha(time_s, 1), motion.beta(time_s, 1)]
        out['rate_rad_s'] = np.hypot(*rates)
        out['direction_alpha'], out['direction_beta'] = map(_direction, rates)
        out['since_move_s'] = np.minimum(_since(time_s, out['rate_rad_s'] > 1e-3), 60.0)
    elif series.reference == 'sim' and motion.force is not None:
        out |= {f'force_{axis}_g': f / G0_MPS2 for axis, f in zip(AXES, motion.force(time_s))}
    for name in ('temperature_c', 'supply_v'):
        path = getattr(motion, name)
        if path is not None:
            out[name] = path(time_s)
    return {name: v for name, v in out.items() if np.ptp(v) > 1e-3}


def covered(series: Sequence[Series]) -> list[str]:
    """Name what no recording covers."""
    seen: set[str] = set()
    for one in series:
        seen |= set(dimensions(one))
        temperature = one.motion.temperature_c
        if temperature is not None and np.ptp(temperature(one.time_s)) < 1.0:
            seen -= {'temperature_c'}
    wanted = {'alpha_rad': 'planes of another alpha', 'beta_rad': 'turns of beta',
              'rate_rad_s': 'motion', 'temperature_c': 'other temperatures',
              'supply_v': 'other supplies', 'direction_beta': 'reversals'}
    return [words for name, words in wanted.items() if name not in seen]


def map_of(series: Series, residual_v: np.ndarray, used: np.ndarray, floor_mps2: float, seed: int
           ) -> list[Cell]:
    """
    Map the residual of a recording; the cells that show, the largest share first.

    Parameters
    ----------
    series
        The recording.
    residual_v
        Of the baseline, V, (n, m).
    used
        Samples that count, (n,).
    floor_mps2
        From `floor`.
    seed
        Of the bootstrap.

    """
    off = residual_v / series.scale_v_per_mps2
    off = off - off[used].mean(axis=0)
    block = max(round(_BLOCK_S * series.sensor.rate_hz), 2)
    number = np.arange(len(off)) // block
    blocks = int(number[-1]) + 1
    cells: list[tuple[str, str, float, float]] = []
    sums, counts = [], []
    for name, values in dimensions(series).items():
        edges = np.unique(np.quantile(values[used], np.linspace(0, 1, _CELLS + 1)))
        if len(edges) < 2:
            continue
        inside = np.clip(np.searchsorted(edges, values, 'right') - 1, 0, len(edges) - 2)
        for cell in range(len(edges) - 1):
            chosen = used & (inside == cell)
            n = np.bincount(number[chosen], minlength=blocks)
            for d, axis in enumerate(series.sensor.axes):
                cells.append((axis, name, float(edges[cell]), float(edges[cell + 1])))
                sums.append(np.bincount(number[chosen], off[chosen, d], minlength=blocks))
                counts.append(n)
    total, size = np.array(sums), np.array(counts).sum(axis=1)
    enough = (np.array(counts) > 0).sum(axis=1) >= _FEWEST
    with np.errstate(all='ignore'):
        mean = total.sum(axis=1) / size
        spread = np.sqrt((total ** 2).sum(axis=1))
        seen = np.where(enough & (spread > 0), np.abs(total.sum(axis=1)) / spread, 0.0)
        signs = np.random.default_rng(seed).choice([-1.0, 1.0], (blocks, _DRAWS))
        drawn = np.where((enough & (spread > 0))[:, None],
                         np.abs(total @ signs) / spread[:, None], 0.0)
    largest = drawn.max(axis=0)
    p = (1 + (largest[None] >= seen[:, None]).sum(axis=1)) / (_DRAWS + 1)
    whole = float(np.sum(off[used] ** 2))
    out = [Cell(axis, name, low, high, float(mean[i]), float(mean[i] / floor_mps2),
                float(min(mean[i] ** 2 * size[i] / whole, 1.0)), float(p[i]))
           for i, (axis, name, low, high) in enumerate(cells) if enough[i] and p[i] < 0.05]
    return sorted(out, key=lambda cell: -cell.share)
