# SPDX-License-Identifier: Apache-2.0

"""The gate of `check`: what became worse between two logs, limits, and reports for CI."""

from itertools import pairwise
import json
from pathlib import Path
from xml.etree import ElementTree

import adxl_ros as adxl
import numpy as np
import pytest
from six_axis import RATE_HZ, tumbled
from still_noise import write_csv

KINDS = {'gaps', 'rate', 'noise', 'zero-g', 'rests'}


def log(path: Path, seed: int, noise: float = 0.0, zero_g: float = 0.0) -> Path:
    sensor, rng = tumbled(seed, 6, 2.0), np.random.default_rng(seed)
    accel = sensor.accel_mps2 + rng.normal(0, noise, sensor.accel_mps2.shape)
    return write_csv(path, sensor.time_s, accel + [0.0, 0.0, zero_g])


def worse(new: Path, old: Path) -> set[str]:
    (outcomes,) = adxl.check(new, against=old).outcomes
    assert {each.name for each in outcomes} == {'sound', *KINDS}
    return {each.name for each in outcomes if each.is_worse} - {'sound'}


def test_chance_is_not_called_worse(tmp_path: Path) -> None:
    logs = [log(tmp_path / f'{seed}.csv', seed) for seed in range(9)]
    wrong = [worse(new, old) for new, old in pairwise(logs)]
    # 8 of 0.01: two or more in 1 of 400 cases.
    assert sum(map(bool, wrong)) <= 1


def test_what_became_worse_is_named(tmp_path: Path) -> None:
    old = log(tmp_path / 'old.csv', 1)
    assert worse(log(tmp_path / 'noisy.csv', 2, noise=0.02), old) == {'noise'}
    assert 'zero-g' in worse(log(tmp_path / 'shifted.csv', 3, zero_g=0.5), old)
    lines = (tmp_path / 'old.csv').read_text().splitlines()
    kept = [line for row, line in enumerate(lines) if row % 150 not in (40, 41, 42)]
    (tmp_path / 'lossy.csv').write_text('\n'.join(kept))
    assert 'gaps' in worse(tmp_path / 'lossy.csv', old)
    sensor = tumbled(4, 6, 2.0)
    slow = write_csv(tmp_path / 'slow.csv', sensor.time_s * 1.05, sensor.accel_mps2)
    assert 'rate' in worse(slow, old)


def test_status_limits_and_reports(run_tool, tmp_path: Path) -> None:
    log(tmp_path / 'old.csv', 1)
    log(tmp_path / 'new.csv', 2, noise=0.02)
    command = 'check', 'new.csv', '--against', 'old.csv'
    assert run_tool(*command).returncode == 1
    assert run_tool(*command, '--fail-on', 'gaps,rate').returncode == 0
    done = run_tool(
        *command, '--fail-on', 'gaps', '--min', f'rate_hz={2 * RATE_HZ}', '--junit', 'c.xml'
    )
    assert done.returncode == 1
    assert 'WORSE   noise: ' in done.stdout
    cases = {
        case.get('name'): case for case in ElementTree.parse(tmp_path / 'c.xml').iter('testcase')
    }
    assert {name for name, case in cases.items() if case.find('failure') is not None} == {
        'min rate_hz'
    }
    assert cases['noise'].find('skipped') is not None
    (entry,) = json.loads(run_tool(*command, '--json').stdout)
    low, high = next(row['interval'] for row in entry['outcomes'] if row['name'] == 'noise')
    assert 1 < low < np.sqrt(2) < high


@pytest.mark.parametrize(
    ('arguments', 'message'),
    [
        (('--fail-on', 'nois'), '--fail-on nois: expected some of sound, gaps'),
        (('--min', 'rate=9'), '--min rate=9: expected NAME=VALUE with one of samples'),
        (('--against', 'no.csv'), 'no.csv: cannot read'),
    ],
)
def test_wrong_arguments_are_one_line(run_tool, tmp_path, arguments, message) -> None:
    log(tmp_path / 'new.csv', 2)
    done = run_tool('check', 'new.csv', *arguments)
    assert done.returncode == 1
    assert message in done.stderr
    assert done.stderr.count('\n') == 1
