# SPDX-License-Identifier: Apache-2.0

"""The search on effects that are linear in their sizes, so that a fit has a closed form."""

from dataclasses import replace

from adxl_ros.diagnose.comparison import compare
from adxl_ros.diagnose.held_out import HeldOutFits
from adxl_ros.diagnose.linear_model import build_linear_model
from adxl_ros.diagnose.search import fit_hypothesis, linearise, Search
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.sensor import put, with_neutral
from gaps import simulated, turning, unit, warm
import numpy as np
import pytest
from units import nominal

LIBRARY = ('temperature_bias', 'lever_arm', 'quadratic')
PER_K = 4e-4
ARM_M = 0.03


def model_of(*effects, only=LIBRARY):
    sensor = unit()
    motion = warm(turning(alphas=(np.pi / 2, np.pi / 4)))
    recording = simulated(sensor, *effects, motion=motion)
    return build_linear_model([compare(recording, sensor)], only=only)


@pytest.fixture(scope='module')
def warmed():
    """Return the linear model of a unit whose zero-g follows the temperature."""
    return model_of(f'temperature_bias:per_k={PER_K}')


def test_the_sensitivity_to_a_temperature_is_its_difference(warmed):
    """Zero-g changes by per_k·(T − 25 °C), filtered by the sensor, which is fast."""
    effects = ['temperature_bias']
    linearised = linearise(warmed, effects, with_neutral(warmed.baseline, effects))
    (comparison,) = warmed.comparisons
    warmer_k = comparison.surroundings['temperature_c'] - 25.0
    for columns in linearised.columns:
        names = [linearised.names[place] for place in columns.places]
        column = columns.values[:, 1 + [n.parameter for n in names].index('per_k')]
        unit_v = np.ptp(column) / np.ptp(warmer_k)
        assert column == pytest.approx(unit_v * warmer_k, abs=0.02 * np.ptp(column))


def test_the_residual_at_the_prior_mean_does_not_depend_on_the_point(warmed):
    """An effect that is linear in its size is linearised to the same model everywhere."""
    effects = ['temperature_bias']
    sensor = with_neutral(warmed.baseline, effects)
    names = [Coefficient('temperature_bias', 'per_k', axis) for axis in 'xy']
    there = linearise(warmed, effects, put(sensor, names, np.array([3e-3, -2e-3])))
    here = linearise(warmed, effects, sensor)
    for one, other in zip(here.columns, there.columns):
        size_v = np.abs(one.values).max()
        assert other.values == pytest.approx(one.values, abs=1e-4 * size_v)


def test_a_fit_finds_the_sizes_within_their_deviations(warmed):
    hypothesis = fit_hypothesis(warmed, ['temperature_bias'], {}, {})
    sizes = {name: i for i, name in enumerate(hypothesis.names) if name.parameter == 'per_k'}
    assert len(sizes) == 2
    for i in sizes.values():
        assert hypothesis.std[i] < 0.2 * hypothesis.values[i]
    assert hypothesis.sizeless == frozenset()
    assert not hypothesis.at_bound


def test_an_effect_that_is_not_there_has_no_size(warmed):
    hypothesis = fit_hypothesis(warmed, ['lever_arm'], {}, {})
    assert hypothesis.sizeless == {'lever_arm'}


def test_a_true_effect_gains_evidence_and_another_one_none(warmed):
    nothing = fit_hypothesis(warmed, [], {}, {})
    true = fit_hypothesis(warmed, ['temperature_bias'], {}, {})
    false = fit_hypothesis(warmed, ['lever_arm'], {}, {})
    assert true.log_evidence > nothing.log_evidence + 10
    assert false.log_evidence < nothing.log_evidence + 3


def test_an_error_of_form_feeds_itself_and_no_further_effect():
    """A quadratic law with some cubic part has its own form; a lever arm is another cause."""
    laws = 'quadratic:quadratic_per_g=0.02', 'nonlinearity:cubic_per_g2=0.001'
    model = model_of(*laws, f'lever_arm:z_m={ARM_M}', only=(*LIBRARY, 'nonlinearity'))

    def left(*effects):
        fits = HeldOutFits(fit_hypothesis(model, effects, {}, {}).linearised, model)
        beside = fits.beside_form_errors(frozenset({'quadratic'}))
        return fits.figures.squares.sum(), beside.squares.sum()

    plain, beside = np.subtract(
        left('quadratic', 'lever_arm'), left('quadratic', 'lever_arm', 'nonlinearity')
    )
    assert beside < 0.1 * plain
    plain, beside = np.subtract(
        left('quadratic', 'nonlinearity'), left('quadratic', 'nonlinearity', 'lever_arm')
    )
    assert beside > 0.9 * plain


def test_a_decay_that_takes_for_ever_is_a_zero_g():
    """A warm-up of hours is constant within a minute; it is not named beside the zero-g."""
    sensor = replace(nominal('xy'), rate_hz=125.0, stage_resolution_rad=1e-4)
    recording = simulated(sensor, 'bias:offset_v=0.009', motion=turning())
    search = Search(build_linear_model([compare(recording, sensor)], only=('bias', 'warm_up')))
    search.run(lambda share: None)
    assert frozenset({'bias'}) in search.found
    assert frozenset({'warm_up'}) not in search.found


def test_the_search_ends_with_the_effects_that_act():
    model = model_of(f'temperature_bias:per_k={PER_K}', f'lever_arm:z_m={ARM_M}')
    search, shares = Search(model), []
    search.run(shares.append)
    assert {'temperature_bias', 'lever_arm'} <= {*search.best.effects}
    # Each of the best set was fitted alone, too, and the empty set is among them.
    assert {frozenset(), frozenset({'lever_arm'})} <= {*search.found}
    assert shares == sorted(shares)
    assert shares[-1] == 1.0
    arm_m = dict(zip(search.best.names, search.best.values))[Coefficient('lever_arm', 'z_m', '')]
    assert arm_m == pytest.approx(ARM_M, rel=0.05)
