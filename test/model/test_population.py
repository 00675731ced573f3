# SPDX-License-Identifier: Apache-2.0
"""A population as prior of a unit: the closed form, coverage, and units that are not of it."""

from dataclasses import replace

from adxl_ros.errors import UserError
from adxl_ros.files import calibration_store
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.population import PooledCoefficient, Population, posterior
from adxl_ros.model.sensor import get, put, with_neutral
import numpy as np
import pytest
from units import nominal

ZERO_G, SCALE = (
    Coefficient('bias', 'offset_v', 'x'),
    Coefficient('scale_factor', 'offset_v_per_g', 'x'),
)
POPULATION = Population(
    'population.yaml',
    {
        'zero_g_x_v': PooledCoefficient(2.52, 0.001, 0.02, 0.015, 0.03, 0.02, 50),
        'scale_x_v_per_g': PooledCoefficient(1.01, 0.001, 0.01, 0.008, 0.02, 0.01, 50),
    },
)


def estimated(zero_g_v, scale_v_per_g, covariance):
    unit = put(
        with_neutral(nominal('x'), ['bias', 'scale_factor']),
        [ZERO_G, SCALE],
        [zero_g_v - 2.5, scale_v_per_g - 1.0],
    )
    return replace(unit, covariance=np.asarray(covariance), covariance_names=(ZERO_G, SCALE))


def test_the_posterior_is_that_of_two_normal_densities():
    covariance = np.array([[4e-4, 1e-4], [1e-4, 2e-4]])
    unit = posterior(estimated(2.54, 1.02, covariance), POPULATION).sensor
    prior = np.diag([0.02**-2, 0.01**-2])
    precision = np.linalg.inv(covariance)
    expected = np.linalg.inv(precision + prior)
    np.testing.assert_allclose(unit.covariance, expected)
    np.testing.assert_allclose(
        get(unit, [ZERO_G, SCALE]), expected @ (precision @ [0.04, 0.02] + prior @ [0.02, 0.01])
    )


@pytest.mark.long
def test_intervals_are_smaller_and_still_true():
    rng = np.random.default_rng(0)
    covariance = np.array([[4e-4, 1e-4], [1e-4, 2e-4]])
    inside, strangers = [], 0
    for _ in range(1000):
        truth = np.array([2.52, 1.01]) + rng.normal(size=2) * [0.02, 0.01]
        unit = estimated(*rng.multivariate_normal(truth, covariance), covariance)
        combined = posterior(unit, POPULATION)
        strangers += combined.is_stranger
        std = np.sqrt(np.diag(combined.sensor.covariance))
        error = get(combined.sensor, [ZERO_G, SCALE]) - (truth - [2.5, 1.0])
        inside += (np.abs(error) < 1.645 * std).tolist()
        assert combined.is_stranger or np.all(std < 0.8 * np.sqrt(np.diag(covariance)))
    assert abs(np.mean(inside) - 0.9) < 3 * np.sqrt(0.09 / 1000)
    assert strangers < 8


def test_a_stranger_is_named_and_keeps_its_estimates():
    unit = estimated(2.75, 1.01, np.diag([1e-6, 1e-6]))
    combined = posterior(unit, POPULATION)
    assert combined.is_stranger and combined.sensor is unit
    assert 'not used' in combined.line


@pytest.mark.parametrize(
    'text, words',
    [
        ('', 'no population of format 1'),
        ('format: 2\ncoefficients: {}\n', 'no population of format 1'),
        ('format: [1\n', ':2:1: not YAML'),
        ('format: 1\ncoefficients: {zero_g_x_v: 3}\n', 'zero_g_x_v: 3 is no set of numbers'),
        (
            'format: 1\ncoefficients: {zero_g_x_v: {mean: .nan}}\n',
            "coefficients.zero_g_x_v: {'mean': nan} is no set of numbers",
        ),
    ],
)
def test_a_bad_file_is_refused(tmp_path, text, words):
    path = tmp_path / 'p.yaml'
    path.write_text(text)
    with pytest.raises(UserError) as error:
        calibration_store.read_population(path)
    assert words in str(error.value) and str(error.value).startswith(str(path))
