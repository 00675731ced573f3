# SPDX-License-Identifier: Apache-2.0
"""
The linear model of all recordings about the baseline: sensitivities to the whole library.

Some coefficients of a healthy unit differ from the parameter file. Zero-g and scale factor age,
the parts of the RC filter have tolerances, and stamps have a latency. These nuisance parameters
are free in every hypothesis, within the tolerance of a healthy unit. An effect is named only if
its parameters exceed this tolerance.

A unit is calibrated with its effects, and often on the same stage. Zero-g and scale factor of the
calibration then contain an unknown share of what an effect does at rest. In a hypothesis with an
effect, they may therefore change by as much.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import chain, product
from typing import NamedTuple

from adxl_ros.diagnose import evidence
from adxl_ros.diagnose.comparison import BaselineComparison, Reference
from adxl_ros.diagnose.evidence import FlexibleColumns, LinearFit, WhitenedChannel
from adxl_ros.diagnose.noise_model import (
    angle_error_filter,
    AngleErrorFilter,
    drifts_among,
    lost_motion_filter,
    LostMotionFilter,
    Whitener,
    whiteners,
)
from adxl_ros.diagnose.residual_map import Basis, flexible_bases
from adxl_ros.errors import UserError
from adxl_ros.model.coefficients import names_of, parameter_of, put, with_neutral
from adxl_ros.model.diagnosis_hints import DiagnosisHints, Manoeuvre, StraightLine
from adxl_ros.model.effects import effect_named, library
from adxl_ros.model.effects.base import ActsOn, Coefficient, Concern, Effect, Parameter, Role
from adxl_ros.model.sensor import Sensor
import numpy as np

PRIOR_WIDTH = 5.0
"""Prior standard deviation of a coefficient, divided by its typical size. Chosen: faults are
larger than typical values. `evidence.AMPLITUDES` adds smaller amplitudes to the prior."""
_SHAPE_FACTORS = (0.2, 1.0, 5.0)
"""Values of a shape parameter that states no starts, divided by its typical value. Chosen: fits
reach the values between."""
_SMOOTH_STEP = 0.2
"""Step of a smooth parameter, divided by its typical size. Chosen: smaller than most faults."""
_ROUGH_STEPS = (1.0, 4.0, 16.0)
"""Steps of a parameter that is not smooth, divided by its typical size. Chosen: the derivative at
a play of 1 mrad does not predict a play of 15 mrad."""
_CLIPPED_SHARES = (0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.3)
"""Shares of the samples that are clipped by the limits that are tried. Chosen: neighbours differ
by factors of 1.5 to 2.5."""
_CLIPPING_AMOUNT = 0.3
"""Share of the change by a limit, on the linear model, below which the axis is not clipped there.
Chosen: the levels differ by factors, so that a limit between two takes a part of each."""
_BEYOND_G = 0.1
"""Distance from the largest sample of a limit that clips none, g. Chosen: five typical knees."""
_FIT_STEP = 0.02
"""Step of a smooth parameter at its fitted value, divided by its typical size. Chosen: small
enough for a derivative."""
_ROUGH_FIT_STEP = 0.3
"""The same for a parameter that is not smooth. Chosen: wide enough for a steady derivative."""
_SMALLEST_V = 1e-9
"""Change of the output, V, that is a rounding error."""

Simulate = Callable[[Sensor], np.ndarray]
"""Mean output of a sensor in one recording, V, (n, m)."""


class AxisColumns(NamedTuple):
    """Sensitivities of one axis to the k coefficients that it follows."""

    numbers: np.ndarray  # Numbers of the coefficients in their variant, (k,)
    values: np.ndarray  # Sensitivities, V per unit of the coefficient, (n, k)


@dataclass(frozen=True)
class Variant:
    """An effect with fixed shape parameters, and the sensitivities to its p coefficients."""

    effect: str  # Name of the effect
    shape: dict[str, float]  # Values of the shape parameters
    step: float  # Step of the derivative, in typical sizes; for a limit the number of its level
    names: tuple[Coefficient, ...]  # Names of the coefficients, (p,)
    prior_std: np.ndarray  # Their prior standard deviations, (p,)
    columns: tuple[AxisColumns, ...]  # Sensitivities of each axis
    # Only for an effect with a limit: first values of its fit, by coefficient. The columns are
    # then the change of the output by these values, V.
    limit_start: dict[Coefficient, float] = field(default_factory=dict)
    # The same for limits that clip no sample
    limit_beyond: dict[Coefficient, float] = field(default_factory=dict)

    def first_limits(self, amounts: Mapping[Coefficient, float]) -> dict[Coefficient, float]:
        """Return first values of a fit of limits; those that hardly clip begin beyond all."""
        return self.limit_start | {name: value for name, value in self.limit_beyond.items()
                                   if amounts.get(name, 0.0) < _CLIPPING_AMOUNT}


def candidates() -> list[Effect]:
    """Return the effects of the library that act on the mean of the output."""
    return [effect for effect in library().values() if effect.acts_on is ActsOn.MEAN]


def limits(effect: Effect) -> list[Parameter]:
    """Return the parameters that do nothing until the signal reaches them."""
    return [p for p in effect.parameters if p.role is Role.LIMIT]


def variants(simulate: Simulate, sensor: Sensor, effect: Effect, baseline_v: np.ndarray,
             pose_known: bool) -> Iterator[Variant]:
    """
    Differentiate the simulated output by the parameters of an effect, for each shape.

    baseline_v: simulated output of the baseline, V, (n, m).
    """
    modelled = effect.name in sensor.effects
    if limits(effect):
        if not modelled:
            yield from _limit_variants(simulate, sensor, effect, limits(effect)[0], baseline_v)
        return
    # An effect with a shape parameter is nearly linear in its sizes. An effect of the baseline
    # keeps its shape.
    rough = not effect.smooth and not any(p.role is Role.SHAPE for p in effect.parameters)
    steps = [start / p.scale for p in effect.parameters if p.is_size for start in p.starts] \
        or list(_ROUGH_STEPS if rough else (_SMOOTH_STEP,))
    for shape, sizes in _tried(effect, modelled):
        for step in steps:
            try:
                variant = _variant(simulate, sensor, replace(effect, parameters=sizes), shape,
                                   step, baseline_v, pose_known)
            except UserError:
                return
            if variant is not None:
                yield variant


def _tried(effect: Effect, modelled: bool
           ) -> Iterator[tuple[dict[str, float], tuple[Parameter, ...]]]:
    """Return the shapes that are tried, each with the sizes that it concerns."""
    sizes = tuple(p for p in effect.parameters if p.role is not Role.SHAPE)
    unshaped = tuple(p for p in sizes if not p.shaped)
    if modelled or not unshaped:
        yield from ((shape, sizes) for shape in ([{}] if modelled else shapes(effect)))
        return
    yield {}, unshaped
    shaped = tuple(p for p in sizes if p.shaped)
    yield from ((shape, shaped) for shape in shapes(effect))


def _limit_variants(simulate: Simulate, sensor: Sensor, effect: Effect, limit: Parameter,
                    baseline_v: np.ndarray) -> Iterator[Variant]:
    """Try limits that clip small shares of the samples, by axis and for all axes together."""
    axes = sensor.axes
    with_effect = with_neutral(sensor, [effect.name])
    names = names_of(replace(effect, parameters=(limit,)), axes)
    # The other parameters have no effect until the limit clips; one-sided ones must leave 0.
    start = {name: p.scale if p.lower == p.neutral else p.neutral
             for p in effect.parameters if p.is_size
             for name in names_of(replace(effect, parameters=(p,)), axes)}
    magnitude_g = np.abs(baseline_v - sensor.zero_g_v) / sensor.scale_v_per_g
    beyond = dict(zip(names, np.clip(magnitude_g.max(axis=0) + _BEYOND_G, limit.lower,
                                     limit.upper)))
    levels = []
    for share in _CLIPPED_SHARES:
        levels.append(np.quantile(magnitude_g, 1 - share, axis=0))
        levels.append(np.full(len(axes), np.quantile(magnitude_g, 1 - share)))
    for number, level in enumerate(levels):
        values = np.clip(level, limit.lower, limit.upper)
        change_v = simulate(put(with_effect, names, values)) - baseline_v
        clipped = [d for d in range(len(axes)) if np.any(np.abs(change_v[:, d]) > _SMALLEST_V)]
        if clipped:
            yield Variant(effect.name, {}, float(number), tuple(names[d] for d in clipped),
                          np.ones(len(clipped)), _limit_columns(change_v, clipped),
                          dict(zip(names, values)) | start, beyond)


def _limit_columns(change_v: np.ndarray, clipped: list[int]) -> tuple[AxisColumns, ...]:
    """Return the change by its limit for each axis, V; no column where the limit does not clip."""
    return tuple(_stacked([(clipped.index(d), change_v[:, d])] if d in clipped else [],
                          len(change_v)) for d in range(change_v.shape[1]))


def shapes(effect: Effect) -> list[dict[str, float]]:
    """
    Return the values of the shape parameters that are tried: all combinations of their starts.

    Where an effect states no starts, its first shape parameter takes multiples of its scale.
    """
    shape_parameters = [p for p in effect.parameters if p.role is Role.SHAPE and not p.held]
    if not shape_parameters:
        return [{}]
    starts = [p.starts or (p.scale,) for p in shape_parameters]
    first = shape_parameters[0]
    if not any(p.starts for p in shape_parameters):
        starts[0] = tuple(dict.fromkeys(float(np.clip(first.scale * factor, first.lower,
                                                      first.upper)) for factor in _SHAPE_FACTORS))
    return [dict(zip([p.name for p in shape_parameters], values)) for values in product(*starts)]


def _variant(simulate: Simulate, sensor: Sensor, effect: Effect, shape: dict[str, float],
             step: float, baseline_v: np.ndarray, pose_known: bool) -> Variant | None:
    """Differentiate by the parameters of an effect at one shape; None where nothing changes."""
    axes = sensor.axes
    start = _with_shape(with_neutral(sensor, [effect.name]), effect_named(effect.name), shape)
    names: list[Coefficient] = []
    prior_std: list[float] = []
    columns: list[list[tuple[int, np.ndarray]]] = [[] for _ in axes]
    for p in effect.parameters:
        size = _step_within(p, np.asarray(start.values[effect.name][p.name]), p.scale * step)
        # A shape has no influence where the sizes are neutral, as in the baseline.
        change = (simulate(_stepped(start, effect.name, p, size)) - baseline_v) / size
        # Without a known pose only changes show, except of the zero-g itself.
        if not pose_known and effect.diagnosis.straight_line is not StraightLine.ZERO_G:
            change -= change.mean(axis=0)
        for name in names_of(replace(effect, parameters=(p,)), axes):
            reached = [axes.index(name.axis)] if p.axes else range(len(axes))
            if not np.any(np.abs(change[:, list(reached)]) * p.scale > _SMALLEST_V):
                continue
            for d in reached:
                columns[d].append((len(names), change[:, d]))
            names.append(name)
            prior_std.append(PRIOR_WIDTH * p.scale)
    if not names:
        return None
    return Variant(effect.name, shape, step, tuple(names), np.array(prior_std), tuple(
        _stacked(axis_columns, len(baseline_v)) for axis_columns in columns))


def _stacked(columns: list[tuple[int, np.ndarray]], count: int) -> AxisColumns:
    """Put numbered columns of `count` samples side by side."""
    if not columns:
        return AxisColumns(np.zeros(0, int), np.zeros((count, 0)))
    return AxisColumns(np.array([i for i, _ in columns], int),
                       np.column_stack([column for _, column in columns]))


def _step_within(parameter: Parameter, values: np.ndarray, step: float) -> float:
    """Return a step that keeps values within their bounds."""
    if parameter.lower <= np.max(values) + step <= parameter.upper:
        return step
    return (parameter.upper - float(np.max(values))) or -step


def _with_shape(sensor: Sensor, effect: Effect, shape: dict[str, float]) -> Sensor:
    """Return the sensor with given shape parameters of an effect that it has."""
    values = {**sensor.values[effect.name]}
    for p in effect.parameters:
        if p.name in shape:
            values[p.name] = np.full(len(sensor.axes), shape[p.name]) if p.axes else \
                np.array(shape[p.name])
    return replace(sensor, values={**sensor.values, effect.name: values})


def _stepped(sensor: Sensor, effect: str, parameter: Parameter, step: float) -> Sensor:
    """Return the sensor with all coefficients of a parameter changed by a step."""
    values = dict(sensor.values[effect])
    values[parameter.name] = np.asarray(values[parameter.name], float) + step
    return replace(sensor, values={**sensor.values, effect: values})


def sensitivities_at(simulate: Simulate, sensor: Sensor, names: Sequence[Coefficient],
                     values: np.ndarray, output_v: np.ndarray) -> np.ndarray:
    """
    Differentiate the output by p coefficients at their values.

    Coefficients of one parameter change together, because each axis only follows its own one.

    names: names of the coefficients, (p,); values: their values, (p,); output_v: simulated output
    of the sensor, V, (n, m); returns: sensitivities, V per unit, (n, m, p).
    """
    out = np.zeros((*output_v.shape, len(names)))
    groups: dict[Coefficient, list[int]] = {}
    for i, name in enumerate(names):
        groups.setdefault(name.without_axis, []).append(i)
    for group in groups.values():
        first = names[group[0]]
        p, smooth = parameter_of(first), effect_named(first.effect).smooth
        step = p.scale * (_FIT_STEP if p.role is Role.LIMIT or smooth else _ROUGH_FIT_STEP)
        if values[group[0]] + step > p.upper:
            step = -step
        changed_v = simulate(put(sensor, [names[i] for i in group], values[group] + step))
        for i in group:
            axis = names[i].axis
            axes = [sensor.axes.index(axis)] if axis else range(len(sensor.axes))
            for d in axes:
                out[:, d, i] = (changed_v[:, d] - output_v[:, d]) / step
    return out


_SIMULATED_SHARE = 0.5
"""Share of the run time of a linear model that its simulations take. Measured."""


_OTHER_RESTS_SHARE = 0.2
"""Share of an effect at rest by which its straight-line part differs between the rests of a
calibration and those of a recording. Tuned on simulated units that are calibrated by a sweep over
51 poses and recorded in other poses; shares there are up to 0.25."""
_SMALLEST_BENT_SHARE = 0.1
"""Share of an effect that differs from a straight line over the force, below which the effect is
a straight line itself. Chosen: a tenth of an effect is material."""


class NumberedColumn(NamedTuple):
    """One column of the linear model on one channel."""

    number: int  # Number of the column
    values: np.ndarray  # Sensitivity of the samples to the coefficient, V per unit, (n,)


def hints_of(name: Coefficient) -> DiagnosisHints:
    """Return the hints of the effect of a coefficient."""
    return effect_named(name.effect).diagnosis


@dataclass(frozen=True)
class LinearModel:
    """
    Recordings of one unit, and the sensitivities at their baseline.

    A channel is one axis of one recording.
    """

    comparisons: list[BaselineComparison]  # The recordings at the rate of the search
    baseline_v: list[np.ndarray]  # Simulated output of the baseline in each recording, V, (n, m)
    variants: list[Variant]  # Variants of the effects of the library
    column_ids: list[list[int]]  # Numbers of the columns of each variant
    names: list[Coefficient]  # Coefficient of each column
    prior_std: np.ndarray  # Prior standard deviation of each coefficient, (columns,)
    # Whitened residuals and columns at the baseline, by the filters for healthy units and for the
    # drifts of the baseline
    channels: list[WhitenedChannel]
    filters: list[list[Whitener]]  # Whitening filters of each channel
    columns: list[list[NumberedColumn]]  # By channel: sensitivities to the library
    # By channel: nuisance parameters and their sensitivities, V per unit, (n,)
    nuisance_columns: list[dict[Coefficient, np.ndarray]]
    # For each coefficient of zero-g and scale factor: how much of it a calibration can take up of
    # one unit of each column, (columns,)
    parts_at_rest: dict[Coefficient, np.ndarray]

    @property
    def baseline(self) -> Sensor:
        """Return the baseline of the first recording."""
        return self.comparisons[0].sensor

    @property
    def pose_known(self) -> bool:
        """Whether all recordings have a reference."""
        return all(c.reference is not Reference.NONE for c in self.comparisons)

    @property
    def lost_motion_mps2(self) -> float:
        """Rms of the motion that smooth references lack, m/s²."""
        scales = [scale for c in self.comparisons for scale in c.scale_v_per_mps2]
        errors = [filters[0].angle_errors for filters in self.filters]
        lost = [e.lost_rms_v / scale if isinstance(e, LostMotionFilter) else 0.0
                for e, scale in zip(errors, scales)]
        return float(np.sqrt(np.mean(np.square(lost))))

    @property
    def library_size(self) -> int:
        """Return the number of effects that have something to act on."""
        return len({v.effect for v in self.variants})

    def place_of_channel(self, number: int) -> tuple[int, int]:
        """Return the number of the recording and of the axis of a channel."""
        return divmod(number, len(self.baseline.axes))

    def filters_of(self, effects: Sequence[str]) -> list[list[Whitener]]:
        """Return for each channel the filters of healthy units and of the drifts of effects."""
        return _filters_of(self.filters, (*effects, *self.baseline.effects))

    @cached_property
    def null_fit(self) -> LinearFit:
        """Fit of the nuisance parameters alone."""
        return self.fit_variants([])

    @cached_property
    def flexible_bases(self) -> list[list[Basis]]:
        """Flexible functions of each axis of each recording about the baseline."""
        return [flexible_bases(c, v) for c, v in zip(self.comparisons, self.baseline_v)]

    def nuisance_ids(self) -> list[int]:
        """Return the numbers of the columns of nuisance parameters, each for small departures."""
        first: dict[str, list[int]] = {}
        for variant, ids in zip(self.variants, self.column_ids):
            first.setdefault(variant.effect, ids)
        return [i for effect, ids in first.items()
                if effect_named(effect).diagnosis.nuisance for i in ids]

    def smallest_angle_rad(self) -> float:
        """Return the standard deviation of an angle by the step of the stage's encoder, rad."""
        return max(c.sensor.stage_resolution_rad if c.reference is Reference.STAGE else 0.0
                   for c in self.comparisons) / 12 ** 0.5

    def prior(self, chosen: Sequence[int]) -> np.ndarray:
        """
        Return prior standard deviations of all coefficients.

        returns: standard deviations, (columns,).
        """
        prior_std = self.prior_std.copy()
        effects = {self.variants[i].effect for i in chosen}
        columns = [k for i in chosen if calibration_takes_up(self.variants[i].effect)
                   for k in self.column_ids[i]]
        for i in self.nuisance_ids():
            name = self.names[i]
            if name.effect in effects:
                continue
            parts = self.parts_at_rest.get(name, np.zeros(len(prior_std)))[columns] \
                * prior_std[columns]
            prior_std[i] = np.hypot(self.tolerance(name), np.sqrt(np.sum(parts ** 2)))
        return prior_std

    def tolerance(self, name: Coefficient) -> float:
        """
        Return the standard deviation of a nuisance parameter in a healthy unit.

        Without a known pose the zero-g is free, because only its changes show.
        """
        hints = hints_of(name)
        assert hints.healthy_std is not None
        sensor = self.baseline
        if hints.straight_line is None:
            return PRIOR_WIDTH * parameter_of(name).scale \
                if {*hints.stated_by} & {*sensor.measured} else hints.healthy_std
        scale = float(sensor.scale_v_per_g[sensor.axes.index(name.axis)])
        zero_g = hints.straight_line is StraightLine.ZERO_G
        if zero_g and not self.pose_known:
            return scale
        # Converters round or cut off, which shifts the zero-g by a part of a step.
        variance = sensor.lsb_v ** 2 / 12 if zero_g else 0.0
        if name in sensor.covariance_names:
            i = sensor.covariance_names.index(name)
            variance += float(sensor.covariance[i, i])
        return float(np.hypot(hints.healthy_std * scale, np.sqrt(variance)))

    def fit_variants(self, chosen: Sequence[int], start: LinearFit | None = None) -> LinearFit:
        """Fit a set of variants on the sensitivities at the baseline."""
        drifts = drifts_among(self.baseline.effects)
        effects = {self.variants[i].effect for i in chosen}
        ids = {k for k in self.nuisance_ids() if self.names[k].effect not in effects}.union(
            *(self.column_ids[i] for i in chosen))
        prior_std = self.prior(chosen)
        fit = evidence.fit_columns(self.channels, sorted(ids), prior_std, None, start, drifts)
        gain = 0.0
        for i in chosen:
            places = np.flatnonzero(np.isin(fit.column_ids, self.column_ids[i]))
            gain += evidence.amplitude_log_bayes_factor(
                fit.values[places], fit.covariance[np.ix_(places, places)],
                prior_std[fit.column_ids[places]])
        return replace(fit, log_evidence=fit.log_evidence + gain)


