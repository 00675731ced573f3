# SPDX-License-Identifier: Apache-2.0

"""Report of a full fit as lines of text: stage, outliers, weakest direction, terms."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from adxl_ros.calibrate.fits import full_model
from adxl_ros.calibrate.fits.term_selection import Term
from adxl_ros.calibrate.poses import Poses
from adxl_ros.model.coefficients import get, parameter_of
from adxl_ros.model.constants import Z_90
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.report.numbers import with_half_width
import numpy as np

NOT_CONVERGED = ('the fit did not converge: coefficients and intervals are those of its last '
                 'step; add poses, or leave out terms')
"""Line of a fit that did not converge."""
_MAX_WARMING_K = 3.0
"""Range of temperature beyond which the report warns, K: 0.3 mg by the datasheet's 0.1 mg/°C."""
_TYPICAL_DRIFT_MG_PER_K = 0.1
"""Typical drift of the zero-g, mg/°C (ADXL203 datasheet)."""
_MIN_POSE_SHARE = 0.1
"""Ratio of the stage error by pose to that by setting from which it is reported."""
_BAD_STAGE_RATIO = 1.5
"""Ratio of the estimated to the stated stage error from which the report warns."""
_MIN_STAGE_EXCESS_RAD = 1e-5
"""Excess over that ratio from which the report warns, rad, for a stage without a stated error."""
_MAX_OUTLIERS_NAMED = 8
"""Largest count of outliers in the report."""
_MAX_PARTS = 4
"""Largest count of components of the weakest direction in the report."""
_MIN_PART = 0.2
"""Smallest component of the weakest direction, a unit vector, in the report."""


class WeakestDirection(NamedTuple):
    """The direction of the sensor's coefficients that the poses determine least."""

    # Square root of the ratio of the extreme eigenvalues of the covariance, with each coefficient
    # in units of its typical size
    condition_number: float
    std: float  # Standard deviation along the direction, in typical sizes
    parts: list[tuple[Coefficient, float]]  # Largest components of its unit vector


def weakest_direction(full: full_model.FullFit) -> WeakestDirection:
    """Return the weakest direction of a fit and its condition number."""
    names = full.fitted.covariance_names
    scale = np.array([parameter_of(name).scale for name in names])
    values, vectors = np.linalg.eigh(full.fitted.covariance / np.outer(scale, scale))
    order = np.argsort(-np.abs(vectors[:, -1]))[:_MAX_PARTS]
    parts = [(names[i], float(vectors[i, -1])) for i in order if abs(vectors[i, -1]) > _MIN_PART]
    return WeakestDirection(float(np.sqrt(values[-1] / values[0])), float(np.sqrt(values[-1])),
                            parts)


def report_lines(full: full_model.FullFit, poses: Poses, terms: Sequence[Term]) -> list[str]:
    """
    Report the stage, the outliers, the weakest direction and the terms of a fit.

    Parameters
    ----------
    full, terms
        From `term_selection.fit_selected`.
    poses
        The fitted poses.

    Returns
    -------
    list
        Lines of text.

    """
    weakest = weakest_direction(full)
    direction = ' '.join(f'{value:+.2f} {name}' for name, value in weakest.parts)
    next_poses = full_model.next_poses(full.unit, poses, full.names, full.stage)
    return [
        *_stage_lines(full),
        *warnings(full, poses),
        f'least determined: {direction}, std {weakest.std:.2g} typical sizes '
        f'(condition number {weakest.condition_number:.0f})',
        f'next poses that would help most, (alpha, beta) in deg: '
        f'{full_model.format_poses(next_poses)}',
        *(['log Bayes factor of each term, nats; above 0 the poses support it:'] if terms else []),
        *(f'  {term.name:20} {term.log_bayes_factor:10.1f}'
          f'{"" if term.is_supported else "   not supported by these poses"}' for term in terms)]


def warnings(full: full_model.FullFit, poses: Poses) -> list[str]:
    """
    Return what is wrong with the poses or the fit, one line each.

    Parameters
    ----------
    full
        The fit.
    poses
        The fitted poses.

    Returns
    -------
    list of str
        Nothing where all is well.

    """
    lines = [] if full.converged else [NOT_CONVERGED]
    if full.stage_std_rad > _BAD_STAGE_RATIO * full.stated_std_rad + _MIN_STAGE_EXCESS_RAD:
        lines.append('the reference is worse than stated, or the model lacks an effect that looks '
                     'like a stage error; poses are weighted accordingly')
    return [*lines, *_outlier_lines(full, poses), *_temperature_lines(full, poses)]


def _stage_lines(full: full_model.FullFit) -> list[str]:
    setting_deg = np.degrees(full.stage.setting_rad * full.stage.joints)
    pose_deg = np.degrees(full.stage.pose_rad * full.stage.joints)
    by_pose = f'; {pose_deg[0]:.2g} and {pose_deg[1]:.2g} deg rms by pose' \
        if pose_deg[0] > _MIN_POSE_SHARE * setting_deg[0] else ''
    lines = [f'stage error: alpha {setting_deg[0]:.2g}, beta {setting_deg[1]:.2g} deg rms by '
             f'setting{by_pose} (stated {np.degrees(full.stated_std_rad):.2g} deg)']
    std = np.sqrt(np.diag(np.linalg.inv(full.information)))
    values = [f'{name} {with_half_width(float(value), Z_90 * value_std)} {parameter_of(name).unit}'
              for name, value, value_std in zip(full.names, get(full.unit, full.names), std)
              if full_model.belongs_to_stage(name)]
    lines.append(f'stage: {", ".join(values)} (90 % intervals)')
    return lines


def _outlier_lines(full: full_model.FullFit, poses: Poses) -> list[str]:
    if not full.outliers:
        return []
    named = [f'{i + 1} (alpha {np.degrees(poses.alpha_rad[i]):.1f}, beta '
             f'{np.degrees(poses.beta_rad[i]):.1f} deg, from {poses.time_s[i, 0]:.1f} s, '
             f'{np.sqrt(full.squared_distances[i]):.0f} sigma)'
             for i in full.outliers[:_MAX_OUTLIERS_NAMED]]
    unnamed = len(full.outliers) - len(named)
    return [f'outliers, left out: pose {", ".join(named)}'
            f'{f" and {unnamed} others" if unnamed else ""}']


def _temperature_lines(full: full_model.FullFit, poses: Poses) -> list[str]:
    change_k = np.ptp(poses.environment.temperature_c)
    if change_k <= _MAX_WARMING_K or 'temperature_bias' in full.fitted.effects:
        return []
    return [f'temperature moved by {change_k:.1f} degC, which the model ignores: typically up to '
            f'{_TYPICAL_DRIFT_MG_PER_K * change_k:.1f} mg; keep it steady, or fit --effect '
            'temperature_bias']
