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
The search for hypotheses: single effects, pairs and triples.

The linear model ranks hundreds of hypotheses within a second. The best are fitted by
re-simulation, shapes included, because large effects are not linear. An example is a delay of 7 ms
at a shaker of 40 Hz.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

from adxl_ros.diagnose.decision_settings import DecisionSettings
from adxl_ros.diagnose.drift_checks import log_bayes_factor_within_rests, unevenness
from adxl_ros.diagnose.effect_sizes import contribution
from adxl_ros.diagnose.evidence import FlexibleColumns, LinearFit
from adxl_ros.diagnose.hypothesis_fit import (
    fit_hypothesis,
    Hypothesis,
    linearise,
    residual_channels,
)
from adxl_ros.diagnose.linear_model import build_linear_model, LinearModel, rests_by_channel
from adxl_ros.diagnose.noise_whitening import drift_effects, drifts_among
from adxl_ros.diagnose.progress_plan import (
    FIT_WORK,
    FURTHER,
    ProgressPlan,
    RANKING_WORK,
    SINGLES,
)
from adxl_ros.diagnose.sensitivities import Variant
from adxl_ros.errors import UserError
from adxl_ros.model.coefficients import parameter_of, with_neutral
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Coefficient
import numpy as np

LARGEST_SET = 3
"""Largest number of effects in a hypothesis. Chosen: more effects are inseparable in one
recording."""
_SINGLES = 8
"""Number of single effects whose pairs are tried on the linear model. Chosen: run time."""
_FITTED_SINGLES = 6
"""Number of single effects that are fitted. Chosen: run time."""
_FURTHER = 3
"""Number of other hypotheses that each step of the search fits. Chosen: run time."""
_BESIDE_DRIFTS = 2
"""Number of hypotheses beside which each drift is tried. Chosen: run time."""
_RANKING_FORM_ERROR = 0.3
"""Share of the size of the present effects by which their form may differ, where a further effect
is ranked. Chosen: the middle of the shares of the decision."""
_FEWEST_TIME_CONSTANTS = 4.0
"""Length of a recording that shows a time constant, relative to it. Chosen: the response to a step
is then complete to 2 %."""
_OTHER_STARTS = 2
"""Other shapes from which a fit that did not converge starts again. Chosen: run time."""
_OTHER_START_SHARE = 0.5
"""Smallest gain of another shape, divided by that of the best. Chosen: half of the power."""
_LARGEST_GAIN_RATIO = 5.0
"""What a fit in full may gain, divided by what the linear model promises. Chosen: large effects
are not linear."""
_NEAR_START = 1.4
"""Largest ratio of the start of a size to the one at which the effect was simulated. Chosen: the
starts differ by factors of two."""
_LARGEST_UNEVENNESS = 1.4
"""Largest unevenness of the noise beside a drift. Tuned by hand on simulated
recordings of the working seeds of the blind check."""

Hypotheses = dict[frozenset[str], Hypothesis]
"""Hypotheses by the names of their effects."""


class _RankedSet(NamedTuple):
    """
    A set of variants on the linear model: gain of log evidence, their numbers, the fit.

    The others are of the same effects with other shapes, from which a fit may also start.
    """

    gain: float
    chosen: tuple[int, ...]
    fit: LinearFit
    others: tuple[_RankedSet, ...] = ()


class SearchResult(NamedTuple):
    """
    What the search found.

    Attributes
    ----------
    hypotheses
        Fitted hypotheses by falling log evidence; the empty one is among them, hopeless ones are
        not.
    single_gains
        Log Bayes factor of each effect of the library over no effect, on the linear model.

    """

    hypotheses: list[Hypothesis]
    single_gains: dict[str, float]


