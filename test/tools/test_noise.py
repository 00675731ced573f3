# SPDX-License-Identifier: Apache-2.0

"""The tool `noise`: its figures, its files, and recordings that are too short or not still."""

import json
from pathlib import Path
import subprocess

from adxl_ros.files import parameter_file
import numpy as np
from processes import run_in_process
import pytest
from still_noise import still_samples, write_csv
import yaml

allantools = pytest.importorskip('allantools')
pytestmark = pytest.mark.long

RATE_HZ = 50.0
N, B, K = 1e-3, 2e-4, 2e-5
G = 9.80665


def samples(seconds: float, seed: int = 1, terms: tuple[float, float, float] = (N, B, K)
            ) -> tuple[np.ndarray, np.ndarray]:
    rng, count = np.random.default_rng(seed), int(seconds * RATE_HZ)
    axes = [still_samples(rng, count, RATE_HZ, *terms) for _ in range(3)]
    return np.arange(count) / RATE_HZ, np.column_stack(axes) + [0.0, 0.0, G]


def run(folder: Path, *arguments: str) -> subprocess.CompletedProcess:
    done = run_in_process('noise', *arguments, cwd=folder)
    assert (done.returncode, done.stderr) == (0, '')
    return done


def as_json(folder: Path, *arguments: str) -> dict:
    return json.loads(run(folder, *arguments, '--json').stdout)


def test_terms_curve_files_and_settings(tmp_path: Path) -> None:
    time_s, accel = samples(3600.0)
    write_csv(tmp_path / 'still.csv', time_s, accel)
    result = as_json(tmp_path, 'still.csv', '-o', 'noise.yaml', '--report', 'page')
    for axis in result['axes'].values():
        assert axis['white']['ci'][0] <= N * 1.01
        assert axis['white']['ci'][1] >= N * 0.99
        assert axis['instability']['ci'][0] <= 1.5 * B
        assert axis['instability']['ci'][1] >= B / 1.5
        assert axis['density_g_per_rthz'] == pytest.approx(np.sqrt(2) * N / G, rel=0.03)
        assert axis['sample_std_mps2'] == pytest.approx(N * np.sqrt(RATE_HZ), rel=0.03)
    curve = result['allan_deviation']
    for i, name in enumerate('xyz'):
        _, expected, _, _ = allantools.oadev(accel[:, i], RATE_HZ, 'freq', curve['tau_s'])
        assert curve[name] == pytest.approx(expected, rel=1e-6)
    settings = {name: value for program in result['settings'].values()
                for name, value in program.items()}
    assert settings['accelerometer_noise_density'] == pytest.approx(N, rel=0.05)
    assert settings['acc_n'] == pytest.approx(N * np.sqrt(RATE_HZ), rel=0.05)
    assert settings['EKF2_ACC_NOISE'] == pytest.approx(N * 10, rel=0.05)
    variances = settings['linear_acceleration_covariance']
    assert variances[4] == pytest.approx(N ** 2 * RATE_HZ, rel=0.1)
    assert {path.name for path in (tmp_path / 'page').iterdir()} == {'report.html', 'allan.png'}
    sensor = parameter_file.load(tmp_path / 'noise.yaml')
    assert sensor.axes == 'xyz'
    assert sensor.noise_density_g_per_rthz == pytest.approx(np.full(3, np.sqrt(2) * N / G),
                                                            rel=0.03)
    assert 'flicker' in sensor.effects
    # Nothing of the nominal sensor is in the file: a rest shows neither range nor resolution.
    assert (sensor.rc_s, sensor.rate_hz) == (0.0, RATE_HZ)
    assert (sensor.range_g, sensor.adc_bits) == (1000.0, 0)


def test_the_lines_to_paste_are_yaml(tmp_path: Path) -> None:
    write_csv(tmp_path / 'still.csv', *samples(60.0))
    text = run(tmp_path, 'still.csv').stdout
    assert max(map(len, text.splitlines())) <= 79
    pasted = text[text.index('# kalibr'):text.index('WARNING')]
    values = yaml.safe_load(pasted)
    assert isinstance(values['accelerometer_random_walk'], float)
    assert all(isinstance(value, float) for value in values['linear_acceleration_covariance'])
    assert {'acc_n', 'acc_w', 'EKF2_ACC_NOISE', 'EKF2_ACC_B_NOISE'} <= set(values)


