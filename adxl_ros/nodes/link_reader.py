# SPDX-License-Identifier: Apache-2.0

"""The thread that reads the driver's link, from its activation to its deactivation."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
import time
from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.files import cdr
from adxl_ros.links.support.base import ImuLink, Level, Link, LinkStatus, Samples, StageLink
from adxl_ros.links.support.self_test import SelfTest, SelfTestAnswer
from adxl_ros.nodes import topics
from adxl_ros.nodes.sample_output import References, SampleOutput
from rclpy.node import Node
from sensor_msgs.msg import Imu, JointState, Temperature

_SIMULATOR_QUEUE = 1000  # Samples that are kept while the node is busy: 1 s at 1 kHz
_FIELDS = {
    'orientation': 4,
    'orientation_covariance': 9,
    'angular_velocity': 3,
    'angular_velocity_covariance': 9,
    'linear_acceleration': 3,
}
"""Number fields of sensor_msgs/Imu with their counts."""
_PAUSE_S = 0.004
"""Time between two looks at the samples, s. At 1 kHz four of them then share a run of the chain,
which costs as much as ten samples."""
_LOOK_S = 1.0
"""Time between two looks at the publishers of the samples, s: the period of the diagnostics, which
show them."""
_PERIOD_S = 0.004
"""Time between two reads where sensor time is not real time, s. A wake-up costs as much as ten
samples: at 80 times real time 40 samples share one."""
_LONGEST_PAUSE_S = 0.05
"""Longest time between two reads in real time, s: the thread sees within it that it shall end."""
_SHORTEST_PAUSE_S = 0.0005
"""Shortest time between two reads in real time, s: half a period at 1 kHz. A link that has nothing
although a sample is due would otherwise keep a core busy."""
_LONGEST_STEP_NS = 20_000_000
"""Longest step of real time that is caught up where sensor time is the graph's clock, ns. At 80
times real time it is 1.6 s of samples at once; a clock that leaps further floods the other
nodes."""
_JUMP_NS = 5_000_000_000
"""Smallest step of the clock that counts as a jump, ns. A driver that was held up for less makes
up its samples: 5000 at 1 kHz, which the queues of 20000 hold."""
_DISCOVERY_NS = 300_000_000
"""Time after which a new subscriber is sure to receive, ns: within a host discovery takes less. A
sample before it would be lost to the subscriber that it waited for."""
_CLOCK_SEARCH_NS = 1_000_000_000
"""Time between two searches for another clock, and before the first sample, ns: nodes that start
together find each other within it, and two clocks would make time go back and forth."""
_QUEUE = 5000  # Messages of the stage that are kept between two reads
_LOG_INTERVAL_S = 1.0
"""Shortest time between two logs of the state of a link, s: a loose contact changes it at each
read."""


class SimulatorInput:
    """Gives the messages of a simulator to a link."""

    def __init__(self, node: Node, link: ImuLink) -> None:
        self._node = node
        self._link = link
        self.frame_id = ''  # Frame of the newest samples
        self._due_s = self._looked_s = time.monotonic()
        self._inbox = topics.Inbox(node, Imu, link.imu_topic, _SIMULATOR_QUEUE, link.imu_unit)
        self._temperature = topics.create_subscription(
            node,
            Temperature,
            link.temperature_topic,
            lambda message: link.sense_temperature(message.temperature),
            1,
        )

    def destroy(self) -> None:
        """Remove the subscriptions; the thread that waits must have ended."""
        self._inbox.destroy()
        self._node.destroy_subscription(self._temperature)

    def wait(self) -> None:
        """Pause after the last samples, wait for others for up to 0.1 s, give all to the link."""
        time.sleep(max(self._due_s - time.monotonic(), 0))
        self._inbox.wait()
        self._due_s = time.monotonic() + _PAUSE_S
        raws = self._inbox.take()
        if not raws or self._due_s > self._looked_s + _LOOK_S:
            topic = self._node.resolve_topic_name(self._link.imu_topic)
            self._link.sense_publishers(self._node.count_publishers(topic), self._inbox.fault())
            self._looked_s = self._due_s
        if raws:
            stamps_ns, fields = topics.decoded(raws, cdr.imu, **_FIELDS)
            self.frame_id = cdr.imu(raws[-1]).texts['frame_id']
            self._link.sense_imu(stamps_ns, fields)


class LinkReader:
    """Reads a link in a thread and publishes its samples, until closed."""

    def __init__(
        self,
        node: Node,
        link: Link,
        output: SampleOutput,
        settings: Any,
        on_error: Callable[[UserError], None],
        on_level: Callable[[Level], None],
    ) -> None:
        self._node = node
        self._link = link
        self._output = output
        self._settings = settings
        self._on_level = on_level
        self._ros: Any = node.get_clock()
        self._is_real_time = False
        self._now_ns: int | None = None
        self._subscribed_ns: int | None = None  # Steady time at which a subscriber was seen
        self._ticked_ns = self._opened_ns = time.monotonic_ns()
        self._search_ns = self._opened_ns + _CLOCK_SEARCH_NS
        self._due_s = time.monotonic()
        self._newest_ns: int | None = None
        self._stage: topics.Inbox | None = None
        self._simulator: SimulatorInput | None = None
        with ExitStack() as on_close:
            on_close.callback(link.close)
            if isinstance(link, ImuLink):
                self._simulator = SimulatorInput(node, link)
                on_close.callback(self._simulator.destroy)
            self._references = References(node, output.frame_id, link.references)
            on_close.callback(self._references.destroy)
            status = link.status()
            self._level = status.level
            self._text = status.text
            self._logged_s = -_LOG_INTERVAL_S
            self._counts: dict[str, int] = {}
            if link.sensor is not None:
                output.use(link.sensor)
            self._self_test = SelfTest(link.hold_self_test)
            # Only a driver that reads its link has the service.
            self._service = topics.LateService(node, '~/self_test')
            self._requests: list[Any] = []
            on_close.callback(self._end_service)
            if isinstance(link, StageLink):
                self._stage = topics.Inbox(
                    node, JointState, link.joint_state_topic, _QUEUE, reliable=True
                )
                on_close.callback(self._stage.destroy)
            on_close.callback(
                topics.RepeatingThread(
                    node, self._live_turn if link.live else self._paced_turn, 'link', on_error
                ).close
            )
            self._on_close = on_close.pop_all()

    def close(self) -> None:
        """End the thread and close the link."""
        self._on_close.close()

    def status(self) -> LinkStatus:
        """Return how the link works."""
        if not self._link.live and self._now_ns is None:
            return LinkStatus(Level.OK, 'waiting for a subscriber of imu/data_raw')
        status = self._link.status()
        if self._link.live:
            self._log(status)
        return status

    def _log(self, status: LinkStatus) -> None:
        """Log the text of a live link or an event that is new, once a second at most."""
        now_s = time.monotonic()
        if now_s - self._logged_s < _LOG_INTERVAL_S:
            return
        for event in status.events:
            if event.count > self._counts.get(event.message, 0):
                topics.log(self._node, Level.WARN, event.message)
                self._counts[event.message], self._logged_s = event.count, now_s
        if status.text != self._text:
            self._text = status.text
            self._logged_s = now_s
            topics.log(self._node, status.level, status.text)

    def _live_turn(self) -> None:
        """Publish what a device sends; the link waits for it."""
        self._serve()
        if self._simulator is not None:
            self._simulator.wait()
            self._output.follow_frame(self._simulator.frame_id)
        samples = self._link.read(time.time_ns())
        if not self._node.context.ok():
            return
        sensor = self._link.sensor
        if sensor is not None and sensor is not self._output.sensor:
            self._output.use(sensor)
        if self._now_ns is None or samples.until_ns < self._now_ns:
            self._output.tally.begin(samples.until_ns)
        self._now_ns = samples.until_ns
        is_incomplete = self._publish(samples)
        level = self._link.status().level
        if is_incomplete and level is Level.OK:
            self._on_level(Level.WARN)
        elif level is not self._level:
            self._on_level(level)
        self._level = level

    def _publish(self, samples: Samples) -> bool:
        """Publish samples but those of a self-test; return whether any is missing or withheld."""
        published, answer = self._self_test.take(samples, self._output.sensor)
        self._output.publish(published, self._references)
        withheld = len(samples.stamp_ns) - len(published.stamp_ns)
        self._output.tally.counts['withheld'] += withheld
        self._answer(answer)
        return samples.missing + withheld > 0

    def _serve(self) -> None:
        """Begin a self-test where it is asked for."""
        if asked := self._service.take():
            self._requests += asked
            self._answer(self._self_test.begin())

    def _answer(self, answer: SelfTestAnswer | None) -> None:
        """Answer all who have asked for a self-test once it has ended."""
        if answer is not None:
            topics.log(self._node, Level.OK if answer.is_passed else Level.WARN, answer.text)
            self._service.answer(self._requests, *answer)
            self._requests = []

    def _end_service(self) -> None:
        if self._node.context.ok():
            self._service.answer(self._requests, False, 'no result: the driver closes its link')
        self._service.destroy()

    def _paced_turn(self) -> None:
        """Wait until samples are due, and publish them."""
        self._serve()
        self._is_real_time = not (self._output.is_clock or self._ros.ros_time_is_active)
        pause_s = self._due_s - time.monotonic()
        time.sleep(min(max(pause_s, 0.0), _LONGEST_PAUSE_S))
        if pause_s <= _LONGEST_PAUSE_S:
            # The stage moves on with the clock of the last tick.
            self._take_motion()
            self._tick()
            self._due_s = self._next_due_s()

    def _next_due_s(self) -> float:
        """Return the steady time of the next tick, s."""
        now_s = time.monotonic()
        if not self._is_real_time or self._newest_ns is None:
            return max(self._due_s + _PERIOD_S, now_s)
        assert self._link.sensor is not None, 'a link that makes its own time has its sensor'
        rate_hz = self._link.sensor.rate_hz
        together_s = self._settings.samples_together(rate_hz) / rate_hz
        # As a board sends a frame: at the time of its last sample.
        pause_s = together_s - (time.time_ns() - self._newest_ns) * 1e-9
        return now_s + min(max(pause_s, _SHORTEST_PAUSE_S), together_s)

    def _tick(self) -> None:
        """Publish the samples that are due."""
        steady_ns = time.monotonic_ns()
        step_ns = steady_ns - self._ticked_ns
        self._ticked_ns = steady_ns
        if self._output.is_clock and steady_ns >= self._search_ns:
            self._search_ns = steady_ns + _CLOCK_SEARCH_NS
            self._output.follow_other_clock()
        if self._now_ns is None:
            if not self._may_begin():
                return
            start_ns = self._link.start_ns if self._output.is_clock else None
            self._now_ns = self._ros.now().nanoseconds if start_ns is None else start_ns
            self._link.begin(self._now_ns)
            self._output.tally.begin(self._now_ns)
        samples = self._link.read(self._due_ns(self._now_ns, step_ns))
        self._now_ns = samples.until_ns
        if len(samples.stamp_ns):
            self._newest_ns = int(samples.stamp_ns[-1])
        if self._publish(samples):
            self._on_level(Level.WARN)

    def _may_begin(self) -> bool:
        """Return whether the link may begin: time runs, and some links wait for a subscriber."""
        if self._output.is_clock:
            if self._ticked_ns - self._opened_ns < _CLOCK_SEARCH_NS:
                return False
        elif not self._ros.now().nanoseconds:
            return False
        if not self._link.waits_for_listener:
            return True
        if not self._output.subscribed():
            self._subscribed_ns = None
            return False
        if self._subscribed_ns is None:
            self._subscribed_ns = self._ticked_ns
        return self._ticked_ns - self._subscribed_ns >= _DISCOVERY_NS

    def _due_ns(self, now_ns: int, step_ns: int) -> int:
        """Return the sensor time up to which samples are due, ns."""
        if self._output.is_clock:
            return now_ns + round(min(step_ns, _LONGEST_STEP_NS) * self._settings.speed)
        ros_ns = time.time_ns() if self._is_real_time else self._ros.now().nanoseconds
        jump_ns = ros_ns - now_ns
        if not -_PERIOD_S * 1e9 < jump_ns < _JUMP_NS:
            self._output.tally.counts['missing'] += self._link.begin(ros_ns)
            self._output.tally.begin(ros_ns)
            self._node.get_logger().warning(
                f'the clock jumped by {jump_ns * 1e-9:+.3f} s; the samples go on from there'
            )
        return ros_ns

    def _take_motion(self) -> None:
        """Give the motion that has come to a link on the stage."""
        if self._stage is None or self._now_ns is None:
            return
        assert isinstance(self._link, StageLink), 'only a link on the stage takes its motion'
        for reading in topics.joint_readings(self._stage.take()):
            self._link.sense_stage(*reading)
