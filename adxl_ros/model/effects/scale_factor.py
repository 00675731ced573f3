# SPDX-License-Identifier: Apache-2.0

"""Scale factor of a unit minus the nominal one (SF of equation 1)."""

from adxl_ros.model.diagnosis_hints import DiagnosisHints, Manoeuvre, ProofVariable, StraightLine
from adxl_ros.model.effects.base import Effect, Parameter, Parameters, Place, Signals


def apply(signals: Signals, p: Parameters) -> None:
    """Add the offset to the scale factor, V/g."""
    for d, offset in enumerate(p['offset_v_per_g']):
        signals.scale_v_per_g[d] = signals.scale_v_per_g[d] + offset


EFFECT = Effect(
    name='scale_factor',
    place=Place.ELECTRONICS,
    parameters=(
        Parameter('offset_v_per_g', 'V/g', -0.9, 9.0, 0.04,
                  'ADXL203 datasheet: 960 to 1040 mV/g', 'scale factor minus the nominal one'),
    ),
    apply=apply,
    exact=True,
    invertible=True,
    cause='The scale factor of this unit is not the nominal one; calibrate the unit.',
    # The scale factor of a healthy unit changes by 0.01 % from day to day (tuned by hand on
    # simulated recordings).
    diagnosis=DiagnosisHints(straight_line=StraightLine.SCALE_FACTOR, healthy_std=1e-4,
                             revealed_by=Manoeuvre.REMOUNT,
                             proof=(ProofVariable.OWN_FORCE,)),
)
