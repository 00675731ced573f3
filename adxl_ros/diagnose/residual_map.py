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
Where the gap lies: the residual's mean and variance over axis and dimension, tested as a whole.

Cells are judged by the largest of all their statistics under a bootstrap of whole blocks with
random signs (max-T; Westfall and Young 1993), so that 200 cells do not give ten false ones. Bands
of frequency are judged by the power that the noise should have there.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

from adxl_ros.diagnose.baseline_comparison import Series
from adxl_ros.diagnose.motion_history import direction, since_move_s
from adxl_ros.model import noise
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.kinematics import specific_force
import numpy as np
from scipy.signal import periodogram
from scipy.stats import gamma

_CELLS = 8
_DRAWS = 500
_BLOCK_S = 2.0
_FEWEST = 3
SHOWS_P = 0.05
_BANDS_HZ = (0.0, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 500.0)


@dataclass(frozen=True)
class Cell:
    """
    The residual in one range of one dimension on one axis.

    Attributes
    ----------
    statistic
        'mean', 'variance', or 'power' of a band of frequency.
    low, high
        Of the dimension, in the unit of its name.
    mean_mps2, floor_units
        Mean residual (of the others: root of what is more than elsewhere, or than noise), and by
        the floor.
    share
        Of the squares of the residual.
    p
        Family-wise probability under no gap.

    """

    axis: str
    dimension: str
    statistic: str
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
        out['direction_alpha'], out['direction_beta'] = map(direction, rates)
        out['since_move_s'] = np.minimum(since_move_s(time_s, rates), 60.0)
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
    Map the residual of a recording; all cells that can be tested, the largest share first.

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
    off = np.where(used[:, None], off - off[used].mean(axis=0), 0.0)
    out = [*_over(series, off, used, floor_mps2, seed),
           *_over_frequency(series, off, floor_mps2)]
    return sorted(out, key=lambda cell: -cell.share)


def _over(series: Series, off: np.ndarray, used: np.ndarray, floor_mps2: float, seed: int
          ) -> Iterator[Cell]:
    """Test mean and variance over all dimensions at once."""
    block = max(round(_BLOCK_S * series.sensor.rate_hz), 2)
    number = np.arange(len(off)) // block
    blocks = int(number[-1]) + 1
    squares = off ** 2
    about = squares - squares[used].mean(axis=0)
    names: list[tuple[str, str, str, float, float]] = []
    sums, counts = [], []
    for name, values in dimensions(series).items():
        edges = np.unique(np.quantile(values[used], np.linspace(0, 1, _CELLS + 1)))
        inside = np.clip(np.searchsorted(edges, values, 'right') - 1, 0, len(edges) - 2)
        for cell, (low, high) in enumerate(pairwise(edges)):
            chosen = used & (inside == cell)
            n = np.bincount(number[chosen], minlength=blocks)
            for d, axis in enumerate(series.sensor.axes):
                for statistic, of in (('mean', off), ('variance', about)):
                    names.append((axis, name, statistic, float(low), float(high)))
                    sums.append(np.bincount(number[chosen], of[chosen, d], minlength=blocks))
                    counts.append(n)
    total, size = np.array(sums), np.array(counts).sum(axis=1)
    spread = np.sqrt((total ** 2).sum(axis=1))
    enough = ((np.array(counts) > 0).sum(axis=1) >= _FEWEST) & (spread > 0)
    signs = np.random.default_rng(seed).choice([-1.0, 1.0], (blocks, _DRAWS))
    with np.errstate(all='ignore'):
        mean = total.sum(axis=1) / size
        seen = np.where(enough, np.abs(total.sum(axis=1)) / spread, 0.0)
        drawn = np.where(enough[:, None], np.abs(total @ signs) / spread[:, None], 0.0)
    p = (1 + (drawn.max(axis=0)[None] >= seen[:, None]).sum(axis=1)) / (_DRAWS + 1)
    whole = float(np.sum(squares))
    for i, (axis, name, statistic, low, high) in enumerate(names):
        if not enough[i] or (statistic == 'variance' and mean[i] <= 0):
            continue
        square = mean[i] ** 2 if statistic == 'mean' else mean[i]
        size_mps2 = mean[i] if statistic == 'mean' else np.sqrt(mean[i])
        yield Cell(axis, name, statistic, low, high, float(size_mps2),
                   float(size_mps2 / floor_mps2), float(min(square * size[i] / whole, 1.0)),
                   float(p[i]))


def _over_frequency(series: Series, off: np.ndarray, floor_mps2: float) -> Iterator[Cell]:
    """Compare the power in bands with that of the stated noise; p by Bonferroni."""
    rate_hz = series.sensor.rate_hz
    frequency, power = periodogram(off, rate_hz, axis=0)
    promised = noise.density_v2_per_hz(series.sensor, frequency) / series.scale_v_per_mps2 ** 2
    step = float(frequency[1])
    bands = [(low, min(high, rate_hz / 2)) for low, high in pairwise(_BANDS_HZ)
             if low < rate_hz / 2]
    for low, high in bands:
        inside = (frequency > low) & (frequency <= high)
        count = int(inside.sum())
        for d, axis in enumerate(series.sensor.axes):
            if not count:
                continue
            seen, usual = power[inside, d].sum(), promised[inside, d].sum()
            p = float(gamma.sf(seen / usual * count, count)) * len(bands) * off.shape[1]
            more = max(seen - usual, 0.0) * step
            yield Cell(axis, 'frequency_hz', 'power', low, high, float(np.sqrt(more)),
                       float(np.sqrt(more) / floor_mps2),
                       float(min(more / np.sum(np.mean(off ** 2, axis=0)), 1.0)),
                       float(np.clip(p, 1e-12, 1.0)))
