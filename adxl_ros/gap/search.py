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
The search: every effect alone, pairs and triples, by evidence on tangents and then in full.

Tangents serve to look at hundreds of hypotheses within a second; the best are fitted by
re-simulation, shapes included, because a delay of 7 ms under a 40 Hz shaker is no longer linear.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

from adxl_ros.errors import UserError
from adxl_ros.gap import evidence, whiten
from adxl_ros.gap.evidence import Channel, Fit
from adxl_ros.gap.series import Series
from adxl_ros.gap.tangents import candidates, Variant, variants, WIDE
from adxl_ros.model.coefficients import get, names_of, parameter_of, put, with_neutral
from adxl_ros.model.effects import effect_named
from adxl_ros.model.sensor import Sensor
import numpy as np

NUISANCES = ('bias', 'scale_factor')
STABLE = {'bias': 5e-4, 'scale_factor': 5e-4}
"""Zero-g, g, and scale factor, relative, of a healthy unit from day to day, beside the file's
covariance."""
MOST_EFFECTS = 3
_REFINED, _PAIRED = 8, 8
_STEPS = 5
_WORTH = 5.0
"""Nats that a hypothesis must gain on tangents to be fitted in full."""
_CHANGED = 1e-3


@dataclass(frozen=True)
class Hypothesis:
    """
    A set of effects after its fit.

    Attributes
    ----------
    effects
        Names; none for no gap.
    sensor
        The baseline with the effects and its nuisances as fitted.
    names, values, std
        Fitted coefficients of the effects, as departures from the baseline.
    log_evidence
        Nats.
    fit
        The last linear step.
    refined
        Whether it was fitted by re-simulation.

    """

    effects: tuple[str, ...]
    sensor: Sensor
    names: tuple[str, ...]
    values: np.ndarray
    std: np.ndarray
    log_evidence: float
    fit: Fit
    refined: bool


@dataclass(frozen=True)
class Study:
    """
    Recordings of one unit, and the tangents at its baseline.

    Attributes
    ----------
    series, used
        Recordings, and the samples of each that count.
    variants, ids
        Of the library, and the numbers of their columns.
    names, prior
        Of all columns.
    channels
        Whitened residuals and columns at the baseline.

    """

    series: list[Series]
    used: list[np.ndarray]
    variants: list[Variant]
    ids: list[list[int]]
    names: list[str]
    prior: np.ndarray
    channels: list[Channel]
    filters: list[list[whiten.Whitener]] = field(default_factory=list)

    def nuisances(self) -> list[int]:
        """Return the numbers of the columns of zero-g and scale factor."""
        return [i for v, of in zip(self.variants, self.ids) if v.effect in NUISANCES for i in of]

    def priors(self, chosen: Iterable[str]) -> np.ndarray:
        """Return prior deviations where zero-g and scale are only free if they are candidates."""
        prior = self.prior.copy()
        sensor = self.series[0].sensor
        for i in self.nuisances():
            if self.names[i].split('.')[0] not in chosen:
                prior[i] = stability(sensor, self.names[i])
        return prior


def stability(sensor: Sensor, name: str) -> float:
    """Return how far zero-g or scale may be from the file's, V or V/g: covariance and age."""
    effect, _, axis = name.split('.')
    scale = float(sensor.scale_v_per_g[sensor.axes.index(axis)])
    known = 0.0
    if name in sensor.covariance_names:
        i = sensor.covariance_names.index(name)
        known = float(sensor.covariance[i, i])
    return float(np.hypot(STABLE[effect] * scale, np.sqrt(known)))


