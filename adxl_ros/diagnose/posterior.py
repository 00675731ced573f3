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
The posterior probability of the hypotheses.

A hypothesis is a set of effects, with or without an unknown function of one dimension. Its
evidence is a normal integral over all coefficients on the whitened recording:

* The effects have their fitted columns, and the nuisance parameters theirs.
* The form of an effect is not exactly that of a real sensor. A flexible function over the
  dimensions that the effect declares stands beside it. Its standard deviation is a share ρ of the
  effect's size, and ρ has a grid (Kennedy and O'Hagan 2001, J. R. Stat. Soc. B 63).
* The unknown function has an amplitude on a grid. It is orthogonal to what the library can imitate
  (Plumlee 2017, J. Am. Stat. Assoc. 112).
* The log evidence is multiplied by one factor below 1, because no model is exact (tempering,
  Miller and Dunson 2019, J. Am. Stat. Assoc. 114).

Effects that do not matter are struck from a set, and sets that become equal are merged.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

from adxl_ros.diagnose import evidence
from adxl_ros.diagnose.baseline_comparison import BaselineComparison
from adxl_ros.diagnose.decision_settings import DecisionSettings
from adxl_ros.diagnose.effect_sizes import SizedHypothesis
from adxl_ros.diagnose.flexible_terms import Basis
from adxl_ros.diagnose.hypothesis_fit import Hypothesis, sparsity_log_bayes_factor
from adxl_ros.diagnose.linear_model import LinearModel
from adxl_ros.diagnose.noise_whitening import drifts_among, Whitener
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.diagnosis_hints import FormDimension
from adxl_ros.model.effects import effect_named
from adxl_ros.model.noise import rounding
import numpy as np
import scipy

_NOISE_ITERATIONS = 3
"""Iterations over coefficients, noise level and filter. Chosen: they no longer change then."""
_LARGEST_HEALTHY = 3
"""Largest number of filters for a healthy unit that are compared. Chosen: run time."""
_LARGEST_DRIFTING = 2
"""The same of filters for drifts."""
_IMITATED_SHARE = 0.9
"""A direction of an unknown function is the library's if its columns reproduce this share of its
square. Chosen: what is left is small beside the noise of what the library holds."""
_SMALLEST_EIGENVALUE = 1e-9
"""Relative eigenvalue below which a direction is empty. Chosen: above rounding errors."""


@dataclass(frozen=True)
class WeighedHypothesis:
    """
    A set of material effects, with or without something unknown.

    Attributes
    ----------
    effects
        Names of the effects.
    unknown
        Dimension of the unknown function; None without one.
    hypothesis
        The fitted hypothesis of the set.
    log_evidence
        Log evidence, not tempered.
    log_weight
        Tempered log evidence and log prior, up to a constant.
    probability
        Posterior probability.
    form_error
        Most probable share of the form error.

    """

    effects: frozenset[str]
    unknown: FormDimension | None
    hypothesis: Hypothesis
    log_evidence: float
    log_weight: float
    probability: float
    form_error: float


@dataclass(frozen=True)
class _ChannelGrams:
    """Products of the whitened columns of a hypothesis and of the basis, by filter."""

    places: np.ndarray
    design: dict[int, np.ndarray]
    cross: dict[int, np.ndarray]


@dataclass(frozen=True)
class _Channel:
    """One axis of one recording: log priors of its filters, products of the whitened basis."""

    log_priors: list[float]
    count: float
    scale_v_per_g: float
    dimensions: dict[FormDimension, np.ndarray]
    unknown: dict[FormDimension, np.ndarray]
    basis: np.ndarray
    hypotheses: list[_ChannelGrams] = field(default_factory=list)


