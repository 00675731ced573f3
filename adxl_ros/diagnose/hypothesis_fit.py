# SPDX-License-Identifier: Apache-2.0

"""The fit of a hypothesis: linearised at its coefficients, fitted, and simulated again."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from typing import NamedTuple

from adxl_ros.diagnose import evidence
from adxl_ros.diagnose.evidence import LinearFit, WhitenedChannel
from adxl_ros.diagnose.linear_model import (
    calibration_takes_up,
    hints_of,
    limits,
    LinearModel,
    NumberedColumn,
    parts_at_rest,
    PRIOR_WIDTH,
    rests_by_channel,
    sensitivities_at,
)
from adxl_ros.diagnose.noise_model import drifts_among, Whitener
from adxl_ros.model.coefficients import fitted_of, get, parameter_of, put, with_neutral
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Coefficient, Role
from adxl_ros.model.gauss_newton import gauss_newton, Iterate
from adxl_ros.model.sensor import Sensor
import numpy as np

_EVALUATIONS = 8
"""Largest number of simulations of a hypothesis. Chosen: most need five."""
_HALVINGS = 2
"""How often a step that lowers the log evidence is halved. Chosen: a quarter of a step is
enough for the library."""
_EVIDENCE_TOLERANCE = 1e-3
"""A step may lower the log evidence by this. Chosen: far below one unit."""
_SMALLEST_STEP = 1e-3
"""Smallest step, in prior standard deviations. Chosen: far below any interval."""
_SMALLEST_GAIN = 0.5
"""Gain of log evidence below which the fit has converged. Chosen: tempered, it changes odds by a
sixth."""
_SMALLEST_GAIN_SHARE = 1e-4
"""The same limit, divided by the gain of all steps. Chosen: a large effect needs no more
digits."""
_FORM_ERROR = 0.03
"""Relative standard deviation of a coefficient because the form of its effect is not exact. Only
geometry and clocks have exact forms. Tuned by hand on simulated recordings of the working seeds of
the blind check."""
_UNDETERMINED_PRIOR_SHARE = 0.5
"""A coefficient is not determined if its posterior standard deviation exceeds this share of the
prior's. Chosen: the samples then determine it hardly better than the prior."""
_LIMIT_STEP = 0.02
"""Share by which a limit of some blocks may differ from that of all blocks. Chosen: the change of
the output is linear within a knee, which is that wide."""
_HEALTHY_STDS = 3.0
"""Largest departure of a healthy unit, in standard deviations: one unit in 400 exceeds it."""
_UNDETERMINED_RATIO = 3.0
"""Some blocks do not determine a coefficient if their standard deviation exceeds that of all
blocks by this factor. Chosen: a quarter of the blocks is held out."""


@dataclass(frozen=True)
class Hypothesis:
    """A set of effects after its fit."""

    effects: tuple[str, ...]  # Names of the effects; none for no gap
    sensor: Sensor  # The baseline with the effects and the nuisance parameters, as fitted
    names: tuple[Coefficient, ...]  # Names of the k fitted coefficients of the effects, (k,)
    values: np.ndarray  # Their values, as departures from the baseline, (k,)
    std: np.ndarray  # Their standard deviations, (k,)
    log_evidence: float  # Log evidence
    fit: LinearFit  # The last linear fit
    linearised: LinearisedHypothesis  # The hypothesis linearised at its values
    # How far the log posterior at the values is below the maximum of the linear model
    linear_loss: float
    converged: bool = True  # Whether the Gauss-Newton iteration has converged

    @property
    def undetermined(self) -> np.ndarray:
        """Coefficients that the recordings narrow hardly more than their prior, (k,) bool."""
        j = len(self.names)
        return np.sqrt(np.diag(self.fit.covariance)[:j]) \
            > _UNDETERMINED_PRIOR_SHARE * np.maximum(self.linearised.prior_std[:j],
                                                     np.abs(self.values))

    @property
    def whiteners(self) -> list[Whitener]:
        """Whitening filter of each channel."""
        return [filters[i] for filters, i in zip(self.linearised.filters,
                                                 self.fit.filter_indices)]