def search(linear_model: LinearModel, settings: DecisionSettings,
           plan: ProgressPlan) -> SearchResult:
    """
    Search single effects, pairs and triples.

    Pairs are tried around the best hypothesis, whose residual is nearly linear in a second effect.
    They are also tried among the best single effects, because two effects can mask each other.

    Parameters
    ----------
    linear_model
        The recordings and their sensitivities.
    settings
        Settings of the decision.
    plan
        The stages of the diagnosis, to which the search tells its work.

    Returns
    -------
    SearchResult
        Fitted hypotheses, and what single effects gain.

    """
    hypotheses: Hypotheses = {frozenset(): fit_hypothesis(linear_model, (), {}, {})}
    null_fit = linear_model.fit_variants([])
    singles = _ranked(linear_model, [(i,) for i in _identifiable(linear_model)], null_fit)
    worth = [s for s in singles[:_FITTED_SINGLES] if s.gain >= settings.worth_fitting]
    plan.expect(SINGLES, FIT_WORK * len(worth))
    if not worth:
        plan.expect(FURTHER, 0.0)
    for number, single in enumerate(worth):
        plan.show(SINGLES, number / len(worth))
        _fit_best(linear_model, settings, [single], null_fit, hypotheses)
    plan.show(FURTHER, 0.0)
    # A nominal parameter file may be wrong in zero-g and scale factor, and the sum of both errors
    # may look like neither of them.
    straight = [i for i in _identifiable(linear_model)
                if effect_named(linear_model.variants[i].effect).diagnosis.straight_line]
    _fit_best(linear_model, settings,
              _ranked(linear_model, list(combinations(straight, 2)), null_fit), null_fit,
              hypotheses)
    best = _best(hypotheses)
    if best.effects:
        plan.expect(FURTHER, RANKING_WORK + FIT_WORK * _FURTHER)
        plan.show(FURTHER, 0.0)
        _add_effects(linear_model, settings, best, hypotheses)
        plan.show(FURTHER, 0.7)
        first = [ranked.chosen[0] for ranked in singles[:_SINGLES]]
        pairs = _ranked(linear_model, list(combinations(sorted(first), 2)), null_fit)
        smallest_gain = _best(hypotheses).log_evidence - null_fit.log_evidence \
            + settings.worth_fitting
        _fit_best(linear_model, settings,
                  [pair for pair in pairs if pair.gain > smallest_gain][:_FURTHER], null_fit,
                  hypotheses)
    _remove_each_effect(linear_model, settings, hypotheses)
    _replace_imitated(linear_model, settings, hypotheses)
    if _drift_shows(linear_model, _best(hypotheses), settings):
        _add_drifts(linear_model, settings, hypotheses)
    plan.show(FURTHER, 1.0)
    lowest = _lowest(hypotheses, settings)
    return SearchResult(
        sorted((h for h in hypotheses.values() if h.log_evidence >= lowest or not h.effects),
               key=lambda h: -h.log_evidence),
        {linear_model.variants[single.chosen[0]].effect: single.gain for single in singles})


def _is_hopeless(log_evidence: float, gain: float, hypotheses: Hypotheses,
                 settings: DecisionSettings) -> bool:
    """Determine whether a gain that the linear model promises leaves a hypothesis hopeless."""
    return log_evidence + _LARGEST_GAIN_RATIO * gain < _lowest(hypotheses, settings)


def _lowest(hypotheses: Hypotheses, settings: DecisionSettings) -> float:
    """Return the log evidence below which a hypothesis is hopeless."""
    best = _best(hypotheses).log_evidence
    gain = best - hypotheses[frozenset()].log_evidence
    return best - max(settings.smallest_deficit, settings.deficit_share * gain)


def _identifiable(linear_model: LinearModel) -> list[int]:
    """Return the variants that can show: no zero-g or scale factor without a known pose."""
    return [i for i, variant in enumerate(linear_model.variants) if linear_model.pose_known
            or not effect_named(variant.effect).diagnosis.straight_line]


def _best(hypotheses: Hypotheses) -> Hypothesis:
    """Return the hypothesis of the largest log evidence."""
    return max(hypotheses.values(), key=lambda h: h.log_evidence)


