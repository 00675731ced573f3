# SPDX-License-Identifier: Apache-2.0

"""fit --update: days of a robot at work change a calibration, or say why they do not."""

from dataclasses import replace

import adxl_ros as adxl
from adxl_ros.files import parameter_file
from adxl_ros.tools import fit
from adxl_ros_validation.kept_robots import BEGIN_NS, calibrated
import numpy as np
import pandas as pd
import pytest

UNIT = replace(calibrated(), rate_hz=50.0)
RATE_HZ = 50


def day(number, shift_g=0.0, celsius=25.0, seconds=150):
    """Return a table of two rests and a move between them; z is off by a shift."""
    rng = np.random.default_rng(number)
    count = seconds * RATE_HZ
    time_s = BEGIN_NS * 1e-9 + 86400 * number + np.arange(count) / RATE_HZ
    force = np.tile([0.0, 0.0, 1.0], (count, 1)) + rng.normal(size=(count, 3)) * 4e-4
    force[count // 2 : count // 2 + 100] += rng.normal(size=(100, 3)) * 0.3
    force[:, 2] += shift_g
    columns = {f'a{axis}_mps2': 9.80665 * force[:, place] for place, axis in enumerate('xyz')}
    return pd.DataFrame({'time_s': time_s, **columns, 'temperature_c': celsius})


@pytest.fixture
def files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    parameter_file.save('old.yaml', UNIT)
    for number in range(3):
        day(number).to_csv(f'day{number}.csv', index=False)
    return tmp_path


def run(*words):
    return fit.fit(fit.parser().parse_args([*words, '--store', '']))


def test_days_are_replayed_into_a_file_and_a_page(files, capsys):
    words = ['day0.csv', 'day1.csv', 'day2.csv', '--update', 'old.yaml', '-o', 'new.yaml']
    assert run(*words, '--report', 'page') == 0
    shown = capsys.readouterr().out
    assert 'KEPT: the rests show no sure improvement' in shown
    assert '6 rests on 3 days, 0 adoptions' in shown
    assert 'only the sum of zero-g and scale factor of z is seen' in ' '.join(shown.split())
    text = (files / 'page' / 'report.html').read_text('utf-8')
    assert 'Zero-g by temperature' in text and '2026-01-03' in text
    new = parameter_file.load('new.yaml')
    # Age and an unknown slope over temperature are in the covariance.
    assert len(new.covariance) > len(UNIT.covariance)
    assert adxl.update('day0.csv', 'old.yaml').to_dict()['days'][0]['rests'] == 2


def test_a_knock_between_days_is_reported():
    days = [day(number, shift_g=0.02 * (number > 5)) for number in range(9)]
    updated = adxl.update(days, UNIT)
    assert updated.outcome == 'CHANGED'
    assert 'mg on z since' in updated.state.changed
    assert 'CHANGED: +20 mg on z since Wednesday' in ' '.join(str(updated).split())
    assert updated.adoptions == 0
    assert len(updated.to_pandas()) == 27


def test_what_cannot_be_updated_is_said(files):
    with pytest.raises(adxl.UserError, match='leave --model out'):
        run('day0.csv', '--update', 'old.yaml', '--model', 'linear', '-o', 'new.yaml')
    with pytest.raises(adxl.UserError, match='in the order of time'):
        adxl.update(['day1.csv', 'day0.csv'], 'old.yaml')
    with pytest.raises(adxl.UserError, match='without temperature_c'):
        adxl.update(day(0).drop(columns='temperature_c'), UNIT)
    with pytest.raises(adxl.UserError, match='no uncertainty of its zero-g'):
        adxl.update('day0.csv', UNIT.without_covariance())
