# SPDX-License-Identifier: Apache-2.0

"""Zero-g of a unit minus the nominal one (B of equation 2)."""

from adxl_ros.model.diagnosis_hints import DiagnosisHints, Manoeuvre, ProofVariable, StraightLine
from adxl_ros.model.effects.base import Effect, Parameter, Parameters, Place, Signals


def apply(signals: Signals, p: Parameters) -> None:
    """Add the offset to the zero-g output, V."""
    for d, offset in enumerate(p['offset_v']):
        signals.zero_g_v[d] = signals.zero_g_v[d] + offset


EFFECT = Effect(
    name='bias',
    place=Place.ELECTRONICS,
    parameters=(
        Parameter('offset_v', 'V', -2.0, 2.0, 0.1, 'ADXL203 datasheet: zero-g 2.4 to 2.6 V',
                  'zero-g output minus the nominal one'),
    ),
    apply=apply,
    exact=True,
    invertible=True,
    cause='The zero-g output of this unit is not the nominal one; calibrate the unit.',
    # Zero-g of a healthy unit changes by 0.1 mg from day to day (tuned by hand on simulated
    # recordings).
    diagnosis=DiagnosisHints(straight_line=StraightLine.ZERO_G, healthy_std=1e-4,
                             revealed_by=Manoeuvre.REMOUNT,
                             proof=(ProofVariable.TIME,)),
)
