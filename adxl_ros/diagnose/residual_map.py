# SPDX-License-Identifier: Apache-2.0
"""
Where a residual lies: its means over ranges of force, angle, rate, temperature and time.

Each mean is compared with the largest of all under random signs of whole blocks (max-T; Westfall
and Young 1993), because separate tests at 5 % would report ten of 200 cells by chance.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

from adxl_ros.diagnose import comparison as beside
from adxl_ros.diagnose.comparison import BaselineComparison, direction_of_last_move
from adxl_ros.model.constants import AXES
import numpy as np

RANGES = 8  # Number of ranges of a dimension, with equally many samples. Chosen: a row of the page
BLOCK_S = 2.0
"""Length of the blocks that change sign together, s. Chosen: beyond the correlation of noise."""
_DRAWS = 500  # Draws of random signs. Chosen: probabilities down to 0.002
_FEWEST_BLOCKS = 3  # Fewest blocks of a cell. Chosen: fewer have too few different signs
_SIGNIFICANT_P = 0.05
"""Family-wise probability below which a cell is reported. Chosen: the usual level."""
_MOST_CELLS = 40  # Largest number of reported cells. Chosen: cells of small share say little
_SMALLEST_RANGE = 1e-3
"""Range of a dimension, in its unit, below which it is constant. Chosen: an encoder, 0.1 mg."""
_SMALLEST_WARMING_C = 1.0  # Range of a temperature that is covered, °C. Chosen: 0.1 mg
_LONGEST_SINCE_MOVE_S = 60.0  # Longest time since a move, s. Chosen: the end of creep
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


class ResidualCell(NamedTuple):
    """
    Mean residual of one axis in one range of one dimension, m/s².

    `share` is of the squares of the residual, `p` the family-wise probability without a gap.
    """

    axis: str
    dimension: str
    low: float
    high: float
    mean_mps2: float
    share: float
    p: float


class _Cell(NamedTuple):
    """The samples of one axis in one range of one dimension."""

    axis: str
    dimension: str
    low: float
    high: float
    sums_mps2: np.ndarray  # Sum of the residual in each block of time, m/s², (blocks,)
    samples: float  # Number of samples

    @property
    def mean_mps2(self) -> float:
        """Return the mean residual, m/s²."""
        return float(self.sums_mps2.sum() / self.samples)


def dimensions(comparison: BaselineComparison) -> dict[str, np.ndarray]:
    """Return the dimensions of the map by name, (n,) each, without constant ones."""
    time_s = comparison.time_s
    force_g = comparison.reference_force_g()
    values = {'time_s': time_s - time_s[0], **comparison.surroundings}
    if force_g is not None:
        values |= {f'force_{axis}_g': f for axis, f in zip(AXES, force_g)}
    if comparison.joints:
        alpha_rad, beta_rad = comparison.joint_values()
        rates = comparison.joint_values(1)
        values |= {
            'alpha_rad': alpha_rad,
            'beta_rad': beta_rad % (2 * np.pi),
            'rate_rad_s': np.hypot(*rates),
            'direction_alpha': direction_of_last_move(alpha_rad),
            'direction_beta': direction_of_last_move(beta_rad),
            'since_move_s': np.minimum(
                beside.time_since_move_s(time_s, rates), _LONGEST_SINCE_MOVE_S
            ),
        }
    return {name: v for name, v in values.items() if np.ptp(v) > _SMALLEST_RANGE}


def not_covered(comparisons: Sequence[BaselineComparison]) -> list[str]:
    """Name, for people, the dimensions that no recording covers."""
    covered: set[str] = set()
    for comparison in comparisons:
        covered |= {
            name
            for name, values in dimensions(comparison).items()
            if name != 'temperature_c' or np.ptp(values) >= _SMALLEST_WARMING_C
        }
    if all(c.reference is beside.Reference.SIMULATOR for c in comparisons):
        covered |= _STAGE_ONLY
    return [text for name, text in _COVERAGE.items() if name not in covered]


def residual_map(comparison: BaselineComparison, seed: int) -> list[ResidualCell]:
    """Return the significant means of the residual over all dimensions, by falling share."""
    used = comparison.used
    residual_mps2 = comparison.residual_v(comparison.sensor) / comparison.scale_v_per_mps2
    residual_mps2 = np.where(used[:, None], residual_mps2 - residual_mps2[used].mean(axis=0), 0.0)
    block_length = max(round(BLOCK_S * comparison.sensor.rate_hz), 2)
    cells = _cells(comparison, residual_mps2, np.arange(len(residual_mps2)) // block_length)
    if not cells:
        return []
    total = max(float(np.sum(residual_mps2**2)), 1e-300)
    sums_mps2 = np.array([cell.sums_mps2 for cell in cells])
    significant = [
        ResidualCell(
            cell.axis,
            cell.dimension,
            cell.low,
            cell.high,
            mean_mps2=cell.mean_mps2,
            share=min(cell.mean_mps2**2 * cell.samples / total, 1.0),
            p=p,
        )
        for cell, p in zip(cells, _family_wise_p(sums_mps2, seed).tolist())
        if p < _SIGNIFICANT_P
    ]
    return sorted(significant, key=lambda cell: -cell.share)[:_MOST_CELLS]


def _cells(
    comparison: BaselineComparison, residual_mps2: np.ndarray, block: np.ndarray
) -> list[_Cell]:
    """Sum the residual over each range of each dimension; block: number of each sample's, (n,)."""
    blocks = int(block[-1]) + 1
    cells = []
    for name, values in dimensions(comparison).items():
        edges = np.unique(np.quantile(values[comparison.used], np.linspace(0, 1, RANGES + 1)))
        place = np.clip(np.searchsorted(edges, values, 'right') - 1, 0, len(edges) - 2)
        for i, (low, high) in enumerate(pairwise(edges)):
            chosen = comparison.used & (place == i)
            by_block = np.bincount(block[chosen], minlength=blocks)
            if np.count_nonzero(by_block) < _FEWEST_BLOCKS:
                continue
            for d, axis in enumerate(comparison.sensor.axes):
                sums = np.bincount(block[chosen], residual_mps2[chosen, d], blocks)
                cells.append(
                    _Cell(axis, name, float(low), float(high), sums, float(by_block.sum()))
                )
    return cells


def _family_wise_p(sums_mps2: np.ndarray, seed: int) -> np.ndarray:
    """
    Return the probability of means as large as those of k cells where there is no gap, (k,).

    sums_mps2: sums of the residual of each cell by block, (k, blocks). Whole blocks change sign at
    random, and the largest of all cells is the one that a mean must exceed (max-T).
    """
    spread = np.maximum(np.sqrt((sums_mps2**2).sum(axis=1)), 1e-300)
    signs = np.random.default_rng(seed).choice([-1.0, 1.0], (sums_mps2.shape[1], _DRAWS))
    largest = np.max(np.abs(sums_mps2 @ signs) / spread[:, None], axis=0)
    statistic = np.abs(sums_mps2.sum(axis=1)) / spread
    at_least = (largest[None] >= statistic[:, None]).sum(axis=1)
    return (1 + at_least) / (_DRAWS + 1)
