# SPDX-License-Identifier: Apache-2.0

"""What is wrong with the input of a diagnosis is named before any effect."""

from dataclasses import replace
import json

from adxl_ros.diagnose.data_checks import check_recording, compare_checked
from adxl_ros.diagnose.data_faults import DataFault
from adxl_ros.files import parameter_file, recording
from adxl_ros.files.recording_columns import Recording
from adxl_ros.files.stream_info import sensor_info
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.kinematics import specific_force
from adxl_ros.simulate import trajectories
from adxl_ros.simulate.motion import Motion
from adxl_ros.simulate.recorded_motion import motion_from_force
from adxl_ros.simulate.response import simulate
from adxl_ros.simulate.trajectories import shaker
import numpy as np
import pytest
from units import nominal

pytest.importorskip('plotly')  # the page of `diagnose`


def unit(rate_hz=100.0):
    return replace(nominal('xyz'), rate_hz=rate_hz, stage_resolution_rad=1e-4)


def script(turns=3):
    path = trajectories.Script(np.pi / 2, 0.0)
    for alpha in (np.pi / 2, 1.0, 2.2)[:turns]:
        path.go(alpha, 0.0)
        for to, speed in ((2.0, 0.6), (0.5, 1.5), (4.0, 1.0), (0.0, 0.8)):
            path.run('beta', to, speed)
            path.rest(1.0)
    return path


def made(sensor, turns=3, seed=3):
    path = script(turns)
    columns = simulate(sensor, Motion(path.now_s, *path.joints()), seed)
    return Recording('made', columns.pop('time_s'), columns, sensor_info(sensor))


def report_of(run_tool, tmp_path, sensor, *recordings, options=()):
    parameter_file.save(tmp_path / 'unit.yaml', sensor)
    names = [f'run{i}.csv' for i in range(len(recordings))]
    for name, recorded in zip(names, recordings):
        recording.write(tmp_path / name, recorded, sensor)
    run = run_tool('diagnose', *names, '--params', 'unit.yaml', '-o', 'out', '--json', *options)
    return json.loads(run.stdout), run


def ideal(tmp_path, late_s, name='sim.csv'):
    """Write the ideal force of the recording of `made`, with stamps that are late."""
    path = script()
    alpha, beta = path.joints()
    time_s = np.arange(0, path.now_s, 0.01)
    force = specific_force(alpha(time_s), beta(time_s), G0_MPS2)
    rows = np.column_stack([time_s + late_s, *force])
    np.savetxt(
        tmp_path / name, rows, '%.6f', ',', comments='', header='time_s,ax_mps2,ay_mps2,az_mps2'
    )
    return name


@pytest.mark.parametrize('late_s', [0.7, -1.3, 12.0])
def test_a_shifted_simulator_is_late(run_tool, tmp_path, late_s):
    """A shift that no latency explains is named with its size, and `--align` with it."""
    report, run = report_of(
        run_tool, tmp_path, unit(), made(unit()), options=['--sim', ideal(tmp_path, late_s)]
    )
    assert run.returncode == 1
    assert report['verdict']['data_fault'] == 'time_misaligned'
    words = report['summary'].split()
    assert words[:2] == ['--sim', 'is'] and 'use --align' in report['summary']
    assert words[4] == ('late;' if late_s > 0 else 'early;')
    assert float(words[2]) == pytest.approx(abs(late_s), abs=2e-3)


@pytest.mark.parametrize(
    'axis, factor, words',
    [
        ('x', 1 / G0_MPS2, 'x is 9.8'),
        ('y', G0_MPS2, 'y is 0.10'),
        ('y', 1e3, 'y is 0.00'),
        ('x', 1e3 / G0_MPS2, 'x is 0.00'),
    ],
)
def test_one_axis_of_a_simulator_in_another_unit_is_no_scale_factor(tmp_path, axis, factor, words):
    stated = recording.read_ideal(tmp_path / ideal(tmp_path, 0.0))
    stated.columns[f'a{axis}_mps2'] *= factor
    force = motion_from_force(stated, False)
    with pytest.raises(DataFault) as refused:
        check_recording(compare_checked(made(unit()), unit(), force, False))
    assert refused.value.name == 'unit'
    assert f'the output of {words}' in refused.value.message


