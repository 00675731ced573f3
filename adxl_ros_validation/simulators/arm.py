# SPDX-License-Identifier: Apache-2.0
"""An arm of three joints that carries an accelerometer and swings freely, and how it is run."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

URDF = Path(__file__).parents[1] / 'pages' / 'arm.urdf'
LINK = 'link3'
"""Link that carries the sensor."""
FRAME = 'imu_link'
"""Frame of the sensor."""
PLACE_M = (0.08, -0.05, 0.06)
"""Place of that frame on the link, m, as the URDF has it."""
TURN_RAD = (0.3, 0.2, -0.4)
"""Roll, pitch and yaw of that frame on the link, rad, as the URDF has them."""
GRAVITY_MPS2 = (0.0, 0.0, -9.80665)
STEP_S = 0.002
"""Step of all simulators, s: the default of MuJoCo."""
EVERY = 2
"""Steps from one sample to the next; chosen: 250 Hz show the fastest motion of the joints."""
SECONDS = 40.0
"""Length of a run, s; chosen: the diagnosis needs 30 s."""
START_RAD = np.array([0.5, -0.5, 0.5])
"""Angles of the joints at the start, rad, at rest; chosen: the arm never turns over."""


def spec(noise: float = 0.0) -> Any:
    """Return the MjSpec of the arm, with an accelerometer that declares a noise, m/s²."""
    mujoco: Any = import_module('mujoco')
    made = mujoco.MjSpec.from_string(URDF.read_text(encoding='utf-8'))
    made.option.timestep, made.option.gravity = STEP_S, GRAVITY_MPS2
    turn = Rotation.from_euler('xyz', TURN_RAD).as_quat()
    made.body(LINK).add_site(name=FRAME, pos=PLACE_M, quat=np.roll(turn, 1))
    kind, site = mujoco.mjtSensor.mjSENS_ACCELEROMETER, mujoco.mjtObj.mjOBJ_SITE
    made.add_sensor(name='accelerometer', type=kind, objtype=site, objname=FRAME, noise=noise)
    return made
