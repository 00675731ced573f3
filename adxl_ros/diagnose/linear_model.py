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

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import chain, product
from typing import NamedTuple

from adxl_ros.diagnose import evidence
from adxl_ros.diagnose.comparison import BaselineComparison, Reference
from adxl_ros.diagnose.evidence import LinearFit, LinearisedHypothesis
from adxl_ros.diagnose.noise_filters import drifts_among, Whitener, whiteners
from adxl_ros.errors import UserError
from adxl_ros.model import noise
from adxl_ros.model.effects import base, effect_named, library
from adxl_ros.model.effects.base import Coefficient, Concern, Effect, Parameter, Role
from adxl_ros.model.error_sizes import rms
from adxl_ros.model.sensor import (
    names_of,
    parameter_of,
    put,
    Sensor,
    with_neutral,
    with_values,
)
import numpy as np

PRIOR_WIDTH = 5.0
"""Prior standard deviation of a coefficient, divided by its typical size. Chosen: faults are
larger than typical values."""
_SHAPE_FACTORS = (0.2, 1.0, 5.0)
"""Values of a shape parameter that states no starts, divided by its typical value. Chosen: fits
reach the values between."""
_SMOOTH_STEP = 0.2
"""Step of a smooth parameter, divided by its typical size. Chosen: a straight line is close."""
_ROUGH_STEPS = (1.0, 4.0, 16.0)
"""Steps of a parameter that is not smooth, divided by its typical size. Chosen: the derivative at
a play of 1 mrad does not predict a play of 15 mrad."""
_FIT_STEP = 0.02
"""Step of a smooth parameter at its fitted value, in typical sizes. Chosen: a derivative."""
_ROUGH_FIT_STEP = 0.3
"""Step of another parameter at its fitted value, in typical sizes. Chosen: a steady derivative."""
_CLIPPED_SHARES = (0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.3)
"""Shares of the samples that are clipped by the limits that are tried. Chosen: neighbours differ
by factors of 1.5 to 2.5."""
_SMALLEST_V = 1e-9  # Change of the output, V, that is a rounding error
_SIMULATED_SHARE = 0.5
"""Share of the run time of a linear model that its simulations take. Measured."""
_OTHER_RESTS_SHARE = 0.2
"""Share of an effect at rest by which its straight-line part differs between the rests of a
calibration and those of a recording. Tuned on simulated units that are calibrated by a sweep over
51 poses and recorded in other poses; shares there are up to 0.25."""
SMALLEST_BENT_SHARE = 0.1
"""Share of an effect that differs from a straight line over the force, below which the effect is
a straight line itself. Chosen: a tenth of an effect is material."""

Simulate = Callable[[Sensor], np.ndarray]  # Mean output of a sensor in one recording, V, (n, m)


@dataclass(frozen=True)
class Variant:
    """An effect with fixed shape parameters, and the sensitivities to its p coefficients."""

    effect: str  # Name of the effect
    shape: dict[str, float]  # Values of the shape parameters
    step: float  # Step of the derivative, in typical sizes; for a limit the number of its level
    names: tuple[Coefficient, ...]  # Names of the coefficients, (p,)
    # By axis: sensitivities by coefficient, V per unit, (n,)
    columns: list[dict[Coefficient, np.ndarray]]
    # Only for an effect with a limit: first values of its fit, by coefficient. The columns are
    # then the change of the output by these values, V.
    limit_start: dict[Coefficient, float] = field(default_factory=dict)

    @property
    def key(self) -> tuple:
        """Return what distinguishes it from the others."""
        return self.effect, tuple(self.shape.items()), self.step


def candidates() -> list[Effect]:
    """Return the effects of the library that act on the mean of the output."""
    return [effect for effect in library().values() if effect.acts_on is base.ActsOn.MEAN]


def variants(
    comparison: BaselineComparison, effect: Effect, baseline_v: np.ndarray
) -> Iterator[Variant]:
    """
    Differentiate the simulated output by the parameters of an effect, for each shape.

    baseline_v: simulated output of the baseline, V, (n, m).
    """
    modelled = effect.name in comparison.sensor.effects
    if effect.concern is Concern.REFERENCE and comparison.reference is not Reference.SIMULATOR:
        return
    if effect.limits:
        if not modelled:
            yield from _limit_variants(comparison, effect, effect.limits[0], baseline_v)
        return
    for shape, parameters in _tried_shapes(effect, modelled):
        for step in _steps(effect):
            try:
                variant = _variant(comparison, effect, parameters, shape, step, baseline_v)
            except UserError:
                return
            if variant is not None:
                yield variant


