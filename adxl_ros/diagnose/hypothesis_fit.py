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

"""A hypothesis about values of its coefficients: differentiated there, fitted, simulated again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from adxl_ros.diagnose import evidence
from adxl_ros.diagnose.baseline_comparison import Series
from adxl_ros.diagnose.evidence import Channel, Fit
from adxl_ros.diagnose.linear_model import BEYOND, of_sensor, STRAIGHT, straight, Study
from adxl_ros.diagnose.noise_whitening import drifts_among, flicker_g_per_rthz, near
from adxl_ros.diagnose.sensitivities import limits, WIDE
from adxl_ros.model.coefficients import fitted_of, get, parameter_of, put, with_neutral
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Coefficient, Role
from adxl_ros.model.sensor import Sensor
import numpy as np

_STEPS = {True: 10, False: 5}
"""Of smooth effects, and of others, whose slopes are those of a wide step and never quite true."""
_HALVED = 2
_CHANGED = 1e-3
_FORM = 0.03
"""No form but geometry's is quite the sensor's: a coefficient is not known better than this."""
_ELSEWHERE = 3.0
"""By how much less sure of a coefficient some blocks are than all, that others determine it."""
_GAINS, _SHARE = 0.05, 1e-4
"""A step that gains less, in nats, is the last; one that would, or less than this of what all have
gained, is not made."""


@dataclass(frozen=True)
class Hypothesis:
    """
    A set of effects after its fit.

    Attributes
    ----------
    effects
        Names; none for no gap.
    sensor
        The baseline with the effects, and all that is free in every hypothesis, as fitted.
    names, values, std
        Fitted coefficients of the effects, as departures from the baseline.
    log_evidence
        Nats.
    fit
        The last linear step.

    """

    effects: tuple[str, ...]
    sensor: Sensor
    names: tuple[Coefficient, ...]
    values: np.ndarray
    std: np.ndarray
    log_evidence: float
    fit: Fit


@dataclass(frozen=True)
class Local:
    """
    A hypothesis differentiated about values of its coefficients.

    What is free in every hypothesis is differentiated at the baseline: it stays near it.

    Attributes
    ----------
    effects
        Names.
    sensor
        At the values.
    names
        Coefficients, those of the effects first, (k,).
    middle, prior
        Mean and standard deviation beforehand, (k,).
    values
        Of the coefficients of the effects, (j,).
    channels
        Whitened: residuals as at the mean beforehand, and columns.

    """

    effects: tuple[str, ...]
    sensor: Sensor
    names: tuple[Coefficient, ...]
    middle: np.ndarray
    prior: np.ndarray
    values: np.ndarray
    channels: list[Channel]

    def fit(self, blocks: np.ndarray | None = None, wanders: Sequence[str] = ()) -> Fit:
        """Fit all coefficients to some blocks, all unless given, (b,)."""
        return evidence.fit(self.channels, range(len(self.names)), self.prior, self.most, blocks,
                            wanders=(*wanders, *drifts_among(self.sensor.effects)))

    @property
    def most(self) -> np.ndarray:
        """How large coefficients may be: a healthy unit stays within its tolerance, (k,)."""
        own = np.arange(len(self.names)) < len(self.values)
        return np.where(own, np.inf, BEYOND * self.prior)

    def fitted(self, found: Fit, moved: bool = True, whole: Fit | None = None) -> Sensor:
        """
        Return the sensor after a fit, within bounds; the effects as they are if not moved.

        What is free beside them is then at its posterior mean given them: they may differ much
        from the fit's along what zero-g and scale factor can take up. `whole` is a fit to all
        blocks, see `moved`.
        """
        if moved:
            values = self.moved(found, whole)
        else:
            own = np.arange(len(self.values))
            values = np.clip(evidence.given(found, own, self.values - self.middle[own]),
                             -self.most, self.most)
        return put(self.sensor, self.names, _within(self.names, self.middle + values))

    def moved(self, found: Fit, whole: Fit | None = None) -> np.ndarray:
        """
        Return departures from the mean beforehand after a fit, (k,).

        A limit or a shape that the samples do not determine stays, for its mean beforehand is
        nowhere in particular, and so does one that only other blocks than those of the fit do:
        where they alone clip, the others tell nothing of it. One that is determined moves by half
        or double at most.
        """
        own = slice(len(self.values))
        of = [parameter_of(name) for name in self.names[own]]
        spread = np.sqrt(np.diag(found.covariance)[own])
        lost = spread > self.prior[own] / 2
        if whole is not None:
            lost |= spread > _ELSEWHERE * np.sqrt(np.diag(whole.covariance)[own])
        there = self.middle[own] + found.values[own]
        there = np.where(lost & ~np.array([p.is_size for p in of], bool), self.values, there)
        near = np.where([p.role is Role.SHAPE for p in of], np.clip(
            there, *np.sort([self.values / 2, self.values * 2], axis=0)), there)
        held = np.flatnonzero(near != self.middle[own] + found.values[own])
        return evidence.given(found, held, near[held] - self.middle[held])

    def log_evidence(self, found: Fit) -> float:
        """Return the log-evidence at the values themselves, nats."""
        return found.log_evidence - evidence.lost(
            self.channels, found, self.values - self.middle[:len(self.values)], self.prior)


def local(of: Study, effects: Sequence[str], sensor: Sensor,
          beside: Sequence[np.ndarray] = (), noise: Sequence[int] | None = None) -> Local:
    """
    Differentiate the effects of a hypothesis about a sensor.

    Parameters
    ----------
    of
        The recordings.
    effects
        Names.
    sensor
        Has them; its coefficients are the values.
    beside
        More columns by recording, (n, j), V a unit, each axis with coefficients of its own: they
        are numbered on, axis by axis.
    noise
        Numbers of the filters about which the noise of each channel is, where it is known.

    """
    held = with_neutral(of.series[0].sensor, effects)
    own = [name for effect in effects for name in fitted_of(effect_named(effect), held.axes)
           if not parameter_of(name).is_size or name in of.names or limits(effect_named(effect))]
    free = [n for n in dict.fromkeys(n for names in of.free for n in names)
            if n.effect not in effects]
    held = with_neutral(held, dict.fromkeys(n.effect for n in free))
    parameters = [parameter_of(name) for name in own]
    middle = np.array([float(get(held, [name])[0]) if p.is_size else p.scale
                       for name, p in zip(own, parameters)])
    values = get(sensor, own)
    sensor = put(held, own, values)
    prior = [p.scale * (WIDE if p.is_size else 1) for p in parameters]
    names = [*own, *free]
    channels: list[Channel] = []
    lines: list[dict[int, np.ndarray]] = []
    does: list[list[tuple[int, np.ndarray]]] = []
    count = len(names)
    for number, (one, mask) in enumerate(zip(of.series, of.used)):
        more = beside[number] if beside else np.zeros((len(one), 0))
        at_rate = replace(sensor, rate_hz=one.sensor.rate_hz)
        there = one.simulated(at_rate)
        columns = columns_at(one, at_rate, own, values, there)
        taken_up = there - _else(of, number, at_rate, held, effects)
        for d in range(len(held.axes)):
            at = [i for i, n in enumerate(own)
                  if n.axis in ('', held.axes[d])]
            known = of.free[len(channels)]
            also = [n for n in free if n in known]
            lines.append({names.index(n): column for n, column in known.items()
                          if n.effect in STRAIGHT})
            does.append([(0, taken_up[:, d])])
            design = columns[:, d, at]
            residual = one.volts[:, d] - there[:, d] + design @ (values - middle)[at]
            tried = of.filters[len(channels)]
            channels.append(evidence.channel(
                residual, np.column_stack([design, *(known[n] for n in also), more]),
                np.array([*at, *(names.index(n) for n in also),
                          *range(count, count + more.shape[1])], int), mask,
                tried if noise is None else near(tried, noise[len(channels)])))
            count += more.shape[1]
    looks = straight(lines, does, 1)
    drifts = drifts_among(effects)
    prior += [float(np.hypot(of.tolerance(n, drifts), looks[i][0] if i in looks else 0.0))
              for i, n in enumerate(free, len(own))]
    return Local(tuple(effects), sensor, tuple(names), np.concatenate([middle, get(held, free)]),
                 np.array(prior), values, channels)


def _else(of: Study, number: int, sensor: Sensor, baseline: Sensor,
          effects: Sequence[str]) -> np.ndarray:
    """Simulate a recording with those effects alone that no calibration takes up, V, (n, m)."""
    own = [effect for effect in effects if of_sensor(effect)]
    if len(own) == len(effects):
        return of.base[number]
    values = {**sensor.values, **{effect: baseline.values[effect] for effect in own}}
    return of.series[number].simulated(replace(sensor, values=values))


def refined(of: Study, effects: Sequence[str], start: dict[Coefficient, float],
            shapes: dict[Coefficient, float]) -> Hypothesis:
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
        Parameters of shape to begin with, by name without axis.

    """
    effects = tuple(dict.fromkeys(effects))
    sensor = with_neutral(of.series[0].sensor, effects)
    names = [n for effect in effects for n in fitted_of(effect_named(effect), sensor.axes)]
    begin = []
    for name in names:
        p = parameter_of(name)
        middle = float(get(sensor, [name])[0]) if p.is_size else p.scale
        short = name.without_axis
        begin.append(shapes[short] if not p.is_size and short in shapes
                     else middle + start.get(name, 0.0))
    sensor = put(sensor, names, _within(names, np.array(begin)))
    best: tuple[float, Local, Fit] | None = None
    step, first, halved = np.zeros(0), 0.0, 0
    for _ in range(_STEPS[all(effect_named(effect).smooth for effect in effects)]):
        here = local(of, effects, sensor)
        found = here.fit()
        reached = here.log_evidence(found)
        first = reached if best is None else first
        own = slice(len(here.values))
        if best is not None and reached < best[0] - _CHANGED:
            step, halved = step / 2, halved + 1
            if halved > _HALVED:
                break
            sensor = put(sensor, here.names[own], _within(here.names[own],
                                                          best[1].values + step))
            continue
        done = best is not None and reached - best[0] < _GAINS
        best, halved = (reached, here, found), 0
        step = here.moved(found)[own] + here.middle[own] - here.values
        if done or found.log_evidence - reached < max(_GAINS, _SHARE * (reached - first)) \
                or np.all(np.abs(step) < _CHANGED * here.prior[own]):
            break
        sensor = put(sensor, here.names[own], _within(here.names[own], here.values + step))
    assert best is not None
    reached, here, found = best
    own = slice(len(here.values))
    fitted = here.fitted(found, False)
    for drift in drifts_among(effects):
        densities = np.zeros(len(fitted.axes))
        for d in range(len(densities)):
            whiten = of.filters[d][found.walks[d]]
            if whiten.drift == drift:
                densities[d] = whiten.density if drift == 'bias_walk' else flicker_g_per_rthz(
                    whiten, found.variance[d], of.series[0], d)
        fitted = replace(fitted, values={**fitted.values, drift: {
            effect_named(drift).parameters[0].name: densities}})
    return Hypothesis(effects, fitted, here.names[own],
                      here.values - here.middle[own],
                      np.sqrt(evidence.robust_std(here.channels, found, here.prior)[own] ** 2
                              + _of_stage(of, here.names[own]) ** 2
                              + _of_form(here, found) ** 2),
                      reached + _of_those_that_show(here, found), found)


