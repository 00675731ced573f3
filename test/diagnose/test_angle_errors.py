# SPDX-License-Identifier: Apache-2.0

"""Errors of the followed angles are a part of the noise."""

from dataclasses import replace

from adxl_ros.diagnose.comparison import compare
from adxl_ros.diagnose.reference import angle_error_filter
from adxl_ros.files import parameter_file
from adxl_ros.files.recording_columns import Recording
from adxl_ros.files.stream_info import sensor_info
from adxl_ros.simulate import simulator
from adxl_ros.simulate.trajectories import tumble
import numpy as np
import pytest

RATE_HZ = 100.0
"""Sample rate of the recordings, Hz."""


def comparison_of(motion, **fields):
    """Return a recording of the nominal sensor beside its simulation."""
    sensor = replace(parameter_file.load(parameter_file.nominal_path()), rate_hz=RATE_HZ, **fields)
    columns = simulator.simulate(sensor, motion, 1)
    time_s = columns.pop('time_s')
    return compare(Recording('drawn', time_s, columns, sensor_info(sensor)), sensor)


def power(values_v):
    """Return the mean square of the means over each second."""
    count = int(RATE_HZ)
    means = values_v[:len(values_v) // count * count].reshape(-1, count).mean(axis=1)
    return np.mean(means ** 2)


def test_noise_with_errors_of_angles_becomes_that_without():
    """Rounded poses add five times the power of the noise below 1 Hz; the filter removes most."""
    comparison = comparison_of(tumble(np.random.default_rng(2)))
    residual_v = comparison.residual_v(comparison.sensor)
    noise_v = comparison.simulated_noise_v(comparison.sensor, 5)
    for axis in range(2):
        filtered_v = angle_error_filter(comparison, axis)(residual_v.T)[axis]
        expected = power(noise_v[:, axis])
        assert power(residual_v[:, axis]) > 6 * expected
        assert 0.3 * expected < power(filtered_v) < 2 * expected
        assert np.std(filtered_v) == pytest.approx(np.std(noise_v[:, axis]), rel=0.1)
