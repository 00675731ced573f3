# Copyright 2026 the adxl_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
The paper's search for the misalignment of (18) and (19), compared with null crossings.

The case's x is set vertical and turned about y and z until the output is largest. Near its
maximum the output is flat: 0.2° change it by 6 µg, below the 35 µg noise of a 5 s mean. Where the
axis is level, the same angle changes it by 3.5 mg.
"""

from __future__ import annotations

from dataclasses import dataclass

from adxl_ros.calibrate.poses import Poses
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.sensor import Sensor
from adxl_ros.reproduction import experiments
import numpy as np

SEARCH_RAD = np.radians(np.arange(-5.0, 5.01, 0.5))
"""Angles about the case's axis, rad; chosen."""


@dataclass(frozen=True)
class DirectionSearch:
    """
    Beta of the direction of the x axis by three methods.

    Attributes
    ----------
    truth_rad
        The true value, rad.
    largest_rad
        By the largest output, rad.
    parabola_rad
        By a parabola through the outputs, rad.
    null_rad
        By the null crossings at ±90°, rad.
    turned_rad, output_g
        Angles, rad, and outputs by the nominal scale factor, g, (k,).

    """

    truth_rad: float
    largest_rad: float
    parabola_rad: float
    null_rad: float
    turned_rad: np.ndarray
    output_g: np.ndarray


def search(truth: Sensor, seed: int) -> DirectionSearch:
    """
    Turn beta about 0 at alpha = 90° (maximum), and about ±90° (null), 5 s in each pose.

    The beta of the largest output is minus that of (18): x_ref has to turn back by it. Between
    the null crossings at +90° and −90° the zero-g cancels.

    Parameters
    ----------
    truth
        The unit.
    seed
        Seed of all random numbers.

    Returns
    -------
    DirectionSearch
        The direction by all methods.

    """
    around = {'top': 0.0, 'left': np.pi / 2, 'right': -np.pi / 2}
    volts = {}
    for i, (name, middle) in enumerate(around.items()):
        read = np.column_stack([np.full(len(SEARCH_RAD), np.pi / 2), middle + SEARCH_RAD])
        poses: Poses = experiments.poses_at(truth, read, seed + (10 + i) * 1_000_003)[0]
        volts[name] = (poses.volts[:, 0] - truth.nominal_zero_g_v[0]) / (
            truth.nominal_scale_v_per_g[0] * truth.local_gravity_mps2 / G0_MPS2)
    top = volts['top']
    curve = np.polyfit(SEARCH_RAD, top, 2)
    # The output near ±90° is ∓s·(turn − u) + zero-g, so that the difference is 0 at u.
    slope, level = np.polyfit(SEARCH_RAD, (volts['left'] - volts['right']) / 2, 1)
    return DirectionSearch(_direction(truth), -float(SEARCH_RAD[np.argmax(top)]),
                           float(curve[1] / (2 * curve[0])), float(level / slope), SEARCH_RAD, top)


def _direction(truth: Sensor) -> float:
    """Return β_x of (18) with the linear cross-axis term, which equals it to first order."""
    beta = float(truth.values.get('misalignment', {}).get('beta_rad', [0.0])[0])
    return beta + float(truth.values.get('cross_axis', {}).get('linear', [0.0])[0])
