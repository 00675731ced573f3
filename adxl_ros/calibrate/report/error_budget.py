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
What limits a calibration, and whether it passes: the mean square of held-out errors in its parts.

Means over the poses that show alpha, and axes, in squares, of the errors of the model against the
stage:

    seen = noise of the means + stage + fit + model

- noise: of the pose's mean, by the inverse's tangent.
- stage: a random error of each joint, up to the stated σ = step/√12; and what poses of the same
  angles differ by beyond that. Its level and its form, as the full model found them, are taken out
  of the reference.
- fit: the covariance of the calibration, which noise and stage have brought about.
- model: what is left, as far as it is more than chance makes once in a hundred (with the freedom
  of correlated poses) and no scatter between visits of the same pose. Where no pose was visited
  twice, a sensor with z tells the two by |f|, which no stage can change.

What calibration itself errs by, noise and stage of the check taken out, is √(fit + model).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import sqrt

from adxl_ros.calibrate.fits.gravity_fit import GravityFit
from adxl_ros.calibrate.pose_response import stage_force
from adxl_ros.calibrate.poses import Poses, reference_force
from adxl_ros.calibrate.report.cross_validation import between, errors, freedom, Score
from adxl_ros.model import noise
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.covariance import force_covariance
from adxl_ros.model.sensor import Sensor
import numpy as np
from scipy.spatial import cKDTree
from scipy.stats import chi2

_SAME_RAD = np.radians(0.5)
"""Poses whose joints agree so well are visits of the same."""
_FEWEST_PAIRS = 6
_SMALL_MPS2 = 1e-3 * G0_MPS2
_CHANCE = 0.01
KINDS = ('noise', 'stage', 'model')


@dataclass(frozen=True)
class Parts:
    """
    Parts of the mean square of held-out errors: (m/s²)² an axis, or rad² of tilt.

    Attributes
    ----------
    seen
        All of it.
    noise, stage, fit, model
        See the module; they need not sum to `seen`, which chance moves.
    own_most
        Upper end of the 90 % interval of `fit + model`.
    apart
        Whether stage and model could be told apart.
    per_axis
        Mean square of tilt that one of 1 (m/s²)² on each measured axis makes; of tilt alone.

    """

    seen: float
    noise: float
    stage: float
    fit: float
    model: float
    own_most: float
    apart: bool = True
    per_axis: float = float('nan')

    @property
    def own(self) -> float:
        """Return the mean square of what the calibration itself errs by."""
        return self.fit + self.model

    @property
    def limit(self) -> str:
        """Name the largest of `KINDS`; the fit's part has come of them and grows with them."""
        return KINDS[int(np.argmax([getattr(self, kind) for kind in KINDS]))]


_NOTHING = Parts(*(float('nan'),) * 6)  # type: ignore[arg-type]


def parts(score: Score, poses: Poses, stage: Sensor | None = None) -> tuple[Parts, Parts]:
    """
    Take the held-out errors of one model apart.

    Parameters
    ----------
    score
        From `cross_validation.held_out`.
    poses
        All of them, as they were given to it.
    stage
        The unit with what was fitted of the stage; None where nothing was.

    Returns
    -------
    tuple
        Of acceleration, (m/s²)² an axis, and of tilt, rad².

    """
    assert score.errors is not None
    held = poses.subset(score.index)
    sensor = score.fitted[0]
    gravity = sensor.local_gravity_mps2
    promised = np.column_stack(reference_force(held, gravity))
    stood = promised if stage is None else np.column_stack(
        stage_force(stage, held.alpha_rad, held.beta_rad))
    shown = np.isfinite(score.errors.tilt_rad)
    axes = [AXES.index(a) for a in sensor.axes]
    # Where equation 5 has two roots, the wrong z shifts x and y: that is none of the parts.
    plain = shown if shown.any() else np.isfinite(score.errors.force_mps2).all(axis=1)
    off = (score.errors.force_mps2 - stood)[plain][:, axes]
    of_noise, of_fit, of_stage, of_one = _covariances(score, held, promised)
    found = []
    scattered = _between_visits(sensor, poses.subset(~poses.check))
    for i, (after, before, weigh) in enumerate((
            (off, score.errors.accel_mps2[plain], _along(axes, plain)),
            (between(score.errors.force_mps2, stood)[shown], score.errors.tilt_rad[shown],
             _across(promised, gravity, shown)))):
        if not after.size:
            # No pose shows it, or a sensor of one axis has no tilt.
            found.append(_NOTHING)
            continue
        known = [weigh(covariance) for covariance in (of_noise, of_fit, of_stage)]
        found.append(_apart(after, float(np.mean(before ** 2)), known,
                            None if scattered is None else scattered[i](known[0])))
    if shown.any() and found[1] is not _NOTHING:
        per_axis = _across(promised, gravity, shown)(of_one) / _SMALL_MPS2 ** 2
        found[1] = replace(found[1], per_axis=per_axis)
    return found[0], found[1]