def calibration_takes_up(effect: str) -> bool:
    """
    Determine whether a calibration can take a part of an effect for zero-g or scale factor.

    Of one that zero-g and scale factor imitate completely, a calibration leaves nothing. Errors
    of the reference are not in a calibration without it.
    """
    library_effect = effect_named(effect)
    return not library_effect.diagnosis.absorbed \
        and library_effect.concern is not Concern.REFERENCE


def shows_in_lost_motion(effect: Effect) -> bool:
    """Determine whether an effect shows in the fast motion that a smooth reference lacks."""
    return effect.diagnosis.revealed_by is Manoeuvre.SHAKE and not effect.exact \
        and effect.concern is not Concern.REFERENCE


def build_linear_model(comparisons: Sequence[BaselineComparison],
                       show_progress: Callable[[float], None] = lambda fraction: None,
                       filters: Sequence[list[Whitener]] | None = None,
                       only: Sequence[str] | None = None,
                       flexible: Sequence[FlexibleColumns] | None = None) -> LinearModel:
    """Differentiate the baseline by the whole library in all recordings."""
    baseline_v = [c.simulated_v(c.sensor) for c in comparisons]
    names: list[Coefficient] = []
    prior_std: list[float] = []
    kept: list[Variant] = []
    column_ids: list[list[int]] = []
    columns: list[list[list[NumberedColumn]]] = [[[] for _ in c.sensor.axes] for c in comparisons]
    for by_recording in _variants(comparisons, baseline_v,
                                  lambda done: show_progress(_SIMULATED_SHARE * done), only):
        numbers: dict[Coefficient, int] = {}
        for i, variant in by_recording.items():
            for name, std in zip(variant.names, variant.prior_std):
                if name not in numbers:
                    numbers[name] = len(names)
                    names.append(name)
                    prior_std.append(float(std))
            for d, axis in enumerate(variant.columns):
                columns[i][d] += [NumberedColumn(numbers[variant.names[j]], column)
                                  for j, column in zip(axis.numbers, axis.values.T)]
        ids = list(numbers.values())
        kept.append(replace(next(iter(by_recording.values())), names=tuple(numbers),
                            prior_std=np.array([prior_std[j] for j in ids])))
        column_ids.append(ids)
    by_channel = list(chain(*columns))
    if filters is None:
        filters = [whiteners(c.sensor, d, c.dt_s, c.span_s,
                             _reference_errors(c, d))
                   for c in comparisons for d in range(len(c.sensor.axes))]
    channels = _whitened_channels(
        comparisons, by_channel, _filters_of(filters, comparisons[0].sensor.effects), flexible)
    show_progress(1.0)
    # The first column of an effect is that of its smallest start.
    nuisance_columns = [{names[i]: column for i, column in reversed(channel)
                         if hints_of(names[i]).nuisance} for channel in by_channel]
    lines = [{names.index(name): column for name, column in channel.items()
              if hints_of(name).straight_line} for channel in nuisance_columns]
    parts = parts_at_rest(lines, by_channel, len(names), rests_by_channel(comparisons))
    return LinearModel(list(comparisons), baseline_v, kept, column_ids, names,
                       np.array(prior_std), channels, list(filters), by_channel, nuisance_columns,
                       {names[i]: amounts for i, amounts in parts.items()})


