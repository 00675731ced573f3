# SPDX-License-Identifier: Apache-2.0

"""The gravity fit compared with two other methods on the same rests of real sensors."""

from adxl_ros.calibrate import pose_extraction
from adxl_ros.calibrate.fits import gravity_fit
from adxl_ros.files import parameter_file, recording
from adxl_ros.files.stream_unit import recorded_unit
from adxl_ros.model.constants import G0_MPS2
import numpy as np
import pytest
from scipy.optimize import least_squares
from units import NOMINAL

FILES = ('mpu9150_0', 'mpu9150_1', 'mpu9150_2', 'xsens_multiposition', 'two_axis_stand')


@pytest.fixture(params=FILES)
def rests(request, shared_dir):
    """Return the fit of a recording, mean accelerations of its rests, m/s², and gravity."""
    stream = recording.read(shared_dir / 'real' / f'{request.param}.csv')
    unit = recorded_unit(parameter_file.load(NOMINAL), stream)
    poses = pose_extraction.extract_poses(stream, unit)
    fit = gravity_fit.fit_gravity(poses.volts, poses.std_v, unit, len(poses))
    kept = np.setdiff1d(np.arange(len(poses)), fit.outliers)
    accel = (poses.volts - unit.nominal_zero_g_v) / unit.nominal_scale_v_per_g * G0_MPS2
    return fit.residual_mps2[kept], fit.held_out_mps2[kept], accel[kept], \
        unit.local_gravity_mps2


def rms_mg(residual_mps2):
    return np.sqrt(np.mean(np.square(residual_mps2))) / G0_MPS2 * 1e3


def least_squares_magnitude(accel, gravity_mps2):
    """Fit zero-g, scale and three angles to |f| = g by ordinary least squares."""
    def magnitude(p, samples):
        upper = np.array([[1, p[6], p[7]], [0, 1, p[8]], [0, 0, 1]])
        return np.linalg.norm(((samples - p[:3]) * (1 + p[3:6])) @ upper.T, axis=1)

    fit = least_squares(lambda p: magnitude(p, accel) - gravity_mps2, np.zeros(9),
                        x_scale=[0.1] * 3 + [0.01] * 6)
    return lambda samples: magnitude(fit.x, samples)


def ferraris_magnitude(accel, gravity_mps2, six):
    """Calibrate by imucal from six rests, one for each direction of an axis."""
    imucal = pytest.importorskip('imucal', reason='imucal is not installed: pip install imucal')
    regions = {}
    for (axis, end), rest in zip([(a, e) for a in 'xyz' for e in 'pa'], six):
        regions[f'acc_{axis}_{end}'] = accel[[rest]]
        regions[f'gyr_{axis}_{end}'] = np.zeros((1, 3))
        for kind in ('acc', 'gyr'):
            regions[f'{kind}_{axis}_rot'] = np.ones((2, 3))
    with np.errstate(all='ignore'):
        fit = imucal.FerrarisCalibration(grav=gravity_mps2).compute(
            imucal.FerrarisSignalRegions(**regions), 100.0, 'm/s^2', 'deg/s')
    return lambda samples: np.linalg.norm(
        np.linalg.solve(fit.K_a @ fit.R_a, (samples - fit.b_a).T).T, axis=1)


def test_is_as_good_as_least_squares(rests):
    """The residuals are compared in-sample, where least squares is optimal, and leave-one-out."""
    residual, leave_one_out, accel, g = rests
    assert rms_mg(residual) <= 1.03 * rms_mg(least_squares_magnitude(accel, g)(accel) - g)
    held_out = [least_squares_magnitude(np.delete(accel, i, 0), g)(accel[[i]])[0] - g
                for i in range(len(accel))]
    assert rms_mg(leave_one_out) <= 1.02 * rms_mg(held_out)


def test_is_better_than_six_positions_on_the_other_rests(rests):
    """The comparison uses rests that imucal has not used, and leave-one-out residuals."""
    _, leave_one_out, accel, g = rests
    six = [int(np.argmax(sign * accel[:, axis])) for axis in range(3) for sign in (1, -1)]
    other = np.setdiff1d(np.arange(len(accel)), six)
    held_out = ferraris_magnitude(accel, g, six)(accel[other]) - g
    assert rms_mg(leave_one_out[other]) < rms_mg(held_out)
