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

"""How large the effects of a hypothesis are, and which of them matter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import NamedTuple

from adxl_ros.diagnose.decision_settings import DecisionSettings
from adxl_ros.diagnose.hypothesis_fit import Hypothesis
from adxl_ros.diagnose.linear_model import (
    calibration_takes_up,
    LinearModel,
    NumberedColumn,
    parts_at_rest,
    rests_by_channel,
)
from adxl_ros.diagnose.noise_whitening import drift_effects, drifts_among, expected_drift_g
from adxl_ros.model.coefficients import get, neutral, parameter_of, with_neutral
from adxl_ros.model.constants import G0_MPS2, Z_90
from adxl_ros.model.diagnosis_hints import FormDimension
from adxl_ros.model.effects import effect_named, library
from adxl_ros.model.effects.base import Concern, Role
from adxl_ros.model.sensor import Sensor
import numpy as np

_POSE = {FormDimension.FORCE, FormDimension.CROSS_FORCE, FormDimension.CODE, FormDimension.ALPHA,
         FormDimension.BETA}
"""Dimensions that only change with the pose."""


class Contribution(NamedTuple):
    """
    What one effect contributes to the output.

    Attributes
    ----------
    rms_mps2
        Rms over samples and axes, m/s².
    varying_mps2
        Rms about the mean of each channel, m/s².
    by_channel_v
        Rms about the mean by channel, V, (channels,); zero for a drift.

    """

    rms_mps2: float
    varying_mps2: float
    by_channel_v: np.ndarray


@dataclass(frozen=True)
class SizedHypothesis:
    """
    A fitted hypothesis with the sizes of its effects.

    Attributes
    ----------
    hypothesis
        The fitted hypothesis.
    contributions
        What each effect contributes.
    material
        Effects that matter. Zero-g and scale factor, which are free beside other effects, are
        among them if they exceed what the calibration can have taken up.

    """

    hypothesis: Hypothesis
    contributions: dict[str, Contribution]
    material: frozenset[str]


def size_hypothesis(linear_model: LinearModel, hypothesis: Hypothesis, noise_mps2: float,
                    settings: DecisionSettings) -> SizedHypothesis:
    """
    Simulate how large the effects of a hypothesis are, and decide which of them matter.

    An effect must be a visible part of the noise and of the gap. One that follows the pose must
    exceed the error of the encoder, which is the same each time a pose returns. One that changes
    with time must exceed the drift of a healthy unit. The interval of one of its sizes must
    exclude zero. An effect of the sensor must stand out of the motion that a smooth reference
    lacks. Beside another effect, zero-g and scale factor must exceed what the calibration
    can have taken up of it.

    Parameters
    ----------
    linear_model
        The recordings.
    hypothesis
        A fitted hypothesis.
    noise_mps2
        Rms of the noise, m/s².
    settings
        Limits of materiality.

    Returns
    -------
    SizedHypothesis
        The hypothesis with sizes.

    """
    contributions = {e: contribution(linear_model, hypothesis, e) for e in hypothesis.effects}
    angle_mps2 = linear_model.smallest_angle_rad() * G0_MPS2
    immaterial = {
        e for e, c in contributions.items()
        if c.rms_mps2 < _smallest_mps2(e, contributions, noise_mps2, settings)
        or (_follows_pose(e) and c.rms_mps2 < angle_mps2) or _may_be_zero(hypothesis, e)
        or (_drifts_in_time(e) and c.varying_mps2 < _healthy_drift_mps2(linear_model))
        or (_is_of_sensor(e) and c.varying_mps2
            < settings.smallest_share_of_lost_motion * linear_model.lost_motion_mps2)}
    material = set(hypothesis.effects) - immaterial
    if any(calibration_takes_up(e) and not effect_named(e).diagnosis.drift for e in material):
        beyond = _beyond_calibration(linear_model, hypothesis, contributions, settings)
        straight = {e for e in library() if effect_named(e).diagnosis.straight_line}
        material = (material - straight) | beyond
    return SizedHypothesis(hypothesis, contributions, frozenset(material))


def _is_of_sensor(effect: str) -> bool:
    """Determine whether an effect is an error of the sensor whose form is not exact."""
    library_effect = effect_named(effect)
    return library_effect.concern is Concern.SENSOR and not library_effect.exact


def _smallest_mps2(effect: str, contributions: dict[str, Contribution], noise_mps2: float,
                   settings: DecisionSettings) -> float:
    """
    Return the rms of an effect below which it does not matter, m/s².

    A drift counts beside the effects on the mean, and they count beside it.
    """
    is_drift = bool(effect_named(effect).diagnosis.drift)
    share = settings.smallest_drift_share_of_gap if is_drift else settings.smallest_share_of_gap
    inexact_mps2 = np.sqrt(sum(
        c.varying_mps2 ** 2 for e, c in contributions.items() if not effect_named(e).exact
        and not (is_drift and effect_named(e).diagnosis.drift)))
    return max(settings.smallest_share_of_noise * noise_mps2, share * float(inexact_mps2))


def contribution(linear_model: LinearModel, hypothesis: Hypothesis, effect: str) -> Contribution:
    """
    Simulate what one effect of a hypothesis contributes to the output.

    Parameters
    ----------
    linear_model
        The recordings.
    hypothesis
        A fitted hypothesis.
    effect
        Name of one of its effects.

    Returns
    -------
    Contribution
        Its rms, in all and by channel.

    """
    library_effect = effect_named(effect)
    spectrum = library_effect.diagnosis.drift
    if spectrum:
        density = np.sqrt(np.mean(next(iter(hypothesis.sensor.values[effect].values())) ** 2))
        squares = [(G0_MPS2 * expected_drift_g(spectrum, float(density), c.span_s,
                                               c.sensor.rate_hz)) ** 2
                   for c in linear_model.comparisons]
        rms_mps2 = float(np.sqrt(np.mean(squares)))
        return Contribution(rms_mps2, rms_mps2,
                            np.zeros(len(linear_model.channels)))
    total, varying, count, by_channel_v = 0.0, 0.0, 0, []
    for c, change_v in zip(linear_model.comparisons,
                           _changes_v(linear_model, hypothesis, [effect])):
        change_v = change_v[c.used]
        total += float(np.sum((change_v / c.scale_v_per_mps2) ** 2))
        varying += float(np.sum(change_v.var(axis=0) / c.scale_v_per_mps2 ** 2)) * len(change_v)
        count += change_v.size
        by_channel_v += list(change_v.std(axis=0))
    return Contribution(float(np.sqrt(total / max(count, 1))),
                        float(np.sqrt(varying / max(count, 1))), np.array(by_channel_v))


def _changes_v(linear_model: LinearModel, hypothesis: Hypothesis, effects: Sequence[str]
               ) -> list[np.ndarray]:
    """Return what some effects of a hypothesis change in each recording, V, (n, m) each."""
    changes = []
    for c in linear_model.comparisons:
        sensor = replace(hypothesis.sensor, rate_hz=c.sensor.rate_hz)
        changes.append(c.simulated_v(sensor) - c.simulated_v(
            without_effects(sensor, linear_model.baseline, effects)))
    return changes


def without_effects(sensor: Sensor, baseline: Sensor, effects: Sequence[str]) -> Sensor:
    """
    Return a sensor with some effects as in the baseline.

    Parameters
    ----------
    sensor
        The sensor.
    baseline
        The baseline.
    effects
        Names of the effects.

    Returns
    -------
    Sensor
        The sensor, whose other effects stay.

    """
    absent = {e: baseline.values[e] if e in baseline.effects
              else neutral(effect_named(e), baseline.axes) for e in effects}
    return replace(sensor, values={**sensor.values, **absent})


def _follows_pose(effect: str) -> bool:
    """Determine whether an effect only follows the pose, as the error of an encoder does."""
    form = effect_named(effect).diagnosis.form
    return any(p.unit == 'rad' for p in effect_named(effect).parameters if p.is_size) \
        or (bool(form) and set(form) <= _POSE)


def _drifts_in_time(effect: str) -> bool:
    """Determine whether an effect changes with time alone, as a healthy zero-g does."""
    return effect_named(effect).diagnosis.form == (FormDimension.TIME,)


def _healthy_drift_mps2(linear_model: LinearModel) -> float:
    """Return the largest rms of the drift of a healthy unit's zero-g, m/s²."""
    return G0_MPS2 * max(
        expected_drift_g(hints.drift, hints.healthy_density, c.span_s, c.sensor.rate_hz)
        for hints in (effect_named(drift).diagnosis for drift in drift_effects()) if hints.drift
        for c in linear_model.comparisons)


