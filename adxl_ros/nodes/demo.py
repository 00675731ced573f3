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

"""Run the main job: a simulated sweep, and a real recording, through the live graph."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
import math
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

from adxl_ros.calibrate.fits import gravity_fit, linear
from adxl_ros.calibrate.guided import pose_plan
from adxl_ros.calibrate.poses import Poses
from adxl_ros.calibrate.report import acceptance, against_truth, cross_validation
from adxl_ros.calibrate.report.against_truth import Comparison
from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file, recording, sweep_journal
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.effects import effect_named
from adxl_ros.model.sensor import Sensor
from adxl_ros.nodes.terminal import steps
from diagnostic_msgs.msg import DiagnosticArray
import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_srvs.srv import Trigger

_SPEED = 12.0
"""Sensor time per real time of the simulated sweep."""
_REPLAY_SPEED = 20.0
"""Sensor time per real time of a recording."""
_SWEEP_S = 1060.0
"""Sensor time of the sweep, s; measured."""
_OVERHEAD_S = 7.0
"""Real time of start, fit and report, s; measured."""
_POLL_S = 0.2
"""Time between two looks at the journal, s."""
_SILENT_S = 60.0
"""Longest time without news while poses are taken, s."""
_FIT_S = 600.0
"""Longest time of a fit, s."""
_PLANES_RAD = tuple(float(np.radians(alpha)) for alpha in (30, 60, 90, 120, 150))
"""Planes alpha of the sweep."""
_STEP_RAD = float(np.radians(30))
"""Step of beta in each plane."""
_CHECKS = 16
"""Number of poses that are kept out of the fit."""
_UNATTENDED = ('-p', 'autostart:=true', '-p', 'screen:=false')
_LOSSLESS = ('-p', 'qos_overrides./imu/data_raw.subscription.reliability:=reliable')
"""At many times real time a best-effort subscriber loses samples on a busy machine."""
_DRAWN = {'bias': 0.5, 'scale_factor': 0.5, 'misalignment': 0.7, 'cross_axis': 0.7,
          'cross_axis_z': 1.0, 'scale_factor_z': 0.7}
"""Effects of the demonstrated unit, in multiples of their typical scale."""
_MODELS = {'nominal': 'datasheet values', 'linear': 'linear calibration',
           'physical': 'physical calibration', 'full': 'full calibration'}
_LONGEST_LABEL = 26
"""Columns that a coefficient's name may take, so that its line has at most 79."""
_COLOURS = {acceptance.PASS: '\x1b[32m', acceptance.FAIL: '\x1b[31m'}
NEXT_PAGE = 'docs/guided.md'
"""Page that a user reads next."""


class Watcher(Node):
    """Reads the diagnostics of the nodes that the demonstration runs, and calls ~/finish."""

    def __init__(self) -> None:
        super().__init__('demo')
        self.reports: dict[str, dict[str, str]] = {}
        self.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 10)
        self._finish = self.create_client(Trigger, 'calibration/finish')
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = {pair.key: pair.value for pair in status.values}
            self.reports[status.name] = {'message': status.message, **values}

    def report_of(self, node: str) -> dict[str, str]:
        """Return the newest diagnostics of a node."""
        return next((values for name, values in self.reports.items() if name.startswith(node)), {})

    def watch(self, seconds: float) -> None:
        """Listen for so long."""
        self._executor.spin_once(timeout_sec=seconds)

    def finish(self) -> str:
        """Ask the calibration to fit what it has; returns its answer."""
        future = self._finish.call_async(Trigger.Request())
        self._executor.spin_until_future_complete(future, timeout_sec=_FIT_S)
        if not future.done():
            raise UserError(f'calibration/finish: no answer for {_FIT_S:g} s')
        return future.result().message


