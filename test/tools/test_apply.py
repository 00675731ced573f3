# SPDX-License-Identifier: Apache-2.0

"""The tool `apply`: its columns, its numbers, and its refusals."""

from collections.abc import Callable
import csv
from dataclasses import replace
from pathlib import Path
import signal
import subprocess
import sys

from adxl_ros.files import parameter_file, recording
from adxl_ros.files.atomic_write import write_text
from adxl_ros.files.recording_columns import Recording
from adxl_ros.files.stream_info import sensor_info
from adxl_ros.model import signal_chain
from adxl_ros.model.effects import effect_named, library
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.kinematics import specific_force
from adxl_ros.model.sensor import Sensor, to_nominal_mps2, typical, with_neutral
import numpy as np
from processes import executable, PATIENCE
import pytest
from units import drawn, nominal

pytestmark = pytest.mark.long

G = 9.80665
COLUMNS = [
    'time_s',
    'ax_mps2',
    'ay_mps2',
    'az_mps2',
    'ax_std_mps2',
    'ay_std_mps2',
    'az_std_mps2',
    'roll_rad',
    'pitch_rad',
    'inclination_rad',
    'roll_std_rad',
    'pitch_std_rad',
    'inclination_std_rad',
    'alpha_rad',
    'beta_rad',
    'alpha_std_rad',
    'beta_std_rad',
]
ALPHA, BETA = np.radians([20, 70, 50, 35]), np.radians([10, -100, 150, 60])

RunTool = Callable[..., subprocess.CompletedProcess]


def unit(axes: str = 'xy') -> Sensor:
    sensor = replace(drawn(np.random.default_rng(1), nominal(axes)), serial='17')
    return replace(
        sensor,
        covariance=1e-6 * np.eye(len(axes)),
        covariance_names=tuple(Coefficient('bias', 'offset_v', a) for a in axes),
    )


def record(
    folder: Path,
    sensor: Sensor,
    volts: np.ndarray,
    info: dict[str, str] | None = None,
    units: str = 'v',
) -> Path:
    data = volts if units == 'v' else to_nominal_mps2(volts, sensor)
    names = ('x_v', 'y_v', 'z_v') if units == 'v' else ('ax_mps2', 'ay_mps2', 'az_mps2')
    part = Recording(
        'made',
        10 + np.arange(len(volts)) / 1000,
        dict(zip(names, data.T)),
        sensor_info(sensor) if info is None else info,
    )
    recording.write(folder / 'made.csv', part, sensor)
    parameter_file.save(folder / 'unit.yaml', sensor)
    return folder / 'made.csv'


def volts_of(sensor: Sensor, alpha: np.ndarray = ALPHA, beta: np.ndarray = BETA) -> np.ndarray:
    return np.column_stack(signal_chain.static_response(sensor)(specific_force(alpha, beta, G)))


def applied(run_tool: RunTool, path: Path, parameters: Path | None = None) -> tuple:
    done = run_tool(
        'apply',
        path,
        '--params',
        parameters or path.with_name('unit.yaml'),
        '-o',
        path.with_name('out.csv'),
    )
    assert done.returncode == 0, done.stderr
    with open(path.with_name('out.csv'), encoding='utf-8', newline='') as file:
        rows = list(csv.reader(file))
    assert rows[0] == COLUMNS
    table = dict(zip(COLUMNS, map(list, zip(*rows[1:]))))
    return table, done.stderr


def numbers(table: dict, *names: str) -> np.ndarray:
    return np.array([[float(v) if v else np.nan for v in table[name]] for name in names])


@pytest.mark.parametrize('axes', ['xy', 'xyz'])
@pytest.mark.parametrize('units', ['v', 'mps2'])
def test_force_and_angles_are_recovered(
    run_tool: RunTool, tmp_path: Path, axes: str, units: str
) -> None:
    sensor = unit(axes)
    table, messages = applied(run_tool, record(tmp_path, sensor, volts_of(sensor), units=units))
    assert messages == ''
    force = np.array(specific_force(ALPHA, BETA, G))
    np.testing.assert_allclose(numbers(table, 'ax_mps2', 'ay_mps2', 'az_mps2'), force, atol=1e-9)
    np.testing.assert_allclose(numbers(table, 'alpha_rad', 'beta_rad'), [ALPHA, BETA], atol=1e-9)
    expected = [np.arctan2(force[1], force[2]), np.arctan2(-force[0], np.hypot(*force[1:])), ALPHA]
    np.testing.assert_allclose(
        numbers(table, 'roll_rad', 'pitch_rad', 'inclination_rad'), expected, atol=1e-9
    )
    assert numbers(table, 'time_s').tolist() == [[10.0, 10.001, 10.002, 10.003]]
    std = numbers(table, *(name for name in COLUMNS if '_std_' in name))
    assert (std > 0).all()
    assert np.isfinite(std).all()
    assert (numbers(table, 'ax_std_mps2') < 0.02).all()


