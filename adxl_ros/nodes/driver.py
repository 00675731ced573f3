# Copyright 2026 the adxl_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Read the ADC link and publish each sample as nominally converted acceleration."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.files import cdr
from adxl_ros.files.columns import JOINTS, sensor_info
from adxl_ros.links import base
from adxl_ros.model import noise
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.sensor import Sensor, to_nominal_mps2
from adxl_ros.model.uncertainty import UNMEASURED_VARIANCE
from adxl_ros.nodes import common
from adxl_ros.nodes.beat import Beat
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
import numpy as np
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.serialization import serialize_message
from rclpy.subscription import Subscription
from rosgraph_msgs.msg import Clock as ClockMessage
from sensor_msgs.msg import BatteryState, Imu, JointState, Temperature

_TICK_S = 0.004
"""A wake-up costs as much as ten samples: at 1 kHz it publishes four of them."""
_LONGEST_TICK_NS = 20_000_000
"""Where sensor time is the clock, it does not catch up with a wake-up that comes late."""
_JUMP_NS = 2_000_000_000
_QUEUE = 5000
_DEAF_NS = 300_000_000
"""A listener that has just appeared may not hear yet for so long."""
_LEVELS = {'ok': common.OK, 'warn': common.WARN, 'error': common.ERROR}


class Driver(Node):
    """The node; where the samples come from is in `links`, ROS-free."""

    def __init__(self) -> None:
        super().__init__('driver')
        sensor = common.make_sensor(common.declare_sensor(self))
        self._frame = common.declare(self, 'frame_id', 'imu_link', 'frame of the case')
        self._type = common.declare(self, 'link.type', 'sim', 'where the samples come from',
                                    choices=base.names())
        module = base.module_of(self._type)
        options = {one.name: common.declare(self, f'link.{one.name}', one.default, one.doc,
                                            one.unit, one.lower, one.upper)
                   for one in module.OPTIONS}
        self._speed = options.get('speed', 1.0)
        # Sensor time that is not real time must be everybody's: then this node is the clock.
        self._is_clock = self._speed != 1 or self.get_parameter('use_sim_time').value
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._wall = Clock(clock_type=ClockType.SYSTEM_TIME)
        self._tally = Tally(self._steady.now().nanoseconds)
        self._now_ns: int | None = None
        self._waited_ns = 0
        self._ticked_ns = self._steady.now().nanoseconds
        self._fault = ''
        self._link: base.Link | None = None
        self._stage: Subscription | None = None
        self._beat: Beat | None = None
        try:
            self._link = module.open_link(sensor, options)
        except UserError as error:
            self._fail(error)
        self._connect(self._link.sensor if self._link else sensor)

    def _connect(self, sensor: Sensor) -> None:
        publisher = common.publisher
        self._imu = ImuWriter(sensor, self._frame)
        self._data = publisher(self, Imu, 'imu/data_raw', _QUEUE)
        self._info = publisher(self, DiagnosticStatus, 'sensor_info', 1, latched=True)
        self._diagnostics = publisher(self, DiagnosticArray, '/diagnostics', 10)
        if self._is_clock:
            self._time = publisher(self, ClockMessage, '/clock', 1)
        if self._link:
            self._info.publish(common.status(common.OK, 'sensor_info', '', sensor.serial,
                                             sensor_info(sensor)))
            self._references = References(self, self._frame, self._link.references)
            if hasattr(self._link, 'feel'):
                self._stage = self.create_subscription(
                    JointState, 'stage/true_joint_states', self._feel, QoSProfile(depth=_QUEUE),
                    callback_group=common.NotForExecutors())
            self._beat = Beat(self, self._tick, _TICK_S)
        self.create_timer(1.0, self._report, clock=self._steady)

    def _take_from_stage(self) -> None:
        with self._stage.handle:
            while (taken := self._stage.handle.take_message(JointState, False)) is not None:
                self._feel(taken[0])

    def _feel(self, message: JointState) -> None:
        stamp = message.header.stamp
        self._link.feel(stamp.sec * 10 ** 9 + stamp.nanosec,
                        dict(zip(message.name, message.position)),
                        dict(zip(message.name, message.velocity)))

    def _tick(self) -> None:
        """Publish what is due."""
        if self._fault:
            return
        steady_ns = self._steady.now().nanoseconds
        passed_ns, self._ticked_ns = steady_ns - self._ticked_ns, steady_ns
        if self._now_ns is None and not self._may_begin(passed_ns):
            return
        if self._stage is not None:
            self._take_from_stage()
        try:
            samples = self._link.read(self._due_ns(passed_ns))
        except UserError as error:
            self._fail(error)
            return
        self._now_ns = samples.until_ns
        self._publish(samples)
        if self._is_clock:
            self._time.publish(ClockMessage(clock=_stamp(self._now_ns)))

    def _may_begin(self, passed_ns: int) -> bool:
        """Begin, as soon as there is somebody to hear a recording's first sample."""
        heard = self._data.get_subscription_count() > 0
        self._waited_ns = self._waited_ns + passed_ns if heard else 0
        if self._link.waits and self._waited_ns < _DEAF_NS:
            return False
        own_ns = self._link.start_ns if self._is_clock else None
        self._now_ns = self._wall.now().nanoseconds if own_ns is None else own_ns
        self._link.begin(self._now_ns)
        self._tally.begin(self._now_ns)
        return True

    def _due_ns(self, passed_ns: int) -> int:
        """Return the time up to which samples are due."""
        if self._is_clock:
            return self._now_ns + round(min(passed_ns, _LONGEST_TICK_NS) * self._speed)
        now_ns = self._wall.now().nanoseconds
        jump_ns = now_ns - self._now_ns
        if not -_TICK_S * 1e9 < jump_ns < _JUMP_NS:
            self._tally.missing += self._link.begin(now_ns)
            self._tally.begin(now_ns)
            self.get_logger().warning(f'the clock jumped by {jump_ns * 1e-9:+.3f} s; '
                                      'the samples go on from there')
        return now_ns

    def _publish(self, samples: base.Samples) -> None:
        good = np.isfinite(samples.volts).all(axis=1)
        stamps, volts = samples.stamp_ns[good], samples.volts[good]
        self._references.publish(samples.stamp_ns, samples.references)
        for message in self._imu.messages(stamps, volts):
            self._data.publish(message)
        self._tally.count(stamps, int(self._imu.saturated(volts).sum()),
                          samples.missing + int((~good).sum()))

    def _fail(self, error: UserError) -> None:
        """Say why there are no samples, and stay up."""
        self._fault = str(error)
        self.get_logger().error(self._fault)

    def _report(self) -> None:
        state = base.State('error', self._fault)
        if not self._fault:
            waiting = base.State('ok', 'waiting for a subscriber of imu/data_raw')
            state = waiting if self._now_ns is None else self._link.state()
        now_ns = self._now_ns
        if now_ns is not None and not self._is_clock:
            now_ns = self._wall.now().nanoseconds
        values, warning = self._tally.report(self._steady.now().nanoseconds, now_ns or 0)
        level = common.WARN if warning and state.level == 'ok' else _LEVELS[state.level]
        text = ', '.join(filter(None, (f'{self._type}: {state.text}', warning)))
        self._diagnostics.publish(common.diagnostics(self, common.status(
            level, 'link', text, self._imu.serial, {
                **values, 'link_type': self._type, 'link_state': state.text})))

    def close(self) -> None:
        """End the thread and close the link."""
        if self._beat is not None:
            self._beat.close()
            self._link.close()


