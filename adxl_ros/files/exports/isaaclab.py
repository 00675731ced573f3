# SPDX-License-Identifier: Apache-2.0

"""Isaac Lab: a Python module with the offset of the sensor and the noise of its observation."""

from __future__ import annotations

from adxl_ros.files.exports.base import (
    arm_m,
    axes,
    Export,
    flat_noise_lines,
    head,
    WHITE_NOISE,
)
from adxl_ros.model.constants import AXES

HOLDS = {WHITE_NOISE: 'std', 'noise_excess': 'std', 'bias': 'mean', 'lever_arm': 'pos'}


def text(export: Export) -> str:
    """Return the content of a file: configurations of Isaac Lab, `isaaclab.sensors.ImuCfg`."""
    sensor = export.sensor
    by_name = {axis.name: axis for axis in axes(sensor)}
    mean, std = ([getattr(by_name[name], field) if name in by_name else 0.0 for name in AXES]
                 for field in ('zero_g_mps2', 'noise_std_mps2'))
    comment = [*head(export, 'Isaac Lab', HOLDS), '',
               *flat_noise_lines(sensor),
               'The whole chain for all environments, in each step:',
               '  from adxl_ros.simulate.sensor_model import SensorModel',
               f'  sensor = SensorModel({export.source!r})',
               '  readings = sensor(imu.data.lin_acc_b.cpu().numpy(), dt)']
    return '\n'.join([
        *(f'# {line}'.rstrip() for line in comment), '',
        'from isaaclab.sensors import ImuCfg',
        'from isaaclab.utils.noise import GaussianNoiseCfg',
        'import torch', '',
        '# ImuCfg(prim_path=..., offset=OFFSET, update_period=UPDATE_PERIOD_S)',
        f'OFFSET = ImuCfg.OffsetCfg(pos={tuple(arm_m(sensor))!r})',
        f'UPDATE_PERIOD_S = {1 / sensor.rate_hz!r}', '',
        '# ObsTerm(func=mdp.imu_lin_acc, noise=ACCELERATION_NOISE), m/s^2',
        'ACCELERATION_NOISE = GaussianNoiseCfg(',
        f'    mean=torch.tensor({mean!r}),',
        f'    std=torch.tensor({std!r}),',
        "    operation='add')", ''])