def _drift_shows(linear_model: LinearModel, best: Hypothesis, settings: DecisionSettings
                 ) -> bool:
    """Determine whether a drift makes the residual of a hypothesis much more probable."""
    linearised = linearise(linear_model, best.effects, best.sensor)
    return linearised.fit(drifts=drift_effects()).log_evidence \
        - linearised.fit().log_evidence > settings.worth_fitting


def _add_drifts(linear_model: LinearModel, settings: DecisionSettings, hypotheses: Hypotheses
                ) -> None:
    """
    Let the zero-g drift, alone, beside the best hypotheses, and beside effects best with a drift.

    A drift has the same power all the time, and goes on within rests. Other hypotheses with a
    drift are removed.
    """
    ranked = sorted(hypotheses.values(), key=lambda h: -h.log_evidence)
    best = [h for h in ranked if 0 < len(h.effects) < LARGEST_SET][:_BESIDE_DRIFTS]
    linearised = [linearise(linear_model, h.effects, h.sensor) for h in best]
    for drift in drift_effects():
        drift_fit = linear_model.fit_variants([], None, (drift,))
        drift_only = fit_hypothesis(linear_model, (drift,), {}, {})
        _add(hypotheses, drift_only)
        for h, at_values in zip(best, linearised):
            log_evidence = at_values.fit(drifts=(drift,)).log_evidence
            if log_evidence >= max(drift_only.log_evidence + settings.worth_fitting,
                                   _best(hypotheses).log_evidence - settings.smallest_deficit):
                _add(hypotheses, _fit_or_none(linear_model, (*h.effects, drift),
                                              dict(zip(h.names, h.values)), {},
                                              _lowest(hypotheses, settings)))
        beside_drift = _ranked(linear_model, [(i,) for i in _identifiable(linear_model)],
                               drift_fit, (drift,))
        _fit_best(linear_model, settings, beside_drift[:_BESIDE_DRIFTS], drift_fit, hypotheses,
                  (drift,))
    for h in list(hypotheses.values()):
        if drifts_among(h.effects) and not _drifts(linear_model, h):
            del hypotheses[frozenset(h.effects)]


def _drifts(linear_model: LinearModel, hypothesis: Hypothesis) -> bool:
    """Determine whether the residual of a hypothesis with a drift drifts as it should."""
    channels = list(residual_channels(linear_model, hypothesis))
    within_rests = 0.0
    for number, (channel, at_rest) in enumerate(zip(
            channels, rests_by_channel(linear_model.comparisons))):
        recording, axis = linear_model.place_of_channel(number)
        within_rests += log_bayes_factor_within_rests(
            channel, at_rest, linear_model.comparisons[recording].sensor, axis)
    return within_rests >= 0 and unevenness(channels) <= _LARGEST_UNEVENNESS


def _model_about(linear_model: LinearModel, best: Hypothesis) -> LinearModel:
    """
    Return the linear model about a hypothesis: residuals and sensitivities at its fit.

    Filter and latency stay those of the parameter file, unless they are effects of the hypothesis,
    so that their tolerance is the same as before.
    """
    file_values = with_neutral(linear_model.baseline, best.sensor.effects).values

    def stays(effect: str) -> bool:
        hints = effect_named(effect).diagnosis
        return hints.nuisance and not hints.straight_line and effect not in best.effects

    values = {effect: file_values[effect] if stays(effect) else fitted
              for effect, fitted in best.sensor.values.items()}
    comparisons = [replace(c, sensor=replace(best.sensor, values=values,
                                             rate_hz=c.sensor.rate_hz))
                   for c in linear_model.comparisons]
    filters = [[f for f in same if f.healthy == w.healthy and f.effect == w.effect] or [w]
               for same, w in zip(best.linearised.filters, best.whiteners)]
    return build_linear_model(comparisons, filters=filters,
                              flexible=_form_functions(linear_model, best))


