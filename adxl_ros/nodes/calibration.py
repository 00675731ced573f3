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

import os
from pathlib import Path
from typing import Any

from adxl_ros.calibrate import plan, recorded, result
from adxl_ros.calibrate.poses import Poses
from adxl_ros.calibrate.sweep import Settings, STAGE_MODES, Sweep
from adxl_ros.calibrate.tumble import Tumble
from adxl_ros.errors import UserError
from adxl_ros.files import cdr, store
from adxl_ros.files.journal import accepted_poses, Journal
from adxl_ros.model.sensor import Sensor, to_volts
from adxl_ros.nodes import common
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
import numpy as np
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.task import Future
from sensor_msgs.msg import Imu, JointState
from std_srvs.srv import Trigger

_POLL_S = 0.05
_REPEAT_COMMAND_S = 0.5
_SILENT_S = 3.0
_QUEUE = 20000


class Calibration(Node):
    """The node; what it does with samples is in `calibrate`, ROS-free."""

    def __init__(self) -> None:
        super().__init__('calibration')
        self.base = common.make_sensor(common.declare_sensor(self))
        self._declare()
        self.unit: Sensor | None = None
        self.walk: Sweep | Tumble | None = None
        self.journal: Journal | None = None
        self.outcome = ''
        self._wanted = self.autostart
        self._raw: list[bytes] = []
        self._accepted: list[dict[str, Any]] = []
        self._captures: list[Future] = []
        self._said = ''
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._heard_ns = self._commanded_ns = self._steady.now().nanoseconds
        self._connect()

    def _declare(self) -> None:
        degrees = np.radians
        declare = common.declare
        self.mode = declare(self, 'mode', 'stage', 'what the reference is',
                            choices=('stage', 'gravity'))
        self.autostart = declare(self, 'autostart', False, 'start without a call of ~/start')
        self.output = Path(declare(self, 'output', 'calibration.yaml', 'parameter file to write'))
        self.journal_path = declare(self, 'journal', '',
                                    'file of accepted poses; empty: beside the output')
        self.report = declare(self, 'report', '', 'directory for the report; empty: none')
        self.store = declare(self, 'store', str(store.default_folder()),
                             'folder of calibrations that gets a copy; empty: none')
        self.planes = declare(self, 'sweep.planes_rad',
                              [float(degrees(a)) for a in (30, 60, 90, 120, 150)],
                              'planes alpha of the sweep, rad')
        self.step = declare(self, 'sweep.step_rad', float(degrees(30)), 'step of beta', 'rad',
                            0.005, 1.6)
        self.dwell = declare(self, 'sweep.dwell_s', 5.0, 'time at rest a pose', 's', 0.5, 3600.0)
        self.checks = declare(self, 'sweep.check_poses', 16,
                              'poses kept out of the fit for the verdict', '', 0, 1000)
        self.settings = Settings(
            self.dwell,
            declare(self, 'stage.tolerance_rad', float(degrees(0.2)),
                    'arrived within this', 'rad', 1e-6, 0.2),
            declare(self, 'stage.timeout_s', 60.0, 'a pose that takes longer is said to be late',
                    's', 1.0, 86400.0),
            declare(self, 'stage.mode', 'commanded', 'who turns the stage', choices=STAGE_MODES))

    def _connect(self) -> None:
        self._command = common.publisher(self, JointState, 'stage/command', 1)
        self._diagnostics = common.publisher(self, DiagnosticArray, '/diagnostics', 10)
        common.subscription(self, DiagnosticStatus, 'sensor_info', self._on_info, 1, latched=True)
        common.subscription(self, Imu, 'imu/data_raw', self._raw.append, _QUEUE, raw=True)
        common.subscription(self, JointState, 'stage/joint_states', self._on_stage, 1000)
        for name in ('start', 'redo', 'finish', 'abort'):
            self.create_service(Trigger, f'~/{name}', getattr(self, f'_on_{name}'))
        # It answers when the pose is on disk: samples must go on coming meanwhile.
        self.create_service(Trigger, '~/capture', self._on_capture,
                            callback_group=ReentrantCallbackGroup())
        self.create_timer(_POLL_S, self._poll, clock=self._steady)
        self.create_timer(1.0, self._report_state, clock=self._steady)

    def _on_info(self, message: DiagnosticStatus) -> None:
        info = {pair.key: pair.value for pair in message.values}
        try:
            unit = recorded.unit_of(self.base, info, 'sensor_info')
        except UserError as error:
            self._fail(f'{error}')
            return
        if self.walk is not None and unit.serial != self.unit.serial:
            self._stop(f'sensor_info: the unit changed from {self.unit.serial} to '
                       f'{unit.serial} during the calibration; start again')
        self.unit = unit

    def _on_stage(self, message: JointState) -> None:
        angles = dict(zip(message.name, message.position))
        pair = angles.get('alpha'), angles.get('beta')
        if isinstance(self.walk, Sweep) and None not in pair and np.isfinite(pair).all():
            stamp = message.header.stamp
            self.walk.stage(stamp.sec * 10 ** 9 + stamp.nanosec, *pair)

    def _on_start(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self.walk is not None:
            return _answer(response, False, 'a calibration is running; finish or abort it first')
        self._wanted = True
        self._try_to_start()
        if self.walk is None and self._wanted:
            return _answer(response, True, 'starts when sensor_info arrives')
        return _answer(response, self.walk is not None, self._said)

    async def _on_capture(self, _: Trigger.Request,
                          response: Trigger.Response) -> Trigger.Response:
        if not isinstance(self.walk, Sweep) or self.settings.stage_mode == 'commanded':
            return _answer(response, False, 'nothing to capture: no sweep is running whose stage '
                                            'is turned by an operator')
        self.walk.capture()
        future = Future()
        self._captures.append(future)
        return _answer(response, *await future)

    def _on_redo(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if not isinstance(self.walk, Sweep) or not self.walk.index:
            return _answer(response, False, 'no pose to take again')
        self.walk.move(self.walk.index - 1)
        return _answer(response, True, f'pose {self.walk.index + 1} will be taken again')

    def _on_finish(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self.walk is None:
            return _answer(response, False, 'no calibration is running')
        self._take_samples()
        return _answer(response, self._finish(), self._said)

    def _on_abort(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        if self.walk is None and not self._wanted:
            return _answer(response, False, 'no calibration is running')
        kept = f'; its poses stay in {self.journal.path}' if self.journal else ''
        self._stop(f'aborted{kept}')
        return _answer(response, True, self._said)

    def _try_to_start(self) -> None:
        if self.unit is None:
            return
        self._wanted = False
        try:
            self._start(self.unit)
        except UserError as error:
            self._stop(f'{error}')

    def _start(self, unit: Sensor) -> None:
        if not os.access(self.output.parent, os.W_OK):
            raise UserError(f'output: {self.output}: {self.output.parent} is not a directory '
                            'that can be written; choose another')
        targets = plan.sweep(self.planes, self.step, self.checks) if self.mode == 'stage' else []
        head = {'mode': self.mode, 'serial': unit.serial, 'axes': unit.axes,
                'rate_hz': unit.rate_hz, 'nominal_zero_g_v': unit.nominal_zero_g_v.tolist(),
                'nominal_scale_v_per_g': unit.nominal_scale_v_per_g.tolist(),
                'dwell_s': self.dwell, 'stage_mode': self.settings.stage_mode,
                'targets_rad': [[t.alpha_rad, t.beta_rad] for t in targets]}
        self.journal = Journal(self.journal_path or f'{self.output}.journal', head)
        self._accepted = accepted_poses(self.journal.entries)
        done = len(self._accepted)
        self.walk = Sweep(unit, targets, done, self.settings) if self.mode == 'stage' \
            else Tumble(unit, done)
        self._raw.clear()
        self.outcome = ''
        resumed = f', resumed after {done} poses' if done else ''
        self._say(f'calibrating {unit.serial}: ' + (
            f'{len(targets)} poses{resumed}' if targets else
            f'rest in 24 or more directions, then call ~/finish{resumed}'))

    def _poll(self) -> None:
        if self.walk is None:
            self._raw.clear()
            if self._wanted:
                self._try_to_start()
            return
        self._take_samples()
        try:
            while self.walk is not None and (entry := self.walk.accept()) is not None:
                self._take(entry)
        except UserError as error:
            self._fail(f'{error}')
        if isinstance(self.walk, Sweep):
            if self.walk.target is None:
                self._finish()
            else:
                self._repeat_command()

    def _take_samples(self) -> None:
        if not self._raw:
            return
        batch = self._raw[:]
        self._raw.clear()
        self._heard_ns = self._steady.now().nanoseconds
        stamps, accel = _decoded(batch)
        accel = accel[:, :len(self.unit.axes)]
        finite = np.isfinite(accel).all(axis=1)
        self.walk.feed(stamps[finite], to_volts(accel[finite], self.unit))

    def _take(self, entry: dict[str, Any]) -> None:
        self.journal.append(entry)
        self._accepted = [*self._accepted[:entry['pose']], entry,
                          *self._accepted[entry['pose'] + 1:]]
        self.walk.move(entry['pose'] + 1)
        text = f'pose {entry["pose"] + 1} is on disk'
        self.get_logger().info(text)
        for future in self._captures:
            future.set_result((True, text))
        self._captures.clear()
        self._commanded_ns = 0

    def _repeat_command(self) -> None:
        now = self._steady.now().nanoseconds
        if self.settings.stage_mode != 'commanded' or \
                now - self._commanded_ns < _REPEAT_COMMAND_S * 1e9:
            return
        self._commanded_ns = now
        command = JointState(name=['alpha', 'beta'], position=[self.walk.target.alpha_rad,
                                                               self.walk.target.beta_rad])
        command.header.stamp = self.get_clock().now().to_msg()
        self._command.publish(command)

    def _finish(self) -> bool:
        entries = self.walk.results(self._accepted)
        try:
            if not entries:
                raise UserError('no pose is taken yet')
            found = self._fit(entries)
            found.save(self.output)
            self.journal.append({'rests': entries, 'done': True})
        except (UserError, OSError) as error:
            # What was taken stays, so that more poses or another directory can save it.
            self._fail(f'cannot finish: {error}')
            if isinstance(self.walk, Sweep) and self.walk.target is None:
                self._stop(self._said)
            return False
        self.get_logger().info(found.keep(self.store))
        self._leave_report(found)
        for line in found.comments():
            self.get_logger().info(line)
        self.outcome = '; '.join(found.verdict)
        self._stop(f'wrote {self.output}')
        return True

    def _leave_report(self, found: result.Result) -> None:
        """Write the report; without it the calibration stands all the same."""
        if not self.report:
            return
        try:
            Path(self.report).mkdir(parents=True, exist_ok=True)
            found.report(self.report, self.store)
        except (UserError, OSError) as error:
            self._fail(f'no report: {error}')

    def _fit(self, entries: list[dict[str, Any]]) -> result.Result:
        poses = Poses.from_entries(entries)
        source = Path(self.journal.path).name
        return result.calibrate(self.unit, [poses], None, [source])

    def _stop(self, text: str) -> None:
        self.walk, self._wanted = None, False
        if self.journal is not None:
            self.journal.close()
            self.journal = None
        for future in self._captures:
            future.set_result((False, text))
        self._captures.clear()
        self._say(text)

    def _say(self, text: str) -> None:
        if text != self._said:
            self.get_logger().info(text)
        self._said = text

    def _fail(self, text: str) -> None:
        if text != self._said:
            self.get_logger().error(text)
        self._said = text

    def _report_state(self) -> None:
        level, text, values = common.OK, self._said or 'idle; call ~/start', {}
        if self.walk is not None:
            state = self.walk.state()
            silent_s = (self._steady.now().nanoseconds - self._heard_ns) * 1e-9
            text = state.text
            if silent_s > _SILENT_S:
                text = f'nothing on {self.resolve_topic_name("imu/data_raw")} for {silent_s:.0f} s'
            if state.late or silent_s > _SILENT_S:
                level = common.WARN
                self._warn(state.phase, text)
            values = {'phase': state.phase, 'pose': str(self.walk.index + 1)}
        elif self._wanted:
            level, text = common.WARN, 'waiting for sensor_info'
            self._warn('info', text)
        values |= {'accepted': str(len(self._accepted)), 'output': str(self.output),
                   'verdict': self.outcome}
        serial = self.unit.serial if self.unit else ''
        self._diagnostics.publish(common.diagnostics(
            self, common.status(level, 'calibration', text, serial, values)))

    def _warn(self, phase: str, text: str) -> None:
        """Log what holds the calibration up once a pose and phase, not once a second."""
        key = f'{phase} {self.walk.index if self.walk else ""}'
        if key != self._warned:
            self.get_logger().warning(text)
        self._warned = key

    _warned = ''

    def close(self) -> None:
        """Let the journal go."""
        if self.journal is not None:
            self.journal.close()


def _decoded(batch: list[bytes]) -> tuple[np.ndarray, np.ndarray]:
    """Read stamps, ns, (n,), and linear acceleration, m/s², (n, 3), of serialized messages."""
    stamps, accel = np.empty(len(batch), np.int64), np.empty((len(batch), 3))
    for table in cdr.tables(batch, cdr.imu):
        stamps[table.rows] = table.stamp_ns()
        accel[table.rows] = table.numbers('linear_acceleration')
    return stamps, accel


def _answer(response: Trigger.Response, success: bool, message: str) -> Trigger.Response:
    response.success, response.message = success, message
    return response


def main() -> int:
    """Run the node."""
    return common.main(Calibration, __doc__)
