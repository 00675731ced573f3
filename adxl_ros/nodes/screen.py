# SPDX-License-Identifier: Apache-2.0

"""Show a guided calibration in this terminal, and pass its keys on; on any machine."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
import os
import signal
import sys
import time
from typing import TextIO, TYPE_CHECKING

from adxl_ros.calibrate.guided.screen_contents import ScreenContents
from adxl_ros.errors import UserError
from adxl_ros.nodes.draw import draw, Line, LogLine
from adxl_ros.nodes.jobs import held_output
from adxl_ros.nodes.parameters import declare_all
from adxl_ros.nodes.run_node import NodeHelp, run
from adxl_ros.nodes.settings import ScreenSettings
from adxl_ros.nodes.topics import create_subscription
from rcl_interfaces.msg import Log
import rclpy
from rclpy.executors import Executor
from rclpy.node import Node
from std_msgs.msg import String
from std_srvs.srv import Trigger

if TYPE_CHECKING:
    from prompt_toolkit.application import Application
    from prompt_toolkit.formatted_text import StyleAndTextTuples
    from prompt_toolkit.key_binding import KeyPressEvent

_REFRESH_S = 0.2
"""Time between two drawings, s: the node publishes contents five times a second."""


def full_screen(lines: Callable[[int, int], list[Line]], press: Callable[[str], None],
                leave: Callable[[], None]) -> Application[None]:
    """Make the application of a full screen."""
    try:
        from prompt_toolkit.application import Application
        from prompt_toolkit.input import create_input
        from prompt_toolkit.key_binding import KeyBindings
        from prompt_toolkit.layout import FormattedTextControl, Layout, Window
        from prompt_toolkit.output import create_output
    except ImportError:
        raise UserError('the screen needs prompt_toolkit; pip install prompt_toolkit') from None
    stdin, stdout = _terminal()
    output, keys = create_output(stdout), KeyBindings()

    def fragments() -> StyleAndTextTuples:
        rows, columns = output.get_size()
        drawn: StyleAndTextTuples = []
        for line in lines(columns, rows):
            drawn += [*line, ('', '\n')]
        return drawn[:-1]

    def end(event: KeyPressEvent) -> None:
        leave()
        event.app.exit()

    keys.add('<any>')(lambda event: press(event.data.lower()))
    # A key with Alt comes as Escape and the key.
    keys.add('escape', '<any>')(lambda _: None)
    for key in ('q', 'Q', 'c-c'):
        keys.add(key)(end)
    return Application(Layout(Window(FormattedTextControl(fragments, show_cursor=False))),
                       key_bindings=keys, full_screen=True, refresh_interval=_REFRESH_S,
                       input=create_input(stdin), output=output)


def _terminal() -> tuple[TextIO, TextIO]:
    """Return the terminal to read from and to write to."""
    if sys.stdin.isatty() and sys.stdout.isatty():
        return sys.stdin, open(os.dup(sys.stdout.fileno()), 'w', encoding='utf-8')
    try:
        # A launch keeps stdin and stdout to itself.
        return open('/dev/tty', encoding='utf-8'), open('/dev/tty', 'w', encoding='utf-8')
    except OSError:
        raise UserError('the screen needs a terminal; run it in one') from None


_SERVICES = ('start', 'resume', 'start_over', 'capture', 'redo', 'skip', 'finish', 'abort')
"""Services of the calibration node that keys call."""
_SPIN_S = 0.02
"""Time between two callbacks, s; chosen: far more often than messages come."""
_SILENT_S = 2.0
"""Age at which a display is reported as missing, s; chosen: ten missing messages."""
_QUEUE = 100
"""Lines of all nodes' logs that wait; chosen: far more than come between two callbacks."""
_MESSAGES = 3
"""Messages of the log that are kept: as many as the screen shows at most."""
_STYLES = {Log.WARN: 'ansiyellow', Log.ERROR: 'ansired', Log.FATAL: 'ansired'}
"""Styles of log lines by level; others have that of `LogLine`."""
_EXAMPLES = {
    'the screen of a calibration that runs elsewhere': '',
    'in the namespace of the sensor': '--ros-args -r __ns:=/arm',
}
"""Examples of arguments, by their purpose."""


