# SPDX-License-Identifier: Apache-2.0

"""Recordings as CSV: round trips, real files, invalid files, memory, speed."""

from pathlib import Path
import sys

from adxl_ros.errors import UserError
from adxl_ros.files import csv_file, recording
from adxl_ros.files.csv_file import csv_writer
from adxl_ros.files.recording_columns import ACCEL, Recording
from adxl_ros.files.stream_info import check_same_sensor, sensor_info
import numpy as np
from pace import within
import pytest
from reading import growth_mb, refusal
from units import nominal

HEADER = 'time_s,x_v,y_v,alpha_rad,beta_rad'
GOOD = '0.0,2.5,2.6,1.5,0.1\n0.001,2.51,2.61,,\n0.002,2.52,2.62,1.6,0.2\n'


@pytest.fixture(autouse=True, params=['large', 'small'])
def parser(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Read small files as large ones, by pandas; write the others as without pyarrow."""
    if request.param == 'large':
        monkeypatch.setattr(csv_file, '_PANDAS_BYTES', 0)
    else:
        monkeypatch.setitem(sys.modules, 'pyarrow.csv', None)


def written(tmp_path: Path, text: str | bytes, name: str = 'run.csv') -> Path:
    path = tmp_path / name
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def recorded(rng: np.random.Generator, count: int = 3000, axes: str = 'xyz') -> Recording:
    columns = {f'{axis}_v': rng.normal(2.5, 0.5, count) for axis in axes}
    for name in ('alpha_rad', 'beta_rad', 'shift_m', 'temperature_c', 'supply_v'):
        columns[name] = np.where(rng.random(count) < 0.3, np.nan, rng.normal(size=count))
    time_s = np.cumsum(rng.uniform(1e-4, 1e-3, count))
    return Recording('made', time_s, columns, sensor_info(nominal(axes)))


def same_bits(first: np.ndarray, second: np.ndarray) -> bool:
    return np.array_equal(first, second, equal_nan=True) and np.array_equal(
        np.signbit(first[~np.isnan(first)]), np.signbit(second[~np.isnan(second)])
    )


def test_round_trip_to_the_bit(tmp_path: Path) -> None:
    sent = recorded(np.random.default_rng(1))
    sent.columns['x_v'][:6] = [0.1, -0.0, 5e-324, 1 / 3, -123456.789e-9, 2.0**0.5]
    sent.columns['other'] = np.where(sent.time_s > 0.5, np.inf, 1e300)
    path = tmp_path / 'run.csv'
    recording.write(path, sent, nominal('xyz'))
    got = recording.read(path)
    assert list(got.columns) == list(sent.columns)
    assert same_bits(got.time_s, sent.time_s)
    for name, values in sent.columns.items():
        assert same_bits(got.columns[name], values), name
    assert got.info == sent.info
    assert got.axes == 'xyz'
    assert got.done == 1.0


def test_another_unit_is_refused() -> None:
    carried = recorded(np.random.default_rng(5), 5)
    carried.info['serial'] = 'A17'
    check_same_sensor(carried.stream_info, carried.axes, nominal('xyz'))
    check_same_sensor(carried.stream_info, carried.axes, nominal('xyz', serial='A17'))
    with pytest.raises(UserError, match=r'A17.*B4'):
        check_same_sensor(carried.stream_info, carried.axes, nominal('xyz', serial='B4'))
    with pytest.raises(UserError, match=r'axes xyz, .*for xy'):
        check_same_sensor(carried.stream_info, carried.axes, nominal('xy'))


@pytest.mark.parametrize(
    'text',
    [
        f'{HEADER}\n{GOOD}',
        f'{HEADER}\n{GOOD}'.rstrip('\n'),
        f'{HEADER}\n{GOOD}'.replace('\n', '\r\n'),
        f'\ufeff{HEADER}\n{GOOD}',
        f'# serial: A17\n\n# a remark: of many words\n{HEADER}\n# axes: xy\n{GOOD}\n# end: 1\n',
        f'{HEADER}\n   \n{GOOD}',
        f' time_s, x_v , y_v,alpha_rad,beta_rad\n{GOOD}'.replace(',', ' , '),
        f'{HEADER}\n{GOOD}'.replace(',,\n', ',nan,NaN\n'),
        'beta_rad,y_v,alpha_rad,time_s,x_v\n0.1,2.6,1.5,0,2.5\n,2.61,,1e-3,2.51\n'
        '0.2,2.62,1.6,.002,2.52\n',
        'time_s,who,x_v,y_v,alpha_rad,beta_rad\n0,"a, b",2.5,2.6,1.5,0.1\n'
        '0.001,c,"2.51",2.61,,\n0.002,"d ""e""",2.52,2.62,1.6,0.2\n',
        'time_s,x_v,y_v,ax_mps2,alpha_rad,beta_rad,\n0,2.5,2.6,1e38,1.5,0.1,\n'
        '0.001,2.51,2.61,,,,\n0.002,2.52,2.62,inf,1.6,0.2,\n',
        (f'{HEADER},who\n' + GOOD.replace('\n', ',Bär\n')).encode('cp1252'),
        f'{HEADER}\n{GOOD}'.replace(',', ';'),
    ],
    ids=[
        'plain',
        'no last newline',
        'CRLF',
        'BOM',
        'comments',
        'blank line',
        'spaces',
        'nan',
        'order',
        'text column',
        'other columns',
        'Windows',
        'semicolons',
    ],
)
def test_forms_that_are_read(tmp_path: Path, text: str | bytes) -> None:
    got = recording.read(written(tmp_path, text))
    assert got.time_s.tolist() == [0.0, 0.001, 0.002]
    assert got.columns['x_v'].tolist() == [2.5, 2.51, 2.52]
    assert got.columns['y_v'].tolist() == [2.6, 2.61, 2.62]
    assert same_bits(got.columns['alpha_rad'], np.array([1.5, np.nan, 1.6]))
    assert same_bits(got.columns['beta_rad'], np.array([0.1, np.nan, 0.2]))
    assert got.axes == 'xy'
    assert 'who' not in got.columns
    if 'ax_mps2' in str(text):
        assert same_bits(got.columns['ax_mps2'], np.array([1e38, np.nan, np.inf]))
    if 'serial' in str(text):
        assert got.info == {'serial': 'A17', 'axes': 'xy', 'end': '1'}


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('', ': is empty'),
        ('# serial: A17\n', ': is empty'),
        (f'{HEADER}\n', ': has a header, but no samples'),
        (f'{HEADER}', ': has a header, but no samples'),
        (GOOD, ': no column time_s; the columns are 1, 2, 3, 4, 5; none looks '),
        (
            f'{HEADER}\n{GOOD}'.replace('time_s', 't'),
            ':1: no column time_s; the columns are t, x_v, ',
        ),
        (f'time_s,alpha_rad\n{GOOD}', ':1: no column of a sensor: needs x_v'),
        (f'#\ntime_s,y_v,z_v\n{GOOD}', ':2: no column x_v beside y_v, z_v'),
        (f'time_s,x_v,y_v,x_v\n{GOOD}', ':1: column x_v stands twice; keep one'),
        *(
            (
                f'{head}\n{GOOD}',
                f':1:{place}: column {head.split(",")[place - 1]} is in another unit; '
                f'expected the column {right}',
            )
            for head, place, right in (
                ('time_s,x_mv', 2, 'x_v'),
                ('time_s,x_v,y_v,z_mv', 4, 'z_v'),
                ('time_s,ax_g,ay_g', 2, 'ax_mps2'),
                ('time_s,x_v,alpha_deg', 3, 'alpha_rad'),
                ('time_s,x_v,temperature_k', 3, 'temperature_c'),
            )
        ),
        (
            'time_ms,x_v\n0,2.5\n1,2.5\n',
            ':1:1: column time_ms is in another unit; expected the column time_s',
        ),
        ('time;x_v\n0;1\n', ':1: no column time_s; the columns are time, x_v; '),
        (f'{HEADER}\n{GOOD}0.003,2.5x,2,1,1\n', ":5:2: x_v is '2.5x', not a number"),
        (f'{HEADER}\n{GOOD}0.003,2_5,2,1,1\n', ":5:2: x_v is '2_5', not a number"),
        (f'{HEADER}\n\n# remark\n{GOOD}0.003,2.5,2,--,1\n', ":7:4: alpha_rad is '--', not a "),
        (f'{HEADER}\n{GOOD}0.003,2.5,2,1\n', ':5:5: 4 fields, but the header has 5'),
        (f'{HEADER}\n0,1,1,1\n1,1,1,1,1,1\n', ':2:5: 4 fields, but the header has 5'),
        (f'{HEADER}\n{GOOD}0.003,2.5,2,1,1,1\n', ':5:6: 6 fields, but the header has 5'),
        (f'{HEADER}\n{GOOD}0.003,2.', ':5:3: 2 fields, but the header has 5'),
        (f'{HEADER}\n{GOOD}0.003,2.5,2.5,1,-', ":5:5: beta_rad is '-', not a number"),
        (f'{HEADER}\n{GOOD}0.003,,2.5,1,1\n', ':5:2: x_v is empty or NaN; every sample needs it'),
        (
            f'{HEADER}\n{GOOD},2.5,2.5,1,1\n',
            ':5:1: time_s is empty or NaN; every sample needs a time',
        ),
        (
            f'{HEADER}\n{GOOD}0.003,2.5,NaN,1,1\n',
            ':5:3: y_v is empty or NaN; every sample needs it',
        ),
        (
            f'{HEADER}\n{GOOD}0.003,-inf,2.5,1,1\n',
            ':5:2: x_v is -inf, no reading of a sensor in v',
        ),
        (f'{HEADER}\n{GOOD}nan,2.5,2.5,1,1\n', ':5:1: time_s is empty or NaN'),
        (
            f'{HEADER}\n{GOOD}0.003,2.5,1e38,1,1\n',
            ':5:3: y_v is 1e+38, no reading of a sensor in v',
        ),
        (
            f'{HEADER}\n{GOOD}0.003,2.5,1e999,1,1\n',
            ':5:3: y_v is inf, no reading of a sensor in v',
        ),
        (f'{HEADER}\n{GOOD}0.003,2.5,2.5,1,-1e38\n', ':5:5: beta_rad is -1e+38, no beta in rad'),
        (
            f'{HEADER},temperature_c\n0,2.5,2.5,1,1,298\n',
            ':2:6: temperature_c is 298, no temperature in c; delete the line, or correct',
        ),
        (f'{HEADER},supply_v\n0,2.5,2.5,1,1,5000\n', ':2:6: supply_v is 5000, no supply in v'),
        (f'{HEADER}\n{GOOD}1e38,2.5,2.5,1,1\n', ':5:1: time_s is 1e+38, no time in s (200 years'),
        (
            f'{HEADER}\n{GOOD}0.0015,2.5,2.5,1,1\n',
            ':5:1: time_s: time runs backwards, 0.0005 s before the newest sample',
        ),
        (
            f'{HEADER}\n{GOOD}\n#\n0.002,2.5,2.5,1,1\n',
            ':7:1: time_s: time stands still; ',
        ),
        (
            f'# epoch_ns: soon\n{HEADER}\n{GOOD}',
            ": epoch_ns is 'soon', expected whole nanoseconds",
        ),
        (f'{HEADER}\n{GOOD}'.encode('utf-16'), ':1:1: is UTF-16; save the file as UTF-8'),
        (b'a' * 6_000_000, ': a line is longer than 1048576 bytes'),
        (b'a' * 900_000, ': the first 200 lines hold no row of numbers'),
        (b'#ROSBAG V2.0\n', ': is a bag of ROS 1; convert it: rosbags-convert'),
        (b'\x89MCAP0\r\n', ': is a bag; rename it so that it ends in .mcap'),
        (b'\x28\xb5\x2f\xfd', ': is compressed; name the directory with its metadata.yaml'),
    ],
)
def test_invalid_files_are_refused_in_one_line(
    tmp_path: Path, text: str | bytes, message: str
) -> None:
    assert refusal(written(tmp_path, text)).startswith(message)


