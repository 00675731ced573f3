# SPDX-License-Identifier: Apache-2.0

"""Recordings as bags: round trips, bags of ros2 bag, references, cuts, invalid bags, memory."""

from dataclasses import replace
from pathlib import Path
import sys

from adxl_ros.errors import UserError
from adxl_ros.files import recording
from adxl_ros.files.recording_columns import ACCEL, Recording, REFERENCES
from adxl_ros.files.stream_info import sensor_info
import numpy as np
import pytest
from reading import growth_mb, refusal
from units import nominal

rosbag2 = pytest.importorskip(
    'rosbags.rosbag2', reason='rosbags is not installed: pip install rosbags'
)
bags = pytest.importorskip('bags')
imu, info, joints, Sent, stamps = bags.imu, bags.info, bags.joints, bags.Sent, bags.stamps
EPOCH_NS, IMU, INFO, JOINTS, STORE, STRING, TYPES = (
    bags.EPOCH_NS,
    bags.IMU,
    bags.INFO,
    bags.JOINTS,
    bags.STORE,
    bags.STRING,
    bags.TYPES,
)


def recorded(count: int = 3000, axes: str = 'xyz') -> Recording:
    rng = np.random.default_rng(1)
    columns = {f'{axis}_v': rng.normal(2.5, 0.5, count) for axis in axes}
    columns.update({name: rng.normal(size=count) for name in REFERENCES})
    columns['supply_v'] = rng.uniform(4.9, 5.1, count).astype(np.float32).astype(float)
    steps = rng.integers(10**5, 10**7, count)
    return Recording(
        'made',
        np.cumsum(steps) / 1e9,
        columns,
        {**sensor_info(nominal(axes)), 'place': 'bench 3'},
        epoch_ns=EPOCH_NS,
    )


@pytest.mark.parametrize('name', ['run', 'run.v2', 'run.mcap'])
@pytest.mark.parametrize('axes', ['x', 'xy', 'xyz'])
def test_round_trip_to_the_bit(tmp_path: Path, name: str, axes: str) -> None:
    sent = recorded(axes=axes)
    sensor = nominal(axes)
    for _ in range(2):  # the second file replaces the first
        recording.write(tmp_path / name, sent, sensor)
    assert [path.name for path in tmp_path.iterdir()] == [name]
    got = recording.read(tmp_path / name)
    assert list(got.columns) == [*ACCEL[: len(axes)], *REFERENCES]
    assert (got.accel_mps2(sensor) == sent.accel_mps2(sensor)).all()
    np.testing.assert_allclose(got.volts(sensor), sent.volts(sensor), rtol=0, atol=1e-15)
    for column in REFERENCES:
        assert (got.columns[column] == sent.columns[column]).all(), column
    assert (got.stamp_ns == sent.stamp_ns).all()
    assert got.info == sent.info
    assert got.alignments['alpha_rad'] == 0.0
    again = replace(got, path='again')
    recording.write(tmp_path / 'again', again, sensor)
    last = recording.read(tmp_path / 'again')
    assert all((last.columns[k] == v).all() for k, v in got.columns.items())


