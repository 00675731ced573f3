# SPDX-License-Identifier: Apache-2.0

"""The link that emulates a sensor on the ideal samples of a simulator, without ROS."""

from __future__ import annotations

from pathlib import Path

from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file, recording
from adxl_ros.links import topic
from adxl_ros.links.support.base import Level, Samples
from adxl_ros.model.sensor import Sensor, to_nominal_mps2
import numpy as np
import pytest
from units import nominal, with_effects

STEP_NS = 5_000_000
START_NS = 40 * 10**9
EFFECTS = ('quadratic', 'temperature_bias:per_k.x=4e-4,per_k.y=-3e-4,per_k.z=2e-4', 'hysteresis')


def unit(*effects: str, **changes: object) -> Sensor:
    quiet = {'noise_density_g_per_rthz': np.zeros(3), 'adc_bits': 0}
    return with_effects(nominal('xyz', **quiet | changes), effects or EFFECTS)


def force(time_s: np.ndarray) -> np.ndarray:
    """Return a smooth specific force, m/s², (n, 3)."""
    return np.column_stack([3 * np.sin(2 * time_s), 2 * np.cos(3 * time_s), 9.8 + np.sin(time_s)])


def fields(accel: np.ndarray) -> dict[str, np.ndarray]:
    """Return the fields of messages with gyroscope and orientation, (n, k) each."""
    count = len(accel)
    return {
        'linear_acceleration': accel,
        'angular_velocity': np.tile([0.1, 0.2, 0.3], (count, 1)),
        'angular_velocity_covariance': np.tile(np.diag([1.0, 2.0, 3.0]).ravel(), (count, 1)),
        'orientation': np.tile([0.0, 0.0, 0.0, 1.0], (count, 1)),
        'orientation_covariance': np.tile(np.eye(3).ravel(), (count, 1)),
    }


def feed(
    link: topic.EmulatedSensor, stamps: np.ndarray, accel: np.ndarray | None = None
) -> Samples:
    link.sense_imu(stamps, fields(force(stamps * 1e-9) if accel is None else accel))
    return link.read(0)


def statistics(link: topic.EmulatedSensor) -> dict[str, int]:
    return link.status().statistics


@pytest.mark.parametrize('seed', [0, 4])
def test_it_reads_what_simulate_records(run_tool, tmp_path: Path, seed: int) -> None:
    sensor = unit(noise_density_g_per_rthz=np.full(3, 1e-4), adc_bits=16)
    parameter_file.save(tmp_path / 'unit.yaml', sensor)
    time_s = 1e-3 * np.arange(1500)
    table = np.column_stack([time_s, force(time_s)]).tolist()
    rows = ['time_s,ax_mps2,ay_mps2,az_mps2', *(','.join(map(repr, row)) for row in table)]
    (tmp_path / 'ideal.csv').write_text('\n'.join(rows))
    done = run_tool(
        'simulate',
        'imu',
        '--force',
        'ideal.csv',
        '--params',
        'unit.yaml',
        '--seed',
        seed,
        '-o',
        'out.csv',
    )
    assert done.returncode == 0, done.stderr
    recorded = recording.read(tmp_path / 'out.csv').volts(sensor)
    link = topic.open_link(sensor, topic.Settings(seed=seed))
    samples = feed(link, np.rint(time_s * 1e9).astype(np.int64))
    assert np.abs(samples.volts - recorded)[: len(samples.volts)].max() < 1e-9


def test_jitter_and_lost_samples_leave_the_chain_running() -> None:
    link = topic.open_link(unit(), topic.Settings())
    exact = topic.open_link(unit(), topic.Settings())
    index = np.arange(2000)
    rng = np.random.default_rng(1)
    stamps = START_NS + STEP_NS * index
    jittered = stamps + rng.integers(-STEP_NS // 5, STEP_NS // 5, len(stamps))
    lost = np.isin(index, [300, 301, 900])
    accel = force(stamps * 1e-9)
    samples = feed(link, jittered[~lost], accel[~lost])
    assert np.array_equal(samples.stamp_ns, jittered[~lost]), 'stamps are those of the simulator'
    assert (samples.missing, samples.estimated) == (3, 3)
    error_mps2 = to_nominal_mps2(samples.volts - feed(exact, stamps, accel).volts[~lost], unit())
    assert np.abs(error_mps2 - to_nominal_mps2(0 * samples.volts, unit())).max() < 0.02
    assert link.sensor is not None
    assert link.sensor.rate_hz == pytest.approx(200, rel=0.01)


def test_a_reset_puts_the_sensor_at_its_power_on() -> None:
    link = topic.open_link(unit(), topic.Settings())
    stamps = STEP_NS * np.arange(1, 301)
    before = feed(link, stamps)
    after = feed(link, stamps)
    assert np.array_equal(before.stamp_ns, after.stamp_ns)
    assert np.array_equal(before.volts, after.volts), 'a unit without noise starts the same way'
    assert statistics(link)['resets'] == 1


def test_gyroscope_and_orientation_pass_through() -> None:
    stamps = START_NS + STEP_NS * np.arange(60)
    given = fields(force(stamps * 1e-9))
    link = topic.open_link(unit(), topic.Settings())
    passed = feed(link, stamps).imu_fields
    assert set(passed) == set(given) - {'linear_acceleration'}
    assert all(np.array_equal(passed[name], given[name]) for name in passed)
    given['angular_velocity'][:] = np.nan
    link.sense_imu(stamps + 60 * STEP_NS, given)
    marked = link.read(0).imu_fields
    assert not marked['angular_velocity'].any()
    assert (marked['angular_velocity_covariance'][:, 0] == -1).all()


def test_the_status_names_what_is_missing() -> None:
    link = topic.open_link(unit('lever_arm'), topic.Settings())
    assert 'waiting for a sample' in link.status().text
    link.sense_publishers(0)
    assert 'nobody publishes it' in link.status().text
    link.sense_publishers(1)
    assert 'paused' in link.status().text
    assert link.status().level is Level.WARN
    feed(link, START_NS + STEP_NS * np.arange(3))
    assert 'measuring the rate' in link.status().text
    feed(link, START_NS + STEP_NS * np.arange(3, 60))
    assert 'at 200 Hz' in link.status().text
    link.sense_publishers(2, 'imu/ideal: 2 nodes publish it')
    assert '2 nodes publish it' in link.status().text and link.status().level is Level.ERROR
    link.sense_publishers(1)
    assert 'lever_arm' in link.status().events[0].message and link.status().events[0].count == 1


def test_the_unit_of_the_samples_is_one_of_acceleration() -> None:
    sensor = nominal('xyz')
    assert topic.open_link(sensor, topic.Settings(unit='m/s^2')).imu_unit == 'mps2'
    for wrong in ('v', 'lsb', 'furlongs'):
        with pytest.raises(UserError, match=f'link.unit is .{wrong}.'):
            topic.open_link(sensor, topic.Settings(unit=wrong))
