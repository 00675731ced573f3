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

"""The terminal of the calibration node: keys go to its controller, contents to the screen."""

from __future__ import annotations

from enum import Enum

from adxl_ros.calibrate.guided.capture_settings import Phase
from adxl_ros.calibrate.guided.controller import Answer, Controller, ControllerState, IDLE_TEXT
from adxl_ros.calibrate.guided.display import live_reading, SessionDisplay
from adxl_ros.calibrate.guided.screen_contents import LiveReading, ScreenContents
from adxl_ros.calibrate.guided.session import Session
from adxl_ros.nodes.terminal.terminal_process import open_terminal, Terminal
import rclpy
from rclpy.node import Node

_TURNS_PER_UPDATE = 4
"""Calls of `Console.turn` from one update of the screen to the next: five updates a second."""


class Action(Enum):
    """What a key does; the value stands on the screen."""

    BEGIN = 'begin'
    CAPTURE = 'capture'
    REDO = 'redo'
    SKIP = 'skip'
    FINISH = 'finish'
    ABORT = 'abort'
    GO_ON = 'go on'
    BEGIN_AGAIN = 'begin again'
    QUIT = 'quit'


_RUNNING = {'r': Action.REDO, 's': Action.SKIP, 'f': Action.FINISH, 'a': Action.ABORT,
            'q': Action.QUIT}
"""Keys while a session runs."""
_BY_HAND = {'c': Action.CAPTURE, **_RUNNING}
"""Keys while a session runs whose poses an operator captures."""
_IDLE = {'b': Action.BEGIN, 'q': Action.QUIT}
"""Keys while no session runs."""
_WAITING = {'a': Action.ABORT, 'q': Action.QUIT}
"""Keys while the sensor is unknown."""
_ASKING = {'y': Action.GO_ON, 'n': Action.BEGIN_AGAIN, 'a': Action.ABORT, 'q': Action.QUIT}
"""Keys that answer the question what to do with an interrupted calibration."""


class Console:
    """
    A screen beside the node, as long as there is a terminal that can show one.

    Parameters
    ----------
    node
        The node, whose log gets a line where the screen is missing.
    controller
        What keys control and the screen shows.

    """

    def __init__(self, node: Node, controller: Controller) -> None:
        self._node, self._controller = node, controller
        self._terminal: Terminal | None
        self._terminal, obstacle = open_terminal()
        if obstacle:
            node.get_logger().info(obstacle)
        controller.may_ask = controller.shows_idle_stream = self._terminal is not None
        self._turns = 0
        self._finish_is_confirmed = False
        self._session: Session | None = None
        self._display: SessionDisplay | None = None

    def turn(self) -> None:
        """Carry out pressed keys and update the screen, without waiting."""
        if self._terminal is None:
            return
        if not self._terminal.alive():
            self._lose_terminal(self._terminal)
            return
        for key in self._terminal.pressed():
            self._press(key)
        self._turns += 1
        if self._turns % _TURNS_PER_UPDATE == 0:
            status = self._controller.status()
            self._show(status.phase, status.text.replace(IDLE_TEXT, 'press b to begin'))

    def show_fit(self, text: str) -> None:
        """Show at once that the fit begins, which takes a while."""
        self._show(Phase.FIT, text)

    def close(self) -> None:
        """Give the terminal back as it was."""
        if self._terminal is not None:
            self._terminal.close()
            self._terminal = None

    def _lose_terminal(self, terminal: Terminal) -> None:
        """Go on without the screen, whose process has ended."""
        terminal.close()
        self._terminal, self._controller.may_ask = None, False
        self._node.get_logger().warning('the screen has ended; plain lines from here on')
        if self._controller.state is ControllerState.ASKING:
            self._controller.start(start_over=False)

    def _show(self, phase: Phase, text: str) -> None:
        """Give the screen its contents."""
        if self._terminal is None:
            return
        controller, unit = self._controller, self._controller.unit
        display = self._session_display()
        self._terminal.show(ScreenContents(
            phase=phase.value, text=text, unit=f'{unit.serial} ({unit.axes})' if unit else '',
            output=str(controller.settings.output),
            keys=tuple((key, action.value) for key, action in self._keys().items()),
            live=self._idle_reading() if display is None else display.live(),
            progress=None if display is None else display.progress(),
            estimate=None if display is None else display.estimate(),
            outcome=controller.outcome))

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

    def _keys(self) -> dict[str, Action]:
        """Return the keys that have an action now."""
        controller = self._controller
        if controller.state is ControllerState.ASKING:
            return _ASKING
        if controller.state is ControllerState.WAITING_FOR_SENSOR:
            return _WAITING
        if controller.state is ControllerState.IDLE:
            return _IDLE
        return _BY_HAND if controller.settings.operator_captures else _RUNNING

    def _press(self, key: str) -> None:
        """Carry out a key; the space captures, and `finish` with open poses needs a second key."""
        action, controller = self._keys().get('c' if key == ' ' else key), self._controller
        open_poses = 0 if controller.session is None else controller.session.guide.open_poses
        if action is Action.FINISH and open_poses and not self._finish_is_confirmed:
            self._finish_is_confirmed = True
            controller.say(f'{open_poses} poses are open; press f again to fit what there is')
            return
        self._finish_is_confirmed = False
        if action is Action.QUIT:
            rclpy.try_shutdown()
        elif action is not None:
            controller.say(self._carry_out(action).message)

    def _carry_out(self, action: Action) -> Answer:
        """Pass an action to the controller and return its answer."""
        controller = self._controller
        if action is Action.BEGIN:
            controller.may_ask = True
            return controller.start()
        if action in (Action.GO_ON, Action.BEGIN_AGAIN):
            return controller.start(start_over=action is Action.BEGIN_AGAIN)
        requests = {Action.CAPTURE: controller.capture, Action.REDO: controller.redo,
                    Action.SKIP: controller.skip, Action.FINISH: controller.finish,
                    Action.ABORT: controller.abort}
        return requests[action]()
