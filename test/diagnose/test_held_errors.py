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

"""Errors that stay while nothing moves: coarse rounding, and drifts that are none."""

from dataclasses import replace

from adxl_ros.diagnose.drift_checks import log_bayes_factor_within_rests, ResidualChannel
from adxl_ros.diagnose.noise_whitening import whiteners
from adxl_ros.model import noise
import numpy as np
import pytest
from units import nominal

RATE_HZ, DENSITY_G_PER_RTS = 100.0, 6e-4
MOVE, REST = 100, 300
"""Samples of a move and of a rest."""


@pytest.mark.parametrize('steps', [0.02, 0.1, 0.2, 0.3])
def test_rounding_is_split_by_the_noise_before_it(steps):
    """The held part is the error of the mean of many roundings, averaged over a step."""
    sensor = replace(nominal('x'), adc_bits=8)
    scale = steps * sensor.lsb_v / noise.analog_std_v(sensor)[0]
    sensor = replace(sensor, noise_density_g_per_rthz=sensor.noise_density_g_per_rthz * scale)
    rng = np.random.default_rng(1)
    places = np.linspace(-0.5, 0.5, 400, endpoint=False)
    rounded = np.rint(places[:, None] + steps * rng.normal(size=(400, 4000)))
    held = np.mean((rounded.mean(axis=1) - places) ** 2) * sensor.lsb_v ** 2
    parts = noise.rounding(sensor, 0)
    assert parts.held_v2 == pytest.approx(held, rel=0.05, abs=1e-3 * sensor.lsb_v ** 2)
    assert parts.held_v2 + parts.white_v2 == pytest.approx(sensor.lsb_v ** 2 / 12)


def channel_of(residual_v, sensor):
    """Return a residual with the filter of a strong random walk."""
    filters = whiteners(sensor, 0, 1 / RATE_HZ, len(residual_v) / RATE_HZ)
    strong = next(f for f in filters if f.density == DENSITY_G_PER_RTS)
    return ResidualChannel(residual_v, np.ones(len(residual_v), bool), RATE_HZ, strong,
                           filters[0], float(np.var(np.diff(residual_v))))


def test_a_walk_goes_on_within_rests_and_errors_of_form_do_not():
    """Both differ from rest to rest by as much; only the walk changes in between."""
    sensor = replace(nominal('xy'), rate_hz=RATE_HZ)
    rng = np.random.default_rng(3)
    at_rest = np.tile(np.repeat([False, True], [MOVE, REST]), 60)
    noise_v = noise.analog_std_v(sensor)[0] * rng.normal(size=len(at_rest))
    step_v = DENSITY_G_PER_RTS * sensor.scale_v_per_g[0] / np.sqrt(RATE_HZ)
    walk_v = np.cumsum(step_v * rng.normal(size=len(at_rest)))
    held_v = np.repeat(walk_v[MOVE::MOVE + REST], MOVE + REST)
    factors = [log_bayes_factor_within_rests(channel_of(noise_v + v, sensor), at_rest, sensor, 0)
               for v in (walk_v, held_v)]
    assert factors[0] > 10
    assert factors[1] < -10