def _reference_errors(comparison: BaselineComparison, axis: int
                      ) -> AngleErrorFilter | LostMotionFilter | None:
    """Return the filter for the errors of the reference on one axis; None where it is exact."""
    angle_errors = angle_error_filter(comparison, axis)
    return lost_motion_filter(comparison, axis, angle_errors) or angle_errors


def rests_by_channel(comparisons: Sequence[BaselineComparison]) -> list[np.ndarray]:
    """Return the samples at rest of each channel."""
    return [c.at_rest & c.used for c in comparisons for _ in c.sensor.axes]


def _variants(comparisons: Sequence[BaselineComparison], baseline_v: Sequence[np.ndarray],
              show_progress: Callable[[float], None], only: Sequence[str] | None
              ) -> list[dict[int, Variant]]:
    """Return the variants of the library, each by the number of the recording."""
    fades = any(c.reference_fades for c in comparisons)
    effects = [e for e in candidates()
               if (only is None or e.name in only or e.diagnosis.nuisance)
               and not (fades and shows_in_lost_motion(e))]
    every: dict[tuple, dict[int, Variant]] = {}
    for i, (comparison, output_v) in enumerate(zip(comparisons, baseline_v)):
        for k, effect in enumerate(effects):
            if effect.concern is Concern.REFERENCE \
                    and comparison.reference is not Reference.SIMULATOR:
                continue
            for variant in variants(comparison.simulated_v, comparison.sensor, effect, output_v,
                                    comparison.reference is not Reference.NONE):
                key = (variant.effect, tuple(variant.shape.items()), variant.step)
                every.setdefault(key, {})[i] = variant
            show_progress((i + (k + 1) / len(effects)) / len(comparisons))
    return list(every.values())


