# SPDX-License-Identifier: Apache-2.0

"""Noise of the samples: standard deviations, spectral density and effective sample counts."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from adxl_ros.model.constants import FINEST_V
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Environment, NOMINAL_ENVIRONMENT, Place, Value
from adxl_ros.model.sensor import Sensor
from adxl_ros.model.signal_chain import Chain
import numpy as np

ONE_SIDED = float(np.sqrt(2))
"""Noise density of a datasheet, over positive frequencies alone, divided by the same over both
signs: N of IEEE Std 952 and `accelerometer_noise_density` of Kalibr, whose sample has the variance
N²·rate (ethz-asl/kalibr, wiki/IMU-Noise-Model)."""
_NO_RC_S = 1e-9  # Smallest time constant, s. Chosen: no accelerometer has a filter of 160 MHz
_HARMONICS = 50  # Harmonics of rounding that are summed. Chosen: the others hold 1 %
_RAIL_STDS = 3.0
"""Distance of a mean from a rail of the ADC, in standard deviations of a sample, up to which its
samples were cut off there. Beyond it one sample of 700 is, which moves the mean by less than a
thousandth of that deviation; half of it would hide a shift of 3 %."""


class Electronics(NamedTuple):
    """RC filter, white noise and steps of a sensor at its sample rate, by axis, (m,)."""

    rc_s: np.ndarray  # Time constant of the RC filter, s
    noise_ratio: np.ndarray  # Noise density divided by the nominal one
    lsb_v: np.ndarray  # Step of the ADC, V; 0 where it does not quantise


def electronics(sensor: Sensor) -> Electronics:
    """Return filter, white noise and steps of a sensor by all its effects, of any package."""
    names = [name for name in sensor.effects if effect_named(name).place is Place.ELECTRONICS]
    chain = Chain(sensor, names)
    count = len(sensor.axes)
    # Arrays of one sample: effects with a memory take no floats.
    around = Environment(*(np.full(1, value) for value in NOMINAL_ENVIRONMENT))
    signals = chain.signals(
        around,
        time_s=around.time_s,
        dt_s=1 / sensor.rate_hz,
        force=[np.zeros(1)] * 3,
        sensed=[np.zeros(1)] * 3,
        output=[np.zeros(1)] * 3,
    )
    with np.errstate(all='ignore'):
        chain(Place.ELECTRONICS, signals)

    def by_axis(values: Iterable[Value]) -> np.ndarray:
        return np.array([float(np.ravel(value)[0]) for value in values])

    return Electronics(
        rc_s=by_axis(signals.rc_s[:count]),
        noise_ratio=by_axis(signals.noise_ratio[:count]),
        lsb_v=by_axis(signals.lsb_v),
    )


def filtered_bandwidth_hz(rc_s: np.ndarray, rate_hz: float) -> np.ndarray:
    """
    Return the noise bandwidth of white noise behind an RC filter, Hz, (m,).

    A first-order filter of time constant RC has the noise bandwidth 1/(4·RC) = f_c·π/2, however
    slow the ADC is: what is above half of its rate aliases. Without a filter it is half the rate.
    """
    return np.where(rc_s > 0, 0.25 / np.where(rc_s > 0, rc_s, 1.0), rate_hz / 2)


def analog_std_v(sensor: Sensor) -> np.ndarray:
    """
    Return the standard deviation of the noise behind the filter by axis, V, (m,).

    Where the parameter file states no filter, the density is that of the samples, up to half of
    their rate: a filter that an effect adds lets no more of it through.
    """
    circuit = electronics(sensor)
    bandwidth_hz = filtered_bandwidth_hz(circuit.rc_s, sensor.rate_hz)
    if not sensor.rc_s:
        bandwidth_hz = np.minimum(bandwidth_hz, sensor.rate_hz / 2)
    density = circuit.noise_ratio * sensor.noise_density_g_per_rthz * sensor.nominal_scale_v_per_g
    return density * np.sqrt(bandwidth_hz)


def sample_std_v(sensor: Sensor) -> np.ndarray:
    """Return the standard deviation of one sample by axis, V, (m,): analog noise and LSB²/12."""
    return np.hypot(analog_std_v(sensor), electronics(sensor).lsb_v / np.sqrt(12))


def held_rounding(sensor: Sensor) -> np.ndarray:
    """
    Return the share of the ADC's rounding that stays while the output stays, by axis, (m,).

    Noise of standard deviation σ makes the rounding random, of the variance LSB²/12. The part
    that depends on the mean output alone is a sawtooth, whose k-th harmonic has the variance
    LSB²/(2π²k²)·exp(−(2πkσ/LSB)²) (Widrow and Kollár 2008, section 4.4). Above half a step of
    noise nothing of it is left.
    """
    harmonics = np.arange(1, _HARMONICS + 1)[:, None]
    sigma_steps = analog_std_v(sensor) / np.maximum(electronics(sensor).lsb_v, FINEST_V)
    return np.sum(
        6 / (np.pi * harmonics) ** 2 * np.exp(-((2 * np.pi * harmonics * sigma_steps) ** 2)),
        axis=0,
    )


def held_rounding_v2(sensor: Sensor) -> np.ndarray:
    """Return the mean square of the rounding that stays while the output stays, V², (m,)."""
    return held_rounding(sensor) * electronics(sensor).lsb_v ** 2 / 12


def density_for_variance(variance: np.ndarray, rc_s: np.ndarray, rate_hz: float) -> np.ndarray:
    """Return the squared density before the filter, of samples' analog variance, by axis, (m,)."""
    return variance / filtered_bandwidth_hz(rc_s, rate_hz)


