# SPDX-License-Identifier: Apache-2.0

"""What the diagnosis needs to know about an effect stands in the effect's own file."""

import ast
from importlib import import_module
from pathlib import Path

from adxl_ros.diagnose.data_faults import DATA_FAULTS
from adxl_ros.model.effects import library
from adxl_ros.model.effects.base import ActsOn, FormDimension, Need, Place
import pytest

MODULES = sorted(Path(import_module('adxl_ros.diagnose').__file__).parent.glob('*.py'))


@pytest.mark.parametrize('module', MODULES, ids=lambda path: path.stem)
def test_diagnosis_names_no_effect(module):
    """A new effect needs no change of the diagnosis, because no table names effects."""
    tree = ast.parse(module.read_text(encoding='utf-8'))
    texts = {
        node.value
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }
    # The fault of the data `gravity` is named like an effect.
    assert not texts & (set(library()) - set(DATA_FAULTS))


@pytest.mark.parametrize('effect', library().values(), ids=lambda effect: effect.name)
def test_a_form_is_tolerant_unless_it_is_exact(effect):
    """An effect of the mean states over what its form differs; geometry and noise do not."""
    form = effect.diagnosis.form
    exact = effect.exact or effect.acts_on is ActsOn.NOISE
    assert bool(form) is not exact
    assert len(set(form)) == len(form)
    assert all(isinstance(dimension, FormDimension) for dimension in form)


@pytest.mark.parametrize('effect', library().values(), ids=lambda effect: effect.name)
def test_a_form_differs_over_what_the_effect_follows(effect):
    """An effect of the surroundings differs over these; only the stage differs over angles."""
    form = {dimension.value for dimension in effect.diagnosis.form}
    assert set(effect.follows) <= form
    assert not form & {'temperature_c', 'supply_v', 'time_s'} - set(effect.follows)
    if Need.STAGE not in effect.needs:
        assert not form & {'alpha_rad', 'beta_rad', 'rate', 'since_move_s'}
    if effect.place is Place.ADC and form:
        assert form == {'code'}
