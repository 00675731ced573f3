# SPDX-License-Identifier: Apache-2.0

"""What a recording beside its simulation says, on values that are made by hand."""

from dataclasses import replace

from adxl_ros.diagnose import comparison as beside
from adxl_ros.diagnose.encoder_checks import seen_step_rad
from adxl_ros.diagnose.fast_motion import fading_frequency_hz
from adxl_ros.diagnose.reference_gaps import stated_poses, without_gaps
from adxl_ros.diagnose.sample_faults import code_step_v
from adxl_ros.files.recording_columns import Recording
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.kinematics import specific_force
from adxl_ros.signals.block_statistics import bridged
from adxl_ros.simulate.motion import ForcePath, Motion
from gaps import simulated, turning, unit
import numpy as np
import pytest
from scipy.signal import butter, sosfiltfilt
from units import nominal

RATE_HZ = 100.0
GAP_MPS2 = 0.05


@pytest.fixture(scope='module')
def compared():
    """Return a recording that is its simulation plus a constant."""
    sensor = unit()
    comparison = beside.compare(simulated(sensor, motion=turning()), sensor)
    gap_v = GAP_MPS2 * comparison.scale_v_per_mps2
    return replace(comparison, volts=comparison.simulated_v(sensor) + gap_v)


def followed(force_mps2, recorded_mps2):
    """Put a recording beside a force of another simulator, m/s², (n, 3), at 100 Hz."""
    sensor = nominal('xyz', rate_hz=RATE_HZ)
    time_s = np.arange(len(force_mps2)) / RATE_HZ
    volts = recorded_mps2 / G0_MPS2 * sensor.scale_v_per_g + sensor.zero_g_v
    columns = {f'{axis}_v': v for axis, v in zip('xyz', volts.T)}
    motion = Motion(float(time_s[-1]), force=ForcePath(time_s, force_mps2))
    return beside.compare(Recording('made', time_s, columns), sensor, motion)


def test_the_residual_is_recording_minus_simulation(compared):
    residual_mps2 = compared.residual_v(compared.sensor) / compared.scale_v_per_mps2
    assert residual_mps2 == pytest.approx(GAP_MPS2)


def test_the_search_has_the_filter_of_the_recording():
    """A digital filter follows the rate of the sensor, not that of the searched samples."""
    sensor = replace(unit(), rate_hz=500.0, filter_rate_hz=125.0)
    comparison = beside.compare(simulated(sensor, motion=turning()), sensor)
    searched = beside.at_search_rate(comparison)
    of_search_v = comparison.simulated_v(sensor)[::4]
    assert len(searched) == len(of_search_v)
    assert searched.simulated_v(sensor) == pytest.approx(of_search_v, abs=1e-5)


def test_without_a_reference_only_changes_are_compared():
    """The pose is unknown, so that the mean of the residual says nothing."""
    sensor = unit()
    volts = np.linspace(2.4, 2.6, 200)[:, None] * [1.0, 1.0]
    columns = {'x_v': volts[:, 0], 'y_v': volts[:, 1]}
    comparison = beside.compare(Recording('rest', np.arange(200) / RATE_HZ, columns), sensor)
    assert comparison.reference is beside.Reference.NONE
    assert comparison.residual_v(sensor) == pytest.approx(volts - volts.mean(axis=0))


def test_what_is_left_out_is_counted_with_its_size(compared):
    rows = np.zeros(len(compared), bool)
    rows[100:150] = True
    kept = beside.leave_out(compared, rows, 'they were shaken', 'spikes')
    (part,) = kept.left_out
    assert (part.samples, part.effect, part.reason) == (50, 'spikes', 'they were shaken')
    assert part.duration_s == pytest.approx(50 * compared.dt_s)
    assert part.rms_mps2 == pytest.approx(GAP_MPS2)
    assert part.squares_mps2 == pytest.approx(50 * GAP_MPS2**2)
    assert kept.used.sum() == compared.used.sum() - 50


def test_a_sample_has_one_reason(compared):
    """The first one stays, and a reason that is left without samples is not noted."""
    rows = np.zeros(len(compared), bool)
    rows[100:150] = True
    once = beside.leave_out(compared, rows, 'first')
    rows[145:160] = True
    twice = beside.leave_out(once, rows, 'second')
    assert [(part.reason, part.samples) for part in twice.left_out] == [
        ('first', 50),
        ('second', 10),
    ]
    assert beside.leave_out(twice, rows, 'third') is twice


def test_gaps_are_bridged_by_lines_and_ends_hold():
    data = np.array([[9.0], [1.0], [9.0], [9.0], [4.0], [9.0]])
    used = np.array([False, True, False, False, True, False])
    assert bridged(data, used).ravel() == pytest.approx([1, 1, 2, 3, 4, 4])


