# SPDX-License-Identifier: Apache-2.0

"""Bandwidth of the output filter: on-chip resistors differ by 25 %, registers set the rest."""

from adxl_ros.model.diagnosis_hints import DiagnosisHints, FormDimension, Manoeuvre, ProofVariable
from adxl_ros.model.effects.base import Effect, Need, Parameter, Parameters, Place, Signals

_WITHOUT_FILTER_S = 1e-3
"""Time constant that r counts in where no filter is stated, s. Chosen."""


def apply(signals: Signals, p: Parameters) -> None:
    """Multiply the time constant of the filter by 1 + r; r ms where no filter is stated."""
    for d, ratio in enumerate(p['resistance_ratio']):
        signals.rc_s[d] = signals.rc_s[d] * (1 + ratio) if signals.rc_s[d] \
            else _WITHOUT_FILTER_S * max(ratio, 0.0)


EFFECT = Effect(
    name='bandwidth',
    place=Place.ELECTRONICS,
    parameters=(
        Parameter('resistance_ratio', '1', -0.95, 1000.0, 1.0,
                  'ADXL203 datasheet: 32 kOhm +-25 %; ADXL355: settings from 1 to 1000 Hz',
                  "filter's resistance divided by the stated one, minus 1; ms without a filter",
                  typical=0.15, starts=(0.03, *(2.0 ** n for n in range(7)))),
    ),
    apply=apply,
    needs=(Need.FILTER,),
    cause='The output filter is not the stated one; measure its resistor and capacitor.',
    # The RC product of a healthy unit is within some 2 % of the measured one (chosen: resistors
    # and capacitors of 1 %, and their temperature).
    diagnosis=DiagnosisHints(healthy_std=0.02,
                             stated_by=('rc_resistance_ohm', 'rc_capacitance_f'),
                             revealed_by=Manoeuvre.SHAKE, form=(FormDimension.LAG,),
                             proof=(ProofVariable.FREQUENCY,)),
)
