# SPDX-License-Identifier: Apache-2.0

"""The model compared with values of the paper, of the datasheet and of closed forms."""

from adxl_ros.model import noise, signal_chain
from adxl_ros.model.coefficients import with_neutral
from adxl_ros.model.effects import library
from adxl_ros.model.effects.misalignment import direction
from adxl_ros.model.kinematics import specific_force
import numpy as np
import pytest
from units import Fed, nominal


def test_matrix_of_misalignment_equals_equations_18_and_19():
    """Equation 18 gives Θx of the paper. (19) is computed by hand, as Θy is misprinted there."""
    x = direction(0, np.radians(0.75), np.radians(-0.33))
    assert np.round(x, 4).tolist() == [0.9999, -0.0058, -0.0131]
    y = direction(1, np.radians(0.75), np.radians(0.5))
    assert np.round(y, 4).tolist() == [-0.0087, 0.9999, 0.0131]


def test_noise_of_the_filter():
    """110 µg/√Hz behind 32 kΩ and 0.33 µF: 0.535 mg, which is 5.25 mm/s²."""
    sensor = nominal()
    assert 1 / (2 * np.pi * sensor.rc_s) == pytest.approx(15.07, abs=0.005)
    assert noise.analog_std_v(sensor)[0] == pytest.approx(0.535e-3, rel=1e-3)
    assert noise.analog_std_v(sensor)[0] * 9.80665 == pytest.approx(5.25e-3, rel=1e-3)


def test_effective_samples_of_a_dwell():
    """5 s at 1 kHz behind the filter are about 237 independent samples."""
    assert noise.effective_samples(5000, 1e-3, nominal().rc_s) == pytest.approx(237, abs=0.5)
    assert noise.effective_samples(5000, 1e-3, 0.0) == 5000


def test_means_of_simulated_noise_have_the_predicted_deviation():
    """Means over 5 s of simulated noise have a standard deviation of σ/√237."""
    sensor = nominal(adc_bits=0)
    fed = Fed(sensor, 5)
    volts = np.vstack([fed([np.zeros(50000), np.zeros(50000), np.full(50000, 9.8)])
                       for _ in range(40)])
    means = volts.reshape(400, 5000, 2).mean(axis=1)
    promised = noise.sample_std_v(sensor)[0] / np.sqrt(noise.effective_samples(
        5000, 1e-3, sensor.rc_s))
    assert means.std() == pytest.approx(promised, rel=0.1)
    assert volts.std() == pytest.approx(noise.sample_std_v(sensor)[0], rel=0.02)


def test_filter_at_10_hz():
    """A 10 Hz sine behind the filter: amplitude 0.833, phase −33.6°."""
    sensor = nominal(adc_bits=0, noise_density_g_per_rthz=np.zeros(2))
    time = np.arange(5000) / 1000
    shake = np.sin(2 * np.pi * 10 * time)
    volts = Fed(sensor)([shake, 0 * shake, 0 * shake + 9.8])[:, 0]
    late = time > 1
    wave = np.exp(-2j * np.pi * 10 * time[late])
    ratio = ((volts[late] - 2.5) * wave).mean() / (shake[late] / 9.80665 * wave).mean()
    assert abs(ratio) == pytest.approx(0.833, abs=0.001)
    assert np.degrees(np.angle(ratio)) == pytest.approx(-33.6, abs=0.05)


def test_samples_do_not_depend_on_the_blocks():
    """The chain gives the same samples in one block and in many."""
    sensor = nominal()
    force = specific_force(np.linspace(0, 1, 1000), np.linspace(0, 2, 1000), 9.8)
    at_once, parts = Fed(sensor, 3)(force), Fed(sensor, 3)
    parts = [parts([f[i:i + 77] for f in force]) for i in range(0, 1000, 77)]
    np.testing.assert_array_equal(at_once, np.vstack(parts))


@pytest.mark.parametrize('name', sorted(library()))
def test_neutral_effect_is_identity(name):
    """An effect with neutral parameters changes no bit."""
    plain = nominal('xyz')
    neutral = with_neutral(plain, [name])
    force = specific_force(np.linspace(-3, 3, 50), np.linspace(-2, 4, 50), 9.8)
    for before, after in zip(signal_chain.static_response(plain)(force),
                             signal_chain.static_response(neutral)(force)):
        np.testing.assert_array_equal(before, after)


def test_stage_frames():
    """X is up at alpha 90°, beta 0; y is down at beta 90°; z is up at alpha 0."""
    quarter = np.pi / 2
    np.testing.assert_allclose(specific_force(quarter, 0.0, 9.8), [9.8, 0, 0], atol=1e-12)
    np.testing.assert_allclose(specific_force(quarter, quarter, 9.8), [0, -9.8, 0], atol=1e-12)
    np.testing.assert_allclose(specific_force(0.0, 1.0, 9.8), [0, 0, 9.8], atol=1e-12)