def test_a_written_bag_is_readable_by_other_software(tmp_path: Path) -> None:
    sensor = nominal('xy')
    sent = recorded(50, 'xy')
    recording.write(tmp_path / 'run', sent, sensor)
    accel = sent.accel_mps2(sensor)
    count: dict[str, int] = {}
    with rosbag2.Reader(tmp_path / 'run') as reader:
        latched = next(c for c in reader.connections if c.topic == '/sensor_info')
        assert latched.ext.offered_qos_profiles[0].durability.name == 'TRANSIENT_LOCAL'
        for connection, log_ns, raw in reader.messages():
            message = STORE.deserialize_cdr(raw, connection.msgtype)
            i = count[connection.topic] = count.get(connection.topic, -1) + 1
            if connection.topic != '/sensor_info':
                stamp = message.header.stamp
                assert stamp.sec * 10**9 + stamp.nanosec == log_ns == sent.stamp_ns[i]
            if connection.topic == '/imu/data_raw':
                force = message.linear_acceleration
                assert [force.x, force.y, force.z] == [*accel[i], 0.0]
                assert message.header.frame_id == 'imu_link'
                assert message.orientation_covariance[0] == -1
                assert message.angular_velocity_covariance[0] == -1
                variance = message.linear_acceleration_covariance.reshape(3, 3)
                assert variance[2, 2] == 1e6
                # 110 µg/√Hz over 1/(4 RC), and the noise of 16 bits over 5 V.
                expected = (110e-6 * 9.80665) ** 2 / (4 * 32e3 * 0.33e-6)
                assert variance[0, 0] == pytest.approx(expected, rel=0.01)
            elif connection.topic == '/stage/joint_states':
                assert message.name == ['alpha', 'beta', 'shift']
                assert message.position[1] == sent.columns['beta_rad'][i]
            elif connection.topic == '/supply':
                assert message.voltage == sent.columns['supply_v'][i]
    assert count == {
        '/sensor_info': 0,
        '/imu/data_raw': 49,
        '/stage/joint_states': 49,
        '/temperature': 49,
        '/supply': 49,
    }


def converted(source: Path, target: Path, storage: str, mode: str) -> None:
    with rosbag2.Reader(source) as reader:
        writer = rosbag2.Writer(target, version=9, storage_plugin=rosbag2.StoragePlugin[storage])
        writer.set_compression(rosbag2.CompressionMode[mode], rosbag2.CompressionFormat.ZSTD)
        with writer:
            new = {
                c.id: writer.add_connection(c.topic, c.msgtype, typestore=STORE)
                for c in reader.connections
            }
            other = writer.add_connection('/rosout', STRING, typestore=STORE)
            writer.add_connection('/robot2/imu/data_raw', IMU, typestore=STORE)  # no message
            for i, (connection, log_ns, raw) in enumerate(reader.messages()):
                writer.write(new[connection.id], log_ns, raw)
                if i % 10 == 0:
                    text = STORE.serialize_cdr(TYPES[STRING](data='so'), STRING)
                    writer.write(other, log_ns, bytes(text))


@pytest.mark.parametrize(
    ('storage', 'mode'),
    [
        ('MCAP', 'NONE'),
        ('MCAP', 'STORAGE'),
        ('MCAP', 'FILE'),
        ('MCAP', 'MESSAGE'),
        ('SQLITE3', 'NONE'),
        ('SQLITE3', 'FILE'),
        ('SQLITE3', 'MESSAGE'),
    ],
)
def test_every_storage_and_compression(tmp_path: Path, storage: str, mode: str) -> None:
    recording.write(tmp_path / 'plain', recorded(), nominal('xyz'))
    plain = recording.read(tmp_path / 'plain')
    target = tmp_path / 'recorded'
    converted(tmp_path / 'plain', target, storage, mode)
    places = [target]
    if mode in ('NONE', 'STORAGE'):
        places += [path for path in target.iterdir() if path.suffix in ('.mcap', '.db3')]
    for place in places:
        got = recording.read(place)
        assert all((got.columns[k] == v).all() for k, v in plain.columns.items())
        assert (got.stamp_ns == plain.stamp_ns).all()
    if mode in ('NONE', 'STORAGE'):
        (target / 'metadata.yaml').unlink()  # as after a kill
        assert len(recording.read(target)) == len(plain)


