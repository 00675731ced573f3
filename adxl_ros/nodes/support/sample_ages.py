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