def _may_be_zero(hypothesis: Hypothesis, effect: str) -> bool:
    """Determine whether the 90 % intervals of all sizes of an effect hold zero."""
    places = [i for i, name in enumerate(hypothesis.names) if name.effect == effect]
    if any(parameter_of(hypothesis.names[i]).role is Role.LIMIT for i in places):
        return False
    sizes = [abs(hypothesis.values[i]) < Z_90 * hypothesis.std[i] for i in places
             if parameter_of(hypothesis.names[i]).is_size]
    return bool(sizes) and all(sizes)


def _beyond_calibration(linear_model: LinearModel, hypothesis: Hypothesis,
                        contributions: dict[str, Contribution], settings: DecisionSettings
                        ) -> set[str]:
    """
    Return whether zero-g or scale factor exceeds what a calibration took up of the effects.

    As any other effect, it must also be a visible part of the gap, and exceed the error of an
    encoder, which is the same each time a pose returns.
    """
    others = [e for e in hypothesis.effects if calibration_takes_up(e)
              and not effect_named(e).diagnosis.drift]
    if not others:
        return set()
    columns = [{name: column for name, column in channel.items()
                if effect_named(name.effect).diagnosis.straight_line}
               for channel in linear_model.nuisance_columns]
    names = list(dict.fromkeys(chain(*columns)))
    changes = [[NumberedColumn(0, axis_v)]
               for change_v in _changes_v(linear_model, hypothesis, others)
               for axis_v in change_v.T]
    parts = parts_at_rest([{names.index(n): column for n, column in channel.items()}
                           for channel in columns], changes, 1,
                          rests_by_channel(linear_model.comparisons))
    drifts = drifts_among(hypothesis.effects)
    departures = get(hypothesis.sensor, names) \
        - get(with_neutral(linear_model.baseline, [n.effect for n in names]), names)
    visible_g = max(linear_model.smallest_angle_rad(), settings.smallest_share_of_gap / G0_MPS2
                    * np.sqrt(sum(contributions[e].varying_mps2 ** 2 for e in others)))
    sensor = linear_model.baseline
    scale_v_per_g = dict(zip(sensor.axes, sensor.scale_v_per_g))
    return {name.effect for i, name in enumerate(names)
            if abs(departures[i]) > max(visible_g * scale_v_per_g[name.axis], np.hypot(
                settings.healthy_factor * linear_model.tolerance(name, drifts),
                settings.calibration_factor * parts[i][0]))}
