# SPDX-License-Identifier: Apache-2.0

# %% [markdown]
# # A swinging arm, by formulas
#
# Write the ideal specific force of a swinging arm, as a simulator would log it.

# %%
import sys

import numpy as np

TIME_S = np.arange(0.0, 120.0, 0.01)
GRAVITY_MPS2, ARM_M = 9.80665, 0.4
RAMP = np.clip(np.minimum(TIME_S - 10, 115 - TIME_S) / 5, 0, 1)
WINDOW = RAMP**3 * (10 - 15 * RAMP + 6 * RAMP**2)
"""Ten seconds of rest at the beginning, and five at the end."""
ROLL, PITCH = (
    0.5 * WINDOW * np.sin(0.5 * TIME_S),
    WINDOW * (1.2 * np.sin(0.9 * TIME_S) + 0.3 * np.sin(3.1 * TIME_S)),
)
RATE = np.gradient(PITCH, TIME_S)
FORCE_MPS2 = np.column_stack(
    [
        GRAVITY_MPS2 * np.sin(PITCH) + ARM_M * np.gradient(RATE, TIME_S),
        GRAVITY_MPS2 * np.cos(PITCH) * np.sin(ROLL),
        GRAVITY_MPS2 * np.cos(PITCH) * np.cos(ROLL) + ARM_M * RATE**2,
    ]
)

np.savetxt(
    sys.argv[1],
    np.column_stack([TIME_S, FORCE_MPS2]),
    '%.6f',
    ',',
    comments='',
    header='time_s,ax_mps2,ay_mps2,az_mps2',
)
