# SPDX-License-Identifier: Apache-2.0

# %% [markdown]
# # Calibrate from arrays
#
# Calibrate a sensor from numpy arrays, correct its samples, and see what a simulator lacks. The
# logs are of a sensor on a stage: a sweep over 125 poses, and a shorter run. Here they are
# simulated; the zero-g of the unit differs from the datasheet by 10 and −5 mV.

# %%
import adxl_ros as adxl

UNIT = {'bias': {'offset_v': {'x': 0.01, 'y': -0.005}}}
sweep = adxl.simulate('sweep', 'adxl203', rate=10, seed=1, effects=UNIT)
run = adxl.simulate('tilt_both', 'adxl203', rate=25, seed=2, effects=UNIT)

# %% [markdown]
# Any arrays do: stamps, s, volts, and the angles of the stage, rad.

# %%
recording = adxl.from_arrays(
    time_s=sweep.time_s,
    x_v=sweep.columns['x_v'],
    y_v=sweep.columns['y_v'],
    alpha_rad=sweep.columns['alpha_rad'],
    beta_rad=sweep.columns['beta_rad'],
)
fit = adxl.fit(recording, 'adxl203', model='physical')
print(fit)
fit.save('unit.yaml')

# %% [markdown]
# The run, corrected: acceleration and tilt with their standard deviations.

# %%
corrected = adxl.apply(run, fit)
print(corrected.to_pandas().head())

# %% [markdown]
# A simulator that knows only the datasheet lacks the zero-g of the unit.

# %%
gap = adxl.diagnose(run, 'adxl203')
print(gap)
print([(effect.name, effect.parameters['offset_v.x']) for effect in gap.effects])
