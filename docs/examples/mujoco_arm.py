# SPDX-License-Identifier: Apache-2.0

# %% [markdown]
# # A free arm in MuJoCo
#
# It swings freely; its accelerometer and its joints are written as two recordings.
#
# ```bash
# python mujoco_arm.py ideal.csv joints.csv
# simulate imu --force ideal.csv -o from_mujoco.csv
# simulate joints.csv --effect lever_arm:x_m=0.05,y_m=-0.03,z_m=0.1 -o from_joints.csv
# ```
#
# The arm has the joints of the stage: alpha turns about −y of the base, beta about the z of what
# alpha carries, so that its frames are those of the interfaces.

# %%
import sys

import mujoco
import numpy as np

ARM = """
<mujoco>
  <option gravity="0 0 -9.80665" timestep="0.0005" integrator="RK4"/>
  <worldbody>
    <body>
      <joint name="alpha" type="hinge" axis="0 -1 0" damping="0.002"/>
      <geom type="capsule" fromto="0 0 0 0.2 0 -0.1" size="0.01" mass="0.3"/>
      <body>
        <joint name="beta" type="hinge" axis="0 0 1" damping="0.0005"/>
        <geom type="box" pos="0.04 0.02 -0.05" size="0.05 0.01 0.03" mass="0.2"/>
        <site name="case" pos="0.05 -0.03 0.1"/>
      </body>
    </body>
  </worldbody>
  <sensor><accelerometer site="case"/></sensor>
</mujoco>
"""


def swing(seconds: float, rate_hz: float) -> np.ndarray:
    """Return time, alpha, beta and the accelerometer, s, rad and m/s², (n, 6)."""
    model = mujoco.MjModel.from_xml_string(ARM)
    data = mujoco.MjData(model)
    data.qpos[:] = 0.9, 0.4
    data.qvel[:] = 0.0, 3.0
    every = round(1 / rate_hz / model.opt.timestep)
    rows = []
    for step in range(round(seconds / model.opt.timestep)):
        if step % every == 0:
            mujoco.mj_forward(model, data)
            rows.append([step * model.opt.timestep, *data.qpos, *data.sensordata])
        mujoco.mj_step(model, data)
    return np.array(rows)


def main(ideal: str, joints: str) -> None:
    """Write both files."""
    rows = swing(10.0, 1000.0)
    for path, header, columns in (
        (ideal, 'time_s,ax_mps2,ay_mps2,az_mps2', rows[:, [0, 3, 4, 5]]),
        (joints, 'time_s,x_v,alpha_rad,beta_rad', rows[:, [0, 0, 1, 2]]),
    ):
        with open(path, 'w', encoding='utf-8') as file:
            file.write(header + '\n')
            file.writelines(','.join(map(repr, row)) + '\n' for row in columns.tolist())


if __name__ == '__main__':
    main(*sys.argv[1:])
