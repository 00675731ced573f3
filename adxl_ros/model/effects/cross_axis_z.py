# SPDX-License-Identifier: Apache-2.0

"""
Bias from the out-of-plane axis: h(V_z) of equations 12 and 13, centred and in g.

The z axis gets it from y.
"""

from adxl_ros.model.diagnosis_hints import DiagnosisHints, FormDimension, Manoeuvre, ProofVariable
from adxl_ros.model.effects.base import Effect, Parameter, Parameters, Place, Signals

OTHER = (2, 2, 1)
"""Index of the other axis by axis: x and y have z, and z has y."""


def apply(signals: Signals, p: Parameters) -> None:
    """Add q1·A_z + q2·A_z² to the x and y axes, and the same of A_y to the z axis."""
    for d, (q1, q2) in enumerate(zip(p['linear'], p['quadratic_per_g'])):
        other = signals.sensed[OTHER[d]]
        signals.output[d] = signals.output[d] + (q1 + q2 * other) * other


EFFECT = Effect(
    name='cross_axis_z',
    place=Place.ELEMENT,
    parameters=(
        Parameter('linear', 'g/g', -0.3, 0.3, 0.015, 'ADXL203 datasheet: cross-axis 1.5 %',
                  'q1 of equation 13; to first order the same as a misalignment'),
        Parameter('quadratic_per_g', '1/g', -0.3, 0.3, 0.01, 'paper, figure 6',
                  'q2 of equation 13'),
    ),
    apply=apply,
    invertible=True,
    cause='The out-of-plane axis shifts the bias; calibrate with several planes alpha.',
    diagnosis=DiagnosisHints(revealed_by=Manoeuvre.PLANES, form=(FormDimension.CROSS_FORCE,),
                             proof=(ProofVariable.FORCE_Z,)),
)
