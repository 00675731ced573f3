# SPDX-License-Identifier: Apache-2.0
"""The smallest size of each effect that recordings would have shown."""

from __future__ import annotations

from typing import NamedTuple

from adxl_ros.diagnose import linear_model as linear, noise_effects, sample_faults
from adxl_ros.diagnose.comparison import BaselineComparison
from adxl_ros.diagnose.evidence import left_beside
from adxl_ros.diagnose.linear_model import LinearModel
from adxl_ros.diagnose.noise_filters import expected_drift_g
from adxl_ros.model import noise
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.effects import effect_named, library
from adxl_ros.model.effects.base import Coefficient, Detector
from adxl_ros.model.sensor import parameter_of
import numpy as np

_SHOWN_STDS = 4.0  # Size of a coefficient, in standard deviations, that shows: it gains 8 nats


class CouldShow(NamedTuple):
    """Smallest size of one parameter of an effect that recordings would have shown."""

    name: Coefficient  # The coefficient
    smallest: float  # The size, in `unit`; infinite where nothing of it reaches the output
    # Share of the effect's signal that zero-g, scale factor and latency cannot imitate
    share: float = 1.0

    @property
    def unit(self) -> str:
        """Return the unit of the size, that of the parameter."""
        return parameter_of(self.name).unit

    @property
    def shows(self) -> bool:
        """Return whether the smallest size is one that the parameter can have."""
        p = parameter_of(self.name)
        return bool(self.smallest <= p.upper - p.neutral)


def could_show(
    model: LinearModel, comparison: BaselineComparison, noise_v: np.ndarray, material_mps2: float
) -> list[CouldShow]:
    """
    Return the smallest sizes by effect: material ones, that exceed their uncertainty.

    Nuisance parameters are free, within their tolerance. An effect with several shapes has the
    size of the shape that shows best. The sizes of effects on the noise are those of one
    recording at its full rate; `noise_v` is its noise, V, (m,).
    """
    rows = [
        *_noise_could_show(comparison, noise_v, material_mps2),
        *_mean_could_show(model, material_mps2),
    ]
    seen = {row.name.effect for row in rows}
    limited = {variant.effect for variant in model.variants if variant.limit_start}
    for effect in linear.candidates():
        if effect.name not in seen | limited:
            name = Coefficient(effect.name, effect.parameters[0].name)
            rows.append(CouldShow(name, np.inf, 0.0))
    # The last coefficient of each effect shows best, by smallest over typical size.
    rows.sort(
        key=lambda row: (row.smallest / parameter_of(row.name).scale, row.name), reverse=True
    )
    best = {row.name.effect: row for row in rows}
    return [best[effect] for effect in sorted(best)]


class _Information(NamedTuple):
    """What recordings tell of the coefficients of all columns, (columns,) each."""

    alone: np.ndarray  # Inverse variance where nothing else is free, 1/unit²
    marginal: np.ndarray  # Inverse variance beside the nuisance parameters, 1/unit²
    power_mps2: np.ndarray  # Mean square over samples and axes, (m/s²)²/unit²


def _information(model: LinearModel) -> _Information:
    """Return what the recordings of a linear model tell."""
    squares_mps2 = np.zeros(len(model.names))
    samples = 0
    for columns, (comparison, axis) in zip(model.columns, model.places):
        scale = float(comparison.scale_v_per_mps2[axis])
        for k, column_v in columns.items():
            squares_mps2[k] += float(np.sum(column_v[comparison.used] ** 2)) / scale**2
        samples += int(comparison.used.sum())
    gram = model.information
    marginal = left_beside(gram, model.nuisance_ids, model.prior(()))
    return _Information(np.diag(gram), marginal, squares_mps2 / max(samples, 1))


def _mean_could_show(model: LinearModel, material_mps2: float) -> list[CouldShow]:
    """Return the smallest sizes of effects that show in the mean of the output."""
    known = _information(model)
    rows = []
    for variant, ids in zip(model.variants, model.column_ids):
        hints = effect_named(variant.effect).diagnosis
        hides_in_pose = bool(hints.straight_line) and not model.pose_known
        if variant.limit_start or hides_in_pose:
            continue
        for k in ids:
            information = known.alone[k] if hints.nuisance else known.marginal[k]
            share = float(np.clip(information / max(known.alone[k], 1e-300), 0.0, 1.0))
            power_mps2 = known.power_mps2[k] * share
            size = np.inf
            if information > 0 and power_mps2 > 0:
                certain = _SHOWN_STDS * information**-0.5
                size = max(certain, material_mps2 * power_mps2**-0.5)
            if hints.nuisance:
                size = np.hypot(size, 3 * model.tolerances[model.names[k]])
            rows.append(CouldShow(model.names[k], float(size), share))
    return rows


def _noise_could_show(
    comparison: BaselineComparison, noise_v: np.ndarray, material_mps2: float
) -> list[CouldShow]:
    """Return the smallest sizes of effects that show in the noise of one recording."""
    sensor = comparison.sensor
    count = len(comparison)
    level_v = float(noise_v.max())
    rate_hz = sensor.rate_hz
    line_v = max(
        level_v * np.sqrt(8 * (noise_effects.LINE_LOG_EXCESS + np.log(count)) / count),
        np.sqrt(2) * material_mps2 * float(comparison.scale_v_per_mps2.max()),
    )
    sizes = {
        Detector.NOISE_LEVEL: ('ratio', noise_effects.NOISE_EXCESS - 1),
        Detector.MAINS_LINE: ('amplitude_v', line_v),
        Detector.ISOLATED_SAMPLES: (
            'amplitude_v',
            sample_faults.SPIKE_STDS * max(level_v, noise.electronics(sensor).lsb_v.max()),
        ),
        Detector.REPEATED_SAMPLES: (
            'duration_s',
            sample_faults.shortest_repeat(comparison.volts, len(sensor.axes)) / rate_hz,
        ),
        Detector.COARSE_CODES: ('lost_bits', float(np.log2(sample_faults.COARSE_STEPS))),
    }
    rows = []
    for effect in library().values():
        hints = effect.diagnosis
        if hints.drift is not None:
            unit_g = expected_drift_g(effect.name, 1.0, comparison)
            density = max(material_mps2 / G0_MPS2 / unit_g, hints.healthy_density)
            rows.append(CouldShow(Coefficient(effect.name, effect.parameters[0].name), density))
        elif hints.detector in sizes:
            parameter, size = sizes[hints.detector]
            rows.append(CouldShow(Coefficient(effect.name, parameter), float(size)))
    return rows
