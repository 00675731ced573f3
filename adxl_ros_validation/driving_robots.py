# SPDX-License-Identifier: Apache-2.0

"""
Simulated robots that drive, brake and turn: the error of their tilt, and what is stated of it.

A robot with wheels rests, speeds up, turns and brakes, again and again, on ground whose slope has
3° rms. It vibrates while it drives, three times as much along z as along x and y. Its sensor has a
calibration, whose errors are drawn from its covariance; the gyroscope has noise, and what is left
of its bias.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from adxl_ros.compensate.estimators import LiveEstimator
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.effects.base import FLOATS
from adxl_ros.model.gyroscope import Gyroscope
from adxl_ros.model.kinematics import angles
from adxl_ros.model.sensor import get, put
from adxl_ros.simulate.gyroscope_model import GyroscopeModel
from adxl_ros.simulate.motion import ForcePath, Motion
from adxl_ros.simulate.response import simulate_blocks
from adxl_ros_validation.kept_robots import calibrated
import numpy as np
import scipy

RATE_HZ = 100.0
_STEP_S = 1e-3  # Step of the path
_DURATION_S = 120.0
_JERK_S = 0.3  # Time in which an acceleration begins or ends
_SLOPE_RAD = np.radians(3.0)  # Of the ground, rms
_VIBRATION_MPS2 = np.array([0.2, 0.2, 0.6])  # Rms at 1 m/s and faster
_VIBRATION_HZ = (5.0, 40.0)
_STANDS_MPS = 0.05
_GYRO_NOISE_RADPS_PER_RTHZ = np.radians(5e-3)
_GYRO_BIAS_RADPS = np.radians(0.03)  # What the subtraction of the bias leaves, standard deviation


@dataclass(frozen=True)
class Kind:
    """How a robot drives, and what it has."""

    slowest_mps2: float  # Accelerations are drawn between this
    fastest_mps2: float  # and this
    axes: str = AXES


KINDS = {
    'gentle, 0.2 to 1 m/s²': Kind(0.2, 1.0),
    'firm, 1 to 4 m/s²': Kind(1.0, 4.0),
    'firm, two axes': Kind(1.0, 4.0, 'xy'),
}


@dataclass(frozen=True)
class Drive:
    """The truth at the steps of a path."""

    time_s: np.ndarray  # (n,)
    force_mps2: np.ndarray  # Specific force in the frame of the robot, (n, 3)
    rate_radps: np.ndarray  # Angular velocity in the frame of the robot, (n, 3)
    tilt_rad: np.ndarray  # Roll and pitch, (n, 2)
    is_driving: np.ndarray  # Whether the wheels turn, (n,)


def drive(kind: Kind, rng: np.random.Generator) -> Drive:
    """Draw a drive."""
    time_s = np.arange(round(_DURATION_S / _STEP_S)) * _STEP_S
    forward, sideways = _accelerations(kind, time_s, rng)
    speed = np.maximum(np.cumsum(forward) * _STEP_S, 0.0)
    way_m = np.cumsum(speed) * _STEP_S
    is_driving = speed > _STANDS_MPS
    yaw_rate = np.where(is_driving, sideways / np.maximum(speed, 0.1), 0.0)
    yaw_pitch_roll = np.column_stack(
        [np.cumsum(yaw_rate) * _STEP_S, _slope(way_m, rng), _slope(way_m, rng)]
    )
    attitude = scipy.spatial.transform.Rotation.from_euler('ZYX', yaw_pitch_roll)
    turns = (attitude[:-1].inv() * attitude[1:]).as_rotvec()
    rate = np.vstack([turns, turns[-1:]]) / _STEP_S
    # The velocity is along x of the robot, which turns with it.
    velocity = np.outer(speed, [1.0, 0.0, 0.0])
    accel = np.gradient(velocity, _STEP_S, axis=0) + np.cross(rate, velocity)
    band = scipy.signal.butter(2, _VIBRATION_HZ, 'bandpass', fs=1 / _STEP_S, output='sos')
    shaken = scipy.signal.sosfilt(band, rng.standard_normal(rate.shape), axis=0)
    shaken *= _VIBRATION_MPS2 / shaken.std(axis=0) * np.minimum(speed, 1.0)[:, None]
    force = accel + attitude.inv().apply([0.0, 0.0, G0_MPS2]) + shaken
    return Drive(time_s, force, rate, yaw_pitch_roll[:, :0:-1], is_driving)


def _accelerations(kind: Kind, time_s: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Draw the acceleration of the wheels forward, and to the left, m/s², (2, n)."""
    accel, begin_s = np.zeros((2, len(time_s))), 5.0
    while begin_s < _DURATION_S - 25:
        speed_mps = rng.uniform(1.0, 3.0)
        speeds_up, turns, brakes = rng.uniform(kind.slowest_mps2, kind.fastest_mps2, 3)
        for row, value, duration_s, pause_s in (
            (0, speeds_up, speed_mps / speeds_up, rng.uniform(1.0, 3.0)),
            (1, turns * rng.choice([-1.0, 1.0]), rng.uniform(1.0, 4.0), rng.uniform(1.0, 3.0)),
            (0, -brakes, speed_mps / brakes, rng.uniform(2.0, 6.0)),
        ):
            accel[row, (begin_s <= time_s) & (time_s < begin_s + duration_s)] = value
            begin_s += duration_s + pause_s
    ramp = np.full((1, round(_JERK_S / _STEP_S)), _STEP_S / _JERK_S)
    return np.asarray(scipy.signal.convolve(accel, ramp, 'same'))


