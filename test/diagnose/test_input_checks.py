# SPDX-License-Identifier: Apache-2.0

"""What is wrong with the input of a diagnosis is named before any effect."""

from dataclasses import replace
import json

from adxl_ros.diagnose import data_checks
from adxl_ros.diagnose.comparison import compare
from adxl_ros.diagnose.data_checks import compare_checked
from adxl_ros.files import parameter_file, recording
from adxl_ros.files.recording_columns import ACCEL, Recording
from adxl_ros.files.stream_info import sensor_info
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.kinematics import specific_force
from adxl_ros.simulate import trajectories
from adxl_ros.simulate.from_recording import motion_from_force
from adxl_ros.simulate.motion import Motion
from adxl_ros.simulate.sensor_model import SensorModel
from adxl_ros.simulate.simulator import simulate
from adxl_ros.simulate.trajectories import shaker
import numpy as np
import pytest
from scipy.signal import butter, sosfiltfilt
from units import nominal


def unit(rate_hz=100.0):
    """Return a nominal unit on a stage with a fine encoder."""
    return replace(nominal('xyz'), rate_hz=rate_hz, stage_resolution_rad=1e-4)


def script(turns=3):
    """Turn beta in several planes, with rests."""
    path = trajectories.Script(np.pi / 2, 0.0)
    for alpha in (np.pi / 2, 1.0, 2.2)[:turns]:
        path.go(alpha, 0.0)
        for to, speed in ((2.0, 0.6), (0.5, 1.5), (4.0, 1.0), (0.0, 0.8)):
            path.run('beta', to, speed)
            path.rest(1.0)
    return path


def made(sensor, turns=3, seed=3):
    """Simulate a recording."""
    path = script(turns)
    columns = simulate(sensor, Motion(path.now, *path.joints()), seed)
    return Recording('made', columns.pop('time_s'), columns, sensor_info(sensor))


def report_of(run_tool, tmp_path, sensor, *recordings, options=()):
    """Run `diagnose` on recordings; return its report and the process."""
    parameter_file.save(tmp_path / 'unit.yaml', sensor)
    names = [f'run{i}.csv' for i in range(len(recordings))]
    for name, recorded in zip(names, recordings):
        recording.write(tmp_path / name, recorded, sensor)
    run = run_tool('diagnose', *names, '--params', 'unit.yaml', '-o', 'out', '--json', *options)
    return json.loads(run.stdout), run


def test_no_verdict_is_exit_status_1(run_tool, tmp_path):
    """A fault of the recording ends with 1, a complete report, and one line on stderr."""
    recorded = made(unit())
    recorded.columns['x_v'] = 5 - recorded.columns['x_v']
    report, run = report_of(run_tool, tmp_path, unit(), recorded)
    assert run.returncode == 1
    assert run.stderr.count('\n') == 1
    assert 'run0.csv: no verdict (axis_inverted)' in run.stderr
    assert report['verdict']['status'] == 'bad_data'
    assert 'Exit status' in run_tool('diagnose', '--help').stdout


def test_short_recordings_count_together():
    """Two recordings of 20 s are long enough, one is not."""
    recorded = made(unit(), turns=1)
    comparison = compare(recorded, unit())
    assert 15 < comparison.span_s < data_checks.SHORTEST_S
    assert data_checks.find_length_fault([comparison]).status == 'insufficient'
    assert data_checks.find_length_fault([comparison, comparison]) is None
    assert data_checks.find_data_fault(comparison, comparison) is None


def ideal(tmp_path, late_s, name='sim.csv'):
    """Write the ideal force of the recording of `made`, with stamps that are late."""
    path = script()
    alpha, beta = path.joints()
    time_s = np.arange(0, path.now, 0.01)
    force = specific_force(alpha(time_s), beta(time_s), G0_MPS2)
    rows = np.column_stack([time_s + late_s, *force])
    np.savetxt(tmp_path / name, rows, '%.6f', ',', comments='',
               header='time_s,ax_mps2,ay_mps2,az_mps2')
    return name


