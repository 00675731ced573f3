# SPDX-License-Identifier: Apache-2.0

"""The tool `noise`: its figures, its files, and recordings that are too short or not still."""

from pathlib import Path
import re
import subprocess
from typing import Any

import adxl_ros as adxl
from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file, recording
from adxl_ros.signals.noise_parameters import recording_noise, RecordingNoise
import numpy as np
from processes import run_in_process
import pytest
from scipy.spatial.transform import Rotation
from still_noise import still_samples, write_csv
import yaml

allantools = pytest.importorskip('allantools')
pytestmark = pytest.mark.long

RATE_HZ = 50.0
N, B, K = 1e-3, 2e-4, 2e-5
G = 9.80665


def samples(
    seconds: float, seed: int = 1, terms: tuple[float, float, float] = (N, B, K)
) -> tuple[np.ndarray, np.ndarray]:
    rng, count = np.random.default_rng(seed), int(seconds * RATE_HZ)
    axes = [still_samples(rng, count, RATE_HZ, *terms) for _ in range(3)]
    return np.arange(count) / RATE_HZ, np.column_stack(axes) + [0.0, 0.0, G]


def run(folder: Path, *arguments: str) -> subprocess.CompletedProcess:
    done = run_in_process('noise', *arguments, cwd=folder)
    assert (done.returncode, done.stderr) == (0, '')
    return done


def measured(path: Path) -> RecordingNoise:
    return recording_noise(lambda: recording.blocks(path, 65536), None)


def settings_of(text: str) -> dict:
    """Return the settings to paste on a screen."""
    begin = text.index('# kalibr')
    return yaml.safe_load(text[begin : text.index('\n\n', begin)])


def flat(text: str) -> str:
    return ' '.join(text.split())


def test_terms_curve_files_and_settings(tmp_path: Path) -> None:
    time_s, accel = samples(3600.0)
    write_csv(tmp_path / 'still.csv', time_s, accel)
    text = run(tmp_path, 'still.csv', '-o', 'noise.yaml', '--report', 'curve').stdout
    result = measured(tmp_path / 'still.csv')
    for noise in result.axes:
        assert noise.fit.white.low <= N * 1.01
        assert noise.fit.white.high >= N * 0.99
        assert noise.fit.instability.low <= 1.5 * B
        assert noise.fit.instability.high >= B / 1.5
        assert noise.sample_std == pytest.approx(N * np.sqrt(RATE_HZ), rel=0.03)
    curve = result.rest.allan
    for i in range(3):
        _, expected, _, _ = allantools.oadev(accel[:, i], RATE_HZ, 'freq', curve.tau_s)
        assert curve.deviation[:, i] == pytest.approx(expected, rel=1e-6)
    settings = settings_of(text)
    assert settings['accelerometer_noise_density'] == pytest.approx(N, rel=0.05)
    assert settings['acc_n'] == pytest.approx(N * np.sqrt(RATE_HZ), rel=0.05)
    assert settings['EKF2_ACC_NOISE'] == pytest.approx(N * 10, rel=0.05)
    variances = settings['linear_acceleration_covariance']
    assert variances[4] == pytest.approx(N**2 * RATE_HZ, rel=0.1)
    curves = {path.name for path in (tmp_path / 'curve').iterdir()}
    assert curves == {'allan.png', 'allan.csv'}
    sensor = parameter_file.load(tmp_path / 'noise.yaml')
    assert sensor.axes == 'xyz'
    assert sensor.noise_density_g_per_rthz == pytest.approx(
        np.full(3, np.sqrt(2) * N / G), rel=0.03
    )
    assert 'flicker' in sensor.effects
    # Nothing of the nominal sensor is in the file: a rest shows neither range nor resolution.
    assert (sensor.rc_s, sensor.rate_hz) == (0.0, RATE_HZ)
    assert (sensor.range_g, sensor.adc_bits) == (1000.0, 0)


def test_the_lines_to_paste_are_yaml(tmp_path: Path) -> None:
    write_csv(tmp_path / 'still.csv', *samples(60.0))
    text = run(tmp_path, 'still.csv').stdout
    assert max(map(len, text.splitlines())) <= 79
    values = settings_of(text)
    assert isinstance(values['accelerometer_random_walk'], float)
    assert all(isinstance(value, float) for value in values['linear_acceleration_covariance'])
    assert {'acc_n', 'acc_w', 'EKF2_ACC_NOISE', 'EKF2_ACC_B_NOISE'} <= set(values)


def test_a_short_recording_is_named(tmp_path: Path) -> None:
    write_csv(tmp_path / 'still.csv', *samples(60.0, terms=(N, 0.0, 0.0)))
    assert re.search(
        'WARNING x: 60 s is too short to see the random walk K[.] .* record about',
        flat(run(tmp_path, 'still.csv').stdout),
    )
    walk = measured(tmp_path / 'still.csv').axes[0].fit.walk
    assert walk.high > walk.low == 0


