# SPDX-License-Identifier: Apache-2.0

"""The expected information in cases with a closed form."""

from adxl_ros.diagnose.next_experiment import expected_information, KnownCoefficients
import numpy as np
import pytest
import scipy


def test_two_hypotheses_give_less_information_than_their_exact_mutual_information():
    # y = 0 or d, with noise 1: the mutual information by integration.
    d, y = 1.5, np.linspace(-12, 14, 20001)
    densities = np.array([np.exp(-(y**2) / 2), np.exp(-((y - d) ** 2) / 2)]) / np.sqrt(2 * np.pi)
    mixture = densities.mean(axis=0)
    exact = np.mean([np.sum(p * np.log(p / mixture)) for p in densities]) * (y[1] - y[0])
    beliefs = [KnownCoefficients(np.array([m]), np.zeros((1, 1))) for m in (0.0, d)]
    bound = expected_information(np.eye(1), [0.5, 0.5], beliefs)
    assert 0.5 * exact < bound < exact


def test_information_is_between_none_and_the_entropy():
    beliefs = [KnownCoefficients(np.array([m]), np.zeros((1, 1))) for m in (0.0, 1.0, 2.0)]
    probabilities = [0.5, 0.3, 0.2]
    assert expected_information(np.zeros((1, 1)), probabilities, beliefs) == pytest.approx(0)
    assert expected_information(1e6 * np.eye(1), probabilities, beliefs) == pytest.approx(
        scipy.stats.entropy(probabilities)
    )
    smaller, larger = (
        expected_information(g * np.eye(1), probabilities, beliefs) for g in (1.0, 2.0)
    )
    assert 0 < smaller < larger < scipy.stats.entropy(probabilities)
    assert expected_information(np.eye(1), probabilities, beliefs, 0.3) < smaller