def posterior(linear_model: LinearModel, sized: Sequence[SizedHypothesis],
              settings: DecisionSettings) -> list[WeighedHypothesis]:
    """
    Compute the posterior probabilities of hypotheses.

    Parameters
    ----------
    linear_model
        The recordings.
    sized
        Fitted hypotheses with sizes; the empty one is among them.
    settings
        Priors and factors of the decision.

    Returns
    -------
    list of WeighedHypothesis
        Hypotheses by falling probability, which sums to 1.

    """
    channels = [_channel(linear_model, i, sized) for i in range(len(linear_model.channels))]
    entries: dict[tuple[frozenset[str], FormDimension | None], WeighedHypothesis] = {}

    def add(index: int, unknown: FormDimension | None, log_evidence: float, form: float) -> None:
        s = sized[index]
        if s.material != frozenset(s.hypothesis.effects) \
                and all(effect_named(e).exact for e in s.material):
            # An exact form lacks nothing that an immaterial effect could take up.
            return
        weight = settings.evidence_factor * log_evidence \
            + _log_prior(s.material, unknown, linear_model, settings)
        key = (s.material, unknown)
        # A merged set is represented by its own fit where it has one.
        exact = s.material == frozenset(s.hypothesis.effects)
        entry = entries.get(key)
        if entry is None:
            entries[key] = WeighedHypothesis(s.material, unknown, s.hypothesis, log_evidence,
                                             weight, 0.0, form)
            return
        hypothesis = s.hypothesis if exact else entry.hypothesis
        entries[key] = WeighedHypothesis(
            s.material, unknown, hypothesis, max(log_evidence, entry.log_evidence),
            max(weight, entry.log_weight), 0.0,
            form if weight > entry.log_weight else entry.form_error)

    by_form = []
    for index, s in enumerate(sized):
        shares = _form_errors(s, settings)
        values = [_log_evidence(channels, index, s, share) for share in shares]
        total = float(np.logaddexp.reduce(values) - np.log(len(values)))
        by_form.append((total, shares[int(np.argmax(values))]))
        add(index, None, *by_form[-1])
    ranked = sorted(range(len(sized)), key=lambda i: -(
        settings.evidence_factor * by_form[i][0]
        + _log_prior(sized[i].material, None, linear_model, settings)))
    rounding_mps2 = max(map(_held_rounding_mps2, linear_model.comparisons))
    kept = ranked[:settings.with_unknown]
    kept += [i for i, s in enumerate(sized) if not s.hypothesis.effects and i not in kept]
    for index in kept:
        for dimension in _dimensions(channels):
            if dimension in _forms_of_smoothing(sized[index]):
                continue
            values = [_log_evidence(channels, index, sized[index], by_form[index][1], dimension,
                                    amplitude)
                      for amplitude in settings.unknown_amplitudes_g]
            total = float(np.logaddexp.reduce(values) - np.log(len(values)))
            size_mps2 = G0_MPS2 * settings.unknown_amplitudes_g[int(np.argmax(values))]
            # What the recording does not make more probable is no finding. What is small beside
            # the effects is an error of their form, and beside coarse rounding or the errors of
            # a smooth reference a part of these.
            smallest_mps2 = max(
                rounding_mps2, settings.smallest_unknown_share * _inexact_mps2(sized[index]),
                settings.smallest_share_of_lost_motion * linear_model.lost_motion_mps2)
            if total > by_form[index][0] and size_mps2 > smallest_mps2:
                add(index, dimension, total, by_form[index][1])
    weights = np.array([e.log_weight for e in entries.values()])
    probabilities = np.exp(weights - np.logaddexp.reduce(weights))
    weighed = [replace(e, probability=float(p)) for e, p in zip(entries.values(), probabilities)]
    return sorted(weighed, key=lambda w: -w.probability)


def hidden_odds(linear_model: LinearModel, single_gains: Mapping[str, float],
                settings: DecisionSettings) -> dict[str, float]:
    """
    Return the odds that an effect acts that is too small to show, over no effect.

    The prior of amplitudes reaches far below the noise. A recording without a gap is therefore
    nearly as probable with such an effect as without one.

    Parameters
    ----------
    linear_model
        The recordings.
    single_gains
        Log Bayes factor of each effect over no effect.
    settings
        Priors and factors of the decision.

    Returns
    -------
    dict
        Odds by effect, of those effects that are not worth fitting.

    """
    none = _log_prior(frozenset(), None, linear_model, settings)
    return {effect: float(np.exp(settings.evidence_factor * gain - none + _log_prior(
        frozenset({effect}), None, linear_model, settings)))
        for effect, gain in single_gains.items() if gain < settings.worth_fitting}


