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
Recordings of one unit beside the baseline, differentiated by the whole library.

Some coefficients are never exactly those of the file: zero-g and scale factor age, the resistor
and capacitor of the filter have tolerances, stamps have a latency. They are free in every
hypothesis, within what a healthy unit shows, so that they neither steal from an effect nor lend
to it, and are only named where they go beyond that. Whatever an effect of the sensor does in a
straight line, calibration has taken up, or not: zero-g and scale factor are as free as that beside
it. What stage and place do is no part of the sensor's figures: gravity that is not the stated one
is nothing but a straight line.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

from adxl_ros.diagnose import evidence, noise_whitening
from adxl_ros.diagnose.baseline_comparison import Series
from adxl_ros.diagnose.evidence import Channel, Fit
from adxl_ros.diagnose.sensitivities import candidates, Variant, variants
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Coefficient, Place
import numpy as np

TOLERANCE = {'bias': 1e-4, 'scale_factor': 1e-4, 'bandwidth': 0.02, 'time_offset': 1e-4}
"""What a healthy unit shows from day to day, beside the file's covariance, as standard deviations:
zero-g in g, scale factor, resistance of the filter, and latency of the stamps in s."""
STRAIGHT = ('bias', 'scale_factor')
"""Of these, what a straight line is made of."""
FOLLOWED = (*TOLERANCE, 'gravity')
"""What they take up whole, so that leaving it out leaves no more: gravity scales all axes."""
_DRIFTED_G = 0.02
BEYOND = 4.0
"""So many of these, and the unit is not healthy: it takes an effect."""


@dataclass(frozen=True)
class Study:
    """
    Recordings of one unit, and the tangents at its baseline.

    Attributes
    ----------
    series, used, base
        Recordings, the samples of each that count, and what the baseline says, V, (n, m).
    variants, ids
        Of the library, and the numbers of their columns.
    names, prior
        Of all columns.
    channels
        Whitened residuals and columns at the baseline.
    filters
        That whiten, by channel.
    free
        By channel: what is free in every hypothesis, and its columns, volts a unit, (n,).
    straight
        By coefficient of zero-g and scale factor: how much of it a unit of each column looks like,
        (all,).

    """

    series: list[Series]
    used: list[np.ndarray]
    base: list[np.ndarray]
    variants: list[Variant]
    ids: list[list[int]]
    names: list[Coefficient]
    prior: np.ndarray
    channels: list[Channel]
    filters: list[list[noise_whitening.Whitener]] = field(default_factory=list)
    free: list[dict[Coefficient, np.ndarray]] = field(default_factory=list)
    straight: dict[Coefficient, np.ndarray] = field(default_factory=dict)

    def nuisances(self) -> list[int]:
        """Return the numbers of the columns of what is free in every hypothesis."""
        return [i for v, of in zip(self.variants, self.ids) if v.effect in TOLERANCE for i in of]

    def least_angle_rad(self) -> float:
        """Return the standard deviation below which the stage's step tells no angle."""
        return max(one.sensor.stage_resolution_rad if one.reference == 'stage' else 0.0
                   for one in self.series) / 12 ** 0.5

    def priors(self, chosen: Sequence[int], drifts: Sequence[str] = ()
               ) -> tuple[np.ndarray, np.ndarray]:
        """
        Return prior deviations of all columns, and how large each may be.

        Only the chosen variants, by number, go beyond the tolerance of a healthy unit.
        """
        prior, most = self.prior.copy(), np.full(len(self.prior), np.inf)
        effects = {self.variants[i].effect for i in chosen}
        columns = [k for i in chosen if of_sensor(self.variants[i].effect) for k in self.ids[i]]
        for i in self.nuisances():
            name = self.names[i]
            if name.effect not in effects:
                looks = self.straight.get(name, np.zeros(len(prior)))[columns] * prior[columns]
                prior[i] = np.hypot(self.tolerance(name, drifts), np.sqrt(np.sum(looks ** 2)))
                # How large the chosen are is not known yet, nor is their straight part.
                most[i] = np.inf if np.any(looks) else BEYOND * prior[i]
        return prior, most

    def tolerance(self, name: Coefficient, drifts: Sequence[str] = ()) -> float:
        """
        Return how far a coefficient may be from the file's in a healthy unit.

        Where the sensor rests, its pose is not known, so that only changes of zero-g tell; where
        its zero-g drifts, it has done so before, too.
        """
        effect = name.effect
        if effect not in STRAIGHT:
            return TOLERANCE[effect]
        sensor = self.series[0].sensor
        scale = float(sensor.scale_v_per_g[sensor.axes.index(name.axis)])
        if effect == 'bias' and any(one.reference == 'rest' for one in self.series):
            return scale
        known = (_DRIFTED_G * scale) ** 2 if effect == 'bias' and drifts else 0.0
        if name in sensor.covariance_names:
            i = sensor.covariance_names.index(name)
            known += float(sensor.covariance[i, i])
        return float(np.hypot(TOLERANCE[effect] * scale, np.sqrt(known)))


