# SPDX-License-Identifier: Apache-2.0

"""The mounting: directions of the sensing axes, and the spring between them and the case."""

from functools import lru_cache
from typing import Any

from adxl_ros.model.effects.base import (
    ARRAYS,
    Components,
    DiagnosisHints,
    effect,
    FLOATS,
    FormDimension,
    Manoeuvre,
    Parameter,
    Parameters,
    Place,
    ProofVariable,
    Role,
    Signals,
    Value,
)
from adxl_ros.model.filters import resonator
import numpy as np


@lru_cache(maxsize=64)
def direction(axis: int, alpha_rad: float, beta_rad: float) -> Components:
    """
    Return the unit vector of one sensing axis in the case frame.

    Θx = R_y(α)·R_z(β)·[1 0 0]ᵀ (18), Θy = R_x(α)·R_z(β)·[0 1 0]ᵀ (19), and in the same manner
    Θz = R_x(α)·R_y(β)·[0 0 1]ᵀ.
    """
    return _direction(axis, alpha_rad, beta_rad)


def _direction(axis: int, alpha_rad: Value, beta_rad: Value) -> Components:
    maths = ARRAYS if np.ndim(alpha_rad) or np.ndim(beta_rad) else FLOATS
    sa, ca, sb, cb = (f(angle) for angle in (alpha_rad, beta_rad)
                      for f in (maths.sin, maths.cos))
    return [[ca * cb, sb, -sa * cb], [-sb, ca * cb, sa * cb], [sb, -sa * cb, ca * cb]][axis]


def _directions(memory: dict[Any, Any], alpha_rad: tuple, beta_rad: tuple) -> list[Components]:
    """Return the sensing axes; those of many units, with angles (n,), are kept in the memory."""
    if not any(map(np.ndim, (*alpha_rad, *beta_rad))):
        return [direction(d, *angles) for d, angles in enumerate(zip(alpha_rad, beta_rad))]
    if memory.get('alpha_rad') is not alpha_rad:
        memory.update(alpha_rad=alpha_rad, directions=[
            _direction(d, *angles) for d, angles in enumerate(zip(alpha_rad, beta_rad))])
    return memory['directions']


@effect(Place.MOUNTING,
        Parameter('alpha_rad', 'rad', -0.5, 0.5, 0.0175,
                  'ADXL203 datasheet: package alignment 1 deg',
                  'tilt of the sensing axis out of the plane (z: about x), equations 18 and 19'),
        Parameter('beta_rad', 'rad', -0.5, 0.5, 0.0175,
                  'ADXL203 datasheet: package alignment 1 deg, x to y 0.1 deg',
                  'turn of the sensing axis in the plane (z: about y), equations 18 and 19'),
        exact=True, invertible=True,
        cause='The sensing axes are not those of the case; calibrate, or mount the package '
              'better.',
        diagnosis=DiagnosisHints(revealed_by=Manoeuvre.PLANES,
                                 proof=(ProofVariable.CROSS_FORCE, ProofVariable.FORCE_Z)))
def misalignment(signals: Signals, p: Parameters) -> None:
    """Directions of the sensing axes in the case: equations 18 and 19, and the same for z."""
    force = list(signals.sensed)
    for d, (tx, ty, tz) in enumerate(_directions(signals.memory, p['alpha_rad'], p['beta_rad'])):
        signals.sensed[d] = tx * force[0] + ty * force[1] + tz * force[2]


@effect(Place.MOUNTING,
        Parameter('gain', '1', -2.0, 2.0, 1.0, 'physics: 0 is rigid, 1 all through the mount',
                  'part of the force that comes through the mount'),
        Parameter('frequency_hz', 'Hz', 2.0, 450.0, 120.0, 'physics: a board on standoffs',
                  'natural frequency, undamped', '', neutral=120.0, role=Role.SHAPE,
                  starts=(8.0, 14.0, 24.0, 40.0, 70.0, 120.0, 250.0)),
        Parameter('damping_ratio', '1', 0.001, 0.95, 0.05, 'physics: metal and FR4',
                  'damping divided by the critical one', '', neutral=0.05, role=Role.SHAPE),
        cause='The mount is a spring; stiffen it, or keep the motion away from its resonance.',
        diagnosis=DiagnosisHints(revealed_by=Manoeuvre.SHAKE, form=(FormDimension.LAG,),
                                 proof=(ProofVariable.FREQUENCY,)))
def mount_resonance(signals: Signals, p: Parameters) -> None:
    """
    Resonance of the mount: it transmits the motion like a spring and a damper.

    Filter a part of the force by ω²/(s² + 2·ζ·ω·s + ω²).
    """
    for d, gain in enumerate(p['gain']):
        if gain:
            sensed = signals.sensed[d]
            transmitted = resonator(sensed, p['frequency_hz'], p['damping_ratio'], signals.dt_s,
                                    signals.memory.setdefault(d, {}))
            signals.sensed[d] = sensed + gain * (transmitted - sensed)
