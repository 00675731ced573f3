# SPDX-License-Identifier: Apache-2.0

"""What the encoder of the stage has read: angles over time, its silence and its clock."""

from __future__ import annotations

from collections import deque

from adxl_ros.calibrate.guided import pose_checks
from adxl_ros.calibrate.guided.live_window import went_back
import numpy as np

_KEPT_READINGS = 100_000
"""Readings that stay in memory; chosen: 1000 s at 100 Hz, longer than a usual dwell."""
_KEPT_OFFSETS = 20
"""Offsets of the two clocks that stay in memory; chosen: a second of messages at 20 Hz."""
_FEWEST_OFFSETS = 4
"""Offsets of the two clocks that a comparison needs; chosen: one message alone may be late."""
SILENT_S = 3.0
"""The encoder counts as silent after this, s; chosen: several of its longest usual periods."""


class EncoderTrack:
    """The newest readings of the encoder, against the stamps of the samples."""

    def __init__(self) -> None:
        self._readings: deque[tuple[int, float, float]] = deque(maxlen=_KEPT_READINGS)
        self._offsets_s: deque[float] = deque(maxlen=_KEPT_OFFSETS)
        self._has_new_reading = False

    @property
    def newest_ns(self) -> int | None:
        """Return the stamp of the newest reading, ns; None without one."""
        return self._readings[-1][0] if self._readings else None

    @property
    def angles_rad(self) -> tuple[float, float] | None:
        """Return the newest angles alpha and beta, rad; None without a reading."""
        return self._readings[-1][1:] if self._readings else None

    def read(self, stamp_ns: int, alpha_rad: float, beta_rad: float) -> bool:
        """Take a reading."""
        restarted = self.newest_ns is not None and went_back(self.newest_ns, stamp_ns)
        if restarted:
            self._readings.clear()
        self._readings.append((stamp_ns, alpha_rad, beta_rad))
        self._has_new_reading = True
        return restarted

    def compare_clock(self, sample_ns: int) -> None:
        """Compare the clock of a new reading with the newest stamp of the samples, ns."""
        if self._has_new_reading:
            self._offsets_s.append((self._readings[-1][0] - sample_ns) * 1e-9)
        self._has_new_reading = False

    def forget_clock(self) -> None:
        """Forget the comparisons, since the clock of the samples has changed."""
        self._offsets_s.clear()

    def clock_fault(self) -> str:
        """Return what is wrong with the clock of the encoder, or ''."""
        if len(self._offsets_s) < _FEWEST_OFFSETS:
            return ''
        # The smallest offset is that of the message with the least delay.
        return pose_checks.clock_fault(min(self._offsets_s, key=abs))

    def silence(self, sample_ns: int) -> str:
        """Return one line on the time without readings up to a stamp, ns; '' if it is short."""
        if not self._readings:
            return 'nothing on stage/joint_states'
        silent_s = (sample_ns - self._readings[-1][0]) * 1e-9
        if silent_s <= SILENT_S:
            return ''
        return f'nothing on stage/joint_states for {silent_s:.0f} s'

    def between(self, first_ns: int, last_ns: int) -> np.ndarray:
        """
        Return the angles between two stamps.

        returns: angles alpha and beta, rad, (n, 2).
        """
        inside = [(alpha_rad, beta_rad) for stamp_ns, alpha_rad, beta_rad in self._readings
                  if first_ns <= stamp_ns <= last_ns]
        return np.array(inside).reshape(-1, 2)

    def mean_between(self, first_ns: int, last_ns: int) -> tuple[float, float]:
        """
        Average the angles between two stamps; without any, take the newest ones.

        returns: angles alpha and beta, rad.
        """
        inside = self.between(first_ns, last_ns)
        alpha_rad, beta_rad = np.mean(
            inside if len(inside) else [self._readings[-1][1:]], axis=0)
        return float(alpha_rad), float(beta_rad)
