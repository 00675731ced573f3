# SPDX-License-Identifier: Apache-2.0
"""PyBullet, which has no IMU: differences of a link's velocity, as its users write them."""

from __future__ import annotations

from adxl_ros_validation.simulators import arm
from adxl_ros_validation.simulators.base import Simulator
import numpy as np
import pybullet as bullet
from scipy.spatial.transform import Rotation

_JOINTS = [0, 1, 2]
_SENSOR = 3
"""Number of the sensor's link."""


class Differences(Simulator):
    """The change of the velocity of the sensor's link in a step, plus gravity, turned into it."""

    library = 'pybullet'
    reads = 'differences of `getLinkState` velocities'

    def __init__(self) -> None:
        """Build the arm without motors and damping, which it has by default."""
        bullet.connect(bullet.DIRECT)
        bullet.setTimeStep(arm.STEP_S)
        bullet.setGravity(*arm.GRAVITY_MPS2)
        flags = bullet.URDF_USE_INERTIA_FROM_FILE
        self._arm = bullet.loadURDF(str(arm.URDF), useFixedBase=True, flags=flags)
        free = {'linearDamping': 0, 'angularDamping': 0, 'jointDamping': 0}
        for joint in (-1, *_JOINTS, _SENSOR):
            bullet.changeDynamics(self._arm, joint, **free)
        for joint in _JOINTS:
            bullet.setJointMotorControl2(self._arm, joint, bullet.VELOCITY_CONTROL, force=0)
        self._before = np.zeros(3)

    def restart(self) -> None:
        """Set the joints; nobody tells the difference of it."""
        for joint, angle in zip(_JOINTS, arm.START_RAD):
            bullet.resetJointState(self._arm, joint, angle, 0.0)

    def step(self) -> None:
        """Simulate a step."""
        self._before = self._velocity()[0]
        bullet.stepSimulation()

    def angles(self) -> np.ndarray:
        """Return the positions of the joints."""
        return np.array([state[0] for state in bullet.getJointStates(self._arm, _JOINTS)])

    def accelerometer(self) -> np.ndarray:
        """Return the difference by the step."""
        velocity, turn = self._velocity()
        return turn.inv().apply((velocity - self._before) / arm.STEP_S - arm.GRAVITY_MPS2)

    def _velocity(self) -> tuple[np.ndarray, Rotation]:
        """Return velocity, m/s, and rotation of the sensor's link in the world."""
        state = bullet.getLinkState(self._arm, _SENSOR, 1, 1)
        return np.array(state[6]), Rotation.from_quat(state[5])
