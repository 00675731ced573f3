# SPDX-License-Identifier: Apache-2.0

"""The noise of each axis of a sensor at rest: fitted terms, drift, and what limits them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.files.exports import kalibr_settings
from adxl_ros.files.recording_columns import Recording, unit_of
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.noise import ONE_SIDED
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals import noise_parameters
from adxl_ros.signals.allan_deviation import longest_rest, StillStretch
from adxl_ros.signals.noise_parameters import Drift, Estimate, NoiseFit
from adxl_ros.signals.recorded_sensor import load_sensor, RESISTANCE_OHM
import numpy as np

TERMS = ('white', 'instability', 'walk')
"""The terms N, B and K, as the fields of `NoiseFit`."""

_UNFILTERED = 0.8
"""Variance of a sample, divided by that of unfiltered white noise, from which there is no filter.
Chosen: a filter at a third of the sample rate."""
_DITHERED_STEPS = 0.6
"""Noise from which rounding adds step²/12, steps. Chosen: exact within 0.4 % by the first harmonic
of the rounding error (Widrow and Kollár 2008, section 4.4)."""
_DENSITY = 'noise_density_g_per_rthz'
"""Field of a sensor that holds its white noise."""


@dataclass(frozen=True)
class AxisNoise:
    """The noise of one axis."""

    axis: str  # Its letter
    fit: NoiseFit  # White noise, bias instability and random walk, in m/s²
    drift: Drift | None  # A drift that is no noise; None where there is none
    sample_std: float  # Standard deviation of a sample, m/s²
    resolution: float  # Smallest change of a sample, m/s²
    rounding: float  # N of the rounding to this resolution, m/s²/√Hz, which `fit` does not contain
    # lowest_s, lowest: Time, s, and value, m/s², of the lowest point of the Allan deviation
    lowest_s: float
    lowest: float

    @property
    def estimates(self) -> tuple[Estimate, Estimate, Estimate]:
        """N in m/s²/√Hz, B in m/s², and K in m/s²/√s."""
        return self.fit.white, self.fit.instability, self.fit.walk

    @property
    def is_coarse(self) -> bool:
        """Whether rounding hides the noise."""
        return _is_coarse(self.sample_std, self.resolution)

    @property
    def sample_white(self) -> float:
        """N of the samples with their rounding, or its upper limit, m/s²/√Hz."""
        return float(np.hypot(_likely(self.fit.white), self.rounding))


@dataclass(frozen=True)
class RecordingNoise:
    """The noise of a recording."""

    path: str  # The recording
    sensor: Sensor  # Its parameter file
    unit: Sensor  # The nominal sensor that it comes from
    rest: StillStretch  # Its samples at rest
    axes: list[AxisNoise]  # The noise by axis


def recording_noise(read: Callable[[], Iterable[Recording]], params: str | None,
                    show: Callable[[float], None] = lambda done: None) -> RecordingNoise:
    """Fit the noise of all axes in the longest rest; `read` yields the blocks of a recording."""
    first = next(iter(read()), None)
    if first is None:
        raise UserError('the recording holds no samples')
    sensor = load_sensor(params, first)
    unit = unit_of(sensor, first.stream_info, first.axes)
    rest = longest_rest(read, unit, first)
    variances = noise_parameters.coefficient_variances(len(rest.means), rest.step_s)
    noises = []
    for i, axis in enumerate(unit.axes):
        means = rest.means[:, i]
        fit = noise_parameters.fit_noise(means, rest.step_s, variances)
        drift = noise_parameters.find_drift(means, rest.step_s, variances, fit, rest.temperature_c)
        deviation = rest.allan.deviation[:, i]
        lowest = int(np.argmin(deviation))
        std, resolution = float(rest.sample_std[i]), float(rest.resolution[i])
        rounding = resolution / float(np.sqrt(12 * rest.rate_hz))
        noises.append(AxisNoise(axis, without_rounding(fit, std, resolution, rounding), drift, std,
                                resolution, rounding, float(rest.allan.tau_s[lowest]),
                                float(deviation[lowest])))
        show((i + 1) / len(unit.axes))
    return RecordingNoise(first.path, sensor, unit, rest, noises)


def without_rounding(fit: NoiseFit, std: float, resolution: float, rounding: float) -> NoiseFit:
    """
    Return the noise before the rounding of the samples to a resolution.

    Above 0.6 steps of noise, rounding adds independent noise of the variance step²/12. Less noise
    is hidden: it may be anything up to that, and codes that do not change show less.

    std: standard deviation of a sample within some seconds, m/s²; resolution: smallest change of a
    sample, m/s².
    """
    if not _is_coarse(std, resolution):
        return replace(fit, white=Estimate(*(float(np.sqrt(max(value ** 2 - rounding ** 2, 0.0)))
                                             for value in fit.white)))
    widest = max(_DITHERED_STEPS * resolution / std, 1.0)
    white, instability, walk = (Estimate(term.value, 0.0, term.high * widest)
                                for term in (fit.white, fit.instability, fit.walk))
    return replace(fit, white=white, instability=instability, walk=walk)


def _is_coarse(std: float, resolution: float) -> bool:
    """Whether samples with rounding have less noise than makes rounding independent of them."""
    return std ** 2 < resolution ** 2 * (_DITHERED_STEPS ** 2 + 1 / 12)


def density_g_per_rthz(noise: AxisNoise) -> float | None:
    """Return the density of white noise as datasheets state it, g/√Hz; None if it is not seen."""
    white = noise.fit.white
    return ONE_SIDED * white.value / G0_MPS2 if white.is_seen else None


def _likely(estimate: Estimate) -> float:
    return estimate.value if estimate.is_seen else estimate.high


def with_noise(sensor: Sensor, noises: list[AxisNoise]) -> Sensor:
    """
    Give a sensor the measured noise.

    White noise is its density. Bias instability is the effect `flicker`, whose density over
    positive frequencies is B²/(π·f), and random walk is `bias_walk`. A term that is not seen on
    an axis keeps the value of `sensor` up to its upper limit. White noise that neither shows stays
    unstated, so that nobody takes it for 0. It has the rounding where `sensor` has no ADC.

    Where the filter is not stated, it is the first-order one that gives a sample the measured
    noise: white noise of the density 2·N² over positive frequencies has the variance N²/(2·RC)
    behind it. A rest shows neither range nor resolution: where they are not stated, the
    placeholders of `Sensor` stay, which limit and round nothing.
    """
    values = {name: value for name, value in sensor.values.items() if name != 'noise_excess'}
    to_g = np.array([ONE_SIDED, 1 / np.sqrt(np.pi), 1.0])[:, None] / G0_MPS2
    # By field of an estimate, term and axis.
    value, low, high = (np.array([noise.estimates for noise in noises]) * to_g).T

    def merged(term: int, before: np.ndarray | float) -> np.ndarray:
        return np.where(low[term] > 0, value[term], np.minimum(before, high[term]))

    for term, (effect, name) in enumerate((('flicker', 'density_g_per_rthz'),
                                           ('bias_walk', 'density_g_per_rts')), 1):
        sizes = merged(term, sensor.values.get(effect, {}).get(name, 0.0))
        values.pop(effect, None)
        if sizes.any():
            values[effect] = {name: sizes}
    if 'bias_walk' in values:
        values['bias_walk']['return_per_s'] = np.array(
            [1 / noise.fit.correlation.value if noise.fit.correlation else 0.0
             for noise in noises])
    kept = [name for name in sensor.effects if name in values]
    changed: dict[str, Any] = {
        'effects': (*kept, *(name for name in values if name not in kept)), 'values': values,
        'unstated': (_DENSITY,)}
    if _DENSITY not in sensor.unstated or (low[0] > 0).all():
        before = sensor.noise_density_g_per_rthz
        density = merged(0, np.where(before > 0, before, np.inf))
        if not sensor.adc_bits:
            rounding = [ONE_SIDED * noise.rounding / G0_MPS2 for noise in noises]
            density = np.where(low[0] > 0, np.hypot(density, rounding), density)
        changed |= {_DENSITY: density, 'unstated': ()}
    if 'rc_capacitance_f' in sensor.unstated:
        changed |= {'rc_resistance_ohm': RESISTANCE_OHM,
                    'rc_capacitance_f': _filter_s(noises, sensor.rate_hz) / RESISTANCE_OHM}
    return replace(sensor, **changed)


def _filter_s(noises: list[AxisNoise], rate_hz: float) -> float:
    """Return the time constant that the noise of a sample shows, s; 0 for no filter."""
    seen = [noise for noise in noises if noise.fit.white.is_seen]
    if not seen:
        return 0.0
    white = float(np.mean([noise.sample_white ** 2 for noise in seen]))
    variance = float(np.mean([noise.sample_std ** 2 for noise in seen]))
    return white / (2 * variance) if variance < _UNFILTERED * white * rate_hz else 0.0


_PX4_HZ = 100.0
"""Rate of the filter of PX4, Hz: EKF2_PREDICT_US is 10 000."""


Setting = tuple[str, list[float], str]
"""A line of another program's settings: name, one value or nine of a matrix, and their unit."""