def study(series: Sequence[Series], used: Sequence[np.ndarray],
          show: Callable[[float], None]) -> Study:
    """
    Differentiate the baseline by the whole library in all recordings.

    Parameters
    ----------
    series
        Of one unit, with one baseline.
    used
        Samples that count, (n,) by recording.
    show
        Takes the fraction that is done.

    """
    every: dict[tuple, dict[int, Variant]] = {}
    effects = candidates(series[0].sensor)
    for i, one in enumerate(series):
        base = one.simulated(one.sensor)
        for k, effect in enumerate(effects):
            for found in variants(one, effect, base):
                key = (found.effect, tuple(found.shape.items()), found.size)
                every.setdefault(key, {})[i] = found
            show((i + (k + 1) / len(effects)) / len(series))
    names: list[str] = []
    prior: list[float] = []
    kept, ids = [], []
    columns: list[list[list[tuple[int, np.ndarray]]]] = [
        [[] for _ in one.sensor.axes] for one in series]
    for of in every.values():
        first = next(iter(of.values()))
        number: dict[str, int] = {}
        for i, found in of.items():
            for name, sd in zip(found.names, found.prior):
                if name not in number:
                    number[name] = len(names)
                    names.append(name)
                    prior.append(float(sd))
            for d, (at, values) in enumerate(found.columns):
                columns[i][d] += [(number[found.names[j]], values[:, c])
                                  for c, j in enumerate(at)]
        kept.append(replace(first, names=tuple(number), prior=np.array(
            [prior[j] for j in number.values()])))
        ids.append(list(number.values()))
    channels, filters = [], []
    for one, mask, of_series in zip(series, used, columns):
        residual = one.volts - one.simulated(one.sensor)
        for d, of_axis in enumerate(of_series):
            filters.append(whiten.whiteners(one, d))
            channels.append(evidence.channel(
                residual[:, d], np.column_stack([c for _, c in of_axis]),
                np.array([i for i, _ in of_axis]), mask, filters[-1]))
    return Study(list(series), list(used), kept, ids, names, np.array(prior), channels, filters)


def on_tangents(of: Study, chosen: Sequence[int], start: Fit | None = None) -> Fit:
    """Fit a set of variants, by number, on the tangents at the baseline."""
    effects = [of.variants[i].effect for i in chosen]
    ids = set(of.nuisances()).union(*(of.ids[i] for i in chosen))
    return evidence.fit(of.channels, sorted(ids), of.priors(effects), start=start)


def refined(of: Study, effects: Sequence[str], start: dict[str, float],
            shapes: dict[str, float], blocks: np.ndarray | None = None) -> Hypothesis:
    """
    Fit a set of effects by re-simulation, parameters of shape included.

    Gauss-Newton: simulate and differentiate at the present values, whiten, fit, until the
    evidence no longer gains; a step that loses is halved.

    Parameters
    ----------
    of
        The recordings.
    effects
        Their names.
    start
        Departures from the baseline to begin with, by coefficient.
    shapes
        Parameters of shape to begin with, by `effect.parameter`.
    blocks
        Which blocks count, all unless given.

    """
    baseline = of.series[0].sensor
    effects = tuple(dict.fromkeys(effects))
    held = with_neutral(baseline, (*effects, *NUISANCES))
    names, prior, middle, begin = [], [], [], []
    for effect in dict.fromkeys((*effects, *NUISANCES)):
        for name in names_of(effect_named(effect), held.axes):
            p = parameter_of(name)
            if not p.shape and name not in of.names:
                continue
            names.append(name)
            if p.shape:
                middle.append(p.scale)
                short = '.'.join(name.split('.')[:2])
                begin.append(shapes.get(short, start.get(name, 0.0) + p.scale))
            else:
                middle.append(float(get(held, [name])[0]))
                begin.append(middle[-1] + start.get(name, 0.0))
            prior.append(stability(baseline, name) if effect in NUISANCES
                         and effect not in effects else p.scale * (1 if p.shape else WIDE))
    lower, upper = (np.array([getattr(parameter_of(n), side) for n in names])
                    for side in ('lower', 'upper'))
    at_neutral, values = np.array(middle), np.clip(np.array(begin), lower, upper)
    best: tuple[float, np.ndarray, Fit] | None = None
    step = np.zeros(len(names))
    for _ in range(_STEPS):
        found, there = _linearised(of, held, names, values, at_neutral, np.array(prior), blocks)
        if best is not None and there < best[0] - _CHANGED:
            step = step / 2
            values = np.clip(best[1] + step, lower, upper)
            continue
        done = best is not None and there - best[0] < 0.05
        best = (there, values, found)
        step = at_neutral + found.values - values
        if done or np.all(np.abs(step) < _CHANGED * np.array(prior)):
            break
        values = np.clip(values + step, lower, upper)
    assert best is not None
    own = [i for i, n in enumerate(names) if n.split('.')[0] in effects]
    fitted = put(held, names, best[1])
    return Hypothesis(effects, fitted, tuple(names[i] for i in own),
                      (best[1] - at_neutral)[own],
                      np.sqrt(np.diag(best[2].covariance))[own], best[0], best[2], True)


