# SPDX-License-Identifier: Apache-2.0

"""A realistic sensor in another simulator: the signal chain on its ideal Imu stream."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import ceil, inf
import time
from typing import NamedTuple

from adxl_ros.files.recording_columns import is_even, stamped_rate_hz
from adxl_ros.links.support.base import (
    Event,
    Level,
    LinkStatus,
    no_samples,
    option,
    Samples,
    SimulatorSettings,
)
from adxl_ros.model.constants import NOMINAL_TEMPERATURE_C
from adxl_ros.model.sensor import Sensor
from adxl_ros.simulate.motion import lagrange_weights, Motion, POINTS
from adxl_ros.simulate.response import Response
from adxl_ros.simulate.sensor_model import SensorModel
import numpy as np
import scipy

_SILENT_S = 3.0
"""Steady time without samples after which the stream counts as silent, s; chosen: as for the
samples of the calibration node."""
_FIRST = 50
"""Samples with even stamps that determine the rate, before the first one is published; chosen:
0.25 s at 200 Hz."""
_FIRST_UNEVEN = 400
"""Samples with uneven stamps that do; chosen: a jitter of a whole period leaves 2 %."""
_FIRST_NS = 1_000_000_000
"""Simulated time after which fewer samples determine the rate, ns; chosen: for slow simulators."""
_MIN_FIRST = 5
"""Fewest samples that determine a rate; chosen: four differences survive one lost sample."""
_BLOCK = 100
"""Samples after which the rate is measured again; chosen."""
_RATE_TOLERANCE = 0.03
"""Largest relative change of the rate that is no change, beside the part of a block that a long
step is; chosen: far above the error of a rate."""
_STEP_SCATTER = 0.45
"""Largest departure of 99 % of the steps from whole periods, periods, where longer steps show lost
samples; chosen: from half a period on, jitter looks like loss."""
_MAX_FILLED_NS = 1_000_000_000
"""Longest gap of the stream through which the chain runs on, ns. Chosen: filter and resonance
forget the past within it."""
_ON_SAMPLE = 1e-4
"""Distance of a time from a sample, in samples, that is rounding; chosen: far above that of
floats."""
_LATE_PERIODS = 10
"""Periods by which a sample may be late; chosen: an older stamp is a simulation that was reset."""

_NOT_MEASURED = np.array([-1.0, *[0.0] * 8])
"""Covariance that says that there is no value (sensor_msgs/Imu)."""
_ABSENT = {'orientation': np.array([0.0, 0.0, 0.0, 1.0]), 'angular_velocity': np.zeros(3)}
"""Values in place of those that are no numbers."""


@dataclass(frozen=True)
class Settings(SimulatorSettings):
    """Settings of the link."""

    # Topic of the ideal samples
    topic: str = option('imu/ideal', 'topic of the ideal sensor_msgs/Imu of a simulator: specific '
                        'force')
    # Topic of the temperature of the sensor
    temperature_topic: str = option('temperature', 'topic of the temperature of the sensor, '
                                    'sensor_msgs/Temperature; 25 °C until it comes')
    seed: int = option(0, 'seed of the noise', '', 0, 2 ** 31 - 1)  # Seed of the noise
    # roll_rad, pitch_rad, yaw_rad: Orientation of the case in the frame of the ideal samples, rad
    roll_rad: float = option(0.0, 'roll of the case in the frame of the ideal samples', 'rad',
                             -7.0, 7.0)
    pitch_rad: float = option(0.0, 'pitch of the case in that frame', 'rad', -7.0, 7.0)
    yaw_rad: float = option(0.0, 'yaw of the case in that frame', 'rad', -7.0, 7.0)

    @property
    def turns_case(self) -> bool:
        """Return whether the frame of the case is not that of the simulator's samples."""
        return any((self.roll_rad, self.pitch_rad, self.yaw_rad))


@dataclass(frozen=True)
class _Statistics:
    """Counts of the link."""

    resets: int = 0  # How often simulated time has jumped backwards
    rate_changes: int = 0  # How often the rate of the stream has changed
    gaps: int = 0  # Gaps of more than a second
    late: int = 0  # Samples that came twice or late, and were not published
    not_finite: int = 0  # Samples whose force was no number


class _Ideal(NamedTuple):
    """One sample of the simulator: stamp, ns, and the fields of its message in the case frame."""

    stamp_ns: int
    fields: dict[str, np.ndarray]

    @property
    def force(self) -> np.ndarray:
        """Return the specific force, m/s², (3,)."""
        return self.fields['linear_acceleration']


