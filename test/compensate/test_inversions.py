# SPDX-License-Identifier: Apache-2.0

"""The inversion of the RC filter, and the paper's approximate inverse with the exact one."""

from itertools import pairwise

from adxl_ros.compensate import inversions
from adxl_ros.model import noise, signal_chain
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.filters import low_pass
from adxl_ros.model.kinematics import specific_force
from adxl_ros.model.sensor import put, with_neutral
from adxl_ros.simulate.motion import Held, Motion
from adxl_ros.simulate.response import Response
import numpy as np
import pytest
from units import drawn, nominal

RC_S = np.array([0.0106, 0.012])
RATE_HZ = 1000.0


def filtered(inputs, rate_hz=RATE_HZ, fine=16):
    """Filter functions of time on a fine grid and sample them; return stamps and volts."""
    time_s = np.arange(int(2 * rate_hz * fine)) / (rate_hz * fine)
    out = [low_pass(f(time_s), rc, 1 / (rate_hz * fine), {}) for f, rc in zip(inputs, RC_S)]
    return time_s[::fine], np.column_stack(out)[::fine]


def test_amplitude_and_phase_are_restored():
    def felt(t):
        return np.sin(62.8 * t) + 0.5 * np.cos(377 * t) + 0.2 * np.sin(942 * t)

    time_s, volts = filtered([felt, lambda t: 2 * felt(t)])
    back = inversions.undo_filter(volts, time_s, RC_S, RATE_HZ)[300:-20]
    expected = np.column_stack([felt(time_s), 2 * felt(time_s)])[300:-20]
    assert np.abs(back - expected).max() < 2e-3


@pytest.mark.parametrize('sizes', [[2000], [700, 3, 1297], [16] * 125])
def test_the_inverse_does_not_depend_on_blocks(sizes):
    """Blocks change the result only beside blocks that are shorter than the filter."""
    time_s, volts = filtered([np.sin, np.cos])
    cuts = np.cumsum([0, *sizes])
    blocks = [(i, time_s[a:b], volts[a:b]) for i, (a, b) in enumerate(pairwise(cuts))]
    parts = list(inversions.undo_filter_blocks(blocks, RC_S, RATE_HZ))
    assert [token for token, _ in parts] == list(range(len(sizes)))
    back = np.concatenate([part for _, part in parts])
    at_once = inversions.undo_filter(volts, time_s, RC_S, RATE_HZ)
    if min(sizes) >= inversions.HALF:
        np.testing.assert_allclose(back, at_once, atol=1e-12)
    assert np.abs(back - at_once)[50:].max() < 1e-3


def test_a_stream_gives_the_same_samples_with_a_delay_of_eight():
    """The zero-phase inverse is delayed sample by sample, and keeps the stamps of the samples."""
    time_s, volts = filtered([np.sin, np.cos])
    kept = np.r_[0:500, 700:1200]
    delayed = inversions.DelayedInversion(RC_S, RATE_HZ)
    out, late = [], []
    for i in kept:
        sample = inversions.FilteredSample(float(time_s[i]), volts[i].tolist(), i)
        for ready in delayed(sample):
            assert ready.time_s == time_s[ready.token]
            out.append((ready.token, *ready.volts))
            late.append(i - ready.token)
    out = np.array(out)
    count = len(out)
    np.testing.assert_array_equal(out[:, 0], kept[:count])
    assert count == len(kept) - inversions.HALF
    expected = inversions.undo_filter(volts[kept], time_s[kept], RC_S, RATE_HZ)[:count]
    np.testing.assert_allclose(out[:, 1:], expected, atol=1e-9)
    assert sorted(late)[len(late) // 2] == inversions.HALF


def test_the_predicted_variance_of_restored_noise_is_right():
    sensor = put(
        with_neutral(nominal(), ['bandwidth']),
        [Coefficient('bandwidth', 'resistance_ratio', 'x')],
        [-0.2],
    )
    time_s = np.arange(200_000) / sensor.rate_hz
    volts = Response(sensor, Motion(200.0, Held(0.5), Held(0.7)), 3)(time_s)
    back = inversions.undo_filter(volts, time_s, noise.electronics(sensor).rc_s, sensor.rate_hz)
    assert back[100:-100].std(axis=0) ** 2 == pytest.approx(
        inversions.noise_variance_v2(sensor), rel=0.02
    )


def unit(rng, **options):
    return drawn(rng, nominal(**options))


def poses(count=200):
    """Draw upright poses, away from the plane in which z is the root of zero."""
    rng = np.random.default_rng(0)
    alpha = rng.uniform(0, np.radians(70), count)
    return specific_force(alpha, rng.uniform(0, 2 * np.pi, count), 9.80665)


@pytest.mark.parametrize('axes', ['xy', 'xyz'])
def test_the_papers_inverse_is_approximate_and_the_other_exact(axes):
    """(14) to (21) have errors of second order: above 1e-6, below some mg. The other has 1e-9."""
    sensor = unit(np.random.default_rng(2), axes=axes)
    force = poses()
    volts = signal_chain.static_response(sensor)(force)
    exact = np.subtract(signal_chain.inverse(sensor)(volts), force)
    paper = np.subtract(inversions.PaperInverse(sensor)(volts), force)
    assert np.abs(exact).max() < 1e-9
    assert 1e-4 < np.abs(paper[:2]).max() < 0.05
