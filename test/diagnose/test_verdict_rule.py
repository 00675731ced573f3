# SPDX-License-Identifier: Apache-2.0

"""The rule of the verdict on figures that are made by hand: 48 blocks of 100 samples."""

from dataclasses import replace
from types import SimpleNamespace

from adxl_ros.diagnose.evidence import BLOCKS
from adxl_ros.diagnose.held_out import HeldOut
from adxl_ros.diagnose.remainder import Remainder
from adxl_ros.diagnose.verdict import block_weights, decide, NoiseCause
from adxl_ros.diagnose.weighing import ByDraw, Evidence, HEALTHY, SimulatedAgain
import numpy as np
import pytest

SAMPLES = 100.0
FLOOR = 1.0
"""Mean square of the noise; all powers below are in its unit."""
NOTHING = frozenset()
BIAS = frozenset({'bias'})
LEVER_ARM = frozenset({'lever_arm'})


def fits(left, drift_mps2=None, seed=1, nats=480.0, tolerated=0.0):
    """Return held-out figures of a set that leaves a power above the floor, with some scatter."""
    scatter = 1 + 0.01 * np.random.default_rng(seed).normal(size=BLOCKS)
    squares = (FLOOR + left) * SAMPLES * scatter
    figures = HeldOut(squares, -squares / FLOOR / 2)
    healthy = SimpleNamespace(
        figures=figures,
        tolerated=np.full(BLOCKS, tolerated * SAMPLES),
        by_quarter=figures.log_likelihood,
        beside_form_errors=lambda effects: figures,
    )
    made = {HEALTHY: healthy}
    if drift_mps2 is not None:
        made['bias_walk'] = drifting(figures, drift_mps2, nats)
    return made


def drifting(figures, drift_mps2, nats):
    """Return held-out figures of a set in the noise of a drift that is so much likelier."""
    likely = figures.log_likelihood + nats / BLOCKS
    return SimpleNamespace(
        figures=HeldOut(figures.squares, likely),
        by_quarter=likely,
        drift_mps2=drift_mps2,
        squares_between=lambda other: np.full(BLOCKS, 5 * SAMPLES),
    )


def remainder(power=0.0, dimension='force'):
    """Return what flexible functions explain beyond the best set."""
    squares = np.full(BLOCKS, power * SAMPLES)
    return Remainder(squares, {dimension: squares}, {dimension: squares[None] / FLOOR / 2})


def decided(
    candidates,
    left_over=0.0,
    in_noise=(),
    material=0.1,
    dimension='force',
    only=(),
    floor_error=0.0,
    vibration=0.0,
):
    floor = FLOOR + floor_error * np.random.default_rng(2).normal(size=len(block_weights(0)))
    floor[0] = FLOOR
    evidence = Evidence(
        candidates=candidates,
        counts=np.full(BLOCKS, SAMPLES),
        weights=block_weights(0),
        material_mps2=material**0.5,
        reference_mps2=0.0,
        errs_in_motion=False,
        fades=False,
        wanders=False,
        floor=ByDraw(floor),
    )
    left = remainder(left_over, dimension)
    if only:
        shares = np.isin(np.arange(BLOCKS), only) * BLOCKS / len(only)
        left = replace(left, squares=left.squares * shares)
    again = SimulatedAgain(
        printed=np.zeros(BLOCKS),
        more_at_rest=np.zeros(1),
        resting=0.0,
        at_bound=False,
        vibration=np.full(BLOCKS, vibration * SAMPLES),
    )
    return decide(evidence, lambda effects, drift: left, in_noise, lambda effects: again)


def test_nothing_above_the_noise_is_no_gap():
    verdict = decided({NOTHING: fits(0.0), BIAS: fits(0.0)})
    assert (verdict.status, verdict.effects) == ('no_gap', ())


def test_one_effect_that_explains_all_is_named():
    verdict = decided({NOTHING: fits(5.0), BIAS: fits(0.0), LEVER_ARM: fits(4.0)})
    assert (verdict.status, verdict.effects) == ('explained', ('bias',))
    assert verdict.explained.value == pytest.approx(5.0, rel=0.02)


def test_two_effects_that_explain_alike_are_inseparable():
    verdict = decided({NOTHING: fits(5.0), BIAS: fits(0.0), LEVER_ARM: fits(0.001)})
    assert (verdict.status, verdict.groups) == ('inseparable', (('bias', 'lever_arm'),))


