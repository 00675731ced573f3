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

"""Whether several recordings are of one unit in one mounting."""

from __future__ import annotations

from collections.abc import Sequence

from adxl_ros.calibrate import pose_response
from adxl_ros.calibrate.fits import full_model
from adxl_ros.calibrate.poses import Poses, reference_force
from adxl_ros.errors import UserError
from adxl_ros.model import signal_chain
import numpy as np

_FARTHEST_RAD = np.radians(0.3)
_FARTHEST_G = 0.02
"""A zero-g may move by so much between two days; more is another unit, or a damaged one."""
_SURE = 6.0
"""Standard deviations."""


def require_one_mounting(found: full_model.FullFit, parts: Sequence[Poses], names: Sequence[str]
                         ) -> None:
    """
    Refuse recordings of which one asks for another mounting or another zero-g than the rest.

    Each recording's residuals about the common fit are explained by a turn of the case and a
    shift of the zero-g of each axis, by least squares.

    Parameters
    ----------
    found
        The common fit.
    parts
        Poses by recording.
    names
        Of the recordings.

    Raises
    ------
    UserError
        Names the recording, the figure and its standard deviations.

    """
    fitted = found.unit
    for poses, name in zip(parts, names):
        force = reference_force(poses, fitted.local_gravity_mps2)
        slope = np.moveaxis(signal_chain.jacobian(signal_chain.analog_response(fitted), force,
                                                  poses.environment), 2, 0)
        f = np.column_stack(force)
        turns = np.stack([np.cross(axis, f) for axis in np.eye(3)], axis=2)
        shifts = np.broadcast_to(np.diag(fitted.scale_v_per_g),
                                 (len(poses), len(fitted.axes), len(fitted.axes)))
        off = poses.volts - pose_response.predicted_volts(fitted, poses)
        products = pose_response.volts_covariance(fitted, poses, found.stage).products(
            np.concatenate([slope @ turns, shifts, off[:, :, None]], axis=2))
        spread = np.linalg.pinv(products[:-1, :-1], rcond=1e-10)
        asked = spread @ products[:-1, -1]
        sigma = np.sqrt(np.maximum(np.diag(spread), 1e-30))
        count = len(fitted.axes)
        limit = np.repeat([_FARTHEST_RAD, _FARTHEST_G], [3, count])
        deviations = np.where(np.abs(asked) > limit, np.abs(asked) / sigma, 0.0)
        worst = int(np.argmax(deviations))
        if deviations[worst] > _SURE:
            text = f'is turned by {np.degrees(asked[worst]):.2f} deg ({"xyz"[worst]})' \
                if worst < 3 else \
                f'has its zero-g off by {1e3 * asked[worst]:.2f} mg ({fitted.axes[worst - 3]})'
            raise UserError(
                f'{name}: {text} about the fit of all recordings, {deviations[worst]:.0f} '
                'standard deviations: another unit or another mounting; fit it alone')
