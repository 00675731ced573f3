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

"""What the samples so far say: the probability of each hypothesis."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from adxl_ros.diagnose.decision import normalised, WeightedHypothesis
from adxl_ros.diagnose.diagnosis import diagnose, Diagnosis, SETTINGS
from adxl_ros.diagnose.noise_detectors import UNKNOWN
from adxl_ros.files.recording_columns import Recording
from adxl_ros.model.sensor import Sensor


@dataclass(frozen=True)
class Assessment:
    """
    Probabilities of the hypotheses, and the diagnosis that gives them.

    Attributes
    ----------
    hypotheses
        Hypotheses by falling probability, which sums to 1; no effect means no gap.
    diagnosis
        The diagnosis; None before there are samples enough.

    """

    hypotheses: tuple[WeightedHypothesis, ...]
    diagnosis: Diagnosis | None = None

    @property
    def fault(self) -> str:
        """Return the fault of the recording that makes a verdict impossible; '' without one."""
        fault = self.diagnosis.data_fault if self.diagnosis else None
        return '' if fault is None or fault.status == 'insufficient' else fault.message


def prior() -> Assessment:
    """Return the probabilities without any sample; those of single effects are not spread yet."""
    none, unknown = SETTINGS.prior_by_count[0], sum(SETTINGS.prior_of_unknown_by_count)
    return Assessment(normalised({(): none, (UNKNOWN,): unknown}))


def assess(recordings: Sequence[Recording], sensor: Sensor, seed: int = 0) -> Assessment:
    """
    Diagnose the samples so far.

    Parameters
    ----------
    recordings
        All samples of the unit.
    sensor
        The baseline.
    seed
        Seed of the diagnosis.

    Returns
    -------
    Assessment
        The probabilities. Those of a recording that is too short are the prior ones.

    Raises
    ------
    UserError
        A recording is of another unit, or its reference cannot be followed.

    """
    diagnosis = diagnose(recordings, sensor, seed=seed)
    if diagnosis.verdict is None:
        return Assessment(prior().hypotheses, diagnosis)
    return Assessment(diagnosis.verdict.described, diagnosis)


def with_unseen(assessment: Assessment, effects: Sequence[str], library_size: int) -> Assessment:
    """
    Add single effects that the samples so far could not show.

    Parameters
    ----------
    assessment
        The assessment.
    effects
        Names of the effects.
    library_size
        Number of effects over which the prior of single effects is spread.

    Returns
    -------
    Assessment
        The assessment, in which each of them has its prior odds over no gap.

    """
    weights = {h.effects: h.probability for h in assessment.hypotheses}
    odds = SETTINGS.prior_by_count[1] / SETTINGS.prior_by_count[0] / max(library_size, 1)
    for effect in effects:
        weights.setdefault((effect,), weights.get((), 0.0) * odds)
    return Assessment(normalised(weights), assessment.diagnosis)
