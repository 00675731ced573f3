# SPDX-License-Identifier: Apache-2.0

"""Errors of a unit in plain words: of its datasheet values, and from turn-on to turn-on."""

from __future__ import annotations

from collections.abc import Sequence

from adxl_ros.calibrate.pose_references import has_angles
from adxl_ros.calibrate.poses import Poses, reference_force
from adxl_ros.model import signal_chain
from adxl_ros.model.sensor import Sensor
import numpy as np

_RIDGE = 1e-3
"""Weight of a change of 0, relative to a rest, for a direction that no rest of a recording has.
Chosen: small beside one rest."""
_NEGLIGIBLE_MG = 0.01
"""Error or scatter below which only this limit is shown, mg. Chosen: no sensor repeats that
well."""
_SMALL_MG = 10.0
"""Error below which mg is the unit, and above which g is. Chosen: two digits read as 9.9 mg."""


def turn_on_lines(fitted: Sensor, recordings: Sequence[Poses]) -> list[str]:
    """Report the scatter of the zero-g over recordings of one unit."""
    if len(recordings) < 2:
        return []
    changes_mg = np.array([_zero_g_change_mg(fitted, poses) for poses in recordings])
    scatter_mg = np.std(changes_mg, axis=0, ddof=1)
    texts = [f'{value:.2g}' if value > _NEGLIGIBLE_MG else f'< {_NEGLIGIBLE_MG:g}'
             for value in scatter_mg]
    by_axis = ', '.join(f'{axis} {text}' for axis, text in zip(fitted.axes, texts))
    return [f'turn-on to turn-on: the zero-g scatters by {by_axis} mg (standard deviation over '
            f'{len(recordings)} recordings)']


def _zero_g_change_mg(fitted: Sensor, poses: Poses) -> np.ndarray:
    """Return the zero-g of a recording minus that of the fit by axis, mg, (m,)."""
    if has_angles(poses).any():
        poses = poses.subset(has_angles(poses))
        force = list(reference_force(poses, fitted.local_gravity_mps2))
        predicted = signal_chain.static_response(fitted)(force, poses.environment)
        residual_v = poses.volts - np.column_stack(predicted)
        return np.asarray(1e3 * np.mean(residual_v / fitted.scale_v_per_g, axis=0))
    # Against gravity a change shows along the direction of each rest only.
    force_mps2 = np.column_stack(signal_chain.inverse(fitted)(
        list(poses.volts.T), poses.environment))
    magnitude_mps2 = np.linalg.norm(force_mps2, axis=1)
    direction = force_mps2 / magnitude_mps2[:, None]
    excess_mg = 1e3 * (magnitude_mps2 / fitted.local_gravity_mps2 - 1)
    normal = direction.T @ direction + _RIDGE * np.eye(direction.shape[1])
    return np.asarray(np.linalg.solve(normal, direction.T @ excess_mg))


def errors_in_words(fitted: Sensor) -> str:
    """Return the largest errors of the uncalibrated sensor, for people."""
    offset_g = (fitted.zero_g_v - fitted.nominal_zero_g_v) / fitted.nominal_scale_v_per_g
    gain = fitted.scale_v_per_g / fitted.nominal_scale_v_per_g - 1
    first, second = int(np.argmax(np.abs(offset_g))), int(np.argmax(np.abs(gain)))
    return (f'Uncalibrated, {fitted.axes[first]} is {_force_text(offset_g[first])} off, and '
            f'{fitted.axes[second]} reads {abs(100 * gain[second]):.2g} % too '
            f'{"much" if gain[second] > 0 else "little"}.')


def _force_text(force_g: float) -> str:
    """Return a specific force with two digits, small ones in mg."""
    force_mg = 1e3 * force_g
    if abs(force_mg) < _NEGLIGIBLE_MG:
        return f'less than {_NEGLIGIBLE_MG:g} mg'
    return f'{force_g:+.2g} g' if abs(force_mg) >= _SMALL_MG else f'{force_mg:+.2g} mg'
