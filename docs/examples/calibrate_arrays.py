# SPDX-License-Identifier: Apache-2.0

"""Calibrate a sensor from arrays, correct its samples, and see what a simulator lacks."""

import adxl_ros as adxl

UNIT = {'bias': {'offset_v': {'x': 0.01, 'y': -0.005}}}
"""What makes this unit another one than its datasheet: the zero-g of both axes, V."""

# Logs of a sensor on a stage: a sweep over 125 poses, and a shorter run. Here they are simulated.
sweep = adxl.simulate('sweep', 'adxl203', rate=10, seed=1, effects=UNIT)
run = adxl.simulate('tilt_both', 'adxl203', rate=25, seed=2, effects=UNIT)

# Any arrays do: stamps, s, volts, and the angles of the stage, rad.
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

corrected = adxl.apply(run, fit)
print(corrected.to_pandas().head())

gap = adxl.diagnose(run, 'adxl203')
print(gap)
print([(effect.name, effect.parameters['offset_v.x']) for effect in gap.effects])