def test_a_time_that_falls_is_no_burst(tmp_path: Path) -> None:
    rows = ''.join(f'{-i},2.5,2.5,1,1\n' for i in range(99))
    told = refusal(written(tmp_path, f'{HEADER}\n{rows}'))
    assert told.startswith(
        ':3:1: time_s: time runs backwards, 1 s before the newest sample; --drop'
    )


@pytest.mark.parametrize('place', [0, 1600, 2999])
def test_faults_in_late_lines_are_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: int
) -> None:
    monkeypatch.setattr(csv_file, '_CHUNK_BYTES', 10_000)
    lines = [f'{i / 1000!r},2.5,2.5,{i % 7},0.1' for i in range(3000)]
    lines[place] = lines[place].replace('2.5,2.5', '2.5,x')
    path = written(tmp_path, f'{HEADER}\n' + '\n'.join(lines) + '\n')
    assert refusal(path) == f":{place + 2}:3: y_v is 'x', not a number"
    if place:
        lines[place] = lines[place - 1]
        path = written(tmp_path, f'{HEADER}\n' + '\n'.join(lines) + '\n')
        assert refusal(path).startswith(f':{place + 2}:1: time_s: time stands still')


@pytest.mark.parametrize('size', [1, 7, 200])
def test_the_result_does_not_depend_on_the_blocks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, size: int
) -> None:
    rows = GOOD.replace('\n', '\r\n')
    path = written(tmp_path, f'\ufeff# serial: A17\r\n{HEADER}\n{rows}# end: 1\n0.1,1,2,3,4')
    complete = recording.read(path)
    monkeypatch.setattr(csv_file, '_CHUNK_BYTES', size)
    cut = recording.read(path)
    assert cut.info == complete.info == {'serial': 'A17', 'end': '1'}
    assert cut.time_s.tolist() == complete.time_s.tolist() == [0.0, 0.001, 0.002, 0.1]
    assert all(same_bits(cut.columns[name], complete.columns[name]) for name in complete.columns)


