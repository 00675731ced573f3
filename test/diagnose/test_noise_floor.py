# Copyright 2026 the adxl_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The interval of a noise floor that is measured at rest."""

from adxl_ros.diagnose.noise_floor import NoiseFloor, squares_at_rest
import numpy as np
import pytest
from scipy.signal import lfilter
from units import nominal

_RATE_HZ = 50.0
_TRIALS = 300


@pytest.mark.parametrize('seconds', [6, 40, 400])
def test_the_interval_contains_the_noise(seconds):
    """Noise behind a filter, whose samples are correlated, has an interval that holds."""
    sensor = nominal(rate_hz=_RATE_HZ)
    pole = np.exp(-1 / (_RATE_HZ * sensor.rc_s))
    count = round(seconds * _RATE_HZ)
    contained = 0
    for seed in range(_TRIALS):
        white = np.random.default_rng(seed).normal(size=(count + 100, 1))
        volts = lfilter([np.sqrt(1 - pole ** 2)], [1, -pole], white, axis=0)[100:]
        sums = squares_at_rest(volts, np.ones(count, bool), sensor)
        parts = np.array([(part.squares_v2[0], part.count) for part in sums]).T
        rms = np.sqrt(parts[0].sum() / parts[1].sum())
        low, high = np.quantile(NoiseFloor(np.array([rms]), rms, 'still', parts).draws_mps2(seed),
                                [0.05, 0.95])
        contained += low < 1.0 < high
    assert (0.8 if seconds < 20 else 0.84) < contained / _TRIALS < 0.95


def test_a_few_seconds_have_no_interval():
    parts = np.ones((2, 19))
    assert NoiseFloor(np.ones(1), 1.0, 'still', parts).draws_mps2(0) is None
