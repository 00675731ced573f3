# SPDX-License-Identifier: Apache-2.0


"""The covariance of all poses against its closed form, and the levels of the stage error."""

from dataclasses import replace

from adxl_ros.calibrate.fits import full_model, linearisation
from adxl_ros.calibrate.fits.pose_covariance import PoseCovariance, shared_settings, StageError
from adxl_ros.calibrate.pose_model import angle_jacobian, predicted_volts
from adxl_ros.model.sensor import with_neutral
import numpy as np
import pytest
from units import drawn, nominal, swept

ERROR = StageError(4e-4, 2e-4, 1.3)


@pytest.fixture(scope='module')
def poses():
    rng = np.random.default_rng(3)
    return swept(rng, drawn(rng, nominal()), per_setting=True, check_poses=4)


def dense(slope, poses, error):
    """Compute the dense covariance: noise, and errors by pose and by setting of each joint."""
    count, axes = slope.shape[:2]
    matrix = np.diag((poses.std_v**2).ravel())
    for joint, setting in enumerate((poses.alpha_setting, poses.beta_setting)):
        angles = error.joints[joint] ** 2 * (
            error.setting_rad**2 * (setting[:, None] == setting)
            + error.pose_rad**2 * np.eye(count)
        )
        part = np.einsum('km,kl,ln->kmln', slope[:, :, joint], angles, slope[:, :, joint])
        matrix += part.reshape(count * axes, count * axes)
    return matrix


def test_products_and_determinant_are_those_of_the_dense_covariance(poses):
    slope = angle_jacobian(nominal(), poses)
    columns = np.random.default_rng(1).normal(size=(len(poses), 2, 5))
    matrix = dense(slope, poses, ERROR)
    covariance = PoseCovariance(slope, poses, shared_settings(poses), ERROR)
    flat = columns.reshape(-1, 5)
    np.testing.assert_allclose(
        covariance.products(columns), flat.T @ np.linalg.solve(matrix, flat), rtol=1e-8
    )
    assert covariance.log_determinant() == pytest.approx(np.linalg.slogdet(matrix)[1], abs=1e-6)


def test_predicted_errors_are_the_best_linear_estimates(poses):
    """Errors of setting and pose are those of the conditional normal distribution."""
    slope = angle_jacobian(nominal(), poses)
    residual = np.random.default_rng(2).normal(size=poses.volts.shape) * 1e-4
    covariance = PoseCovariance(slope, poses, shared_settings(poses), ERROR)
    weighted = np.linalg.solve(dense(slope, poses, ERROR), residual.ravel()).reshape(
        residual.shape
    )
    felt = np.einsum('kmj,km->kj', slope, weighted)
    expected = ERROR.pose_rad**2 * felt
    for joint, setting in enumerate((poses.alpha_setting, poses.beta_setting)):
        expected[:, joint] += ERROR.setting_rad**2 * (setting[:, None] == setting) @ felt[:, joint]
    expected *= ERROR.joints**2
    np.testing.assert_allclose(
        covariance.predicted_errors(residual).total_rad, expected, rtol=1e-7, atol=1e-15
    )


def test_the_stated_error_counts_where_poses_do_not_determine_it(poses):
    unit = with_neutral(nominal(), ('bias', 'scale_factor', 'base_tilt'))
    names = full_model.fitted_coefficients('xy', ('bias', 'scale_factor'))
    precision = full_model.prior_precision(names)
    few = linearisation.linearised(unit, poses.subset(np.arange(4)), names, precision)
    assert few.stage_error(1e-3).total_rad == pytest.approx(1e-3, rel=1.0)
    quiet = replace(poses, volts=predicted_volts(unit, poses))
    many = linearisation.linearised(unit, quiet, names, precision)
    assert many.stage_error(1e-3).total_rad < 1e-4
