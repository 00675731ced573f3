# SPDX-License-Identifier: Apache-2.0
"""Codes that are coarser than stated are found on all axes or on one, and never by chance."""

from adxl_ros.diagnose.noise_detectors import coarse_codes
import numpy as np
import pytest
from units import nominal

SENSOR = nominal('xyz')


def recorded(count, bits=(0, 0, 0), seed=1):
    """Return volts of a slow wave with noise, by axis without some bits."""
    rng, t = np.random.default_rng(seed), np.linspace(0, 20, count)[:, None]
    analog_v = 2.5 + 0.7 * np.sin(t + np.arange(3)) + 1e-3 * rng.normal(size=(count, 3))
    step_v = SENSOR.lsb_v * 2.0 ** np.array(bits)
    return np.rint(analog_v / step_v) * step_v


@pytest.mark.parametrize(('bits', 'common', 'further'), [
    ((4, 4, 4), 4, (0, 0, 0)), ((0, 5, 0), 0, (0, 5, 0)), ((3, 6, 3), 3, (0, 3, 0))])
def test_lost_bits_by_axis(bits, common, further):
    """Bits that all axes lose are common; an axis may lose more."""
    detection = coarse_codes(recorded(6000, bits), SENSOR)
    assert detection.values['lost_bits'] == pytest.approx(common, abs=0.01)
    np.testing.assert_allclose(detection.values['axis_lost_bits'], further, atol=0.01)
    assert (' on y' in detection.message) == (common == 0)
