# SPDX-License-Identifier: Apache-2.0
"""Newton: `SensorIMU` on the body accelerations of its MuJoCo solver."""

from __future__ import annotations

from adxl_ros_validation.simulators import arm
from adxl_ros_validation.simulators.base import Simulator
import newton
import numpy as np
import warp as wp

wp.config.quiet = True


class Imu(Simulator):
    """The sensor of Newton after a step."""

    library = 'newton'
    reads = '`SensorIMU` after `SolverMuJoCo.step`'

    def __init__(self) -> None:
        """Build the arm on the CPU."""
        builder = newton.ModelBuilder(gravity=arm.GRAVITY_MPS2)
        builder.add_mjcf(arm.spec().to_xml(), parse_sites=True)
        self._model = builder.finalize(device='cpu')
        self._sensor = newton.sensors.SensorIMU(
            self._model, f'*{arm.FRAME}', request_state_attributes=False
        )
        self._solver = newton.solvers.SolverMuJoCo(self._model, use_mujoco_cpu=True)
        self._observed = self._solver.observables(kinds=self._sensor.solver_observable_kinds)
        self._control = self._model.control()
        self._states = [self._model.state(), self._model.state()]

    def restart(self) -> None:
        """Set joints and bodies of the state, and reset the solver."""
        state = self._states[0]
        state.joint_q.assign(arm.START_RAD.astype(np.float32))
        state.joint_qd.zero_()
        newton.eval_fk(self._model, state.joint_q, state.joint_qd, state)
        self._solver.reset(state)

    def step(self) -> None:
        """Simulate a step, and exchange the states."""
        before, after = self._states
        self._solver.step(
            before, after, self._control, None, arm.STEP_S, observables=self._observed
        )
        self._states = [after, before]

    def angles(self) -> np.ndarray:
        """Return the joints of the newest state."""
        return self._states[0].joint_q.numpy().astype(float)

    def accelerometer(self) -> np.ndarray:
        """Update the sensor."""
        self._sensor.update(self._states[0], observables=self._observed)
        return self._sensor.accelerometer.numpy()[0].astype(float)
