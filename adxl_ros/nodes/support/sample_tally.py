# SPDX-License-Identifier: Apache-2.0

"""Counts of the driver's samples, and of what went wrong with them."""

from __future__ import annotations

from typing import Any, NamedTuple

from adxl_ros.nodes.support.sample_ages import SampleAges
import numpy as np


class _Totals(NamedTuple):
    """Times and counts at one report; the next report is about the differences."""

    steady_ns: int
    sensor_ns: int
    samples: int
    missing: int
    estimated: int
    saturated: int


class Tally:
    """
    Counts samples, and what went wrong with them, between two reports.

    samples: published samples; missing: samples that are lost; estimated: part of `missing` that
    is estimated by time, not counted; saturated: samples at a rail of the ADC or beyond the
    sensor's range.
    """

    def __init__(self, steady_ns: int) -> None:
        # Sensor time up to which samples have been read, ns; None before the first one
        self.now_ns: int | None = None
        self.samples = self.missing = self.estimated = self.saturated = 0
        self.ages = SampleAges()  # Ages of the samples on publication
        self._newest_ns: int | None = None
        self._reported = _Totals(steady_ns, 0, 0, 0, 0, 0)

    def begin(self, now_ns: int) -> None:
        """Let the next report count sensor time from `now_ns`, ns."""
        self._reported = self._reported._replace(sensor_ns=now_ns)

    def count(self, stamps_ns: np.ndarray, saturated: int, missing: int, estimated: int) -> None:
        """
        Add samples.

        stamps_ns: stamps of the published ones, ns, (n,).
        """
        self.samples += len(stamps_ns)
        self.saturated += saturated
        self.missing += missing
        self.estimated += estimated
        if len(stamps_ns):
            self._newest_ns = int(stamps_ns[-1])

    def report(self, steady_ns: int, sensor_ns: int) -> tuple[dict[str, Any], str]:
        """Report what has been counted since the last report."""
        totals = _Totals(steady_ns, sensor_ns, self.samples, self.missing, self.estimated,
                         self.saturated)
        new = _Totals(*(now - before for now, before in zip(totals, self._reported)))
        self._reported = totals
        values = {'rate_hz': round(new.samples / new.sensor_ns * 1e9, 3)
                  if new.sensor_ns > 0 else 0.0,
                  'missing': self.missing, 'missing_estimated': self.estimated,
                  'saturated': self.saturated, 'samples': self.samples,
                  'speed': round(new.sensor_ns / new.steady_ns, 3) if new.steady_ns > 0 else 0.0}
        if self._newest_ns is not None:
            values['age_s'] = round((sensor_ns - self._newest_ns) * 1e-9, 6)
        values |= self.ages.report()
        estimated = f', {new.estimated} of them estimated' if new.estimated else ''
        warnings = [f'{new.missing} samples missing{estimated}'] if new.missing else []
        warnings += [f'{new.saturated} samples saturated'] if new.saturated else []
        return values, ', '.join(warnings)