@pytest.mark.parametrize('late_s', [0.7, -1.3, 12.0])
def test_a_shifted_simulator_is_late(run_tool, tmp_path, late_s):
    """A shift that no latency explains is named with its size, and `--align` with it."""
    report, run = report_of(run_tool, tmp_path, unit(), made(unit()),
                            options=['--sim', ideal(tmp_path, late_s)])
    assert run.returncode == 1
    assert report['verdict']['data_fault'] == 'time_misaligned'
    words = report['summary'].split()
    assert words[:2] == ['--sim', 'is'] and 'use --align' in report['summary']
    assert words[4] == ('late' if late_s > 0 else 'early')
    assert float(words[2]) == pytest.approx(abs(late_s), abs=2e-3)
    assert float(words[6]) < 2e-3


def test_a_simulator_of_another_time_does_not_overlap(run_tool, tmp_path):
    """Both ranges of time are named, and the shift that makes the motion fit."""
    report, run = report_of(run_tool, tmp_path, unit(), made(unit()),
                            options=['--sim', ideal(tmp_path, 1000.0)])
    assert (run.returncode, report['verdict']['data_fault']) == (1, 'no_overlap')
    summary = report['summary']
    assert 'from 0 to ' in summary and 'from 1000 to ' in summary and '--align' in summary
    assert '1000.00' in summary


@pytest.mark.parametrize('late_s', [1000.0, 0.7, 0.02])
def test_align_shifts_the_simulator(tmp_path, late_s):
    """`--align` removes a shift, and leaves a latency of the sensor where it is."""
    force = motion_from_force(tmp_path / ideal(tmp_path, late_s), False)[0]
    comparison = compare_checked(made(unit()), unit(), force, True)
    residual_g = comparison.residual_v(comparison.sensor)[comparison.used]
    assert np.sqrt(np.mean(residual_g ** 2)) < (1e-3 if late_s > 0.1 else 1e-2)
    assert comparison.notes[0].startswith('--align')
    assert ('nothing is shifted' in comparison.notes[0]) == (late_s < 0.1)


def in_a_loop(tmp_path, jerk_s=0.008, noise_mps2=0.0):
    """Return a sensor in the loop of a simulator that begins with a jerk; write its force."""
    sensor, time_s = unit(200.0), np.arange(8000) / 200.0
    jerk = np.exp(-time_s / jerk_s)
    force = np.column_stack([3 * np.sin(0.7 * time_s) - 4 * jerk,
                             4 * np.cos(0.45 * time_s) + 6 * jerk, 9 + np.sin(0.3 * time_s)])
    model = SensorModel(sensor, seed=1)
    readings = np.array([model(row, 1 / 200.0) for row in force])
    force += noise_mps2 * np.random.default_rng(2).standard_normal(force.shape)
    np.savetxt(tmp_path / 'sim.csv', np.column_stack([time_s, force]), '%.6f', ',', comments='',
               header='time_s,ax_mps2,ay_mps2,az_mps2')
    return sensor, Recording('made', time_s, dict(zip(ACCEL, readings.T)), sensor_info(sensor))


def test_a_simulator_that_begins_with_a_jerk_has_no_gap(run_tool, tmp_path):
    """No effect is named for the filter, whose state before the first sample is unknown."""
    sensor, recorded = in_a_loop(tmp_path)
    report, run = report_of(run_tool, tmp_path, sensor, recorded, options=['--sim', 'sim.csv'])
    assert (run.returncode, report['verdict']['status']) == (0, 'no_gap')
    proposal = report['next_experiment']
    assert '--sim' in proposal['command'], 'no stage makes the motion'
    assert proposal['manoeuvre'] == 'tilt slowly in all directions'
    assert report['not_covered'] == ['other temperatures', 'other supplies']


