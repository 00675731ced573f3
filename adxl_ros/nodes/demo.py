# SPDX-License-Identifier: Apache-2.0

"""Run the main job: a simulated sweep through the live graph."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
import json
from pathlib import Path
import subprocess
import sys
import time
from typing import NamedTuple

from adxl_ros.calibrate.fits import linear
from adxl_ros.calibrate.guided import pose_plan
from adxl_ros.calibrate.poses import Poses
from adxl_ros.calibrate.report.acceptance import acceptance_lines, screen_table
from adxl_ros.calibrate.report.held_out import HeldOutErrors, pose_errors, summarise
from adxl_ros.calibrate.result import compare, truth_table
from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file, sweep_journal
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Parameter
from adxl_ros.model.sensor import Sensor
from adxl_ros.nodes import jobs
from adxl_ros.process import ended_by_closed_output
from adxl_ros.report.screen import coloured, program_parser
from adxl_ros.wording import options_named
import numpy as np

_LONGEST_S = 600.0
"""Longest time of a step, s: twelve times the whole demonstration on two cores."""
_POLL_S = 0.2  # Time between two looks at the progress, s
_SPEED = 80.0
"""Sensor time per real time. Two cores can follow it; a slower machine takes longer, and drops no
sample. With half of it the demonstration takes twice as long."""
_RATE_HZ = 125.0
"""Rate of the simulated sensor, Hz. Its noise ends at 50 Hz, so that more samples would say no
more, and many times real time leaves room to catch up."""
_DURATION_S = 50  # Real time of the demonstration, s; measured
_PLANES_DEG = [30.0, 60.0, 90.0, 120.0, 150.0]  # Planes alpha of the sweep, degrees
_STEP_DEG = 30.0  # Step of beta in each plane, degrees
_CHECK_POSES = 16  # Number of poses that are kept out of the fit
_SEED = 203
"""Default seed of the demonstrated unit and its stage: any. It is fixed, so that the README can
state the figures."""
_STARTED = ('driver', 'stage', 'calibration')
"""Nodes of the demonstration in the order of their start."""
_UNIT_EFFECTS = {
    'bias': 0.5,
    'scale_factor': 0.5,
    'misalignment': 0.7,
    'cross_axis': 0.7,
    'cross_axis_z': 1.0,
    'scale_factor_z': 0.7,
}
"""Effects of the demonstrated unit, in multiples of their typical values: at most one, as a unit
from the shelf has."""
_SPREAD = (0.5, 1.5)
"""Range of the random factor of each coefficient of the demonstrated unit: no two are alike, and
none vanishes."""
_DELAY_S = 0.2
"""Time from a command to the motion of the stage, s. Driver and stage wait for each other once in
this time, and the samples of a longer time would overflow the shared memory."""
_QUEUE = 100_000
"""Samples that wait for a busy subscriber: 10 s of real time at the speed of the demonstration,
longer than a busy machine lets a process wait."""
_KEEPING: dict[str, object] = {'qos_overrides./imu/data_raw.publisher.depth': _QUEUE}
"""Parameters of a driver that keeps its samples until the calibration has them."""
_UNATTENDED = {
    'autostart': True,
    'screen': False,
    'qos_overrides./imu/data_raw.subscription.reliability': 'reliable',
    'qos_overrides./imu/data_raw.subscription.depth': _QUEUE,
}
"""Parameters of a calibration that nobody controls and that loses no sample: at many times real
time, a best-effort subscriber loses samples on a busy machine."""
_EXAMPLES = {'the simulated sensor': '-o demo_output'}  # Examples of arguments, by their purpose
NEXT_PAGE = 'docs/start/tilt.md'  # Page that a user reads next


def _command(name: str, params_file: Path, parameters: Mapping[str, object]) -> list[str]:
    """Return the command of a node that follows the clock of the driver."""
    command = [
        jobs.executable(name),
        '--ros-args',
        '--log-level',
        'warn',
        '--params-file',
        str(params_file),
    ]
    for key, value in {'use_sim_time': True, **parameters}.items():
        command += ['-p', f'{key}:={json.dumps(value, ensure_ascii=False, default=str)}']
    return command


def _wait(finished: Callable[[], bool], processes: Sequence[subprocess.Popen], log: Path) -> None:
    """Wait until a condition holds; a node that ends, and a time that is too long, are errors."""
    end_s = time.monotonic() + _LONGEST_S
    while not finished():
        time.sleep(_POLL_S)
        ended = [name for name, process in zip(_STARTED, processes) if process.poll() is not None]
        if ended or time.monotonic() > end_s:
            what = f'the node {ended[0]} has ended' if ended else f'no end in {_LONGEST_S:.0f} s'
            raise UserError(f'{what}; see {log}')


class _Poses(NamedTuple):
    """The poses of a journal."""

    accepted: int  # How many are accepted
    fitted: list[sweep_journal.PoseRecord]  # Those of the fit, once everything is written


def _poses(journal: Path) -> _Poses:
    """Return the poses so far."""
    with suppress(UserError):
        entries = sweep_journal.read(journal).entries
        fitted: list = []
        for entry in entries:
            if isinstance(entry, sweep_journal.Fitted):
                fitted += entry.rests or ()
        return _Poses(len(sweep_journal.accepted_poses(entries)), fitted)
    return _Poses(0, [])


@ended_by_closed_output()
@options_named()
def main() -> int:
    """Run the demonstration; return the exit status."""
    parser = program_parser(argparse.ArgumentParser, 'demo', __doc__, _EXAMPLES)
    parser.add_argument(
        '-o',
        dest='output',
        metavar='DIR',
        default='demo_output',
        type=Path,
        help='folder of pages and calibrations (default demo_output)',
    )
    parser.add_argument(
        '--seed',
        type=int,
        metavar='N',
        default=_SEED,
        help=f'seed of the simulated unit and its stage (default {_SEED})',
    )
    options = parser.parse_args()
    if not 0 <= options.seed < 2**31:
        parser.error(f'--seed: {options.seed} is not between 0 and {2**31 - 1}')
    jobs.use_own_graph()
    try:
        try:
            options.output.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(f'{options.output}: {error.strerror}') from None
        _run_sweep(options.output, options.seed)
        _print('', *file_lines({'Next': f'your own sensor: {NEXT_PAGE}'}))
    except UserError as error:
        print(f'demo: {error}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    return 0


class _Files(NamedTuple):
    """The files of a demonstration."""

    truth: Path  # The simulated unit
    nominal: Path  # What the calibration knows of it
    output: Path  # The calibration
    report: Path  # Folder of its page
    store: Path
    journal: Path
    log: Path


def _files(folder: Path, name: str) -> _Files:
    """Return the files in a folder; those of an earlier demonstration are removed."""
    output = folder / f'{name}_demo.yaml'
    files = _Files(
        truth=folder / 'simulated_unit.yaml',
        nominal=folder / 'nominal.yaml',
        output=output,
        report=folder / 'sweep',
        store=folder / 'calibrations',
        journal=output.with_name(f'{output.name}.journal'),
        log=output.with_suffix('.log'),
    )
    # Results of an earlier demonstration would pass for those of this one.
    for path in (files.output, files.journal):
        path.unlink(missing_ok=True)
    return files


def _commands(files: _Files, seed: int) -> list[list[str]]:
    """Return the commands of the nodes, in the order of `_STARTED`."""
    return [
        _command('driver', files.truth, _KEEPING | {'link.type': 'sim', 'link.speed': _SPEED}),
        _command('stage', files.nominal, {'delay_s': _DELAY_S, 'seed': seed}),
        _command(
            'calibration',
            files.nominal,
            {
                **_UNATTENDED,
                'output': files.output,
                'store': files.store,
                'report': files.report,
                'sweep.planes_deg': _PLANES_DEG,
                'sweep.step_deg': _STEP_DEG,
                'sweep.check_poses': _CHECK_POSES,
            },
        ),
    ]


def _run_sweep(folder: Path, seed: int) -> None:
    """Sweep a simulated sensor whose coefficients are drawn at datasheet spread."""
    name = parameter_file.nominal_path().stem
    files = _files(folder, name)
    nominal = replace(
        parameter_file.load(parameter_file.nominal_path()), serial='demo', rate_hz=_RATE_HZ
    )
    truth = _draw_unit(nominal, seed)
    parameter_file.save(files.nominal, nominal)
    parameter_file.save(files.truth, truth, ['The truth of the simulated unit.'])
    _print(
        f'Demo: calibrate a simulated {name.upper()} whose true coefficients are known   '
        f'({_DURATION_S} s)',
        '',
    )
    _watch(files, _commands(files, seed))
    poses = Poses.from_records(_poses(files.journal).fitted)
    fitted = parameter_file.load(files.output)
    _print(
        '',
        *screen_table(_held_out_errors(nominal, fitted, poses)),
        '',
        *truth_table(compare(fitted, truth)),
        '',
        *acceptance_lines(fitted),
        '',
        *file_lines({'Page': files.report / 'report.html', 'Calibration': files.output}),
    )


def _watch(files: _Files, commands: Sequence[Sequence[str]]) -> None:
    """Run the nodes, and show their progress, until the journal has the fitted poses."""
    total = len(
        pose_plan.guided(
            np.radians(_PLANES_DEG).tolist(), float(np.radians(_STEP_DEG)), _CHECK_POSES
        )
    )
    with files.log.open('wb') as file, jobs.running(commands, file) as nodes:
        with jobs.Step('1/3 sweep', 'starting', total) as step:

            def swept() -> bool:
                count = _poses(files.journal).accepted
                step.show(f'{count} of {total} poses', count)
                return count == total

            _wait(swept, nodes, files.log)
        fitting = f'{total - _CHECK_POSES} poses'
        with jobs.Step('2/3 fit', fitting) as step:
            _wait(files.output.exists, nodes, files.log)
            step.show(f'{fitting}, {parameter_file.load(files.output).model} model')
        with jobs.Step('3/3 check', f'{_CHECK_POSES} poses that the fit has not seen'):
            _wait(lambda: bool(_poses(files.journal).fitted), nodes, files.log)


def _draw_unit(sensor: Sensor, seed: int) -> Sensor:
    """
    Draw the coefficients of a unit: 0.5 to 1.5 times a multiple of their typical values.

    The linear cross-axis terms are part of the misalignment, as in the fits.
    """
    rng = np.random.default_rng(seed)

    def drawn(parameter: Parameter, multiple: float) -> np.ndarray:
        size = 0.0 if parameter.name == 'linear' else multiple * parameter.scale
        values = np.zeros(len(sensor.axes))
        for place, axis in enumerate(sensor.axes):
            if axis in parameter.axes:
                values[place] = size * rng.choice((-1, 1)) * rng.uniform(*_SPREAD)
        return values

    values = {}
    for name, multiple in _UNIT_EFFECTS.items():
        values[name] = {p.name: drawn(p, multiple) for p in effect_named(name).parameters}
    return replace(sensor, effects=tuple(_UNIT_EFFECTS), values=values)


def _held_out_errors(nominal: Sensor, fitted: Sensor, poses: Poses) -> list[HeldOutErrors]:
    """Return the errors of datasheet, linear and fitted coefficients on the check poses."""
    checks = poses.subset(poses.check)
    models = {
        'nominal': nominal,
        'linear': linear.fit(nominal, poses.subset(~poses.check)),
        fitted.model: fitted,
    }
    return [summarise(model, pose_errors(sensor, checks)) for model, sensor in models.items()]


def file_lines(values: dict[str, object]) -> list[str]:
    """Return one line for each value, with its name before it."""
    return [f' {name:12} {value}' for name, value in values.items()]


def _print(*lines: str) -> None:
    """Print lines; PASS and FAIL are coloured in a terminal."""
    print(*map(coloured, lines), sep='\n', flush=True)
