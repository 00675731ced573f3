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

"""How the simulated output follows each parameter of the library: the tangents of the search."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

from adxl_ros.diagnose.baseline_comparison import Series
from adxl_ros.errors import UserError
from adxl_ros.model.coefficients import names_of, parameter_of, put, with_neutral
from adxl_ros.model.effects import library
from adxl_ros.model.effects.base import ActsOn, Coefficient, Effect, Parameter, Role
from adxl_ros.model.sensor import Sensor
import numpy as np

WIDE = 5.0
"""Standard deviation of a coefficient beforehand, by its typical size: faults are not typical."""
_SHAPES = (0.2, 1.0, 5.0)
"""Shapes that are tried, by the typical one."""
_SMALL = 0.2
"""Step of a smooth parameter, by its typical size."""
_LARGE = (1.0, 4.0, 16.0)
"""Steps of one that is not: what a play of 1 mrad does tells little of one of 15."""
_CLIPPED = (0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.3)
"""Part of the samples that a limit clips where it is tried."""


@dataclass(frozen=True)
class Variant:
    """
    An effect with its shape held, and how the output follows its coefficients.

    Attributes
    ----------
    effect
        Its name.
    shape
        Values of the parameters of shape.
    size
        Step that it was differentiated by, in typical sizes.
    names, prior
        Coefficients and the standard deviation that they may have, (p,).
    columns
        By axis: numbers of the coefficients that it follows, and volts a unit, (n, of them).
    begin
        Where the fit of a limit begins, by coefficient; its columns are what that limit does.

    """

    effect: str
    shape: dict[str, float]
    size: float
    names: tuple[Coefficient, ...]
    prior: np.ndarray
    columns: tuple[tuple[np.ndarray, np.ndarray], ...]
    begin: dict[Coefficient, float] = field(default_factory=dict)


def candidates() -> list[Effect]:
    """Return the effects of the library that act on the mean and have tangents."""
    return [effect for effect in library().values() if effect.acts_on is ActsOn.MEAN]


def limits(effect: Effect) -> list[Parameter]:
    """Return the parameters that do nothing until the signal reaches them."""
    return [p for p in effect.parameters if p.role is Role.LIMIT]


def variants(series: Series, effect: Effect, base: np.ndarray) -> Iterator[Variant]:
    """
    Differentiate the simulated output by the parameters of an effect, shape by shape.

    One that has nothing to act on in this recording has no variant.
    """
    if limits(effect):
        if effect.name not in series.sensor.effects:
            yield from _limited(series, effect, limits(effect)[0], base)
        return
    # An effect that the sensor has keeps its shape; one with a shape is linear beside it.
    bends = not effect.smooth and not any(p.role is Role.SHAPE for p in effect.parameters)
    for shape in [{}] if effect.name in series.sensor.effects else shapes(effect):
        for size in _LARGE if bends else (_SMALL,):
            try:
                found = variant(series, effect, shape, size, base)
            except UserError:
                return
            if found is not None:
                yield found


def _limited(series: Series, effect: Effect, limit: Parameter, base: np.ndarray
             ) -> Iterator[Variant]:
    """Try a limit where it clips a small part of the samples, and more: one, or by axis."""
    axes = series.sensor.axes
    held = with_neutral(series.sensor, [effect.name])
    names = names_of(replace(effect, parameters=(limit,)), axes)
    # What else it has is no size until it clips.
    beside = {name: p.scale for p in effect.parameters if p.is_size
              for name in names_of(replace(effect, parameters=(p,)), axes)}
    g = np.abs(base - series.sensor.zero_g_v) / series.sensor.scale_v_per_g
    levels = [level for part in _CLIPPED for level in (
        np.quantile(g, 1 - part, axis=0), np.full(len(axes), np.quantile(g, 1 - part)))]
    for number, level in enumerate(levels):
        values = np.clip(level, limit.lower, limit.upper)
        does = series.simulated(put(held, names, values)) - base
        seen = [d for d in range(len(axes)) if np.any(np.abs(does[:, d]) > 1e-9)]
        if seen:
            yield Variant(effect.name, {}, float(number), tuple(names[d] for d in seen), np.ones(
                len(seen)), tuple((np.array([seen.index(d)] if d in seen else [], int),
                                   does[:, [d]] if d in seen else np.zeros((len(base), 0)))
                                  for d in range(len(axes))),
                          dict(zip(names, values)) | beside)


def shapes(effect: Effect) -> list[dict[str, float]]:
    """Return the shapes of an effect that are tried: each parameter of shape by a few factors."""
    of_shape = [p for p in effect.parameters if p.role is Role.SHAPE and not p.held]
    if not of_shape:
        return [{}]
    first, rest = of_shape[0], {p.name: p.scale for p in of_shape[1:]}
    values = [float(np.clip(first.scale * by, first.lower, first.upper)) for by in _SHAPES]
    return [{first.name: value, **rest} for value in dict.fromkeys(values)]


def variant(series: Series, effect: Effect, shape: dict[str, float], size: float,
            base: np.ndarray) -> Variant | None:
    """Differentiate by one effect's coefficients at one shape; None where nothing follows."""
    axes = series.sensor.axes
    held = _shaped(with_neutral(series.sensor, [effect.name]), effect, shape)
    names: list[Coefficient] = []
    prior: list[float] = []
    columns: list[list[tuple[int, np.ndarray]]] = [[] for _ in axes]
    start = base if not shape else series.simulated(held)
    for p in effect.parameters:
        if p.role is Role.SHAPE:
            continue
        step = p.scale * size
        if not p.lower <= np.max(values := np.asarray(held.values[effect.name][p.name])) + step \
                <= p.upper:
            step = (p.upper - float(np.max(values))) or -p.scale * size
        moved = (series.simulated(_stepped(held, effect.name, p, step)) - start) / step
        if series.reference == 'rest' and effect.name != 'bias':
            moved -= moved.mean(axis=0)
        own = names_of(replace(effect, parameters=(p,)), axes)
        for name in own:
            reach = [axes.index(name.axis)] if p.axes else range(len(axes))
            if not np.any(np.abs(moved[:, list(reach)]) * p.scale > 1e-9):
                continue
            for d in reach:
                columns[d].append((len(names), moved[:, d]))
            names.append(name)
            prior.append(WIDE * parameter_of(name).scale)
    if not names:
        return None
    return Variant(effect.name, shape, size, tuple(names), np.array(prior), tuple(
        (np.array([i for i, _ in of], int),
         np.column_stack([c for _, c in of]) if of else np.zeros((len(base), 0)))
        for of in columns))


def _shaped(sensor: Sensor, effect: Effect, shape: dict[str, float]) -> Sensor:
    values = {**sensor.values[effect.name]}
    for p in effect.parameters:
        if p.name in shape:
            values[p.name] = np.full(len(sensor.axes), shape[p.name]) if p.axes else \
                np.array(shape[p.name])
    return replace(sensor, values={**sensor.values, effect.name: values})


def _stepped(sensor: Sensor, effect: str, p: Parameter, step: float) -> Sensor:
    values = dict(sensor.values[effect])
    values[p.name] = np.asarray(values[p.name], float) + step
    return replace(sensor, values={**sensor.values, effect: values})
