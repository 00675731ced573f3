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
Which parameters of an effect the recordings determine.

A parameter is determined if the recordings alone narrow it well below its prior. The other
parameters of the effect and the nuisance parameters are free meanwhile. Zero-g and scale factor
have no prior here, because an effect that differs from a straight line by nothing is not
determined by how well the straight line is known. The sensitivities are those of the baseline. At
a fitted value far from it, a second-order term may show although its sign does not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from adxl_ros.diagnose import evidence
from adxl_ros.diagnose.hypothesis_fit import Hypothesis, linearise
from adxl_ros.diagnose.linear_model import hints_of, LinearModel
from adxl_ros.diagnose.noise_whitening import drifts_among
from adxl_ros.diagnose.sensitivities import PRIOR_WIDTH
from adxl_ros.model.coefficients import fitted_of, get, parameter_of, put, with_neutral
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Coefficient
import numpy as np

_UNDETERMINED_SHARE = 0.5
"""A parameter is not determined if its standard deviation by the recordings exceeds this share of
its prior's, or of its own value if that is larger. Chosen: the recordings then narrow the prior by
a tenth at most."""
_FREE = 1e4
"""Factor by which the prior of a free coefficient is widened. Chosen: its square is below the
inverse of rounding errors."""
_ENCODER_STDS = 3.0
"""A sensitivity to an angle counts if its rms is above that by the error of the encoder, times
this. Chosen: noise of the reference then adds a tenth to its square."""
_PARTNER_CORRELATION = 0.7
"""Smallest correlation of two parameters of which only a combination is determined. Chosen: half
of the variance of each is that of the other."""

NotDetermined = dict[Coefficient, tuple[Coefficient, ...]]
"""Parameters that are not determined, each with those that it cannot be separated from. None are
given where no combination is determined either."""


def not_determined(linear_model: LinearModel, hypotheses: Sequence[Hypothesis]) -> NotDetermined:
    """
    Find the parameters that the recordings do not determine.

    Parameters
    ----------
    linear_model
        The recordings.
    hypotheses
        Fitted hypotheses. The first one with an effect counts for this effect.

    Returns
    -------
    dict
        Parameters that are not determined, and what each cannot be separated from.

    """
    undetermined: NotDetermined = {}
    effects: set[str] = set()
    for hypothesis in hypotheses:
        for effect in hypothesis.effects:
            if effect not in effects and not effect_named(effect).diagnosis.drift:
                effects.add(effect)
                undetermined |= _not_determined_of(linear_model, hypothesis, effect)
    return undetermined


def _not_determined_of(linear_model: LinearModel, hypothesis: Hypothesis, effect: str
                       ) -> NotDetermined:
    """Return the parameters of one effect of a hypothesis that are not determined."""
    baseline = linear_model.baseline
    names = fitted_of(effect_named(effect), baseline.axes)
    places = {name: i for i, name in enumerate(hypothesis.names)}
    fit_variance = np.diag(hypothesis.fit.covariance)
    best = _Information(linear_model, hypothesis, effect)
    undetermined: NotDetermined = {}
    for name in names:
        p = parameter_of(name)
        if name not in places:
            undetermined[name] = ()
            continue
        prior_std = p.scale * (PRIOR_WIDTH if p.is_size else 1.0)
        i = places[name]
        value = abs(hypothesis.values[i]) if p.is_size \
            else abs(float(get(hypothesis.sensor, [name])[0]))
        largest = _UNDETERMINED_SHARE * max(prior_std, value)
        fitted_std = _std_of_data(float(fit_variance[i]), prior_std)
        if not p.is_size or effect_named(effect).diagnosis.imitated:
            if fitted_std > largest:
                undetermined[name] = ()
            continue
        if max(best.std(name), fitted_std) > largest:
            undetermined[name] = best.partners(name, largest)
    return undetermined


def _std_of_data(variance: float, prior_std: float) -> float:
    """Return the standard deviation by the samples alone, from that with the prior."""
    information = 1 / max(variance, 1e-300) - prior_std ** -2.0
    return float(information ** -0.5) if information > 0 else np.inf


