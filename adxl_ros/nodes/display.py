# SPDX-License-Identifier: Apache-2.0

"""What a calibration shows: the next pose, and its screen in this terminal."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack, suppress
import os
import signal
import subprocess
import sys
import termios

from adxl_ros.calibrate.guided.controller import Controller, ControllerState, IDLE_TEXT
from adxl_ros.calibrate.guided.guide import NextPose
from adxl_ros.calibrate.guided.screen_contents import KeyAction, Phase, ScreenContents
from adxl_ros.nodes.jobs import executable, held_output
from adxl_ros.nodes.topics import create_publisher, Level, stamp, Status, status_message, STEADY
from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import String

_SCREEN_END_S = 5.0
"""Longest wait for the end of the screen, s; chosen: far above its usual end."""
_RESET = b'\x1b[?1049l\x1b[?2004l\x1b[?25h\x1b[0m'
"""Leaves alternate screen and bracketed paste and shows the cursor, by the codes of xterm."""


def open_screen(node_name: str) -> tuple[OwnScreen | None, str]:
    """Start a screen if this process has a terminal, and is no background job of it."""
    is_terminal = all(stream and stream.isatty() for stream in (sys.stdin, sys.stdout))
    if not is_terminal or os.environ.get('TERM') == 'dumb':
        return None, ''
    # A terminal that does not control this process has no background.
    with suppress(OSError):
        if os.tcgetpgrp(sys.stdin.fileno()) != os.getpgrp():
            return None, ''
    try:
        import prompt_toolkit  # noqa: F401
    except ImportError:
        return None, 'no screen, plain lines: it needs prompt_toolkit; pip install prompt_toolkit'
    return OwnScreen(node_name), ''


class OwnScreen:
    """A process of the executable `screen`, which draws where this process would print."""

    def __init__(self, node_name: str) -> None:
        self._saved = termios.tcgetattr(sys.stdin.fileno())
        # Ctrl-C during the start is for the node. The screen inherits the mask.
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        self._process = subprocess.Popen([
            sys.executable, executable('screen'), '--ros-args', '-p', f'node:={node_name}', '-p',
            f'node_pid:={os.getpid()}'])
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        self._output = ExitStack()
        self._output.enter_context(held_output())

    def alive(self) -> bool:
        """Return whether the process of the screen still runs."""
        return self._process.poll() is None

    def close(self) -> None:
        """End the screen, restore the terminal if the screen did not, and print what was held."""
        self._process.terminate()
        try:
            self._process.wait(_SCREEN_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        if self._process.returncode < 0:
            with suppress(OSError, termios.error):
                os.write(sys.stdin.fileno(), _RESET)
                termios.tcsetattr(sys.stdin.fileno(), termios.TCSANOW, self._saved)
        self._output.close()


_REPEAT_NS = 500_000_000
"""Time between two commands of the same pose, ns; chosen: a late stage loses little time."""
_COMMAND_QUEUE = 10
"""Commands that are kept for a recorder that stalls: a bag then has every command."""


class Announcer:
    """
    Announces the next pose.

    `~/next_pose` has the pose for people and programs, latched. `stage/command` has the command
    for a stage that turns itself. It is repeated, so that a stage that starts later or loses a
    message gets it, too.
    """

    def __init__(self, node: Node, has_stage: bool) -> None:
        self._node = node
        self._command = create_publisher(node, JointState, 'stage/command', _COMMAND_QUEUE) \
            if has_stage else None
        self._next = create_publisher(node, DiagnosticStatus, '~/next_pose', 1, latched=True)
        self._announced = ''
        self._commanded, self._commanded_ns = '', 0

    def announce(self, pose: NextPose) -> None:
        """Announce a pose if it is new, and command the stage if it turns itself."""
        if pose.text != self._announced:
            self._node.get_logger().info(pose.text)
            self._publish(pose.text, pose.values)
        self._announced = pose.text
        now_ns = STEADY.now().nanoseconds
        if self._command and pose.command_rad is not None and (
                pose.text != self._commanded or now_ns - self._commanded_ns >= _REPEAT_NS):
            self._commanded, self._commanded_ns = pose.text, now_ns
            command = JointState(name=['alpha', 'beta'], position=list(pose.command_rad))
            # The clock of a simulation may lag behind samples that have come.
            stamp_ns = max(self._node.get_clock().now().nanoseconds, pose.newest_ns)
            command.header.stamp = stamp(stamp_ns)
            self._command.publish(command)

    def withdraw(self, reason: str) -> None:
        """Take back the pose that was announced, if one was: the topic is latched."""
        if self._announced:
            self._publish(f'no pose: {reason}', {})
        self._announced = ''

    def _publish(self, text: str, values: Mapping[str, str | float]) -> None:
        self._next.publish(status_message('next_pose', Status(Level.OK, text, '', values)))


_PERIOD_S = 0.2
"""Time between two messages, s; chosen: the eye follows it, and it costs no samples."""

_ABORT = KeyAction('a', 'abort', 'abort')
_RUNNING = (KeyAction('r', 'redo', 'redo'), KeyAction('s', 'skip', 'skip'),
            KeyAction('f', 'finish', 'finish'), _ABORT)
"""Keys while a session runs."""
_BY_HAND = (KeyAction('c', 'capture', 'capture'), *_RUNNING)
"""Keys while a session runs whose poses an operator captures."""
_KEYS = {ControllerState.IDLE: (KeyAction('b', 'begin', 'start'),),
         ControllerState.WAITING_FOR_SENSOR: (_ABORT,),
         ControllerState.ASKING: (KeyAction('y', 'go on', 'resume'),
                                  KeyAction('n', 'begin again', 'start_over'), _ABORT)}
"""Keys while no session runs, by the state."""


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
        self._publisher = create_publisher(node, String, '~/display', 1, latched=True)
        node.create_timer(_PERIOD_S, self.update, clock=STEADY)

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
        controller, stream = self._controller, self._controller.stream
        unit, session, newest = stream.unit, controller.session, stream.newest
        keys = () if phase is Phase.FIT else _KEYS.get(
            controller.state, _BY_HAND if controller.settings.operator_captures else _RUNNING)
        if session is not None:
            live = session.newest.reading(session.guide.stillness(session.newest))
        else:
            live = None if newest is None else newest.reading(newest.stillness())
        self._publisher.publish(String(data=ScreenContents(
            phase=phase.value, text=text, unit=f'{unit.serial} ({unit.axes})' if unit else '',
            output=str(controller.settings.output), keys=keys, live=live,
            progress=None if session is None else session.guide.progress(),
            estimate=None if session is None else session.estimate(),
            outcome=controller.outcome).to_json()))
