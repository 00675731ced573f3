# SPDX-License-Identifier: Apache-2.0

"""
Scale factor that depends on the other in-plane axis; that of the z axis depends on x.

The paper has only the dependence on z (15). At rest A_c² of the other axis is g² minus the squares
of the other two. A quadratic term would equal a sum of `nonlinearity`, `scale_factor_z` and
`scale_factor`, so that the effect has none.
"""

from adxl_ros.model.diagnosis_hints import DiagnosisHints, FormDimension, ProofVariable
from adxl_ros.model.effects.base import Effect, Parameter, Parameters, Place, Signals

OTHER = (1, 0, 0)
"""Index of the other axis c by axis: x has y, y has x, and z has x."""


def apply(signals: Signals, p: Parameters) -> None:
    """Add s·A_d·A_c to each measured axis, c being its `OTHER`."""
    for d, s in enumerate(p['linear_per_g']):
        signals.output[d] = signals.output[d] + s * signals.sensed[d] * signals.sensed[OTHER[d]]


EFFECT = Effect(
    name='scale_factor_cross',
    place=Place.ELEMENT,
    parameters=(
        Parameter('linear_per_g', '1/g', -0.3, 0.3, 0.01,
                  'as scale_factor_z: paper, figure 8',
                  'relative change of the scale factor for 1 g on the other axis'),
    ),
    apply=apply,
    invertible=True,
    cause='The other in-plane axis changes the scale factor; calibrate with several planes '
          'alpha.',
    diagnosis=DiagnosisHints(form=(FormDimension.FORCE, FormDimension.CROSS_FORCE),
                             proof=(ProofVariable.CROSS_FORCE, ProofVariable.OWN_FORCE)),
)
