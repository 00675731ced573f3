# SPDX-License-Identifier: Apache-2.0

"""`fleet` through its command: rows, refusals, resuming, kills, clusters and object stores."""

from contextlib import suppress
from dataclasses import replace
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
import urllib.request

from adxl_ros.files import calibration_store, parameter_file
from adxl_ros.fleet.run import only_client
from fleets import recording_text, row_files, table_of, without_timing, write_fleet
from job_tasks import children, dask_cluster, free_port
from processes import executable, run_executable
import pytest
from units import nominal

pytest.importorskip('pyarrow', reason='pyarrow is not installed: pip install adxl_ros[fleet]')
pytest.importorskip('fsspec', reason='fsspec is not installed: pip install adxl_ros[fleet]')
pytestmark = pytest.mark.long
_LONG_WAIT_S = 180.0
"""Longest wait of a test for something, s."""


def start_fleet(folder, *words, **options):
    return subprocess.Popen(
        [executable('fleet'), *map(str, words)],
        cwd=folder,
        text=True,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        **options,
    )


def by_name(rows):
    return {row['url'].rpartition('/')[2]: row for row in rows}


def test_every_recording_has_one_row(run_tool, tmp_path):
    write_fleet(tmp_path / 'day', 2, 2)
    (tmp_path / 'day' / 'cut.csv').write_text('time_s,x_v\n0,2.5\n1,oops\n')
    (tmp_path / 'day' / 'notes.txt').write_text('no recording')
    dry = run_tool(
        'fleet',
        'day',
        'gone.csv',
        '--do',
        'check,noise',
        '-o',
        'out',
        '--dry-run',
        '--store',
        'my store',
        '--retries',
        0,
    )
    assert dry.returncode == 0 and dry.stdout.startswith('6 recordings to do')
    assert 'core hours' in dry.stdout and 'U0 (2), U1 (2)' in dry.stdout
    assert re.search(r'about .* s of one core', dry.stdout)
    following = ' '.join(dry.stdout.partition(' next ')[2].replace('\\\n', '').split())
    assert following.endswith("gone.csv --do check,noise -o out --store 'my store' --retries 0")
    assert not (tmp_path / 'out').exists()
    done = run_tool('fleet', 'day', 'gone.csv', '--do', 'check,noise', '-o', 'out', '--jobs', 2)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith('6 recordings: 4 done, 2 refused')
    assert max(map(len, done.stdout.splitlines())) <= 79
    rows = by_name(table_of(tmp_path / 'out'))
    assert set(rows) == {
        'u0000_0000.csv',
        'u0000_0001.csv',
        'u0001_0000.csv',
        'u0001_0001.csv',
        'cut.csv',
        'gone.csv',
    }
    assert rows['gone.csv']['refusal'] == 'no such file'
    assert rows['cut.csv']['refusal'] == "cut.csv:3:2: x_v is 'oops', not a number"
    sound = rows['u0001_0000.csv']
    assert sound['date'].isoformat() == '2026-10-01T08:00:00+00:00'
    assert (sound['serial'], sound['date_source'], sound['outcome']) == ('U1', 'header', 'done')
    assert (sound['rate_hz'], sound['samples'], sound['axes'], sound['is_sound']) == (
        50.0,
        800,
        'xy',
        True,
    )
    # White noise of 1 mV at 50 Hz and 1 V/g.
    assert sound['noise_n_x_mps2_per_rthz'] == pytest.approx(9.80665e-3 / 50**0.5, rel=0.15)
    assert sound['noise_n_z_mps2_per_rthz'] is None
    assert sound['memory_mb'] > 1 and sound['seconds'] > 0 and sound['attempts'] == 1


def test_a_second_run_computes_only_what_is_new(run_tool, tmp_path):
    first, second, *_ = write_fleet(tmp_path / 'day', 2, 2)
    words = ('fleet', 'day', '--do', 'check', '-o', 'out', '--jobs', 1)
    assert run_tool(*words).returncode == 0
    before = row_files(tmp_path / 'out')
    assert 'Nothing to do: 4 recordings had a row before' in run_tool(*words).stdout
    assert row_files(tmp_path / 'out') == before
    # The same content at another time and another place gets the row that is there.
    os.utime(first, (0, 0))
    shutil.copy(second, tmp_path / 'day' / 'copy.csv')
    run_tool(*words)
    rows = by_name(table_of(tmp_path / 'out'))
    assert len(rows) == 5 and rows['copy.csv']['key'] == rows[second.name]['key']
    # Another content or another option makes a new row in place of the old one.
    first.write_text(recording_text('U9', '2026-10-01', 99))
    assert run_tool(*words).stdout.startswith('1 recording: 1 done')
    rows = by_name(table_of(tmp_path / 'out'))
    assert len(rows) == 5 and rows[first.name]['serial'] == 'U9'
    assert run_tool(*words, '--rate', 25).stdout.startswith('5 recordings: 5 done')
    assert {row['rate_hz'] for row in table_of(tmp_path / 'out')} == {25.0}


