# SPDX-License-Identifier: Apache-2.0

"""Vibration rectification: vibration shifts the zero-g by its mean square."""

from adxl_ros.model.diagnosis_hints import DiagnosisHints, FormDimension, Manoeuvre, ProofVariable
from adxl_ros.model.effects.base import Effect, Parameter, Parameters, Place, Role, Signals
from adxl_ros.model.filters import low_pass


def apply(signals: Signals, p: Parameters) -> None:
    """Add k times the mean square of the acceleration along the axis about its mean, g."""
    tau_s = p['tau_s']
    for d, k in enumerate(p['coefficient_per_g']):
        if not k:
            continue
        sensed = signals.sensed[d]
        mean, square = (signals.memory.setdefault((d, i), {}) for i in range(2))
        vibration = sensed - low_pass(sensed, tau_s, signals.dt_s, mean)
        signals.output[d] = signals.output[d] + k * low_pass(vibration * vibration, tau_s,
                                                             signals.dt_s, square)


EFFECT = Effect(
    name='vibration_rectification',
    place=Place.ELEMENT,
    parameters=(
        Parameter('coefficient_per_g', 'g/g^2', -1.0, 1.0, 0.05,
                  'physics: asymmetry of the element, clipping of fast peaks',
                  'shift of the zero-g divided by the mean square of the vibration'),
        Parameter('tau_s', 's', 0.01, 60.0, 0.5, 'physics: slower than any vibration',
                  'time over which the mean square is taken', '', neutral=0.5, role=Role.SHAPE,
                  starts=(0.1, 0.5, 2.5)),
    ),
    apply=apply,
    cause='Vibration shifts the zero-g; damp the mount, or stay away from its resonance.',
    diagnosis=DiagnosisHints(revealed_by=Manoeuvre.SHAKE, form=(FormDimension.LAG,),
                             proof=(ProofVariable.TIME,)),
)
