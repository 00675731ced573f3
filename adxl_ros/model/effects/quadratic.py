# SPDX-License-Identifier: Apache-2.0

"""Even nonlinearity of an axis: its scale factors up and down differ."""

from adxl_ros.model.diagnosis_hints import DiagnosisHints, FormDimension, Manoeuvre, ProofVariable
from adxl_ros.model.effects.base import Effect, Parameter, Parameters, Place, Signals


def apply(signals: Signals, p: Parameters) -> None:
    """Add k·a² of the axis's own acceleration, g."""
    for d, k in enumerate(p['quadratic_per_g']):
        sensed = signals.sensed[d]
        signals.output[d] = signals.output[d] + k * sensed * sensed


EFFECT = Effect(
    name='quadratic',
    place=Place.ELEMENT,
    parameters=(
        Parameter('quadratic_per_g', '1/g', -0.1, 0.1, 1.2e-3,
                  'ADXL203 datasheet: nonlinearity 0.2 % of 1.7 g full scale',
                  'coefficient of the square of the acceleration along the axis'),
    ),
    apply=apply,
    invertible=True,
    cause='Scale factors up and down differ; calibrate, and let no supply clip one side.',
    diagnosis=DiagnosisHints(revealed_by=Manoeuvre.PLANES, form=(FormDimension.FORCE,),
                             proof=(ProofVariable.OWN_FORCE,)),
)
