# SPDX-License-Identifier: Apache-2.0

"""Recordings of `import adxl_ros`: arrays, tables and what they refuse."""

import subprocess
import sys

import adxl_ros as adxl
import numpy as np
import pandas as pd
import pytest

TIME_S = np.arange(400) / 100.0
ACCEL = {'ax_mps2': np.sin(TIME_S), 'ay_mps2': np.cos(TIME_S), 'az_mps2': np.full(400, 9.8)}


def test_the_import_is_light_and_loads_no_ros() -> None:
    code = (
        'import sys, time; begin = time.process_time(); import adxl_ros; '
        'print(time.process_time() - begin, "numpy" in sys.modules); '
        'adxl_ros.diagnose, adxl_ros.read; print("rclpy" in sys.modules)'
    )
    printed = subprocess.run(
        [sys.executable, '-c', code], text=True, capture_output=True, check=True
    ).stdout.split()
    assert float(printed[0]) < 0.2
    assert printed[1:] == ['False', 'False']


def test_every_name_is_there() -> None:
    assert all(callable(getattr(adxl, name)) for name in adxl.__all__)
    assert adxl.__version__ and set(adxl.__all__) < set(dir(adxl))
    with pytest.raises(AttributeError, match='no_such_verb'):
        _ = adxl.no_such_verb


def test_arrays_tables_and_files_hold_the_same(tmp_path) -> None:
    recording = adxl.from_arrays(time_s=TIME_S, **ACCEL)
    table = pd.DataFrame({'time_s': TIME_S, **ACCEL})
    table.to_csv(tmp_path / 'log.csv', index=False)
    for other in (
        adxl.from_arrays(table),
        adxl.read(table),
        adxl.read(tmp_path / 'log.csv'),
        adxl.from_arrays(rate=100, **ACCEL),
    ):
        np.testing.assert_allclose(other.time_s, recording.time_s, atol=1e-12)
        np.testing.assert_allclose(other.columns['ay_mps2'], ACCEL['ay_mps2'], rtol=1e-9)
    pd.testing.assert_series_equal(
        recording.to_pandas()['ax_mps2'].reset_index(drop=True), table['ax_mps2']
    )
    assert str(recording) == 'arrays: 3.99 s, 100 Hz, axes x y z'


def test_a_table_of_other_software_is_read_by_its_mapping() -> None:
    table = pd.DataFrame({'t': 1000 * TIME_S, 'X': 1000 * ACCEL['ax_mps2'] / 9.80665})
    recording = adxl.read(table, columns={'time': 't:ms', 'x': ('X', 'mg')})
    np.testing.assert_allclose(recording.columns['ax_mps2'], ACCEL['ax_mps2'], atol=1e-9)
    assert recording.rate_hz == 100.0


def test_axes_are_drawn_into_those_that_are_given() -> None:
    from matplotlib.figure import Figure

    axes = Figure().subplots()
    assert adxl.from_arrays(rate=100, **ACCEL).plot(axes) is axes
    assert len(axes.lines) == 3 and axes.get_xlabel() == 'time, s'


@pytest.mark.parametrize('name', ['log.csv', 'log.mcap'])
def test_a_recording_saves_itself(name: str, tmp_path) -> None:
    recording = adxl.from_arrays(time_s=TIME_S, temperature_c=25 + TIME_S, **ACCEL)
    recording.save(tmp_path / name)
    again = adxl.read(tmp_path / name)
    np.testing.assert_allclose(again.time_s, TIME_S, atol=1e-9)
    for column in (*ACCEL, 'temperature_c'):
        np.testing.assert_allclose(
            again.columns[column], recording.columns[column], rtol=1e-6, atol=1e-9
        )


@pytest.mark.parametrize(
    'arrays, named',
    [
        ({'ax_mps2': [1.0, 2.0]}, 'time'),
        ({'time_s': [0.0, 1.0, 2.0], 'ax_mps2': [1.0, 2.0]}, 'ax_mps2'),
        ({'time_s': [0.0, 0.1], 'gx_mps2': [1.0, 2.0]}, 'gx_mps2'),
        ({'time_s': [0.2, 0.1], 'ax_mps2': [1.0, 2.0]}, 'arrays: row 2'),
        ({'time_s': [0.1, 0.2], 'ax_mps2': [1.0, 1e9]}, 'arrays: row 2 of ax_mps2'),
    ],
)
def test_what_is_no_recording_is_refused_by_name(arrays: dict, named: str) -> None:
    with pytest.raises(adxl.UserError, match=named):
        adxl.from_arrays(**arrays)
