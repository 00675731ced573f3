# SPDX-License-Identifier: Apache-2.0

"""Thermal hysteresis: a zero-g that differs between warming and cooling."""

from adxl_ros.model.diagnosis_hints import DiagnosisHints, FormDimension, Manoeuvre, ProofVariable
from adxl_ros.model.effects.base import Effect, Parameter, Parameters, Place, Role, Signals
from adxl_ros.model.play_operator import loop
import numpy as np


def apply(signals: Signals, p: Parameters) -> None:
    """
    Add a loop over temperature to the zero-g, which begins when the temperature turns back.

    The loop has its full width when the temperature has changed by 2·`reach_k` since. It does not
    depend on how fast the temperature changes. The first branch belongs to `temperature_bias`.
    """
    temperature_c = signals.environment.temperature_c
    if not any(p['half_width_g']) or not np.ndim(temperature_c):
        return
    branch = loop(temperature_c, p['reach_k'], signals.memory)
    for d, half_width in enumerate(p['half_width_g']):
        signals.output[d] = signals.output[d] - half_width * branch


EFFECT = Effect(
    name='thermal_hysteresis',
    place=Place.ELECTRONICS,
    parameters=(
        Parameter('half_width_g', 'g', -0.1, 0.1, 2e-3,
                  'physics: friction and creep in solder and die attach',
                  'zero-g while cooling minus that while warming, divided by 2'),
        Parameter('reach_k', 'K', 0.1, 200.0, 10.0, 'physics: part of the range',
                  'half of the change after a reversal that opens the loop', '',
                  neutral=10.0, role=Role.SHAPE, starts=(2.0, 10.0, 50.0)),
    ),
    apply=apply,
    smooth=False,
    follows=('temperature_c',),
    cause='The zero-g depends on whether the sensor warms or cools; relieve its package of '
          'stress, or state the loop as an uncertainty.',
    diagnosis=DiagnosisHints(revealed_by=Manoeuvre.HEAT,
                             form=(FormDimension.TEMPERATURE, FormDimension.WARMING),
                             proof=(ProofVariable.TEMPERATURE_RATE, ProofVariable.TEMPERATURE)),
)
