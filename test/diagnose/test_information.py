# SPDX-License-Identifier: Apache-2.0

"""The expected information in cases with a closed form."""

from adxl_ros.diagnose.information import Belief, bhattacharyya, entropy, expected_information
import numpy as np
import pytest


def random_belief(rng, count, rank):
    return Belief(rng.normal(size=count), rng.normal(size=(count, rank)))


def test_the_distance_of_two_known_predictions_is_an_eighth_of_the_squared_difference():
    gram = np.diag([4.0, 1.0])
    first = Belief(np.array([1.0, 0.0]), np.zeros((2, 0)))
    second = Belief(np.array([0.0, 2.0]), np.zeros((2, 0)))
    assert bhattacharyya(gram, first, second) == pytest.approx((4 + 4) / 8)


def test_the_distance_of_two_variances_is_that_of_the_textbook():
    variance = np.array([1 + 3.0 ** 2, 1 + 0.5 ** 2])
    distance = bhattacharyya(np.eye(1), Belief(np.zeros(1), np.array([[3.0]])),
                             Belief(np.zeros(1), np.array([[0.5]])))
    expected = 0.5 * np.log(variance.mean() / np.sqrt(variance.prod()))
    assert distance == pytest.approx(expected)


def test_the_distance_equals_that_of_the_samples_themselves():
    rng = np.random.default_rng(1)
    design = rng.normal(size=(50, 4))
    first, second = random_belief(rng, 4, 3), random_belief(rng, 4, 2)
    covariances = [np.eye(50) + design @ b.root @ b.root.T @ design.T for b in (first, second)]
    middle = sum(covariances) / 2
    difference = design @ (first.mean - second.mean)
    half_logs = [np.linalg.slogdet(c)[1] / 4 for c in covariances]
    expected = difference @ np.linalg.solve(middle, difference) / 8 \
        + np.linalg.slogdet(middle)[1] / 2 - sum(half_logs)
    assert bhattacharyya(design.T @ design, first, second) == pytest.approx(expected)


def test_two_hypotheses_give_less_information_than_their_exact_mutual_information():
    # y = 0 or d, with noise 1: the mutual information by integration.
    d, y = 1.5, np.linspace(-12, 14, 20001)
    densities = np.array([np.exp(-y ** 2 / 2), np.exp(-(y - d) ** 2 / 2)]) / np.sqrt(2 * np.pi)
    mixture = densities.mean(axis=0)
    exact = np.mean([np.sum(p * np.log(p / mixture)) for p in densities]) * (y[1] - y[0])
    beliefs = [Belief(np.array([m]), np.zeros((1, 0))) for m in (0.0, d)]
    bound = expected_information(np.eye(1), [0.5, 0.5], beliefs)
    assert 0.5 * exact < bound < exact


def test_information_is_between_none_and_the_entropy():
    beliefs = [Belief(np.array([m]), np.zeros((1, 0))) for m in (0.0, 1.0, 2.0)]
    probabilities = [0.5, 0.3, 0.2]
    assert expected_information(np.zeros((1, 1)), probabilities, beliefs) == pytest.approx(0)
    assert expected_information(1e6 * np.eye(1), probabilities, beliefs) \
        == pytest.approx(entropy(probabilities))
    smaller, larger = (expected_information(g * np.eye(1), probabilities, beliefs)
                       for g in (1.0, 2.0))
    assert 0 < smaller < larger < entropy(probabilities)
    assert expected_information(np.eye(1), probabilities, beliefs, 0.3) < smaller
