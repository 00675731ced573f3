# SPDX-License-Identifier: Apache-2.0

"""White noise, bias instability and random walk of simulated signals, and their intervals."""

from adxl_ros.signals.noise_fit import coefficient_variances, fit_noise
import numpy as np
import pytest
from scipy.signal import lfilter
from still_noise import still_samples

N, B, K = 1e-3, 2e-4, 1e-5
STEP_S = 1.0


def cells(
    seed: int, count: int = 7200, terms: tuple[float, float, float] = (N, B, K)
) -> np.ndarray:
    samples = still_samples(np.random.default_rng(seed), 10 * count, 10.0, *terms)
    return samples.reshape(count, 10).mean(axis=1)


@pytest.mark.long
def test_nine_of_ten_intervals_hold_the_truth() -> None:
    """docs/measurements/noise_coverage.md has 200 draws of more cases."""
    variances = coefficient_variances(7200, STEP_S)
    fits = [fit_noise(cells(seed), STEP_S, variances) for seed in range(40)]
    for name, truth in (('white', N), ('instability', B), ('walk', K)):
        estimates = [getattr(fit, name) for fit in fits]
        inside = sum(estimate.low <= truth <= estimate.high for estimate in estimates)
        # 40 draws of 0.9: 30 to 40 in 998 of 1000 cases.
        assert inside >= 30, name
        assert np.median([estimate.value for estimate in estimates]) == pytest.approx(
            truth, rel=0.25
        )


def test_the_fitted_curve_is_the_allan_deviation_of_the_terms() -> None:
    fit = fit_noise(cells(1), STEP_S)
    white, floor, walk = fit.lines(np.array([1.0, 3.0]))
    assert white == pytest.approx(fit.white.value / np.sqrt([1.0, 3.0]))
    assert floor == pytest.approx(
        np.full(2, np.sqrt(2 * np.log(2) / np.pi) * fit.instability.value)
    )
    assert walk[1] == pytest.approx(fit.walk.value)
    assert fit.allan_deviation(np.array([1.0]))[0] ** 2 == pytest.approx(
        white[0] ** 2 + floor[0] ** 2 + walk[0] ** 2
    )


def test_a_walk_with_bounds() -> None:
    """Its density is known, where a walk without bounds would fall short of it."""
    rng, k, bound_s = np.random.default_rng(10), 1e-4, 100.0
    decay = np.exp(-STEP_S / bound_s)
    fits = []
    for _ in range(10):
        walk = lfilter([1.0], [1.0, -decay], rng.standard_normal(8000))[800:]
        walk *= k * np.sqrt(bound_s / 2 * (1 - decay**2))
        fits.append(fit_noise(walk + rng.standard_normal(7200) * N, STEP_S))
    assert all(50.0 < fit.bound_s < 200.0 for fit in fits)
    assert sum(fit.walk.low <= k <= fit.walk.high for fit in fits) >= 7
    flat = fits[0].lines(np.array([1000.0, 10000.0]))[2]
    assert flat[0] / flat[1] > 2


@pytest.mark.parametrize('amplitude', [0.6, 2.0])
def test_a_line_leaves_the_truth_in_the_interval(amplitude: float) -> None:
    """It is left out with what is above, so that two windows of one log agree."""
    for seed in range(6):
        rng, time_s = np.random.default_rng(seed), np.arange(6000) * 0.1
        line = amplitude * np.sin(2 * np.pi * 0.55 * time_s + seed)
        white = fit_noise(N * (rng.standard_normal(6000) / 0.1**0.5 + line), 0.1).white
        assert 0.98 * white.low <= N <= 1.02 * white.high


@pytest.mark.parametrize('seconds', [10, 12])
def test_a_filter_is_no_walk(seconds: int) -> None:
    """White noise behind a filter has the spectrum of a walk with bounds, above its corner."""
    rate_hz, rc_s, step = 1000.0, 0.01056, 0.07 * N
    decay = np.exp(-1 / (rate_hz * rc_s))
    std = N / np.sqrt(2 * rc_s)
    for seed in range(3):
        drawn = np.random.default_rng(seed).standard_normal(seconds * 1000 + 200)
        samples = std * lfilter([np.sqrt(1 - decay**2)], [1.0, -decay], drawn)[200:]
        rounded = np.round(samples / step) * step
        fit = fit_noise(rounded, 1 / rate_hz, rounding=step / np.sqrt(12 * rate_hz))
        assert fit.white.low > 0
        assert fit.white.value == pytest.approx(N, rel=0.4)
        assert (fit.instability.low, fit.walk.low) == (0.0, 0.0)
