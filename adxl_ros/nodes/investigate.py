# SPDX-License-Identifier: Apache-2.0

"""Investigate the sim-to-real gap: record, diagnose, command the next manoeuvre, until certain."""

from __future__ import annotations

from functools import partial
import signal

from adxl_ros.investigate.background import BackgroundDiagnoser
from adxl_ros.investigate.investigation import Investigation, State
from adxl_ros.investigate.manoeuvres import Pose
from adxl_ros.investigate.output_folder import OutputFolder
from adxl_ros.links.support.watchdog import Watchdog
from adxl_ros.nodes.support.bag_recorder import BagRecorder
from adxl_ros.nodes.support.diagnostics import DiagnosticsReporter, Level, Status
from adxl_ros.nodes.support.given_parameters import check_given_parameters
from adxl_ros.nodes.support.investigate_parameters import declare_settings
from adxl_ros.nodes.support.node_help import NodeHelp
from adxl_ros.nodes.support.run_node import run
from adxl_ros.nodes.support.sensor_parameters import declare_sensor, make_sensor
from adxl_ros.nodes.support.topics import create_publisher, create_subscription
from adxl_ros.nodes.terminal.investigation_lines import closing_lines, InvestigationScreen
import numpy as np
from rclpy.clock import Clock, ClockType
from rclpy.executors import Executor
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from std_srvs.srv import Trigger

_POLL_S = 0.02
"""Time between two commands, s; chosen: a tenth of the largest step."""
_SILENT_S = 3.0
"""Time without samples or poses after which the stage is stopped, s; chosen."""
_LONGEST_TURN_S = 0.2
"""Longest time between two commands that counts as silence, s; chosen: ten turns."""
_FAREWELL_S = 0.5
"""Time for which the last command is repeated at the end, s; chosen: the stage has it then."""
_COMMAND_QUEUE = 10
"""Commands that are kept for a slow subscriber; chosen."""
_STAGE_QUEUE = 1000
"""Poses of the stage that wait while the node is busy; chosen: 10 s."""
_EXAMPLES = {
    'a simulated stage, driver and stage running': '',
    'a unit by its parameter file, within limits':
        '--ros-args --params-file unit.yaml -p limits.rate_deg_s:=10.0 '
        "-p 'limits.beta_deg:=[-90.0,90.0]'",
}
"""Examples of arguments, by their purpose."""


