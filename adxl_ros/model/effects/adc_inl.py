# SPDX-License-Identifier: Apache-2.0

"""Integral nonlinearity of the ADC: one curve over its codes for all channels."""

from adxl_ros.model.diagnosis_hints import DiagnosisHints, FormDimension, Manoeuvre, ProofVariable
from adxl_ros.model.effects.base import Effect, Parameter, Parameters, Place, Role, Signals
import numpy as np


def apply(signals: Signals, p: Parameters) -> None:
    """
    Add A·sin φ + C·cos φ, φ = 2π·n·V/V_ref, and wrong weights of the heaviest bits to the volts.

    The output of a converter that weighs bit by bit has the errors of all bits that are set (van
    de Plassche, "CMOS Integrated Analog-to-Digital Converters", 2003): half of each, up or down.
    """
    turn = 2 * np.pi * p['cycles'] / signals.vref_v
    for d, volts in enumerate(signals.input_v):
        errors_v = [p[name] * function(turn * volts)
                    for name, function in (('amplitude_v', np.sin), ('cosine_v', np.cos))
                    if p[name]]
        if any(p[name] for name in _BITS):
            code = np.floor(volts / signals.vref_v * 2 ** len(_BITS)).astype(int)
            errors_v += [p[name] * ((code >> (len(_BITS) - bit) & 1) - 0.5)
                         for bit, name in enumerate(_BITS, 1) if p[name]]
        signals.volts[d] = sum(errors_v, signals.volts[d])


_BITS = ('first_bit_v', 'second_bit_v', 'third_bit_v', 'fourth_bit_v', 'fifth_bit_v',
         'sixth_bit_v')
"""Parameters of the bits, the heaviest first."""


_STARTS = (1.0, 2.4, 4.0, 5.8, 7.6, 9.4, 11.2, 13.0, 14.8, 16.6, 18.4, 20.2, 22.0, 23.8, 25.6,
           27.4, 29.2, 32.0, 36.0, 41.0, 47.0, 54.0, 62.0)
"""Periods from which a fit starts. Chosen: 1 g of either sign covers 0.4 of the full scale.
A start that differs by a third of a period there, 0.9, explains half of the power of a sine. Above
30 the steps are wider, because converters with so many segments are rare."""

EFFECT = Effect(
    name='adc_inl',
    place=Place.ADC,
    parameters=(
        Parameter('amplitude_v', 'V', -0.05, 0.05, 3e-4, 'physics: 4 LSB of 16 bit at 5 V',
                  'amplitude of the sine by which it deviates from the straight line', ''),
        Parameter('cosine_v', 'V', -0.05, 0.05, 3e-4, 'physics: 4 LSB of 16 bit at 5 V',
                  'amplitude of the cosine, which shifts the sine over the codes', '',
                  typical=0.0, role=Role.OPTIONAL),
        Parameter('cycles', '1', 0.5, 64.0, 8.0, 'physics: segments of a converter',
                  'periods of the deviation over the full scale', '', neutral=8.0,
                  role=Role.SHAPE, starts=_STARTS),
        *(Parameter(name, 'V', -0.05, 0.05, 3e-4, 'physics: 4 LSB of 16 bit at 5 V',
                    f'error of the weight of bit {i}, the heaviest being 1', '', typical=0.0,
                    role=Role.OPTIONAL, shaped=False)
          for i, name in enumerate(_BITS, 1)),
    ),
    apply=apply,
    invertible=True,
    cause='The ADC is nonlinear; calibrate it with a voltage source, or choose another.',
    diagnosis=DiagnosisHints(revealed_by=Manoeuvre.REMOUNT, form=(FormDimension.CODE,),
                             proof=(ProofVariable.OUTPUT,)),
)
