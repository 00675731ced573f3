# SPDX-License-Identifier: Apache-2.0
"""Say "bias" to every recording: what a method must be better than."""

from adxl_ros.model.effects.base import Coefficient
from adxl_ros_validation.benchmark.case import Case, Finding
import numpy as np


def method(case: Case) -> Finding:
    """Move zero-g by the mean of the residual, and name that."""
    scale = case.v_per_mps2
    mean_v = np.nanmean(case.residual_mps2(), axis=0) * scale
    changes = {
        Coefficient('bias', 'offset_v', axis): float(value)
        for axis, value in zip(case.parameters.axes, mean_v)
    }
    return Finding(frozenset({'bias'}), 1.0, case.with_changes(changes))
