# SPDX-License-Identifier: Apache-2.0

"""Warm-up: a zero-g that settles after power-on."""

from adxl_ros.model.diagnosis_hints import DiagnosisHints, FormDimension, Manoeuvre, ProofVariable
from adxl_ros.model.effects.base import Effect, Parameter, Parameters, Place, Role, Signals
import numpy as np


def apply(signals: Signals, p: Parameters) -> None:
    """Add A·exp(−t/τ) to the output, g; t is the time since power-on."""
    unsettled = np.exp(-signals.environment.time_s / p['tau_s'])
    for d, amplitude in enumerate(p['amplitude_g']):
        signals.output[d] = signals.output[d] + amplitude * unsettled


EFFECT = Effect(
    name='warm_up',
    place=Place.ELECTRONICS,
    parameters=(
        Parameter('amplitude_g', 'g', -0.5, 0.5, 2e-3, 'physics: self-heating by 20 K, 0.1 mg/K',
                  'zero-g at power-on minus the settled one'),
        Parameter('tau_s', 's', 1.0, 1e5, 300.0, 'physics: a board in still air',
                  'time constant of settling', '', neutral=300.0, role=Role.SHAPE,
                  starts=(15.0, 60.0, 300.0, 1500.0)),
    ),
    apply=apply,
    invertible=True,
    follows=('time_s',),
    cause='The sensor warms up after power-on; wait some time constants before measuring.',
    diagnosis=DiagnosisHints(revealed_by=Manoeuvre.HEAT, form=(FormDimension.TIME,),
                             proof=(ProofVariable.TIME,)),
)
