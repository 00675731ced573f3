# SPDX-License-Identifier: Apache-2.0

"""The parameter files of common sensors in `params/`: installed, consistent, ready for use."""

import re

from adxl_ros.files import parameter_file, recording
from adxl_ros.model.constants import AXES
import numpy as np
from processes import REPO
import pytest

FILES = sorted((REPO / 'params').glob('*.yaml'))

COMPLETE = [path for path in FILES if not parameter_file.load(path, may_measure=True).unstated]
PLACE = r'\([^()]*(table|page|section|figure|not the sheet|not verified)[^()]*\)$'
"""Where a figure stands in the sheet, or that it was not read there."""
each_file = pytest.mark.parametrize('path', COMPLETE, ids=lambda path: path.stem)


@each_file
def test_a_file_is_a_nominal_sensor_with_its_source(path):
    sensor = parameter_file.load(path)
    head = re.match('(#.*\n)+', path.read_text('utf-8'))[0]
    assert (sensor.model, sensor.serial, sensor.effects) == ('nominal', 'nominal', ())
    assert re.search(r'Rev\. \w+(.|\n)*?(\d{4}|not verified)', head), 'sheet, revision and date'
    figures = re.findall('^#   .*', head, re.MULTILINE)
    assert figures
    for figure in figures:
        assert re.search(PLACE, figure), f'{figure}: no place in the sheet'
    for typical, maximum in sensor.datasheet.values():
        assert maximum == 0 or typical <= maximum


@each_file
def test_a_still_recording_has_the_stated_noise_and_zero_g(run_tool, tmp_path, path):
    sensor = parameter_file.load(path)
    times = np.arange(4096) / sensor.rate_hz
    measured = ''.join(f',{axis}_v' for axis in sensor.axes)
    (tmp_path / 'still.csv').write_text(
        f'time_s{measured},alpha_rad,beta_rad\n'
        + ''.join(f'{time!r}{",1.0" * len(sensor.axes)},0.0,0.0\n' for time in times.tolist())
    )
    done = run_tool('simulate', 'still.csv', '--params', path, '-o', 'out.csv')
    assert done.returncode == 0, done.stderr
    simulated = recording.read(tmp_path / 'out.csv')
    assert simulated.rate_hz == pytest.approx(sensor.rate_hz, rel=1e-6)
    filter_hz = 0.25 / (sensor.rc_resistance_ohm * sensor.rc_capacitance_f)
    for axis, zero_g_v, scale, density in zip(
        sensor.axes,
        sensor.nominal_zero_g_v,
        sensor.nominal_scale_v_per_g,
        sensor.noise_density_g_per_rthz,
    ):
        volts = simulated.columns[f'{axis}_v']
        noise_v = np.hypot(density * scale * np.sqrt(filter_hz), sensor.lsb_v / np.sqrt(12))
        # Filtered noise has few independent samples: its mean and deviation scatter more.
        correlated = 1 + sensor.rate_hz / (2 * filter_hz)
        count = len(volts) / correlated
        expected = zero_g_v + scale * (axis == AXES[2])
        assert abs(volts.mean() - expected) < 5 * noise_v / np.sqrt(count) + sensor.lsb_v / 2
        assert volts.std() == pytest.approx(noise_v, rel=5 / np.sqrt(2 * count))


def test_a_sensor_is_taken_by_its_name(run_tool, tmp_path):
    installed = parameter_file.nominal_path().with_name('mpu6050.yaml')
    for number, params in enumerate(('MPU-6050', installed)):
        done = run_tool(
            'simulate', 'motion', '--params', params, '--rate', 25, '-o', f'{number}.csv'
        )
        assert done.returncode == 0, done.stderr
    assert (tmp_path / '0.csv').read_bytes() == (tmp_path / '1.csv').read_bytes()
    (tmp_path / 'mpu6050').write_text('none')
    assert (
        'mpu6050:1:1'
        in run_tool('simulate', 'motion', '--params', 'mpu6050', '-o', '2.csv').stderr
    )


def test_an_unknown_sensor_is_refused(run_tool):
    done = run_tool('simulate', 'motion', '--params', 'mpu6051', '-o', 'out.csv')
    assert done.returncode == 1 and done.stderr.count('\n') == 1
    assert 'mpu6051: no file' in done.stderr and 'mpu6050' in done.stderr
