# SPDX-License-Identifier: Apache-2.0
"""
The search for sets of effects: singles, pairs and triples.

The linear model ranks hundreds of sets within a second. The best are fitted by re-simulation,
shapes included, because large effects are not linear. What is found is judged elsewhere, by
held-out figures.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, combinations
from typing import NamedTuple

from adxl_ros.diagnose import evidence, linear_model as linear
from adxl_ros.diagnose.comparison import BaselineComparison
from adxl_ros.diagnose.evidence import LinearFit, LinearisedHypothesis
from adxl_ros.diagnose.linear_model import LinearModel, with_filters
from adxl_ros.diagnose.noise_filters import Whitener
from adxl_ros.errors import UserError
from adxl_ros.model.constants import Z_90
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Coefficient, StraightLine
from adxl_ros.model.error_sizes import rms, stds
from adxl_ros.model.gauss_newton import gauss_newton, Iterate
from adxl_ros.model.sensor import fitted_of, get, parameter_of, put, Sensor, with_neutral
import numpy as np

_EVALUATIONS = 8  # Largest number of simulations of a hypothesis. Chosen: most need five
_HALVINGS = 2  # Largest number of halvings of a step. Chosen: a quarter is enough for the library
_EVIDENCE_TOLERANCE = 1e-3  # A step may lower the log evidence by this. Chosen: far below one unit
_SMALLEST_STEP = 1e-3
"""Step, in prior standard deviations, below which a fit has converged. Chosen: far below any
interval."""
_SMALLEST_GAIN = 0.5
"""Gain of log evidence below which a fit has converged. Chosen: no verdict depends on it."""
_SMALLEST_GAIN_SHARE = 1e-4
"""The same divided by the gain of all steps. Chosen: a large effect needs no more digits."""
_FORM_ERROR = 0.03
"""Relative standard deviation of a coefficient because the form of its effect is not exact. Only
geometry and clocks have exact forms. Tuned by hand on simulated recordings of the working seeds of
the blind check."""
_HEALTHY_STDS = 3.0
"""Largest departure of a healthy unit, in standard deviations: one unit in 400 exceeds it."""
LARGEST_SET = 3  # Largest number of effects in a set. Chosen: one recording hardly separates more
_SINGLES = 8  # Singles whose pairs are ranked. Chosen: run time
_FITTED_SINGLES = 5  # Singles that are fitted. Chosen: run time
_FURTHER = 3  # Further effects that are fitted beside the best set, and pairs. Chosen: run time
_COMPLETED = 4  # Sets that are fitted without each of their effects. Chosen: run time
_IMMATERIAL = 0.01
"""Share of the gain of a set that a further effect must gain, so that a third one is looked for.
Chosen: a third of what each effect of a set must explain."""
_WORTH_FITTING = -30.0
"""Gain of log evidence from which a set is fitted. Chosen: the wide priors of a small effect on
three axes cost as much, and the held-out figures decide."""
_HOPELESS_SHARE = 0.2
"""A set that gains less than the best one by this share of its gain is not refined or extended.
Its form would have to be wrong by as much of the gap."""
_SMALLEST_DEFICIT = 100.0
"""Log evidence by which such a set is below the best at least. Chosen: beyond any tolerance of the
linear model, exp(−100)."""
_LARGEST_GAIN_RATIO = 5.0  # What a fit in full may gain, divided by what the linear model promises
_NEAR_START = 1.4
"""Largest ratio of the start of a size to the one at which the effect was simulated: the starts
differ by factors of two."""
_AT_BOUND = 1e-4  # Distance from a bound, as a share of the range, that is at it. Chosen: rounding
_CONSTANT = 1e-6  # Range of a constant column, relative. Chosen: rounding errors
_SMALL_CHANGE = 0.05
"""Largest change of the output by a set, as a share of its variation, at which the sensitivities
to other effects are not computed again. Chosen: they change by as much, and the gains by which
effects are ranked by a tenth."""
_TIME_CONSTANTS = 4.0
"""Length of a recording that shows a time constant: its response is then complete to 2 %."""


@dataclass(frozen=True)
class Hypothesis:
    """A set of effects after its fit."""

    effects: tuple[str, ...]  # Names of the effects; none for no gap
    sensor: Sensor  # The baseline with the effects and the nuisance parameters, as fitted
    names: tuple[Coefficient, ...]  # Names of the k fitted coefficients of the effects, (k,)
    values: np.ndarray  # Their values, as departures from the baseline, (k,)
    std: np.ndarray  # Their standard deviations, (k,)
    undetermined: np.ndarray  # Those that the recordings hardly narrow, (k,) bool
    log_evidence: float  # Log evidence
    fit: LinearFit  # The last linear fit
    linearised: LinearisedHypothesis  # The hypothesis linearised at its values

    @property
    def sizeless(self) -> frozenset[str]:
        """
        Effects whose determined sizes all agree with the baseline, by 90 % intervals.

        The intervals are those at the fitted shapes: without a size a shape has no meaning.
        """
        covariance = self.fit.covariance
        shapes = [i for i, name in enumerate(self.names) if not parameter_of(name).is_size]
        by_shapes = covariance[: len(self.names), shapes]
        known = np.linalg.solve(covariance[np.ix_(shapes, shapes)], by_shapes.T)
        variance = self.std**2 - np.einsum('ij,ji->i', by_shapes, known)
        differs = self.values**2 > Z_90**2 * np.maximum(variance, 0.0)
        sized = set[str]()
        differing = set[str]()
        for name, shows, is_open in zip(self.names, differs, self.undetermined):
            if parameter_of(name).is_size and not is_open:
                sized.add(name.effect)
                if shows:
                    differing.add(name.effect)
        return frozenset(sized - differing)

    def is_zero_g(self, effect: str) -> bool:
        """Whether another effect than the zero-g does not change within the recordings."""
        if effect_named(effect).diagnosis.straight_line:
            return False
        own = [
            i
            for i, name in enumerate(self.names)
            if name.effect == effect and parameter_of(name).is_size
        ]
        squares = 0.0
        varying = 0.0
        for channel in self.linearised.columns:
            shown = [(k, i) for k, i in enumerate(channel.places) if i in own]
            change_v = sum(self.values[i] * channel.own[:, 1 + k] for k, i in shown)
            squares += float(np.mean(np.square(change_v)))
            varying += float(np.var(change_v))
        return varying < linear.SMALLEST_BENT_SHARE**2 * squares

    @property
    def at_bound(self) -> bool:
        """Whether a determined size is at the end of what its parameter can have: no result."""
        for name, value, is_open in zip(
            self.names, get(self.sensor, self.names), self.undetermined
        ):
            p = parameter_of(name)
            margin = _AT_BOUND * (p.upper - p.lower)
            is_within = p.lower + margin < value < p.upper - margin
            is_neutral = abs(value - p.neutral) <= margin
            is_determined_size = p.is_size and not is_open
            if is_determined_size and not (is_within or is_neutral):
                return True
        return False


def linearise(
    linear_model: LinearModel,
    effects: Sequence[str],
    sensor: Sensor,
    filters: Sequence[Sequence[Whitener]] | None = None,
) -> LinearisedHypothesis:
    """Linearise a hypothesis at the coefficients of a sensor."""
    filters = linear_model.usual_filters if filters is None else filters
    names = _fitted_names(linear_model, effects)
    nuisances = [n for n in linear_model.nuisances if n.effect not in effects]
    start = with_neutral(linear_model.baseline, [*effects, *(n.effect for n in nuisances)])
    point = _Point.of(start, effects, names, get(sensor, names))
    responses = chain.from_iterable(
        map(point.responses, linear_model.comparisons, linear_model.baseline_v)
    )
    columns: list[evidence.ChannelColumns] = []
    changes: list[dict[int, np.ndarray]] = []
    for response, own in zip(responses, linear_model.nuisance_columns):
        shown = [n for n in nuisances if n in own]
        nuisance_places = [len(names) + nuisances.index(name) for name in shown]
        ids = np.array([*response.places, *nuisance_places], int)
        columns.append(
            evidence.ChannelColumns(ids, response.columns, {name: own[name] for name in shown})
        )
        changes.append({0: response.change_v})
    # The square of each deviation is that of a healthy unit's tolerance plus that of what a
    # calibration can take up of the effects.
    parts = linear_model.taken_up(changes, 1)
    taken_up = np.array([float(parts[n][0]) if n in parts else 0.0 for n in nuisances])
    tolerance = np.array([linear_model.tolerances[name] for name in nuisances])
    linearised = LinearisedHypothesis(
        effects=tuple(effects),
        sensor=point.sensor,
        names=(*names, *nuisances),
        prior_mean=np.concatenate([point.prior_mean, get(start, nuisances)]),
        prior_std=np.concatenate([_prior_std(names), np.hypot(tolerance, taken_up)]),
        reach=np.hypot(_HEALTHY_STDS * tolerance, taken_up),
        values=point.values,
        channels=[],
        columns=columns,
        filters=[],
    )
    return with_filters(linear_model, linearised, filters)


class _Response(NamedTuple):
    """What one channel shows about a point."""

    places: list[int]  # Places of the k coefficients that the axis follows
    # Residual at the prior mean, by the linear model, and derivatives, V, V per unit, (n, k + 1)
    columns: np.ndarray
    change_v: np.ndarray  # Part of the output that a calibration can take up, V, (n,)


@dataclass(frozen=True)
class _Point:
    """Values of the k coefficients of effects, about which a hypothesis is linear."""

    names: Sequence[Coefficient]
    values: np.ndarray  # (k,)
    prior_mean: np.ndarray  # (k,)
    sensor: Sensor  # The sensor with the values
    # The same without the effects that a calibration can take up; None for the baseline
    without: Sensor | None

    @classmethod
    def of(
        cls,
        neutral: Sensor,
        effects: Sequence[str],
        names: Sequence[Coefficient],
        values: np.ndarray,
    ) -> _Point:
        """Give a sensor with neutral effects some values."""
        sensor = put(neutral, names, values)
        taken_up = [e for e in effects if linear.calibration_takes_up(e)]
        kept = {**sensor.values, **{e: neutral.values[e] for e in taken_up}}
        without = replace(sensor, values=kept) if len(taken_up) < len(effects) else None
        return cls(names, values, _prior_mean(neutral, names), sensor, without)

    def responses(
        self, comparison: BaselineComparison, baseline_v: np.ndarray
    ) -> Iterator[_Response]:
        """Simulate and differentiate a recording; yield each of its axes."""
        sensor = self.sensor
        output_v = comparison.simulated_v(sensor)
        derivatives = linear.sensitivities_at(
            comparison.simulated_v, sensor, self.names, self.values, output_v
        )
        change_v = output_v - baseline_v
        if self.without is not None:
            change_v = output_v - comparison.simulated_v(self.without)
        departures = self.values - self.prior_mean
        for d, axis in enumerate(sensor.axes):
            places = [i for i, name in enumerate(self.names) if name.axis in ('', axis)]
            own = derivatives[:, d, places]
            residual_v = comparison.volts[:, d] - output_v[:, d] + own @ departures[places]
            yield _Response(places, np.vstack([residual_v, own.T]).T, change_v[:, d])


def _fitted_names(linear_model: LinearModel, effects: Sequence[str]) -> list[Coefficient]:
    """Return the coefficients of effects that the recordings show, and limits and shapes."""
    fitted = []
    for effect in map(effect_named, effects):
        for name in fitted_of(effect, linear_model.baseline.axes):
            is_form = bool(effect.limits) or not parameter_of(name).is_size
            if is_form or name in linear_model.names:
                fitted.append(name)
    return fitted


def _prior_mean(sensor: Sensor, names: Sequence[Coefficient]) -> np.ndarray:
    """Return prior means of coefficients: as in a sensor, typical of shapes and limits, (k,)."""
    parameters = [parameter_of(name) for name in names]
    is_size = np.array([p.is_size for p in parameters], bool)
    return np.where(is_size, get(sensor, names), [p.scale for p in parameters])


def _prior_std(names: Sequence[Coefficient]) -> np.ndarray:
    """Return prior standard deviations of coefficients, (k,)."""
    parameters = [parameter_of(name) for name in names]
    widths = [linear.PRIOR_WIDTH if p.is_size else 1.0 for p in parameters]
    return np.array([p.scale * width for p, width in zip(parameters, widths)])


@dataclass(frozen=True)
class _HypothesisIterate(Iterate):
    """An iterate of the fit: the linearised hypothesis and its linear fit."""

    linearised: LinearisedHypothesis
    fit: LinearFit


def fit_hypothesis(
    linear_model: LinearModel,
    effects: Sequence[str],
    start: Mapping[Coefficient, float],
    shapes: Mapping[Coefficient, float],
    lowest_log_evidence: float = -np.inf,
) -> Hypothesis:
    """
    Fit a set of effects by re-simulation, shape parameters included.

    Each Gauss-Newton step simulates, differentiates, whitens and fits at the present values. The
    iteration ends where the log evidence no longer gains, or where even the maximum of the linear
    model is hopelessly low. `start` has departures of sizes from the prior mean.
    The iteration has the noise of no gap; only its end is compared for every noise.
    """
    sensor = with_neutral(linear_model.baseline, effects)
    names = _fitted_names(linear_model, effects)
    first = _prior_mean(sensor, names) + [start.get(name, 0.0) for name in names]
    first = np.array([shapes.get(name.without_axis, value) for name, value in zip(names, first)])
    parameters = [parameter_of(name) for name in names]
    low, high = [p.lower for p in parameters], [p.upper for p in parameters]
    chosen = zip(linear_model.usual_filters, linear_model.null_fit.filter_indices)
    filters = [[of_channel[i]] for of_channel, i in chosen]

    def iterate_at(values: np.ndarray) -> _HypothesisIterate:
        at_values = put(sensor, names, np.clip(values, low, high))
        linearised = linearise(linear_model, effects, at_values, filters)
        fit = linearised.fit()
        j = len(names)
        present = linearised.values - linearised.prior_mean[:j]
        return _HypothesisIterate(
            values=linearised.values,
            step=linearised.departures(fit)[:j] - present,
            cost=fit.loss(np.arange(j), present) - fit.log_evidence,
            linearised=linearised,
            fit=fit,
        )

    def has_ended(
        first: _HypothesisIterate,
        previous: _HypothesisIterate | None,
        present: _HypothesisIterate,
    ) -> bool:
        if previous is not None:
            is_hopeless = present.fit.log_evidence < lowest_log_evidence
            if is_hopeless or previous.cost - present.cost < _SMALLEST_GAIN:
                return True
        promised = present.fit.log_evidence + present.cost
        smallest = max(_SMALLEST_GAIN, _SMALLEST_GAIN_SHARE * (first.cost - present.cost))
        smallest_step = _SMALLEST_STEP * present.linearised.prior_std[: len(names)]
        return promised < smallest or bool(np.all(np.abs(present.step) < smallest_step))

    last = gauss_newton(iterate_at, first, has_ended, _EVALUATIONS, _HALVINGS, _EVIDENCE_TOLERANCE)
    return _fitted_hypothesis(
        linear_model, with_filters(linear_model, last.linearised, linear_model.usual_filters)
    )


def _fitted_hypothesis(linear_model: LinearModel, linearised: LinearisedHypothesis) -> Hypothesis:
    """Return a hypothesis at the values at which it was linearised, with their deviations."""
    fit = linearised.fit()
    j = len(linearised.values)
    names = linearised.names[:j]
    at_values = linearised.values - linearised.prior_mean[:j]
    std = stds(fit.covariance)[:j]
    # Neither the encoder nor the form of an effect is exact.
    in_rad = [parameter_of(n).unit == 'rad' for n in names]
    size = np.where([parameter_of(n).is_size for n in names], fit.values[:j], linearised.values)
    form = np.where([effect_named(n.effect).exact for n in names], 0.0, _FORM_ERROR * size)
    # The nuisance parameters are at their mean given the values of the effects.
    fitted = linearised.prior_mean + fit.given(np.arange(j), at_values)
    low = [parameter_of(name).lower for name in linearised.names]
    high = [parameter_of(name).upper for name in linearised.names]
    angle_rad = np.where(in_rad, linear_model.smallest_angle_rad(), 0.0)
    widest = np.maximum(linearised.prior_std[:j], np.abs(at_values))
    return Hypothesis(
        effects=linearised.effects,
        sensor=put(linearised.sensor, linearised.names, np.clip(fitted, low, high)),
        names=names,
        values=at_values,
        std=np.sqrt(std**2 + form**2 + angle_rad**2),
        undetermined=std > evidence.UNDETERMINED_SHARE * widest,
        log_evidence=fit.log_evidence - fit.loss(np.arange(j), at_values),
        fit=fit,
        linearised=linearised,
    )


class _Ranked(NamedTuple):
    """Variants on the linear model: gain of log evidence, numbers and fit."""

    gain: float
    chosen: tuple[int, ...]
    fit: LinearFit
    start: float  # The gain where limits begin as they were simulated


class Search:
    """The sets of effects that were fitted to recordings of one unit."""

    def __init__(self, model: LinearModel) -> None:
        self.model = model
        self.found = {frozenset[str](): fit_hypothesis(model, (), {}, {})}

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

    def run(self, show_share: Callable[[float], None]) -> None:
        """Fit singles, then further effects beside the best set, then pairs."""
        variants = self.model.variants
        identifiable = _identifiable(self.model)
        straight = [
            i for i in identifiable if effect_named(variants[i].effect).diagnosis.straight_line
        ]
        singles = self._rank(self.model, (), [(i,) for i in identifiable])
        lines = self._rank(self.model, (), [*((i,) for i in straight), *combinations(straight, 2)])
        first = [*singles[:_FITTED_SINGLES], *lines]
        for number, single in enumerate(first):
            show_share(0.5 * number / len(first))
            self._fit(self.model, single)
        for _ in range(LARGEST_SET - 1):
            show_share(0.6)
            best = self.best
            if not 0 < len(best.effects) < LARGEST_SET:
                break
            self._extend(best)
            gained = best.log_evidence - self.model.null_fit.log_evidence
            if self.best.log_evidence - best.log_evidence < _IMMATERIAL * gained:
                break
        # Zero-g and scale factor of a unit are rarely exact, and may hide behind another effect.
        singles_found = [h for h in self.found.values() if len(h.effects) == 1]
        best_single = max(singles_found, key=lambda h: h.log_evidence, default=self.best)
        for beside in (self.best, best_single):
            self._add_straight(beside, [variants[i].effect for i in straight])
        show_share(0.8)
        leading = sorted(ranked.chosen[0] for ranked in singles[:_SINGLES])
        pairs = self._rank(self.model, (), list(combinations(leading, 2)))
        for pair in pairs[:_FURTHER]:
            if pair.gain > (1 + _IMMATERIAL) * singles[0].gain:
                self._fit(self.model, pair)
        for hypothesis in sorted(self.found.values(), key=lambda h: -h.log_evidence)[:_COMPLETED]:
            self._complete(hypothesis.effects)
        show_share(1.0)

    def _add_straight(self, beside: Hypothesis, straight: Sequence[str]) -> None:
        """Fit zero-g and scale factor beside a set."""
        if not 0 < len(beside.effects) < LARGEST_SET:
            return
        start = dict(zip(beside.names, beside.values))
        for effect in dict.fromkeys(straight):
            effects = (*beside.effects, effect)
            if effect not in beside.effects and frozenset(effects) not in self.found:
                self._add(effects, start, {})

    def _complete(self, effects: Sequence[str]) -> None:
        """Fit a set without each of its effects, and these without each, and so on."""
        for effect in effects:
            fewer = tuple(e for e in effects if e != effect)
            start = self.found.get(frozenset(effects), self.best)
            # The first fit of a part of the best set may have ended at a lower maximum.
            if start is self.best or frozenset(fewer) not in self.found:
                self._add(fewer, dict(zip(start.names, start.values)), {}, -np.inf)
            if frozenset(fewer) in self.found:
                self._complete(fewer)

    def _extend(self, best: Hypothesis) -> None:
        """Fit the further effects that gain most beside a set, ranked at its values."""
        about = _model_about(self.model, best)
        present = tuple(i for i, v in enumerate(about.variants) if v.effect in best.effects)
        further = [
            (i,) for i in _identifiable(about) if about.variants[i].effect not in best.effects
        ]
        for ranked in self._rank(about, present, further)[:_FURTHER]:
            if best.log_evidence + _LARGEST_GAIN_RATIO * ranked.gain >= self._lowest:
                self._fit(about, ranked, best)

    def _rank(
        self, model: LinearModel, present: tuple[int, ...], sets: Sequence[tuple[int, ...]]
    ) -> list[_Ranked]:
        """
        Fit sets of variants beside present ones on a linear model, by falling gain.

        Of each set of effects the variants that begin best are ranked.
        """
        without = model.fit_variants(present) if present else model.null_fit
        best: dict[frozenset[str], _Ranked] = {}
        for chosen in sets:
            effects = frozenset(model.variants[i].effect for i in chosen)
            if len(effects) == len(chosen):
                fit = model.fit_variants([*present, *chosen], without)
                gain = fit.log_evidence - without.log_evidence
                ranked = _Ranked(gain, chosen, fit, gain - _loss_of_limits(model, chosen, fit))
                if effects not in best or ranked.start > best[effects].start:
                    best[effects] = ranked
        return sorted(best.values(), key=lambda f: -f.gain)

    def _fit(self, model: LinearModel, ranked: _Ranked, beside: Hypothesis | None = None) -> None:
        """Fit a ranked set beside another one."""
        present = beside.effects if beside else ()
        effects = (*present, *(model.variants[i].effect for i in ranked.chosen))
        if ranked.gain < _WORTH_FITTING or frozenset(effects) in self.found:
            return
        start = dict(zip(beside.names, beside.values)) if beside else {}
        shapes: dict[Coefficient, float] = {}
        chosen = [model.variants[i] for i in ranked.chosen]
        own = set(chain(*(model.column_ids[i] for i in ranked.chosen)))
        for k, value in zip(ranked.fit.column_ids, ranked.fit.values):
            if k in own:
                start[model.names[k]] = float(value)
        for variant in chosen:
            # Limits and sizes start where the effect was simulated.
            for name, value in variant.limit_start.items():
                p = parameter_of(name)
                start[name] = value - (0.0 if p.is_size else p.scale)
            # An effect that is far from linear stays near the sizes at which it was simulated.
            for name in variant.names:
                p = parameter_of(name)
                if p.starts and p.is_size:
                    size = variant.step * p.scale
                    near = np.clip(start.get(name, size), size / _NEAR_START, size * _NEAR_START)
                    start[name] = float(near)
            shapes |= {Coefficient(variant.effect, p): v for p, v in variant.shape.items()}
        self._add(effects, start, shapes)

    def _add(
        self,
        effects: Sequence[str],
        start: Mapping[Coefficient, float],
        shapes: Mapping[Coefficient, float],
        lowest: float | None = None,
    ) -> None:
        """Fit and keep a set, unless it cannot be simulated, is singular or shows otherwise."""
        try:
            fitted = fit_hypothesis(
                self.model, effects, start, shapes, self._lowest if lowest is None else lowest
            )
        except (UserError, np.linalg.LinAlgError):
            return
        before = self.found.get(frozenset(effects))
        is_worse = before is not None and fitted.log_evidence < before.log_evidence
        if is_worse or any(map(fitted.is_zero_g, fitted.effects)):
            return
        # Recordings that are not much longer than a time constant do not show it.
        longest_s = max(c.span_s for c in self.model.comparisons)
        values = dict(zip(fitted.names, fitted.values))
        if all(
            longest_s
            >= _TIME_CONSTANTS
            * values.get(Coefficient(e, effect_named(e).diagnosis.time_constant), 0.0)
            for e in fitted.effects
        ):
            self.found[frozenset(effects)] = fitted


def _loss_of_limits(model: LinearModel, chosen: Sequence[int], fit: LinearFit) -> float:
    """Return what a fit loses where limits clip as much as they were simulated to."""
    limited = [model.column_ids[i] for i in chosen if model.variants[i].limit_start]
    places = np.flatnonzero(np.isin(fit.column_ids, [*chain(*limited)]))
    return fit.loss(places, np.ones(len(places)))


def _identifiable(model: LinearModel) -> list[int]:
    """
    Return the variants that can show.

    Without a known pose zero-g and scale factor cannot. What is constant in all recordings, as a
    scale factor is in one pose, is the zero-g.
    """
    identifiable = []
    for i, variant in enumerate(model.variants):
        line = effect_named(variant.effect).diagnosis.straight_line
        shows_in_pose = model.pose_known or not line
        is_zero_g = line is StraightLine.ZERO_G
        if shows_in_pose and (is_zero_g or not _is_constant(model, i)):
            identifiable.append(i)
    return identifiable


def _is_constant(model: LinearModel, variant: int) -> bool:
    """Determine whether a variant changes the output of each axis by a constant alone."""
    for channel in model.columns:
        for column in (channel[k] for k in model.column_ids[variant] if k in channel):
            if np.ptp(column) > _CONSTANT * np.abs(column).max():
                return False
    return True


def _model_about(model: LinearModel, best: Hypothesis) -> LinearModel:
    """
    Return the linear model about a set: residuals and sensitivities at its fit.

    Where the set changes the output little, those to other effects stay as they were.
    Filter and latency stay those of the parameter file, unless they are effects of the set, so
    that their tolerance is the same as before.
    """
    file_values = with_neutral(model.baseline, best.sensor.effects).values
    values = {}
    for effect, fitted in best.sensor.values.items():
        hints = effect_named(effect).diagnosis
        stays = hints.nuisance and not hints.straight_line and effect not in best.effects
        values[effect] = file_values[effect] if stays else fitted
    comparisons = [
        replace(c, sensor=replace(c.at_rate(best.sensor), values=values))
        for c in model.comparisons
    ]
    outputs_v = zip(comparisons, model.baseline_v)
    is_near = all(
        rms(c.simulated_v(c.sensor) - v) < _SMALL_CHANGE * rms(v.std(axis=0)) for c, v in outputs_v
    )
    return linear.build_linear_model(
        comparisons,
        only=best.effects if is_near else None,
        near=model if is_near else None,
        filters=[[f[i]] for f, i in zip(best.linearised.filters, best.fit.filter_indices)],
    )
