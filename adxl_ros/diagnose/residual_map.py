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
Where the gap lies: mean and variance of the residual over axis and dimension, tested together.

Each statistic is compared with the largest of all statistics under random signs of whole blocks
(max-T; Westfall and Young 1993). Separate tests at 5 % would report ten of 200 cells by chance.
The power in bands of frequency is compared with that of the stated noise.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

from adxl_ros.diagnose.baseline_comparison import BaselineComparison, Reference
from adxl_ros.diagnose.motion_history import direction_of_last_move, time_since_move_s
from adxl_ros.model import noise
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.kinematics import specific_force
from adxl_ros.model.sensor import Sensor
import numpy as np
import scipy

RANGES = 8
"""Number of ranges of a dimension, with equally many samples. Chosen: a row of the page."""
_DRAWS = 500
"""Number of draws of random signs. Chosen: probabilities down to 0.002."""
_BLOCK_S = 2.0
"""Length of the blocks that change sign together, s. Chosen: beyond the correlation of noise."""
_FEWEST_BLOCKS = 3
"""Fewest blocks of a cell that is tested. Chosen: the signs of two blocks have four patterns."""
SIGNIFICANT_P = 0.05
"""Family-wise probability below which a cell is reported. Chosen: the usual level."""
_BANDS_HZ = (0.0, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 500.0)
"""Edges of the bands of frequency, Hz. Chosen: half a decade each."""
_SMALLEST_RANGE = 1e-3
"""Range of a dimension, in its unit, below which it is constant. Chosen: steps of an
encoder."""
SMALLEST_WARMING_C = 1.0
"""Range of the temperature, °C, below which it counts as constant. Chosen: 0.1 mg of a typical
sensor."""
_LONGEST_SINCE_MOVE_S = 60.0
"""Longest time since the last move that is mapped, s. Chosen: creep has ended."""
_COVERAGE = {
    'alpha_rad': 'planes of another alpha',
    'beta_rad': 'turns of beta',
    'rate_rad_s': 'motion',
    'temperature_c': 'other temperatures',
    'supply_v': 'other supplies',
    'direction_beta': 'reversals',
}
"""Dimensions that recordings should cover, and how the report names them."""
_STAGE_ONLY = {'alpha_rad', 'beta_rad', 'rate_rad_s', 'direction_beta'}
"""Dimensions of a stage, which another simulator does not have."""


