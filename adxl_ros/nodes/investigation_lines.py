# SPDX-License-Identifier: Apache-2.0

"""What an investigation shows: a line for each diagnosis, and what the stage does meanwhile."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
import shlex
import sys
from textwrap import wrap
from typing import Any

from adxl_ros.investigate.diagnosis_round import Answer, hypothesis_text, Outcome
from adxl_ros.investigate.investigation import Investigation, State, Status
from adxl_ros.investigate.manoeuvres import description, StageLimits
from adxl_ros.investigate.output_folder import OutputFolder
from adxl_ros.nodes.steps import drawable
import numpy as np

_COLUMNS = 79
"""Columns of a line."""
_TIME_COLUMNS = 11
"""Columns of the time at the beginning of a line."""
_SMALLEST_SHOWN = 0.01
"""Probability below which a hypothesis is not named. Chosen: the smallest number that is shown."""


class InvestigationScreen:
    """Prints lines; in a terminal that can draw, the last line shows what happens now."""

    def __init__(self, folder: Path, limits: StageLimits, minutes: float) -> None:
        """Print what is about to happen."""
        self._live: Any = None
        self._text = ''
        if drawable():
            from rich.console import Console
            from rich.live import Live
            self._live = Live('', console=Console(file=sys.stdout, highlight=False,
                                                  markup=False, emoji=False), transient=True)
            self._live.start()
        for line in opening_lines(folder, limits, minutes):
            self._print(line)

    def show_answer(self, minutes: float, answer: Answer) -> None:
        """Print the probabilities after a diagnosis, and what follows."""
        for line in answer_lines(minutes, answer):
            self._print(line)

    def show_status(self, status: Status) -> None:
        """Show what happens now, where the terminal can draw."""
        if self._live is None:
            return
        text = status_line(status)
        if text != self._text:
            from rich.text import Text
            self._live.update(Text(text))
            self._text = text

    def close(self) -> None:
        """Stop drawing."""
        if self._live is not None:
            self._live.stop()
            self._live = None

    def _print(self, line: str) -> None:
        if self._live is None:
            print(line, flush=True)
        else:
            self._live.console.print(line, soft_wrap=True)


def opening_lines(folder: Path, limits: StageLimits, minutes: float) -> list[str]:
    """Return what is about to happen."""
    ranges = ', '.join(f'{joint} {low:.0f} to {high:.0f}°' for joint, (low, high) in (
        ('alpha', np.degrees(limits.alpha_rad)), ('beta', np.degrees(limits.beta_rad))))
    return [f'Investigation into {folder}, {minutes:g} minutes at most',
            f'Stage within {ranges}, {np.degrees(limits.rate_rad_s):.3g}°/s', '']


def answer_lines(minutes: float, answer: Answer) -> list[str]:
    """Return the lines of one diagnosis."""
    line, rest = f'{minutes:5.1f} min ', 1.0
    for hypothesis in answer.hypotheses:
        if hypothesis.probability < _SMALLEST_SHOWN:
            break
        part = f' {hypothesis_text(hypothesis.effects)} {_percent(hypothesis.probability)} '
        other = f' others {_percent(rest - hypothesis.probability)}'
        if len(line) + len(part) + len(other) > _COLUMNS:
            break
        line, rest = line + part, rest - hypothesis.probability
    if rest >= _SMALLEST_SHOWN / 2:
        line += f' others {_percent(rest)}'
    lines = [line.rstrip()]
    if answer.outcome is Outcome.GO_ON:
        lines += _indented(f'next: {description(answer.manoeuvre)}')
    return lines


def status_line(status: Status) -> str:
    """Return one line about what happens now."""
    remaining = f', {status.remaining_s:.0f} s left' if status.state is State.MOVING else ''
    text = f'{status.minutes:5.1f} min  {status.text}'
    room = _COLUMNS - len(remaining)
    return (text if len(text) <= room else f'{text[:room - 1]}…') + remaining


def closing_lines(investigation: Investigation, folder: OutputFolder) -> list[str]:
    """Return the result, where the files are, and what to do next."""
    bag, baseline, gap, parameters = (shlex.quote(str(path)) for path in (
        folder.bag, folder.baseline, folder.path / 'gap', folder.parameters))
    diagnose = ['ros2 run adxl_ros diagnose', bag, f'--params {baseline}', f'-o {gap}']
    files = [('Report', folder.report), ('Parameters', folder.parameters), ('Bag', folder.bag)]
    named = [f' {name:11} {path}' for name, path in files if path.exists()]
    if investigation.state is State.STOPPED:
        return ['', *wrap(f'Stopped without a verdict: {investigation.reason}', _COLUMNS), '',
                *named, *(_command(diagnose) if investigation.has_moved else [])]
    answer = investigation.answers[-1][1]
    lines = ['', *wrap(answer.sentence, _COLUMNS)]
    if answer.hidden:
        lines += wrap(f'It cannot show {_listed(answer.hidden)}.', _COLUMNS)
    simulate = ['ros2 run adxl_ros simulate rich', f'--params {parameters}', '-o sim.csv']
    return [*lines, '', *named, *_command(simulate)]


def _command(words: Sequence[str]) -> list[str]:
    """Return a command for the terminal; it goes on in the next line where it is long."""
    lines = [f' {"Next":11}']
    for word in words:
        if len(lines[-1]) + len(word) + len(' \\') >= _COLUMNS:
            lines[-1] += ' \\'
            lines.append(' ' * 15)
        lines[-1] += f' {word}'
    return lines


def _percent(probability: float) -> str:
    """Return a probability in percent; 99 % stands for all below 1."""
    percent = 100 * probability
    return f'{min(percent, 99) if probability < 0.9995 else percent:.0f} %'


def _listed(names: Sequence[str]) -> str:
    return ', '.join(names[:-1]) + ' or ' * (len(names) > 1) + names[-1]


def _indented(text: str) -> list[str]:
    return [' ' * _TIME_COLUMNS + line for line in wrap(text, _COLUMNS - _TIME_COLUMNS)]
