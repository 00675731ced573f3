# SPDX-License-Identifier: Apache-2.0
"""
The toolbox mujoco.sysid over zero-g, scale factor, misalignment, delay and bandwidth.

It fits all of them at once, with noise that is independent from sample to sample, and says no
cause. Those whose 95 % interval does not hold 0 count as named.
"""

from __future__ import annotations

from contextlib import redirect_stdout
import io

from absl import logging
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.sensor import parameter_of
from adxl_ros_validation.benchmark.case import Case, Finding
import numpy as np

try:
    from mujoco.sysid import calculate_intervals, optimize, Parameter, ParameterDict
except ImportError as error:
    # Without one of its own libraries it is empty, and does not say which.
    raise ImportError("mujoco[sysid]: run `pip install 'mujoco[sysid]'`") from error

logging.set_verbosity(logging.ERROR)
_EFFECTS = ('bias', 'scale_factor', 'misalignment', 'time_offset', 'bandwidth')
_STEP = 3
"""Samples from one that is fitted to the next; chosen: run time."""
_ITERATIONS = 10
"""Most iterations; chosen: run time."""


def method(case: Case) -> Finding:
    """Fit the parameters, and name those that are significant."""
    names = [name for name, change in case.tangents(_EFFECTS).items() if np.any(change)]
    scales = np.array([parameter_of(name).scale for name in names])

    def left(values: np.ndarray) -> np.ndarray:
        """Return what parameters, in their typical sizes, leave of the recording, m/s²."""
        sensor = case.with_changes(dict(zip(names, values * scales)))
        return case.residual_mps2(sensor)[case.known][::_STEP].ravel()

    def residual(values: np.ndarray, *_: object) -> tuple[list[np.ndarray], None, None]:
        """Return what parameters leave, in the form of the toolbox: several sets are columns."""
        if values.ndim == 1:
            return [left(values)], None, None
        return [np.column_stack([left(column) for column in values.T])], None, None

    limits = np.array([_bounds(name, scale) for name, scale in zip(names, scales)])
    given = Parameter('sensor', np.zeros(len(names)), limits[:, 0], limits[:, 1])
    with redirect_stdout(io.StringIO()):  # It prints each iteration, whatever it is told.
        fitted, found = optimize(
            ParameterDict({'sensor': given}), residual, x_scale='jac', max_iters=_ITERATIONS
        )
    values = fitted.as_vector()
    _, widths = calculate_intervals(residual(values)[0], np.asarray(found.jac))
    causes = {name.effect for name, v, w in zip(names, values, widths) if abs(v) > w}
    return Finding(frozenset(causes), 0.95, case.with_changes(dict(zip(names, values * scales))))


def _bounds(name: Coefficient, scale: float) -> tuple[float, float]:
    """Return the bounds of a change, in units of its typical size."""
    parameter = parameter_of(name)
    return max(parameter.lower / scale, -1e4), min(parameter.upper / scale, 1e4)
