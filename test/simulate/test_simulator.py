# SPDX-License-Identifier: Apache-2.0

"""The simulator against theory: rate, noise and motion."""

from dataclasses import replace

from adxl_ros.model import noise
from adxl_ros.model.effects import library
from adxl_ros.model.effects.base import ActsOn, Coefficient, Need
from adxl_ros.model.sensor import put, typical
from adxl_ros.simulate.motion import Motion
from adxl_ros.simulate.response import simulate
from adxl_ros.simulate.trajectories import rich, TRAJECTORIES
import numpy as np
from pace import within
import pytest
from scipy.signal import welch
from units import nominal

pytestmark = pytest.mark.long

AXES = 'xyz'
SLOW_HZ = 250.0
FASTER = 64  # By how much the fast simulation has more samples
CLEAN = {'noise_density_g_per_rthz': np.zeros(3), 'adc_bits': 0}


def with_all(sensor, acts_on=tuple(ActsOn)):
    names = [
        name for name, e in library().items() if e.acts_on in acts_on and Need.ROBOT not in e.needs
    ]
    values = {name: typical(library()[name], sensor.axes) for name in names}
    return replace(sensor, effects=tuple(names), values=values)


@pytest.mark.parametrize('everything', [False, True])
def test_rich_at_250_hz_equals_rich_at_16_khz(everything):
    sensor = nominal(AXES, **CLEAN)
    if everything:
        sensor = with_all(sensor, (ActsOn.MEAN,))
        limits = [Coefficient('saturation', 'limit_g', axis) for axis in AXES]
        sensor = put(sensor, limits, [1000.0] * len(limits))
    motion = rich(np.random.default_rng(0))
    if everything:
        motion = replace(motion, duration_s=150.0)
    slow = simulate(replace(sensor, rate_hz=SLOW_HZ), motion, 0)
    fast = simulate(replace(sensor, rate_hz=SLOW_HZ * FASTER), motion, 0)
    for name in ('x_v', 'y_v', 'z_v'):
        difference_v = slow[name] - fast[name][::FASTER][: len(slow[name])]
        assert np.sqrt(np.mean(difference_v**2)) < 1e-6


@pytest.mark.parametrize('name', sorted(TRAJECTORIES))
def test_velocity_and_acceleration_are_derivatives_of_the_position(name):
    """All manoeuvres but `motion` also begin and end at rest."""
    motion = TRAJECTORIES[name](np.random.default_rng(0))
    time_s = np.linspace(0, min(motion.duration_s, 300.0), 300001)
    for joint in (motion.alpha, motion.beta, motion.shift):
        position, velocity, acceleration = (joint(time_s, order) for order in range(3))
        by_s = 1 / time_s[1]
        assert np.abs(np.gradient(position) * by_s - velocity)[2:-2].max() < 1e-3
        assert np.abs(np.gradient(velocity) * by_s - acceleration)[2:-2].max() < 0.05
    if name != 'motion':
        for joint in (motion.alpha, motion.beta, motion.shift):
            assert np.abs(joint(np.array([0.0, motion.duration_s]), 1)).max() < 1e-9


@pytest.mark.perf
def test_ten_minutes_with_all_effects_take_seconds():
    sensor = with_all(nominal(AXES))
    motion = rich(np.random.default_rng(0))
    with within(3.0 * motion.duration_s / 600):
        simulate(sensor, motion, 0)


def at_rest_v(sensor, seed):
    """Return 50 minutes of the output at rest, V, (n, 3)."""
    columns = simulate(sensor, Motion(3000.0), seed)
    return np.column_stack([columns[f'{axis}_v'] for axis in AXES])


def test_noise_has_the_stated_spectrum_and_allan_deviation():
    sensor = nominal(AXES, adc_bits=0)
    step_s = 1 / sensor.rate_hz
    output_v = np.hstack([at_rest_v(sensor, seed) for seed in range(2)])
    f, densities = welch(output_v, sensor.rate_hz, nperseg=8192, axis=0)
    density = densities.mean(axis=1)
    decay = np.exp(-step_s / sensor.rc_s)
    variance = noise.analog_std_v(sensor)[0] ** 2
    theory = one_sided_density(variance, decay, step_s, f)
    for low, high in ((0.5, 3), (3, 15), (15, 60), (60, 450)):
        band = (f > low) & (f < high)
        assert density[band].mean() == pytest.approx(theory[band].mean(), rel=0.03)
    # The datasheet has 110 µg/√Hz, and the scale factor is 1 V/g.
    assert np.sqrt(density[(f > 0.3) & (f < 2)].mean()) == pytest.approx(110e-6, rel=0.03)
    for length in (10, 100, 1000):
        whole = len(output_v) // length * length
        means_v = output_v[:whole].reshape(-1, length, output_v.shape[1]).mean(axis=1)
        deviation_v = np.sqrt(np.mean(np.diff(means_v, axis=0) ** 2) / 2)
        expected_v = np.sqrt(allan_variance(variance, decay, length))
        assert deviation_v == pytest.approx(expected_v, rel=0.03)


def one_sided_density(variance, decay, step_s, f):
    """Return the one-sided spectral density of an AR(1) sequence of a variance."""
    below = 1 - 2 * decay * np.cos(2 * np.pi * f * step_s) + decay**2
    return 2 * step_s * variance * (1 - decay**2) / below


def allan_variance(variance, decay, length):
    """Return the Allan variance of an AR(1) sequence for means of `length` samples."""
    lag = np.arange(1 - length, length)
    weight = length - np.abs(lag)
    same = np.sum(weight * decay ** np.abs(lag))
    adjacent = np.sum(weight * decay ** np.abs(lag + length))
    return variance * (same - adjacent) / length**2
