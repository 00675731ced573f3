# SPDX-License-Identifier: Apache-2.0

"""Axes that are inverted or swapped, by the correlation with their references."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

CERTAIN_CORRELATION = 0.9  # Correlation that identifies an axis. Chosen: errors cost few percent


@dataclass(frozen=True)
class PolarityFault:
    """An axis that does not follow its reference."""

    axis: int  # Index of the measured axis
    follows: int  # Index of the reference axis that it follows: its own if it is inverted
    correlation: float  # Correlation with that reference, −1 to 1

    def describe(self, axis: str, reference: str) -> str:
        """Return the fault and its remedy as one line."""
        if axis == reference:
            return (
                f'{axis} reads against its reference (correlation {self.correlation:.2f}): '
                'the axis is inverted; correct its sign or the mounting'
            )
        sign = 'against' if self.correlation < 0 else 'with'
        return (
            f'{axis} moves {sign} the reference of {reference} (correlation '
            f'{self.correlation:.2f}): axes are swapped; correct the wiring or the mounting'
        )


def find_polarity_fault(
    correlation: np.ndarray, references: list[int], swap_limit: float
) -> PolarityFault | None:
    """
    Find the first axis that is inverted or follows the reference of another axis.

    correlation: of m measured axes with r reference axes, (m, r), NaN where an axis is constant;
    references: index of the reference of each measured axis, (m,).
    """
    for axis, (row, reference) in enumerate(zip(correlation, references)):
        if not np.isfinite(row[reference]):
            continue
        if row[reference] < -CERTAIN_CORRELATION:
            return PolarityFault(axis, reference, float(row[reference]))
        other = int(np.nanargmax(np.abs(row)))
        follows_other = other != reference and abs(row[other]) > CERTAIN_CORRELATION
        if follows_other and abs(row[reference]) < swap_limit:
            return PolarityFault(axis, other, float(row[other]))
    return None
