# SPDX-License-Identifier: Apache-2.0

"""Noise of the samples: standard deviations, spectral density and effective sample counts."""

from __future__ import annotations

from typing import NamedTuple

from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Need, NOMINAL_ENVIRONMENT, Place, Signals
from adxl_ros.model.sensor import Sensor
import numpy as np

ONE_SIDED = float(np.sqrt(2))
"""Noise density of a datasheet, over positive frequencies alone, divided by the same over both
signs: N of IEEE Std 952 and `accelerometer_noise_density` of Kalibr, whose sample has the variance
N²·rate (ethz-asl/kalibr, wiki/IMU-Noise-Model)."""
_HARMONICS = 50  # Harmonics of rounding that are summed. Chosen: the others hold 1 %


class Electronics(NamedTuple):
    """RC filter and white noise of a unit."""

    rc_s: np.ndarray  # Time constant of the RC filter by axis, s, (m,)
    noise_ratio: np.ndarray  # Noise density divided by the nominal one, by axis, (m,)


def electronics(sensor: Sensor) -> Electronics:
    """Return filter and white noise of a unit by its effects."""
    count = len(sensor.axes)
    signals = Signals(NOMINAL_ENVIRONMENT, rc_s=[sensor.rc_s] * count, noise_ratio=[1.0] * count,
                      zero_g_v=sensor.nominal_zero_g_v.tolist(), output=[0.0] * count,
                      scale_v_per_g=sensor.nominal_scale_v_per_g.tolist())
    for effect in map(effect_named, sensor.effects):
        # They change nothing else, so that the rest of the chain need not run.
        if effect.needs in ((Need.FILTER,), (Need.NOISE,)) and effect.place is Place.ELECTRONICS:
            effect.apply(signals, sensor.parameters(effect.name))
    return Electronics(np.array(signals.rc_s), np.array(signals.noise_ratio))


def analog_std_v(sensor: Sensor) -> np.ndarray:
    """
    Return the standard deviation of the analog noise by axis, V, (m,).

    The noise is white before the RC filter. A first-order filter of time constant RC has the
    noise bandwidth 1/(4·RC) = f_c·π/2. Without a filter it is half the sample rate.
    """
    rc_s, noise_ratio = electronics(sensor)
    bandwidth_hz = np.where(rc_s > 0, 0.25 / np.where(rc_s > 0, rc_s, 1.0), sensor.rate_hz / 2)
    density = noise_ratio * sensor.noise_density_g_per_rthz * sensor.nominal_scale_v_per_g
    return density * np.sqrt(bandwidth_hz)


def sample_std_v(sensor: Sensor) -> np.ndarray:
    """Return the standard deviation of one sample by axis, V, (m,): analog noise and LSB²/12."""
    return np.hypot(analog_std_v(sensor), sensor.lsb_v / np.sqrt(12))


def held_rounding(sensor: Sensor) -> np.ndarray:
    """
    Return the share of the ADC's rounding that stays while the output stays, by axis, (m,).

    Noise of standard deviation σ makes the rounding random, of the variance LSB²/12. The part
    that depends on the mean output alone is a sawtooth, whose k-th harmonic has the variance
    LSB²/(2π²k²)·exp(−(2πkσ/LSB)²) (Widrow and Kollár 2008, section 4.4). Above half a step of
    noise nothing of it is left.
    """
    if not sensor.lsb_v:
        return np.zeros(len(sensor.axes))
    harmonics = np.arange(1, _HARMONICS + 1)[:, None]
    sigma_steps = analog_std_v(sensor) / sensor.lsb_v
    return np.sum(6 / (np.pi * harmonics) ** 2
                  * np.exp(-(2 * np.pi * harmonics * sigma_steps) ** 2), axis=0)


def density_v2_per_hz(sensor: Sensor, frequency_hz: np.ndarray) -> np.ndarray:
    """
    Return the one-sided spectral density of the samples' noise at frequencies, (k,): (k, m).

    The noise is the sum of an AR(1) sequence (Percival and Walden 1993, section 9.2) and of the
    ADC's quantisation, which is white.
    """
    rc_s = electronics(sensor).rc_s
    decay = np.where(rc_s > 0, np.exp(-1 / (sensor.rate_hz * np.where(rc_s > 0, rc_s, 1.0))), 0.0)
    turn = np.exp(-2j * np.pi * frequency_hz / sensor.rate_hz)[:, None]
    shape = (1 - decay ** 2) / np.abs(1 - decay * turn) ** 2
    return 2 / sensor.rate_hz * (analog_std_v(sensor) ** 2 * shape + sensor.lsb_v ** 2 / 12)


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
    correlated = 2 * a / (1 - a) * (1 - (1 - a ** n) / (n * (1 - a)))
    return n / (1 + correlated)
