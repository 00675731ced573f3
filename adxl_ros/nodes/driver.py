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

from collections.abc import Callable
import time
import traceback
from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.files.stream_info import sensor_info
from adxl_ros.links.support import base
from adxl_ros.model.sensor import Sensor
from adxl_ros.nodes.support.diagnostics import DiagnosticsReporter, Level, Status, status_message
from adxl_ros.nodes.support.driver_publishers import ImuWriter, References, stamp, Tally
from adxl_ros.nodes.support.parameters import declare
from adxl_ros.nodes.support.rclpy_internals import NotForExecutors, take_messages
from adxl_ros.nodes.support.receive_thread import PeriodicTurn, RepeatingThread
from adxl_ros.nodes.support.run_node import run
from adxl_ros.nodes.support.sensor_parameters import declare_sensor, make_sensor
from adxl_ros.nodes.support.topics import create_publisher
from diagnostic_msgs.msg import DiagnosticStatus
import numpy as np
from rclpy.clock import Clock, ClockType
from rclpy.impl.rcutils_logger import RcutilsLogger
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription
from rosgraph_msgs.msg import Clock as ClockMessage
from sensor_msgs.msg import Imu, JointState

_TICK_S = 0.004
"""A wake-up costs as much as ten samples: at 1 kHz it publishes four of them."""
_LONGEST_TICK_NS = 20_000_000
"""Where sensor time is the clock, it does not catch up with a wake-up that comes late."""
_JUMP_NS = 2_000_000_000
_QUEUE = 5000
_DEAF_NS = 300_000_000
"""A listener that has just appeared may not hear yet for so long."""


