# SPDX-License-Identifier: Apache-2.0

"""Quantisation that is coarser than the resolution of the ADC."""

from adxl_ros.model.diagnosis_hints import Detector, DiagnosisHints, ProofVariable
from adxl_ros.model.effects.base import (
    ActsOn,
    Effect,
    Need,
    Parameter,
    Parameters,
    Place,
    Role,
    Signals,
)


def apply(signals: Signals, p: Parameters) -> None:
    """Multiply the step of the ADC by 2 for each lost bit, of all axes and of each."""
    signals.lsb_v = signals.lsb_v * 2.0 ** p['lost_bits']
    for d, lost in enumerate(p['axis_lost_bits']):
        signals.lsb_ratio[d] = signals.lsb_ratio[d] * 2.0 ** lost


EFFECT = Effect(
    name='quantisation',
    place=Place.ELECTRONICS,
    parameters=(
        Parameter('lost_bits', 'bit', 0.0, 12.0, 3.0, 'physics: a driver that drops low bits',
                  'number of bits that the ADC loses', ''),
        Parameter('axis_lost_bits', 'bit', 0.0, 12.0, 3.0, 'physics: a converter for each axis',
                  'number of further bits that the axis loses', typical=0.0,
                  role=Role.OPTIONAL),
    ),
    apply=apply,
    smooth=False,
    acts_on=ActsOn.NOISE,
    needs=(Need.ADC,),
    cause='The ADC resolves less than stated; check its setting, reference and format.',
    diagnosis=DiagnosisHints(detector=Detector.COARSE_CODES,
                             proof=(ProofVariable.STEP,)),
)