class ImuWriter:
    """Makes serialized messages: forty at once take half the time of filling messages."""

    def __init__(self, sensor: Sensor, frame_id: str) -> None:
        self.serial = sensor.serial
        self._sensor = sensor
        self._axes = [AXES.index(axis) for axis in sensor.axes]
        self._template = serialize_message(imu_message(sensor, frame_id))
        self._layout = cdr.imu(self._template)

    def messages(self, stamp_ns: np.ndarray, volts: np.ndarray) -> list[bytes]:
        """Serialize samples: stamps, ns, (n,), and volts by axis, (n, m)."""
        accel = np.zeros((len(stamp_ns), 3))
        accel[:, self._axes] = to_nominal_mps2(volts, self._sensor)
        data = cdr.fill(self._template, self._layout, stamp_ns, {'linear_acceleration': accel})
        size = len(self._template)
        return [data[i:i + size] for i in range(0, len(data), size)]

    def saturated(self, volts: np.ndarray) -> np.ndarray:
        """Tell which samples are at a rail of the ADC or beyond the sensor's range, (n,)."""
        s = self._sensor
        beyond = np.abs(volts - s.nominal_zero_g_v) > s.range_g * s.nominal_scale_v_per_g
        if s.adc_bits:
            beyond |= (volts <= 0) | (volts >= s.adc_vref_v - s.lsb_v)
        return beyond.any(axis=1)


def imu_message(sensor: Sensor, frame_id: str) -> Imu:
    """Make the message that all samples have in common."""
    message = Imu()
    message.header.frame_id = frame_id
    message.orientation_covariance[0] = message.angular_velocity_covariance[0] = -1.0
    variance = np.full(3, UNMEASURED_VARIANCE)
    sigma_g = noise.sigma_v(sensor) / sensor.nominal_scale_v_per_g
    variance[:len(sensor.axes)] = (sigma_g * G0_MPS2) ** 2
    message.linear_acceleration_covariance = np.diag(variance).ravel()
    return message