def _steps(effect: Effect) -> list[float]:
    """Return the steps of the derivatives by the sizes of an effect, in typical sizes."""
    starts: list[float] = []
    for p in (p for p in effect.parameters if p.is_size):
        starts += [start / p.scale for start in p.starts]
    if starts:
        return starts
    # An effect with a shape parameter is nearly linear in its sizes.
    has_shape = any(p.role is Role.SHAPE for p in effect.parameters)
    return [_SMOOTH_STEP] if effect.smooth or has_shape else list(_ROUGH_STEPS)


def _tried_shapes(
    effect: Effect, modelled: bool
) -> list[tuple[dict[str, float], list[Parameter]]]:
    """
    Return shapes, and the parameters of which derivatives are taken there.

    An effect of the baseline keeps its shape. Sizes without a shape are tried once.
    """
    sizes = [p for p in effect.parameters if p.role is not Role.SHAPE]
    if modelled:
        return [({}, sizes)]
    unshaped = [p for p in sizes if not p.shaped]
    shaped = [p for p in sizes if p.shaped]
    once: list[tuple[dict[str, float], list[Parameter]]] = [({}, unshaped)] if unshaped else []
    return once + [(shape, shaped) for shape in _shapes(effect)]


def _shapes(effect: Effect) -> list[dict[str, float]]:
    """
    Return the values of the shape parameters that are tried: all combinations of their starts.

    Where an effect states no starts, its first shape parameter takes multiples of its scale.
    """
    parameters = [p for p in effect.parameters if p.role is Role.SHAPE and not p.held]
    starts = [p.starts or (p.scale,) for p in parameters]
    if parameters and not any(p.starts for p in parameters):
        first = parameters[0]
        starts[0] = tuple(
            dict.fromkeys(
                float(np.clip(first.scale * factor, first.lower, first.upper))
                for factor in _SHAPE_FACTORS
            )
        )
    return [dict(zip([p.name for p in parameters], values)) for values in product(*starts)]


def _limit_variants(
    comparison: BaselineComparison, effect: Effect, limit: Parameter, baseline_v: np.ndarray
) -> Iterator[Variant]:
    """Try limits that clip small shares of the samples, and the largest recorded output."""
    sensor = comparison.sensor
    axes, with_effect = sensor.axes, with_neutral(sensor, [effect.name])
    names = _names_of_parameter(effect, limit, axes)
    # The other parameters have no effect until the limit clips; one-sided ones must leave 0.
    start: dict[Coefficient, float] = {}
    for p in (p for p in effect.parameters if p.is_size):
        value = p.scale if p.lower == p.neutral else p.neutral
        start |= dict.fromkeys(_names_of_parameter(effect, p, axes), value)
    simulated_g, recorded_g = (
        np.abs(volts - sensor.zero_g_v) / sensor.scale_v_per_g
        for volts in (baseline_v, comparison.volts[comparison.used])
    )
    tried_g = [np.quantile(simulated_g, 1 - share, axis=0) for share in _CLIPPED_SHARES]
    for number, limits_g in enumerate([*tried_g, recorded_g.max(axis=0)]):
        values = np.clip(limits_g, limit.lower, limit.upper)
        change_v = comparison.simulated_v(put(with_effect, names, values)) - baseline_v
        clipped = [d for d in range(len(axes)) if np.any(np.abs(change_v[:, d]) > _SMALLEST_V)]
        if clipped:
            yield Variant(
                effect.name,
                {},
                float(number),
                tuple(names[d] for d in clipped),
                [{name: change_v[:, d]} if d in clipped else {} for d, name in enumerate(names)],
                dict(zip(names, values)) | start,
            )


def _names_of_parameter(effect: Effect, parameter: Parameter, axes: str) -> list[Coefficient]:
    """Return the coefficients of one parameter of an effect."""
    return [name for name in names_of(effect, axes) if name.parameter == parameter.name]


