# SPDX-License-Identifier: Apache-2.0
"""What recordings can show: the smallest size of each effect, beside everything that is free."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from adxl_ros.diagnose.comparison import BaselineComparison
from adxl_ros.diagnose.evidence import fit_columns
from adxl_ros.diagnose.linear_model import candidates, LinearModel
from adxl_ros.diagnose.noise_effects import (
    COARSE_STEPS,
    LINE_LOG_EXCESS,
    NOISE_EXCESS,
    shortest_repeat,
    SPIKE_STDS,
)
from adxl_ros.diagnose.noise_model import expected_drift_g
from adxl_ros.model.coefficients import parameter_of
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.diagnosis_hints import Detector, Manoeuvre
from adxl_ros.model.effects import effect_named, library
import numpy as np

_SHOWN_STDS = 4.0
"""Size of a coefficient, in standard deviations, that shows: it gains 8 nats."""


@dataclass(frozen=True)
class CouldShow:
    """Smallest size of one parameter of an effect that recordings would have shown."""

    # effect, parameter, axis: The coefficient; `axis` is '' where it has none
    effect: str
    parameter: str
    axis: str
    unit: str  # Unit of the size
    smallest: float  # The size; infinite where nothing of the effect reaches the output
    typical: float  # Typical size
    shows: bool  # Whether the smallest size is one that the parameter can have
    # Share of the effect's signal that zero-g, scale factor and latency cannot imitate
    share: float
    revealed_by: Manoeuvre | None  # Manoeuvre that shows the effect best


def could_show(model: LinearModel, material_mps2: float) -> list[CouldShow]:
    """
    Return the smallest sizes by coefficient: material ones, that exceed their uncertainty.

    Nuisance parameters are free, within their tolerance. An effect with several shapes has the
    size of the shape that shows best.
    """
    gram, marginal, plain = _products(model)
    best: dict[tuple[str, str, str], CouldShow] = {}
    for variant, ids in zip(model.variants, model.column_ids):
        effect = effect_named(variant.effect)
        if variant.limit_start or (effect.diagnosis.straight_line and not model.pose_known):
            continue
        for k in ids:
            name, p = model.names[k], parameter_of(model.names[k])
            nuisance = effect.diagnosis.nuisance
            information = gram[k, k] if nuisance else marginal[k, k]
            share = float(np.clip(information / max(gram[k, k], 1e-300), 0.0, 1.0))
            power = plain[k] * share
            size = max(_SHOWN_STDS * information ** -0.5, material_mps2 * power ** -0.5) \
                if information > 0 and power > 0 else np.inf
            if nuisance:
                size = float(np.hypot(size, 3 * model.tolerance(name)))
            row = CouldShow(variant.effect, name.parameter, name.axis, p.unit, float(size),
                            p.scale, bool(size <= p.upper - p.neutral), share,
                            effect.diagnosis.revealed_by)
            key = (row.effect, row.parameter, row.axis)
            if key not in best or row.smallest < best[key].smallest:
                best[key] = row
    seen = {row.effect for row in best.values()} | {
        v.effect for v in model.variants if v.limit_start}
    hidden = [CouldShow(e.name, e.parameters[0].name, '', e.parameters[0].unit, np.inf,
                        e.parameters[0].scale, False, 0.0, e.diagnosis.revealed_by)
              for e in candidates() if e.name not in seen]
    return sorted([*best.values(), *hidden], key=lambda r: (r.effect, r.parameter, r.axis))


def noise_could_show(comparison: BaselineComparison, noise_v: np.ndarray, material_mps2: float
                     ) -> list[CouldShow]:
    """Return the smallest sizes of effects that show in the noise of one recording."""
    sensor, span_s, count = comparison.sensor, comparison.span_s, len(comparison)
    level_v, rate_hz = float(noise_v.max()), sensor.rate_hz
    line_v = level_v * np.sqrt(8 * (LINE_LOG_EXCESS + np.log(count)) / count)
    sizes = {Detector.NOISE_LEVEL: ('ratio', NOISE_EXCESS - 1),
             Detector.MAINS_LINE: ('amplitude_v', line_v),
             Detector.ISOLATED_SAMPLES: ('amplitude_v', SPIKE_STDS * max(level_v, sensor.lsb_v)),
             Detector.REPEATED_SAMPLES: ('duration_s', shortest_repeat(
                 comparison.volts, len(sensor.axes)) / rate_hz),
             Detector.COARSE_CODES: ('lost_bits', float(np.log2(COARSE_STEPS)))}
    rows = []
    for effect in library().values():
        hints = effect.diagnosis
        if hints.drift is not None:
            unit_g = expected_drift_g(hints.drift, 1.0, span_s, rate_hz)
            sizes_of = (effect.parameters[0].name, max(
                material_mps2 / G0_MPS2 / unit_g, hints.healthy_density))
        elif hints.detector in sizes:
            sizes_of = sizes[hints.detector]
        else:
            continue
        p = next(p for p in effect.parameters if p.name == sizes_of[0])
        rows.append(CouldShow(effect.name, p.name, '', p.unit, float(sizes_of[1]), p.scale,
                              bool(sizes_of[1] <= p.upper - p.neutral), 1.0, hints.revealed_by))
    return rows


def by_effect(rows: Sequence[CouldShow]) -> dict[str, CouldShow]:
    """Return for each effect its coefficient that shows best, by smallest over typical size."""
    best: dict[str, CouldShow] = {}
    for row in sorted(rows, key=lambda r: r.smallest / r.typical):
        best.setdefault(row.effect, row)
    return best


def _products(model: LinearModel) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    Return products of the whitened columns in units of the noise, and mean squares of the columns.

    The second has the nuisance parameters eliminated. The squares are over samples and axes,
    (m/s²)² per unit².
    """
    prior_std, nuisances = model.prior(()), np.array(model.nuisance_ids(), int)
    fit = fit_columns(model.channels, model.nuisance_ids(), prior_std)
    count = len(model.names)
    gram, plain, samples = np.zeros((count, count)), np.zeros(count), 0.0
    for number, (c, f, variance) in enumerate(zip(
            model.channels, fit.filter_indices, fit.innovation_variance_v2)):
        gram[np.ix_(c.column_ids, c.column_ids)] += c.total_grams[f][1:, 1:] / variance
        recording, axis = model.place_of_channel(number)
        comparison = model.comparisons[recording]
        scale = float(comparison.scale_v_per_mps2[axis])
        for column in model.columns[number]:
            plain[column.number] += float(np.sum(column.values[comparison.used] ** 2)) / scale ** 2
        samples += comparison.used.sum()
    precision = gram[np.ix_(nuisances, nuisances)] + np.diag(prior_std[nuisances] ** -2.0)
    regression = np.linalg.solve(precision, gram[nuisances]).T
    return gram, gram - regression @ gram[nuisances], plain / max(samples, 1.0)
