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

"""Quantisation that is coarser than the resolution of the ADC."""

from adxl_ros.model.diagnosis_hints import Detector, DiagnosisHints
from adxl_ros.model.effects.base import ActsOn, Effect, Need, Parameter, Parameters, Place, Signals


def apply(signals: Signals, p: Parameters) -> None:
    """Multiply the step of the ADC by 2 for each lost bit."""
    signals.lsb_v = signals.lsb_v * 2.0 ** p['lost_bits']


EFFECT = Effect(
    name='quantisation',
    place=Place.ELECTRONICS,
    parameters=(
        Parameter('lost_bits', 'bit', 0.0, 12.0, 3.0, 'physics: a driver that drops low bits',
                  'number of bits that the ADC loses', ''),
    ),
    apply=apply,
    smooth=False,
    acts_on=ActsOn.NOISE,
    needs=(Need.ADC,),
    cause='The ADC resolves less than stated; check its setting, reference and format.',
    diagnosis=DiagnosisHints(detector=Detector.COARSE_CODES),
)
