# SPDX-License-Identifier: Apache-2.0

"""The gyroscope beside an accelerometer: read, noise, bias, faults, corrected and simulated."""

from dataclasses import replace
from pathlib import Path

import adxl_ros as adxl
from adxl_ros.files import imu_message
from adxl_ros.model.constants import Z_90
from adxl_ros.model.gyroscope import Gyroscope
from adxl_ros.signals.gyroscope_at_rest import RestTurns, with_bias
from adxl_ros.simulate.gyroscope_model import GyroscopeModel
import numpy as np
import pytest
from six_axis import SixAxis, tumbled
from still_noise import still_samples
import yaml

BIAS = np.array([0.01, -0.02, 0.03])
SLOPE = np.array([1e-4, 0.0, -2e-4])
STD = 0.002


@pytest.fixture(scope='module')
def turned() -> SixAxis:
    return tumbled(1, 12)


def noisy(sensor: SixAxis) -> np.ndarray:
    rng = np.random.default_rng(2)
    return sensor.gyro_radps + BIAS + rng.normal(0, STD, sensor.gyro_radps.shape)


def read(sensor: SixAxis, gyro_radps: np.ndarray) -> adxl.Recording:
    return adxl.from_arrays(sensor.arrays(gyro_radps))


def still(seconds: int, white: float, instability: float, walk: float) -> adxl.Recording:
    rng, count = np.random.default_rng(4), 50 * seconds
    accel, gyro = (
        np.column_stack([still_samples(rng, count, 50.0, *terms) for _ in range(3)])
        for terms in ((1e-3, 0.0, 0.0), (white, instability, walk))
    )
    sensor = SixAxis(np.arange(count) / 50.0, accel + [0.0, 0.0, 9.80665], gyro)
    return read(sensor, gyro + BIAS)


def test_noise_of_the_gyroscope_and_a_whole_imu_yaml() -> None:
    allantools = pytest.importorskip('allantools')
    log = still(1200, 2e-4, 3e-5, 2e-6)
    noise = adxl.noise(log)
    inside = 0
    for axis, measured in zip(noise.gyro, log.gyro_radps.T):
        for estimate, truth in zip(axis.estimates, (2e-4, 3e-5, 2e-6)):
            inside += estimate.low <= truth <= estimate.high
        assert axis.fit.white.value == pytest.approx(2e-4, rel=0.1)
        assert axis.sample_std == pytest.approx(2e-4 * np.sqrt(50.0), rel=0.1)
        column = 'xyz'.index(axis.axis)
        _, expected, _, _ = allantools.oadev(measured, 50.0, 'freq', noise.tau_s)
        # The rest is shorter by a part of a second.
        curve = noise.gyro_allan_deviation_radps[:, column]
        assert curve == pytest.approx(expected, rel=1e-2)
    # Nine of 0.9: six or more in 999 of 1000 cases.
    assert inside >= 6
    text = '\n'.join(noise.screen)
    begin = text.index('# kalibr')
    pasted = text[begin : text.index('\n\n', begin)]
    settings = yaml.safe_load(pasted)
    # The names that Kalibr's ImuParameters asks for, each above 0.
    for sensor in ('accelerometer', 'gyroscope'):
        assert settings[f'{sensor}_noise_density'] > 0
        assert settings[f'{sensor}_random_walk'] > 0
    assert settings['rostopic'] == '/imu/data_raw'
    assert settings['gyroscope_noise_density'] == pytest.approx(2e-4, rel=0.05)
    assert settings['gyr_n'] == pytest.approx(2e-4 * np.sqrt(50.0), rel=0.05)
    assert settings['angular_velocity_covariance'][8] == pytest.approx(2e-6, rel=0.1)
    assert max(map(len, pasted.splitlines())) <= 79
    # The simulated gyroscope repeats it.
    model = GyroscopeModel(noise.sensor.gyro, seed=1)
    samples = model(np.zeros((4000, 3)), 1 / 50.0)
    assert samples.std(axis=0) == pytest.approx(np.full(3, 2e-4 * np.sqrt(50.0)), rel=0.1)


def test_a_gyroscope_that_never_changes_is_left_out_of_the_noise() -> None:
    log = still(60, 2e-4, 0.0, 0.0)
    log.columns['gz_radps'] = np.zeros(len(log))
    noise = adxl.noise(log)
    assert noise.gyro == ()
    assert any('gz_radps never changes' in text for text in noise.warnings)


@pytest.mark.parametrize('slope', [0.0, 1e-4])
def test_nine_of_ten_intervals_of_the_bias_hold_the_truth(slope: float) -> None:
    inside = 0
    for seed in range(100):
        rng = np.random.default_rng(seed)
        rests = []
        for number in range(4):
            samples = rng.normal(0, STD, (rng.integers(100, 400), 3))
            temperature_c = np.full(len(samples), 25.0 + 5 * number * (slope != 0))
            rests.append(
                RestTurns(samples + BIAS + slope * (temperature_c[:, None] - 25), temperature_c)
            )
        gyro = with_bias(Gyroscope(), rests)
        assert gyro.follows_temperature == (slope != 0)
        error = gyro.bias_at(25.0) - BIAS
        inside += int((np.abs(error) < Z_90 * gyro.bias_std_at(25.0)).sum())
    # 300 draws of 0.9: 252 to 288 in 999 of 1000 cases.
    assert 252 <= inside <= 288