def test_ideal_force(tmp_path: Path) -> None:
    path = written(tmp_path, 'time_s,ay_mps2,ax_mps2,az_mps2,x_v\n0,2,1,3,\n0.5,5,4,6,7\n')
    ideal = recording.read_ideal(path)
    assert ideal.time_s.tolist() == [0.0, 0.5]
    assert [ideal.columns[name].tolist() for name in ACCEL] == [[1, 4], [2, 5], [3, 6]]
    assert recording.read_ideal(path, -(10**9)).time_s.tolist() == [1.0, 1.5]
    with pytest.raises(UserError, match='no column az_mps2'):
        recording.read_ideal(written(tmp_path, 'time_s,ax_mps2,ay_mps2\n0,1,2\n'))


@pytest.fixture
def long_csv(tmp_path: Path) -> Path:
    """Write a tenth of 3 million rows, which may need 15 s for reading."""
    path = tmp_path / 'long.csv'
    rng = np.random.default_rng(6)
    with csv_writer(path) as append:
        for start in range(0, 300_000, 50_000):
            columns = {name: rng.normal(2.5, 0.3, 50_000) for name in ('x_v', 'y_v', 'z_v')}
            append({'time_s': np.arange(start, start + 50_000) / 1000, **columns})
    return path


@pytest.mark.perf
def test_reading_is_quick(long_csv: Path) -> None:
    with within(1.5):
        assert sum(len(block) for block in recording.blocks(long_csv, 65536)) == 300_000


def test_the_memory_of_reading_is_bounded(long_csv: Path) -> None:
    assert growth_mb(long_csv) < 2