def test_jumps_of_a_simulators_force_are_no_effect(run_tool, tmp_path):
    """The time of a jump between two readings is unknown: samples after it do not count."""
    rng = np.random.default_rng(4)
    time_s = np.arange(40000) / 1000.0
    force = np.column_stack([3 * np.sin(0.7 * time_s), 4 * np.cos(0.45 * time_s),
                             9 + np.sin(0.3 * time_s)])
    for i in range(0, len(time_s), 500):
        force[i + rng.integers(500):, :2] += 0.4 * rng.choice([-1, 1], 2) * rng.uniform(0.5, 1, 2)
    model = SensorModel(unit(1000.0), seed=1)
    readings = np.array([model(row, 1e-3) for row in force])[::5]
    sensor = unit(200.0)
    np.savetxt(tmp_path / 'sim.csv', np.column_stack([time_s, force])[::5], '%.6f', ',',
               comments='', header='time_s,ax_mps2,ay_mps2,az_mps2')
    recorded = Recording('made', time_s[::5], dict(zip(ACCEL, readings.T)), sensor_info(sensor))
    report, run = report_of(run_tool, tmp_path, sensor, recorded, options=['--sim', 'sim.csv'])
    assert (run.returncode, report['verdict']['status']) == (0, 'no_gap')
    assert '--sim jumps between its readings' in report['notes'][0]


def test_the_noise_of_a_simulator_is_to_be_switched_off(run_tool, tmp_path):
    sensor, recorded = in_a_loop(tmp_path, noise_mps2=0.05)
    report, run = report_of(run_tool, tmp_path, sensor, recorded, options=['--sim', 'sim.csv'])
    assert (run.returncode, report['verdict']['status']) == (1, 'insufficient')
    assert 'usable reference' in report['summary']
    assert any('switch off noise that the simulator adds' in note for note in report['notes'])


def test_a_simulator_of_another_motion_is_no_shift(run_tool, tmp_path):
    """A motion that fits at no shift is named as another recording's."""
    recorded = made(unit())
    time_s = recorded.time_s
    rng = np.random.default_rng(1)
    wander = np.cumsum(rng.normal(size=(3, len(time_s))), axis=1) * 0.02
    np.savetxt(tmp_path / 'sim.csv', np.column_stack([time_s + 500.0, *wander]), '%.6f', ',',
               comments='', header='time_s,ax_mps2,ay_mps2,az_mps2')
    report, run = report_of(run_tool, tmp_path, unit(), recorded, options=['--sim', 'sim.csv'])
    assert (run.returncode, report['verdict']['data_fault']) == (1, 'no_overlap')
    assert 'no shift' in report['summary']


@pytest.mark.parametrize('signs', [(1, -1), (-1, 1)])
@pytest.mark.parametrize('axes', ['xy', 'xyz'])
def test_an_encoder_that_counts_backwards_is_named(run_tool, tmp_path, signs, axes):
    """The wrong sign of an encoder is not blamed on the sensor."""
    sensor = replace(nominal(axes), rate_hz=100.0, stage_resolution_rad=1e-4)
    recorded = made(sensor)
    for name, sign in zip(('alpha_rad', 'beta_rad'), signs):
        recorded.columns[name] = recorded.columns[name] * sign
    report, run = report_of(run_tool, tmp_path, sensor, recorded)
    name = 'alpha_rad' if signs[0] < 0 else 'beta_rad'
    assert (run.returncode, report['verdict']['data_fault']) == (1, 'encoder_sign')
    assert report['summary'].startswith(f'{name}: opposite sign of the encoder')


def test_zero_g_tells_an_inverted_axis_from_an_encoder(run_tool, tmp_path):
    """An inverted y looks like a wrong sign of beta, but its zero-g is mirrored, too."""
    sensor = replace(unit(), effects=('bias',),
                     values={'bias': {'offset_v': np.array([0.0, 0.03, 0.0])}})
    recorded = made(sensor)
    recorded.columns['beta_rad'] = -recorded.columns['beta_rad']
    report, _ = report_of(run_tool, tmp_path, sensor, recorded)
    assert report['verdict']['data_fault'] == 'encoder_sign'
    recorded = made(sensor)
    recorded.columns['y_v'] = 5 - recorded.columns['y_v']
    report, _ = report_of(run_tool, tmp_path, sensor, recorded)
    assert report['verdict']['data_fault'] == 'axis_inverted'