def test_unobservable_angles_are_empty_cells(run_tool: RunTool, tmp_path: Path) -> None:
    sensor = replace(unit(), mounting={'rpy_rad': [0.1, 0.0, 0.0]})
    table, messages = applied(
        run_tool,
        record(
            tmp_path,
            sensor,
            volts_of(sensor, np.array([0.0, np.pi / 2, np.pi / 2]), np.array([1.0, 0.0, np.pi])),
        ),
    )
    assert 'those of the case: only the compensation turns them' in messages
    assert [text == '' for text in table['beta_rad']] == [True, False, False]
    assert [text == 'inf' for text in table['beta_std_rad']] == [True, False, False]
    assert table['roll_rad'][1:] == ['', '']
    assert table['roll_std_rad'][1:] == ['inf', 'inf']
    # Angles are in (−π, π].
    assert numbers(table, 'beta_rad')[0, 2] == pytest.approx(np.pi, abs=1e-3)


def test_samples_without_a_solution_are_kept_and_counted(
    run_tool: RunTool, tmp_path: Path
) -> None:
    sensor = unit()
    volts = np.vstack([volts_of(sensor), [[20.0, 2.0]], [[0.0, 2.5]], volts_of(sensor)])
    table, messages = applied(run_tool, record(tmp_path, sensor, volts))
    assert len(table['time_s']) == 10
    lost, rail = ({name: table[name][i] for name in COLUMNS} for i in (4, 5))
    for row in (lost, rail):
        assert {row[name] for name in COLUMNS if '_std_' in name} == {'inf'}
        assert row['pitch_rad'] == row['alpha_rad'] == ''
    assert lost['ax_mps2'] == lost['az_mps2'] == ''
    assert float(rail['ax_mps2']) < -20
    assert 'apply: 1 of 10 samples have no solution: their cells are empty, ' in messages
    assert 'apply: 1 of 10 samples have the ADC at its rail: their standard ' in messages
    assert table['ax_mps2'][:4] == table['ax_mps2'][6:]


def refused(run_tool: RunTool, path: Path, *options: object) -> str:
    """Assert that `apply` has status 1, one line on stderr and no output; return the line."""
    before = {p: p.read_bytes() for p in path.parent.iterdir() if p.is_file()}
    done = run_tool(
        'apply',
        path,
        *(options or ('--params', path.with_name('unit.yaml'), '-o', path.with_name('out.csv'))),
    )
    assert done.returncode == 1
    assert done.stdout == ''
    assert done.stderr.count('\n') == 1
    assert {p: p.read_bytes() for p in path.parent.iterdir() if p.is_file()} == before
    assert not [p for p in path.parent.iterdir() if p.name.startswith('.')]
    return done.stderr


@pytest.mark.parametrize(
    ('key', 'value', 'message'),
    [
        ('serial', '18', 'is of the sensor 18, but the parameters are of 17'),
        ('nominal_zero_g_v', 'two, 2.5', 'nominal_zero_g_v'),
    ],
)
def test_another_unit_is_refused(
    run_tool: RunTool, tmp_path: Path, key: str, value: str, message: str
) -> None:
    sensor = unit()
    path = record(tmp_path, sensor, volts_of(sensor), {**sensor_info(sensor), key: value})
    reason = refused(run_tool, path)
    assert message in reason
    assert str(path) in reason


def test_bad_input_leaves_the_earlier_output(run_tool: RunTool, tmp_path: Path) -> None:
    sensor = unit()
    path = record(tmp_path, sensor, volts_of(sensor))
    write_text(tmp_path / 'out.csv', 'earlier')
    text = path.read_text(encoding='utf-8')
    path.write_text(text + '10.004,nan,2.5\n', encoding='utf-8')
    line = text.count('\n') + 1
    assert f'{path}:{line}:2: x_v is empty or NaN' in refused(run_tool, path)
    (tmp_path / 'unit.yaml').write_text('/**:\n  ros__parameters:\n    format: 1\n')
    path.write_text(text, encoding='utf-8')
    assert f'{tmp_path}/unit.yaml:3:5: ' in refused(run_tool, path)


