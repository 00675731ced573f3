# SPDX-License-Identifier: Apache-2.0

# %% [markdown]
# # Tilt with its covariance
#
# Tilt of every sample with its standard deviation, and the covariance of the force as
# `sensor_msgs/Imu` has it.

# %%
import adxl_ros as adxl
import numpy as np

recording = adxl.simulate('tumble', 'adxl355', rate=50, seed=2)
corrected = adxl.apply(recording, 'adxl355')
roll_deg = np.degrees(corrected.columns['roll_rad'])
std_deg = np.degrees(corrected.columns['roll_std_rad'])
covariance = corrected.force_covariance  # (m/s²)², (n, 3, 3)

for row in range(0, len(roll_deg), 1000):
    print(
        f'{corrected.time_s[row]:6.2f} s   roll {roll_deg[row]:8.3f}° ± {std_deg[row]:.3f}°   '
        f'std of x {1e3 * np.sqrt(covariance[row, 0, 0]):.2f} mm/s²'
    )
