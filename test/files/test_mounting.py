# SPDX-License-Identifier: Apache-2.0

"""The mounting against scipy's rotations."""

from adxl_ros.files import imu_message
from adxl_ros.model.kinematics import Covariance3, Mounting
import numpy as np
from rclpy.serialization import deserialize_message, serialize_message
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import Imu

RPY = (0.3, -1.1, 2.2)
TURN = Rotation.from_euler('xyz', RPY)
MOUNTING = Mounting(RPY)


def test_rotation_covariance_and_orientation_agree_with_scipy():
    rng = np.random.default_rng(1)
    vector, root = rng.normal(size=3), rng.normal(size=(3, 3))
    covariance = root @ root.T
    np.testing.assert_allclose(MOUNTING.rows, TURN.as_matrix(), atol=1e-15)
    np.testing.assert_allclose(MOUNTING.rotate(vector), TURN.apply(vector))
    expected = TURN.as_matrix() @ covariance @ TURN.as_matrix().T
    np.testing.assert_allclose(
        MOUNTING.rotate_covariance(Covariance3.of(covariance)).matrix, expected
    )
    np.testing.assert_allclose(MOUNTING.rotate_matrix(covariance.ravel()), expected.ravel())
    case = Rotation.random(random_state=3)
    robot = Rotation.from_quat(MOUNTING.rotate_orientation(case.as_quat()))
    np.testing.assert_allclose(robot.as_matrix(), (case * TURN.inv()).as_matrix(), atol=1e-12)


def test_a_levelled_mounting_makes_the_force_vertical_and_keeps_yaw():
    force = TURN.inv().apply([0.0, 0.0, 9.8])
    levelled = MOUNTING.levelled(force)
    np.testing.assert_allclose(levelled.rotate(force), [0, 0, 9.8], atol=1e-12)
    assert levelled.rpy_rad[2] == RPY[2]


def test_a_message_gets_another_frame_of_any_length():
    """The numbers of the message stay, whatever the lengths of both names."""
    for old in ('', 'a', 'imu_link', 'camera_imu_optical'):
        message = Imu()
        message.header.frame_id, message.header.stamp.sec = old, 7
        message.orientation.x, message.linear_acceleration.z = 0.5, 9.8
        raw = serialize_message(message)
        imu_message.read(raw)
        for new in ('', 'b', 'base_link', 'base_footprint_frame'):
            changed = deserialize_message(imu_message.with_frame(raw, new), Imu)
            message.header.frame_id = new
            assert changed == message


def test_angular_velocity_is_turned_unless_it_is_absent():
    message = Imu()
    message.angular_velocity.x = 1.0
    message.angular_velocity_covariance = np.diag([1.0, 2.0, 3.0]).ravel()
    turned = deserialize_message(imu_message.turned(serialize_message(message), MOUNTING), Imu)
    w = turned.angular_velocity
    np.testing.assert_allclose([w.x, w.y, w.z], TURN.apply([1, 0, 0]))
    np.testing.assert_allclose(
        turned.angular_velocity_covariance,
        (TURN.as_matrix() @ np.diag([1.0, 2.0, 3.0]) @ TURN.as_matrix().T).ravel(),
    )
    message.angular_velocity_covariance[0] = -1.0
    raw = serialize_message(message)
    assert imu_message.turned(raw, MOUNTING) == raw
