# SPDX-License-Identifier: Apache-2.0

"""
The bias of a gyroscope over the rests of its accelerometer, with its uncertainty.

The bias is the weighted mean of the rests, or a line through them by temperature. Its uncertainty
follows from the scatter between the rests, which contains white noise, the wandering of the bias
and the effect of the pose. A few rests are divided, so that there are enough to scatter. A steady
turn about the vertical is a rest for an accelerometer: it is a part of the bias.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from math import ceil
from typing import NamedTuple

from adxl_ros.files.recording_columns import Recording
from adxl_ros.model.constants import Z_90
from adxl_ros.model.gyroscope import Gyroscope
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.block_statistics import DITHERED_STEPS, smallest_change
from adxl_ros.signals.rest_detection import rests_of
import numpy as np
import scipy

_FEWEST_PARTS = 10  # Parts whose scatter is known within a quarter
_FEWEST_SAMPLES = 8  # Fewest samples of a part. Chosen: fewer are no mean
_TEMPERATURES_K = 3.0
"""Range of temperatures from which the bias follows temperature, K. Chosen: a usual slope of
5 m°/s/K then changes it by more than its noise in a rest."""
_COVERED = 0.95  # Probability below the upper end of a 90 % interval


class RestTurns(NamedTuple):
    """The gyroscope in one rest."""

    gyro_radps: np.ndarray  # Its readings, rad/s, (n, 3)
    temperature_c: np.ndarray  # Temperature of each, °C, (n,); NaN where it is not known


def rest_turns(read: Recording, sensor: Sensor, are_rows: bool = False) -> list[RestTurns]:
    """Return the gyroscope in each rest of a recording, or in each row; none without one."""
    gyro_radps = read.gyro_radps
    if gyro_radps is None:
        return []
    temperature_c = read.columns.get('temperature_c', np.full(len(read), np.nan))
    is_taken = np.isfinite(gyro_radps).all(axis=1)
    if are_rows:
        places = [np.arange(len(read)) == row for row in range(len(read))]
    else:
        places = [found.rest.includes(read.time_s) for found in rests_of(sensor, read)]
    turns = [
        RestTurns(gyro_radps[place & is_taken], temperature_c[place & is_taken])
        for place in places
    ]
    fewest = 1 if are_rows else _FEWEST_SAMPLES
    return [turn for turn in turns if len(turn.gyro_radps) >= fewest]


def with_bias(gyro: Gyroscope, rests: Sequence[RestTurns]) -> Gyroscope:
    """
    Give a gyroscope the bias of rests; it stays as it is where there are too few samples.

    The standard deviations are such that 1.645 of them are half of a 90 % interval, whatever the
    number of rests.
    """
    parts = _divided(rests)
    if len(parts) < _FEWEST_PARTS:
        return gyro
    means = np.array([part.gyro_radps.mean(axis=0) for part in parts])
    weight = np.array([float(len(part.gyro_radps)) for part in parts])
    temperature_c = np.array([part.temperature_c.mean() for part in parts])
    is_known = bool(np.isfinite(temperature_c).all())
    middle_c = float(np.average(temperature_c, weights=weight)) if is_known else np.nan
    departure_k = temperature_c - middle_c
    has_slope = is_known and bool(np.ptp(temperature_c) >= _TEMPERATURES_K)
    design = np.ones((len(parts), 1))
    if has_slope:
        design = np.column_stack([design, departure_k])
    fit = _weighted_fit(design, means, weight)
    range_c = (float(temperature_c.min()), middle_c, float(temperature_c.max()))
    return replace(
        gyro,
        bias_radps=tuple(fit.value[0].tolist()),
        bias_std_radps=tuple(np.hypot(fit.std[0], _rounding(parts)).tolist()),
        bias_per_k_radps=tuple(fit.value[1].tolist()) if has_slope else (),
        bias_per_k_std_radps=tuple(fit.std[1].tolist()) if has_slope else (),
        temperature_c=range_c if is_known else (),
    )


class _Fitted(NamedTuple):
    """Coefficients by axis."""

    value: np.ndarray  # (p, 3)
    std: np.ndarray  # Standard deviations, those of Student's t as of a normal one, (p, 3)


def _weighted_fit(design: np.ndarray, means: np.ndarray, weight: np.ndarray) -> _Fitted:
    """Fit means, (k, 3), by a design, (k, p), weighted by the numbers of their samples, (k,)."""
    root = np.sqrt(weight / weight.mean())[:, None]
    value = np.linalg.lstsq(design * root, means * root, rcond=None)[0]
    freedom = len(means) - design.shape[1]
    scatter = np.sum(((means - design @ value) * root) ** 2, axis=0) / freedom
    widths = np.diag(np.linalg.inv((design * root).T @ (design * root)))
    student = float(scipy.stats.t.ppf(_COVERED, freedom)) / Z_90
    return _Fitted(value, student * np.sqrt(np.outer(widths, scatter)))


def _divided(rests: Sequence[RestTurns]) -> list[RestTurns]:
    """Divide rests evenly until there are enough parts; none that is too short."""
    if not rests:
        return []
    count = ceil(_FEWEST_PARTS / len(rests))
    parts: list[RestTurns] = []
    for rest in rests:
        number = max(min(count, len(rest.gyro_radps) // _FEWEST_SAMPLES), 1)
        pieces = (np.array_split(values, number) for values in rest)
        parts += map(RestTurns, *pieces)
    return parts


def _rounding(parts: Sequence[RestTurns]) -> np.ndarray:
    """Return the standard deviation of a mean by rounding that no noise spreads, rad/s, (3,)."""
    changes = np.concatenate([np.abs(np.diff(part.gyro_radps, axis=0)) for part in parts])
    step = smallest_change(changes)
    std = np.sqrt(np.mean([part.gyro_radps.var(axis=0) for part in parts], axis=0))
    step[np.isinf(step)] = 0.0
    return np.where(std < DITHERED_STEPS * step, step / np.sqrt(12), 0.0)
