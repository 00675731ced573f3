# SPDX-License-Identifier: Apache-2.0

"""The topics of a bag that hold the sensor and its references, and what it states of itself."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.files.bag_messages import Bag
from adxl_ros.model.constants import MEASURED_AXES

IMU = 'sensor_msgs/msg/Imu'
"""Type of the sensor's output."""

JOINT_STATE = 'sensor_msgs/msg/JointState'
"""Type of the positions and commands of the stage."""

DIAGNOSTIC_STATUS = 'diagnostic_msgs/msg/DiagnosticStatus'
"""Type of `sensor_info`."""

TEMPERATURE = 'sensor_msgs/msg/Temperature'
"""Type of the temperature."""

BATTERY_STATE = 'sensor_msgs/msg/BatteryState'
"""Type of the supply."""

_IDENTITY = ('serial', 'axes', 'nominal_zero_g_v', 'nominal_scale_v_per_g')
"""Keys of sensor_info that must not change within a recording."""


@dataclass(frozen=True)
class Topics:
    """Full names of the topics in a bag; None where the bag does not hold it."""

    imu: str  # The sensor's output
    joints: str | None = None  # Positions of the stage
    info: str | None = None  # What the sensor states of itself
    # temperature, supply: References of these quantities
    temperature: str | None = None
    supply: str | None = None
    command: str | None = None  # Commands of the stage

    def sampled(self) -> list[str]:
        """Return the topics to read sample by sample."""
        return [topic for topic in (self.imu, self.joints, self.temperature, self.supply,
                                    self.command) if topic]


def find_topics(bag: Bag, topic: str = '') -> Topics:
    """Find the topics by their names, in any namespace, and their types."""
    imu = _chosen(bag, topic) if topic else _only(bag, 'imu/data_raw', IMU) or _only_imu(bag)
    space = imu.removesuffix('imu/data_raw')
    if space == imu:
        space = imu[:imu.rfind('/') + 1]
    joints = _beside(bag, space, 'stage/joint_states', JOINT_STATE)
    stage = (joints or f'{space}stage/joint_states').removesuffix('joint_states')
    return Topics(imu, joints,
                  _info(bag, imu, space),
                  # Other nodes use these names, too: a topic of another type is ignored.
                  _typed(bag, space + 'temperature', TEMPERATURE),
                  _typed(bag, space + 'supply', BATTERY_STATE),
                  _typed(bag, stage + 'command', JOINT_STATE))


def _chosen(bag: Bag, topic: str) -> str:
    """Return the full name of the topic that the user has named."""
    kinds = {kind for name, kind in bag.types if name.lstrip('/') == topic.lstrip('/')}
    if IMU in kinds:
        return next(name for name, kind in bag.types
                    if kind == IMU and name.lstrip('/') == topic.lstrip('/'))
    if kinds:
        raise UserError(f'{bag.path}: topic {topic} is of type {", ".join(sorted(kinds))}, '
                        f'expected {IMU}; {_imu_choices(bag)}')
    raise UserError(f'{bag.path}: no topic {topic}; {_imu_choices(bag)}')


def _imu_topics(bag: Bag) -> list[str]:
    return sorted(topic for topic, kind in bag.types if kind == IMU)


def _imu_choices(bag: Bag) -> str:
    """Return which topics `--topic` can name, for messages."""
    topics = _imu_topics(bag)
    return f'name one of {", ".join(topics)}' if topics else f'it holds {_contents(bag)}'


def _only_imu(bag: Bag) -> str:
    """Return the only topic of the sensor's type."""
    topics = _imu_topics(bag)
    if len(topics) == 1:
        return topics[0]
    if topics:
        raise UserError(f'{bag.path}: several topics of type {IMU}, none of them imu/data_raw: '
                        f'{", ".join(topics)}; choose one: --topic {topics[0]}')
    raise UserError(f'{bag.path}: no topic imu/data_raw of type {IMU}, and no other of this type; '
                    f'it holds {_contents(bag)}')


