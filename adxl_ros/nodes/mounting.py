# SPDX-License-Identifier: Apache-2.0

"""The mounting of the case on the robot: parameters of a node, and the service that levels it."""

from __future__ import annotations

from datetime import datetime, timezone
from pathlib import Path
from typing import Any, NamedTuple

from adxl_ros.compensate.live_stream import LiveStream
from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file
from adxl_ros.model import noise
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.kinematics import Mounting
from adxl_ros.model.sensor import Sensor
from adxl_ros.nodes import parameters, params_files
from adxl_ros.nodes.topics import STEADY
import numpy as np
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.task import Future
from std_srvs.srv import Trigger

_MOUNTING = 'mounting.'  # Begin of the names of the parameters of the mounting
_RPY = f'{_MOUNTING}rpy_rad'  # Parameter of the rotation
_LEVEL_S = 1.0
"""Time over which a rest is averaged, s. At 100 Hz the mean has a tenth of the noise of a sample,
0.003° of tilt for an ADXL203."""
FEWEST_SAMPLES = 10
"""Smallest number of samples of that rest: their scatter is then known within a quarter, which
tells motion from noise."""
_MAX_NOISE = 3.0
"""Largest scatter of a rest, in standard deviations of a sample's noise. The scatter of ten
samples at rest exceeds twice that in one of 25 000 rests, three times never."""
_MAX_GRAVITY_ERROR = 0.1
"""Largest relative departure of a rest from gravity: beyond the zero-g of an uncalibrated ADXL203,
0.1 g, another unit of measurement or motion explains it."""


class NamedSensor(NamedTuple):
    """A sensor that corrects the samples."""

    sensor: Sensor
    source: str  # Where it is from, for people: the path of a calibration


class MountingParameters:
    """The parameters `mounting.*` and the service `~/level` of a node."""

    def __init__(self, node: Node, stream: LiveStream, mounting: Mounting, frame_id: str) -> None:
        self._node = node
        self._stream = stream
        self._frame_id = frame_id
        self._path = ''
        # What was given counts before the file of a calibration.
        self._is_given = _RPY in parameters.given_parameters(node)
        self._mount(mounting)
        parameters.on_change(node, _RPY, mounting_by_angles, self._mount)
        # The answer comes after a second of samples, which the node takes meanwhile.
        node.create_service(
            Trigger, '~/level', self._on_level, callback_group=ReentrantCallbackGroup()
        )

    def take(self, loaded: NamedSensor) -> None:
        """Use the mounting that the file of a calibration has, unless one was given."""
        self._path = path = loaded.source
        mounting = mounting_of(loaded)
        if mounting is None:
            return
        if not self._is_given:
            self._node.set_parameters([Parameter(_RPY, value=list(mounting.rpy_rad))])
        elif mounting != self._mounting:
            self._node.get_logger().warning(
                f'{_RPY} is given, and counts before that of {path}: {list(mounting.rpy_rad)}'
            )

    def _mount(self, mounting: Mounting) -> None:
        self._mounting = mounting
        self._stream.mount(mounting, self._frame_id)

    async def _on_level(self, *_: object) -> Trigger.Response:
        over: Future = Future()
        self._stream.collect()
        timer = self._node.create_timer(_LEVEL_S, lambda: over.set_result(True), clock=STEADY)
        await over
        self._node.destroy_timer(timer)
        try:
            levelled = level(self._mounting, self._stream.collected(), self._stream.sensor)
        except UserError as error:
            return Trigger.Response(message=f'{error}')
        before_rad = list(self._mounting.rpy_rad)
        rpy_rad = [round(angle, 6) for angle in levelled.rpy_rad]
        self._node.set_parameters([Parameter(_RPY, value=rpy_rad)])
        text = self._kept(rpy_rad, before_rad)
        self._node.get_logger().info(text)
        return Trigger.Response(success=True, message=text)

    def _kept(self, rpy_rad: list[float], before_rad: list[float]) -> str:
        """Write a new mounting where the next start finds it; return where that is."""
        path = (
            params_files.file_of(_RPY)
            if self._is_given
            else self._path or params_files.file_of('format')
        )
        begin = f'level: {_RPY} is {rpy_rad}'
        option = f"to keep it, start the node with -p '{_RPY}:={rpy_rad}'"
        if not path:
            return f'{begin} until this node ends; {option}'
        date = datetime.now(timezone.utc).isoformat(timespec='seconds')
        try:
            params_files.write_into(
                path,
                self._node.get_fully_qualified_name(),
                {
                    _RPY: f'[{", ".join(map(parameter_file.float_text, rpy_rad))}]',
                    'provenance.levelled': f"'{date}, {_RPY} before: {before_rad}'",
                },
            )
        except UserError as error:
            return f'{begin} until this node ends: {error}; {option}'
        return f'{begin}, written into {Path(path).resolve()}, which the next start reads'


def level(mounting: Mounting, forces_mps2: np.ndarray, sensor: Sensor) -> Mounting:
    """
    Return the mounting that makes the force of a rest vertical.

    forces_mps2: corrected samples in the frame of the case, m/s², (n, 3).
    """
    if len(forces_mps2) < FEWEST_SAMPLES:
        raise UserError(
            f'{len(forces_mps2)} samples in {_LEVEL_S:g} s; at least {FEWEST_SAMPLES} are needed'
        )
    mean_mps2 = forces_mps2.mean(axis=0)
    scatter_mps2 = forces_mps2.std(axis=0)[: len(sensor.axes)]
    noise_mps2 = noise.sample_std_v(sensor) / sensor.scale_v_per_g * G0_MPS2
    worst = int(np.argmax(scatter_mps2 / noise_mps2))
    if scatter_mps2[worst] > _MAX_NOISE * noise_mps2[worst]:
        raise UserError(
            f'the sensor moves: {sensor.axes[worst]} scatters by '
            f'{scatter_mps2[worst]:.2g} m/s², and its noise is '
            f'{noise_mps2[worst]:.2g} m/s²; let the robot rest on level ground'
        )
    magnitude_mps2 = float(np.linalg.norm(mean_mps2))
    if abs(magnitude_mps2 / sensor.local_gravity_mps2 - 1) > _MAX_GRAVITY_ERROR:
        raise UserError(
            f'the sensor reads {magnitude_mps2:.2f} m/s², and gravity is '
            f'{sensor.local_gravity_mps2:.2f} m/s²; calibrate it first'
        )
    return mounting.levelled(mean_mps2.tolist())


def mounting_by_angles(
    rpy_rad: Any, make_error: parameter_file.MakeError = params_files.parameter_error
) -> Mounting:
    """Return the mounting of three angles, rad; refuse what is none."""
    try:
        roll, pitch, yaw = map(float, rpy_rad)
        is_right = bool(np.abs([roll, pitch, yaw]).max() <= 2 * np.pi)
    except (TypeError, ValueError):
        is_right = False
    if not is_right:
        raise make_error(_RPY, f'{rpy_rad} is not roll, pitch and yaw in rad, each within a turn')
    return Mounting((roll, pitch, yaw))


def mounting_of(loaded: NamedSensor) -> Mounting | None:
    """Return the mounting that the file of a calibration has, None where it has none."""
    rpy_rad = loaded.sensor.mounting.get(_RPY.removeprefix(_MOUNTING))
    if rpy_rad is None:
        return None
    return mounting_by_angles(
        rpy_rad, lambda key, reason: UserError(f'{loaded.source}: {key}: {reason}')
    )
