# SPDX-License-Identifier: Apache-2.0

"""The look at gravity and samples while a recording is read, and while a live stream goes on."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

from adxl_ros.errors import one_line, UserError
from adxl_ros.files.recording_columns import Recording
from adxl_ros.files.stream_info import uncalibrated
from adxl_ros.model.constants import TINY
from adxl_ros.model.sensor import Sensor, to_volts
from adxl_ros.signals.axis_ranges import axis_faults, AxisLook, AxisRange
from adxl_ros.signals.gravity_at_rest import GravityAtRest, GravityFaultKind, of_volts, TURNED_COS
from adxl_ros.signals.neighbouring_samples import NeighbouringSamples
from adxl_ros.signals.rest_detection import RecordedRests, RestFinder, RestMean
from adxl_ros.signals.rest_limits import datasheet_noise
from adxl_ros.signals.rest_search import BY_STREAM, RestRule
import numpy as np

LIVE_WINDOW_S = 4.0  # Newest samples in which a live stream may rest, s. Chosen: two short rests
_OTHER_STREAM = 1.5  # Ratio of two lengths in one pose from which the driver has changed its unit
_MOST_POSES = 20  # Newest poses of a live stream that are kept. Chosen: a tumble by hand


class RecordingLook:
    """Looks at gravity, at each axis and at neighbouring samples while a recording is read."""

    def __init__(self, sensor: Sensor, first: Recording) -> None:
        """Prepare for a recording of a sensor, calibrated or not, by its first block."""
        self._sensor = sensor
        # The same without coefficients, as the recording states it
        self.nominal = uncalibrated(sensor, first.stream_info, first.axes, first.rate_hz)
        self.rests = RecordedRests(self.nominal, first)
        self._neighbours = NeighbouringSamples(self.nominal.axes, first.rate_hz)
        self._axes = [AxisLook(name, 1 / first.rate_hz) for name in first.sensor_columns]

    def feed(self, block: Recording) -> None:
        """Add a block of the recording."""
        self.rests.feed(block)
        accel_mps2 = block.accel_mps2(self.nominal)
        self._neighbours.feed(block.time_s, accel_mps2)
        for axis, values in zip(self._axes, accel_mps2.T):
            axis.feed(values)

    def gravity(self) -> GravityAtRest:
        """
        Return the length of gravity over the rests so far.

        In a small unit even motion is below the noise that is stated for the sensor, so that no
        rest of it reads gravity: then rests by the noise of the readings themselves tell the unit.
        """
        self.rests.take()
        if self._neighbours.are_means:
            return self._look([])
        gravity = self._look(self.rests.detected)
        if gravity.fault is not None and gravity.fault.kind is GravityFaultKind.REMOVED:
            by_own_noise = self._look(self.rests.by_own_noise())
            if by_own_noise.fault is not None and by_own_noise.fault.is_unit:
                return by_own_noise
        return gravity

    def _look(self, rests: list[RestMean]) -> GravityAtRest:
        is_calibrated = self._sensor.effects and self._sensor.axes == self.nominal.axes
        return _of_rests(rests, self._sensor if is_calibrated else self.nominal)

    def axes(self) -> tuple[AxisRange, ...]:
        """Return the range of each axis."""
        return tuple(axis.result() for axis in self._axes)

    def faults(self) -> list[str]:
        """Return what is wrong on an axis and between neighbouring samples, one line each."""
        return [*axis_faults(self.axes()), *self._neighbours.faults()]

    @contextmanager
    def named_in_refusals(self) -> Iterator[None]:
        """Add what is wrong with the samples to a refusal, as it may be why nothing rests."""
        try:
            yield
        except UserError as error:
            faults = self.faults()
            if not faults:
                raise
            raise UserError('; '.join([one_line(error), *faults])) from None


class LiveLook:
    """
    Looks at gravity over the newest rests of a live stream.

    The noise of readings in another unit is not that of the sensor, so that rests by the noise
    that the stream shows tell the unit. In a vehicle such a rest may be a steady acceleration:
    smaller errors count where the stream is as quiet as the sensor.
    """

    def __init__(self) -> None:
        self._sensor: Sensor | None = None
        # Rests of different poses, by whether their noise was learned from the stream
        self._rests: dict[bool, list[RestMean]] = {}

    def __call__(
        self, sensor: Sensor, rate_hz: float, stamps_ns: np.ndarray, accel_mps2: np.ndarray
    ) -> GravityAtRest:
        """
        Return the look at the rests so far.

        sensor: what the samples are corrected by, at a rate, Hz; stamps_ns, accel_mps2: the
        newest `LIVE_WINDOW_S` of the stream, ns, (n,), and m/s², (n, 3).
        """
        if sensor is not self._sensor:
            self._sensor = sensor
            self._rests = {True: [], False: []}
        time_s = (stamps_ns - stamps_ns[:1].sum()) * 1e-9
        volts = to_volts(accel_mps2[:, : len(sensor.axes)], sensor)
        look = partial(self._look, sensor, rate_hz, time_s, volts)
        by_stream = look(BY_STREAM)
        if by_stream.fault is not None and by_stream.fault.is_clear:
            return by_stream
        return look(RestRule(datasheet_noise(sensor), learns=False))

    def _look(
        self,
        sensor: Sensor,
        rate_hz: float,
        time_s: np.ndarray,
        volts: np.ndarray,
        rule: RestRule,
    ) -> GravityAtRest:
        """Add the rests of a window to those before, and look at all of them."""
        finder = RestFinder(rate_hz, volts.shape[1], rule)
        finder.feed(time_s, volts)
        rests = self._rests[rule.learns]
        for found in finder.means(finder.rests()):
            rests = _with_rest(rests, found, sensor)
        self._rests[rule.learns] = rests
        return _of_rests(rests, sensor)


def _of_rests(rests: list[RestMean], sensor: Sensor) -> GravityAtRest:
    """Look at the means of rests on the axes of a sensor."""
    shape = len(rests), len(sensor.axes)
    mean_v = np.reshape([rest.mean_v for rest in rests], shape)
    return of_volts(mean_v, np.reshape([rest.std_v for rest in rests], shape), sensor)


def _with_rest(rests: list[RestMean], found: RestMean, sensor: Sensor) -> list[RestMean]:
    """Add a rest: one in the pose of an earlier one replaces it; a new length replaces all."""

    def force_v(rest: RestMean) -> np.ndarray:
        return rest.mean_v - sensor.nominal_zero_g_v

    length_v = max(float(np.linalg.norm(force_v(found))), TINY)
    others = []
    for rest in rests:
        other_v = max(float(np.linalg.norm(force_v(rest))), TINY)
        if force_v(rest) @ force_v(found) < TURNED_COS * length_v * other_v:
            others.append(rest)
        elif not 1 / _OTHER_STREAM < length_v / other_v < _OTHER_STREAM:
            return [found]
    return [*others[1 - _MOST_POSES :], found]
