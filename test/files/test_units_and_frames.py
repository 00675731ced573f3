# SPDX-License-Identifier: Apache-2.0

"""Units, frames and stamps of recordings that other software wrote."""

from pathlib import Path

from adxl_ros.errors import UserError
from adxl_ros.files import recording
from adxl_ros.files.column_mapping import parse_mapping, parse_mounting, ReadingOptions
from adxl_ros.files.mapping_proposal import propose
from adxl_ros.files.tables import open_table
from adxl_ros.model.constants import G0_MPS2
from bags import bag_of, EPOCH_NS, imu
from foreign_logs import lines
import numpy as np
import pytest
import scipy.io

FORCE_MPS2 = np.tile([1.0, -2.0, 9.5], (50, 1)) + 0.1 * np.sin(np.arange(50.0))[:, None]
TIME_S = 0.01 * np.arange(50)
IN_UNIT = {
    'g': 1 / G0_MPS2,
    'mg': 1e3 / G0_MPS2,
    'mps2': 1.0,
    'mmps2': 1e3,
    'lsb': 16384 / G0_MPS2,
}
"""Reading of 1 m/s² by the name of a unit."""


def bag_and_table(folder: Path, readings: np.ndarray) -> tuple[Path, Path]:
    """Write readings, named as if in m/s², as a bag and as a table."""
    bag_of(
        folder / 'bag',
        [
            imu(EPOCH_NS + round(1e9 * time_s), reading, variance=(0, 0, 0))
            for time_s, reading in zip(TIME_S, readings)
        ],
    )
    table = folder / 'table.csv'
    table.write_text(
        'time_s,ax_mps2,ay_mps2,az_mps2\n' + lines([TIME_S, *readings.T], ['%.3f'] + ['%.9f'] * 3)
    )
    return folder / 'bag', table


def read_in(path: Path, unit: str) -> recording.Recording:
    counts = (16384.0,) if unit == 'lsb' else ()
    return recording.read(path, ReadingOptions(unit=unit, lsb_per_g=counts))


@pytest.mark.parametrize('unit', IN_UNIT)
def test_one_option_states_the_unit_of_a_bag_and_of_a_table(tmp_path: Path, unit: str) -> None:
    """Bags and tables whose columns are named as if in m/s² become m/s² by the same option."""
    readings = FORCE_MPS2 * IN_UNIT[unit]
    for path in bag_and_table(tmp_path, readings):
        read = read_in(path, unit)
        force = np.column_stack([read.columns[name] for name in read.sensor_columns])
        np.testing.assert_allclose(force, FORCE_MPS2, atol=1e-6)


def test_a_unit_is_stated_once(tmp_path: Path) -> None:
    mapping = parse_mapping('time=t:s,x=x:mg,y=y:mg,z=z:mg')
    with pytest.raises(UserError, match='--unit g.*--columns'):
        ReadingOptions(mapping=mapping, unit='g')
    assert ReadingOptions(mapping=mapping, unit='mg').unit == 'mg'
    table = tmp_path / 'volts.csv'
    table.write_text('time_s,x_v\n' + lines([TIME_S, FORCE_MPS2[:, 0]], ['%.3f'] * 2))
    with pytest.raises(UserError, match='--unit g: x_v'):
        recording.read(table, ReadingOptions(unit='g'))


def options_for(folder: Path, header: str, time: np.ndarray, readings: np.ndarray) -> str:
    path = folder / 'log.csv'
    path.write_text(f'{header}\n' + lines([time, *readings.T], ['%.4f'] + ['%.6g'] * 3))
    return propose(open_table(path))[1]


@pytest.mark.parametrize(
    ('length', 'expected'),
    [
        (9700.4, 'z:mmps2'),
        (9806.0, 'z:mmps2'),
        (8192.0, 'z:lsb'),
        (9.7, 'z:mps2'),
        (1000.0, 'z:mg'),
        (1024.0, 'z:lsb'),
    ],
)
def test_the_unit_is_guessed_by_the_nearest_length_of_gravity(
    tmp_path: Path, length: float, expected: str
) -> None:
    readings = np.tile([0.0, 0.0, length], (50, 1))
    assert expected in options_for(tmp_path, 't,x,y,z', TIME_S, readings)


