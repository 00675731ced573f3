# SPDX-License-Identifier: Apache-2.0

"""Bags that the library rosbags writes message by message."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

rosbag2 = pytest.importorskip('rosbags.rosbag2')
typesys = pytest.importorskip('rosbags.typesys')
STORE = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
TYPES = STORE.types
IMU = 'sensor_msgs/msg/Imu'
JOINTS = 'sensor_msgs/msg/JointState'
INFO = 'diagnostic_msgs/msg/DiagnosticStatus'
STRING = 'std_msgs/msg/String'
EPOCH_NS = 1_750_000_000_000_000_000


@dataclass
class Sent:
    """A message of a bag; `raw` are bytes of a message without a type, `log_ns` its log time."""

    topic: str
    kind: str
    stamp_ns: int
    message: Any = None
    raw: bytes | None = None
    log_ns: int | None = None


def header(stamp_ns: int, frame: str = 'imu_link') -> Any:
    sec, nanosec = divmod(stamp_ns, 10**9)
    time = TYPES['builtin_interfaces/msg/Time'](sec=sec, nanosec=nanosec)
    return TYPES['std_msgs/msg/Header'](stamp=time, frame_id=frame)


def imu(
    stamp_ns: int,
    accel: Iterable[float] = (1.0, 2.0, 3.0),
    topic: str = '/imu/data_raw',
    variance: Iterable[float] = (1e-4, 1e-4, 1e6),
    frame: str = 'imu_link',
) -> Sent:
    vector = TYPES['geometry_msgs/msg/Vector3']
    none = np.full(9, -1.0)
    return Sent(
        topic,
        IMU,
        stamp_ns,
        TYPES[IMU](
            header=header(stamp_ns, frame),
            orientation=TYPES['geometry_msgs/msg/Quaternion'](x=0.0, y=0.0, z=0.0, w=1.0),
            orientation_covariance=none,
            angular_velocity=vector(x=0.0, y=0.0, z=0.0),
            angular_velocity_covariance=none,
            linear_acceleration=vector(*map(float, accel)),
            linear_acceleration_covariance=np.diag(np.array(list(variance), float)).ravel(),
        ),
    )


def joints(stamp_ns: int, topic: str = '/stage/joint_states', **positions: float) -> Sent:
    none = np.zeros(0)
    return Sent(
        topic,
        JOINTS,
        stamp_ns,
        TYPES[JOINTS](
            header=header(stamp_ns, ''),
            name=list(positions),
            position=np.array(list(positions.values())),
            velocity=none,
            effort=none,
        ),
    )


def info(topic: str = '/sensor_info', **values: str) -> Sent:
    pairs = [TYPES['diagnostic_msgs/msg/KeyValue'](key=k, value=v) for k, v in values.items()]
    return Sent(
        topic,
        INFO,
        EPOCH_NS,
        TYPES[INFO](level=0, name='', message='', hardware_id='', values=pairs),
    )


def bag_of(path: Path, messages: Iterable[Sent], little_endian: bool = True) -> Path:
    connections: dict[tuple[str, str], Any] = {}
    with rosbag2.Writer(path, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP) as writer:
        for i, sent in enumerate(messages):
            key = sent.topic, sent.kind
            if key not in connections:
                connections[key] = writer.add_connection(*key, typestore=STORE)
            raw = sent.raw or STORE.serialize_cdr(
                sent.message, sent.kind, little_endian=little_endian
            )
            log_ns = EPOCH_NS + 1000 * i if sent.log_ns is None else sent.log_ns
            writer.write(connections[key], log_ns, raw)  # in the order of arrival
    return path


def stamps(count: int, step_ns: int = 1_000_000) -> list[int]:
    return [EPOCH_NS + 123_456_789 + i * step_ns for i in range(count)]
