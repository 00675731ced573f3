# SPDX-License-Identifier: Apache-2.0

"""Recordings of a calibrated unit with effects that its file does not have."""

from dataclasses import replace

from adxl_ros.files.recording_columns import Recording
from adxl_ros.files.stream_info import sensor_info
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.simulate import trajectories
from adxl_ros.simulate.motion import Knots, Motion
from adxl_ros.simulate.response import simulate
import numpy as np
from units import nominal, with_effects


def unit(axes='xy'):
    names = tuple(
        Coefficient(effect, parameter, axis)
        for effect, parameter in (('bias', 'offset_v'), ('scale_factor', 'offset_v_per_g'))
        for axis in axes
    )
    return replace(
        nominal(axes),
        rate_hz=125.0,
        stage_resolution_rad=1e-4,
        model='linear',
        effects=('bias', 'scale_factor'),
        covariance_names=names,
        covariance=np.eye(len(names)) * 1e-9,
        values={
            'bias': {'offset_v': np.array([0.01, -0.04, 0.02])[: len(axes)]},
            'scale_factor': {'offset_v_per_g': np.array([0.02, -0.01, 0.0])[: len(axes)]},
        },
    )


def turning(speeds=(0.6, 1.5, 1.0, 2.5, 0.8), alphas=(np.pi / 2, np.pi / 4, 2.0)):
    """Turn beta in some planes at some speeds, with rests."""
    script = trajectories.Script(alphas[0], 0.0)
    for alpha in alphas:
        script.go(alpha, 0.0)
        script.rest(3.0)
        for to, speed in zip((2.0, 0.5, 6.0, 3.0, 0.0), speeds):
            script.run('beta', to, speed)
            script.rest(1.0)
    alpha, beta = script.joints()
    return Motion(script.now_s, alpha, beta)


def warm(motion):
    """Add a temperature that rises by 12 degC and falls."""
    times_s = np.linspace(0.0, motion.duration_s, 4)
    return replace(motion, temperature_c=Knots(times_s, [25.0, 25.0, 37.0, 33.0]))


def simulated(sensor, *effects, motion=None, seed=3, change=lambda columns: columns):
    made = with_effects(sensor, list(effects))
    columns = change(simulate(made, motion or warm(turning()), seed))
    return Recording('made', columns.pop('time_s'), columns, sensor_info(sensor))