class ChannelColumns(NamedTuple):
    """The linear model of a hypothesis in one channel."""

    places: np.ndarray  # Places of the k coefficients among all, (k,)
    values: np.ndarray  # Residual at the prior mean, V, and sensitivities, V per unit, (n, k + 1)
    # Products of the same divided by the scale factor and the root of the number of axes, by
    # block, (m/s²)², (blocks, k + 1, k + 1)
    plain: np.ndarray


@dataclass(frozen=True)
class LinearisedHypothesis:
    """
    A hypothesis linearised at values of its k coefficients.

    The first j coefficients are those of the effects. The others are nuisance parameters, which
    stay near the baseline and are linearised there.
    """

    effects: tuple[str, ...]  # Names of the effects
    sensor: Sensor  # The sensor at the values
    names: tuple[Coefficient, ...]  # Coefficients, those of the effects first, (k,)
    prior_mean: np.ndarray  # Prior mean of the coefficients, (k,)
    prior_std: np.ndarray  # Prior standard deviation of the coefficients, (k,)
    reach: np.ndarray  # Largest departure of the nuisance parameters of a healthy unit, (k − j,)
    values: np.ndarray  # Values of the coefficients of the effects, (j,)
    # Whitened columns, and whitened residuals at the prior mean by the linear model
    channels: list[WhitenedChannel]
    columns: list[ChannelColumns]  # The same before whitening
    filters: Sequence[Sequence[Whitener]]  # Whitening filters of each channel

    @property
    def effect_names(self) -> tuple[Coefficient, ...]:
        """Names of the coefficients of the effects, (j,)."""
        return self.names[:len(self.values)]

    def fit(self, blocks: np.ndarray | None = None, drifts: Sequence[str] = ()) -> LinearFit:
        """
        Fit all coefficients.

        blocks: blocks that are used, (blocks,) bool; None for all.
        """
        return evidence.fit_columns(self.channels, range(len(self.names)), self.prior_std, blocks,
                                    drifts=(*drifts, *drifts_among(self.sensor.effects)))

    def sensor_at_values(self, fit: LinearFit) -> Sensor:
        """
        Return the sensor with the effects at their values.

        The nuisance parameters are at their posterior mean given these values. Their mean in the
        fit itself may differ much, because there the effects have other values.
        """
        of_effects = np.arange(len(self.values))
        departures = evidence.conditional_mean(fit, of_effects,
                                               self.values - self.prior_mean[of_effects])
        return put(self.sensor, self.names,
                   _within_bounds(self.names, self.prior_mean + departures))

    def departures(self, fit: LinearFit, full_fit: LinearFit | None = None) -> np.ndarray:
        """
        Return the departures from the prior mean after a fit.

        A limit with its knee, or a shape, keeps its value if the samples do not determine it,
        because its prior mean is no better guess. It also keeps its value if only the held-out
        blocks determine it. A shape changes by a factor of two at most, and a limit that is fitted
        to some blocks by a small share.

        returns: departures, (k,).
        """
        j = len(self.values)
        parameters = [parameter_of(name) for name in self.effect_names]
        std = np.sqrt(np.diag(fit.covariance)[:j])
        undetermined = std > self.prior_std[:j] * _UNDETERMINED_PRIOR_SHARE
        if full_fit is not None:
            undetermined |= std > _UNDETERMINED_RATIO * np.sqrt(np.diag(full_fit.covariance)[:j])
        fitted = self.prior_mean[:j] + fit.values[:j]
        sized = np.array([p.is_size and not limits(effect_named(name.effect))
                          for p, name in zip(parameters, self.effect_names)], bool)
        values = np.where(undetermined & ~sized, self.values, fitted)
        if full_fit is not None:
            # Of a size that only the held-out blocks show, the others predict nothing.
            hidden = undetermined & sized & (2 * std > np.abs(self.values - self.prior_mean[:j]))
            values = np.where(hidden, self.prior_mean[:j], values)
        shape_range = np.sort([self.values / 2, self.values * 2], axis=0)
        is_shape = [p.role is Role.SHAPE for p in parameters]
        values = np.where(is_shape, np.clip(values, *shape_range), values)
        changed = values != fitted
        departures = self._given(fit, changed, values)
        if full_fit is None:
            return departures
        # A healthy unit's zero-g, scale factor, filter and latency stay within their tolerance.
        outside = np.abs(departures[j:]) > self.reach
        if outside.any():
            given = np.flatnonzero(np.concatenate([changed, outside]))
            within = np.clip(departures[j:], -self.reach, self.reach)
            departures = evidence.conditional_mean(fit, given, np.concatenate(
                [values - self.prior_mean[:j], within])[given])
        # A limit may follow another coefficient that keeps its value, so that it is bounded last.
        values = departures[:j] + self.prior_mean[:j]
        limit_range = np.sort(np.outer([1 - _LIMIT_STEP, 1 + _LIMIT_STEP], self.values), axis=0)
        is_limit = np.array([p.role is Role.LIMIT for p in parameters], bool)
        bounded = np.where(is_limit, np.clip(values, *limit_range), values)
        if np.array_equal(bounded, values):
            return departures
        return self._given(fit, changed | (bounded != values), bounded)

    def _given(self, fit: LinearFit, given: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return departures, (k,), where coefficients of the effects, (j,) bool, are given."""
        places = np.flatnonzero(given)
        return evidence.conditional_mean(fit, places, values[places] - self.prior_mean[places])

    def linear_loss(self, fit: LinearFit) -> float:
        """Return how far the log posterior at the values is below the linear model's maximum."""
        return evidence.log_posterior_loss(
            self.channels, fit, self.values - self.prior_mean[:len(self.values)], self.prior_std)


def linearise(linear_model: LinearModel, effects: Sequence[str], sensor: Sensor,
              filters: Sequence[Sequence[Whitener]] | None = None) -> LinearisedHypothesis:
    """Linearise a hypothesis at the coefficients of a sensor."""
    filters = linear_model.filters_of(()) if filters is None else filters
    start = with_neutral(linear_model.baseline, effects)
    names = _fitted_names(linear_model, effects)
    nuisances = [n for n in dict.fromkeys(chain(*linear_model.nuisance_columns))
                 if n.effect not in effects]
    start = with_neutral(start, dict.fromkeys(n.effect for n in nuisances))
    prior_mean, prior_std = _prior(start, names)
    values = get(sensor, names)
    sensor = put(start, names, values)
    all_names = [*names, *nuisances]
    channels: list[WhitenedChannel] = []
    columns: list[ChannelColumns] = []
    changes_v: list[np.ndarray] = []
    for number, comparison in enumerate(linear_model.comparisons):
        at_rate = replace(sensor, rate_hz=comparison.sensor.rate_hz)
        output_v = comparison.simulated_v(at_rate)
        derivatives = sensitivities_at(comparison.simulated_v, at_rate, names, values, output_v)
        change_v = output_v - _output_without_calibrated(linear_model, number, at_rate, start,
                                                         effects)
        for d, axis in enumerate(start.axes):
            places = [i for i, n in enumerate(names) if n.axis in ('', axis)]
            design = derivatives[:, d, places]
            residual_v = comparison.volts[:, d] - output_v[:, d] \
                + design @ (values - prior_mean)[places]
            on_channel = linear_model.nuisance_columns[len(channels)]
            nuisance_columns = {all_names.index(n): on_channel[n]
                                for n in nuisances if n in on_channel}
            ids = np.array([*places, *nuisance_columns], int)
            design = np.column_stack([design, *nuisance_columns.values()])
            changes_v.append(change_v[:, d])
            stacked = np.column_stack([residual_v, design])
            scale = float(comparison.scale_v_per_mps2[d]) * len(start.axes) ** 0.5
            columns.append(ChannelColumns(ids, stacked.astype(np.float32), evidence.plain_grams(
                stacked / scale, comparison.used)))
            channels.append(evidence.whiten_channel(residual_v, design, ids, comparison.used,
                                                    filters[len(channels)]))
    nuisance_std, reach = _nuisance_std(linear_model, effects, all_names, nuisances, changes_v)
    return LinearisedHypothesis(
        effects=tuple(effects), sensor=sensor, names=tuple(all_names),
        prior_mean=np.concatenate([prior_mean, get(start, nuisances)]),
        prior_std=np.array([*prior_std, *nuisance_std]), values=values, channels=channels,
        reach=np.array(reach), columns=columns, filters=filters)


def _output_without_calibrated(linear_model: LinearModel, number: int, sensor: Sensor,
                               start: Sensor, effects: Sequence[str]) -> np.ndarray:
    """Simulate a recording without the effects that a calibration can take up, V, (n, m)."""
    taken_up = [effect for effect in effects if calibration_takes_up(effect)]
    if len(taken_up) == len(effects):
        return linear_model.baseline_v[number]
    values = {**sensor.values, **{effect: start.values[effect] for effect in taken_up}}
    return linear_model.comparisons[number].simulated_v(replace(sensor, values=values))


def _nuisance_std(linear_model: LinearModel, effects: Sequence[str], names: list[Coefficient],
                  nuisances: Sequence[Coefficient], changes_v: Sequence[np.ndarray]
                  ) -> tuple[list[float], list[float]]:
    """
    Return prior standard deviations of nuisance parameters beside effects, and their reach.

    The reach is what a healthy unit stays within. The square of each deviation is that of a
    healthy unit's tolerance plus that of what a calibration can take up of the effects.
    `changes_v` are the outputs of the effects by channel, V, (n,); `names` are all coefficients.
    """
    lines = [{names.index(n): column for n, column in columns.items() if hints_of(n).straight_line}
             for columns in linear_model.nuisance_columns]
    changes = [[NumberedColumn(0, change_v)] for change_v in changes_v]
    parts = parts_at_rest(lines, changes, 1, rests_by_channel(linear_model.comparisons))
    std, reach = [], []
    for name in nuisances:
        part = parts.get(names.index(name), np.zeros(1))
        std.append(float(np.hypot(linear_model.tolerance(name), part[0])))
        reach.append(float(np.hypot(_HEALTHY_STDS * linear_model.tolerance(name), part[0])))
    return std, reach


def _fitted_names(linear_model: LinearModel, effects: Sequence[str]
                  ) -> list[Coefficient]:
    """Return the coefficients of effects that the recordings show, and limits and shapes."""
    return [name for effect in effects
            for name in fitted_of(effect_named(effect), linear_model.baseline.axes)
            if not parameter_of(name).is_size or name in linear_model.names
            or limits(effect_named(effect))]


def _prior(sensor: Sensor, names: Sequence[Coefficient]) -> tuple[np.ndarray, list[float]]:
    """Return prior means and standard deviations of the coefficients of effects, (k,) each."""
    parameters = [parameter_of(name) for name in names]
    mean = np.array([float(get(sensor, [name])[0]) if p.is_size else p.scale
                     for name, p in zip(names, parameters)])
    return mean, [p.scale * (PRIOR_WIDTH if p.is_size else 1) for p in parameters]


@dataclass(frozen=True)
class _HypothesisIterate(Iterate):
    """An iterate of the fit: the linearised hypothesis and its linear fit."""

    linearised: LinearisedHypothesis
    fit: LinearFit

    @property
    def log_evidence(self) -> float:
        """Log evidence at the values."""
        return -self.cost


def fit_hypothesis(linear_model: LinearModel, effects: Sequence[str],
                   start: Mapping[Coefficient, float],
                   shapes: Mapping[Coefficient, float],
                   lowest_log_evidence: float = -np.inf) -> Hypothesis:
    """
    Fit a set of effects by re-simulation, shape parameters included.

    Each Gauss-Newton step simulates, differentiates, whitens and fits at the present values. The
    iteration ends where the log evidence no longer gains, or where even the maximum of the linear
    model is hopelessly low.
    """
    effects = tuple(dict.fromkeys(effects))
    neutral_sensor = with_neutral(linear_model.baseline, effects)
    names = _fitted_names(linear_model, effects)
    filters = linear_model.filters_of(())
    # The iteration has the noise of no gap; only its end is compared for every noise.
    fixed = [[f[i]] for f, i in zip(filters, linear_model.null_fit.filter_indices)]

    def linearised_at(values: np.ndarray) -> _HypothesisIterate:
        linearised = linearise(linear_model, effects,
                               put(neutral_sensor, names, _within_bounds(names, values)), fixed)
        fit = linearised.fit()
        j = len(linearised.values)
        step = linearised.departures(fit)[:j] + linearised.prior_mean[:j] - linearised.values
        log_evidence = fit.log_evidence - linearised.linear_loss(fit)
        return _HypothesisIterate(linearised.values, step, -log_evidence, linearised, fit)

    def has_ended(first: _HypothesisIterate, previous: _HypothesisIterate | None,
                  present: _HypothesisIterate) -> bool:
        hopeless = previous is not None and present.fit.log_evidence < lowest_log_evidence
        return hopeless or _has_converged(first, previous, present)

    solve = partial(
        gauss_newton, linearised_at, has_converged=has_ended, max_halvings=_HALVINGS,
        max_evaluations=_EVALUATIONS,
        cost_tolerance=_EVIDENCE_TOLERANCE)
    first = _first_values(neutral_sensor, names, start, shapes)
    solution = solve(first)
    if not solution.converged:
        nearer = _nearer_shape(linearised_at, first, names, shapes, solution.last.log_evidence)
        if nearer is not None:
            solution = min(solution, solve(nearer), key=lambda s: s.last.cost)
    hopeless = solution.last.fit.log_evidence < lowest_log_evidence
    linearised = linearise(linear_model, effects, solution.last.linearised.sensor, filters)
    fit = linearised.fit()
    j = len(linearised.values)
    std = np.sqrt(evidence.robust_std(linearised.channels, fit, linearised.prior_std)[:j] ** 2
                  + _encoder_std(linear_model, linearised.effect_names) ** 2
                  + _form_std(linearised, fit) ** 2)
    log_evidence = fit.log_evidence - linearised.linear_loss(fit) + sparsity_log_bayes_factor(
        linearised, fit.values, fit.covariance)
    return Hypothesis(
        effects, linearised.sensor_at_values(fit), linearised.effect_names,
        linearised.values - linearised.prior_mean[:j], std, log_evidence, fit, linearised,
        linearised.linear_loss(fit),
        solution.converged and not hopeless)


def _nearer_shape(linearised_at: Callable[[np.ndarray], _HypothesisIterate], first: np.ndarray,
                  names: Sequence[Coefficient], shapes: Mapping[Coefficient, float],
                  log_evidence: float) -> np.ndarray | None:
    """
    Return first values with a shape between two starts, where that exceeds a log evidence.

    The sizes are those of the linear fit at each shape (variable projection; Golub and Pereyra
    1973).
    """
    tried: list[np.ndarray] = []
    for i, name in enumerate(names):
        starts = parameter_of(name).starts
        if name.without_axis not in shapes or first[i] not in starts:
            continue
        place = starts.index(first[i])
        for neighbour in starts[max(place - 1, 0):place] + starts[place + 1:place + 2]:
            values = first.copy()
            values[i] = (first[i] + neighbour) / 2
            tried.append(values)
    fitted = [_with_fitted_sizes(linearised_at(values)) for values in tried]
    best = max(fitted, key=lambda f: f[0], default=None)
    return best[1] if best is not None and best[0] > log_evidence else None


def _with_fitted_sizes(iterate: _HypothesisIterate) -> tuple[float, np.ndarray]:
    """Return log evidence and values, (j,), with the shapes kept and the sizes fitted."""
    linearised, fit = iterate.linearised, iterate.fit
    j = len(linearised.values)
    is_shape = np.array([not parameter_of(name).is_size for name in linearised.effect_names])
    shapes = np.flatnonzero(is_shape)
    departures = (linearised.values - linearised.prior_mean[:j])[shapes]
    deviation = departures - fit.values[shapes]
    loss = 0.5 * deviation @ np.linalg.solve(fit.covariance[np.ix_(shapes, shapes)], deviation)
    mean = evidence.conditional_mean(fit, shapes, departures)[:j] + linearised.prior_mean[:j]
    return fit.log_evidence - float(loss), np.where(is_shape, linearised.values, mean)


def _first_values(sensor: Sensor, names: Sequence[Coefficient], start: Mapping[Coefficient, float],
                  shapes: Mapping[Coefficient, float]) -> np.ndarray:
    """Return the first values of the coefficients, (k,)."""
    values = []
    for name in names:
        p = parameter_of(name)
        mean = float(get(sensor, [name])[0]) if p.is_size else p.scale
        parameter = name.without_axis
        values.append(shapes[parameter] if not p.is_size and parameter in shapes
                      else mean + start.get(name, 0.0))
    return np.array(values)


def _has_converged(first: _HypothesisIterate, previous: _HypothesisIterate | None,
                   present: _HypothesisIterate) -> bool:
    """Determine whether the last step gained too little, or the next one would."""
    if previous is not None and present.log_evidence - previous.log_evidence < _SMALLEST_GAIN:
        return True
    smallest = max(_SMALLEST_GAIN,
                   _SMALLEST_GAIN_SHARE * (present.log_evidence - first.log_evidence))
    if present.fit.log_evidence - present.log_evidence < smallest:
        return True
    prior_std = present.linearised.prior_std[:len(present.step)]
    return bool(np.all(np.abs(present.step) < _SMALLEST_STEP * prior_std))


def _encoder_std(linear_model: LinearModel, names: Sequence[Coefficient]) -> np.ndarray:
    """Return standard deviations by the encoder's step: rad for angles, 0 for others, (k,)."""
    return np.where([parameter_of(n).unit == 'rad' for n in names],
                    linear_model.smallest_angle_rad(), 0.0)


def _form_std(linearised: LinearisedHypothesis, fit: LinearFit) -> np.ndarray:
    """Return standard deviations because forms are not exact, (j,); 0 for exact forms."""
    names = linearised.effect_names
    size = np.where([parameter_of(n).is_size for n in names], fit.values[:len(names)],
                    linearised.values)
    exact = [effect_named(n.effect).exact for n in names]
    return np.where(exact, 0.0, _FORM_ERROR * np.abs(size))


def sparsity_log_bayes_factor(linearised: LinearisedHypothesis, mean: np.ndarray,
                              covariance: np.ndarray) -> float:
    """
    Return what the log evidence gains because an effect need not show in all coefficients.

    The prior gives every set of an effect's coefficients the same probability, and a log-uniform
    amplitude. Omitting a coefficient multiplies the evidence by the ratio of its posterior and
    prior densities at zero (Dickey 1971). Coefficients are omitted one by one while the evidence
    gains; at least one coefficient of each effect stays.

    mean: posterior mean of its coefficients, as departures from the prior mean, (k,); covariance:
    their posterior covariance, (k, k).
    """
    gain = 0.0
    for effect in linearised.effects:
        kept = [i for i, name in enumerate(linearised.effect_names)
                if name.effect == effect and parameter_of(name).is_size]
        if not kept:
            continue
        gain -= float(np.log(2.0 ** len(kept) - 1))
        while len(kept) > 1:
            variance = np.diag(covariance)[kept]
            gains = 0.5 * (np.log(linearised.prior_std[kept] ** 2 / variance)
                           - mean[kept] ** 2 / variance)
            if gains.max() <= 0:
                break
            gain += float(gains.max())
            j = kept.pop(int(np.argmax(gains)))
            regression = covariance[:, j] / covariance[j, j]
            mean = mean - regression * mean[j]
            covariance = covariance - np.outer(regression, covariance[j])
        gain += evidence.amplitude_log_bayes_factor(
            mean[kept], covariance[np.ix_(kept, kept)], linearised.prior_std[kept])
    return gain


def _within_bounds(names: Sequence[Coefficient], values: np.ndarray) -> np.ndarray:
    """Clip values to the bounds of their parameters, (k,)."""
    return np.clip(values, np.array([parameter_of(n).lower for n in names]),
                   np.array([parameter_of(n).upper for n in names]))
