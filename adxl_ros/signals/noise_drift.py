# SPDX-License-Identifier: Apache-2.0

"""Drift of a signal at rest that is no noise: with temperature, steady, or in a step."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

from adxl_ros.signals.noise_parameters import coefficients, fit_noise, NoiseFit
import numpy as np
import scipy

_TREND_GAIN = 12.0
"""Gain in twice the log likelihood from which a trend is named. Chosen: one chance in 2000."""
_STEP_GAIN = 30.0
"""The same of a step, whose time is searched. Chosen: also after a search over 10⁵ times rare."""
_FIT_ROUNDS = 3
"""Rounds that fit the size of a drift and the noise in turn. Chosen: sizes then stay."""
_TEMPERATURE_SHARE = 0.8
"""Share of the largest gain from which temperature is named first. Chosen: it is the cause, where
a trend or a step only describes."""


class DriftKind(Enum):
    """What a drift follows."""

    TEMPERATURE = 'temperature'
    TREND = 'trend'
    STEP = 'step'


@dataclass(frozen=True)
class Drift:
    """A drift of one axis; u is its unit."""

    kind: DriftKind  # What it follows
    size: float  # Its size: u/K, u/s, or u
    cell: int  # Number of the cell at which a step is; 0 for the others
    without: NoiseFit  # The noise without the drift


def find_drift(means: np.ndarray, step_s: float, variances: np.ndarray, fit: NoiseFit,
               temperature_c: np.ndarray | None) -> Drift | None:
    """
    Find the drift that explains most of the slow motion of a signal.

    Parameters
    ----------
    means
        Means of cells, u, (n,).
    step_s
        Length of a cell, s.
    variances
        Those of `coefficient_variances`.
    fit
        The noise of the same cells.
    temperature_c
        Temperature of the cells, °C, (n,); None where it is not measured.

    Returns
    -------
    Drift or None
        None where noise explains everything.

    """
    number = np.arange(len(means), dtype=float)
    shapes = {DriftKind.TREND: number * step_s}
    if temperature_c is not None and np.ptp(temperature_c) > 0:
        shapes[DriftKind.TEMPERATURE] = temperature_c
    cell = _likely_step(coefficients(means), variances, fit)
    shapes[DriftKind.STEP] = (number >= cell).astype(float)
    drifts = {}
    for kind, shape in shapes.items():
        size, without = _without(means, shape, step_s, variances, fit)
        limit = _STEP_GAIN if kind is DriftKind.STEP else _TREND_GAIN
        if _gain(without, fit) > limit:
            drifts[kind] = Drift(kind, size, cell if kind is DriftKind.STEP else 0, without)
    if not drifts:
        return None
    best = max(drifts.values(), key=lambda drift: _gain(drift.without, fit))
    warm = drifts.get(DriftKind.TEMPERATURE)
    if warm and _gain(warm.without, fit) > _TEMPERATURE_SHARE * _gain(best.without, fit):
        return warm
    return best


def _gain(fit: NoiseFit, before: NoiseFit) -> float:
    """Return the gain of twice the log likelihood."""
    return 2 * (fit.log_likelihood - before.log_likelihood)


def _without(means: np.ndarray, shape: np.ndarray, step_s: float, variances: np.ndarray,
             fit: NoiseFit) -> tuple[float, NoiseFit]:
    """Return the size of a drift of a shape, (n,), and the noise without it."""
    measured, expected = (coefficients(values)[:fit.highest] for values in (means, shape))
    size = 0.0
    for _ in range(_FIT_ROUNDS):
        weight = expected / (variances[:fit.highest] @ fit.squares)
        size = float(weight @ measured / (weight @ expected))
        fit = fit_noise(means - size * shape, step_s, variances, fit)
    return size, fit


def _likely_step(measured: np.ndarray, variances: np.ndarray, fit: NoiseFit) -> int:
    """
    Return the cell at which a step is most likely, by the matched filter for the fitted noise.

    Coefficient k of a unit step at cell p of n is −sin(k·π·p/n)/(√(2·n)·sin(k·π/(2·n))).
    """
    count = len(measured) + 1
    k = np.arange(1, count)
    variance = variances @ fit.squares
    factor = np.where(k < fit.highest, 1 / np.sin(k * np.pi / (2 * count)), 0.0)
    score = scipy.fft.dst(measured * factor / variance, type=1)
    weight = np.zeros(count)
    weight[1:] = factor ** 2 / variance
    # The sum of sin² by place: (1 − cos)/2 of the double angle.
    norm = weight.sum() - np.fft.fft(weight).real[1:]
    return 1 + int(np.argmax(score ** 2 / np.maximum(norm, 1e-6 * norm.max())))