@pytest.mark.parametrize(
    ('header', 'counter'),
    [
        ('Packet number,x,y,z', 10 * np.arange(50)),
        ('sampleIndex,x,y,z', 2 * np.arange(50)),
        ('n,x,y,z', np.arange(50) + (np.arange(50) > 20)),
    ],
)
def test_a_counter_is_no_time(tmp_path: Path, header: str, counter: np.ndarray) -> None:
    assert options_for(tmp_path, header, counter, FORCE_MPS2).endswith('--rate HZ')


def test_an_empty_first_stamp_does_not_look_like_a_bad_one(tmp_path: Path) -> None:
    time_s = np.where(np.arange(50) == 0, np.nan, TIME_S)
    assert '--drop-bad-stamps' not in options_for(tmp_path, 't,x,y,z', time_s, FORCE_MPS2)


@pytest.mark.parametrize('text', ['x=y,y=x,z=z', 'x=-x,y=y,z=z', 'x=y,y=z,z=-x', 'x=-x,y=-y,z=-z'])
def test_a_mirror_is_no_mounting(text: str) -> None:
    with pytest.raises(UserError, match='no rotation'):
        parse_mounting(text)


@pytest.mark.parametrize(
    'text', ['x=-y,y=x,z=z', 'x=y,y=z,z=x', 'x=-x,y=-y,z=z', 'x=y,y=x,z=-z', 'x=y,y=x']
)
def test_rotations_are_mountings(text: str) -> None:
    assert len(parse_mounting(text)) == 1 + text.count(',')


@pytest.mark.parametrize('offset', ['Z', '+02:00'])
def test_dates_before_1970_rise(tmp_path: Path, offset: str) -> None:
    """Around the turn of a second before 1970, and across 1970 itself."""
    path = tmp_path / 'old.csv'
    start = np.datetime64('1969-12-31T23:59:58.750', 'ms')
    stamps = start + 250 * np.arange(12)
    path.write_text(
        'date,x,y,z\n' + ''.join(f'{stamp}{offset},0.01,0.02,1.0\n' for stamp in stamps)
    )
    read = recording.read(
        path, ReadingOptions(mapping=parse_mapping('time=date:s,x=x:g,y=y:g,z=z:g'))
    )
    np.testing.assert_allclose(np.diff(read.time_s), 0.25, atol=1e-9)


def test_a_sample_without_a_number_is_left_out_by_an_option_and_counted(tmp_path: Path) -> None:
    """Its neighbours keep their times, also where stamps are those of an index."""
    force = FORCE_MPS2.copy()
    force[7, 1] = np.nan
    for path in bag_and_table(tmp_path, force):
        with pytest.raises(UserError, match='--drop-bad-samples'):
            recording.read(path)
        for rate_hz in (None, 100.0):
            read = recording.read(path, ReadingOptions(drop_bad_samples=True, rate_hz=rate_hz))
            assert len(read) == 49
            np.testing.assert_allclose(read.time_s - read.time_s[0], np.delete(TIME_S, 7))
            assert any(': 1' in remark for remark in read.remarks), read.remarks


def test_vectors_of_matlab_are_a_table(tmp_path: Path) -> None:
    """What cannot be read is named, with the commands that write it as a table."""
    path = tmp_path / 'run.mat'
    x, y, z = FORCE_MPS2.T
    scipy.io.savemat(path, {'t': TIME_S[:, None], 'x': x, 'y': y, 'z': z[:, None], 'note': 'a'})
    read = recording.read(
        path, ReadingOptions(mapping=parse_mapping('time=t:s,x=x:mps2,y=y:mps2,z=z:mps2'))
    )
    np.testing.assert_array_equal(read.columns['az_mps2'], z)
    scipy.io.savemat(path, {'log': {'t': TIME_S, 'x': x}})
    with pytest.raises(UserError, match='writetable'):
        recording.read(path)
    path.write_bytes(b'MATLAB 7.3 MAT-file' + bytes(200))
    with pytest.raises(UserError, match=r'MATLAB file.*-v7'):
        recording.read(path)
