# SPDX-License-Identifier: Apache-2.0

"""Check that several recordings are of one unit in one mounting."""

from __future__ import annotations

from collections.abc import Sequence

from adxl_ros.calibrate import pose_response
from adxl_ros.calibrate.fits.full_model import FullFit
from adxl_ros.calibrate.poses import Poses, reference_force
from adxl_ros.errors import UserError
from adxl_ros.model import analog_stages, signal_chain
from adxl_ros.model.constants import AXES
import numpy as np

_MAX_TURN_RAD = np.radians(0.3)
"""Largest turn of the case between recordings, rad. Chosen: above the 0.1° of the stage's level in
either recording, far below a new mounting."""
_MAX_ZERO_G_SHIFT_G = 0.02
"""Largest shift of the zero-g between recordings, g. Chosen: a healthy unit may shift by so much
between two days."""
_MIN_DEVIATIONS = 6.0
"""Smallest turn or shift that counts, in its standard deviations. Chosen: never by chance."""
_MIN_EIGENVALUE_RATIO = 1e-10
"""Smallest relative eigenvalue of the information whose direction counts as determined."""
_MIN_VARIANCE = 1e-30
"""Lower bound of the variance of a turn, rad², or shift, g², so that it can be a divisor."""


def require_one_mounting(full: FullFit, parts: Sequence[Poses], names: Sequence[str]) -> None:
    """
    Refuse recordings if the mounting or the zero-g of one of them differs.

    A turn of the case and a shift of the zero-g of each axis are fitted by least squares to the
    residuals of each recording about the common fit.
    """
    axes = full.unit.axes
    limits = np.repeat([_MAX_TURN_RAD, _MAX_ZERO_G_SHIFT_G], [3, len(axes)])
    for poses, name in zip(parts, names):
        changes, std = _turn_and_shifts(full, poses)
        deviations = np.where(np.abs(changes) > limits, np.abs(changes) / std, 0.0)
        worst = int(np.argmax(deviations))
        if deviations[worst] <= _MIN_DEVIATIONS:
            continue
        change = f'case is turned by {np.degrees(changes[worst]):.2f} deg about {AXES[worst]}' \
            if worst < 3 else \
            f'zero-g of {axes[worst - 3]} is shifted by {1e3 * changes[worst]:.2f} mg'
        raise UserError(
            f'{name}: {change} from the fit of all recordings ({deviations[worst]:.0f} standard '
            'deviations): another unit or another mounting; fit this recording separately')


def _turn_and_shifts(full: FullFit, poses: Poses) -> tuple[np.ndarray, np.ndarray]:
    """Fit the turn of the case, rad, (3,), and the zero-g shifts, g, (m,); values and std."""
    unit = full.unit
    force = reference_force(poses, unit.local_gravity_mps2)
    by_force = np.moveaxis(signal_chain.jacobian(
        analog_stages.analog_response(unit), force, poses.environment), 2, 0)
    turned = np.stack([np.cross(axis, np.column_stack(force)) for axis in np.eye(3)], axis=2)
    shifted = np.broadcast_to(np.diag(unit.scale_v_per_g),
                              (len(poses), len(unit.axes), len(unit.axes)))
    normal = pose_response.volts_covariance(unit, poses, full.stage).normal_equations(
        np.concatenate([by_force @ turned, shifted], axis=2),
        poses.volts - pose_response.predicted_volts(unit, poses))
    covariance = np.linalg.pinv(normal.information, rcond=_MIN_EIGENVALUE_RATIO)
    return (covariance @ normal.gradient,
            np.sqrt(np.maximum(np.diag(covariance), _MIN_VARIANCE)))