class _Chain:
    """The signal chain at the rate of the samples, as `simulate` runs it."""

    def __init__(self, sensor: Sensor, seed: int) -> None:
        self._rate_hz = sensor.rate_hz
        delay_s = float(sensor.values.get('time_offset', {}).get('offset_s', 0.0))
        self._kept = POINTS + ceil(delay_s * sensor.rate_hz)
        self._force = np.zeros((0, 3))
        self._first = self._count = 0
        self._temperature_c = NOMINAL_TEMPERATURE_C
        self._respond = Response(sensor, Motion(
            inf, force=self._force_at, temperature_c=self._temperature_at,
            internal_rate_hz=sensor.rate_hz), seed)

    def __call__(self, force: np.ndarray, temperature_c: float) -> np.ndarray:
        """
        Advance over the next samples.

        force: specific force in the case frame, m/s², (n, 3); returns: output of the sensor, V,
        (n, m).
        """
        if not self._count:
            # Before its first sample the sensor has rested.
            self._force = np.tile(force[0], (self._kept, 1))
            self._first = -self._kept
        self._force = np.concatenate([self._force, force])
        self._temperature_c = temperature_c
        index = self._count + np.arange(len(force))
        self._count += len(force)
        volts = self._respond(index / self._rate_hz)
        surplus = len(self._force) - self._kept
        self._force, self._first = self._force[surplus:], self._first + surplus
        return volts

    def _force_at(self, time_s: np.ndarray) -> list[np.ndarray]:
        """Return the force at times, s, (n,); between samples by a polynomial."""
        place = time_s * self._rate_hz - self._first
        nearest = np.rint(place).astype(int)
        if np.abs(place - nearest).max() < _ON_SAMPLE:
            return list(self._force[nearest].T)
        first = np.clip(place.astype(int) - POINTS // 2 + 1, 0, len(self._force) - POINTS)
        weights = lagrange_weights(place - first)
        return list(np.einsum('ij,ijk->ki', weights,
                              self._force[first[:, None] + np.arange(POINTS)]))

    def _temperature_at(self, time_s: np.ndarray, order: int = 0) -> np.ndarray:
        """Return the temperature at times, s, (n,), °C."""
        return np.full(len(time_s), 0.0 if order else self._temperature_c)


def open_link(sensor: Sensor, settings: Settings) -> EmulatedSensor:
    """Open the link."""
    return EmulatedSensor(sensor, settings)


class EmulatedSensor:
    """
    The signal chain behind the ideal samples of a simulator.

    Stamps are those of the simulator, so that a pause and any real-time factor need nothing. The
    chain runs at the rate of the stream, which its first samples determine. A reset of the
    simulation and a new rate put the sensor at its power-on.
    """

    live = True
    references = ()
    waits_for_listener = False
    start_ns = None

    def __init__(self, sensor: Sensor, settings: Settings) -> None:
        """Wait for the first sample."""
        self.sensor: Sensor | None = None
        self.imu_topic, self.temperature_topic = settings.topic, settings.temperature_topic
        self._seed = settings.seed
        # Fixed axes (REP-103), as in a URDF joint.
        self._case = scipy.spatial.transform.Rotation.from_euler(
            'xyz', (settings.roll_rad, settings.pitch_rad, settings.yaw_rad)) \
            if settings.turns_case else None
        self._temperature_c = NOMINAL_TEMPERATURE_C
        self._statistics = _Statistics()
        left_out = SensorModel(sensor).left_out
        self._left_out = '; '.join(f'{name} {reason}' for name, reason in left_out.items())
        effects = tuple(name for name in sensor.effects if name not in left_out)
        self._unit = replace(sensor, effects=effects,
                             values={name: sensor.values[name] for name in effects})
        self._publishers: int | None = None
        self._mixture = ''
        self._heard_s = time.monotonic()
        self._newest_ns: int | None = None
        self._made: list[tuple[_Ideal, np.ndarray]] = []
        self._waiting: list[tuple[_Ideal | None, np.ndarray]] = []
        self._missing = 0
        self._chain: _Chain | None = None
        self._restart()

    def sense_temperature(self, temperature_c: float) -> None:
        """Use a temperature, °C, from the next sample on; ignore NaN."""
        if np.isfinite(temperature_c):
            self._temperature_c = temperature_c

    def sense_publishers(self, count: int, mixture: str = '') -> None:
        """Take who publishes the ideal samples."""
        self._publishers, self._mixture = count, mixture

    def sense_imu(self, stamp_ns: np.ndarray, fields: Mapping[str, np.ndarray]) -> None:
        """
        Take ideal samples.

        stamp_ns: their stamps, ns, (n,); fields: number fields of sensor_msgs/Imu by name, (n, k)
        each, in the simulator's frame.
        """
        self._heard_s = time.monotonic()
        for i, stamp in enumerate(stamp_ns.tolist()):
            self._sense(_Ideal(stamp, _in_case(
                {name: values[i] for name, values in fields.items()}, self._case)))
        self._run_chain()

    def begin(self, now_ns: int) -> int:
        """Return 0: stamps are those of the simulator, and no sample is lost."""
        return 0

    def read(self, now_ns: int) -> Samples:
        """Return the samples since the last call."""
        made, self._made = self._made, []
        missing, self._missing = self._missing, 0
        if not made:
            empty = no_samples(self._unit, self._newest_ns or 0)
            return replace(empty, missing=missing, estimated=missing)
        passed = {name: np.array([ideal.fields[name] for ideal, _ in made])
                  for name in made[0][0].fields if name != 'linear_acceleration'}
        return Samples(np.array([ideal.stamp_ns for ideal, _ in made], np.int64),
                       np.array([volts for _, volts in made]), made[-1][0].stamp_ns, missing,
                       estimated=missing, imu_fields=passed)

    def status(self) -> LinkStatus:
        """Return whether the simulator sends samples."""
        counts = self._statistics
        events = (Event(f'not emulated: {self._left_out}', int(bool(self._left_out))),
                  Event('the simulation was reset; the sensor is at its power-on', counts.resets),
                  Event('the rate of the simulator changed; the sensor is at its power-on',
                        counts.rate_changes),
                  Event(f'{self.imu_topic}: a sample is not a number; check the simulation',
                        counts.not_finite))
        text = self._fault()
        if self._mixture:
            return LinkStatus(Level.ERROR, self._mixture, (counts,), events)
        if text:
            return LinkStatus(Level.WARN, text, (counts,), events)
        rate_hz = self.sensor.rate_hz if self.sensor else 0.0
        return LinkStatus(Level.OK, f'emulates {self._unit.serial} on {self.imu_topic} at '
                          f'{rate_hz:.6g} Hz', (counts,), events)

    def close(self) -> None:
        """Do nothing: the link holds nothing open."""

    def _fault(self) -> str:
        """Return why no samples come, or not those of one simulator; '' while all is well."""
        if self._newest_ns is None or time.monotonic() - self._heard_s > _SILENT_S:
            if self._publishers is None:
                return f'{self.imu_topic}: waiting for a sample'
            return f'{self.imu_topic}: no samples; is the simulation paused?' \
                if self._publishers else \
                f'{self.imu_topic}: nobody publishes it; start the simulator, or set link.topic'
        return '' if self._chain else f'{self.imu_topic}: measuring the rate'

    def _restart(self) -> None:
        """Put the sensor at its power-on, at a rate that the next samples determine."""
        self._run_chain()
        self._chain = None
        self._held: list[_Ideal] = []
        self._last: _Ideal | None = None
        self._stamps_ns: deque[int] = deque(maxlen=_BLOCK)
        self._shows_losses = True
        self._since = 0

    def _count(self, name: str) -> None:
        """Add one to a count of the statistics."""
        self._statistics = replace(
            self._statistics, **{name: getattr(self._statistics, name) + 1})

    def _sense(self, ideal: _Ideal) -> None:
        """Take one sample: drop it, hold it until the rate is known, or apply the chain."""
        if self._newest_ns is not None and ideal.stamp_ns <= self._newest_ns:
            if not self._is_reset(ideal.stamp_ns):
                self._count('late')
                return
            self._count('resets')
            self._restart()
        if not np.isfinite(ideal.force).all():
            self._count('not_finite')
            return
        self._newest_ns = ideal.stamp_ns
        if self._chain is None:
            self._hold(ideal)
        else:
            self._advance(ideal)

    def _is_reset(self, stamp_ns: int) -> bool:
        """Return whether a stamp that does not follow the newest one is of a new simulation."""
        assert self._newest_ns is not None, 'an older stamp needs a newer one'
        period_ns = 1e9 / self.sensor.rate_hz if self.sensor else 0.0
        return stamp_ns < self._newest_ns - _LATE_PERIODS * period_ns

    def _hold(self, ideal: _Ideal) -> None:
        """Hold a sample; publish all that are held once they determine the rate."""
        self._held.append(ideal)
        span_ns = ideal.stamp_ns - self._held[0].stamp_ns
        count = len(self._held)
        if count < _FIRST and (span_ns < _FIRST_NS or count < _MIN_FIRST):
            return
        time_s = _seconds([held.stamp_ns for held in self._held])
        if span_ns < _FIRST_NS and count < _FIRST_UNEVEN and not is_even(time_s):
            return
        rate_hz = stamped_rate_hz(time_s)
        self._shows_losses = _show_losses(np.diff(time_s) * rate_hz)
        self.sensor = replace(self._unit, rate_hz=rate_hz)
        self._chain = _Chain(self.sensor, self._seed)
        self._seed += 1
        held, self._held = self._held, []
        for waiting in held:
            self._advance(waiting)

    def _advance(self, ideal: _Ideal) -> None:
        """Let the chain run up to a sample, through those that were lost before it."""
        assert self.sensor is not None, 'a chain has a rate'
        period_ns = 1e9 / self.sensor.rate_hz
        steps = 1
        if self._last is not None:
            step_ns = ideal.stamp_ns - self._last.stamp_ns
            steps = max(round(step_ns / period_ns), 1) if self._shows_losses else 1
            self._missing += steps - 1
            if step_ns > max(_MAX_FILLED_NS, _LATE_PERIODS * period_ns):
                self._count('gaps')
                self._restart()
                self._hold(ideal)
                return
            for k in range(1, steps):
                between = self._last.force + k / steps * (ideal.force - self._last.force)
                self._waiting.append((None, between))
        self._stamps_ns.append(ideal.stamp_ns)
        self._waiting.append((ideal, ideal.force))
        self._last = ideal
        self._check_rate(self.sensor.rate_hz)

    def _run_chain(self) -> None:
        """Run the chain over the samples that wait for it."""
        waiting, self._waiting = self._waiting, []
        if waiting and self._chain is not None:
            volts = self._chain(np.array([force for _, force in waiting]), self._temperature_c)
            self._made += [(ideal, row) for (ideal, _), row in zip(waiting, volts)
                           if ideal is not None]

    def _check_rate(self, rate_hz: float) -> None:
        """Measure the rate of a block of samples; start again if the simulator has another one."""
        self._since += 1
        if self._since < _BLOCK:
            return
        self._since = 0
        time_s = _seconds(self._stamps_ns)
        steps = np.diff(time_s) * rate_hz
        self._shows_losses = _show_losses(steps)
        # A burst at the end of the block may belong to it or not.
        tolerance = _RATE_TOLERANCE + max(np.quantile(steps, 0.99) - 1, 0) / _BLOCK
        if abs(rate_hz / stamped_rate_hz(time_s) - 1) > tolerance:
            self._count('rate_changes')
            self._restart()


def _in_case(fields: dict[str, np.ndarray], case: scipy.spatial.transform.Rotation | None
             ) -> dict[str, np.ndarray]:
    """Turn a message of the simulator into the frame of the case."""
    for name, value in _ABSENT.items():
        if not np.isfinite([*fields[name], *fields[f'{name}_covariance']]).all():
            fields |= {name: value, f'{name}_covariance': _NOT_MEASURED}
    if case is None:
        return fields
    for name in ('linear_acceleration', 'angular_velocity'):
        fields[name] = case.inv().apply(fields[name])
    covariance = fields['angular_velocity_covariance']
    if covariance[0] >= 0:
        rotation = case.as_matrix()
        fields['angular_velocity_covariance'] = (
            rotation.T @ covariance.reshape(3, 3) @ rotation).ravel()
    if fields['orientation'].any():
        orientation = scipy.spatial.transform.Rotation.from_quat(fields['orientation'])
        fields['orientation'] = (orientation * case).as_quat()
    return fields


def _seconds(stamps_ns: Sequence[int]) -> np.ndarray:
    """Return stamps, ns, (n,), as times since the first one, s."""
    return (np.array(stamps_ns) - stamps_ns[0]) * 1e-9


def _show_losses(steps: np.ndarray) -> bool:
    """Return whether steps of stamps, periods, (n,), are whole periods, so that losses show."""
    return bool(np.quantile(np.abs(steps - np.rint(steps).clip(1)), 0.99) < _STEP_SCATTER)
