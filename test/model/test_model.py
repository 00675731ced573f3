# SPDX-License-Identifier: Apache-2.0

"""The model against the paper, the datasheet and closed forms; names of coefficients."""

import json

from adxl_ros.model import noise
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.accelerometer import direction
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.kinematics import gravity_slopes, specific_force
from adxl_ros.model.sensor import get, names_of, parameter_of, put, with_neutral
import numpy as np
import pytest
from units import Fed, nominal


def test_matrix_of_misalignment_equals_equations_18_and_19():
    """Equation 18 gives Θx of the paper. (19) is computed by hand, as Θy is misprinted there."""
    x = direction(0, np.radians(0.75), np.radians(-0.33))
    assert np.round(x, 4).tolist() == [0.9999, -0.0058, -0.0131]
    y = direction(1, np.radians(0.75), np.radians(0.5))
    assert np.round(y, 4).tolist() == [-0.0087, 0.9999, 0.0131]


def test_means_of_simulated_noise_have_the_predicted_deviation():
    sensor = nominal(adc_bits=0)
    fed = Fed(sensor, 5)
    volts = np.vstack(
        [fed([np.zeros(50000), np.zeros(50000), np.full(50000, 9.8)]) for _ in range(40)]
    )
    means = volts.reshape(400, 5000, 2).mean(axis=1)
    promised = noise.sample_std_v(sensor)[0] / np.sqrt(
        noise.effective_samples(5000, 1e-3, sensor.rc_s)
    )
    assert means.std() == pytest.approx(promised, rel=0.1)
    assert volts.std() == pytest.approx(noise.sample_std_v(sensor)[0], rel=0.02)


def test_stage_frames():
    """X is up at alpha 90°, beta 0; y is down at beta 90°; z is up at alpha 0."""
    quarter = np.pi / 2
    np.testing.assert_allclose(specific_force(quarter, 0.0, 9.8), [9.8, 0, 0], atol=1e-12)
    np.testing.assert_allclose(specific_force(quarter, quarter, 9.8), [0, -9.8, 0], atol=1e-12)
    np.testing.assert_allclose(specific_force(0.0, 1.0, 9.8), [0, 0, 9.8], atol=1e-12)


@pytest.mark.parametrize(
    ('text', 'coefficient'),
    [
        ('bias.offset_v.x', Coefficient('bias', 'offset_v', 'x')),
        ('time_offset.offset_s', Coefficient('time_offset', 'offset_s')),
    ],
)
def test_text_and_name_are_equivalent(text: str, coefficient: Coefficient) -> None:
    assert Coefficient.parse(text) == coefficient
    assert str(coefficient) == f'{coefficient}' == text
    with pytest.raises(TypeError):
        json.dumps(coefficient)  # reports hold the text


def test_names_of_an_effect() -> None:
    assert [str(name) for name in names_of(effect_named('lever_arm'), 'xy')] == [
        'lever_arm.x_m',
        'lever_arm.y_m',
        'lever_arm.z_m',
    ]
    assert names_of(effect_named('bias'), 'xy') == (
        Coefficient('bias', 'offset_v', 'x'),
        Coefficient('bias', 'offset_v', 'y'),
    )
    assert parameter_of(Coefficient('bias', 'offset_v', 'y')).unit == 'V'


def test_put_changes_a_copy() -> None:
    sensor = with_neutral(nominal('xy'), ['bias', 'gravity'])
    names = [Coefficient('bias', 'offset_v', 'y'), Coefficient('gravity', 'offset_mps2')]
    changed = put(sensor, names, [0.1, 0.02])
    assert get(changed, names).tolist() == [0.1, 0.02]
    assert get(sensor, names).tolist() == [0.0, 0.0]
    assert changed.zero_g_v.tolist() == [2.5, 2.6]


def test_the_slopes_of_gravity_are_its_derivatives():
    alpha_rad, beta_rad = np.random.default_rng(1).uniform(-np.pi, np.pi, (2, 20))
    step = 1e-6
    for i, (d_alpha, d_beta) in enumerate([(step, 0.0), (0.0, step)]):
        after = specific_force(alpha_rad + d_alpha, beta_rad + d_beta, 1.0)
        before = specific_force(alpha_rad - d_alpha, beta_rad - d_beta, 1.0)
        derivative = (np.array(after) - np.array(before)) / (2 * step)
        slopes = gravity_slopes(alpha_rad, beta_rad)[i]
        assert slopes == pytest.approx(derivative, abs=1e-8)
