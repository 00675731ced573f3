# SPDX-License-Identifier: Apache-2.0
"""What a simulator has to do to be checked, and what is found of it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np


class Simulator(ABC):
    """The arm in a simulator, free to swing."""

    library: ClassVar[str]
    """What pip calls it; its version is stated."""
    reads: ClassVar[str]
    """How the accelerometer is read, in a few words."""

    @abstractmethod
    def __init__(self) -> None:
        """Build the arm."""

    @abstractmethod
    def restart(self) -> None:
        """Reset, as a user does, and put the joints to `arm.START_RAD`, at rest."""

    @abstractmethod
    def step(self) -> None:
        """Simulate a step of `arm.STEP_S`."""

    @abstractmethod
    def angles(self) -> np.ndarray:
        """Return the angles of the joints now, rad, (3,)."""

    @abstractmethod
    def accelerometer(self) -> np.ndarray:
        """Return the reading as a user gets it now, m/s², (3,)."""


MOVED = ('attitude', 'acceleration', 'rates')
"""What may be late."""


@dataclass(frozen=True)
class Checked:
    """What was found of one accelerometer."""

    made: str  # Date, and version of this package
    simulator: str  # Library and version
    reads: str  # How it is read
    left_mg: float  # rms of what it reads minus what its joints say, mg
    verdict: str
    named: list[str]  # Effects of the verdict with sizes and intervals, or the fault
    would_show: list[str]  # Smallest sizes that would have shown
    late_ms: dict[str, list[float]]  # By what may be late: value and ends of its interval
    explained: float  # Share of the squared difference that lateness explains
    # Readings after a reset in mid-run, compared with those of a fresh start: the reading before
    # the first step, 0 where there is none, and the largest difference at once and later, mg
    at_rest_mps2: float
    at_once_mg: float
    later_mg: float
