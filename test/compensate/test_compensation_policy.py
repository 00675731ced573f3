# SPDX-License-Identifier: Apache-2.0

"""The choice of the calibration of a stream, its refusal, and the state of the stream."""

from dataclasses import replace
from datetime import datetime, timedelta, timezone
from pathlib import Path

from adxl_ros.compensate.compensation_policy import CompensationPolicy, StreamInterval
from adxl_ros.files import calibration_store
from adxl_ros.files.stream_info import sensor_info, StreamInfo
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.sensor import Sensor
from adxl_ros.report.level import Level
import numpy as np
import pytest
from units import drawn, nominal

QUIET = StreamInterval(1.0, {'received': 1000, 'published': 1000}, (), {}, {})


def unit(serial: str = '17', axes: str = 'xy', seed: int = 1) -> Sensor:
    sensor = drawn(np.random.default_rng(seed), nominal(axes))
    return replace(
        sensor,
        serial=serial,
        covariance_names=(Coefficient('bias', 'offset_v', 'x'),),
        covariance=np.array([[1e-6]]),
    )


def policy_for(
    sensor: Sensor, store: Path | str = '', paper: bool = False, **info: str
) -> CompensationPolicy:
    """Return the policy of a stream of this sensor; `changes` replaces keys of its info."""
    policy = CompensationPolicy(paper, str(store), '/{}'.format)
    policy.use(sensor, 'a file')
    policy.info = StreamInfo({**sensor_info(sensor), **info}, '/sensor_info')
    policy.assess()
    return policy


def stored(folder: Path, sensor: Sensor, days_old: float) -> Path:
    made = datetime.now(timezone.utc) - timedelta(days=days_old)
    path = calibration_store.put(
        folder,
        replace(
            sensor,
            provenance={
                'date': made.isoformat(timespec='seconds'),
                'data_sha256': f'{days_old:064.3f}',
            },
        ),
    )
    assert path is not None
    return path


def test_the_source_of_a_calibration_is_stated_in_one_line() -> None:
    policy = CompensationPolicy(False, '', '/{}'.format)
    assert (
        policy.use(nominal(), 'the file')
        == 'compensating by the file: nominal, which is not calibrated'
    )
    assert policy.use(unit(), 'the file').startswith('compensating by the file: 17, model ')


@pytest.mark.parametrize(('z_sign', 'side'), [(0, 'up, or down'), (1, 'up,'), (-1, 'down,')])
def test_the_side_that_a_sensor_of_two_axes_is_taken_for_is_stated(z_sign: int, side: str) -> None:
    policy = CompensationPolicy(False, '', '/{}'.format)
    assert f'point {side}' in policy.use(replace(unit(), z_sign=z_sign), 'a file').replace(
        'points', 'point'
    )


@pytest.mark.parametrize(
    ('key', 'value', 'reason'),
    [
        ('serial', '18', 'is of the sensor 18, but the parameters are of 17'),
        ('axes', 'xyz', 'axes xyz, but the parameters of 17 are for xy'),
        ('nominal_zero_g_v', '1.65, 1.65', 'nominal_zero_g_v is [1.65, 1.65], but [2.5, 2.5]'),
        (
            'nominal_scale_v_per_g',
            '0.3, 0.3',
            'nominal_scale_v_per_g is [0.3, 0.3], but [1.0, 1.0]',
        ),
        ('format', '99', 'format version 99, but this package reads version 1'),
        ('rate_hz', 'nan', "rate_hz is 'nan', expected samples a second"),
        ('rate_hz', '-1', "rate_hz is '-1', expected samples a second"),
    ],
)
def test_a_stream_is_refused_until_it_belongs_to_the_unit(
    key: str, value: str, reason: str
) -> None:
    policy = policy_for(unit(), **{key: value})
    assert reason in policy.refusal
    assert policy.refusal.startswith('/sensor_info: ')
    assert not policy.assess(), 'the refusal is as before'
    status = policy.status(QUIET, None, '')
    assert status == (Level.ERROR, f'publishing nothing: {policy.refusal}')
    assert policy.values(QUIET, None)['unit'] == 'other'
    assert policy.values(QUIET, None)['validity'] == policy.refusal
    policy.info = StreamInfo(sensor_info(unit()), '/sensor_info')
    assert policy.assess()
    assert policy.status(QUIET, None, '') == (Level.OK, 'compensating')


