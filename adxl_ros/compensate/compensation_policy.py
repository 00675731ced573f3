# SPDX-License-Identifier: Apache-2.0

"""The decisions of a live compensation: which calibration applies, to whose stream, and where."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta, timezone
from math import inf
from pathlib import Path
from typing import Any, NamedTuple

from adxl_ros.errors import UserError
from adxl_ros.files import calibration_store
from adxl_ros.files.stream_info import check_same_sensor, NO_SERIAL, StreamInfo
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import NOMINAL_ENVIRONMENT
from adxl_ros.model.sensor import Sensor
from adxl_ros.report.level import Level

_STALE_S = 60.0
"""Age from which a temperature or supply counts as unknown, s; chosen: a room warms by less than
0.1 K in that time."""
_SHORTEST_SILENCE_S = 0.5
"""Shortest interval in which samples are missed, s; chosen. A report on a change of level may
follow the last one by less than a sample period."""


@dataclass
class StreamFaults:
    """What is wrong with a stream, one line each; '' for what is not."""

    mixture: str = ''  # Several nodes publish the samples, so that none counts
    no_gravity: str = ''  # The rests are in another unit, or without gravity
    wrong_gravity: str = ''  # They are off by less


class CompensationStatus(NamedTuple):
    """The state of a compensation."""

    level: Level
    text: str  # One line for people


@dataclass(frozen=True)
class StreamInterval:
    """What a stream has shown since the last report."""

    duration_s: float  # Length of the interval, s
    counts: Mapping[str, int]  # Samples in the interval, by the names of `live_stream.COUNTS`
    # What the newest sample outside of the calibrated range exceeds, in words
    outside: tuple[str, ...]
    # Temperature, °C, and supply, V, that the inverse uses, by name
    surroundings: Mapping[str, float]
    ages_s: Mapping[str, float]  # Time since each of them was heard, s, by name
    obstacle: str = ''  # Why the sensor of the samples is still unknown, or ''


def _side_text(sensor: Sensor) -> str:
    """Return which way up a calibrated sensor of two axes is taken to be; '' for others."""
    if sensor.axes != 'xy' or not sensor.effects:
        return ''
    if sensor.z_sign:
        return f'; its z points {"up" if sensor.z_sign > 0 else "down"}, as sensor.z_sign states'
    return (
        '; its z is taken to point up, or down where mounting.rpy_rad turns it over: '
        'sensor.z_sign states it'
    )


class CompensationPolicy:
    """
    Decides which calibration applies to a stream, and whether it applies at all.

    A calibration that is named stands. Otherwise the sensor's newest one in the store applies,
    as soon as the stream states its serial number.
    """

    sensor: Sensor  # The sensor whose coefficients are used, since `use`
    source: str  # Where the coefficients come from, since `use`

    def __init__(self, paper: bool, store: str, full_name: Callable[[str], str]) -> None:
        """Prepare; `full_name` gives the full name of a topic, for messages."""
        self._paper = paper
        self._store = store
        self._full_name = full_name
        self._given: set[str] = set()  # Warnings that were given
        self.stored_path = ''  # File that was taken from the store, '' if none was
        # What the stream states of itself (`sensor_info`), None before it does
        self.info: StreamInfo | None = None
        self.faults = StreamFaults()
        self.refusal = ''  # Why the sensor cannot correct the stream, or ''

    @property
    def rate_hz(self) -> float:
        """Sample rate that the stream states, Hz, else that of the calibration."""
        try:
            stated_hz = self.info.rate_hz if self.info else None
        except UserError:
            # `check` refuses such a stream.
            stated_hz = None
        return stated_hz or self.sensor.rate_hz

    def check(self, sensor: Sensor) -> None:
        """Refuse a sensor that cannot correct the stream."""
        if self._paper and sensor.axes == 'x':
            raise UserError("inverse: the paper's needs the axes x and y, the sensor has x")
        if self.info is not None:
            check_same_sensor(self.info, self.info.axes or sensor.axes, sensor)
            _ = self.info.rate_hz  # raises where it is no rate

    def use(self, sensor: Sensor, source: str) -> str:
        """Apply a sensor from now on."""
        self.sensor = sensor
        self.source = source
        model = (
            f'{sensor.serial}, model {sensor.model}'
            if sensor.effects
            else f'{sensor.serial}, which is not calibrated'
        )
        return f'compensating by {source}: {model}{_side_text(sensor)}'

    def assess(self) -> bool:
        """Update `refusal` by the sensor and the stream; return whether it has changed."""
        before = self.refusal
        self.refusal = self.faults.mixture or self.faults.no_gravity
        try:
            self.check(self.sensor)
        except UserError as error:
            self.refusal = str(error)
        return self.refusal != before

    def is_named(self, calibration: str) -> bool:
        """Return whether a user named the calibration; `calibration` is the parameter's value."""
        return calibration != self.stored_path if calibration else bool(self.sensor.effects)

    def choose(self, calibration: str) -> tuple[str, list[str]]:
        """Choose the newest calibration of the stream's sensor, unless one was named."""
        serial = self.info.serial if self.info else NO_SERIAL
        if not self._store or serial == NO_SERIAL or self.is_named(calibration):
            return '', []
        path, refused = calibration_store.newest(self._store, serial, self.check)
        warnings = [f'passed over: {reason}' for reason in refused]
        if path is None:
            warnings.append(f'no calibration of {serial} in {self._store}')
        unchanged = path is None or str(path) == self.stored_path
        return '' if unchanged else str(path), self.new_warnings(warnings)

    def new_warnings(self, warnings: list[str]) -> list[str]:
        """Return the warnings that were not given before."""
        new = [text for text in dict.fromkeys(warnings) if text not in self._given]
        self._given.update(new)
        return new

    def newer(self) -> Path | None:
        """Return a calibration that was put into the store after the one in use."""
        sensor = self.sensor
        if not self._store or not sensor.effects or sensor.serial == NO_SERIAL:
            return None
        return calibration_store.newer(self._store, sensor)

    def status(
        self, interval: StreamInterval, newer: Path | None, calibration: str
    ) -> CompensationStatus:
        """Return the state: the first fault or warning that holds."""
        if self.refusal:
            return CompensationStatus(Level.ERROR, f'publishing nothing: {self.refusal}')
        if self.faults.wrong_gravity:
            return CompensationStatus(
                Level.ERROR, f'the tilt is uncertain: {self.faults.wrong_gravity}'
            )
        for warning in self._warnings(interval, newer, calibration):
            return CompensationStatus(Level.WARN, warning)
        return CompensationStatus(Level.OK, 'compensating')

    def _warnings(
        self, interval: StreamInterval, newer: Path | None, calibration: str
    ) -> Iterator[str]:
        """Yield what is not as it should be, the gravest first."""
        samples = self._full_name('imu/data_raw')
        no_info = f'nothing on {self._full_name("sensor_info")}'
        counts = interval.counts
        if not counts.get('received') and interval.duration_s > _SHORTEST_SILENCE_S:
            yield f'no samples on {samples}'
        if interval.obstacle:
            yield (
                f'publishing nothing yet: {no_info}, and {samples} does not show '
                f'its sensor: {interval.obstacle}'
            )
        if dropped := counts.get('dropped'):
            yield f'{dropped} samples dropped that no force explains'
        if saturated := counts.get('saturated'):
            yield f'{saturated} samples with the ADC at its rail'
        if backward := counts.get('backward'):
            yield (
                f'{backward} samples whose stamp steps back; '
                f'one driver must stamp {samples} in order'
            )
        if self.info is None:
            yield f'unit not confirmed: {no_info}'
        if unknown := self._unknown_surroundings(interval):
            yield unknown
        if not self.sensor.effects:
            yield 'not calibrated: the datasheet values apply'
        if outside := counts.get('outside'):
            yield (
                f'{outside} samples outside of what was '
                f'calibrated, their covariance raised: {"; ".join(interval.outside)}'
            )
        if newer is not None and not self.is_named(calibration):
            yield (
                f'a newer calibration is in the store: {newer}; set calibration to it, or start '
                'again'
            )

    def _unknown_surroundings(self, interval: StreamInterval) -> str:
        """Name an effect whose temperature or supply nobody publishes, or return ''."""
        topics = {'temperature_c': 'temperature', 'supply_v': 'supply'}
        for effect in map(effect_named, self.sensor.effects):
            for name in topics.keys() & set(effect.follows):
                if interval.ages_s.get(name, inf) > _STALE_S:
                    value = interval.surroundings.get(name, getattr(NOMINAL_ENVIRONMENT, name))
                    return (
                        f'{effect.name} is taken at {value:g}: nothing on '
                        f'{self._full_name(topics[name])}'
                    )
        return ''

    def values(self, interval: StreamInterval, newer: Path | None) -> dict[str, Any]:
        """Return what diagnostics report of the calibration in use."""
        sensor = self.sensor
        date = calibration_store.date_of(sensor) if sensor.effects else None
        age = datetime.now(timezone.utc) - date if date else None
        return {
            'unit': self._unit(),
            'calibration': self.source,
            'serial': sensor.serial,
            'axes': sensor.axes,
            'model': sensor.model,
            'effects': ', '.join(sensor.effects),
            'calibration_id': calibration_store.calibration_id(sensor) if sensor.effects else '',
            'age_days': '' if age is None else round(age / timedelta(days=1), 3),
            'validity': self._validity(interval),
            'newer': str(newer or ''),
            **{f'provenance.{key}': value for key, value in sensor.provenance.items()},
        }

    def _unit(self) -> str:
        if self.refusal or self.info is None:
            return 'other' if self.refusal else 'not confirmed'
        # A stream or a file without a serial number goes with every sensor.
        return (
            'no serial number'
            if NO_SERIAL in (self.info.serial, self.sensor.serial)
            else 'confirmed'
        )

    def _validity(self, interval: StreamInterval) -> str:
        if not self.sensor.effects:
            return 'not calibrated'
        if self.refusal:
            return self.refusal
        if interval.counts.get('outside'):
            return f'outside: {"; ".join(interval.outside)}'
        knows_temperature = (
            self.sensor.envelope.temperature_c is not None
            and interval.ages_s.get('temperature_c', inf) <= _STALE_S
        )
        return 'valid' if knows_temperature else 'valid, temperature not known'
