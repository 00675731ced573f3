# SPDX-License-Identifier: Apache-2.0

"""Names of coefficients, and the statements of an effect about its parameters."""

import json

from adxl_ros.model.coefficients import get, names_of, parameter_of, put, with_neutral
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Coefficient
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
