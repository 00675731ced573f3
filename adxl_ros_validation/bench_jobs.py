# SPDX-License-Identifier: Apache-2.0

"""The jobs of the benchmark that need no graph, each beside what does the same elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import date
from importlib import import_module
from importlib.metadata import version
from importlib.util import find_spec
import os
from pathlib import Path
import platform
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from typing import Any

from adxl_ros.calibrate.fits.gravity_fit import fit_gravity
from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file, recording
from adxl_ros.files.recording_columns import Recording, sensor_info
from adxl_ros.links.support import wire_format
from adxl_ros.model import coefficients, signal_chain
from adxl_ros.model.coefficients import Coefficient
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.effects import library
from adxl_ros.model.sensor import Sensor, to_nominal_mps2, with_axes
from adxl_ros.nodes.jobs import executable
from adxl_ros.signals.allan_deviation import AllanStream, CellMeans
from adxl_ros.simulate.response import simulate
from adxl_ros.simulate.sensor_model import SensorModel
from adxl_ros.simulate.trajectories import rich, sweep
import numpy as np
import scipy

_PACKAGES = ('numpy', 'scipy', 'pyarrow', 'polars', 'pandas', 'rosbags', 'allantools', 'mujoco')
"""Libraries whose versions the table states."""


def cpu_s() -> float:
    """Return the processor time of this process and of its finished children, s."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


@dataclass(frozen=True)
class Job:
    """A job that is measured."""

    name: str  # What is done
    run: Callable[[], object]  # Does it with this package
    # Largest ratio to the first rival, or largest processor time, s, without a rival; 0 without a
    # goal
    goal: float = 0.0
    # Others that do the same, by name
    rivals: Mapping[str, Callable[[], object]] = field(default_factory=dict)
    rounds: int = 100  # Largest number of rounds; a long job has few
    # Returns what is to be said of the finished job beside its time
    detail: Callable[[], str] = str
    clock: Callable[[], float] = cpu_s  # What is measured, s; processor time without it


def print_table(jobs: Iterable[Job], rounds: int) -> None:
    """Measure each job and its rivals in turns, and print a table."""
    print(f'\n{date.today()}, adxl_ros {version("adxl-ros")}, CPython '
          f'{platform.python_version()}, {platform.machine()}, {os.cpu_count()} cores')
    print(', '.join(f'{name} {version(name)}' for name in _PACKAGES if find_spec(name)))
    print(f'\nProcessor time, s, and ratio: median (least to greatest) of {rounds} rounds in '
          'turns\n')
    print('| job | s | beside | ratio | goal |\n|---|---|---|---|---|', flush=True)
    for job in jobs:
        try:
            rows = rows_of(job, min(rounds, job.rounds))
        except UserError as error:
            rows = [f'| {job.name} | {error} | – | – | – |']
        print(*rows, sep='\n', flush=True)


def rows_of(job: Job, rounds: int) -> list[str]:
    """Measure one job and its rivals in turns."""
    runs = {'': job.run, **job.rivals}
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    # The first of several rounds imports and allocates.
    for number in range(0 if rounds > 1 else 1, rounds + 1):
        for name, run in runs.items():
            began_s = job.clock()
            with suppress(ImportError):
                run()
                if number:
                    seconds[name].append(job.clock() - began_s)
    measured = np.array(seconds.pop(''))
    limit = f'{job.goal:g}' if job.goal else '–'
    head = f'| {job.name}{job.detail()} | {spread(measured, ".2g")} |'
    if not job.rivals:
        return [f'{head} – | – | {limit} s |'.replace('– s', '–')]
    ratios = [spread(measured / np.array(theirs), '.2g') if theirs else 'not installed'
              for theirs in seconds.values()]
    return [f'{head} {name} | {ratio} | {limit if i == 0 else "–"} |'
            for i, (name, ratio) in enumerate(zip(seconds, ratios))]


def spread(values: Sequence[float] | np.ndarray, form: str) -> str:
    """Return median, least and greatest of values as text, with the format of a number."""
    return f'{np.median(values):{form}} ({min(values):{form}}–{max(values):{form}})'


_ROWS = 300_000
"""Rows of the files that are read and written; chosen: 5 min at 1 kHz."""
_APPLIED_ROWS = 3_000_000
"""Rows of the file that `apply` corrects; chosen: 50 min at 1 kHz."""
_LONG_BLOCK = 100_000
"""Rows of a block of the long recording; chosen: a few MB."""
_LONG_GOAL_S_PER_H = 60 / 8
"""Largest time of `apply` for an hour of a long recording, s: 60 s for 8 h."""
_ROW_BYTES = 1100
"""Largest room that a sample of a long recording and its corrected bag take, measured."""
_MEASURE = ('import resource, subprocess, sys; '
            'status = subprocess.call(sys.argv[1:], stdout=subprocess.DEVNULL); '
            'print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss); sys.exit(status)')
