# SPDX-License-Identifier: Apache-2.0

"""White noise, bias instability and random walk of simulated signals, and their intervals."""

from adxl_ros.signals.noise_drift import DriftKind, find_drift
from adxl_ros.signals.noise_parameters import (
    coefficient_variances,
    coefficients,
    fit_noise,
    FLOOR,
    needed_time_s,
)
import numpy as np
import pytest
from scipy.linalg import toeplitz
from scipy.signal import lfilter
from still_noise import flicker, still_samples

N, B, K = 1e-3, 2e-4, 1e-5
STEP_S = 1.0


def cells(seed: int, count: int = 7200, terms: tuple[float, float, float] = (N, B, K)
          ) -> np.ndarray:
    """Return means of 1 s of samples at 10 Hz."""
    samples = still_samples(np.random.default_rng(seed), 10 * count, 10.0, *terms)
    return samples.reshape(count, 10).mean(axis=1)


def test_nine_of_ten_intervals_hold_the_truth() -> None:
    """test/long/noise_coverage.py draws 200 of each case; here are 40 of the middle one."""
    variances = coefficient_variances(7200, STEP_S)
    fits = [fit_noise(cells(seed), STEP_S, variances) for seed in range(40)]
    for name, truth in (('white', N), ('instability', B), ('walk', K)):
        estimates = [getattr(fit, name) for fit in fits]
        inside = sum(estimate.low <= truth <= estimate.high for estimate in estimates)
        # 40 draws of 0.9: 30 to 40 in 998 of 1000 cases.
        assert inside >= 30, name
        assert np.median([estimate.value for estimate in estimates]) == pytest.approx(
            truth, rel=0.25)


def test_the_fitted_curve_is_the_allan_deviation_of_the_terms() -> None:
    fit = fit_noise(cells(1), STEP_S)
    white, floor, walk = fit.lines(np.array([1.0, 3.0]))
    assert white == pytest.approx(fit.white.value / np.sqrt([1.0, 3.0]))
    assert floor == pytest.approx(np.full(2, np.sqrt(2 * np.log(2) / np.pi)
                                          * fit.instability.value))
    assert walk[1] == pytest.approx(fit.walk.value)
    assert fit.allan_deviation(np.array([1.0]))[0] ** 2 == pytest.approx(
        white[0] ** 2 + floor[0] ** 2 + walk[0] ** 2)


def test_a_term_that_the_time_does_not_show_has_an_upper_limit() -> None:
    fit = fit_noise(cells(2, 600, (N, 1e-4, 1e-6)), STEP_S)
    assert fit.white.is_seen
    assert not fit.walk.is_seen
    assert fit.walk.high > 1e-6
    assert needed_time_s(fit, 2, 600.0) > 600.0


def test_a_recording_as_long_as_needed_shows_the_term() -> None:
    fit = fit_noise(cells(3, 600, (N, 0.0, 1e-6)), STEP_S)
    needed_s = needed_time_s(fit, 2, 600.0)
    walk = fit.walk.high / 2
    seen = [fit_noise(cells(seed, int(2 * needed_s), (N, 0.0, walk)), STEP_S).walk.is_seen
            for seed in range(10)]
    assert sum(seen) >= 7


def test_a_filter_does_not_change_white_noise() -> None:
    """A moving average over 4 cells leaves a quarter of the band."""
    rng = np.random.default_rng(4)
    inside = 0
    for _ in range(10):
        white = rng.standard_normal(8003) * N / np.sqrt(STEP_S)
        fit = fit_noise(np.convolve(white, np.full(4, 0.25), 'valid'), STEP_S)
        inside += fit.white.low <= N <= fit.white.high
    assert inside >= 7


def test_a_tone_is_named() -> None:
    means = cells(5, terms=(N, 0.0, 0.0)) + 3e-3 * np.sin(2 * np.pi * 0.01 * np.arange(7200))
    octaves = fit_noise(means, STEP_S).octaves
    assert any(octave.low_hz <= 0.01 <= octave.high_hz and octave.ratio > 1.2
               for octave in octaves)


