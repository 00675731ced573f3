# SPDX-License-Identifier: Apache-2.0
"""
Whether a verdict comes back from recordings that are simulated from it.

This is posterior simulation-based calibration (Säilynoja, Schmitt, Bürkner and Vehtari 2025,
arXiv 2502.03279): the sensor of the verdict records the same motion, with noise and with the
steps of the encoder, and the same baseline is compared with it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

from adxl_ros.diagnose.diagnosis import diagnose, Diagnosis, Report
from adxl_ros.files.recording_columns import Recording
from adxl_ros.model.constants import Z_90
from adxl_ros.model.sensor import get
from adxl_ros.simulate.motion import Motion
from adxl_ros.simulate.response import simulate
import numpy as np


def diagnose_again(
    diagnosis: Diagnosis,
    recordings: Sequence[Recording],
    sim: Motion | None,
    count: int,
    seed: int,
    show: Callable[[float], None] = lambda done: None,
) -> str:
    """Diagnose simulated recordings; say how often the verdict comes back, and its sizes."""
    report = diagnosis.report
    assert report is not None
    verdict = report.verdict
    same = 0
    held: list[bool] = []
    for i in range(count):
        first_seed = seed + 1 + i * len(recordings)
        drawn = _simulated(diagnosis, report, recordings, first_seed)
        again = diagnose(drawn, report.baseline, sim, seed).report
        if again is not None:
            found = again.verdict
            same += (found.effects, found.groups) == (verdict.effects, verdict.groups)
            held += _intervals_hold(again, report)
        show((i + 1) / count)
    text = f'self-check: {same} of {count} simulated recordings had the same verdict'
    if held:
        text += f', {sum(held)} of {len(held)} intervals held the size (90 % expected)'
    return text


def _simulated(
    diagnosis: Diagnosis, report: Report, recordings: Sequence[Recording], first_seed: int
) -> list[Recording]:
    """Simulate recordings like some by the sensor of a verdict."""
    drawn = []
    for number, (comparison, recording) in enumerate(zip(diagnosis.full_rate, recordings)):
        sensor = replace(report.sensor, rate_hz=recording.rate_hz)
        columns = simulate(sensor, comparison.motion, first_seed + number, like=recording)
        drawn.append(replace(recording, time_s=columns.pop('time_s'), columns=columns))
    return drawn


def _intervals_hold(again: Report, report: Report) -> list[bool]:
    """Say of each size that was simulated and found again whether its interval holds it."""
    if not report.verdict.closes:
        return []
    fitted = again.hypotheses[0]
    places = [
        i
        for i, name in enumerate(fitted.names)
        if name.effect in report.verdict.best and not fitted.undetermined[i]
    ]
    names = [fitted.names[i] for i in places]
    errors = np.abs(get(fitted.sensor, names) - get(report.sensor, names))
    return (errors <= Z_90 * fitted.std[places]).tolist()
