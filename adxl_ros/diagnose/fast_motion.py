# SPDX-License-Identifier: Apache-2.0
"""
Motion that the readings of a reference do not show, because it is too fast for them.

Where splines of two degrees through the same readings differ by more than the noise, the motion
between the readings is open, and the samples are left out. A reference that was smoothed lacks the
motion above some frequency.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from adxl_ros.diagnose.comparison import BaselineComparison, leave_out, Reference
from adxl_ros.files.recording_columns import JOINTS
from adxl_ros.files.stamps import stamped_rate_hz
from adxl_ros.model import noise
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.signals.block_statistics import bridged, true_runs
from adxl_ros.simulate.smoothed_path import BAND_LIMITED_DEGREE
import numpy as np
import scipy

_WINDOW_S = 1.0  # Length of a window whose spectrum is taken, s. Chosen: shorter than a move
_SHORTEST_WINDOW = 64  # Its fewest readings. Chosen: some periods of a shaker
_LARGEST_ERROR = 0.3
"""Error of the force by the spline, divided by the noise, up to which a window is used. Chosen: it
adds 4 % to the noise."""
_USUAL_STEP = 1.5  # Largest step between two readings, in medians of all: halfway to two steps
_SAME_MOTION = 2.0
"""Ratio of recorded and simulated motion from which one is an alias. Chosen: an alias below 0.2 of
the rate has a ratio of 4."""
_FEWEST_WINDOWS = 20
"""Fewest windows by which fading is judged. Chosen: noise then has a coherence of 0.05."""
_BAND_HZ = 2.0  # Width of its bands, Hz. Chosen: a line of the mains is one value
_MOTION_POWER_RATIO = 10.0
"""Power over that of the noise from which motion shows. Chosen: a single ordinate of noise exceeds
it once in e¹⁰, 22 000."""
_FADED_POWER_RATIO = 0.5
"""Power of the reference, even without the filter of the sensor, divided by the recorded one,
below which it has faded. Chosen: −3 dB, the usual corner of a filter."""
_JERK_S = 0.1
"""Time around a jerk of a robot that is left out, s. Chosen: that of the splines' knots."""
_LARGEST_JERK = 4.0
"""Error of the force, divided by the noise, from which it is a jerk. Chosen: the error of what
stays is below the noise, rms, and the filter for errors weighs it."""


def without_fast_motion(
    comparison: BaselineComparison, columns: dict[str, np.ndarray]
) -> BaselineComparison:
    """
    Leave out samples at which the reference moves faster than its readings show.

    Rests that the sensor shows stay; a stage may move at an alias of its readings where it seems
    to rest. Where readings are missing, or the output is beyond the range, that is the reason.
    """
    sensor = comparison.sensor
    robot = comparison.robot_force
    noise_g = float(np.min(noise.analog_std_v(sensor) / sensor.scale_v_per_g))
    if robot is not None:
        return _without_jerks(comparison, robot, noise_g)
    limit_g = _LARGEST_ERROR * max(noise_g, float(np.min(sensor.lsb_v / sensor.scale_v_per_g)))
    margin = np.ones(2 * round(_WINDOW_S / 2 * sensor.rate_hz) + 1)

    def near(rows: Any) -> np.ndarray:
        return np.convolve(rows, margin, 'same') > 0.5

    beyond = near(comparison.out_of_range.any(axis=1))
    rests = (
        comparison.at_rest
        if comparison.reference is Reference.SIMULATOR
        else np.zeros(len(comparison), bool)
    )
    for readings in _readings(comparison, columns):
        error_g = readings.error_g(comparison.time_s)
        coarse = comparison.used & ~rests & (error_g > np.hypot(limit_g, readings.step_g))
        if not coarse.any():
            continue
        rows = near(_with_aliases(comparison, coarse, noise_g)) & ~rests
        lacks = near(readings.lacks(comparison.time_s))
        error = f'(error up to {1e3 * error_g[rows].max():.2g} mg)'
        rate_hz = stamped_rate_hz(readings.time_s)
        reasons = [
            (
                beyond,
                f'the output is beyond the range of {sensor.range_g:g} g that the parameter file '
                f'states, in motion that {readings.name} does not follow {error}',
            ),
            (lacks, f'{readings.name} lacks readings there {error}'),
            (
                rows,
                f'{readings.name} moves too fast for its {rate_hz:.4g} readings a second {error}; '
                'read it at a higher rate',
            ),
        ]
        for explained, reason in reasons:
            comparison = leave_out(comparison, rows & explained, reason)
    return comparison


def _without_jerks(
    comparison: BaselineComparison, force: Any, noise_g: float
) -> BaselineComparison:
    """Leave out samples at which a robot jerks: its encoders do not show its acceleration."""
    error_g = np.abs(force.smoothing_mps2[:, : len(comparison.sensor.axes)]).max(axis=1) / G0_MPS2
    time_s = comparison.time_s
    rows = np.interp(time_s, force.time_s, error_g) > _LARGEST_JERK * noise_g
    rows |= (time_s < force.time_s[0] + _JERK_S) | (time_s > force.time_s[-1] - _JERK_S)
    margin = round(_JERK_S * comparison.sensor.rate_hz)
    return leave_out(
        comparison,
        np.convolve(rows, np.ones(2 * margin + 1), 'same') > 0.5,
        f'the robot jerks, which its encoders do not show (error up to {1e3 * error_g.max():.2g} '
        'mg); move more smoothly, or record the joints at a higher rate',
    )