@pytest.mark.parametrize('names', [['beta_rad'], ['alpha_rad'], ['alpha_rad', 'beta_rad']])
def test_degrees_in_a_column_of_radians_are_named(run_tool, tmp_path, names):
    """Column, value, unit and remedy are named."""
    recorded = made(unit())
    for name in names:
        recorded.columns[name] = np.degrees(recorded.columns[name])
    report, run = report_of(run_tool, tmp_path, unit(), recorded)
    assert (run.returncode, report['verdict']['data_fault']) == (1, 'unit')
    assert 'degrees in a column of radians' in report['summary']
    assert f'multiply {" and ".join(names)} by π/180' in report['summary']
    assert '229' in report['summary'] or names == ['alpha_rad']


def rms_mg(comparison, rows):
    """Return the rms of recording minus simulation over some samples, mg."""
    return 1e3 * float(np.sqrt(np.mean(comparison.residual_v(comparison.sensor)[rows] ** 2)))


@pytest.mark.parametrize('rate_hz, left_out', [(20, True), (50, True), (250, False)])
def test_a_shaker_is_followed_as_far_as_its_readings_show(rate_hz, left_out):
    """What is used has the noise of the sensor, and the note names the times of the rest."""
    sensor = unit(float(rate_hz))
    columns = simulate(sensor, shaker(None), 1)
    recorded = Recording('made', columns.pop('time_s'), columns, sensor_info(sensor))
    comparison = compare_checked(recorded, sensor, None, False)
    noise_mg = rms_mg(comparison, recorded.time_s < 5)
    for part in np.array_split(np.flatnonzero(comparison.used), 8):
        assert rms_mg(comparison, part) < 1.2 * noise_mg
    assert (not comparison.used.all()) == left_out == bool(comparison.notes)
    if left_out:
        assert rms_mg(comparison, ~comparison.used) > 1.05 * noise_mg
        assert comparison.used.mean() > 0.2
        assert 'shift_m moves too fast' in comparison.notes[0]


def test_long_gaps_of_an_encoder_are_left_out(run_tool, tmp_path):
    """Single empty cells are bridged. A second without a reading is left out and named."""
    recorded = made(unit())
    beta_rad, time_s = recorded.columns['beta_rad'], recorded.time_s
    beta_rad[::3] = np.nan
    assert compare_checked(recorded, unit(), None, False).used.all()
    moving = float(time_s[np.nanargmax(np.abs(np.diff(beta_rad[1::3]))) * 3])
    beta_rad[(time_s > moving - 1) & (time_s < moving + 1)] = np.nan
    comparison = compare_checked(recorded, unit(), None, False)
    assert 0.02 < 1 - comparison.used.mean() < 0.06
    assert not comparison.used[np.abs(time_s - moving) < 1].any()
    assert 'no reading of beta_rad for more than 0.1 s' in comparison.notes[0]
    assert rms_mg(comparison, comparison.used) < 1.0
    beta_rad[time_s > 20] = np.nan
    report, run = report_of(run_tool, tmp_path, unit(), recorded)
    assert (run.returncode, report['verdict']['status']) == (1, 'insufficient')
    assert 'usable reference' in report['summary'] and 'beta_rad' in report['notes'][0]


def test_a_gap_of_the_simulator_is_left_out(tmp_path):
    """Samples in a hole of `--sim` have no reference."""
    path = tmp_path / ideal(tmp_path, 0.0)
    head, *lines = path.read_text().splitlines()
    path.write_text('\n'.join([head, *lines[:2000], *lines[2300:], '']))
    comparison = compare_checked(made(unit()), unit(), motion_from_force(path, False)[0], False)
    assert 'no reading of --sim' in comparison.notes[0]
    assert 20 <= 66.7 * (1 - comparison.used.mean()) * 1e1 <= 40