def _apart(off: np.ndarray, seen: float, known: list[float], random: float | None) -> Parts:
    """
    Split a mean square whose parts by noise, fit and the stated stage are known.

    `random` is what no model could explain, noise apart; None where nothing tells it.
    """
    by_noise, by_fit, stated = known
    after, nu = float(np.mean(off ** 2)), freedom(off)
    sure, high = (after * nu / float(chi2.isf(chance, nu)) for chance in (_CHANCE, 0.95))
    at_most = stated if random is None else max(stated, random)
    explained = by_noise + by_fit + at_most
    model = after - explained if sure > explained else 0.0
    stage = min(max(after - by_noise - by_fit, 0.0), at_most)
    return Parts(seen, by_noise, max(seen - after, 0.0) + stage, by_fit, model,
                 by_fit + max(high - explained, 0.0), random is not None)


def _covariances(score: Score, held: Poses, promised: np.ndarray) -> list[np.ndarray]:
    """Return those of the force by the mean's noise, fit, stated stage and 1 mg, (3, 3, k)."""
    found = [np.zeros((3, 3, len(held))) for _ in range(4)]
    for number, sensor in enumerate(score.fitted):
        own = score.fold == number
        force, around = list(promised[own].T), held.subset(own).environment
        std2 = np.mean(held.std_v[own], axis=0) ** 2
        both = force_covariance(sensor, force, std2, around)
        quiet = force_covariance(sensor, force, 0 * std2, around)
        found[0][:, :, own], found[1][:, :, own] = both - quiet, quiet
        known = sensor.without_covariance()
        found[3][:, :, own] = force_covariance(
            known, force, (sensor.scale_v_per_g / G0_MPS2 * _SMALL_MPS2) ** 2, around)
    sensor = score.fitted[0]
    sigma2 = sensor.stage_resolution_rad ** 2 / 12 * sensor.local_gravity_mps2 ** 2
    a, b, nothing = held.alpha_rad, held.beta_rad, np.zeros(len(held))
    by_alpha = np.array([np.cos(a) * np.cos(b), -np.cos(a) * np.sin(b), -np.sin(a)])
    by_beta = np.array([-np.sin(a) * np.sin(b), -np.sin(a) * np.cos(b), nothing])
    found[2] = sigma2 * sum(np.einsum('ik,jk->ijk', one, one) for one in (by_alpha, by_beta))
    return found


def _along(axes: list[int], used: np.ndarray) -> Callable[[np.ndarray], float]:
    return lambda covariance: float(np.mean([covariance[d, d][used] for d in axes]))


def _across(force: np.ndarray, gravity: float, shown: np.ndarray
            ) -> Callable[[np.ndarray], float]:
    """Weigh a covariance by what it turns the vertical by, mean over the poses that show it."""
    up = force / np.linalg.norm(force, axis=1, keepdims=True)

    def weigh(covariance: np.ndarray) -> float:
        whole = np.einsum('iik->k', covariance)
        radial = np.einsum('ki,ijk,kj->k', up, covariance, up)
        return float(np.mean((whole - radial)[shown])) / gravity ** 2
    return weigh


