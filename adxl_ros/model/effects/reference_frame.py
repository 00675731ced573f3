# SPDX-License-Identifier: Apache-2.0


"""Rotation between the frame of the reference and that of the sensor."""

from math import cos, sin

from adxl_ros.model.diagnosis_hints import DiagnosisHints, Manoeuvre, ProofVariable
from adxl_ros.model.effects.base import Effect, Parameter, Parameters, Place, Signals


def apply(signals: Signals, p: Parameters) -> None:
    """Turn the force of the reference about its x, then about y, then about z."""
    x, y, z = signals.force
    c, s = cos(p['x_rad']), sin(p['x_rad'])
    y, z = y * c - z * s, y * s + z * c
    c, s = cos(p['y_rad']), sin(p['y_rad'])
    x, z = x * c + z * s, z * c - x * s
    c, s = cos(p['z_rad']), sin(p['z_rad'])
    signals.force = [x * c - y * s, x * s + y * c, z]


EFFECT = Effect(
    name='reference_frame',
    place=Place.REFERENCE,
    parameters=(
        Parameter('x_rad', 'rad', -0.5, 0.5, 0.0175, 'physics: markers are placed to some 1 deg',
                  'turn of the specific force about x, from the reference to the sensor', ''),
        Parameter('y_rad', 'rad', -0.5, 0.5, 0.0175, 'physics: markers are placed to some 1 deg',
                  'turn of the specific force about y, from the reference to the sensor', ''),
        Parameter('z_rad', 'rad', -0.5, 0.5, 0.0175, 'physics: markers are placed to some 1 deg',
                  'turn of the specific force about z, from the reference to the sensor', ''),
    ),
    apply=apply,
    exact=True,
    cause='The frame of the reference is turned against that of the sensor; state the rotation, '
          'or align the two.',
    diagnosis=DiagnosisHints(revealed_by=Manoeuvre.PLANES, imitated_by='misalignment',
                             proof=(ProofVariable.CROSS_FORCE, ProofVariable.FORCE_Z)),
)