def test_references_at_another_rate_are_interpolated(tmp_path: Path) -> None:
    times = np.array(stamps(4000))
    start = times[1000] + 300_000
    there = start + 20_000_000 * np.arange(100)  # 50 Hz, beside the samples, for 2 s
    alpha = 2.0 * (there - times[0]) * 1e-9 + 30.0  # far beyond a turn: not wrapped
    beta = np.sin(2 * np.pi * (there - times[0]) * 1e-9)
    messages = [imu(int(t)) for t in times]
    messages += [joints(int(t), alpha=a, beta=b) for t, a, b in zip(there, alpha, beta)]
    path = bags.bag_of(tmp_path / 'run', sorted(messages, key=lambda sent: sent.stamp_ns))
    got = recording.read(path)
    inside = (times >= there[0]) & (times <= there[-1])
    near = (times >= there[0] - 20_000_000) & (times <= there[-1] + 20_000_000)
    s = (times - times[0]) * 1e-9
    np.testing.assert_allclose(got.columns['alpha_rad'][inside], 2.0 * s[inside] + 30, rtol=1e-12)
    assert (np.isnan(got.columns['alpha_rad']) == ~near).all()
    assert (got.columns['alpha_rad'][near & (times < there[0])] == alpha[0]).all()
    error = np.abs(got.columns['beta_rad'] - np.sin(2 * np.pi * s))[inside].max()
    # Twice the spacing has four times the error, whose rms is 1/√2 of its largest value.
    assert error < got.alignments['beta_rad'] < 4.5 * error
    assert got.alignments['alpha_rad'] < 1e-9
    for rows in (100, 1000):
        blocks = list(recording.blocks(path, rows))
        assert np.array_equal(
            np.concatenate([b.columns['beta_rad'] for b in blocks]),
            got.columns['beta_rad'],
            equal_nan=True,
        )
        assert blocks[-1].alignments['beta_rad'] == pytest.approx(got.alignments['beta_rad'])
        assert blocks[-1].done == 1.0


def test_a_command_is_in_force_until_the_next_one(tmp_path: Path) -> None:
    """Its stamp counts, or the time of its record without a stamp. No sample waits for it."""
    times = stamps(1000)
    messages = [
        m
        for i, t in enumerate(times)
        for m in (imu(t), *([joints(t, alpha=0.0, beta=0.0)] if i % 10 == 0 else []))
    ]

    def index_after(row: int) -> int:
        return (
            next(
                i
                for i, m in enumerate(messages)
                if m.message.header == imu(times[row]).message.header and m.kind == IMU
            )
            + 1
        )

    for row, late_ns, positions in (
        (100, 500_000, {'alpha': 1.0}),
        (200, 0, {'beta': 2.0, 'other': 5.0}),
        (300, 0, {'alpha': 3.0, 'beta': np.nan}),
        (400, 0, {'alpha': np.inf}),
        (500, 0, {}),
        (600, -3_000_000, {'alpha': 1e7, 'beta': 4.0}),
    ):
        command = joints(times[row] + late_ns, '/stage/command', **positions)
        messages.insert(index_after(row), command)
    path = bags.bag_of(tmp_path / 'run', messages)
    got = recording.read(path)
    nan = np.nan
    assert np.array_equal(
        got.columns['alpha_command_rad'],
        np.repeat([nan, 1.0, 3.0], [101, 199, 700]),
        equal_nan=True,
    )
    assert np.array_equal(
        got.columns['beta_command_rad'],
        np.repeat([nan, 2.0, 4.0], [200, 397, 403]),
        equal_nan=True,
    )
    assert not any('command' in column for column in got.alignments)
    for rows in (7, 100, 1000):
        blocks = list(recording.blocks(path, rows))
        assert max(map(len, blocks)) <= rows
        for name in ('alpha_command_rad', 'beta_command_rad'):
            joined = np.concatenate([b.columns[name] for b in blocks])
            # A command that is recorded 3 ms late may not apply to the samples before it.
            assert np.count_nonzero(~((joined == got.columns[name]) | np.isnan(joined))) <= 3
            assert (np.isnan(joined) == np.isnan(got.columns[name])).all()


