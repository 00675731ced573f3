# SPDX-License-Identifier: Apache-2.0
"""
The reproducible remainder: what flexible functions predict of held-out blocks beyond effects.

Flexible functions of everything that a residual may follow are fitted to what a set of effects
leaves of the other blocks. What they predict of the held-out ones returns, and is no noise.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple, TYPE_CHECKING

from adxl_ros.diagnose import evidence as linear
from adxl_ros.diagnose.evidence import BLOCKS, ChannelColumns
from adxl_ros.diagnose.random_drift import drift_p
import numpy as np

if TYPE_CHECKING:
    from adxl_ros.diagnose.flexible_functions import Basis
    from adxl_ros.diagnose.held_out import HeldOutFits

_ROUNDS = 12
"""Rounds of the fit of the levels of flexible functions. Chosen: the levels hardly change then."""
_FIRST_LEVEL_G = 1e-3  # First level, g rms. Chosen: any other start ends at the same levels
_SMALLEST_NOISE = 1e-5
"""Smallest noise, in first levels. Chosen: 10 ng is below any sensor's, above rounding."""
_SMALLEST_LEVEL = 1e-4
"""Level, in first ones, below which a function is left out. Chosen: 0.1 µg is below any noise."""


@dataclass(frozen=True)
class Remainder:
    """What flexible functions predict of held-out blocks beyond a set of effects."""

    squares: np.ndarray  # Decrease of the squares by all functions, by block, (m/s²)², (blocks,)
    by_dimension: dict[str, np.ndarray]  # Decrease by the functions of one dimension alone
    # Increase of the log likelihood by those of one axis alone, by dimension, (axes, blocks)
    nats: Mapping[str, np.ndarray]
    # Probability that a drift has increments with such jumps or lines; 1 beside a healthy unit
    drift_p: float = 1.0


def reproducible_remainder(fits: HeldOutFits, bases: Iterable[Basis]) -> Remainder:
    """
    Predict held-out blocks by flexible functions of everything that a residual may follow.

    Each axis has functions by dimension; their levels are those of the largest evidence (MacKay
    1992), so that functions that follow noise vanish. The effects keep their values, so that the
    functions take up only what the effects leave. `bases` are the functions of each channel.
    """
    squares = np.zeros(BLOCKS)
    by_dimension: dict[str, np.ndarray] = {}
    nats: dict[str, np.ndarray] = {}
    for number, basis in enumerate(bases):
        if not basis:
            continue
        functions = _FlexibleFunctions.of(fits, number, basis)
        squares += functions.predict(fits, functions.dimensions != '').squares
        for dimension in (d.value for d in basis):
            alone = functions.predict(fits, functions.dimensions == dimension)
            by_dimension[dimension] = by_dimension.get(dimension, 0.0) + alone.squares
            before = nats.get(dimension, np.zeros((0, BLOCKS)))
            nats[dimension] = np.vstack([before, alone.log_likelihood])
    return Remainder(squares, by_dimension, nats, drift_p(fits))


class _Decrease(NamedTuple):
    """What functions predict of each block, (blocks,) each."""

    squares: np.ndarray  # Decrease of the squares, (m/s²)²
    log_likelihood: np.ndarray  # Increase of the log likelihood


class _FoldProducts(NamedTuple):
    """The products of a fold."""

    fitted_v2: np.ndarray  # Whitened, over the fitted blocks, V²
    white_v2: np.ndarray  # Whitened, by held-out block, V²
    plain_mps2: np.ndarray  # Mean over axes, by held-out block, (m/s²)²


