# SPDX-License-Identifier: Apache-2.0

"""
The diagnosis of an investigation in a process of its own, so that no sample is lost meanwhile.

The process reads the bag as far as it is written, and writes its answer and the files of the
diagnosis into the folder of the investigation. It ends when its parent does.
"""

from __future__ import annotations

from dataclasses import asdict
import json
import os
from pathlib import Path
import subprocess
import sys
import tempfile
import threading
from typing import IO

from adxl_ros.errors import one_line, UserError
from adxl_ros.files import parameter_file, recording
from adxl_ros.investigate.diagnosis_round import Answer, Outcome, Question, run_round
from adxl_ros.investigate.manoeuvres import Pose, StageLimits
from adxl_ros.investigate.output_folder import OutputFolder, write_diagnosis

_NICENESS = 10
"""Niceness of the process. Chosen: the node that records comes first."""


class BackgroundDiagnoser:
    """Diagnoses in a process of its own."""

    def __init__(self, folder: OutputFolder, limits: StageLimits, seed: int) -> None:
        """Diagnose the bag of a folder."""
        self._folder, self._limits, self._seed = folder, limits, seed
        self._process: subprocess.Popen | None = None
        self._errors: IO[bytes] | None = None

    def ask(self, question: Question) -> None:
        """Start the process."""
        self._folder.answer.unlink(missing_ok=True)
        task = {'folder': str(self._folder.path), 'question': asdict(question),
                'limits': asdict(self._limits), 'seed': self._seed}
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115 (the process writes into it)
        # A session of its own: Ctrl-C in the terminal is for the node alone.
        self._process = subprocess.Popen(
            [sys.executable, '-m', __name__, json.dumps(task)], stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL, stderr=self._errors, start_new_session=True)

    def answer(self) -> Answer | None:
        """Return the answer, or None while the process runs."""
        process = self._process
        if process is None or process.poll() is None:
            return None
        last_error = self._close()
        if process.returncode:
            raise UserError(f'the diagnosis failed: {last_error}')
        return Answer.from_json(json.loads(self._folder.answer.read_text(encoding='utf-8')))

    def cancel(self) -> None:
        """Kill the process."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._close()

    def _close(self) -> str:
        """Close the pipes of the process, and return the last line of its errors."""
        assert self._process is not None and self._process.stdin and self._errors is not None
        self._process.stdin.close()
        self._errors.seek(0)
        lines = self._errors.read().decode(errors='replace').strip().splitlines()
        self._errors.close()
        self._process = None
        return lines[-1] if lines else 'no message'


def _end_with_parent() -> None:
    """End the process when its parent does, whose end of the pipe is then closed."""
    # A buffered read would hold a lock that the end of the process needs.
    while os.read(0, 1):
        pass
    os._exit(1)


def main() -> int:
    """Answer one question; the task is the argument."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    os.nice(_NICENESS)
    task = json.loads(sys.argv[1])
    folder = OutputFolder(Path(task['folder']))
    question = Question(**{**task['question'], 'pose': Pose(*task['question']['pose'])})
    limits = StageLimits(**{**task['limits'], 'alpha_rad': tuple(task['limits']['alpha_rad']),
                            'beta_rad': tuple(task['limits']['beta_rad'])})
    try:
        sensor = parameter_file.load(folder.baseline)
        recordings = [recording.read(folder.bag)] if question.has_samples else []
        answer, diagnosis = run_round(question, recordings, sensor, limits, task['seed'])
        if diagnosis is not None:
            write_diagnosis(folder, diagnosis, recordings[0],
                            with_page=answer.outcome is not Outcome.GO_ON)
        folder.write_answer(answer)
    except UserError as error:
        print(one_line(error), file=sys.stderr)
        return 1
    return 0


if __name__ == '__main__':
    sys.exit(main())
