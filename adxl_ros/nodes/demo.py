# SPDX-License-Identifier: Apache-2.0

"""Run the main job: a simulated sweep, and a real recording, through the live graph."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
import math
import os
from pathlib import Path
import subprocess
import sys
import time

from adxl_ros.calibrate.fits import gravity_fit, linear
from adxl_ros.calibrate.guided import pose_plan
from adxl_ros.calibrate.poses import Poses
from adxl_ros.calibrate.report import acceptance, held_out as unseen
from adxl_ros.calibrate.report.acceptance import acceptance_lines, error_table, gravity_lines
from adxl_ros.calibrate.report.coefficients import added_effect_lines, compare, truth_table
from adxl_ros.closed_output import ended_by_closed_output
from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file, recording, sweep_journal
from adxl_ros.model.effects import effect_named
from adxl_ros.model.sensor import Sensor
from adxl_ros.nodes import steps
from adxl_ros.nodes.node_help import program_parser
from adxl_ros.nodes.run_node import executable, stop, use_own_graph
from diagnostic_msgs.msg import DiagnosticArray
import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_srvs.srv import Trigger

FIT_S = 600.0
"""Longest time of a fit, s; chosen: far above the seconds that a fit takes."""
_POLL_S = 0.2
"""Time between two looks at the progress, s."""
_SILENT_S = 60.0
"""Longest time without progress while poses are taken, s; chosen: a pose takes 1 s."""


class DemoGraph:
    """The nodes that the demonstration runs, each in a process of its own."""

    def __init__(self, log: Path) -> None:
        self._log = log
        self._processes: dict[str, subprocess.Popen] = {}
        # Newest message and values, by the name of the diagnostic status
        self._reports: dict[str, dict[str, str]] = {}
        self._node = Node('demo')
        self._node.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 10)
        self._finish = self._node.create_client(Trigger, 'calibration/finish')
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            values = {pair.key: pair.value for pair in status.values}
            self._reports[status.name] = {'message': status.message, **values}

    def report_of(self, node: str) -> dict[str, str]:
        """Return the newest diagnostics of a node."""
        return next((values for name, values in self._reports.items() if name.startswith(node)),
                    {})

    def finish(self) -> str:
        """Let the calibration fit what it has; return its answer."""
        future = self._finish.call_async(Trigger.Request())
        self._executor.spin_until_future_complete(future, timeout_sec=FIT_S)
        answer = future.result() if future.done() else None
        if answer is None:
            raise UserError(f'calibration/finish: no answer for {FIT_S:g} s')
        return answer.message

    def start(self, name: str, params_file: Path, *arguments: str) -> None:
        """Start a node."""
        command = [executable(name), '--ros-args', '--log-level', 'warn', '--params-file',
                   str(params_file), *arguments]
        with self._log.open('ab') as log:
            self._processes[name] = subprocess.Popen(command, stdout=log, stderr=log)

    def close(self) -> None:
        """End the nodes."""
        stop(list(self._processes.values()))
        self._processes.clear()

    def wait(self, finished: Callable[[], bool], progress: Callable[[], object],
             silent_s: float = _SILENT_S) -> None:
        """Wait until a condition holds."""
        newest: object = None
        changed_s = time.monotonic()
        while not finished():
            self._executor.spin_once(timeout_sec=_POLL_S)
            message = self._check_nodes()
            news = (progress(), message)
            if news != newest:
                newest, changed_s = news, time.monotonic()
            if time.monotonic() - changed_s > silent_s:
                raise UserError(f'no progress for {silent_s:g} s; the calibration reported: '
                                f'{message or "nothing"}; see {self._log}')

    def _check_nodes(self) -> str:
        """Return what the calibration reports; refuse a node that has ended or a failed fit."""
        message = self.report_of('calibration').get('message', '')
        ended = [name for name, process in self._processes.items() if process.poll() is not None]
        if ended:
            raise UserError(f'the node {ended[0]} has ended; see {self._log}')
        if message.startswith('cannot finish'):
            raise UserError(f'{message}; see {self._log}')
        return message


@contextmanager
def open_graph(log: Path) -> Iterator[DemoGraph]:
    """Yield a graph without nodes, and end the nodes that were started in it."""
    log.unlink(missing_ok=True)
    rclpy.init(args=[])
    graph = DemoGraph(log)
    try:
        yield graph
    finally:
        rclpy.try_shutdown()
        graph.close()


_SPEED = 40.0
"""Default sensor time per real time of the simulated sweep; chosen: two cores can follow."""
_REPLAY_SPEED = 40.0
"""Sensor time per real time of a recording; chosen: two cores can follow."""
_SWEEP_S = 1060.0
"""Sensor time of the sweep, s; measured."""
_OVERHEAD_S = 15.0
"""Real time of start, fit and report, s; measured."""
_PLANES_DEG = [30.0, 60.0, 90.0, 120.0, 150.0]
"""Planes alpha of the sweep, degrees."""
_STEP_DEG = 30.0
"""Step of beta in each plane, degrees."""
_CHECK_POSES = 16
"""Number of poses that are kept out of the fit."""
_PLAN = ('-p', f'sweep.planes_deg:={_PLANES_DEG}', '-p', f'sweep.step_deg:={_STEP_DEG}',
         '-p', f'sweep.check_poses:={_CHECK_POSES}')
"""Arguments of the calibration for these poses."""
_SEED = 203
"""Default seed of the demonstrated unit and its stage; chosen."""
_UNIT_EFFECTS = {'bias': 0.5, 'scale_factor': 0.5, 'misalignment': 0.7, 'cross_axis': 0.7,
                 'cross_axis_z': 1.0, 'scale_factor_z': 0.7}
"""Effects of the demonstrated unit, in multiples of their typical values; chosen."""
_SPREAD = (0.5, 1.5)
"""Range of the random factor of each coefficient of the demonstrated unit; chosen."""
_DELAY = ('-p', 'delay_s:=0.2')
"""Arguments of a stage that moves 0.2 s after a command. Chosen: driver and stage wait for each
other once in this time, and the samples of a longer time would overflow the shared memory."""
_SIM_TIME = ('-p', 'use_sim_time:=true')
"""Arguments of a node that follows the driver's clock."""
_UNATTENDED = ('-p', 'autostart:=true', '-p', 'screen:=false')
"""Arguments of a calibration that nobody controls."""
_QUEUE = 100_000
"""Samples that wait for a busy subscriber; chosen: 2.5 s of real time at the default
speed, longer than a busy machine lets a process wait."""
_KEEPING = ('-p', f'qos_overrides./imu/data_raw.publisher.depth:={_QUEUE}')
"""Arguments of a driver that keeps its samples until the calibration has them."""
_LOSSLESS = ('-p', 'qos_overrides./imu/data_raw.subscription.reliability:=reliable',
             '-p', f'qos_overrides./imu/data_raw.subscription.depth:={_QUEUE}')