# Sends a signal to its own process when the output that is written gets its name, runs a tool.
INTERRUPTED = """import os, runpy, sys
number = int(sys.argv.pop(1))
def interrupt(event, arguments):
    if event == 'os.rename' and '/.out' in str(arguments[0]):
        os.kill(os.getpid(), number)
sys.addaudithook(interrupt)
del sys.argv[0]
runpy.run_path(sys.argv[0], run_name='__main__')
"""


@pytest.mark.parametrize(
    ('number', 'status', 'output'),
    [
        (signal.SIGINT, 130, 'out.csv'),
        (signal.SIGTERM, 143, 'out.csv'),
        (signal.SIGINT, 130, 'out.mcap'),
        (signal.SIGINT, 130, 'out'),
    ],
)
def test_an_interruption_leaves_no_output(
    tmp_path: Path, number: int, status: int, output: str
) -> None:
    sensor = unit()
    path = record(tmp_path, sensor, volts_of(sensor))
    done = subprocess.run(
        [
            sys.executable,
            '-c',
            INTERRUPTED,
            str(int(number)),
            executable('apply'),
            path,
            '--params',
            tmp_path / 'unit.yaml',
            '-o',
            tmp_path / output,
        ],
        stderr=subprocess.PIPE,
        text=True,
        timeout=60 * PATIENCE,
    )
    assert done.returncode == status
    assert done.stderr.count('\n') <= 1
    assert 'Traceback' not in done.stderr
    assert sorted(p.name for p in tmp_path.iterdir()) == ['made.csv', 'unit.yaml']


def test_the_output_does_not_depend_on_blocks(run_tool: RunTool, tmp_path: Path) -> None:
    """Rows beyond one block are in the order of the recording."""
    sensor = unit()
    count = 40000
    alpha, beta = np.linspace(0.3, 1.3, count), np.linspace(-3, 3, count)
    path = record(tmp_path, sensor, volts_of(sensor, alpha, beta))
    table, _ = applied(run_tool, path)
    np.testing.assert_allclose(numbers(table, 'alpha_rad', 'beta_rad'), [alpha, beta], atol=1e-8)


def messages_of(path: Path, kinds: dict[str, str]) -> dict[str, list]:
    reader = pytest.importorskip('rosbags.rosbag2').Reader(path)
    typesys = pytest.importorskip('rosbags.typesys')
    store = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
    messages: dict[str, list] = {topic: [] for topic in kinds}
    with reader as bag:
        assert {c.topic: c.msgtype for c in bag.connections} == kinds
        for connection, stamp_ns, raw in bag.messages():
            message = store.deserialize_cdr(raw, connection.msgtype)
            stamp = message.header.stamp
            assert stamp.sec * 10**9 + stamp.nanosec == stamp_ns
            assert message.header.frame_id == 'imu_link'
            messages[connection.topic].append(message)
    return messages


