# SPDX-License-Identifier: Apache-2.0

"""Tilt of the stage's base: it is not level."""

from math import cos, sin

from adxl_ros.model.diagnosis_hints import DiagnosisHints, Manoeuvre, ProofVariable
from adxl_ros.model.effects.base import Effect, Need, Parameter, Parameters, Place, Signals


def apply(signals: Signals, p: Parameters) -> None:
    """Turn the vertical about the base's x, and then about its y, the axis of alpha."""
    x, y, z = signals.up
    c, s = cos(p['x_rad']), sin(p['x_rad'])
    y, z = y * c - z * s, y * s + z * c
    c, s = cos(p['y_rad']), sin(p['y_rad'])
    signals.up = [x * c + z * s, y, z * c - x * s]


EFFECT = Effect(
    name='base_tilt',
    place=Place.STAGE,
    parameters=(
        Parameter('x_rad', 'rad', -0.5, 0.5, 1.75e-3, 'paper: level of 0.1 deg',
                  "turn of the vertical about the base's x, across the axis of alpha", ''),
        Parameter('y_rad', 'rad', -0.5, 0.5, 1.75e-3, 'paper: level of 0.1 deg',
                  'turn of the vertical about the axis of alpha; it equals an offset of alpha',
                  ''),
    ),
    apply=apply,
    exact=True,
    needs=(Need.STAGE,),
    cause='The base of the stage is not level; level it, or measure its tilt.',
    diagnosis=DiagnosisHints(revealed_by=Manoeuvre.PLANES,
                             proof=(ProofVariable.BETA, ProofVariable.ALPHA)),
)