def stamped(stamps_s, rate_hz=300.0):
    """Compare a recording with other stamps; return it with the true instants, s."""
    sensor = unit(rate_hz)
    recorded = made(sensor, turns=2)
    true_s = recorded.time_s
    return compare_checked(replace(recorded, time_s=stamps_s(true_s)), sensor, None, False), true_s


@pytest.mark.parametrize('lost', [False, True])
def test_rounded_stamps_get_their_instants_back(lost):
    """Stamps of whole milliseconds at 300 Hz are an even clock, also where samples are lost."""
    sensor = unit(300.0)
    recorded = made(sensor, turns=2)
    true_s = recorded.time_s
    kept = np.ones(len(true_s), bool)
    if lost:
        kept[4000:4037] = kept[9000] = False
    recorded = replace(recorded, time_s=np.round(true_s, 3)[kept],
                       columns={k: v[kept] for k, v in recorded.columns.items()})
    comparison = compare_checked(recorded, sensor, None, False)
    assert np.abs(comparison.time_s - true_s[kept]).max() < 2e-5
    assert comparison.sensor.rate_hz == pytest.approx(300.0, abs=1e-3)
    assert 'rounded to 0.001 s' in comparison.notes[0]


def test_stamps_that_scatter_or_come_in_bursts_are_no_fault():
    """The instants are even where that fits the motion as well."""
    rng = np.random.default_rng(4)
    comparison, true_s = stamped(lambda t: t + rng.uniform(-1e-3, 1e-3, len(t)))
    assert np.abs(comparison.time_s - true_s).max() < 5e-5
    assert 'stamps scatter by up to 1' in comparison.notes[0]
    comparison, true_s = stamped(
        lambda t: (np.arange(len(t)) // 16 + 1) * 16 / 300 + np.arange(len(t)) % 16 * 1e-5)
    assert np.ptp(comparison.time_s - true_s) < 2e-3
    assert comparison.sensor.rate_hz == pytest.approx(300.0, rel=1e-3)
    assert 'come in bursts' in comparison.notes[0]


def test_samples_that_are_taken_unevenly_keep_their_stamps(tmp_path):
    """Stamps that are right stay, although they scatter."""
    sensor, path, rng = unit(), script(), np.random.default_rng(5)
    alpha, beta = path.joints()
    even = np.arange(0, path.now, 0.01)
    time_s = even + rng.uniform(-3e-3, 3e-3, len(even))
    force = specific_force(alpha(time_s), beta(time_s), 1.0)
    columns = {f'{axis}_v': 2.5 + f + rng.normal(0, 2e-4, len(f)) for axis, f in zip('xyz', force)}
    recorded = Recording('made', time_s, columns, sensor_info(sensor))
    sim = motion_from_force(tmp_path / ideal(tmp_path, 0.0), False)[0]
    comparison = compare_checked(recorded, replace(sensor, rc_resistance_ohm=0.0), sim, False)
    inside = slice(1, len(comparison.time_s) - 1)
    assert np.isin(comparison.time_s[inside], time_s).all() and not any(
        'even rate' in note for note in comparison.notes)


def test_rounded_stamps_are_in_the_report(run_tool, tmp_path):
    """A fault of another kind does not hide the note."""
    sensor = unit(300.0)
    recorded = made(sensor, turns=2)
    recorded = replace(recorded, time_s=np.round(recorded.time_s, 3))
    recorded.columns['x_v'] = 5 - recorded.columns['x_v']
    report, _ = report_of(run_tool, tmp_path, sensor, recorded)
    assert report['verdict']['data_fault'] == 'axis_inverted'
    assert 'rounded to 0.001 s' in report['notes'][0]


def shaken(tmp_path, corner_hz, sensor):
    """Return a recording by hand, and the motion of a simulator behind a low-pass filter."""
    rng = np.random.default_rng(6)
    time_s = np.arange(0, 70, 1 / sensor.rate_hz)
    angle = sosfiltfilt(butter(2, [0.1, 6.0], 'band', fs=sensor.rate_hz, output='sos'),
                        rng.normal(size=(2, len(time_s))), axis=1)
    angle[:, time_s < 8] = 0.0
    force = np.array(specific_force(1.0 + angle[0], angle[1], G0_MPS2))
    columns = {f'{axis}_v': 2.5 + f / G0_MPS2 + rng.normal(0, 6e-4, len(f))
               for axis, f in zip('xyz', force)}
    if corner_hz:
        force = sosfiltfilt(butter(2, corner_hz, fs=sensor.rate_hz, output='sos'), force, axis=1)
    np.savetxt(tmp_path / 'sim.csv', np.column_stack([time_s, *force]), '%.6f', ',', comments='',
               header='time_s,ax_mps2,ay_mps2,az_mps2')
    return (Recording('made', time_s, columns, sensor_info(sensor)),
            motion_from_force(tmp_path / 'sim.csv', False)[0])


def test_a_reference_that_is_smoother_than_the_sensor_is_named(tmp_path):
    """Motion that only the recording has is no effect of the sensor."""
    sensor = replace(unit(), rc_resistance_ohm=0.0)
    recorded, sim = shaken(tmp_path, None, sensor)
    assert not compare_checked(recorded, sensor, sim, False).reference_fades
    recorded, sim = shaken(tmp_path, 2.0, sensor)
    comparison = compare_checked(recorded, sensor, sim, False)
    assert comparison.reference_fades
    assert comparison.notes[-1].startswith('--sim is smoother than the sensor: above ')
    # A sensor without its filter has more motion than its simulation, too.
    recorded, sim = shaken(tmp_path, None, sensor)
    assert not compare_checked(recorded, unit(), sim, False).reference_fades


def test_rests_alone_have_no_motion(run_tool, tmp_path):
    """Where the moves were cut out of a recording, the samples beside the cuts are left out."""
    sensor, poses = unit(), [(1.0, 0.0), (1.5, 0.4), (1.5, 0.8), (1.0, 1.2), (0.6, 0.9)]
    alpha, beta = np.repeat(np.array(poses).T, 800, axis=1)
    rng = np.random.default_rng(7)
    columns = {f'{axis}_v': 2.5 + f + rng.normal(0, 6e-4, len(f))
               for axis, f in zip('xyz', specific_force(alpha, beta, 1.0))}
    columns |= {'alpha_rad': alpha, 'beta_rad': beta}
    recorded = Recording('made', np.arange(len(alpha)) / 100.0, columns, sensor_info(sensor))
    comparison = compare_checked(recorded, sensor, None, False)
    assert 0.5 < comparison.used.mean() < 0.98
    assert rms_mg(comparison, comparison.used) < 0.7
    assert any('beta_rad moves too fast' in note for note in comparison.notes)
    gaps = replace(recorded, time_s=recorded.time_s + 5.0 * (np.arange(len(alpha)) // 800))
    report, run = report_of(run_tool, tmp_path, sensor, gaps)
    assert (run.returncode, report['verdict']['data_fault']) == (1, 'clock_jump')


def test_parts_of_a_recording_have_a_verdict_together(run_tool, tmp_path):
    """Four recordings of 17 s are one of 67 s."""
    recorded = made(unit())
    parts = [replace(recorded, time_s=recorded.time_s[rows],
                     columns={k: v[rows] for k, v in recorded.columns.items()})
             for rows in np.array_split(np.arange(len(recorded)), 4)]
    report, run = report_of(run_tool, tmp_path, unit(), *parts)
    assert (run.returncode, run.stderr, report['verdict']['status']) == (0, '', 'no_gap')