"""Runs a command and prints its largest memory, kB. A child of the benchmark itself would count
the memory of the benchmark, which it has until it becomes the command."""
_DEMO_S = 60.0
"""Largest time of the demonstration, s."""
_SIMULATED_S = 600.0
"""Duration of the simulated recording, s."""
_RATE_HZ = 1000.0
"""Sample rate of all recordings, Hz."""
_ALLAN_SAMPLES = 1_000_000
"""Samples of the Allan deviation."""
_ALLAN_BLOCK = 65536
"""Samples that the Allan deviation gets at a time, as from a file."""
_RESTS = 40
"""Rests of the gravity fit; chosen: a sweep by hand has 20 to 60."""
_FITS = 10
"""Gravity fits of a round; chosen: one takes 30 ms."""
_REST_STD_V = 5e-5
"""Standard deviation of a rest, V; chosen: 0.05 mg."""
_FRAMES = 2000
"""Frames of the serial link that are decoded."""
_SAMPLES_PER_FRAME = 10
"""Samples of a frame."""
_FRAME_US = round(_SAMPLES_PER_FRAME / _RATE_HZ * 1e6)
"""Time from frame to frame, µs."""
_STEPS = 2000
"""Steps of a simulator in the loop."""
_EFFECTS = ('bias', 'scale_factor', 'misalignment', 'cross_axis', 'cross_axis_z',
            'scale_factor_z')
"""Effects of the units that `apply` corrects, with twenty coefficients on two axes."""
_RELATIVE_STD = 0.05
"""Standard deviation of its coefficients, in typical sizes."""
_TOOLS = ('simulate', 'fit', 'apply', 'noise', 'check', 'diagnose', 'export', 'blind', 'reproduce')
"""Tools whose `--help` is measured."""
_HELP_S = 0.4
"""Largest processor time of `--help`, s."""
_FREE_BODY = """<mujoco><option timestep="0.001"/><worldbody><body><freejoint/>
<geom size="0.1"/><site name="s"/></body></worldbody>
<sensor><accelerometer site="s"/></sensor></mujoco>"""
"""A falling body with an accelerometer."""