class Screen(Node):
    """The screen: a client of the topics and services of the calibration node."""

    def __init__(self) -> None:
        super().__init__('screen')
        own = declare_all(self, ScreenSettings)
        name, self._node_pid = own.node, own.node_pid
        self._target = self.resolve_topic_name(name)
        self._contents, self._received_s = ScreenContents('info', ''), 0.0
        self._log: deque[LogLine] = deque(maxlen=_MESSAGES)
        self._finish_is_confirmed = False
        self._application = full_screen(
            lambda columns, rows: draw(self._shown(), self._log, columns, rows), self._press,
            self._leave)
        create_subscription(self, String, f'{name}/display', self._on_display, 1, latched=True)
        create_subscription(self, Log, '/rosout', self._on_log, _QUEUE, latched=True)
        self._keyed = {service: self.create_client(Trigger, f'{name}/{service}')
                       for service in _SERVICES}

    def show(self, executor: Executor) -> None:
        """Draw and read keys until the operator quits, a signal comes or the terminal ends."""
        def begin() -> None:
            application.create_background_task(self._spin(executor))

        application = self._application
        signal.signal(signal.SIGHUP, lambda *_: rclpy.try_shutdown())
        # A terminal that has hung up can be neither read nor drawn in.
        with held_output(), suppress(EOFError, OSError):
            application.run(begin, set_exception_handler=False, handle_sigint=False)
        if self._node_pid:
            return
        if self._is_fresh():
            print(f'{self._target} goes on; show it again: ros2 run adxl_ros screen')
        elif self._contents.outcome:
            # The screen is gone, and its last lines with it.
            print(f'{self._contents.outcome[0]}\n{self._contents.text}')

    async def _spin(self, executor: Executor) -> None:
        """Take messages until a signal comes, or the node that has started this screen ends."""
        try:
            while self._node_pid in (0, os.getppid()):
                executor.spin_once(timeout_sec=0.0)
                await asyncio.sleep(_SPIN_S)
        except Exception:
            # A signal makes rclpy's calls fail in several ways.
            if rclpy.ok():
                raise
        finally:
            if self._application.is_running and not self._application.is_done:
                self._application.exit()

    def _shown(self) -> ScreenContents:
        """Return the newest contents, or what the screen waits for."""
        if self._is_fresh():
            return self._contents
        text = f'waiting for {self._target}; is it running in this ROS domain?'
        if self._received_s and self._is_there():
            silent_s = time.monotonic() - self._received_s
            text = f'nothing from {self._target} for {silent_s:.0f} s; waiting for it'
        elif self._received_s:
            text = f'{self._target} has ended; waiting until it is started again'
        elif self._node_pid:
            text = 'starting'
        return replace(self._contents, phase='silent', text=text, keys=())

    def _is_fresh(self) -> bool:
        """Return whether the newest contents still hold; a node that fits publishes none."""
        is_silent = time.monotonic() - self._received_s > _SILENT_S
        return self._received_s > 0 and self._is_there() and (
            not is_silent or self._contents.phase == 'fit')

    def _is_there(self) -> bool:
        return rclpy.ok() and self.count_publishers(f'{self._target}/display') > 0

    def _press(self, key: str) -> None:
        """Call the service of a key; the space captures, `finish` may need a second key."""
        contents = self._shown()
        services = {entry.key: entry.service for entry in contents.keys}
        service = services.get('c' if key == ' ' else key)
        open_poses = contents.progress.open_poses if contents.progress else 0
        if service == 'finish' and open_poses and not self._finish_is_confirmed:
            self._finish_is_confirmed = True
            self._say(f'{open_poses} poses are open; press f again to fit what there is')
            return
        self._finish_is_confirmed = False
        if service is not None:
            answer = self._keyed[service].call_async(Trigger.Request())
            answer.add_done_callback(lambda future: self._say(future.result().message))

    def _leave(self) -> None:
        """End the node, too, if it has started this screen."""
        if self._node_pid:
            os.kill(self._node_pid, signal.SIGINT)

    def _on_display(self, message: String) -> None:
        try:
            self._contents = ScreenContents.from_json(message.data)
        except ValueError:
            self._contents = ScreenContents(
                'refused', f'{self._target} is of another version of adxl_ros; update both')
        self._received_s = time.monotonic()

    def _on_log(self, message: Log) -> None:
        if message.name == self._target.strip('/').replace('/', '.'):
            self._log.append(LogLine(message.msg, _STYLES.get(message.level, LogLine('').style)))

    def _say(self, text: str) -> None:
        """Show a line unless the log shows it."""
        if all(line.text != text for line in self._log):
            self._log.append(LogLine(text))


def main() -> int:
    """Run the screen."""
    return run(Screen, NodeHelp(__doc__, _EXAMPLES, (ScreenSettings,), has_sensor=False),
               Screen.show)