def test_lines_do_not_change_white_noise() -> None:
    """A line of a fan beside the band of a filter, and in the band of white noise."""
    rng, time_s = np.random.default_rng(9), np.arange(30000) / 50.0
    inside = 0
    for _ in range(10):
        white = rng.standard_normal(30000) * N * np.sqrt(50.0)
        line = 5e-3 * np.sin(2 * np.pi * 0.55 * time_s + rng.uniform(0, 6))
        fit = fit_noise(white + line, 1 / 50.0)
        inside += fit.white.low <= N <= fit.white.high
        assert fit.white.high < 1.05 * N
    assert inside >= 7


def test_a_walk_with_bounds() -> None:
    """Its density is known, where a walk without bounds would fall short of it."""
    rng, k, bound_s = np.random.default_rng(10), 1e-4, 100.0
    decay = np.exp(-STEP_S / bound_s)
    fits = []
    for _ in range(10):
        walk = lfilter([1.0], [1.0, -decay], rng.standard_normal(8000))[800:]
        walk *= k * np.sqrt(bound_s / 2 * (1 - decay ** 2))
        fits.append(fit_noise(walk + rng.standard_normal(7200) * N, STEP_S))
    assert all(fit.correlation is not None for fit in fits)
    assert sum(fit.walk.low <= k <= fit.walk.high for fit in fits) >= 7
    assert sum(fit.correlation.low <= bound_s <= fit.correlation.high for fit in fits) >= 7
    flat = fits[0].lines(np.array([1000.0, 10000.0]))[2]
    assert flat[0] / flat[1] > 2


def test_variances_of_the_coefficients() -> None:
    """A walk and white noise exactly by their covariance, 1/f noise by draws."""
    count = 64
    variances = coefficient_variances(count, STEP_S)
    lag = np.arange(count + 1.0)
    cubes = lag ** 3
    averaged = -np.concatenate([[2.0], cubes[2:] - 2 * cubes[1:-1] + cubes[:-2]]) / 12
    basis = np.array([coefficients(row) for row in np.eye(count)]).T
    walk = basis @ toeplitz(averaged) @ basis.T
    assert np.diag(walk) == pytest.approx(variances[:, 2], rel=1e-3)
    assert np.abs(walk - np.diag(np.diag(walk))).max() < 1e-9 * walk.max()
    rng = np.random.default_rng(6)
    drawn = np.array([coefficients(flicker(rng, 16 * count).reshape(count, 16).mean(axis=1))
                      for _ in range(2000)])
    assert (drawn ** 2).mean(axis=0)[:40] == pytest.approx(variances[:40, 1], rel=0.2)
    assert pytest.approx(0.664, abs=1e-3) == FLOOR


@pytest.mark.parametrize('kind', [None, *DriftKind])
def test_drift_is_named_with_its_size(kind: DriftKind | None) -> None:
    means, time_s = cells(7), np.arange(7200) * STEP_S
    temperature = 25 + 2 * np.sin(time_s / 1500)
    size, shape = {
        None: (0.0, time_s),
        DriftKind.TEMPERATURE: (3e-3, temperature),
        DriftKind.TREND: (3e-6, time_s),
        DriftKind.STEP: (5e-3, time_s >= 3000),
    }[kind]
    means = means + size * shape
    variances = coefficient_variances(7200, STEP_S)
    fit = fit_noise(means, STEP_S, variances)
    drift = find_drift(means, STEP_S, variances, fit, temperature)
    if kind is None:
        assert drift is None
        return
    assert drift is not None
    assert drift.kind is kind
    assert drift.size == pytest.approx(size, rel=0.25)
    assert drift.without.walk.value < fit.walk.value
    if kind is DriftKind.STEP:
        assert drift.cell == pytest.approx(3000, abs=10)
