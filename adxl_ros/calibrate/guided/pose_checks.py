# SPDX-License-Identifier: Apache-2.0

"""
Checks of a pose: one line with the value that is wrong and what to do, or '' where all is well.

- The check that the sensor is mounted as it was when earlier poses were taken.
- What the encoder of the stage has read: angles over time, its silence and its clock.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

from adxl_ros.calibrate.guided.guide import went_back
from adxl_ros.calibrate.guided.pose_plan import Target
from adxl_ros.files.sweep_journal import PoseRecord
from adxl_ros.model.kinematics import specific_force
from adxl_ros.model.sensor import Sensor
import numpy as np

_CLOCK_OFFSET_S = 2.0
"""Largest offset of the clocks of stage and sensor, s; chosen: above any delay of messages."""
_RATE_ERROR = 0.05
"""Largest relative error of the sample rate; chosen: above the error of any oscillator."""
_LONGEST_IN_S = 600
"""Longest time that is stated in seconds; a longer time is stated in hours."""
_CHANGE_G = 0.003
"""Largest change of a repeated pose beyond noise and stage error, g; chosen: a turn of 0.17°."""
_NOISE_STDS = 3.0
"""Standard deviations of the noise in the limit of a change; chosen: exceeded once in 400."""
_ACROSS_COSINE = 0.94
"""Cosine of 20°: two poses whose verticals are closer do not show each turn of the mounting."""


def angle_fault(target: Target, alpha_rad: float, beta_rad: float, tolerance_rad: float) -> str:
    """Refuse a stage that is not at the pose."""
    return ', '.join(
        f'{name} is {_degrees(now - wanted)} from the target {np.degrees(wanted):.4g}°'
        for name, now, wanted in (('alpha', alpha_rad, target.alpha_rad),
                                  ('beta', beta_rad, target.beta_rad))
        if abs(now - wanted) > tolerance_rad)


def motion_fault(readings_rad: np.ndarray, tolerance_rad: float) -> str:
    """Refuse a stage whose encoder, (n, 2), turned while the pose was averaged."""
    for name, angles_rad in zip(('alpha', 'beta'), readings_rad.T):
        range_rad = float(np.ptp(angles_rad)) if len(angles_rad) else 0.0
        if range_rad > tolerance_rad:
            return (f'{name} moved {_degrees(range_rad)} while the pose was averaged; hold the '
                    'stage still')
    return ''


def saturation_fault(sensor: Sensor, volts: np.ndarray) -> str:
    """Refuse samples, V, (n, m), at a rail of the ADC or beyond the range of the sensor."""
    rows, columns = np.nonzero(sensor.saturated(volts))
    if not len(rows):
        return ''
    axis = int(columns[0])
    reading_v = volts[rows[0], axis]
    reading_g = (reading_v - sensor.nominal_zero_g_v[axis]) / sensor.nominal_scale_v_per_g[axis]
    return (f'saturated: {sensor.axes[axis]} reads {signed_text(reading_g)} g '
            f'({reading_v:.3f} V), beyond its range of ±{sensor.range_g:g} g or at a rail of the '
            'ADC; check supply and wiring')


def rate_fault(measured_hz: float, unit: Sensor) -> str:
    """Refuse samples whose rate is not that of the unit."""
    if not abs(measured_hz / unit.rate_hz - 1) > _RATE_ERROR:
        return ''
    expected = f'were {unit.rate_hz:.4g} at the start; keep the rate of the sensor' \
        if 'rate_hz' in unit.measured else \
        f'sensor_info states rate_hz {unit.rate_hz:.4g}; correct the rate of the driver'
    return f'samples are {measured_hz:.4g} a second by their stamps, but {expected}'


def _degrees(angle_rad: float) -> str:
    """Return the size of an angle as text."""
    size = abs(float(np.degrees(angle_rad)))
    return f'{size:.2f}°' if size < 1 else f'{size:.1f}°'


def signed_text(value: float) -> str:
    """Return a value as text, with its sign."""
    return f'{value:+.2f}'.replace('-', '−')


def to_take_again(records: Sequence[PoseRecord]) -> list[PoseRecord]:
    """
    Choose the poses of a journal that show the mounting when they are taken again.

    A turn about the vertical of the newest pose does not show there. The pose whose vertical is
    nearest to 90° from it comes second, if there is one.
    """
    def alignment(record: PoseRecord) -> float:
        verticals = [np.array(specific_force(pose.alpha_rad, pose.beta_rad, 1.0))
                     for pose in (record, newest)]
        return abs(float(verticals[0] @ verticals[1]))

    newest = max(records, key=lambda record: record.stop_ns)
    across = min(records, key=alignment)
    return [newest, across] if alignment(across) < _ACROSS_COSINE else [newest]


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
        self.newest_ns: int | None = None  # Stamp of the newest reading, ns
        self.angles_rad: tuple[float, float] | None = None  # Newest alpha and beta, rad
        self._readings: deque[tuple[int, float, float]] = deque(maxlen=_KEPT_READINGS)
        self._offsets_s: deque[float] = deque(maxlen=_KEPT_OFFSETS)
        self._is_compared = True

    def read(self, stamp_ns: int, alpha_rad: float, beta_rad: float) -> bool:
        """Take a reading; return whether its clock went back."""
        restarted = went_back(self.newest_ns, stamp_ns)
        if restarted:
            self._readings.clear()
        self._readings.append((stamp_ns, alpha_rad, beta_rad))
        self.newest_ns, self.angles_rad = stamp_ns, (alpha_rad, beta_rad)
        self._is_compared = False
        return restarted

    def compare_clock(self, sample_ns: int) -> None:
        """Compare the clock of a new reading with the newest stamp of the samples, ns."""
        if not self._is_compared and self.newest_ns is not None:
            self._offsets_s.append((self.newest_ns - sample_ns) * 1e-9)
        self._is_compared = True

    def forget_clock(self) -> None:
        """Forget the comparisons, since the clock of the samples has changed."""
        self._offsets_s.clear()

    def clock_fault(self) -> str:
        """Return what is wrong with the clock of the encoder, or ''."""
        # The smallest offset is that of the message with the least delay.
        ahead_s = min(self._offsets_s, key=abs) \
            if len(self._offsets_s) >= _FEWEST_OFFSETS else 0.0
        size_s = abs(ahead_s)
        if size_s <= _CLOCK_OFFSET_S:
            return ''
        size = f'{size_s:.1f} s' if size_s < _LONGEST_IN_S else f'{size_s / 3600:.3g} h'
        return (f'stage/joint_states is stamped {size} {"ahead of" if ahead_s > 0 else "behind"} '
                'imu/data_raw: stage and sensor must share one clock (use_sim_time for both or '
                'for none, or synchronise their computers)')

    def silence(self, sample_ns: int) -> str:
        """Return one line on the time without readings up to a stamp, ns; '' if it is short."""
        if self.newest_ns is None:
            return 'nothing on stage/joint_states'
        silent_s = (sample_ns - self.newest_ns) * 1e-9
        return f'nothing on stage/joint_states for {silent_s:.0f} s' if silent_s > SILENT_S else ''

    def between(self, first_ns: int, last_ns: int) -> np.ndarray:
        """Return the angles alpha and beta between two stamps, rad, (n, 2)."""
        inside = [angles_rad for stamp_ns, *angles_rad in self._readings
                  if first_ns <= stamp_ns <= last_ns]
        return np.array(inside).reshape(-1, 2)

    def mean_between(self, first_ns: int, last_ns: int) -> tuple[float, float]:
        """Average the angles between two stamps, rad; without any, take the newest ones."""
        inside = self.between(first_ns, last_ns)
        alpha_rad, beta_rad = np.mean(inside if len(inside) else [self.angles_rad], axis=0)
        return float(alpha_rad), float(beta_rad)
