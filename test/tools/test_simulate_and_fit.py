"""`simulate` and `fit` through the front door: what they write, repeat and refuse."""

import re
import shlex

from adxl_ros.files import parameter_file, recording
import numpy as np
import pytest
from units import drawn, NOMINAL, nominal

pytestmark = pytest.mark.long

HEAD = 'time_s,x_v,y_v,alpha_rad,beta_rad\n'


def test_simulate_fit_and_apply_make_one_path(run_tool, tmp_path):
    truth = drawn(np.random.default_rng(8), nominal(serial='S8'))
    parameter_file.save(tmp_path / 'truth.yaml', truth)
    parameter_file.save(tmp_path / 'nominal.yaml', nominal(serial='S8'))
    for name, trajectory in (('sweep', 'sweep'), ('tilt', 'tilt_alpha')):
        done = run_tool(
            'simulate',
            trajectory,
            '--params',
            'truth.yaml',
            '--rate',
            200,
            '--seed',
            5,
            '-o',
            f'{name}.csv',
        )
        assert (done.returncode, done.stderr) == (0, '')
    done = run_tool(
        'fit',
        'sweep.csv',
        '--params',
        'nominal.yaml',
        '-o',
        'unit.yaml',
        '--report',
        'figures',
        '--dcc',
        'certificate.xml',
    )
    assert done.returncode == 0, done.stderr
    assert '<si:uncertaintyXMLList>' in (tmp_path / 'certificate.xml').read_text()
    assert 'full model' in done.stdout and 'poses that the fit has not seen' in done.stdout
    assert (tmp_path / 'figures' / 'report.html').stat().st_size > 20000
    fitted = parameter_file.load(tmp_path / 'unit.yaml')
    np.testing.assert_allclose(fitted.zero_g_v, truth.zero_g_v, atol=5e-4)
    np.testing.assert_allclose(fitted.scale_v_per_g, truth.scale_v_per_g, atol=5e-4)
    done = run_tool('apply', 'tilt.csv', '--params', 'unit.yaml', '-o', 'tilt_out.csv')
    assert done.returncode == 0, done.stderr
    out = np.genfromtxt(tmp_path / 'tilt_out.csv', delimiter=',', names=True, comments='#')
    alpha = np.abs(recording.read(tmp_path / 'tilt.csv').columns['alpha_rad'])
    still = (alpha > np.radians(25)) & (alpha < np.radians(65))
    assert np.sqrt(np.mean((out['alpha_rad'] - alpha)[still] ** 2)) < np.radians(0.2)


def test_a_resting_recording_is_fitted_over_temperature(run_tool, tmp_path):
    done = run_tool(
        'simulate',
        'soak',
        '--rate',
        5,
        '--effect',
        'temperature_bias:per_k=4e-4',
        '--effect',
        'thermal_lag:per_k=4e-4,tau_s=50',
        '-o',
        'oven.csv',
    )
    assert done.returncode == 0, done.stderr
    done = run_tool('fit', 'oven.csv', '--effect', 'temperature_bias', '-o', 'warm.yaml')
    assert done.returncode == 0, done.stderr
    assert 'expected error of the zero-g over 10 to 40 °C' in done.stdout
    warm = parameter_file.load(tmp_path / 'warm.yaml')
    assert {'temperature_bias', 'thermal_lag'} <= set(warm.effects)
    np.testing.assert_allclose(warm.values['temperature_bias']['per_k'], 4e-4, rtol=0.05)
    assert float(warm.values['thermal_lag']['tau_s']) == pytest.approx(50.0, rel=0.15)
    done = run_tool(
        'fit', 'oven.csv', '--effect', 'temperature_bias', '-o', 'b.yaml', '--report', 'page'
    )
    assert done.returncode == 1 and '--report page: a fit over temperature' in done.stderr
    done = run_tool(
        'fit',
        'oven.csv',
        '--effect',
        'temperature_bias',
        '-o',
        'b.yaml',
        '--dcc',
        'certificate.xml',
    )
    assert done.returncode == 1 and 'a certificate states errors at stage' in done.stderr
    assert not (tmp_path / 'b.yaml').exists()


