# SPDX-License-Identifier: Apache-2.0

"""
Variances of units that moderate each other.

The variances have a scaled inverse χ² distribution over units, whose two parameters the units
determine (Smyth 2004, section 6.2). Each unit then has the mean of its own variance and that of
all, by their degrees of freedom.
"""

from __future__ import annotations

import numpy as np
import scipy

_EQUAL_VARIANCES = 1e6
"""Degrees of freedom of the common variance where units do not differ. Chosen: infinite."""
_NO_FREEDOM = 1e-6
"""Degrees of freedom of the common variance of one unit, which moderates none. Chosen: small."""
_ROUNDS = 20
"""Steps of Newton's method; it converges in fewer than ten."""


def moderated(variance: np.ndarray, freedom: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    Moderate the variances of units.

    variance: variances of the units, (m,). Those without a degree of freedom may be NaN.; freedom:
    their degrees of freedom, (m,); 0 for none; returns: moderated variances and their degrees of
    freedom, (m,) each. Without any variance all are 1.
    """
    determined = freedom > 0
    common, common_freedom = _common(variance[determined], freedom[determined])
    squares = np.where(determined, freedom * np.nan_to_num(variance), 0.0)
    total = common_freedom + freedom
    # What all units share is no better known than from all of their recordings (limma).
    largest = float(freedom[determined].sum())
    return (common_freedom * common + squares) / total, np.minimum(total, largest or np.inf)


def _common(variance: np.ndarray, freedom: np.ndarray) -> tuple[float, float]:
    """Return the scale of the inverse χ² distribution and its degrees of freedom."""
    freedom, variance = freedom[variance > 0], variance[variance > 0]
    if len(variance) < 2:
        return (float(variance[0]), _NO_FREEDOM) if len(variance) else (1.0, _EQUAL_VARIANCES)
    log_variance = np.log(variance) - scipy.special.digamma(freedom / 2) + np.log(freedom / 2)
    mean = float(log_variance.mean())
    excess = float(log_variance.var(ddof=1) - scipy.special.polygamma(1, freedom / 2).mean())
    if excess <= 0:
        return float(np.exp(mean)), _EQUAL_VARIANCES
    half = _inverse_trigamma(excess)
    return float(np.exp(mean + scipy.special.digamma(half) - np.log(half))), 2 * half


def _inverse_trigamma(value: float) -> float:
    """Solve trigamma(x) = value by Newton's method (Smyth 2004, appendix)."""
    x = 0.5 + 1 / value
    for _ in range(_ROUNDS):
        trigamma = float(scipy.special.polygamma(1, x))
        x += trigamma * (1 - trigamma / value) / float(scipy.special.polygamma(2, x))
    return min(x, _EQUAL_VARIANCES / 2)
