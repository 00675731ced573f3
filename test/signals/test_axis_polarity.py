# SPDX-License-Identifier: Apache-2.0

"""Inverted and swapped axes, and runs of a mask."""

from adxl_ros.signals.recorded_sensor import find_polarity_fault, PolarityFault
import numpy as np
import pytest


@pytest.mark.parametrize('correlation, fault', [
    ([[1.0, 0.1], [0.1, 1.0]], None),
    ([[-0.99, 0.1], [0.1, 1.0]], PolarityFault(0, 0, -0.99)),
    ([[0.1, -0.95], [0.95, 0.1]], PolarityFault(0, 1, -0.95)),
    ([[0.8, 0.95], [0.1, 1.0]], None),
    ([[np.nan, 0.95], [0.1, -0.99]], PolarityFault(1, 1, -0.99))])
def test_polarity_fault(correlation, fault):
    """The first fault counts. An axis that correlates with its reference has none."""
    assert find_polarity_fault(np.array(correlation), [0, 1], 0.7) == fault


def test_text_of_a_polarity_fault():
    assert 'x reads against its reference' in PolarityFault(0, 0, -0.99).describe('x', 'x')
    assert 'x moves against the reference of y' in PolarityFault(0, 1, -0.95).describe('x', 'y')
