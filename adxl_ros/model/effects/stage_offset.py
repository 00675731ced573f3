# SPDX-License-Identifier: Apache-2.0

"""Offset of the stage's encoders: true angle minus reading."""

from adxl_ros.model.diagnosis_hints import DiagnosisHints, Manoeuvre, ProofVariable
from adxl_ros.model.effects.base import Effect, Need, Parameter, Parameters, Place, Signals


def apply(signals: Signals, p: Parameters) -> None:
    """Add the offsets to the encoders' angles."""
    for joint in ('alpha', 'beta'):
        read = getattr(signals, joint)
        setattr(signals, joint, read._replace(position=read.position + p[f'{joint}_rad']))


EFFECT = Effect(
    name='stage_offset',
    place=Place.STAGE,
    parameters=(
        Parameter('alpha_rad', 'rad', -0.5, 0.5, 1.75e-3, 'paper: level of 0.1 deg',
                  'true alpha minus the encoder', ''),
        Parameter('beta_rad', 'rad', -0.5, 0.5, 1.75e-3, 'paper: level of 0.1 deg',
                  'true beta minus the encoder', ''),
    ),
    apply=apply,
    exact=True,
    needs=(Need.STAGE,),
    cause='The zero of an encoder is wrong; set it by a level, or remount the sensor by 180 deg.',
    diagnosis=DiagnosisHints(revealed_by=Manoeuvre.REMOUNT, half_turn='beta_rad',
                             proof=(ProofVariable.BETA, ProofVariable.ALPHA)),
)
