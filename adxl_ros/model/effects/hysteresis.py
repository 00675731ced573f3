# SPDX-License-Identifier: Apache-2.0

"""Hysteresis of the sensing element: a Prandtl-Ishlinskii operator of the acceleration."""

from adxl_ros.model.diagnosis_hints import DiagnosisHints, FormDimension, Manoeuvre, ProofVariable
from adxl_ros.model.effects.base import Effect, Parameter, Parameters, Place, Role, Signals
from adxl_ros.model.play_operator import stop


def apply(signals: Signals, p: Parameters) -> None:
    """
    Let the output lag by a stop operator of the force along the sensing axis.

    The lag is at most `half_width_g`. It reaches that when the input has changed by 2·`reach_g`
    after a reversal.
    """
    for d, half_width in enumerate(p['half_width_g']):
        if half_width:
            lag = stop(signals.sensed[d], p['reach_g'], signals.memory.setdefault(d, {}))
            signals.output[d] = signals.output[d] - half_width * lag


EFFECT = Effect(
    name='hysteresis',
    place=Place.ELEMENT,
    parameters=(
        Parameter('half_width_g', 'g', -0.1, 0.1, 2e-3, 'physics: friction in die and package',
                  'largest lag behind the input: half of the width of the loop'),
        Parameter('reach_g', 'g', 1e-3, 2.0, 0.2, 'physics: part of the range',
                  'change of the input after a reversal that builds up half of the lag', '',
                  neutral=0.2, role=Role.SHAPE, starts=(0.04, 0.2, 1.0)),
    ),
    apply=apply,
    smooth=False,
    cause='The reading depends on the direction of the last change; approach poses from both '
          'sides and average, or relieve the package of mounting stress.',
    diagnosis=DiagnosisHints(revealed_by=Manoeuvre.SPEEDS,
                             form=(FormDimension.FORCE, FormDimension.DIRECTION,
                                   FormDimension.LAG),
                             proof=(ProofVariable.FORCE_RATE, ProofVariable.OWN_FORCE)),
)
