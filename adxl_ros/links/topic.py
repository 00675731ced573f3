# SPDX-License-Identifier: Apache-2.0

"""A realistic sensor in another simulator: the signal chain on its ideal Imu stream."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import ceil, inf
import time

from adxl_ros.errors import UserError
from adxl_ros.files.column_mapping import GRAVITY, Quantity, unit_name
from adxl_ros.files.stamps import is_even, stamped_rate_hz
from adxl_ros.links.support.base import (
    Event,
    Level,
    Link,
    LinkStatus,
    no_samples,
    option,
    Samples,
    SimulatorSettings,
)
from adxl_ros.model.constants import NOMINAL_TEMPERATURE_C
from adxl_ros.model.covariance import NOT_MEASURED
from adxl_ros.model.sensor import Sensor
from adxl_ros.simulate.motion import lagrange_weights, Motion, POINTS
from adxl_ros.simulate.response import Response
from adxl_ros.simulate.sensor_model import SensorModel
import numpy as np

_SILENT_S = 3.0
"""Steady time without samples after which the stream counts as silent, s; chosen: as for the
samples of the calibration node."""
_FIRST = 50
"""Samples with even stamps that determine the rate, before the first one is published; chosen:
0.25 s at 200 Hz."""
_FIRST_S = 1.0
"""Simulated time after which other samples determine the rate, s; chosen: for uneven stamps and
slow simulators."""
_MIN_FIRST = 5
"""Fewest samples that determine a rate; chosen: four differences survive one lost sample."""
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

_ABSENT = {'orientation': np.array([0.0, 0.0, 0.0, 1.0]), 'angular_velocity': np.zeros(3)}
"""Values in place of those that are no numbers."""


@dataclass(frozen=True)
class Settings(SimulatorSettings):
    """Settings of the link."""

    topic: str = option(
        'imu/ideal', 'topic of the ideal sensor_msgs/Imu of a simulator: specific force'
    )
    unit: str = option('mps2', 'unit of its accelerations: mps2, g, mg or mmps2')
    temperature_topic: str = option(
        'temperature',
        'topic of the temperature of the sensor, sensor_msgs/Temperature; 25 °C until it comes',
    )
    seed: int = option(0, 'seed of the noise', '', 0, 2**31 - 1)


class _SimulatedChain:
    """The signal chain at the rate of the samples, as `simulate` runs it."""

    def __init__(self, sensor: Sensor, seed: int) -> None:
        self._rate_hz = sensor.rate_hz
        delay_s = float(sensor.values.get('time_offset', {}).get('offset_s', 0.0))
        self._kept = POINTS + ceil(delay_s * sensor.rate_hz)
        self._force = np.zeros((0, 3))
        self._first = self._count = 0
        self._temperature_c = NOMINAL_TEMPERATURE_C
        self._respond = Response(
            sensor,
            Motion(
                inf,
                force=self._force_at,
                temperature_c=self._temperature_at,
                internal_rate_hz=sensor.rate_hz,
            ),
            seed,
        )

    def __call__(self, force: np.ndarray, temperature_c: float) -> np.ndarray:
        """Return the output, V, (n, m), over the next samples of the specific force, (n, 3)."""
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
        self._force = self._force[surplus:]
        self._first = self._first + surplus
        return volts

    def _force_at(self, time_s: np.ndarray) -> list[np.ndarray]:
        place = time_s * self._rate_hz - self._first
        nearest = np.rint(place).astype(int)
        if np.abs(place - nearest).max() < _ON_SAMPLE:
            return list(self._force[nearest].T)
        first = np.clip(place.astype(int) - POINTS // 2 + 1, 0, len(self._force) - POINTS)
        weights = lagrange_weights(place - first)
        return list(
            np.einsum('ij,ijk->ki', weights, self._force[first[:, None] + np.arange(POINTS)])
        )

    def _temperature_at(self, time_s: np.ndarray, order: int = 0) -> np.ndarray:
        return np.full(len(time_s), 0.0 if order else self._temperature_c)


def open_link(sensor: Sensor, settings: Settings) -> EmulatedSensor:
    """Open the link."""
    return EmulatedSensor(sensor, settings)


class EmulatedSensor(Link):
    """
    The signal chain behind the ideal samples of a simulator.

    Stamps are those of the simulator, so that a pause and any real-time factor need nothing. The
    chain runs at the rate of the stream, which its first samples determine. A reset of the
    simulation puts the sensor at its power-on.
    """

    def __init__(self, sensor: Sensor, settings: Settings) -> None:
        self.imu_topic = settings.topic
        self.temperature_topic = settings.temperature_topic
        self.imu_unit = unit_name(settings.unit, Quantity.OUTPUT) or ''
        if self.imu_unit not in GRAVITY:
            raise UserError(
                f'link.unit is {settings.unit!r}, expected one of {", ".join(GRAVITY)}'
            )
        self._seed = settings.seed
        self._temperature_c = NOMINAL_TEMPERATURE_C
        left_out = SensorModel(sensor).left_out
        self._left_out = '; '.join(f'{name} {reason}' for name, reason in left_out.items())
        effects = tuple(name for name in sensor.effects if name not in left_out)
        self._sensor = replace(
            sensor, effects=effects, values={name: sensor.values[name] for name in effects}
        )
        self._counts = dict.fromkeys(('resets', 'gaps', 'late', 'not_finite'), 0)
        self._publishers: int | None = None
        self._mixture = ''
        self._heard_s = time.monotonic()
        self._newest_ns: int | None = None
        self._chain: _SimulatedChain | None = None
        # Period of the samples, and the longest gap through which the chain runs on, ns
        self._period_ns = self._longest_ns = 0.0
        # Samples of the simulator by stamp, ns, and fields, and their volts
        self._held: list[tuple[int, dict[str, np.ndarray]]] = []
        self._made: list[tuple[int, dict[str, np.ndarray], np.ndarray]] = []
        self._missing = 0
        self._restart()

    def sense_temperature(self, temperature_c: float) -> None:
        """Use a temperature, °C, from the next sample on; ignore NaN."""
        if np.isfinite(temperature_c):
            self._temperature_c = temperature_c

    def sense_publishers(self, count: int, mixture: str = '') -> None:
        """Take who publishes the ideal samples."""
        self._publishers = count
        self._mixture = mixture

    def sense_imu(self, stamp_ns: np.ndarray, fields: Mapping[str, np.ndarray]) -> None:
        """Take ideal samples in the frame of the case; values that are no numbers are absent."""
        self._heard_s = time.monotonic()
        for i, stamp in enumerate(stamp_ns.tolist()):
            sample = {name: values[i] for name, values in fields.items()}
            for name, value in _ABSENT.items():
                if not np.isfinite([*sample[name], *sample[f'{name}_covariance']]).all():
                    sample |= {name: value, f'{name}_covariance': NOT_MEASURED}
            self._sense(stamp, sample)
        self._run_chain()

    def read(self, now_ns: int) -> Samples:
        """Return the samples since the last call."""
        made = self._made
        self._made = []
        missing = self._missing
        self._missing = 0
        if not made:
            empty = no_samples(self._sensor, self._newest_ns or 0)
            return replace(empty, missing=missing, estimated=missing)
        stamps_ns, fields, volts = zip(*made)
        passed = {
            name: np.array([values[name] for values in fields])
            for name in fields[0]
            if name != 'linear_acceleration'
        }
        return Samples(
            np.array(stamps_ns, np.int64),
            np.array(volts),
            stamps_ns[-1],
            missing,
            estimated=missing,
            imu_fields=passed,
        )

    def status(self) -> LinkStatus:
        """Return whether the simulator sends samples."""
        counts = dict(self._counts)
        events = (
            Event(f'not emulated: {self._left_out}', int(bool(self._left_out))),
            Event('the simulation was reset; the sensor is at its power-on', counts['resets']),
            Event(
                f'{self.imu_topic}: a sample is not a number; check the simulation',
                counts['not_finite'],
            ),
        )
        return LinkStatus(*self._condition(), counts, events)

    def _condition(self) -> tuple[Level, str]:
        topic = self.imu_topic
        sensor = self.sensor
        if self._mixture:
            return Level.ERROR, self._mixture
        if self._newest_ns is None or time.monotonic() - self._heard_s > _SILENT_S:
            if self._publishers is None:
                reason = 'waiting for a sample'
            elif self._publishers:
                reason = 'no samples; is the simulation paused?'
            else:
                reason = 'nobody publishes it; start the simulator, or set link.topic'
            return Level.WARN, f'{topic}: {reason}'
        if self._chain is None or sensor is None:
            return Level.WARN, f'{topic}: measuring the rate'
        return (
            Level.OK,
            f'emulates {self._sensor.serial} on {topic} at {sensor.rate_hz:.6g} Hz',
        )

    def _restart(self) -> None:
        """Put the sensor at its power-on, at a rate that the next samples determine."""
        self._run_chain()
        self._chain = None
        self._held.clear()
        self._last: tuple[int, np.ndarray] | None = None  # The last stamp, ns, and force

    def _sense(self, stamp_ns: int, fields: dict[str, np.ndarray]) -> None:
        """Hold a sample for the chain, or drop it; a reset and a long gap begin anew."""
        step_ns = 1 if self._newest_ns is None else stamp_ns - self._newest_ns
        if step_ns <= 0:
            if step_ns >= -_LATE_PERIODS * self._period_ns:
                self._counts['late'] += 1
                return
            self._counts['resets'] += 1
            self._restart()
        if not np.isfinite(fields['linear_acceleration']).all():
            self._counts['not_finite'] += 1
            return
        if self._chain is not None and step_ns > self._longest_ns:
            self._counts['gaps'] += 1
            self._missing += round(step_ns / self._period_ns) - 1 if self._shows_losses else 0
            self._restart()
        self._newest_ns = stamp_ns
        self._held.append((stamp_ns, fields))

    def _ready_chain(self) -> _SimulatedChain | None:
        """Return the chain, which is made once the held samples show the rate."""
        if self._chain is None and self._held:
            stamps_ns = np.array([stamp_ns for stamp_ns, _ in self._held])
            count = len(stamps_ns)
            time_s = (stamps_ns - stamps_ns[0]) * 1e-9
            is_long = time_s[-1] >= _FIRST_S and count >= _MIN_FIRST
            if is_long or (count >= _FIRST and is_even(time_s)):
                rate_hz = stamped_rate_hz(time_s)
                # Where steps of the stamps are whole periods, longer ones show losses.
                steps = np.diff(time_s) * rate_hz
                self._shows_losses = bool(
                    np.quantile(np.abs(steps - np.rint(steps).clip(1)), 0.99) < _STEP_SCATTER
                )
                self.sensor = replace(self._sensor, rate_hz=rate_hz)
                self._period_ns = 1e9 / rate_hz
                self._longest_ns = max(_MAX_FILLED_NS, _LATE_PERIODS * self._period_ns)
                self._chain = _SimulatedChain(self.sensor, self._seed)
                self._seed += 1
        return self._chain

    def _run_chain(self) -> None:
        """Run the chain over the samples that are held, and those that were lost between them."""
        chain = self._ready_chain()
        if not self._held or chain is None:
            return
        forces: list[np.ndarray] = []
        places = []
        for stamp_ns, fields in self._held:
            force = fields['linear_acceleration']
            last_ns, last_force = self._last or (stamp_ns, force)
            step_ns = stamp_ns - last_ns
            steps = max(round(step_ns / self._period_ns), 1) if self._shows_losses else 1
            self._missing += steps - 1
            if step_ns <= self._longest_ns:
                forces += [last_force + k / steps * (force - last_force) for k in range(1, steps)]
            places.append(len(forces))
            forces.append(force)
            self._last = stamp_ns, force
        volts = chain(np.array(forces), self._temperature_c)
        self._made += ((*held, made) for held, made in zip(self._held, volts[places]))
        self._held.clear()
