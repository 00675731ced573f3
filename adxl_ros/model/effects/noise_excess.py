# Copyright 2026 the adxl_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

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
