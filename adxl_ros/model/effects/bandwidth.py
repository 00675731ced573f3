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

"""Bandwidth of the RC filter: the on-chip resistor has a tolerance of 25 %."""

from adxl_ros.model.diagnosis_hints import DiagnosisHints, FormDimension, Manoeuvre, ProofVariable
from adxl_ros.model.effects.base import Effect, Need, Parameter, Parameters, Place, Signals


def apply(signals: Signals, p: Parameters) -> None:
    """Multiply the time constant of the RC filter by 1 + r."""
    for d, ratio in enumerate(p['resistance_ratio']):
        signals.rc_s[d] = signals.rc_s[d] * (1 + ratio)


EFFECT = Effect(
    name='bandwidth',
    place=Place.ELECTRONICS,
    parameters=(
        Parameter('resistance_ratio', '1', -0.95, 10.0, 0.15,
                  'ADXL203 datasheet: 32 kOhm +-25 %',
                  "filter's resistance divided by the stated one, minus 1"),
    ),
    apply=apply,
    needs=(Need.FILTER,),
    cause='The output filter is not the stated one; measure its resistor and capacitor.',
    # The RC product of a healthy unit is within some 2 % of the measured one (chosen: resistors
    # and capacitors of 1 %, and their temperature).
    diagnosis=DiagnosisHints(healthy_std=0.02, revealed_by=Manoeuvre.SHAKE,
                             form=(FormDimension.LAG,),
                             proof=(ProofVariable.FREQUENCY,)),
)