def of_sensor(effect: str) -> bool:
    """Tell whether a calibration takes up what an effect does in a straight line."""
    return effect_named(effect).place not in (Place.STAGE, Place.FORCE)


def study(series: Sequence[Series], used: Sequence[np.ndarray],
          show: Callable[[float], None], noise: Sequence[int] | None = None,
          only: Sequence[str] | None = None) -> Study:
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
    noise
        Numbers of the filters about which the noise of each channel is, where it is known.
    only
        These effects and what is free, not the whole library.

    """
    every: dict[tuple, dict[int, Variant]] = {}
    effects = [e for e in candidates() if only is None or e.name in (*only, *TOLERANCE)]
    bases = [one.simulated(one.sensor) for one in series]
    for i, (one, base) in enumerate(zip(series, bases)):
        for k, effect in enumerate(effects):
            for found in variants(one, effect, base):
                key = (found.effect, tuple(found.shape.items()), found.size)
                every.setdefault(key, {})[i] = found
            show((i + (k + 1) / len(effects)) / len(series))
    names: list[Coefficient] = []
    prior: list[float] = []
    kept, ids = [], []
    columns: list[list[list[tuple[int, np.ndarray]]]] = [
        [[] for _ in one.sensor.axes] for one in series]
    for of in every.values():
        first = next(iter(of.values()))
        number: dict[Coefficient, int] = {}
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
    channels: list[Channel] = []
    filters: list[list[noise_whitening.Whitener]] = []
    for one, mask, of_series in zip(series, used, columns):
        residual = one.residual(one.sensor)
        for d, of_axis in enumerate(of_series):
            tried = noise_whitening.whiteners(one, d)
            filters.append(tried if noise is None else noise_whitening.near(
                tried, noise[len(filters)]))
            channels.append(evidence.channel(
                residual[:, d], np.column_stack([c for _, c in of_axis]),
                np.array([i for i, _ in of_axis]), mask, filters[-1]))
    free = [{names[i]: column for i, column in of_axis if names[i].effect in TOLERANCE}
            for of_series in columns for of_axis in of_series]
    looks = straight([{names.index(name): column for name, column in of.items()
                       if name.effect in STRAIGHT} for of in free],
                     [of_axis for of_series in columns for of_axis in of_series], len(names))
    return Study(list(series), list(used), bases, kept, ids, names, np.array(prior), channels,
                 filters, free, {names[i]: of for i, of in looks.items()})


def straight(lines: Sequence[dict[int, np.ndarray]],
             columns: Sequence[Sequence[tuple[int, np.ndarray]]], count: int
             ) -> dict[int, np.ndarray]:
    """
    Say how much of a straight line columns look like, by least squares.

    Parameters
    ----------
    lines
        By channel: number and column, (n,), of what makes the line.
    columns
        By channel: numbers, below `count`, and columns, (n,).
    count
        Of the columns.

    Returns
    -------
    dict
        By number of what makes the line: its amount a unit of each column, (count,).

    """
    grams: dict[tuple[int, ...], np.ndarray] = {}
    pulls: dict[tuple[int, ...], np.ndarray] = {}
    for line, of in zip(lines, columns):
        if not line or not of:
            continue
        key, matrix = tuple(line), np.column_stack(list(line.values()))
        grams[key] = grams.get(key, 0.0) + matrix.T @ matrix
        pull = pulls.setdefault(key, np.zeros((len(line), count)))
        for i, column in of:
            pull[:, i] += matrix.T @ column
    out: dict[int, np.ndarray] = {}
    for key, gram in grams.items():
        out |= dict(zip(key, np.linalg.lstsq(gram, pulls[key])[0]))
    return out


def on_tangents(of: Study, chosen: Sequence[int], start: Fit | None = None,
                wanders: Sequence[str] = ()) -> Fit:
    """
    Fit a set of variants, by number, on the tangents at the baseline.

    Parameters
    ----------
    of
        The recordings.
    chosen
        Numbers of variants.
    start
        A fit with noise like that of this one.
    wanders
        Effects by which the zero-g may wander more than that of a healthy unit, beside those of
        the baseline.

    """
    wanders = (*wanders, *noise_whitening.drifts_among(of.series[0].sensor.effects))
    ids = set(of.nuisances()).union(*(of.ids[i] for i in chosen))
    prior, most = of.priors(chosen, wanders)
    found = evidence.fit(of.channels, sorted(ids), prior, most, None, start, wanders)
    gain = 0.0
    for i in chosen:
        own = np.flatnonzero(np.isin(found.ids, of.ids[i]))
        gain += evidence.of_any_size(found.values[own], found.covariance[np.ix_(own, own)],
                                     prior[found.ids[own]])
    return replace(found, log_evidence=found.log_evidence + gain)
