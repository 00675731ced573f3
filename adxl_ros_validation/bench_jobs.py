# SPDX-License-Identifier: Apache-2.0

"""The jobs of the benchmark that need no graph, each beside what does the same elsewhere."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from datetime import date
from functools import partial
from importlib import import_module
from importlib.metadata import version
from importlib.util import find_spec
from io import BytesIO
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
from adxl_ros.files.recording_columns import Recording
from adxl_ros.files.stream_info import sensor_info
from adxl_ros.links.support import wire_format
from adxl_ros.model import sensor as sensors, signal_chain
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.effects import library
from adxl_ros.model.sensor import Sensor, to_nominal_mps2, with_axes
from adxl_ros.nodes.jobs import executable
from adxl_ros.signals.allan_deviation import RunningSums
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
    run: Callable[[], object]  # Does it with this package; what it returns as text is shown
    # Largest ratio to the first rival, or largest processor time, s, without a rival; 0 without a
    # goal
    goal: float = 0.0
    # Others that do the same, by name
    rivals: Mapping[str, Callable[[], object]] = field(default_factory=dict)
    rounds: int = 100  # Largest number of rounds; a long job has few
    clock: Callable[[], float] = cpu_s  # What is measured, s; processor time without it


def print_table(jobs: Iterable[Job], rounds: int) -> None:
    """Measure each job and its rivals in turns, and print a table."""
    print(
        f'\n{date.today()}, adxl_ros {version("adxl-ros")}, CPython '
        f'{platform.python_version()}, {platform.machine()}, {os.cpu_count()} cores'
    )
    print(', '.join(f'{name} {version(name)}' for name in _PACKAGES if find_spec(name)))
    print(
        f'\nProcessor time, s, and ratio: median (least to greatest) of {rounds} rounds in turns\n'
    )
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
    detail = ''
    # The first of several rounds imports and allocates.
    for number in range(0 if rounds > 1 else 1, rounds + 1):
        for name, run in runs.items():
            began_s = job.clock()
            with suppress(ImportError):
                result = run()
                detail = result if isinstance(result, str) else detail
                if number:
                    seconds[name].append(job.clock() - began_s)
    measured = np.array(seconds.pop(''))
    limit = f'{job.goal:g}' if job.goal else '–'
    head = f'| {job.name}{detail} | {spread(measured, ".2g")} |'
    if not job.rivals:
        return [f'{head} – | – | {limit} s |'.replace('– s', '–')]
    ratios = [
        spread(measured / np.array(theirs), '.2g') if theirs else 'not installed'
        for theirs in seconds.values()
    ]
    return [
        f'{head} {name} | {ratio} | {limit if i == 0 else "–"} |'
        for i, (name, ratio) in enumerate(zip(seconds, ratios))
    ]


def spread(values: Sequence[float] | np.ndarray, form: str) -> str:
    """Return median, least and greatest of values as text, with the format of a number."""
    return f'{np.median(values):{form}} ({min(values):{form}}–{max(values):{form}})'


_ROWS = 300_000
"""Rows of the files that are read and written; chosen: 5 min at 1 kHz."""
_APPLIED_ROWS = 3_000_000
"""Rows of the file that `apply` corrects; chosen: 50 min at 1 kHz."""
_LONG_BLOCK = 100_000
"""Rows of a block of the long recording; chosen: a few MB."""
_ROW_BYTES = 1100
"""Largest room that a sample of a long recording and its corrected bag take, measured."""
_MEASURE = (
    'import resource, subprocess, sys; '
    'status = subprocess.call(sys.argv[1:], stdout=subprocess.DEVNULL); '
    'print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss); sys.exit(status)'
)
"""Runs a command and prints its largest memory, kB. A child of the benchmark itself would count
the memory of the benchmark, which it has until it becomes the command."""
_RATE_HZ = 1000.0
"""Sample rate of all recordings, Hz."""
_EFFECTS = ('bias', 'scale_factor', 'misalignment', 'cross_axis', 'cross_axis_z', 'scale_factor_z')
"""Effects of the units that `apply` corrects, with twenty coefficients on two axes."""
_TOOLS = ('simulate', 'fit', 'apply', 'noise', 'check', 'diagnose', 'export', 'blind', 'reproduce')
"""Tools whose `--help` is measured."""
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
        yield from _reading_and_writing(folder, sensor, _recording(sensor, columns, _ROWS))
        yield _applying(folder, sensor, columns)
        values = {name: sensors.typical(effect, 'xyz') for name, effect in library().items()}
        full = replace(
            with_axes(sensor, 'xyz'), rate_hz=_RATE_HZ, effects=tuple(values), values=values
        )
        motion = replace(rich(np.random.default_rng(0)), duration_s=600.0)
        yield Job(
            f'simulate, {motion.duration_s:g} s at 1 kHz, 3 axes, {len(values)} effects',
            lambda: simulate(full, motion, 0),
            1.0,
            rounds=3,
        )
        yield from (make() for make in (_gravity_fit, _allan, _frames, _in_the_loop))
        commands = [[executable(name), '--help'] for name in _TOOLS]
        yield Job(
            f'--help of {len(commands)} tools',
            lambda: [
                subprocess.run(command, check=True, capture_output=True) for command in commands
            ],
            0.4 * len(commands),
            rounds=3,
        )
        yield Job(
            'demo, elapsed time',
            partial(_program, 'demo', '-o', folder / 'demo'),
            60.0,
            rounds=1,
            clock=time.monotonic,
        )
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

    yield Job(
        f'read CSV, {_ROWS} rows',
        lambda: recording.read(csv),
        1.5,
        {
            'pyarrow': lambda: import_module('pyarrow.csv').read_csv(csv),
            'polars': lambda: import_module('polars').read_csv(csv),
        },
    )
    yield Job(
        f'write CSV, {_ROWS} rows',
        lambda: recording.write(folder / 'ours.csv', samples, sensor),
        0.0,
        {'pyarrow': write_by_pyarrow},
    )
    yield Job(
        f'read MCAP, {2 * _ROWS} messages',
        lambda: recording.read(mcap),
        0.25,
        {'rosbags': read_by_rosbags},
    )


def _applying(folder: Path, sensor: Sensor, columns: dict[str, np.ndarray]) -> Job:
    """Apply six effects with a covariance of their coefficients to a long file."""
    unit, path = _unit(sensor, 'xy'), folder / 'long.csv'
    recording.write(path, _recording(unit, columns, _APPLIED_ROWS), unit)
    count = len(unit.covariance)
    return Job(
        f'apply, {_APPLIED_ROWS} rows, 6 effects, {count} x {count} covariance',
        _apply(unit, path, folder / 'applied.csv'),
        5.0,
        rounds=1,
    )


def _apply(unit: Sensor, path: Path, output: Path) -> Callable[[], str]:
    """Return what applies the calibration of a unit to a recording."""
    params = path.with_name('unit.yaml')
    parameter_file.save(params, unit)
    return partial(_program, 'apply', path, '--params', params, '-o', output)


def _program(name: str, *arguments: str | Path) -> str:
    """Run an executable of the package; return its elapsed time and its memory in words."""
    began_s = time.monotonic()
    done = subprocess.run(
        [sys.executable, '-c', _MEASURE, executable(name), *arguments],
        stdout=subprocess.PIPE,
        text=True,
    )
    if done.returncode:
        raise UserError(f'{executable(name)} ended with status {done.returncode}')
    return f' ({time.monotonic() - began_s:.0f} s elapsed, {int(done.stdout) / 1e3:.0f} MB)'


def _unit(sensor: Sensor, axes: str) -> Sensor:
    """Return a unit with six effects and a covariance of their coefficients."""
    unit = sensors.with_neutral(with_axes(sensor, axes), _EFFECTS)
    names = tuple(
        name for effect in _EFFECTS for name in sensors.names_of(library()[effect], unit.axes)
    )
    scales = np.array([sensors.parameter_of(name).scale for name in names])
    return replace(
        sensors.put(unit, names, 0.5 * scales),
        covariance_names=names,
        covariance=np.diag((0.05 * scales) ** 2),
    )


def _long_applying(folder: Path, sensor: Sensor, kind: str, hours: float) -> Iterator[Job]:
    """Apply six effects to a recording of three axes of many hours, in the format of its name."""
    needed, free = hours * 3600 * _RATE_HZ * _ROW_BYTES, shutil.disk_usage(folder).free
    if needed > free:
        raise UserError(
            f'{folder}: {free / 1e9:.1f} GB free; recordings of {hours:g} h need '
            f'{needed / 1e9:.1f} GB: set TMPDIR to a larger disk, or --hours'
        )
    unit = _unit(sensor, 'xyz').without_covariance()
    path, output = folder / f'in.{kind}', folder / f'out.{kind}'
    columns = simulate(unit, sweep(np.random.default_rng(0)), 0)
    block = _recording(unit, {f'{axis}_v': columns[f'{axis}_v'] for axis in 'xyz'}, _LONG_BLOCK)
    with recording.writer(path, unit) as append:
        for begin in range(0, rows := round(hours * 3600 * _RATE_HZ), _LONG_BLOCK):
            count = min(_LONG_BLOCK, rows - begin)
            append(
                replace(
                    block,
                    time_s=(begin + np.arange(count)) / _RATE_HZ,
                    columns={name: values[:count] for name, values in block.columns.items()},
                )
            )
    yield Job(
        f'apply, {hours:g} h at 1 kHz, {kind.upper()} to {kind.upper()}',
        _apply(unit, path, output),
        hours * 60 / 8,
        rounds=1,
    )
    path.unlink()
    output.unlink()


def _gravity_fit() -> Job:
    """Fit nine coefficients with covariance to rests, beside plain least squares."""
    rng, fits, rests = np.random.default_rng(11), 10, 40  # A sweep by hand has 20 to 60 rests
    sensor = with_axes(parameter_file.load(parameter_file.nominal_path()), 'xyz')
    unit = sensors.with_neutral(sensor, ('bias', 'scale_factor', 'misalignment'))
    names = sensors.names_of(library()['bias'], 'xyz')
    unit = sensors.put(unit, names, [0.05, -0.03, 0.02])
    drawn = rng.normal(size=(rests, 3))
    force = sensor.local_gravity_mps2 * drawn / np.linalg.norm(drawn, axis=1, keepdims=True)
    std_v = np.full((rests, 3), 5e-5)  # 0.05 mg
    mean_v = np.column_stack(signal_chain.static_response(unit)(list(force.T)))
    mean_v = mean_v + std_v * rng.normal(size=mean_v.shape)
    accel = to_nominal_mps2(mean_v, sensor)

    def residual(p: np.ndarray) -> np.ndarray:
        upper = np.array([[1, p[6], p[7]], [0, 1, p[8]], [0, 0, 1]])
        return np.linalg.norm(((accel - p[:3]) * (1 + p[3:6])) @ upper.T, axis=1) - G0_MPS2

    def by_least_squares() -> None:
        for _ in range(fits):
            scipy.optimize.least_squares(residual, np.zeros(9), x_scale=[0.1] * 3 + [0.01] * 6)

    return Job(
        f'{fits} gravity fits with covariance, {rests} rests',
        lambda: [fit_gravity(mean_v, std_v, sensor) for _ in range(fits)],
        10.0,
        {'least squares': by_least_squares},
    )


def _allan() -> Job:
    samples, block = np.random.default_rng(0).normal(size=1_000_000), 65536

    def ours() -> None:
        stream = RunningSums(1, BytesIO())
        for begin in range(0, len(samples), block):
            stream.feed(samples[begin : begin + block, None])
        stream.allan_deviation(_RATE_HZ), stream.cells()

    return Job(
        f'Allan deviation, {len(samples)} samples',
        ours,
        1.0,
        {
            'allantools': lambda: import_module('allantools').oadev(
                samples, rate=_RATE_HZ, data_type='freq', taus='octave'
            )
        },
    )


def _frames() -> Job:
    encoder = wire_format.Encoder(wire_format.BoardInfo(_RATE_HZ, 16, 3, 5.0, 'bench'))
    codes, count = np.random.default_rng(0).integers(1, 65535, (10, 3)), 2000
    # A frame has ten samples, which take 10 ms.
    stream = b''.join(encoder.sample_frame(10_000 * k, 10 * k, codes) for k in range(count))

    def ours() -> None:
        for _ in range(10):
            for raw in wire_format.Splitter().split(stream):
                wire_format.decode(raw)

    return Job(f'decode {10 * count} frames of the serial link', ours)


def _in_the_loop() -> Job:
    """Step a sensor in the loop, beside a step of a simulator with its own accelerometer."""
    path, steps = parameter_file.nominal_path(), 2000

    def ours() -> None:
        model = SensorModel(path)
        for _ in range(steps):
            model(np.array([0.0, 0.0, G0_MPS2]), 1 / _RATE_HZ)

    def by_mujoco() -> None:
        mujoco: Any = import_module('mujoco')
        model = mujoco.MjModel.from_xml_string(_FREE_BODY)
        data = mujoco.MjData(model)
        for _ in range(steps):
            mujoco.mj_step(model, data)

    return Job(f'{steps} steps of a sensor in the loop', ours, 0.0, {'mujoco': by_mujoco})