def settings(noises: list[AxisNoise], rate_hz: float) -> dict[str, list[Setting]]:
    """
    Return the settings of other programs.

    kalibr takes N and K as they are. VINS-Fusion and PX4 add the variance of a value times the
    square of the time step, so they take N·√rate and K·√rate, at the rate of their filter.
    robot_localization takes the variance of a sample from the message. Programs that have one
    value for all axes get the largest one. A term that is not seen is its upper limit.
    """
    loudest = max(noises, key=lambda noise: noise.sample_white)
    walk = max((noise.fit.walk for noise in noises), key=lambda walk: walk.value)
    white, k = loudest.sample_white, walk.value
    if not walk.is_seen:
        k = max(noise.fit.walk.high for noise in noises)
    white_note, note = ('' if term.is_seen else ', an upper limit'
                        for term in (loudest.fit.white, walk))
    variances = [noise.sample_std ** 2 for noise in noises]
    matrix = np.diag((variances + [1e6] * 3)[:3]).ravel()

    def both(names: tuple[str, str], filter_hz: float, remark: str = '') -> list[Setting]:
        root = float(np.sqrt(filter_hz))
        return [(names[0], [white * root], f'm/s^2{remark}{white_note}'),
                (names[1], [k * root], f'm/s^3{note}')]

    return {
        'kalibr, imu.yaml': [
            (name, [value], unit + remark) for (name, value, unit), remark
            in zip(kalibr_settings(white, k, rate_hz), (white_note, note, ''))],
        f'VINS-Fusion, at {rate_hz:.4g} Hz': both(('acc_n', 'acc_w'), rate_hz),
        'robot_localization, in sensor_msgs/Imu of the driver': [
            ('linear_acceleration_covariance', matrix.tolist(), '(m/s^2)^2')],
        'PX4, its filter at 100 Hz; vibration in flight needs more': both(
            ('EKF2_ACC_NOISE', 'EKF2_ACC_B_NOISE'), _PX4_HZ, ', at least 0.01')}