def _form_functions(linear_model: LinearModel, best: Hypothesis) -> list[FlexibleColumns]:
    """Return for each channel what the form of the present effects may lack."""
    sizes = {e: contribution(linear_model, best, e).by_channel_v for e in best.effects}
    out = []
    for number in range(len(linear_model.channels)):
        recording, axis = linear_model.place_of_channel(number)
        comparison = linear_model.comparisons[recording]
        basis = linear_model.flexible_bases[recording][axis]
        columns = [_RANKING_FORM_ERROR * size[number] * basis[dimension]
                   for e, size in sizes.items() for dimension in effect_named(e).diagnosis.form
                   if dimension in basis]
        out.append(FlexibleColumns(
            np.concatenate([np.zeros((0, len(comparison))), *(c.T for c in columns)]).T,
            float(best.fit.innovation_variance_v2[number])))
    return out


def _add_effects(linear_model: LinearModel, settings: DecisionSettings, best: Hypothesis,
                 hypotheses: Hypotheses) -> None:
    """
    Add one and two effects to a hypothesis: rank on the linear model, then fit the best in full.

    A second added effect is ranked beside the first one on the same linear model.
    """
    about = _model_about(linear_model, best)
    present = [i for i, v in enumerate(about.variants) if v.effect in best.effects]
    ranked = _ranked_beside(about, best, present)
    _fit_added(linear_model, settings, about, best, ranked, hypotheses)
    larger = _best(hypotheses)
    added = next((r.chosen[-1] for r in ranked
                  if {*best.effects, about.variants[r.chosen[-1]].effect} == {*larger.effects}),
                 None)
    if added is not None and len(larger.effects) < LARGEST_SET:
        _fit_added(linear_model, settings, about, larger,
                   _ranked_beside(about, larger, [*present, added]), hypotheses)


def _ranked_beside(about: LinearModel, best: Hypothesis, present: Sequence[int]
                   ) -> list[_RankedSet]:
    """Rank the variants of further effects beside the present ones, the best first."""
    drifts = drifts_among(best.effects)
    best_fit = about.fit_variants(present, None, drifts)
    fits = []
    for i in _identifiable(about):
        if about.variants[i].effect not in best.effects:
            fit = about.fit_variants([*present, i], best_fit, drifts)
            fits.append(_RankedSet(fit.log_evidence - best_fit.log_evidence, (i,), fit))
    return _best_of_each(about, fits)


def _best_of_each(linear_model: LinearModel, fits: Iterable[_RankedSet]) -> list[_RankedSet]:
    """Return the best fit of each set of effects, by falling gain, with the next best shapes."""
    by_effects: dict[frozenset[str], list[_RankedSet]] = {}
    for fit in sorted(fits, key=lambda f: -f.gain):
        by_effects.setdefault(
            frozenset(linear_model.variants[i].effect for i in fit.chosen), []).append(fit)
    for same in by_effects.values():
        same.sort(key=lambda f: _start_loss(linear_model, f) - f.gain)
    return [best._replace(others=tuple(
        f for f in others if f.gain > _OTHER_START_SHARE * best.gain
        and all(linear_model.variants[i].shape for i in f.chosen))[:_OTHER_STARTS])
        for best, *others in by_effects.values()]


def _stepped(variant: Variant) -> dict[Coefficient, float]:
    """Return the sizes at which an effect that is far from linear was simulated."""
    return {Coefficient(variant.effect, p.name): variant.step * p.scale
            for p in effect_named(variant.effect).parameters if p.starts and p.is_size}


def _start_loss(linear_model: LinearModel, ranked: _RankedSet) -> float:
    """Return what log likelihood a fit loses at the sizes at which its effects were simulated."""
    loss = 0.0
    for i in ranked.chosen:
        stepped = _stepped(linear_model.variants[i])
        for k in range(len(ranked.fit.values) if stepped else 0):
            name = linear_model.names[ranked.fit.column_ids[k]]
            if name in stepped:
                loss += 0.5 * float((ranked.fit.values[k] - stepped[name]) ** 2
                                    / ranked.fit.covariance[k, k])
    return loss


