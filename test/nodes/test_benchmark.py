# SPDX-License-Identifier: Apache-2.0

"""The table of the benchmark: ratios of processor time, measured in turns, and a rival."""

from functools import partial
import re
import sys

from adxl_ros.errors import UserError
from adxl_ros_validation import bench_command, bench_jobs
from adxl_ros_validation.bench_jobs import Job, print_table, rows_of
from processes import executable
import pytest
from units import nominal


def missing() -> None:
    raise ModuleNotFoundError('no such library')


def test_rows_state_the_ratio_to_each_rival_and_what_is_not_installed() -> None:
    spent_s = 0.0

    def work(seconds: float) -> None:
        nonlocal spent_s
        spent_s += seconds

    make = partial(Job, clock=lambda: spent_s)
    job = make(
        'count',
        lambda: work(0.3),
        1.5,
        {'rival': lambda: work(0.2), 'other': missing, 'slow': lambda: work(3.0)},
    )
    first, second, third = rows_of(job, 2)
    assert first == '| count | 0.3 (0.3–0.3) | rival | 1.5 (1.5–1.5) | 1.5 |'
    assert second == '| count | 0.3 (0.3–0.3) | other | not installed | – |'
    assert third == '| count | 0.3 (0.3–0.3) | slow | 0.1 (0.1–0.1) | – |'
    assert rows_of(make('alone', lambda: work(2.0), 5.0), 1) == [
        '| alone | 2 (2–2) | – | – | 5 s |'
    ]


def refuse(*_: object) -> float:
    raise UserError('no messages for 20 s')


def test_a_row_that_fails_is_named_and_the_others_stand(monkeypatch, capsys) -> None:
    def measure(subject: bench_command._Subject, seconds: float) -> dict:
        return (
            refuse()
            if 'iio' in subject.label
            else {
                'first_s': 2.0,
                'rate_hz': 1000.0,
                'missing': 0,
                'p50_ms': 0.5,
                'p99_ms': 1.0,
                'loads': (0.1,),
            }
        )

    labels = 'bare publisher and relay', 'driver, iio, compensation', 'driver, sim, compensation'
    monkeypatch.setattr(
        bench_command,
        '_subjects',
        lambda *_: [bench_command._Subject(label, 'imu/data', []) for label in labels],
    )
    monkeypatch.setattr(bench_command, '_measure', measure)
    bench_command.measure_live(1.0, 3, None)
    table = capsys.readouterr().out.splitlines()[3:]
    assert table[1] == f'{labels[1]:27} failed in 3 of 3 rounds: no messages for 20 s'
    assert [line[:34].split()[-1] for line in table[0:3:2]] == ['1000', '1000']
    assert f'CPU of {labels[2]} by that of the {labels[0]}: 1.00' in table
    assert '2.00 (2.00–2.00)  10.0' in table[2]

    failing = Job('apply', refuse)
    print_table([failing, Job('count', lambda: None)], 1)
    rows = capsys.readouterr().out.splitlines()
    assert rows[-2] == '| apply | no messages for 20 s | – | – | – |' and 'count' in rows[-1]


@pytest.mark.parametrize('kind', ['csv', 'mcap'])
def test_a_long_recording_is_applied_with_its_memory_and_leaves_no_file(
    monkeypatch, tmp_path, kind
):
    if kind == 'mcap':
        pytest.importorskip('rosbags')
    # The other executables stand beside the running one.
    monkeypatch.setattr(sys, 'argv', [executable('bench')])
    jobs = bench_jobs._long_applying(tmp_path, nominal(), kind, 0.01)
    (row,) = rows_of(next(jobs), 1)
    format_ = kind.upper()
    assert re.match(
        rf'\| apply, 0.01 h at 1 kHz, {format_} to {format_} '
        r'\(\d+ s elapsed, [1-9]\d+ MB\) \| .* \| 0.075 s \|',
        row,
    )
    assert list(jobs) == []
    assert [path.name for path in tmp_path.iterdir()] == ['unit.yaml']
    # More than any disk holds.
    with pytest.raises(UserError, match='GB free; recordings of 1e.09 h need .* set TMPDIR'):
        next(bench_jobs._long_applying(tmp_path, nominal(), kind, 1e9))
