# SPDX-License-Identifier: Apache-2.0

"""Supply voltage: zero-g and scale factor follow it, though not exactly in proportion."""

from adxl_ros.model.constants import NOMINAL_SUPPLY_V
from adxl_ros.model.diagnosis_hints import DiagnosisHints, FormDimension, Manoeuvre, ProofVariable
from adxl_ros.model.effects.base import Effect, Parameter, Parameters, Place, Role, Signals

_SCALE_EXPONENT = 1.135
"""Typical exponent of the scale factor, ln(560/1000)/ln(3/5): 560 mV/g at 3 V and 1000 mV/g at 5 V
(ADXL203 datasheet, specifications)."""


def apply(signals: Signals, p: Parameters) -> None:
    """Multiply zero-g and scale factor by powers of the supply voltage over its nominal value."""
    ratio = signals.environment.supply_v / p['nominal_v']
    for d, (zero, scale) in enumerate(zip(p['zero_g_exponent'], p['scale_exponent'])):
        signals.zero_g_v[d] = signals.zero_g_v[d] * ratio ** zero
        signals.scale_v_per_g[d] = signals.scale_v_per_g[d] * ratio ** scale


EFFECT = Effect(
    name='supply',
    place=Place.ELECTRONICS,
    parameters=(
        Parameter('zero_g_exponent', '1', -3.0, 3.0, 1.0, 'ADXL203 datasheet: ratiometric',
                  'exponent of the supply voltage in the zero-g; 0 is independent of it'),
        Parameter('scale_exponent', '1', -3.0, 3.0, _SCALE_EXPONENT,
                  'ADXL203 datasheet: 560 mV/g at 3 V, not 600',
                  'exponent of the supply voltage in the scale factor; 0 is independent of it'),
        Parameter('nominal_v', 'V', 1.0, 30.0, NOMINAL_SUPPLY_V,
                  'ADXL203 datasheet: values at 5 V',
                  'supply voltage of the datasheet values', '',
                  neutral=NOMINAL_SUPPLY_V, held=True, role=Role.SHAPE),
    ),
    apply=apply,
    invertible=True,
    follows=('supply_v',),
    cause='The output follows the supply; measure the supply and correct, or regulate it.',
    diagnosis=DiagnosisHints(revealed_by=Manoeuvre.SUPPLY, form=(FormDimension.SUPPLY,),
                             proof=(ProofVariable.SUPPLY,)),
)
