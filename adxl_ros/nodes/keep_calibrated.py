# SPDX-License-Identifier: Apache-2.0

"""Keep the calibration of a robot at work up to date by its rests, and say how sure it is."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
import math
from pathlib import Path
import time
from typing import Any, NamedTuple

from adxl_ros.calibrate.keep.keeper import by_axis, Keeper, KeepSettings, KEPT, KeptState
from adxl_ros.calibrate.keep.stays import RestStream
from adxl_ros.errors import UserError
from adxl_ros.files import calibration_store, parameter_file
from adxl_ros.files.atomic_write import make_folder
from adxl_ros.files.stream_info import check_same_sensor, NO_SERIAL, StreamInfo
from adxl_ros.files.sweep_journal import Journal, NaturalRest, read
from adxl_ros.model.sensor import get, put, Sensor, to_volts
from adxl_ros.nodes import parameter_checks, parameters, params_files, sensor_parameters, topics
from adxl_ros.nodes.parameters import parameter, sample_unit
from adxl_ros.nodes.run_node import run
from adxl_ros.nodes.topics import Inbox, Level, Status
from adxl_ros.report.quantities import utc
import numpy as np
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.node import Node
from sensor_msgs.msg import Imu
from std_srvs.srv import Trigger

_INPUT_QUEUE = 10000  # Messages that are kept while the node is busy: 10 s at 1 kHz
_TURN_S = 0.2
"""Time between two looks at the topics, s. A look costs as much as ten messages: at 1 kHz a
twentieth of the work. Rests last for seconds, so that nothing is lost by it."""
_STEPS = 20
"""Steps of a ramp. A change of 5 mg has steps of 0.25 mg, below the noise of a sample of an
ADXL203, 0.5 mg."""
_SENT_AGAIN_S = 3600.0
"""Time after which a grown covariance is sent, s. Drift of 1 mg in a year changes it by 10⁻⁴ mg in
this time; a subscriber that starts anew has a latched message."""
_EXAMPLES = {
    'a robot at work': '--ros-args --params-file unit.yaml',
    'only report what would be adopted': '--ros-args --params-file unit.yaml -p dry_run:=true',
}
"""Examples of arguments, by their purpose."""


@dataclass(frozen=True)
class KeepCalibratedSettings:
    """The node that keeps a calibration."""

    samples_unit: str = sample_unit()
    drift_mg_per_year: float = parameter(
        KeepSettings.drift_mg_per_year, 'usual drift of the zero-g in a year', 'mg', 0.01, 1000.0
    )
    dry_run: bool = parameter(False, 'only report; nothing is adopted or sent')
    ramp_s: float = parameter(
        60.0, 'time over which an adopted calibration replaces the one before', 's', 0.0, 3600.0
    )
    compensation: str = parameter(
        'compensation', 'node that gets the calibration and its covariance; empty: none'
    )
    store: str = parameter(
        str(calibration_store.default_folder()),
        'folder of calibrations, which gets each adopted one; empty: none',
    )
    output: str = parameter(
        str(calibration_store.default_folder().with_name('kept')), 'folder of the journal'
    )


class _Receiver:
    """The compensation that gets calibrations, whole and live."""

    def __init__(self, node: Node, name: str, folder: Path, ramp_s: float) -> None:
        self._folder = folder
        self._step_s = ramp_s / _STEPS
        self._client = (
            node.create_client(SetParameters, f'{name}/set_parameters') if name else None
        )
        self._waiting: deque[Sensor] = deque()
        self._due_s = 0.0
        self._number = 0
        self._was_there = False
        self.refusal = ''

    @property
    def is_there(self) -> bool:
        """Return whether the compensation runs."""
        return self._client is not None and self._client.service_is_ready()

    @property
    def ramp(self) -> float:
        """Return the share of the newest change that is in use, 0 to 1."""
        # A single one is the last step, or a calibration that is sent at once.
        steps_left = len(self._waiting) if len(self._waiting) > 1 else 0
        return 1.0 - steps_left / _STEPS

    def change(self, before: Sensor, after: Sensor) -> None:
        """Send a calibration in small steps from the one before."""
        names = after.covariance_names
        begin, end = get(before, names), get(after, names)
        shares = np.linspace(0, 1, _STEPS + 1)[1:]
        self._waiting = deque(put(after, names, begin + share * (end - begin)) for share in shares)

    def send(self, sensor: Sensor) -> None:
        """Send a calibration at once, unless a ramp runs."""
        if not self._waiting:
            self._waiting.append(sensor)

    def has_come(self) -> bool:
        """Return whether the compensation has started since the last call."""
        before = self._was_there
        self._was_there = self.is_there
        return self._was_there and not before

    def turn(self, now_s: float) -> None:
        """Send what is due."""
        client = self._client
        is_due = bool(self._waiting) and now_s >= self._due_s
        if client is None or not (is_due and client.service_is_ready()):
            return
        self._due_s = now_s + self._step_s
        # The one before may still be read.
        self._number = 1 - self._number
        path = self._folder / f'in_use_{self._number}.yaml'
        parameter_file.save(path, self._waiting.popleft())
        value = ParameterValue(
            type=ParameterType.PARAMETER_STRING, string_value=str(path.resolve())
        )
        request = SetParameters.Request(parameters=[Parameter(name='calibration', value=value)])
        future = client.call_async(request)
        future.add_done_callback(lambda done: self._note(done.result()))

    def _note(self, response: SetParameters.Response | None) -> None:
        results = response.results if response else []
        self.refusal = next((each.reason for each in results if not each.successful), '')


class _Keeping(NamedTuple):
    """What keeps one calibration."""

    keeper: Keeper
    stream: RestStream
    journal: Journal
    receiver: _Receiver


class KeepCalibrated(Node):
    """The node: it connects topics and services to the package `calibrate.keep`."""

    def __init__(self) -> None:
        super().__init__('keep_calibrated')
        parameter_checks.check_given(self)
        flat = sensor_parameters.given_sensor(self)
        self._own = own = parameters.declare_all(self, KeepCalibratedSettings)
        self._keeping: _Keeping | None = None  # None before the sensor is known
        self._newest_ns = 0
        self._sent_s = -_SENT_AGAIN_S
        self._obstacle = 'waiting for sensor_info, which names the unit'
        self._samples = Inbox(self, Imu, 'imu/data_raw', _INPUT_QUEUE, own.samples_unit)
        self._surroundings = topics.SurroundingTopics(self, _INPUT_QUEUE)
        given = sensor_parameters.make_sensor(flat, may_measure=True)
        if given.effects:
            self._begin(given)
        topics.subscribe_info(self, self.resolve_topic_name('sensor_info'), self._on_info)
        topics.DiagnosticsReporter(self, 'calibration', self._status)
        self.create_service(Trigger, '~/undo', self._on_undo)
        self.create_timer(_TURN_S, self._turn, clock=topics.STEADY)

    def close(self) -> None:
        """Close the journal."""
        if self._keeping is not None:
            self._keeping.journal.close()

    def _begin(self, sensor: Sensor) -> _Keeping:
        """Keep a calibration, or go on with its journal."""
        own = self._own
        folder = make_folder(
            calibration_store.sensor_folder(Path(own.output).expanduser(), sensor.serial)
        )
        journal, base = self._journal(folder, sensor)
        entries = journal.entries
        keeper = Keeper(
            base,
            KeepSettings(own.drift_mg_per_year),
            entries,
            journal.append,
            may_adopt=not own.dry_run,
        )
        stream = RestStream(base)
        stream.go_on_after(
            max((entry.stay for entry in entries if isinstance(entry, NaturalRest)), default=0)
        )
        name = '' if own.dry_run else own.compensation
        receiver = _Receiver(self, name, folder, own.ramp_s)
        self._keeping = _Keeping(keeper, stream, journal, receiver)
        self._obstacle = ''
        self.get_logger().info(
            f'keeping {calibration_store.calibration_id(base)} up to date, '
            f'{len(entries)} entries in {journal.path}'
        )
        return self._keeping

    def _journal(self, folder: Path, sensor: Sensor) -> tuple[Journal, Sensor]:
        """Open the journal of a calibration; return it, and the calibration that it began with."""
        first = sensor.provenance.get(KEPT)
        name = first or calibration_store.calibration_id(sensor)
        path = folder / f'{calibration_store.file_name(name)}.jsonl'
        head: dict[str, Any] = {'kind': 'kept', 'base': parameter_file.to_flat(sensor)}
        if path.exists() and path.stat().st_size:
            head = read(path).head
            sensor = parameter_file.from_flat(head['base'], params_files.parameter_error)
        elif first:
            self.get_logger().info(f'{path}: is not there; the journal begins anew')
        return Journal(path, head), sensor

    def _on_info(self, info: StreamInfo) -> None:
        try:
            keeping = self._keeping or self._begin(self._stored(info))
            sensor = keeping.keeper.sensor
            check_same_sensor(info, info.axes or sensor.axes, sensor)
            self._obstacle = ''
        except UserError as error:
            self._stop(error)

    def _stop(self, error: UserError) -> None:
        """Use no sample until what is wrong is mended."""
        self._obstacle = str(error)
        self.get_logger().error(self._obstacle)

    def _stored(self, info: StreamInfo) -> Sensor:
        """Return the newest calibration of the unit in the store."""
        own = self._own
        if not own.store or info.serial == NO_SERIAL:
            raise UserError('no calibration is given; start with --params-file unit.yaml')

        def check(sensor: Sensor) -> None:
            check_same_sensor(info, info.axes or sensor.axes, sensor)

        choice = calibration_store.newest(own.store, info.serial, check)
        if choice.path is None:
            raise UserError(
                f'no calibration of {info.serial} in {own.store}; start with --params-file'
            )
        return parameter_file.load(choice.path)

    def _turn(self) -> None:
        """Take what has come."""
        stamps_ns, accel_mps2 = topics.imu_samples(self._samples.take())
        surroundings = [*self._surroundings.take()]
        keeping = self._keeping
        if keeping is None or self._obstacle:
            return
        for topic, times_ns, values in surroundings:
            if topic == 'temperature':
                keeping.stream.add_temperature(times_ns, values[:, 0])
        if len(stamps_ns):
            self._newest_ns = int(stamps_ns[-1])
            sensor = keeping.keeper.sensor
            volts = to_volts(accel_mps2[:, : len(sensor.axes)], sensor)
            for rest in keeping.stream.add(stamps_ns, volts):
                self._take(keeping, rest)
        now_s = time.monotonic()
        if keeping.receiver.has_come() or now_s - self._sent_s > _SENT_AGAIN_S:
            keeping.receiver.send(keeping.keeper.sensor)
            self._sent_s = now_s
        keeping.receiver.turn(now_s)

    def _take(self, keeping: _Keeping, rest: NaturalRest) -> None:
        """Take a rest, and adopt what it decides."""
        keeper = keeping.keeper
        before = keeper.sensor
        try:
            adopted = keeper.add(rest)
        except UserError as error:
            self._stop(error)
            return
        if adopted is not None:
            stored = self._exchange(keeping, before, keeper.sensor)
            state = keeper.state(rest.stop_ns)
            self.get_logger().info(
                f'adopted: {by_axis(keeper.sensor.axes, state.total_mg)} since the calibration; '
                f'{stored}'
            )

    def _exchange(self, keeping: _Keeping, before: Sensor, after: Sensor) -> str:
        """Store a calibration and send it in a ramp; return where it is."""
        keeping.receiver.change(before, after)
        self._sent_s = time.monotonic()
        path = calibration_store.put(self._own.store, after) if self._own.store else None
        return f'stored as {path}' if path else 'not stored'

    def _on_undo(self, *_: object) -> Trigger.Response:
        try:
            text = self._undo()
        except UserError as error:
            return Trigger.Response(message=str(error))
        self.get_logger().info(text)
        return Trigger.Response(success=True, message=text)

    def _undo(self) -> str:
        """Go back to the calibration before; return a line for people."""
        keeping = self._keeping
        if keeping is None:
            raise UserError(self._obstacle)
        keeper = keeping.keeper
        before = keeper.sensor
        now_ns = self.get_clock().now().nanoseconds
        keeper.undo(self._newest_ns or now_ns)
        date = utc(now_ns).isoformat(timespec='seconds')
        kept_from = before.provenance.get(KEPT, '')
        provenance = {**keeper.sensor.provenance, 'date': date, KEPT: kept_from}
        provenance.pop('id', None)
        after = replace(keeper.sensor, provenance=provenance)
        stored = self._exchange(keeping, before, after)
        return f'undone: the calibration before is in use again, {stored}'

    def _status(self) -> Status:
        """Return what is known now."""
        silence = self._obstacle or self._samples.silence()
        if self._keeping is None:
            return Status(Level.WARN, silence, NO_SERIAL, {})
        keeper = self._keeping.keeper
        stream = self._keeping.stream
        receiver = self._keeping.receiver
        serial = keeper.sensor.serial
        state = keeper.state(self._newest_ns or self.get_clock().now().nanoseconds)
        values = _values(keeper.sensor, state)
        values |= {
            **stream.counts,
            'dry_run': self._own.dry_run,
            'ramp': receiver.ramp,
            'compensation': 'runs' if receiver.is_there else 'not there',
        }
        fault = self._samples.fault() or receiver.refusal or state.changed
        has_no_temperature = stream.counts['without_temperature'] and not stream.counts['rests']
        if fault:
            return Status(Level.ERROR, fault, serial, values)
        if not silence and has_no_temperature:
            silence = (
                f'nothing on {self.resolve_topic_name("temperature")}, which tells age from '
                'temperature: no rest is used'
            )
        if silence:
            return Status(Level.WARN, silence, serial, values)
        text = f'kept: acceleration within {state.error_90_mg:.2g} mg (90 %)'
        if math.isfinite(state.tilt_90_deg):
            text += f', tilt within {state.tilt_90_deg:.2g}°'
        if receiver.ramp < 1:
            text += f'; a new calibration comes into use, {receiver.ramp:.0%}'
        if state.proposal and self._own.dry_run:
            text = f'dry run, would adopt: {state.proposal}'
        return Status(Level.OK, text, serial, values)


def _values(sensor: Sensor, state: KeptState) -> dict[str, object]:
    """Return what diagnostics report."""
    values: dict[str, object] = {
        'age_days': round(state.age_days, 3) if math.isfinite(state.age_days) else '',
        'temperature_c': round(state.temperature_c, 2),
        'error_90_mg': state.error_90_mg,
        'tilt_90_deg': state.tilt_90_deg if math.isfinite(state.tilt_90_deg) else '',
        'determined': '; '.join(state.determined),
        'held_out_stays': state.held_out,
        'adopted': utc(state.adopted_ns).isoformat(timespec='seconds') if state.adopted_ns else '',
        'changed': state.changed,
        'proposal': state.proposal,
    }
    for place, axis in enumerate(sensor.axes):
        values[f'zero_g_{axis}_mg'] = state.total_mg[place]
        values[f'zero_g_{axis}_90_mg'] = state.zero_g_90_mg[place]
    for side, count in state.rests_a_day.items():
        values[f'rests_a_day_{side}'] = count
    return values


def main() -> int:
    """Run the node."""
    return run(KeepCalibrated, __doc__, _EXAMPLES)
