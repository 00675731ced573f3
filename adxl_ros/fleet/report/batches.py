# SPDX-License-Identifier: Apache-2.0

"""
Batches: units whose serial numbers begin alike, and whose coefficient is not that of the others.

Levels are compared by Welch's t test, whose chance all batches share (Bonferroni). A difference
that no one would notice is no bad batch, however certain it is.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy

MIN_GROUP = 5
"""Fewest units of a group. Chosen: fewer have nothing in common that a test could show."""
CHANCE = 0.01
"""Probability of a false group among all groups. Chosen."""


class BadBatch(NamedTuple):
    """Units with a serial number `prefix`…, and how far their mean is above that of the others."""

    prefix: str
    members: np.ndarray
    difference: float
    low: float
    high: float


def by_prefix(serials: Sequence[str]) -> dict[str, np.ndarray]:
    """Return the units whose serial numbers begin alike, (m,) bool each, by this beginning."""
    prefixes = {serial[:length] for serial in serials for length in range(1, len(serial))}
    return {prefix: np.array([serial.startswith(prefix) for serial in serials])
            for prefix in sorted(prefixes)}


def bad_batch(serials: Sequence[str], level: np.ndarray, tolerance: float, tests: int
              ) -> BadBatch | None:
    """
    Return the most certain batch whose level differs by more than a tolerance.

    serials, level: serial number and level of each unit, (m,).
    """
    # The larger part of a fleet is what the others are compared with.
    groups = {prefix: members for prefix, members in by_prefix(serials).items()
              if MIN_GROUP <= members.sum() <= len(serials) / 2}
    differing: list[tuple[float, BadBatch]] = []
    for prefix, members in groups.items():
        test = scipy.stats.ttest_ind(level[members], level[~members], equal_var=False)
        difference = float(level[members].mean() - level[~members].mean())
        if test.pvalue < CHANCE / (len(groups) * tests) and abs(difference) > tolerance:
            differing.append((float(test.pvalue), BadBatch(
                prefix, members, difference, *map(float, test.confidence_interval(0.9)))))
    return min(differing, key=lambda item: item[0])[1] if differing else None
