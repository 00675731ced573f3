# SPDX-License-Identifier: Apache-2.0
"""
The search for sets of effects: singles, pairs and triples.

The linear model ranks hundreds of sets within a second. The best are fitted by re-simulation,
shapes included, because large effects are not linear. What is found is judged elsewhere, by
held-out figures.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

from adxl_ros.diagnose.evidence import FlexibleColumns, LinearFit
from adxl_ros.diagnose.hypothesis_fit import fit_hypothesis, Hypothesis
from adxl_ros.diagnose.linear_model import build_linear_model, LinearModel, Variant
from adxl_ros.errors import UserError
from adxl_ros.model.coefficients import parameter_of, with_neutral
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Coefficient
import numpy as np

LARGEST_SET = 3
"""Largest number of effects in a set. Chosen: one recording hardly separates more."""
_SINGLES = 8
"""Single effects whose pairs are tried on the linear model. Chosen: run time."""
_FITTED_SINGLES = 5
"""Single effects that are fitted. Chosen: run time."""
_FURTHER = 3
"""Further effects that are fitted beside the best set. Chosen: run time."""
_IMMATERIAL = 0.01
"""Share of the gain of a set that a further effect must gain, so that a third one is looked for.
Chosen: a third of what each effect of a set must explain."""
_COMPLETED = 4
"""Best sets that are fitted without each of their effects. Chosen: run time."""
_WORTH_FITTING = 10.0
"""Gain of log evidence from which a set is fitted: below it no held-out figure shows it."""
_HOPELESS_SHARE = 0.2
"""A set that gains less than the best one by this share of it is neither refined nor extended. Its
form would have to be wrong by as much of the gap."""
_SMALLEST_DEFICIT = 100.0
"""Deficit of log evidence below which no set is hopeless. Chosen: small effects."""
_LARGEST_GAIN_RATIO = 5.0
"""What a fit in full may gain, divided by what the linear model promises."""
_FORM_ERROR = 0.3
"""Share of the present effects by which their form may differ where further ones are ranked."""
_OTHER_STARTS = 2
"""Other shapes from which a fit that did not converge starts again. Chosen: run time."""
_NEAR_START = 1.4
"""Largest ratio of the start of a size to the one at which the effect was simulated: the starts
differ by factors of two."""
_TIME_CONSTANTS = 4.0
"""Length of a recording that shows a time constant: its response is then complete to 2 %."""

Found = dict[frozenset[str], Hypothesis]
"""Fitted sets by the names of their effects."""


class _Ranked(NamedTuple):
    """Variants on the linear model: gain of log evidence, numbers, fit, and other shapes."""

    gain: float
    chosen: tuple[int, ...]
    fit: LinearFit
    others: tuple[_Ranked, ...] = ()


class Search:
    """The sets of effects that were fitted to recordings of one unit."""

    def __init__(self, model: LinearModel) -> None:
        self.model = model
        self.found: Found = {frozenset(): fit_hypothesis(model, (), {}, {})}
        self._null = model.null_fit

    @property
    def best(self) -> Hypothesis:
        """Return the set of the largest log evidence."""
        return max(self.found.values(), key=lambda h: h.log_evidence)

    @property
    def _lowest(self) -> float:
        """Return the log evidence below which a set is hopeless."""
        best = self.best.log_evidence
        gain = best - self.found[frozenset()].log_evidence
        return best - max(_SMALLEST_DEFICIT, _HOPELESS_SHARE * gain)

    def identifiable(self, model: LinearModel) -> list[int]:
        """Return the variants that can show: no zero-g or scale factor without a known pose."""
        return [i for i, v in enumerate(model.variants) if model.pose_known
                or not effect_named(v.effect).diagnosis.straight_line]

    def run(self, show_share: Callable[[float], None]) -> None:
        """Fit singles, then further effects beside the best set, then pairs."""
        singles = self._rank([(i,) for i in self.identifiable(self.model)])
        worth = [s for s in singles[:_FITTED_SINGLES] if s.gain > _WORTH_FITTING]
        for number, single in enumerate(worth):
            show_share(0.5 * number / len(worth))
            self._fit(single)
        straight = [i for i in self.identifiable(self.model)
                    if effect_named(self.model.variants[i].effect).diagnosis.straight_line]
        for ranked in (*self._rank([(i,) for i in straight]),
                       *self._rank(list(combinations(straight, 2)))):
            self._fit(ranked)
        for _ in range(LARGEST_SET - 1):
            show_share(0.6)
            best = self.best
            if not 0 < len(best.effects) < LARGEST_SET:
                break
            self._extend(best)
            gained = self.best.log_evidence - best.log_evidence
            if gained < _IMMATERIAL * (best.log_evidence - self._null.log_evidence):
                break
        best = self.best
        for i in straight:
            effect = self.model.variants[i].effect
            if 0 < len(best.effects) < LARGEST_SET and effect not in best.effects:
                self._add((*best.effects, effect), dict(zip(best.names, best.values)), {})
        show_share(0.8)
        first = sorted(ranked.chosen[0] for ranked in singles[:_SINGLES])
        pairs = self._rank(list(combinations(first, 2)))[:_FURTHER]
        for pair in pairs:
            if pair.gain > singles[0].gain + _IMMATERIAL * pairs[0].gain \
                    and pair.gain > (1 - _HOPELESS_SHARE) * pairs[0].gain:
                self._fit(pair)
        for hypothesis in sorted(self.found.values(), key=lambda h: -h.log_evidence)[:_COMPLETED]:
            self.complete(hypothesis.effects)
        show_share(1.0)

    def complete(self, effects: Sequence[str] | frozenset[str]) -> None:
        """Fit a set without each of its effects, and these without each, and so on."""
        for effect in effects:
            rest = frozenset(effects) - {effect}
            if rest not in self.found:
                start = self.found.get(frozenset(effects), self.best)
                self._add(rest, dict(zip(start.names, start.values)), {}, hopeful=True)
            if rest in self.found:
                self.complete(rest)

    def _rank(self, sets: Sequence[tuple[int, ...]]) -> list[_Ranked]:
        """Fit sets of variants on the linear model; the best of each set of effects, ranked."""
        fits = []
        for chosen in sets:
            if len({self.model.variants[i].effect for i in chosen}) == len(chosen):
                fit = self.model.fit_variants(chosen, self._null)
                fits.append(_Ranked(fit.log_evidence - self._null.log_evidence, chosen, fit))
        return _best_of_each(self.model, fits)

    def _fit(self, first: _Ranked) -> None:
        """Fit a ranked set in full, from other shapes, too, where it does not converge."""
        effects = tuple(self.model.variants[i].effect for i in first.chosen)
        if first.gain < _WORTH_FITTING or frozenset(effects) in self.found:
            return
        for ranked in (first, *first.others):
            start, shapes = _start(self.model, ranked)
            fitted = self._add(effects, start, shapes)
            if fitted is not None and (fitted.converged or fitted.log_evidence < self._lowest):
                break

    def _extend(self, best: Hypothesis) -> None:
        """Fit the further effects that gain most beside a set, ranked at its values."""
        about = _model_about(self.model, best)
        present = [i for i, v in enumerate(about.variants) if v.effect in best.effects]
        without = about.fit_variants(present)
        fits = []
        for i in self.identifiable(about):
            if about.variants[i].effect not in best.effects:
                fit = about.fit_variants([*present, i], without)
                fits.append(_Ranked(fit.log_evidence - without.log_evidence, (i,), fit))
        for first in _best_of_each(about, fits)[:_FURTHER]:
            promised = best.log_evidence + _LARGEST_GAIN_RATIO * first.gain
            if first.gain < _WORTH_FITTING or promised < self._lowest:
                break
            effects = (*best.effects, about.variants[first.chosen[0]].effect)
            if frozenset(effects) in self.found:
                continue
            for ranked in (first, *first.others[:1]):
                added = about.variants[ranked.chosen[0]]
                start = dict(zip(best.names, best.values))
                start |= {about.names[k]: v for k, v in zip(ranked.fit.column_ids,
                                                            ranked.fit.values)
                          if k in about.column_ids[ranked.chosen[0]]}
                start |= _limit_start(added, start) | _size_start(added, start)
                fitted = self._add(effects, start, _shape(added))
                if fitted is not None and fitted.converged:
                    break

    def _add(self, effects: Iterable[str], start: Mapping[Coefficient, float],
             shapes: Mapping[Coefficient, float], hopeful: bool = False) -> Hypothesis | None:
        """Fit a set; None where it cannot be simulated, is singular or does not show."""
        effects = tuple(dict.fromkeys(effects))
        fitted = None
        with suppress(UserError, np.linalg.LinAlgError):
            fitted = fit_hypothesis(self.model, effects, start, shapes,
                                    -np.inf if hopeful else self._lowest)
        if fitted is None or not _shows_time_constants(self.model, fitted):
            return None
        key = frozenset(effects)
        if key not in self.found or fitted.log_evidence > self.found[key].log_evidence:
            self.found[key] = fitted
        return fitted


def _model_about(model: LinearModel, best: Hypothesis) -> LinearModel:
    """
    Return the linear model about a set: residuals and sensitivities at its fit.

    Filter and latency stay those of the parameter file, unless they are effects of the set, so
    that their tolerance is the same as before.
    """
    file_values = with_neutral(model.baseline, best.sensor.effects).values

    def stays(effect: str) -> bool:
        hints = effect_named(effect).diagnosis
        return hints.nuisance and not hints.straight_line and effect not in best.effects

    values = {effect: file_values[effect] if stays(effect) else fitted
              for effect, fitted in best.sensor.values.items()}
    comparisons = [replace(c, sensor=replace(best.sensor, values=values,
                                             rate_hz=c.sensor.rate_hz))
                   for c in model.comparisons]
    filters = [[w] for w in best.whiteners]
    return build_linear_model(comparisons, filters=filters,
                              flexible=_form_functions(model, best))


def _form_functions(model: LinearModel, best: Hypothesis) -> list[FlexibleColumns]:
    """Return for each channel what the form of the present effects may lack."""
    out = []
    for number, columns in enumerate(best.linearised.columns):
        recording, axis = model.place_of_channel(number)
        basis = model.flexible_bases[recording][axis]
        functions = [np.zeros((len(model.comparisons[recording]), 0))]
        for effect in best.effects:
            own = [i for i, place in enumerate(columns.places)
                   if place < len(best.names) and best.names[place].effect == effect]
            size_v = float(np.std(columns.values[:, 1:][:, own]
                                  @ best.values[columns.places[own]]))
            functions += [_FORM_ERROR * size_v * basis[d]
                          for d in effect_named(effect).diagnosis.form if d in basis]
        out.append(FlexibleColumns(np.concatenate(functions, axis=1),
                                   float(best.fit.innovation_variance_v2[number])))
    return out


def _best_of_each(model: LinearModel, fits: Iterable[_Ranked]) -> list[_Ranked]:
    """Return the best fit of each set of effects, by falling gain, with the next best shapes."""
    by_effects: dict[frozenset[str], list[_Ranked]] = {}
    for fit in sorted(fits, key=lambda f: -f.gain):
        by_effects.setdefault(
            frozenset(model.variants[i].effect for i in fit.chosen), []).append(fit)
    for same in by_effects.values():
        same.sort(key=lambda f: _start_loss(model, f) - f.gain)
    return [best._replace(others=tuple(
        f for f in others if 2 * f.gain > best.gain
        and all(model.variants[i].shape for i in f.chosen))[:_OTHER_STARTS])
        for best, *others in by_effects.values()]


def _stepped(variant: Variant) -> dict[Coefficient, float]:
    """Return the sizes at which an effect that is far from linear was simulated."""
    return {name: variant.step * p.scale for name in variant.names
            if (p := parameter_of(name)).starts and p.is_size}


def _start_loss(model: LinearModel, ranked: _Ranked) -> float:
    """Return what log likelihood a fit loses at the sizes at which its effects were simulated."""
    loss = 0.0
    for i in ranked.chosen:
        stepped = _stepped(model.variants[i])
        for k in range(len(ranked.fit.values) if stepped else 0):
            name = model.names[ranked.fit.column_ids[k]]
            if name in stepped:
                loss += 0.5 * float((ranked.fit.values[k] - stepped[name]) ** 2
                                    / ranked.fit.covariance[k, k])
    return loss


def _start(model: LinearModel, ranked: _Ranked
           ) -> tuple[dict[Coefficient, float], dict[Coefficient, float]]:
    """Return first departures of all coefficients, and first values of shapes."""
    start = dict(zip([model.names[i] for i in ranked.fit.column_ids], ranked.fit.values))
    shapes: dict[Coefficient, float] = {}
    for variant in (model.variants[i] for i in ranked.chosen):
        start |= _limit_start(variant, start) | _size_start(variant, start)
        shapes |= _shape(variant)
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


def _shape(variant: Variant) -> dict[Coefficient, float]:
    """Return the shape parameters of a variant by coefficient without axis."""
    return {Coefficient(variant.effect, parameter): value
            for parameter, value in variant.shape.items()}


def _shows_time_constants(model: LinearModel, hypothesis: Hypothesis) -> bool:
    """Determine whether the longest recording shows the time constants of the effects."""
    longest_s = max(c.span_s for c in model.comparisons)
    values = dict(zip(hypothesis.names, hypothesis.values))
    names = [Coefficient(e, effect_named(e).diagnosis.time_constant) for e in hypothesis.effects]
    return all(longest_s >= _TIME_CONSTANTS * values[name] for name in names if name in values)
