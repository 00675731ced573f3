# SPDX-License-Identifier: Apache-2.0


"""Pose plans: their travel, and their expected and actual errors."""

from adxl_ros.calibrate.fits import full_model
from adxl_ros.calibrate.guided import pose_plan, running_estimate
from adxl_ros_validation.experiments import sweep
import numpy as np
import pytest
from units import drawn, nominal, swept

STEP = np.radians(30)


def expected_error_deg(axes, targets, resolution_deg=5 / 60):
    sensor = nominal(axes, stage_resolution_rad=np.radians(resolution_deg))
    return np.degrees(running_estimate.expected_tilt_error_rad(sensor, 5.0, targets))


@pytest.mark.parametrize('axes', ['xy', 'xyz'])
def test_the_guided_order_has_smaller_errors_on_a_stage_with_errors_by_setting(axes):
    """The guided order halves the expected tilt error."""
    planes = pose_plan.default_planes_rad('xy')
    guided, paper = pose_plan.guided(planes, STEP, 0), sweep(planes, STEP, 0)
    assert sorted(map(str, guided)) == sorted(map(str, paper))
    assert expected_error_deg(axes, guided) < 0.5 * expected_error_deg(axes, paper)


@pytest.mark.long
@pytest.mark.parametrize('axes', ['xy', 'xyz'])
@pytest.mark.parametrize('kind', pose_plan.KINDS)
def test_fits_have_the_standard_deviations_that_a_plan_predicts(axes, kind):
    sensor = nominal(axes)
    targets = (
        pose_plan.guided(pose_plan.default_planes_rad(axes), STEP, 0)
        if kind == 'full'
        else running_estimate.quick(sensor, 5.0, np.radians(0.1), 0)
    )
    ratios = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        truth = drawn(rng, sensor, full_model.default_terms(axes))
        poses = swept(rng, truth, per_setting=True, targets=targets)
        fit = full_model.fit_full(sensor, poses)
        spread = np.sqrt(np.diag(fit.fitted.covariance))
        promised = running_estimate.from_records(sensor, [], 5.0).with_poses(targets)
        stds = dict(zip(promised.names, np.sqrt(np.diag(promised.covariance))))
        ratios += [s / stds[name] for s, name in zip(spread, fit.fitted.covariance_names)]
    assert np.exp(np.mean(np.log(ratios))) == pytest.approx(1.0, abs=0.15)
