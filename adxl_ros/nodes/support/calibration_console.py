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

"""The terminal of the calibration node: keys to its actions, figures to the screen."""

from __future__ import annotations

from typing import Any

from adxl_ros.calibrate.guided.display import live, View
from adxl_ros.calibrate.guided.session import Session
from adxl_ros.nodes.terminal.terminal_process import open_terminal, Terminal
import rclpy
from rclpy.node import Node

IDLE = 'idle; call ~/start'
"""What a node says that has not been told to begin."""

_EVERY = 4
"""The screen is given new figures every so many turns: five times a second."""
_RUNNING = {'r': 'redo', 's': 'skip', 'f': 'finish', 'a': 'abort', 'q': 'quit'}
_BY_HAND = {'c': 'capture', **_RUNNING}
_IDLE = {'b': 'begin', 'q': 'quit'}
_WAITING = {'a': 'abort', 'q': 'quit'}
_ASKED = {'y': 'go on', 'n': 'begin anew', 'a': 'abort', 'q': 'quit'}


class Console:
    """A screen beside the node, as long as there is a terminal that can show one."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._terminal: Terminal | None
        self._terminal, why_not = open_terminal()
        if why_not:
            node.get_logger().info(why_not)
        self.asks = self._terminal is not None
        self._turns = 0
        self._sure = False
        self._view: tuple[Session, View] | None = None

    def turn(self) -> None:
        """Do what keys say, and show the present figures; both without waiting."""
        if self._terminal is None:
            return
        if not self._terminal.alive():
            self._terminal.close()
            self._terminal, self.asks = None, False
            self._node.get_logger().warning('the screen has ended; plain lines from here on')
            if self._node.question:
                self._node.start(anew=False)
            return
        for key in self._terminal.pressed():
            self._press(key)
        self._turns += 1
        if self._turns % _EVERY == 0:
            phase, text, _ = self._node.state()
            self.show(phase, text.replace(IDLE, 'press b to begin'))

    def show(self, phase: str, text: str) -> None:
        """Show the figures now."""
        if self._terminal is not None:
            self._terminal.show({**self._figures(), 'phase': phase, 'text': text,
                                 'keys': self._keys(), 'outcome': self._node.outcome})

    def close(self) -> None:
        """Give the terminal back as it was."""
        if self._terminal is not None:
            self._terminal.close()
            self._terminal = None

    def _figures(self) -> dict[str, Any]:
        node = self._node
        unit, session = node.unit, node.session
        figures: dict[str, Any] = {'unit': f'{unit.serial} ({unit.axes})' if unit else '',
                                   'output': str(node.asked.output), 'mode': node.asked.mode}
        if session is not None:
            if self._view is None or self._view[0] is not session:
                self._view = session, View(session)
            return {**self._view[1].figures(), **figures}
        self._view = None
        newest = node.newest()
        if newest is None:
            return figures
        return {**figures, **live(newest, unit, newest.stillness())}

    def _keys(self) -> dict[str, str]:
        if self._node.question:
            return _ASKED
        if self._node.session is None:
            return _WAITING if self._node.waiting else _IDLE
        asked = self._node.asked
        by_hand = asked.mode == 'stage' and asked.settings.stage_mode != 'commanded'
        return _BY_HAND if by_hand else _RUNNING

    def _press(self, key: str) -> None:
        action = self._keys().get('c' if key == ' ' else key)
        node = self._node
        left = node.session.left if node.session is not None else 0
        if action == 'finish' and left and not self._sure:
            self._sure = True
            node.say(f'{left} poses are open; press f again to fit what there is')
            return
        self._sure = False
        if action == 'quit':
            rclpy.try_shutdown()
        elif action == 'begin':
            self.asks = True
            self._tell(node.start())
        elif action in ('go on', 'begin anew'):
            self._tell(node.start(anew=action == 'begin anew'))
        elif action is not None:
            self._tell(getattr(node, action)())

    def _tell(self, answer: tuple[bool, str]) -> None:
        """Say what came of a key, where the node has not said so itself."""
        self._node.say(answer[1])
