# SPDX-License-Identifier: Apache-2.0

"""The topics of the driver: acceleration, what was recorded beside it, the clock."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Mapping
import math
from typing import Any

from adxl_ros.files import cdr
from adxl_ros.files.recording_columns import JOINTS
from adxl_ros.files.stream_info import sensor_info
from adxl_ros.links.support.base import Samples
from adxl_ros.model.covariance import imu_covariance
from adxl_ros.model.sensor import Sensor, to_nominal_mps2
from adxl_ros.nodes import topics
from diagnostic_msgs.msg import DiagnosticStatus
import numpy as np
from rclpy.clock import Clock as StampClock
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import BatteryState, Imu, JointState, Temperature

MOST_AGES = 10_000
"""Newest ages that count: all of a second up to 10 kHz, the period of the diagnostics."""


def age_report(ages_s: deque[float]) -> dict[str, float]:
    """Take the ages, s, that another thread adds; return their percentiles, ms, if any."""
    taken_s = [ages_s.popleft() for _ in range(len(ages_s))]
    if not taken_s:
        return {}
    p50_ms, p99_ms = np.percentile(taken_s, [50, 99]) * 1e3
    return {'age_p50_ms': round(float(p50_ms), 3), 'age_p99_ms': round(float(p99_ms), 3)}


_FAULTS = {
    'missing': 'missing',
    'saturated': 'saturated',
    'withheld': 'withheld during the self-test',
}
"""Words of a warning by the count that has risen."""


class Tally:
    """
    Counts samples, and what went wrong with them, between two reports.

    samples: published samples; missing: samples that are lost; estimated: part of `missing` that
    is estimated by time, not counted; saturated: samples at a rail of the ADC or beyond the
    sensor's range; withheld: samples that a self-test of the sensor has changed.
    """

    def __init__(self, steady_ns: int) -> None:
        self.now_ns: int | None = None  # Sensor time up to which samples have been read, ns
        self.counts: Counter[str] = Counter()  # By the names above
        self.ages_s: deque[float] = deque(maxlen=MOST_AGES)  # Of the samples on publication, s
        self.newest_ns: int | None = None  # Stamp of the newest sample, ns
        # Counts and times at the last report
        self._reported: Counter[str] = Counter()
        self._reported_steady_ns = steady_ns
        self._reported_sensor_ns = 0

    def begin(self, now_ns: int) -> None:
        """Let the next report count sensor time from `now_ns`, ns."""
        self._reported_sensor_ns = now_ns

    def report(self, steady_ns: int, sensor_ns: int) -> tuple[dict[str, Any], str]:
        """Report what has been counted since the last report."""
        totals = self.counts.copy()
        new = {name: totals[name] - self._reported[name] for name in ('samples', *_FAULTS)}
        elapsed_ns = max(sensor_ns - self._reported_sensor_ns, 0)
        values: dict[str, Any] = {
            **{name: totals[name] for name in new},
            'missing_estimated': totals['estimated'],
            'rate_hz': round(new['samples'] / elapsed_ns * 1e9, 3) if elapsed_ns else 0.0,
            'speed': round(elapsed_ns / (steady_ns - self._reported_steady_ns), 3),
        }
        self._reported = totals
        self._reported_steady_ns = steady_ns
        self._reported_sensor_ns = sensor_ns
        if self.newest_ns is not None:
            values['age_s'] = round((sensor_ns - self.newest_ns) * 1e-9, 6)
        faults = [f'{new[name]} samples {words}' for name, words in _FAULTS.items() if new[name]]
        return values | age_report(self.ages_s), ', '.join(faults)


_QUEUE = 5000
"""Samples, and references beside them, that are kept for a slow subscriber: 5 s at 1 kHz."""
_STAGE = 'stage/joint_states'  # Topic of the stage angles, which have several columns
_COLUMNS = {
    _STAGE: tuple(JOINTS.values()),
    'temperature': ('temperature_c',),
    'supply': ('supply_v',),
}
"""Columns of a recording by topic."""
_KINDS = {_STAGE: JointState, 'temperature': Temperature, 'supply': BatteryState}
"""Type of each topic."""
_PERIODS_NS = {_STAGE: 10_000_000, 'temperature': 1_000_000_000, 'supply': 1_000_000_000}
"""Longest time between two messages with the same values, ns: 10 ms, as a stage's controller sends
at 100 Hz, and 1 s for quantities that change over minutes."""


class References:
    """Publishes what was recorded beside the sensor: stage angles, temperature, supply."""

    def __init__(self, node: Node, frame_id: str, columns: tuple[str, ...]) -> None:
        self._node = node
        self._frame_id = frame_id
        of_topics = {
            topic: [name for name in names if name in columns] for topic, names in _COLUMNS.items()
        }
        self._columns = {topic: names for topic, names in of_topics.items() if names}
        # Period and values of the last message by topic
        self._published = {
            topic: (-1, np.full(len(names), np.inf)) for topic, names in self._columns.items()
        }
        self._publishers = {
            topic: topics.create_publisher(node, _KINDS[topic], topic, _QUEUE)
            for topic in self._columns
        }

    def destroy(self) -> None:
        """Remove the topics."""
        for publisher in self._publishers.values():
            self._node.destroy_publisher(publisher)

    def publish(self, stamps_ns: np.ndarray, columns: Mapping[str, np.ndarray]) -> None:
        """
        Publish values that differ from those before, and others once in a period.

        stamps_ns: stamps, ns, (n,); columns: values by column, (n,); NaN where there is none.
        """
        for topic, names in self._columns.items() if len(stamps_ns) else ():
            values = np.column_stack([columns[name] for name in names])
            rows = np.flatnonzero(np.isfinite(values).any(axis=1))
            if not len(rows):
                continue
            values = values[rows]
            periods = stamps_ns[rows] // _PERIODS_NS[topic]
            last_period, last = self._published[topic]
            is_new = (np.diff(values, axis=0, prepend=last[None]) != 0).any(axis=1) | (
                np.diff(periods, prepend=last_period) != 0
            )
            self._published[topic] = int(periods[-1]), values[-1]
            for row, of_row in zip(rows[is_new], values[is_new].tolist()):
                message = self._message(topic, dict(zip(names, of_row)))
                message.header.stamp = topics.stamp(stamps_ns[row])
                self._publishers[topic].publish(message)

    def _message(self, topic: str, values: Mapping[str, float]) -> Any:
        """Make the message of the joints that have a value, or of a temperature or supply."""
        if topic == _STAGE:
            angles = {
                joint: values[column]
                for joint, column in JOINTS.items()
                if math.isfinite(values.get(column, math.nan))
            }
            return JointState(name=list(angles), position=list(angles.values()))
        message = (
            Temperature(temperature=values['temperature_c'])
            if topic == 'temperature'
            else BatteryState(voltage=values['supply_v'], present=True)
        )
        message.header.frame_id = self._frame_id
        return message


_UNKNOWN_NODE = '_NODE_NAME_UNKNOWN_'
"""Name that the middleware gives a node that it has not discovered yet (rmw_dds_common)."""


def imu_writer(sensor: Sensor, frame_id: str) -> topics.MessageWriter:
    """Return what writes the measured axes of samples, and further fields."""
    return topics.MessageWriter(
        imu_message(sensor, frame_id), cdr.imu, linear_acceleration=len(sensor.axes)
    )


def imu_message(sensor: Sensor, frame_id: str) -> Imu:
    """Make the message that all samples have in common."""
    message = Imu()
    message.header.frame_id = frame_id
    message.orientation_covariance[0] = message.angular_velocity_covariance[0] = -1.0
    message.linear_acceleration_covariance = imu_covariance(sensor)
    return message


class SampleOutput:
    """
    Publishes samples, the values that make them readable, and sensor time.

    sensor, frame_id, is_clock, tally: as given; `sensor` may be replaced, `frame_id` may follow
    that of a simulator, and `is_clock` ends where another node publishes /clock.
    """

    def __init__(
        self,
        node: Node,
        sensor: Sensor,
        frame_id: str,
        delay_ns: int,
        is_clock: bool,
        clock: StampClock,
        tally: Tally,
    ) -> None:
        self._node = node
        self._delay_ns = delay_ns
        self._stamp_clock = clock
        self.sensor = sensor
        self.frame_id = frame_id
        self.is_clock = is_clock
        self.tally = tally
        self._follows_frame = not frame_id
        self._writer = imu_writer(sensor, frame_id)
        self._data = topics.create_publisher(node, Imu, 'imu/data_raw', _QUEUE)
        self._info = topics.create_publisher(
            node, DiagnosticStatus, 'sensor_info', 1, latched=True
        )
        self._clock = topics.create_publisher(node, Clock, '/clock', 1) if is_clock else None
        self._left: Publisher | None = None  # Publisher of a clock that another node has become
        self._leave = node.create_guard_condition(self._destroy_left)

    def destroy(self) -> None:
        """Remove the topics."""
        self._destroy_left()
        self._node.destroy_guard_condition(self._leave)
        for publisher in filter(None, (self._data, self._info, self._clock)):
            self._node.destroy_publisher(publisher)

    def _destroy_left(self) -> None:
        """Destroy the publisher of the clock; an executor that waits for it would fail."""
        left = self._left
        self._left = None
        if left is not None:
            self._node.destroy_publisher(left)

    def follow_other_clock(self) -> None:
        """Stop being the clock if another node is; of drivers, the one that sorts first stays."""
        own = self._node.get_namespace(), self._node.get_name()
        clocks = [
            (info.node_namespace, info.node_name)
            for info in self._node.get_publishers_info_by_topic('/clock')
            if info.node_name != _UNKNOWN_NODE
        ]
        # Another driver, which has the same name, follows this one if it sorts later.
        followers = [name for name in clocks if name[1] == own[1] and name > own]
        if self._clock is None or not set(clocks) - {own, *followers}:
            return
        # The thread of the link calls this: the executor destroys the publisher in its own.
        self._left = self._clock
        self._clock = None
        self.is_clock = False
        self._leave.trigger()
        self._node.set_parameters([Parameter('use_sim_time', value=True)])
        self._node.get_logger().warning(
            'another node publishes /clock: this driver follows it, '
            'and link.speed is that of this clock'
        )

    def use(self, sensor: Sensor) -> None:
        """Convert samples by the nominal values of a sensor, and publish these."""
        self.sensor = sensor
        self._writer = imu_writer(sensor, self.frame_id)
        self._info.publish(
            topics.status_message(
                'sensor_info',
                topics.Status(topics.Level.OK, '', sensor.serial, sensor_info(sensor)),
            )
        )

    def follow_frame(self, frame_id: str) -> None:
        """Publish in the frame of a simulator's samples, unless a frame was given."""
        if self._follows_frame and frame_id != self.frame_id:
            self.frame_id = frame_id
            self._writer = imu_writer(self.sensor, frame_id)

    def subscribed(self) -> bool:
        """Return whether the samples have a subscriber."""
        return self._data.get_subscription_count() > 0

    def publish(self, samples: Samples, references: References) -> None:
        """Publish samples and what was recorded beside them."""
        finite = samples.finite()
        published_ns = finite.stamp_ns - self._delay_ns
        fields = {
            **finite.imu_fields,
            'linear_acceleration': to_nominal_mps2(finite.volts, self.sensor),
        }
        for message in self._writer.messages(published_ns, **fields):
            self._data.publish(message)
        # The age of a sample is the time until here: all that can wait comes after it.
        now_ns = samples.until_ns if self.is_clock else self._stamp_clock.now().nanoseconds
        references.publish(samples.stamp_ns, samples.references)
        self.tally.ages_s.extend(((now_ns - published_ns) * 1e-9).tolist())
        self.tally.counts.update(
            samples=len(published_ns),
            missing=finite.missing,
            estimated=finite.estimated,
            saturated=int(self.sensor.saturated(finite.volts).any(axis=1).sum()),
        )
        if len(published_ns):
            self.tally.newest_ns = int(finite.stamp_ns[-1])
        self.tally.now_ns = samples.until_ns
        if self._clock is not None:
            self._clock.publish(Clock(clock=topics.stamp(samples.until_ns)))
