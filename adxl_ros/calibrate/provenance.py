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

"""Where a calibration comes from, and where it holds: what its parameter file says of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from datetime import datetime, timezone
import hashlib
from importlib.metadata import PackageNotFoundError, version

from adxl_ros.calibrate.fits.paper_regression import planes
from adxl_ros.calibrate.poses import Poses
from adxl_ros.files import calibration_store
from adxl_ros.model.covariance import leverage
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.sensor import Sensor
from adxl_ros.model.validity import Envelope, STRETCH
import numpy as np


def package_version() -> str:
    """Return the version of this package; 'unknown' when it runs from its source."""
    try:
        return version('adxl_ros')
    except PackageNotFoundError:
        return 'unknown'


def with_provenance(fitted: Sensor, source: str, poses: Poses, data_sha256: str,
                    more: Mapping[str, str]) -> Sensor:
    """
    State a fitted unit's date, surroundings, sweep, data and id.

    Parameters
    ----------
    fitted
        The unit.
    source
        Names of the recordings.
    poses
        All of them.
    data_sha256
        Of the recordings' files; empty takes the hash of the poses.
    more
        Keys and values more.

    """
    said = {'date': datetime.now(timezone.utc).isoformat(timespec='seconds'),
            'package_version': package_version(), 'source': source,
            'data_sha256': data_sha256 or poses_sha256(poses),
            'poses': str(int((~poses.check).sum())), 'check_poses': str(int(poses.check.sum())),
            'sweep': sweep_in_words(poses), 'temperature_c': _around(poses.temperature_c, '.2f'),
            'supply_v': _around(poses.supply_v, '.4f'), **more}
    made = replace(fitted, provenance=said)
    return replace(made, provenance={'id': calibration_store.calibration_id(made), **said})


def poses_sha256(poses: Poses) -> str:
    """Return the SHA-256 of the figures of poses, hexadecimal: volts, angles, times, marks."""
    found = hashlib.sha256()
    for field in fields(poses):
        values = np.ascontiguousarray(getattr(poses, field.name), dtype='<f8')
        found.update(f'{field.name} {values.shape}'.encode())
        found.update(values.tobytes())
    return found.hexdigest()


def sweep_in_words(poses: Poses) -> str:
    """Say which poses were visited, in degrees."""
    fitted = poses.subset(~poses.check)
    if not np.isfinite(fitted.alpha_rad).all():
        return f'{len(fitted)} rests in directions of its own, against gravity'
    of = [fitted.subset(plane) for plane in planes(fitted.alpha_rad)]
    ends = np.degrees([fitted.beta_rad.min(), fitted.beta_rad.max()])
    steps = np.concatenate([np.abs(np.diff(fitted.beta_rad)), np.zeros(1)])
    step = np.degrees(np.median(steps[steps > 1e-3])) if (steps > 1e-3).any() else 0.0
    back = np.diff(fitted.beta_rad)
    ways = 'both directions' if (back > 1e-3).any() and (back < -1e-3).any() else 'one direction'
    alpha = [float(np.degrees(one.alpha_rad.mean())) for one in of]
    said = ', '.join(f'{a:.0f}' for a in alpha) if len(alpha) <= 12 else \
        f'{len(alpha)} planes from {alpha[0]:.0f} to {alpha[-1]:.0f}'
    return (f'{len(fitted)} poses: alpha {said} deg; beta {ends[0]:.0f} to {ends[1]:.0f} deg, '
            f'steps of {step:.0f}, {ways}')


def _around(values: np.ndarray, digits: str) -> str:
    known = values[np.isfinite(values)]
    return f'{known.mean():{digits}}' if known.size else 'not measured'


def envelope(fitted: Sensor, force: np.ndarray, poses: Poses, misfit_mps2: float) -> Envelope:
    """
    Return where a calibration holds; see `model.validity`.

    Parameters
    ----------
    fitted
        The unit with its covariance.
    force
        Specific force of all poses, those that judge it too, m/s², (k, 3).
    poses
        The same poses.
    misfit_mps2
        What they showed beyond noise and stage, m/s².

    """
    known = poses.temperature_c[np.isfinite(poses.temperature_c)]
    slopes = {'zero_g_per_k': 'temperature_bias', 'scale_per_k': 'temperature_scale'}
    drift = {name: 0.0 if effect in fitted.effects else _typical_slope(fitted, effect)
             for name, effect in slopes.items()}
    h = leverage(fitted)
    largest = max(float(h(list(stretch * force.T)).max()) for stretch in (1.0, STRETCH))
    return Envelope((float(known.min()), float(known.max())) if known.size else None,
                    **drift, leverage=largest, misfit_mps2=misfit_mps2,
                    force_low_mps2=tuple(force.min(axis=0).tolist()),
                    force_high_mps2=tuple(force.max(axis=0).tolist()))


def _typical_slope(sensor: Sensor, effect: str) -> float:
    """Return the datasheet's typical slope, else that of the library."""
    typical, _ = sensor.datasheet.get(Coefficient(effect, 'per_k'), (0.0, 0.0))
    return typical or effect_named(effect).parameters[0].scale
