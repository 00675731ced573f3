# SPDX-License-Identifier: Apache-2.0

"""The noise floor: its interval where it is measured at rest, and the part of rounding."""

from dataclasses import replace

from adxl_ros.diagnose.comparison import compare
from adxl_ros.diagnose.noise_floor import estimate_floor, NoiseFloor, squares_at_rest
from adxl_ros.files.recording_columns import Recording
from adxl_ros.model import noise
from adxl_ros.model.constants import G0_MPS2
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
        volts = lfilter([np.sqrt(1 - pole**2)], [1, -pole], white, axis=0)[100:]
        sums = squares_at_rest(volts, np.ones(count, bool), sensor)
        squares = np.array([part.squares_v2[0] for part in sums])
        samples = np.array([part.samples for part in sums])
        rms = np.sqrt(squares.sum() / samples.sum())
        floor = NoiseFloor(np.array([rms]), rms, 'still', squares, samples)
        low, high = np.quantile(floor.power(seed, 200), [0.05, 0.95])
        contained += low < 1.0 < high
    assert (0.8 if seconds < 20 else 0.84) < contained / _TRIALS < 0.95


def test_a_second_has_no_interval():
    assert np.isinf(NoiseFloor(np.ones(1), 1.0, 'still', *np.ones((2, 7))).power(0, 200)).all()


@pytest.mark.parametrize('seconds', [0.6, 1.4, 2.7])
def test_no_sample_of_a_rest_is_lost(seconds):
    """The parts of a rest have all of its samples, and their mean square is that of the noise."""
    sensor = nominal(rate_hz=_RATE_HZ)
    count = round(seconds * _RATE_HZ)
    at_rest = np.arange(400 * (count + 1)) % (count + 1) < count
    white = np.random.default_rng(1).normal(size=(len(at_rest), 1))
    pole = np.exp(-1 / (_RATE_HZ * sensor.rc_s))
    volts = lfilter([np.sqrt(1 - pole**2)], [1, -pole], white, axis=0)
    sums = squares_at_rest(volts, at_rest, sensor)
    assert sum(part.samples for part in sums) == at_rest.sum()
    squares = sum(part.squares_v2[0] for part in sums)
    assert squares / at_rest.sum() == pytest.approx(1.0, rel=0.03)


@pytest.mark.parametrize('steps', [0.02, 0.1, 0.2, 0.3])
def test_rounding_is_split_by_the_noise_before_it(steps):
    """The held part is the error of the mean of many roundings, averaged over a step."""
    sensor = replace(nominal('x'), adc_bits=8)
    scale = steps * sensor.lsb_v / noise.analog_std_v(sensor)[0]
    sensor = replace(sensor, noise_density_g_per_rthz=sensor.noise_density_g_per_rthz * scale)
    rng = np.random.default_rng(1)
    places = np.linspace(-0.5, 0.5, 200, endpoint=False)
    rounded = np.rint(places[:, None] + steps * rng.normal(size=(200, 4000)))
    held = np.mean((rounded.mean(axis=1) - places) ** 2) * sensor.lsb_v**2
    share = float(noise.held_rounding(sensor)[0])
    assert share * sensor.lsb_v**2 / 12 == pytest.approx(
        held, rel=0.05, abs=1e-3 * sensor.lsb_v**2
    )


def test_rounding_that_no_rest_shows_is_part_of_the_floor():
    """One code for the whole rest: its distance from the output is up to half a step."""
    sensor = nominal('x', rate_hz=_RATE_HZ, adc_bits=6)
    time_s = np.arange(500) / _RATE_HZ
    floor = estimate_floor([compare(Recording('made', time_s, {'x_v': 0 * time_s + 2.5}), sensor)])
    step_mps2 = G0_MPS2 * sensor.lsb_v / sensor.scale_v_per_g[0]
    assert floor.source == 'still'
    assert floor.rms_mps2 == pytest.approx(step_mps2 / np.sqrt(12), rel=0.03)
