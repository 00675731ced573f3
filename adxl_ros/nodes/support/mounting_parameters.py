# SPDX-License-Identifier: Apache-2.0

"""Where the sensor is mounted on the robot: parameters, and the service that levels it."""

from __future__ import annotations

from collections.abc import Sequence

from adxl_ros.compensate.live_stream import LiveStream
from adxl_ros.errors import UserError
from adxl_ros.model import noise
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.mounting import Mounting
from adxl_ros.model.sensor import Sensor
from adxl_ros.nodes.support.parameters import declare, parameter_error
import numpy as np
from rcl_interfaces.msg import SetParametersResult
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.task import Future
from std_srvs.srv import Trigger

_RPY = 'mounting.rpy_rad'
"""Parameter of the rotation."""
_LEVEL_S = 1.0
"""Time over which a rest is averaged, s; chosen: the noise of a sample then is negligible."""
_FEWEST_SAMPLES = 10
"""Smallest number of samples of that rest; chosen: they show whether the sensor moves."""
_MAX_NOISE = 3.0
"""Largest scatter of a rest, in standard deviations of a sample's noise; chosen."""
_MAX_GRAVITY_ERROR = 0.1
"""Largest relative departure of a rest from gravity; chosen: beyond an uncalibrated sensor."""


class MountingParameters:
    """The parameters `mounting.*` and the service `~/level` of a node."""

    def __init__(self, node: Node, stream: LiveStream) -> None:
        self._node, self._stream = node, stream
        rpy_rad = declare(node, _RPY, [0.0, 0.0, 0.0], 'roll, pitch and yaw of the case in the '
                          'frame of the robot, as in a URDF joint', 'rad', live=True)
        self._frame_id = declare(node, 'mounting.frame_id', 'base_link',
                                 'frame of the robot, in the header where the case is turned')
        self._mounting = _mounting(rpy_rad)
        self._waiting: Future | None = None
        stream.mount(self._mounting, self._frame_id)
        node.add_on_set_parameters_callback(_check)
        node.add_post_set_parameters_callback(self._apply)
        # The answer comes after a second of samples, which the node takes meanwhile.
        node.create_service(Trigger, '~/level', self._on_level,
                            callback_group=ReentrantCallbackGroup())

    def _apply(self, parameters: Sequence[Parameter]) -> None:
        for parameter in parameters:
            if parameter.name == _RPY:
                self._mounting = _mounting(parameter.value)
                self._stream.mount(self._mounting, self._frame_id)

    async def _on_level(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self._waiting is not None:
            response.message = 'a rest is being averaged; wait for its answer'
            return response
        self._waiting = Future()
        self._stream.collect()
        timer = self._node.create_timer(_LEVEL_S, self._waiting_ends,
                                        clock=Clock(clock_type=ClockType.STEADY_TIME))
        await self._waiting
        self._node.destroy_timer(timer)
        forces_mps2, self._waiting = self._stream.collected(), None
        self._stream.stop_collecting()
        try:
            levelled = level(self._mounting, forces_mps2, self._stream.sensor)
        except UserError as error:
            response.message = f'{error}'
            return response
        rpy_rad = [round(angle, 6) for angle in levelled.rpy_rad]
        self._node.set_parameters([Parameter(_RPY, value=rpy_rad)])
        degrees = ', '.join(f'{np.degrees(angle):.2f}' for angle in rpy_rad)
        response.success = True
        yaml = f'[{", ".join(f"{angle:.6f}" for angle in rpy_rad)}]'
        response.message = (
            f'level: roll, pitch, yaw of the case are {degrees} deg, until this node ends; to '
            f"keep them, start it with -p '{_RPY}:={yaml}', or write '/**: {{ros__parameters: "
            f"{{{_RPY}: {yaml}}}}}' into a file and start it with --params-file")
        self._node.get_logger().info(response.message)
        return response

    def _waiting_ends(self) -> None:
        if self._waiting is not None and not self._waiting.done():
            self._waiting.set_result(True)


def level(mounting: Mounting, forces_mps2: np.ndarray, sensor: Sensor) -> Mounting:
    """
    Return the mounting that makes the force of a rest vertical.

    forces_mps2: corrected samples in the frame of the case, m/s², (n, 3).
    """
    if len(forces_mps2) < _FEWEST_SAMPLES:
        raise UserError(f'{len(forces_mps2)} samples in {_LEVEL_S:g} s; at least '
                        f'{_FEWEST_SAMPLES} are needed')
    mean_mps2 = forces_mps2.mean(axis=0)
    scatter_mps2 = forces_mps2.std(axis=0)[:len(sensor.axes)]
    noise_mps2 = noise.sample_std_v(sensor) / sensor.scale_v_per_g * G0_MPS2
    worst = int(np.argmax(scatter_mps2 / noise_mps2))
    if scatter_mps2[worst] > _MAX_NOISE * noise_mps2[worst]:
        raise UserError(f'the sensor moves: {sensor.axes[worst]} scatters by '
                        f'{scatter_mps2[worst]:.2g} m/s², and its noise is '
                        f'{noise_mps2[worst]:.2g} m/s²; let the robot rest on level ground')
    magnitude_mps2 = float(np.linalg.norm(mean_mps2))
    if abs(magnitude_mps2 / sensor.local_gravity_mps2 - 1) > _MAX_GRAVITY_ERROR:
        raise UserError(f'the sensor reads {magnitude_mps2:.2f} m/s², and gravity is '
                        f'{sensor.local_gravity_mps2:.2f} m/s²; calibrate it first')
    return mounting.levelled(mean_mps2.tolist())


def _mounting(rpy_rad: Sequence[float]) -> Mounting:
    if _fault(rpy_rad):
        raise parameter_error(_RPY, _fault(rpy_rad))
    roll, pitch, yaw = rpy_rad
    return Mounting((float(roll), float(pitch), float(yaw)))


def _fault(rpy_rad: Sequence[float]) -> str:
    """Return why a rotation is not three angles in rad; empty where it is."""
    if len(rpy_rad) != 3 or not np.isfinite(rpy_rad).all():
        return f'{list(rpy_rad)} is not roll, pitch and yaw in rad'
    if np.abs(rpy_rad).max() > 2 * np.pi:
        in_rad = ', '.join(f'{angle:.6g}' for angle in np.radians(rpy_rad))
        return f'{list(rpy_rad)} is more than a turn in rad; if it is in degrees, write [{in_rad}]'
    return ''


def _check(parameters: Sequence[Parameter]) -> SetParametersResult:
    """Refuse a rotation that is not three angles in rad."""
    for parameter in parameters:
        fault = _fault(parameter.value) if parameter.name == _RPY else ''
        if fault:
            return SetParametersResult(successful=False, reason=f'{_RPY}: {fault}')
    return SetParametersResult(successful=True)
