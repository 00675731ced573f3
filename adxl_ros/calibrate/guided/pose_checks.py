# SPDX-License-Identifier: Apache-2.0

"""
Checks of a pose: one line with the value that is wrong, and what to do.

- The dwell in one pose: the samples since the arrival, and the rests among them.
- The check that the sensor is mounted as it was when earlier poses were taken.
- What the encoder of the stage has read: angles over time, its silence and its clock.

Each check returns that line, or '' where nothing is wrong.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from itertools import permutations, product
from typing import NamedTuple

from adxl_ros.calibrate.guided.guide import went_back
from adxl_ros.calibrate.guided.pose_plan import Target
from adxl_ros.calibrate.guided.running_estimate import in_g, RunningEstimate
from adxl_ros.files.sweep_journal import PoseRecord
from adxl_ros.model.kinematics import specific_force
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.rest_detection import (
    datasheet_noise,
    Rest,
    rest_means,
    RestFinder,
    Stillness,
)
import numpy as np


class RestMean(NamedTuple):
    """The average of a rest."""

    # start_ns, stop_ns: Stamps of the first and the last sample, ns
    start_ns: int
    stop_ns: int
    samples: int  # Number of samples
    # mean_v, std_v: Mean output of each axis and the standard deviation of that mean, V, (m,)
    mean_v: tuple[float, ...]
    std_v: tuple[float, ...]


class Dwell:
    """Samples from an arrival on."""

    def __init__(self, sensor: Sensor, arrived_ns: int) -> None:
        self.arrived_ns = arrived_ns
        self._sensor = sensor
        self._finder = RestFinder(sensor.rate_hz, len(sensor.axes), datasheet_noise(sensor),
                                  learn=False)
        self._stamps: list[np.ndarray] = []
        self._volts: list[np.ndarray] = []

    def __len__(self) -> int:
        """Return the number of samples since the arrival."""
        return sum(map(len, self._stamps))

    def feed(self, stamps_ns: np.ndarray, volts: np.ndarray) -> None:
        """
        Take samples.

        stamps_ns: their stamps, ns, (n,); volts: the samples, V, (n, m).
        """
        new = stamps_ns >= self.arrived_ns
        self._stamps.append(stamps_ns[new])
        self._volts.append(volts[new])
        # From the arrival: float64 seconds since 1970 resolve only 0.2 µs.
        self._finder.feed((stamps_ns[new] - self.arrived_ns) * 1e-9, volts[new])

    def rests(self) -> list[Rest]:
        """Return the rests so far; the last one may still go on."""
        return self._finder.rests() if self._stamps else []

    def stillness(self) -> Stillness | None:
        """Return whether the newest samples are at rest; None while they are too few."""
        return self._finder.stillness()

    def at_rest_s(self) -> float:
        """Return for how long the newest rest has lasted, s."""
        rests = self.rests()
        return (rests[-1].stop - rests[-1].start) / self._sensor.rate_hz if rests else 0.0

    def at_rest(self) -> bool:
        """Return whether the newest samples are known to be at rest."""
        stillness = self.stillness()
        return stillness is not None and stillness.at_rest

    def age_s(self) -> float:
        """Return for how long there have been samples, s."""
        return len(self) / self._sensor.rate_hz

    def volts(self, rest: Rest) -> np.ndarray:
        """Return the samples of a rest, V, (n, m)."""
        return np.concatenate(self._volts)[rest.start:rest.stop]

    def mean(self, rest: Rest, samples: int) -> RestMean:
        """Average the first samples of a rest."""
        stamps, start, stop = np.concatenate(self._stamps), rest.start, rest.start + samples
        times = (stamps - self.arrived_ns) * 1e-9
        mean, std = rest_means(times, np.concatenate(self._volts),
                               [Rest(start, stop, times[start], times[stop - 1])],
                               self._sensor.rate_hz, datasheet_noise(self._sensor))
        return RestMean(int(stamps[start]), int(stamps[stop - 1]), samples,
                        tuple(mean[0].tolist()), tuple(std[0].tolist()))


_OUTLIER_STDS = 3.5
"""Residual from which a pose is refused, standard deviations; chosen: one of 2000 by chance."""
_MODEL_STD_G = 5e-3
"""Standard deviation of further model errors, g; chosen: it accepts twice the datasheet limits."""
_SAME_READING_G = 0.2
"""Largest difference of readings that count as equal when a mistake is named, g; chosen."""
_WIRING_POSES = 4
"""Poses after which the wiring of the axes counts as right; chosen: all axes have moved."""
_CLOCK_OFFSET_S = 2.0
"""Largest offset of the clocks of stage and sensor, s; chosen: above any delay of messages."""
_RATE_ERROR = 0.05
"""Largest relative error of the sample rate; chosen: above the error of any oscillator."""
_LONGEST_IN_S = 600
"""Longest time that is stated in seconds; a longer time is stated in hours."""


def angle_fault(target: Target, alpha_rad: float, beta_rad: float, tolerance_rad: float) -> str:
    """Refuse a stage that is not at the pose."""
    return ', '.join(
        f'{name} is {degrees_text(now - wanted)} from the target {np.degrees(wanted):.4g}°'
        for name, now, wanted in (('alpha', alpha_rad, target.alpha_rad),
                                  ('beta', beta_rad, target.beta_rad))
        if abs(now - wanted) > tolerance_rad)


def motion_fault(name: str, angles_rad: np.ndarray, tolerance_rad: float) -> str:
    """
    Refuse a joint that turned while the pose was averaged.

    angles_rad: its readings during the dwell, rad, (n,).
    """
    range_rad = float(np.ptp(angles_rad)) if len(angles_rad) else 0.0
    if range_rad <= tolerance_rad:
        return ''
    return (f'{name} moved {degrees_text(range_rad)} while the pose was averaged; hold the stage '
            'still')


def saturation_fault(sensor: Sensor, volts: np.ndarray) -> str:
    """
    Refuse volts at a rail of the ADC or beyond the range of the sensor.

    volts: samples of the pose, V, (n, m).
    """
    rows, columns = np.nonzero(sensor.saturated(volts))
    if not len(rows):
        return ''
    axis = int(columns[0])
    reading_v = volts[rows[0], axis]
    reading_g = (reading_v - sensor.nominal_zero_g_v[axis]) / sensor.nominal_scale_v_per_g[axis]
    return (f'saturated: {sensor.axes[axis]} reads {signed_text(reading_g)} g '
            f'({reading_v:.3f} V), beyond its range of ±{sensor.range_g:g} g or at a rail of the '
            'ADC; check supply and wiring')


def temperature_fault(first_c: float, now_c: float, span_c: float) -> str:
    """Refuse a pose whose temperature differs from that of the first pose."""
    if not abs(now_c - first_c) > span_c:
        return ''
    return (f'temperature moved {abs(now_c - first_c):.1f} °C since the first pose '
            f'({first_c:.1f} to {now_c:.1f} °C), must stay within {span_c:g} °C; wait until it '
            'is back, or finish with the poses so far')


def rate_fault(measured_hz: float, unit: Sensor) -> str:
    """Refuse samples whose rate is not that of the unit."""
    if not abs(measured_hz / unit.rate_hz - 1) > _RATE_ERROR:
        return ''
    expected = f'were {unit.rate_hz:.4g} at the start; keep the rate of the sensor' \
        if 'rate_hz' in unit.measured else \
        f'sensor_info states rate_hz {unit.rate_hz:.4g}; correct the rate of the driver'
    return f'samples are {measured_hz:.4g} a second by their stamps, but {expected}'


def clock_fault(stage_ahead_s: float) -> str:
    """Refuse a stage whose clock differs from that of the samples, by the offset, s."""
    if not abs(stage_ahead_s) > _CLOCK_OFFSET_S:
        return ''
    side = 'ahead of' if stage_ahead_s > 0 else 'behind'
    return (f'stage/joint_states is stamped {_duration_text(abs(stage_ahead_s))} {side} '
            'imu/data_raw: stage and sensor must share one clock (use_sim_time for both or for '
            'none, or synchronise their computers)')


def reading_fault(estimate: RunningEstimate, target: Target, volts: np.ndarray,
                  tolerance_rad: float) -> str:
    """
    Refuse a pose whose mean is an outlier to the prediction from the poses so far.

    volts: mean of the pose, V, (m,).
    """
    sensor = estimate.unit
    expected_v, std_v = estimate.predicted(target.alpha_rad, target.beta_rad)
    slack_v = sensor.nominal_scale_v_per_g * np.hypot(_MODEL_STD_G, tolerance_rad)
    residual_stds = np.abs(volts - expected_v) / np.hypot(std_v, slack_v)
    if residual_stds.max() <= _OUTLIER_STDS:
        return ''
    axis = int(residual_stds.argmax())
    measured_g, expected_g = in_g(sensor, volts), in_g(sensor, expected_v)
    finding = (f'{sensor.axes[axis]} reads {signed_text(measured_g[axis])} g where '
               f'{signed_text(expected_g[axis])} g was expected')
    # After some good poses the wiring is right, but the operator may still be wrong.
    is_wiring_unproven = estimate.poses < _WIRING_POSES
    if is_wiring_unproven and _is_crossed(measured_g, expected_g):
        return f'{finding}: axis inverted or swapped; check wiring, mounting and pose'
    advice = ', or take the pose before again' if estimate.poses and is_wiring_unproven else ''
    angles_rad = estimate.angles_of(target.alpha_rad, target.beta_rad, volts, slack_v)
    distance = angle_fault(target, *angles_rad, tolerance_rad) if angles_rad else ''
    if distance:
        return f'{finding}: by the sensor, {distance}; check the pose and the mounting{advice}'
    return f'{finding}; check the pose, the mounting and the wiring{advice}'


def degrees_text(angle_rad: float) -> str:
    """Return the size of an angle as text, in degrees."""
    size = abs(float(np.degrees(angle_rad)))
    return f'{size:.2f}°' if size < 1 else f'{size:.1f}°'


def signed_text(value: float) -> str:
    """Return a value as text, with its sign."""
    return f'{value:+.2f}'.replace('-', '−')


def _is_crossed(measured_g: np.ndarray, expected_g: np.ndarray) -> bool:
    """Return whether axes with other signs, or in another order, read the expected values."""
    def is_expected(values_g: np.ndarray) -> bool:
        return bool(np.abs(values_g - expected_g).max() < _SAME_READING_G)

    if is_expected(measured_g):
        return False
    signs = product((1, -1), repeat=len(measured_g))
    orders = permutations(measured_g)
    return any(is_expected(np.array(sign) * order) for sign, order in product(signs, orders))


def _duration_text(seconds: float) -> str:
    return f'{seconds:.1f} s' if seconds < _LONGEST_IN_S else f'{seconds / 3600:.3g} h'


_CHANGE_G = 0.003
"""Largest change of a repeated pose beyond noise and stage error, g; chosen: a turn of 0.17°."""
_NOISE_STDS = 3.0
"""Standard deviations of the noise in the limit of a change; chosen: exceeded once in 400."""
_ACROSS_COSINE = 0.94
"""Cosine of 20°: two poses whose verticals are closer do not show each turn of the mounting."""


def to_take_again(records: Sequence[PoseRecord]) -> list[PoseRecord]:
    """
    Choose the poses of a journal that show the mounting when they are taken again.

    A turn about the vertical of the newest pose does not show there. The pose whose vertical is
    nearest to 90° from it comes second, if there is one.
    """
    newest = max(records, key=lambda record: record.stop_ns)
    across = min(records, key=lambda record: _alignment(record, newest))
    return [newest, across] if _alignment(across, newest) < _ACROSS_COSINE else [newest]


def changed(sensor: Sensor, before: PoseRecord, now: PoseRecord, tolerance_rad: float) -> str:
    """Compare two readings of the same pose, before and after an interruption."""
    before_v, now_v = np.array(before.mean_v), np.array(now.mean_v)
    change_g = np.abs(now_v - before_v) / sensor.nominal_scale_v_per_g
    noise_g = np.hypot(before.std_v, now.std_v) / sensor.nominal_scale_v_per_g
    # The stage may be off by its tolerance both times.
    limit_g = _CHANGE_G + _NOISE_STDS * noise_g + 2 * tolerance_rad
    axis = int((change_g - limit_g).argmax())
    if change_g[axis] <= limit_g[axis]:
        return ''
    return (f'mounting changed: in pose {before.pose + 1} {sensor.axes[axis]} reads '
            f'{now_v[axis]:.4f} V, but read {before_v[axis]:.4f} V before the interruption '
            f'({change_g[axis] * 1e3:.1f} mg apart, {limit_g[axis] * 1e3:.1f} mg are allowed); '
            'put the sensor back as it was, or begin again with resume:=anew')


def _alignment(first: PoseRecord, second: PoseRecord) -> float:
    """Return the cosine of the angle between the verticals of two poses, without its sign."""
    first_up = np.array(specific_force(first.alpha_rad, first.beta_rad, 1.0))
    second_up = np.array(specific_force(second.alpha_rad, second.beta_rad, 1.0))
    return abs(float(first_up @ second_up))


_KEPT_READINGS = 100_000
"""Readings that stay in memory; chosen: 1000 s at 100 Hz, longer than a usual dwell."""
_KEPT_OFFSETS = 20
"""Offsets of the two clocks that stay in memory; chosen: a second of messages at 20 Hz."""
_FEWEST_OFFSETS = 4
"""Offsets of the two clocks that a comparison needs; chosen: one message alone may be late."""
SILENT_S = 3.0
"""The encoder counts as silent after this, s; chosen: several of its longest usual periods."""


class EncoderTrack:
    """The newest readings of the encoder, against the stamps of the samples."""

    def __init__(self) -> None:
        self._readings: deque[tuple[int, float, float]] = deque(maxlen=_KEPT_READINGS)
        self._offsets_s: deque[float] = deque(maxlen=_KEPT_OFFSETS)
        self._has_new_reading = False

    @property
    def newest_ns(self) -> int | None:
        """Return the stamp of the newest reading, ns; None without one."""
        return self._readings[-1][0] if self._readings else None

    @property
    def angles_rad(self) -> tuple[float, float] | None:
        """Return the newest angles alpha and beta, rad; None without a reading."""
        return self._readings[-1][1:] if self._readings else None

    def read(self, stamp_ns: int, alpha_rad: float, beta_rad: float) -> bool:
        """Take a reading."""
        restarted = self.newest_ns is not None and went_back(self.newest_ns, stamp_ns)
        if restarted:
            self._readings.clear()
        self._readings.append((stamp_ns, alpha_rad, beta_rad))
        self._has_new_reading = True
        return restarted

    def compare_clock(self, sample_ns: int) -> None:
        """Compare the clock of a new reading with the newest stamp of the samples, ns."""
        if self._has_new_reading:
            self._offsets_s.append((self._readings[-1][0] - sample_ns) * 1e-9)
        self._has_new_reading = False

    def forget_clock(self) -> None:
        """Forget the comparisons, since the clock of the samples has changed."""
        self._offsets_s.clear()

    def clock_fault(self) -> str:
        """Return what is wrong with the clock of the encoder, or ''."""
        if len(self._offsets_s) < _FEWEST_OFFSETS:
            return ''
        # The smallest offset is that of the message with the least delay.
        return clock_fault(min(self._offsets_s, key=abs))

    def silence(self, sample_ns: int) -> str:
        """Return one line on the time without readings up to a stamp, ns; '' if it is short."""
        if not self._readings:
            return 'nothing on stage/joint_states'
        silent_s = (sample_ns - self._readings[-1][0]) * 1e-9
        if silent_s <= SILENT_S:
            return ''
        return f'nothing on stage/joint_states for {silent_s:.0f} s'

    def between(self, first_ns: int, last_ns: int) -> np.ndarray:
        """
        Return the angles between two stamps.

        returns: angles alpha and beta, rad, (n, 2).
        """
        inside = [(alpha_rad, beta_rad) for stamp_ns, alpha_rad, beta_rad in self._readings
                  if first_ns <= stamp_ns <= last_ns]
        return np.array(inside).reshape(-1, 2)

    def mean_between(self, first_ns: int, last_ns: int) -> tuple[float, float]:
        """
        Average the angles between two stamps; without any, take the newest ones.

        returns: angles alpha and beta, rad.
        """
        inside = self.between(first_ns, last_ns)
        alpha_rad, beta_rad = np.mean(
            inside if len(inside) else [self._readings[-1][1:]], axis=0)
        return float(alpha_rad), float(beta_rad)
