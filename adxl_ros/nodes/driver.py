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
import traceback
from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.links.support import base
from adxl_ros.nodes.support.diagnostics import DiagnosticsReporter, Level, Status
from adxl_ros.nodes.support.link_reader import LinkReader
from adxl_ros.nodes.support.parameters import declare
from adxl_ros.nodes.support.run_node import run
from adxl_ros.nodes.support.sample_output import SampleOutput
from adxl_ros.nodes.support.sample_tally import Tally
from adxl_ros.nodes.support.sensor_parameters import declare_sensor, make_sensor
from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn


class Driver(LifecycleNode):
    """
    The node of the driver.

    It publishes the samples of a link of the package `links`. The configured node has its topics,
    the active node reads the link. It configures and activates itself unless `autostart` is false.
    """

    def __init__(self) -> None:
        super().__init__('driver')
        self._sensor = make_sensor(declare_sensor(self))
        self._frame_id = declare(self, 'frame_id', 'imu_link', 'frame of the case')
        self._delay_ns = round(1e9 * declare(
            self, 'stamp_offset', 0.0, 'delay of the sensor, such as that of its RC filter, that '
            'is taken out of the stamps: they are earlier by this', 's', -10.0, 10.0))
        self._link_type = declare(self, 'link.type', base.DEFAULT_LINK,
                                  'where the samples come from', choices=base.link_names())
        self._module = base.link_module(self._link_type)
        self._settings = self._declare_settings()
        autostart = declare(
            self, 'autostart', True, 'configure and activate at the start; else a system manager '
            'does')
        paced = isinstance(self._settings, base.PacedSettings)
        self._speed = self._settings.speed if paced else 1.0
        # All nodes must share a sensor time that is not real time: this node then publishes it.
        self._is_clock = self._speed != 1 or (paced and self.get_parameter('use_sim_time').value)
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._wall = Clock(clock_type=ClockType.SYSTEM_TIME)
        self._tally = Tally(self._steady.now().nanoseconds)
        self._fault = ''
        self._output: SampleOutput | None = None
        self._reader: LinkReader | None = None
        self._diagnostics = DiagnosticsReporter(self, {'link': self._status})
        if autostart:
            self.trigger_configure()
            self.trigger_activate()

    def _declare_settings(self) -> Any:
        """Declare the parameters of the link and return its settings."""
        return self._module.Settings(**{
            option.name: declare(self, f'link.{option.name}', option.default, option.doc,
                                 option.unit, option.lower, option.upper)
            for option in base.options(self._module.Settings)})

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Create the topics."""
        return self._transition(self._configure, super().on_configure, state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Open the link and read it from now on; a failure leaves no link open."""
        result = self._transition(self._activate, super().on_activate, state)
        if result != TransitionCallbackReturn.SUCCESS:
            self.close()
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Close the link."""
        return self._transition(self.close, super().on_deactivate, state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Remove the topics."""
        return self._transition(self._clean_up, super().on_cleanup, state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Close the link and remove the topics."""
        return self._transition(self._release, super().on_shutdown, state)

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Close the link and remove the topics, so that the node can be configured again."""
        return self._transition(self._release, super().on_error, state)

    def close(self) -> None:
        """End the thread and close the link."""
        reader, self._reader = self._reader, None
        if reader is not None:
            reader.close()

    def _transition(self, act: Callable[[], None],
                    parent: Callable[[LifecycleState], TransitionCallbackReturn],
                    state: LifecycleState) -> TransitionCallbackReturn:
        """Do what a transition asks for; rclpy itself would not report why it fails."""
        try:
            act()
            return parent(state)
        except UserError as error:
            self._fail(error)
            return TransitionCallbackReturn.FAILURE
        except Exception:
            self.get_logger().fatal(traceback.format_exc())
            return TransitionCallbackReturn.ERROR

    def _configure(self) -> None:
        self._output = SampleOutput(self, self._sensor, self._frame_id, self._delay_ns,
                                    self._is_clock, self._tally)

    def _activate(self) -> None:
        assert self._output is not None, 'the life cycle configures a node before it activates it'
        self._fault = ''
        link = self._module.open_link(self._sensor, self._settings)
        self._reader = LinkReader(self, link, self._output, self._speed, self._fail,
                                  self._on_level)

    def _clean_up(self) -> None:
        if self._output is not None:
            self._output.destroy()
            self._output = None

    def _release(self) -> None:
        self.close()
        self._clean_up()

    def _fail(self, error: UserError) -> None:
        """Report why there are no samples, and stay up."""
        self._fault = str(error)
        self.get_logger().error(self._fault)
        self._diagnostics.notice('link', Level.ERROR)

    def _on_level(self, level: base.Level) -> None:
        self._diagnostics.notice('link', Level[level.name])

    def _status(self) -> Status:
        link = self._link_status()
        sensor_ns = self._tally.now_ns or 0
        if sensor_ns and not self._is_clock:
            sensor_ns = self._wall.now().nanoseconds
        values, warning = self._tally.report(self._steady.now().nanoseconds, sensor_ns)
        level = Level[link.level.name]
        if warning and level is Level.OK:
            level = Level.WARN
        text = ', '.join(filter(None, (f'{self._link_type}: {link.text}', warning)))
        serial = (self._output.sensor if self._output else self._sensor).serial
        return Status(level, text, serial, {
            **values, 'link_type': self._link_type, 'link_state': link.text, **link.values()})

    def _link_status(self) -> base.LinkStatus:
        """Return how the link works, or why there is none."""
        if self._fault:
            return base.LinkStatus(base.Level.ERROR, self._fault)
        if self._reader is None:
            return base.LinkStatus(base.Level.OK, 'inactive')
        return self._reader.status()


def main() -> int:
    """Run the node."""
    return run(Driver, __doc__)
