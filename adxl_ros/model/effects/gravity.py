# SPDX-License-Identifier: Apache-2.0

"""Local gravity that differs from the stated one."""

from adxl_ros.model.diagnosis_hints import DiagnosisHints, Manoeuvre, ProofVariable
from adxl_ros.model.effects.base import Effect, Need, Parameter, Parameters, Place, Signals


def apply(signals: Signals, p: Parameters) -> None:
    """Add the offset to local gravity, m/s²."""
    signals.gravity_mps2 = signals.gravity_mps2 + p['offset_mps2']


EFFECT = Effect(
    name='gravity',
    place=Place.STAGE,
    parameters=(
        Parameter('offset_mps2', 'm/s^2', -5.0, 5.0, 0.01,
                  'geodesy: 9.780 at the equator, 9.832 at the poles',
                  'local gravity minus the stated one', ''),
    ),
    apply=apply,
    exact=True,
    invertible=True,
    needs=(Need.STAGE,),
    cause='Local gravity is not the stated one; look it up for latitude and height.',
    diagnosis=DiagnosisHints(imitated=True, revealed_by=Manoeuvre.REMOUNT,
                             proof=(ProofVariable.OWN_FORCE,)),
)
