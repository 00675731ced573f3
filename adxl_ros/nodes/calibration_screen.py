# SPDX-License-Identifier: Apache-2.0

"""The screen of a calibration node: its contents on a topic, and the process that draws them."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack, suppress
import os
import signal
import subprocess
import sys
import termios

from adxl_ros.calibrate.guided.controller import Controller, ControllerState, IDLE_TEXT, StartMode
from adxl_ros.calibrate.guided.screen_contents import KeyAction, Phase, ScreenContents, ScreenRow
from adxl_ros.nodes.jobs import executable, held_output
from adxl_ros.nodes.topics import create_publisher, STEADY
from rclpy.node import Node
from std_msgs.msg import String

_SCREEN_END_S = 5.0
"""Longest wait for the end of the screen, s. It ends within one callback, 0.02 s; a process that
hangs is killed after this, and the node's own end waits as long."""
_RESET = b'\x1b[?1049l\x1b[?2004l\x1b[?25h\x1b[0m'
"""Leaves alternate screen and bracketed paste and shows the cursor, by the codes of xterm."""
_PERIOD_S = 0.2
"""Time between two messages, s: numbers that change more often than 5 times a second are not
read."""
_ABORT = KeyAction('a', 'abort', 'abort')
_RUNNING = (
    KeyAction('r', 'redo', 'redo'),
    KeyAction('s', 'skip', 'skip'),
    KeyAction('f', 'finish', 'finish'),
    _ABORT,
)
"""Keys while a session runs."""
_BY_HAND = (KeyAction('c', 'capture', 'capture'), *_RUNNING)
"""Keys while a session runs whose poses an operator captures."""
_KEYS = {
    ControllerState.IDLE: (KeyAction('b', 'begin', 'start'),),
    ControllerState.WAITING_FOR_SENSOR: (_ABORT,),
    ControllerState.ASKING: (
        KeyAction('y', 'go on', 'resume'),
        KeyAction('n', 'begin again', 'start_over'),
        _ABORT,
    ),
}
"""Keys while no session runs, by the state."""


def open_screen(node_name: str, log: Callable[[str], object]) -> OwnScreen | None:
    """Start a screen if this process has a terminal, and is no background job of it."""
    is_terminal = all(stream and stream.isatty() for stream in (sys.stdin, sys.stdout))
    if not is_terminal or os.environ.get('TERM') == 'dumb':
        return None
    # A terminal that does not control this process has no background.
    with suppress(OSError):
        if os.tcgetpgrp(sys.stdin.fileno()) != os.getpgrp():
            return None
    try:
        import prompt_toolkit  # noqa: F401
    except ImportError:
        log('no screen, plain lines: it needs prompt_toolkit; pip install prompt_toolkit')
        return None
    return OwnScreen(node_name)


class OwnScreen:
    """A process of the executable `screen`, which draws where this process would print."""

    def __init__(self, node_name: str) -> None:
        self._saved = termios.tcgetattr(sys.stdin.fileno())
        # Ctrl-C during the start is for the node. The screen inherits the mask.
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        self.process = subprocess.Popen(
            [
                sys.executable,
                executable('screen'),
                '--ros-args',
                '-p',
                f'node:={node_name}',
                '-p',
                f'node_pid:={os.getpid()}',
            ]
        )
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        self._output = ExitStack()
        self._output.enter_context(held_output())

    def close(self) -> None:
        """End the screen, restore the terminal if the screen did not, and print what was held."""
        self.process.terminate()
        try:
            self.process.wait(_SCREEN_END_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        if self.process.returncode < 0:
            with suppress(OSError, termios.error):
                os.write(sys.stdin.fileno(), _RESET)
                termios.tcsetattr(sys.stdin.fileno(), termios.TCSANOW, self._saved)
        self._output.close()


class DisplayPublisher:
    """
    Publishes the contents of the screen on `~/display` while somebody subscribes to it.

    In a terminal it also starts a screen. The controller learns whether somebody can answer its
    question: a screen is a client of `~/resume`, and a recorder is not.
    """

    def __init__(self, node: Node, controller: Controller, starts_screen: bool) -> None:
        self._node = node
        self._controller = controller
        self._own_screen = (
            open_screen(node.get_fully_qualified_name(), node.get_logger().info)
            if starts_screen
            else None
        )
        controller.may_ask = self._own_screen is not None
        self._publisher = create_publisher(node, String, '~/display', 1, latched=True)
        node.create_timer(_PERIOD_S, self.update, clock=STEADY)

    def update(self) -> None:
        """Notice who looks, and publish the contents for them."""
        controller = self._controller
        if self._own_screen is not None and self._own_screen.process.poll() is not None:
            self.close()
            self._node.get_logger().warning('the screen has ended; plain lines from here on')
        controller.may_ask = self._own_screen is not None or bool(
            self._node.count_clients('~/resume')
        )
        if controller.state is ControllerState.ASKING and not controller.may_ask:
            controller.start(StartMode.CONTINUE)
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
        controller = self._controller
        stream = self._controller.stream
        nominal = stream.nominal
        session = controller.session
        newest = stream.newest
        usual = _BY_HAND if controller.settings.operator_captures else _RUNNING
        keys = () if phase is Phase.FIT else _KEYS.get(controller.state, usual)
        coefficients: list[ScreenRow] = []
        if session is not None:
            rows, coefficients = session.rows()
        else:
            rows = [] if newest is None else newest.rows(newest.stillness())
        self._publisher.publish(
            String(
                data=ScreenContents(
                    phase=phase,
                    text=text,
                    unit=f'{nominal.serial} ({nominal.axes})' if nominal else '',
                    output=str(controller.settings.output),
                    keys=keys,
                    rows=tuple(rows),
                    coefficients=tuple(coefficients),
                    outcome=controller.outcome,
                ).to_json()
            )
        )