def _held_rounding_mps2(comparison: BaselineComparison) -> float:
    """Return the rms of the rounding error that stays while the output stays, m/s²."""
    return max(float(np.sqrt(rounding(comparison.sensor, d).held_v2) / scale)
               for d, scale in enumerate(comparison.scale_v_per_mps2))


def _inexact_mps2(sized: SizedHypothesis) -> float:
    """Return the rms of the effects of a hypothesis whose form is not exact, m/s²."""
    return float(np.sqrt(sum(c.rms_mps2 ** 2 for e, c in sized.contributions.items()
                             if effect_named(e).diagnosis.form)))


def _form_errors(sized: SizedHypothesis, settings: DecisionSettings) -> Sequence[float]:
    """Return the shares of the form error that are tried beside a set of effects."""
    has_form = any(effect_named(e).diagnosis.form for e in sized.hypothesis.effects)
    return settings.form_errors if has_form else (0.0,)


def _log_prior(effects: frozenset[str], unknown: FormDimension | None, linear_model: LinearModel,
               settings: DecisionSettings) -> float:
    """Return the log prior of one set: the probability of its size, spread over such sets."""
    n, count, drifts = linear_model.library_size, len(effects), len(drifts_among(effects))
    others = count - drifts + (unknown is not None)
    handicap = settings.beside_drift * (others if drifts else 0)
    sets = float(np.prod([(n - i) / (i + 1) for i in range(count)]))
    by_count = settings.prior_by_count if unknown is None else settings.prior_of_unknown_by_count
    prior = by_count[min(count, len(by_count) - 1)] / sets
    return float(np.log(prior if unknown is None else prior / len(FormDimension))) \
        - settings.evidence_factor * handicap


def _forms_of_smoothing(sized: SizedHypothesis) -> set[FormDimension]:
    """Return where the form of a smooth reference looks like something unknown."""
    return {dimension for effect in map(effect_named, sized.hypothesis.effects)
            if effect.diagnosis.smooths_reference for dimension in effect.diagnosis.form}


def _dimensions(channels: Sequence[_Channel]) -> list[FormDimension]:
    """Return the dimensions in which any channel has an unknown function."""
    return list(dict.fromkeys(d for channel in channels for d in channel.unknown))


def _channel(linear_model: LinearModel, number: int, sized: Sequence[SizedHypothesis]
             ) -> _Channel:
    """Whiten the basis and the columns of all hypotheses in one channel."""
    recording, axis = linear_model.place_of_channel(number)
    comparison = linear_model.comparisons[recording]
    basis = linear_model.flexible_bases[recording][axis]
    scale = float(comparison.sensor.scale_v_per_g[axis])
    columns = np.concatenate([values.T for values in basis.values()]).T * scale
    filters = _filters(number, sized)
    used = comparison.used
    grams = np.empty((len(filters), columns.shape[1], columns.shape[1]))
    linearised = [s.hypothesis.linearised for s in sized]
    design: list[dict[int, np.ndarray]] = [{} for _ in sized]
    cross: list[dict[int, np.ndarray]] = [{} for _ in sized]
    imitated = np.zeros(0)
    series = evidence.prepared(filters, columns, used)
    by_hypothesis = [evidence.prepared(filters, hypothesis.columns[number].values, used)
                     for hypothesis in linearised]
    for f, whitener in enumerate(filters):
        white = evidence.whitened(whitener, series, used)
        grams[f] = white @ white.T
        if f == 0:
            library = evidence.prepared(
                filters, np.array([c for _, c in linear_model.columns[number]]).T, used)
            imitated = _imitated(white, evidence.whitened(whitener, library, used))
        for h, (hypothesis, columns_of) in enumerate(zip(linearised, by_hypothesis)):
            place = _place(whitener, hypothesis.filters[number])
            if place is not None:
                design[h][f] = hypothesis.channels[number].total_grams[place]
                cross[h][f] = evidence.whitened(whitener, columns_of, used) @ white.T
    numbers = _numbers(basis)
    return _Channel(
        [f.log_prior + float(f.log_scale(used).sum()) for f in filters], float(used.sum()),
        scale, numbers,
        {dimension: _not_imitated(grams[0], imitated, places)
         for dimension, places in numbers.items()},
        grams, [_ChannelGrams(hypothesis.columns[number].places, design[h], cross[h])
                for h, hypothesis in enumerate(linearised)])


