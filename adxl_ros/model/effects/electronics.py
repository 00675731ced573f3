# SPDX-License-Identifier: Apache-2.0

"""The electronics: zero-g, scale factor, supply, output stage and filter."""

from adxl_ros.model.constants import NOMINAL_SUPPLY_V
from adxl_ros.model.effects.base import (
    DiagnosisHints,
    effect,
    FormDimension,
    Manoeuvre,
    Need,
    Parameter,
    Parameters,
    Place,
    ProofVariable,
    Role,
    Signals,
    StraightLine,
)
import numpy as np


@effect(Place.ELECTRONICS,
        Parameter('offset_v', 'V', -2.0, 2.0, 0.1, 'ADXL203 datasheet: zero-g 2.4 to 2.6 V',
                  'zero-g output minus the nominal one'),
        exact=True, invertible=True,
        cause='The zero-g output of this unit is not the nominal one; calibrate the unit.',
        # Zero-g of a healthy unit changes by 0.1 mg from day to day (tuned by hand on simulated
        # recordings).
        diagnosis=DiagnosisHints(straight_line=StraightLine.ZERO_G, healthy_std=1e-4,
                                 revealed_by=Manoeuvre.REMOUNT, proof=(ProofVariable.TIME,)))
def bias(signals: Signals, p: Parameters) -> None:
    """Zero-g of a unit minus the nominal one (B of equation 2)."""
    for d, offset in enumerate(p['offset_v']):
        signals.zero_g_v[d] = signals.zero_g_v[d] + offset


@effect(Place.ELECTRONICS,
        Parameter('offset_v_per_g', 'V/g', -0.9, 9.0, 0.04,
                  'ADXL203 datasheet: 960 to 1040 mV/g', 'scale factor minus the nominal one'),
        exact=True, invertible=True,
        cause='The scale factor of this unit is not the nominal one; calibrate the unit.',
        # The scale factor of a healthy unit changes by 0.01 % from day to day (tuned by hand on
        # simulated recordings).
        diagnosis=DiagnosisHints(straight_line=StraightLine.SCALE_FACTOR, healthy_std=1e-4,
                                 revealed_by=Manoeuvre.REMOUNT, proof=(ProofVariable.OWN_FORCE,)))
def scale_factor(signals: Signals, p: Parameters) -> None:
    """Scale factor of a unit minus the nominal one (SF of equation 1)."""
    for d, offset in enumerate(p['offset_v_per_g']):
        signals.scale_v_per_g[d] = signals.scale_v_per_g[d] + offset


_SCALE_EXPONENT = 1.135
"""Typical exponent of the scale factor, ln(560/1000)/ln(3/5): 560 mV/g at 3 V and 1000 mV/g at 5 V
(ADXL203 datasheet, specifications)."""


@effect(Place.ELECTRONICS,
        Parameter('zero_g_exponent', '1', -3.0, 3.0, 1.0, 'ADXL203 datasheet: ratiometric',
                  'exponent of the supply voltage in the zero-g; 0 is independent of it'),
        Parameter('scale_exponent', '1', -3.0, 3.0, _SCALE_EXPONENT,
                  'ADXL203 datasheet: 560 mV/g at 3 V, not 600',
                  'exponent of the supply voltage in the scale factor; 0 is independent of it'),
        Parameter('nominal_v', 'V', 1.0, 30.0, NOMINAL_SUPPLY_V,
                  'ADXL203 datasheet: values at 5 V',
                  'supply voltage of the datasheet values', '',
                  neutral=NOMINAL_SUPPLY_V, held=True, role=Role.SHAPE),
        invertible=True, follows=('supply_v',),
        cause='The output follows the supply; measure the supply and correct, or regulate it.',
        diagnosis=DiagnosisHints(revealed_by=Manoeuvre.SUPPLY, form=(FormDimension.SUPPLY,),
                                 proof=(ProofVariable.SUPPLY,)))