def _linearised(of: Study, held: Sensor, names: Sequence[str], values: np.ndarray,
                middle: np.ndarray, prior: np.ndarray, blocks: np.ndarray | None
                ) -> tuple[Fit, float]:
    """Fit around values; return the fit and the log-evidence at the values themselves."""
    sensor = put(held, names, values)
    channels = []
    k = 0
    for one, mask in zip(of.series, of.used):
        there = one.simulated(replace(sensor, rate_hz=one.sensor.rate_hz))
        columns = _columns(one, replace(sensor, rate_hz=one.sensor.rate_hz), names, values, there)
        for d in range(len(held.axes)):
            at = [i for i, n in enumerate(names)
                  if len(n.split('.')) == 2 or held.axes.index(n.split('.')[2]) == d]
            design = columns[:, d, at]
            residual = one.volts[:, d] - there[:, d] + design @ (values - middle)[at]
            channels.append(evidence.channel(residual, design, np.array(at), mask,
                                             of.filters[k]))
            k += 1
    found = evidence.fit(channels, range(len(names)), prior, blocks)
    return found, found.log_evidence - evidence.lost(channels, found, values - middle, prior,
                                                     blocks)


def _columns(series: Series, sensor: Sensor, names: Sequence[str], values: np.ndarray,
             there: np.ndarray) -> np.ndarray:
    """Differentiate volts by coefficients at their values, (n, m, p); all axes at once."""
    out = np.zeros((*there.shape, len(names)))
    groups: dict[str, list[int]] = {}
    for i, name in enumerate(names):
        groups.setdefault('.'.join(name.split('.')[:2]), []).append(i)
    for of in groups.values():
        p = parameter_of(names[of[0]])
        by = p.scale * (0.02 if effect_named(names[of[0]].split('.')[0]).smooth else 0.3)
        if values[of[0]] + by > p.upper:
            by = -by
        moved = series.simulated(put(sensor, [names[i] for i in of], values[of] + by))
        for i in of:
            parts = names[i].split('.')
            axes = [sensor.axes.index(parts[2])] if len(parts) == 3 else range(len(sensor.axes))
            for d in axes:
                out[:, d, i] = (moved[:, d] - there[:, d]) / by
    return out


