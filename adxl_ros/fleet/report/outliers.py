# SPDX-License-Identifier: Apache-2.0

"""Recordings far from the others of their unit, by median and median absolute deviation."""

from __future__ import annotations

from adxl_ros.fleet.report.moderated_variance import moderated
from adxl_ros.fleet.report.trends import Recordings
from adxl_ros.model.constants import MAD_TO_STD
import numpy as np
import scipy

FALSE_OUTLIERS = 0.05
"""Probability that a fleet without outliers has one on its page. Chosen."""
_MIN_RECORDINGS = 5
"""Fewest recordings of a unit with outliers. Chosen: a median needs them."""
_MAD_EFFICIENCY = 0.37
"""Efficiency of that median for normal values (Rousseeuw and Croux 1993)."""
_MAD_BIAS = 0.8
"""That median of n values is too small by the factor 1 − 0.8/n (Croux and Rousseeuw 1992)."""


def outlier_distances(recordings: Recordings) -> tuple[np.ndarray, np.ndarray]:
    """
    Return how far recordings are from the median of their unit and period.

    returns: the distance in robust standard deviations, (n,), and the degrees of freedom of its t
    distribution, (n,). The distance is 0 where a period has too few recordings.
    """
    period, value = recordings.period, recordings.value
    counts = np.bincount(period)
    deviation = np.abs(value - _medians(period, value)[period])
    enough = counts >= _MIN_RECORDINGS
    # Both the median of few values and that of their deviations are uncertain.
    mad = MAD_TO_STD * counts / (counts - _MAD_BIAS) * _medians(period, deviation)
    variance, freedom = moderated(mad ** 2, np.where(
        enough, _MAD_EFFICIENCY * (counts - 1), 0.0))
    stated2 = recordings.std ** 2
    worse2 = np.maximum(stated2 - _medians(period, stated2)[period], 0.0)
    scale = np.sqrt((variance * (1 + np.pi / 2 / counts))[period] + worse2)
    distance = np.divide(deviation, scale, out=np.zeros(len(value)), where=scale > 0)
    return np.where(enough[period], distance, 0.0), freedom[period]


def are_outliers(distance: np.ndarray, freedom: np.ndarray, tests: int) -> np.ndarray:
    """
    Mark the recordings that are too far to be chance.

    distance, freedom: as `outlier_distances` returns them, (n,); returns: whether each recording
    is an outlier, (n,) bool.
    """
    limits = -scipy.special.stdtrit(np.minimum(freedom, 1e6), FALSE_OUTLIERS / (2 * max(tests, 1)))
    return distance > limits


def _medians(label: np.ndarray, value: np.ndarray) -> np.ndarray:
    """Return the median of the values with each label 0, 1, ..., which are sorted."""
    order = np.lexsort((value, label))
    counts = np.bincount(label)
    starts = np.cumsum(counts) - counts
    ordered = value[order]
    return (ordered[starts + (counts - 1) // 2] + ordered[starts + counts // 2]) / 2