def test_noise_that_rounding_hides_is_not_written(tmp_path: Path) -> None:
    """The file keeps the figure of --params, or states none: nobody may take it for 0."""
    time_s, accel = samples(60.0, terms=(N, 0.0, 0.0))
    accel[:, 0] = np.round(accel[:, 0] / 0.02) * 0.02
    write_csv(tmp_path / 'coarse.csv', time_s, accel)
    text = run(tmp_path, 'coarse.csv', '-o', 'noise.yaml').stdout
    x, y = (noise.fit.white for noise in measured(tmp_path / 'coarse.csv').axes[:2])
    assert x.low == 0 and x.high > N
    assert y.value == pytest.approx(N, rel=0.1)
    assert settings_of(text)['accelerometer_noise_density'] > N
    assert 'WARNING x: N is not determined' in flat(text)
    file = tmp_path / 'noise.yaml'
    assert parameter_file.load(file, may_measure=True).unstated == ('noise_density_g_per_rthz',)
    file.write_text(
        file.read_text().replace(
            '      rc_res', '      noise_density_g_per_rthz: [1.3e-4, 0.1, 0.1]\n      rc_res', 1
        )
    )
    run(tmp_path, 'coarse.csv', '--params', 'noise.yaml', '-o', 'kept.yaml')
    kept = parameter_file.load(tmp_path / 'kept.yaml').noise_density_g_per_rthz
    assert kept[0] == 1.3e-4
    assert kept[1:] == pytest.approx(np.sqrt(2) * N / G, rel=0.1)


def test_a_rest_goes_on_after_a_few_lost_samples_and_not_after_a_long_gap(tmp_path: Path) -> None:
    time_s, accel = samples(600.0)
    kept = np.ones(len(time_s), bool)
    kept[1000:1020] = False
    write_csv(tmp_path / 'lost.csv', time_s[kept], accel[kept])
    rest = measured(tmp_path / 'lost.csv').rest
    # A rest is found in blocks of 0.05 s.
    assert 29970 <= rest.count <= 29980
    assert rest.rate_hz == pytest.approx(RATE_HZ, rel=1e-4)
    kept[10000:10200] = False
    write_csv(tmp_path / 'gap.csv', time_s[kept], accel[kept])
    assert measured(tmp_path / 'gap.csv').rest.start_s == pytest.approx(10200 / RATE_HZ, abs=0.1)
    assert 'interrupted' in run(tmp_path, 'gap.csv').stdout


@pytest.mark.parametrize(
    ('change', 'reason'),
    [
        ('stuck', 'az_mps2 never changes'),
        ('stuck half way', 'az_mps2 never changes'),
        ('short', 'record longer'),
    ],
)
def test_refusals_are_one_line(tmp_path: Path, change: str, reason: str) -> None:
    time_s, accel = samples(5.0 if change == 'short' else 60.0)
    if change == 'stuck':
        accel[:, 2] = G
    if change == 'stuck half way':
        accel[len(accel) // 2 :, 2] = G
    write_csv(tmp_path / 'bad.csv', time_s, accel)
    done = run_in_process('noise', 'bad.csv', '-o', 'noise.yaml', cwd=tmp_path)
    assert done.returncode == 1
    assert done.stderr.startswith('noise: bad.csv: ')
    assert reason in done.stderr
    assert done.stderr.count('\n') == 1
    assert not (tmp_path / 'noise.yaml').exists()


@pytest.mark.parametrize(
    ('axis', 'per_mps2', 'unit'),
    [('x', 1 / G, 'g'), ('y', 1e3 / G, 'mg'), ('y', 1e-3, 'm/s² divided by 1000'), ('z', 2.5, '')],
)
def test_a_level_axis_in_another_unit_is_told_by_its_noise(
    tmp_path: Path, axis: str, per_mps2: float, unit: str
) -> None:
    """Gravity shows the unit of z alone; one axis may have 2.5 times the noise of the others."""
    time_s, accel = samples(60.0, terms=(N, 0.0, 0.0))
    accel[:, 'xyz'.index(axis)] *= per_mps2
    accel[:, 2] += G - accel[:, 2].mean()
    write_csv(tmp_path / 'level.csv', time_s, accel)
    found = [text for text in adxl.noise(tmp_path / 'level.csv').warnings if '--columns' in text]
    assert len(found) == bool(unit)
    for text in found:
        assert text.startswith(f'{axis}: N is') and f'in {unit};' in text
        ratio, of_upright = re.search(r', (.*) times that of z \((.*)\)', text).groups()
        assert float(ratio) == pytest.approx(per_mps2, rel=0.1)
        assert float(of_upright) == pytest.approx(1e6 * N / G, rel=0.1)


@pytest.mark.parametrize('verb', [adxl.noise, adxl.fit])
def test_a_refusal_for_want_of_rests_names_why_nothing_rests(tmp_path: Path, verb: Any) -> None:
    time_s, accel = samples(60.0, terms=(N, 0.0, 0.0))
    turned = Rotation.from_rotvec(np.floor(time_s / 4.0)[:, None] * [0.7, 0.4, 0.2])
    accel = turned.apply(accel)
    accel[1::2] = accel[1::2, [1, 2, 0]]
    write_csv(tmp_path / 'two.csv', time_s, accel)
    with pytest.raises(UserError, match='rest.*rows alternate between 2 values'):
        verb(tmp_path / 'two.csv')
