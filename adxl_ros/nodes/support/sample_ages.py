# SPDX-License-Identifier: Apache-2.0

"""How old samples are when a node publishes them, between two reports of diagnostics."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

import numpy as np

_KEPT = 10_000
"""Newest ages that count; chosen: one second at 10 kHz, in a memory that does not grow."""


class SampleAges:
    """Ages of the newest published samples; one thread adds them, another one reports."""

    def __init__(self) -> None:
        self._ages_s: deque[float] = deque(maxlen=_KEPT)

    def add(self, ages_s: Iterable[float]) -> None:
        """Add the ages of samples that were published just now, s."""
        self._ages_s.extend(ages_s)

    def report(self) -> dict[str, float]:
        """Return median and 99th percentile since the last report, ms; nothing without samples."""
        ages_s, self._ages_s = self._ages_s, deque(maxlen=_KEPT)
        if not ages_s:
            return {}
        p50_ms, p99_ms = np.percentile(list(ages_s), [50, 99]) * 1e3
        return {'age_p50_ms': round(float(p50_ms), 3), 'age_p99_ms': round(float(p99_ms), 3)}
