# SPDX-License-Identifier: Apache-2.0
"""
Does the verdict come back? Recordings simulated from it are diagnosed again.

This is posterior simulation-based calibration (Säilynoja, Schmitt, Bürkner and Vehtari 2025,
arXiv 2502.03279): the sensor of the verdict records the same motion, with noise and with the
steps of the encoder, and the same baseline is compared with it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from adxl_ros.diagnose.diagnosis import diagnose, Diagnosis, Report
from adxl_ros.files.recording_columns import Recording
from adxl_ros.model.coefficients import get
from adxl_ros.model.constants import Z_90
from adxl_ros.simulate.motion import Motion
from adxl_ros.simulate.response import simulate_at_stamps
import numpy as np


@dataclass(frozen=True)
class SelfCheck:
    """What diagnoses of simulated recordings said."""

    count: int  # Number of the recordings
    same: int  # How many had the same verdict: the same effects and groups, or none
    # held, sizes: How many 90 % intervals of sizes held the simulated size, of how many
    held: int
    sizes: int

    @property
    def text(self) -> str:
        """Return the result in one sentence."""
        sizes = f', {self.held} of {self.sizes} intervals held the size (90 % expected)' \
            if self.sizes else ''
        return f'self-check: {self.same} of {self.count} simulated recordings had the same ' \
               f'verdict{sizes}'


def self_check(diagnosis: Diagnosis, recordings: list[Recording], sim: Motion | None, count: int,
               seed: int, show: Callable[[float], None] = lambda done: None) -> SelfCheck:
    """Simulate recordings from a verdict, and diagnose them."""
    report = diagnosis.report
    assert report is not None
    same = held = sizes = 0
    for i in range(count):
        drawn = [_simulated(report, c.motion, recording, seed + 1 + i * len(recordings) + k)
                 for k, (c, recording) in enumerate(zip(diagnosis.full_rate, recordings))]
        again = diagnose(drawn, report.baseline, sim, seed)
        if again.report is not None:
            same += _named(again.report) == _named(report)
            inside = _inside(again.report, report)
            held, sizes = held + int(inside.sum()), sizes + len(inside)
        show((i + 1) / count)
    return SelfCheck(count, same, held, sizes)


def _simulated(report: Report, motion: Motion, recording: Recording, seed: int) -> Recording:
    """Return what the sensor of a verdict records in place of a recording."""
    sensor = replace(report.sensor, rate_hz=recording.rate_hz)
    parts = list(simulate_at_stamps(sensor, motion, recording, seed))
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    time_s = columns.pop('time_s')
    return replace(recording, time_s=time_s, columns=columns)


def _named(report: Report) -> tuple[frozenset[str], frozenset[frozenset[str]]]:
    """Return what a verdict names."""
    verdict = report.verdict
    return frozenset(verdict.effects), frozenset(map(frozenset, verdict.groups))


def _inside(again: Report, report: Report) -> np.ndarray:
    """Return which intervals of sizes hold the simulated size, (k,) bool."""
    fitted = again.verdict.best
    places = [i for i, name in enumerate(fitted.names)
              if name.effect in report.verdict.best.effects and not fitted.undetermined[i]]
    if report.verdict.status in ('no_gap', 'unknown', 'insufficient') or not places:
        return np.zeros(0, bool)
    names = [fitted.names[i] for i in places]
    return np.abs(get(fitted.sensor, names) - get(report.sensor, names)) \
        <= Z_90 * fitted.std[places]
