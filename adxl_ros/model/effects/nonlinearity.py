# SPDX-License-Identifier: Apache-2.0

"""Odd nonlinearity of an axis: its scale factor changes with its own input."""

from adxl_ros.model.diagnosis_hints import DiagnosisHints, FormDimension, Manoeuvre, ProofVariable
from adxl_ros.model.effects.base import Effect, Parameter, Parameters, Place, Signals


def apply(signals: Signals, p: Parameters) -> None:
    """Add k·a³ of the axis's own acceleration, g."""
    for d, k in enumerate(p['cubic_per_g2']):
        sensed = signals.sensed[d]
        signals.output[d] = signals.output[d] + k * sensed * sensed * sensed


EFFECT = Effect(
    name='nonlinearity',
    place=Place.ELEMENT,
    parameters=(
        Parameter('cubic_per_g2', '1/g^2', -0.1, 0.1, 7e-4,
                  'ADXL203 datasheet: nonlinearity 0.2 % of 1.7 g full scale',
                  'coefficient of the cube of the acceleration along the axis'),
    ),
    apply=apply,
    invertible=True,
    cause='The scale factor changes with the input; calibrate with poses between 0 and 1 g.',
    diagnosis=DiagnosisHints(revealed_by=Manoeuvre.PLANES, form=(FormDimension.FORCE,),
                             proof=(ProofVariable.OWN_FORCE,)),
)