def test_a_simulator_of_another_time_does_not_overlap(run_tool, tmp_path):
    report, run = report_of(
        run_tool, tmp_path, unit(), made(unit()), options=['--sim', ideal(tmp_path, 1000.0)]
    )
    assert (run.returncode, report['verdict']['data_fault']) == (1, 'no_overlap')
    summary = report['summary']
    assert 'from 0 to ' in summary and 'from 1000 to ' in summary and '--align' in summary
    assert '1000.00' in summary


@pytest.mark.parametrize('late_s', [1000.0, 0.7, 0.02])
def test_align_shifts_the_simulator(tmp_path, late_s):
    force = motion_from_force(recording.read_ideal(tmp_path / ideal(tmp_path, late_s)), False)
    comparison = compare_checked(made(unit()), unit(), force, True)
    residual_g = comparison.residual_v(comparison.sensor)[comparison.used]
    assert np.sqrt(np.mean(residual_g**2)) < (1e-3 if late_s > 0.1 else 1e-2)
    assert comparison.notes[0].startswith('--align')
    assert ('nothing is shifted' in comparison.notes[0]) == (late_s < 0.1)


def test_a_simulator_of_another_motion_is_no_shift(run_tool, tmp_path):
    recorded = made(unit())
    time_s = recorded.time_s
    rng = np.random.default_rng(1)
    wander = np.cumsum(rng.normal(size=(3, len(time_s))), axis=1) * 0.02
    wander[2] += G0_MPS2
    np.savetxt(
        tmp_path / 'sim.csv',
        np.column_stack([time_s + 500.0, *wander]),
        '%.6f',
        ',',
        comments='',
        header='time_s,ax_mps2,ay_mps2,az_mps2',
    )
    report, run = report_of(run_tool, tmp_path, unit(), recorded, options=['--sim', 'sim.csv'])
    assert (run.returncode, report['verdict']['data_fault']) == (1, 'no_overlap')
    assert 'no shift' in report['summary']


@pytest.mark.parametrize('signs', [(1, -1), (-1, 1)])
@pytest.mark.parametrize('axes', ['xy', 'xyz'])
def test_an_encoder_that_counts_backwards_is_named(run_tool, tmp_path, signs, axes):
    sensor = replace(nominal(axes), rate_hz=100.0, stage_resolution_rad=1e-4)
    recorded = made(sensor)
    for name, sign in zip(('alpha_rad', 'beta_rad'), signs):
        recorded.columns[name] = recorded.columns[name] * sign
    report, run = report_of(run_tool, tmp_path, sensor, recorded)
    name = 'alpha_rad' if signs[0] < 0 else 'beta_rad'
    assert (run.returncode, report['verdict']['data_fault']) == (1, 'encoder_sign')
    assert report['summary'].startswith(f'{name}: opposite sign of the encoder')


@pytest.mark.parametrize('names', [['beta_rad'], ['alpha_rad'], ['alpha_rad', 'beta_rad']])
def test_degrees_in_a_column_of_radians_are_named(run_tool, tmp_path, names):
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


@pytest.mark.parametrize('lost', [False, True])
def test_rounded_stamps_get_their_instants_back(lost):
    """Stamps of whole milliseconds at 300 Hz are an even clock, also where samples are lost."""
    sensor = unit(300.0)
    recorded = made(sensor, turns=2)
    true_s = recorded.time_s
    kept = np.ones(len(true_s), bool)
    if lost:
        kept[4000:4037] = kept[9000] = False
    recorded = replace(
        recorded,
        time_s=np.round(true_s, 3)[kept],
        columns={k: v[kept] for k, v in recorded.columns.items()},
    )
    comparison = compare_checked(recorded, sensor, None, False)
    assert np.abs(comparison.time_s - true_s[kept]).max() < 2e-5
    assert comparison.sensor.rate_hz == pytest.approx(300.0, abs=1e-3)
    assert 'even rate of 300 Hz' in comparison.notes[0]
