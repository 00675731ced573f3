# SPDX-License-Identifier: Apache-2.0

"""Run the main job: a simulated sweep through the live graph."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import replace
import json
import math
from pathlib import Path
import subprocess
import sys
import time

from adxl_ros.calibrate.fits import linear
from adxl_ros.calibrate.guided import pose_plan
from adxl_ros.calibrate.poses import Poses
from adxl_ros.calibrate.report import held_out as unseen
from adxl_ros.calibrate.report.acceptance import acceptance_lines, screen_table
from adxl_ros.calibrate.result import compare, truth_table
from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file, sweep_journal
from adxl_ros.model.effects import effect_named
from adxl_ros.model.sensor import Sensor
from adxl_ros.nodes import jobs
from adxl_ros.nodes.run_node import program_parser
from adxl_ros.process import ended_by_closed_output
from adxl_ros.report.screen import coloured
from diagnostic_msgs.msg import DiagnosticArray
import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

_FIT_S = 600.0
"""Longest time of a fit, s; chosen: far above the seconds that a fit takes."""
_POLL_S = 0.2
"""Time between two looks at the progress, s."""
_SILENT_S = 60.0
"""Longest time without progress while poses are taken, s; chosen: a pose takes 1 s."""
_SPEED = 40.0
"""Default sensor time per real time; chosen: two cores can follow."""
_RATE_HZ = 250.0
"""Rate of the simulated sensor, Hz. Chosen: its noise ends at 50 Hz, so that more samples would
say no more, and many times real time leaves room to catch up."""
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
_SEED = 203
"""Default seed of the demonstrated unit and its stage; chosen."""
_UNIT_EFFECTS = {'bias': 0.5, 'scale_factor': 0.5, 'misalignment': 0.7, 'cross_axis': 0.7,
                 'cross_axis_z': 1.0, 'scale_factor_z': 0.7}
"""Effects of the demonstrated unit, in multiples of their typical values; chosen."""
_SPREAD = (0.5, 1.5)
"""Range of the random factor of each coefficient of the demonstrated unit; chosen."""
_DELAY_S = 0.2
"""Time from a command to the motion of the stage, s. Chosen: driver and stage wait for each other
once in this time, and the samples of a longer time would overflow the shared memory."""
_QUEUE = 100_000
"""Samples that wait for a busy subscriber; chosen: 2.5 s of real time at the default
speed, longer than a busy machine lets a process wait."""
_KEEPING: dict[str, object] = {'qos_overrides./imu/data_raw.publisher.depth': _QUEUE}
"""Parameters of a driver that keeps its samples until the calibration has them."""
_UNATTENDED = {'autostart': True, 'screen': False,
               'qos_overrides./imu/data_raw.subscription.reliability': 'reliable',
               'qos_overrides./imu/data_raw.subscription.depth': _QUEUE}
"""Parameters of a calibration that nobody controls and that loses no sample: at many times real
time, a best-effort subscriber loses samples on a busy machine."""
_EXAMPLES = {'the simulated sensor': '-o demo_output'}
"""Examples of arguments, by their purpose."""
NEXT_PAGE = 'docs/start/tilt.md'
"""Page that a user reads next."""


class DemoGraph:
    """The nodes that the demonstration runs, each in a process of its own."""

    def __init__(self, output: Path) -> None:
        self._output, self._log = output, output.with_suffix('.log')
        self._processes: dict[str, subprocess.Popen] = {}
        self.reports: dict[str, dict[str, str]] = {}  # Newest diagnostics by node
        self._node = Node('demo')
        self._node.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, 10)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self._node)

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self.reports[status.name.split(':')[0]] = {
                'message': status.message, **{pair.key: pair.value for pair in status.values}}

    def start(self, name: str, params_file: Path, parameters: Mapping[str, object]) -> None:
        """Start a node that follows the clock of the driver."""
        command = [jobs.executable(name), '--ros-args', '--log-level', 'warn', '--params-file',
                   str(params_file)]
        for key, value in {'use_sim_time': True, **parameters}.items():
            command += ['-p', f'{key}:={json.dumps(value, ensure_ascii=False, default=str)}']
        with self._log.open('ab') as log:
            self._processes[name] = subprocess.Popen(command, stdout=log, stderr=log)

    def close(self) -> None:
        """End the nodes."""
        jobs.stop(list(self._processes.values()))
        self._processes.clear()

    def wait(self, finished: Callable[[], bool], progress: Callable[[], object] = lambda: None,
             silent_s: float = _FIT_S) -> None:
        """Wait until a condition holds; a node that ends, a failed fit or silence is an error."""
        newest: object = None
        changed_s = time.monotonic()
        while not finished():
            self._executor.spin_once(timeout_sec=_POLL_S)
            message = self.reports.get('calibration', {}).get('message', '')
            # The message counts seconds of silence, too, which are no progress.
            if (news := progress() or message) != newest:
                newest, changed_s = news, time.monotonic()
            ended = [name for name, process in self._processes.items()
                     if process.poll() is not None]
            if ended or message.startswith('cannot finish') \
                    or time.monotonic() - changed_s > silent_s:
                what = f'the node {ended[0]} has ended' if ended else message or 'no progress'
                raise UserError(f'{what}; see {self._log}')

    def entries(self) -> list[sweep_journal.JournalEntry]:
        """Return the entries of the journal; none while it has no head."""
        with suppress(UserError):
            return sweep_journal.read(_journal(self._output)).entries
        return []

    def fitted_poses(self) -> list[sweep_journal.PoseRecord]:
        """Return the poses of the fit; the journal has them when everything is written."""
        return [pose for entry in self.entries()
                if isinstance(entry, sweep_journal.Fitted) for pose in entry.rests or ()]


def _journal(output: Path) -> Path:
    """Return the journal of the calibration that writes a parameter file."""
    return output.with_name(f'{output.name}.journal')


@contextmanager
def open_graph(output: Path) -> Iterator[DemoGraph]:
    """Yield a graph for a parameter file that is to be written, and end its nodes at the end."""
    # Results of an earlier demonstration would pass for those of this one.
    for path in (output, _journal(output), output.with_suffix('.log')):
        path.unlink(missing_ok=True)
    rclpy.init(args=[])
    graph = DemoGraph(output)
    try:
        yield graph
    finally:
        rclpy.try_shutdown()
        graph.close()


@ended_by_closed_output()
def main() -> int:
    """Run the demonstration; return the exit status."""
    parser = program_parser('demo', __doc__, _EXAMPLES)
    parser.add_argument('-o', dest='output', metavar='DIR', default='demo_output', type=Path,
                        help='folder of pages and calibrations (default demo_output)')
    parser.add_argument('--speed', type=float, default=_SPEED,
                        help=f'sensor time per real time (default {_SPEED:g})')
    parser.add_argument('--seed', type=int, default=_SEED,
                        help=f'seed of the simulated unit and its stage (default {_SEED})')
    options = parser.parse_args()
    for name, lowest, highest in (('seed', 0, 2 ** 31 - 1), ('speed', 0.01, 1000)):
        if not lowest <= (value := getattr(options, name)) <= highest:
            parser.error(f'--{name}: {value} is not between {lowest} and {highest}')
    jobs.use_own_graph()
    try:
        try:
            options.output.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(f'{options.output}: {error.strerror}') from None
        _run_sweep(options.output, options.speed, options.seed)
        _print('', *file_lines({'Next': f'your own sensor: {NEXT_PAGE}'}))
    except UserError as error:
        print(f'demo: {error}', file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        return 130
    return 0


def _run_sweep(folder: Path, speed: float, seed: int) -> None:
    """Sweep a simulated sensor whose coefficients are drawn at datasheet spread."""
    unit, nominal = folder / 'simulated_unit.yaml', folder / 'nominal.yaml'
    sensor = replace(parameter_file.load(parameter_file.nominal_path()), serial='demo',
                     rate_hz=_RATE_HZ)
    truth = _draw_unit(sensor, seed)
    parameter_file.save(nominal, sensor)
    parameter_file.save(unit, truth, ['The truth of the simulated unit.'])
    name = parameter_file.nominal_path().stem
    output, report = folder / f'{name}_demo.yaml', folder / 'sweep'
    _print(title(f'Demo: calibrate a simulated {name.upper()} whose true coefficients are known',
                 _SWEEP_S / speed + _OVERHEAD_S), '')
    with open_graph(output) as graph:
        graph.start('driver', unit, _KEEPING | {'link.type': 'sim', 'link.speed': speed})
        graph.start('stage', nominal, {'delay_s': _DELAY_S, 'seed': seed})
        graph.start('calibration', nominal, {
            **_UNATTENDED, 'output': output, 'store': folder / 'calibrations', 'report': report,
            'sweep.planes_deg': _PLANES_DEG, 'sweep.step_deg': _STEP_DEG,
            'sweep.check_poses': _CHECK_POSES})
        total = len(pose_plan.guided(np.radians(_PLANES_DEG).tolist(),
                                     float(np.radians(_STEP_DEG)), _CHECK_POSES))
        with jobs.Step('1/3 sweep', 'starting', total) as step:
            def accepted() -> int:
                count = len(sweep_journal.accepted_poses(graph.entries()))
                step.show(f'{count} of {total} poses', count)
                return count
            graph.wait(lambda: accepted() == total, accepted, _SILENT_S)
        fitting = f'{total - _CHECK_POSES} poses'
        with jobs.Step('2/3 fit', fitting) as step:
            graph.wait(output.exists)
            step.show(f'{fitting}, {parameter_file.load(output).model} model')
        with jobs.Step('3/3 check', f'{_CHECK_POSES} poses that the fit has not seen'):
            graph.wait(lambda: bool(graph.fitted_poses()))
            graph.close()
        poses = Poses.from_records(graph.fitted_poses())
    fitted = parameter_file.load(output)
    _print('', *screen_table(_held_out_errors(sensor, fitted, poses)), '',
           *truth_table(compare(fitted, truth)), '', *acceptance_lines(fitted), '',
           *file_lines({'Page': report / 'report.html', 'Calibration': output}))


def _draw_unit(sensor: Sensor, seed: int) -> Sensor:
    """
    Draw the coefficients of a unit: 0.5 to 1.5 times a multiple of their typical values.

    The linear cross-axis terms are part of the misalignment, as in the fits.
    """
    rng = np.random.default_rng(seed)
    values = {name: {p.name: np.array([
        multiple * p.scale * rng.choice((-1, 1)) * rng.uniform(*_SPREAD)
        * (p.name != 'linear') if axis in p.axes else 0.0
        for axis in sensor.axes]) for p in effect_named(name).parameters}
        for name, multiple in _UNIT_EFFECTS.items()}
    return replace(sensor, effects=tuple(_UNIT_EFFECTS), values=values)


def _held_out_errors(nominal: Sensor, fitted: Sensor, poses: Poses
                     ) -> list[unseen.HeldOutErrors]:
    """Return the errors of datasheet, linear and fitted coefficients on the check poses."""
    held_out = poses.subset(poses.check)
    models = {'nominal': nominal, 'linear': linear.fit(nominal, poses.subset(~poses.check)),
              fitted.model: fitted}
    return [unseen.summarise(model, unseen.pose_errors(sensor, held_out))
            for model, sensor in models.items()]


def title(text: str, seconds: float) -> str:
    """Return a title with the time, s, that its part takes."""
    takes = f'{seconds / 60:.0f} min' if seconds >= 90 else f'{math.ceil(seconds / 10) * 10} s'
    return f'{text}   ({takes})'


def file_lines(values: dict[str, object]) -> list[str]:
    """Return one line for each value, with its name before it."""
    return [f' {name:12} {value}' for name, value in values.items()]


def _print(*lines: str) -> None:
    """Print lines; PASS and FAIL are coloured in a terminal."""
    print(*map(coloured, lines), sep='\n', flush=True)
