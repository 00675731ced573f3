# SPDX-License-Identifier: Apache-2.0

"""A fit may follow the rests to a microgram and still be that of no sound unit."""

from dataclasses import replace

from adxl_ros.calibrate.calibration import calibrate, RecordedPoses
from adxl_ros.calibrate.poses import Poses
from adxl_ros.calibrate.report import acceptance
from adxl_ros.files import parameter_file
from adxl_ros.model.sensor import Sensor
import numpy as np
import pytest
from units import nominal


def any_imu() -> Sensor:
    sensor = parameter_file.usual(is_nominal=False)
    return replace(sensor, noise_density_g_per_rthz=np.full(3, 4e-4), unstated=())


def fitted(sensor: Sensor, scale: list[float], zero_g: list[float]) -> Sensor:
    """Calibrate a unit whose scale factor is wrong by a factor, and zero-g by some g, by axis."""
    rng = np.random.default_rng(1)
    up = rng.normal(size=(30, 3))
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    volts = sensor.nominal_zero_g_v + sensor.nominal_scale_v_per_g * (
        up * scale + zero_g + rng.normal(0, 2e-5, up.shape)
    )
    missing, begins_s = np.full(30, np.nan), 5.0 * np.arange(30)
    poses = Poses(
        volts,
        np.full((30, 3), 2e-5),
        missing,
        missing,
        np.column_stack([begins_s, begins_s + 4]),
        np.zeros(30, bool),
    )
    return calibrate(sensor, [RecordedPoses('rests.csv', poses)]).fitted


@pytest.mark.parametrize('sensor', [nominal('xyz'), any_imu()], ids=['adxl203', 'any'])
@pytest.mark.parametrize(
    ('scale', 'zero_g', 'words'),
    [
        ([0.68] * 3, [0.0] * 3, 'scale factor of x'),
        ([1.0, 1.0, 2.0], [0.0] * 3, 'scale factor of z'),
        ([1.0] * 3, [0.0, 0.6, 0.0], 'zero-g of y'),
    ],
)
def test_an_implausible_unit_fails(
    sensor: Sensor, scale: list[float], zero_g: list[float], words: str
) -> None:
    unit = fitted(sensor, scale, zero_g)
    accepted = acceptance.acceptance(unit)
    assert accepted.outcome == acceptance.FAIL == unit.provenance['verdict']
    assert words in accepted.reason


@pytest.mark.parametrize('sensor', [nominal('xyz'), any_imu()], ids=['adxl203', 'any'])
def test_a_unit_a_little_beyond_its_datasheet_passes(sensor: Sensor) -> None:
    assert (
        acceptance.acceptance(fitted(sensor, [1.03, 0.95, 1.0], [0.12, 0.0, 0.0])).outcome
        == 'PASS'
    )
