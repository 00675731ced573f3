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

"""Republish a stream corrected by its parameter file: acceleration, orientation, tilt."""

from __future__ import annotations

from collections import Counter
from datetime import datetime, timezone
from math import cos, isfinite, sin
from pathlib import Path
from typing import Any, NamedTuple

from adxl_ros.compensate import filter_inversion
from adxl_ros.compensate.sample_by_sample import Estimate, LiveEstimator
from adxl_ros.errors import UserError
from adxl_ros.files import calibration_store, imu_message
from adxl_ros.files.cdr import CdrError
from adxl_ros.files.stream_info import NO_UNIT, StreamInfo
from adxl_ros.files.stream_unit import check_unit
from adxl_ros.model import noise
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import NOMINAL_ENVIRONMENT
from adxl_ros.model.sensor import Sensor
from adxl_ros.model.tilt import UNOBSERVABLE_RAD2
from adxl_ros.nodes.support.diagnostics import DiagnosticsReporter, Level, Status
from adxl_ros.nodes.support.exchangeable_sensor import ExchangeableSensor
from adxl_ros.nodes.support.parameters import declare
from adxl_ros.nodes.support.receive_thread import ReceiveTurn, RepeatingThread
from adxl_ros.nodes.support.run_node import run
from adxl_ros.nodes.support.topics import create_publisher, create_subscription
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import Vector3Stamped
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.parameter import Parameter
from sensor_msgs.msg import BatteryState, Imu, Temperature

_DEPTH = 100
"""Samples kept while the node is busy: 0.1 s at 1 kHz."""

_UNKNOWN_RAD2 = 1e6
"""Variance of an angle that is not known, yaw always among them.

π²/3, that of a uniform angle, would let a filter that fuses 1000 samples a second believe in
yaw = 0 before long; 1e6, as for an axis that is not there, never counts."""


_OLD_S = 60.0
"""A temperature or supply that was said so long ago is not known any more."""

_CLOCK_DAYS = 0.01
"""Clocks that differ by a quarter of an hour make no calibration one of the future."""


class _Chain(NamedTuple):
    """What corrects a sample; replaced as one."""

    live: LiveEstimator
    delayed: filter_inversion.DelayedInversion


