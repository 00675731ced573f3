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
to it, and are only named where they go beyond that.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

from adxl_ros.gap import evidence, whiten
from adxl_ros.gap.evidence import Channel, Fit
from adxl_ros.gap.series import Series
from adxl_ros.gap.tangents import candidates, Variant, variants
import numpy as np

WANDERING = 'bias_walk'
"""The effect that lets the noise of a hypothesis drift more than that of a healthy unit."""
TOLERANCE = {'bias': 5e-4, 'scale_factor': 5e-4, 'bandwidth': 0.02, 'time_offset': 1e-4}
"""What a healthy unit shows from day to day, beside the file's covariance, as standard deviations:
zero-g in g, scale factor, resistance of the filter, and latency of the stamps in s."""


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
    filters
        That whiten, by channel.
    free
        By channel: what is free in every hypothesis, and its columns, volts a unit, (n,).

    """

    series: list[Series]
    used: list[np.ndarray]
    variants: list[Variant]
    ids: list[list[int]]
    names: list[str]
    prior: np.ndarray
    channels: list[Channel]
    filters: list[list[whiten.Whitener]] = field(default_factory=list)
    free: list[dict[str, np.ndarray]] = field(default_factory=list)

    def nuisances(self) -> list[int]:
        """Return the numbers of the columns of what is free in every hypothesis."""
        return [i for v, of in zip(self.variants, self.ids) if v.effect in TOLERANCE for i in of]

    def priors(self, chosen: Iterable[str]) -> np.ndarray:
        """Return prior deviations where only the chosen effects go beyond their tolerance."""
        prior = self.prior.copy()
        for i in self.nuisances():
            if self.names[i].split('.')[0] not in chosen:
                prior[i] = self.tolerance(self.names[i])
        return prior

    def tolerance(self, name: str) -> float:
        """
        Return how far a coefficient may be from the file's in a healthy unit.

        Where the sensor rests, its pose is not known, so that only changes of zero-g tell.
        """
        effect, *_, axis = name.split('.')
        if effect not in ('bias', 'scale_factor'):
            return TOLERANCE[effect]
        sensor = self.series[0].sensor
        scale = float(sensor.scale_v_per_g[sensor.axes.index(axis)])
        if effect == 'bias' and any(one.reference == 'rest' for one in self.series):
            return scale
        known = 0.0
        if name in sensor.covariance_names:
            i = sensor.covariance_names.index(name)
            known = float(sensor.covariance[i, i])
        return float(np.hypot(TOLERANCE[effect] * scale, np.sqrt(known)))


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
    channels: list[Channel] = []
    filters: list[list[whiten.Whitener]] = []
    for one, mask, of_series in zip(series, used, columns):
        residual = one.residual(one.sensor)
        for d, of_axis in enumerate(of_series):
            tried = whiten.whiteners(one, d)
            filters.append(tried if noise is None else whiten.near(tried, noise[len(filters)]))
            channels.append(evidence.channel(
                residual[:, d], np.column_stack([c for _, c in of_axis]),
                np.array([i for i, _ in of_axis]), mask, filters[-1]))
    free = [{names[i]: column for i, column in of_axis if names[i].split('.')[0] in TOLERANCE}
            for of_series in columns for of_axis in of_series]
    return Study(list(series), list(used), kept, ids, names, np.array(prior), channels, filters,
                 free)


def on_tangents(of: Study, chosen: Sequence[int], start: Fit | None = None,
                wanders: bool = False) -> Fit:
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
        Whether the zero-g may wander more than that of a healthy unit.

    """
    effects = [of.variants[i].effect for i in chosen]
    ids = set(of.nuisances()).union(*(of.ids[i] for i in chosen))
    return evidence.fit(of.channels, sorted(ids), of.priors(effects), None, start, wanders)