def test_the_direction_of_the_last_move_stays():
    """A path by the steps of an encoder rings at a stop, by less than a move."""
    angles_rad = np.array([0.0, 1e-5, 0.5, 0.4999, 0.5001, 0.3, 0.3001, 0.6])
    directions = beside.direction_of_last_move(angles_rad).tolist()
    assert directions == [0, 0, 1, 1, 1, -1, -1, 1]


def test_any_joint_ends_a_rest():
    time_s = np.arange(6.0)
    rates = [np.array([0, 1, 0, 0, 0, 0]), np.array([0, 0, 0, 0, -1, 0])]
    since_s = beside.time_since_move_s(time_s, rates)
    assert since_s[1:].tolist() == [0, 1, 2, 0, 1]
    assert since_s[0] > 100


def test_the_step_of_the_codes_is_the_smallest_change():
    volts = np.array([[0.0, 1.0], [0.5, 1.0], [0.25, 1.0], [0.25, 1.0]])
    assert code_step_v(volts).tolist() == [0.25, 0.0]


@pytest.mark.parametrize('step_rad', [2e-3, 8e-3])
def test_the_step_of_an_encoder_shows_in_its_readings(step_rad):
    sensor = replace(nominal(), stage_resolution_rad=1e-4)
    angle_rad = np.sin(np.arange(4000) / 300)
    columns = {
        'x_v': angle_rad,
        'y_v': angle_rad,
        'alpha_rad': np.round(angle_rad / step_rad) * step_rad,
        'beta_rad': np.zeros(4000),
    }
    recording = Recording('made', np.arange(4000) / RATE_HZ, columns)
    assert seen_step_rad(recording, sensor) == pytest.approx(step_rad, rel=1e-6)
    columns['alpha_rad'] = angle_rad
    assert seen_step_rad(recording, sensor) == sensor.stage_resolution_rad


def test_samples_in_a_gap_of_a_simulator_are_left_out():
    force_mps2 = np.tile([0.0, 0.0, G0_MPS2], (3000, 1))
    comparison = followed(force_mps2, force_mps2)
    time_s = comparison.time_s
    read = (time_s < 10.0) | (time_s > 12.0)
    motion = replace(comparison.motion, force=ForcePath(time_s[read], force_mps2[read]))
    kept = without_gaps(replace(comparison, motion=motion))
    unknown_s = time_s[comparison.used & ~kept.used]
    # The spline is uncertain before the gap, and the filter settles after it.
    assert 9.8 < unknown_s.min() < 10.0
    assert 12.0 < unknown_s.max() < 12.5
    assert kept.left_out[0].effect is None


def test_a_pose_that_is_stated_at_rests_alone_holds_there():
    """Poses of 4 s with 3 s between them, in which no angle is stated and the sensor turns."""
    sensor, time_s = replace(nominal(), rate_hz=RATE_HZ), np.arange(8100) / RATE_HZ
    poses_rad = np.random.default_rng(1).uniform(-1.5, 1.5, (2, 12))
    place, resting = (time_s // 7.0).astype(int), time_s % 7.0 < 4.0
    stated_rad = np.where(resting, poses_rad[:, place], np.nan)
    force = np.array(specific_force(*poses_rad[:, place], 1.0))[:2].T
    moving_g = np.sin(20.0 * time_s)[:, None] * ~resting[:, None]
    volts = (force + moving_g) * sensor.scale_v_per_g + sensor.zero_g_v
    columns = dict(zip(('x_v', 'y_v', 'alpha_rad', 'beta_rad'), [*volts.T, *stated_rad]))
    read, left_out = stated_poses(Recording('made', time_s, columns), sensor)
    unknown = left_out[0][0] | left_out[1][0]
    assert unknown[~resting].all() and unknown[resting].mean() < 0.15
    comparison = beside.compare(read, sensor)
    residual_g = comparison.residual_v(sensor)[~unknown] / sensor.scale_v_per_g
    # The step of the encoder is 1.5 mrad.
    assert np.abs(residual_g).max() < 1e-3


def low_passed(values, corner_hz):
    return sosfiltfilt(butter(4, corner_hz, fs=RATE_HZ, output='sos'), values, axis=0)


@pytest.mark.parametrize('corner_hz', [8.0, 16.0])
def test_a_smooth_reference_fades_at_its_corner(corner_hz):
    white_mps2 = np.random.default_rng(2).normal(0, 3.0, (6000, 3))
    motion_mps2 = low_passed(white_mps2, 30.0) + [0.0, 0.0, G0_MPS2]
    smooth_mps2 = low_passed(motion_mps2, corner_hz)
    fading_hz = fading_frequency_hz(followed(smooth_mps2, motion_mps2))
    assert fading_hz == pytest.approx(corner_hz, abs=3.0)
    assert fading_frequency_hz(followed(motion_mps2, motion_mps2)) is None
