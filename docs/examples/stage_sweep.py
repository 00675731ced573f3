# SPDX-License-Identifier: Apache-2.0

# %% [markdown]
# # A sweep on a stage
#
# Sweep a simulated unit on a stage, calibrate it, and see its errors on poses that the fit has not
# seen.

# %%
import adxl_ros as adxl

sweep = adxl.simulate(
    'sweep',
    'adxl203',
    rate=10,
    seed=3,
    effects={'bias': {'offset_v': {'x': 0.02}}, 'scale_factor': {'offset_v_per_g': {'y': 0.01}}},
)
fit = adxl.fit(sweep, 'adxl203', model='linear')
for errors in fit.held_out:
    print(f'{errors.model:8} {errors.accel_mg.rms:6.2f} mg   {errors.tilt_deg.rms:.3f}°')

# %% [markdown]
# The coefficients with their intervals, the page, and the parameter file.

# %%
print(fit.to_pandas().to_string(index=False))
fit.report('report')
fit.save('unit.yaml')