def test_only_failed_since_and_limit(run_tool, tmp_path):
    old, *_ = write_fleet(tmp_path / 'day', 3, 1)
    os.utime(old, (1e9, 1e9))
    words = ('fleet', 'day', 'gone.csv', '--do', 'check', '-o', 'out', '--jobs', 1)
    run_tool(*words, '--since', '2020-01-01', '--limit', 2)
    assert len(table_of(tmp_path / 'out')) == 2
    run_tool(*words)
    assert len(table_of(tmp_path / 'out')) == 4
    (tmp_path / 'gone.csv').write_text(recording_text('U7', '2026-10-01', 7))
    done = run_tool(*words, '--only-failed')
    assert done.stdout.startswith('1 recording: 1 done')
    assert by_name(table_of(tmp_path / 'out'))['gone.csv']['serial'] == 'U7'


def test_fit_and_diagnose_name_the_effect(run_tool, tmp_path):
    run_tool(
        'simulate',
        'rich',
        '--rate',
        50,
        '--effect',
        'temperature_bias',
        '--seed',
        1,
        '-o',
        'rich.csv',
    )
    done = run_tool('fleet', 'rich.csv', '-o', 'out', '--jobs', 1)
    assert done.returncode == 0, done.stderr
    (row,) = table_of(tmp_path / 'out')
    assert (row['outcome'], row['status'], row['effects']) == (
        'done',
        'explained',
        ['temperature_bias'],
    )
    assert row['gap_before_low_mps2'] < row['gap_before_mps2'] < row['gap_before_high_mps2']
    assert row['gap_floor_low_mps2'] < row['gap_floor_mps2'] < row['gap_floor_high_mps2']
    assert row['gap_after_mps2'] < row['gap_before_mps2'] and row['gap_closed'] > 0.5
    assert abs(row['zero_g_x_v'] - 2.5) < 0.05 and 0 < row['zero_g_std_x_v'] < 0.01
    report = tmp_path / 'out' / row['report']
    written = json.loads((report / 'report.json').read_text())
    assert written['verdict']['status'] == 'explained'
    # A report names the recording, and not the copy that is gone.
    assert [noise['recording'] for noise in written['gap']['noise']] == [
        str(tmp_path / 'rich.csv')
    ]
    assert f'diagnose {tmp_path / "rich.csv"} -o gap' in (report / 'report.html').read_text()
    parameter_file.load(report / 'params.yaml')
    parameter_file.load(report / 'unit.yaml')


def test_the_calibration_is_that_of_the_date(run_tool, tmp_path):
    write_fleet(tmp_path / 'day', 1, 60)
    sensor = nominal(serial='U0')
    values = {'bias': {'offset_v': [0.01, 0.0]}}
    for date in ('2026-10-05T00:00:00+0000', '2026-11-10T00:00:00+0000'):
        calibration_store.put(
            tmp_path / 'store',
            replace(
                sensor,
                effects=('bias',),
                values=values,
                model='linear',
                provenance={'id': f'U0-{date[:10]}', 'date': date},
            ),
        )
    names = [f'day/u0000_{day:04d}.csv' for day in (1, 10, 55)]
    run_tool('fleet', *names, '--do', 'check', '-o', 'out', '--store', 'store', '--jobs', 1)
    before, first, second = table_of(tmp_path / 'out')
    assert (before['calibration_id'], before['validity']) == (None, 'not calibrated')
    assert (first['calibration_id'], first['calibration_age_days']) == (
        'U0-2026-10-05',
        pytest.approx(6 + 8 / 24),
    )
    assert (second['calibration_id'], second['validity']) == (
        'U0-2026-11-10',
        'valid, temperature not known',
    )