def _variant(
    comparison: BaselineComparison,
    effect: Effect,
    parameters: Sequence[Parameter],
    shape: dict[str, float],
    step: float,
    baseline_v: np.ndarray,
) -> Variant | None:
    """Differentiate by parameters of an effect at one shape; None where nothing changes."""
    axes = comparison.sensor.axes
    start = with_values(with_neutral(comparison.sensor, [effect.name]), effect.name, shape)
    names: list[Coefficient] = []
    columns: list[dict[Coefficient, np.ndarray]] = [{} for _ in axes]
    for p in parameters:
        values = np.asarray(start.values[effect.name][p.name], float)
        size, highest = p.scale * step, float(np.max(values))
        if not p.lower <= highest + size <= p.upper:
            size = (p.upper - highest) or -size
        # A shape has no influence where the sizes are neutral, as in the baseline.
        change = (
            comparison.simulated_v(with_values(start, effect.name, {p.name: values + size}))
            - baseline_v
        ) / size
        # Without a known pose only changes show, except of the zero-g itself.
        is_zero_g = effect.diagnosis.straight_line is base.StraightLine.ZERO_G
        if not (comparison.pose_known or is_zero_g):
            change -= change.mean(axis=0)
        for name in _names_of_parameter(effect, p, axes):
            reached = [axes.index(name.axis)] if p.axes else list(range(len(axes)))
            if np.any(np.abs(change[:, reached]) * p.scale > _SMALLEST_V):
                names.append(name)
                for d in reached:
                    columns[d][name] = change[:, d]
    return Variant(effect.name, shape, step, tuple(names), columns) if names else None


def sensitivities_at(
    simulate: Simulate,
    sensor: Sensor,
    names: Sequence[Coefficient],
    values: np.ndarray,
    output_v: np.ndarray,
) -> np.ndarray:
    """
    Differentiate the output by p coefficients at their values; return V per unit, (n, m, p).

    Coefficients of one parameter change together, because each axis only follows its own one.
    """
    # Samples are next to each other in memory, as filters take them.
    out = np.zeros((len(names), *output_v.shape[::-1])).T
    groups: dict[Coefficient, list[int]] = {}
    for i, name in enumerate(names):
        groups.setdefault(name.without_axis, []).append(i)
    for parameter, group in groups.items():
        p, smooth = parameter_of(parameter), effect_named(parameter.effect).smooth
        step = p.scale * (_FIT_STEP if p.role is Role.LIMIT or smooth else _ROUGH_FIT_STEP)
        if values[group[0]] + step > p.upper:
            step = -step
        changed_v = simulate(put(sensor, [names[i] for i in group], values[group] + step))
        for i in group:
            axes = [sensor.axes.index(names[i].axis)] if names[i].axis else slice(None)
            out[:, axes, i] = (changed_v[:, axes] - output_v[:, axes]) / step
    return out


def hints_of(name: Coefficient) -> base.DiagnosisHints:
    """Return the hints of the effect of a coefficient."""
    return effect_named(name.effect).diagnosis