class Driver(LifecycleNode):
    """
    The node; where the samples come from is in `links`, ROS-free.

    Configured it has its topics; active it reads the link. It configures and activates itself
    unless `autostart` is false.
    """

    def __init__(self) -> None:
        super().__init__('driver')
        self._given = make_sensor(declare_sensor(self))
        self._frame = declare(self, 'frame_id', 'imu_link', 'frame of the case')
        self._offset_ns = round(1e9 * declare(
            self, 'stamp_offset', 0.0, 'delay of the sensor, such as that of its RC filter, that '
            'is taken out of the stamps: they are earlier by this', 's', -10.0, 10.0))
        self._type = declare(self, 'link.type', base.DEFAULT_LINK, 'where the samples come from',
                             choices=base.link_names())
        self._module = base.link_module(self._type)
        self._settings = self._module.Settings(**{
            option.name: declare(self, f'link.{option.name}', option.default, option.doc,
                                 option.unit, option.lower, option.upper)
            for option in base.options(self._module.Settings)})
        autostart = declare(
            self, 'autostart', True, 'configure and activate at the start; else a system manager '
            'does')
        paced = isinstance(self._settings, base.PacedSettings)
        self._speed = self._settings.speed if paced else 1.0
        # Sensor time that is not real time must be everybody's: then this node is the clock.
        self._is_clock = self._speed != 1 or (
            paced and self.get_parameter('use_sim_time').value)
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._wall = Clock(clock_type=ClockType.SYSTEM_TIME)
        self._tally = Tally(self._steady.now().nanoseconds)
        self._now_ns: int | None = None
        self._fault = ''
        self._link: base.Link | None = None
        self._loop: RepeatingThread | None = None
        self._topics: list[Publisher] = []
        self._references: References | None = None
        self._stage: Subscription | None = None
        self._adopt(self._given, known=False)
        self._diagnostics = DiagnosticsReporter(self, {'link': self._status})
        if autostart:
            self.trigger_configure()
            self.trigger_activate()

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Make the topics."""
        return self._done(self._configure)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Open the link and read it, from now on."""
        return self._done(self._activate)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Read no more, and let go of the link."""
        return self._done(self.close)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Take the topics away."""
        return self._done(self._clean_up)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Let go of everything."""
        return self._done(lambda: (self.close(), self._clean_up()))

    def close(self) -> None:
        """End the thread and close the link."""
        loop, self._loop = self._loop, None
        if loop is not None:
            loop.close()
        if self._link is not None:
            self._link.close()
            self._link = None
        if self._references is not None:
            self._references.destroy()
            self._references = None
        if self._stage is not None:
            self.destroy_subscription(self._stage)
            self._stage = None

    def _done(self, act: Callable[[], Any]) -> TransitionCallbackReturn:
        """Do what a transition asks for; without this rclpy would swallow the reason."""
        try:
            act()
        except UserError as error:
            self._fail(error)
            return TransitionCallbackReturn.FAILURE
        except Exception:
            self.get_logger().fatal(traceback.format_exc())
            return TransitionCallbackReturn.ERROR
        return TransitionCallbackReturn.SUCCESS

    def _configure(self) -> None:
        publisher = create_publisher
        self._data = publisher(self, Imu, 'imu/data_raw', _QUEUE)
        self._info = publisher(self, DiagnosticStatus, 'sensor_info', 1, latched=True)
        self._topics = [self._data, self._info]
        if self._is_clock:
            self._time = publisher(self, ClockMessage, '/clock', 1)
            self._topics.append(self._time)

    def _clean_up(self) -> None:
        for topic in self._topics:
            self.destroy_publisher(topic)
        self._topics.clear()

    def _activate(self) -> None:
        self._fault = ''
        self._now_ns = None
        self._waited_ns = 0
        self._ticked_ns = self._steady.now().nanoseconds
        self._link = self._module.open_link(self._given, self._settings)
        if self._link.live and self.get_parameter('use_sim_time').value:
            self.get_logger().warning('use_sim_time: a real device lives in real time; its '
                                      'samples are stamped by the system clock')
        self._references = References(self, self._frame, self._link.references)
        self._say = StatusLog(self.get_logger(), self._link.status().text)
        if self._link.sensor is not None:
            self._adopt(self._link.sensor)
        if isinstance(self._link, base.StageLink):
            self._stage = self.create_subscription(
                JointState, self._link.joint_state_topic, self._sense_stage,
                QoSProfile(depth=_QUEUE), callback_group=NotForExecutors())
        turn = self._live_turn if self._link.live else PeriodicTurn(self._tick, _TICK_S)
        self._loop = RepeatingThread(self, turn, 'link')

    def _adopt(self, sensor: Sensor, known: bool = True) -> None:
        """Publish samples by the figures of a sensor, and say what they are."""
        self._sensor = sensor
        self._imu = ImuWriter(sensor, self._frame)
        if known:
            self._info.publish(status_message('sensor_info', Status(
                Level.OK, '', sensor.serial, sensor_info(sensor))))

    def _take_from_stage(self) -> None:
        for message in take_messages(self._stage, JointState, False, _QUEUE):
            self._sense_stage(message)

    def _sense_stage(self, message: JointState) -> None:
        ros_time = message.header.stamp
        self._link.sense_stage(ros_time.sec * 10 ** 9 + ros_time.nanosec,
                               dict(zip(message.name, message.position)),
                               dict(zip(message.name, message.velocity)))

    def _live_turn(self) -> None:
        """Publish what a device sends; the link waits for it."""
        try:
            samples = self._link.read(time.time_ns())
        except UserError as error:
            self._fail(error)
            samples = None
        if not self.context.ok():
            return
        if self._fault:
            time.sleep(_TICK_S)
            return
        if self._link.sensor is not None and self._link.sensor is not self._sensor:
            self._adopt(self._link.sensor)
        if self._now_ns is None:
            self._tally.begin(samples.until_ns)
        self._now_ns = samples.until_ns
        self._publish(samples)
        self._say(self._link.status())

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
            self._time.publish(ClockMessage(clock=stamp(self._now_ns)))

    def _may_begin(self, passed_ns: int) -> bool:
        """Begin, as soon as there is somebody to hear a recording's first sample."""
        heard = self._data.get_subscription_count() > 0
        self._waited_ns = self._waited_ns + passed_ns if heard else 0
        if self._link.waits_for_listener and self._waited_ns < _DEAF_NS:
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
        for message in self._imu.messages(stamps - self._offset_ns, volts):
            self._data.publish(message)
        self._tally.count(stamps, int(self._imu.saturated(volts).sum()),
                          samples.missing + int((~good).sum()), samples.estimated)

    def _fail(self, error: UserError) -> None:
        """Say why there are no samples, and stay up."""
        self._fault = str(error)
        self.get_logger().error(self._fault)

    def _status(self) -> Status:
        link = self._link_status()
        now_ns = self._now_ns
        if now_ns is not None and not self._is_clock:
            now_ns = self._wall.now().nanoseconds
        values, warning = self._tally.report(self._steady.now().nanoseconds, now_ns or 0)
        level = Level[link.level.name]
        if warning and level == Level.OK:
            level = Level.WARN
        text = ', '.join(filter(None, (f'{self._type}: {link.text}', warning)))
        return Status(level, text, self._imu.serial, {
            **values, 'link_type': self._type, 'link_state': link.text, **link.values()})

    def _link_status(self) -> base.LinkStatus:
        """Say how the link is, or why there is none."""
        link = self._link
        if self._fault:
            return base.LinkStatus(base.Level.ERROR, self._fault)
        if link is None:
            return base.LinkStatus(base.Level.OK, 'inactive')
        if not link.live and self._now_ns is None:
            return base.LinkStatus(base.Level.OK, 'waiting for a subscriber of imu/data_raw')
        status = link.status()
        if link.live:
            # A read may be held up for a while; what holds it up is said all the same.
            self._say(status)
        return status


class StatusLog:
    """Logs the status of a link when its text or an event is new, once a second at most."""

    _MIN_PERIOD_S = 1.0
    """Shortest time between two messages, s."""

    def __init__(self, logger: RcutilsLogger, text: str) -> None:
        """
        Begin with a text that is not logged.

        Parameters
        ----------
        logger
            Logger of the node.
        text
            Text of the present status.

        """
        self._logger, self._text = logger, text
        self._logged_s = -self._MIN_PERIOD_S
        self._counts: dict[str, int] = {}

    def __call__(self, status: base.LinkStatus) -> None:
        """Log a status where it is new."""
        now_s = time.monotonic()
        if now_s - self._logged_s < self._MIN_PERIOD_S:
            return
        new_events = [event for event in status.events
                      if event.count > self._counts.get(event.message, 0)]
        new_text = status.text != self._text
        if not new_events and not new_text:
            return
        for event in new_events:
            self._logger.warning(event.message)
            self._counts[event.message] = event.count
        self._text, self._logged_s = status.text, now_s
        if not new_text:
            return
        # rclpy permits one severity for each line of code.
        if status.level == base.Level.OK:
            self._logger.info(status.text)
        elif status.level == base.Level.WARN:
            self._logger.warning(status.text)
        else:
            self._logger.error(status.text)


def main() -> int:
    """Run the node."""
    return run(Driver, __doc__)
