# SPDX-License-Identifier: Apache-2.0

"""Directions of the sensing axes in the case: equations 18 and 19, and the same for z."""

from functools import lru_cache
from math import cos, sin

from adxl_ros.model.diagnosis_hints import DiagnosisHints, Manoeuvre, ProofVariable
from adxl_ros.model.effects.base import Components, Effect, Parameter, Parameters, Place, Signals


def apply(signals: Signals, p: Parameters) -> None:
    """Project the specific force in the case frame on the sensing axes."""
    force = list(signals.sensed)
    for d, angles in enumerate(zip(p['alpha_rad'], p['beta_rad'])):
        tx, ty, tz = direction(d, *angles)
        signals.sensed[d] = tx * force[0] + ty * force[1] + tz * force[2]


@lru_cache(maxsize=64)
def direction(axis: int, alpha_rad: float, beta_rad: float) -> Components:
    """
    Return the unit vector of one sensing axis in the case frame.

    Θx = R_y(α)·R_z(β)·[1 0 0]ᵀ (18), Θy = R_x(α)·R_z(β)·[0 1 0]ᵀ (19), and in the same manner
    Θz = R_x(α)·R_y(β)·[0 0 1]ᵀ.
    """
    sa, ca, sb, cb = sin(alpha_rad), cos(alpha_rad), sin(beta_rad), cos(beta_rad)
    return [[ca * cb, sb, -sa * cb], [-sb, ca * cb, sa * cb], [sb, -sa * cb, ca * cb]][axis]


EFFECT = Effect(
    name='misalignment',
    place=Place.MOUNTING,
    parameters=(
        Parameter('alpha_rad', 'rad', -0.5, 0.5, 0.0175,
                  'ADXL203 datasheet: package alignment 1 deg',
                  'tilt of the sensing axis out of the plane (z: about x), equations 18 and 19'),
        Parameter('beta_rad', 'rad', -0.5, 0.5, 0.0175,
                  'ADXL203 datasheet: package alignment 1 deg, x to y 0.1 deg',
                  'turn of the sensing axis in the plane (z: about y), equations 18 and 19'),
    ),
    apply=apply,
    exact=True,
    invertible=True,
    cause='The sensing axes are not those of the case; calibrate, or mount the package better.',
    diagnosis=DiagnosisHints(revealed_by=Manoeuvre.PLANES,
                             proof=(ProofVariable.CROSS_FORCE, ProofVariable.FORCE_Z)),
)
