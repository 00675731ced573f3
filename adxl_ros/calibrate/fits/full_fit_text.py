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

"""What a full fit says for people: the stage, disturbed poses, weak directions, terms."""

from __future__ import annotations

from collections.abc import Sequence

from adxl_ros.calibrate.fits import full_model
from adxl_ros.calibrate.fits.term_selection import Term
from adxl_ros.calibrate.poses import Poses
from adxl_ros.model.coefficients import get, parameter_of
from adxl_ros.model.constants import Z_90
from adxl_ros.model.effects.base import Coefficient
import numpy as np

_WARMED_K = 3.0
"""Temperature that moved by more is worth a word: 0.3 mg by the datasheet's 0.1 mg/°C."""
_SMALL_SHARE = 0.1
"""An error new with each pose is named from this share of that of a setting on."""
NOT_CONVERGED = ('the fit did not converge: coefficients and intervals are those of its last '
                 'step; add poses, or leave out terms')
_WORSE = 1.5
"""A stage that errs by so much more than stated is said to."""


def weakest(found: full_model.FullFit) -> tuple[float, float, list[tuple[Coefficient, float]]]:
    """
    Return the condition number, and the weakest direction of the sensor's coefficients.

    Returns
    -------
    tuple
        Condition number of the information with each coefficient in units of its typical size;
        standard deviation along the weakest direction, in the same; its largest parts by name.

    """
    names = found.fitted.covariance_names
    scale = np.array([parameter_of(name).scale for name in names])
    values, vectors = np.linalg.eigh(found.fitted.covariance / np.outer(scale, scale))
    order = np.argsort(-np.abs(vectors[:, -1]))[:4]
    parts = [(names[i], float(vectors[i, -1])) for i in order if abs(vectors[i, -1]) > 0.2]
    return (float(np.sqrt(values[-1] / values[0])), float(np.sqrt(values[-1])), parts)


def words(found: full_model.FullFit, poses: Poses, judged: Sequence[Term]) -> list[str]:
    """
    Lay out for people what the fit found beside the sensor.

    Parameters
    ----------
    found, judged
        From `term_selection.fit_selected`.
    poses
        That it was made of.

    """
    setting, pose = (np.degrees(level * found.stage.joints) for level in (
        found.stage.setting_rad, found.stage.pose_rad))
    beside = f', and {pose[0]:.2g} and {pose[1]:.2g} deg new with each pose' \
        if pose[0] > _SMALL_SHARE * setting[0] else ''
    lines = [f'stage: a setting of alpha has an error of {setting[0]:.2g} deg rms, of beta '
             f'{setting[1]:.2g} deg{beside} (stated {np.degrees(found.stated_std_rad):.2g})'
             f'{_of_the_stage(found)}']
    if not found.converged:
        lines.append(NOT_CONVERGED)
    if found.stage_std_rad > _WORSE * found.stated_std_rad + 1e-5:
        lines.append('the reference is worse than stated, or the model lacks something that '
                     'looks like it: poses weigh accordingly, and the sensor is not blamed')
    if found.outliers:
        worst = [f'{i + 1} (alpha {np.degrees(poses.alpha_rad[i]):.1f}, beta '
                 f'{np.degrees(poses.beta_rad[i]):.1f} deg, from {poses.time_s[i, 0]:.1f} s, '
                 f'{np.sqrt(found.distances[i]):.0f} sigma)' for i in found.outliers[:8]]
        lines.append(f'left out, disturbed: pose {", ".join(worst)}')
    condition, spread, parts = weakest(found)
    direction = ' '.join(f'{value:+.2f} {name}' for name, value in parts)
    lines.append(f'condition number {condition:.0f}; known least ({spread:.2g} of typical '
                 f'sizes): {direction}')
    helpful = full_model.next_poses(found.unit, poses, found.names, found.stage)
    add = ', '.join(f'({np.degrees(a):.0f}, {np.degrees(b):.0f})' for a, b in helpful)
    lines.append(f'next poses that would help most, (alpha, beta) in deg: {add}')
    warmed = np.ptp(poses.environment.temperature_c)
    if warmed > _WARMED_K and 'temperature_bias' not in found.fitted.effects:
        lines.append(
            f'temperature moved by {warmed:.1f} degC, which the model does not know: by the '
            f'datasheet up to {0.1 * warmed:.1f} mg; keep it steady, or fit --effect '
            'temperature_bias')
    lines.append('terms by the evidence for them, log Bayes factor in nats:')
    lines += [f'  {term.name:20} {term.log_bayes_factor:10.1f}'
              f'{"" if term.earns else "   not shown by these poses"}' for term in judged]
    return lines


def _of_the_stage(found: full_model.FullFit) -> str:
    """Lay out what was found of the stage itself, with its 90 % intervals."""
    std = np.sqrt(np.diag(np.linalg.inv(found.information)))
    return ''.join(
        f', {name} {value:.2g} +- {Z_90 * s:.1g} {parameter_of(name).unit}'
        for name, value, s in zip(found.names, get(found.unit, found.names), std)
        if full_model.belongs_to_stage(name))
