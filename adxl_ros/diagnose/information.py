# SPDX-License-Identifier: Apache-2.0

"""
What an experiment is expected to tell between hypotheses with Gaussian predictions.

All hypotheses predict y = J·θ + e with white noise e of variance 1. They differ in what they know
of θ: mean m and covariance S. Only the products G = Jᵀ·J matter, so that the number of samples
does not.

The mutual information between hypothesis and data has no closed form. Pairwise Bhattacharyya
distances bound it from below (Kolchinsky and Tracey 2017, Entropy 19, 361, equation 10).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Belief:
    """What a hypothesis knows of k coefficients."""

    mean: np.ndarray  # Mean, (k,)
    root: np.ndarray  # Square root of the covariance, S = root·rootᵀ, (k, r)


def bhattacharyya(gram: np.ndarray, first: Belief, second: Belief) -> float:
    """
    Return the Bhattacharyya distance between the predictions of two hypotheses.

    gram: products of the sensitivities, in units of the noise, (k, k); returns: distance, nat; 0
    for equal predictions.
    """
    return _distance(gram, first, second) - 0.25 * (
        _log_det_of(gram, first) + _log_det_of(gram, second))


def _distance(gram: np.ndarray, first: Belief, second: Belief) -> float:
    """Return the part of the distance that is not a function of one belief alone."""
    both = np.hstack([first.root, second.root]) / np.sqrt(2)
    difference = first.mean - second.mean
    projected = gram @ difference
    middle = np.eye(both.shape[1]) + both.T @ gram @ both
    across = both.T @ projected
    # Woodbury: (1 + J·S·Jᵀ)⁻¹ within the span of J.
    square = float(difference @ projected - across @ np.linalg.solve(middle, across))
    return max(square, 0.0) / 8 + 0.5 * _log_det(middle)


def _log_det_of(gram: np.ndarray, belief: Belief) -> float:
    """Return the log determinant of the covariance of a prediction, in units of the noise."""
    return _log_det(np.eye(belief.root.shape[1]) + belief.root.T @ gram @ belief.root)


def _log_det(matrix: np.ndarray) -> float:
    """Return the log determinant of a positive definite matrix."""
    return float(np.linalg.slogdet(matrix)[1])


def expected_information(gram: np.ndarray, probabilities: Sequence[float],
                         beliefs: Sequence[Belief], factor: float = 1.0) -> float:
    """
    Return a lower bound of the information that an experiment gives on the hypothesis.

    gram: products of the sensitivities, in units of the noise, (k, k).
    """
    weights = np.asarray(probabilities, float)
    count = len(weights)
    overlap = np.eye(count)
    # One each, not one for each pair.
    log_dets = [_log_det_of(gram, belief) for belief in beliefs]
    for i in range(count):
        for j in range(i):
            distance = factor * (_distance(gram, beliefs[i], beliefs[j])
                                 - 0.25 * (log_dets[i] + log_dets[j]))
            overlap[i, j] = overlap[j, i] = np.exp(-max(distance, 0.0))
    positive = weights > 0
    return max(float(-weights[positive] @ np.log((overlap @ weights)[positive])), 0.0)


def entropy(probabilities: Sequence[float]) -> float:
    """Return the entropy of probabilities, nat."""
    weights = np.asarray(probabilities, float)
    weights = weights[weights > 0]
    return float(-weights @ np.log(weights))
