# SPDX-License-Identifier: Apache-2.0

"""Scale factor that changes with temperature."""

from adxl_ros.model.constants import NOMINAL_TEMPERATURE_C
from adxl_ros.model.diagnosis_hints import DiagnosisHints, FormDimension, Manoeuvre, ProofVariable
from adxl_ros.model.effects.base import Effect, Parameter, Parameters, Place, Role, Signals


def apply(signals: Signals, p: Parameters) -> None:
    """Multiply the scale factor by 1 + k·(T − 25 °C) + k2·(T − 25 °C)²."""
    warmer_k = signals.environment.temperature_c - NOMINAL_TEMPERATURE_C
    for d, (per_k, per_k2) in enumerate(zip(p['per_k'], p['per_k2'])):
        signals.scale_v_per_g[d] = signals.scale_v_per_g[d] * (
            1 + warmer_k * (per_k + warmer_k * per_k2))


EFFECT = Effect(
    name='temperature_scale',
    place=Place.ELECTRONICS,
    parameters=(
        Parameter('per_k', '1/K', -0.01, 0.01, 1e-4,
                  'ADXL203 datasheet: sensitivity +-0.3 % over temperature',
                  'relative slope of the scale factor over temperature, from 25 degC on'),
        Parameter('per_k2', '1/K^2', -0.001, 0.001, 1e-6,
                  'physics: a slope that changes by 1 % a degree',
                  'relative curvature of the scale factor over temperature', typical=0.0,
                  role=Role.OPTIONAL),
    ),
    apply=apply,
    invertible=True,
    follows=('temperature_c',),
    cause='The scale factor follows the temperature; measure it and correct, or keep it steady.',
    diagnosis=DiagnosisHints(revealed_by=Manoeuvre.HEAT, form=(FormDimension.TEMPERATURE,),
                             proof=(ProofVariable.TEMPERATURE,)),
)