class Tally:
    """Counts samples, and what went wrong with them, between two reports."""

    def __init__(self, steady_ns: int) -> None:
        self.missing = self.saturated = self.samples = 0
        self._newest_ns: int | None = None
        self._then = (steady_ns, 0, 0, 0, 0)

    def begin(self, now_ns: int) -> None:
        """Count sensor time from now on."""
        self._then = (self._then[0], now_ns, *self._then[2:])

    def count(self, stamps: np.ndarray, saturated: int, missing: int) -> None:
        """Add samples."""
        self.samples += len(stamps)
        self.saturated += saturated
        self.missing += missing
        if len(stamps):
            self._newest_ns = int(stamps[-1])

    def report(self, steady_ns: int, now_ns: int) -> tuple[dict[str, Any], str]:
        """Return the values for diagnostics since the last report, and what is wrong or ''."""
        now = (steady_ns, now_ns, self.samples, self.missing, self.saturated)
        real_ns, sensed_ns, samples, missing, saturated = (
            a - b for a, b in zip(now, self._then))
        self._then = now
        values = {'rate_hz': round(samples / sensed_ns * 1e9, 3) if sensed_ns > 0 else 0.0,
                  'missing': self.missing, 'saturated': self.saturated, 'samples': self.samples,
                  'speed': round(sensed_ns / real_ns, 3) if real_ns > 0 else 0.0}
        if self._newest_ns is not None:
            values['age_s'] = round((now_ns - self._newest_ns) * 1e-9, 6)
        wrong = [f'{missing} samples missing'] if missing else []
        wrong += [f'{saturated} samples saturated'] if saturated else []
        return values, ', '.join(wrong)


class References:
    """Publishes what was recorded beside the sensor: stage angles, temperature, supply."""

    def __init__(self, node: Node, frame_id: str, names: tuple[str, ...]) -> None:
        self._frame = frame_id
        self._kept: dict[str, tuple[int, np.ndarray]] = {}
        self._joints = {column: joint for joint, column in JOINTS.items() if column in names}
        kinds = {'stage': (JointState, 'stage/joint_states', bool(self._joints)),
                 'temperature_c': (Temperature, 'temperature', 'temperature_c' in names),
                 'supply_v': (BatteryState, 'supply', 'supply_v' in names)}
        self._publishers = {name: common.publisher(node, kind, topic, 1000)
                            for name, (kind, topic, there) in kinds.items() if there}

    def publish(self, stamps: np.ndarray, columns: Mapping[str, np.ndarray]) -> None:
        """Publish what is new, and what is not once in a while."""
        if not len(stamps):
            return
        for name, publisher in self._publishers.items():
            if name == 'stage':
                values = np.column_stack([columns[column] for column in self._joints])
                for i in self._new(name, stamps, values, 10_000_000):
                    publisher.publish(self._stage(stamps[i], values[i]))
            else:
                for i in self._new(name, stamps, columns[name][:, None], 1_000_000_000):
                    publisher.publish(self._scalar(name, stamps[i], float(columns[name][i])))

    def _new(self, name: str, stamps: np.ndarray, values: np.ndarray, every_ns: int) -> Any:
        """Find rows with a value that differs from the one before, or begins a period."""
        rows = np.flatnonzero(np.isfinite(values).any(axis=1))
        if not len(rows):
            return rows
        values, period = values[rows], stamps[rows] // every_ns
        before, last = self._kept.get(name, (-1, np.full(values.shape[1], np.inf)))
        changed = (np.diff(values, axis=0, prepend=last[None]) != 0).any(axis=1)
        self._kept[name] = int(period[-1]), values[-1]
        return rows[changed | (np.diff(period, prepend=before) != 0)]

    def _stage(self, stamp_ns: int, values: np.ndarray) -> JointState:
        angles = {joint: float(value) for joint, value in zip(self._joints.values(), values)
                  if np.isfinite(value)}
        message = JointState(name=list(angles), position=list(angles.values()))
        message.header.stamp = _stamp(stamp_ns)
        return message

    def _scalar(self, name: str, stamp_ns: int, value: float) -> Temperature | BatteryState:
        message = Temperature(temperature=value) if name == 'temperature_c' else \
            BatteryState(voltage=value, present=True)
        message.header.stamp, message.header.frame_id = _stamp(stamp_ns), self._frame
        return message


def _stamp(time_ns: int) -> Time:
    sec, nanosec = divmod(int(time_ns), 10 ** 9)
    return Time(sec=sec, nanosec=nanosec)


def main() -> int:
    """Run the node."""
    return common.main(Driver, __doc__)
