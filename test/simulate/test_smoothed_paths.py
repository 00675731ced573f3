# SPDX-License-Identifier: Apache-2.0

"""Paths through readings of encoders: their error, its prediction, and fast motion."""

import adxl_ros as adxl
from adxl_ros.simulate.recorded_motion import motion_from_references
from adxl_ros.simulate.smoothed_path import SmoothedPath, visible_step
from adxl_ros.simulate.trajectories import tumble
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
        for at_s, values in ((time_s, np.interp(time_s, read_s, readings)), (read_s, readings))
    )
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


def test_the_digits_of_a_fast_read_shift_are_no_force():
    """A shaker at 17.3 Hz, written to 10 nm a thousand times a second: known to 0.05 mg."""
    time_s = np.arange(20_000) / 1000
    stroke_m, omega = 1e-4, 2 * np.pi * 17.3
    shift_m = np.round(stroke_m * np.sin(omega * time_s), 8)
    angles_rad = {name: np.linspace(0, 1, len(time_s)) for name in ('alpha_rad', 'beta_rad')}
    read = adxl.from_arrays(
        time_s=time_s, x_v=2.5 + angles_rad['alpha_rad'], shift_m=shift_m, **angles_rad
    )
    path = motion_from_references(read, adxl.load('adxl203')).shift
    true_mps2 = -stroke_m * omega**2 * np.sin(omega * time_s)
    error_mps2 = (path(time_s, 2) - true_mps2)[1000:-1000]
    assert np.sqrt(np.mean(error_mps2**2)) < 0.05e-3 * 9.81
