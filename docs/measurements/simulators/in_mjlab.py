# SPDX-License-Identifier: Apache-2.0
"""mjlab: its wrapper of MuJoCo's accelerometer on MuJoCo Warp."""

from __future__ import annotations

from adxl_ros_validation.simulators import arm
from adxl_ros_validation.simulators.base import Simulator
from mjlab.entity import EntityCfg
from mjlab.scene import Scene, SceneCfg
from mjlab.sim import MujocoCfg, Simulation, SimulationCfg
import numpy as np
import torch
import warp as wp

wp.config.quiet = True


class AfterStep(Simulator):
    """The sensor after a step, as terminations and rewards of an environment see it."""

    library = 'mjlab'
    reads = '`BuiltinSensor.data` after `sim.step`'

    def __init__(self) -> None:
        """Build scene and simulation on the CPU."""
        entity = EntityCfg(spec_fn=arm.spec)
        self._scene = Scene(SceneCfg(entities={'arm': entity}), 'cpu')
        options = MujocoCfg(timestep=arm.STEP_S, gravity=arm.GRAVITY_MPS2)
        self._sim = Simulation(
            1, SimulationCfg(mujoco=options), model=self._scene.compile(), device='cpu'
        )
        self._scene.initialize(self._sim.mj_model, self._sim.model, self._sim.data)

    def restart(self) -> None:
        """Reset simulation and scene, and set the joints."""
        self._sim.reset()
        self._scene.reset()
        self._sim.data.qpos[0] = torch.from_numpy(arm.START_RAD.astype(np.float32))

    def step(self) -> None:
        """Simulate a step."""
        self._sim.step()
        self._scene.update(arm.STEP_S)

    def angles(self) -> np.ndarray:
        """Return qpos."""
        return self._sim.data.qpos[0].numpy().astype(float)

    def accelerometer(self) -> np.ndarray:
        """Return the data of the sensor."""
        return self._scene['arm/accelerometer'].data[0].numpy().astype(float)


class Forward(AfterStep):
    """The sensor after the `forward` that comes before the observations."""

    reads = '`BuiltinSensor.data` after `sim.forward`'

    def accelerometer(self) -> np.ndarray:
        """Compute the sensors of this state."""
        self._sim.forward()
        self._scene.update(0.0)
        return super().accelerometer()
