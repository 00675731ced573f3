# SPDX-License-Identifier: Apache-2.0
"""
The noise of a healthy unit and of its reference, below which no model can predict a sample.

The floor is from noise at rest, differences of repeats, and the steps of the encoder.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement
from typing import NamedTuple

from adxl_ros.diagnose.comparison import BaselineComparison
from adxl_ros.model import noise
from adxl_ros.model.kinematics import gravity_slopes
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.block_statistics import true_runs
import numpy as np
import scipy

_REST_S = 1.0
"""Length of a part of a rest whose mean is subtracted, s, to within a half. Chosen: slower changes
are part of the gap."""
_PIECES = 4
"""Pieces of such a part, for the interval of the noise. Chosen: longer than its samples
correlate."""
_FEWEST_PIECES = 8
"""Pieces from which an interval is drawn. Chosen: they show their spread to a quarter."""
_MOST_PIECES = 100  # Largest number of pieces that are drawn. Chosen: run time
_FEWEST_SAMPLES = 200  # Fewest samples of an estimate. Chosen: 5 % of the standard deviation
_REPEAT_SHORTEST_S = 20.0  # Shortest repeat of a trajectory, s. Chosen: a few moves
_REPEAT_DELAY_S = 10.0
"""Smallest delay of a repeat in the same recording, s. Chosen: beyond the correlation of a move
with itself."""
_REPEAT_STEPS = 5.0
"""Largest rms angle between two repeats, in steps of the encoder. Chosen."""
_SMALLEST_RESOLUTION_RAD = 1e-5  # Smallest such step, rad. Chosen: 0.01 mg
_REPEAT_MOTION = 0.05
"""Smallest standard deviation of the direction of gravity in a repeat, rad. Chosen: 50 mg, from
which an axis is compared, too."""
_SAME_RATE = 1e-3  # Relative difference of equal sample rates. Chosen: a lag of 20 ms in a repeat


@dataclass(frozen=True)
class NoiseFloor:
    """Rms of what no model can predict, over samples and measured axes."""

    noise_v: np.ndarray  # Standard deviation of the samples about their mean, V, (m,)
    rms_mps2: float  # Noise and the steps of the stage's encoder, m/s²
    # 'still' for rests, 'repeats' of a trajectory, or 'assumed' from the parameter file
    source: str
    # Sum of the squares of noise and steps by piece of the recordings, mean over axes, (m/s²)²,
    # (k,); of no piece where the floor is assumed
    squares: np.ndarray
    samples: np.ndarray  # Number of samples of each piece, (k,)

    def power(self, seed: int, draws: int) -> np.ndarray:
        """
        Return its mean square, and that of pieces drawn with replacement, (m/s²)², (1 + draws,).

        It is infinite where it is assumed, or of too few pieces to say how sure it is, so that
        nothing is above it.
        """
        count = len(self.squares)
        if count < _FEWEST_PIECES:
            return np.full(1 + draws, np.inf)
        edges = np.linspace(0, count, min(count, _MOST_PIECES) + 1).astype(int)[:-1]
        squares = np.add.reduceat(self.squares, edges)
        samples = np.add.reduceat(self.samples, edges)
        drawn = np.random.default_rng(seed).integers(0, len(edges), (draws, len(edges)))
        return np.append(self.rms_mps2**2, squares[drawn].sum(axis=1) / samples[drawn].sum(axis=1))


class PartSquares(NamedTuple):
    """The squares of a part of a recording."""

    squares_v2: np.ndarray  # Sum by axis, V², (m,)
    samples: int


def estimate_floor(comparisons: Sequence[BaselineComparison]) -> NoiseFloor:
    """
    Estimate the noise floor from rests, else from repeats, else from the parameter file.

    The noise at rest is that about the mean of each second. The mean square of the encoder's steps
    is added: step²/12 times the squared slope of gravity, or what they leave open of a robot. So
    is the rounding that no rest shows.
    """
    sensor = comparisons[0].sensor
    scale_v_per_mps2 = comparisons[0].scale_v_per_mps2
    # Mean square that no part shows, (m/s²)²
    unknown = np.mean([_encoder_error_mps2(c) ** 2 for c in comparisons])
    noise_v = noise.sample_std_v(sensor)
    source = 'still'
    parts: list[PartSquares] = []
    for c in comparisons:
        parts += squares_at_rest(c.volts, c.at_rest & c.used, c.sensor)
    if _samples(parts) < _FEWEST_SAMPLES:
        source = 'repeats'
        parts = _repeat_squares(comparisons)
    if _samples(parts) < _FEWEST_SAMPLES:
        source = 'assumed'
        parts = []
    else:
        noise_v = np.sqrt(np.sum([p.squares_v2 for p in parts], axis=0) / _samples(parts))
    if source == 'still':
        unknown += np.mean(noise.held_rounding_v2(sensor) / scale_v_per_mps2**2)
    samples = np.array([p.samples for p in parts])
    squares = np.array([np.mean(p.squares_v2 / scale_v_per_mps2**2) for p in parts])
    rms_mps2 = np.sqrt(np.mean((noise_v / scale_v_per_mps2) ** 2) + unknown)
    return NoiseFloor(noise_v, float(rms_mps2), source, squares + samples * unknown, samples)


def _samples(parts: Sequence[PartSquares]) -> int:
    """Return the number of samples of all parts."""
    return sum(part.samples for part in parts)


def _encoder_error_mps2(comparison: BaselineComparison) -> float:
    """Return the rms over samples and axes that the steps of encoders leave open."""
    if comparison.joints is None:
        return comparison.robot_error_mps2
    sensor = comparison.sensor
    slopes = gravity_slopes(*comparison.joint_values())[:, : len(sensor.axes), comparison.used]
    squares = (slopes**2).sum(axis=0).mean()
    return float(sensor.local_gravity_mps2 * sensor.stage_std_rad * np.sqrt(squares))


def squares_at_rest(volts: np.ndarray, at_rest: np.ndarray, sensor: Sensor) -> list[PartSquares]:
    """Sum the squares of an output, V, (n, m), about the means of parts of its rests."""
    usual = max(round(_REST_S * sensor.rate_hz), 4)
    squares: list[PartSquares] = []
    for begin, end in true_runs(at_rest):
        # No sample of a rest is lost: its parts are longer or shorter by up to a half.
        count = round((end - begin) / usual)
        for part in np.array_split(volts[begin:end], count) if count else ():
            length = len(part)
            # The mean of correlated samples takes more out of their variance than one sample.
            independent = length / float(
                noise.effective_samples(length, 1 / sensor.rate_hz, sensor.rc_s)
            )
            squares_v2 = (part - part.mean(axis=0)) ** 2 * length / (length - independent)
            squares += [
                PartSquares(piece.sum(axis=0), len(piece))
                for piece in np.array_split(squares_v2, _PIECES)
            ]
    return squares


def _repeat_squares(comparisons: Sequence[BaselineComparison]) -> list[PartSquares]:
    """Return half the squares of the differences between repeats of a trajectory on the stage."""
    staged = [c for c in comparisons if c.joints]
    squares: list[PartSquares] = []
    for first, second in combinations_with_replacement(staged, 2):
        squares += _squares_between(first, second)
    return squares


def _squares_between(first: BaselineComparison, second: BaselineComparison) -> list[PartSquares]:
    """Return half the squares of the differences of two recordings; none without a repeat."""
    rate_hz = first.sensor.rate_hz
    force = first.reference_force_g()
    other = second.reference_force_g()
    assert force is not None and other is not None, 'a stage states both'
    if abs(rate_hz / second.sensor.rate_hz - 1) > _SAME_RATE:
        return []
    repeat = find_repeat(force, other, rate_hz, first.sensor.stage_resolution_rad, first is second)
    if repeat is None:
        return []
    before = slice(repeat.samples)
    behind = slice(repeat.lag, repeat.lag + repeat.samples)
    residual_v = first.residual_v(first.sensor)[before]
    difference_v = second.residual_v(second.sensor)[behind] - residual_v
    difference_v = difference_v[first.used[before] & second.used[behind]]
    squares_v2 = (difference_v - difference_v.mean(axis=0)) ** 2 / 2
    length = max(round(_REST_S * rate_hz), 1)
    return [
        PartSquares(part.sum(axis=0), len(part))
        for part in np.split(squares_v2, range(length, len(squares_v2), length))
    ]


class Repeat(NamedTuple):
    """A part of a trajectory that is repeated later."""

    lag: int  # How much later, samples
    samples: int  # Length of the part


def find_repeat(
    first: np.ndarray,
    second: np.ndarray,
    rate_hz: float,
    resolution_rad: float,
    same_recording: bool,
) -> Repeat | None:
    """
    Find the lag, and its overlap, by which the directions of gravity in two recordings agree best.

    first, second: direction of gravity in the sensor's frame, unit vectors, (3, n) and (3, n').
    """
    products = sum(scipy.signal.correlate(b, a, method='fft') for a, b in zip(first, second))
    lags = scipy.signal.correlation_lags(second.shape[1], first.shape[1])
    overlap = np.minimum(first.shape[1], second.shape[1] - lags)
    smallest_delay_s = _REPEAT_DELAY_S if same_recording else 0.0
    tried = (lags >= smallest_delay_s * rate_hz) & (overlap >= _REPEAT_SHORTEST_S * rate_hz)
    if not tried.any():
        return None
    # |a − b|² of unit vectors is 2 − 2·a·b.
    mean_square = np.where(tried, 2 - 2 * products / np.maximum(overlap, 1), np.inf)
    best = int(np.argmin(mean_square))
    repeat = Repeat(int(lags[best]), int(overlap[best]))
    largest_rad = _REPEAT_STEPS * max(resolution_rad, _SMALLEST_RESOLUTION_RAD)
    moved = first[:, : repeat.samples].std(axis=1).max()
    is_same = mean_square[best] <= largest_rad**2
    return repeat if is_same and moved >= _REPEAT_MOTION else None
