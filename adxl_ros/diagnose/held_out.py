# SPDX-License-Identifier: Apache-2.0
"""
What a set of effects leaves of samples that it was not fitted to.

Blocks of time are held out in turn, and the blocks next to them are not fitted. A set of effects
is fitted to the other blocks and predicts the ones left out. Zero-g, scale factor, filter and
latency are free beside it, within what a healthy, calibrated unit may differ by.

Few effects have exactly the form of the library. Where a set is compared with a part of itself,
flexible functions of the variables of these effects stand beside both (embedded errors of form;
Kennedy and O'Hagan 2001, J. R. Stat. Soc. B 63), so that an error of form feeds itself, and not
a further effect.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import chain, pairwise, repeat
from typing import NamedTuple

from adxl_ros.diagnose import evidence as linear
from adxl_ros.diagnose.evidence import BLOCKS, LinearFit, LinearisedHypothesis
from adxl_ros.diagnose.flexible_functions import flexible_bases
from adxl_ros.diagnose.linear_model import filters_for, LinearModel, with_filters
from adxl_ros.diagnose.noise_filters import expected_drift_g, Whitener
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.effects import effect_named
from adxl_ros.model.error_sizes import rms
import numpy as np

FOLDS = 4  # Parts of a recording, each of which is held out once. Chosen: run time
_RUN_BLOCKS = 2
"""Neighbouring blocks that are held out together. Chosen: slow effects change within two."""
_FORM_ERROR = 0.1
"""Prior rms of an error of form, divided by that of its effect. Chosen: a curve that differs by
more is another effect."""


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

    # The set of effects, linearised at its fit to all blocks, in the noise of a healthy unit
    healthy: LinearisedHypothesis
    model: LinearModel
    # Effects by which the zero-g may drift more than that of a healthy unit
    drifts: tuple[str, ...] = ()
    # Figures beside errors of form, as far as they were asked for, by the effects that have them
    beside_errors: dict[frozenset[str], HeldOut] = field(default_factory=dict)

    def beside_form_errors(self, effects: frozenset[str]) -> HeldOut:
        """Return the figures where some effects of the set have errors of form, too."""
        if effects not in self.beside_errors:
            wider = self._with_form_errors(effects)
            filtered = with_filters(self.model, wider, [[w] for w in self._whiteners])
            self.beside_errors[effects] = HeldOutFits(filtered, self.model).figures
        return self.beside_errors[effects]

    def _with_form_errors(self, effects: frozenset[str]) -> LinearisedHypothesis:
        """Add what errors of form of some effects may be: columns of one standard deviation."""
        model, linearised = self.model, self.linearised
        forms = {e: form for e in effects if (form := effect_named(e).diagnosis.form)}
        chosen = set(chain(*forms.values()))
        bases = map(flexible_bases, model.comparisons, model.baseline_v, repeat(chosen))
        widened = []
        count = first = len(linearised.prior_std)
        for columns, basis, channel in zip(linearised.columns, chain(*bases), model.places):
            of_effects = [
                k for k, i in enumerate(columns.places) if linearised.names[i].effect in forms
            ]
            values = linearised.values[columns.places[of_effects]]
            change_v = columns.own[channel.comparison.used, 1:][:, of_effects] @ values
            size_v = _FORM_ERROR * float(change_v.std())
            own = np.hstack([columns.own, *(size_v * f for f in basis.values())])
            last = columns.own.shape[1]
            numbers = count + np.arange(own.shape[1] - last)
            count += len(numbers)
            places = np.insert(columns.places, last - 1, numbers)
            widened.append(columns._replace(places=places, own=own))
        return replace(
            linearised,
            prior_std=np.append(linearised.prior_std, np.ones(count - first)),
            reach=np.append(linearised.reach, np.full(count - first, np.inf)),
            columns=widened,
        )

    @cached_property
    def linearised(self) -> LinearisedHypothesis:
        """Whiten the set for noise that may drift, once it is asked for."""
        if not self.drifts:
            return self.healthy
        filters = filters_for(self.model.filters, (*self.model.baseline.effects, *self.drifts))
        return with_filters(self.model, self.healthy, filters)

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
        return self._folds_of(_RUN_BLOCKS)

    def _folds_of(self, run_blocks: int) -> list[Fold]:
        """Fit to all blocks but a part; so many neighbouring ones are held out together."""
        lasting = run_blocks > _RUN_BLOCKS
        out = []
        for part in range(FOLDS):
            held_out = (np.arange(BLOCKS) // run_blocks) % FOLDS == part
            fitted = np.convolve(held_out, np.ones(3), 'same') == 0
            fit = self.linearised.fit(fitted, self.drifts)
            departures = self.linearised.departures(fit, self.full, lasting)
            out.append(Fold(held_out, fitted, fit, departures))
        return out

    @cached_property
    def _plain(self) -> list[np.ndarray]:
        """Products of the columns of each channel, mean over axes, by block, (m/s²)²."""
        return [
            linear.block_grams(columns.values.T * place.comparison.used) / place.v_per_mean_mps2**2
            for columns, place in zip(self.linearised.columns, self.model.places)
        ]

    @cached_property
    def _left_v(self) -> list[np.ndarray]:
        """Return what is left of the held-out samples of each channel, V, (n,)."""
        every = []
        for columns in self.linearised.columns:
            values = columns.values
            left_v = np.zeros(len(values))
            edges = list(pairwise(linear.block_edges(len(values))))
            for fold in self.folds:
                v = columns.combination(fold.departures)
                for block in np.flatnonzero(fold.held_out):
                    samples = slice(*edges[block])
                    left_v[samples] = values[samples] @ v
            every.append(left_v)
        return every

    @cached_property
    def by_quarter(self) -> np.ndarray:
        """Log likelihood by block, (blocks,), where whole quarters of the time are held out."""
        return self._predicted(self._folds_of(BLOCKS // FOLDS)).log_likelihood

    def squares_between(self, other: HeldOutFits) -> np.ndarray:
        """Squares by which predictions differ, mean over axes, by block, (m/s²)², (blocks,)."""
        squares = np.zeros(BLOCKS)
        for place, own_v, other_v in zip(self.model.places, self._left_v, other._left_v):
            between = (own_v - other_v) * place.comparison.used / place.v_per_mean_mps2
            squares += linear.sum_by_block(between**2)
        return squares

    @property
    def tolerated(self) -> np.ndarray:
        """
        Squares of what nuisance parameters change, mean over axes, by block, (m/s²)², (blocks,).

        Nothing is known of it without a pose, which the zero-g then stands for.
        """
        squares = np.zeros(BLOCKS)
        departures = self.full_departures.copy()
        departures[: len(self.linearised.values)] = 0.0
        for columns, plain in zip(self.linearised.columns, self._plain):
            change = departures[columns.places]
            squares += np.einsum('i,bij,j->b', change, plain[:, 1:, 1:], change)
        return squares * self.model.pose_known

    @cached_property
    def figures(self) -> HeldOut:
        """Squares and log likelihood of the held-out blocks."""
        return self._predicted(self.folds)

    def _predicted(self, folds: list[Fold]) -> HeldOut:
        """Predict the blocks that fits hold out."""
        squares = np.zeros(BLOCKS)
        log_likelihood = np.zeros(BLOCKS)
        linearised = self.linearised
        for fold in folds:
            held_out = fold.held_out
            for number, columns in enumerate(linearised.columns):
                channel = linearised.channels[number]
                filter_index = fold.fit.filter_indices[number]
                variance_v2 = fold.fit.innovation_variance_v2[number]
                v = columns.combination(fold.departures)
                squares[held_out] += np.einsum('i,bij,j->b', v, self._plain[number][held_out], v)
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
