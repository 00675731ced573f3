# SPDX-License-Identifier: Apache-2.0

"""Held-out errors, error budget and acceptance of simulated units, whose truth is known."""

from dataclasses import replace
import re

from adxl_ros.calibrate import calibration
from adxl_ros.calibrate.fits.full_model import TERMS
from adxl_ros.calibrate.guided.pose_plan import Target
from adxl_ros.calibrate.report import acceptance, held_out
from adxl_ros.calibrate.report.error_budget import ErrorBudget, ErrorBudgets
from adxl_ros.errors import UserError
from adxl_ros.model import signal_chain
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.kinematics import specific_force
import numpy as np
import pytest
from units import drawn, nominal, swept

pytestmark = pytest.mark.long


def calibrated(seed, model=None, axes='xy', check=16, stage_rad=None, effects=TERMS, **figures):
    """Calibrate a drawn unit on a stage whose true step may differ from the stated one."""
    rng = np.random.default_rng([seed, 81])
    sensor = nominal(axes, serial='S', **figures)
    truth = drawn(rng, sensor, effects)
    on = truth if stage_rad is None else replace(truth, stage_resolution_rad=stage_rad)
    poses = swept(rng, on, check_poses=check)
    return truth, calibration.calibrate(sensor, [calibration.RecordedPoses('made', poses)], model)


def true_errors(truth, result):
    """Return the errors of the fitted units without noise and stage error, mg and deg rms."""
    unseen = result.held_out[-1]
    poses = result.poses.subset(result.inliers).subset(unseen.pose_index)
    force = np.column_stack(
        specific_force(poses.alpha_rad, poses.beta_rad, truth.local_gravity_mps2)
    )
    volts = np.column_stack(signal_chain.static_response(truth)(list(force.T)))
    got = np.empty_like(force)
    for number, unit in enumerate(unseen.fitted):
        in_fold = unseen.fold == number
        up = np.where(force[in_fold, 2] < 0, -1, 1)
        got[in_fold] = np.column_stack(signal_chain.inverse(unit, up)(list(volts[in_fold].T)))
    finite = np.isfinite(unseen.pose_errors.tilt_rad)
    mg = (got - force)[finite, : len(truth.axes)] / G0_MPS2 * 1e3
    return (
        np.sqrt(np.mean(mg**2)),
        np.degrees(np.sqrt(np.mean(held_out.angle_between(got, force)[finite] ** 2))),
    )


def test_poses_at_a_rail_are_left_out_and_an_open_scale_factor_does_not_pass():
    rng = np.random.default_rng(6)
    sensor = nominal('xyz')
    poses = swept(
        rng,
        drawn(rng, sensor, ('bias', 'scale_factor')),
        check_poses=0,
        targets=[Target(np.radians(alpha), 0.0) for alpha in (0, 40, 80, 120, 160, 180)],
    )
    poses.volts[1, 0] = sensor.adc_vref_v - sensor.lsb_v
    result = calibration.calibrate(sensor, [calibration.RecordedPoses('made', poses)])
    assert len(result.poses) == 5 and 'ADC at a rail in 1 poses' in ' '.join(result.warnings)
    accepted = acceptance.acceptance(result.fitted)
    assert accepted.outcome == acceptance.NOT_SHOWN
    assert 'scale_factor.offset_v_per_g.y' in accepted.advice[-1]
    poses.volts[:, 2] = 0.0
    with pytest.raises(UserError, match='made: ADC at a rail in 6 poses .*check supply'):
        calibration.calibrate(sensor, [calibration.RecordedPoses('made', poses)])


@pytest.mark.parametrize(
    ('check', 'units', 'within'), [(16, 4, 0.35), (0, 2, 0.5)], ids=['check poses', 'folds']
)
def test_the_stated_calibration_error_is_right(check, units, within):
    estimated, true, measured = [], [], []
    for seed in range(units):
        truth, result = calibrated(seed, 'full', check=check)
        assessment = result.assessments[-1]
        estimated.append((assessment.error_mg, assessment.error_deg))
        true.append(true_errors(truth, result))
        measured.append(result.held_out[-1].accel_mg.rms)
        assert assessment.accel.limited_by == 'stage'
        assert (assessment.accel_outcome, assessment.tilt_outcome) == ('PASS', 'PASS')
        entries = result.fitted.provenance
        assert float(entries['own_accel_mg']) == pytest.approx(assessment.error_mg, rel=1e-3)
        assert float(entries['held_out_accel_rms_mg']) == pytest.approx(measured[-1], rel=1e-3)
    estimated, true = (np.sqrt(np.mean(np.square(errors), axis=0)) for errors in (estimated, true))
    np.testing.assert_allclose(true, estimated, rtol=within)
    assert np.sqrt(np.mean(np.square(measured))) > 2 * estimated[0]


