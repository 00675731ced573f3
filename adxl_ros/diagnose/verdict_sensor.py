# SPDX-License-Identifier: Apache-2.0
"""Sensors that have the effects of a fitted set, as a reader gets them and as a verdict names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from adxl_ros.diagnose.detection import Detection
from adxl_ros.diagnose.noise_filters import drifts_among
from adxl_ros.diagnose.search import Hypothesis
from adxl_ros.diagnose.verdict import Verdict
from adxl_ros.diagnose.weighing import drifts_beside, Evidence
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.effects import effect_named, library
from adxl_ros.model.sensor import get, parameter_of, put, Sensor, with_neutral, with_values
import numpy as np

if TYPE_CHECKING:
    from adxl_ros.diagnose.held_out import HeldOutFits


def as_printed(hypothesis: Hypothesis, sensor: Sensor) -> Sensor:
    """
    Give a sensor, which has the effects of a hypothesis, their fitted values.

    A size that these recordings do not determine would be a guess in others.
    """
    hidden = [
        name
        for name, is_open in zip(hypothesis.names, hypothesis.undetermined)
        if is_open and parameter_of(name).is_size
    ]
    fitted = _with_fitted(sensor, hypothesis.sensor, hypothesis.effects)
    return put(fitted, hidden, get(sensor, hidden))


def _with_fitted(sensor: Sensor, fitted: Sensor, effects: Sequence[str]) -> Sensor:
    """Give a sensor the values that some of its effects have in a fitted one."""
    return replace(sensor, values={**sensor.values, **{e: fitted.values[e] for e in effects}})


def with_likely_drift(best: Hypothesis, evidence: Evidence) -> Sensor:
    """Return the sensor of a set, with the drift that its noise needs most, if any."""
    effects = frozenset(best.effects)
    drifts = drifts_beside(evidence, effects)
    if not drifts:
        return best.sensor
    return _with_drift(best.sensor, drifts[0], evidence.candidates[effects][drifts[0]])


def _with_drift(sensor: Sensor, drift: str, fits: HeldOutFits) -> Sensor:
    """Return a sensor with the drift that the noise of fits has."""
    densities = fits.drift_densities()[: len(sensor.axes)]
    name = effect_named(drift).parameters[0].name
    return with_values(with_neutral(sensor, [drift]), drift, {name: densities})


def named_sensor(
    verdict: Verdict,
    best: Hypothesis,
    detections: Sequence[Detection],
    baseline: Sensor,
    fits: Mapping[str, HeldOutFits],
    pose_known: bool,
) -> Sensor:
    """
    Return the baseline with exactly the effects whose closing the verdict states.

    Zero-g and scale factor that the file holds, or that changed beside the effects by a material
    amount, have their fitted values. Without a known pose these are those of its median output,
    and stay those of the file, as filter and latency do.
    """
    if not verdict.closes:
        return baseline
    sensor = with_neutral(baseline, best.effects)
    if best.effects:
        beside = []
        if pose_known:
            beside = _straight_lines_beside(best, baseline, verdict.material_mps2)
        sensor = with_neutral(sensor, beside)
        sensor = as_printed(best, _with_fitted(sensor, best.sensor, beside))
    for detection in detections:
        sensor = detection.added_to(sensor)
    drift = next((e for e in drifts_among(library()) if e in verdict.named), None)
    if drift is not None:
        sensor = _with_drift(sensor, drift, fits[drift])
    kept = [i for i, name in enumerate(baseline.covariance_names) if name.effect in sensor.effects]
    return replace(
        sensor,
        covariance=baseline.covariance[np.ix_(kept, kept)],
        covariance_names=tuple(baseline.covariance_names[i] for i in kept),
    )


def _straight_lines_beside(best: Hypothesis, baseline: Sensor, material_mps2: float) -> list[str]:
    """Return zero-g and scale factor beside a set, where the file holds them or they changed."""
    fitted = best.sensor
    from_file = with_neutral(baseline, fitted.effects)
    smallest_v = material_mps2 / G0_MPS2 * baseline.scale_v_per_g.min()

    def has_changed(effect: str) -> bool:
        before = from_file.values[effect]
        changes_v = [value - before[name] for name, value in fitted.values[effect].items()]
        return any(np.abs(change_v).max() > smallest_v for change_v in changes_v)

    others = [e for e in fitted.effects if e not in best.effects]
    straight = [e for e in others if effect_named(e).diagnosis.straight_line]
    return [e for e in straight if e in baseline.effects or has_changed(e)]
