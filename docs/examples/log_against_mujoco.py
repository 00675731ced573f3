# SPDX-License-Identifier: Apache-2.0

# %% [markdown]
# # Why does my log differ from MuJoCo?
#
# A small arm swings in MuJoCo. The log comes from a sensor whose board sits a little askew, which
# the model of the arm does not know. The diagnosis finds it.

# %%
import adxl_ros as adxl
import matplotlib.pyplot as plt
import mujoco
import numpy as np

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
        <site name="imu"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="roll"/><motor joint="pitch"/></actuator>
  <sensor><accelerometer name="imu" site="imu"/></sensor>
</mujoco>
"""

# %% [markdown]
# The simulation, and beside it the sensor, which stands for your log.

# %%
model = mujoco.MjModel.from_xml_string(ARM)
data = mujoco.MjData(model)
askew = {'misalignment': {'alpha_rad': 0.02, 'beta_rad': 0.01}}
sensor = adxl.SensorModel(adxl.load('adxl355', effects=askew), seed=1)
time_s, simulated_mps2, logged_mps2 = [], [], []
for _ in range(8000):
    goal_rad = np.array([2.0 * np.sin(0.31 * data.time), 1.2 * np.sin(0.73 * data.time)])
    data.ctrl[:] = 0.02 * (goal_rad - data.qpos) - 0.004 * data.qvel
    mujoco.mj_step(model, data)
    time_s.append(data.time)
    simulated_mps2.append(data.sensor('imu').data.copy())
    logged_mps2.append(sensor(simulated_mps2[-1], model.opt.timestep))


# %%
def recording(samples_mps2: list[np.ndarray]) -> adxl.Recording:
    """Return samples of three axes as a recording."""
    ax, ay, az = np.array(samples_mps2).T
    return adxl.from_arrays(time_s=np.array(time_s), ax_mps2=ax, ay_mps2=ay, az_mps2=az)


gap = adxl.diagnose(recording(logged_mps2), 'adxl355', sim=recording(simulated_mps2))
print(gap)

# %% [markdown]
# The sizes, and what is left of the gap in a simulation that has them.

# %%
for effect in gap.effects:
    for name, found in effect.parameters.items():
        if found.low is not None and found.high is not None:
            print(f'{effect.name} {name}: {found.value:.4f} ({found.low:.4f} to {found.high:.4f})')
figure, axis = plt.subplots(figsize=(8, 3), layout='constrained')
gap.plot(ax=axis)
figure.savefig('gap.png')