CASES = {
    'a fine stage': ('noise', {'stage_resolution_rad': 0.0}),
    'a stage as stated': ('stage', {}),
    'a stage worse than stated': ('stage', {'stage_rad': np.radians(2.0)}),
    'a model that lacks terms': ('model', {'model': 'linear'}),
}


@pytest.mark.parametrize('name', CASES)
def test_the_limiting_part_of_the_error_is_named(name):
    """Chance changes one outcome in a hundred, so that one of two units must have the name."""
    limit, settings = CASES[name]
    named = [calibrated(seed, **settings)[1].assessments[-1].accel.limited_by for seed in range(2)]
    assert limit in named, named


def test_a_linear_model_fails_because_of_its_model():
    _, result = calibrated(1)
    outcomes = {
        row.model: (row.accel_outcome, row.tilt_outcome, row.accel.limited_by)
        for row in result.assessments
    }
    assert outcomes['linear'] == ('FAIL', 'FAIL', 'model')
    assert outcomes['full'][:2] == ('PASS', 'PASS')
    # A screen has the acceptance first, then one line for each model, within 80 columns.
    assert re.fullmatch(
        r' PASS  calibration error 0\.\d\d mg; the datasheet allows 3\.4 mg', result.summary[0]
    )
    models = re.findall(r'^ (\w+) (?:values|calibration) +\d', '\n'.join(result.summary), re.M)
    assert models == ['datasheet', 'linear', 'physical', 'full']
    assert max(map(len, result.summary)) <= 88


@pytest.mark.parametrize(
    ('parts', 'outcome'),
    [
        ((1.0, 0.0, 0.9, 0.1, 0.0, 0.2), 'PASS'),
        ((9.0, 0.0, 8.9, 0.1, 0.0, 2.0), 'NOT SHOWN'),
        ((9.0, 0.0, 0.1, 0.1, 8.8, 12.0), 'FAIL'),
        ((9.0, 0.0, 0.1, 0.1, 8.8, 12.0, False), 'NOT SHOWN'),
    ],
)
def test_outcomes_of_the_acceptance(parts, outcome):
    """At a limit of 1, an error is below it, possibly below it, or above it."""
    sensor = replace(
        nominal(),
        datasheet={
            Coefficient('nonlinearity', 'cubic_per_g2'): (
                1 / G0_MPS2 / nominal().range_g ** 3,
                0.0,
            )
        },
    )
    budget = ErrorBudget(*parts)
    assessment = acceptance.assess('full', ErrorBudgets(budget, budget), sensor)
    assert assessment.accel_outcome == outcome
    tilted = acceptance.assess(
        'full',
        ErrorBudgets(
            ErrorBudget(1.0, 0.0, 0.9, 0.1, 0.0, 0.2), replace(budget, tilt_per_axis=1.0)
        ),
        sensor,
    )
    assert (tilted.accel_outcome, tilted.tilt_outcome) == ('PASS', outcome)
    if len(parts) == 7:
        assert assessment.accel.limited_by == 'stage or model'
    else:
        assert assessment.accel.limited_by == ('model' if outcome == 'FAIL' else 'stage')


@pytest.mark.parametrize(('correlation', 'min_coverage'), [(0.0, 0.82), (0.9, 0.7)])
def test_intervals_have_their_coverage_for_correlated_errors(correlation, min_coverage):
    """For 130 correlated errors an interval for independent errors has a coverage of 35 %."""
    rng = np.random.default_rng(82)
    covered = naive = 0
    for _ in range(400):
        noise = rng.normal(size=230)
        errors = np.empty(230)
        errors[0] = noise[0]
        for k in range(1, 230):
            errors[k] = correlation * errors[k - 1] + np.sqrt(1 - correlation**2) * noise[k]
        errors = errors[100:]
        low, high = held_out.statistic(errors).interval
        covered += low < 1 < high
        naive += 1 / 1.11 < np.sqrt(np.mean(errors**2)) < 1.11
    assert min_coverage < covered / 400 < 0.97
    assert correlation == 0 or naive < 0.6 * covered
