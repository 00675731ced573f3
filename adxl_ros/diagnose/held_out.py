# SPDX-License-Identifier: Apache-2.0
"""
What a set of effects leaves of samples that it was not fitted to.

Blocks of time are held out in turn, and the blocks next to them are not fitted. A set of effects
is fitted to the other blocks and predicts the ones left out. Zero-g, scale factor, filter and
latency are free beside it, within what a healthy, calibrated unit may differ by.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, TYPE_CHECKING

from adxl_ros.diagnose import evidence as linear
from adxl_ros.diagnose.evidence import BLOCKS, LinearFit, LinearisedHypothesis
from adxl_ros.diagnose.noise_filters import expected_drift_g, Whitener
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.error_sizes import rms
import numpy as np

if TYPE_CHECKING:
    from adxl_ros.diagnose.linear_model import LinearModel

FOLDS = 4  # Parts of a recording, each of which is held out once. Chosen: run time
_RUN_BLOCKS = 2
"""Neighbouring blocks that are held out together. Chosen: slow effects change within two."""


class HeldOut(NamedTuple):
    """What a set of effects leaves of blocks that it was not fitted to."""

    # Squares of recording minus simulation, mean over axes, sum over samples, by block, (m/s²)²,
    # (blocks,)
    squares: np.ndarray
    log_likelihood: np.ndarray  # Log likelihood by block, (blocks,)


class Fold(NamedTuple):
    """A fit to some blocks, and the blocks that it predicts."""

    held_out: np.ndarray  # Blocks that are predicted, (blocks,) bool
    fitted: np.ndarray  # Blocks that are fitted: none of them is next to a held-out one
    fit: LinearFit
    departures: np.ndarray  # Departures of the k coefficients from the prior mean, (k,)


@dataclass(frozen=True)
class HeldOutFits:
    """The fits of a linearised set of effects to all blocks but those held out."""

    linearised: LinearisedHypothesis  # The set of effects, linearised at its fit to all blocks
    model: LinearModel
    # Effects by which the zero-g may drift more than that of a healthy unit
    drifts: tuple[str, ...] = ()

    @cached_property
    def full(self) -> LinearFit:
        """Fit to all blocks."""
        return self.linearised.fit(drifts=self.drifts)

    @cached_property
    def full_departures(self) -> np.ndarray:
        """Departures from the prior mean in the fit to all blocks, (k,)."""
        return self.linearised.departures(self.full, self.full)

    @cached_property
    def folds(self) -> list[Fold]:
        """Return the fits to all blocks but one part of them, which is held out."""
        out = []
        for part in range(FOLDS):
            held_out = (np.arange(BLOCKS) // _RUN_BLOCKS) % FOLDS == part
            fitted = np.convolve(held_out, np.ones(3), 'same') == 0
            fit = self.linearised.fit(fitted, self.drifts)
            out.append(Fold(held_out, fitted, fit, self.linearised.departures(fit, self.full)))
        return out

    @cached_property
    def figures(self) -> HeldOut:
        """Squares and log likelihood of the held-out blocks."""
        squares = np.zeros(BLOCKS)
        log_likelihood = np.zeros(BLOCKS)
        linearised = self.linearised
        # Products of the columns, mean over axes, by block, (m/s²)²
        plain = [
            linear.plain_grams(columns.values, place.comparison.used) / place.v_per_mean_mps2**2
            for columns, place in zip(linearised.columns, self.model.places)
        ]
        for fold in self.folds:
            held_out = fold.held_out
            for number, columns in enumerate(linearised.columns):
                channel = linearised.channels[number]
                filter_index = fold.fit.filter_indices[number]
                variance_v2 = fold.fit.innovation_variance_v2[number]
                v = columns.combination(fold.departures)
                squares[held_out] += np.einsum('i,bij,j->b', v, plain[number][held_out], v)
                white_v2 = np.einsum(
                    'i,bij,j->b', v, channel.block_grams[filter_index][held_out], v
                )
                log_likelihood[held_out] += channel.log_scales[filter_index][held_out] - 0.5 * (
                    white_v2 / variance_v2 + channel.counts[held_out] * np.log(variance_v2)
                )
        return HeldOut(squares, log_likelihood)

    @property
    def _whiteners(self) -> list[Whitener]:
        """Whitening filter of each channel."""
        return [
            filters[f] for filters, f in zip(self.linearised.filters, self.full.filter_indices)
        ]

    def drift_densities(self) -> np.ndarray:
        """Return the densities of the drift by channel; 0 for that of a healthy unit."""
        per_v = [0.0 if w.healthy else w.density_per_v for w in self._whiteners]
        return np.array(per_v) * np.sqrt(self.full.innovation_variance_v2)

    @cached_property
    def drift_mps2(self) -> float:
        """Return the expected rms of the drift that the fitted noise has, m/s²."""
        sizes_g = [
            expected_drift_g(w.effect, density, comparison)
            for w, density, (comparison, _) in zip(
                self._whiteners, self.drift_densities(), self.model.places
            )
        ]
        return G0_MPS2 * rms(sizes_g)
