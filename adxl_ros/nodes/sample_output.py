# SPDX-License-Identifier: Apache-2.0

"""The topics of the driver: acceleration, what was recorded beside it, the clock."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
import struct
from typing import Any, NamedTuple

from adxl_ros.files import cdr
from adxl_ros.files.recording_columns import JOINTS
from adxl_ros.files.stream_info import sensor_info
from adxl_ros.links.support.base import Samples
from adxl_ros.model import noise
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.covariance import UNMEASURED_VARIANCE
from adxl_ros.model.sensor import Sensor, to_nominal_mps2
from adxl_ros.nodes.topics import create_publisher, Level, stamp, Status, status_message
from diagnostic_msgs.msg import DiagnosticStatus
import numpy as np
from rclpy.clock import Clock as StampClock
from rclpy.node import Node
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import BatteryState, Imu, JointState, Temperature

_KEPT = 10_000
"""Newest ages that count; chosen: one second at 10 kHz, in a memory that does not grow."""


class SampleAges:
    """Ages of the newest published samples; one thread adds them, another one reports."""

    def __init__(self) -> None:
        self._ages_s: deque[float] = deque(maxlen=_KEPT)

    def add(self, ages_s: Iterable[float]) -> None:
        """Add the ages of samples that were published just now, s."""
        self._ages_s.extend(ages_s)

    def report(self) -> dict[str, float]:
        """Return median and 99th percentile since the last report, ms; nothing without samples."""
        ages_s, self._ages_s = self._ages_s, deque(maxlen=_KEPT)
        if not ages_s:
            return {}
        p50_ms, p99_ms = np.percentile(list(ages_s), [50, 99]) * 1e3
        return {'age_p50_ms': round(float(p50_ms), 3), 'age_p99_ms': round(float(p99_ms), 3)}


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

    samples: published samples; missing: samples that are lost; estimated: part of `missing` that
    is estimated by time, not counted; saturated: samples at a rail of the ADC or beyond the
    sensor's range.
    """

    def __init__(self, steady_ns: int) -> None:
        # Sensor time up to which samples have been read, ns; None before the first one
        self.now_ns: int | None = None
        self.samples = self.missing = self.estimated = self.saturated = 0
        self.ages = SampleAges()  # Ages of the samples on publication
        self._newest_ns: int | None = None
        self._reported = _Totals(steady_ns, 0, 0, 0, 0, 0)

    def begin(self, now_ns: int) -> None:
        """Let the next report count sensor time from `now_ns`, ns."""
        self._reported = self._reported._replace(sensor_ns=now_ns)

    def count(self, stamps_ns: np.ndarray, saturated: int, missing: int, estimated: int) -> None:
        """
        Add samples.

        stamps_ns: stamps of the published ones, ns, (n,).
        """
        self.samples += len(stamps_ns)
        self.saturated += saturated
        self.missing += missing
        self.estimated += estimated
        if len(stamps_ns):
            self._newest_ns = int(stamps_ns[-1])

    def report(self, steady_ns: int, sensor_ns: int) -> tuple[dict[str, Any], str]:
        """Report what has been counted since the last report."""
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
        values |= self.ages.report()
        estimated = f', {new.estimated} of them estimated' if new.estimated else ''
        warnings = [f'{new.missing} samples missing{estimated}'] if new.missing else []
        warnings += [f'{new.saturated} samples saturated'] if new.saturated else []
        return values, ', '.join(warnings)


_REFERENCE_QUEUE = 1000
"""References that are kept for a slow subscriber: 10 s of stage angles."""
_STAGE_PERIOD_NS = 10_000_000
"""Longest time between two messages with the same stage angles, ns; chosen: 100 Hz, as a stage's
controller sends."""
_SCALAR_PERIOD_NS = 1_000_000_000
"""Longest time between two messages with the same temperature or supply, ns; chosen."""

_JOINTS = 'stage'
"""Key of the publisher of the stage angles, which have several columns."""
_SCALARS = {'temperature_c': (Temperature, 'temperature'), 'supply_v': (BatteryState, 'supply')}
"""Message type and topic of what has one value a sample, by the column of a recording."""


class References:
    """Publishes what was recorded beside the sensor: stage angles, temperature, supply."""

    def __init__(self, node: Node, frame_id: str, columns: tuple[str, ...]) -> None:
        self._node, self._frame_id = node, frame_id
        self._published: dict[str, tuple[int, np.ndarray]] = {}
        self._joints = {column: joint for joint, column in JOINTS.items() if column in columns}
        self._publishers = {}
        if self._joints:
            self._publishers[_JOINTS] = create_publisher(
                node, JointState, 'stage/joint_states', _REFERENCE_QUEUE)
        for column, (kind, topic) in _SCALARS.items():
            if column in columns:
                self._publishers[column] = create_publisher(node, kind, topic, _REFERENCE_QUEUE)

    def destroy(self) -> None:
        """Remove the topics."""
        for publisher in self._publishers.values():
            self._node.destroy_publisher(publisher)

    def publish(self, stamps_ns: np.ndarray, columns: Mapping[str, np.ndarray]) -> None:
        """
        Publish values that have changed, and others once in a period.

        stamps_ns: stamps, ns, (n,); columns: values by column, (n,); NaN where there is none.
        """
        if not len(stamps_ns):
            return
        for name, publisher in self._publishers.items():
            if name == _JOINTS:
                values = np.column_stack([columns[column] for column in self._joints])
                for i in self._new_rows(name, stamps_ns, values, _STAGE_PERIOD_NS):
                    publisher.publish(self._joint_state(stamps_ns[i], values[i]))
            else:
                values = columns[name][:, None]
                for i in self._new_rows(name, stamps_ns, values, _SCALAR_PERIOD_NS):
                    publisher.publish(self._scalar(name, stamps_ns[i], float(values[i, 0])))

    def _new_rows(self, name: str, stamps_ns: np.ndarray, values: np.ndarray, period_ns: int
                  ) -> np.ndarray:
        """Return the rows of values, (n, k), that differ from the row before or begin a period."""
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
        """Make the message of a temperature, °C, or supply, V, by the column of a recording."""
        message = Temperature(temperature=value) if name == 'temperature_c' else \
            BatteryState(voltage=value, present=True)
        message.header.stamp, message.header.frame_id = stamp(stamp_ns), self._frame_id
        return message


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
