# SPDX-License-Identifier: Apache-2.0

"""
Scale factor that depends on the out-of-plane axis: equations 15 and 17, centred and in g.

The scale factor of the z axis depends on y.
"""

from adxl_ros.model.diagnosis_hints import DiagnosisHints, FormDimension, Manoeuvre, ProofVariable
from adxl_ros.model.effects.base import Effect, Parameter, Parameters, Place, Signals

OTHER = (2, 2, 1)
"""Index of the other axis by axis: x and y have z, and z has y."""


def apply(signals: Signals, p: Parameters) -> None:
    """Add A_d·(r1·A_z + r2·A_z²) to the x and y axes, and the same with A_y to the z axis."""
    for d, (r1, r2) in enumerate(zip(p['linear_per_g'], p['quadratic_per_g2'])):
        other = signals.sensed[OTHER[d]]
        signals.output[d] = signals.output[d] + signals.sensed[d] * (r1 + r2 * other) * other


EFFECT = Effect(
    name='scale_factor_z',
    place=Place.ELEMENT,
    parameters=(
        Parameter('linear_per_g', '1/g', -0.3, 0.3, 0.01, 'paper, figure 8',
                  'r1 over r0 of equation 15'),
        Parameter('quadratic_per_g2', '1/g^2', -0.3, 0.3, 0.01, 'paper, figure 8',
                  'r2 over r0 of equation 15'),
    ),
    apply=apply,
    invertible=True,
    cause='The out-of-plane axis changes the scale factor; calibrate with several planes alpha.',
    diagnosis=DiagnosisHints(revealed_by=Manoeuvre.PLANES,
                             form=(FormDimension.FORCE, FormDimension.CROSS_FORCE),
                             proof=(ProofVariable.FORCE_Z, ProofVariable.OWN_FORCE)),
)
