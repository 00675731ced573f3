# SPDX-License-Identifier: Apache-2.0
"""Genesis: its IMU sensor on the last link."""

from __future__ import annotations

from typing import Any, ClassVar

from adxl_ros_validation.simulators import arm
from adxl_ros_validation.simulators.base import Simulator
import genesis as gs
import numpy as np

gs.init(backend=gs.cpu, precision='64', logging_level='error')


class Imu(Simulator):
    """The sensor of Genesis after a step, on the last link by its offsets."""

    library = 'genesis-world'
    reads = '`sensors.IMU` on the last link, with `pos_offset` and `euler_offset`'
    link = arm.LINK
    offsets: ClassVar[dict[str, Any]] = {
        'pos_offset': arm.PLACE_M,
        'euler_offset': tuple(np.degrees(arm.TURN_RAD)),
    }

    def __init__(self) -> None:
        """Build the arm on the CPU, without collisions."""
        self._scene = gs.Scene(
            sim_options=gs.options.SimOptions(dt=arm.STEP_S, gravity=arm.GRAVITY_MPS2),
            rigid_options=gs.options.RigidOptions(enable_collision=False),
            show_viewer=False,
        )
        # An armature would slow the joints down; it is no part of the URDF.
        shape = gs.morphs.URDF(
            file=str(arm.URDF), fixed=True, default_armature=0.0, links_to_keep=[arm.FRAME]
        )
        self._arm = self._scene.add_entity(shape)
        link = self._arm.get_link(self.link).idx_local
        sensor = gs.sensors.IMU(entity_idx=self._arm.idx, link_idx_local=link, **self.offsets)
        self._sensor = self._scene.add_sensor(sensor)
        self._scene.build()

    def restart(self) -> None:
        """Reset the scene, and set the joints."""
        self._scene.reset()
        self._arm.set_dofs_position(arm.START_RAD)
        self._arm.zero_all_dofs_velocity()

    def step(self) -> None:
        """Simulate a step."""
        self._scene.step()

    def angles(self) -> np.ndarray:
        """Return the positions of the degrees of freedom."""
        return self._arm.get_dofs_position().numpy().astype(float)

    def accelerometer(self) -> np.ndarray:
        """Read the sensor."""
        return self._sensor.read().lin_acc.numpy().astype(float).ravel()


class OnFrame(Imu):
    """The same on a link of its own that has the pose of the sensor."""

    reads = '`sensors.IMU` on a link of its own'
    link = arm.FRAME
    offsets: ClassVar[dict[str, Any]] = {}
