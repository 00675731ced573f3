# SPDX-License-Identifier: Apache-2.0

"""Sizes of errors: root mean squares, and what follows from a covariance."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def rms(values: np.ndarray | Sequence[float]) -> float:
    """Return the root of the mean square of all values."""
    return float(np.sqrt(np.mean(np.square(values))))


def stds(covariance: np.ndarray) -> np.ndarray:
    """Return the standard deviations of quantities with a covariance, (k, k): (k,)."""
    return np.sqrt(np.diag(covariance))


def variances_of(rows: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return the variances of sums with weights, (n, k), of quantities with a covariance: (n,)."""
    return np.einsum('ni,ij,nj->n', rows, covariance, rows)