@pytest.mark.parametrize('name', ['run', 'run.mcap'])
def test_a_cut_file_is_read_up_to_the_cut(tmp_path: Path, name: str) -> None:
    sensor = nominal('xyz')
    recording.write(tmp_path / name, recorded(9000), sensor)
    file = tmp_path / name if name == 'run.mcap' else tmp_path / name / 'run.mcap'
    complete = recording.read(tmp_path / name)
    data = file.read_bytes()
    counts = []
    for size in (len(data) - 1, len(data) * 2 // 3, len(data) // 3):
        file.write_bytes(data[:size])
        got = recording.read(file)
        counts.append(len(got))
        assert (got.stamp_ns == complete.stamp_ns[: len(got)]).all()
        assert (got.columns['ay_mps2'] == complete.columns['ay_mps2'][: len(got)]).all()
        assert got.info == complete.info
        assert f'{file}: cut off at byte ' in got.cut and f' of {size}; the last sample' in got.cut
        assert list(recording.blocks(file, 100))[-1].cut
    assert counts[0] == 9000
    assert 4000 < counts[1] < 7000
    assert 1000 < counts[2] < 4000
    file.write_bytes(data[:60])
    assert '.mcap: cut off' in refusal(file)
    file.write_bytes(b'')
    assert ': cannot read it as a rosbag2 recording: File ' in refusal(file)


def test_damaged_files_are_refused(tmp_path: Path) -> None:
    recording.write(tmp_path / 'run.mcap', recorded(), nominal('xyz'))
    data = bytearray((tmp_path / 'run.mcap').read_bytes())
    data[-30] ^= 0xFF  # in the footer
    (tmp_path / 'footer.mcap').write_bytes(data)
    assert ': cannot read it as a rosbag2 recording: ' in refusal(tmp_path / 'footer.mcap')
    recording.write(tmp_path / 'plain', recorded(), nominal('xyz'))
    converted(tmp_path / 'plain', tmp_path / 'sql', 'SQLITE3', 'NONE')
    file = tmp_path / 'sql' / 'sql.db3'
    file.write_bytes(file.read_bytes()[:100_000])
    assert ': cannot read it as a rosbag2 recording: ' in refusal(tmp_path / 'sql')
    (tmp_path / 'text.db3').write_text('time_s,x_v')
    assert ': cannot read it as a rosbag2 recording: ' in refusal(tmp_path / 'text.db3')
    (tmp_path / 'text.mcap').write_text('time_s,x_v')
    assert refusal(tmp_path / 'text.mcap').endswith('File magic is invalid.')
    (tmp_path / 'empty').mkdir()
    assert refusal(tmp_path / 'empty').startswith(': is a directory without metadata.yaml')
    (tmp_path / 'empty' / 'metadata.yaml').write_text('so: [')
    assert 'Could not load YAML from' in refusal(tmp_path / 'empty')


T = stamps(3)
CUT_IMU = bytes(STORE.serialize_cdr(imu(T[1]).message, IMU))[:100]


@pytest.mark.parametrize(
    ('messages', 'message'),
    [
        (
            [Sent('/imu/data_raw', STRING, 0, TYPES[STRING](data=''))],
            f': no topic of type {IMU}; it holds /imu/data_raw ({STRING})',
        ),
        ([joints(T[0])], f': no topic of type {IMU}; it holds /stage/joint_states ({JOINTS})'),
        (
            [imu(T[0], topic='/imu'), imu(T[0], topic='/camera/imu')],
            f': 2 topics {IMU}; choose one with --topic: /camera/imu, /imu',
        ),
        (
            [imu(T[0], topic='/a/imu/data_raw'), imu(T[0], topic='/b/imu/data_raw')],
            f': 2 topics {IMU}; choose one with --topic: /a/imu/data_raw, /b/imu/data_raw',
        ),
        (
            [imu(T[1]), imu(T[2]), imu(T[0])],
            ': topic /imu/data_raw: message 3, stamped 1750000000.123456789 s: '
            'time runs backwards, '
            '0.002 s before the newest sample',
        ),
        (
            [imu(T[1]), imu(T[1])],
            ': topic /imu/data_raw: message 2, stamped 1750000000.124456789 s: time stands still',
        ),
        (
            [imu(T[0]), imu(T[1], (1, np.nan, 1))],
            ': topic /imu/data_raw: message 2, stamped 1750000000.124456789 s: '
            'linear_acceleration.y is '
            'nan m/s², expected a number within ±1e+06',
        ),
        (
            [imu(T[0]), imu(T[1], (1, 1, 1e38))],
            ': topic /imu/data_raw: message 2, stamped 1750000000.124456789 s: '
            'linear_acceleration.z is '
            '1e+38 m/s²',
        ),
        (
            [imu(T[0], variance=(-1, 0, 0))],
            ': topic /imu/data_raw: linear_acceleration_covariance gives the axes none',
        ),
        (
            [imu(T[0], variance=(1, 1e6, 1))],
            ': topic /imu/data_raw: linear_acceleration_covariance gives the axes xz',
        ),
        (
            [imu(T[0]), Sent('/imu/data_raw', IMU, T[1], raw=CUT_IMU)],
            ': topic /imu/data_raw: a message is damaged: 100 bytes are too few for it',
        ),
        (
            [imu(T[0]), Sent('/imu/data_raw', IMU, T[1], raw=b'\0\7' + CUT_IMU)],
            ': topic /imu/data_raw: a message is damaged: encapsulation 0x0007 is not plain CDR',
        ),
        (
            [imu(T[0]), joints(T[0], alpha=1e38)],
            ': topic /stage/joint_states: alpha_rad is 1e+38 at '
            '1750000000.123456789 s, expected -1e+06 to 1e+06',
        ),
        (
            [imu(T[0]), joints(T[1], alpha=1.0), joints(T[0], alpha=1.0)],
            ': topic /stage/joint_states: time runs backwards: 1750000000.123456789 s comes after '
            '1750000000.124456789 s',
        ),
        (
            [info(serial='A'), imu(T[0]), info(serial='B')],
            ': topic /sensor_info: serial changes from A to B; record each sensor by itself',
        ),
        (
            [info(axes='yx'), imu(T[0])],
            ": topic /sensor_info: axes is 'yx', expected x, xy or xyz",
        ),
        (
            [imu(T[0]), Sent('/sensor_info', INFO, 0, raw=b'\0\1\0\0\7')],
            ': topic /sensor_info: cannot read it as a rosbag2 recording: ',
        ),
    ],
)
def test_invalid_bags_are_refused_in_one_line(
    tmp_path: Path, messages: list[Sent], message: str
) -> None:
    assert refusal(bags.bag_of(tmp_path / 'run', messages)).startswith(message)


def test_ideal_force(tmp_path: Path) -> None:
    messages = [imu(t, (i, 2, 3), '/world/imu', (0, 0, 0)) for i, t in enumerate(T)]
    path = bags.bag_of(tmp_path / 'run', messages)
    ideal = recording.read_ideal(path, EPOCH_NS)
    assert (ideal.time_s == (np.array(T) - EPOCH_NS) / 1e9).all()
    assert [ideal.columns[name].tolist() for name in ACCEL] == [[0, 1, 2], [2] * 3, [3] * 3]
    two = [*messages, *(imu(t, topic='/other/imu') for t in T)]
    with pytest.raises(UserError, match='2 topics sensor_msgs/msg/Imu'):
        recording.read_ideal(bags.bag_of(tmp_path / 'two', two))
    with pytest.raises(UserError, match='no topic of type sensor_msgs/msg/Imu'):
        recording.read_ideal(bags.bag_of(tmp_path / 'none', [joints(T[0])]))


def test_without_rosbags(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, 'rosbags.rosbag2', None)
    (tmp_path / 'run').mkdir()
    with pytest.raises(UserError, match="pip install 'rosbags"):
        recording.read(tmp_path / 'run')
    with pytest.raises(UserError, match="pip install 'rosbags"):
        recording.write(tmp_path / 'run', recorded(5), nominal('xyz'))


def test_memory_is_bounded(tmp_path: Path) -> None:
    part = recorded(6_000, 'xy')
    del part.columns['temperature_c'], part.columns['supply_v']
    span_ns = int(part.stamp_ns[-1] - part.stamp_ns[0]) + 10**6
    with recording.writer(tmp_path / 'run', nominal('xy')) as append:
        for i in range(5):
            append(replace(part, epoch_ns=EPOCH_NS + i * span_ns))
    assert len(recording.read(tmp_path / 'run')) == 30_000
    assert growth_mb(tmp_path / 'run') < 2
