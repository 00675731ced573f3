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

"""Guide a calibration: command or announce poses, average at rest, fit, write the file."""

from __future__ import annotations

from collections.abc import Callable
import os
from pathlib import Path

from adxl_ros.calibrate.calibration import CalibrationResult
from adxl_ros.calibrate.guided.live_window import Newest, STALE_NS
from adxl_ros.calibrate.guided.session import Session
from adxl_ros.calibrate.guided.stage_guide import MountingError, Sweep
from adxl_ros.calibrate.report import report_html
from adxl_ros.errors import UserError
from adxl_ros.files.stream_info import StreamInfo
from adxl_ros.files.stream_unit import unit_of
from adxl_ros.model.sensor import Sensor
from adxl_ros.nodes.support import next_pose
from adxl_ros.nodes.support.calibration_console import Console, IDLE
from adxl_ros.nodes.support.calibration_parameters import declare_plan
from adxl_ros.nodes.support.diagnostics import DiagnosticsReporter, Level, Status
from adxl_ros.nodes.support.imu_subscription import Samples
from adxl_ros.nodes.support.parameters import declare
from adxl_ros.nodes.support.run_node import run
from adxl_ros.nodes.support.sensor_parameters import declare_sensor, make_sensor
from adxl_ros.nodes.support.topics import create_subscription
from diagnostic_msgs.msg import DiagnosticStatus
import numpy as np
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.task import Future
from sensor_msgs.msg import BatteryState, JointState, Temperature
from std_srvs.srv import Trigger

_POLL_S = 0.05
_SERVICES = ('start', 'redo', 'skip', 'finish', 'abort')


