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

"""The ideal reading of MuJoCo through the signal chain, compared with the kinematics."""

import subprocess
import sys

from adxl_ros.files import parameter_file, recording
import numpy as np
from processes import REPO
import pytest
from units import nominal

SCRIPT = REPO / 'docs' / 'examples' / 'mujoco_arm.py'


def test_the_accelerometer_of_mujoco_agrees_to_a_tenth_of_a_mg(run_tool, tmp_path):
    """Specific force of a swinging arm by MuJoCo and by a stage with a lever arm agree."""
    pytest.importorskip('mujoco', reason='mujoco is not installed: pip install mujoco')
    ideal, joints = tmp_path / 'ideal.csv', tmp_path / 'joints.csv'
    subprocess.run([sys.executable, str(SCRIPT), str(ideal), str(joints)], check=True)
    parameter_file.save(tmp_path / 'exact.yaml', nominal(
        'xyz', noise_density_g_per_rthz=np.zeros(3), adc_bits=0, stage_resolution_rad=0.0))
    volts = []
    for args in (('imu', '--force', ideal),
                 (joints, '--effect', 'lever_arm:x_m=0.05,y_m=-0.03,z_m=0.1')):
        out = tmp_path / 'out.csv'
        done = run_tool('simulate', *args, '--params', tmp_path / 'exact.yaml', '-o', out)
        assert done.returncode == 0, done.stderr
        volts.append(recording.read(out).volts(nominal('xyz')))
    by_mujoco, by_joints = volts
    assert np.ptp(by_mujoco, axis=0).min() > 0.5, 'the arm must move the sensor'
    difference_mg = 1e3 * (by_mujoco[:len(by_joints)] - by_joints)[50:-50]
    assert np.abs(difference_mg).max() < 0.1
