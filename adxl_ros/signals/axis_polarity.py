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

"""Inverted and swapped axes, from the correlation of each axis with a reference."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

CERTAIN_CORRELATION = 0.9
"""Correlation with the reference from which an axis is identified. Chosen: noise, misalignment and
cross-axis terms of real sensors lower the correlation by a few percent only."""


@dataclass(frozen=True)
class PolarityFault:
    """
    An axis that does not follow its reference.

    Attributes
    ----------
    axis
        Index of the measured axis.
    follows
        Index of the reference axis that it follows: its own reference if it is inverted.
    correlation
        Correlation with that reference, −1 to 1.

    """

    axis: int
    follows: int
    correlation: float

    def describe(self, axis: str, reference: str) -> str:
        """
        Return the fault and its remedy as one line.

        Parameters
        ----------
        axis
            Letter of the measured axis.
        reference
            Letter of the reference axis that it follows.

        Returns
        -------
        str
            One line.

        """
        if axis == reference:
            return (f'{axis} reads against its reference (correlation {self.correlation:.2f}): '
                    'the axis is inverted; correct its sign or the mounting')
        sign = 'against' if self.correlation < 0 else 'with'
        return (f'{axis} moves {sign} the reference of {reference} (correlation '
                f'{self.correlation:.2f}): axes are swapped; correct the wiring or the mounting')


def find_polarity_fault(correlation: np.ndarray, references: list[int],
                        swap_limit: float) -> PolarityFault | None:
    """
    Find the first axis that is inverted or follows the reference of another axis.

    Parameters
    ----------
    correlation
        Correlation of m measured axes with r reference axes, (m, r). NaN where an axis is
        constant.
    references : list of int
        Index of the reference of each measured axis, (m,). An axis whose own correlation is NaN
        is skipped.
    swap_limit
        An axis is swapped only if its correlation with its own reference is less than this.

    Returns
    -------
    PolarityFault or None
        None where every axis follows its own reference, or where no axis is certain.

    """
    for axis, (row, reference) in enumerate(zip(correlation, references)):
        if not np.isfinite(row[reference]):
            continue
        if row[reference] < -CERTAIN_CORRELATION:
            return PolarityFault(axis, reference, float(row[reference]))
        other = int(np.nanargmax(np.abs(row)))
        if other != reference and abs(row[other]) > CERTAIN_CORRELATION \
                and abs(row[reference]) < swap_limit:
            return PolarityFault(axis, other, float(row[other]))
    return None
