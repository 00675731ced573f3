# SPDX-License-Identifier: Apache-2.0

"""Topics of the driver's samples: acceleration, the values that make it readable, the clock."""

from __future__ import annotations

from collections.abc import Mapping
import struct

from adxl_ros.files import cdr
from adxl_ros.files.stream_info import sensor_info
from adxl_ros.links.support.base import Samples
from adxl_ros.model import noise
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.covariance import UNMEASURED_VARIANCE
from adxl_ros.model.sensor import Sensor, to_nominal_mps2
from adxl_ros.nodes.support.diagnostics import Level, Status, status_message
from adxl_ros.nodes.support.references import References
from adxl_ros.nodes.support.sample_tally import Tally
from adxl_ros.nodes.support.topics import create_publisher, stamp
from diagnostic_msgs.msg import DiagnosticStatus
import numpy as np
from rclpy.clock import Clock as StampClock
from rclpy.node import Node
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import Imu

_QUEUE = 5000
"""Samples that are kept for a slow subscriber: 5 s at 1 kHz."""
_UNKNOWN_NODE = '_NODE_NAME_UNKNOWN_'
"""Name that the middleware gives a node that it has not discovered yet (rmw_dds_common)."""


class ImuWriter:
    """
    Makes serialized messages, by replacing numbers in the bytes of a template.

    A sample is one of two or few that have just come, after a pause of the processor. Calls of
    numpy are slow then: these messages would take twice the time.
    """

    def __init__(self, sensor: Sensor, frame_id: str) -> None:
        self._sensor = sensor
        self._template = serialize_message(imu_message(sensor, frame_id))
        layout = cdr.imu(self._template)
        self._stamp = struct.Struct(f'{layout.order}iI')
        self._stamp_offset = layout.fields['sec'].offset
        counts = {name: field.count for name, field in layout.fields.items()
                  if field.code == 'f8'} | {'linear_acceleration': len(sensor.axes)}
        self._fields = {name: (struct.Struct(f'{layout.order}{count}d'),
                               layout.fields[name].offset) for name, count in counts.items()}

    def messages(self, stamp_ns: np.ndarray, volts: np.ndarray,
                 imu_fields: Mapping[str, np.ndarray]) -> list[bytes]:
        """
        Serialize samples.

        stamp_ns: stamps, ns, (n,); volts: output by axis, V, (n, m); imu_fields: further fields of
        the messages by name, (n, k) each.
        """
        values = {**imu_fields, 'linear_acceleration': to_nominal_mps2(volts, self._sensor)}
        columns = [(*self._fields[name], rows.tolist()) for name, rows in values.items()]
        messages = []
        for i, time_ns in enumerate(stamp_ns.tolist()):
            message = bytearray(self._template)
            self._stamp.pack_into(message, self._stamp_offset, *divmod(time_ns, 10 ** 9))
            for packer, offset, rows in columns:
                packer.pack_into(message, offset, *rows[i])
            messages.append(bytes(message))
        return messages

    def saturated(self, volts: np.ndarray) -> np.ndarray:
        """Return which samples, V, (n, m), are at a rail of the ADC or beyond the range, (n,)."""
        return np.asarray(self._sensor.saturated(volts).any(axis=1))


def imu_message(sensor: Sensor, frame_id: str) -> Imu:
    """Make the message that all samples have in common."""
    message = Imu()
    message.header.frame_id = frame_id
    message.orientation_covariance[0] = message.angular_velocity_covariance[0] = -1.0
    variance = np.full(3, UNMEASURED_VARIANCE)
    noise_std_g = noise.sample_std_v(sensor) / sensor.nominal_scale_v_per_g
    variance[:len(sensor.axes)] = (noise_std_g * G0_MPS2) ** 2
    message.linear_acceleration_covariance = np.diag(variance).ravel()
    return message


class SampleOutput:
    """
    Publishes samples, the values that make them readable, and sensor time.

    sensor, frame_id, is_clock, tally: as given; `sensor` may be replaced, `frame_id` may follow
    that of a simulator, and `is_clock` ends beside another clock.
    """

    def __init__(self, node: Node, sensor: Sensor, frame_id: str, delay_ns: int, is_clock: bool,
                 clock: StampClock, tally: Tally) -> None:
        self._node, self._delay_ns, self._stamp_clock = node, delay_ns, clock
        self.sensor, self.frame_id, self.is_clock, self.tally = sensor, frame_id, is_clock, tally
        self._follows_frame = not frame_id
        self._writer = ImuWriter(sensor, frame_id)
        self._data = create_publisher(node, Imu, 'imu/data_raw', _QUEUE)
        self._info = create_publisher(node, DiagnosticStatus, 'sensor_info', 1, latched=True)
        self._clock = create_publisher(node, Clock, '/clock', 1) if is_clock else None

    def destroy(self) -> None:
        """Remove the topics."""
        for publisher in filter(None, (self._data, self._info, self._clock)):
            self._node.destroy_publisher(publisher)

    def follow_other_clock(self) -> str:
        """Stop being the clock if another node is; the one that sorts first stays."""
        if self._clock is None:
            return ''
        own_name = self._node.get_fully_qualified_name()
        # A publisher may be discovered before the name of its node; the next search has it.
        names = [f'{info.node_namespace.rstrip("/")}/{info.node_name}'
                 for info in self._node.get_publishers_info_by_topic(self._clock.topic_name)
                 if info.node_name != _UNKNOWN_NODE]
        others = [name for name in names if name != own_name
                  and (name.split('/')[-1] != self._node.get_name() or name < own_name)]
        if not others:
            return ''
        self._node.destroy_publisher(self._clock)
        self._clock, self.is_clock = None, False
        return others[0]

    def use(self, sensor: Sensor) -> None:
        """Convert samples by the nominal values of a sensor, and publish these."""
        self.sensor = sensor
        self._writer = ImuWriter(sensor, self.frame_id)
        self._info.publish(status_message('sensor_info', Status(
            Level.OK, '', sensor.serial, sensor_info(sensor))))

    def follow_frame(self, frame_id: str) -> None:
        """Publish in the frame of a simulator's samples, unless a frame was given."""
        if self._follows_frame and frame_id != self.frame_id:
            self.frame_id = frame_id
            self._writer = ImuWriter(self.sensor, frame_id)

    def subscribed(self) -> bool:
        """Return whether the samples have a subscriber."""
        return self._data.get_subscription_count() > 0

    def publish(self, samples: Samples, references: References) -> None:
        """Publish samples and what was recorded beside them."""
        finite = samples.finite()
        published_ns = finite.stamp_ns - self._delay_ns
        for message in self._writer.messages(published_ns, finite.volts, finite.imu_fields):
            self._data.publish(message)
        # The age of a sample is the time until here: all that can wait comes after it.
        now_ns = samples.until_ns if self.is_clock else self._stamp_clock.now().nanoseconds
        references.publish(samples.stamp_ns, samples.references)
        self.tally.ages.add(((now_ns - published_ns) * 1e-9).tolist())
        self.tally.count(finite.stamp_ns, int(self._writer.saturated(finite.volts).sum()),
                         finite.missing, finite.estimated)
        self.tally.now_ns = samples.until_ns
        if self._clock is not None:
            self._clock.publish(Clock(clock=stamp(samples.until_ns)))
