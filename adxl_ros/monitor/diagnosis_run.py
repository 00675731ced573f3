# SPDX-License-Identifier: Apache-2.0

"""A diagnosis of the newest samples in a process of its own, with a budget of time."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
import json
import os
from pathlib import Path
import subprocess
import threading
import time

from adxl_ros.errors import one_line, UserError
from adxl_ros.files import parameter_file, recording
from adxl_ros.files.recording_columns import ACCEL, Recording
from adxl_ros.model.sensor import Sensor
import numpy as np

_NICENESS = 15
"""Niceness of the process; chosen: every node of the robot has priority."""
_POLL_S = 0.2
"""Time between two looks at the process, s; chosen."""
_REASON_LENGTH = 300
"""Most characters of a reason; chosen: one line of diagnostics."""


@dataclass(frozen=True)
class DiagnosisInput:
    """What a diagnosis compares."""

    recording: Recording  # Samples, with the references of a stage
    sensor: Sensor  # The baseline
    # Times, s, (k,), and force of a simulator, m/s², (k, 3); None with a stage
    force: tuple[np.ndarray, np.ndarray] | None = None


@dataclass(frozen=True)
class DiagnosisResult:
    """The end of a diagnosis."""

    is_done: bool  # Whether there is a report
    text: str  # The verdict in words, or why there is none
    report: str = ''  # Path of the page; empty without one
    effects: tuple[str, ...] = ()  # Likely effects
    probability: float = 0.0  # Probability of the verdict; 0 without one


class DiagnosisRun:
    """Runs the tool `diagnose`; the files appear whole, and a killed run leaves those before."""

    def __init__(self, folder: Path, given: DiagnosisInput, tool: Sequence[str], budget_s: float
                 ) -> None:
        self.result: DiagnosisResult | None = None  # The end; None while it runs
        self._folder, self._given, self._tool = folder, given, tool
        self._budget_s = budget_s
        self._is_closed = False
        self._process: subprocess.Popen[str] | None = None
        self._thread = threading.Thread(target=self._run, name='diagnosis', daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the process; its finished files stay."""
        self._is_closed = True
        process = self._process
        if process is not None:
            with suppress(ProcessLookupError):
                process.kill()
        self._thread.join()

    def _run(self) -> None:
        """Write the input, run the tool, and read its report."""
        try:
            command = [*self._tool, *self._write_input(), '-o', str(self._folder / 'gap')]
            self.result = self._finished(command)
        except (UserError, OSError, ValueError, KeyError) as error:
            reason = one_line(error)[:_REASON_LENGTH]
            self.result = DiagnosisResult(False, f'no diagnosis: {reason}')

    def _write_input(self) -> list[str]:
        """Write recording, baseline and force; return the arguments that name them."""
        given, folder = self._given, self._folder
        folder.mkdir(parents=True, exist_ok=True)
        paths = folder / 'recording.csv', folder / 'baseline.yaml'
        recording.write(paths[0], given.recording, given.sensor)
        parameter_file.save(paths[1], given.sensor)
        arguments = [str(paths[0]), '--params', str(paths[1])]
        if given.force is not None:
            time_s, force_mps2 = given.force
            ideal = folder / 'reference.csv'
            recording.write(ideal, Recording(str(ideal), time_s, dict(zip(ACCEL, force_mps2.T))),
                            given.sensor)
            arguments += ['--sim', str(ideal)]
        return arguments

    def _finished(self, command: Sequence[str]) -> DiagnosisResult:
        """Run the tool to its end, or to that of the budget."""
        environment = os.environ | {'OPENBLAS_NUM_THREADS': '1', 'NO_COLOR': '1'}
        with open(self._folder / 'diagnose.log', 'w', encoding='utf-8') as log:
            self._process = process = subprocess.Popen(
                ['nice', '-n', str(_NICENESS), *command], stdin=subprocess.DEVNULL, stdout=log,
                stderr=subprocess.STDOUT, text=True, env=environment)
            end_s = time.monotonic() + self._budget_s
            while process.poll() is None:
                if self._is_closed or time.monotonic() > end_s:
                    process.kill()
                    process.wait()
                    return DiagnosisResult(False, 'no diagnosis: it takes longer than '
                                           f'diagnose.budget_s, {self._budget_s:.0f} s')
                time.sleep(_POLL_S)
        report = self._folder / 'gap' / 'report.json'
        if not report.exists():
            lines = (self._folder / 'diagnose.log').read_text(encoding='utf-8').splitlines()
            reason = ' '.join(lines[-1].split())[:_REASON_LENGTH] if lines else ''
            return DiagnosisResult(False, f'no diagnosis: {reason}')
        return result_of(json.loads(report.read_text(encoding='utf-8')),
                         str(report.with_name('report.html')))


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
