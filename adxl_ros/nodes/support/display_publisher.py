# SPDX-License-Identifier: Apache-2.0
"""The topic that carries the contents of the calibration screen, and who looks at it."""

from __future__ import annotations

from adxl_ros.calibrate.guided.capture_settings import Phase
from adxl_ros.calibrate.guided.controller import Controller, ControllerState, IDLE_TEXT
from adxl_ros.calibrate.guided.display import live_reading, SessionDisplay
from adxl_ros.calibrate.guided.screen_contents import KeyAction, LiveReading, ScreenContents
from adxl_ros.calibrate.guided.session import Session
from adxl_ros.nodes.support.own_screen import open_screen
from adxl_ros.nodes.support.topics import create_publisher
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from std_msgs.msg import String

_PERIOD_S = 0.2
"""Time between two messages, s; chosen: the eye follows it, and it costs no samples."""

_ABORT = KeyAction('a', 'abort', 'abort')
_RUNNING = (KeyAction('r', 'redo', 'redo'), KeyAction('s', 'skip', 'skip'),
            KeyAction('f', 'finish', 'finish'), _ABORT)
"""Keys while a session runs."""
_BY_HAND = (KeyAction('c', 'capture', 'capture'), *_RUNNING)
"""Keys while a session runs whose poses an operator captures."""
_IDLE = (KeyAction('b', 'begin', 'start'),)
"""Keys while no session runs."""
_ASKING = (KeyAction('y', 'go on', 'resume'), KeyAction('n', 'begin again', 'start_over'), _ABORT)
"""Keys that answer the question what to do with an interrupted calibration."""


class DisplayPublisher:
    """
    Publishes the contents of the screen on `~/display` while somebody subscribes to it.

    In a terminal it also starts a screen. The controller learns whether somebody can answer its
    question: a screen is a client of `~/resume`, and a recorder is not.
    """

    def __init__(self, node: Node, controller: Controller, starts_screen: bool) -> None:
        self._node, self._controller = node, controller
        self._own_screen, obstacle = open_screen(node.get_fully_qualified_name()) \
            if starts_screen else (None, '')
        if obstacle:
            node.get_logger().info(obstacle)
        controller.may_ask = self._own_screen is not None
        self._session: Session | None = None
        self._display: SessionDisplay | None = None
        self._publisher = create_publisher(node, String, '~/display', 1, latched=True)
        node.create_timer(_PERIOD_S, self.update, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def update(self) -> None:
        """Notice who looks, and publish the contents for them."""
        controller = self._controller
        if self._own_screen is not None and not self._own_screen.alive():
            self.close()
            self._node.get_logger().warning('the screen has ended; plain lines from here on')
        controller.may_ask = self._own_screen is not None or bool(
            self._node.count_clients('~/resume'))
        if controller.state is ControllerState.ASKING and not controller.may_ask:
            controller.start(start_over=False)
        controller.shows_idle_stream = bool(self._publisher.get_subscription_count())
        if controller.shows_idle_stream:
            status = controller.status()
            self._publish(status.phase, status.text.replace(IDLE_TEXT, 'press b to begin'))

    def show_fit(self, text: str) -> None:
        """Publish at once that the fit begins, which takes a while."""
        self._publish(Phase.FIT, text)

    def close(self) -> None:
        """End the screen that the node has started."""
        if self._own_screen is not None:
            self._own_screen.close()
            self._own_screen = None

    def _publish(self, phase: Phase, text: str) -> None:
        controller, unit = self._controller, self._controller.unit
        display = self._session_display()
        keys = () if phase is Phase.FIT else self._keys()
        self._publisher.publish(String(data=ScreenContents(
            phase=phase.value, text=text, unit=f'{unit.serial} ({unit.axes})' if unit else '',
            output=str(controller.settings.output), keys=keys,
            live=self._idle_reading() if display is None else display.live(),
            progress=None if display is None else display.progress(),
            estimate=None if display is None else display.estimate(),
            outcome=controller.outcome).to_json()))

    def _session_display(self) -> SessionDisplay | None:
        """Return the display of the running session; None while there is none."""
        session = self._controller.session
        if session is not self._session:
            self._session = session
            self._display = None if session is None else SessionDisplay(session)
        return self._display

    def _idle_reading(self) -> LiveReading | None:
        """Return what the sensor reads while no session runs; None before the first samples."""
        newest, unit = self._controller.newest, self._controller.unit
        if newest is None or unit is None:
            return None
        return live_reading(newest, unit, newest.stillness())

    def _keys(self) -> tuple[KeyAction, ...]:
        """Return the keys that have an action now."""
        controller = self._controller
        if controller.state is ControllerState.ASKING:
            return _ASKING
        if controller.state is ControllerState.WAITING_FOR_SENSOR:
            return (_ABORT,)
        if controller.state is ControllerState.IDLE:
            return _IDLE
        return _BY_HAND if controller.settings.operator_captures else _RUNNING