def _place(whitener: Whitener, filters: Sequence[Whitener]) -> int | None:
    """Return the place of a filter among others; None where it is not among them."""
    return next((i for i, f in enumerate(filters) if f is whitener), None)


def _filters(number: int, sized: Sequence[SizedHypothesis]) -> list[Whitener]:
    """Return whitening filters of one channel: those of the most probable hypotheses."""
    ranked = sorted(sized, key=lambda s: -s.hypothesis.log_evidence)
    by_rank: dict[tuple[str, float], Whitener] = {}
    for whitener in (s.hypothesis.whiteners[number] for s in ranked):
        by_rank.setdefault((whitener.effect, whitener.density), whitener)
    healthy = [w for w in by_rank.values() if w.healthy]
    drifting = [w for w in by_rank.values() if not w.healthy]
    return healthy[:_LARGEST_HEALTHY] + drifting[:_LARGEST_DRIFTING]


def _numbers(basis: Basis) -> dict[FormDimension, np.ndarray]:
    """Return the numbers of the columns of each dimension."""
    numbers, first = {}, 0
    for dimension, values in basis.items():
        numbers[dimension] = np.arange(first, first + values.shape[1])
        first += values.shape[1]
    return numbers


def _imitated(white: np.ndarray, library: np.ndarray) -> np.ndarray:
    """
    Return the products of the parts of the whitened basis that the library reproduces.

    `white` is (basis, n), `library` (columns, n); the result is (basis, basis).
    """
    size = np.sqrt(np.maximum((library ** 2).sum(axis=1), np.finfo(float).tiny))
    gram = (library @ library.T) / np.outer(size, size)
    values, vectors = np.linalg.eigh(gram)
    kept = values > values[-1] * _SMALLEST_EIGENVALUE
    projection = (vectors[:, kept] / np.sqrt(values[kept])).T \
        @ ((library @ white.T) / size[:, None])
    return projection.T @ projection