def offline_jobs(hours: float) -> Iterator[Job]:
    """Yield the jobs, each with its files."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        sensor = parameter_file.load(parameter_file.nominal_path())
        columns = simulate(sensor, sweep(np.random.default_rng(0)), 0)
        del columns['time_s']
        samples = _recording(sensor, columns, _ROWS)
        yield from _reading_and_writing(folder, sensor, samples)
        yield _applying(folder, sensor, columns)
        values = {name: coefficients.typical(effect, 'xyz') for name, effect in library().items()}
        full = replace(with_axes(sensor, 'xyz'), rate_hz=_RATE_HZ, effects=tuple(values),
                       values=values)
        motion = replace(rich(np.random.default_rng(0)), duration_s=_SIMULATED_S)
        yield Job(f'simulate, {_SIMULATED_S:g} s at 1 kHz, 3 axes, {len(values)} effects',
                  lambda: simulate(full, motion, 0), 1.0, rounds=3)
        yield from (make() for make in (_gravity_fit, _allan, _frames, _in_the_loop))
        commands = [[executable(name), '--help'] for name in _TOOLS]
        yield Job(f'--help of {len(commands)} tools', lambda: [
            subprocess.run(command, check=True, capture_output=True) for command in commands],
            _HELP_S * len(commands), rounds=3)
        demo = _Program('demo', '-o', str(folder / 'demo'))
        yield Job('demo, elapsed time', demo.run, _DEMO_S, rounds=1, clock=time.monotonic)
        for kind in ('csv', 'mcap'):
            yield from _long_applying(folder, sensor, kind, hours)


def _recording(sensor: Sensor, columns: dict[str, np.ndarray], rows: int) -> Recording:
    """Make a recording that repeats columns, (n,) each, with equal steps of time."""
    repeated = {name: np.resize(values, rows) for name, values in columns.items()}
    return Recording('bench', np.arange(rows) / _RATE_HZ, repeated, sensor_info(sensor))


def _reading_and_writing(folder: Path, sensor: Sensor, samples: Recording) -> Iterator[Job]:
    csv, mcap = folder / 'read.csv', folder / 'read.mcap'
    recording.write(csv, replace(samples, info={}), sensor)
    recording.write(mcap, samples, sensor)

    def write_by_pyarrow() -> None:
        table = import_module('pyarrow').table({'time_s': samples.time_s, **samples.columns})
        import_module('pyarrow.csv').write_csv(table, folder / 'theirs.csv')

    def read_by_rosbags() -> None:
        types = import_module('rosbags.typesys')
        store = types.get_typestore(types.Stores.ROS2_JAZZY)
        with import_module('rosbags.rosbag2').Reader(mcap) as reader:
            for connection, _, raw in reader.messages():
                store.deserialize_cdr(raw, connection.msgtype)

    yield Job(f'read CSV, {_ROWS} rows', lambda: recording.read(csv), 1.5, {
        'pyarrow': lambda: import_module('pyarrow.csv').read_csv(csv),
        'polars': lambda: import_module('polars').read_csv(csv)})
    yield Job(f'write CSV, {_ROWS} rows',
              lambda: recording.write(folder / 'ours.csv', samples, sensor), 0.0,
              {'pyarrow': write_by_pyarrow})
    yield Job(f'read MCAP, {2 * _ROWS} messages', lambda: recording.read(mcap), 0.25,
              {'rosbags': read_by_rosbags})


def _applying(folder: Path, sensor: Sensor, columns: dict[str, np.ndarray]) -> Job:
    """Apply six effects with a covariance of their coefficients to a long file."""
    unit, names = _unit(sensor, 'xy')
    unit = replace(unit, covariance_names=names,
                   covariance=np.diag((_RELATIVE_STD * _scales(names)) ** 2))
    params, path = folder / 'unit.yaml', folder / 'long.csv'
    parameter_file.save(params, unit)
    recording.write(path, _recording(unit, columns, _APPLIED_ROWS), unit)
    program = _Program('apply', str(path), '--params', str(params), '-o',
                       str(folder / 'applied.csv'))
    return Job(f'apply, {_APPLIED_ROWS} rows, 6 effects, {len(names)} x {len(names)} covariance',
               program.run, 5.0, rounds=1)


def _unit(sensor: Sensor, axes: str) -> tuple[Sensor, tuple[Coefficient, ...]]:
    """Return a unit with six effects, and the names of its coefficients."""
    unit = coefficients.with_neutral(with_axes(sensor, axes), _EFFECTS)
    names = tuple(name for effect in _EFFECTS
                  for name in coefficients.names_of(library()[effect], unit.axes))
    return coefficients.put(unit, names, 0.5 * _scales(names)), names


def _scales(names: Sequence[Coefficient]) -> np.ndarray:
    """Return the typical sizes of coefficients, in their units, (p,)."""
    return np.array([coefficients.parameter_of(name).scale for name in names])


class _Program:
    """An executable of the package; `costs` are elapsed time and memory of its last run."""

    def __init__(self, name: str, *arguments: str) -> None:
        self._command = [executable(name), *arguments]
        self.costs = ''

    def run(self) -> None:
        """Run it; raise UserError if it fails."""
        began_s = time.monotonic()
        done = subprocess.run([sys.executable, '-c', _MEASURE, *self._command],
                              stdout=subprocess.PIPE, text=True)
        if done.returncode:
            raise UserError(f'{self._command[0]} ended with status {done.returncode}')
        self.costs = (f' ({time.monotonic() - began_s:.0f} s elapsed, '
                      f'{int(done.stdout) / 1e3:.0f} MB)')


def _long_applying(folder: Path, sensor: Sensor, kind: str, hours: float) -> Iterator[Job]:
    """Apply six effects to a recording of three axes of many hours, in the format of its name."""
    needed, free = hours * 3600 * _RATE_HZ * _ROW_BYTES, shutil.disk_usage(folder).free
    if needed > free:
        raise UserError(f'{folder}: {free / 1e9:.1f} GB free; recordings of {hours:g} h need '
                        f'{needed / 1e9:.1f} GB: set TMPDIR to a larger disk, or --hours')
    unit, _ = _unit(sensor, 'xyz')
    params, path, output = folder / 'unit.yaml', folder / f'in.{kind}', folder / f'out.{kind}'
    parameter_file.save(params, unit)
    _write_long(path, unit, hours)
    program = _Program('apply', str(path), '--params', str(params), '-o', str(output))
    yield Job(f'apply, {hours:g} h at 1 kHz, {kind.upper()} to {kind.upper()}', program.run,
              hours * _LONG_GOAL_S_PER_H, rounds=1, detail=lambda: program.costs)
    path.unlink()
    output.unlink()


def _write_long(path: Path, sensor: Sensor, hours: float) -> None:
    """Write a recording of many hours, whose samples repeat."""
    rng = np.random.default_rng(0)
    force = np.array([[0.2, -0.1, np.sqrt(0.95)]]) * G0_MPS2
    mean_v = signal_chain.static_response(sensor)(list(force.T))
    noise_v = rng.normal(size=(_LONG_BLOCK, len(sensor.axes))) * 5e-4
    block_v = np.rint((np.column_stack(mean_v) + noise_v) / sensor.lsb_v) * sensor.lsb_v
    columns = {f'{axis}_v': values for axis, values in zip(sensor.axes, block_v.T)}
    samples = _recording(sensor, columns, _LONG_BLOCK)
    rows = round(hours * 3600 * _RATE_HZ)
    with recording.writer(path, sensor) as append:
        for begin in range(0, rows, _LONG_BLOCK):
            count = min(_LONG_BLOCK, rows - begin)
            append(replace(samples, time_s=(begin + np.arange(count)) / _RATE_HZ, columns={
                name: values[:count] for name, values in columns.items()}))


def _gravity_fit() -> Job:
    """Fit nine coefficients with covariance to rests, beside plain least squares."""
    rng = np.random.default_rng(11)
    sensor = with_axes(parameter_file.load(parameter_file.nominal_path()), 'xyz')
    unit = coefficients.with_neutral(sensor, ('bias', 'scale_factor', 'misalignment'))
    names = coefficients.names_of(library()['bias'], 'xyz')
    unit = coefficients.put(unit, names, [0.05, -0.03, 0.02])
    drawn = rng.normal(size=(_RESTS, 3))
    force = sensor.local_gravity_mps2 * drawn / np.linalg.norm(drawn, axis=1, keepdims=True)
    std_v = np.full((_RESTS, 3), _REST_STD_V)
    mean_v = np.column_stack(signal_chain.static_response(unit)(list(force.T)))
    mean_v = mean_v + std_v * rng.normal(size=mean_v.shape)
    accel = to_nominal_mps2(mean_v, sensor)

    def residual(p: np.ndarray) -> np.ndarray:
        upper = np.array([[1, p[6], p[7]], [0, 1, p[8]], [0, 0, 1]])
        return np.linalg.norm(((accel - p[:3]) * (1 + p[3:6])) @ upper.T, axis=1) - G0_MPS2

    def by_least_squares() -> None:
        for _ in range(_FITS):
            scipy.optimize.least_squares(residual, np.zeros(9), x_scale=[0.1] * 3 + [0.01] * 6)

    return Job(f'{_FITS} gravity fits with covariance, {_RESTS} rests',
               lambda: [fit_gravity(mean_v, std_v, sensor) for _ in range(_FITS)], 10.0,
               {'least squares': by_least_squares})


def _allan() -> Job:
    samples = np.random.default_rng(0).normal(size=_ALLAN_SAMPLES)

    def ours() -> None:
        stream, cells = AllanStream(1), CellMeans(1)
        for begin in range(0, _ALLAN_SAMPLES, _ALLAN_BLOCK):
            stream.feed(samples[begin:begin + _ALLAN_BLOCK, None])
            cells.feed(samples[begin:begin + _ALLAN_BLOCK, None])
        stream.result(_RATE_HZ, cells)

    return Job(f'Allan deviation, {_ALLAN_SAMPLES} samples', ours, 1.0, {
        'allantools': lambda: import_module('allantools').oadev(
            samples, rate=_RATE_HZ, data_type='freq', taus='octave')})


def _frames() -> Job:
    encoder = wire_format.Encoder(wire_format.BoardInfo(_RATE_HZ, 16, 3, 5.0, 'bench'))
    codes = np.random.default_rng(0).integers(1, 65535, (_SAMPLES_PER_FRAME, 3))
    stream = b''.join(encoder.sample_frame(_FRAME_US * k, _SAMPLES_PER_FRAME * k, codes)
                      for k in range(_FRAMES))

    def ours() -> None:
        for _ in range(10):
            for raw in wire_format.Splitter().split(stream):
                wire_format.decode(raw)

    return Job(f'decode {10 * _FRAMES} frames of the serial link', ours)


def _in_the_loop() -> Job:
    """Step a sensor in the loop, beside a step of a simulator with its own accelerometer."""
    path = parameter_file.nominal_path()

    def ours() -> None:
        model = SensorModel(path)
        for _ in range(_STEPS):
            model(np.array([0.0, 0.0, G0_MPS2]), 1 / _RATE_HZ)

    def by_mujoco() -> None:
        mujoco: Any = import_module('mujoco')
        model = mujoco.MjModel.from_xml_string(_FREE_BODY)
        data = mujoco.MjData(model)
        for _ in range(_STEPS):
            mujoco.mj_step(model, data)

    return Job(f'{_STEPS} steps of a sensor in the loop', ours, 0.0, {'mujoco': by_mujoco})
