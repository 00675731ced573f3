# SPDX-License-Identifier: Apache-2.0

"""The link that emulates a sensor on the ideal samples of a simulator, without ROS."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from adxl_ros.files import parameter_file, recording
from adxl_ros.links import topic
from adxl_ros.links.support.base import Level, Samples
from adxl_ros.model.sensor import Sensor, to_nominal_mps2
from adxl_ros.simulate.sensor_model import SensorModel
from adxl_ros.tools.effect_option import with_effects
import numpy as np
import pytest
from units import nominal

STEP_NS = 5_000_000
START_NS = 40 * 10 ** 9
EFFECTS = ('quadratic', 'temperature_bias:per_k.x=4e-4,per_k.y=-3e-4,per_k.z=2e-4', 'hysteresis')


def unit(*effects: str, **changes: object) -> Sensor:
    """Return a unit without noise and ADC, with some effects."""
    quiet = {'noise_density_g_per_rthz': np.zeros(3), 'adc_bits': 0}
    return with_effects(nominal('xyz', **quiet | changes), effects or EFFECTS)


def force(time_s: np.ndarray) -> np.ndarray:
    """Return a smooth specific force, m/s², (n, 3)."""
    return np.column_stack([3 * np.sin(2 * time_s), 2 * np.cos(3 * time_s),
                            9.8 + np.sin(time_s)])


def fields(accel: np.ndarray) -> dict[str, np.ndarray]:
    """Return the fields of messages with gyroscope and orientation, (n, k) each."""
    count = len(accel)
    return {'linear_acceleration': accel,
            'angular_velocity': np.tile([0.1, 0.2, 0.3], (count, 1)),
            'angular_velocity_covariance': np.tile(np.diag([1., 2., 3.]).ravel(), (count, 1)),
            'orientation': np.tile([0.0, 0.0, 0.0, 1.0], (count, 1)),
            'orientation_covariance': np.tile(np.eye(3).ravel(), (count, 1))}


def feed(link: topic.EmulatedSensor, stamps: np.ndarray, accel: np.ndarray | None = None
         ) -> Samples:
    """Give samples to a link, and return what it makes of them."""
    link.sense_imu(stamps, fields(force(stamps * 1e-9) if accel is None else accel))
    return link.read(0)


def statistics(link: topic.EmulatedSensor) -> dict[str, int]:
    """Return the counts of a link."""
    return link.status().values()


@pytest.mark.parametrize('seed', [0, 4])
def test_it_reads_what_simulate_records(run_tool, tmp_path: Path, seed: int) -> None:
    sensor = unit(noise_density_g_per_rthz=np.full(3, 1e-4), adc_bits=16)
    parameter_file.save(tmp_path / 'unit.yaml', sensor)
    time_s = 1e-3 * np.arange(1500)
    table = np.column_stack([time_s, force(time_s)]).tolist()
    rows = ['time_s,ax_mps2,ay_mps2,az_mps2', *(','.join(map(repr, row)) for row in table)]
    (tmp_path / 'ideal.csv').write_text('\n'.join(rows))
    done = run_tool('simulate', 'imu', '--force', 'ideal.csv', '--params', 'unit.yaml', '--seed',
                    seed, '-o', 'out.csv')
    assert done.returncode == 0, done.stderr
    recorded = recording.read(tmp_path / 'out.csv').volts(sensor)
    link = topic.open_link(sensor, topic.Settings(seed=seed))
    samples = feed(link, np.rint(time_s * 1e9).astype(np.int64))
    assert np.abs(samples.volts - recorded)[:len(samples.volts)].max() < 1e-9


def test_a_delay_is_that_of_the_sensor_model() -> None:
    sensor = unit('time_offset:offset_s=0.0123', 'hysteresis')
    index = np.arange(400)
    accel = force(5e-3 * index)
    model = SensorModel(replace(sensor, rate_hz=200.0))
    expected = np.array([model(row, 5e-3) for row in accel])
    link = topic.open_link(sensor, topic.Settings())
    parts = [feed(link, START_NS + STEP_NS * rows, accel[rows]).volts
             for rows in np.split(index, [70, 71, 200])]
    assert to_nominal_mps2(np.concatenate(parts), sensor) == pytest.approx(expected, abs=1e-9)


def test_the_temperature_is_that_of_its_topic() -> None:
    link = topic.open_link(unit(rc_capacitance_f=0.0), topic.Settings())
    link.sense_temperature(np.nan)
    stamps = START_NS + STEP_NS * np.arange(400)
    still = np.tile([0.0, 0.0, 9.80665], (200, 1))
    cold = feed(link, stamps[:200], still)
    link.sense_temperature(35.0)
    warm = feed(link, stamps[200:], still)
    change_g = (to_nominal_mps2(warm.volts[-1], unit())
                - to_nominal_mps2(cold.volts[-1], unit())) / 9.80665
    assert change_g == pytest.approx([4e-3, -3e-3, 2e-3], rel=0.02)


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
    assert statistics(link)['rate_changes'] == 0


def host_stamps(kind: str, rng: np.random.Generator) -> np.ndarray:
    """Return 20 s of stamps at 200 Hz as a host gives them on arrival, ns, (n,)."""
    index = np.arange(4000)
    due = 5e-3 * index
    if kind == 'bursts':
        arrival = 5e-3 * (index // 10 * 10)
    elif kind == 'uneven bursts':
        flushed = np.cumsum(rng.uniform(0.01, 0.05, 1000))
        arrival = flushed[np.searchsorted(flushed, due)]
    elif kind == 'stalls':
        arrival = np.where(index % 150 < 20, due[index // 150 * 150] + 0.1, due)
    else:
        arrival = due + {'normal': rng.normal(0, 1.5e-3, len(index)),
                         'delays': rng.exponential(5e-3, len(index))}[kind]
    # A sample takes 40 µs to be handed on.
    return START_NS + np.rint(1e9 * (
        np.maximum.accumulate(arrival - 4e-5 * index) + 4e-5 * index)).astype(np.int64)


@pytest.mark.parametrize('kind', ['normal', 'delays', 'bursts', 'uneven bursts', 'stalls'])
def test_host_stamps_neither_mislead_the_rate_nor_restart_the_sensor(kind: str) -> None:
    link = topic.open_link(unit(), topic.Settings())
    stamps = host_stamps(kind, np.random.default_rng(1))
    parts = [feed(link, part) for part in np.array_split(stamps, 200)]
    assert link.sensor is not None
    assert link.sensor.rate_hz == pytest.approx(200, rel=0.05)
    assert statistics(link)['rate_changes'] == 0
    assert sum(len(part.stamp_ns) for part in parts) == len(stamps)
    assert sum(part.missing for part in parts) == 0 or kind == 'stalls'


@pytest.mark.parametrize('step_ns', [STEP_NS // 2, STEP_NS * 2, STEP_NS * 11 // 10])
def test_a_new_rate_is_measured(step_ns: int) -> None:
    link = topic.open_link(unit(), topic.Settings())
    feed(link, START_NS + STEP_NS * np.arange(300))
    first_ns = START_NS + 300 * STEP_NS
    feed(link, first_ns + step_ns * np.arange(600))
    assert link.sensor is not None
    assert link.sensor.rate_hz == pytest.approx(1e9 / step_ns, rel=1e-6)
    assert statistics(link)['rate_changes'] == 1
    assert link.status().level is Level.OK


def test_a_reset_puts_the_sensor_at_its_power_on() -> None:
    link = topic.open_link(unit(), topic.Settings())
    stamps = STEP_NS * np.arange(1, 301)
    before = feed(link, stamps)
    after = feed(link, stamps)
    assert np.array_equal(before.stamp_ns, after.stamp_ns)
    assert np.array_equal(before.volts, after.volts), 'a unit without noise starts the same way'
    assert statistics(link)['resets'] == 1


def test_late_samples_gaps_and_values_that_are_no_number() -> None:
    link = topic.open_link(unit(), topic.Settings())
    stamps = START_NS + STEP_NS * np.arange(200)
    feed(link, stamps)
    assert not len(feed(link, stamps[-2:]).stamp_ns)
    assert statistics(link)['late'] == 2
    assert not len(feed(link, stamps[-1:] + STEP_NS, np.full((1, 3), np.nan)).stamp_ns)
    assert statistics(link)['not_finite'] == 1
    after = feed(link, stamps[-1] + 7 * 10 ** 9 + STEP_NS * np.arange(200))
    assert statistics(link)['gaps'] == 1
    assert after.missing == 7 * 200 - 1
    assert len(after.stamp_ns) == 200 and np.isfinite(after.volts).all()


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


def test_a_rotation_turns_the_whole_message() -> None:
    """The x axis of a case that is yawed by 90° lies along the y axis of the simulator."""
    sensor = unit('bias:offset_v=0', rc_capacitance_f=0.0)
    link = topic.open_link(sensor, topic.Settings(yaw_rad=np.pi / 2))
    samples = feed(link, START_NS + STEP_NS * np.arange(60), np.tile([1.0, 2.0, 3.0], (60, 1)))
    assert to_nominal_mps2(samples.volts[-1], sensor) == pytest.approx([2.0, -1.0, 3.0])
    turned = samples.imu_fields
    assert turned['angular_velocity'][0] == pytest.approx([0.2, -0.1, 0.3])
    assert turned['angular_velocity_covariance'][0].reshape(3, 3).diagonal() == pytest.approx(
        [2, 1, 3])
    assert turned['orientation'][0] == pytest.approx([0, 0, 0.5 ** 0.5, 0.5 ** 0.5])


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