class _Information:
    """What the recordings say about the sizes of one effect, at the baseline."""

    def __init__(self, linear_model: LinearModel, hypothesis: Hypothesis, effect: str) -> None:
        self._covariances: list[tuple[list[Coefficient], np.ndarray]] = []
        for variant, ids in zip(linear_model.variants, linear_model.column_ids):
            if variant.effect == effect and not variant.limit_start:
                self._covariances.append((
                    [linear_model.names[i] for i in ids],
                    _covariance(linear_model, hypothesis, ids)))

    def std(self, name: Coefficient) -> float:
        """Return the standard deviation of a parameter in the variant that shows it best."""
        stds = [float(np.sqrt(covariance[names.index(name), names.index(name)]))
                for names, covariance in self._covariances if name in names]
        # The sensitivities of limits are not those of their parameters; the fit decides alone.
        return min(stds, default=0.0 if not self._covariances else np.inf)

    def partners(self, name: Coefficient, largest: float) -> tuple[Coefficient, ...]:
        """Return the parameters that a parameter cannot be separated from."""
        for names, covariance in self._covariances:
            if name not in names:
                continue
            i, std = names.index(name), np.sqrt(np.diag(covariance))
            scaled_precision = np.linalg.pinv(covariance / np.outer(std, std))
            conditional_std = std[i] * scaled_precision[i, i] ** -0.5
            correlation = np.abs(covariance[i]) / (std * std[i])
            if conditional_std <= largest:
                return tuple(n for n, c in zip(names, correlation)
                             if n != name and c > _PARTNER_CORRELATION)
        return ()


def _covariance(linear_model: LinearModel, hypothesis: Hypothesis, ids: list[int]) -> np.ndarray:
    """Return the covariance of columns by the samples alone, nuisance parameters free."""
    imitated = {linear_model.names[i].effect for i in ids}
    every = [*ids, *(i for i in linear_model.nuisance_ids()
                     if linear_model.names[i].effect not in imitated)]
    prior_std = linear_model.prior(())
    free = np.array([i in ids or hints_of(linear_model.names[i]).straight_line is not None
                     for i in every])
    std = np.where(free, _FREE, 1.0) * prior_std[every]
    precision = np.diag(std ** -2.0)
    fit = hypothesis.fit
    angles_rad = np.array([linear_model.smallest_angle_rad()
                           if parameter_of(linear_model.names[i]).unit == 'rad' else 0.0
                           for i in ids])
    encoder_information = np.zeros(len(ids))
    scales = [scale for c in linear_model.comparisons for scale in c.sensor.scale_v_per_g]
    drifting = bool(drifts_among(hypothesis.effects))
    for channel, filters, whitener, variance, scale in zip(
            linear_model.drifting_channels if drifting else linear_model.channels,
            linear_model.filters if drifting else linear_model.filters_of(()),
            hypothesis.whiteners, fit.innovation_variance_v2, scales):
        f = next(i for i, same in enumerate(filters) if same is whitener)
        columns = [i for i, k in enumerate(channel.column_ids) if k in every]
        places = np.array([every.index(channel.column_ids[i]) for i in columns], int)
        rows = 1 + np.array(columns, int)
        precision[np.ix_(places, places)] += channel.total_grams[f][np.ix_(rows, rows)] / variance
        followed = np.isin(np.arange(len(ids)), places)
        error_v = angles_rad * _ENCODER_STDS * scale
        encoder_information += followed * channel.counts.sum() * error_v ** 2 / variance
    size = 1 / np.sqrt(np.diag(precision))
    covariance = np.linalg.inv(precision * np.outer(size, size)) * np.outer(size, size)
    part = covariance[:len(ids), :len(ids)]
    # An angle that shows by the errors of the encoder alone is not determined.
    hidden = 1 / np.diag(part) < encoder_information
    return part * np.outer(np.where(hidden, _FREE, 1.0), np.where(hidden, _FREE, 1.0))


def at_baseline(linear_model: LinearModel, hypothesis: Hypothesis) -> Hypothesis:
    """
    Return a hypothesis whose sizes that are not determined have the values of the baseline.

    The other coefficients are fitted again. A guess from this recording would else enter the
    simulation of others.

    Parameters
    ----------
    linear_model
        The recordings.
    hypothesis
        A fitted hypothesis.

    Returns
    -------
    Hypothesis
        The same hypothesis with another sensor, or the given one if all sizes are determined.

    """
    open_names = not_determined(linear_model, [hypothesis])
    places = [i for i, name in enumerate(hypothesis.names)
              if name in open_names and parameter_of(name).is_size and hypothesis.values[i]]
    if not places:
        return hypothesis
    names = [hypothesis.names[i] for i in places]
    start = put(hypothesis.sensor, names, get(
        with_neutral(linear_model.baseline, hypothesis.effects), names))
    linearised = linearise(linear_model, hypothesis.effects, start,
                           [[whitener] for whitener in hypothesis.whiteners])
    fit = linearised.fit()
    held = [i for i, name in enumerate(linearised.names) if name in open_names]
    departures = evidence.conditional_mean(
        fit, np.array(held), linearised.values[held] - linearised.prior_mean[held])
    fitted = linearised.prior_mean + departures
    parameters = [parameter_of(name) for name in linearised.names]
    sensor = put(start, linearised.names, np.clip(
        fitted, [p.lower for p in parameters], [p.upper for p in parameters]))
    j = len(hypothesis.names)
    return replace(hypothesis, sensor=sensor, values=departures[:j])
