# SPDX-License-Identifier: Apache-2.0

"""With white noise the linear fit is Bayesian least squares, which has a closed form."""

from adxl_ros.diagnose.evidence import (
    BLOCKS,
    fit_columns,
    LinearFit,
    LinearisedHypothesis,
    whiten_channel,
)
from adxl_ros.diagnose.noise_filters import Whitener
from adxl_ros.model.effects.base import Coefficient
import numpy as np
import pytest
from scipy.stats import multivariate_normal
from units import nominal

COUNT = 480
PRIOR_STD = np.array([0.5, 2.0, 1.0])
PASSES_ALL = np.array([[1.0, 0.0, 0.0, 1.0, 0.0, 0.0]])
"""Second-order section of a filter that changes nothing."""


def white_filter():
    return Whitener(PASSES_ALL, 'bias_walk', 1e-7)


def problem(true=(0.3, -1.0, 0.0), noise_v=0.2, seed=1):
    """Return a residual, V, and three columns; the first sample, a step from zero, is 0."""
    rng = np.random.default_rng(seed)
    columns = rng.normal(size=(COUNT, 3))
    columns[0] = 0.0
    residual_v = columns @ np.array(true) + noise_v * rng.normal(size=COUNT)
    residual_v[0] = 0.0
    return residual_v, columns


def fitted(residual_v, columns, ids=(0, 1, 2), used=None, blocks=None):
    used = np.ones(COUNT, bool) if used is None else used
    design = np.column_stack([residual_v, columns])
    channel = whiten_channel(design, np.arange(3), used, [white_filter()])
    return fit_columns([channel], ids, PRIOR_STD, blocks)


def bayesian(residual_v, columns, variance_v2):
    """Return the posterior mean for a known variance."""
    precision = columns.T @ columns / variance_v2 + np.diag(PRIOR_STD**-2)
    return np.linalg.solve(precision, columns.T @ residual_v / variance_v2)


def test_the_posterior_is_that_of_bayesian_least_squares():
    residual_v, columns = problem()
    fit = fitted(residual_v, columns)
    variance_v2 = fit.innovation_variance_v2[0]
    precision = columns.T @ columns / variance_v2 + np.diag(PRIOR_STD**-2)
    assert fit.values == pytest.approx(bayesian(residual_v, columns, variance_v2), rel=1e-6)
    assert fit.covariance == pytest.approx(np.linalg.inv(precision), rel=1e-5)
    left = residual_v - columns @ fit.values
    assert variance_v2 == pytest.approx(np.mean(left**2), rel=1e-5)


def test_the_evidence_integrates_the_coefficients_out():
    """Two sets of columns differ by the ratio of their marginal likelihoods."""
    residual_v, columns = problem()
    evidence, marginal = [], []
    for ids in ((0, 1, 2), (0, 1), (1,)):
        fit = fitted(residual_v, columns, ids)
        chosen = columns[:, ids]
        covariance = (
            fit.innovation_variance_v2[0] * np.eye(COUNT)
            + chosen * PRIOR_STD[list(ids)] ** 2 @ chosen.T
        )
        evidence.append(fit.log_evidence)
        marginal.append(multivariate_normal.logpdf(residual_v, np.zeros(COUNT), covariance))
    assert np.diff(evidence) == pytest.approx(np.diff(marginal), rel=1e-6)


