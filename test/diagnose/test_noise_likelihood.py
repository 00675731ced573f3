# SPDX-License-Identifier: Apache-2.0

"""The likelihood of noise with a drift, beside that of its covariance matrix."""

from dataclasses import replace

from adxl_ros.diagnose import evidence, noise_filters, noise_floor
from adxl_ros.diagnose.comparison import compare
from adxl_ros.files.recording_columns import Recording
from adxl_ros.model import noise
import numpy as np
import pytest
from units import nominal

RATE_HZ = 50.0
COUNT = 1000
TIME_S = np.arange(COUNT) / RATE_HZ


@pytest.fixture(scope='module')
def resting():
    """Return a recording of one axis at rest."""
    sensor = replace(nominal('x'), rate_hz=RATE_HZ)
    return compare(Recording('made', TIME_S, {'x_v': np.full(COUNT, 2.5)}), sensor)


def covariance_v2(comparison, walk_v):
    """Return the covariance of noise behind a filter, of rounding, and of a random walk."""
    sensor = comparison.sensor
    pole = np.exp(-comparison.dt_s / float(noise.electronics(sensor).rc_s[0]))
    number = np.arange(COUNT)
    analog_v2 = float(noise.analog_std_v(sensor)[0]) ** 2
    lag = np.abs(number[:, None] - number)
    walk_v2 = walk_v**2 * comparison.dt_s * (1 + np.minimum(number[:, None], number))
    return analog_v2 * pole**lag + walk_v2 + np.eye(COUNT) * sensor.lsb_v**2 / 12


def log_likelihood(volts, covariance):
    """Return the log likelihood at the best scale of a covariance, up to a constant."""
    _, log_determinant = np.linalg.slogdet(covariance)
    squares = volts @ np.linalg.solve(covariance, volts) / COUNT
    return -0.5 * (COUNT * np.log(squares) + log_determinant)


def walks(comparison):
    return [f for f in noise_filters.whiteners(comparison, 0) if f.effect == 'bias_walk']


@pytest.mark.parametrize('number', [2, 4, 6])
def test_innovations_have_the_likelihood_of_the_covariance(resting, number):
    """The determinant of a monic filter is 1, so that the sum of squares alone decides."""
    scale = float(resting.sensor.scale_v_per_g[0])
    filters = walks(resting)[number - 1 : number + 2]
    covariances_v2 = [covariance_v2(resting, f.density * scale) for f in filters]
    white = np.random.default_rng(number).normal(size=COUNT)
    volts = np.linalg.cholesky(covariances_v2[1]) @ white
    whitened = evidence.whiten_channel(
        volts[:, None], np.zeros(0, int), np.ones(COUNT, bool), filters
    )
    by_filter = -0.5 * COUNT * np.log(whitened.total_grams[:, 0, 0])
    exact = [log_likelihood(volts, covariance) for covariance in covariances_v2]
    # The filters begin with a step from zero, which the covariance does not have.
    assert np.diff(by_filter) == pytest.approx(np.diff(exact), rel=0.1, abs=2.0)


def test_a_fit_takes_the_drift_that_the_noise_has(resting):
    scale = float(resting.sensor.scale_v_per_g[0])
    filters = noise_filters.whiteners(resting, 0)
    density = noise_filters.RANDOM_WALKS_G_PER_RTS[-2]
    factor = np.linalg.cholesky(covariance_v2(resting, density * scale))
    volts = factor @ np.random.default_rng(1).normal(size=COUNT)
    channel = evidence.whiten_channel(
        volts[:, None], np.zeros(0, int), np.ones(COUNT, bool), filters
    )
    free = evidence.fit_columns([channel], [], np.zeros(0), drifts=('bias_walk',))
    healthy = evidence.fit_columns([channel], [], np.zeros(0))
    assert filters[free.filter_indices[0]].density == density
    assert filters[healthy.filter_indices[0]].healthy
    assert free.log_evidence > healthy.log_evidence + 10


@pytest.mark.parametrize('density, excess', [(1e-3, 1.0), (1e-2, 1.0), (2e-3, 3.0)])
def test_the_size_of_flicker_is_that_of_the_fitted_noise(resting, density, excess):
    """Noise above the stated one has a corner of its own, and the grid has no such density."""
    scale, rng = float(resting.sensor.scale_v_per_g[0]), np.random.default_rng(1)
    factor = np.linalg.cholesky(covariance_v2(resting, 0.0))
    shape = np.maximum(np.fft.rfftfreq(COUNT, 1 / RATE_HZ), 1 / TIME_S[-1]) ** -0.5
    flicker = np.fft.irfft(np.fft.rfft(rng.normal(size=COUNT)) * shape, COUNT)
    volts = excess * factor @ rng.normal(size=COUNT)
    volts += density * scale * np.sqrt(RATE_HZ / 2) * flicker
    filters = [f for f in noise_filters.whiteners(resting, 0) if f.effect == 'flicker']
    channel = evidence.whiten_channel(
        volts[:, None], np.zeros(0, int), np.ones(COUNT, bool), filters
    )
    squares_v2 = channel.total_grams[:, 0, 0]
    best = int(np.argmin(squares_v2))
    fitted = filters[best].density_per_v * np.sqrt(squares_v2[best] / COUNT)
    # The grid has steps of three.
    assert abs(np.log(fitted / density)) < np.log(3) / 2


def test_the_expected_drift_is_that_of_random_walks(resting):
    """A walk about its mean has a mean square of its variance at the end, divided by 6."""
    steps = np.random.default_rng(1).normal(size=(2000, COUNT)) / np.sqrt(RATE_HZ)
    paths = np.cumsum(1e-3 * steps, axis=1)
    rms_g = np.sqrt(np.mean(np.var(paths, axis=1)))
    assert noise_filters.expected_drift_g('bias_walk', 1e-3, resting) == pytest.approx(
        rms_g, rel=0.05
    )


def test_a_repeat_is_found_with_its_lag():
    rng = np.random.default_rng(1)
    angle_rad = np.interp(np.arange(6000), np.arange(0, 6001, 300), rng.uniform(0, 6, 21))
    direction = np.array([np.sin(angle_rad), np.cos(angle_rad), 0 * angle_rad])
    later = np.concatenate([direction[:, :700][:, ::-1], direction], axis=1)
    assert noise_floor.find_repeat(direction, later, RATE_HZ, 1e-4, False) == (700, 6000)
    other = np.roll(direction, 1, axis=0)
    assert noise_floor.find_repeat(direction, other, RATE_HZ, 1e-4, False) is None


def test_each_used_sample_is_in_one_block():
    used = np.ones(COUNT, bool)
    used[:100] = False
    assert evidence.sum_by_block(used).sum() == COUNT - 100
    assert evidence.block_grams(used[None].astype(float)).sum() == COUNT - 100
