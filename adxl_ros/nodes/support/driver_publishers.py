# Copyright 2026 the adxl_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""What the driver makes of samples: messages, counts, and what was sampled beside the axes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from adxl_ros.files import cdr
from adxl_ros.files.recording_columns import JOINTS
from adxl_ros.model import noise
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.covariance import UNMEASURED_VARIANCE
from adxl_ros.model.sensor import Sensor, to_nominal_mps2
from adxl_ros.nodes.support.topics import create_publisher
from builtin_interfaces.msg import Time
import numpy as np
from rclpy.node import Node
from rclpy.serialization import serialize_message
from sensor_msgs.msg import BatteryState, Imu, JointState, Temperature


class ImuWriter:
    """Makes serialized messages: forty at once take half the time of filling messages."""

    def __init__(self, sensor: Sensor, frame_id: str) -> None:
        self.serial = sensor.serial
        self._sensor = sensor
        self._axes = [AXES.index(axis) for axis in sensor.axes]
        self._template = serialize_message(imu_message(sensor, frame_id))
        self._layout = cdr.imu(self._template)

    def messages(self, stamp_ns: np.ndarray, volts: np.ndarray) -> list[bytes]:
        """Serialize samples: stamps, ns, (n,), and volts by axis, (n, m)."""
        accel = np.zeros((len(stamp_ns), 3))
        accel[:, self._axes] = to_nominal_mps2(volts, self._sensor)
        data = cdr.fill(self._template, self._layout, stamp_ns, {'linear_acceleration': accel})
        size = len(self._template)
        return [data[i:i + size] for i in range(0, len(data), size)]

    def saturated(self, volts: np.ndarray) -> np.ndarray:
        """Tell which samples are at a rail of the ADC or beyond the sensor's range, (n,)."""
        return self._sensor.saturated(volts).any(axis=1)


def imu_message(sensor: Sensor, frame_id: str) -> Imu:
    """Make the message that all samples have in common."""
    message = Imu()
    message.header.frame_id = frame_id
    message.orientation_covariance[0] = message.angular_velocity_covariance[0] = -1.0
    variance = np.full(3, UNMEASURED_VARIANCE)
    sigma_g = noise.sample_std_v(sensor) / sensor.nominal_scale_v_per_g
    variance[:len(sensor.axes)] = (sigma_g * G0_MPS2) ** 2
    message.linear_acceleration_covariance = np.diag(variance).ravel()
    return message


class Tally:
    """Counts samples, and what went wrong with them, between two reports."""

    def __init__(self, steady_ns: int) -> None:
        self.missing = self.estimated = self.saturated = self.samples = 0
        self._newest_ns: int | None = None
        self._then = (steady_ns, 0, 0, 0, 0, 0)

    def begin(self, now_ns: int) -> None:
        """Count sensor time from now on."""
        self._then = (self._then[0], now_ns, *self._then[2:])

    def count(self, stamps: np.ndarray, saturated: int, missing: int, estimated: int) -> None:
        """Add samples; `estimated` of the missing ones are not counted, but guessed by time."""
        self.samples += len(stamps)
        self.saturated += saturated
        self.missing += missing
        self.estimated += estimated
        if len(stamps):
            self._newest_ns = int(stamps[-1])

    def report(self, steady_ns: int, now_ns: int) -> tuple[dict[str, Any], str]:
        """Return the values for diagnostics since the last report, and what is wrong or ''."""
        now = (steady_ns, now_ns, self.samples, self.missing, self.estimated, self.saturated)
        real_ns, sensed_ns, samples, missing, estimated, saturated = (
            a - b for a, b in zip(now, self._then))
        self._then = now
        values = {'rate_hz': round(samples / sensed_ns * 1e9, 3) if sensed_ns > 0 else 0.0,
                  'missing': self.missing, 'missing_estimated': self.estimated,
                  'saturated': self.saturated, 'samples': self.samples,
                  'speed': round(sensed_ns / real_ns, 3) if real_ns > 0 else 0.0}
        if self._newest_ns is not None:
            values['age_s'] = round((now_ns - self._newest_ns) * 1e-9, 6)
        guess = f', {estimated} of them estimated' if estimated else ''
        wrong = [f'{missing} samples missing{guess}'] if missing else []
        wrong += [f'{saturated} samples saturated'] if saturated else []
        return values, ', '.join(wrong)


class References:
    """Publishes what was recorded beside the sensor: stage angles, temperature, supply."""

    def __init__(self, node: Node, frame_id: str, names: tuple[str, ...]) -> None:
        self._node, self._frame = node, frame_id
        self._kept: dict[str, tuple[int, np.ndarray]] = {}
        self._joints = {column: joint for joint, column in JOINTS.items() if column in names}
        kinds = {'stage': (JointState, 'stage/joint_states', bool(self._joints)),
                 'temperature_c': (Temperature, 'temperature', 'temperature_c' in names),
                 'supply_v': (BatteryState, 'supply', 'supply_v' in names)}
        self._publishers = {name: create_publisher(node, kind, topic, 1000)
                            for name, (kind, topic, there) in kinds.items() if there}

    def destroy(self) -> None:
        """Take the topics away."""
        for publisher in self._publishers.values():
            self._node.destroy_publisher(publisher)

    def publish(self, stamps: np.ndarray, columns: Mapping[str, np.ndarray]) -> None:
        """Publish what is new, and what is not once in a while."""
        if not len(stamps):
            return
        for name, publisher in self._publishers.items():
            if name == 'stage':
                values = np.column_stack([columns[column] for column in self._joints])
                for i in self._new(name, stamps, values, 10_000_000):
                    publisher.publish(self._stage(stamps[i], values[i]))
            else:
                for i in self._new(name, stamps, columns[name][:, None], 1_000_000_000):
                    publisher.publish(self._scalar(name, stamps[i], float(columns[name][i])))

    def _new(self, name: str, stamps: np.ndarray, values: np.ndarray, every_ns: int) -> Any:
        """Find rows with a value that differs from the one before, or begins a period."""
        rows = np.flatnonzero(np.isfinite(values).any(axis=1))
        if not len(rows):
            return rows
        values, period = values[rows], stamps[rows] // every_ns
        before, last = self._kept.get(name, (-1, np.full(values.shape[1], np.inf)))
        changed = (np.diff(values, axis=0, prepend=last[None]) != 0).any(axis=1)
        self._kept[name] = int(period[-1]), values[-1]
        return rows[changed | (np.diff(period, prepend=before) != 0)]

    def _stage(self, stamp_ns: int, values: np.ndarray) -> JointState:
        angles = {joint: float(value) for joint, value in zip(self._joints.values(), values)
                  if np.isfinite(value)}
        message = JointState(name=list(angles), position=list(angles.values()))
        message.header.stamp = stamp(stamp_ns)
        return message

    def _scalar(self, name: str, stamp_ns: int, value: float) -> Temperature | BatteryState:
        message = Temperature(temperature=value) if name == 'temperature_c' else \
            BatteryState(voltage=value, present=True)
        message.header.stamp, message.header.frame_id = stamp(stamp_ns), self._frame
        return message


def stamp(time_ns: int) -> Time:
    """Make the stamp of a ROS time, ns."""
    sec, nanosec = divmod(int(time_ns), 10 ** 9)
    return Time(sec=sec, nanosec=nanosec)