def _of_stage(of: Study, names: Sequence[Coefficient]) -> np.ndarray:
    """Return standard deviations below which the stage's step tells no angle, (k,)."""
    return np.where([parameter_of(n).unit == 'rad' for n in names], of.least_angle_rad(), 0.0)


def _of_form(here: Local, found: Fit) -> np.ndarray:
    """Return standard deviations of coefficients by a form that is not quite true, (k,)."""
    names = here.names[:len(here.values)]
    whole = np.where([parameter_of(n).is_size for n in names], found.values[:len(names)],
                     here.values)
    return np.where([effect_named(n.effect).exact for n in names], 0.0, _FORM * whole)


def _of_those_that_show(here: Local, found: Fit) -> float:
    """
    Return what the log-evidence gains by what an effect need not be, nats.

    It may be smaller than usual, and need not act on all axes: each set of its coefficients is as
    likely beforehand as any other. What leaving one out gains is the ratio of its posterior and
    prior densities at nothing (Dickey 1971); they are left out one by one, at least one of an
    effect stays.
    """
    mean, covariance = found.values.copy(), found.covariance.copy()
    gain = 0.0
    for effect in here.effects:
        own = [i for i, name in enumerate(here.names[:len(here.values)])
               if name.effect == effect and parameter_of(name).is_size]
        if own:
            gain -= float(np.log(2.0 ** len(own) - 1))
        while len(own) > 1:
            spread = np.diag(covariance)[own]
            gains = 0.5 * (np.log(here.prior[own] ** 2 / spread) - mean[own] ** 2 / spread)
            if gains.max() <= 0:
                break
            gain += float(gains.max())
            j = own.pop(int(np.argmax(gains)))
            across = covariance[:, j] / covariance[j, j]
            mean = mean - across * mean[j]
            covariance = covariance - np.outer(across, covariance[j])
        if own:
            gain += evidence.of_any_size(mean[own], covariance[np.ix_(own, own)],
                                         here.prior[own])
    return gain


def _within(names: Sequence[Coefficient], values: np.ndarray) -> np.ndarray:
    lower, upper = (np.array([getattr(parameter_of(n), side) for n in names])
                    for side in ('lower', 'upper'))
    return np.clip(values, lower, upper)


def columns_at(series: Series, sensor: Sensor, names: Sequence[Coefficient], values: np.ndarray,
               there: np.ndarray) -> np.ndarray:
    """Differentiate volts by coefficients at their values, (n, m, p); all axes at once."""
    out = np.zeros((*there.shape, len(names)))
    groups: dict[Coefficient, list[int]] = {}
    for i, name in enumerate(names):
        groups.setdefault(name.without_axis, []).append(i)
    for of in groups.values():
        p = parameter_of(names[of[0]])
        by = p.scale * (0.3 if p.role is not Role.LIMIT and not effect_named(
            names[of[0]].effect).smooth else 0.02)
        if values[of[0]] + by > p.upper:
            by = -by
        moved = series.simulated(put(sensor, [names[i] for i in of], values[of] + by))
        for i in of:
            axis = names[i].axis
            axes = [sensor.axes.index(axis)] if axis else range(len(sensor.axes))
            for d in axes:
                out[:, d, i] = (moved[:, d] - there[:, d]) / by
    return out