class Investigate(Node):
    """
    The node of the investigation.

    It connects topics to an `Investigation`, records them, and shows what happens.
    """

    def __init__(self) -> None:
        super().__init__('investigate')
        check_given_parameters(self)
        self._sensor = make_sensor(declare_sensor(self))
        self._settings = declare_settings(self)
        self._commands = create_publisher(self, JointState, 'stage/command', _COMMAND_QUEUE)
        self.create_service(Trigger, '~/abort', self._on_abort)
        create_subscription(self, JointState, 'stage/joint_states', self._on_stage, _STAGE_QUEUE)
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._pose: Pose | None = None
        self._watchdogs = {topic: Watchdog(_LONGEST_TURN_S)
                           for topic in ('imu/data_raw', 'stage/joint_states')}
        self._diagnostics = DiagnosticsReporter(self, {'investigate': self._status})
        self._recorder = BagRecorder(self, self._watchdogs['imu/data_raw'])
        self._investigation: Investigation | None = None
        self._screen: InvestigationScreen | None = None
        self._ended_ns: int | None = None
        self._request = ''

    def request_stop(self, reason: str) -> None:
        """Stop the investigation at the next turn; a signal may come at any time."""
        self._request = reason

    def begin(self) -> None:
        """Wait for sensor and stage; the files are made when both are there."""
        settings = self._settings
        self._folder = OutputFolder.free(settings.output)
        self._screen = InvestigationScreen(self._folder.path, settings)
        self._investigation = Investigation(
            settings.limits, settings.minutes,
            BackgroundDiagnoser(self._folder, settings.limits, settings.seed),
            self._screen.show_answer, self._recorder.flush)
        self._recorder.listen()
        self.create_timer(_POLL_S, self._poll, clock=self._steady)

    def stop(self, reason: str) -> None:
        """Stop the investigation; the stage holds its pose."""
        if self._investigation is not None:
            self._investigation.stop(reason)

    def close(self) -> None:
        """Write the end of the bag, and end the screen and the diagnosis."""
        self.stop('the node has ended')
        self._recorder.close()
        if self._screen is not None:
            self._screen.close()

    def _poll(self) -> None:
        investigation, screen = self._investigation, self._screen
        assert investigation is not None and screen is not None
        if self._request:
            self.stop(self._request)
        if not investigation.has_ended:
            self._check_streams(investigation)
        now_s = self.get_clock().now().nanoseconds * 1e-9
        command = investigation.step(now_s, self._pose) if now_s else None
        if command is not None:
            self._commands.publish(JointState(
                header=Header(stamp=self.get_clock().now().to_msg()), name=['alpha', 'beta'],
                position=list(command), velocity=list(investigation.speed or ())))
        screen.show_status(investigation.status())
        if investigation.has_ended:
            self._end(investigation)

    def _end(self, investigation: Investigation) -> None:
        """End the node when the stage has its last command."""
        now_ns = self._steady.now().nanoseconds
        if self._ended_ns is None:
            self._ended_ns = now_ns
        elif now_ns - self._ended_ns > _FAREWELL_S * 1e9:
            assert self._screen is not None
            self._recorder.close()
            self._screen.close()
            print('\n'.join(closing_lines(investigation, self._folder)), flush=True)
            raise SystemExit(0 if investigation.has_verdict else 1)

    def _check_streams(self, investigation: Investigation) -> None:
        """Stop where sensor or stage is silent; wait for both at the beginning."""
        if investigation.state is State.RECORDING:
            if not self._recorder.has_samples:
                self._pose = None
            elif self._pose is not None and not self._recorder.is_writing:
                self._folder.make(self._sensor)
                self._recorder.start(self._folder.bag)
            return
        if self._recorder.fault():
            investigation.stop(f'{self._recorder.fault()}; the stage holds its pose')
        for topic, watchdog in self._watchdogs.items():
            silent_s = watchdog.check()
            if silent_s > _SILENT_S:
                investigation.stop(f'nothing on {self.resolve_topic_name(topic)} for '
                                   f'{silent_s:.0f} s; the stage holds its pose')

    def _on_stage(self, message: JointState) -> None:
        angles_rad = dict(zip(message.name, message.position))
        pose = Pose(angles_rad.get('alpha', np.nan), angles_rad.get('beta', np.nan))
        if np.isfinite(pose).all():
            self._pose = pose
            self._watchdogs['stage/joint_states'].feed()

    def _on_abort(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.stop('~/abort was called')
        response.success, response.message = True, 'stopped; the stage holds its pose'
        return response

    def _status(self) -> Status:
        if self._investigation is None:
            return Status(Level.OK, 'not begun', self._sensor.serial, {})
        status = self._investigation.status()
        level = Level.WARN if status.state in (State.STOPPED, State.RECORDING) else Level.OK
        answers = self._investigation.answers
        values = {'state': status.state.value, 'minutes': status.minutes}
        if answers:
            best = answers[-1][1].hypotheses[0]
            values |= {'hypothesis': ' '.join(best.effects) or 'no gap',
                       'probability': best.probability}
        return Status(level, status.text, self._sensor.serial, values)


def _work(node: Investigate, executor: Executor) -> None:
    """Run the node; a signal stops the stage before the node ends."""
    # A handler of rclpy would end the graph before the stage has its last command.
    for number, name in ((signal.SIGINT, 'Ctrl-C'), (signal.SIGTERM, 'SIGTERM')):
        signal.signal(number, partial(_stop_by_signal, node, name))
    node.begin()
    executor.spin()


def _stop_by_signal(node: Investigate, name: str, *_: object) -> None:
    node.request_stop(name)


def main() -> int:
    """Run the node."""
    return run(Investigate, NodeHelp(__doc__, _EXAMPLES), _work)
