# SPDX-License-Identifier: Apache-2.0
"""Faults of the data that make a diagnosis meaningless."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from adxl_ros.diagnose.comparison import BaselineComparison

DATA_FAULTS = {
    'axis_inverted': 'an axis has the opposite sign',
    'axis_swapped': 'two axes are swapped',
    'clock_drift': 'two clocks drift apart by more than one shift corrects',
    'clock_jump': 'a clock steps or runs backwards',
    'constant': 'an axis does not change',
    'encoder_sign': 'an angle has the opposite sign',
    'gravity': 'gravity is missing at rest, as in linear acceleration',
    'missing': 'many samples are no numbers',
    'no_overlap': 'the reference has no time in common with the recording',
    'reference': 'the reference is wrong, of another motion, or missing',
    'saturated': 'many samples are at the end of the range',
    'time_misaligned': 'one shift in time is needed that is no latency',
    'too_short': 'too little can be compared; the status is insufficient',
    'unit': 'readings, angles or stamps are in another unit',
}
"""Faults of the data by name, with their meaning."""


@dataclass(eq=False)
class DataFault(Exception):
    """A fault of the recording, with the recordings whose notes say more."""

    name: str  # Name in the report, `verdict.data_fault`: one of `DATA_FAULTS`
    message: str  # What is wrong and what to do, one line
    status: str = 'bad_data'  # Status of the verdict: 'bad_data' or 'insufficient'
    comparisons: tuple[BaselineComparison, ...] = ()

    def __post_init__(self) -> None:
        assert self.name in DATA_FAULTS, 'a fault has a meaning for reports'

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy and pickle it, which exceptions with names do not by themselves."""
        return DataFault, (self.name, self.message, self.status, self.comparisons)
