# SPDX-License-Identifier: Apache-2.0

"""Read the ADC link and publish each sample as nominally converted acceleration."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
import traceback
from typing import Any

from adxl_ros.errors import one_line, UserError
from adxl_ros.files.stream_info import NO_SERIAL
from adxl_ros.links.support import base
from adxl_ros.model.sensor import Sensor
from adxl_ros.nodes import parameter_checks, parameters, sensor_parameters
from adxl_ros.nodes.link_reader import LinkReader
from adxl_ros.nodes.parameters import LINK, parameter
from adxl_ros.nodes.params_files import parameter_error
from adxl_ros.nodes.run_node import run
from adxl_ros.nodes.sample_output import SampleOutput, Tally
from adxl_ros.nodes.topics import DiagnosticsReporter, Level, Status, STEADY
from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn

DEFAULT_FRAME = 'imu_link'  # Frame of the case, unless a parameter or a simulator states it


@dataclass(frozen=True)
class DriverSettings:
    """The driver."""

    link: str = parameter(
        base.DEFAULT_LINK,
        'where the samples come from',
        name=f'{LINK}type',
        choices=base.link_names(),
    )
    stamp_offset_s: float = parameter(
        0.0,
        'delay of the sensor, such as that of its RC filter, by which the stamps are earlier',
        's',
        -10.0,
        10.0,
        name='stamp_offset',
    )
    frame_id: str = parameter(
        '', 'frame of the case; empty: imu_link, or as a simulator states it'
    )
    autostart: bool = parameter(True, 'configure and activate at the start')


_SIMULATED = f'SIMULATED sensor (link.type: {base.DEFAULT_LINK})'
"""Words of log and diagnostics where no sensor is read."""
_EXAMPLES = {
    'a board on a serial port': '--ros-args -p link.type:=serial -p link.port:=/dev/ttyACM0',
    "a realistic sensor on a simulator's ideal one": '--ros-args -p link.type:=topic -p '
    'link.topic:=/imu -p use_sim_time:=true --params-file gap/params.yaml',
}
"""Examples of arguments, by their purpose."""


def _transition(goal: str, *acts: str) -> Callable[..., TransitionCallbackReturn]:
    """Return the callback of a transition to a state, which calls methods of the driver."""

    def callback(node: Driver, _: LifecycleState) -> TransitionCallbackReturn:
        return node.change(goal, acts)

    return callback


def other_sensor(given: Sensor, found: Sensor) -> str:
    """Return that a link has found another unit than the parameters name, or ''."""
    if NO_SERIAL in (given.serial, found.serial) or given.serial == found.serial:
        return ''
    return (
        f'the samples are of the unit {found.serial}, but the parameters are those of '
        f'{given.serial}; give the file of {found.serial}'
    )


class Driver(LifecycleNode):
    """
    The node of the driver.

    It publishes the samples of a link of the package `links`. The configured node has its topics,
    the active node reads the link. It configures and activates itself unless `autostart` is false.
    """

    on_configure = _transition('inactive', 'configure')
    on_activate = _transition('active', 'activate')
    on_deactivate = _transition('inactive', 'close')
    on_cleanup = _transition('unconfigured', 'clean_up')
    on_shutdown = _transition('finalized', 'close', 'clean_up')
    # The node can be configured again.
    on_error = _transition('unconfigured', 'close', 'clean_up')

    def __init__(self) -> None:
        super().__init__('driver')
        parameter_checks.check_given(self)
        self._sensor = sensor_parameters.make_sensor(sensor_parameters.declare_sensor(self))
        self._refuse_silent_simulation()
        own = parameters.declare_all(self, DriverSettings)
        self._delay_ns = round(1e9 * own.stamp_offset_s)
        self._link = own.link
        self._module = base.link_module(own.link)
        self._settings = settings = self._declare_link()
        has_frame = isinstance(settings, base.SimulatorSettings)
        self._frame_id = own.frame_id or ('' if has_frame else DEFAULT_FRAME)
        paced = isinstance(settings, base.PacedSettings)
        # All nodes must share a sensor time that is not real time: this node then publishes it,
        # unless another node does.
        self._is_clock = paced and (
            settings.speed != 1 or self.get_parameter('use_sim_time').value
        )
        # A real device lives in real time, whatever the clock of the graph is.
        self._stamp_clock = (
            self.get_clock()
            if paced or isinstance(settings, base.SimulatorSettings)
            else Clock(clock_type=ClockType.SYSTEM_TIME)
        )
        self._simulates = self._link == base.DEFAULT_LINK
        self._tally = Tally(STEADY.now().nanoseconds)
        self._fault = self._told = ''  # Why there are no samples; the unit that was named last
        self._announces = not own.autostart
        self._output: SampleOutput | None = None
        self._reader: LinkReader | None = None
        self._diagnostics = DiagnosticsReporter(self, 'link', self._status)
        if not own.autostart:
            self._announce('unconfigured')
        elif self.trigger_configure() == TransitionCallbackReturn.SUCCESS:
            self.trigger_activate()
        if self._fault:
            raise UserError(self._fault)
        self._announces = True

    def _refuse_silent_simulation(self) -> None:
        """Refuse a driver of a real unit without a link: no real unit gets simulated data."""
        given = [*parameters.given_below(self, LINK)]
        serial = self._sensor.serial
        if given:
            reason = f'{LINK}{given[0]} is given'
        elif serial != NO_SERIAL:
            reason = f'the sensor is the unit {serial}'
        else:
            return
        if 'type' not in given:
            devices = [name for name in base.link_names() if name != base.DEFAULT_LINK]
            raise parameter_error(
                'link.type',
                f'is not set, but {reason}; set it to '
                f'{", ".join(devices)}, or to {base.DEFAULT_LINK} for a '
                'simulated sensor',
            )

    def _declare_link(self) -> Any:
        """Declare the parameters of the link; refuse those of another one."""
        specs = {spec.name.removeprefix(LINK): spec for spec in parameters.link_specs(self._link)}
        for name in parameters.given_below(self, LINK):
            if name not in ('type', *specs):
                raise parameter_error(
                    f'{LINK}{name}',
                    f'the link {self._link} has no such '
                    'parameter; it has link.type, '
                    f'{", ".join(spec.name for spec in specs.values())}',
                )
        return self._module.Settings(
            **{name: parameters.declare(self, spec) for name, spec in specs.items()}
        )

    def configure(self) -> None:
        """Create the topics."""
        self._fault = ''
        self._output = SampleOutput(
            node=self,
            sensor=self._sensor,
            frame_id=self._frame_id,
            delay_ns=self._delay_ns,
            is_clock=self._is_clock,
            clock=self._stamp_clock,
            tally=self._tally,
        )

    def activate(self) -> None:
        """Open the link and read it from now on; a failure leaves no link open."""
        assert self._output is not None, 'the life cycle configures a node before it activates it'
        self._fault = ''
        link = self._module.open_link(self._sensor, self._settings)
        self._reader = LinkReader(
            node=self,
            link=link,
            output=self._output,
            settings=self._settings,
            on_error=self._fail,
            on_level=self._diagnostics.notice,
        )

    def close(self) -> None:
        """End the thread and close the link."""
        reader = self._reader
        self._reader = None
        if reader is not None:
            reader.close()

    def clean_up(self) -> None:
        """Remove the topics."""
        output = self._output
        self._output = None
        if output is not None:
            output.destroy()

    def change(self, goal: str, acts: Sequence[str]) -> TransitionCallbackReturn:
        """Do what the transition to a goal asks for; rclpy would not report why it fails."""
        try:
            for act in acts:
                getattr(self, act)()
        except Exception as error:
            self.close()
            if not self.context.ok():
                # A signal has ended the context, and whatever was being made failed by that.
                return TransitionCallbackReturn.FAILURE
            if isinstance(error, UserError):
                self._fail(error)
                return TransitionCallbackReturn.FAILURE
            self._fault = f'the driver has failed: {one_line(error)}'
            self.get_logger().fatal(traceback.format_exc())
            self._diagnostics.notice(Level.ERROR)
            return TransitionCallbackReturn.ERROR
        if goal == 'active' or self._announces:
            self._announce(goal)
        self._diagnostics.notice(self._level())
        return TransitionCallbackReturn.SUCCESS

    def _announce(self, state: str) -> None:
        """Log a state of the life cycle: link, unit, rate and topic; warn where it simulates."""
        if not self.context.ok():
            return
        sensor = self._output.sensor if self._output else self._sensor
        topic = self.resolve_topic_name('imu/data_raw')
        self.get_logger().info(
            f'{state}: link {self._link}, unit {sensor.serial}, '
            f'{sensor.rate_hz:g} Hz, topic {topic}'
        )
        if state == 'active' and self._simulates:
            self.get_logger().warning(f'{_SIMULATED}: no sensor is read')

    def _fail(self, error: UserError) -> None:
        """Report why there are no samples, and stay up."""
        self._fault = str(error)
        # During the start the node ends with it: the parameters are wrong.
        if self._announces:
            self.get_logger().error(self._fault)
            self._diagnostics.notice(Level.ERROR)

    def _status(self) -> Status:
        link = self._link_status()
        sensor_ns = self._tally.now_ns or 0
        if sensor_ns and not (self._output and self._output.is_clock):
            # A simulator may publish no /clock, although the node waits for one.
            sensor_ns = self._stamp_clock.now().nanoseconds or sensor_ns
        values, warning = self._tally.report(STEADY.now().nanoseconds, sensor_ns)
        counts = {
            topic: self.count_publishers(topic)
            for topic in (self.resolve_topic_name('imu/data_raw'), '/clock')
        }
        several = [
            f'{count} nodes publish {topic}; end all but one'
            for topic, count in counts.items()
            if count > 1
        ]
        warning = ', '.join(filter(None, (*several, warning)))
        level = self._level()
        if warning and level is Level.OK:
            level = Level.WARN
        kind = _SIMULATED if self._simulates else self._link
        text = ', '.join(filter(None, (f'{kind}: {link.text}', warning)))
        serial = (self._output.sensor if self._output else self._sensor).serial
        return Status(
            level,
            text,
            serial,
            {**values, 'link_type': self._link, 'link_state': link.text, **link.statistics},
        )

    def _level(self) -> Level:
        """Return the level of the link; a simulated sensor is a warning at least."""
        level = self._link_status().level
        return Level.WARN if self._simulates and level is Level.OK else level

    def _link_status(self) -> base.LinkStatus:
        """Return how the link works, or why there is none."""
        if self._fault:
            return base.LinkStatus(Level.ERROR, self._fault)
        if self._reader is None:
            return base.LinkStatus(Level.WARN, 'inactive, no samples are published')
        status = self._reader.status()
        found = self._output.sensor if self._output else self._sensor
        fault = '' if status.level is Level.ERROR else other_sensor(self._sensor, found)
        if fault and fault != self._told:
            self.get_logger().error(fault)
            self._told = fault
        return replace(status, level=Level.ERROR, text=fault) if fault else status


def main() -> int:
    """Run the node."""
    return run(Driver, __doc__, _EXAMPLES)
