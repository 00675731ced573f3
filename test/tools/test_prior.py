# SPDX-License-Identifier: Apache-2.0
"""`--prior`: few poses with the population of a fleet, and units that are not of it."""

from dataclasses import replace

from adxl_ros.files import calibration_store, parameter_file
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.population import PooledCoefficient, Population
from adxl_ros.model.sensor import get, put, with_neutral
import numpy as np
from units import nominal

NAMES = [
    Coefficient(*effect, axis)
    for effect in (('bias', 'offset_v'), ('scale_factor', 'offset_v_per_g'))
    for axis in 'xy'
]
STD = np.array([2e-3, 2e-3, 1e-3, 1e-3])
MEAN = np.array([0.02, -0.01, 0.01, 0.0])


def pooled(mean, std):
    return PooledCoefficient(mean, 1e-5, std, 0.8 * std, 1.2 * std, std, 50)


def population(shift_v=0.0):
    """Return the population of the drawn units; `shift_v` makes its zero-g wrong."""
    return Population(
        'population.yaml',
        {
            **{
                f'zero_g_{axis}_v': pooled(2.5 + mean + shift_v, 2e-3)
                for axis, mean in zip('xy', MEAN)
            },
            **{
                f'scale_{axis}_v_per_g': pooled(1 + mean, 1e-3)
                for axis, mean in zip('xy', MEAN[2:])
            },
        },
    )


def drawn(rng):
    return put(
        with_neutral(nominal(), ['bias', 'scale_factor']), NAMES, MEAN + STD * rng.normal(size=4)
    )


def test_poses_take_the_population(run_tool, tmp_path):
    truth = replace(drawn(np.random.default_rng(1)), serial='N1')
    parameter_file.save(tmp_path / 'truth.yaml', truth)
    calibration_store.write_population(tmp_path / 'population.yaml', population())
    run_tool('simulate', 'sweep', '--params', 'truth.yaml', '--rate', 100, '-o', 'one.csv')
    done = run_tool(
        'fit', 'one.csv', '--model', 'linear', '--prior', 'population.yaml', '-o', 'unit.yaml'
    )
    assert done.returncode == 0, done.stderr
    assert 'prior: population.yaml is the prior of 4 coefficients' in done.stdout
    unit = parameter_file.load(tmp_path / 'unit.yaml')
    std = dict(zip(unit.covariance_names, np.sqrt(np.diag(unit.covariance))))
    assert std[NAMES[2]] < 0.97e-3
    assert np.all(np.abs(get(unit, NAMES) - get(truth, NAMES)) < 4 * STD)
    assert unit.provenance['prior'] == 'population.yaml'


def test_a_stranger_is_named_by_fit(run_tool, tmp_path):
    """A wrong prior is said and not used: the fit is that without it."""
    truth = drawn(np.random.default_rng(2))
    parameter_file.save(tmp_path / 'truth.yaml', truth)
    calibration_store.write_population(tmp_path / 'wrong.yaml', population(0.1))
    run_tool('simulate', 'sweep', '--params', 'truth.yaml', '--rate', 50, '-o', 'sweep.csv')
    for arguments in (['--prior', 'wrong.yaml', '-o', 'a.yaml'], ['-o', 'b.yaml']):
        done = run_tool('fit', 'sweep.csv', '--model', 'linear', *arguments)
        assert done.returncode == 0, done.stderr
        assert ('The prior is not' in done.stdout) == ('--prior' in arguments)
    a, b = (parameter_file.load(tmp_path / f'{name}.yaml') for name in 'ab')
    np.testing.assert_array_equal(get(a, NAMES), get(b, NAMES))