def _slope(way_m: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the slope of the ground along a way, rad, (n,)."""
    waves = zip(2 * np.pi / rng.uniform(4.0, 20.0, 4), rng.uniform(0, 2 * np.pi, 4))
    total = sum(np.sin(number * way_m + phase) for number, phase in waves)
    return np.asarray(_SLOPE_RAD * total / np.sqrt(2.0))


@dataclass(frozen=True)
class Measured:
    """Samples of the sensors on a drive, as the compensation publishes them, and the truth."""

    time_s: np.ndarray  # (n,)
    tilt_rad: np.ndarray  # Roll and pitch of the samples, (n, 2)
    variance_rad2: np.ndarray  # Their variances, (n, 2)
    resting_rad2: np.ndarray  # Their variances by noise and coefficients alone, (n, 2)
    rate_radps: np.ndarray  # Angular velocity, (n, 3)
    rate_variance: float  # Its variance, (rad/s)²
    true_rad: np.ndarray  # True roll and pitch, (n, 2)
    is_driving: np.ndarray  # (n,)


def measure(kind: Kind, seed: int) -> Measured:
    """Draw a robot and its drive, and measure it."""
    rng = np.random.default_rng([seed, 46])
    path = drive(kind, rng)
    sensor = replace(calibrated(kind.axes), rate_hz=RATE_HZ)
    names, stds = sensor.covariance_names, np.sqrt(np.diag(sensor.covariance))
    unit = put(sensor, names, get(sensor, names) + rng.normal(0.0, stds))
    motion = Motion(_DURATION_S, force=ForcePath(path.time_s, path.force_mps2))
    live, rows = LiveEstimator(sensor), []
    for block in simulate_blocks(unit, motion, seed):
        volts = np.column_stack([block[f'{axis}_v'] for axis in kind.axes])
        for time_s, sample in zip(block['time_s'].tolist(), volts.tolist()):
            estimate = live(sample, time_s)
            assert estimate is not None, 'the sensor does not saturate'
            still = angles(estimate.force, estimate.covariance, FLOATS)
            rows.append(
                (time_s, *estimate.roll, *estimate.pitch, *(s.variance_rad2 for s in still[:2]))
            )
    time_s, roll, roll_2, pitch, pitch_2, still_roll_2, still_pitch_2 = np.array(rows).T
    step = np.rint(time_s / _STEP_S).astype(int)
    bias = rng.normal(0.0, _GYRO_BIAS_RADPS, 3)
    gyro = GyroscopeModel(
        Gyroscope(
            bias_radps=tuple(bias.tolist()),
            noise_density_radps_per_rthz=(_GYRO_NOISE_RADPS_PER_RTHZ,) * 3,
        ),
        seed,
    )
    return Measured(
        time_s,
        np.column_stack([roll, pitch]),
        np.column_stack([roll_2, pitch_2]),
        np.column_stack([still_roll_2, still_pitch_2]),
        np.array([gyro(rate, 1 / RATE_HZ) for rate in path.rate_radps[step]]),
        _GYRO_NOISE_RADPS_PER_RTHZ**2 * RATE_HZ / 2 + _GYRO_BIAS_RADPS**2,
        path.tilt_rad[step],
        path.is_driving[step],
    )
