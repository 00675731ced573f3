# SPDX-License-Identifier: Apache-2.0

"""The parameters of the node `investigate`."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from adxl_ros.investigate.manoeuvres import StageLimits
from adxl_ros.nodes.support.parameters import declare, parameter_error
import numpy as np
from rclpy.node import Node

_ALPHA_DEG = (0.0, 180.0)
"""Default limits of alpha, degrees; chosen: gravity then reaches every direction."""
_BETA_DEG = (0.0, 360.0)
"""Default limits of beta, degrees; chosen: one turn, as in a calibration."""
_RATE_DEG_S = 17.0
"""Default limit of rate, degrees/s; chosen: the default speed of the bridge, 0.3 rad/s."""


class InvestigateSettings(NamedTuple):
    """Settings of an investigation."""

    output: Path  # Folder of bag and report
    limits: StageLimits  # Limits of the stage
    minutes: float  # Largest time of all manoeuvres together, min
    seed: int  # Seed of the diagnosis


def declare_settings(node: Node) -> InvestigateSettings:
    """Declare the parameters and return the settings."""
    output = Path(declare(node, 'output', 'investigation',
                          'folder of bag, report and parameters; a number is added where it '
                          'has a diagnosis'))
    rate_deg_s = declare(node, 'limits.rate_deg_s', _RATE_DEG_S, 'largest rate of each joint',
                         'deg/s', 0.1, 180.0)
    minutes = declare(node, 'limits.minutes', 15.0, 'largest time of all manoeuvres together',
                      'min', 0.5, 240.0)
    limits = StageLimits(_declare_range(node, 'alpha', _ALPHA_DEG),
                         _declare_range(node, 'beta', _BETA_DEG), float(np.radians(rate_deg_s)))
    return InvestigateSettings(output, limits, minutes, declare(
        node, 'seed', 0, 'seed of the diagnosis', '', 0, 2 ** 31 - 1))


def _declare_range(node: Node, joint: str, default_deg: tuple[float, float]
                   ) -> tuple[float, float]:
    """Declare the limits of one joint, and return them in rad."""
    name = f'limits.{joint}_deg'
    given = declare(node, name, (), f'lowest and highest angle of {joint}, a list of numbers; '
                    f'empty: {default_deg[0]:g} to {default_deg[1]:g}', 'deg') or default_deg
    try:
        low_deg, high_deg = (float(value) for value in given)
    except (TypeError, ValueError):
        raise parameter_error(name, f'{given!r} is no list of two degrees; write [0.0, 90.0]'
                              ) from None
    if not -3600 <= low_deg < high_deg <= 3600:
        raise parameter_error(name, f'[{low_deg:g}, {high_deg:g}] is no lowest and highest angle '
                              'within 10 turns; write [0.0, 90.0]')
    return float(np.radians(low_deg)), float(np.radians(high_deg))