@dataclass(frozen=True)
class _Readings:
    """The readings of a reference, and the splines that follow them."""

    name: str  # For people
    time_s: np.ndarray  # Times of the readings, s, (k,)
    values: np.ndarray  # Readings, (k, components)
    degrees: tuple[int, int]  # Degrees of two splines: where they agree, they show the motion
    order: int  # Derivative of the splines that is the force, g
    step_g: float  # Step of the readings

    def error_g(self, time_s: np.ndarray) -> np.ndarray:
        """Return the difference between the splines, g, (n,), by that between readings."""
        middle_s = (self.time_s[1:] + self.time_s[:-1]) / 2

        def force_g(degree: int) -> np.ndarray:
            spline = scipy.interpolate.make_interp_spline(self.time_s, self.values, degree)
            return spline(middle_s, self.order)

        low, high = self.degrees
        return np.interp(time_s, middle_s, np.abs(force_g(low) - force_g(high)).max(axis=1))

    def lacks(self, time_s: np.ndarray) -> np.ndarray:
        """Return where readings are missing between their neighbours, (n,) bool."""
        steps_s = np.diff(self.time_s)
        after = np.clip(np.searchsorted(self.time_s, time_s, 'right') - 1, 0, len(steps_s) - 1)
        return (steps_s > _USUAL_STEP * np.median(steps_s))[after]


def _readings(comparison: BaselineComparison, columns: dict[str, np.ndarray]) -> list[_Readings]:
    """Return the readings of another simulator, or of the joints that move."""
    sensor = comparison.sensor
    force = comparison.stated_force
    if force is not None:
        force_g = np.array(force(force.time_s))[: len(sensor.axes)].T / G0_MPS2
        return [_Readings(force.name, force.time_s, force_g, (3, 5), 0, 0.0)]
    if not comparison.joints:
        return []
    found = []
    for joint, name in JOINTS.items():
        values = columns.get(name, np.zeros(0))
        read = np.isfinite(values)
        if read.sum() <= BAND_LIMITED_DEGREE or not np.ptp(values[read]):
            continue
        readings = values[read, None]
        time_s = comparison.time_s[read]
        if joint == 'shift':
            degrees = (BAND_LIMITED_DEGREE - 2, BAND_LIMITED_DEGREE)
            found.append(_Readings(name, time_s, readings / G0_MPS2, degrees, 2, 0.0))
        else:
            step_g = sensor.stage_resolution_rad
            found.append(_Readings(name, time_s, readings, (3, 5), 0, step_g))
    return found


def _with_aliases(
    comparison: BaselineComparison, coarse: np.ndarray, noise_g: float
) -> np.ndarray:
    """Extend samples to the seconds beside them that move otherwise than simulated, (n,) bool."""
    sensor = comparison.sensor
    measured = comparison.measured
    length = max(round(_WINDOW_S * sensor.rate_hz), _SHORTEST_WINDOW)
    part = np.minimum(np.arange(len(coarse)) // length, max(len(coarse) // length - 1, 0))

    def motion_g(volts: np.ndarray) -> np.ndarray:
        """Return the rms of the changes from sample to sample with noise, by part and axis."""
        changes_g = np.diff(bridged(volts, measured) / sensor.scale_v_per_g, axis=0, prepend=0.0)
        squares_g2 = [np.bincount(part, c**2) / np.bincount(part) for c in changes_g.T]
        return np.sqrt(noise_g**2 + np.array(squares_g2))

    recorded = motion_g(comparison.volts)
    simulated = motion_g(comparison.simulated_v(sensor))
    differs = np.any(np.abs(np.log(recorded / simulated)) > np.log(_SAME_MOTION), axis=0)
    touched = np.bincount(part, coarse) > 0
    extended = coarse.copy()
    for begin, end in true_runs(differs | touched):
        if touched[begin:end].any():
            extended |= (part >= begin) & (part < end) & differs[part]
    return extended


def fading_frequency_hz(comparison: BaselineComparison) -> float | None:
    """Find the frequency above which the reference has less motion than the sensor."""
    if comparison.reference is not Reference.SIMULATOR:
        return None
    sensor = comparison.sensor
    size = max(round(_WINDOW_S * sensor.rate_hz), _SHORTEST_WINDOW)
    if len(comparison) < _FEWEST_WINDOWS * size // 2:
        return None
    within = comparison.measured & ~comparison.out_of_range.any(axis=1)
    frequency_hz = np.arange(size // 2 + 1) * sensor.rate_hz / size
    width = max(round(_BAND_HZ * size / sensor.rate_hz), 1)

    def power(volts: np.ndarray) -> np.ndarray:
        """Return the power density of all axes, g²/Hz, at frequencies above 0."""
        output_g = bridged(volts, within) / sensor.scale_v_per_g
        density = scipy.signal.welch(
            output_g, sensor.rate_hz, nperseg=size, detrend='linear', axis=0
        )[1]
        return density[1:].sum(axis=1)

    def by_band(density: np.ndarray) -> np.ndarray:
        return density[: (size // 2) // width * width].reshape(-1, width).mean(axis=1)

    # Without its RC filter the sensor has this gain over its simulation.
    rc_s = float(np.max(noise.electronics(sensor).rc_s))
    unfiltered = 1 + (2 * np.pi * frequency_hz[1:] * rc_s) ** 2
    recorded = by_band(power(comparison.volts))
    simulated = by_band(power(comparison.simulated_v(sensor)) * unfiltered)
    noise_g2 = noise.density_v2_per_hz(sensor, frequency_hz[1:]) / sensor.scale_v_per_g**2
    moves = recorded > _MOTION_POWER_RATIO * by_band(noise_g2.sum(1))
    followed = np.flatnonzero(moves & (simulated >= _FADED_POWER_RATIO * recorded))
    first = followed[-1] + 1 if len(followed) else 0
    return float(frequency_hz[1 + first * width]) if moves[first:].any() else None
