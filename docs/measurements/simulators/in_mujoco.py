# SPDX-License-Identifier: Apache-2.0
"""MuJoCo: `sensordata` as a step leaves it, and after `mj_forward`."""

from __future__ import annotations

from adxl_ros_validation.simulators import arm
from adxl_ros_validation.simulators.base import Simulator
import mujoco
import numpy as np


class AfterStep(Simulator):
    """The reading that `mj_step` leaves."""

    library = 'mujoco'
    reads = '`sensordata` as `mj_step` leaves it'
    noise = 0.0

    def __init__(self) -> None:
        """Build the arm."""
        self._model = arm.spec(self.noise).compile()
        self._data = mujoco.MjData(self._model)

    def restart(self) -> None:
        """Reset the data, and set the joints."""
        mujoco.mj_resetData(self._model, self._data)
        self._data.qpos[:] = arm.START_RAD

    def step(self) -> None:
        """Simulate a step."""
        mujoco.mj_step(self._model, self._data)

    def angles(self) -> np.ndarray:
        """Return qpos."""
        return self._data.qpos.copy()

    def accelerometer(self) -> np.ndarray:
        """Return what the step left."""
        return self._data.sensordata.copy()


class Forward(AfterStep):
    """The reading after `mj_forward`."""

    reads = '`sensordata` after `mj_forward`'

    def accelerometer(self) -> np.ndarray:
        """Compute the sensors of this state."""
        mujoco.mj_forward(self._model, self._data)
        return super().accelerometer()


class RungeKutta(Forward):
    """The same by an integrator whose rates belong to the instant of the angles."""

    reads = '`sensordata` after `mj_forward`, RK4'

    def __init__(self) -> None:
        """Build the arm."""
        super().__init__()
        self._model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4


class Declared(RungeKutta):
    """The same with a noise that the model declares."""

    reads = '`sensordata` after `mj_forward`, RK4, `noise="0.05"` declared'
    noise = 0.05
