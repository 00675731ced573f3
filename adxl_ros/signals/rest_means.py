# SPDX-License-Identifier: Apache-2.0

"""The means of the samples of rests, with their standard deviations."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from adxl_ros.model.noise import effective_samples
from adxl_ros.signals import block_statistics as stats
from adxl_ros.signals.block_statistics import Blocks, Spans
from adxl_ros.signals.rest_limits import SampleNoise
import numpy as np

if TYPE_CHECKING:
    from adxl_ros.signals.rest_search import Rest

MOST_BATCHES = 20  # Most batches that show the error of a mean. Chosen: the usual number
_MIN_BATCH_BLOCKS = 2  # Smallest length of such a batch, blocks: 0.1 s


def rest_means(
    time_s: np.ndarray,
    samples: np.ndarray,
    rests: Sequence[Rest],
    rate_hz: float,
    noise: SampleNoise | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """
    Average the rests of a recording, as a finder of rests does: mean and std, (k, m) each.

    The std is that by the scatter between parts of the rest, and at least that of the noise.
    """
    parts = [
        stats.BlockCutter(rate_hz, samples.shape[1]).feed(
            time_s[rest.start : rest.stop], samples[rest.start : rest.stop]
        )
        for rest in rests
    ]
    return means_of_blocks(parts, Spans(rate_hz), noise)


def means_of_blocks(
    parts: list[Blocks], spans: Spans, noise: SampleNoise | None
) -> tuple[np.ndarray, np.ndarray]:
    """Average the blocks of each rest; mean and standard deviation, (k, m) each."""
    # The step is that of all rests: a rest with constant codes does not show it.
    step = stats.adc_step(Blocks.join(parts)) if parts else np.empty(0)
    pairs = [_mean(_without_knocks(part, step, spans), step, spans, noise) for part in parts]
    mean, error = zip(*pairs) if pairs else ((), ())
    return np.array(mean), np.array(error)


def _mean(
    part: Blocks, step: np.ndarray, spans: Spans, noise: SampleNoise | None
) -> tuple[np.ndarray, np.ndarray]:
    """
    Average the blocks of a rest; mean and standard deviation, (m,) each.

    The noise may have any spectrum. The means of up to twenty batches of the rest are nearly
    independent, and their scatter is the long-run variance (batch means; Law and Kelton 2000).
    """
    mean = part.mean.mean(axis=0)
    white = part.squares.sum(axis=0) / max((spans.size - 1) * len(part), 1)
    length = max(-(-len(part) // MOST_BATCHES), _MIN_BATCH_BLOCKS)
    count = len(part) // length
    long_run = np.zeros(len(mean))
    if count > 1:
        batches = part.mean[: count * length].reshape(count, length, -1).mean(axis=1)
        squares = ((batches - batches.mean(axis=0)) ** 2).sum(axis=0)
        long_run = length * squares / (count - 1)
    variance = np.maximum(long_run, white / spans.size) / len(part)
    if noise is not None:
        independent = effective_samples(len(part) * spans.size, 1 / spans.rate_hz, noise.tau_s)
        variance = np.maximum(variance, noise.sigma**2 / independent)
    rounding = stats.undithered(step, np.sqrt(white)) ** 2 / 12
    return mean, np.sqrt(variance + rounding)


def _without_knocks(part: Blocks, step: np.ndarray, spans: Spans) -> Blocks:
    """Leave out the blocks of a rest whose variance differs from that of most blocks."""
    windows = stats.window_variance(part, spans)
    _, limit = stats.quiet_variance(part, windows, step)
    calm = part[stats.quiet_blocks(part, windows, limit, spans.window)]
    return calm if 2 * len(calm) > len(part) else part
