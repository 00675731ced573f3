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

"""How far a diagnosis is, by the work that is done and the work that is still expected."""

from __future__ import annotations

from collections.abc import Callable

ShowProgress = Callable[[str, float], None]
"""Called with number and name of the stage, and the fraction of all work that is done, 0 to 1."""

CHECKS, LIBRARY, SINGLES = 'checks', 'library of effects', 'single effects'
FURTHER, PROBABILITIES, REPORT = 'further effects', 'probabilities', 'report'

_USUAL_WORK = {CHECKS: 0.6, LIBRARY: 2.0, SINGLES: 2.0, FURTHER: 1.5, PROBABILITIES: 3.0,
               REPORT: 0.2}
"""Usual work of each stage. Measured: seconds on a recording of five minutes at 250 Hz, with none
to two effects."""
FIT_WORK = 0.6
"""Work of one fit by simulation. Measured as the usual work."""
RANKING_WORK = 1.2
"""Work of the ranking of further effects. Measured as the usual work."""
BASIS_WORK, SET_WORK = 1.5, 0.3
"""Work of the probabilities of all sets, and of each set. Measured as the usual work."""


class ProgressPlan:
    """
    The stages of a diagnosis with their work.

    What the recording does not need is taken out of the plan as soon as it is known, so that the
    time that is left can be told from the fraction.
    """

    def __init__(self, show: ShowProgress) -> None:
        """Plan the usual work; `show` is called with each step."""
        self._show, self._work = show, dict(_USUAL_WORK)
        self._done = dict.fromkeys(_USUAL_WORK, 0.0)

    def expect(self, stage: str, work: float) -> None:
        """
        Change the work of a stage.

        Parameters
        ----------
        stage
            Name of the stage.
        work
            Its whole work, as `FIT_WORK` counts it.

        """
        self._work[stage] = max(work, 0.0)

    def show(self, stage: str, share: float) -> None:
        """
        Show how far a stage is; the stages before it are done.

        Parameters
        ----------
        stage
            Name of the stage.
        share
            Share of its work that is done, 0 to 1.

        """
        for before in self._work:
            if before == stage:
                break
            self._done[before] = self._work[before]
        self._done[stage] = self._work[stage] * share
        number = list(self._work).index(stage) + 1
        self._show(f'{number}/{len(self._work)} {stage}',
                   sum(self._done.values()) / sum(self._work.values()))

    def within(self, stage: str) -> Callable[[float], None]:
        """Return a function that shows how far a stage is, from its share that is done."""
        return lambda share: self.show(stage, share)
