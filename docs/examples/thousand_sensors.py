# SPDX-License-Identifier: Apache-2.0

# %% [markdown]
# # A thousand sensors in a training loop
#
# Each robot has another part, within the limits of its datasheet. `SensorModel` takes the specific
# force of one step of all robots; arrays of torch and jax do as well.

# %%
import adxl_ros as adxl
import numpy as np

SENSORS, STEPS, DT_S = 1000, 200, 0.005
GRAVITY_MPS2 = np.array([0.0, 0.0, 9.80665])

sensors = adxl.SensorModel('adxl203', seed=7, units='datasheet')
readings = np.empty((STEPS, SENSORS, 3))
for step in range(STEPS):
    force_mps2 = np.tile(GRAVITY_MPS2, (SENSORS, 1))
    force_mps2[:, 0] += np.sin(2 * np.pi * step * DT_S)  # a push along x
    readings[step] = sensors(force_mps2, DT_S)
    if step == STEPS // 2:
        sensors.reset(np.arange(100))  # a hundred robots begin anew

# %% [markdown]
# What differs from part to part, and from sample to sample:

# %%
offset_mg = 1e3 * (readings[:, 200:, 1].mean(axis=0)) / 9.80665
print(
    f'zero-g of y over the parts: {offset_mg.std():.1f} mg, '
    f'noise of a sample: {readings[:, 200:, 1].std(axis=0).mean() / 9.80665 * 1e3:.2f} mg'
)