@dataclass
class Graph:
    """
    The nodes that the demonstration runs, each in a process of its own.

    Attributes
    ----------
    watcher
        Hears what they report.
    log
        File that takes what they print.

    """

    watcher: Watcher
    log: Path
    processes: dict[str, subprocess.Popen] = field(default_factory=dict)

    def start(self, name: str, params_file: Path, *arguments: str) -> None:
        """
        Start a node.

        Parameters
        ----------
        name
            Its executable.
        params_file
            Its parameter file.
        arguments
            Further ROS arguments.

        """
        command = [str(Path(sys.argv[0]).with_name(name)), '--ros-args', '--log-level', 'warn',
                   '--params-file', str(params_file), *arguments]
        with self.log.open('ab') as log:
            self.processes[name] = subprocess.Popen(command, stdout=log, stderr=log)

    def close(self) -> None:
        """End the nodes."""
        end(list(self.processes.values()))
        self.processes.clear()

    def wait(self, finished: Callable[[], bool], progress: Callable[[], object],
             silent_s: float = _SILENT_S) -> None:
        """
        Wait until a condition holds.

        Parameters
        ----------
        finished
            The condition.
        progress
            Shows how far it is, and returns what changes as long as it goes on.
        silent_s
            Longest time without a change, s.

        Raises
        ------
        UserError
            A node has ended, the fit has failed, or nothing has changed for too long.

        """
        newest: object = None
        heard_s = time.monotonic()
        while not finished():
            self.watcher.watch(_POLL_S)
            message = self.watcher.report_of('calibration').get('message', '')
            ended = [name for name, process in self.processes.items()
                     if process.poll() is not None]
            if ended:
                raise UserError(f'the node {ended[0]} has ended; see {self.log}')
            if message.startswith('cannot finish'):
                raise UserError(f'{message}; see {self.log}')
            news = (progress(), message)
            if news != newest:
                newest, heard_s = news, time.monotonic()
            if time.monotonic() - heard_s > silent_s:
                raise UserError(f'no progress for {silent_s:g} s; the calibration reported: '
                                f'{message or "nothing"}; see {self.log}')