def _between_visits(sensor: Sensor, poses: Poses) -> list[Callable[[float], float]] | None:
    """
    Return what scatters and is no model's, of acceleration, (m/s²)² an axis, and of tilt, rad².

    Functions of the part that is the noise of the means; None where nothing tells it.
    """
    place = np.column_stack([np.cos(poses.alpha_rad), np.sin(poses.alpha_rad),
                             np.cos(poses.beta_rad), np.sin(poses.beta_rad)])
    pairs = np.array(sorted(cKDTree(place).query_pairs(_SAME_RAD)), int).reshape(-1, 2)
    gravity = sensor.local_gravity_mps2
    of, promised = errors(sensor, poses), np.column_stack(reference_force(poses, gravity))
    if len(pairs) >= _FEWEST_PAIRS:
        off = np.diff(of.accel_mps2[pairs], axis=1)[:, 0]
        whole = np.diff((of.force_mps2 - promised)[pairs], axis=1)[:, 0]
        shown = np.isfinite(of.tilt_rad[pairs]).all(axis=1)
        across = np.cross(whole, promised[pairs[:, 0]])[shown] / gravity ** 2
        scatter = np.mean(off ** 2) / 2, np.sum(across ** 2) / max(len(across), 1) / 2
        return [lambda noise, one=one: float(one) - noise for one in scatter]  # type: ignore
    if sensor.axes != 'xyz':
        return None
    # No stage changes |f|: what that scatters by, a model's error has in each direction.
    along = np.linalg.norm(of.force_mps2, axis=1) - gravity
    more = max(float(np.mean(of.accel_mps2 ** 2) - np.mean(along ** 2)), 0.0)
    return [lambda _: more, lambda _: 3 * more / gravity ** 2]


def gravity_parts(found: GravityFit, fitted: Sensor, force: np.ndarray, kept: np.ndarray
                  ) -> tuple[Parts, Parts]:
    """
    Take the errors of magnitudes, each by the fit to the other rests, apart; no stage is there.

    The fit's part is that of the force, which the covariance tells, not that of the magnitude:
    it has the directions that a magnitude does not show.

    Parameters
    ----------
    found, fitted
        The fit, and the unit that it gives.
    force
        Of all rests by the fit, m/s², (k, 3).
    kept
        Numbers of those that were no knocks.

    Returns
    -------
    tuple
        Of acceleration, (m/s²)² an axis, and of tilt, rad².

    """
    off = found.leave_one_out_mps2[kept]
    excess = found.excess_mps2 ** 2
    by_noise = float(np.mean(found.expected_mps2[kept] ** 2)) - excess
    covariance = force_covariance(fitted, list(force[kept].T), np.zeros(len(fitted.axes)))
    gravity, shown = fitted.local_gravity_mps2, np.ones(len(kept), bool)
    seen, nu = float(np.mean(off ** 2)), freedom(off)
    most = max(seen * nu / float(chi2.isf(0.95, nu)) - by_noise, excess)
    by_fit = _along([0, 1, 2], shown)(covariance), _across(force[kept], gravity, shown)(covariance)
    return (Parts(seen, by_noise, 0.0, by_fit[0], excess, by_fit[0] + most),
            Parts(3 * seen / gravity ** 2, 2 * by_noise / gravity ** 2, 0.0, by_fit[1],
                  2 * excess / gravity ** 2, by_fit[1] + 2 * most / gravity ** 2,
                  per_axis=2 / gravity ** 2))


def own_noise_mps2(sensor: Sensor) -> float:
    """Return the noise of one sample, rms over the axes, m/s²."""
    return float(np.sqrt(np.mean((noise.sigma_v(sensor) / sensor.scale_v_per_g) ** 2))) * G0_MPS2


def milli_g(square: float) -> float:
    """Turn a mean square, (m/s²)², into mg rms."""
    return sqrt(max(square, 0.0)) / G0_MPS2 * 1e3
