# SPDX-License-Identifier: Apache-2.0

"""Show a guided calibration in this terminal, and pass its keys on; on any machine."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
import os
import signal
import sys
from textwrap import wrap
import time
from typing import Any, TextIO

from adxl_ros.calibrate.guided.screen_contents import KeyAction, Phase, ScreenContents, ScreenRow
from adxl_ros.errors import UserError
from adxl_ros.nodes.jobs import held_output
from adxl_ros.nodes.parameter_checks import check_given
from adxl_ros.nodes.parameters import declare_all, parameter
from adxl_ros.nodes.run_node import run
from adxl_ros.nodes.topics import create_subscription
from rcl_interfaces.msg import Log
import rclpy
from rclpy.executors import Executor
from rclpy.node import Node
from std_msgs.msg import String
from std_srvs.srv import Trigger

Styled = tuple[str, str]  # A style of prompt_toolkit and its text
Line = list[Styled]  # A line of the screen
_COLOURS = {
    Phase.DWELL: 'ansigreen',
    Phase.REFUSED: 'ansired',
    Phase.SILENT: 'ansired',
    Phase.QUESTION: 'ansiyellow',
    Phase.REST: 'ansiyellow',
    Phase.STAGE: 'ansiyellow',
    Phase.OPERATOR: 'bold ansicyan',
    Phase.FIT: 'ansigreen',
}
"""Styles by phase."""
_LEAST_WIDTH = 20  # A narrower terminal is drawn as if it had this width, columns
_LEAST_LINES = 4
"""Lines that a low terminal keeps beside log and keys: title, text, pose and angles."""
_TEXT_LINES = 5  # Largest number of lines of the text at the top
_LABEL_WIDTH = 11  # Width of the labels with a space, columns: the longest is 'tilt error'
_BAR_WIDTH = 12  # Width of a bar, columns
_COEFFICIENT_BAR_WIDTH = 3
"""Width of the bar of a coefficient, columns: the intervals of three axes are long."""
_SHORTEST_NAME = 8  # Smallest width of the name of a coefficient, columns
_FEW_LINES = 3  # Largest number of lines of the log, and of a text with a label
_REFRESH_S = 0.2  # Time between two drawings, s: the node publishes contents five times a second
_QUIT = KeyAction('q', 'quit', '')  # The key of the screen itself
_SERVICES = ('start', 'resume', 'start_over', 'capture', 'redo', 'skip', 'finish', 'abort')
"""Services of the calibration node that keys call."""
_SPIN_S = 0.02
"""Time between two callbacks, s: a tenth of the period of the display, so that keys act at
once."""
_SILENT_S = 2.0
"""Age at which a display is reported as missing, s: ten of its messages at 5 Hz."""
_QUEUE = 100
"""Lines of all nodes' logs that wait between two callbacks: far more than they write in this time,
and more than a terminal shows."""
_STYLES = {Log.WARN: 'ansiyellow', Log.ERROR: 'ansired', Log.FATAL: 'ansired'}
"""Styles of log lines by level."""
_PLAIN = 'ansibrightblack'  # Style of other log lines
_EXAMPLES = {'in the namespace of the sensor': '--ros-args -r __ns:=/arm'}
"""Examples of arguments, by their purpose."""


@dataclass(frozen=True)
class ScreenSettings:
    """The screen."""

    node: str = parameter('calibration', 'name of the calibration node')
    node_pid: int = parameter(0, 'process of the node that has started this screen')


def draw(contents: ScreenContents, log: Iterable[Styled], columns: int, rows: int) -> list[Line]:
    """Lay contents and log, styles and messages, out in the lines of a terminal."""
    width = max(columns - 1, _LEAST_WIDTH)
    task = f' of {contents.unit or "no sensor yet"} into {contents.output}'
    title = f' calibration{task if contents.output else ""}'
    body = [
        ('reverse', f'{title:{width}}'),
        *_styled(_COLOURS.get(contents.phase, 'bold'), wrap(contents.text, width)[:_TEXT_LINES]),
    ]
    for row in contents.rows:
        bar = '' if row.share is None else f'{_bar(row.share)} '
        body += _styled(
            row.style,
            wrap(
                f'{bar}{row.text}',
                width,
                initial_indent=f'{row.label:{_LABEL_WIDTH}}',
                subsequent_indent=_LABEL_WIDTH * ' ',
            )[:_FEW_LINES],
        )
    for text in contents.outcome:
        # A line that fits keeps its spaces.
        body += _styled('', [text] if len(text) <= width else wrap(text, width))
    if not contents.outcome:
        body += _styled('', _coefficients(contents.coefficients, width))
    messages = []
    for style, text in log:
        messages += _styled(style, wrap(text, width))
    messages = messages[-_FEW_LINES:]
    # A small terminal keeps the keys and the first lines, which say what to do.
    body_lines = max(rows - len(messages) - 1, _LEAST_LINES)
    body = [*body, *[('', '')] * body_lines][:body_lines]
    keys = []
    for key in (*contents.keys, _QUIT):
        keys += [('reverse', f' {key.key} '), ('', f' {key.action}  ')]
    lines = [[(style, text[:width])] for style, text in (*body, *messages)]
    return [*lines, keys]


def _styled(style: str, lines: Iterable[str]) -> list[Styled]:
    return [(style, line) for line in lines]


def _coefficients(rows: Sequence[ScreenRow], width: int) -> list[str]:
    """Return a line for each coefficient: name, bar and intervals."""
    texts = {
        row.label: f'{_bar(row.share or 0.0, _COEFFICIENT_BAR_WIDTH)} {row.text}' for row in rows
    }
    longest_text = max(map(len, texts.values()), default=0)
    longest_name = max(map(len, texts), default=0)
    name_width = max(min(longest_name, width - 1 - longest_text), _SHORTEST_NAME)
    return [f'{name[:name_width]:{name_width}} {text}' for name, text in texts.items()]


def _bar(share: float, width: int = _BAR_WIDTH) -> str:
    """Return a bar of a width in columns, of which a share from 0 to 1 is full."""
    full = round(min(max(share, 0.0), 1.0) * width)
    return '█' * full + '░' * (width - full)


def full_screen(
    lines: Callable[[int, int], list[Line]],
    press: Callable[[str], None],
    leave: Callable[[], None],
) -> Any:
    """Make the application of prompt_toolkit with a full screen."""
    try:
        from prompt_toolkit.application import Application
        from prompt_toolkit.input import create_input
        from prompt_toolkit.key_binding import KeyBindings
        from prompt_toolkit.layout import FormattedTextControl, Layout, Window
        from prompt_toolkit.output import create_output
    except ImportError:
        raise UserError('the screen needs prompt_toolkit; pip install prompt_toolkit') from None
    stdin, stdout = _terminal()
    output = create_output(stdout)
    keys = KeyBindings()

    def fragments() -> Any:
        rows, columns = output.get_size()
        drawn: list[Styled] = []
        for line in lines(columns, rows):
            drawn += [*line, ('', '\n')]
        return drawn[:-1]

    def end(event: Any) -> None:
        leave()
        event.app.exit()

    keys.add('<any>')(lambda event: press(event.data.lower()))
    # A key with Alt comes as Escape and the key.
    keys.add('escape', '<any>')(lambda _: None)
    for key in ('q', 'Q', 'c-c'):
        keys.add(key)(end)
    return Application(
        Layout(Window(FormattedTextControl(fragments, show_cursor=False))),
        key_bindings=keys,
        full_screen=True,
        refresh_interval=_REFRESH_S,
        input=create_input(stdin),
        output=output,
    )


def _terminal() -> tuple[TextIO, TextIO]:
    """Return the terminal to read from and to write to."""
    if sys.stdin.isatty() and sys.stdout.isatty():
        return sys.stdin, open(os.dup(sys.stdout.fileno()), 'w', encoding='utf-8')
    try:
        # A launch keeps stdin and stdout to itself.
        return open('/dev/tty', encoding='utf-8'), open('/dev/tty', 'w', encoding='utf-8')
    except OSError:
        raise UserError('the screen needs a terminal; run it in one') from None


class Screen(Node):
    """The screen: a client of the topics and services of the calibration node."""

    def __init__(self) -> None:
        super().__init__('screen')
        check_given(self)
        own = declare_all(self, ScreenSettings)
        name = own.node
        self._node_pid = own.node_pid
        self._target = self.resolve_topic_name(name)
        self._contents = ScreenContents(Phase.INFO, '')
        self._received_s = -_SILENT_S
        self._log: deque[tuple[str, str]] = deque(maxlen=_FEW_LINES)  # Styles and messages
        self._application = full_screen(
            lambda columns, rows: draw(self._shown(), self._log, columns, rows),
            self._press,
            self._leave,
        )
        create_subscription(self, String, f'{name}/display', self._on_display, 1, latched=True)
        create_subscription(self, Log, '/rosout', self._on_log, _QUEUE, latched=True)
        self._keyed = {
            service: self.create_client(Trigger, f'{name}/{service}') for service in _SERVICES
        }

    def show(self, executor: Executor) -> None:
        """Draw and read keys until the operator quits, a signal comes or the terminal ends."""

        def begin() -> None:
            application.create_background_task(self._spin(executor))

        application = self._application
        signal.signal(signal.SIGHUP, lambda *_: rclpy.try_shutdown())
        # A terminal that has hung up can be neither read nor drawn in.
        with held_output(), suppress(EOFError, OSError):
            application.run(begin, set_exception_handler=False, handle_sigint=False)
        if not self._node_pid and self._contents.outcome:
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
        """Return the newest contents, or what the screen waits for; a node that fits is silent."""
        age_s = time.monotonic() - self._received_s
        may_be_silent = self._contents.phase is Phase.FIT
        is_there = rclpy.ok() and self.count_publishers(f'{self._target}/display') > 0
        if is_there and (age_s < _SILENT_S or may_be_silent):
            return self._contents
        return replace(
            self._contents,
            phase=Phase.SILENT,
            keys=(),
            text=f'waiting for {self._target}; is it running in this ROS domain?',
        )

    def _press(self, key: str) -> None:
        """Call the service of a key; the space captures."""
        services = {entry.key: entry.service for entry in self._shown().keys}
        service = services.get('c' if key == ' ' else key)
        if service is not None:
            answer = self._keyed[service].call_async(Trigger.Request())
            answer.add_done_callback(lambda future: self._say(future.result().message))

    def _leave(self) -> None:
        """End the node, too, if it has started this screen."""
        if self._node_pid:
            os.kill(self._node_pid, signal.SIGINT)

    def _on_display(self, message: String) -> None:
        before = self._contents.phase
        try:
            self._contents = ScreenContents.from_json(message.data)
        except (LookupError, TypeError, ValueError):
            self._contents = ScreenContents(
                Phase.REFUSED, f'{self._target} is of another version of adxl_ros; update both'
            )
        if self._contents.phase is not before:
            # A launch prints lines of its own into this terminal: draw all, not what is new.
            self._application.renderer.clear()
        self._received_s = time.monotonic()

    def _on_log(self, message: Log) -> None:
        if message.name == self._target.strip('/').replace('/', '.'):
            self._log.append((_STYLES.get(message.level, _PLAIN), message.msg))

    def _say(self, text: str) -> None:
        """Show a line unless the log shows it."""
        if all(line != text for _, line in self._log):
            self._log.append((_PLAIN, text))


def main() -> int:
    """Run the screen."""
    return run(Screen, __doc__, _EXAMPLES, Screen.show)
