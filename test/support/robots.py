# SPDX-License-Identifier: Apache-2.0

"""URDFs of small robots, and the readings of their joints."""

import numpy as np


def urdf(joints, arm_m=0.5, fixed_rpy='0 0 0'):
    """Return a chain of joints, each (axis, origin), that ends in imu_link at the arm along x."""
    inertia = (
        '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" '
        'iyz="0"/></inertial>'
    )
    text, parent = f'<robot name="r"><link name="base">{inertia}</link>', 'base'
    for number, (axis, origin) in enumerate(joints, 1):
        text += (
            f'<link name="l{number}">{inertia}</link><joint name="j{number}" '
            f'type="revolute"><parent link="{parent}"/><child link="l{number}"/>'
            f'<origin xyz="{origin}"/><axis xyz="{axis}"/>'
            '<limit lower="-6" upper="6" effort="9" velocity="9"/></joint>'
        )
        parent = f'l{number}'
    return text + (
        f'<link name="imu_link"/><joint name="mount" type="fixed"><parent '
        f'link="{parent}"/><child link="imu_link"/><origin xyz="{arm_m} 0 0" '
        f'rpy="{fixed_rpy}"/></joint></robot>'
    )


def encoded(values, step_rad):
    return np.rint(values / step_rad) * step_rad if step_rad else values