def _fit_added(linear_model: LinearModel, settings: DecisionSettings, about: LinearModel,
               best: Hypothesis, ranked: Sequence[_RankedSet], hypotheses: Hypotheses) -> None:
    """Fit in full, beside the effects of a hypothesis, the further effects that gain most."""
    with_variants = {v.effect for v in linear_model.variants} | {*drifts_among(best.effects)}
    for first in ranked[:_FURTHER]:
        if first.gain < settings.worth_fitting \
                or _is_hopeless(best.log_evidence, first.gain, hypotheses, settings):
            break
        effects = (*best.effects, about.variants[first.chosen[0]].effect)
        if not with_variants.issuperset(effects) or frozenset(effects) in hypotheses:
            continue
        for _, (i,), fit, _ in (first, *first.others[:1]):
            added = about.variants[i]
            start = dict(zip(best.names, best.values))
            start |= {about.names[k]: value for k, value in zip(fit.column_ids, fit.values)
                      if k in about.column_ids[i]}
            start |= _limit_start(added, start) | _size_start(added, start)
            hypothesis = _fit_or_none(linear_model, effects, start, _named_shape(added),
                                      _lowest(hypotheses, settings))
            _add(hypotheses, hypothesis)
            if hypothesis is not None and hypothesis.converged:
                break


def _remove_each_effect(linear_model: LinearModel, settings: DecisionSettings,
                        hypotheses: Hypotheses) -> None:
    """Fit the best set without each of its effects; two effects may replace an earlier one."""
    best = _best(hypotheses)
    for effect in best.effects:
        if frozenset(best.effects) - {effect} not in hypotheses:
            _add(hypotheses, _fit_or_none(
                linear_model, [e for e in best.effects if e != effect],
                dict(zip(best.names, best.values)), {}, _lowest(hypotheses, settings)))


def _replace_imitated(linear_model: LinearModel, settings: DecisionSettings,
                      hypotheses: Hypotheses) -> None:
    """Fit the best set with errors of the reference in place of effects that imitate them."""
    best = _best(hypotheses)
    for effect in dict.fromkeys(variant.effect for variant in linear_model.variants):
        imitating = effect_named(effect).diagnosis.imitated_by
        replaced = [effect if e == imitating else e for e in best.effects]
        if imitating in best.effects and effect not in best.effects \
                and frozenset(replaced) not in hypotheses:
            _add(hypotheses, _fit_or_none(linear_model, replaced,
                                          dict(zip(best.names, best.values)), {},
                                          _lowest(hypotheses, settings)))


def refit(linear_model: LinearModel, hypothesis: Hypothesis, effects: Sequence[str]
          ) -> Hypothesis | None:
    """
    Fit other effects from the values of a hypothesis.

    Parameters
    ----------
    linear_model
        The recordings.
    hypothesis
        A fitted hypothesis.
    effects
        The effects to fit.

    Returns
    -------
    Hypothesis or None
        The hypothesis of these effects; None where it cannot be simulated.

    """
    return _fit_or_none(linear_model, effects, dict(zip(hypothesis.names, hypothesis.values)), {})


def _ranked(linear_model: LinearModel, sets: Sequence[tuple[int, ...]], null_fit: LinearFit,
            drifts: Sequence[str] = ()) -> list[_RankedSet]:
    """Fit sets of variants on the linear model; return the best of each set of effects, ranked."""
    fits = []
    for chosen in sets:
        if len({linear_model.variants[i].effect for i in chosen}) == len(chosen):
            fit = linear_model.fit_variants(chosen, null_fit, drifts)
            fits.append(_RankedSet(fit.log_evidence - null_fit.log_evidence, chosen, fit))
    return _best_of_each(linear_model, fits)


