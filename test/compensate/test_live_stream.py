# SPDX-License-Identifier: Apache-2.0

"""Serialized samples in, corrected samples and tilt out, without a graph."""

from dataclasses import replace

from adxl_ros.compensate import inversions
from adxl_ros.compensate.live_stream import LiveStream
from adxl_ros.model import signal_chain
from adxl_ros.model.effects.base import Coefficient, Environment, NOMINAL_ENVIRONMENT
from adxl_ros.model.kinematics import specific_force, UNKNOWN_ANGLE_RAD2
from adxl_ros.model.sensor import put, Sensor, to_nominal_mps2, with_neutral
from geometry_msgs.msg import Vector3Stamped
import numpy as np
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import Imu
from units import drawn, nominal

G = 9.80665


class Stream(LiveStream):
    def __init__(
        self,
        sensor: Sensor,
        undo_filter: bool = False,
        period_ns: int = 2 * 10**9,
        output_rate_hz: float = 0.0,
    ) -> None:
        self.data: list[bytes] = []
        self.tilt: list[bytes] = []
        super().__init__(
            False, undo_filter, self.data.append, self.tilt.append, output_rate_hz=output_rate_hz
        )
        self.use(sensor, 1000.0)
        self.period_ns, self.time_ns = period_ns, 0

    def send(
        self, sensor: Sensor, alpha: float, beta: float, around: Environment = NOMINAL_ENVIRONMENT
    ) -> None:
        force = [float(f) for f in specific_force(alpha, beta, G)]
        volts = np.array([signal_chain.static_response(sensor)(force, around)])
        message = Imu()
        self.time_ns += self.period_ns
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(self.time_ns, 10**9)
        a = message.linear_acceleration
        a.x, a.y, a.z = [*to_nominal_mps2(volts, sensor)[0].tolist(), 0.0][:3]
        self(serialize_message(message))

    def force(self) -> np.ndarray:
        a = deserialize_message(self.data[-1], Imu).linear_acceleration
        return np.array([a.x, a.y, a.z])


def unit(seed: int = 1, axes: str = 'xy') -> Sensor:
    return drawn(np.random.default_rng(seed), nominal(axes))


def test_invalid_messages_are_dropped() -> None:
    stream = Stream(unit())
    stream(b'too short')
    stream(serialize_message(Imu())[:-8])
    message = Imu()
    message.linear_acceleration.x = float('nan')
    stream(serialize_message(message))
    assert (stream.counts['dropped'], stream.data) == (3, [])


def test_stamps_that_step_back_are_counted() -> None:
    stream = Stream(unit())
    for period_ns in (10, 10, -5, 20):
        stream.period_ns = period_ns * 1_000_000
        stream.send(unit(), 0.7, 0.4)
    assert (stream.counts['backward'], len(stream.data)) == (1, 4)


def test_temperature_and_supply_apply_from_the_next_sample_on() -> None:
    sensor = put(
        with_neutral(unit(), ['temperature_bias']),
        [Coefficient('temperature_bias', 'per_k', 'x')],
        [1e-3],
    )
    warm = NOMINAL_ENVIRONMENT._replace(temperature_c=35.0)
    stream = Stream(sensor)
    stream.surround('temperature_c', 35.0)
    stream.send(sensor, 0.7, 0.4, warm)
    assert stream.surroundings == {'temperature_c': 35.0}
    np.testing.assert_allclose(stream.force(), specific_force(0.7, 0.4, G), atol=1e-6)
    # A new sensor uses them as well.
    stream.use(sensor, 1000.0)
    stream.send(sensor, 0.6, 0.4, warm)
    np.testing.assert_allclose(stream.force(), specific_force(0.6, 0.4, G), atol=1e-6)


def test_an_unobservable_angle_keeps_its_value() -> None:
    """With x upright, roll is not observable."""
    sensor = unit(axes='xyz')
    stream = Stream(sensor)
    stream.send(sensor, 0.7, -1.2)
    roll = deserialize_message(stream.tilt[-1], Vector3Stamped).vector.x
    stream.send(sensor, np.pi / 2, 0.0)
    assert deserialize_message(stream.tilt[-1], Vector3Stamped).vector.x == roll
    covariance = deserialize_message(stream.data[-1], Imu).orientation_covariance.reshape(3, 3)
    assert covariance[0, 0] == covariance[2, 2] == UNKNOWN_ANGLE_RAD2
    assert covariance[0, 1] == covariance[1, 0] == 0
    assert 0 < covariance[1, 1] < 1e-5


def test_inversion_of_the_filter_delays_samples() -> None:
    sensor = replace(unit(), rc_capacitance_f=1e-7)
    stream = Stream(sensor, undo_filter=True, period_ns=1_000_000)
    for _ in range(20):
        stream.send(sensor, 0.7, 0.4)
    assert len(stream.data) == 20 - inversions.HALF
    stream.use(stream.sensor, 500.0)
    for _ in range(inversions.HALF):
        stream.send(sensor, 0.7, 0.4)
    assert len(stream.data) == 20 - inversions.HALF, 'the waiting samples are dropped'