class Compensation(Node):
    """The node; what it makes of a sample is in `compensate.sample_by_sample`, ROS-free."""

    def __init__(self) -> None:
        super().__init__('compensation')
        self._info: dict[str, str] | None = None
        self._refusal = ''
        self._counts: Counter[str] = Counter()
        self._reported: Counter[str] = Counter()
        self._angles = [0.0, 0.0, 0.0]
        self._outside: tuple[str, ...] = ()
        # The file that was taken from the store, and what was said of the store.
        self._picked: str | None = None
        self._said_of_store = ''
        # Surroundings to be taken up, and those that are.
        self._around: dict[str, float] = {}
        self._known: dict[str, float] = {}
        self._heard_ns: dict[str, int] = {}
        self._paper = declare(
            self, 'inverse', 'exact', "of the model: exact, or the paper's approximation",
            choices=('exact', 'paper')) == 'paper'
        self._undo_filter = declare(
            self, 'undo_filter', False, 'take the RC filter out, amplitude and phase; a sample '
            f'is published {filter_inversion.HALF} samples late, with its own stamp')
        self._store = declare(
            self, 'store', str(calibration_store.default_folder()),
            'folder of calibrations, of which the newest of the unit is taken where none is '
            'named; empty: none')
        ExchangeableSensor(self, self._check_unit, self._use)
        self._data = create_publisher(self, Imu, 'imu/data', _DEPTH)
        self._tilt = create_publisher(self, Vector3Stamped, 'tilt', _DEPTH)
        create_subscription(self, DiagnosticStatus, 'sensor_info', self._on_info, 1,
                                  latched=True)
        create_subscription(self, Temperature, 'temperature', self._on_temperature, 1)
        create_subscription(self, BatteryState, 'supply', self._on_supply, 1)
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._reported_ns = self._steady.now().nanoseconds
        self._diagnostics = DiagnosticsReporter(self, {'compensation': self._status})
        self._loop = RepeatingThread(
            self, ReceiveTurn(self, Imu, 'imu/data_raw', self._on_sample, _DEPTH), 'imu/data_raw')

    def close(self) -> None:
        """End the thread that receives."""
        self._loop.close()

    def _use(self, sensor: Sensor, source: str) -> None:
        live = LiveEstimator(sensor, self._paper, self._undo_filter)
        live.set_environment(**self._known)
        self._source = source
        self._chain = _Chain(live, self._new_delayed(sensor))
        of = f'{sensor.serial}, model {sensor.model}' if sensor.effects else \
            f'{sensor.serial}, which is not calibrated'
        self.get_logger().info(f'compensating by {source}: {of}')
        self._judge()

    @property
    def _sensor(self) -> Sensor:
        return self._chain.live.sensor

    def _new_delayed(self, sensor: Sensor) -> filter_inversion.DelayedInversion:
        return filter_inversion.DelayedInversion(noise.electronics(sensor).rc_s,
                                                 self._rate_hz(sensor))

    def _rate_hz(self, sensor: Sensor) -> float:
        """Return the rate that the stream states, else that of the calibration."""
        try:
            return StreamInfo(self._info or {}, '').rate_hz or sensor.rate_hz
        except UserError:
            # Nothing is published then; see `_check_unit`.
            return sensor.rate_hz

    def _check_unit(self, sensor: Sensor) -> None:
        if self._paper and sensor.axes == 'x':
            raise UserError("inverse: the paper's needs the axes x and y, the sensor has x")
        if self._info is not None:
            info = StreamInfo(self._info, self.resolve_topic_name('sensor_info'))
            check_unit(info, info.axes or sensor.axes, sensor)
            _ = info.rate_hz  # refuses what is no rate

    def _on_info(self, message: DiagnosticStatus) -> None:
        self._info = {pair.key: pair.value for pair in message.values}
        self._pick()
        self._chain = self._chain._replace(delayed=self._new_delayed(self._sensor))
        self._judge()

    def _named(self) -> bool:
        """Tell whether a calibration was named, in place of the store's newest."""
        path = self.get_parameter('calibration').value
        return path != self._picked if path else bool(self._sensor.effects)

    def _pick(self) -> None:
        """Take the newest calibration of the stream's unit, unless one was named."""
        serial = (self._info or {}).get('serial', NO_UNIT)
        if not self._store or serial == NO_UNIT or self._named():
            return
        path, refused = calibration_store.newest(self._store, serial, self._check_unit)
        for why in refused:
            self._say_of_store(f'passed over: {why}')
        if path is None:
            self._say_of_store(f'no calibration of {serial} in {self._store}')
        elif str(path) != self._picked:
            before, self._picked = self._picked, str(path)
            result = self.set_parameters([Parameter('calibration', value=str(path))])[0]
            if not result.successful:
                self._picked = before
                self._say_of_store(f'not taken: {result.reason}')

    def _say_of_store(self, text: str) -> None:
        if text not in self._said_of_store:
            self.get_logger().warning(text)
            self._said_of_store += f'{text}\n'

    def _newer(self) -> Path | None:
        """Return a calibration of the unit that was put into the store after the active one."""
        sensor = self._sensor
        if not self._store or not sensor.effects or sensor.serial == NO_UNIT:
            return None
        return calibration_store.newer(self._store, sensor)

    def _on_temperature(self, message: Temperature) -> None:
        self._surround('temperature_c', message.temperature)

    def _on_supply(self, message: BatteryState) -> None:
        self._surround('supply_v', message.voltage)

    def _surround(self, name: str, value: float) -> None:
        # The receiving thread takes it up with its next sample.
        if isfinite(value):
            self._around[name] = value
            self._heard_ns[name] = self.get_clock().now().nanoseconds

    def _age_s(self, name: str) -> float:
        """Return how long ago it was said, by the clock of the graph."""
        return (self.get_clock().now().nanoseconds - self._heard_ns.get(name, 0)) * 1e-9

    def _judge(self) -> None:
        """Find out whether the parameters are those of the stream, and say so on a change."""
        before, self._refusal = self._refusal, ''
        try:
            self._check_unit(self._sensor)
        except UserError as error:
            self._refusal = str(error)
        if self._refusal and self._refusal != before:
            self.get_logger().error(f'publishing nothing: {self._refusal}')
        elif before and not self._refusal:
            self.get_logger().info('publishing again: the parameters are those of the stream')

    def _on_sample(self, raw: bytes) -> None:
        """Take one serialized Imu; in the receiving thread."""
        self._counts['received'] += 1
        if self._refusal:
            return
        try:
            time_s, accel = imu_message.read(raw)
        except CdrError:
            self._counts['dropped'] += 1
            return
        # One reading: a sample has the old coefficients or the new ones.
        chain = self._chain
        if self._around:
            around, self._around = self._around, {}
            chain.live.set_environment(**around)
            self._known |= around
        volts = chain.live.volts(accel)
        if not volts:
            self._counts['dropped'] += 1
        elif self._undo_filter:
            for ready in chain.delayed(time_s, volts, raw):
                self._estimate(chain.live, *ready)
        else:
            self._estimate(chain.live, time_s, volts, raw)

    def _estimate(self, live: LiveEstimator, time_s: float, volts: list[float], raw: bytes
                  ) -> None:
        estimate = live.from_volts(volts, time_s)
        if estimate is None:
            self._counts['dropped'] += 1
            return
        self._counts['saturated'] += estimate.saturated
        if estimate.outside:
            self._counts['outside'] += 1
            self._outside = estimate.outside
        orientation = self._orientation(estimate)
        xx, xy, xz, yy, yz, zz = estimate.covariance
        self._data.publish(imu_message.corrected(
            raw, orientation, (*estimate.force, xx, xy, xz, xy, yy, yz, xz, yz, zz)))
        self._tilt.publish(imu_message.vector3_stamped(raw, self._angles))
        self._counts['published'] += 1

    def _orientation(self, estimate: Estimate) -> tuple[float, ...]:
        """Turn the angles, where not shown the last ones, to a quaternion with yaw 0."""
        variances = []
        for i, (angle, variance) in enumerate((estimate.roll, estimate.pitch,
                                               estimate.inclination)):
            shown = variance < UNOBSERVABLE_RAD2
            if shown:
                self._angles[i] = angle
            variances.append(variance if shown else _UNKNOWN_RAD2)
        roll, pitch, _ = variances
        both = estimate.roll_pitch if max(roll, pitch) < _UNKNOWN_RAD2 else 0.0
        half_roll, half_pitch = self._angles[0] / 2, self._angles[1] / 2
        sr, cr, sp, cp = sin(half_roll), cos(half_roll), sin(half_pitch), cos(half_pitch)
        return (sr * cp, cr * sp, -sr * sp, cr * cp,
                roll, both, 0.0, both, pitch, 0.0, 0.0, 0.0, _UNKNOWN_RAD2)

    def _status(self) -> Status:
        now_ns = self._steady.now().nanoseconds
        passed_s, self._reported_ns = (now_ns - self._reported_ns) * 1e-9, now_ns
        counts = self._counts.copy()
        new = {name: counts[name] - self._reported[name] for name in counts}
        self._reported = counts
        sensor = self._sensor
        newer = self._newer()
        level, text = self._state(new, newer)
        unit = 'other' if self._refusal else 'confirmed' if self._info else 'not confirmed'
        values: dict[str, Any] = {
            'rate_in_hz': round(new.get('received', 0) / passed_s, 1),
            'rate_out_hz': round(new.get('published', 0) / passed_s, 1),
            **{name: counts[name] for name in ('received', 'published', 'dropped', 'saturated',
                                               'outside')},
            'delay_s': filter_inversion.HALF / self._rate_hz(sensor) if self._undo_filter else 0.0,
            'unit': unit, 'calibration': self._source, 'serial': sensor.serial,
            'axes': sensor.axes, 'model': sensor.model, 'effects': ', '.join(sensor.effects),
            **self._calibration(new), 'newer': str(newer or ''),
            **{f'provenance.{key}': value for key, value in sensor.provenance.items()}}
        return Status(level, text, sensor.serial, values)

    def _calibration(self, new: dict[str, int]) -> dict[str, Any]:
        """Say which calibration is active, how old it is and whether it holds here."""
        sensor = self._sensor
        if not sensor.effects:
            return {'calibration_id': '', 'age_days': '', 'validity': 'not calibrated'}
        made = calibration_store.date_of(sensor)
        days = (datetime.now(timezone.utc) - made).total_seconds() / 86400 if made else None
        if self._refusal:
            valid = f'of another unit: {self._refusal}'
        elif new.get('outside'):
            valid = f'outside: {"; ".join(self._outside)}'
        elif days is not None and days < -_CLOCK_DAYS:
            valid = 'dated in the future: the clock here, or there, is wrong'
        elif not sensor.covariance_names:
            valid = 'within, as far as is known: it states no covariance'
        elif sensor.envelope.temperature_c is None or 'temperature_c' not in self._known \
                or self._age_s('temperature_c') > _OLD_S:
            valid = 'valid, temperature not known'
        else:
            valid = 'valid'
        return {'calibration_id': calibration_store.calibration_id(sensor),
                'age_days': '' if days is None else round(days, 3), 'validity': valid}

    def _state(self, new: dict[str, int], newer: Path | None) -> tuple[Level, str]:
        if self._refusal:
            return Level.ERROR, f'publishing nothing: {self._refusal}'
        if not new.get('received'):
            return Level.WARN, f'no samples on {self.resolve_topic_name("imu/data_raw")}'
        for name, what in (('dropped', 'samples dropped that no force explains'),
                           ('saturated', 'samples with the ADC at its rail')):
            if new.get(name):
                return Level.WARN, f'{new[name]} {what}'
        if self._info is None:
            return Level.WARN, (f'unit not confirmed: nothing on '
                                       f'{self.resolve_topic_name("sensor_info")}')
        lacks = self._lacks()
        if lacks:
            return Level.WARN, lacks
        if not self._sensor.effects:
            return Level.WARN, 'not calibrated: the nominal figures apply'
        if new.get('outside'):
            return Level.WARN, (
                f'{new["outside"]} samples outside of what was calibrated, their covariance '
                f'raised: {"; ".join(self._outside)}')
        if newer is not None and not self._named():
            return Level.WARN, (
                f'a newer calibration is in the store: {newer}; set calibration to it, or start '
                'again')
        return Level.OK, 'compensating'

    def _lacks(self) -> str:
        """Name what the calibration follows and nobody says."""
        topics = {'temperature_c': 'temperature', 'supply_v': 'supply'}
        for effect in map(effect_named, self._sensor.effects):
            for name in effect.follows:
                if name not in topics:
                    continue
                topic = self.resolve_topic_name(topics[name])
                if name not in self._known:
                    return (f'{effect.name} is taken at {getattr(NOMINAL_ENVIRONMENT, name):g}: '
                            f'nothing on {topic}')
                if self._age_s(name) > _OLD_S:
                    return (f'{effect.name} is taken at {self._known[name]:g}: nothing on '
                            f'{topic} for {self._age_s(name):.0f} s')
        return ''


def main() -> int:
    """Run the node."""
    return run(Compensation, __doc__)
