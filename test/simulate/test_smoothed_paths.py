# SPDX-License-Identifier: Apache-2.0

"""Paths through readings of encoders: their error, its prediction, and fast motion."""

from adxl_ros.simulate.smoothed_paths import (
    BAND_LIMITED_DEGREE,
    SmoothedPath,
    visible_step,
)
from adxl_ros.simulate.trajectories import shaker, tumble
import numpy as np
import pytest

STEP = np.radians(1 / 12)
"""Step of the encoder of the default stage, rad."""


def followed_tumble(rate_hz):
    """Return times, s, path and error, rad, of beta in 30 poses behind an encoder."""
    motion = tumble(np.random.default_rng(3))
    time_s = np.arange(200 * rate_hz) / rate_hz
    true = motion.beta(time_s)
    path = SmoothedPath(time_s, np.rint(true / STEP) * STEP, STEP)
    return time_s, path, path(time_s) - true, np.abs(motion.beta(time_s, 1)) > 0.2


@pytest.mark.parametrize('rate_hz', [25, 100, 500])
def test_motion_is_known_better_than_one_reading(rate_hz):
    """In motion the error is below half of that of a reading; nowhere is it above a step."""
    _, _, error_rad, moving = followed_tumble(rate_hz)
    assert np.sqrt(np.mean(error_rad[moving] ** 2)) < 0.5 * STEP / np.sqrt(12)
    assert np.abs(error_rad).max() < STEP


@pytest.mark.parametrize('rate_hz', [25, 100, 500])
def test_predicted_error_is_that_of_the_path(rate_hz):
    """At rest it holds within 20 %; in fast motion it is at most five times too large."""
    time_s, path, error_rad, moving = followed_tumble(rate_hz)
    errors = path.errors(time_s)
    at_rest = errors.forgetting_per_s == 0
    ratio = np.sqrt(np.mean(error_rad[at_rest] ** 2)) / errors.std[at_rest].mean()
    assert ratio == pytest.approx(1, abs=0.2)
    ratio = np.sqrt(np.mean(error_rad[moving] ** 2) / np.mean(errors.std[moving] ** 2))
    assert 0.2 < ratio < 1.2


def test_an_exact_path_has_no_error():
    """Without a step no error is predicted, and the path passes through the readings."""
    time_s = np.arange(500) / 100
    reading = np.sin(time_s)
    path = SmoothedPath(time_s, reading, 0.0)
    assert path.errors(time_s) is None
    assert path(time_s) == pytest.approx(reading, abs=1e-12)


def test_a_shaker_close_to_half_the_sample_rate_is_followed():
    """At 100 Hz the acceleration of a shaker up to 40 Hz is exact to 1 %, also between samples."""
    motion = shaker(np.random.default_rng(0))
    time_s = np.arange(5500) / 100
    path = SmoothedPath(time_s, motion.shift(time_s), 0.0, BAND_LIMITED_DEGREE)
    dense_s = np.arange(54000) / 1000
    true = motion.shift(dense_s, 2)
    assert np.abs(path(dense_s, 2) - true).max() < 0.01 * np.abs(true).max()


def test_a_gap_between_exact_readings_is_bridged_without_overshoot():
    """Over a gap the path stays within the range of the readings."""
    time_s = np.delete(np.arange(1000) / 100, slice(400, 480))
    reading = np.tanh(time_s - 4.4)
    path = SmoothedPath(time_s, reading, 0.0, BAND_LIMITED_DEGREE)
    assert np.abs(path(np.arange(1000) / 100)).max() < 1.1


def test_readings_that_no_encoder_gives_are_followed():
    """Readings with noise of two steps stay within four steps of the path."""
    time_s = np.arange(6000) / 100
    rng = np.random.default_rng(0)
    reading = np.rint(np.sin(0.5 * time_s) / STEP + rng.normal(0, 2, len(time_s))) * STEP
    error_rad = SmoothedPath(time_s, reading, STEP)(time_s) - np.sin(0.5 * time_s)
    assert np.sqrt(np.mean(error_rad ** 2)) < 4 * STEP


def test_a_joint_that_rests_for_most_of_the_time_is_followed():
    """Rests with rounding errors of floats do not make the path stiff for the moves."""
    time_s = np.arange(40000) / 100
    true = 1.0 + 1e-15 * np.sin(1e3 * time_s) + 0.5 * (1 + np.tanh(time_s - 200)) * 0.8
    path = SmoothedPath(time_s, true, STEP)
    assert np.abs(path(time_s) - true).max() < STEP


@pytest.mark.parametrize('offset', [0, 0.4])
@pytest.mark.parametrize('samples', [5, 10, 40])
def test_lines_between_the_readings_of_an_encoder_are_no_finer_reference(samples, offset):
    """Samples at 1 kHz beside an encoder at 200, 100 or 25 Hz, at their stamps and between."""
    time_s = np.arange(60_000) / 1000
    read_s = (np.arange(0, 60_000, samples) + offset) / 1000
    path = tumble(np.random.default_rng(3)).beta
    lines = np.interp(time_s, read_s, np.rint(path(read_s) / STEP) * STEP)
    assert visible_step(lines, STEP) == STEP


@pytest.mark.parametrize('offset', [0, 0.4])
@pytest.mark.parametrize('speed', [1.0, 0.1])
def test_a_path_along_lines_is_as_good_as_one_through_the_readings(speed, offset):
    """Samples at 1 kHz, an encoder at 100 Hz; a part of a sample costs a part of a step."""
    def true(at_s):
        return 0.8 * np.sin(speed * at_s) + 0.3 * np.sin(2.3 * speed * at_s)

    time_s = np.arange(60_000) / 1000
    read_s = (np.arange(0, 60_000, 10) + offset) / 1000
    readings = np.rint(true(read_s) / STEP) * STEP
    inside_s = time_s[1000:-1000]
    along, through = (
        np.std(SmoothedPath(at_s, values, STEP)(inside_s) - true(inside_s))
        for at_s, values in ((time_s, np.interp(time_s, read_s, readings)), (read_s, readings)))
    assert along < 1.2 * through + 0.025 * offset * STEP


@pytest.mark.parametrize('rate_hz', [100, 500])
def test_a_reference_finer_than_the_stated_step_is_followed_exactly(rate_hz):
    """A finer reference counts as such, and an encoder does not, even where interpolated."""
    time_s = np.arange(100 * rate_hz) / rate_hz
    true = tumble(np.random.default_rng(3)).beta(time_s)
    coarse = np.rint(true / STEP) * STEP
    interpolated = np.interp(time_s, time_s[::5], coarse[::5])
    assert visible_step(true, STEP) < 0.01 * STEP
    assert visible_step(np.rint(true * 1e5) / 1e5, STEP) < 0.02 * STEP
    assert np.abs(SmoothedPath(time_s, true, STEP)(time_s) - true).max() < 0.01 * STEP
    for encoder in (coarse, interpolated):
        assert visible_step(encoder, STEP) == STEP
        assert visible_step(encoder, 0.996 * STEP) == 0.996 * STEP