def _info(bag: Bag, imu: str, space: str) -> str | None:
    """Return the topic on which the sensor states its values."""
    if imu.endswith('imu/data_raw') or len(_imu_topics(bag)) == 1:
        return _beside(bag, space, 'sensor_info', DIAGNOSTIC_STATUS)
    # With several sensors, the only sensor_info may be that of another one.
    return _typed(bag, space + 'sensor_info', DIAGNOSTIC_STATUS)


def find_ideal(bag: Bag) -> Topics:
    """Find another simulator's specific force: the only topic of type sensor_msgs/Imu."""
    candidates = sorted(topic for topic, kind in bag.types if kind == IMU)
    if len(candidates) == 1:
        return Topics(candidates[0])
    if not candidates:
        raise UserError(f'{bag.path}: no topic of type {IMU}; it holds {_contents(bag)}')
    imu = _only(bag, 'imu/data_raw', IMU)
    if imu is None:
        raise UserError(f'{bag.path}: several topics of type {IMU}, none of them imu/data_raw: '
                        f'{", ".join(candidates)}; record one')
    return Topics(imu)


def _typed(bag: Bag, topic: str, kind: str) -> str | None:
    """Return a topic if the bag holds it with this type, else None."""
    return topic if (topic, kind) in bag.types else None


def _beside(bag: Bag, space: str, name: str, kind: str) -> str | None:
    """Return the topic in the sensor's own namespace or, if there is none, the only one."""
    return _typed(bag, space + name, kind) or _only(bag, name, kind)


def _only(bag: Bag, name: str, kind: str) -> str | None:
    """Return the topic of this name in any namespace; None if there is none."""
    candidates = sorted(item for item in bag.types if f'/{item[0]}'.endswith(f'/{name}'))
    for topic, other in candidates:
        if other != kind:
            raise UserError(f'{bag.path}: topic {topic} is of type {other}, expected {kind}')
    if len(candidates) > 1:
        raise UserError(f'{bag.path}: several topics {name}: '
                        f'{", ".join(topic for topic, _ in candidates)}; record one sensor'
                        + f', or choose one: --topic {candidates[0][0]}' * (kind == IMU))
    return candidates[0][0] if candidates else None


def _contents(bag: Bag) -> str:
    """Return topics and types of a bag, and its cut, for messages."""
    listed = ', '.join(f'{topic} ({kind})' for topic, kind in sorted(bag.types))
    return (listed or 'no messages') + (f'; {bag.cut}' if bag.cut else '')


def typestore() -> Any:
    """Return the message definitions of ROS 2 Jazzy."""
    from rosbags.typesys import get_typestore, Stores
    return get_typestore(Stores.ROS2_JAZZY)


def read_info(bag: Bag, topic: str | None) -> dict[str, str]:
    """Return what the sensor states in the last message of `sensor_info`."""
    info: dict[str, str] = {}
    if topic is None:
        return info
    types = typestore()
    for _, raw in bag.messages([topic]):
        try:
            message = types.deserialize_cdr(raw, DIAGNOSTIC_STATUS)
        except Exception as error:
            # In damaged bytes, the decoder of rosbags can raise errors of any kind.
            raise UserError(f'{bag.path}: topic {topic}: damaged message: {error}') from error
        new = {pair.key: pair.value for pair in message.values}
        for key in _IDENTITY:
            if info.get(key, new.get(key)) != new.get(key):
                raise UserError(f'{bag.path}: topic {topic}: {key} changes from {info[key]} to '
                                f'{new.get(key)}; record each sensor by itself')
        info = new
    if info.get('axes', 'x') not in MEASURED_AXES:
        raise UserError(f"{bag.path}: topic {topic}: axes is {info['axes']!r}, "
                        'expected x, xy or xyz')
    return info