class Calibration(Node):
    """The node; what it does with samples is in `calibrate`, ROS-free."""

    def __init__(self) -> None:
        super().__init__('calibration')
        self.base = make_sensor(declare_sensor(self))
        self.autostart = declare(self, 'autostart', False, 'start without a call of ~/start')
        self.resume = declare(
            self, 'resume', 'ask', 'go on with an interrupted calibration; ask where there is a '
            'screen, else go on', choices=('ask', 'continue', 'anew'))
        self.asked = declare_plan(self)
        self.unit: Sensor | None = None
        self.session: Session | None = None
        self.outcome: list[str] = []
        self.question = self._outlook = ''
        self.said = self._hindrance = self._warned = self._foreign = self._stuck = ''
        self._wanted = self.autostart
        self._anew = self.resume == 'anew'
        self._newest: Newest | None = None
        self._captures: list[Future] = []
        self._misdated: set[str] = set()
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._samples = Samples(self)
        self._announcer = next_pose.Announcer(self)
        self._connect()
        self.console = Console(self) if declare(
            self, 'screen', True, 'show a screen, where the node runs in a terminal') else None

    def _connect(self) -> None:
        self._diagnostics = DiagnosticsReporter(self, {'calibration': self._status})
        subscribe = create_subscription
        subscribe(self, DiagnosticStatus, 'sensor_info', self._on_info, 1, latched=True)
        subscribe(self, JointState, 'stage/joint_states', self._on_stage, 1000)
        subscribe(self, JointState, 'stage/command', self._on_command, 100)
        subscribe(self, Temperature, 'temperature',
                  lambda m: self._surround('temperature_c', m, m.temperature), 100)
        subscribe(self, BatteryState, 'supply',
                  lambda m: self._surround('supply_v', m, m.voltage), 100)
        for name in _SERVICES:
            self.create_service(Trigger, f'~/{name}', self._service(name))
        # It answers when the pose is on disk: samples must go on coming meanwhile.
        self.create_service(Trigger, '~/capture', self._on_capture,
                            callback_group=ReentrantCallbackGroup())
        self.create_timer(_POLL_S, self._poll, clock=self._steady)

    def _service(self, name: str) -> Callable[..., Trigger.Response]:
        def answer(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
            response.success, response.message = getattr(self, name)()
            return response
        return answer

    def _on_info(self, message: DiagnosticStatus) -> None:
        info = {pair.key: pair.value for pair in message.values}
        try:
            unit = unit_of(self.base, StreamInfo(info, 'sensor_info'))
        except UserError as error:
            self._foreign = f'{error}'
            # Of that sensor nothing is taken or shown.
            self.unit = self._newest = None
            if self.session is not None:
                self._stop(f'{error}; the poses are kept', failed=True)
            self.fail(self._foreign)
            return
        self._foreign = ''
        if self.session is not None:
            was, now = (self.asked.head(of) for of in (self.session.unit, unit))
            changed = ', '.join(f'{key} was {was[key]}, is {now[key]}' for key in was
                                if was[key] != now[key])
            if not changed and self._sweep is not None:
                # A driver that was started anew: the sensor may have been taken off.
                self._sweep.verify()
                self._answer_captures(False, 'the driver began anew; capture again')
            elif changed:
                self._stop(f'sensor_info: {changed}: changed during the calibration; put it back '
                           'and start again, the poses are kept', failed=True)
        self.unit, self._newest = unit, Newest(unit)
        self._outlook = self.asked.outlook(unit)

    def _on_stage(self, message: JointState) -> None:
        angles = dict(zip(message.name, message.position))
        pair = angles.get('alpha'), angles.get('beta')
        if self._sweep is not None and None not in pair and np.isfinite(pair).all():
            self._sweep.stage(_stamp_ns(message), *pair)

    def _on_command(self, message: JointState) -> None:
        angles = dict(zip(message.name, message.position))
        if self._sweep is not None:
            self._sweep.command(*(angles.get(joint, np.nan) for joint in ('alpha', 'beta')))

    def _surround(self, name: str, message: Temperature | BatteryState, value: float) -> None:
        if self.session is None:
            return
        stamp_ns, newest_ns = _stamp_ns(message), self.session.walk.newest_ns or 0
        ahead_ns = stamp_ns - newest_ns
        if stamp_ns and newest_ns and abs(ahead_ns) > STALE_NS:
            if name not in self._misdated:
                self._misdated.add(name)
                self.get_logger().warning(
                    f'{name.split("_")[0]} is stamped {abs(ahead_ns) * 1e-9:.0f} s '
                    f'{"ahead of" if ahead_ns > 0 else "behind"} imu/data_raw: it counts from '
                    'when it arrives; put both on one clock')
            stamp_ns = 0
        getattr(self.session.walk.surroundings, name).add(stamp_ns or newest_ns, value)

    @property
    def _sweep(self) -> Sweep | None:
        walk = self.session.walk if self.session else None
        return walk if isinstance(walk, Sweep) else None

    @property
    def waiting(self) -> bool:
        """Tell whether a calibration is to start that cannot yet."""
        return self.session is None and self._wanted

    def start(self, anew: bool | None = None) -> tuple[bool, str]:
        """Begin, or go on with what was interrupted; returns whether, and what is said."""
        if self.session is not None:
            return False, 'a calibration is running; finish or abort it first'
        if self.question and anew is None:
            return False, self.question
        self._wanted, self.question = True, ''
        self._anew = self.resume == 'anew' if anew is None else anew
        self._try_to_start()
        if self.question:
            return False, self.question
        if self.waiting:
            return True, 'starts when sensor_info arrives'
        return self.session is not None, self.said

    def capture(self) -> tuple[bool, str]:
        """Take the pose that the operator has reached; returns whether, and why not."""
        if self.session is None:
            return False, 'no calibration is running'
        if self._sweep is not None and self.asked.settings.stage_mode == 'commanded':
            return False, 'nothing to capture: the stage moves itself, and poses are taken when ' \
                          'it has arrived'
        if self._hindrance or self._stuck:
            return False, self._hindrance or self._stuck
        self._take_samples()
        why = self.session.walk.capture()
        if why:
            self.warn(why)
        return not why, why or 'averaging'

    def redo(self) -> tuple[bool, str]:
        """Take the pose before again."""
        return self._act('redo', 'no pose to take again')

    def skip(self) -> tuple[bool, str]:
        """Leave the pose out."""
        return self._act('skip', 'no pose to leave out')

    def finish(self) -> tuple[bool, str]:
        """Fit what there is and write the file."""
        if self.session is None:
            return False, 'no calibration is running'
        self._take_samples()
        return self._finish(), self.said

    def abort(self) -> tuple[bool, str]:
        """Stop; what was taken stays."""
        if self.session is None and not self._wanted:
            return False, 'no calibration is running'
        kept = f'; its poses stay in {self.session.journal.path}' if self.session else ''
        self._stop(f'aborted{kept}')
        return True, self.said

    def _act(self, name: str, otherwise: str) -> tuple[bool, str]:
        if self.session is None:
            return False, 'no calibration is running'
        try:
            text = getattr(self.session, name)()
        except UserError as error:
            text, otherwise = '', f'{error}'
        if text:
            self._stuck = ''
            self._answer_captures(False, text)
            self.say(text)
        return bool(text), text or otherwise

    async def _on_capture(self, _: Trigger.Request,
                          response: Trigger.Response) -> Trigger.Response:
        response.success, response.message = self.capture()
        if response.success:
            future = Future()
            self._captures.append(future)
            response.success, response.message = await future
        return response

    def _answer_captures(self, success: bool, text: str) -> None:
        for future in self._captures:
            future.set_result((success, text))
        self._captures.clear()

    def _try_to_start(self) -> None:
        if self.unit is None or self.question:
            return
        try:
            if self.console is not None and self.console.asks and self._ask():
                return
            self._wanted = False
            self._start(self.unit)
        except UserError as error:
            self._stop(f'{error}', failed=True)

    def _ask(self) -> bool:
        """Ask in the terminal what to do with an interrupted calibration, if there is one."""
        if self.resume == 'ask':
            self.question = self.asked.question(self.unit)
        self.console.asks = False
        return bool(self.question)

    def _start(self, unit: Sensor) -> None:
        self.session = session = Session(unit, self.asked, self._anew)
        self._samples.heard()
        self.outcome = []
        if session.resumed:
            again = ' (the last one first, to see that the mounting is as it was)' \
                if self._sweep is not None and self._sweep.verifying else ''
            resumed = f', resumed after {session.resumed} poses{again}; ' \
                      'resume:=anew puts them aside'
        else:
            resumed = ''
        self.say(f'calibrating {unit.serial}: ' + (
            f'{self._outlook}{resumed}' if self._sweep is not None else
            f'rest in 24 or more directions, then call ~/finish{resumed}'))

    def _poll(self) -> None:
        if self.waiting:
            self._try_to_start()
        if self.session is None:
            self._watch()
        else:
            self._take_samples()
            self._take_poses()
        if self.session is not None:
            if self.session.over:
                if not self._stuck:
                    self._finish()
            else:
                self._announcer.announce(self.session.walk, self._steady.now().nanoseconds)
        self._diagnostics.notice('calibration', Level.WARN if self.state()[2] else Level.OK)
        if self.console is not None:
            self.console.turn()

    def _take_poses(self) -> None:
        try:
            for text in self.session.accepted():
                self.say(text)
                self._answer_captures(True, text)
        except MountingError as error:
            self._stop(f'{error}', failed=True)
            return
        except UserError as error:
            self.fail(f'{error}')
            self._answer_captures(False, f'{error}')
        refused = self.session.walk.refused()
        if refused:
            self.warn(refused)
            self._answer_captures(False, refused)

    def _watch(self) -> None:
        """Show the live reading while no calibration runs."""
        if self.unit is None and self._wanted:
            # A driver that has just begun says what it is on another topic.
            self._samples.keep_newest()
        elif self._newest is not None and self.console is not None:
            self._newest.feed(*self._samples.take(self.unit))
        else:
            self._samples.clear()

    def _take_samples(self) -> None:
        stamps, volts = self._samples.take(self.unit)
        if not len(stamps) and not self._samples.useless:
            return
        hindrance = self._samples.useless or self.session.feed(stamps, volts)
        if hindrance and not self._hindrance:
            self.fail(hindrance)
        self._hindrance = hindrance

    def _finish(self) -> bool:
        self.say(f'fitting {self.session.done} poses')
        if self.console is not None:
            self.console.show('fit', self.said)
        self._stuck = ''
        try:
            found = self.session.finish()
            self.get_logger().info(found.keep(self.asked.store))
            self._leave_report(found)
            self.session.end()
        except (UserError, OSError) as error:
            # What was taken stays: other poses, or room on the disk, can save it.
            text = f'cannot finish: {error}'
            if self.session.over:
                self._stuck = text = f'{text}; finish again, redo or abort'
            self.fail(text)
            return False
        for line in found.comments():
            self.get_logger().info(line)
        self.outcome = found.summary_lines
        left = self.session.left
        self._stop(f'wrote {self.asked.output}' + (
            f'; {left} poses are open: start again to go on' if left else ''))
        return True

    def _leave_report(self, found: CalibrationResult) -> None:
        """Write the report; without it the calibration stands all the same."""
        if not self.asked.report:
            return
        try:
            Path(self.asked.report).mkdir(parents=True, exist_ok=True)
            report_html.write(self.asked.report, found, self.asked.store)
        except (UserError, OSError) as error:
            self.fail(f'no report: {error}')

    def _stop(self, text: str, failed: bool = False) -> None:
        self._wanted, self.question, self._hindrance, self._stuck = False, '', '', ''
        session, self.session = self.session, None
        if session is not None:
            session.close()
        self._answer_captures(False, text)
        self._announcer.end(text)
        if failed:
            self.fail(text)
        else:
            self.say(text)

    def say(self, text: str) -> None:
        """Log what is news."""
        if text != self.said:
            self.get_logger().info(text)
        self.said = text

    def warn(self, text: str) -> None:
        """Log what is refused."""
        if text != self.said:
            self.get_logger().warning(text)
        self.said = text

    def fail(self, text: str) -> None:
        """Log what is wrong."""
        if text != self.said:
            self.get_logger().error(text)
        self.said = text

    def state(self) -> tuple[str, str, bool]:
        """Return the phase, what is waited for in words, and whether somebody should look."""
        if self.question:
            return 'question', self.question, True
        if self.session is None:
            if self._wanted and self._foreign:
                return 'refused', self._foreign, True
            if self._wanted:
                silent = '; is the driver running?' if self._samples.silent() else ''
                return 'info', f'waiting for sensor_info{silent}', True
            return 'idle', self.said or '; '.join(filter(None, (IDLE, self._outlook))), False
        silent = self._samples.silent()
        if silent:
            return 'silent', silent, True
        if self._hindrance:
            return 'refused', self._hindrance, True
        if self._stuck:
            return 'refused', self._stuck, True
        state = self.session.walk.state()
        return state.phase, state.text, state.late

    def _status(self) -> Status:
        phase, text, late = self.state()
        if late:
            self._warn_once(phase, text)
        values: dict[str, str | float] = {'accepted': '0', 'output': str(self.asked.output),
                                          'verdict': '; '.join(self.outcome)}
        if self.session is not None:
            walk = self.session.walk
            number = walk.index + 1 if isinstance(walk, Sweep) else len(walk.accepted) + 1
            values |= {'phase': phase, 'pose': str(number), 'next': walk.where(),
                       'accepted': str(self.session.done)}
            tilt_rad = walk.tilt_error_rad()
            if np.isfinite(tilt_rad):
                values['tilt_error_deg'] = float(np.degrees(tilt_rad))
        serial = self.unit.serial if self.unit else ''
        return Status(Level.WARN if late else Level.OK, text, serial, values)

    def _warn_once(self, phase: str, text: str) -> None:
        """Log what holds the calibration up once a pose and phase, not once a second."""
        walk = self.session.walk if self.session else None
        key = f'{phase} {len(walk.accepted) if walk else ""}'
        if key != self._warned and text != self.said:
            self.get_logger().warning(text)
        self._warned = key

    def newest(self) -> Newest | None:
        """Return the newest samples; None before there is a unit."""
        return self.session.newest if self.session else self._newest

    def close(self) -> None:
        """Let the journal and the terminal go."""
        if self.session is not None:
            self.session.close()
        if self.console is not None:
            self.console.close()


def _stamp_ns(message: JointState | Temperature | BatteryState) -> int:
    return message.header.stamp.sec * 10 ** 9 + message.header.stamp.nanosec


def main() -> int:
    """Run the node."""
    # Through shared memory, Fast DDS does not reach a process again that was killed and started
    # anew (eProsima/Fast-DDS issues 2811, 5053 and 5469): an interrupted sweep could not go on.
    os.environ.setdefault('FASTDDS_BUILTIN_TRANSPORTS', 'UDPv4')
    return run(Calibration, __doc__)
