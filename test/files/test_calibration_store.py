# SPDX-License-Identifier: Apache-2.0

"""Provenance and calibration store by `fit`: copies by serial number and date, earlier files."""

from dataclasses import replace
import hashlib
import shutil
import subprocess

from adxl_ros.files import calibration_store, parameter_file
import numpy as np
from processes import executable, PATIENCE, run_executable
import pytest
from units import drawn, NOMINAL, nominal

pytestmark = pytest.mark.long

DATED = {'date': '2026-01-02T03:04:05+00:00', 'data_sha256': 'ab' * 32}


@pytest.fixture
def swept_csv(made_once):
    """Return a folder with a sweep of the unit U/7, its temperature, supply and nominal file."""
    return made_once('swept', sweep)


def sweep(folder):
    (folder / 'u7.yaml').write_text(NOMINAL.read_text().replace('serial: nominal', 'serial: U/7'))
    done = run_executable(
        'simulate',
        'sweep',
        '--params',
        'u7.yaml',
        '--rate',
        '100',
        '--effect',
        'bias',
        '--effect',
        'misalignment',
        '--seed',
        '5',
        '-o',
        'sweep.csv',
        cwd=folder,
    )
    assert done.returncode == 0, done.stderr
    lines = (folder / 'sweep.csv').read_text().splitlines()
    head = next(i for i, line in enumerate(lines) if line.startswith('time_s'))
    first = [name for name in lines[head].split(',') if name not in ('temperature_c', 'supply_v')]
    kept = [lines[head].split(',').index(name) for name in first]
    rows = [','.join([*first, 'temperature_c', 'supply_v'])]
    for i, line in enumerate(lines[head + 1 :]):
        cells = line.split(',')
        rows.append(','.join([*(cells[k] for k in kept), f'{22 + i / len(lines):.3f}', '4.95']))
    (folder / 'sweep.csv').write_text('\n'.join([*lines[:head], *rows]) + '\n')


def test_provenance_store_and_the_previous_file(run_tool, swept_csv, tmp_path):
    """The file states its provenance. A second fit keeps the first file, and both are stored."""
    shutil.copytree(swept_csv, tmp_path, dirs_exist_ok=True)
    done = run_tool(
        'fit', 'sweep.csv', '--params', 'u7.yaml', '--model', 'physical', '-o', 'u.yaml'
    )
    assert done.returncode == 0, done.stderr
    first = (tmp_path / 'u.yaml').read_text()
    sensor = parameter_file.load(tmp_path / 'u.yaml')
    provenance = sensor.provenance
    raw = (tmp_path / 'sweep.csv').read_bytes()
    assert provenance['data_sha256'] == hashlib.sha256(raw).hexdigest()
    assert provenance['temperature_c'] == '22.50'
    assert provenance['supply_v'] == '4.9500'
    assert provenance['poses'] == '125'
    assert provenance['sweep'] == '5 planes alpha'
    assert provenance['package_version'] and provenance['date'] and provenance['residual_mg']
    assert float(provenance['held_out_tilt_rms_deg']) > 0
    assert provenance['id'].startswith('U/7-20')
    assert provenance['id'].endswith(provenance['data_sha256'][:8])
    assert sensor.envelope.temperature_c == pytest.approx((22.0, 23.0), abs=0.05)
    assert sensor.envelope.force_high_mps2[0] > 9
    assert (sensor.serial, sensor.model) == ('U/7', 'physical')
    folder = tmp_path / 'ros_home' / 'adxl_ros' / 'calibrations' / 'U%2F7'
    (kept,) = folder.iterdir()
    assert kept.read_text() == first
    assert f'kept as {kept}' in done.stderr

    done = run_tool(
        'fit',
        'sweep.csv',
        '--params',
        'u7.yaml',
        '--model',
        'linear',
        '-o',
        'u.yaml',
        '--store',
        'elsewhere',
    )
    assert done.returncode == 0, done.stderr
    assert parameter_file.load(tmp_path / 'u.yaml').model == 'linear'
    assert (tmp_path / 'u.yaml.previous').read_text() == first
    assert len(list((tmp_path / 'elsewhere').rglob('*.yaml'))) == 1
    assert len(list(folder.iterdir())) == 1
    # Nodes and tools load the written parameters.
    done = run_tool('apply', 'sweep.csv', '--params', 'u.yaml', '-o', 'out.csv')
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize('serial', ['17', 'A/B', '..', 'ä €', '-x', 'ä' * 200])
def test_each_serial_number_has_its_folder(tmp_path, serial):
    sensor = replace(drawn(np.random.default_rng(1), nominal(serial=serial)), provenance=DATED)
    path = calibration_store.put(tmp_path / 'store', sensor)
    assert path.parent.parent == tmp_path / 'store'
    assert calibration_store.newer(tmp_path / 'store', sensor) is None
    old = replace(sensor, provenance={'date': '2025-01-02T03:04:05+00:00'})
    assert calibration_store.newer(tmp_path / 'store', old) == path
    ((stored, again),) = calibration_store.history(tmp_path / 'store', serial).calibrations
    assert stored == path and again.serial == serial


def test_history_is_ordered_by_date_and_names_unreadable_files(tmp_path):
    sensor = drawn(np.random.default_rng(1), nominal(serial='17'))
    dates = ['2026-03-01T00:00:00+00:00', '2025-12-24T00:00:00+00:00', '2026-02-01T00:00:00']
    for date in dates:
        calibration_store.put(tmp_path, replace(sensor, provenance={'date': date}))
    parameter_file.save(tmp_path / '17' / 'other.yaml', replace(sensor, serial='18'))
    (tmp_path / '17' / 'half.yaml').write_text('/**:\n  ros__par')
    calibrations, refused = calibration_store.history(tmp_path, '17')
    assert [s.provenance['date'] for _, s in calibrations] == [dates[1], dates[2], dates[0]]
    assert len(refused) == 2 and 'half.yaml:' in refused[0] and 'unit 18' in refused[1]


def test_a_full_disk_keeps_the_old_file(swept_csv, tmp_path):
    """If no file can exceed a kilobyte, the old file is kept and no other file remains."""
    shutil.copytree(swept_csv, tmp_path, dirs_exist_ok=True)
    (tmp_path / 'u.yaml').write_text('old')
    there = {path.name for path in tmp_path.iterdir()}
    done = subprocess.run(
        [
            'bash',
            '-c',
            'ulimit -f 1; trap "" XFSZ; exec "$@"',
            'bash',
            executable('fit'),
            'sweep.csv',
            '--params',
            'u7.yaml',
            '--model',
            'linear',
            '-o',
            'u.yaml',
            '--overwrite',
        ],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=60 * PATIENCE,
    )
    assert done.returncode == 1
    assert 'u.yaml: cannot write: File too large' in done.stderr
    assert done.stderr.count('\n') == 1
    assert (tmp_path / 'u.yaml').read_text() == 'old'
    assert {path.name for path in tmp_path.iterdir()} == there | {'u.yaml.previous'}
