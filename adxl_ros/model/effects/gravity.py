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

"""Local gravity that differs from the stated one."""

from adxl_ros.model.diagnosis_hints import DiagnosisHints, Manoeuvre, ProofVariable
from adxl_ros.model.effects.base import Effect, Need, Parameter, Parameters, Place, Signals


def apply(signals: Signals, p: Parameters) -> None:
    """Add the offset to local gravity, m/s²."""
    signals.gravity_mps2 = signals.gravity_mps2 + p['offset_mps2']


EFFECT = Effect(
    name='gravity',
    place=Place.STAGE,
    parameters=(
        Parameter('offset_mps2', 'm/s^2', -5.0, 5.0, 0.01,
                  'geodesy: 9.780 at the equator, 9.832 at the poles',
                  'local gravity minus the stated one', ''),
    ),
    apply=apply,
    exact=True,
    invertible=True,
    needs=(Need.STAGE,),
    cause='Local gravity is not the stated one; look it up for latitude and height.',
    diagnosis=DiagnosisHints(imitated=True, revealed_by=Manoeuvre.REMOUNT,
                             proof=(ProofVariable.OWN_FORCE,)),
)
