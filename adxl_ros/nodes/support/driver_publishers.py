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

"""What the driver publishes and counts: samples, and what was sampled beside the axes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from adxl_ros.files import cdr
from adxl_ros.files.recording_columns import JOINTS
from adxl_ros.files.stream_info import sensor_info
from adxl_ros.links.support.base import Samples
from adxl_ros.model import noise
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.covariance import UNMEASURED_VARIANCE
from adxl_ros.model.sensor import Sensor, to_nominal_mps2
from adxl_ros.nodes.support.diagnostics import Level, Status, status_message
from adxl_ros.nodes.support.topics import create_publisher
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus
import numpy as np
from rclpy.node import Node
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import BatteryState, Imu, JointState, Temperature

_QUEUE = 5000
"""Samples that are kept for a slow subscriber: 5 s at 1 kHz."""
_REFERENCE_QUEUE = 1000
"""References that are kept for a slow subscriber: 10 s of stage angles."""
_STAGE_PERIOD_NS = 10_000_000
"""Longest time between two messages with the same stage angles, ns; chosen: 100 Hz, as a stage's
controller sends."""
_SCALAR_PERIOD_NS = 1_000_000_000
"""Longest time between two messages with the same temperature or supply, ns; chosen."""


class ImuWriter:
    """
    Makes serialized messages; forty at once take half the time of filling messages.

    Parameters
    ----------
    sensor
        The unit; its nominal values convert volts to acceleration.
    frame_id
        Frame of the messages.

    """

    def __init__(self, sensor: Sensor, frame_id: str) -> None:
        self._sensor = sensor
        self._axes = [AXES.index(axis) for axis in sensor.axes]
        self._template = serialize_message(imu_message(sensor, frame_id))
        self._layout = cdr.imu(self._template)

    def messages(self, stamp_ns: np.ndarray, volts: np.ndarray) -> list[bytes]:
        """
        Serialize samples.

        Parameters
        ----------
        stamp_ns
            Stamps, ns, (n,).
        volts
            Output by axis, V, (n, m).

        Returns
        -------
        list
            One serialized sensor_msgs/Imu a sample.

        """
        accel = np.zeros((len(stamp_ns), 3))
        accel[:, self._axes] = to_nominal_mps2(volts, self._sensor)
        data = cdr.fill(self._template, self._layout, stamp_ns, {'linear_acceleration': accel})
        size = len(self._template)
        return [data[i:i + size] for i in range(0, len(data), size)]

    def saturated(self, volts: np.ndarray) -> np.ndarray:
        """Tell which samples, (n, m), are at a rail of the ADC or beyond the range, (n,)."""
        return np.asarray(self._sensor.saturated(volts).any(axis=1))


def imu_message(sensor: Sensor, frame_id: str) -> Imu:
    """
    Make the message that all samples have in common.

    Parameters
    ----------
    sensor
        The unit; its noise gives the covariance.
    frame_id
        Frame of the message.

    Returns
    -------
    Imu
        The message, without stamp and acceleration.

    """
    message = Imu()
    message.header.frame_id = frame_id
    message.orientation_covariance[0] = message.angular_velocity_covariance[0] = -1.0
    variance = np.full(3, UNMEASURED_VARIANCE)
    noise_std_g = noise.sample_std_v(sensor) / sensor.nominal_scale_v_per_g
    variance[:len(sensor.axes)] = (noise_std_g * G0_MPS2) ** 2
    message.linear_acceleration_covariance = np.diag(variance).ravel()
    return message


class _Totals(NamedTuple):
    """Times and counts at one report; the next report is about the differences."""

    steady_ns: int
    sensor_ns: int
    samples: int
    missing: int
    estimated: int
    saturated: int


class Tally:
    """
    Counts samples, and what went wrong with them, between two reports.

    Parameters
    ----------
    steady_ns
        Steady time, ns.

    Attributes
    ----------
    now_ns
        Sensor time up to which samples have been read, ns; None before the first one.
    samples
        Published samples.
    missing
        Samples that are lost.
    estimated
        Those of the missing ones whose number is estimated by time, not counted.
    saturated
        Samples at a rail of the ADC or beyond the sensor's range.

    """

    def __init__(self, steady_ns: int) -> None:
        self.now_ns: int | None = None
        self.samples = self.missing = self.estimated = self.saturated = 0
        self._newest_ns: int | None = None
        self._reported = _Totals(steady_ns, 0, 0, 0, 0, 0)

    def begin(self, now_ns: int) -> None:
        """Count sensor time from now on, ns."""
        self._reported = self._reported._replace(sensor_ns=now_ns)

    def count(self, stamps_ns: np.ndarray, saturated: int, missing: int, estimated: int) -> None:
        """
        Add samples.

        Parameters
        ----------
        stamps_ns
            Stamps of the published ones, ns, (n,).
        saturated
            Number of saturated ones among them.
        missing
            Number of lost samples.
        estimated
            Number of lost samples that is estimated by time, not counted.

        """
        self.samples += len(stamps_ns)
        self.saturated += saturated
        self.missing += missing
        self.estimated += estimated
        if len(stamps_ns):
            self._newest_ns = int(stamps_ns[-1])

    def report(self, steady_ns: int, sensor_ns: int) -> tuple[dict[str, Any], str]:
        """
        Report what has been counted since the last report.

        Parameters
        ----------
        steady_ns
            Steady time, ns.
        sensor_ns
            Sensor time, ns; 0 before the first sample.

        Returns
        -------
        tuple
            Values for diagnostics by key, and a warning or ''.

        """
        totals = _Totals(steady_ns, sensor_ns, self.samples, self.missing, self.estimated,
                         self.saturated)
        new = _Totals(*(now - before for now, before in zip(totals, self._reported)))
        self._reported = totals
        values = {'rate_hz': round(new.samples / new.sensor_ns * 1e9, 3)
                  if new.sensor_ns > 0 else 0.0,
                  'missing': self.missing, 'missing_estimated': self.estimated,
                  'saturated': self.saturated, 'samples': self.samples,
                  'speed': round(new.sensor_ns / new.steady_ns, 3) if new.steady_ns > 0 else 0.0}
        if self._newest_ns is not None:
            values['age_s'] = round((sensor_ns - self._newest_ns) * 1e-9, 6)
        estimated = f', {new.estimated} of them estimated' if new.estimated else ''
        warnings = [f'{new.missing} samples missing{estimated}'] if new.missing else []
        warnings += [f'{new.saturated} samples saturated'] if new.saturated else []
        return values, ', '.join(warnings)


class SampleOutput:
    """
    Publishes samples, the figures that make them readable, and sensor time.

    Parameters
    ----------
    node
        The node that publishes.
    sensor
        Its nominal values convert the samples, until a link states others.
    frame_id
        Frame of the samples.
    delay_ns
        Delay of the sensor, which is taken out of the stamps, ns.
    is_clock
        Whether sensor time is the clock of the graph.
    tally
        Counts the samples.

    Attributes
    ----------
    sensor, frame_id, is_clock, tally
        As given; `sensor` may be replaced.

    """

    def __init__(self, node: Node, sensor: Sensor, frame_id: str, delay_ns: int, is_clock: bool,
                 tally: Tally) -> None:
        self._node, self._delay_ns = node, delay_ns
        self.sensor, self.frame_id, self.is_clock, self.tally = sensor, frame_id, is_clock, tally
        self._writer = ImuWriter(sensor, frame_id)
        self._data = create_publisher(node, Imu, 'imu/data_raw', _QUEUE)
        self._info = create_publisher(node, DiagnosticStatus, 'sensor_info', 1, latched=True)
        self._clock = create_publisher(node, Clock, '/clock', 1) if is_clock else None

    def destroy(self) -> None:
        """Remove the topics."""
        for publisher in filter(None, (self._data, self._info, self._clock)):
            self._node.destroy_publisher(publisher)

    def use(self, sensor: Sensor) -> None:
        """Convert samples by the nominal values of a sensor, and publish these."""
        self.sensor = sensor
        self._writer = ImuWriter(sensor, self.frame_id)
        self._info.publish(status_message('sensor_info', Status(
            Level.OK, '', sensor.serial, sensor_info(sensor))))

    def subscribed(self) -> bool:
        """Tell whether somebody listens to the samples."""
        return self._data.get_subscription_count() > 0

    def publish(self, samples: Samples, references: References) -> None:
        """
        Publish samples and what was recorded beside them.

        Parameters
        ----------
        samples
            What a link has given; samples that are not finite count as missing.
        references
            Publishes what was recorded beside the sensor.

        """
        finite = np.isfinite(samples.volts).all(axis=1)
        stamps_ns, volts = samples.stamp_ns[finite], samples.volts[finite]
        references.publish(samples.stamp_ns, samples.references)
        for message in self._writer.messages(stamps_ns - self._delay_ns, volts):
            self._data.publish(message)
        self.tally.count(stamps_ns, int(self._writer.saturated(volts).sum()),
                         samples.missing + int((~finite).sum()), samples.estimated)
        self.tally.now_ns = samples.until_ns
        if self._clock is not None:
            self._clock.publish(Clock(clock=stamp(samples.until_ns)))


_KINDS = {'temperature_c': (Temperature, 'temperature'), 'supply_v': (BatteryState, 'supply')}
"""Message type and topic of what has one value a sample, by the column of a recording."""


class References:
    """
    Publishes what was recorded beside the sensor: stage angles, temperature, supply.

    Parameters
    ----------
    node
        The node that publishes.
    frame_id
        Frame of the messages.
    columns
        Columns of a recording that the link gives.

    """

    def __init__(self, node: Node, frame_id: str, columns: tuple[str, ...]) -> None:
        self._node, self._frame_id = node, frame_id
        self._published: dict[str, tuple[int, np.ndarray]] = {}
        self._joints = {column: joint for joint, column in JOINTS.items() if column in columns}
        self._publishers = {}
        if self._joints:
            self._publishers['stage'] = create_publisher(node, JointState, 'stage/joint_states',
                                                         _REFERENCE_QUEUE)
        for column, (kind, topic) in _KINDS.items():
            if column in columns:
                self._publishers[column] = create_publisher(node, kind, topic, _REFERENCE_QUEUE)

    def destroy(self) -> None:
        """Remove the topics."""
        for publisher in self._publishers.values():
            self._node.destroy_publisher(publisher)

    def publish(self, stamps_ns: np.ndarray, columns: Mapping[str, np.ndarray]) -> None:
        """
        Publish values that have changed, and others once in a period.

        Parameters
        ----------
        stamps_ns
            Stamps, ns, (n,).
        columns
            Values by column, (n,); NaN where there is none.

        """
        if not len(stamps_ns):
            return
        for name, publisher in self._publishers.items():
            if name == 'stage':
                values = np.column_stack([columns[column] for column in self._joints])
                for i in self._new_rows(name, stamps_ns, values, _STAGE_PERIOD_NS):
                    publisher.publish(self._joint_state(stamps_ns[i], values[i]))
            else:
                values = columns[name][:, None]
                for i in self._new_rows(name, stamps_ns, values, _SCALAR_PERIOD_NS):
                    publisher.publish(self._scalar(name, stamps_ns[i], float(values[i, 0])))

    def _new_rows(self, name: str, stamps_ns: np.ndarray, values: np.ndarray, period_ns: int
                  ) -> np.ndarray:
        """Find the rows of (n, k) that differ from the row before, or begin a period."""
        rows = np.flatnonzero(np.isfinite(values).any(axis=1))
        if not len(rows):
            return rows
        values, period = values[rows], stamps_ns[rows] // period_ns
        last_period, last = self._published.get(name, (-1, np.full(values.shape[1], np.inf)))
        changed = (np.diff(values, axis=0, prepend=last[None]) != 0).any(axis=1)
        self._published[name] = int(period[-1]), values[-1]
        return rows[changed | (np.diff(period, prepend=last_period) != 0)]

    def _joint_state(self, stamp_ns: int, values: np.ndarray) -> JointState:
        """Make the message of the joints that have a value, rad or m, (k,)."""
        angles = {joint: float(value) for joint, value in zip(self._joints.values(), values)
                  if np.isfinite(value)}
        message = JointState(name=list(angles), position=list(angles.values()))
        message.header.stamp = stamp(stamp_ns)
        return message

    def _scalar(self, name: str, stamp_ns: int, value: float) -> Temperature | BatteryState:
        message = Temperature(temperature=value) if name == 'temperature_c' else \
            BatteryState(voltage=value, present=True)
        message.header.stamp, message.header.frame_id = stamp(stamp_ns), self._frame_id
        return message


def stamp(time_ns: int) -> Time:
    """Make the stamp of a ROS time, ns."""
    sec, nanosec = divmod(int(time_ns), 10 ** 9)
    return Time(sec=sec, nanosec=nanosec)
