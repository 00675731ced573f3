# SPDX-License-Identifier: Apache-2.0

"""How surely an ideal observer could have named the effects of a verdict."""

import json

from adxl_ros.diagnose.diagnosis import diagnose
from adxl_ros.diagnose.ideal_observer import bounds, surest
from adxl_ros.model.effects import library
from gaps import simulated, unit
import numpy as np
import pytest
import scipy


def test_two_hypotheses_are_confused_by_their_distance():
    assert bounds([4.0]) == pytest.approx((scipy.stats.norm.cdf(1.0),) * 2)
    several = bounds([4.0, 9.0, 1e4])
    confused = scipy.stats.norm.cdf([-1.0, -1.5])
    assert several == pytest.approx((1 - confused.sum(), 1 - confused[0]))
    assert bounds([0.0] * 5) == (0.0, 0.5)


@pytest.mark.long
def test_without_rivals_it_is_as_sure_as_the_interval_of_a_size():
    """One coefficient against none: the distance is the size in its standard deviations."""
    report = diagnose([simulated(unit())], unit()).report
    single = [h for h in report.hypotheses if h.effects in (('gravity',), ('clock_skew',))]
    assert single
    for hypothesis in single:
        size = abs(hypothesis.values[0]) / np.sqrt(hypothesis.fit.covariance[0, 0])
        found = surest(report.linear_model, hypothesis, library())
        assert found.high == pytest.approx(scipy.stats.norm.cdf(size / 2), abs=1e-4)


@pytest.mark.long
def test_it_stands_beside_the_probability(two_effects):
    said = ' '.join((two_effects / 'screen.txt').read_text().split())
    assert '% sure; an ideal observer > 99 %)' in said
    report = json.loads((two_effects / 'gap' / 'report.json').read_text())
    low, high = report['verdict']['surest']
    assert 0.99 < low <= high <= 1.0
