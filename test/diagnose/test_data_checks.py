# SPDX-License-Identifier: Apache-2.0

"""Each check of a recording's data near its rule, on arrays made by hand."""

from dataclasses import replace

from adxl_ros.diagnose.axis_checks import check_axes, check_output, stuck
from adxl_ros.diagnose.comparison import compare
from adxl_ros.diagnose.data_checks import compare_checked
from adxl_ros.diagnose.data_faults import DataFault
from adxl_ros.diagnose.encoder_checks import check_encoder
from adxl_ros.diagnose.motion_shifts import correlate, find_drift, find_step, Motions
from adxl_ros.diagnose.stamp_checks import check_clock, even_stamps
from adxl_ros.files.recording_columns import Recording
from adxl_ros.files.stream_info import sensor_info
from adxl_ros.model.kinematics import specific_force
from adxl_ros.simulate.motion import ForcePath, Motion
import numpy as np
import pytest
from units import nominal

RATE_HZ = 50.0
TIME_S = np.arange(3000) / RATE_HZ


def wandering(count=3000, seed=1):
    """Return a motion of three axes, g, (n, 3), that does not repeat, below 1 Hz."""
    knots = np.random.default_rng(seed).uniform(-0.8, 0.8, (count // 40 + 2, 3))
    at = np.arange(count) / 40
    return np.column_stack([np.interp(at, np.arange(len(knots)), k) for k in knots.T])


def recorded(time_s=TIME_S, **columns):
    sensor = nominal('xyz')
    columns = {f'{axis}_v': np.zeros(len(time_s)) for axis in 'xyz'} | columns
    return Recording('made', time_s, columns, sensor_info(sensor))


def test_stamps_that_scatter_lie_on_a_line_although_samples_are_missing():
    number = np.delete(np.arange(500), [100, 101, 300])
    scatter = np.random.default_rng(1).uniform(-0.2, 0.2, len(number))
    even_s = even_stamps((number + scatter) / RATE_HZ)
    assert even_s == pytest.approx(number / RATE_HZ, abs=0.05 / RATE_HZ)


@pytest.mark.parametrize('scatter', [0.0, 0.6])
def test_even_stamps_stay_and_wild_ones_show_no_line(scatter):
    stamps = np.arange(500) + scatter * np.random.default_rng(1).uniform(-1, 1, 500)
    assert even_stamps(np.sort(stamps) / RATE_HZ) is None


@pytest.mark.parametrize(
    ('time_s', 'name', 'words'),
    [
        (np.array([0.0, 0.1, 0.05, 0.2]), 'clock_jump', 'backwards at 0.1 s'),
        (np.concatenate([TIME_S, TIME_S + 160.0]), 'clock_jump', 'jump by 100 s at 59.98 s'),
        (1e3 * TIME_S, 'unit', 'divide stamps in milliseconds by 1000'),
    ],
)
def test_impossible_stamps_are_refused(time_s, name, words):
    angle_rad = np.linspace(0.0, 1.0, len(time_s))
    with pytest.raises(DataFault) as refused:
        check_clock(recorded(time_s, alpha_rad=angle_rad, beta_rad=angle_rad))
    assert refused.value.name == name and words in refused.value.message


@pytest.mark.parametrize('lag', [-7, 0, 12])
def test_the_correlation_of_two_motions_is_one_at_their_lag(lag):
    motion_g = wandering(600)
    first = motion_g[100:400]
    found = correlate(first, motion_g[100 - lag :], 0.5, 200)
    best = np.argmax(found.correlation)
    assert found.late_s == 0.5 * lag and found.overlap[best] == 300 + min(lag, 0)
    assert found.correlation[best] == pytest.approx(1.0, abs=1e-9)


def motions(late_s):
    """Return a motion, and a simulator that is stamped later by some time, s, (n,) or ()."""
    time_s = np.arange(0.0, 120.0, 0.02)
    motion_g = wandering(len(time_s))
    stated_g = np.column_stack([np.interp(time_s, time_s + late_s, g) for g in motion_g.T])
    return Motions(time_s, motion_g, time_s, stated_g, 0.02)


def test_a_drift_of_the_clock_is_found_with_both_ends():
    drift_s = np.linspace(0.2, 1.0, 6000)
    made = motions(drift_s)
    drift = find_drift(made, made.fitting_parts())
    assert drift == pytest.approx((0.2, 1.0), abs=0.02)


def test_one_shift_is_neither_a_drift_nor_a_step():
    made = motions(0.5)
    parts = made.fitting_parts()
    assert [part.late_s for part in parts] == pytest.approx([0.5] * len(parts), abs=0.02)
    assert find_drift(made, parts) is None
    assert find_step(made, recorded(made.measured_s), 0.5, parts) is None


def test_a_step_of_the_clock_is_found_with_its_size_and_time():
    made = motions(np.where(np.arange(6000) < 2000, 0.1, 0.6))
    step = find_step(made, recorded(made.measured_s), 0.1, made.fitting_parts())
    assert step.after_s - step.before_s == pytest.approx(0.5, abs=0.01)
    assert step.at_s == pytest.approx(40.0, abs=1.0)


def turned(alpha_factor=1.0, beta_factor=1.0, axis_signs=(1, 1, 1)):
    """Return a recording on a stage whose encoders or axes are wrong by factors."""
    sensor = nominal('xyz')
    alpha_rad = 1.2 + 0.8 * np.sin(TIME_S / 7)
    beta_rad = 2.0 * np.sin(TIME_S / 3)
    force_g = np.column_stack(specific_force(alpha_rad, beta_rad, 1.0)) * axis_signs
    volts = sensor.zero_g_v + sensor.scale_v_per_g * force_g
    return recorded(
        alpha_rad=alpha_rad * alpha_factor,
        beta_rad=beta_rad * beta_factor,
        **{f'{axis}_v': v for axis, v in zip('xyz', volts.T)},
    )


@pytest.mark.parametrize(
    ('factors', 'name', 'words'),
    [
        ({'beta_factor': -1.0}, 'encoder_sign', 'beta_rad: opposite sign'),
        ({'alpha_factor': 180 / np.pi}, 'unit', 'alpha_rad: up to 114.6: degrees'),
    ],
)
def test_angles_with_a_wrong_sign_or_unit_are_refused(factors, name, words):
    with pytest.raises(DataFault) as refused:
        check_encoder(turned(**factors), nominal('xyz'))
    assert refused.value.name == name and words in refused.value.message


def test_right_angles_and_inverted_axes_are_no_fault_of_the_encoder():
    check_encoder(turned(), nominal('xyz'))
    check_encoder(turned(axis_signs=(-1, 1, 1)), nominal('xyz'))


@pytest.fixture
def beside():
    """Give a function that puts an output beside a simulator, both g, (n, 3)."""
    sensor = replace(nominal('xyz'), rate_hz=RATE_HZ)
    force_g = wandering()
    sim = Motion(float(TIME_S[-1]), force=ForcePath(TIME_S, 9.80665 * force_g))

    def compared(change):
        output_g = change(force_g) + 2e-3 * np.random.default_rng(2).normal(size=force_g.shape)
        volts = sensor.zero_g_v + sensor.scale_v_per_g * output_g
        return compare(recorded(**dict(zip(('x_v', 'y_v', 'z_v'), volts.T))), sensor, sim)

    return compared


@pytest.mark.parametrize(
    ('change', 'name', 'words'),
    [
        (lambda g: g * [1, -1, 1], 'axis_inverted', 'y'),
        (lambda g: g[:, [1, 0, 2]], 'axis_swapped', 'x'),
        (lambda g: g * 9.80665, 'unit', 'the output is 9.8'),
        (lambda g: wandering(seed=5), 'reference', 'does not follow the reference'),
    ],
)
def test_axes_that_do_not_follow_the_simulation_are_named(beside, change, name, words):
    with pytest.raises(DataFault) as refused:
        check_axes(beside(change))
    assert refused.value.name == name and words in refused.value.message


def test_an_axis_that_never_changes_is_refused(beside):
    comparison = beside(lambda g: g)
    check_output(comparison)
    check_axes(comparison)
    volts = comparison.volts.copy()
    volts[:, 2] = volts[0, 2]
    with pytest.raises(DataFault) as refused:
        check_output(replace(comparison, volts=volts))
    assert refused.value.name == 'constant' and refused.value.message.startswith('z ')


def test_an_output_is_stuck_where_it_keeps_a_value_for_more_than_a_second(beside):
    comparison = beside(lambda g: g)
    volts = comparison.volts.copy()
    volts[1000:1200, 1] = volts[1000, 1]
    volts[2000:2040, 0] = volts[2000, 0]
    rows, axes = np.nonzero(stuck(replace(comparison, volts=volts)))
    assert rows.tolist() == list(range(1001, 1200)) and set(axes) == {1}


def test_coarse_codes_are_not_stuck(beside):
    comparison = beside(lambda g: g)
    coarse_v = np.round(comparison.volts / 0.3) * 0.3
    assert not stuck(replace(comparison, volts=coarse_v)).any()


def test_a_pose_that_is_read_before_and_after_a_gap_holds_in_it():
    """As in a table by hand: poses at rest, none in between, and some readings are missing."""
    sensor = replace(nominal('xyz'), rate_hz=RATE_HZ)
    rng = np.random.default_rng(1)
    number = np.arange(len(TIME_S)) // 300
    moves = np.arange(len(TIME_S)) % 300 < 60
    poses = rng.uniform([0.3, -2.5], [2.8, 2.5], (10, 2))
    alpha_rad, beta_rad = (np.interp(TIME_S, TIME_S[~moves], p[number][~moves]) for p in poses.T)
    force_g = np.column_stack(specific_force(alpha_rad, beta_rad, 1.0))
    volts = sensor.zero_g_v + sensor.scale_v_per_g * force_g
    volts += 1e-3 * rng.normal(size=volts.shape)
    alpha_rad[300 * 3 + 240 :] += 1e-5
    missing = moves.copy()
    missing[300 * 3 + 80 : 300 * 3 + 240] = True
    alpha_rad[missing] = beta_rad[missing] = np.nan
    columns = {f'{axis}_v': v for axis, v in zip('xyz', volts.T)}
    recording = recorded(alpha_rad=alpha_rad, beta_rad=beta_rad, **columns)
    comparison = compare_checked(recording, sensor, None, False)
    residual_v = comparison.residual_v(sensor)[comparison.used]
    assert np.std(residual_v, axis=0) == pytest.approx(1e-3, rel=0.1)
    assert comparison.used[300 * 3 + 80 : 300 * 3 + 240].all()
