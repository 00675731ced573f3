# SPDX-License-Identifier: Apache-2.0

"""Linear and physical fits: equations 1 to 19 on simulated units."""

from dataclasses import replace

from adxl_ros.calibrate import calibration
from adxl_ros.calibrate.fits import linear
from adxl_ros.calibrate.poses import Poses
from adxl_ros.calibrate.report import held_out
from adxl_ros.errors import UserError
import numpy as np
from pace import within
import pytest
from units import drawn, nominal, swept

pytestmark = pytest.mark.long


def _made(volts, alpha_deg, beta_deg):
    count = len(volts)
    return Poses(
        np.array(volts, float),
        np.full((count, 2), 1e-5),
        np.radians(alpha_deg),
        np.radians(beta_deg),
        np.zeros((count, 2)),
        np.zeros(count, bool),
    )


def test_equations_1_to_3():
    """Poses at ±1 g give SF = (V₊ − V₋)/2 and B = (V₊ + V₋)/2, independent of other poses."""
    poses = _made(
        [[3.52, 2.51], [1.50, 2.53], [2.44, 1.49], [2.60, 3.55], [2.9, 2.9]],
        [90, 90, 90, 90, 30],
        [0, 180, 90, 270, 45],
    )
    fitted = linear.fit(nominal(), poses)
    assert fitted.scale_v_per_g == pytest.approx([1.01, 1.03], abs=1e-12)
    assert fitted.zero_g_v == pytest.approx([2.51, 2.52], abs=1e-12)


@pytest.mark.parametrize('axes', ['xy', 'xyz'])
def test_physical_recovers_the_unit(axes):
    rng = np.random.default_rng(7)
    sensor = nominal(axes)
    inside, tilt_deg = [], []
    for _ in range(6):
        truth = drawn(rng, sensor)
        for effect in ('cross_axis', 'cross_axis_z', 'scale_factor_z'):
            # The paper does not model a z axis.
            for values in truth.values[effect].values():
                values[2:] = 0.0
        poses = swept(rng, truth, per_setting=True)
        fitted = linear.fit_physical(sensor, poses.subset(~poses.check))
        std = np.sqrt(np.diag(fitted.covariance))
        for name, sigma in zip(fitted.covariance_names, std):
            index = axes.index(name.axis)
            error = (
                fitted.values[name.effect][name.parameter][index]
                - truth.values[name.effect][name.parameter][index]
            )
            inside.append(abs(error) < 1.645 * sigma)
        errors = held_out.summarise(
            'physical', held_out.pose_errors(fitted, poses.subset(poses.check))
        )
        tilt_deg.append(errors.tilt_deg.rms)
        assert errors.accel_mg.rms < 0.6
    assert np.mean(tilt_deg) < 0.1
    assert 0.85 < np.mean(inside) < 0.99


def test_physical_reduces_the_tilt_error_as_the_paper_does():
    rng = np.random.default_rng(11)
    sensor = nominal()
    ratios = []
    for _ in range(5):
        poses = swept(rng, drawn(rng, sensor))
        linear_errors, physical_errors = held_out.cross_validate(
            {'linear': linear.fit, 'physical': linear.fit_physical}, sensor, poses
        )
        ratios.append(physical_errors.tilt_deg.rms / linear_errors.tilt_deg.rms)
    assert np.mean(ratios) < 1 - 0.889


@pytest.mark.perf
def test_physical_takes_less_than_a_second():
    rng = np.random.default_rng(1)
    poses = swept(rng, drawn(rng, nominal()))
    with within(1.0):
        linear.fit_physical(nominal(), poses)


@pytest.mark.parametrize(
    'planes_deg, missing',
    [
        ([30, 60], 'alpha = 90 deg'),
        ([90], 'planes alpha = 30, 60, 120 and 150'),
        ([90, 60], 'planes alpha = 30, 60, 120 and 150'),
    ],
)
def test_physical_names_the_missing_planes(planes_deg, missing):
    rng = np.random.default_rng(1)
    poses = swept(rng, drawn(rng, nominal()), np.radians(planes_deg), 0)
    with pytest.raises(UserError, match=missing):
        linear.fit_physical(nominal(), poses)


@pytest.mark.parametrize(
    'change, words',
    [
        (lambda v: v * [-1, 1] + [5, 0], 'x reads against its reference'),
        (lambda v: v[:, ::-1], 'axes are swapped'),
    ],
)
def test_wrong_polarity_is_named(change, words):
    rng = np.random.default_rng(4)
    poses = swept(rng, nominal())
    with pytest.raises(UserError, match=words):
        calibration.calibrate(
            nominal(),
            [calibration.RecordedPoses('made', replace(poses, volts=change(poses.volts)))],
        )


def test_without_check_poses_folds_are_held_out():
    rng = np.random.default_rng(6)
    poses = swept(rng, drawn(rng, nominal()), check_poses=0)
    result = calibration.calibrate(nominal(), [calibration.RecordedPoses('made', poses)])
    assert result.fitted.model == 'full'
    words = [line.split()[0] for line in result.summary if line]
    assert words[words.index('datasheet') :][:4] == ['datasheet', 'linear', 'physical', 'full']
