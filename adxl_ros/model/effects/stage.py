# SPDX-License-Identifier: Apache-2.0

"""The stage: its site, base, joints and encoders, and where the sensor sits on it."""

from math import cos, sin

from adxl_ros.model.constants import AXES
from adxl_ros.model.diagnosis_hints import DiagnosisHints, FormDimension, Manoeuvre, ProofVariable
from adxl_ros.model.effects.base import Effect, Joint, Need, Parameter, Parameters, Place, Signals
from adxl_ros.model.filters import play
from adxl_ros.model.kinematics import angular_motion, carried_acceleration
import numpy as np


def _gravity(signals: Signals, p: Parameters) -> None:
    """Add the offset to local gravity, m/s²."""
    signals.gravity_mps2 = signals.gravity_mps2 + p['offset_mps2']


GRAVITY = Effect(
    name='gravity',
    place=Place.STAGE,
    parameters=(
        Parameter('offset_mps2', 'm/s^2', -5.0, 5.0, 0.01,
                  'geodesy: 9.780 at the equator, 9.832 at the poles',
                  'local gravity minus the stated one', ''),
    ),
    apply=_gravity,
    exact=True,
    invertible=True,
    needs=(Need.STAGE,),
    cause='Local gravity is not the stated one; look it up for latitude and height.',
    diagnosis=DiagnosisHints(imitated=True, revealed_by=Manoeuvre.REMOUNT,
                             proof=(ProofVariable.OWN_FORCE,)),
)
"""Local gravity that differs from the stated one."""


def _base_tilt(signals: Signals, p: Parameters) -> None:
    """Turn the vertical about the base's x, and then about its y, the axis of alpha."""
    x, y, z = signals.up
    c, s = cos(p['x_rad']), sin(p['x_rad'])
    y, z = y * c - z * s, y * s + z * c
    c, s = cos(p['y_rad']), sin(p['y_rad'])
    signals.up = [x * c + z * s, y, z * c - x * s]


BASE_TILT = Effect(
    name='base_tilt',
    place=Place.STAGE,
    parameters=(
        Parameter('x_rad', 'rad', -0.5, 0.5, 1.75e-3, 'paper: level of 0.1 deg',
                  "turn of the vertical about the base's x, across the axis of alpha", ''),
        Parameter('y_rad', 'rad', -0.5, 0.5, 1.75e-3, 'paper: level of 0.1 deg',
                  'turn of the vertical about the axis of alpha; it equals an offset of alpha',
                  ''),
    ),
    apply=_base_tilt,
    exact=True,
    needs=(Need.STAGE,),
    cause='The base of the stage is not level; level it, or measure its tilt.',
    diagnosis=DiagnosisHints(revealed_by=Manoeuvre.PLANES,
                             proof=(ProofVariable.BETA, ProofVariable.ALPHA)),
)
"""Tilt of the stage's base: it is not level."""


def _stage_offset(signals: Signals, p: Parameters) -> None:
    """Add the offsets to the encoders' angles."""
    for joint in ('alpha', 'beta'):
        read = getattr(signals, joint)
        setattr(signals, joint, read._replace(position=read.position + p[f'{joint}_rad']))


STAGE_OFFSET = Effect(
    name='stage_offset',
    place=Place.STAGE,
    parameters=(
        Parameter('alpha_rad', 'rad', -0.5, 0.5, 1.75e-3, 'paper: level of 0.1 deg',
                  'true alpha minus the encoder', ''),
        Parameter('beta_rad', 'rad', -0.5, 0.5, 1.75e-3, 'paper: level of 0.1 deg',
                  'true beta minus the encoder', ''),
    ),
    apply=_stage_offset,
    exact=True,
    needs=(Need.STAGE,),
    cause='The zero of an encoder is wrong; set it by a level, or remount the sensor by 180 deg.',
    diagnosis=DiagnosisHints(revealed_by=Manoeuvre.REMOUNT, half_turn='beta_rad',
                             proof=(ProofVariable.BETA, ProofVariable.ALPHA)),
)
"""Offset of the stage's encoders: true angle minus reading."""


