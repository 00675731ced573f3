# SPDX-License-Identifier: Apache-2.0

"""A sensor with a gyroscope that is turned from rest to rest, made apart from the package."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

RATE_HZ = 100.0
G = 9.80665
REST_S, TURN_S = 4.0, 1.5


class SixAxis(NamedTuple):
    time_s: np.ndarray
    accel_mps2: np.ndarray  # (n, 3)
    gyro_radps: np.ndarray  # (n, 3), without errors

    def arrays(self, gyro_radps: np.ndarray) -> dict[str, np.ndarray]:
        """Return the columns of a recording with these readings of the gyroscope."""
        return {
            'time_s': self.time_s,
            **dict(zip(('ax_mps2', 'ay_mps2', 'az_mps2'), self.accel_mps2.T)),
            **dict(zip(('gx_radps', 'gy_radps', 'gz_radps'), gyro_radps.T)),
        }


def tumbled(seed: int, poses: int, rest_s: float = REST_S) -> SixAxis:
    """Return a sensor that rests in random poses, and turns evenly from one to the next."""
    rng = np.random.default_rng(seed)
    times = [0.0]
    for _ in range(poses):
        times += [times[-1] + rest_s, times[-1] + rest_s + TURN_S]
    rotations = Rotation.random(poses, random_state=rng)
    path = Slerp(times[:-1], rotations[np.repeat(np.arange(poses), 2)])
    time_s = np.arange(int(times[-2] * RATE_HZ)) / RATE_HZ
    attitude = path(time_s)
    later = path(np.minimum(time_s + 1 / RATE_HZ, times[-2]))
    gyro_radps = (attitude.inv() * later).as_rotvec() * RATE_HZ
    accel = attitude.inv().apply([0.0, 0.0, G]) + rng.normal(0, 0.02, (len(time_s), 3))
    return SixAxis(time_s, accel, gyro_radps)
