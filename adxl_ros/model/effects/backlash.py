# SPDX-License-Identifier: Apache-2.0

"""Backlash of the stage: a joint follows its encoder with play."""

from adxl_ros.model.diagnosis_hints import DiagnosisHints, FormDimension, Manoeuvre, ProofVariable
from adxl_ros.model.effects.base import Effect, Joint, Need, Parameter, Parameters, Place, Signals
from adxl_ros.model.play_operator import play

_ROUNDING = 1e-9
"""Relative rounding error of a dead band; chosen: far above that of float64."""


def apply(signals: Signals, p: Parameters) -> None:
    """Let each joint follow with a dead band; it moves while the flanks of its gears touch."""
    for joint in ('alpha', 'beta'):
        half = p[f'{joint}_rad'] / 2
        if half:
            q, velocity, acceleration = getattr(signals, joint)
            memory = signals.memory.setdefault(joint, {})
            position = play(q, half, memory)
            touches = abs(q - position) >= half * (1 - _ROUNDING)
            setattr(signals, joint, Joint(position, velocity * touches, acceleration * touches))


EFFECT = Effect(
    name='backlash',
    place=Place.STAGE,
    parameters=(
        Parameter('alpha_rad', 'rad', 0.0, 0.2, 1e-3, 'physics: worm gears, 3 arcmin',
                  'dead band of alpha, its full width', ''),
        Parameter('beta_rad', 'rad', 0.0, 0.2, 1e-3, 'physics: worm gears, 3 arcmin',
                  'dead band of beta, its full width', ''),
    ),
    apply=apply,
    smooth=False,
    needs=(Need.STAGE,),
    cause='The gears have play; approach each pose from the same side, or preload them.',
    diagnosis=DiagnosisHints(revealed_by=Manoeuvre.SPEEDS, form=(FormDimension.DIRECTION,),
                             proof=(ProofVariable.BETA, ProofVariable.ALPHA)),
)