"""Arguments of a calibration that loses no sample: at many times real time, a best-effort
subscriber loses samples on a busy machine."""
_COLOURS = {acceptance.PASS: '\x1b[32m', acceptance.FAIL: '\x1b[31m'}
"""Green and red by the word that they colour, as codes of xterm."""
_NO_COLOUR = '\x1b[0m'
"""Code of xterm that ends a colour."""
_EXAMPLES = {'the simulated sensor': '-o demo_output',
             'a real recording, too': '--real imu.csv -o demo_output'}
"""Examples of arguments, by their purpose."""
NEXT_PAGE = 'docs/start/tilt.md'
"""Page that a user reads next."""


@ended_by_closed_output()
def main() -> int:
    """Run the demonstration; return the exit status."""
    parser = program_parser('demo', __doc__, _EXAMPLES)
    parser.add_argument('-o', dest='output', metavar='DIR', default='demo_output', type=Path,
                        help='folder of pages and calibrations (default demo_output)')
    parser.add_argument('--real', metavar='CSV', type=Path,
                        help='a three-axis recording turned by hand, calibrated too')
    parser.add_argument('--speed', type=float, default=_SPEED,
                        help=f'sensor time per real time (default {_SPEED:g})')
    parser.add_argument('--seed', type=int, default=_SEED,
                        help=f'seed of the simulated unit and its stage (default {_SEED})')
    options = parser.parse_args()
    if not 0 <= options.seed < 2 ** 31:
        parser.error(f'--seed: {options.seed} is not between 0 and {2 ** 31 - 1}')
    use_own_graph()
    try:
        # A recording that cannot be read is refused before the sweep.
        length_s = 0.0 if options.real is None else \
            float(np.ptp(recording.read(options.real).time_s))
        options.output.mkdir(parents=True, exist_ok=True)
        _run_sweep(options.output, options.speed, options.seed)
        if options.real is not None:
            _run_recording(options.output, options.real, length_s)
        _print('', *file_lines({'Next': f'your own sensor: {NEXT_PAGE}'}))
    except UserError as error:
        print(f'demo: {error}', file=sys.stderr)
        return 1
    except BrokenPipeError:
        raise
    except OSError as error:
        print(f'demo: {options.output}: {error.strerror}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    return 0


def _run_sweep(folder: Path, speed: float, seed: int) -> None:
    """Sweep a simulated sensor whose coefficients are drawn at datasheet spread."""
    unit, nominal = folder / 'simulated_unit.yaml', folder / 'nominal.yaml'
    sensor = replace(parameter_file.load(parameter_file.nominal_path()), serial='demo')
    truth = _draw_unit(sensor, seed)
    parameter_file.save(nominal, sensor)
    parameter_file.save(unit, truth, ['The truth of the simulated unit.'])
    name = parameter_file.nominal_path().stem
    output, report = folder / f'{name}_demo.yaml', folder / 'sweep'
    _print(title(f'Demo: calibrate a simulated {name.upper()} whose true coefficients are known',
                 _SWEEP_S / speed + _OVERHEAD_S), '')
    _remove_results(output)
    with open_graph(folder / 'sweep.log') as graph:
        graph.start('driver', unit, '-p', 'link.type:=sim', '-p', f'link.speed:={speed}',
                    *_SIM_TIME, *_KEEPING)
        graph.start('stage', nominal, *_SIM_TIME, *_DELAY, '-p', f'seed:={seed}')
        graph.start('calibration', nominal, *_SIM_TIME, *_LOSSLESS, *_UNATTENDED,
                    *_PLAN, *_output_arguments(output, report))
        poses = _show_sweep(graph, output)
    fitted = parameter_file.load(output)
    _print('', *error_table(_held_out_errors(sensor, fitted, poses)), '',
           *truth_table(compare(fitted, truth)), '', *acceptance_lines(fitted),
           *added_effect_lines(fitted, truth), '',
           *file_lines({'Page': report / 'report.html', 'Calibration': output}))


def _draw_unit(sensor: Sensor, seed: int) -> Sensor:
    """
    Draw the coefficients of a unit: 0.5 to 1.5 times a multiple of their typical values.

    The linear cross-axis terms are part of the misalignment, as in the fits.
    """
    rng = np.random.default_rng(seed)
    values: dict[str, dict[str, np.ndarray]] = {}
    for name, multiple in _UNIT_EFFECTS.items():
        values[name] = {}
        for p in effect_named(name).parameters:
            values[name][p.name] = np.array([
                multiple * p.scale * rng.choice((-1, 1)) * rng.uniform(*_SPREAD)
                * (p.name != 'linear') if axis in p.axes else 0.0 for axis in sensor.axes])
    return replace(sensor, effects=tuple(_UNIT_EFFECTS), values=values)


def _held_out_errors(nominal: Sensor, fitted: Sensor, poses: Poses
                     ) -> list[unseen.HeldOutErrors]:
    """Return the errors of datasheet, linear and fitted coefficients on the check poses."""
    held_out = poses.subset(poses.check)
    models = {'nominal': nominal, 'linear': linear.fit(nominal, poses.subset(~poses.check)),
              fitted.model: fitted}
    return [unseen.summarise(model, unseen.pose_errors(sensor, held_out))
            for model, sensor in models.items()]


def _show_sweep(graph: DemoGraph, output: Path) -> Poses:
    """Show the sweep, the fit and the check while they run; return the poses."""
    journal = _journal(output)
    total = len(pose_plan.guided(np.radians(_PLANES_DEG).tolist(), float(np.radians(_STEP_DEG)),
                                 _CHECK_POSES))
    with steps.step('1/3 sweep', 'starting', total) as step:
        def show_poses() -> int:
            count = len(_accepted_poses(journal))
            if count:
                step.show(f'{count} of {total} poses', count)
            return count

        graph.wait(lambda: show_poses() == total, show_poses)
    fitting = f'{total - _CHECK_POSES} poses'
    with steps.step('2/3 fit', fitting) as step:
        graph.wait(output.exists, lambda: None, FIT_S)
        step.show(f'{fitting}, {parameter_file.load(output).model} model')
    with steps.step('3/3 check', f'{_CHECK_POSES} poses that the fit has not seen'):
        graph.wait(lambda: bool(_fitted_poses(journal)), lambda: None, FIT_S)
        graph.close()
    return Poses.from_records(_fitted_poses(journal))


def _run_recording(folder: Path, path: Path, length_s: float) -> None:
    """Calibrate a recorded sensor against gravity, replayed through the graph."""
    output, report = folder / f'{path.stem}.yaml', folder / path.stem
    _print('', title(f'Real recording {path.name}: a sensor turned by hand',
                     length_s / _REPLAY_SPEED + _OVERHEAD_S), '')
    _remove_results(output)
    nominal_path = parameter_file.nominal_path()
    with open_graph(folder / f'{path.stem}.log') as graph:
        graph.start('calibration', nominal_path, *_SIM_TIME, *_LOSSLESS, *_UNATTENDED,
                    '-p', 'mode:=gravity', *_output_arguments(output, report))
        graph.start('driver', nominal_path, '-p', 'link.type:=replay', '-p',
                    f'link.recording:={path}', '-p', f'link.speed:={_REPLAY_SPEED}', *_SIM_TIME,
                    *_KEEPING)
        poses = _show_replay(graph, output, path)
    fitted = parameter_file.load(output)
    nominal = replace(fitted.without_covariance(), effects=(), values={})
    _print('', *gravity_lines(gravity_fit.fit_gravity(poses.volts, poses.std_v, nominal)), '',
           *file_lines({'Page': report / 'report.html', 'Calibration': output}))


def _show_replay(graph: DemoGraph, output: Path, path: Path) -> Poses:
    """Show the replay of a recording and the fit while they run; return the rests."""
    journal = _journal(output)
    with steps.step('1/2 replay', 'starting') as step:
        def show_rests() -> int:
            count = len(_accepted_poses(journal))
            if count:
                step.show(f'{count} rests')
            return count

        def replayed() -> bool:
            return graph.report_of('driver').get('link_state') == 'ended'

        graph.wait(replayed, show_rests)
    with steps.step('2/2 fit', f'{len(_accepted_poses(journal))} rests') as step:
        answer = graph.finish()
        if not output.exists():
            raise UserError(f'{path}: {answer}')
        poses = Poses.from_records(_fitted_poses(journal))
        step.show(f'{len(poses)} rests, magnitude of gravity')
        graph.close()
    return poses


def title(text: str, seconds: float) -> str:
    """
    Return a title with the time that its part takes.

    seconds: the time, s.
    """
    takes = f'{seconds / 60:.0f} min' if seconds >= 90 else f'{math.ceil(seconds / 10) * 10} s'
    return f'{text}   ({takes})'


def file_lines(values: dict[str, object]) -> list[str]:
    """Return one line for each value, with its name before it."""
    return [f' {name:12} {value}' for name, value in values.items()]


def _print(*lines: str) -> None:
    """Print lines; PASS and FAIL are coloured in a terminal."""
    for line in lines:
        word = line.split()[0] if line.split() else ''
        if word in _COLOURS and steps.drawable() and 'NO_COLOR' not in os.environ:
            line = line.replace(word, f'{_COLOURS[word]}{word}{_NO_COLOUR}', 1)
        print(line, flush=True)


def _output_arguments(output: Path, report: Path) -> tuple[str, ...]:
    """Return the arguments of the node for its files, the calibration store among them."""
    return ('-p', f'output:={output}', '-p', f'report:={report}',
            '-p', f'store:={output.parent / "calibrations"}')


def _remove_results(output: Path) -> None:
    """Remove the results of an earlier demonstration, which would pass for those of this one."""
    for path in (output, _journal(output)):
        path.unlink(missing_ok=True)


def _journal(output: Path) -> Path:
    """Return the journal of the calibration that writes a parameter file."""
    return output.with_name(f'{output.name}.journal')


def _accepted_poses(journal: Path) -> list[sweep_journal.PoseRecord]:
    """Return the poses that a journal has so far."""
    return sweep_journal.accepted_poses(_entries(journal))


def _fitted_poses(journal: Path) -> list[sweep_journal.PoseRecord]:
    """Return the poses that were fitted; the journal has them when everything is written."""
    fits = [entry for entry in _entries(journal) if isinstance(entry, sweep_journal.Fitted)]
    return list(fits[0].rests or ()) if fits else []


def _entries(journal: Path) -> list[sweep_journal.JournalEntry]:
    """Return the entries of a journal; none while it has no head."""
    try:
        return sweep_journal.read(journal).entries
    except UserError:
        return []