def white_share(rc_s: np.ndarray, rate_hz: float) -> np.ndarray:
    """
    Return the variance of samples behind a filter by that of white ones of the same low end, (m,).

    It is (1 − a)/(1 + a) = tanh(1/(2·RC·rate)) of the AR(1) sequence, and 1 without a filter.
    """
    return np.tanh(0.5 / (rate_hz * np.maximum(rc_s, _NO_RC_S)))


def rc_of_white_share(share: float, rate_hz: float) -> float:
    """Return the time constant, s, whose filter leaves a share of the variance; 0 for 1."""
    return 0.5 / (rate_hz * float(np.arctanh(share))) if share < 1 else 0.0


def density_v2_per_hz(sensor: Sensor, frequency_hz: np.ndarray) -> np.ndarray:
    """
    Return the one-sided spectral density of the samples' noise at frequencies, (k,): (k, m).

    The noise is the sum of an AR(1) sequence (Percival and Walden 1993, section 9.2) and of the
    ADC's quantisation, which is white.
    """
    rc_s, _, lsb_v = electronics(sensor)
    decay = np.where(rc_s > 0, np.exp(-1 / (sensor.rate_hz * np.where(rc_s > 0, rc_s, 1.0))), 0.0)
    turn = np.exp(-2j * np.pi * frequency_hz / sensor.rate_hz)[:, None]
    shape = (1 - decay**2) / np.abs(1 - decay * turn) ** 2
    return 2 / sensor.rate_hz * (analog_std_v(sensor) ** 2 * shape + lsb_v**2 / 12)


def effective_samples(count: int | np.ndarray, dt_s: float, rc_s: float) -> np.ndarray:
    """
    Count the independent samples that make a mean as good as `count` filtered ones.

    Noise behind a first-order filter is an AR(1) sequence with a = exp(−dt/RC). The variance of
    the mean of N samples is exactly σ²/N·[1 + 2·Σ (1 − k/N)·aᵏ]. 5000 samples at 1 kHz behind
    32 kΩ and 0.33 µF are 237.
    """
    n = np.asarray(count, float)
    if rc_s <= 0:
        return n
    a = np.exp(-dt_s / rc_s)
    correlated = 2 * a / (1 - a) * (1 - (1 - a**n) / (n * (1 - a)))
    return n / (1 + correlated)


def means_at_a_rail(sensor: Sensor, mean_v: np.ndarray) -> np.ndarray:
    """Return which means of samples, V, (k, m), are false as samples are at a rail, (k,) bool."""
    if not sensor.adc_bits:
        return np.zeros(len(mean_v), bool)
    reach_v = _RAIL_STDS * sample_std_v(sensor) + sensor.lsb_v
    highest_v = sensor.adc_vref_v - sensor.lsb_v
    is_cut_off = (np.abs(mean_v) < reach_v) | (np.abs(mean_v - highest_v) < reach_v)
    return is_cut_off.any(axis=1)
