# SPDX-License-Identifier: Apache-2.0
"""Drake: its `Accelerometer` on a discrete plant."""

from __future__ import annotations

from typing import Any, ClassVar

from adxl_ros_validation.simulators import arm
from adxl_ros_validation.simulators.base import Simulator
import numpy as np
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import Simulator as Stepper
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.sensors import Accelerometer

_PORTS = ('body_poses', 'body_spatial_velocities', 'body_spatial_accelerations')
"""What the accelerometer takes from the plant."""


class Imu(Simulator):
    """The output of the system after a step."""

    library = 'drake'
    reads = '`Accelerometer` with `gravity_vector`, discrete plant'
    stated: ClassVar[dict[str, Any]] = {'gravity_vector': arm.GRAVITY_MPS2}

    def __init__(self) -> None:
        """Build plant and accelerometer."""
        builder = DiagramBuilder()
        plant = builder.AddSystem(MultibodyPlant(arm.STEP_S))
        Parser(plant).AddModels(str(arm.URDF))
        plant.WeldFrames(plant.world_frame(), plant.GetFrameByName('base'))
        plant.mutable_gravity_field().set_gravity_vector(arm.GRAVITY_MPS2)
        plant.Finalize()
        pose = RigidTransform(RollPitchYaw(*arm.TURN_RAD), arm.PLACE_M)
        sensor = builder.AddSystem(
            Accelerometer(plant.GetBodyByName(arm.LINK), pose, **self.stated)
        )
        for name in _PORTS:
            builder.Connect(plant.GetOutputPort(name), sensor.GetInputPort(name))
        self._plant, self._sensor = plant, sensor
        self._stepper = Stepper(builder.Build())
        self._start = self._stepper.get_context().Clone()
        self._steps = 0

    def restart(self) -> None:
        """Put time and state back, and set the joints."""
        context = self._stepper.get_mutable_context()
        context.SetTimeStateAndParametersFrom(self._start)
        self._plant.SetPositions(self._plant.GetMyMutableContextFromRoot(context), arm.START_RAD)
        self._stepper.Initialize()
        self._steps = 0

    def step(self) -> None:
        """Simulate a step."""
        self._steps += 1
        # A sum of steps would now and then end just before one.
        self._stepper.AdvanceTo(self._steps * arm.STEP_S)

    def angles(self) -> np.ndarray:
        """Return the positions of the plant."""
        return self._plant.GetPositions(self._inside(self._plant)).copy()

    def accelerometer(self) -> np.ndarray:
        """Evaluate the output."""
        return np.array(self._sensor.get_output_port(0).Eval(self._inside(self._sensor)))

    def _inside(self, system: Any) -> Any:
        """Return the context of a system."""
        return system.GetMyContextFromRoot(self._stepper.get_context())


class ByDefault(Imu):
    """The same without a gravity vector."""

    reads = '`Accelerometer` as it is by default'
    stated: ClassVar[dict[str, Any]] = {}