def main() -> int:
    """Run the demonstration; returns the exit status."""
    parse = argparse.ArgumentParser(prog='demo', description=__doc__)
    parse.add_argument('-o', dest='output', metavar='DIR', default='demo_output', type=Path)
    parse.add_argument('--real', metavar='CSV', type=Path,
                       help='a three-axis recording turned by hand, calibrated too')
    parse.add_argument('--speed', type=float, default=_SPEED,
                       help=f'sensor time per real time (default {_SPEED:g})')
    options = parse.parse_args()
    # A graph of its own: the demonstration must not move a robot that shares the network.
    os.environ.setdefault('ROS_DOMAIN_ID', str(60 + os.getpid() % 40))
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    try:
        # A recording that cannot be read is refused before the sweep.
        length_s = 0.0 if options.real is None else \
            float(np.ptp(recording.read(options.real).time_s))
        options.output.mkdir(parents=True, exist_ok=True)
        _simulated(options.output, options.speed)
        if options.real is not None:
            _real(options.output, options.real, length_s)
        _print('', *file_lines({'Next': f'your own sensor: {NEXT_PAGE}'}))
    except UserError as error:
        print(f'demo: {error}', file=sys.stderr)
        return 1
    except OSError as error:
        print(f'demo: {options.output}: {error.strerror}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    return 0


def _simulated(folder: Path, speed: float) -> None:
    """Sweep a simulated sensor whose coefficients are drawn at datasheet spread."""
    unit, nominal = folder / 'simulated_unit.yaml', folder / 'nominal.yaml'
    sensor = replace(parameter_file.load(parameter_file.nominal_path()), serial='demo')
    truth = _drawn(sensor)
    parameter_file.save(nominal, sensor)
    parameter_file.save(unit, truth, ['The truth of the simulated unit.'])
    sensor_name = parameter_file.nominal_path().stem
    output, report = folder / f'{sensor_name}_demo.yaml', folder / 'sweep'
    _print(title(f'Demo: calibrate a simulated {sensor_name.upper()} whose true coefficients '
                 'are known',
                 _SWEEP_S / speed + _OVERHEAD_S), '')
    _fresh(output)
    clock = ('-p', 'use_sim_time:=true')
    with _graph(folder / 'sweep.log') as graph:
        graph.start('driver', unit, '-p', f'link.speed:={speed}', *clock)
        graph.start('stage', nominal, *clock)
        graph.start('calibration', nominal, *clock, *_LOSSLESS, *_UNATTENDED, *_plan(),
                    '-p', f'output:={output}', '-p', f'report:={report}',
                    '-p', f'store:={folder / "calibrations"}')
        poses = _sweep(graph, output)
    fitted, held_out = parameter_file.load(output), poses.subset(poses.check)
    models = {'nominal': sensor, 'linear': linear.fit(sensor, poses.subset(~poses.check)),
              fitted.model: fitted}
    errors = [cross_validation.summarise(model,
                                         cross_validation.pose_errors(calibrated, held_out))
              for model, calibrated in models.items()]
    _print('', *error_table(errors), '', *truth_table(against_truth.compare(fitted, truth)), '',
           *verdict_lines(fitted), *added_lines(against_truth.added_effects(fitted, truth)), '',
           *file_lines({'Page': report / 'report.html', 'Calibration': output}))


def _sweep(graph: Graph, output: Path) -> Poses:
    """Show the sweep, the fit and the check while they run; return the poses."""
    path = _journal(output)
    total = len(pose_plan.guided(_PLANES_RAD, _STEP_RAD, _CHECKS))
    with steps.step('1/3 sweep', 'starting', total) as step:
        def taken() -> int:
            count = len(_poses(path))
            if count:
                step.show(f'{count} of {total} poses', count)
            return count

        graph.wait(lambda: taken() == total, taken)
    fitting = f'{total - _CHECKS} poses'
    with steps.step('2/3 fit', fitting) as step:
        graph.wait(output.exists, lambda: None, _FIT_S)
        step.show(f'{fitting}, {parameter_file.load(output).model} model')
    with steps.step('3/3 check', f'{_CHECKS} poses that the fit has not seen'):
        graph.wait(lambda: bool(_fitted_poses(path)), lambda: None, _FIT_S)
        graph.close()
    return Poses.from_records(_fitted_poses(path))


def _real(folder: Path, path: Path, length_s: float) -> None:
    """Calibrate a recorded sensor against gravity, replayed through the graph."""
    output, report = folder / f'{path.stem}.yaml', folder / path.stem
    _print('', title(f'Real recording {path.name}: a sensor turned by hand',
                     length_s / _REPLAY_SPEED + _OVERHEAD_S), '')
    clock = ('-p', 'use_sim_time:=true')
    _fresh(output)
    with _graph(folder / f'{path.stem}.log') as graph:
        graph.start('calibration', parameter_file.nominal_path(), *clock, *_LOSSLESS, *_UNATTENDED,
                    '-p', 'mode:=gravity', '-p', f'output:={output}', '-p', f'report:={report}',
                    '-p', f'store:={folder / "calibrations"}')
        graph.start('driver', parameter_file.nominal_path(), '-p', 'link.type:=replay',
                    '-p', f'link.recording:={path}', '-p', f'link.speed:={_REPLAY_SPEED}', *clock)
        with steps.step('1/2 replay', 'starting') as step:
            def rests() -> int:
                count = len(_poses(_journal(output)))
                if count:
                    step.show(f'{count} rests')
                return count

            def replayed() -> bool:
                return graph.watcher.report_of('driver').get('link_state') == 'ended'

            graph.wait(replayed, rests)
        with steps.step('2/2 fit', f'{rests()} rests') as step:
            answer = graph.watcher.finish()
            if not output.exists():
                raise UserError(f'{path}: {answer}')
            poses = Poses.from_records(_fitted_poses(_journal(output)))
            step.show(f'{len(poses)} rests, magnitude of gravity')
            graph.close()
    fitted = parameter_file.load(output)
    nominal = replace(fitted.without_covariance(), effects=(), values={})
    _print('', *gravity_lines(gravity_fit.fit_gravity(poses.volts, poses.std_v, nominal)), '',
           *file_lines({'Page': report / 'report.html', 'Calibration': output}))


def title(text: str, seconds: float) -> str:
    """
    Return a title with the time that its part takes.

    Parameters
    ----------
    text
        The title.
    seconds
        The time, s.

    """
    takes = f'{seconds / 60:.0f} min' if seconds >= 90 else f'{math.ceil(seconds / 10) * 10} s'
    return f'{text}   ({takes})'


def error_table(models: Sequence[cross_validation.HeldOutErrors]) -> list[str]:
    """Lay out the errors of the models on held-out poses; the file holds the last model."""
    lines = [f' {"":24}tilt error     acceleration error     (rms)']
    lines += [f' {_MODELS[errors.model]:22} {_three_digits(errors.tilt_deg.rms):>9} ° '
              f'{_three_digits(errors.accel_mg.rms):>18} mg' for errors in models]
    lines[-1] += '           <- saved'
    return lines


def _three_digits(value: float) -> str:
    """Write a value so that the decimal points of a right-aligned column stand in one line."""
    if np.isnan(value):
        return '-   '
    decimals = 1 if value >= 10 else 2 if value >= 1 else 3
    return f'{value:.{decimals}f}'.ljust(len(f'{value:.3f}'))


def truth_table(compared: Sequence[Comparison]) -> list[str]:
    """Lay out each fitted coefficient beside the true one, in 79 columns."""
    width = min(max((len(row.label) for row in compared), default=0) + 1, _LONGEST_LABEL)
    width = max(width, len('coefficient'))
    lines = [f' {"coefficient":{width}}     fitted (90 %) {"":16}true']
    for row in compared:
        decimals = _decimals(row.half_width)
        fitted, half, truth = (f'{round(value, decimals) + 0.0:.{decimals}f}'
                               for value in (row.fitted, row.half_width, row.truth))
        truth = '0' if row.truth == 0 else truth
        lines.append(f' {row.label[:width]:{width}} {row.axis:1} {fitted:>10} ± {half:8} '
                     f'{row.unit:5} {truth:>10}   {"ok" if row.inside else "MISSED"}')
    inside = sum(row.inside for row in compared)
    return [*lines, f' ({inside} of {len(compared)} inside their 90 % intervals; about '
            f'{0.9 * len(compared):.0f} are expected)']


def _decimals(half_width: float) -> int:
    """Return how many decimals show two digits of an interval."""
    if not half_width > 0:
        return 4
    exponent = int(f'{half_width:.1e}'.partition('e')[2])
    return min(max(1 - exponent, 0), 7)


def verdict_lines(fitted: Sensor) -> list[str]:
    """Say whether the calibration is as good as the datasheet, with figure, limit and meaning."""
    figures = fitted.provenance
    if 'own_accel_mg' not in figures:
        return [f' {acceptance.NOT_SHOWN}  no pose was kept out of the fit to judge it']
    error_mg = float(figures['own_accel_mg'])
    limit = f'{1e3 * acceptance.nonlinearity_mps2(fitted) / G0_MPS2:.2g} mg'
    accel, tilt = (figures.get(f'verdict_{name}', '') for name in ('datasheet', 'tilt_datasheet'))
    shown = f'calibration error {error_mg:#.2g} mg; the datasheet allows {limit}'
    if acceptance.FAIL in (accel, tilt):
        if accel != acceptance.FAIL:
            shown = f'tilt error {float(figures["own_tilt_deg"]):.2g}°, more than {limit} causes'
        return [f' {acceptance.FAIL}  {shown}',
                '       The sensor is worse than its datasheet states: do not use this file.']
    if acceptance.NOT_SHOWN in (accel, tilt):
        return [f' {acceptance.NOT_SHOWN}  {shown}',
                '            The check poses are too few to show that the limit is kept.']
    return [f' {acceptance.PASS}  {shown}']


def added_lines(effects: Sequence[str]) -> list[str]:
    """Name each effect that the fit has and the simulated unit has not."""
    return [f'       The fit has the term {effect}, which this unit does not have.'
            for effect in effects]


def gravity_lines(fit: gravity_fit.GravityFit) -> list[str]:
    """Lay out the errors of a calibration against gravity, before and after."""
    kept = np.setdiff1d(np.arange(len(fit.before_mps2)), fit.outliers)
    before, after, held_out = (
        _three_digits(1e3 * float(np.sqrt(np.mean(values[kept] ** 2))) / G0_MPS2)
        for values in (fit.before_mps2, fit.residual_mps2, fit.leave_one_out_mps2))
    lines = [f' error of the magnitude of gravity, rms over {len(kept)} rests',
             f' {"datasheet values":22} {before:>9} mg',
             f' {"gravity calibration":22} {after:>9} mg   '
             f'(on held-out rests {held_out.strip()} mg)    <- saved']
    if fit.outliers:
        count = len(fit.outliers)
        lines.append(f' {count} disturbed {"rest was" if count == 1 else "rests were"} left out')
    return lines


def file_lines(named: dict[str, object]) -> list[str]:
    """Lay out the files that are written, and what to do next."""
    return [f' {name:12} {value}' for name, value in named.items()]


def _print(*lines: str) -> None:
    """Print lines; a verdict is coloured in a terminal."""
    for line in lines:
        word = line.split()[0] if line.split() else ''
        if word in _COLOURS and steps.drawable() and 'NO_COLOR' not in os.environ:
            line = line.replace(word, f'{_COLOURS[word]}{word}\x1b[0m', 1)
        print(line, flush=True)


def _drawn(sensor: Sensor) -> Sensor:
    rng = np.random.default_rng(203)
    values = {name: {p.name: np.array([
        spread * p.scale * rng.choice((-1, 1)) * rng.uniform(0.5, 1.5) if a in p.axes else 0.0
        for a in sensor.axes]) for p in effect_named(name).parameters}
        for name, spread in _DRAWN.items()}
    return replace(sensor, effects=tuple(_DRAWN), values=values)


def _plan() -> tuple[str, ...]:
    planes = ', '.join(str(alpha) for alpha in _PLANES_RAD)
    return ('-p', f'sweep.planes_rad:=[{planes}]', '-p', f'sweep.step_rad:={_STEP_RAD}',
            '-p', f'sweep.check_poses:={_CHECKS}')


def _journal(output: Path) -> Path:
    return output.with_name(f'{output.name}.journal')


def _poses(path: Path) -> list[sweep_journal.PoseRecord]:
    """Return the poses that a journal has so far."""
    return sweep_journal.accepted_poses(_entries(path))


def _fitted_poses(path: Path) -> list[sweep_journal.PoseRecord]:
    """Return the poses that were fitted; the journal has them when everything is written."""
    fits = [entry for entry in _entries(path) if isinstance(entry, sweep_journal.Fitted)]
    return list(fits[0].rests or ()) if fits else []


def _entries(path: Path) -> list[sweep_journal.JournalEntry]:
    try:
        return sweep_journal.read(path)[1]
    except UserError:
        # Its head is not written yet.
        return []


def _fresh(output: Path) -> None:
    """Remove what an earlier demonstration left, so that this one's result can be told."""
    for path in (output, _journal(output)):
        path.unlink(missing_ok=True)


@contextmanager
def _graph(log: Path) -> Iterator[Graph]:
    """Make a graph without nodes; end its nodes at the end."""
    log.unlink(missing_ok=True)
    rclpy.init(args=[])
    graph = Graph(Watcher(), log)
    try:
        yield graph
    finally:
        graph.watcher.destroy_node()
        rclpy.try_shutdown()
        graph.close()


def end(processes: Sequence[subprocess.Popen]) -> None:
    """Interrupt processes, and kill those that do not end within 10 s."""
    for process in processes:
        process.send_signal(signal.SIGINT)
    for process in processes:
        try:
            process.wait(10)
        except subprocess.TimeoutExpired:
            process.kill()