def test_a_second_effect_must_explain_more_than_what_is_material():
    pair = BIAS | LEVER_ARM
    alone = {NOTHING: fits(5.0), BIAS: fits(0.05), LEVER_ARM: fits(4.9), pair: fits(0.0)}
    assert decided(alone).effects == ('bias',)
    both = {**alone, BIAS: fits(2.0), LEVER_ARM: fits(3.0)}
    assert decided(both).effects == ('bias', 'lever_arm')


@pytest.mark.parametrize(('form_error', 'named'), [(0.0, ('bias', 'lever_arm')), (0.3, ('bias',))])
def test_a_weak_second_effect_must_exceed_an_error_of_form_of_the_first(form_error, named):
    """It holds a sixteenth of what the pair explains; an error of form may explain as much."""
    candidates = {
        NOTHING: fits(5.0),
        BIAS: fits(0.3),
        LEVER_ARM: fits(4.5),
        BIAS | LEVER_ARM: fits(0.0),
    }
    for effects, made in candidates.items():
        left = 0.3 - form_error if effects == BIAS else 0.0
        beside = dict.fromkeys(candidates, fits(left)[HEALTHY].figures)
        made[HEALTHY].beside_errors = beside
        made[HEALTHY].beside_form_errors = beside.get
    assert decided(candidates).effects == named


def test_what_repeats_beside_an_effect_is_said():
    verdict = decided({NOTHING: fits(5.0), BIAS: fits(1.0)}, left_over=1.0)
    assert (verdict.status, verdict.effects) == ('partly', ('bias',))
    assert verdict.remainder.value == pytest.approx(1.0)


@pytest.mark.parametrize(('left', 'status'), [(0.0, 'inseparable'), (1.5, 'unknown')])
def test_rivals_that_leave_what_repeats_only_imitate_it(left, status):
    """Two effects that leave a part of a gap, the second of which may be another one."""
    other = frozenset({'nonlinearity'})
    candidates = {
        NOTHING: fits(9.0 + left),
        BIAS: fits(5.0 + left),
        LEVER_ARM: fits(7.0 + left),
        other: fits(7.0 + left),
        BIAS | LEVER_ARM: fits(left),
        BIAS | other: fits(0.001 + left),
    }
    assert decided(candidates, left_over=left).status == status


@pytest.mark.parametrize(('share', 'status'), [(0.1, 'explained'), (-0.1, 'unknown')])
def test_an_effect_must_gain_in_whole_quarters(share, status):
    """
    What imitates a jump between neighbouring blocks does not predict a whole quarter.

    What shows in one quarter alone, as a filter does where it is shaken, gains less there.
    """
    candidates = {NOTHING: fits(5.0), BIAS: fits(0.0)}
    without, with_it = candidates[NOTHING][HEALTHY], candidates[BIAS][HEALTHY]
    gained = with_it.by_quarter - without.by_quarter
    with_it.by_quarter = without.by_quarter + share * gained
    assert decided(candidates).status == status


def test_what_repeats_and_no_effect_explains_is_unknown():
    verdict = decided({NOTHING: fits(5.0), BIAS: fits(4.5)}, left_over=4.0)
    assert (verdict.status, verdict.effects) == ('unknown', ())


def test_a_name_that_most_draws_do_not_support_is_not_stated():
    """What is left is in two blocks: beyond its interval it is nothing, in most draws it is."""
    candidates = {NOTHING: fits(2.0), BIAS: fits(0.0)}
    assert decided(candidates, left_over=3.0, only=(3, 30)).status == 'unknown'
    assert decided(candidates, left_over=1.0, only=(3, 30)).effects == ('bias',)


def test_effects_that_explain_less_than_they_leave_are_no_cause():
    """What jumps from sample to sample repeats with nothing, and is left above the floor."""
    verdict = decided({NOTHING: fits(5.0), BIAS: fits(3.0)})
    assert (verdict.status, verdict.effects) == ('unknown', ())
    assert decided({NOTHING: fits(5.0), BIAS: fits(2.0)}).status == 'partly'
    hum = NoiseCause('mains_hum', 3.0, is_left_out=False)
    beside = decided({NOTHING: fits(5.0), BIAS: fits(3.0)}, in_noise=[hum])
    assert beside.effects == ('bias', 'mains_hum')


def test_vibration_of_the_stage_makes_no_cause_unknown():
    """It shows only while joints move, so that it is of the motor or the mount."""
    candidates = {NOTHING: fits(5.0), BIAS: fits(3.0)}
    verdict = decided(candidates, vibration=2.5)
    assert (verdict.status, verdict.effects) == ('partly', ('bias',))
    assert verdict.vibration_mps2**2 == pytest.approx(2.5)
    assert decided(candidates, vibration=0.5).status == 'unknown'


