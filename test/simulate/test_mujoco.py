# SPDX-License-Identifier: Apache-2.0

"""The ideal reading of MuJoCo through the signal chain, compared with the kinematics."""

import json
import subprocess
import sys

from adxl_ros.files import parameter_file, recording
from adxl_ros.simulate.sensor_model import SensorModel
import numpy as np
from processes import REPO
import pytest
from units import nominal, with_effects

pytestmark = pytest.mark.long

SCRIPT = REPO / 'docs' / 'examples' / 'mujoco_arm.py'


def test_the_accelerometer_of_mujoco_agrees_to_a_tenth_of_a_mg(run_tool, tmp_path):
    """Specific force of a swinging arm by MuJoCo and by a stage with a lever arm agree."""
    pytest.importorskip('mujoco', reason='mujoco is not installed: pip install mujoco')
    ideal, joints = tmp_path / 'ideal.csv', tmp_path / 'joints.csv'
    subprocess.run([sys.executable, str(SCRIPT), str(ideal), str(joints)], check=True)
    parameter_file.save(
        tmp_path / 'exact.yaml',
        nominal('xyz', noise_density_g_per_rthz=np.zeros(3), adc_bits=0, stage_resolution_rad=0.0),
    )
    volts = []
    for args in (
        ('imu', '--force', ideal),
        (joints, '--effect', 'lever_arm:x_m=0.05,y_m=-0.03,z_m=0.1'),
    ):
        out = tmp_path / 'out.csv'
        done = run_tool('simulate', *args, '--params', tmp_path / 'exact.yaml', '-o', out)
        assert done.returncode == 0, done.stderr
        volts.append(recording.read(out).volts(nominal('xyz')))
    by_mujoco, by_joints = volts
    assert np.ptp(by_mujoco, axis=0).min() > 0.5, 'the arm must move the sensor'
    difference_mg = 1e3 * (by_mujoco[: len(by_joints)] - by_joints)[50:-50]
    assert np.abs(difference_mg).max() < 0.1


ARM = """
<mujoco>
  <option gravity="0 0 -9.80665" timestep="0.005" integrator="RK4"/>
  <worldbody>
    <body>
      <joint name="roll" type="hinge" axis="1 0 0"/>
      <geom type="box" size="0.03 0.03 0.03" mass="0.2"/>
      <body>
        <joint name="pitch" type="hinge" axis="0 1 0"/>
        <geom type="box" size="0.05 0.04 0.02" mass="0.5"/>
        <site name="case"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="roll"/><motor joint="pitch"/></actuator>
  <sensor><accelerometer name="imu" site="case"/></sensor>
</mujoco>
"""


def mujoco_loop(mujoco, sensor, count=12000):
    """Return the ideal and the sensor's readings in a loop of MuJoCo, m/s², (n, 3) each."""
    model = mujoco.MjModel.from_xml_string(ARM)
    data = mujoco.MjData(model)
    ideal, readings = np.empty((count, 3)), np.empty((count, 3))
    for step in range(count):
        goal = np.array([2.0 * np.sin(0.31 * data.time), 1.2 * np.sin(0.73 * data.time)])
        data.ctrl[:] = 0.02 * (goal - data.qpos) - 0.004 * data.qvel
        mujoco.mj_step(model, data)
        ideal[step] = data.sensor('imu').data
        readings[step] = sensor(ideal[step], model.opt.timestep, temperature=25 + step / 600)
    return ideal, readings


def save(path, header, *columns):
    np.savetxt(path, np.column_stack(columns), delimiter=',', header=header, comments='')


def test_an_effect_in_the_loop_of_mujoco_is_found_and_closed(run_tool, tmp_path):
    """A withheld effect is diagnosed, and a sensor by the diagnosed file then reads the same."""
    mujoco = pytest.importorskip('mujoco', reason='mujoco is not installed: pip install mujoco')
    nominal_unit = nominal('xyz', rate_hz=200.0)
    parameter_file.save(tmp_path / 'nominal.yaml', nominal_unit)
    truth = with_effects(nominal_unit, ['quadratic:quadratic_per_g=0.01'])
    ideal, readings = mujoco_loop(mujoco, SensorModel(truth, seed=1))
    time_s = np.arange(len(ideal)) / 200.0
    save(tmp_path / 'ideal.csv', 'time_s,ax_mps2,ay_mps2,az_mps2', time_s, ideal)
    save(
        tmp_path / 'real.csv',
        'time_s,ax_mps2,ay_mps2,az_mps2,temperature_c',
        time_s,
        readings,
        25 + np.arange(len(ideal)) / 600,
    )
    done = run_tool(
        'diagnose',
        tmp_path / 'real.csv',
        '--sim',
        tmp_path / 'ideal.csv',
        '--params',
        tmp_path / 'nominal.yaml',
        '-o',
        tmp_path / 'gap',
    )
    assert done.returncode == 0, done.stderr
    verdict = json.loads((tmp_path / 'gap' / 'report.json').read_text())['verdict']
    assert (verdict['status'], verdict['effects']) == ('explained', ['quadratic'])
    count = 3000

    def gap_mps2(unit):
        _, simulated = mujoco_loop(mujoco, SensorModel(unit, seed=2), count)
        return np.sqrt(np.mean((readings[:count] - simulated) ** 2))

    floor_mps2 = gap_mps2(truth)
    assert gap_mps2(tmp_path / 'nominal.yaml') > 3 * floor_mps2
    assert gap_mps2(tmp_path / 'gap' / 'params.yaml') < 1.1 * floor_mps2