@dataclass(frozen=True)
class ResidualCell:
    """
    The residual of one axis in one range of one dimension.

    Attributes
    ----------
    axis
        Name of the axis.
    dimension
        Name of the dimension, with its unit.
    statistic
        'mean', 'variance', or 'power' of a band of frequency.
    low, high
        Range of the dimension, in its unit.
    mean_mps2
        Mean residual, m/s². For variance and power: root of the excess, m/s².
    floor_units
        `mean_mps2` divided by the noise floor.
    share
        Share of the squares of the residual.
    p
        Family-wise probability without a gap.

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


class _Candidate(NamedTuple):
    """A cell before the test; sum and count of samples are by block."""

    axis: str
    dimension: str
    statistic: str
    low: float
    high: float
    sums: np.ndarray
    counts: np.ndarray


def dimensions(comparison: BaselineComparison) -> dict[str, np.ndarray]:
    """Return the dimensions of the map by name, (n,) each, without constant ones."""
    time_s, motion = comparison.time_s, comparison.motion
    values = {'time_s': time_s - time_s[0]}
    if comparison.reference is Reference.STAGE:
        alpha_rad, beta_rad = motion.alpha(time_s), motion.beta(time_s)
        values |= {'alpha_rad': alpha_rad, 'beta_rad': beta_rad % (2 * np.pi)}
        force = specific_force(alpha_rad, beta_rad, 1.0)
        values |= {f'force_{axis}_g': f for axis, f in zip(AXES, force)}
        rates = [motion.alpha(time_s, 1), motion.beta(time_s, 1)]
        values['rate_rad_s'] = np.hypot(*rates)
        values['direction_alpha'], values['direction_beta'] = map(direction_of_last_move, rates)
        values['since_move_s'] = np.minimum(time_since_move_s(time_s, rates),
                                            _LONGEST_SINCE_MOVE_S)
    elif comparison.reference is Reference.SIMULATOR and motion.force is not None:
        values |= {f'force_{axis}_g': f / G0_MPS2
                   for axis, f in zip(AXES, motion.force(time_s))}
    if motion.temperature_c is not None:
        values['temperature_c'] = motion.temperature_c(time_s)
    if motion.supply_v is not None:
        values['supply_v'] = motion.supply_v(time_s)
    return {name: v for name, v in values.items() if np.ptp(v) > _SMALLEST_RANGE}


def not_covered(comparisons: Sequence[BaselineComparison]) -> list[str]:
    """Name, for people, the dimensions that no recording covers."""
    covered: set[str] = set()
    for comparison in comparisons:
        covered |= set(dimensions(comparison))
        temperature = comparison.motion.temperature_c
        if temperature is not None \
                and np.ptp(temperature(comparison.time_s)) < SMALLEST_WARMING_C:
            covered -= {'temperature_c'}
    if all(c.reference is Reference.SIMULATOR for c in comparisons):
        covered |= _STAGE_ONLY
    return [text for name, text in _COVERAGE.items() if name not in covered]


def residual_map(comparison: BaselineComparison, at_full_rate: BaselineComparison,
                 floor_mps2: float, seed: int) -> list[ResidualCell]:
    """
    Map the residual of a recording.

    Parameters
    ----------
    comparison
        The recording beside the baseline.
    at_full_rate
        The same with all samples, for the frequencies.
    floor_mps2
        Noise floor, m/s².
    seed
        Seed of the random signs.

    Returns
    -------
    list of ResidualCell
        All cells that can be tested, by falling share.

    """
    cells = [*_cells_over_dimensions(comparison, _levelled(comparison), floor_mps2, seed),
             *_cells_over_frequency(at_full_rate.sensor, _levelled(at_full_rate), floor_mps2)]
    return sorted(cells, key=lambda cell: -cell.share)


def _levelled(comparison: BaselineComparison) -> np.ndarray:
    """Return the residual about its mean, m/s², (n, m); 0 where samples are not used."""
    used = comparison.used
    residual = comparison.residual_v(comparison.sensor) / comparison.scale_v_per_mps2
    return np.where(used[:, None], residual - residual[used].mean(axis=0), 0.0)


def _candidates(comparison: BaselineComparison, residual: np.ndarray) -> list[_Candidate]:
    """Sum residual and excess square over each range of each dimension, by block."""
    block = max(round(_BLOCK_S * comparison.sensor.rate_hz), 2)
    number = np.arange(len(residual)) // block
    blocks, used = int(number[-1]) + 1, comparison.used
    squares = residual ** 2
    excess = squares - squares[used].mean(axis=0)
    out = []
    for name, values in dimensions(comparison).items():
        edges = np.unique(np.quantile(values[used], np.linspace(0, 1, RANGES + 1)))
        place = np.clip(np.searchsorted(edges, values, 'right') - 1, 0, len(edges) - 2)
        for i, (low, high) in enumerate(pairwise(edges)):
            chosen = used & (place == i)
            counts = np.bincount(number[chosen], minlength=blocks)
            for d, axis in enumerate(comparison.sensor.axes):
                for statistic, signal in (('mean', residual), ('variance', excess)):
                    sums = np.bincount(number[chosen], signal[chosen, d], minlength=blocks)
                    out.append(_Candidate(axis, name, statistic, float(low), float(high), sums,
                                          counts))
    return out


def _cells_over_dimensions(comparison: BaselineComparison, residual: np.ndarray,
                           floor_mps2: float, seed: int) -> Iterator[ResidualCell]:
    """Test mean and variance over all dimensions together."""
    candidates = _candidates(comparison, residual)
    sums = np.array([c.sums for c in candidates])
    counts = np.array([c.counts for c in candidates])
    size = counts.sum(axis=1)
    spread = np.sqrt((sums ** 2).sum(axis=1))
    enough = ((counts > 0).sum(axis=1) >= _FEWEST_BLOCKS) & (spread > 0)
    signs = np.random.default_rng(seed).choice([-1.0, 1.0], (sums.shape[1], _DRAWS))
    with np.errstate(all='ignore'):
        mean = sums.sum(axis=1) / size
        statistic = np.where(enough, np.abs(sums.sum(axis=1)) / spread, 0.0)
        drawn = np.where(enough[:, None], np.abs(sums @ signs) / spread[:, None], 0.0)
    p = (1 + (drawn.max(axis=0)[None] >= statistic[:, None]).sum(axis=1)) / (_DRAWS + 1)
    total = float(np.sum(residual ** 2))
    for i, c in enumerate(candidates):
        is_mean = c.statistic == 'mean'
        if not enough[i] or (not is_mean and mean[i] <= 0):
            continue
        square = mean[i] ** 2 if is_mean else mean[i]
        size_mps2 = mean[i] if is_mean else np.sqrt(mean[i])
        yield ResidualCell(c.axis, c.dimension, c.statistic, c.low, c.high, float(size_mps2),
                           float(size_mps2 / floor_mps2),
                           float(min(square * size[i] / total, 1.0)), float(p[i]))


def _cells_over_frequency(sensor: Sensor, residual: np.ndarray, floor_mps2: float
                          ) -> Iterator[ResidualCell]:
    """Compare the power in bands with that of the stated noise (gamma, Bonferroni)."""
    rate_hz = sensor.rate_hz
    frequency_hz, power = scipy.signal.periodogram(residual, rate_hz, axis=0)
    stated = noise.density_v2_per_hz(sensor, frequency_hz) \
        / (sensor.scale_v_per_g / G0_MPS2) ** 2
    step_hz = float(frequency_hz[1])
    bands = [(low, min(high, rate_hz / 2)) for low, high in pairwise(_BANDS_HZ)
             if low < rate_hz / 2]
    for low, high in bands:
        inside = (frequency_hz > low) & (frequency_hz <= high)
        count = int(inside.sum())
        if not count:
            continue
        for d, axis in enumerate(sensor.axes):
            measured, expected = power[inside, d].sum(), stated[inside, d].sum()
            p = float(scipy.stats.gamma.sf(measured / expected * count, count)) * len(bands) \
                * residual.shape[1]
            excess = max(measured - expected, 0.0) * step_hz
            yield ResidualCell(
                axis, 'frequency_hz', 'power', low, high, float(np.sqrt(excess)),
                float(np.sqrt(excess) / floor_mps2),
                float(min(excess / np.sum(np.mean(residual ** 2, axis=0)), 1.0)),
                float(np.clip(p, 1e-12, 1.0)))
