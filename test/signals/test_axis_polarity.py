# SPDX-License-Identifier: Apache-2.0

"""Inverted and swapped axes, and runs of a mask."""

from adxl_ros.signals.axis_polarity import find_polarity_fault, PolarityFault
from adxl_ros.signals.runs import true_runs
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


def test_runs_end_where_the_mask_or_the_group_changes():
    mask = np.array([True, True, False, True, True, True])
    assert true_runs(mask) == [(0, 2), (3, 6)]
    assert true_runs(mask, np.array([0, 1, 1, 1, 2, 2])) == [(0, 1), (1, 2), (3, 4), (4, 6)]
    assert true_runs(np.zeros(0, bool)) == []
