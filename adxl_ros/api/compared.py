# SPDX-License-Identifier: Apache-2.0

"""What a diagnosis compared, for its page and for commands: what repeats it, and what is next."""

from __future__ import annotations

import os
from pathlib import Path
import shlex
from typing import NamedTuple

from adxl_ros.diagnose.diagnosis import Diagnosis
from adxl_ros.files.atomic_write import free_name
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Concern
from adxl_ros.process import command
from adxl_ros.report.screen import NextStep

PARAMETERS = 'params.yaml'  # File of the sensor with the effects that were found


class Compared(NamedTuple):
    """What was compared with what, for the page and for commands."""

    recordings: tuple[str, ...]  # Names or paths of the recordings
    params: str  # What names the sensor on a command line; '' for the nominal one
    params_name: str  # Name of its file
    sim: str  # Path of the recording of another simulator; '' for none
    sim_unit: str  # Unit of that, as it was given; '' for m/s²
    urdf: str  # Path of the robot; '' for none
    frame: str  # Its frame that carries the sensor
    subject: str  # All of it in one line

    def with_params(self, path: str) -> Compared:
        """Name the parameter file of a sensor that was given as such; '' is the usual one."""
        return self._replace(params=path, params_name=Path(path).name or self.params_name)

    def command(self, folder: str | os.PathLike) -> str:
        """
        Return the command line that repeats the diagnosis into a folder.

        RECORDING and SIMULATION stand for samples that are in no file yet.
        """
        return self._stored()._command(folder)

    def _stored(self) -> Compared:
        """Return the same with words for samples that are in no file."""
        return self._replace(
            recordings=tuple(_stored(name, 'RECORDING') for name in self.recordings),
            sim=_stored(self.sim, 'SIMULATION'),
        )

    def _command(self, folder: str | os.PathLike) -> str:
        """Return the command line of a diagnosis; options without a value are left out."""
        words = [*self.recordings]
        for option, value in {
            '--params': self.params,
            '--sim': self.sim,
            '--sim-unit': self.sim_unit,
            '--urdf': self.urdf,
            '--frame': self.frame if self.urdf else '',
            '-o': str(folder),
        }.items():
            words += [option, value] if value else []
        return command('diagnose', shlex.join(words))

    def next_steps(
        self, diagnosis: Diagnosis, folder: str | os.PathLike, is_closed: bool
    ) -> list[NextStep]:
        """
        Return what to record, how to diagnose that, and how to simulate what was found.

        folder: that of the diagnosis; is_closed: whether its effects explain a part of the gap.
        """
        report = diagnosis.report
        if report is None:
            return []
        params = str(Path(folder) / PARAMETERS)
        proposal = report.next_experiment
        steps = []
        if proposal is not None:
            simulated = f'{proposal.stem}_simulated.csv' if self.sim else ''
            both = f', and {simulated} in the simulator' if simulated else ''
            steps.append(
                NextStep(
                    f'record {proposal.stem}.csv{both}: {proposal.manoeuvre}, {proposal.why}',
                    '' if proposal.beside_simulator else proposal.command,
                )
            )
            if not proposal.concerns_reference:
                is_alone = is_closed or bool(self.sim or self.urdf)
                before = () if is_alone else self._stored().recordings
                following = self._replace(
                    recordings=(*before, f'{proposal.stem}.csv'),
                    params=params if is_closed else self.params,
                    sim=simulated,
                )
                purpose = 'diagnose it' if is_alone else 'diagnose it together with this one'
                steps.append(NextStep(purpose, following._command(f'{folder}_2')))
        if not any(effect_named(e).concern is Concern.REFERENCE for e in report.sensor.effects):
            # The folder is of the diagnosis, so that no input is replaced.
            output = str(free_name(Path(folder) / 'simulated.csv'))
            words = ['rich', '--params', params, '-o', output]
            steps.append(
                NextStep(
                    'simulate the sensor as it was found', command('simulate', shlex.join(words))
                )
            )
        return steps


def _stored(name: str, otherwise: str) -> str:
    """Return the name of a file; another word where samples are in none, '' for no samples."""
    return name if not name or Path(name).exists() else otherwise