def supply(signals: Signals, p: Parameters) -> None:
    """Supply voltage: zero-g and scale factor follow it, though not exactly in proportion."""
    ratio = signals.environment.supply_v / p['nominal_v']
    for d, (zero, scale) in enumerate(zip(p['zero_g_exponent'], p['scale_exponent'])):
        signals.zero_g_v[d] = signals.zero_g_v[d] * ratio ** zero
        signals.scale_v_per_g[d] = signals.scale_v_per_g[d] * ratio ** scale


@effect(Place.ELECTRONICS,
        Parameter('limit_g', 'g', 0.1, 1000.0, 1.0,
                  'ADXL203 datasheet: range 1.7 g at least; lower with a low supply',
                  'largest output of either sign; 1000 does not clip', neutral=1000.0,
                  role=Role.LIMIT),
        Parameter('knee_g', 'g', 0.0, 0.5, 0.02, 'physics: an amplifier near its rail',
                  'width of a soft clip; 0 is hard', '', typical=0.0,
                  role=Role.OPTIONAL),
        Parameter('offset_g', 'g', -0.5, 0.5, 0.02,
                  'ADXL203 datasheet: zero-g 2.4 to 2.6 V between rails of 0 and 5 V',
                  'middle of the two limits', typical=0.0, role=Role.OPTIONAL),
        smooth=False,
        cause='The output clips; raise the supply, lower the gain, or choose a wider range.',
        diagnosis=DiagnosisHints(form=(FormDimension.FORCE,), proof=(ProofVariable.OWN_FORCE,)))
def saturation(signals: Signals, p: Parameters) -> None:
    """
    Saturation: the output stage clips at its limit.

    Clip the output of each axis at plus and minus its limit about an offset, g.

    With a knee w the clip is soft: x − w·ln(1 + exp((x − limit)/w)), and the same below. The
    offset is that of the zero-g from the middle of the rails.
    """
    knee_g = float(p['knee_g'])
    for d, (limit, offset) in enumerate(zip(p['limit_g'], p['offset_g'])):
        x = signals.output[d]
        upper, lower = limit + offset, limit - offset
        if not knee_g:
            signals.output[d] = np.clip(x, -lower, upper)
        else:
            beyond = [np.logaddexp(0.0, (sign * x - rail) / knee_g)
                      for sign, rail in ((1, upper), (-1, lower))]
            signals.output[d] = x - knee_g * (beyond[0] - beyond[1])


_WITHOUT_FILTER_S = 1e-3
"""Time constant that r counts in where no filter is stated, s. Chosen."""


@effect(Place.ELECTRONICS,
        Parameter('resistance_ratio', '1', -0.95, 1000.0, 1.0,
                  'ADXL203 datasheet: 32 kOhm +-25 %; ADXL355: settings from 1 to 1000 Hz',
                  "filter's resistance divided by the stated one, minus 1; ms without a filter",
                  typical=0.15, starts=(0.03, *(2.0 ** n for n in range(7)))),
        needs=(Need.FILTER,),
        cause='The output filter is not the stated one; measure its resistor and capacitor.',
        # The RC product of a healthy unit is within some 2 % of the measured one (chosen:
        # resistors and capacitors of 1 %, and their temperature).
        diagnosis=DiagnosisHints(healthy_std=0.02,
                                 stated_by=('rc_resistance_ohm', 'rc_capacitance_f'),
                                 revealed_by=Manoeuvre.SHAKE, form=(FormDimension.LAG,),
                                 proof=(ProofVariable.FREQUENCY,)))
def bandwidth(signals: Signals, p: Parameters) -> None:
    """Bandwidth of the output filter: on-chip resistors differ by 25 %, registers set the rest."""
    for d, ratio in enumerate(p['resistance_ratio']):
        signals.rc_s[d] = signals.rc_s[d] * (1 + ratio) if signals.rc_s[d] \
            else _WITHOUT_FILTER_S * max(ratio, 0.0)
