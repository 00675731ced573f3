# SPDX-License-Identifier: Apache-2.0

# %% [markdown]
# # Allan deviation of a log
#
# The sensor lies still. `noise` separates white noise from slow drift, and writes a parameter file
# for simulation. Here a minute of noise is made up, so that the truth is known.

# %%
import adxl_ros as adxl
import numpy as np

RATE_HZ = 100
rng = np.random.default_rng(4)
white_mps2 = rng.normal(0.0, 0.02, (60 * RATE_HZ, 3))
walk_mps2 = np.cumsum(rng.normal(0.0, 1e-5, (60 * RATE_HZ, 3)), axis=0)
samples_mps2 = white_mps2 + walk_mps2 + [0.0, 0.0, 9.80665]

recording = adxl.from_arrays(
    rate=RATE_HZ,
    ax_mps2=samples_mps2[:, 0],
    ay_mps2=samples_mps2[:, 1],
    az_mps2=samples_mps2[:, 2],
)
noise = adxl.noise(recording)
print(noise)

# %% [markdown]
# The curve with its interval, and the file that a simulator reads.

# %%
noise.plot().figure.savefig('allan.png')
noise.save('noise.yaml')