def _not_imitated(gram: np.ndarray, imitated: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """
    Return directions of the coefficients of one dimension that the library does not imitate.

    The directions are orthonormal, (basis, r).
    """
    part, gram_of = imitated[np.ix_(columns, columns)], gram[np.ix_(columns, columns)]
    values, vectors = np.linalg.eigh(gram_of)
    kept = values > max(values[-1], 0.0) * _SMALLEST_EIGENVALUE
    whitening = vectors[:, kept] / np.sqrt(values[kept])
    shares, directions = np.linalg.eigh(whitening.T @ part @ whitening)
    free = whitening @ directions[:, shares < _IMITATED_SHARE]
    out = np.zeros((len(gram), free.shape[1]))
    out[columns] = np.linalg.qr(free)[0] if free.shape[1] else free
    return out


def _flexible(channel: _Channel, number: int, sized: SizedHypothesis, form_error: float,
              unknown: FormDimension | None, amplitude_g: float
              ) -> tuple[np.ndarray, np.ndarray]:
    """Return directions in the basis, (basis, r), and their prior deviations, (r,)."""
    count = len(channel.basis[0])
    variance = np.zeros(count)
    for effect, size in sized.contributions.items():
        for dimension in effect_named(effect).diagnosis.form:
            if dimension in channel.dimensions:
                variance[channel.dimensions[dimension]] += (
                    form_error * size.by_channel_v[number] / channel.scale_v_per_g) ** 2
    columns = np.flatnonzero(variance > 0)
    directions, std = np.eye(count)[:, columns], np.sqrt(variance[columns])
    if unknown is None or unknown not in channel.unknown:
        return directions, std
    free = channel.unknown[unknown]
    return (np.column_stack([directions, free]),
            np.concatenate([std, np.full(free.shape[1], amplitude_g)]))


def _log_evidence(channels: Sequence[_Channel], index: int, sized: SizedHypothesis,
                  form_error: float, unknown: FormDimension | None = None,
                  amplitude_g: float = 0.0) -> float:
    """Integrate the coefficients of one model; the noise level and the filter are fitted."""
    hypothesis = sized.hypothesis
    linearised = hypothesis.linearised
    prior_precision = linearised.prior_std ** -2.0
    mean = hypothesis.fit.values.copy()
    models = [_ChannelModel(channel, channel.hypotheses[index],
                            *_flexible(channel, number, sized, form_error, unknown, amplitude_g))
              for number, channel in enumerate(channels)]
    for _ in range(_NOISE_ITERATIONS):
        precision, information = np.diag(prior_precision), np.zeros(len(mean))
        constant = 0.0
        for model in models:
            part = model.marginal(mean)
            places = part.places
            precision[np.ix_(places, places)] += part.precision
            information[places] += part.information
            constant += part.constant
        covariance = np.linalg.inv(precision)
        mean = covariance @ information
    half_log_det = 0.5 * (np.linalg.slogdet(precision)[1] - float(np.log(prior_precision).sum()))
    total = constant + 0.5 * float(information @ mean) - half_log_det
    return total - hypothesis.linear_loss \
        + sparsity_log_bayes_factor(linearised, mean, covariance)


class _Marginal(NamedTuple):
    """Precision, information and constant of one channel, flexible functions integrated out."""

    places: np.ndarray
    precision: np.ndarray
    information: np.ndarray
    constant: float


class _ChannelModel:
    """One channel of one model: its noise is fitted to the coefficients of the model."""

    def __init__(self, channel: _Channel, grams: _ChannelGrams, directions: np.ndarray,
                 std: np.ndarray) -> None:
        self._places, self._count = grams.places, channel.count
        self._log_prior = [channel.log_priors[i] for i in grams.design]
        weights = directions * std
        self._design = list(grams.design.values())
        self._cross = [cross @ weights for cross in grams.cross.values()]
        self._basis = [weights.T @ channel.basis[i] @ weights for i in grams.design]
        self._variance_v2 = [max(float(g[0, 0]) / self._count, np.finfo(float).tiny)
                             for g in self._design]
        self._started = False

    def marginal(self, mean: np.ndarray) -> _Marginal:
        """Return the best filter's precision and information, given coefficients, (k,)."""
        v = np.concatenate([[1.0], -mean[self._places]])
        best: tuple[float, _Marginal] | None = None
        for i, (design, cross, basis) in enumerate(zip(self._design, self._cross, self._basis)):
            if not self._started:
                self._variance_v2[i] = max(float(v @ design @ v) / self._count,
                                           np.finfo(float).tiny)
            marginal, constant = self._integrated(i, design, cross, basis, v)
            log_likelihood = constant - 0.5 * float(v @ marginal @ v)
            part = _Marginal(self._places, marginal[1:, 1:], marginal[1:, 0],
                             constant - 0.5 * float(marginal[0, 0]))
            if best is None or log_likelihood > best[0]:
                best = log_likelihood, part
        self._started = True
        assert best is not None
        return best[1]

    def _integrated(self, i: int, design: np.ndarray, cross: np.ndarray, basis: np.ndarray,
                    v: np.ndarray) -> tuple[np.ndarray, float]:
        """Integrate the flexible functions for one filter, and update its noise level."""
        scale = 1 / self._variance_v2[i]
        out, half_log_det = scale * design, 0.0
        if len(basis):
            factor, solved, fault = scipy.linalg.lapack.dposv(
                scale * basis + np.eye(len(basis)), scale * cross.T)
            if fault:
                raise np.linalg.LinAlgError('the flexible functions are singular')
            out = out - scale * (cross @ solved)
            half_log_det = float(np.log(np.diag(factor)).sum())
            # The flexible functions at their posterior mean leave this residual.
            flexible = solved @ v
            squares = v @ design @ v - 2 * v @ cross @ flexible + flexible @ basis @ flexible
        else:
            squares = v @ design @ v
        constant = -0.5 * self._count * float(np.log(self._variance_v2[i])) \
            - half_log_det + self._log_prior[i]
        self._variance_v2[i] = max(float(squares) / self._count, np.finfo(float).tiny)
        return out, constant
