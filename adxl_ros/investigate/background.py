# SPDX-License-Identifier: Apache-2.0

"""
The files of an investigation, and its diagnosis in a process of its own.

No sample is lost meanwhile. The process reads the bag as far as it is written, and writes its
answer and the files of the diagnosis into the folder of the investigation. It ends when its parent
does.
"""

from __future__ import annotations

from concurrent.futures import Future
from itertools import chain, count
import json
import os
from pathlib import Path
import shlex
import shutil
from typing import Any

from adxl_ros.diagnose import page
from adxl_ros.diagnose.diagnosis import Diagnosis
from adxl_ros.diagnose.report import as_json, screen_lines
from adxl_ros.errors import one_line, UserError
from adxl_ros.files import parameter_file, recording as recording_files
from adxl_ros.files.atomic_write import write_text
from adxl_ros.files.recording_columns import Recording
from adxl_ros.investigate.diagnosis_round import Answer, Outcome, Question, run_round
from adxl_ros.investigate.manoeuvres import StageLimits
from adxl_ros.model.sensor import Sensor
from adxl_ros.workers import Processes

_NICENESS = 10
"""Niceness of the process. Chosen: the node that records comes first."""
_WITHOUT_DIAGNOSIS = {'bag', 'baseline.yaml', 'answer.json'}
"""Files of an investigation that was stopped before its first diagnosis of samples."""


class OutputFolder:
    """The folder of an investigation."""

    def __init__(self, path: Path) -> None:
        self.path = path  # The folder
        self.bag = path / 'bag'  # The recording, a rosbag2 directory
        self.baseline = path / 'baseline.yaml'  # What the recording is compared with
        self.parameters = path / 'params.yaml'  # The parameters with the effects that were found
        self.report = path / 'report.html'  # The page of the diagnosis
        self.answer = path / 'answer.json'  # The newest answer

    @staticmethod
    def free(path: Path) -> OutputFolder:
        """Return the first of `path`, `path_2`, ... that has nothing, or no diagnosis yet."""
        candidates = chain([path], (path.with_name(f'{path.name}_{n}') for n in count(2)))
        return next(OutputFolder(p) for p in candidates if not p.exists() or (
            p.is_dir() and {child.name for child in p.iterdir()} <= _WITHOUT_DIAGNOSIS))

    def make(self, sensor: Sensor) -> None:
        """Make the folder, and write the baseline; an investigation without diagnosis goes."""
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            if self.bag.exists():
                shutil.rmtree(self.bag)
        except OSError as error:
            raise UserError(f'{self.path}: cannot make the folder: {error.strerror}; set output '
                            'to another one') from None
        parameter_file.save(self.baseline, sensor)


def _write_diagnosis(folder: OutputFolder, diagnosis: Diagnosis, recording: Recording,
                     with_page: bool) -> None:
    """Write report and parameters of a diagnosis."""
    subject = (f'{folder.bag.name} ({recording.time_s[-1] - recording.time_s[0]:.0f} s, '
               f'{recording.rate_hz:.4g} Hz, {" ".join(recording.axes)})  minus  simulation of '
               f'{folder.baseline.name}')
    write_text(folder.path / 'report.json', _as_text(as_json(diagnosis)))
    parameters = ''
    if diagnosis.report is not None:
        parameters = parameter_file.as_text(diagnosis.report.sensor,
                                            screen_lines(diagnosis, subject))
        write_text(folder.parameters, parameters)
    if with_page:
        steps = [('simulate with these parameters', 'ros2 run adxl_ros simulate rich --params '
                  f'{folder.parameters} -o sim.csv')] if parameters else []
        command = shlex.join(['ros2', 'run', 'adxl_ros', 'diagnose', str(folder.bag), '--params',
                              str(folder.baseline), '-o', f'{folder.path}_again'])
        write_text(folder.report, page.page(diagnosis, page.Run(
            subject, folder.baseline.name, steps, parameters, command)))


def _as_text(values: dict[str, Any]) -> str:
    return json.dumps(values, indent=1, allow_nan=False) + '\n'


class BackgroundDiagnoser:
    """Diagnoses the bag of a folder in a process of its own."""

    def __init__(self, folder: OutputFolder, limits: StageLimits, seed: int) -> None:
        self._folder, self._limits, self._seed = folder, limits, seed
        self._pool: Processes | None = None
        self._answer: Future | None = None

    def ask(self, question: Question) -> None:
        """Start the process."""
        self._folder.answer.unlink(missing_ok=True)
        self._pool = Processes(1)
        self._answer = self._pool.submit(_diagnose, self._folder, question, self._limits,
                                         self._seed)
        self._pool.shutdown(wait=False)

    def answer(self) -> Answer | None:
        """Return the answer, or None while the process runs."""
        if self._answer is None or not self._answer.done():
            return None
        ended, self._answer = self._answer, None
        try:
            return ended.result()
        except Exception as error:
            raise UserError(f'the diagnosis failed: {one_line(error)}') from error

    def cancel(self) -> None:
        """End the process."""
        if self._pool is not None and self._answer is not None:
            self._pool.kill()


def _diagnose(folder: OutputFolder, question: Question, limits: StageLimits, seed: int) -> Answer:
    """Answer one question, and write the answer and the files of its diagnosis."""
    os.nice(_NICENESS)
    sensor = parameter_file.load(folder.baseline)
    recordings = [recording_files.read(folder.bag)] if question.has_samples else []
    answer, diagnosis = run_round(question, recordings, sensor, limits, seed)
    if diagnosis is not None:
        _write_diagnosis(folder, diagnosis, recordings[0],
                         with_page=answer.outcome is not Outcome.GO_ON)
    write_text(folder.answer, _as_text(answer.as_json()))
    return answer
