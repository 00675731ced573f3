# SPDX-License-Identifier: Apache-2.0

"""Lever arm: rotation accelerates a sensor that is not on the axes of the stage."""

from adxl_ros.model.constants import AXES
from adxl_ros.model.diagnosis_hints import DiagnosisHints, Manoeuvre, ProofVariable
from adxl_ros.model.effects.base import Effect, Need, Parameter, Parameters, Place, Signals
from adxl_ros.model.kinematics import angular_motion, carried_acceleration


def apply(signals: Signals, p: Parameters) -> None:
    """Add the centripetal and tangential acceleration ω × (ω × r) + ω̇ × r, m/s²."""
    r = [p['x_m'], p['y_m'], p['z_m']]
    if any(r):
        added = carried_acceleration(*angular_motion(signals.alpha, signals.beta), r)
        signals.force = [f + a for f, a in zip(signals.force, added)]


EFFECT = Effect(
    name='lever_arm',
    place=Place.FORCE,
    parameters=tuple(
        Parameter(f'{axis}_m', 'm', -2.0, 2.0, 0.02, 'physics: size of a board',
                  f"from the axis to the sensor along the sensor's {axis}", '')
        for axis in AXES),
    apply=apply,
    exact=True,
    needs=(Need.STAGE,),
    cause='The sensor is not on the axis of rotation; mount it there, or state the arm.',
    diagnosis=DiagnosisHints(revealed_by=Manoeuvre.SPEEDS,
                             proof=(ProofVariable.ALPHA_RATE, ProofVariable.BETA_RATE,
                                    ProofVariable.ALPHA_ACCELERATION,
                                    ProofVariable.BETA_ACCELERATION)),
)