def _filters_of(filters: Sequence[list[Whitener]], effects: Sequence[str]
                ) -> list[list[Whitener]]:
    """Return for each channel the filters of healthy units and of the drifts among effects."""
    drifts = drifts_among(effects)
    return [[f for f in every if f.healthy or f.effect in drifts] or every for every in filters]


def _whitened_channels(comparisons: Sequence[BaselineComparison],
                       columns: Sequence[Sequence[NumberedColumn]],
                       filters: Sequence[list[Whitener]],
                       flexible: Sequence[FlexibleColumns] | None) -> list[WhitenedChannel]:
    """Whiten residual and columns of each channel."""
    channels: list[WhitenedChannel] = []
    for comparison in comparisons:
        for residual_v in comparison.residual_v(comparison.sensor).T:
            number = len(channels)
            channels.append(evidence.whiten_channel(
                residual_v, np.array([column for _, column in columns[number]]).T,
                np.array([i for i, _ in columns[number]]), comparison.used, filters[number],
                None if flexible is None else flexible[number], False))
    return channels


def parts_at_rest(lines: Sequence[dict[int, np.ndarray]],
                  columns: Sequence[Sequence[NumberedColumn]], count: int,
                  at_rest: Sequence[np.ndarray]) -> dict[int, np.ndarray]:
    """
    Compute how much of other columns a calibration can take for zero-g or scale factor.

    A calibration uses rests. It takes the straight-line part of an effect at its own rests for an
    error of zero-g and scale factor, and nothing of an effect that only acts in motion. The rests
    of the calibration differ from those of the recording, so that a share of the whole effect is
    added.

    lines: for each channel: columns of zero-g and scale factor by number, V per unit, (n,);
    columns: for each channel: the other columns, V per unit, (n,), with their numbers below
    `count`; at_rest: for each channel: samples at rest, (n,) bool; where none rests, all samples
    count; returns: by number of a column of zero-g or scale factor: the standard deviation of its
    part in one unit of each other column, in its own unit, (count,).
    """
    parts: dict[int, np.ndarray] = {}
    for line, channel_columns, resting in zip(lines, columns, at_rest):
        rows = resting if resting.any() else np.ones(len(resting), bool)
        if not line or not channel_columns:
            continue
        matrix = np.column_stack(list(line.values()))
        others = np.column_stack([column for _, column in channel_columns])
        rms = np.sqrt(np.mean(others[rows] ** 2, axis=0))
        at_rests = np.abs(np.linalg.lstsq(matrix[rows], others[rows])[0])
        lines_in_all = np.linalg.lstsq(matrix, others)[0]
        in_all = np.abs(lines_in_all)
        # A calibration with an effect that is a straight line would have left nothing of it.
        bent = (others - matrix @ lines_in_all).std(axis=0) \
            > _SMALLEST_BENT_SHARE * np.sqrt(np.mean(others ** 2, axis=0))
        for j, number in enumerate(line):
            size = max(float(np.sqrt(np.mean(matrix[:, j] ** 2))), np.finfo(float).tiny)
            part = parts.setdefault(number, np.zeros(count))
            ids = [i for i, _ in channel_columns]
            # The poses of a calibration may reach further than the rests of the recording.
            reach = np.abs(others).max(axis=0) / np.abs(matrix[:, j]).max() \
                if np.ptp(matrix[:, j]) else in_all[j]
            straight = np.maximum(at_rests[j], np.minimum(np.maximum(in_all[j], reach),
                                                          2 * rms / size))
            part[ids] = np.maximum(part[ids], bent * np.hypot(straight,
                                                              _OTHER_RESTS_SHARE * rms / size))
    return parts