def search(of: Study, show: Callable[[float], None]) -> list[Hypothesis]:
    """
    Look at every effect, at pairs and at triples; the most probable first.

    Pairs are looked for around the best effect, where what it leaves is straight, and among the
    best of all effects, because two can mask each other.

    Parameters
    ----------
    of
        The recordings and their tangents.
    show
        Takes the fraction that is done.

    """
    none = on_tangents(of, [])
    empty = Hypothesis((), of.series[0].sensor, (), np.zeros(0), np.zeros(0), none.log_evidence,
                       none, True)
    found: dict[tuple[str, ...], Hypothesis] = {(): empty}
    singles = _ranked(of, [(i,) for i in range(len(of.variants))], none)
    _refine(of, singles[:_REFINED], none.log_evidence, found)
    show(0.3)
    best = max(found.values(), key=lambda h: h.log_evidence)
    if best.effects:
        _forward(of, best, found)
        show(0.6)
        first = [chosen[0] for _, chosen, _ in singles[:_PAIRED]]
        pairs = _ranked(of, list(combinations(sorted(first), 2)), none)
        best = max(found.values(), key=lambda h: h.log_evidence)
        worth = best.log_evidence - none.log_evidence + _WORTH
        _refine(of, [one for one in pairs if one[0] > worth][:_REFINED // 2],
                none.log_evidence, found)
        best = max(found.values(), key=lambda h: h.log_evidence)
        if 1 < len(best.effects) < MOST_EFFECTS:
            _forward(of, best, found)
    show(1.0)
    return sorted(found.values(), key=lambda h: -h.log_evidence)


def around(of: Study, best: Hypothesis) -> Study:
    """Return the study about a hypothesis: residuals and tangents at its fit."""
    there = [replace(one, sensor=replace(best.sensor, rate_hz=one.sensor.rate_hz))
             for one in of.series]
    return study(there, of.used, lambda done: None)


def _forward(of: Study, best: Hypothesis, found: dict[tuple[str, ...], Hypothesis]) -> None:
    """Add one effect more to a hypothesis: on tangents about it, then in full."""
    there = around(of, best)
    own = [i for i, v in enumerate(there.variants) if v.effect in best.effects]
    alone = on_tangents(there, own)
    gains = []
    for i, more in enumerate(there.variants):
        if more.effect in best.effects or more.effect in NUISANCES:
            continue
        fit = on_tangents(there, [*own, i], alone)
        gains.append((fit.log_evidence - alone.log_evidence, i, fit))
    base = {v.effect: k for k, v in enumerate(of.variants)}
    for gain, i, fit in sorted(gains, key=lambda one: -one[0])[:_REFINED // 2]:
        if gain < _WORTH:
            break
        effects = (*best.effects, there.variants[i].effect)
        if not all(e in base for e in effects):
            continue
        start = dict(zip(best.names, best.values))
        start |= {there.names[k]: v for k, v in zip(fit.ids, fit.values)
                  if k in there.ids[i]}
        shape = {f'{there.variants[i].effect}.{p}': v
                 for p, v in there.variants[i].shape.items()}
        one = _resimulated(of, effects, start, shape)
        if one is not None:
            found[one.effects] = one


def _ranked(of: Study, sets: Sequence[tuple[int, ...]], none: Fit
            ) -> list[tuple[float, tuple[int, ...], Fit]]:
    """Fit sets of variants on tangents; the best of each set of effects, the best first."""
    best: dict[frozenset[str], tuple[float, tuple[int, ...], Fit]] = {}
    for chosen in sets:
        key = frozenset(of.variants[i].effect for i in chosen)
        if len(key) < len(chosen):
            continue
        found = on_tangents(of, chosen, none)
        gain = found.log_evidence - none.log_evidence
        if key not in best or gain > best[key][0]:
            best[key] = (gain, chosen, found)
    return sorted(best.values(), key=lambda one: -one[0])


def _refine(of: Study, ranked: Iterable[tuple[float, tuple[int, ...], Fit]], none: float,
            found: dict[tuple[str, ...], Hypothesis]) -> None:
    """Fit the best on tangents in full; those that gain less than is worth it are left."""
    for gain, chosen, fit in ranked:
        if gain < _WORTH:
            continue
        start = dict(zip([of.names[i] for i in fit.ids], fit.values))
        shapes = {f'{of.variants[i].effect}.{p}': value for i in chosen
                  for p, value in of.variants[i].shape.items()}
        one = _resimulated(of, [of.variants[i].effect for i in chosen], start, shapes)
        if one is not None and one.log_evidence > none:
            found[one.effects] = one


def _resimulated(of: Study, effects: Sequence[str], start: dict[str, float],
                 shapes: dict[str, float]) -> Hypothesis | None:
    try:
        return refined(of, effects, start, shapes)
    except (UserError, np.linalg.LinAlgError):
        return None
