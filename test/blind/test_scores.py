# SPDX-License-Identifier: Apache-2.0
"""Scores of the blind check: the competition's utility, and what counts."""

from adxl_ros_validation.blind import grading, scores
from adxl_ros_validation.blind.grading import Answer, COMPONENTS, pair_utility, utility
from adxl_ros_validation.blind.trials import Label
import pytest


def label(group, effects=(), power=1.0, inseparable=()):
    """Return a label whose effects all have the same power and rivals."""
    shape = {'w': [0.0] * 6, 'hertz': 9.0}
    faults = [
        {
            'effect': name,
            'size': 1.0,
            'shape': shape,
            'strength_mps2': 0.01,
            'power': power,
            'told': 1.0,
            'inseparable': list(inseparable),
        }
        for name in effects
    ]
    return Label(
        'r0', group, tuple(effects), (1, 2, 3), (90.0, 200.0), 'rich', 'xyz', 0.01, faults, 1.0
    )


def diagnoses(*effects):
    return {frozenset(words.split()) for words in effects}


def test_utility_of_one_diagnosis():
    """The extremes are those of the competition, and a wrong blame costs a test in vain."""
    f = len(COMPONENTS)
    every, nothing, bias = frozenset(COMPONENTS), frozenset(), frozenset({'bias'})
    assert pair_utility(bias, bias) == pair_utility(nothing, nothing) == 1
    assert pair_utility(every, nothing) == pytest.approx(0)
    assert pair_utility(nothing, every) == pytest.approx(0)
    assert pair_utility(bias, nothing) == pytest.approx(1 - 1 / f)
    assert pair_utility(nothing, bias) == pytest.approx(1 - (f + 1) / (2 * f))
    assert pair_utility(frozenset({'gravity'}), bias) == pytest.approx(1 - 1 / f - 1 / 2)


def test_utility_of_ambiguity_groups():
    """The true group is best; more and fewer diagnoses lose, and a failure has none."""
    true = diagnoses('bias', 'gravity')
    assert utility(true, true) == 1
    assert utility(diagnoses('supply', 'gravity'), true) < 1
    assert utility(diagnoses('bias', 'gravity', 'supply'), true) < 1
    assert (
        utility(diagnoses('bias', 'gravity', 'supply'), diagnoses('bias'))
        < utility(diagnoses('bias', 'gravity'), diagnoses('bias'))
        < 1
    )
    assert utility(set(), true) == 0


def test_true_group_has_what_the_ideal_observer_cannot_separate():
    single = label('single', ['bias'], inseparable=['gravity', 'supply'])
    assert grading.true_group(single) == diagnoses('bias', 'gravity', 'supply')
    assert grading.true_group(label('single', ['bias'], 0.1)) == diagnoses('')
    assert grading.true_group(label('zero', ['bias'])) == diagnoses('')
    assert grading.true_group(label('outside', ['creep'])) == diagnoses('unknown')
    pair = label('pair', ['bias', 'gravity'], inseparable=['supply'])
    assert grading.true_group(pair) == diagnoses('bias gravity', 'bias supply', 'supply gravity')


def said(status, *effects, **words):
    return Answer(
        status,
        frozenset(effects),
        probability=0.8,
        hypotheses=((frozenset(effects), 0.8),),
        **words,
    )


def test_an_effect_below_the_material_amplitude_is_no_gap_if_the_limit_holds_it():
    """Its strength is 0.01 m/s²; a verdict may name it, and must not name another."""
    row = label('single', ['bias'])
    for material, limit, right in (
        (0.02, 0.015, True),
        (0.02, None, True),
        (0.02, 0.005, False),
        (0.001, 0.015, False),
    ):
        assert (
            grading.verdict_right(said('no_gap', material_mps2=material, limit_mps2=limit), row)
            == right
        )
    assert grading.verdict_right(said('explained', 'bias', material_mps2=0.02), row)
    assert not grading.verdict_right(said('explained', 'supply', material_mps2=0.02), row)
    assert grading.limit_holds(said('no_gap', limit_mps2=0.005), row) is False
    assert grading.limit_holds(said('no_gap', limit_mps2=0.005), label('none')) is True
    made = scores.scores(
        [scores.Trial(row, said('no_gap', material_mps2=0.02, limit_mps2=0.015), None)]
    )
    assert made['set_recall']['count'] == 0 and made['limit_held']['value'] == 1


@pytest.mark.parametrize(
    'name, value, ci, count, words',
    [
        ('calibration_error', 0.0484, (0.052, 0.09), 200, 'not refuted'),
        ('calibration_error', 0.06, (0.03, 0.09), 200, 'not refuted'),
        ('calibration_error', 0.03, (0.01, 0.049), 200, 'yes'),
        ('calibration_error', 0.08, (0.06, 0.09), 200, 'NO'),
        ('top_1', 0.95, (0.91, 0.99), 56, 'yes'),
        ('top_1', 0.8, (0.7, 0.91), 56, 'not refuted'),
        ('top_1', 0.75, (0.645, 0.832), 56, 'NO'),
        ('coverage', 0.496, (0.1, 0.95), 2, 'too few'),
        ('coverage', 0.5, (0.4, 0.99), 30, 'not refuted'),
        ('coverage', 0.9, (0.88, 0.92), 30, 'yes'),
        ('coverage', 0.99, (0.95, 1.0), 30, 'NO'),
    ],
)
def test_a_bar_is_met_not_refuted_or_refuted(name, value, ci, count, words):
    """Few trials show nothing, and an interval that reaches the bar does not refute it."""
    assert scores.outcome(scores.BARS[name], {'value': value, 'ci': ci, 'count': count}) == words


def test_an_ideal_observer_reaches_no_more_than_it_sees_and_tells():
    """A squared visibility of 4 shows with Φ(1), and the nearest rival is told with 0.7."""
    seen = label('single', ['bias'])
    seen.faults[0].update(visibility=4.0, told=0.7)
    made = scores.scores([scores.Trial(seen, Answer('unknown', frozenset({'unknown'})), None)])
    assert made['set_ideal']['value'] == pytest.approx(0.8413, abs=1e-4)
    row = scores.Trial(seen, Answer('unknown'), None).row()
    assert (row['ideal_names'], row['ideal_sees']) == (0.7, pytest.approx(0.8413, abs=1e-4))