def test_the_force_of_another_simulator_brings_its_temperature_and_is_the_reference(
    run_tool, tmp_path
):
    """The temperature acts, what it lacks is said, and the proposed command has a reference."""
    time_s = np.arange(0, 40, 0.02)
    moves = np.clip((time_s - 10) / 5, 0, 1)
    columns = {
        'time_s': time_s,
        'ax_mps2': moves * np.sin(3 * time_s),
        'ay_mps2': moves * np.cos(2 * time_s),
        'az_mps2': 9.8 + 0 * time_s,
    }
    for name, further in (('cold', {}), ('warm', {'temperature_c': 45 + 0 * time_s})):
        table = {**columns, **further}
        np.savetxt(
            tmp_path / f'{name}.csv',
            np.column_stack(list(table.values())),
            delimiter=',',
            header=','.join(table),
            comments='',
        )
        done = run_tool(
            'simulate',
            'imu',
            '--force',
            f'{name}.csv',
            '-o',
            f'{name}_sim.csv',
            '--effect',
            'temperature_bias:per_k=1e-3',
        )
        assert done.returncode == 0, done.stderr
        assert ('temperature_c is not recorded' in done.stdout) == (name == 'cold')
    cold, warm = (recording.read(tmp_path / f'{name}_sim.csv') for name in ('cold', 'warm'))
    np.testing.assert_allclose(warm.columns['x_v'] - cold.columns['x_v'], 0.02, atol=2e-3)
    following = shlex.split(done.stdout[done.stdout.index('ros2 run') :].replace('\\\n', ' '))
    done = run_tool(*following[3:])
    assert done.returncode == 0 and 'BAD DATA' not in done.stdout, done.stderr


def test_several_recordings_of_one_unit_are_fitted_together(run_tool, tmp_path):
    for seed in (1, 2):
        run_tool('simulate', 'sweep', '--rate', 100, '--seed', seed, '-o', f'{seed}.csv')
    run_tool('fit', '1.csv', '-o', 'one.yaml')
    done = run_tool('fit', '1.csv', '2.csv', '-o', 'both.yaml')
    assert done.returncode == 0, done.stderr
    single, both = (
        parameter_file.load(tmp_path / 'one.yaml'),
        parameter_file.load(tmp_path / 'both.yaml'),
    )
    assert np.mean(np.diag(both.covariance) / np.diag(single.covariance)) < 0.8
    assert both.provenance['source'] == '1.csv, 2.csv'


def test_an_output_may_have_the_name_of_a_trajectory_but_not_that_of_the_input(run_tool, tmp_path):
    done = run_tool('simulate', 'tilt_beta', '--rate', '20', '-o', 'tilt_beta')
    assert done.returncode == 0, done.stderr
    done = run_tool('simulate', './tilt_beta', '-o', 'tilt_beta')
    assert (done.returncode, 'is the input itself' in done.stderr) == (1, True)
    assert recording.read(tmp_path / 'tilt_beta').rate_hz == 20.0


@pytest.mark.parametrize(
    'text, words',
    [
        ('', 'empty'),
        (HEAD + '0,1,2,0,0\n0.1,one,2,0,0\n', "bad.csv:3:2: x_v is 'one'"),
        (HEAD + '0,1,2,0,0\n0.1,1,2,0,0\n', 'nowhere at rest'),
        (
            'time_s,x_v,y_v\n' + ''.join(f'{i / 100},2.5,2.5\n' for i in range(500)),
            'no stage angles',
        ),
    ],
)
def test_fit_refuses_a_bad_recording(run_tool, tmp_path, text, words):
    (tmp_path / 'bad.csv').write_text(text)
    (tmp_path / 'unit.yaml').write_text('before')
    done = run_tool('fit', 'bad.csv', '-o', 'unit.yaml', '--overwrite')
    assert done.returncode == 1
    assert words in done.stderr and done.stderr.count('\n') == 1, done.stderr
    assert (tmp_path / 'unit.yaml').read_text() == 'before'


def test_fit_refuses_another_unit_and_a_missing_folder(run_tool, tmp_path):
    run_tool('simulate', 'sweep', '--rate', 100, '-o', 'a.csv')
    text = (tmp_path / 'a.csv').read_text().replace('serial: nominal', 'serial: A1')
    (tmp_path / 'a.csv').write_text(text)
    other = NOMINAL.read_text().replace('serial: nominal', 'serial: B2')
    (tmp_path / 'b.yaml').write_text(other)
    done = run_tool('fit', 'a.csv', '--params', 'b.yaml', '-o', 'unit.yaml')
    assert done.returncode == 1 and 'A1' in done.stderr and 'B2' in done.stderr
    done = run_tool('fit', 'a.csv', '-o', 'none/unit.yaml')
    assert done.returncode == 1 and 'none/unit.yaml: cannot write into none' in done.stderr


@pytest.mark.parametrize('name', ['no_gap', 'temperature_bias', 'time_offset'])
def test_sweeps_of_another_generator(run_tool, tmp_path, shared_dir, name):
    """The linear fit of the sweep predicts held-out poses to 0.1 mg."""
    done = run_tool(
        'fit', shared_dir / 'samples' / name / 'cal.csv', '--model', 'linear', '-o', 'unit.yaml'
    )
    assert done.returncode == 0, done.stderr
    (linear,) = re.findall(r'linear calibration.* ([\d.]+) +mg', done.stdout)
    assert float(linear) < 0.1
