# SPDX-License-Identifier: Apache-2.0

"""The overlapping Allan deviation: equal to that of allantools, in bounded memory."""

from io import BytesIO
from tempfile import TemporaryFile
import tracemalloc

from adxl_ros.signals import allan_deviation
from adxl_ros.signals.allan_deviation import AllanDeviation, RunningSums
import numpy as np
import pytest
from still_noise import still_samples

allantools = pytest.importorskip('allantools')


def streamed(samples: np.ndarray, rate_hz: float, portion: int) -> AllanDeviation:
    stream = RunningSums(samples.shape[1], BytesIO())
    for start in range(0, len(samples), portion):
        stream.feed(samples[start : start + portion])
    size, means = stream.cells()
    expected = samples[: len(means) * size].reshape(len(means), size, -1).mean(axis=1)
    assert len(samples) // size == len(means) < 1 << 17
    np.testing.assert_allclose(means, expected, rtol=1e-12)
    return stream.allan_deviation(rate_hz)


@pytest.mark.parametrize(
    'count, portions', [(9, (1, 777)), (5000, (777, 65536)), (300_001, (777, 65536))]
)
def test_equal_to_allantools(count: int, portions: tuple[int, int]) -> None:
    rng = np.random.default_rng(1)
    samples = 9.8 + np.column_stack(
        [still_samples(rng, count, 100.0, 1e-3, 1e-4, 1e-5) for _ in range(2)]
    )
    first, second = (streamed(samples, 100.0, portion) for portion in portions)
    assert first.deviation == pytest.approx(second.deviation, rel=1e-9)
    for axis in range(2):
        tau_s, expected, _, _ = allantools.oadev(samples[:, axis], 100.0, 'freq', first.tau_s)
        assert first.tau_s == pytest.approx(tau_s)
        assert first.deviation[:, axis] == pytest.approx(expected, rel=1e-9)


def test_memory_does_not_grow_with_the_stream(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(allan_deviation, '_MOST_CELLS', 1 << 10)
    monkeypatch.setattr(allan_deviation, '_AT_ONCE', 1 << 10)
    block = np.random.default_rng(3).standard_normal((8192, 3))
    peaks = []
    with TemporaryFile() as file:
        stream = RunningSums(3, file)
        tracemalloc.start()
        for _ in range(3):
            for _ in range(20):
                stream.feed(block)
            assert len(stream.cells()[1]) < 1 << 10
            assert np.isfinite(stream.allan_deviation(100.0).deviation).all()
            peaks.append(tracemalloc.get_traced_memory()[1])
    tracemalloc.stop()
    assert peaks[2] < 1.05 * peaks[0]
    assert stream.count == 3 * 20 * 8192
