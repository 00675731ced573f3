# SPDX-License-Identifier: Apache-2.0

"""
What each manoeuvre is expected to tell, given the samples so far.

Each hypothesis has a posterior of its coefficients by the samples so far. The manoeuvre is
simulated with the baseline and goes through the same comparison as a recording, with the steps of
the encoder. Its sensitivities to the library then predict the response of each hypothesis, with
the spread of its coefficients. `information` compares the predictions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Protocol

from adxl_ros.diagnose import evidence
from adxl_ros.diagnose.comparison import at_search_rate, compare
from adxl_ros.diagnose.evidence import LinearFit
from adxl_ros.diagnose.information import Belief, expected_information
from adxl_ros.diagnose.linear_model import build_linear_model, LinearModel
from adxl_ros.diagnose.noise_detectors import UNKNOWN
from adxl_ros.diagnose.noise_whitening import drifts_among
from adxl_ros.diagnose.verdict import Verdict, WeightedHypothesis
from adxl_ros.files.recording_columns import Recording
from adxl_ros.model.diagnosis_hints import FormDimension
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.sensor import Sensor
from adxl_ros.simulate.motion import Motion
from adxl_ros.simulate.simulator import simulate_blocks
import numpy as np

_RATE_HZ = 62.5
"""Sample rate of the simulated manoeuvres, Hz. Chosen: run time; a stage moves far slower."""
_SMALLEST_PROBABILITY = 1e-3
"""Probability below which a hypothesis does not lead the choice. Chosen: together they are far
below the 5 % that remain at the end."""
_MOST_HYPOTHESES = 40
"""Largest number of hypotheses that lead the choice. Chosen: run time."""
_UNKNOWN_G = 1e-3
"""Rms of an unknown function, g. Chosen: the middle of those of the diagnosis."""


_EVIDENCE_FACTOR = 0.3
"""Factor of the information, because no model of a sensor is exact (Miller and Dunson 2019)."""


class Experiment(Protocol):
    """A manoeuvre that can be recorded next."""

    @property
    def name(self) -> str:
        """Return its name."""

    @property
    def motion(self) -> Motion:
        """Return its motion."""

    @property
    def begin_s(self) -> float:
        """Return the time of its motion at which it begins, s."""

    @property
    def minutes(self) -> float:
        """Return its duration, min."""


class ColumnKey(NamedTuple):
    """A coefficient of one variant of an effect, or of a flexible function."""

    variant: tuple  # Effect, shape and step; dimension, channel and number of a flexible function
    name: Coefficient | None  # The coefficient; None of a flexible function


@dataclass(frozen=True)
class ManoeuvreWorth:
    """What a manoeuvre is expected to tell."""

    manoeuvre: Experiment  # The manoeuvre
    information: float  # Expected decrease of the entropy of the hypotheses, nat

    @property
    def per_minute(self) -> float:
        """Return the expected information per minute, nat/min."""
        return self.information / self.manoeuvre.minutes


@dataclass(frozen=True)
class PredictedResponse:
    """Products of the sensitivities of one manoeuvre."""

    manoeuvre: Experiment  # The manoeuvre
    linear_model: LinearModel  # Its linear model
    places: dict[ColumnKey, int]  # Place of each column
    gram: np.ndarray  # Products, in units of the noise, (k, k)

    @property
    def effects(self) -> set[str]:
        """Return the effects that the manoeuvre excites."""
        return {v.effect for v in self.linear_model.variants}


@dataclass(frozen=True)
class _Posterior:
    """What a hypothesis knows after the samples so far."""

    keys: tuple[ColumnKey, ...]  # Columns of its k coefficients
    mean: np.ndarray  # Their means, (k,)
    covariance: np.ndarray  # Their covariance, (k, k)
    unseen: tuple[str, ...] = ()  # Effects of the hypothesis about which only the prior is known
    dimensions: tuple[FormDimension, ...] = ()  # Dimensions in which it has an unknown function


@dataclass
class _Samples:
    """The linear model of the samples so far, and fits that hypotheses share."""

    linear_model: LinearModel
    null_fit: LinearFit
    best_variants: dict[str, int] = field(default_factory=dict)

    def best_variant(self, effect: str) -> int | None:
        """Return the variant of an effect that fits best; None where the samples show none."""
        if effect not in self.best_variants:
            model = self.linear_model
            numbers = [i for i, v in enumerate(model.variants)
                       if v.effect == effect and not v.limit_start]
            if not numbers:
                return None
            self.best_variants[effect] = max(
                numbers, key=lambda i: model.fit_variants([i], self.null_fit).log_evidence)
        return self.best_variants[effect]


def leading(hypotheses: Sequence[WeightedHypothesis]) -> tuple[WeightedHypothesis, ...]:
    """Return the hypotheses that lead the choice of a manoeuvre, by falling probability."""
    return tuple(h for h in hypotheses
                 if h.probability > _SMALLEST_PROBABILITY)[:_MOST_HYPOTHESES]


def unknown_dimensions(verdict: Verdict | None) -> tuple[FormDimension, ...]:
    """Return the dimensions in which something unknown may act, or the usual ones."""
    present = {d.value: d for d in FormDimension}
    where = tuple(present[d] for d in (verdict.rest_follows if verdict else ()) if d in present)
    return where or (FormDimension.FORCE, FormDimension.DIRECTION, FormDimension.RATE,
                     FormDimension.TIME)


def rank_responses(responses: Sequence[PredictedResponse],
                   hypotheses: Sequence[WeightedHypothesis], model: LinearModel | None,
                   dimensions: Sequence[FormDimension]
                   ) -> tuple[ManoeuvreWorth, ...]:
    """Rank manoeuvres by their expected information per minute."""
    samples = _Samples(model, model.fit_variants([])) if model else None
    leaders = leading(hypotheses)
    posteriors = [_posterior_of(h, samples, leaders, dimensions) for h in leaders]
    total = sum(h.probability for h in leaders)
    probabilities = [h.probability / total for h in leaders]
    worth = [ManoeuvreWorth(r.manoeuvre, expected_information(
        r.gram, probabilities, [_belief(p, r) for p in posteriors], _EVIDENCE_FACTOR))
        for r in responses]
    return tuple(sorted(worth, key=lambda w: -w.per_minute))


def predict(manoeuvre: Experiment, sensor: Sensor, effects: Sequence[str],
            dimensions: Sequence[FormDimension]) -> PredictedResponse:
    """Simulate a manoeuvre with the baseline, and multiply its whitened sensitivities."""
    at_rate = replace(sensor, rate_hz=min(sensor.rate_hz, _RATE_HZ))
    parts = list(simulate_blocks(at_rate, manoeuvre.motion, 0, manoeuvre.begin_s))
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    time_s = columns.pop('time_s')
    comparison = at_search_rate(compare(Recording(manoeuvre.name, time_s, columns), at_rate))
    model = build_linear_model([comparison], only=effects)
    fit = model.fit_variants([])
    keys = _keys(model)
    places: dict[ColumnKey, int] = {}
    blocks = []
    for number, channel in enumerate(model.columns):
        functions = model.flexible_bases[0][number]
        scale = float(comparison.sensor.scale_v_per_g[number])
        of_channel = [(keys[c.number], c.values) for c in channel if c.number in keys]
        for dimension in (d for d in dimensions if d in functions):
            of_channel += [(ColumnKey((dimension, number, i), None), scale * _UNKNOWN_G * values)
                           for i, values in enumerate(functions[dimension].T)]
        whitener = model.filters_of(())[number][fit.filter_indices[number]]
        series = evidence.prepared([whitener], np.array([v for _, v in of_channel]).T,
                                   comparison.used)
        white = evidence.whitened(whitener, series, comparison.used)
        for key, _ in of_channel:
            places.setdefault(key, len(places))
        blocks.append((np.array([places[key] for key, _ in of_channel]),
                       white @ white.T / fit.innovation_variance_v2[number]))
    gram = np.zeros((len(places), len(places)))
    for ids, block in blocks:
        gram[np.ix_(ids, ids)] += block
    return PredictedResponse(manoeuvre, model, places, gram)


def _keys(model: LinearModel) -> dict[int, ColumnKey]:
    """Return the key of each column of a linear model by its number."""
    return {number: ColumnKey((v.effect, tuple(v.shape.items()), v.step), model.names[number])
            for v, ids in zip(model.variants, model.column_ids) if not v.limit_start
            for number in ids}


def _posterior_of(hypothesis: WeightedHypothesis, samples: _Samples | None,
                  others: Sequence[WeightedHypothesis], dimensions: Sequence[FormDimension]
                  ) -> _Posterior:
    """Return what a hypothesis knows; something unknown acts beside the best other one."""
    if UNKNOWN in hypothesis.effects:
        named = next((h for h in others if UNKNOWN not in h.effects), WeightedHypothesis((), 1.0))
        effects, functions = named.effects, tuple(dimensions)
    else:
        effects, functions = hypothesis.effects, ()
    if drifts_among(effects):
        functions = tuple(dict.fromkeys((*functions, FormDimension.TIME)))
    if samples is None:
        return _Posterior((), np.zeros(0), np.zeros((0, 0)), effects, functions)
    numbers = {e: samples.best_variant(e) for e in effects}
    unseen = tuple(e for e, number in numbers.items() if number is None)
    chosen = [number for number in numbers.values() if number is not None]
    model = samples.linear_model
    fit = model.fit_variants(chosen, samples.null_fit) if chosen else samples.null_fit
    keys = _keys(model)
    return _Posterior(tuple(keys[int(i)] for i in fit.column_ids), fit.values, fit.covariance,
                      unseen, functions)


def _belief(posterior: _Posterior, response: PredictedResponse) -> Belief:
    """Return what a hypothesis knows of the columns of a manoeuvre."""
    places = response.places
    count = len(places)
    kept = [i for i, key in enumerate(posterior.keys) if key in places]
    mean = np.zeros(count)
    mean[[places[posterior.keys[i]] for i in kept]] = posterior.mean[kept]
    roots = []
    if kept:
        root = np.zeros((count, len(kept)))
        root[[places[posterior.keys[i]] for i in kept]] = _square_root(
            posterior.covariance[np.ix_(kept, kept)])
        roots.append(root)
    prior_std = _prior_std(posterior, response)
    ids = [place for place in prior_std if prior_std[place] > 0]
    if ids:
        root = np.zeros((count, len(ids)))
        root[ids, range(len(ids))] = [prior_std[i] for i in ids]
        roots.append(root)
    return Belief(mean, np.hstack(roots) if roots else np.zeros((count, 0)))


def _prior_std(posterior: _Posterior, response: PredictedResponse) -> dict[int, float]:
    """Return prior standard deviations by place of what the samples so far do not determine."""
    places, model = response.places, response.linear_model
    keys = _keys(model)
    chosen = []
    for effect in posterior.unseen:
        numbers = [i for i, v in enumerate(model.variants)
                   if v.effect == effect and not v.limit_start]
        # The middle one of the shapes stands for all.
        chosen += [numbers[len(numbers) // 2]] if numbers else []
    prior_std = model.prior(chosen)
    determined = {places[key] for key in posterior.keys if key in places}
    ids = {k for i in chosen for k in model.column_ids[i]} | set(model.nuisance_ids())
    stds = {places[keys[k]]: float(prior_std[k]) for k in ids if keys[k] in places}
    stds |= {place: 1.0 for key, place in places.items()
             if key.name is None and key.variant[0] in posterior.dimensions}
    return {place: std for place, std in stds.items() if place not in determined}


def _square_root(covariance: np.ndarray) -> np.ndarray:
    """Return a square root of a covariance, (k, k), whose units may differ by orders."""
    std = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(std, std))
    return std[:, None] * vectors * np.sqrt(np.maximum(values, 0.0))
