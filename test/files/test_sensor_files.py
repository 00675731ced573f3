# SPDX-License-Identifier: Apache-2.0

"""The parameter files of common sensors in `params/`: installed, consistent, ready for use."""

from pathlib import Path
import re

from adxl_ros.files import parameter_file, recording
from adxl_ros.model import signal_chain
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.kinematics import specific_force
import numpy as np
from processes import REPO
import pytest

FILES = sorted((REPO / 'params').glob('*.yaml'))

COMPLETE = [path for path in FILES if not parameter_file.load(path, may_measure=True).unstated]
each_file = pytest.mark.parametrize('path', COMPLETE, ids=lambda path: path.stem)


def digital(path: Path) -> bool:
    """Return whether the head of a file says that the sensor is digital."""
    return 'Digital output' in path.read_text('utf-8')


def test_all_files_are_installed():
    """A user finds every sensor in the share folder, as it is in the repository."""
    installed = parameter_file.nominal_path().parent
    assert {path.name: path.read_bytes() for path in FILES} == {
        path.name: path.read_bytes() for path in installed.glob('*.yaml')}


@each_file
def test_a_file_is_a_nominal_sensor_with_its_source(path):
    """A file has no effect and no unit, and its head names the datasheet."""
    sensor = parameter_file.load(path)
    head = re.match('(#.*\n)+', path.read_text('utf-8'))[0]
    assert (sensor.model, sensor.serial, sensor.effects) == ('nominal', 'nominal', ())
    assert re.search(r'Rev\. \w', head)
    for typical, maximum in sensor.datasheet.values():
        assert maximum == 0 or typical <= maximum


@each_file
@pytest.mark.parametrize('sign', [-1, 1])
def test_gravity_and_the_range_are_within_the_rails(path, sign):
    """The ADC resolves ±1 g and the range to a step; at most the last step is saturated."""
    sensor = parameter_file.load(path)
    for force_g, steps in ((1.0, 0.5), (0.99 * sensor.range_g, 0.5), (sensor.range_g, 1.5)):
        exact = sensor.nominal_zero_g_v + sign * force_g * sensor.nominal_scale_v_per_g
        volts = signal_chain.quantise(exact[None], sensor, np.full(len(exact), sensor.lsb_v))
        # The datasheet rounds the step of a digital sensor, so its range ends within 0.1 %.
        margin = 1e-3 * sensor.range_g if force_g == sensor.range_g else 0.0
        assert np.abs(volts - exact).max() <= steps * sensor.lsb_v * (1 + 1e-9) + margin
        assert force_g == sensor.range_g or not sensor.saturated(volts).any()
    beyond = sensor.nominal_zero_g_v + sign * 1.1 * sensor.range_g * sensor.nominal_scale_v_per_g
    assert sensor.saturated(beyond[None]).all()


@pytest.mark.parametrize('path', [path for path in FILES if digital(path)],
                         ids=lambda path: path.stem)
def test_a_digital_sensor_reads_codes_around_zero(path):
    """Pseudo-volts are 1 V/g, and 0 g is the code in the middle."""
    sensor = parameter_file.load(path)
    np.testing.assert_array_equal(sensor.nominal_scale_v_per_g, 1.0)
    np.testing.assert_allclose(sensor.nominal_zero_g_v / sensor.lsb_v,
                               2 ** (sensor.adc_bits - 1), rtol=1e-12)


@each_file
def test_a_still_recording_has_the_stated_noise_and_zero_g(run_tool, tmp_path, path):
    """`simulate` follows a still reference at the sensor's rate with its noise and zero-g."""
    sensor = parameter_file.load(path)
    times = np.arange(4096) / sensor.rate_hz
    measured = ''.join(f',{axis}_v' for axis in sensor.axes)
    (tmp_path / 'still.csv').write_text(f'time_s{measured},alpha_rad,beta_rad\n' + ''.join(
        f'{time!r}{",1.0" * len(sensor.axes)},0.0,0.0\n' for time in times.tolist()))
    done = run_tool('simulate', 'still.csv', '--params', path, '-o', 'out.csv')
    assert done.returncode == 0, done.stderr
    simulated = recording.read(tmp_path / 'out.csv')
    assert simulated.rate_hz == pytest.approx(sensor.rate_hz, rel=1e-6)
    filter_hz = 0.25 / (sensor.rc_resistance_ohm * sensor.rc_capacitance_f)
    for axis, zero_g_v, scale, density in zip(
            sensor.axes, sensor.nominal_zero_g_v, sensor.nominal_scale_v_per_g,
            sensor.noise_density_g_per_rthz):
        volts = simulated.columns[f'{axis}_v']
        noise_v = np.hypot(density * scale * np.sqrt(filter_hz), sensor.lsb_v / np.sqrt(12))
        # Filtered noise has few independent samples: its mean and deviation scatter more.
        correlated = 1 + sensor.rate_hz / (2 * filter_hz)
        count = len(volts) / correlated
        expected = zero_g_v + scale * (axis == AXES[2])
        assert abs(volts.mean() - expected) < 5 * noise_v / np.sqrt(count) + sensor.lsb_v / 2
        assert volts.std() == pytest.approx(noise_v, rel=5 / np.sqrt(2 * count))