def _stage_eccentricity(signals: Signals, p: Parameters) -> None:
    """Add s·sin q + c·cos q to each joint, and its derivatives to the motion."""
    for joint in ('alpha', 'beta'):
        s, c = p[f'{joint}_sine_rad'], p[f'{joint}_cosine_rad']
        if s or c:
            q, velocity, acceleration = getattr(signals, joint)
            sine, cosine = np.sin(q), np.cos(q)
            slope, bend = s * cosine - c * sine, -s * sine - c * cosine
            setattr(signals, joint, Joint(
                q + s * sine + c * cosine, velocity + slope * velocity,
                acceleration + slope * acceleration + bend * velocity * velocity))


STAGE_ECCENTRICITY = Effect(
    name='stage_eccentricity',
    place=Place.STAGE,
    parameters=tuple(
        Parameter(f'{joint}_{wave}_rad', 'rad', -0.2, 0.2, 1e-3,
                  'physics: a disc of radius 20 mm, 20 um off its axis',
                  f'true {joint} minus the encoder, amplitude of the {wave}', '')
        for joint in ('alpha', 'beta') for wave in ('sine', 'cosine')),
    apply=_stage_eccentricity,
    needs=(Need.STAGE,),
    cause='The disc of an encoder is not centred on its axis; '
          'use two reading heads, or a table of errors.',
    diagnosis=DiagnosisHints(revealed_by=Manoeuvre.PLANES,
                             form=(FormDimension.ALPHA, FormDimension.BETA),
                             proof=(ProofVariable.BETA, ProofVariable.ALPHA)),
)
"""Eccentricity of the stage's encoder discs: an error with one period per turn."""


_ROUNDING = 1e-9
"""Relative rounding error of a dead band; chosen: far above that of float64."""


def _backlash(signals: Signals, p: Parameters) -> None:
    """Let each joint follow with a dead band; it moves while the flanks of its gears touch."""
    for joint in ('alpha', 'beta'):
        half = p[f'{joint}_rad'] / 2
        if half:
            q, velocity, acceleration = getattr(signals, joint)
            memory = signals.memory.setdefault(joint, {})
            position = play(q, half, memory)
            touches = abs(q - position) >= half * (1 - _ROUNDING)
            setattr(signals, joint, Joint(position, velocity * touches, acceleration * touches))


BACKLASH = Effect(
    name='backlash',
    place=Place.STAGE,
    parameters=(
        Parameter('alpha_rad', 'rad', 0.0, 0.2, 1e-3, 'physics: worm gears, 3 arcmin',
                  'dead band of alpha, its full width', ''),
        Parameter('beta_rad', 'rad', 0.0, 0.2, 1e-3, 'physics: worm gears, 3 arcmin',
                  'dead band of beta, its full width', ''),
    ),
    apply=_backlash,
    smooth=False,
    needs=(Need.STAGE,),
    cause='The gears have play; approach each pose from the same side, or preload them.',
    diagnosis=DiagnosisHints(revealed_by=Manoeuvre.SPEEDS, form=(FormDimension.DIRECTION,),
                             proof=(ProofVariable.BETA, ProofVariable.ALPHA)),
)
"""Backlash of the stage: a joint follows its encoder with play."""


def _lever_arm(signals: Signals, p: Parameters) -> None:
    """Add the centripetal and tangential acceleration ω × (ω × r) + ω̇ × r, m/s²."""
    r = [p['x_m'], p['y_m'], p['z_m']]
    if any(r):
        added = carried_acceleration(*angular_motion(signals.alpha, signals.beta), r)
        signals.force = [f + a for f, a in zip(signals.force, added)]


LEVER_ARM = Effect(
    name='lever_arm',
    place=Place.FORCE,
    parameters=tuple(
        Parameter(f'{axis}_m', 'm', -2.0, 2.0, 0.02, 'physics: size of a board',
                  f"from the axis to the sensor along the sensor's {axis}", '')
        for axis in AXES),
    apply=_lever_arm,
    exact=True,
    needs=(Need.STAGE,),
    cause='The sensor is not on the axis of rotation; mount it there, or state the arm.',
    diagnosis=DiagnosisHints(revealed_by=Manoeuvre.SPEEDS,
                             proof=(ProofVariable.ALPHA_RATE, ProofVariable.BETA_RATE,
                                    ProofVariable.ALPHA_ACCELERATION,
                                    ProofVariable.BETA_ACCELERATION)),
)
"""Lever arm: rotation accelerates a sensor that is not on the axes of the stage."""
