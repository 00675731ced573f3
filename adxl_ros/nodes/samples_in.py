# SPDX-License-Identifier: Apache-2.0

"""
Serialized messages of samples and joints, many at once.

This takes a tenth of the time of filling messages.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from adxl_ros.files import cdr
from adxl_ros.model.kinematics import UNKNOWN_ANGLE_RAD2
from adxl_ros.model.sensor import Sensor, to_volts
from adxl_ros.nodes.topics import Inbox, STEADY
import numpy as np
from rclpy.node import Node
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Imu, JointState

_TOPIC = 'imu/data_raw'
"""Topic of the samples, relative to the namespace of the node."""
_YAW_VARIANCE = 8
"""Place of the variance of yaw in an orientation's covariance of 9 numbers, from 0."""
_SILENT_S = 3.0
"""Time without samples after which the stream is silent, s; chosen."""
_QUEUE = 20000
"""Samples that are kept: 20 s at 1 kHz, longer than a fit takes."""


class Samples:
    """Takes the serialized messages that wait, and decodes many at once."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._raw: list[bytes] = []
        self.fault = ''  # Why the newest samples cannot be used, or ''
        self.restart_silence()
        self._subscription = Inbox(node, Imu, _TOPIC, _QUEUE)

    def restart_silence(self) -> None:
        """Restart the time without samples."""
        self._heard_ns = STEADY.now().nanoseconds

    def clear(self) -> None:
        """Forget all samples so far."""
        self._receive()
        self._raw.clear()

    def keep_newest(self) -> None:
        """Forget all samples but the newest, as many as the queue holds."""
        self._receive()
        del self._raw[:-_QUEUE]

    def waiting(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the samples that wait: stamps, ns, (n,), and m/s², (n, 3), finite; keep them."""
        self._receive()
        return finite_samples(self._raw)

    def take(self, unit: Sensor) -> tuple[np.ndarray, np.ndarray]:
        """Return the samples since the last call: stamps, ns, (n,), and volts, (n, m), finite."""
        self._receive()
        batch, self._raw = self._raw, []
        stamps, fields = decoded(batch, cdr.imu, linear_acceleration=3, orientation_covariance=9)
        accel, covariance = fields['linear_acceleration'], fields['orientation_covariance']
        # -1 in the first place means that a message has no orientation.
        yaw_rad2 = np.where(covariance[:, 0] >= 0, covariance[:, _YAW_VARIANCE], 0.0)
        accel = accel[:, :len(unit.axes)]
        finite = np.isfinite(accel)
        if batch:
            self.fault = self._why_compensated(yaw_rad2) or _why_not_finite(finite, unit)
        complete = finite.all(axis=1)
        return stamps[complete], to_volts(accel[complete], unit)

    def _receive(self) -> None:
        """Take the messages that have come since the last call."""
        new = self._subscription.take()
        self._raw += new
        if new:
            self.restart_silence()

    @property
    def is_mixed(self) -> bool:
        """Return whether several nodes publish the samples, so that none is taken."""
        return bool(self._subscription.fault())

    def _why_compensated(self, yaw_rad2: np.ndarray) -> str:
        """Return that a stream with these variances of yaw is compensated, or ''."""
        return '' if (yaw_rad2 != UNKNOWN_ANGLE_RAD2).all() else (
            f'{self._node.resolve_topic_name(_TOPIC)}: this stream is already compensated '
            '(it carries an orientation, as imu/data does); remap it to imu/data_raw of the '
            'driver')

    def silence(self) -> str:
        """Return in words why or for how long no sample has come; '' while samples come."""
        if self.is_mixed:
            return self._subscription.fault()
        silent_s = (STEADY.now().nanoseconds - self._heard_ns) * 1e-9
        if silent_s < _SILENT_S:
            return ''
        topic = self._node.resolve_topic_name(_TOPIC)
        publishers = '' if self._node.count_publishers(topic) else ', and nobody publishes it'
        return f'nothing on {topic} for {silent_s:.0f} s{publishers}'


def imu_samples(batch: Sequence[bytes]) -> tuple[np.ndarray, np.ndarray]:
    """Return the samples of serialized messages: stamps, ns, (n,), and m/s², (n, 3)."""
    stamps, fields = decoded(batch, cdr.imu, linear_acceleration=3)
    return stamps, fields['linear_acceleration']


def finite_samples(batch: Sequence[bytes]) -> tuple[np.ndarray, np.ndarray]:
    """Return the samples of serialized messages whose numbers are finite."""
    stamps, accel = imu_samples(batch)
    finite = np.isfinite(accel).all(axis=1)
    return stamps[finite], accel[finite]


def decoded(messages: Sequence[bytes], layout: Callable[[bytes], cdr.Layout], **counts: int
            ) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return stamps, ns, (n,), and fields of a count of numbers, (n, k), of n messages."""
    stamps_ns = np.empty(len(messages), np.int64)
    fields = {name: np.empty((len(messages), count)) for name, count in counts.items()}
    for table in cdr.tables(messages, layout):
        stamps_ns[table.rows] = table.stamp_ns()
        for name, values in fields.items():
            values[table.rows] = table.numbers(name)
    return stamps_ns, fields


def _why_not_finite(finite: np.ndarray, unit: Sensor) -> str:
    """Return why no sample is complete, by which values are finite, (n, m); '' if one is."""
    if finite.all(axis=1).any():
        return ''
    axis_lives = np.asarray(finite.any(axis=0))
    dead = ' and '.join(axis for axis, lives in zip(unit.axes, axis_lives) if not lives)
    return f'{dead or "one axis or another"} is not a number in all samples; check its wiring ' \
           'and the driver'


class JointReading(NamedTuple):
    """Motion of the joints at one stamp."""

    stamp_ns: int  # Stamp, ns
    position: dict[str, float]  # Position by joint, rad or m
    velocity: dict[str, float]  # Velocity by joint, rad/s or m/s; empty where the message has none


def joint_readings(messages: Sequence[bytes]) -> list[JointReading]:
    """Return the readings of serialized sensor_msgs/JointState, in their order."""
    numbered: list[tuple[int, JointReading]] = []
    for table in cdr.tables(messages, cdr.joint_state):
        names = [text for key, text in table.layout.texts.items() if key != 'frame_id']
        positions, velocities = (
            table.numbers(field).tolist() if field in table.layout.fields
            else [[]] * len(table.rows) for field in ('position', 'velocity'))
        numbered += [
            (row, JointReading(stamp_ns, dict(zip(names, position)), dict(zip(names, velocity))))
            for row, stamp_ns, position, velocity in zip(
                table.rows.tolist(), table.stamp_ns().tolist(), positions, velocities)]
    return [reading for _, reading in sorted(numbered, key=lambda item: item[0])]


class JointStateWriter:
    """Makes serialized messages of joints."""

    def __init__(self, names: Sequence[str]) -> None:
        zeros = [0.0] * len(names)
        self._template = serialize_message(
            JointState(name=list(names), position=zeros, velocity=zeros))
        self._layout = cdr.joint_state(self._template)

    def messages(self, stamp_ns: np.ndarray, position: np.ndarray, velocity: np.ndarray
                 ) -> list[bytes]:
        """
        Serialize readings.

        stamp_ns: stamps, ns, (n,); position: positions, rad or m, (n, k); velocity: velocities,
        rad/s or m/s, (n, k).
        """
        data = cdr.fill(self._template, self._layout, stamp_ns,
                        {'position': position, 'velocity': velocity}).tobytes()
        size = len(self._template)
        return [data[i:i + size] for i in range(0, len(data), size)]
