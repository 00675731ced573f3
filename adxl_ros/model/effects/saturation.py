# SPDX-License-Identifier: Apache-2.0

"""Saturation: the output stage clips at its limit."""

from adxl_ros.model.diagnosis_hints import DiagnosisHints, FormDimension, ProofVariable
from adxl_ros.model.effects.base import Effect, Parameter, Parameters, Place, Role, Signals
import numpy as np


def apply(signals: Signals, p: Parameters) -> None:
    """
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


EFFECT = Effect(
    name='saturation',
    place=Place.ELECTRONICS,
    parameters=(
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
    ),
    apply=apply,
    smooth=False,
    cause='The output clips; raise the supply, lower the gain, or choose a wider range.',
    diagnosis=DiagnosisHints(form=(FormDimension.FORCE,),
                             proof=(ProofVariable.OWN_FORCE,)),
)
