# SPDX-License-Identifier: Apache-2.0

"""
Provenance of a calibration and its validity range, as the parameter file has them.

- Check that several recordings are of one unit in one mounting.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from datetime import datetime, timezone
import hashlib

from adxl_ros.calibrate import pose_response
from adxl_ros.calibrate.fits.full_model import FullFit
from adxl_ros.calibrate.fits.linear import planes
from adxl_ros.calibrate.poses import Poses, reference_force
from adxl_ros.errors import UserError
from adxl_ros.files import calibration_store
from adxl_ros.model import signal_chain
from adxl_ros.model.constants import AXES
from adxl_ros.model.covariance import leverage
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.sensor import Envelope, Sensor, STRETCH
from adxl_ros.package_version import package_version
import numpy as np

_SAME_BETA_RAD = 1e-3
"""Smaller changes of beta are no step of the sweep, rad. Chosen: below any step of a plan."""
_MAX_PLANES_LISTED = 12
"""Largest count of planes that are listed one by one."""


def with_provenance(fitted: Sensor, source: str, poses: Poses, data_sha256: str,
                    results: Mapping[str, str]) -> Sensor:
    """Add date, sources, sweep, data hash, results and id to a fitted unit."""
    entries = {
        **{key: text for key, text in fitted.provenance.items() if key.endswith('_from')},
        # A text of YAML, where +00:00 makes a date, which ros2 param cannot set.
        'date': f'{datetime.now(timezone.utc):%Y-%m-%dT%H:%M:%S}+0000',
        'package_version': package_version(), 'source': source,
        'data_sha256': data_sha256 or _poses_sha256(poses),
        'poses': str(int((~poses.check).sum())), 'check_poses': str(int(poses.check.sum())),
        'sweep': _sweep_text(poses), 'temperature_c': _mean_text(poses.temperature_c, '.2f'),
        'supply_v': _mean_text(poses.supply_v, '.4f'), **results}
    calibration_id = calibration_store.calibration_id(replace(fitted, provenance=entries))
    return replace(fitted, provenance={'id': calibration_id, **entries})


def _poses_sha256(poses: Poses) -> str:
    """Return the SHA-256 of all fields of poses, hexadecimal."""
    digest = hashlib.sha256()
    for field in fields(poses):
        values = np.ascontiguousarray(getattr(poses, field.name), dtype='<f8')
        digest.update(f'{field.name} {values.shape}'.encode())
        digest.update(values.tobytes())
    return digest.hexdigest()


def _sweep_text(poses: Poses) -> str:
    """Describe the fitted poses: planes, range and steps of beta, directions."""
    fitted = poses.subset(~poses.check)
    if not np.isfinite(fitted.alpha_rad).all():
        return f'{len(fitted)} rests in directions of its own, against gravity'
    alpha = [float(np.degrees(fitted.alpha_rad[plane].mean()))
             for plane in planes(fitted.alpha_rad)]
    alpha_text = ', '.join(f'{a:.0f}' for a in alpha) if len(alpha) <= _MAX_PLANES_LISTED else \
        f'{len(alpha)} planes from {alpha[0]:.0f} to {alpha[-1]:.0f}'
    lowest, highest = np.degrees([fitted.beta_rad.min(), fitted.beta_rad.max()])
    changes = np.diff(fitted.beta_rad)
    steps = np.abs(changes)[np.abs(changes) > _SAME_BETA_RAD]
    step = np.degrees(np.median(steps)) if steps.size else 0.0
    both_ways = (changes > _SAME_BETA_RAD).any() and (changes < -_SAME_BETA_RAD).any()
    # Without a colon: ros2 param reads the text as YAML again.
    return (f'{len(fitted)} poses, alpha {alpha_text} deg; beta {lowest:.0f} to {highest:.0f} '
            f'deg, steps of {step:.0f}, {"both directions" if both_ways else "one direction"}')


def _mean_text(values: np.ndarray, digits: str) -> str:
    finite = values[np.isfinite(values)]
    return f'{finite.mean():{digits}}' if finite.size else 'not measured'


def envelope(fitted: Sensor, force: np.ndarray, poses: Poses, misfit_mps2: float) -> Envelope:
    """
    Return the validity range of a calibration.

    force: specific force of k poses, check poses among them, m/s², (k, 3).
    """
    finite_c = poses.temperature_c[np.isfinite(poses.temperature_c)]
    rest_leverage = leverage(fitted)
    largest = max(float(rest_leverage(list(stretch * force.T)).max())
                  for stretch in (1.0, STRETCH))
    return Envelope((float(finite_c.min()), float(finite_c.max())) if finite_c.size else None,
                    zero_g_per_k=_unmodelled_slope(fitted, 'temperature_bias'),
                    scale_per_k=_unmodelled_slope(fitted, 'temperature_scale'),
                    leverage=largest, misfit_mps2=misfit_mps2,
                    force_low_mps2=tuple(force.min(axis=0).tolist()),
                    force_high_mps2=tuple(force.max(axis=0).tolist()))


def _unmodelled_slope(fitted: Sensor, effect: str) -> float:
    """Return the typical slope of an effect by the datasheet, else by the library; 0 if fitted."""
    if effect in fitted.effects:
        return 0.0
    typical, _ = fitted.datasheet.get(Coefficient(effect, 'per_k'), (0.0, 0.0))
    return typical or effect_named(effect).parameters[0].scale


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
        signal_chain.analog_response(unit), force, poses.environment), 2, 0)
    turned = np.stack([np.cross(axis, np.column_stack(force)) for axis in np.eye(3)], axis=2)
    shifted = np.broadcast_to(np.diag(unit.scale_v_per_g),
                              (len(poses), len(unit.axes), len(unit.axes)))
    normal = pose_response.volts_covariance(unit, poses, full.stage).normal_equations(
        np.concatenate([by_force @ turned, shifted], axis=2),
        poses.volts - pose_response.predicted_volts(unit, poses))
    covariance = np.linalg.pinv(normal.information, rcond=_MIN_EIGENVALUE_RATIO)
    return (covariance @ normal.gradient,
            np.sqrt(np.maximum(np.diag(covariance), _MIN_VARIANCE)))