@dataclass(frozen=True)
class _FlexibleFunctions:
    """The k flexible functions of one channel, beside the columns of a set of effects."""

    dimensions: np.ndarray  # What each function follows, (k,)
    columns: ChannelColumns  # The columns of the set
    # Products of the columns, then the functions, in both directions
    white_v2: np.ndarray  # Whitened, V²
    by_fold: list[_FoldProducts]
    variance_v2: float  # Variance of the whitened noise, V²

    @classmethod
    def of(cls, fits: HeldOutFits, number: int, basis: Basis) -> _FlexibleFunctions:
        """Multiply the columns and functions of the channel of some number."""
        columns = fits.linearised.columns[number]
        channel = fits.model.places[number]
        sensor = channel.comparison.sensor
        used = channel.comparison.used
        unit_v = _FIRST_LEVEL_G * float(sensor.scale_v_per_g[channel.axis])
        rows = np.concatenate([columns.values.T, *(b.T for b in basis.values())])
        rows[1 + len(columns.places) :] *= unit_v
        rows *= used
        plain_mps2 = linear.block_grams(rows) / channel.v_per_mean_mps2**2
        whitener = fits.linearised.filters[number][fits.full.filter_indices[number]]
        # Two at a time and in place they take little memory.
        for i in range(0, len(rows), 2):
            rows[i : i + 2] = next(linear.white_rows(rows[i : i + 2].T, used, [whitener]))
        white_v2 = linear.block_grams(rows)
        fitted_v2 = np.tensordot([fold.fitted for fold in fits.folds], white_v2, 1)
        return cls(
            dimensions=np.repeat(
                [d.value for d in basis], [functions.shape[1] for functions in basis.values()]
            ),
            columns=columns,
            white_v2=white_v2.sum(axis=0),
            by_fold=[
                _FoldProducts(of_fold, white_v2[fold.held_out], plain_mps2[fold.held_out])
                for of_fold, fold in zip(fitted_v2, fits.folds)
            ],
            # A recording without noise is known to the rounding of its simulation.
            variance_v2=max(
                float(fits.full.innovation_variance_v2[number]), (_SMALLEST_NOISE * unit_v) ** 2
            ),
        )

    def products(
        self, grams: np.ndarray, departures: np.ndarray, chosen: np.ndarray
    ) -> FunctionProducts:
        """Return the products of chosen functions, where effects have some departures."""
        effects = 1 + len(self.columns.places)
        functions = grams[..., effects:, effects:]
        residual = grams[..., effects:, :effects] @ self.columns.combination(departures)
        return FunctionProducts(functions[..., chosen, :][..., chosen], residual[..., chosen])

    def predict(self, fits: HeldOutFits, chosen: np.ndarray) -> _Decrease:
        """Fit functions, (k,) bool, to the other blocks, and predict those held out."""
        number = np.flatnonzero(chosen)
        level = largest_evidence_levels(
            self.products(self.white_v2, fits.full_departures, number),
            self.dimensions[number],
            self.variance_v2,
        )
        active = number[level > 0]
        level = level[level > 0]
        squares = np.zeros(BLOCKS)
        log_likelihood = np.zeros(BLOCKS)
        if not len(active):
            return _Decrease(squares, log_likelihood)
        for fold, products in zip(fits.folds, self.by_fold):
            known = self.products(products.fitted_v2, fold.departures, active)
            values = np.linalg.solve(
                known.functions / self.variance_v2 + np.diag(1 / level),
                known.residual / self.variance_v2,
            )
            plain = self.products(products.plain_mps2, fold.departures, active)
            white = self.products(products.white_v2, fold.departures, active)
            squares[fold.held_out] = plain.decrease(values)
            log_likelihood[fold.held_out] = 0.5 * white.decrease(values) / self.variance_v2
        return _Decrease(squares, log_likelihood)


class FunctionProducts(NamedTuple):
    """Products of k functions, of one part of a recording or by part."""

    functions: np.ndarray  # With each other, (..., k, k)
    residual: np.ndarray  # With what the effects leave, (..., k)

    def decrease(self, values: np.ndarray) -> np.ndarray:
        """Return by how much the functions lower the squares with k coefficients."""
        return 2 * self.residual @ values - (self.functions @ values) @ values


def largest_evidence_levels(
    products: FunctionProducts, dimensions: np.ndarray, variance: float
) -> np.ndarray:
    """
    Return the prior variances of the coefficients of k functions of the largest evidence, (k,).

    All functions of a dimension have one. It is 0 where the functions follow noise. `variance` is
    that of the noise.
    """
    level = np.ones(len(dimensions))
    for _ in range(_ROUNDS):
        active = np.flatnonzero(level)
        if not len(active):
            break
        precision = products.functions[np.ix_(active, active)] / variance
        covariance = np.linalg.inv(precision + np.diag(1 / level[active]))
        mean = covariance @ products.residual[active] / variance
        squares = mean**2 + np.diag(covariance)
        for dimension in np.unique(dimensions[active]):
            alike = dimensions[active] == dimension
            level[active[alike]] = squares[alike].mean()
        level[level <= _SMALLEST_LEVEL**2] = 0.0
    return level
