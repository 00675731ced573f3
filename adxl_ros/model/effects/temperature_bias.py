# SPDX-License-Identifier: Apache-2.0

"""Zero-g that changes with temperature."""

from adxl_ros.model.constants import NOMINAL_TEMPERATURE_C
from adxl_ros.model.diagnosis_hints import DiagnosisHints, FormDimension, Manoeuvre, ProofVariable
from adxl_ros.model.effects.base import Effect, Parameter, Parameters, Place, Role, Signals


def apply(signals: Signals, p: Parameters) -> None:
    """Add k·(T − 25 °C) + k2·(T − 25 °C)² to the output, g."""
    warmer_k = signals.environment.temperature_c - NOMINAL_TEMPERATURE_C
    for d, (per_k, per_k2) in enumerate(zip(p['per_k'], p['per_k2'])):
        signals.output[d] = signals.output[d] + warmer_k * (per_k + warmer_k * per_k2)


EFFECT = Effect(
    name='temperature_bias',
    place=Place.ELECTRONICS,
    parameters=(
        Parameter('per_k', 'g/K', -0.1, 0.1, 1e-4, 'ADXL203 datasheet: 0.1 mg/degC',
                  'slope of the zero-g over temperature at 25 degC'),
        Parameter('per_k2', 'g/K^2', -0.01, 0.01, 1e-6,
                  'physics: a slope that changes by 1 % a degree',
                  'curvature of the zero-g over temperature', typical=0.0, role=Role.OPTIONAL),
    ),
    apply=apply,
    invertible=True,
    follows=('temperature_c',),
    cause='The zero-g follows the temperature; measure it and correct, or keep it steady.',
    diagnosis=DiagnosisHints(revealed_by=Manoeuvre.HEAT, form=(FormDimension.TEMPERATURE,),
                             proof=(ProofVariable.TEMPERATURE,)),
)