def test_the_newest_calibration_of_the_unit_is_chosen(tmp_path: Path) -> None:
    stored(tmp_path, unit(seed=1), 30.0)
    newest = stored(tmp_path, unit(seed=2), 10.0)
    stored(tmp_path, unit('18', seed=3), 1.0)
    three = stored(tmp_path, unit(axes='xyz', seed=4), 5.0)
    policy = policy_for(nominal(serial='17'), tmp_path)
    path, warnings = policy.choose('')
    assert path == str(newest)
    assert len(warnings) == 1
    assert warnings[0].startswith(f'passed over: {three}: ')
    policy.stored_path = path
    assert policy.choose(path) == ('', []), 'it is in use, and a warning is given once'
    assert not policy.is_named(path)
    fresh = stored(tmp_path, unit(seed=5), 0.0)
    assert policy.choose(path) == (str(fresh), [])


def test_a_newer_calibration_is_announced_unless_one_was_named(tmp_path: Path) -> None:
    old = stored(tmp_path, unit(), 3.0)
    dated = (datetime.now(timezone.utc) - timedelta(days=3)).isoformat(timespec='seconds')
    policy = policy_for(replace(unit(), provenance={'date': dated}), tmp_path)
    assert policy.newer() is None
    fresh = stored(tmp_path, unit(seed=2), 1.0)
    assert policy.newer() == fresh
    policy.stored_path = str(old)
    level, text = policy.status(QUIET, fresh, str(old))
    assert level is Level.WARN and f'a newer calibration is in the store: {fresh}' in text
    assert policy.status(QUIET, fresh, '/named.yaml') == (Level.OK, 'compensating')
    assert policy.values(QUIET, fresh)['newer'] == str(fresh)
    assert policy.values(QUIET, fresh)['age_days'] == pytest.approx(3.0, abs=0.01)


@pytest.mark.parametrize(
    ('counts', 'expected'),
    [
        ({'received': 0}, 'no samples on /imu/data_raw'),
        ({'received': 9, 'dropped': 5}, '5 samples dropped'),
        ({'received': 9, 'saturated': 2}, '2 samples with the ADC at its rail'),
        ({'received': 9, 'backward': 4}, '4 samples whose stamp steps back'),
        ({'received': 9, 'outside': 3}, '3 samples outside of what was calibrated'),
    ],
)
def test_states_of_the_samples(counts: dict[str, int], expected: str) -> None:
    interval = replace(QUIET, counts=counts, outside=('temperature 40.0 degC',))
    level, text = policy_for(unit()).status(interval, None, '')
    assert level is Level.WARN and expected in text


def test_validity() -> None:
    sensor = unit()
    calibrated = replace(sensor, envelope=replace(sensor.envelope, temperature_c=(20.0, 25.0)))
    at_23_c = replace(QUIET, surroundings={'temperature_c': 23.0}, ages_s={'temperature_c': 1.0})

    def validity(sensor: Sensor, interval: StreamInterval) -> str:
        return policy_for(sensor).values(interval, None)['validity']

    assert validity(calibrated, at_23_c) == 'valid'
    unknown = 'valid, temperature not known'
    assert validity(sensor, at_23_c) == unknown
    assert validity(calibrated, QUIET) == unknown
    assert validity(calibrated, replace(at_23_c, ages_s={'temperature_c': 61.0})) == unknown
    outside = replace(at_23_c, counts={'received': 9, 'outside': 1}, outside=('force', 'heat'))
    assert validity(calibrated, outside) == 'outside: force; heat'