def test_blocks_that_are_left_out_do_not_count():
    residual_v, columns = problem()
    blocks = np.arange(BLOCKS) < BLOCKS // 2
    spoilt_v = residual_v.copy()
    spoilt_v[COUNT // 2 :] += 100.0
    assert fitted(spoilt_v, columns, blocks=blocks).values == pytest.approx(
        fitted(residual_v, columns, blocks=blocks).values, rel=1e-9
    )


def test_samples_that_are_not_used_do_not_count():
    residual_v, columns = problem()
    used = np.ones(COUNT, bool)
    used[100:140] = False
    spoilt_v = np.where(used, residual_v, 50.0)
    fit = fitted(spoilt_v, columns, used=used)
    assert fit.values == pytest.approx(
        bayesian(residual_v[used], columns[used], fit.innovation_variance_v2[0]), rel=1e-6
    )


@pytest.mark.parametrize('value', [0.0, 0.4])
def test_a_given_coefficient_moves_the_others_by_their_covariance(value):
    """The conditional mean of a normal distribution."""
    residual_v, columns = problem()
    fit = fitted(residual_v, columns)
    conditional = fit.given(np.array([0]), np.array([value]))
    slope = fit.covariance[1:, 0] / fit.covariance[0, 0]
    assert conditional == pytest.approx(
        [value, *(fit.values[1:] + slope * (value - fit.values[0]))]
    )


def test_the_loss_is_half_the_squared_distance():
    residual_v, columns = problem()
    fit = fitted(residual_v, columns)
    std = np.sqrt(fit.covariance[0, 0])
    assert fit.loss(np.array([0]), fit.values[:1] + 2 * std) == pytest.approx(2.0, rel=1e-6)


HELD = {
    'size': Coefficient('mount_resonance', 'gain'),
    'shape': Coefficient('mount_resonance', 'frequency_hz'),
    'limit': Coefficient('saturation', 'knee_g', 'x'),
}
"""A size, a shape, and a size of an effect with limits."""


def departures_of(kinds, std, *, full_std=None, change=1.0):
    """Return the departures of coefficients with mean 10 and prior 1, of fits that change all."""
    names = tuple(HELD[kind] for kind in kinds)
    count = len(names)

    def fit(std):
        values = np.full(count, change)
        return LinearFit(np.arange(count), values, np.diag(std**2), 0.0, (), np.ones(1))

    hypothesis = LinearisedHypothesis(
        effects=('mount_resonance',),
        sensor=nominal(),
        names=names,
        prior_mean=np.full(count, 10.0),
        prior_std=np.ones(count),
        reach=np.zeros(0),
        values=np.full(count, 10.5),
        channels=[],
        columns=[],
        filters=[],
    )
    full = None if full_std is None else fit(np.array(full_std))
    return hypothesis.departures(fit(np.array(std)), full)


def test_what_the_samples_do_not_determine_keeps_its_value_unless_it_is_a_size():
    kinds = ('size', 'shape', 'limit')
    assert departures_of(kinds, [0.1, 0.1, 0.1]) == pytest.approx([1.0, 1.0, 1.0])
    assert departures_of(kinds, [0.9, 0.9, 0.9]) == pytest.approx([1.0, 0.5, 0.5])


def test_some_blocks_that_determine_less_than_all_keep_the_value_too():
    assert departures_of(['shape'], [0.4], full_std=[0.1]) == pytest.approx([0.5])
    assert departures_of(['shape'], [0.4], full_std=[0.2]) == pytest.approx([1.0])


def test_a_shape_changes_by_a_factor_of_two_at_most():
    assert departures_of(['shape'], [0.1], change=30.0) == pytest.approx([11.0])
    assert departures_of(['size'], [0.1], change=30.0) == pytest.approx([30.0])


def test_a_nuisance_parameter_stays_within_the_reach_of_a_healthy_unit():
    """One that these blocks do not determine keeps that of all blocks; alone it goes beyond."""
    hypothesis = LinearisedHypothesis(
        effects=(),
        sensor=nominal(),
        names=(Coefficient('bias', 'offset_v', 'x'), Coefficient('bias', 'offset_v', 'y')),
        prior_mean=np.zeros(2),
        prior_std=np.ones(2),
        reach=np.array([0.5, 0.5]),
        values=np.zeros(0),
        channels=[],
        columns=[],
        filters=[],
    )
    ids = np.arange(2)
    fit = LinearFit(ids, np.array([2.0, 2.0]), np.diag([0.01, 1.0]), 0.0, (), np.ones(1))
    full = LinearFit(ids, np.array([0.1, 0.2]), np.diag([0.01, 0.01]), 0.0, (), np.ones(1))
    assert hypothesis.departures(fit) == pytest.approx([2.0, 2.0])
    assert hypothesis.departures(fit, full) == pytest.approx([0.5, 0.2])
