# SPDX-License-Identifier: Apache-2.0

"""Units in which readings may be in place of m/s²."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from adxl_ros.model.constants import G0_MPS2
from adxl_ros.wording import option

_COUNTS_PER_G = [2**k for k in range(6, 19)]
"""Counts of 1 g of digital sensors: from 6 bits of ±2 g to 20 bits of ±2 g, by powers of two."""


@dataclass(frozen=True)
class ReadingUnit:
    """A unit in which readings may be in place of m/s²."""

    name: str  # For people
    gravity: float  # Number of this unit that gravity has
    conversion: str = ''  # What converts it
    # Options that state it, in place of a conversion
    options: Mapping[str, Any] = field(default_factory=dict, compare=False)

    @property
    def symbol(self) -> str:
        """Name of the unit in options and parameters; '' where it alone does not state it."""
        return self.options.get('unit', '') if len(self.options) == 1 else ''

    @property
    def remedy(self) -> str:
        """Return what states or converts it."""
        return self.conversion or f'state it by {option(**self.options)}'


READING_UNITS = (
    ReadingUnit('g', 1.0, options={'unit': 'g'}),
    ReadingUnit('mg', 1e3, options={'unit': 'mg'}),
    ReadingUnit('mm/s²', 1e3 * G0_MPS2, options={'unit': 'mmps2'}),
    ReadingUnit('cm/s²', 1e2 * G0_MPS2, 'divide the readings by 100'),
    ReadingUnit('ft/s²', G0_MPS2 / 0.3048, 'multiply the readings by 0.3048'),
    ReadingUnit('m/s² divided by 1000', 1e-3 * G0_MPS2, 'multiply the readings by 1000'),
    ReadingUnit('g divided by 1000', 1e-3, f'multiply the readings by {1e3 * G0_MPS2:g}'),
    ReadingUnit('m/s² that were stated as g', G0_MPS2**2, options={'unit': 'mps2'}),
    *(
        ReadingUnit(
            f'counts of {count} per g', float(count), options={'unit': 'lsb', 'lsb_per_g': count}
        )
        for count in _COUNTS_PER_G
    ),
)
"""Units in which readings may be, those of physics before counts."""
_OF_AXES = ('g', 'mg', 'mm/s²', 'm/s² divided by 1000')
AXIS_UNITS = [unit for unit in READING_UNITS if unit.name in _OF_AXES]
"""Units that single axes are tried in. Counts are left out: one of them fits almost any length."""