def test_what_is_left_counts_beyond_the_interval_of_the_floor():
    """A floor from a few samples at rest may be higher than it seems."""
    candidates = {NOTHING: fits(0.5), BIAS: fits(0.3)}
    assert decided(candidates).status == 'unknown'
    assert decided(candidates, floor_error=0.3).effects == ('bias',)


def test_samples_that_are_left_out_explain_nothing_of_the_others():
    stuck = NoiseCause('stuck', np.inf, is_left_out=True)
    assert decided({NOTHING: fits(5.0)}, left_over=5.0, in_noise=[stuck]).status == 'unknown'
    both = {NOTHING: fits(5.0), BIAS: fits(3.0)}
    assert decided(both, in_noise=[stuck]).status == 'unknown'


def test_an_effect_of_the_noise_is_named_beside_no_gap_of_the_mean():
    verdict = decided({NOTHING: fits(0.0)}, in_noise=[NoiseCause('spikes', 1.0, True)])
    assert (verdict.status, verdict.effects) == ('explained', ('spikes',))


def test_a_drift_is_weighed_with_the_set_that_it_needs():
    """Beside white noise an effect takes up a part of a drift that is likelier without it."""
    candidates = {
        NOTHING: fits(5.0, drift_mps2=2.0, nats=30_000.0),
        BIAS: fits(2.0, drift_mps2=1.0, nats=10_000.0),
    }
    assert decided(candidates).effects == ('bias_walk',)
    # What the force predicts is no drift; what time predicts may be.
    assert decided(candidates, left_over=0.1, dimension='time_s').effects == ('bias_walk',)
    assert decided(candidates, left_over=0.1, dimension='force').status == 'unknown'
    too_large = {**candidates, NOTHING: fits(5.0, drift_mps2=6.0, nats=30_000.0)}
    assert decided(too_large).status == 'unknown'
    # Another drift is less likely, but not too large.
    beside = drifting(too_large[NOTHING][HEALTHY].figures, 2.0, 20_000.0)
    flicker = {**candidates, NOTHING: {**too_large[NOTHING], 'flicker': beside}}
    assert decided(flicker).effects == ('flicker',)


def test_what_errors_of_form_explain_is_no_drift():
    """Beside them the samples are more probable than in noise that drifts."""
    candidates = {NOTHING: fits(50.0, 2.0), BIAS: fits(5.0, drift_mps2=2.0, nats=480.0)}
    assert decided(candidates).effects == ('bias', 'bias_walk')
    figures = candidates[BIAS][HEALTHY].figures
    likelier = figures._replace(log_likelihood=figures.log_likelihood + 500.0 / BLOCKS)
    candidates[BIAS][HEALTHY].beside_form_errors = lambda effects: likelier
    assert decided(candidates, left_over=0.0).effects == ('bias',)


def test_beside_a_drift_an_effect_is_needed_only_where_it_surely_predicts():
    """What predictions differ by is a square, which is never below 0."""
    for surely, named in ((True, ('bias', 'bias_walk')), (False, ('bias_walk',))):
        nothing = fits(5.0, drift_mps2=2.0, nats=30_000.0)
        bias = fits(4.9, drift_mps2=2.0, nats=30_000.0)
        before = nothing['bias_walk'].figures
        gained = np.full(BLOCKS, 20.0 / BLOCKS)
        if not surely:
            gained[:2] += [200.0, -200.0]
        bias['bias_walk'].figures = before._replace(log_likelihood=before.log_likelihood + gained)
        bias['bias_walk'].by_quarter = bias['bias_walk'].figures.log_likelihood
        assert decided({NOTHING: nothing, BIAS: bias}).effects == named


def test_the_probabilities_sum_to_one_and_the_answer_has_the_largest():
    verdict = decided({NOTHING: fits(5.0), BIAS: fits(0.0), LEVER_ARM: fits(0.02)})
    probabilities = [hypothesis.probability for hypothesis in verdict.hypotheses]
    assert sum(probabilities) == pytest.approx(1.0)
    assert verdict.hypotheses[0].effects == verdict.effects


def test_what_is_within_tolerances_belongs_to_the_upper_limit():
    without, with_it = (decided({NOTHING: fits(0.0, tolerated=power)}) for power in (0.0, 4.0))
    assert (without.status, with_it.status) == ('no_gap', 'no_gap')
    assert with_it.tolerated_mps2 == pytest.approx(2.0)
    assert with_it.upper_limit_mps2**2 == pytest.approx(without.upper_limit_mps2**2 + 4.0)
