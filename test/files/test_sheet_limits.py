# SPDX-License-Identifier: Apache-2.0

"""Units that are drawn from a parameter file of `params/` are parts by their datasheets."""

from dataclasses import replace
from typing import NamedTuple

from adxl_ros.files import parameter_file
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.simulate.sensor_model import SensorModel
import numpy as np
from processes import REPO
import pytest

UNITS = 2000
"""Units that are drawn: their standard deviation is known to 1.6 %."""
SMALL_G = 0.1  # Force at which nonlinearity does not count, g
HOT_K = 40.0  # Temperature above that of the nominal values, K


class Sheet(NamedTuple):
    """What a datasheet states, typed in from it and not from the file; 0 is not stated."""

    range_g: float
    step_mg: float
    noise_ug: tuple[float, float]  # x and y, z, in µg/√Hz
    zero_g_mg: tuple[float, float] = (0, 0)  # Typical and largest error
    scale_percent: tuple[float, float] = (0, 0)  # Typical and largest error
    drift_mg_per_k: float = 0  # Typical
    scale_drift_percent_per_k: tuple[float, float] = (0, 0)


SHEETS = {
    'adxl345': Sheet(2, 1000 / 256, (290, 430), (40, 250), (1, 10.2), 1.2, (0.01, 0)),
    'adxl362': Sheet(2, 1, (550, 920), (0, 250), (0, 10), 0.6, (0.05, 0)),
    'bmi088': Sheet(6, 1000 / 5460, (160, 190), (20, 0), (0, 0), 0.2, (0.002, 0)),
    'bmi270': Sheet(8, 1000 / 4096, (160, 160), (20, 0), (0.4, 0), 0.25, (0.004, 0)),
    'icm42688': Sheet(16, 1000 / 2048, (65, 70), (20, 0), (0.5, 0), 0.15, (0.005, 0)),
    'iis3dwb': Sheet(2, 0.061, (75, 110), (60, 180), (0, 2), 1.0, (1 / 80, 2 / 80)),
    'lis2dw12': Sheet(2, 0.244, (90, 90)),
    'lis3dh': Sheet(2, 1, (220, 220), (40, 0), (0, 0), 0.5, (0.01, 0)),
    'lsm6ds3': Sheet(2, 0.061, (90, 90), (40, 0), (0, 0), 0.5, (1 / 60, 0)),
    'sca3300': Sheet(3, 1000 / 2700, (37, 37)),
}


def readings_g(sensor, force_g, temperature_c):
    """Return the readings of the x axes of drawn units without noise, g, (n,)."""
    quiet = replace(sensor, noise_density_g_per_rthz=np.zeros(3), adc_bits=0, rc_capacitance_f=0.0)
    model = SensorModel(quiet, seed=7, units='datasheet')
    force_mps2 = np.tile([force_g * G0_MPS2, 0.0, 0.0], (UNITS, 1))
    return model(force_mps2, 1 / sensor.rate_hz, temperature=temperature_c)[:, 0] / G0_MPS2


def check(departures, typical, largest=0.0):
    """Compare the departures of units with what a sheet states: 0 is not stated."""
    if largest:
        assert np.abs(departures).max() <= largest * 1.01  # other departures add a little
    if typical:
        # A limit cuts off the tails, which makes the deviation smaller.
        assert (0.8 if largest else 0.95) * typical < np.std(departures) < 1.05 * typical


@pytest.mark.parametrize('name', SHEETS)
def test_drawn_units_keep_to_the_limits_of_the_sheet(name):
    sheet, sensor = SHEETS[name], parameter_file.load(REPO / 'params' / f'{name}.yaml')
    assert sensor.range_g == sheet.range_g
    step_g = sensor.lsb_v / sensor.nominal_scale_v_per_g[0]
    assert step_g * 1e3 == pytest.approx(sheet.step_mg, rel=1e-5)
    assert sensor.noise_density_g_per_rthz[[0, 2]] * 1e6 == pytest.approx(sheet.noise_ug)
    if not sensor.datasheet:
        assert not any(sheet.zero_g_mg), 'a file without tolerances has a sheet without them'
        return
    zero_g = readings_g(sensor, 0.0, 25.0)
    scale = (readings_g(sensor, SMALL_G, 25.0) - zero_g) / SMALL_G
    hot_zero_g = readings_g(sensor, 0.0, 25.0 + HOT_K)
    hot_scale = (readings_g(sensor, SMALL_G, 25.0 + HOT_K) - hot_zero_g) / SMALL_G
    check(zero_g * 1e3, *sheet.zero_g_mg)
    check((scale - 1) * 1e2, *sheet.scale_percent)
    check((hot_zero_g - zero_g) / HOT_K * 1e3, sheet.drift_mg_per_k)
    check((hot_scale - scale) / HOT_K * 1e2, *sheet.scale_drift_percent_per_k)
