# SPDX-License-Identifier: Apache-2.0

"""
Bias from the other in-plane axis: g(V_c) of equations 10 and 11, centred and in g.

The z axis gets it from x.
"""

from adxl_ros.model.diagnosis_hints import DiagnosisHints, FormDimension, Manoeuvre, ProofVariable
from adxl_ros.model.effects.base import Effect, Parameter, Parameters, Place, Signals

OTHER = (1, 0, 0)
"""Index of the other axis c by axis: x has y, y has x, and z has x."""


def apply(signals: Signals, p: Parameters) -> None:
    """Add p1·A_c + p2·A_c² to each measured axis, c being its `OTHER`."""
    for d, (p1, p2) in enumerate(zip(p['linear'], p['quadratic_per_g'])):
        other = signals.sensed[OTHER[d]]
        signals.output[d] = signals.output[d] + (p1 + p2 * other) * other


EFFECT = Effect(
    name='cross_axis',
    place=Place.ELEMENT,
    parameters=(
        Parameter('linear', 'g/g', -0.3, 0.3, 0.015, 'ADXL203 datasheet: cross-axis 1.5 %',
                  'p1 of equation 11; to first order the same as a misalignment'),
        Parameter('quadratic_per_g', '1/g', -0.3, 0.3, 0.01, 'paper, figure 4',
                  'p2 of equation 11'),
    ),
    apply=apply,
    invertible=True,
    cause='The other in-plane axis shifts the bias; calibrate with the plane alpha = 90 deg.',
    diagnosis=DiagnosisHints(revealed_by=Manoeuvre.PLANES, form=(FormDimension.CROSS_FORCE,),
                             proof=(ProofVariable.CROSS_FORCE,)),
)
