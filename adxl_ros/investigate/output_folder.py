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

"""The files of an investigation."""

from __future__ import annotations

from dataclasses import dataclass
import json
from pathlib import Path
import shlex

from adxl_ros.diagnose import report_html, report_json, report_text
from adxl_ros.diagnose.diagnosis import Diagnosis
from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file
from adxl_ros.files.atomic_write import write_text
from adxl_ros.files.recording_columns import Recording
from adxl_ros.investigate.diagnosis_round import Answer
from adxl_ros.model.sensor import Sensor


@dataclass(frozen=True)
class OutputFolder:
    """
    The folder of an investigation.

    Attributes
    ----------
    path
        The folder.

    """

    path: Path

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

    def write_answer(self, answer: Answer) -> None:
        """Write the newest answer."""
        write_text(self.answer, json.dumps(answer.as_json(), indent=1, allow_nan=False) + '\n')


def new_folder(path: Path, sensor: Sensor) -> OutputFolder:
    """
    Make the folder of an investigation, and write the baseline into it.

    Parameters
    ----------
    path
        The folder. Where it exists, the first of `path_2`, `path_3`, ... that does not is made:
        an earlier investigation stays.
    sensor
        The baseline.

    Returns
    -------
    OutputFolder
        The folder.

    Raises
    ------
    UserError
        The folder cannot be made.

    """
    folder, number = path, 1
    while True:
        try:
            folder.mkdir(parents=True)
            break
        except FileExistsError:
            number += 1
            folder = path.with_name(f'{path.name}_{number}')
        except OSError as error:
            raise UserError(f'{folder}: cannot make the folder: {error.strerror}; set output to '
                            'another one') from None
    output = OutputFolder(folder)
    parameter_file.save(output.baseline, sensor)
    return output


def write_diagnosis(folder: OutputFolder, diagnosis: Diagnosis, recording: Recording,
                    with_page: bool) -> None:
    """
    Write report and parameters of a diagnosis.

    Parameters
    ----------
    folder
        The folder.
    diagnosis
        The diagnosis.
    recording
        The recording.
    with_page
        Whether to write the page, too.

    Raises
    ------
    UserError
        A file cannot be written.

    """
    subject = (f'{folder.bag.name} ({recording.time_s[-1] - recording.time_s[0]:.0f} s, '
               f'{recording.rate_hz:.4g} Hz, {" ".join(recording.axes)})  minus  simulation of '
               f'{folder.baseline.name}')
    write_text(folder.path / 'report.json', json.dumps(
        report_json.as_json(diagnosis), indent=1, allow_nan=False) + '\n')
    parameters = ''
    if diagnosis.sensor is not None:
        lines = report_text.screen_lines(diagnosis, subject)
        parameters = parameter_file.as_text(diagnosis.sensor, lines)
        write_text(folder.parameters, parameters)
    if with_page:
        steps = [('simulate with these parameters', 'ros2 run adxl_ros simulate rich --params '
                  f'{folder.parameters} -o sim.csv')] if parameters else []
        write_text(folder.report, report_html.page(diagnosis, report_html.Run(
            subject, folder.baseline.name, steps, parameters, shlex.join(
                ['ros2', 'run', 'adxl_ros', 'diagnose', str(folder.bag), '--params',
                 str(folder.baseline), '-o', f'{folder.path}_again']))))