class Channel(NamedTuple):
    """One axis of one recording."""

    comparison: BaselineComparison  # The recording
    axis: int  # Number of the axis

    @property
    def v_per_mean_mps2(self) -> float:
        """Voltage that adds 1 m/s² to the root of the mean square over axes, V/(m/s²)."""
        scale = float(self.comparison.scale_v_per_mps2[self.axis])
        return scale * len(self.comparison.sensor.axes) ** 0.5


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
    channels: list[evidence.WhitenedChannel]
    filters: list[list[Whitener]]  # Whitening filters of each channel
    # By channel: sensitivities by number of the column, V per unit, (n,)
    columns: list[dict[int, np.ndarray]]
    # Variants by what distinguishes them, the effect first, and by the number of the recording
    by_key: dict[tuple, dict[int, Variant]]
    # Whitened nuisance columns by number of the channel and identity of the filter
    _white: dict[tuple[int, int], np.ndarray] = field(default_factory=dict)

    @property
    def baseline(self) -> Sensor:
        """Return the baseline of the first recording."""
        return self.comparisons[0].sensor

    @property
    def pose_known(self) -> bool:
        """Whether all recordings have a reference."""
        return all(c.pose_known for c in self.comparisons)

    @cached_property
    def usual_filters(self) -> list[list[Whitener]]:
        """Return the filters of each channel for healthy units and for drifts of the baseline."""
        return filters_for(self.filters, self.baseline.effects)

    @cached_property
    def lost_motion_mps2(self) -> float:
        """Rms of the motion that smooth references lack, m/s²."""
        return rms([c.lost_motion_mps2() for c in self.comparisons])

    @cached_property
    def places(self) -> list[Channel]:
        """Return recording and axis of each channel."""
        return channels_of(self.comparisons)

    @cached_property
    def null_fit(self) -> LinearFit:
        """Fit of the nuisance parameters alone."""
        return self.fit_variants([])

    @cached_property
    def information(self) -> np.ndarray:
        """Products of the whitened columns, in units of the noise, (columns, columns)."""
        fit = self.null_fit
        products = np.zeros((len(self.names), len(self.names)))
        for channel, f, variance_v2 in zip(
            self.channels, fit.filter_indices, fit.innovation_variance_v2
        ):
            places = np.ix_(channel.column_ids, channel.column_ids)
            products[places] += channel.total_grams[f][1:, 1:] / variance_v2
        return products

    @cached_property
    def nuisance_columns(self) -> list[dict[Coefficient, np.ndarray]]:
        """By channel: nuisance parameters and their sensitivities, V per unit, (n,)."""
        every = []
        for channel in self.columns:
            # Of several starts of an effect, the column is that of the smallest.
            shown = [k for k in reversed(channel) if hints_of(self.names[k]).nuisance]
            every.append({self.names[k]: channel[k] for k in shown})
        return every

    @cached_property
    def nuisances(self) -> list[Coefficient]:
        """Return the nuisance parameters that show in any channel."""
        return list(dict.fromkeys(chain(*self.nuisance_columns)))

    def white_nuisances(
        self, number: int, shown: Iterable[Coefficient], filters: Sequence[Whitener]
    ) -> Iterator[np.ndarray]:
        """Yield nuisance columns of a channel whitened by each filter, (k, n); each once."""
        own, used = self.nuisance_columns[number], self.places[number].comparison.used
        places = [[*own].index(name) for name in shown]
        for whitener in filters:
            key = number, id(whitener)
            if key not in self._white:
                design = np.reshape([*own.values()], (len(own), len(used))).T
                self._white[key] = next(evidence.white_rows(design, used, [whitener]))
            yield self._white[key][places]

    @cached_property
    def parts_at_rest(self) -> dict[Coefficient, np.ndarray]:
        """How much a calibration can take up of one unit of each column, (columns,)."""
        return self.taken_up(self.columns, len(self.names))

    @cached_property
    def nuisance_ids(self) -> list[int]:
        """Numbers of the columns of nuisance parameters, each for small departures."""
        first: dict[str, list[int]] = {}
        for variant, ids in zip(self.variants, self.column_ids):
            if effect_named(variant.effect).diagnosis.nuisance:
                first.setdefault(variant.effect, ids)
        return list(chain(*first.values()))

    def smallest_angle_rad(self) -> float:
        """Return the standard deviation of an angle by the step of the stage's encoder, rad."""
        return max(c.sensor.stage_std_rad if c.joints else 0.0 for c in self.comparisons)

    def prior(self, chosen: Sequence[int]) -> np.ndarray:
        """Return prior standard deviations of all coefficients beside variants, (columns,)."""
        prior_std = self.prior_std.copy()
        effects = {self.variants[i].effect for i in chosen}
        taken_up = [i for i in chosen if calibration_takes_up(self.variants[i].effect)]
        columns = list(chain(*(self.column_ids[i] for i in taken_up)))
        for i in self.nuisance_ids:
            name = self.names[i]
            if name.effect not in effects:
                parts = self.parts_at_rest.get(name, np.zeros(len(prior_std)))
                part = np.sqrt(np.sum((parts[columns] * prior_std[columns]) ** 2))
                prior_std[i] = np.hypot(self.tolerances[name], part)
        return prior_std

    @cached_property
    def tolerances(self) -> dict[Coefficient, float]:
        """Return the standard deviations of the nuisance parameters in a healthy unit."""
        return {name: self._tolerance(name) for name in self.nuisances}

    def _tolerance(self, name: Coefficient) -> float:
        """
        Return the standard deviation of a nuisance parameter in a healthy unit.

        Without a known pose the zero-g is free, because only its changes show.
        """
        hints, sensor = hints_of(name), self.baseline
        assert hints.healthy_std is not None
        if hints.straight_line is None:
            return (
                PRIOR_WIDTH * parameter_of(name).scale
                if {*hints.stated_by} & {*sensor.measured}
                else hints.healthy_std
            )
        axis = sensor.axes.index(name.axis)
        scale = float(sensor.scale_v_per_g[axis])
        zero_g = hints.straight_line is base.StraightLine.ZERO_G
        if zero_g and not self.pose_known:
            return scale
        # Converters round or cut off, which shifts the zero-g by a part of a step.
        variance = float(noise.electronics(sensor).lsb_v[axis]) ** 2 / 12 if zero_g else 0.0
        if name in sensor.covariance_names:
            i = sensor.covariance_names.index(name)
            variance += float(sensor.covariance[i, i])
        return float(np.hypot(hints.healthy_std * scale, np.sqrt(variance)))

    def taken_up(
        self, columns: Sequence[Mapping[int, np.ndarray]], count: int
    ) -> dict[Coefficient, np.ndarray]:
        """
        Compute how much of other columns a calibration can take for zero-g or scale factor.

        A calibration uses rests. It takes the straight-line part of an effect at its own rests for
        an error of zero-g and scale factor, and nothing of an effect that only acts in motion. The
        rests of the calibration differ from those of the recording, so that a share of the whole
        effect is added. Zero-g and scale factor that the baseline does not hold were not
        calibrated, and took up nothing.

        columns: other columns of each channel by numbers below `count`; returns: by coefficient of
        zero-g or scale factor: the standard deviation of its part in one unit of each other
        column, in its own unit, (count,).
        """
        parts: dict[Coefficient, np.ndarray] = {}
        for lines, others in zip(self._straight_lines, columns):
            if not lines.names or not others:
                continue
            by_line = lines.parts(np.array([*others.values()]))
            for name, part in zip(lines.names, by_line):
                largest = parts.setdefault(name, np.zeros(count))
                largest[list(others)] = np.maximum(largest[list(others)], part)
        return parts

    @cached_property
    def _straight_lines(self) -> list[_StraightLines]:
        """Zero-g and scale factor that the baseline holds, by channel."""
        every = []
        for nuisances, (comparison, _) in zip(self.nuisance_columns, self.places):
            names = [
                name
                for name in nuisances
                if hints_of(name).straight_line and name.effect in self.baseline.effects
            ]
            values = np.reshape([nuisances[name] for name in names], (-1, len(comparison)))
            rests = comparison.at_rest & comparison.used
            every.append(_StraightLines(names, values, rests if rests.any() else ~rests))
        return every

    def fit_variants(self, chosen: Sequence[int], start: LinearFit | None = None) -> LinearFit:
        """Fit a set of variants on the sensitivities at the baseline."""
        effects = {self.variants[i].effect for i in chosen}
        ids = {k for k in self.nuisance_ids if self.names[k].effect not in effects}.union(
            *(self.column_ids[i] for i in chosen)
        )
        return evidence.fit_columns(
            self.channels,
            ids,
            self.prior(chosen),
            None,
            start,
            drifts_among(self.baseline.effects),
        )


