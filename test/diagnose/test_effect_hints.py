# SPDX-License-Identifier: Apache-2.0

"""What the diagnosis needs to know about an effect stands in the effect's own file."""

import ast
from collections import Counter
from pathlib import Path

from adxl_ros import diagnose
from adxl_ros.diagnose.next_experiment import MENU
from adxl_ros.model.diagnosis_hints import (
    Detector,
    DriftSpectrum,
    FormDimension,
    Manoeuvre,
    StraightLine,
)
from adxl_ros.model.effects import library
from adxl_ros.model.effects.base import ActsOn, Need, Place
import pytest

MODULES = sorted(Path(diagnose.__file__).parent.glob('*.py'))


@pytest.mark.parametrize('module', MODULES, ids=lambda path: path.stem)
def test_diagnosis_names_no_effect(module):
    """A new effect needs no change of the diagnosis, because no table names effects."""
    tree = ast.parse(module.read_text(encoding='utf-8'))
    texts = {node.value for node in ast.walk(tree)
             if isinstance(node, ast.Constant) and isinstance(node.value, str)}
    assert not texts & set(library())


def test_each_detector_drift_and_straight_line_has_one_effect():
    """The diagnosis finds the effect of a detector, so that there must be exactly one."""
    hints = [effect.diagnosis for effect in library().values()]
    declared = Counter(value for hint in hints
                       for value in (hint.detector, hint.drift, hint.straight_line) if value)
    assert declared == Counter([*Detector, *DriftSpectrum, *StraightLine])


def test_effects_of_detectors_have_the_parameters_that_are_estimated():
    """A detection becomes the values of its effect in the parameter file."""
    estimated = {Detector.REPEATED_SAMPLES: {'rate_hz', 'duration_s'},
                 Detector.ISOLATED_SAMPLES: {'rate_hz', 'amplitude_v'},
                 Detector.COARSE_CODES: {'lost_bits', 'axis_lost_bits'},
                 Detector.MAINS_LINE: {'amplitude_v', 'frequency_hz', 'phase_rad'},
                 Detector.NOISE_LEVEL: {'ratio'}}
    for effect in library().values():
        if effect.diagnosis.detector:
            assert {p.name for p in effect.parameters} == estimated[effect.diagnosis.detector]


def test_menu_holds_every_manoeuvre():
    """An effect may name any manoeuvre."""
    assert set(MENU) == set(Manoeuvre)


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


def test_each_effect_declares_what_shows_it():
    """The report draws the proof of each effect over a variable that the effect declares."""
    assert [name for name, effect in library().items() if not effect.diagnosis.proof] == []
