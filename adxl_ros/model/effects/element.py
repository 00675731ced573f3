# SPDX-License-Identifier: Apache-2.0

"""The sensing element and its mounting: force along and across its axes, and their directions."""

from functools import lru_cache
from typing import Any

from adxl_ros.model.effects.base import (
    add,
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
from adxl_ros.model.filters import low_pass, resonator, stop
import numpy as np

_IN_PLANE, _OUT_OF_PLANE = (1, 0, 0), (2, 2, 1)
OTHER_AXIS = {'cross_axis': _IN_PLANE, 'scale_factor_cross': _IN_PLANE,
              'cross_axis_z': _OUT_OF_PLANE, 'scale_factor_z': _OUT_OF_PLANE}
"""By effect: index of the axis c that acts on x, y and z; what is in plane for z is x, and what
is out of plane is y."""


def _bias_by(others: tuple[int, int, int], signals: Signals, p: Parameters) -> None:
    """Add p1·A_c + p2·A_c² of another axis c to each measured axis."""
    other = [signals.sensed[other] for other in others]
    add(signals.output, ((p1 + p2 * c) * c for p1, p2, c in zip(
        p['linear'], p['quadratic_per_g'], other)))


@effect(Place.ELEMENT,
        Parameter('linear', 'g/g', -0.3, 0.3, 0.015, 'ADXL203 datasheet: cross-axis 1.5 %',
                  'p1 of equation 11; to first order the same as a misalignment'),
        Parameter('quadratic_per_g', '1/g', -0.3, 0.3, 0.01, 'paper, figure 4',
                  'p2 of equation 11'),
        invertible=True,
        cause='The other in-plane axis shifts the bias; calibrate with the plane alpha = 90 deg.',
        diagnosis=DiagnosisHints(revealed_by=Manoeuvre.PLANES, form=(FormDimension.CROSS_FORCE,),
                                 proof=(ProofVariable.CROSS_FORCE,)))
def cross_axis(signals: Signals, p: Parameters) -> None:
    """Bias from the other in-plane axis: g(V_c) of equations 10 and 11, centred and in g."""
    _bias_by(_IN_PLANE, signals, p)


@effect(Place.ELEMENT,
        Parameter('linear', 'g/g', -0.3, 0.3, 0.015, 'ADXL203 datasheet: cross-axis 1.5 %',
                  'q1 of equation 13; to first order the same as a misalignment'),
        Parameter('quadratic_per_g', '1/g', -0.3, 0.3, 0.01, 'paper, figure 6',
                  'q2 of equation 13'),
        invertible=True,
        cause='The out-of-plane axis shifts the bias; calibrate with several planes alpha.',
        diagnosis=DiagnosisHints(revealed_by=Manoeuvre.PLANES, form=(FormDimension.CROSS_FORCE,),
                                 proof=(ProofVariable.FORCE_Z,)))
def cross_axis_z(signals: Signals, p: Parameters) -> None:
    """Bias from the out-of-plane axis: h(V_z) of equations 12 and 13, centred and in g."""
    _bias_by(_OUT_OF_PLANE, signals, p)


@effect(Place.ELEMENT,
        Parameter('linear_per_g', '1/g', -0.3, 0.3, 0.01,
                  'as scale_factor_z: paper, figure 8',
                  'relative change of the scale factor for 1 g on the other axis'),
        invertible=True,
        cause='The other in-plane axis changes the scale factor; calibrate with several planes '
              'alpha.',
        diagnosis=DiagnosisHints(form=(FormDimension.FORCE, FormDimension.CROSS_FORCE),
                                 proof=(ProofVariable.CROSS_FORCE, ProofVariable.OWN_FORCE)))
def scale_factor_cross(signals: Signals, p: Parameters) -> None:
    """
    Scale factor that depends on the other in-plane axis; that of the z axis depends on x.

    The paper has only the dependence on z (15). At rest A_c² of the other axis is g² minus the
    squares of the other two. A quadratic term would equal a sum of `nonlinearity`,
    `scale_factor_z` and `scale_factor`, so that the effect has none.
    """
    add(signals.output, (s * sensed * signals.sensed[other] for s, sensed, other in zip(
        p['linear_per_g'], signals.sensed, _IN_PLANE)))


@effect(Place.ELEMENT,
        Parameter('linear_per_g', '1/g', -0.3, 0.3, 0.01, 'paper, figure 8',
                  'r1 over r0 of equation 15'),
        Parameter('quadratic_per_g2', '1/g^2', -0.3, 0.3, 0.01, 'paper, figure 8',
                  'r2 over r0 of equation 15'),
        invertible=True,
        cause='The out-of-plane axis changes the scale factor; calibrate with several planes '
              'alpha.',
        diagnosis=DiagnosisHints(revealed_by=Manoeuvre.PLANES,
                                 form=(FormDimension.FORCE, FormDimension.CROSS_FORCE),
                                 proof=(ProofVariable.FORCE_Z, ProofVariable.OWN_FORCE)))
def scale_factor_z(signals: Signals, p: Parameters) -> None:
    """Scale factor by the out-of-plane axis, y for z: equations 15 and 17, centred and in g."""
    other = [signals.sensed[other] for other in _OUT_OF_PLANE]
    add(signals.output, (sensed * (r1 + r2 * c) * c for sensed, r1, r2, c in zip(
        signals.sensed, p['linear_per_g'], p['quadratic_per_g2'], other)))


@effect(Place.ELEMENT,
        Parameter('cubic_per_g2', '1/g^2', -0.1, 0.1, 7e-4,
                  'ADXL203 datasheet: nonlinearity 0.2 % of 1.7 g full scale',
                  'coefficient of the cube of the acceleration along the axis'),
        invertible=True,
        cause='The scale factor changes with the input; calibrate with poses between 0 and 1 g.',
        diagnosis=DiagnosisHints(revealed_by=Manoeuvre.PLANES, form=(FormDimension.FORCE,),
                                 proof=(ProofVariable.OWN_FORCE,)))
def nonlinearity(signals: Signals, p: Parameters) -> None:
    """
    Odd nonlinearity of an axis: its scale factor changes with its own input.

    Add k·a³ of the axis's own acceleration, g.
    """
    add(signals.output, (k * a * a * a for k, a in zip(p['cubic_per_g2'], signals.sensed)))


@effect(Place.ELEMENT,
        Parameter('quadratic_per_g', '1/g', -0.1, 0.1, 1.2e-3,
                  'ADXL203 datasheet: nonlinearity 0.2 % of 1.7 g full scale',
                  'coefficient of the square of the acceleration along the axis'),
        invertible=True,
        cause='Scale factors up and down differ; calibrate, and let no supply clip one side.',
        diagnosis=DiagnosisHints(revealed_by=Manoeuvre.PLANES, form=(FormDimension.FORCE,),
                                 proof=(ProofVariable.OWN_FORCE,)))
def quadratic(signals: Signals, p: Parameters) -> None:
    """
    Even nonlinearity of an axis: its scale factors up and down differ.

    Add k·a² of the axis's own acceleration, g.
    """
    add(signals.output, (k * a * a for k, a in zip(p['quadratic_per_g'], signals.sensed)))


@effect(Place.ELEMENT,
        Parameter('half_width_g', 'g', -0.1, 0.1, 2e-3, 'physics: friction in die and package',
                  'largest lag behind the input: half of the width of the loop'),
        Parameter('reach_g', 'g', 1e-3, 2.0, 0.2, 'physics: part of the range',
                  'change of the input after a reversal that builds up half of the lag', '',
                  neutral=0.2, role=Role.SHAPE, starts=(0.04, 0.2, 1.0)),
        smooth=False,
        cause='The reading depends on the direction of the last change; approach poses from both '
              'sides and average, or relieve the package of mounting stress.',
        diagnosis=DiagnosisHints(revealed_by=Manoeuvre.SPEEDS,
                                 form=(FormDimension.FORCE, FormDimension.DIRECTION,
                                       FormDimension.LAG),
                                 proof=(ProofVariable.FORCE_RATE, ProofVariable.OWN_FORCE)))
def hysteresis(signals: Signals, p: Parameters) -> None:
    """
    Hysteresis of the sensing element: a Prandtl-Ishlinskii operator of the acceleration.

    Let the output lag by a stop operator of the force along the sensing axis.

    The lag is at most `half_width_g`. It reaches that when the input has changed by 2·`reach_g`
    after a reversal.
    """
    for d, half_width in enumerate(p['half_width_g']):
        if half_width:
            lag = stop(signals.sensed[d], p['reach_g'], signals.memory.setdefault(d, {}))
            signals.output[d] = signals.output[d] - half_width * lag


@effect(Place.ELEMENT,
        Parameter('coefficient_per_g', 'g/g^2', -1.0, 1.0, 0.05,
                  'physics: asymmetry of the element, clipping of fast peaks',
                  'shift of the zero-g divided by the mean square of the vibration'),
        Parameter('tau_s', 's', 0.01, 60.0, 0.5, 'physics: slower than any vibration',
                  'time over which the mean square is taken', '', neutral=0.5, role=Role.SHAPE,
                  starts=(0.1, 0.5, 2.5)),
        cause='Vibration shifts the zero-g; damp the mount, or stay away from its resonance.',
        diagnosis=DiagnosisHints(revealed_by=Manoeuvre.SHAKE, form=(FormDimension.LAG,),
                                 proof=(ProofVariable.TIME,)))
def vibration_rectification(signals: Signals, p: Parameters) -> None:
    """
    Vibration rectification: vibration shifts the zero-g by its mean square.

    Add k times the mean square of the acceleration along the axis about its mean, g.
    """
    tau_s = p['tau_s']
    for d, k in enumerate(p['coefficient_per_g']):
        if not k:
            continue
        sensed = signals.sensed[d]
        mean, square = (signals.memory.setdefault((d, i), {}) for i in range(2))
        vibration = sensed - low_pass(sensed, tau_s, signals.dt_s, mean)
        signals.output[d] = signals.output[d] + k * low_pass(vibration * vibration, tau_s,
                                                             signals.dt_s, square)


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