def with_filters(
    linear_model: LinearModel,
    linearised: LinearisedHypothesis,
    filters: Sequence[Sequence[Whitener]],
) -> LinearisedHypothesis:
    """Return a linearised hypothesis, whitened by the filters of each channel."""
    channels = []
    for number, (columns, of_channel) in enumerate(zip(linearised.columns, filters)):
        known = linear_model.white_nuisances(number, columns.nuisances, of_channel)
        used = linear_model.places[number].comparison.used
        channels.append(
            evidence.whiten_channel(columns.own, columns.places, used, of_channel, also=known)
        )
    return replace(linearised, channels=channels, filters=filters)


def channels_of(comparisons: Sequence[BaselineComparison]) -> list[Channel]:
    """Return the channels of recordings."""
    channels = []
    for comparison in comparisons:
        channels += [Channel(comparison, axis) for axis in range(len(comparison.sensor.axes))]
    return channels


def calibration_takes_up(effect: str) -> bool:
    """
    Determine whether a calibration can take a part of an effect for zero-g or scale factor.

    Of one that zero-g and scale factor imitate completely, a calibration leaves nothing. Errors
    of the reference are not in a calibration without it.
    """
    described = effect_named(effect)
    return not described.diagnosis.absorbed and described.concern is not Concern.REFERENCE


