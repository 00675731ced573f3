# SPDX-License-Identifier: Apache-2.0

"""Names of coefficients, and the statements of an effect about its parameters."""

from dataclasses import replace
import json

from adxl_ros.model.coefficients import get, names_of, parameter_of, put, with_neutral
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import ActsOn, Coefficient, Effect, Need, Parameter, Place, Role
import numpy as np
import pytest
from units import nominal


@pytest.mark.parametrize(('text', 'coefficient'), [
    ('bias.offset_v.x', Coefficient('bias', 'offset_v', 'x')),
    ('time_offset.offset_s', Coefficient('time_offset', 'offset_s'))])
def test_text_and_name_are_equivalent(text: str, coefficient: Coefficient) -> None:
    assert Coefficient.parse(text) == coefficient
    assert str(coefficient) == f'{coefficient}' == text
    with pytest.raises(TypeError):
        json.dumps(coefficient)  # reports hold the text


def test_names_of_an_effect() -> None:
    assert [str(name) for name in names_of(effect_named('lever_arm'), 'xy')] == [
        'lever_arm.x_m', 'lever_arm.y_m', 'lever_arm.z_m']
    assert names_of(effect_named('bias'), 'xy') == (
        Coefficient('bias', 'offset_v', 'x'), Coefficient('bias', 'offset_v', 'y'))
    assert parameter_of(Coefficient('bias', 'offset_v', 'y')).unit == 'V'


def test_put_changes_a_copy() -> None:
    sensor = with_neutral(nominal('xy'), ['bias', 'gravity'])
    names = [Coefficient('bias', 'offset_v', 'y'), Coefficient('gravity', 'offset_mps2')]
    changed = put(sensor, names, [0.1, 0.02])
    assert get(changed, names).tolist() == [0.1, 0.02]
    assert get(sensor, names).tolist() == [0.0, 0.0]
    assert changed.zero_g_v.tolist() == [2.5, 2.6]


def test_a_covariance_is_removed_completely() -> None:
    sensor = replace(nominal('x'), covariance=np.eye(1),
                     covariance_names=(Coefficient('bias', 'offset_v', 'x'),))
    bare = sensor.without_covariance()
    assert bare.covariance.shape == (0, 0)
    assert bare.covariance_names == ()


def test_equal_numbers_do_not_change_a_role() -> None:
    """A parameter keeps its role where the typical value is the neutral one, or a bound."""
    size = Parameter('offset_v', 'V', -1.0, 0.0, 0.0, 'made', 'offset', typical=0.0)
    assert size.role is Role.SIZE
    assert size.is_size
    shape = replace(size, role=Role.SHAPE)
    assert not shape.is_size


def test_an_effect_may_state_its_needs_as_text() -> None:
    """Effects of other packages may use the texts."""
    effect = Effect('made', Place.STAGE, (), lambda signals, p: None, 'Made.',
                    acts_on='noise', needs=('stage', 'adc'))
    assert effect.acts_on is ActsOn.NOISE
    assert effect.needs == (Need.STAGE, Need.ADC)
    with pytest.raises(ValueError, match='everything'):
        replace(effect, needs=('everything',))