def test_a_short_recording_is_named(tmp_path: Path) -> None:
    write_csv(tmp_path / 'still.csv', *samples(60.0, terms=(N, 0.0, 0.0)))
    result = as_json(tmp_path, 'still.csv')
    assert result['axes']['x']['walk']['value'] is None
    assert result['axes']['x']['walk']['ci'][1] > 0
    warning = next(text for text in result['warnings'] if 'random walk K' in text)
    assert 'too short' in warning
    assert 'record about' in warning


def test_noise_that_rounding_hides_is_not_written(tmp_path: Path) -> None:
    """The file keeps the figure of --params, or states none: nobody may take it for 0."""
    time_s, accel = samples(60.0, terms=(N, 0.0, 0.0))
    accel[:, 0] = np.round(accel[:, 0] / 0.02) * 0.02
    write_csv(tmp_path / 'coarse.csv', time_s, accel)
    result = as_json(tmp_path, 'coarse.csv', '-o', 'noise.yaml')
    x, y = result['axes']['x'], result['axes']['y']
    assert (x['white']['value'], x['white']['ci'][0], x['density_g_per_rthz']) == (None, 0, None)
    assert x['white']['ci'][1] > N
    assert y['white']['value'] == pytest.approx(N, rel=0.1)
    assert result['settings']['kalibr, imu.yaml']['accelerometer_noise_density'] > N
    assert any('N is not determined' in text for text in result['warnings'])
    file = tmp_path / 'noise.yaml'
    assert parameter_file.load(file, may_measure=True).unstated == ('noise_density_g_per_rthz',)
    file.write_text(file.read_text().replace(
        '      rc_res', '      noise_density_g_per_rthz: [1.3e-4, 0.1, 0.1]\n      rc_res', 1))
    run(tmp_path, 'coarse.csv', '--params', 'noise.yaml', '-o', 'kept.yaml')
    kept = parameter_file.load(tmp_path / 'kept.yaml').noise_density_g_per_rthz
    assert kept[0] == 1.3e-4
    assert kept[1:] == pytest.approx(np.sqrt(2) * N / G, rel=0.1)


def test_a_rest_goes_on_after_a_few_lost_samples_and_not_after_a_long_gap(tmp_path: Path) -> None:
    time_s, accel = samples(600.0)
    kept = np.ones(len(time_s), bool)
    kept[1000:1020] = False
    write_csv(tmp_path / 'lost.csv', time_s[kept], accel[kept])
    result = as_json(tmp_path, 'lost.csv')
    # A rest is found in blocks of 0.05 s.
    assert 29970 <= result['samples'] <= 29980
    assert result['rate_hz'] == pytest.approx(RATE_HZ, rel=1e-4)
    kept[10000:10200] = False
    write_csv(tmp_path / 'gap.csv', time_s[kept], accel[kept])
    result = as_json(tmp_path, 'gap.csv')
    assert result['rest_s'][0] == pytest.approx(10200 / RATE_HZ, abs=0.1)
    assert any('interrupted' in text for text in result['warnings'])


@pytest.mark.parametrize(('change', 'reason'), [
    ('stuck', 'az_mps2 never changes'), ('stuck half way', 'az_mps2 never changes'),
    ('short', 'record longer')])
def test_refusals_are_one_line(tmp_path: Path, change: str, reason: str) -> None:
    time_s, accel = samples(5.0 if change == 'short' else 60.0)
    if change == 'stuck':
        accel[:, 2] = G
    if change == 'stuck half way':
        accel[len(accel) // 2:, 2] = G
    write_csv(tmp_path / 'bad.csv', time_s, accel)
    done = run_in_process('noise', 'bad.csv', '-o', 'noise.yaml', cwd=tmp_path)
    assert done.returncode == 1
    assert done.stderr.startswith('noise: bad.csv: ')
    assert reason in done.stderr
    assert done.stderr.count('\n') == 1
    assert not (tmp_path / 'noise.yaml').exists()
