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

"""Time offset: the stamps are late."""

from adxl_ros.model.diagnosis_hints import DiagnosisHints, Manoeuvre, ProofVariable
from adxl_ros.model.effects.base import Effect, Parameter, Parameters, Place, Signals


def apply(signals: Signals, p: Parameters) -> None:
    """Take each sample earlier than its stamp."""
    signals.time_s = signals.time_s - p['offset_s']


EFFECT = Effect(
    name='time_offset',
    place=Place.CLOCK,
    parameters=(
        Parameter('offset_s', 's', -1.0, 1.0, 5e-3, 'physics: buffers between ADC and host',
                  'delay of the stamps behind the samples', ''),
    ),
    apply=apply,
    exact=True,
    cause='The stamps of sensor and stage differ; synchronise the clocks, or state the delay.',
    # Stamps have a latency of some 0.1 ms (chosen: buffers of a board that works).
    diagnosis=DiagnosisHints(healthy_std=1e-4, revealed_by=Manoeuvre.SHAKE,
                             proof=(ProofVariable.FORCE_RATE,)),
)