def test_a_manifest_states_unit_parameters_and_date(run_tool, tmp_path):
    (path,) = write_fleet(tmp_path / 'day', 1, 1)
    parameter_file.save(tmp_path / 'day' / 'mine.yaml', nominal(serial='M3'))
    (tmp_path / 'day' / 'list.csv').write_text(
        'url,serial,params,date\nu0000_0000.csv,U0,,2025-01-02\n'
    )
    run_tool('fleet', 'day/list.csv', '--do', 'check', '-o', 'out', '--jobs', 1)
    (row,) = table_of(tmp_path / 'out')
    assert (row['url'], row['date'].year, row['date_source']) == (str(path), 2025, 'manifest')
    # The manifest is corrected: nothing is computed again, and the row has the new date.
    (tmp_path / 'day' / 'list.csv').write_text(
        'url,serial,params,date\nu0000_0000.csv,U0,,2025-03-02\n'
    )
    run_tool('fleet', 'day/list.csv', '--do', 'check', '-o', 'out', '--jobs', 1)
    (corrected,) = table_of(tmp_path / 'out')
    assert (corrected['date'].month, corrected['key']) == (3, row['key'])
    (tmp_path / 'day' / 'list.csv').write_text('\nurl,serial\n\nu0000_0000.csv\n')
    wrong = run_tool('fleet', 'day/list.csv', '-o', 'out')
    assert wrong.returncode == 1
    assert 'day/list.csv: row 1: has not the 2 columns of the header' in wrong.stderr


def test_what_cannot_be_reached_or_read_is_a_row(run_tool, tmp_path):
    """A dead server, an empty file and a manifest in a folder do not stop the others."""
    write_fleet(tmp_path / 'day', 1, 1)
    (tmp_path / 'day' / 'empty.csv').write_text('')
    dead = f'127.0.0.1:{free_port()}'
    (tmp_path / 'day' / 'list.csv').write_text(
        f'url,serial\n\nu0000_0000.csv,U0\nftp://robot:secret@{dead}/a.csv,\ngs2://b/b.csv,\n'
    )
    words = ('--do', 'check', '--jobs', 1, '-o')
    run_tool('fleet', 'day/list.csv', *words, 'listed')
    rows = {row['url']: row['refusal'] for row in table_of(tmp_path / 'listed')}
    refused = 'cannot be opened: [Errno 111] Connection refused'
    assert rows == {
        f'ftp://robot@{dead}/a.csv': refused,
        'gs2://b/b.csv': 'Protocol not known: gs2',
        str(tmp_path / 'day' / 'u0000_0000.csv'): None,
    }
    done = run_tool('fleet', 'day', *words, 'found', '--limit', 2)
    assert '1 by --since, --limit or --only-failed' in done.stdout
    run_tool('fleet', 'day', *words, 'found')
    rows = by_name(table_of(tmp_path / 'found'))
    assert rows['empty.csv']['refusal'] == 'is empty'
    assert rows['list.csv']['outcome'] == 'refused'
    assert rows['u0000_0000.csv']['serial'] == 'U0'


def test_kills_lose_and_repeat_nothing(tmp_path):
    chance = random.Random(5)
    write_fleet(tmp_path / 'day', 4, 12)
    words = ('day', '--do', 'check', '-o', 'out', '--jobs', 2, '--retries', 20)
    written = {}
    for _ in range(2):
        with start_fleet(tmp_path, *words, start_new_session=True) as client:
            wanted = len(written) + chance.randrange(6, 14)
            end_s, next_kill = time.monotonic() + _LONG_WAIT_S, 0
            while len(row_files(tmp_path / 'out')) < wanted:
                assert time.monotonic() < end_s and client.poll() is None
                if len(row_files(tmp_path / 'out')) >= next_kill:
                    for pid in children(client.pid)[:1]:
                        with suppress(ProcessLookupError):
                            os.kill(pid, signal.SIGKILL)
                    next_kill = len(row_files(tmp_path / 'out')) + chance.randrange(3, 7)
                time.sleep(0.02)
            client.send_signal(signal.SIGKILL)
        now = row_files(tmp_path / 'out')
        assert {name: now[name] for name in written} == written
        written = now
    last = run_executable('fleet', *words, cwd=tmp_path)
    assert last.returncode == 0, last.stderr
    now = row_files(tmp_path / 'out')
    assert {name: now[name] for name in written} == written
    calm = run_executable('fleet', *words[:4], 'calm', *words[5:], cwd=tmp_path)
    assert calm.returncode == 0, calm.stderr
    rows = table_of(tmp_path / 'out')
    assert len({row['url'] for row in rows}) == len(rows) == 48
    assert without_timing(rows) == without_timing(table_of(tmp_path / 'calm'))


def test_a_folder_has_one_client_at_a_time(run_tool, tmp_path):
    write_fleet(tmp_path / 'day', 2, 2)
    words = ('day', '--do', 'check', '-o', 'out', '--jobs', 1)
    (tmp_path / 'out').mkdir()
    with only_client(tmp_path / 'out'):
        second = run_tool('fleet', *words)
    assert second.returncode == 1
    assert second.stderr == (
        f'fleet: out: process {os.getpid()} on {os.uname().nodename} works on it; '
        'wait for its end, or name another folder\n'
    )
    assert run_tool('fleet', *words).returncode == 0
    assert len(table_of(tmp_path / 'out')) == 4