@pytest.mark.long
@each_file
def test_simulate_fit_and_apply_take_the_file(run_tool, tmp_path, path):
    """A unit of the sensor is calibrated within its interval, and apply corrects it."""
    run_tool('simulate', 'sweep', '--params', path, '--rate', 25, '--effect', 'bias',
             '--effect', 'scale_factor:offset_v_per_g=0.02', '--seed', 3, '-o', 'sweep.csv')
    done = run_tool('fit', 'sweep.csv', '--params', path, '--model', 'linear', '-o', 'unit.yaml')
    assert done.returncode == 0, done.stderr
    unit = parameter_file.load(tmp_path / 'unit.yaml')
    truth = {'bias': 0.1, 'scale_factor': 0.02}
    std = np.sqrt(np.diag(unit.covariance))
    errors = [unit.values[name.effect][name.parameter][unit.axes.index(name.axis)]
              - truth[name.effect] for name in unit.covariance_names]
    assert len(errors) == 2 * len(unit.axes)
    assert (np.abs(errors) < 5 * std).all()
    done = run_tool('apply', 'sweep.csv', '--params', 'unit.yaml', '-o', 'out.csv')
    assert done.returncode == 0, done.stderr
    out = np.genfromtxt(tmp_path / 'out.csv', delimiter=',', names=True, comments='#')
    columns = recording.read(tmp_path / 'sweep.csv').columns
    force = specific_force(columns['alpha_rad'], columns['beta_rad'], G0_MPS2)
    for axis in unit.axes:
        error = out[f'a{axis}_mps2'] - force[AXES.index(axis)]
        assert abs(np.median(error)) < np.median(out[f'a{axis}_std_mps2']) / 5


def test_a_sensor_is_taken_by_its_name(run_tool, tmp_path):
    """`--params MPU-6050` is the installed file; a file of that name in the folder is first."""
    installed = parameter_file.nominal_path().with_name('mpu6050.yaml')
    for number, params in enumerate(('MPU-6050', installed)):
        done = run_tool('simulate', 'motion', '--params', params, '--rate', 25,
                        '-o', f'{number}.csv')
        assert done.returncode == 0, done.stderr
    assert (tmp_path / '0.csv').read_bytes() == (tmp_path / '1.csv').read_bytes()
    (tmp_path / 'mpu6050').write_text('none')
    assert 'mpu6050:1:1' in run_tool(
        'simulate', 'motion', '--params', 'mpu6050', '-o', '2.csv').stderr


def test_an_unknown_sensor_is_refused(run_tool):
    """A name without a file is answered with the names that have one."""
    done = run_tool('simulate', 'motion', '--params', 'mpu6051', '-o', 'out.csv')
    assert done.returncode == 1 and done.stderr.count('\n') == 1
    assert 'mpu6051: no file' in done.stderr and 'mpu6050' in done.stderr


def test_one_axis_that_is_misaligned_fails_for_its_reason(run_tool):
    """The other forces of a misaligned axis are unknown, which is no fault of the sensor."""
    run_tool('simulate', 'sweep', '--params', 'adxl103', '--rate', 25, '--effect',
             'misalignment', '--seed', 1, '-o', 'sweep.csv')
    done = run_tool('fit', 'sweep.csv', '--params', 'adxl103', '-o', 'unit.yaml')
    assert 'FAIL' in done.stdout and 'One axis does not see the force across it' in done.stdout
    assert 'worse than its datasheet' not in done.stdout and '. mg' not in done.stdout
