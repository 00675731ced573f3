# SPDX-License-Identifier: Apache-2.0

"""Sensitivities: how the simulated output changes with each parameter of the library."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import NamedTuple

from adxl_ros.errors import UserError
from adxl_ros.model.coefficients import names_of, parameter_of, put, with_neutral
from adxl_ros.model.diagnosis_hints import StraightLine
from adxl_ros.model.effects import effect_named, library
from adxl_ros.model.effects.base import ActsOn, Coefficient, Effect, Parameter, Role
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
