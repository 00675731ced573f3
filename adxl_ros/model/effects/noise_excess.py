# SPDX-License-Identifier: Apache-2.0

"""White noise beyond the stated density."""

from adxl_ros.model.diagnosis_hints import Detector, DiagnosisHints, ProofVariable
from adxl_ros.model.effects.base import ActsOn, Effect, Need, Parameter, Parameters, Place, Signals


def apply(signals: Signals, p: Parameters) -> None:
    """Multiply the noise density by 1 + r."""
    for d, ratio in enumerate(p['ratio']):
        signals.noise_ratio[d] = signals.noise_ratio[d] * (1 + ratio)


EFFECT = Effect(
    name='noise_excess',
    place=Place.ELECTRONICS,
    parameters=(
        Parameter('ratio', '1', -0.99, 100.0, 0.3,
                  'ADXL203 datasheet: 190 instead of 110 ug/sqrt(Hz) at 3 V',
                  'noise density divided by the stated one, minus 1'),
    ),
    apply=apply,
    acts_on=ActsOn.NOISE,
    needs=(Need.NOISE,),
    cause='The noise is not the stated one; check the supply, its decoupling and the cable.',
    diagnosis=DiagnosisHints(detector=Detector.NOISE_LEVEL,
                             proof=(ProofVariable.FREQUENCY,)),
)
