# SPDX-License-Identifier: Apache-2.0

"""The files of an investigation."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain, count
import json
from pathlib import Path
import shlex
import shutil

from adxl_ros.diagnose import page
from adxl_ros.diagnose.diagnosis import Diagnosis
from adxl_ros.diagnose.report import as_json, screen_lines
from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file
from adxl_ros.files.atomic_write import write_text
from adxl_ros.files.recording_columns import Recording
from adxl_ros.investigate.diagnosis_round import Answer
from adxl_ros.model.sensor import Sensor

_WITHOUT_DIAGNOSIS = {'bag', 'baseline.yaml', 'answer.json'}
"""Files of an investigation that was stopped before its first diagnosis of samples."""


@dataclass(frozen=True)
class OutputFolder:
    """The folder of an investigation."""

    path: Path  # The folder

    @property
    def bag(self) -> Path:
        """Return the recording, a rosbag2 directory."""
        return self.path / 'bag'

    @property
    def baseline(self) -> Path:
        """Return the parameter file that the recording is compared with."""
        return self.path / 'baseline.yaml'

    @property
    def parameters(self) -> Path:
        """Return the parameter file with the effects that were found."""
        return self.path / 'params.yaml'

    @property
    def report(self) -> Path:
        """Return the page of the diagnosis."""
        return self.path / 'report.html'

    @property
    def answer(self) -> Path:
        """Return the newest answer, JSON."""
        return self.path / 'answer.json'

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

    def write_answer(self, answer: Answer) -> None:
        """Write the newest answer."""
        write_text(self.answer, json.dumps(answer.as_json(), indent=1, allow_nan=False) + '\n')


def write_diagnosis(folder: OutputFolder, diagnosis: Diagnosis, recording: Recording,
                    with_page: bool) -> None:
    """Write report and parameters of a diagnosis."""
    subject = (f'{folder.bag.name} ({recording.time_s[-1] - recording.time_s[0]:.0f} s, '
               f'{recording.rate_hz:.4g} Hz, {" ".join(recording.axes)})  minus  simulation of '
               f'{folder.baseline.name}')
    write_text(folder.path / 'report.json', json.dumps(
        as_json(diagnosis), indent=1, allow_nan=False) + '\n')
    parameters = ''
    if diagnosis.report is not None:
        lines = screen_lines(diagnosis, subject)
        parameters = parameter_file.as_text(diagnosis.report.sensor, lines)
        write_text(folder.parameters, parameters)
    if with_page:
        steps = [('simulate with these parameters', 'ros2 run adxl_ros simulate rich --params '
                  f'{folder.parameters} -o sim.csv')] if parameters else []
        write_text(folder.report, page.page(diagnosis, page.Run(
            subject, folder.baseline.name, steps, parameters, shlex.join(
                ['ros2', 'run', 'adxl_ros', 'diagnose', str(folder.bag), '--params',
                 str(folder.baseline), '-o', f'{folder.path}_again']))))