def test_fit_gives_the_bias_and_apply_subtracts_it(tmp_path: Path, turned: SixAxis) -> None:
    temperature_c = 20.0 + turned.time_s / 5.0
    gyro = noisy(turned) + SLOPE * (temperature_c[:, None] - 25.0)
    log = read(turned, gyro)
    log.columns['temperature_c'] = temperature_c
    fitted = adxl.fit(log)
    fitted.save(tmp_path / 'unit.yaml')
    unit = adxl.load(tmp_path / 'unit.yaml')
    assert unit.gyro == fitted.sensor.gyro
    assert np.abs(unit.gyro.bias_at(25.0) - BIAS) == pytest.approx(
        0.0, abs=3 * unit.gyro.bias_std_at(25.0).max()
    )
    assert unit.gyro.bias_per_k_radps == pytest.approx(SLOPE, abs=3e-5)
    assert any('gyroscope, bias at rest' in line for line in fitted.screen)
    for name in ('out.csv', 'out.mcap'):
        adxl.apply(log, unit).save(tmp_path / name)
        if name.endswith('.csv'):
            corrected = adxl.read(tmp_path / name, rate=100.0).gyro_radps
        else:
            corrected = adxl.read(tmp_path / name, topic='/imu/data').gyro_radps
        left = corrected - turned.gyro_radps
        assert left.mean(axis=0) == pytest.approx(np.zeros(3), abs=2e-4)
        assert left.std(axis=0) == pytest.approx(np.full(3, STD), rel=0.05)


def test_a_message_is_less_by_the_bias(tmp_path: Path) -> None:
    bags = pytest.importorskip('bags')
    message = bags.imu(0).message
    message.angular_velocity.x = 0.5
    message.angular_velocity_covariance[:] = 0.0
    raw = bags.STORE.serialize_cdr(message, bags.IMU)
    less = bags.STORE.deserialize_cdr(
        imu_message.less_bias(bytes(raw), BIAS.tolist(), [1e-6] * 3), bags.IMU
    )
    assert less.angular_velocity.x == pytest.approx(0.49)
    assert less.angular_velocity.y == pytest.approx(0.02)
    # 0 says that the covariance is not known.
    assert not less.angular_velocity_covariance.any()
    message.angular_velocity_covariance[0] = -1.0
    absent = bytes(bags.STORE.serialize_cdr(message, bags.IMU))
    assert imu_message.less_bias(absent, BIAS.tolist(), [1e-6] * 3) == absent


def test_a_sound_gyroscope(turned: SixAxis) -> None:
    checked = adxl.check(read(turned, noisy(turned)))
    assert checked.is_sound
    gyro = checked.recordings[0].contents.gyro
    assert gyro.bias_radps == pytest.approx(BIAS, abs=1e-3)
    assert gyro.turns == 11
    assert gyro.error_rad < 0.02


@pytest.mark.parametrize(
    ('change', 'fault'),
    [
        (lambda gyro: gyro * [1, -1, 1], 'x is gx, y is -gy, z is gz;'),
        (lambda gyro: gyro[:, [1, 0, 2]], 'x is gy, y is gx, z is gz;'),
        (lambda gyro: gyro[:, [2, 0, 1]] * [-1, 1, 1], 'x is gy, y is gz, z is -gx;'),
        (np.degrees, 'the gyroscope is in °/s'),
        (lambda gyro: gyro + [0.0, 0.0, 0.6], 'turns at rest: gz reads 0.63 rad/s'),
        (lambda gyro: gyro * 0.5, 'does not follow the accelerometer'),
        (lambda gyro: gyro * [1, 0, 1], 'gy_radps never changes'),
    ],
)
def test_faults_of_a_gyroscope(turned: SixAxis, change: object, fault: str) -> None:
    checked = adxl.check(read(turned, change(noisy(turned))))
    assert [fault in text for text in checked.faults] == [True]


def test_columns_with_units_and_messages_are_read_alike(tmp_path: Path, turned: SixAxis) -> None:
    gyro = noisy(turned)
    log = read(turned, gyro)
    log.save(tmp_path / 'log.mcap')
    assert adxl.read(tmp_path / 'log.mcap').gyro_radps == pytest.approx(gyro)
    names = ['time_s', 'ax_mps2', 'ay_mps2', 'az_mps2', 'gx_dps', 'gy_dps', 'gz_dps']
    table = np.column_stack([turned.time_s, turned.accel_mps2, np.degrees(gyro)])
    np.savetxt(tmp_path / 'log.csv', table, '%.9g', ',', header=','.join(names), comments='')
    assert adxl.read(tmp_path / 'log.csv').gyro_radps == pytest.approx(gyro, abs=1e-7)
    mapping = 'time=1:s,x=2:mps2,y=3:mps2,z=4:mps2,gx=5:dps,gy=6:dps,gz=7:dps'
    named = adxl.read(tmp_path / 'log.csv', columns=mapping, axes='x=-y,y=x,z=z')
    assert named.gyro_radps == pytest.approx(gyro[:, [1, 0, 2]] * [-1, 1, 1], abs=1e-7)
    with pytest.raises(adxl.UserError, match='names gx of a gyroscope; name gx, gy, gz'):
        adxl.read(tmp_path / 'log.csv', columns='time=1:s,x=2:mps2,gx=5:dps')
    bare = replace(log, columns={name: log.columns[name] for name in names[1:4]})
    bare.save(tmp_path / 'bare.mcap')
    assert adxl.read(tmp_path / 'bare.mcap').gyro_radps is None
