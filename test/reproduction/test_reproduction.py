# SPDX-License-Identifier: Apache-2.0
"""`reproduce`: the paper's experiments, each figure that is to be reached."""

from adxl_ros.files import parameter_file
from adxl_ros.model.constants import Z_90
from adxl_ros_validation import experiments
import numpy as np
import pandas as pd
import pytest
from units import NOMINAL

pytestmark = pytest.mark.long

_UNITS = {'perfect': 3, 'paper': 10}


@pytest.fixture(scope='module')
def evaluations():
    """Evaluate units on each stage; their number is larger where poses share stage errors."""
    nominal = parameter_file.load(NOMINAL)
    return {
        name: [experiments.evaluate(nominal, stage, seed) for seed in range(_UNITS[name])]
        for name, stage in experiments.STAGES.items()
    }


def angles_of(evaluated, model):
    errors = pd.concat([unit.angles for unit in evaluated])
    return errors[errors.counts & (errors.model == model)]


def rms(values):
    return np.sqrt(np.mean(values**2))


@pytest.mark.parametrize('stage, bound', [('perfect', 'pose_bound'), ('paper', 'bound')])
def test_tilt_error_reaches_its_bound(evaluations, stage, bound):
    """The error is at most 1.10 of the bound by noise, or by noise, stage and calibration."""
    errors = angles_of(evaluations[stage], 'full')
    assert rms(errors.error / errors[bound]) < 1.10


@pytest.mark.parametrize('stage', ['perfect', 'paper'])
def test_alpha_errors_are_below_those_of_the_linear_model(evaluations, stage):
    """15° or more from ±90° the error falls by 88.9 % (physical) and 98 % (full)."""
    error_rad = {
        model: rms(
            angles_of(evaluations[stage], model)
            .query('angle == "alpha" and not near_vertical')
            .error
        )
        for model in experiments.MODELS
    }
    assert 1 - error_rad['physical'] / error_rad['linear'] >= 0.889
    assert 1 - error_rad['full'] / error_rad['linear'] >= 0.98


def test_motion_error_reaches_the_noise_floor(evaluations):
    """With the filter time constant of the noise the error is at most 1.05 of 5.08 mm/s²."""
    nominal = parameter_file.load(NOMINAL)
    bound = experiments.motion_bound_mmps2(nominal)
    assert bound == pytest.approx(5.08, abs=0.01)
    error_mmps2 = [
        unit.motion['full'][0] for evaluated in evaluations.values() for unit in evaluated
    ]
    assert np.sqrt(np.mean(np.square(error_mmps2))) < 1.05 * bound


@pytest.mark.parametrize('stage', ['perfect', 'paper'])
def test_intervals_have_their_stated_coverage(evaluations, stage):
    # Poses of one unit share the errors of its few settings of alpha. Units are independent.
    inside = np.array(
        [np.mean(np.abs(unit.acceleration['full']) < Z_90) for unit in evaluations[stage]]
    )
    assert abs(inside.mean() - 0.9) < 0.02 + 2.5 * inside.std() / np.sqrt(len(inside))
    spread = np.sqrt(
        np.mean([np.mean(unit.acceleration['full'] ** 2) for unit in evaluations[stage]])
    )
    assert 0.7 < spread < 1.4


def test_the_command_writes_the_page_and_its_plots(run_tool, tmp_path):
    done = run_tool('reproduce', '--units', '1', '--seed', '5', '-o', tmp_path)
    page = (tmp_path / 'reproduction.md').read_text(encoding='utf-8')
    assert 'Table I' in done.stdout
    assert '20.8' in page and 'Cramér-Rao bound' in page
    for figure in ('sweep', 'misalignment', 'tilt', 'motion', 'components'):
        assert f'(reproduction/{figure}.png)' in page
        assert (tmp_path / 'reproduction' / f'{figure}.png').stat().st_size > 20_000


def test_the_command_on_a_recording(run_tool, tmp_path):
    run_tool(
        'simulate',
        'sweep',
        '--params',
        NOMINAL,
        '--effect',
        'cross_axis_z',
        '--effect',
        'misalignment',
        '-o',
        tmp_path / 'sweep.csv',
    )
    done = run_tool('reproduce', tmp_path / 'sweep.csv', '-o', tmp_path / 'out')
    assert 'physical 0.32 / 0.82°' in done.stdout
    assert (tmp_path / 'out' / 'reproduction' / 'sweep.png').exists()


@pytest.mark.parametrize(
    'option, words', [(('--units', '0'), 'at least 1'), (('--seed', '-1'), 'at least 0')]
)
def test_wrong_options_are_refused_in_one_line(run_tool, tmp_path, option, words):
    done = run_tool('reproduce', *option, '-o', tmp_path / 'out')
    assert done.returncode == 1 and words in done.stderr
    assert not (tmp_path / 'out').exists()
