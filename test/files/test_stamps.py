# SPDX-License-Identifier: Apache-2.0

"""The rate of stamps is that of the samples, however a host delays, rounds or loses them."""

from adxl_ros.files.stamps import halves, is_even, lacks_samples, late_by, stamped_rate_hz
import numpy as np
import pytest

RATE_HZ = 100.0


def even(seconds: float, rate_hz: float = RATE_HZ) -> np.ndarray:
    return np.arange(round(seconds * rate_hz)) / rate_hz


def polled(time_s: np.ndarray, period_s: float) -> np.ndarray:
    """Stamp samples when a host that looks every `period_s` finds them."""
    return np.ceil(time_s / period_s) * period_s


def stalled(time_s: np.ndarray, stall_s: float) -> np.ndarray:
    """Stamp the samples of the first part of each second at once, at its end."""
    waits = time_s % 1 < stall_s
    return np.where(
        waits, np.floor(time_s) + stall_s + 1e-4 * np.arange(len(time_s)) / RATE_HZ, time_s
    )


@pytest.mark.parametrize('seconds', [1.2, 10.0])
@pytest.mark.parametrize(
    ('rate_hz', 'period_s'), [(100.0, 4.25e-3), (75.0, 10e-3), (133.0, 10e-3), (400.0, 1e-3)]
)
def test_a_host_that_polls(rate_hz: float, period_s: float, seconds: float) -> None:
    time_s = polled(even(seconds, rate_hz), period_s)
    assert stamped_rate_hz(time_s) == pytest.approx(rate_hz, rel=period_s / seconds)


@pytest.mark.parametrize('stall_s', [0.05, 0.2, 0.5])
def test_a_host_that_stalls_loses_nothing(stall_s: float) -> None:
    time_s = stalled(0.7 + even(10), stall_s)
    assert stamped_rate_hz(time_s) == pytest.approx(RATE_HZ, rel=0.01)
    assert not lacks_samples(time_s, 1 / RATE_HZ).any()


@pytest.mark.parametrize('jitter_s', [0.0, 1e-3])
@pytest.mark.parametrize('lost', [0.01, 0.1, 0.2])
def test_lost_samples_are_not_counted(lost: float, jitter_s: float) -> None:
    draw = np.random.default_rng(1)
    time_s = even(20) + draw.normal(0, jitter_s, 2000)
    time_s = time_s[draw.random(2000) > lost]
    assert stamped_rate_hz(time_s) == pytest.approx(RATE_HZ, rel=0.005)


def test_pauses_are_not_counted() -> None:
    time_s = even(4)
    time_s = time_s + 0.5 * (time_s > 1) + 700.0 * (time_s > 2)
    assert stamped_rate_hz(time_s) == RATE_HZ
    assert np.flatnonzero(lacks_samples(time_s, 0.01)).tolist() == [100, 200]


@pytest.mark.parametrize('size', [2, 10, 40])
def test_bursts_have_the_rate_of_their_samples(size: int) -> None:
    number = np.arange(400)
    time_s = (number // size + 1) * size / RATE_HZ + 1e-5 * (number % size)
    assert stamped_rate_hz(time_s) == pytest.approx(RATE_HZ, rel=1e-3)


def test_even_stamps_may_lack_samples_but_are_not_polled() -> None:
    time_s = even(2)
    assert is_even(np.delete(time_s, [20, 70, 71, 130]))
    assert not is_even(polled(time_s, 4.25e-3))


def test_only_a_lasting_other_rate_is_in_both_halves() -> None:
    steady, late = halves(even(4)), halves(stalled(even(4)[60:], 0.5))
    assert steady.agree(0.05) and steady.contradict(110.0, 0.05)
    assert not late.contradict(RATE_HZ, 0.05)
    lossy = halves(even(4)[np.random.default_rng(2).random(400) > 0.1])
    assert not lossy.contradict(RATE_HZ, 0.05)


def test_stamps_that_step_back() -> None:
    assert late_by(np.array([0, 10, 5, 8, 20])).tolist() == [0, 0, 5, 2, 0]
