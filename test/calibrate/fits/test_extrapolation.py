# SPDX-License-Identifier: Apache-2.0

"""The stated deviation beyond the temperatures of a fit covers what units do there."""

from dataclasses import replace

from adxl_ros.calibrate import calibration
from adxl_ros.calibrate.poses import Poses
from adxl_ros.files import parameter_file
from adxl_ros.model.constants import G0_MPS2, Z_90
from adxl_ros.model.covariance import force_covariance
from adxl_ros.model.effects.base import NOMINAL_ENVIRONMENT
from adxl_ros.model.sensor import Envelope, get, Sensor
import numpy as np
import pytest
from units import nominal

LOW_C, HIGH_C, BASE_C = 20.0, 60.0, 25.0
UNITS = 15


def zero_g(curve: np.ndarray, temperature_c: np.ndarray | float) -> np.ndarray:
    """Return the zero-g, g, (n, 3), of a polynomial by axis that is 0 where it was calibrated."""
    middle_c, half_k = (LOW_C + HIGH_C) / 2, (HIGH_C - LOW_C) / 2
    values = [
        np.polynomial.polynomial.polyval((np.asarray(at_c) - middle_c) / half_k, curve)
        for at_c in (temperature_c, BASE_C)
    ]
    return np.transpose(values[0] - np.reshape(values[1], (3,) + (1,) * np.ndim(temperature_c)))


def warmed(rng: np.random.Generator, curve: np.ndarray, noise_g: float = 3e-4) -> Sensor:
    """Fit a unit, (degrees, 3), that was warmed and cooled at rest."""
    temperature_c = np.concatenate(
        [np.linspace(LOW_C, HIGH_C, 120), np.linspace(HIGH_C, LOW_C, 120)]
    )
    base = replace(nominal('xyz'), envelope=Envelope(temperature_c=(BASE_C, BASE_C)))
    volts = base.nominal_zero_g_v + base.nominal_scale_v_per_g * (
        zero_g(curve, temperature_c) + [0.0, 0.0, 1.0] + rng.normal(0, noise_g, (240, 3))
    )
    missing, begins_s = np.full(240, np.nan), 10.0 * np.arange(240)
    return calibration.calibrate_thermal(
        base,
        Poses(
            volts,
            np.full((240, 3), 1e-4),
            missing,
            missing,
            np.column_stack([begins_s, begins_s + 10]),
            np.zeros(240, bool),
            temperature_c=temperature_c,
        ),
        'oven.csv',
    ).fitted


def std_g(sensor: Sensor, temperature_c: float) -> np.ndarray:
    """Return the stated deviation of a sample without noise, g, (3,)."""
    covariance = force_covariance(
        sensor,
        [0.0, 0.0, G0_MPS2],
        np.zeros(3),
        NOMINAL_ENVIRONMENT._replace(temperature_c=temperature_c),
    )
    return np.sqrt(np.diagonal(covariance[:, :, 0])) / G0_MPS2


def error_g(sensor: Sensor, curve: np.ndarray, temperature_c: float) -> np.ndarray:
    """Return by how much the fit is wrong, g, (3,)."""
    effect = sensor.values['temperature_bias']
    bias_g = sensor.values['bias']['offset_v'] / sensor.nominal_scale_v_per_g
    warmer_k = temperature_c - 25.0
    return (
        bias_g
        + effect['per_k'] * warmer_k
        + effect['per_k2'] * warmer_k**2
        - zero_g(curve, temperature_c)
    )


@pytest.mark.parametrize('degree', [1, 2, 3])
def test_intervals_cover_units_of_each_degree(degree: int) -> None:
    rng = np.random.default_rng(degree)
    inside: dict[float, list[bool]] = {5.0: [], 10.0: [], 20.0: []}
    for _ in range(UNITS):
        curve = rng.normal(0, 4e-3, (4, 3)) * (np.arange(4) <= degree)[:, None]
        sensor = warmed(rng, curve)
        for beyond_k, cases in inside.items():
            for temperature_c in (LOW_C - beyond_k, HIGH_C + beyond_k):
                cases += (
                    np.abs(error_g(sensor, curve, temperature_c))
                    <= Z_90 * std_g(sensor, temperature_c)
                ).tolist()
    assert min(np.mean(cases) for cases in inside.values()) >= 0.87


def test_a_quadratic_unit_is_not_made_useless() -> None:
    curve = np.array([[0.0] * 3, [4e-3] * 3, [2e-3] * 3, [0.0] * 3])
    sensor = warmed(np.random.default_rng(1), curve)
    assert std_g(sensor, 40.0).max() < 2e-4 and std_g(sensor, HIGH_C + 10).max() < 1e-3


def test_a_cubic_unit_is_wrong_by_as_much_as_stated_and_the_file_keeps_it(tmp_path) -> None:
    curve = np.zeros((4, 3))
    curve[1:, 2] = 8e-3, 3e-3, -5e-3
    sensor = warmed(np.random.default_rng(2), curve)
    parameter_file.save(tmp_path / 'unit.yaml', sensor)
    loaded = parameter_file.load(tmp_path / 'unit.yaml')
    stated = std_g(loaded, 75.0)[2]
    assert stated == pytest.approx(abs(error_g(sensor, curve, 75.0)[2]), rel=0.1)
    assert get(loaded, loaded.covariance_names) == pytest.approx(
        get(sensor, sensor.covariance_names)
    )
    assert std_g(sensor.without_temperature_range(), 75.0)[2] < stated / 5
