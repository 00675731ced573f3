# SPDX-License-Identifier: Apache-2.0

"""The nodes on the stream of any IMU, which publishes no sensor_info."""

from collections.abc import Callable, Iterator
from pathlib import Path

from geometry_msgs.msg import Vector3Stamped
from graph import accel, Graph, stamp_ns
import numpy as np
from processes import Started
import pytest
from sensor_msgs.msg import Imu
from std_srvs.srv import Trigger

G = 9.80665
TOPIC = 'camera/imu'
NOISE_MPS2 = 0.02
RATE_HZ = 100.0
Start = Callable[..., Started]


class Camera:
    """A camera's IMU: three axes, a gyroscope, an orientation, host stamps, no sensor_info."""

    def __init__(self, graph: Graph) -> None:
        self.graph = graph
        self._publisher = graph.node.create_publisher(Imu, TOPIC, 1000)
        self._rng, self._jitter = np.random.default_rng(5), np.random.default_rng(6)
        self._count = 0

    def connected(self) -> None:
        self.graph.spin_until(self._publisher.get_subscription_count, 20, 'a subscriber')

    def rest(self, force_mps2: list[float], seconds: float) -> None:
        for _ in range(round(seconds * RATE_HZ)):
            self.send(np.asarray(force_mps2) + self._rng.normal(0, NOISE_MPS2, 3))
            if self._count % 20 == 0:
                self.graph.spin(0.005)

    def turn(self, seconds: float = 0.5) -> None:
        for _ in range(round(seconds * RATE_HZ)):
            self.send(self._rng.normal(0, 5.0, 3))

    def send(self, force_mps2: np.ndarray) -> None:
        message = Imu()
        time_ns = 1_700_000_000_000_000_000 + round(
            (self._count + self._jitter.uniform(0, 0.9)) * 1e9 / RATE_HZ
        )
        self._count += 1
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(time_ns, 10**9)
        message.header.frame_id = 'camera_imu'
        message.orientation.x, message.orientation.w = 0.6, 0.8
        message.orientation_covariance = [0.01, 0.0, 0.0, 0.0, 0.01, 0.0, 0.0, 0.0, 0.02]
        message.angular_velocity.x, message.angular_velocity.z = 0.25, -0.5
        message.angular_velocity_covariance = [0.04, 0.0, 0.0, 0.0, 0.04, 0.0, 0.0, 0.0, 0.04]
        a = message.linear_acceleration
        a.x, a.y, a.z = map(float, force_mps2)
        self._publisher.publish(message)


@pytest.fixture
def camera(ros_env: dict[str, str]) -> Iterator[Camera]:
    with Graph() as graph:
        yield Camera(graph)


def test_compensation_takes_any_imu(camera: Camera, start: Start) -> None:
    """Axes, rate and noise are measured; the gyroscope passes through."""
    graph = camera.graph
    data = graph.listen(Imu, 'imu/data')
    node = start(
        'compensation', '--ros-args', '-r', f'imu/data_raw:={TOPIC}', '-p', 'orientation:=tilt'
    )
    camera.connected()

    def published() -> bool:
        camera.rest([0.0, 0.0, G], 0.1)
        graph.spin(0.05)
        return bool(data)

    graph.spin_until(published, 40, 'corrected samples')
    node.wait_for('Hz, axes: xyz')
    message = data[-1]
    assert message.header.frame_id == 'camera_imu' and stamp_ns(message) > 0
    np.testing.assert_allclose(accel(message), [0, 0, G], atol=0.2)
    assert (message.angular_velocity.x, message.angular_velocity.z) == (0.25, -0.5)
    variances = np.reshape(message.linear_acceleration_covariance, (3, 3)).diagonal()
    np.testing.assert_allclose(np.sqrt(variances), NOISE_MPS2, rtol=0.3)
    assert abs(message.orientation.x) < 0.01, 'the tilt, not what the camera states'


def test_a_mounted_sensor_is_turned_into_the_frame_of_the_robot(
    camera: Camera, start: Start, tmp_path: Path
) -> None:
    """
    Acceleration, covariance, gyroscope and tilt are those of the robot, after ~/level, too.

    The bias of the gyroscope is subtracted in the frame of the sensor, and its variance added.
    The level is written into the file of the mounting.
    """
    mounted = tmp_path / 'mounted.yaml'
    mounted.write_text(
        'compensation:\n  ros__parameters:\n    mounting: {rpy_rad: '
        '[3.141592653589793, 0.0, 0.0]}  # upside down\n'
    )
    graph = camera.graph
    data, tilt = graph.listen(Imu, 'imu/data'), graph.listen(Vector3Stamped, 'tilt')
    free = graph.listen(Vector3Stamped, 'imu/linear_acceleration_free')
    start(
        'compensation',
        '--ros-args',
        '-r',
        f'imu/data_raw:={TOPIC}',
        '--params-file',
        mounted,
        '-p',
        'free_acceleration:=true',
        '-p',
        'gyro.bias_radps:=[0.05, 0.02, -0.1]',
        '-p',
        'gyro.bias_std_radps:=[0.01, 0.01, 0.03]',
    )
    camera.connected()

    def until(condition: Callable[[], bool], purpose: str) -> None:
        def met() -> bool:
            camera.rest([0.0, 1.0, -G], 0.1)
            graph.spin(0.05)
            return bool(data and tilt and free) and condition()

        graph.spin_until(met, 40, purpose)

    until(lambda: True, 'corrected samples')
    assert data[-1].header.frame_id == tilt[-1].header.frame_id == 'base_link'
    np.testing.assert_allclose(accel(data[-1]), [0, -1, G], atol=0.2)
    w = data[-1].angular_velocity
    np.testing.assert_allclose([w.x, w.y, w.z], [0.2, 0.02, 0.4], atol=1e-12)
    variances = np.reshape(data[-1].angular_velocity_covariance, (3, 3)).diagonal()
    np.testing.assert_allclose(variances, [4.01e-2, 4.01e-2, 4.09e-2], rtol=1e-9)
    assert tilt[-1].vector.x == pytest.approx(-0.1, abs=0.02)
    stated = data[-1].orientation
    assert [abs(stated.x), abs(stated.w)] == pytest.approx([0.8, 0.6]), 'kept, of another frame'
    client = graph.node.create_client(Trigger, 'compensation/level')
    assert client.wait_for_service(100)
    answer = client.call_async(Trigger.Request())
    until(answer.done, 'the answer of ~/level')
    assert answer.result().success, answer.result().message
    assert f'written into {mounted}' in answer.result().message
    written = mounted.read_text()
    assert '# upside down' in written and '3.14159265' not in written.split('rpy_rad: ', 1)[1][:30]
    until(lambda: abs(tilt[-1].vector.x) < 0.01, 'a level robot')
    # The orientation that the camera states is 2·atan2(0.6, 0.8) about x, whatever it measures.
    quaternion = data[-1].orientation
    assert quaternion.x**2 + quaternion.w**2 == pytest.approx(1)
    assert np.linalg.norm([free[-1].vector.y, free[-1].vector.z]) > 1