def build_linear_model(
    comparisons: Sequence[BaselineComparison],
    show_progress: Callable[[float], None] = lambda fraction: None,
    only: Sequence[str] | None = None,
    filters: Sequence[list[Whitener]] = (),
    near: LinearModel | None = None,
) -> LinearModel:
    """
    Differentiate the baseline by the whole library, or by some effects, in all recordings.

    filters: whitening filters of each channel, where not all are tried; near: the linear model
    about a baseline nearby, whose sensitivities to all other effects are taken.
    """
    filters = filters or [whiteners(*channel) for channel in channels_of(comparisons)]
    baseline_v = [c.simulated_v(c.sensor) for c in comparisons]
    table, effects = _ColumnTable(comparisons), _tried_effects(comparisons, only)
    by_key = _variants_by_key(comparisons, baseline_v, effects, show_progress)
    if near is not None:
        tried = {effect.name for effect in effects}
        by_key |= {key: known for key, known in near.by_key.items() if key[0] not in tried}
    for by_recording in by_key.values():
        table.add(by_recording)
    channels = _whitened(comparisons, table.channels, filters)
    show_progress(1.0)
    return LinearModel(
        comparisons=list(comparisons),
        baseline_v=baseline_v,
        variants=table.variants,
        column_ids=table.ids,
        names=table.names,
        prior_std=table.prior_std(),
        channels=channels,
        filters=list(filters),
        columns=table.channels,
        by_key=by_key,
    )


def _tried_effects(
    comparisons: Sequence[BaselineComparison], only: Sequence[str] | None
) -> list[Effect]:
    """Return the effects by which a baseline is differentiated; the nuisances are among them."""
    fades = any(c.fading_hz is not None for c in comparisons)

    def is_asked_for(effect: Effect) -> bool:
        return only is None or effect.name in only or effect.diagnosis.nuisance

    def would_fit_lost_motion(effect: Effect) -> bool:
        """Whether an effect would be found in the fast motion that a smooth reference lacks."""
        shows_in_fast_motion = effect.diagnosis.revealed_by is base.Manoeuvre.SHAKE
        return (
            fades
            and shows_in_fast_motion
            and not effect.exact
            and effect.concern is not Concern.REFERENCE
        )

    return [e for e in candidates() if is_asked_for(e) and not would_fit_lost_motion(e)]


def _variants_by_key(
    comparisons: Sequence[BaselineComparison],
    baseline_v: Sequence[np.ndarray],
    effects: Sequence[Effect],
    show_progress: Callable[[float], None],
) -> dict[tuple, dict[int, Variant]]:
    """Return each variant by its key, in all recordings that show it, by their numbers."""
    every: dict[tuple, dict[int, Variant]] = {}
    for i, (comparison, output_v) in enumerate(zip(comparisons, baseline_v)):
        for k, effect in enumerate(effects):
            for variant in variants(comparison, effect, output_v):
                every.setdefault(variant.key, {})[i] = variant
            done = (i + (k + 1) / len(effects)) / len(comparisons)
            show_progress(_SIMULATED_SHARE * done)
    return every


