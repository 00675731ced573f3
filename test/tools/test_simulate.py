# SPDX-License-Identifier: Apache-2.0

"""The tool `simulate`: recordings that are simulated again, other simulators, and refusals."""

from adxl_ros.files import recording
from adxl_ros.model.constants import G0_MPS2
import numpy as np
import pytest
from units import nominal

pytestmark = pytest.mark.long


def test_a_recording_is_simulated_again(run_tool, tmp_path):
    first, second = tmp_path / 'first.csv', tmp_path / 'second.mcap'
    for args in (
        ('rich', '--rate', '100', '--effect', 'lever_arm:z_m=0.05', '-o', str(first)),
        (str(first), '--effect', 'lever_arm:z_m=0.05', '--seed', '1', '-o', str(second)),
    ):
        done = run_tool('simulate', *args)
        assert done.returncode == 0, done.stderr
    original, repeated = recording.read(first), recording.read(second)
    np.testing.assert_array_equal(original.columns['alpha_rad'], repeated.columns['alpha_rad'])
    np.testing.assert_allclose(original.time_s, repeated.time_s, atol=1e-9)
    volts = [r.volts(nominal('xy')) for r in (original, repeated)]
    # Noise of both, and the encoder's step of 1.45 mrad: 0.42 mg.
    assert np.sqrt(np.mean((volts[0] - volts[1]) ** 2)) < 1.1e-3


def test_a_recorded_specific_force_passes_through_the_chain(run_tool, tmp_path):
    time_s = np.arange(4000) / 200
    force = np.column_stack([np.sin(time_s), np.cos(3 * time_s), np.full(4000, G0_MPS2)])
    lines = ['time_s,ax_mps2,ay_mps2,az_mps2'] + [
        ','.join(map(repr, map(float, row))) for row in np.column_stack([time_s, force])
    ]
    ideal = tmp_path / 'ideal.csv'
    ideal.write_text('\n'.join(lines) + '\n')
    for rate in ((), ('--rate', '1000')):
        out = tmp_path / 'out.csv'
        done = run_tool('simulate', 'imu', '--force', str(ideal), *rate, '-o', str(out))
        assert done.returncode == 0, done.stderr
        read = recording.read(out)
        assert len(read) == pytest.approx(4000 * (5 if rate else 1), abs=5)
        expected = 2.5 + np.sin(read.time_s - nominal('xy').rc_s) / G0_MPS2
        assert np.sqrt(np.mean((read.columns['x_v'] - expected)[500:] ** 2)) < 0.6e-3


@pytest.mark.parametrize(
    'args, message',
    [
        (('rich', '--effect', 'lever_am'), "unknown effect 'lever_am'; known: "),
        (('rich', '--effect', 'lever_arm:zm=1'), "no parameter 'zm', but x_m, y_m, z_m"),
        (('rich', '--effect', 'lever_arm:z_m=3'), "'3' is not a number from -2 to 2 (m)"),
        (('rich', '--effect', 'lever_arm:z_m.x=1'), 'it is one number'),
        (('rich', '--effect', 'temperature_bias:per_k=0.1mg/K'), '(g/K)'),
        (('rich', '--effect', 'bias:offset_v=nine'), "'nine' is not a number"),
        (('rich', '--effect', 'cross_axis:linear.z=0.1'), "no axis 'z' to act on"),
        (('rich', '--rate', '0'), 'outside 0.01 to 100000 Hz'),
        (('rich', '--params', 'none.yaml'), 'none.yaml: cannot be read'),
        (('imu',), '--force RECORDING'),
    ],
)
def test_bad_input_is_one_line_and_no_file(run_tool, tmp_path, args, message):
    out = tmp_path / 'out.csv'
    done = run_tool('simulate', *args, '-o', str(out))
    assert done.returncode == 1 and message in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1 and not out.exists()
