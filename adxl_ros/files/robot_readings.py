# SPDX-License-Identifier: Apache-2.0

"""Readings of a robot's joints, and of its base, from a bag or a table."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from adxl_ros.errors import UserError
from adxl_ros.files import cdr
from adxl_ros.files.atomic_write import AnyPath
from adxl_ros.files.bag_messages import Bag, choose_topic, JOINT_STATE, open_bag, typestore
from adxl_ros.files.bag_reader import positions, series
from adxl_ros.files.recording import is_bag
from adxl_ros.files.tables import open_table
import numpy as np

_ODOMETRY = 'nav_msgs/msg/Odometry'
_TRANSFORMS = 'tf2_msgs/msg/TFMessage'
_BASE = ('x_m', 'y_m', 'z_m', 'qx', 'qy', 'qz', 'qw')
"""Columns of the pose of the base in a table, behind `base_`."""


class JointTrack(NamedTuple):
    """Readings of a joint, or of the base."""

    time_s: np.ndarray  # (k,), rising
    values: np.ndarray  # (k,), or (k, 7) of the base


class RobotReadings(NamedTuple):
    """What a recording says of a robot."""

    path: str  # The recording, for messages
    joints: Mapping[str, JointTrack]  # Readings, rad or m, by name of the joint
    # Pose of the base in the world: x, y, z, m, and a quaternion x, y, z, w; None for a base that
    # is at rest and level
    base: JointTrack | None = None


def read(
    path: AnyPath,
    epoch_ns: int,
    topic: str = '',
    root: str = '',
    needs_joints: bool = True,
) -> RobotReadings:
    """
    Read joints and base of a robot.

    Parameters
    ----------
    path
        A bag with `sensor_msgs/JointState`, and `nav_msgs/Odometry` or tf where the base moves; or
        a table with `time_s`, columns NAME_rad or NAME_m, and base_x_m ... base_qw.
    epoch_ns
        Stamp of time 0, ns.
    topic
        Topic of the joints; empty for the only one.
    root
        Frame of the base, as tf names it.
    needs_joints
        Whether a bag without joints is refused.

    Returns
    -------
    RobotReadings
        Times, s, and values of each joint.

    Raises
    ------
    UserError
        There are no joints, or several topics of them.

    """
    if not is_bag(path):
        return _from_table(str(path))
    with open_bag(path) as bag:
        joints = {}
        if needs_joints:
            stamp_ns, _, columns = series(
                bag,
                choose_topic(bag, JOINT_STATE, 'joint_states', topic, 'joints'),
                cdr.joint_state,
                positions,
            )
            joints = {
                name: _track((stamp_ns - epoch_ns) / 1e9, values)
                for name, values in columns.items()
            }
        return RobotReadings(str(path), joints, _base(bag, root, epoch_ns))


def _from_table(path: str) -> RobotReadings:
    table = open_table(path)
    if 'time_s' not in table.names:
        raise UserError(f'{path}: no column time_s beside the joints of a robot')
    return of_columns(path, table.read(['time_s', *filter(_is_of_robot, table.names)]))


def _is_of_robot(name: str) -> bool:
    return name.startswith('base_') or name.endswith(('_rad', '_m'))


def of_columns(path: str, columns: Mapping[str, np.ndarray]) -> RobotReadings:
    """Return the readings in columns `time_s`, NAME_rad or NAME_m, and base_x_m ... base_qw."""
    times = columns['time_s']
    base = [columns[f'base_{name}'] for name in _BASE if f'base_{name}' in columns]
    joints = {
        name.rpartition('_')[0]: _track(times, values)
        for name, values in columns.items()
        if name.endswith(('_rad', '_m')) and not name.startswith('base_')
    }
    is_whole = len(base) == len(_BASE)
    return RobotReadings(path, joints, _track(times, np.column_stack(base)) if is_whole else None)


def _track(time_s: np.ndarray, values: np.ndarray) -> JointTrack:
    """Return the finite readings in the order of their times, each time once."""
    known = np.isfinite(values).reshape(len(values), -1).all(axis=1)
    read_s, first = np.unique(time_s[known], return_index=True)
    return JointTrack(read_s, values[known][first])


def _poses_in(message: Any, kind: str, root: str) -> list[tuple]:
    """Return header, moving frame, place and turn of odometry, or of the root in transforms."""
    if kind == _ODOMETRY:
        pose = message.pose.pose
        return [(message.header, message.child_frame_id, pose.position, pose.orientation)]
    return [
        (each.header, each.child_frame_id, each.transform.translation, each.transform.rotation)
        for each in message.transforms
        if each.child_frame_id.strip('/') == root
    ]


def _base(bag: Bag, root: str, epoch_ns: int) -> JointTrack | None:
    """Return the pose of the base by odometry, or else by tf; None where neither moves it."""
    store = typestore()
    kinds = dict(sorted(bag.types))
    odometry = [topic for topic, kind in kinds.items() if kind == _ODOMETRY]
    topics = odometry or [
        topic for topic, kind in kinds.items() if kind == _TRANSFORMS and topic.endswith('tf')
    ]
    # Stamps and poses by topic and the frame that moves
    moving: dict[tuple[str, str], tuple[list[int], list[list[float]]]] = {}
    for topic in topics:
        for raw in bag.messages(topic):
            message = store.deserialize_cdr(raw, kinds[topic])
            for header, child, place, turn in _poses_in(message, kinds[topic], root):
                stamps, poses = moving.setdefault((topic, child.strip('/') or root), ([], []))
                stamps.append(header.stamp.sec * 1_000_000_000 + header.stamp.nanosec)
                poses.append([place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w])
    moving = {key: track for key, track in moving.items() if np.ptp(track[1], axis=0).any()}
    if not moving:
        return None
    of_root = [key for key in moving if key[1] == root]
    if len(of_root) != 1:
        raise UserError(
            f'{bag.path}: {len(of_root) or "no"} topics have the pose of {root}, the root of the '
            f'URDF; there are {", ".join(f"{t} of {child}" for t, child in moving)}; record one '
            'for the root, or give a URDF whose root that frame is'
        )
    stamps, poses = moving[of_root[0]]
    return _track((np.array(stamps) - epoch_ns) / 1e9, np.array(poses))