def test_a_cluster_makes_the_same_table(tmp_path):
    pytest.importorskip(
        'distributed', reason='distributed is not installed: pip install distributed'
    )
    write_fleet(tmp_path / 'day', 5, 10)
    words = ('day', '--do', 'check', '--retries', 20)
    with (
        dask_cluster(tmp_path) as cluster,
        start_fleet(tmp_path, *words, '-o', 'out', '--scheduler', cluster.address) as client,
    ):
        end_s = time.monotonic() + _LONG_WAIT_S
        for count, kill in ((6, lambda: cluster.kill_worker(0)), (24, cluster.kill_scheduler)):
            while len(row_files(tmp_path / 'out')) < count:
                assert time.monotonic() < end_s
                time.sleep(0.05)
            kill()
        _, error = client.communicate(timeout=_LONG_WAIT_S)
        assert client.returncode == 1
        assert 'was lost; start it again, and the same command continues' in error
        assert error.count('\n') == 1
        again = run_executable(
            'fleet', *words, '-o', 'out', '--scheduler', cluster.address, cwd=tmp_path
        )
        assert (again.returncode, again.stderr) == (0, '')
    calm = run_executable('fleet', *words, '-o', 'calm', '--jobs', 2, cwd=tmp_path)
    assert calm.returncode == 0, calm.stderr
    assert without_timing(table_of(tmp_path / 'out')) == without_timing(
        table_of(tmp_path / 'calm')
    )


@pytest.fixture
def bucket(tmp_path, monkeypatch):
    """Yield a client of an object store on this machine with a bucket `robots`."""
    for name in ('moto', 's3fs', 'boto3'):
        pytest.importorskip(
            name, reason=f'{name} is not installed: pip install -r requirements/test.txt'
        )
    import boto3

    url = f'http://127.0.0.1:{free_port()}'
    for name, value in {
        'AWS_ENDPOINT_URL': url,
        'AWS_ACCESS_KEY_ID': 'a',
        'AWS_SECRET_ACCESS_KEY': 'b',
        'AWS_DEFAULT_REGION': 'us-east-1',
    }.items():
        monkeypatch.setenv(name, value)
    with subprocess.Popen(
        [sys.executable, '-m', 'moto.server', '-p', url.rpartition(':')[2]],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    ) as server:
        end_s = time.monotonic() + _LONG_WAIT_S
        while True:
            with suppress(OSError):
                urllib.request.urlopen(url).close()
                break
            assert time.monotonic() < end_s and server.poll() is None
            time.sleep(0.05)
        client = boto3.client('s3')
        client.create_bucket(Bucket='robots')
        yield client
        server.kill()


def test_an_object_store(bucket, tmp_path):
    for path in write_fleet(tmp_path / 'day', 2, 2):
        bucket.upload_file(str(path), 'robots', f'2026/{path.name}')
    words = (
        's3://robots/2026/*.csv',
        's3://robots/gone.csv',
        '--do',
        'check',
        '-o',
        'out',
        '--jobs',
        1,
    )
    done = run_executable('fleet', *words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    rows = by_name(table_of(tmp_path / 'out'))
    assert len(rows) == 5 and rows['gone.csv']['refusal'] == 'no such file'
    assert rows['u0000_0001.csv']['url'] == 's3://robots/2026/u0000_0001.csv'
    assert rows['u0000_0001.csv']['serial'] == 'U0'
    # What the store states of an object shows that it need not be read again.
    again = run_executable('fleet', *words, cwd=tmp_path)
    assert again.stdout.startswith('Nothing to do: 5 recordings had a row before')
    bucket.put_object(
        Bucket='robots',
        Key='2026/u0000_0000.csv',
        Body=recording_text('U5', '2026-10-01', 5).encode(),
    )
    changed = run_executable('fleet', *words, cwd=tmp_path)
    assert changed.stdout.startswith('1 recording: 1 done')


def test_wrong_usage_is_one_line(run_tool, tmp_path):
    (tmp_path / 'empty').mkdir()
    (tmp_path / 'list.csv').write_text('url,serial\n')
    for words, text in (
        (['empty'], 'has no recording'),
        (['none/*.csv'], 'matches nothing'),
        (['list.csv'], 'list.csv: the manifest has no row'),
        (['empty', '--do', 'check,dance'], "'dance' is no task"),
        (['empty', '--since', 'May'], '--since May: expected a date'),
        (['x.csv', '--jobs', 0], '--jobs 0'),
        (['gs2://x/y.csv'], 'gs2://x/y.csv'),
    ):
        done = run_tool('fleet', *words, '-o', 'out')
        assert done.returncode == 1, done
        (line,) = done.stderr.splitlines()
        assert text in line
    assert not (tmp_path / 'out').exists()