def _fit_best(linear_model: LinearModel, settings: DecisionSettings, ranked: Iterable[_RankedSet],
              null_fit: LinearFit, hypotheses: Hypotheses, drifts: tuple[str, ...] = ()) -> None:
    """Fit in full, together with drifts, those ranked sets that gain enough."""
    for first in ranked:
        effects = tuple(linear_model.variants[i].effect for i in first.chosen)
        hopeless = drifts and _is_hopeless(null_fit.log_evidence, first.gain, hypotheses, settings)
        if first.gain < settings.worth_fitting or hopeless \
                or frozenset((*effects, *drifts)) in hypotheses:
            continue
        without_drift = hypotheses.get(frozenset(effects)) if drifts else None
        others = [r for r in first.others if not drifts and not _is_hopeless(
            null_fit.log_evidence, r.gain, hypotheses, settings)]
        starts = [(dict(zip(without_drift.names, without_drift.values)), {})] if without_drift \
            else [_start(linear_model, r) for r in (first, *others)]
        for start, shapes in starts:
            hypothesis = _fit_or_none(linear_model, (*effects, *drifts), start, shapes,
                                      _lowest(hypotheses, settings))
            if hypothesis is not None and hypothesis.log_evidence > null_fit.log_evidence:
                _add(hypotheses, hypothesis)
                if hypothesis.converged:
                    break


def _start(linear_model: LinearModel, ranked: _RankedSet
           ) -> tuple[dict[Coefficient, float], dict[Coefficient, float]]:
    """Return first departures of all coefficients, and first values of shapes."""
    start = dict(zip([linear_model.names[i] for i in ranked.fit.column_ids], ranked.fit.values))
    shapes: dict[Coefficient, float] = {}
    for variant in (linear_model.variants[i] for i in ranked.chosen):
        start |= _limit_start(variant, start) | _size_start(variant, start)
        shapes |= _named_shape(variant)
    return start, shapes


def _size_start(variant: Variant, start: Mapping[Coefficient, float]) -> dict[Coefficient, float]:
    """Return where the fit of a size starts in which the effect is far from linear."""
    return {name: float(np.clip(start.get(name, size), size / _NEAR_START, size * _NEAR_START))
            for name, size in _stepped(variant).items()}


def _limit_start(variant: Variant, amounts: Mapping[Coefficient, float]
                 ) -> dict[Coefficient, float]:
    """Return where the fit of a limit starts, as departures from the prior mean."""
    return {name: value - (0.0 if parameter_of(name).is_size else parameter_of(name).scale)
            for name, value in variant.first_limits(amounts).items()}


def _named_shape(variant: Variant) -> dict[Coefficient, float]:
    """Return the shape parameters of a variant by coefficient without axis."""
    return {Coefficient(variant.effect, parameter): value
            for parameter, value in variant.shape.items()}


def _add(hypotheses: Hypotheses, hypothesis: Hypothesis | None) -> None:
    """Add a hypothesis, if it could be fitted and is better than another fit of the same set."""
    if hypothesis is None:
        return
    key = frozenset(hypothesis.effects)
    if key not in hypotheses or hypothesis.log_evidence > hypotheses[key].log_evidence:
        hypotheses[key] = hypothesis


def _fit_or_none(linear_model: LinearModel, effects: Sequence[str],
                 start: Mapping[Coefficient, float], shapes: Mapping[Coefficient, float],
                 lowest_log_evidence: float = -np.inf) -> Hypothesis | None:
    """Fit a hypothesis; return None where it cannot be simulated, is singular or does not show."""
    try:
        fitted = fit_hypothesis(linear_model, effects, start, shapes, lowest_log_evidence)
    except (UserError, np.linalg.LinAlgError):
        return None
    return fitted if _shows_time_constants(linear_model, fitted) else None


def _shows_time_constants(linear_model: LinearModel, hypothesis: Hypothesis) -> bool:
    """Determine whether the longest recording shows the time constants of the effects."""
    longest_s = max(float(np.ptp(comparison.time_s))
                    for comparison in linear_model.comparisons)
    time_constants = [Coefficient(effect, effect_named(effect).diagnosis.time_constant)
                      for effect in hypothesis.effects
                      if effect_named(effect).diagnosis.time_constant]
    values = dict(zip(hypothesis.names, hypothesis.values))
    return all(longest_s >= _FEWEST_TIME_CONSTANTS * values[name] for name in time_constants
               if name in values)
