# Copyright 2026 the adxl_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Calibration against gravity beside others' on the same rests of real sensors."""

from adxl_ros.calibrate import pose_extraction
from adxl_ros.calibrate.fits import gravity_fit
from adxl_ros.files import parameter_file, recording
from adxl_ros.files.recorded_unit import recorded_unit
from adxl_ros.model.constants import G0_MPS2
import numpy as np
import pytest
from scipy.optimize import least_squares
from units import NOMINAL

FILES = ('mpu9150_0', 'mpu9150_1', 'mpu9150_2', 'xsens_multiposition', 'two_axis_stand')


def plain(accel, gravity_mps2):
    """Fit zero-g, scale and three angles to |f| = g by ordinary least squares."""
    def force(p, a=accel):
        upper = np.array([[1, p[6], p[7]], [0, 1, p[8]], [0, 0, 1]])
        return ((a - p[:3]) * (1 + p[3:6])) @ upper.T

    def off(p):
        return np.linalg.norm(force(p), axis=1) - gravity_mps2

    found = least_squares(off, np.zeros(9), x_scale=[0.1] * 3 + [0.01] * 6)
    return lambda a: np.linalg.norm(force(found.x, a), axis=1)


def ferraris(accel, gravity_mps2):
    """Calibrate by imucal from the rests nearest the six directions of the axes."""
    imucal = pytest.importorskip('imucal')
    regions = {}
    for axis, name in enumerate('xyz'):
        for sign, end in ((1, 'p'), (-1, 'a')):
            best = accel[[np.argmax(sign * accel[:, axis])]]
            regions[f'acc_{name}_{end}'] = best
            regions[f'gyr_{name}_{end}'] = np.zeros((1, 3))
        for kind in ('acc', 'gyr'):
            regions[f'{kind}_{name}_rot'] = np.ones((2, 3))
    with np.errstate(all='ignore'):
        found = imucal.FerrarisCalibration(grav=gravity_mps2).compute(
            imucal.FerrarisSignalRegions(**regions), 100.0, 'm/s^2', 'deg/s')
    return lambda a: np.linalg.norm(
        np.linalg.solve(found.K_a @ found.R_a, (a - found.b_a).T).T, axis=1)


@pytest.mark.parametrize('name', FILES)
def test_never_worse_than_others(name, shared_dir, record_property):
    """In-sample and leave-one-out rms of the magnitude: a plain fit and imucal beside ours."""
    read = recording.read(shared_dir / 'real' / f'{name}.csv')
    unit = recorded_unit(parameter_file.load(NOMINAL), read)
    poses = pose_extraction.poses_of(read, unit)
    found = gravity_fit.fit_gravity(poses.volts, poses.std_v, unit)
    kept = np.setdiff1d(np.arange(len(poses)), found.outliers)
    g = unit.local_gravity_mps2
    accel = ((poses.volts - unit.nominal_zero_g_v) / unit.nominal_scale_v_per_g * G0_MPS2)[kept]

    def rms_mg(off):
        return np.sqrt(np.mean(np.square(off))) / G0_MPS2 * 1e3

    def left_out(fit):
        return rms_mg([fit(np.delete(accel, i, 0), g)(accel[i:i + 1])[0] - g
                       for i in range(len(accel))])

    ours = rms_mg(found.residual_mps2[kept]), rms_mg(found.leave_one_out_mps2[kept])
    others = {'plain': (rms_mg(plain(accel, g)(accel) - g), left_out(plain)),
              'imucal': (rms_mg(ferraris(accel, g)(accel) - g), np.inf)}
    for label, figures in {'ours': ours, **others}.items():
        record_property(f'{name}_{label}_mg', [float(figure) for figure in figures])
        print(f'{name:20} {label:7} in-sample {figures[0]:.3f} mg, leave-one-out {figures[1]:.3f}')
    for figures in others.values():
        # In-sample nothing beats least squares, which ours, weighted by the noise, is not quite.
        assert ours[0] <= 1.03 * figures[0]
        assert ours[1] <= 1.02 * figures[1]
