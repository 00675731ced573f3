# SPDX-License-Identifier: Apache-2.0
"""
The search for sets of effects: singles, pairs and triples.

The linear model ranks hundreds of sets within a second. The best are fitted by re-simulation,
shapes included, because large effects are not linear. What is found is judged elsewhere, by
held-out figures.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, combinations
from typing import NamedTuple

from adxl_ros.diagnose import evidence, linear_model as linear
from adxl_ros.diagnose.evidence import LinearFit, LinearisedHypothesis, Whitener
from adxl_ros.diagnose.linear_model import LinearModel
from adxl_ros.errors import UserError
from adxl_ros.model.constants import Z_90
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Coefficient, StraightLine
from adxl_ros.model.gauss_newton import gauss_newton, Iterate
from adxl_ros.model.sensor import fitted_of, get, parameter_of, put, Sensor, with_neutral
import numpy as np

_EVALUATIONS, _HALVINGS = 8, 2
"""Largest number of simulations of a hypothesis, and of halvings of a step. Chosen: most need
five, and a quarter of a step is enough for the library."""
_EVIDENCE_TOLERANCE = 1e-3  # A step may lower the log evidence by this. Chosen: far below one unit
_SMALLEST_STEP, _SMALLEST_GAIN, _SMALLEST_GAIN_SHARE = 1e-3, 0.5, 1e-4
"""Step, in prior standard deviations, and gain of log evidence, also divided by that of all steps,
below which a fit has converged. Chosen: far below any interval; a large effect needs no more
digits."""
_FORM_ERROR = 0.03
"""Relative standard deviation of a coefficient because the form of its effect is not exact. Only
geometry and clocks have exact forms. Tuned by hand on simulated recordings of the working seeds of
the blind check."""
_HEALTHY_STDS = 3.0
"""Largest departure of a healthy unit, in standard deviations: one unit in 400 exceeds it."""
LARGEST_SET = 3  # Largest number of effects in a set. Chosen: one recording hardly separates more
_SINGLES, _FITTED_SINGLES, _FURTHER, _COMPLETED = 8, 5, 3, 4
"""Singles whose pairs are ranked, singles that are fitted, further effects beside the best set,
and sets that are fitted without each effect. Chosen: run time."""
_IMMATERIAL = 0.01
"""Share of the gain of a set that a further effect must gain, so that a third one is looked for.
Chosen: a third of what each effect of a set must explain."""
_WORTH_FITTING = -30.0
"""Gain of log evidence from which a set is fitted. Chosen: the wide priors of a small effect on
three axes cost as much, and the held-out figures decide."""
_HOPELESS_SHARE, _SMALLEST_DEFICIT = 0.2, 100.0
"""A set that gains less than the best one by this share of it, and by this log evidence, is not
refined or extended. Its form would have to be wrong by as much of the gap."""
_LARGEST_GAIN_RATIO = 5.0  # What a fit in full may gain, divided by what the linear model promises
_NEAR_START = 1.4
"""Largest ratio of the start of a size to the one at which the effect was simulated: the starts
differ by factors of two."""
_AT_BOUND = 1e-4  # Distance from a bound, as a share of the range, that is at it. Chosen: rounding
_CONSTANT = 1e-6  # Range of a constant column, relative. Chosen: rounding errors
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
        """Effects whose determined sizes all agree with the baseline, by 90 % intervals."""
        differs = np.abs(self.values) > Z_90 * self.std
        sizes = [
            (name.effect, shows)
            for name, shows, is_open in zip(self.names, differs, self.undetermined)
            if parameter_of(name).is_size and not is_open
        ]
        return frozenset(e for e, _ in sizes) - {e for e, shows in sizes if shows}

    @property
    def at_bound(self) -> bool:
        """Whether a determined size is at the end of what its parameter can have: no result."""
        for name, value, is_open in zip(
            self.names, get(self.sensor, self.names), self.undetermined
        ):
            p = parameter_of(name)
            margin = _AT_BOUND * (p.upper - p.lower)
            within = p.lower + margin < value < p.upper - margin
            if p.is_size and not is_open and not within and abs(value - p.neutral) > margin:
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
    nuisances = [
        n for n in dict.fromkeys(chain(*linear_model.nuisance_columns)) if n.effect not in effects
    ]
    start = with_neutral(
        linear_model.baseline, [*effects, *dict.fromkeys(n.effect for n in nuisances)]
    )
    parameters, values = [parameter_of(name) for name in names], get(sensor, names)
    prior_mean = _prior_mean(start, names)
    prior_std = [p.scale * (linear.PRIOR_WIDTH if p.is_size else 1) for p in parameters]
    sensor = put(start, names, values)
    all_names, j = [*names, *nuisances], len(names)
    # Without the effects that a calibration can take up.
    without = replace(
        sensor,
        values={
            **sensor.values,
            **{e: start.values[e] for e in effects if linear.calibration_takes_up(e)},
        },
    )
    channels: list[evidence.WhitenedChannel] = []
    columns: list[evidence.ChannelColumns] = []
    changes: list[dict[int, np.ndarray]] = []
    for comparison in linear_model.comparisons:
        at_rate = replace(sensor, rate_hz=comparison.sensor.rate_hz)
        output_v = comparison.simulated_v(at_rate)
        derivatives = linear.sensitivities_at(
            comparison.simulated_v, at_rate, names, values, output_v
        )
        change_v = output_v - comparison.simulated_v(replace(without, rate_hz=at_rate.rate_hz))
        for d, axis in enumerate(start.axes):
            places = [i for i, n in enumerate(names) if n.axis in ('', axis)]
            design = derivatives[:, d, places]
            residual_v = (
                comparison.volts[:, d] - output_v[:, d] + design @ (values - prior_mean)[places]
            )
            on_channel = linear_model.nuisance_columns[len(channels)]
            own = [n for n in nuisances if n in on_channel]
            ids = np.array([*places, *map(all_names.index, own)], int)
            stacked = np.column_stack([residual_v, design, *(on_channel[n] for n in own)])
            scale = float(comparison.scale_v_per_mps2[d]) * len(start.axes) ** 0.5
            columns.append(
                evidence.ChannelColumns(
                    ids,
                    stacked.astype(np.float32),
                    evidence.plain_grams(stacked / scale, comparison.used),
                )
            )
            channels.append(
                evidence.whiten_channel(
                    stacked[:, 0], stacked[:, 1:], ids, comparison.used, filters[len(channels)]
                )
            )
            changes.append({0: change_v[:, d]})
    # The square of each deviation is that of a healthy unit's tolerance plus that of what a
    # calibration can take up of the effects.
    parts = linear.parts_at_rest(
        linear_model.comparisons, linear_model.nuisance_columns, changes, 1
    )
    nuisance_std, reach = (
        np.array(
            [
                np.hypot(factor * linear_model.tolerance(n), parts.get(n, np.zeros(1))[0])
                for n in nuisances
            ]
        )
        for factor in (1.0, _HEALTHY_STDS)
    )
    return LinearisedHypothesis(
        tuple(effects),
        sensor,
        tuple(all_names),
        np.concatenate([prior_mean, get(start, nuisances)]),
        np.array([*prior_std, *nuisance_std]),
        reach,
        values[:j],
        channels,
        columns,
        filters,
    )


def _fitted_names(linear_model: LinearModel, effects: Sequence[str]) -> list[Coefficient]:
    """Return the coefficients of effects that the recordings show, and limits and shapes."""
    return [
        name
        for effect in effects
        for name in fitted_of(effect_named(effect), linear_model.baseline.axes)
        if not parameter_of(name).is_size
        or name in linear_model.names
        or effect_named(effect).limits
    ]


def _prior_mean(sensor: Sensor, names: Sequence[Coefficient]) -> np.ndarray:
    """Return prior means of coefficients: as in a sensor, typical of shapes and limits, (k,)."""
    return np.array(
        [
            float(get(sensor, [name])[0]) if p.is_size else p.scale
            for name in names
            for p in (parameter_of(name),)
        ]
    )


@dataclass(frozen=True)
class _HypothesisIterate(Iterate):
    """An iterate of the fit: the linearised hypothesis and its linear fit."""

    linearised: LinearisedHypothesis
    fit: LinearFit


@dataclass(frozen=True)
class _Refit:
    """The fit of a set of effects by re-simulation, for one noise."""

    linear_model: LinearModel
    effects: Sequence[str]
    names: list[Coefficient]  # Coefficients of the effects, (k,)
    sensor: Sensor  # The baseline with neutral effects
    filter_indices: Sequence[int]  # Number of the whitening filter of each channel
    lowest_log_evidence: float  # Log evidence below which the set is hopeless

    def run(self, values: np.ndarray) -> Sensor:
        """Iterate from values, (k,), until the log evidence no longer gains."""
        last = gauss_newton(
            self._linearised_at,
            values,
            self._has_ended,
            _EVALUATIONS,
            _HALVINGS,
            _EVIDENCE_TOLERANCE,
        )
        return last.linearised.sensor

    def _linearised_at(self, values: np.ndarray) -> _HypothesisIterate:
        within = (
            np.clip(
                values,
                [parameter_of(n).lower for n in self.names],
                [parameter_of(n).upper for n in self.names],
            )
            if self.names
            else values
        )
        filters = [[f[i]] for f, i in zip(self.linear_model.usual_filters, self.filter_indices)]
        linearised = linearise(
            self.linear_model, self.effects, put(self.sensor, self.names, within), filters
        )
        fit, j = linearised.fit(), len(linearised.values)
        step = linearised.departures(fit)[:j] + linearised.prior_mean[:j] - linearised.values
        loss = fit.loss(linearised.values - linearised.prior_mean[:j])
        return _HypothesisIterate(
            linearised.values, step, loss - fit.log_evidence, linearised, fit
        )

    def _has_ended(
        self,
        first: _HypothesisIterate,
        previous: _HypothesisIterate | None,
        present: _HypothesisIterate,
    ) -> bool:
        if previous is not None and (
            present.fit.log_evidence < self.lowest_log_evidence
            or previous.cost - present.cost < _SMALLEST_GAIN
        ):
            return True
        smallest = max(_SMALLEST_GAIN, _SMALLEST_GAIN_SHARE * (first.cost - present.cost))
        return present.fit.log_evidence + present.cost < smallest or bool(
            np.all(
                np.abs(present.step)
                < _SMALLEST_STEP * present.linearised.prior_std[: len(self.names)]
            )
        )


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
    refit = _Refit(
        linear_model,
        effects,
        names,
        sensor,
        linear_model.null_fit.filter_indices,
        lowest_log_evidence,
    )
    linearised = linearise(linear_model, effects, refit.run(first))
    return _fitted_hypothesis(linear_model, linearised, linearised.fit())


def _fitted_hypothesis(
    linear_model: LinearModel, linearised: LinearisedHypothesis, fit: LinearFit
) -> Hypothesis:
    """Return a hypothesis at the values at which it was linearised, with their deviations."""
    j = len(linearised.values)
    names = linearised.names[:j]
    at_values = linearised.values - linearised.prior_mean[:j]
    std = np.sqrt(np.diag(fit.covariance)[:j])
    # Neither the encoder nor the form of an effect is exact.
    in_rad = [parameter_of(n).unit == 'rad' for n in names]
    size = np.where([parameter_of(n).is_size for n in names], fit.values[:j], linearised.values)
    form = np.where([effect_named(n.effect).exact for n in names], 0.0, _FORM_ERROR * size)
    # The nuisance parameters are at their mean given the values of the effects.
    fitted = linearised.prior_mean + fit.given(np.arange(j), at_values)
    low, high = (
        [getattr(parameter_of(n), end) for n in linearised.names] for end in ('lower', 'upper')
    )
    return Hypothesis(
        linearised.effects,
        put(linearised.sensor, linearised.names, np.clip(fitted, low, high)),
        names,
        at_values,
        np.sqrt(std**2 + form**2 + np.where(in_rad, linear_model.smallest_angle_rad(), 0.0) ** 2),
        std
        > evidence.UNDETERMINED_SHARE * np.maximum(linearised.prior_std[:j], np.abs(at_values)),
        fit.log_evidence - fit.loss(at_values),
        fit,
        linearised,
    )


class _Ranked(NamedTuple):
    """Variants on the linear model: gain of log evidence, numbers and fit."""

    gain: float
    chosen: tuple[int, ...]
    fit: LinearFit


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
        singles = self._rank(self.model, (), [(i,) for i in _identifiable(self.model)])
        straight = [
            i
            for i in _identifiable(self.model)
            if effect_named(self.model.variants[i].effect).diagnosis.straight_line
        ]
        first = [
            *singles[:_FITTED_SINGLES],
            *self._rank(self.model, (), [*((i,) for i in straight), *combinations(straight, 2)]),
        ]
        for number, single in enumerate(first):
            show_share(0.5 * number / len(first))
            self._fit(self.model, single)
        for _ in range(LARGEST_SET - 1):
            show_share(0.6)
            best = self.best
            if not 0 < len(best.effects) < LARGEST_SET:
                break
            self._extend(best)
            if self.best.log_evidence - best.log_evidence < _IMMATERIAL * (
                best.log_evidence - self.model.null_fit.log_evidence
            ):
                break
        # Zero-g and scale factor of a unit are rarely exact, and may hide behind another effect.
        singles_found = [h for h in self.found.values() if len(h.effects) == 1]
        best_single = max(singles_found, key=lambda h: h.log_evidence, default=self.best)
        for beside in (self.best, best_single):
            self._add_straight(beside, [self.model.variants[i].effect for i in straight])
        show_share(0.8)
        for pair in self._rank(
            self.model,
            (),
            list(combinations(sorted(ranked.chosen[0] for ranked in singles[:_SINGLES]), 2)),
        )[:_FURTHER]:
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
            if frozenset(fewer) not in self.found:
                start = self.found.get(frozenset(effects), self.best)
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

        Of each set of effects the best variants are ranked.
        """
        without = model.fit_variants(present) if present else model.null_fit
        best: dict[frozenset[str], _Ranked] = {}
        for chosen in sets:
            effects = frozenset(model.variants[i].effect for i in chosen)
            if len(effects) == len(chosen):
                fit = model.fit_variants([*present, *chosen], without)
                gain = fit.log_evidence - without.log_evidence
                if effects not in best or gain > best[effects].gain:
                    best[effects] = _Ranked(gain, chosen, fit)
        return sorted(best.values(), key=lambda f: -f.gain)

    def _fit(self, model: LinearModel, ranked: _Ranked, beside: Hypothesis | None = None) -> None:
        """Fit a ranked set beside another one."""
        present = beside.effects if beside else ()
        effects = (*present, *(model.variants[i].effect for i in ranked.chosen))
        if ranked.gain < _WORTH_FITTING or frozenset(effects) in self.found:
            return
        start = dict(zip(beside.names, beside.values)) if beside else {}
        shapes: dict[Coefficient, float] = {}
        own = {k for i in ranked.chosen for k in model.column_ids[i]}
        start |= {
            model.names[k]: float(v)
            for k, v in zip(ranked.fit.column_ids, ranked.fit.values)
            if k in own
        }
        for variant in (model.variants[i] for i in ranked.chosen):
            # Limits and sizes start where the effect was simulated.
            start |= {
                name: value - (0.0 if parameter_of(name).is_size else parameter_of(name).scale)
                for name, value in variant.limit_start.items()
            }
            # An effect that is far from linear stays near the sizes at which it was simulated.
            start |= {
                name: float(np.clip(start.get(name, size), size / _NEAR_START, size * _NEAR_START))
                for name in variant.names
                if (p := parameter_of(name)).starts and p.is_size
                for size in (variant.step * p.scale,)
            }
            shapes |= {Coefficient(variant.effect, p): v for p, v in variant.shape.items()}
        self._add(effects, start, shapes)

    def _add(
        self,
        effects: Sequence[str],
        start: Mapping[Coefficient, float],
        shapes: Mapping[Coefficient, float],
        lowest: float | None = None,
    ) -> None:
        """Fit and keep a set, unless it cannot be simulated, is singular or does not show."""
        try:
            fitted = fit_hypothesis(
                self.model, effects, start, shapes, self._lowest if lowest is None else lowest
            )
        except (UserError, np.linalg.LinAlgError):
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


