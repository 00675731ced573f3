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
    """Read joints and base from the columns of a table."""
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


class _Pose(NamedTuple):
    """A pose of a frame that moves."""

    frame: str
    stamp_ns: int
    values: tuple[float, ...]  # x, y, z, m, and a quaternion x, y, z, w


def _pose(message: Any, place: Any, turn: Any) -> _Pose:
    """Return the pose of a message, by its place and its turn."""
    stamp = message.header.stamp
    return _Pose(
        frame=message.child_frame_id.strip('/'),
        stamp_ns=stamp.sec * 1_000_000_000 + stamp.nanosec,
        values=(place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w),
    )


def _poses_in(message: Any, kind: str, root: str) -> list[_Pose]:
    """Return the pose of odometry, or those of the root in transforms."""
    if kind == _ODOMETRY:
        pose = message.pose.pose
        return [_pose(message, pose.position, pose.orientation)]
    poses = [
        _pose(each, each.transform.translation, each.transform.rotation)
        for each in message.transforms
    ]
    return [pose for pose in poses if pose.frame == root]


def _base(bag: Bag, root: str, epoch_ns: int) -> JointTrack | None:
    """Return the pose of the base by odometry, or else by tf; None where neither moves it."""
    store = typestore()
    kinds = dict(sorted(bag.types))
    odometry = [topic for topic, kind in kinds.items() if kind == _ODOMETRY]
    transforms = [topic for topic, kind in kinds.items() if kind == _TRANSFORMS]
    topics = odometry or [topic for topic in transforms if topic.endswith('tf')]
    found: dict[tuple[str, str], list[_Pose]] = {}  # By topic and the frame that moves
    for topic in topics:
        for raw in bag.messages(topic):
            message = store.deserialize_cdr(raw, kinds[topic])
            for pose in _poses_in(message, kinds[topic], root):
                found.setdefault((topic, pose.frame or root), []).append(pose)
    tracks = {
        key: _track(
            (np.array([pose.stamp_ns for pose in poses]) - epoch_ns) / 1e9,
            np.array([pose.values for pose in poses]),
        )
        for key, poses in found.items()
    }
    moving = {
        key: track for key, track in tracks.items() if (track.values != track.values[:1]).any()
    }
    if not moving:
        return None
    of_root = [track for (_, frame), track in moving.items() if frame == root]
    if len(of_root) != 1:
        raise UserError(
            f'{bag.path}: {len(of_root) or "no"} topics have the pose of {root}, the root of the '
            f'URDF; there are {", ".join(f"{t} of {child}" for t, child in moving)}; record one '
            'for the root, or give a URDF whose root that frame is'
        )
    return of_root[0]
