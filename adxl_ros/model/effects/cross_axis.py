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

"""
Bias from the other in-plane axis: g(V_c) of equations 10 and 11, centred and in g.

The z axis gets it from x.
"""

from adxl_ros.model.diagnosis_hints import DiagnosisHints, FormDimension, Manoeuvre, ProofVariable
from adxl_ros.model.effects.base import Effect, Parameter, Parameters, Place, Signals

OTHER = (1, 0, 0)
"""Index of the other axis c by axis: x has y, y has x, and z has x."""


def apply(signals: Signals, p: Parameters) -> None:
    """Add p1·A_c + p2·A_c² to each measured axis, c being its `OTHER`."""
    for d, (p1, p2) in enumerate(zip(p['linear'], p['quadratic_per_g'])):
        other = signals.sensed[OTHER[d]]
        signals.output[d] = signals.output[d] + (p1 + p2 * other) * other


EFFECT = Effect(
    name='cross_axis',
    place=Place.ELEMENT,
    parameters=(
        Parameter('linear', 'g/g', -0.3, 0.3, 0.015, 'ADXL203 datasheet: cross-axis 1.5 %',
                  'p1 of equation 11; to first order the same as a misalignment'),
        Parameter('quadratic_per_g', '1/g', -0.3, 0.3, 0.01, 'paper, figure 4',
                  'p2 of equation 11'),
    ),
    apply=apply,
    invertible=True,
    cause='The other in-plane axis shifts the bias; calibrate with the plane alpha = 90 deg.',
    diagnosis=DiagnosisHints(revealed_by=Manoeuvre.PLANES, form=(FormDimension.CROSS_FORCE,),
                             proof=(ProofVariable.CROSS_FORCE,)),
)