def _identifiable(model: LinearModel) -> list[int]:
    """
    Return the variants that can show.

    Without a known pose zero-g and scale factor cannot. What is constant in all recordings, as a
    scale factor is in one pose, is the zero-g.
    """
    return [
        i
        for i, v in enumerate(model.variants)
        if (model.pose_known or not effect_named(v.effect).diagnosis.straight_line)
        and (
            effect_named(v.effect).diagnosis.straight_line is StraightLine.ZERO_G
            or not _is_constant(model, i)
        )
    ]


def _is_constant(model: LinearModel, variant: int) -> bool:
    """Determine whether a variant changes the output of each axis by a constant alone."""
    columns = [
        channel[k] for channel in model.columns for k in model.column_ids[variant] if k in channel
    ]
    return all(np.ptp(column) <= _CONSTANT * np.abs(column).max() for column in columns)


def _model_about(model: LinearModel, best: Hypothesis) -> LinearModel:
    """
    Return the linear model about a set: residuals and sensitivities at its fit.

    Filter and latency stay those of the parameter file, unless they are effects of the set, so
    that their tolerance is the same as before.
    """
    file_values, values = with_neutral(model.baseline, best.sensor.effects).values, {}
    for effect, fitted in best.sensor.values.items():
        hints = effect_named(effect).diagnosis
        stays = hints.nuisance and not hints.straight_line and effect not in best.effects
        values[effect] = file_values[effect] if stays else fitted
    comparisons = [
        replace(c, sensor=replace(best.sensor, values=values, rate_hz=c.sensor.rate_hz))
        for c in model.comparisons
    ]
    return linear.build_linear_model(
        comparisons,
        filters=[[f[i]] for f, i in zip(best.linearised.filters, best.fit.filter_indices)],
    )
