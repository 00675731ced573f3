# SPDX-License-Identifier: Apache-2.0

"""Motion raises the variance of the tilt by the acceleration that it shows; a rest does not."""

from adxl_ros.compensate.motion_measure import MotionMeasure
from adxl_ros.model.constants import Z_90
from adxl_ros_validation.driving_robots import KINDS, measure
import numpy as np
import pytest

G = 9.80665
NOISE_MPS2 = 0.01
RATE_HZ = 100


def shown_mps2(force_mps2: np.ndarray, vibration_mps2: float = 0.0) -> np.ndarray:
    """Return the acceleration that each sample of a force, (n, 3), shows, m/s², (n,)."""
    rng = np.random.default_rng(3)
    noisy = force_mps2 + rng.normal(0.0, np.hypot(NOISE_MPS2, vibration_mps2), force_mps2.shape)
    motion, shown = MotionMeasure([NOISE_MPS2**2] * 2, G), []
    for i, force in enumerate(noisy.tolist()):
        changes = motion.changes(force, i / RATE_HZ)
        shown.append(max(changes, motion.of_length(force, NOISE_MPS2**2)) ** 0.5)
    return np.array(shown)


def level(seconds: float) -> np.ndarray:
    return np.tile([0.0, 0.0, G], (round(seconds * RATE_HZ), 1))


@pytest.mark.parametrize('brakes_mps2', [0.5, 2.0])
def test_a_brake_raises_it_by_its_size_until_the_robot_has_rested(brakes_mps2: float) -> None:
    force = level(20)
    force[1000:1200, 0] = brakes_mps2
    shown = shown_mps2(force)
    assert (shown[:1000] < 0.05).mean() > 0.99
    assert np.min(shown[1050:1200]) / brakes_mps2 > 0.6
    assert np.median(shown[1050:1200]) / brakes_mps2 < 1.5
    assert (shown[1700:] < 0.05).mean() > 0.99


def test_a_steady_turn_of_a_robot_that_vibrates_is_seen_by_the_length_of_the_force() -> None:
    force = level(40)
    force[1000:, 1] = 3.0
    shown = shown_mps2(force, vibration_mps2=0.2)
    assert 2.5 < np.median(shown[3000:]) < 3.6


def test_an_error_of_the_length_is_no_motion_of_a_sensor_that_rests() -> None:
    """An acceleration across gravity that lengthens the force by 10 mg is 1.4 m/s²."""
    shown = shown_mps2(level(10) * 1.01)
    assert np.median(shown) < 0.15


def test_the_stated_deviation_of_a_robot_that_drives_covers_its_error() -> None:
    for kind in KINDS.values():
        robot = measure(kind, 7)
        error_rad = np.abs(robot.tilt_rad - robot.true_rad)
        inside = error_rad <= Z_90 * np.sqrt(robot.variance_rad2)
        assert inside[robot.is_driving].mean() > 0.9
        assert inside[~robot.is_driving].mean() > 0.88
        resting = error_rad <= Z_90 * np.sqrt(robot.resting_rad2)
        assert resting[robot.is_driving].mean() < 0.6