def test_a_bag_holds_the_estimates_of_the_table(run_tool: RunTool, tmp_path: Path) -> None:
    """A sample without a solution is left out, and an angle that is not shown keeps its value."""
    sensor = unit()
    volts = np.vstack(
        [
            volts_of(sensor),
            [[20.0, 2.0]],
            [[0.0, 2.5]],
            volts_of(sensor, np.array([np.pi / 2, 0.4]), np.array([0.2, 0.3])),
        ]
    )
    path = record(tmp_path, sensor, volts)
    table, _ = applied(run_tool, path)
    recording.write(tmp_path / 'made.mcap', recording.read(path), sensor)
    kept = [i for i in range(len(volts)) if i != 4]
    for source, output in (
        ('made.csv', 'out.mcap'),
        ('made.csv', 'folder'),
        ('made.mcap', 'again.mcap'),
    ):
        done = run_tool(
            'apply', tmp_path / source, '--params', tmp_path / 'unit.yaml', '-o', tmp_path / output
        )
        assert done.returncode == 0, done.stderr
        assert '1 of 8 samples have no solution: their cells are empty' in done.stderr
        assert '1 of 8 samples have the ADC at its rail: ' in done.stderr
        assert str(tmp_path / output) in done.stdout
        topics = messages_of(
            tmp_path / output,
            {'/imu/data': 'sensor_msgs/msg/Imu', '/tilt': 'geometry_msgs/msg/Vector3Stamped'},
        )
        imu, tilt = topics['/imu/data'], topics['/tilt']
        stamps_s = [m.header.stamp.sec + m.header.stamp.nanosec * 1e-9 for m in imu]
        np.testing.assert_allclose(stamps_s, numbers(table, 'time_s')[0, kept], atol=1e-9)
        force = [
            (m.linear_acceleration.x, m.linear_acceleration.y, m.linear_acceleration.z)
            for m in imu
        ]
        np.testing.assert_allclose(
            force, numbers(table, 'ax_mps2', 'ay_mps2', 'az_mps2').T[kept], rtol=1e-9, atol=1e-9
        )
        variance = np.array(
            [m.linear_acceleration_covariance.reshape(3, 3).diagonal() for m in imu]
        )
        std = numbers(table, 'ax_std_mps2', 'ay_std_mps2', 'az_std_mps2').T[kept]
        expected = np.where(np.isfinite(std), std**2, 1e6)
        np.testing.assert_allclose(variance, expected, rtol=1e-9)
        angles = numbers(table, 'roll_rad', 'pitch_rad', 'inclination_rad').T[kept]
        for row in range(1, len(angles)):
            angles[row] = np.where(np.isnan(angles[row]), angles[row - 1], angles[row])
        vectors = [(m.vector.x, m.vector.y, m.vector.z) for m in tilt]
        np.testing.assert_allclose(vectors, angles, rtol=1e-9)
        is_shown = np.isfinite(numbers(table, 'roll_std_rad')[0, kept])
        assert 0 < is_shown.sum() < len(imu)
        assert [m.orientation_covariance[0] < 1 for m in imu] == is_shown.tolist()
        for message, (roll, pitch, _) in zip(imu, angles):
            assert message.angular_velocity_covariance[0] == -1
            assert np.isfinite(message.orientation_covariance).all()
            assert message.orientation_covariance[8] == 1e6
            q = message.orientation
            assert 2 * np.arctan2(q.x, q.w) == pytest.approx(roll, abs=1e-9)
            assert 2 * (q.w * q.y - q.x * q.z) == pytest.approx(np.sin(pitch), abs=1e-9)


def test_a_temperature_that_ends_is_held_and_said(run_tool: RunTool, tmp_path: Path) -> None:
    """A gap behind the first block is no step, and stands in the result."""
    sensor = replace(
        unit().without_covariance(),
        effects=('temperature_bias',),
        values={'temperature_bias': typical(effect_named('temperature_bias'), 'xy')},
    )
    count = 20000
    path = record(tmp_path, sensor, np.tile(volts_of(sensor)[:1], (count, 1)))
    read = recording.read(path)
    read.columns['temperature_c'] = np.where(np.arange(count) < 15000, 45.0, np.nan)
    recording.write(path, read, sensor)
    force = numbers(applied(run_tool, path)[0], 'ax_mps2')[0]
    np.testing.assert_allclose(force, force[0], atol=1e-9)
    done = run_tool('apply', path, '--params', path.with_name('unit.yaml'), '-o', 'again.csv')
    assert '5000 of 20000' in done.stdout


def test_temperature_and_supply_are_corrected(run_tool: RunTool, tmp_path: Path) -> None:
    effects = ('--effect', 'supply', '--effect', 'temperature_bias:per_k=1e-3')
    made = run_tool('simulate', 'soak', '--rate', '2', *effects, '-o', 'soak.csv')
    assert made.returncode == 0, made.stderr
    sensor = with_neutral(nominal('xy'), ['supply', 'temperature_bias'])
    sensor = replace(
        sensor,
        values={
            **sensor.values,
            'supply': typical(library()['supply'], 'xy'),
            'temperature_bias': {'per_k': np.full(2, 1e-3)},
        },
    )
    parameter_file.save(tmp_path / 'unit.yaml', sensor)
    done = run_tool('apply', 'soak.csv', '--params', 'unit.yaml', '-o', 'out.csv')
    assert done.returncode == 0 and not done.stderr
    ax = np.genfromtxt(tmp_path / 'out.csv', delimiter=',', names=True)['ax_mps2']
    assert np.abs(ax - G * np.sin(np.radians(60)) * np.cos(np.radians(30))).max() < 0.03
    bare = [
        ','.join(line.split(',')[:3]) if line[0] != '#' else line
        for line in (tmp_path / 'soak.csv').read_text().splitlines()
    ]
    (tmp_path / 'bare.csv').write_text('\n'.join(bare) + '\n')
    done = run_tool('apply', 'bare.csv', '--params', 'unit.yaml', '-o', 'out.csv')
    assert done.returncode == 0 and 'supply_v is not recorded' in done.stdout
