# SPDX-License-Identifier: Apache-2.0

"""Samples that stand alone are found one by one, whatever their size and however near."""

from adxl_ros.diagnose.sample_faults import isolated_samples
import numpy as np
import pytest
from units import nominal

RATE_HZ, NOISE_V = 100.0, 5e-4


@pytest.mark.parametrize('size_v', [0.02, 0.2, 2.0])
@pytest.mark.parametrize('distance', [1, 2, 3, 4])
def test_spikes_next_to_each_other(size_v: float, distance: int) -> None:
    sensor = nominal('xy', rate_hz=RATE_HZ)
    count = 4000
    residual_v = np.random.default_rng(3).normal(0.0, NOISE_V, (count, 2))
    first = np.arange(200, 3800, 400)
    places = np.concatenate([first, first[:1] + distance])
    residual_v[places, 0] += size_v
    used, (found,) = isolated_samples(
        2.5 + residual_v, residual_v, np.arange(count) / RATE_HZ, np.ones(count, bool), sensor
    )
    alone = first[1:] if distance == 1 else places
    assert set(alone) <= set(np.flatnonzero(~used)) <= set(places)
    assert found.values['amplitude_v'][0] == pytest.approx(size_v, abs=5 * NOISE_V)
    assert found.values['amplitude_v'][1] == 0.0