class _ColumnTable:
    """The columns of all variants, numbered over all recordings."""

    def __init__(self, comparisons: Sequence[BaselineComparison]) -> None:
        self.names: list[Coefficient] = []  # Coefficient of each column
        self.variants: list[Variant] = []
        self.ids: list[list[int]] = []  # Numbers of the columns of each variant
        # By recording and axis: sensitivities by number of the column, V per unit, (n,)
        self._columns: list[list[dict[int, np.ndarray]]] = [
            [{} for _ in c.sensor.axes] for c in comparisons
        ]

    def add(self, by_recording: dict[int, Variant]) -> None:
        """Add one variant in the recordings that show it."""
        own = dict.fromkeys(chain(*(v.names for v in by_recording.values())))
        numbers = {name: len(self.names) + i for i, name in enumerate(own)}
        self.names += own
        for i, variant in by_recording.items():
            for of_channel, of_axis in zip(self._columns[i], variant.columns):
                of_channel |= {numbers[name]: values for name, values in of_axis.items()}
        first = next(iter(by_recording.values()))
        self.variants.append(replace(first, names=tuple(own)))
        self.ids.append(list(numbers.values()))

    @property
    def channels(self) -> list[dict[int, np.ndarray]]:
        """Return the sensitivities of each channel by number of the column, V per unit, (n,)."""
        return list(chain(*self._columns))

    def prior_std(self) -> np.ndarray:
        """Return the prior standard deviation of each column's coefficient."""
        stds: list[float] = []
        for variant in self.variants:
            # The columns of a limit are the change by its first value.
            stds += [
                1.0 if variant.limit_start else PRIOR_WIDTH * parameter_of(name).scale
                for name in variant.names
            ]
        return np.array(stds)


def _whitened(
    comparisons: Sequence[BaselineComparison],
    columns: Sequence[Mapping[int, np.ndarray]],
    filters: Sequence[list[Whitener]],
) -> list[evidence.WhitenedChannel]:
    """Whiten residual and columns of each channel for noise that the baseline may have."""
    chosen = filters_for(filters, comparisons[0].sensor.effects)
    residuals_v = [c.residual_v(c.sensor).T for c in comparisons]
    return [
        evidence.whiten_channel(
            np.array([residual_v, *own.values()]).T,
            np.array([*own]),
            channel.comparison.used,
            of_filters,
            False,
        )
        for residual_v, own, channel, of_filters in zip(
            chain(*residuals_v), columns, channels_of(comparisons), chosen
        )
    ]


def filters_for(filters: Sequence[list[Whitener]], effects: Sequence[str]) -> list[list[Whitener]]:
    """Return for each channel the filters of healthy units and of the drifts among effects."""
    drifts = drifts_among(effects)
    return [[f for f in every if f.healthy or f.effect in drifts] or every for every in filters]


@dataclass(frozen=True)
class _StraightLines:
    """Sensitivities of one channel to zero-g and scale factor, l straight lines over the force."""

    names: list[Coefficient]  # (l,)
    values: np.ndarray  # (l, n)
    rows: np.ndarray  # Samples at rest, or all, (n,) bool

    @cached_property
    def _inverses(self) -> list[np.ndarray]:
        """Return what fits the lines to a column at rest, (rests, l), and to all of it, (n, l)."""
        both = self.values[:, self.rows], self.values
        return [np.linalg.pinv(v, np.finfo(float).eps * v.shape[1]) for v in both]

    def parts(self, others: np.ndarray) -> list[np.ndarray]:
        """Return how much of k columns, (k, n), a calibration can take for each line, (k,)."""
        rests, (by_rests, by_all) = others[:, self.rows], self._inverses
        rms_of_rests = np.sqrt(np.mean(rests**2, axis=1))
        in_all = others @ by_all
        # A calibration with an effect that is a straight line would have left nothing of it.
        bent = (others - in_all @ self.values).std(axis=1) > SMALLEST_BENT_SHARE * np.sqrt(
            np.mean(others**2, axis=1)
        )
        largest, parts = np.abs(others).max(axis=1), []
        for line, at_rests, over_all in zip(self.values, (rests @ by_rests).T, in_all.T):
            size = max(rms(line), np.finfo(float).tiny)
            # The poses of a calibration may reach further than the rests of the recording.
            reach = largest / np.abs(line).max() if np.ptp(line) else 0.0
            beyond_rests = np.minimum(np.maximum(np.abs(over_all), reach), 2 * rms_of_rests / size)
            straight = np.maximum(np.abs(at_rests), beyond_rests)
            parts.append(bent * np.hypot(straight, _OTHER_RESTS_SHARE * rms_of_rests / size))
        return parts
