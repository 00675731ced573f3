# SPDX-License-Identifier: Apache-2.0

"""What is published of corrected samples: of a live stream one by one, and of recordings."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from math import inf
from typing import Any, NamedTuple

from adxl_ros.compensate.estimators import Estimate, Estimates, LiveEstimator
from adxl_ros.compensate.inversions import DelayedInversion, FilteredSample
from adxl_ros.files import imu_message
from adxl_ros.files.cdr import CdrError
from adxl_ros.model import noise
from adxl_ros.model.covariance import UNMEASURED_VARIANCE
from adxl_ros.model.effects.base import ARRAYS, Components, FLOATS
from adxl_ros.model.gyroscope import Gyroscope
from adxl_ros.model.kinematics import (
    Covariance3,
    Mounting,
    quaternion,
    UNKNOWN_ANGLE_RAD2,
    UNOBSERVABLE_RAD2,
)
from adxl_ros.model.sensor import Sensor
import numpy as np

COUNTS = ('received', 'published', 'dropped', 'saturated', 'outside', 'backward')
"""What a stream counts: samples, and those to which something happened."""

_MAX_UNKNOWN = 5000  # Largest number of samples that wait for their sensor; chosen: 5 s at 1 kHz


class _Chain(NamedTuple):
    """What corrects a sample; replaced as a whole."""

    live: LiveEstimator
    delayed: DelayedInversion
    stride: int
    gyro: Gyroscope


class LiveStream:
    """
    Corrects the samples of one stream.

    One thread calls it with samples and surroundings; another one may replace the sensor
    meanwhile. A sample has the coefficients before or after a replacement, never some of both.

    publish_tilt, publish_free: take roll, pitch and inclination, and the acceleration without
    gravity of a sample with an orientation, each a serialized geometry_msgs/Vector3Stamped.
    """

    def __init__(
        self,
        paper: bool,
        undo_filter: bool,
        publish_imu: Callable[[bytes], None],
        publish_tilt: Callable[[bytes], None],
        keep_orientation: bool = False,
        publish_free: Callable[[bytes], None] | None = None,
        output_rate_hz: float = 0.0,
    ) -> None:
        self._paper = paper
        self._undo_filter = undo_filter
        self._keep_orientation = keep_orientation
        self._publish_free = publish_free
        self._output_rate_hz = output_rate_hz
        self._corrected = 0
        self._mounting = Mounting()
        self._frame_id = ''
        self._sensor: tuple[Sensor, float]
        self._forces: list[Components] | None = None
        self._publish_imu = publish_imu
        self._publish_tilt = publish_tilt
        self._chain: _Chain
        self._angles_rad = [0.0, 0.0, 0.0]
        self._newest_s = -inf  # Stamp of the newest sample, s
        self.counts: Counter[str] = Counter()  # Samples since the start, by the names of `COUNTS`
        # What the newest sample outside of the calibrated range exceeds, in words
        self.outside: tuple[str, ...] = ()
        # Temperature, °C, and supply, V, that the inverse uses, by name; those that are known
        self.surroundings: dict[str, float] = {}
        # Whether the stream belongs to another sensor; then its samples are counted only
        self.refused = False
        # Whether nobody has named the sensor. The stream is then held as soon as it has a value on
        # an axis that the sensor lacks.
        self.may_be_foreign = False
        # Newest samples of a stream that is held; None where it is not
        self.unknown: deque[bytes] | None = None

    def hold(self) -> None:
        """Keep the samples that follow and publish nothing, until `release` is called."""
        self.unknown = deque(maxlen=_MAX_UNKNOWN)

    def release(self) -> None:
        """Correct and publish the samples that follow."""
        self.unknown = None
        self.may_be_foreign = False

    def use(self, sensor: Sensor, rate_hz: float) -> None:
        """Correct by a sensor, at the rate of the stream, from the next sample on."""
        self._sensor = sensor, rate_hz
        at_rate = replace(sensor, rate_hz=rate_hz)
        live = LiveEstimator(
            at_rate,
            self._paper,
            self._undo_filter,
            self._mounting if self._mounting.turns else None,
        )
        live.set_environment(**self.surroundings)
        stride = max(1, round(rate_hz / self._output_rate_hz)) if self._output_rate_hz else 1
        self._chain = _Chain(
            live, DelayedInversion(noise.electronics(at_rate).rc_s, rate_hz), stride, sensor.gyro
        )

    @property
    def sensor(self) -> Sensor:
        """Return the sensor that corrects the samples."""
        return self._sensor[0]

    def mount(self, mounting: Mounting, frame_id: str) -> None:
        """Turn the samples that follow into the frame of the robot."""
        self._mounting = mounting
        self._frame_id = frame_id
        self.use(*self._sensor)

    def collect(self) -> None:
        """Begin to keep the corrected forces, for `collected`."""
        self._forces = []

    def collected(self) -> np.ndarray:
        """Return the forces since `collect` in the frame of the case, (n, 3), and forget them."""
        forces = self._forces or []
        self._forces = None
        return np.reshape(forces, (-1, 3)) @ self._mounting.rows

    def surround(self, name: str, value: float) -> None:
        """Take a temperature or supply into account, from the next sample on."""
        self.surroundings = {**self.surroundings, name: value}
        self._chain.live.set_environment(**{name: value})

    def __call__(self, raw: bytes) -> None:
        """Correct one sample, a serialized sensor_msgs/Imu, and publish the result."""
        self.counts['received'] += 1
        unknown = self.unknown
        if unknown is not None:
            unknown.append(raw)
            return
        if self.refused:
            return
        try:
            time_s, accel_mps2 = imu_message.read(raw)
        except CdrError:
            self.counts['dropped'] += 1
            return
        self.counts['backward'] += time_s < self._newest_s
        self._newest_s = time_s
        # Read once: another thread may replace the chain at any time.
        chain = self._chain
        volts = chain.live.volts(accel_mps2)
        if self.may_be_foreign and any(accel_mps2[len(volts) :]):
            self.hold()
            return
        if not volts:
            self.counts['dropped'] += 1
        elif self._undo_filter:
            for ready in chain.delayed(FilteredSample(time_s, volts, raw)):
                self._correct(chain, *ready)
        else:
            self._correct(chain, time_s, volts, raw)

    def _correct(self, chain: _Chain, time_s: float, volts: list[float], raw: Any) -> None:
        live = chain.live
        estimate = live(volts, time_s)
        if estimate is None:
            self.counts['dropped'] += 1
            return
        self.counts['saturated'] += estimate.saturated
        if estimate.outside:
            self.counts['outside'] += 1
            self.outside = estimate.outside
        # Read once: `collected` may take the list away at any time.
        forces = self._forces
        if forces is not None:
            forces.append(estimate.force)
        self._corrected += 1
        if self._corrected % chain.stride:
            return
        if chain.gyro.is_calibrated:
            temperature_c = self.surroundings.get('temperature_c')
            raw = imu_message.less_bias(
                raw,
                chain.gyro.bias_at(temperature_c).tolist(),
                (chain.gyro.bias_std_at(temperature_c) ** 2).tolist(),
            )
        if live.mounting is not None:
            raw = imu_message.with_frame(imu_message.turned(raw, live.mounting), self._frame_id)
        orientation: Sequence[float] | None = self._orientation(estimate)
        if self._keep_orientation and imu_message.has_orientation(raw):
            orientation = None
            if self._publish_free is not None:
                self._publish_free(
                    imu_message.vector3_stamped(
                        raw,
                        free_acceleration(
                            estimate.force,
                            imu_message.orientation(raw),
                            live.sensor.local_gravity_mps2,
                        ),
                    )
                )
        self._publish_imu(
            imu_message.corrected(
                raw, orientation, (*estimate.force, *estimate.covariance.row_by_row)
            )
        )
        self._publish_tilt(imu_message.vector3_stamped(raw, self._angles_rad))
        self.counts['published'] += 1

    def _orientation(self, estimate: Estimate) -> tuple[float, ...]:
        """
        Return the quaternion with yaw 0 (x, y, z, w), and its covariance, rad², row by row.

        An angle that the pose does not show keeps its last value, with a very large variance.
        """
        variances = [UNKNOWN_ANGLE_RAD2] * 3
        for i, shown in enumerate((estimate.roll, estimate.pitch, estimate.inclination)):
            if shown.variance_rad2 < UNOBSERVABLE_RAD2:
                self._angles_rad[i] = shown.angle_rad
                variances[i] = shown.variance_rad2
        roll, pitch, _ = self._angles_rad
        covariance = Covariance3(variances[0], 0.0, 0.0, variances[1], 0.0, UNKNOWN_ANGLE_RAD2)
        return (*quaternion(roll, pitch, FLOATS), *covariance.row_by_row)


def free_acceleration(
    force_mps2: Components, quaternion: Sequence[float], gravity_mps2: float
) -> list[float]:
    """Return the acceleration without gravity, m/s², three floats."""
    x, y, z, w = quaternion
    vertical = (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y))
    return [f - gravity_mps2 * v for f, v in zip(force_mps2, vertical)]


class ImuFields:
    """
    Makes the fields of `imu/data` and `tilt`, block by block.

    An angle that a sample does not show keeps its last value, 0 before the first, with a very
    large variance. So has a force that the sample does not determine.
    """

    def __init__(self) -> None:
        self._last_rad = np.zeros(3)

    def __call__(self, estimates: Estimates) -> tuple[dict[str, np.ndarray], np.ndarray]:
        """Return fields of sensor_msgs/Imu, (n, k), and the tilt, (n, 3), of solved samples."""
        unsolved = estimates.unsolved
        solved = ~unsolved if unsolved.any() else slice(None)  # a slice copies nothing
        force = estimates.force_mps2[:, solved]
        force = np.where(np.isnan(force), 0.0, force)
        covariance = estimates.covariance[:, :, solved]
        unknown = np.diag(np.full(3, UNMEASURED_VARIANCE))[:, :, None]
        covariance = np.where(np.isfinite(covariance).all(axis=(0, 1)), covariance, unknown)
        tilt = estimates.tilt
        shown_rad = np.stack([tilt.roll, tilt.pitch, tilt.inclination])[:, solved]
        std_rad = np.stack([tilt.roll_std, tilt.pitch_std])[:, solved]
        angles_rad = self._held(shown_rad)
        variances = np.zeros((9, len(force.T)))
        variances[[0, 4]] = np.where(np.isfinite(std_rad), std_rad**2, UNKNOWN_ANGLE_RAD2)
        variances[8] = UNKNOWN_ANGLE_RAD2
        return {
            'linear_acceleration': force.T,
            'linear_acceleration_covariance': covariance.reshape(9, -1).T,
            'orientation': np.stack(quaternion(angles_rad[0], angles_rad[1], ARRAYS)).T,
            'orientation_covariance': variances.T,
        }, angles_rad.T

    def _held(self, angles_rad: np.ndarray) -> np.ndarray:
        """Return angles, rad, (3, n), with the last known value in place of NaN."""
        import pandas  # It would slow down the start of a node

        held = pandas.DataFrame(np.vstack([self._last_rad, angles_rad.T])).ffill().to_numpy()
        self._last_rad = held[-1]
        return held[1:].T
