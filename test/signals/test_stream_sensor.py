# SPDX-License-Identifier: Apache-2.0

"""What a stream shows of a sensor that states nothing: a host changes the stamps, not the rate."""

from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file
from adxl_ros.signals.recorded_sensor import sensor_of_stream
import numpy as np
import pytest

G, RATE_HZ = 9.80665, 200.0
SENSOR = parameter_file.usual(is_nominal=False)


def resting(time_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    noise = np.random.default_rng(1).normal(0, 0.02, (len(time_s), 3))
    return np.rint(1.7e18 + time_s * 1e9).astype(np.int64), noise + [0.0, 0.0, G]


def even(seconds: float = 3.0) -> np.ndarray:
    return np.arange(round(seconds * RATE_HZ)) / RATE_HZ


@pytest.mark.parametrize(
    'time_s',
    [
        np.ceil(even() / 4.25e-3) * 4.25e-3,
        even()[np.random.default_rng(2).random(600) > 0.05],
        even() + np.random.default_rng(3).uniform(0, 4e-3, 600),
    ],
    ids=['polled', 'lossy', 'jitter'],
)
def test_the_rate_is_that_of_the_samples(time_s: np.ndarray) -> None:
    unit, lines = sensor_of_stream(SENSOR, *resting(time_s))
    assert unit.rate_hz == pytest.approx(RATE_HZ, rel=0.01)
    assert not unit.unstated and not any('left out' in line for line in lines)


def test_a_few_stamps_that_step_back_are_left_out_and_named() -> None:
    time_s = even()
    time_s[100::60] -= 0.012
    unit, lines = sensor_of_stream(SENSOR, *resting(time_s))
    assert unit.rate_hz == pytest.approx(RATE_HZ, rel=0.02)
    assert '9 of 600 samples, whose stamp steps back by up to 7 ms' in lines[-1]


@pytest.mark.parametrize(
    ('time_s', 'words'),
    [
        (np.where(np.arange(600) % 2, even(), even() - 0.02), 'steps back'),
        (np.where(even() < 1.5, even(), 1.5 + 0.4 * (even() - 1.5)), 'uneven'),
        (np.repeat(0.25 * np.arange(12), 8) + np.tile(1e-3 * np.arange(8), 12), 'gaps of up to'),
    ],
)
def test_what_is_wrong_with_the_stamps_is_named(time_s: np.ndarray, words: str) -> None:
    with pytest.raises(UserError, match=words):
        sensor_of_stream(SENSOR, *resting(time_s))
