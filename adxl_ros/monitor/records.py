# SPDX-License-Identifier: Apache-2.0

"""
What a monitor leaves on disk: the record of changes, and a diagnosis of the newest samples.

A change is one line of JSON, synced before it is reported. A diagnosis runs in a process of its
own, with a budget of time; its files appear whole, and a killed run leaves those before.
"""

from __future__ import annotations

from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from datetime import datetime, UTC
from importlib import import_module
import json
import os
from pathlib import Path
import sys
import time

from adxl_ros.errors import one_line, UserError
from adxl_ros.files import parameter_file, recording
from adxl_ros.files.recording_columns import ACCEL, Recording
from adxl_ros.model.sensor import Sensor
from adxl_ros.workers import Processes
import numpy as np

NAME = 'changes.jsonl'
"""Name of the file."""
_FIRST_UTC_NS = 10 ** 18
"""Earliest stamp that is UTC, ns: September 2001. Chosen: a simulator begins at 0."""
_NICENESS = 15
"""Niceness of the process; chosen: every node of the robot has priority."""
_REASON_LENGTH = 300
"""Most characters of a reason; chosen: one line of diagnostics."""


@dataclass(frozen=True)
class GapChange:
    """A change of the residual."""

    axis: str  # x, y or z
    quantity: str  # `mean`, or `noise` for the standard deviation within a second
    since_ns: int  # Stamp of the change, ns
    detected_ns: int  # Stamp of its detection, ns
    size: float  # Change of the mean, mg; ratio of the standard deviations

    def text(self) -> str:
        """Return the change in words."""
        if self.quantity == 'mean':
            return f'{self.axis} by {self.size:+.3g} mg'
        return f'noise of {self.axis} by a factor of {self.size:.3g}'


@dataclass(frozen=True)
class DiagnosisInput:
    """What a diagnosis compares."""

    recording: Recording  # Samples, with the references of a stage
    sensor: Sensor  # The baseline
    # Times, s, (k,), and force of a simulator, m/s², (k, 3); None with a stage
    force: tuple[np.ndarray, np.ndarray] | None = None


def iso_time(stamp_ns: int) -> str:
    """Return a stamp, ns, as UTC to the second, such as 2026-11-23T05:00:00Z; else in seconds."""
    if stamp_ns < _FIRST_UTC_NS:
        return f'{stamp_ns * 1e-9:.0f} s'
    try:
        return datetime.fromtimestamp(stamp_ns // 10 ** 9, UTC).strftime('%Y-%m-%dT%H:%M:%SZ')
    except (OverflowError, ValueError, OSError):
        return f'{stamp_ns * 1e-9:.0f} s'


def append(folder: Path, change: GapChange, serial: str) -> None:
    """Append a change to the record of a folder."""
    unit = 'mg' if change.quantity == 'mean' else 'ratio'
    line = json.dumps({
        'serial': serial, 'axis': change.axis, 'quantity': change.quantity,
        'size': round(change.size, 6), 'unit': unit, 'since': iso_time(change.since_ns),
        'since_ns': change.since_ns, 'detected_ns': change.detected_ns})
    path = folder / NAME
    try:
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o644)
        try:
            # A line that a power cut has torn ends before the next one.
            size = os.fstat(file).st_size
            torn = size > 0 and os.pread(file, 1, size - 1) != b'\n'
            os.write(file, f'{chr(10) * torn}{line}\n'.encode())
            os.fsync(file)
        finally:
            os.close(file)
    except OSError as error:
        raise UserError(f'{path}: cannot write: {error.strerror}; set output to a folder that '
                        'can be written') from None


@dataclass(frozen=True)
class DiagnosisResult:
    """The end of a diagnosis."""

    is_done: bool  # Whether there is a report
    text: str  # The verdict in words, or why there is none
    report: str = ''  # Path of the page; empty without one
    effects: tuple[str, ...] = ()  # Likely effects
    probability: float = 0.0  # Probability of the verdict; 0 without one


class DiagnosisRun:
    """Runs the tool `diagnose`, a module with `main`, on some samples."""

    def __init__(self, folder: Path, given: DiagnosisInput, tool: str, budget_s: float) -> None:
        self._budget_s, self._end_s = budget_s, time.monotonic() + budget_s
        self._pool = Processes(1)
        self._end = self._pool.submit(_diagnose, folder, given, tool)
        self._pool.shutdown(wait=False)

    @property
    def result(self) -> DiagnosisResult | None:
        """Return the end; None while it runs."""
        if self._end.done():
            error = self._end.exception()
            return self._end.result() if error is None else _without(one_line(error))
        if time.monotonic() < self._end_s:
            return None
        self.close()
        return _without(f'it takes longer than diagnose.budget_s, {self._budget_s:.0f} s')

    def close(self) -> None:
        """End the process; its finished files stay."""
        self._pool.kill()


def _without(reason: str) -> DiagnosisResult:
    return DiagnosisResult(False, f'no diagnosis: {reason[:_REASON_LENGTH]}')


def _diagnose(folder: Path, given: DiagnosisInput, tool: str) -> DiagnosisResult:
    """Write recording, baseline and force, run the tool on them, and read its report."""
    os.nice(_NICENESS)
    os.environ['NO_COLOR'] = '1'
    folder.mkdir(parents=True, exist_ok=True)
    samples, baseline = folder / 'recording.csv', folder / 'baseline.yaml'
    recording.write(samples, given.recording, given.sensor)
    parameter_file.save(baseline, given.sensor)
    sys.argv = ['diagnose', str(samples), '--params', str(baseline), '-o', str(folder / 'gap')]
    if given.force is not None:
        time_s, force_mps2 = given.force
        ideal = folder / 'reference.csv'
        recording.write(ideal, Recording(str(ideal), time_s, dict(zip(ACCEL, force_mps2.T))),
                        given.sensor)
        sys.argv += ['--sim', str(ideal)]
    log = folder / 'diagnose.log'
    with open(log, 'w', encoding='utf-8') as file, redirect_stdout(file), redirect_stderr(file):
        import_module(tool).main()
    report = folder / 'gap' / 'report.json'
    if report.exists():
        return result_of(json.loads(report.read_text(encoding='utf-8')),
                         str(report.with_name('report.html')))
    lines = log.read_text(encoding='utf-8').splitlines()
    return _without(' '.join(lines[-1].split()) if lines else '')


def result_of(report: dict, page: str) -> DiagnosisResult:
    """Put a report of `diagnose` into words."""
    verdict = report['verdict']
    status, effects = verdict['status'], tuple(verdict['effects'])
    probability = float(verdict.get('probability') or 0.0)
    names = ' and '.join(effects)
    likely = tuple(effect for group in verdict.get('groups') or [] for effect in group)
    texts = {
        'explained': f'{names} ({100 * probability:.0f} %)',
        'partly': f'partly {names} ({100 * probability:.0f} %), and something else',
        'no_gap': 'no gap: the parameters explain the samples',
        'inseparable': f'one of {", ".join(likely)}: these samples cannot choose',
        'unknown': 'a cause that is not in the library',
        'insufficient': 'too little motion or time for a cause',
        'bad_data': f'a fault of the data: {verdict.get("data_fault")}'}
    return DiagnosisResult(True, texts.get(status, status), page, effects or likely, probability)
