# SPDX-License-Identifier: Apache-2.0

"""Estimators of the noise floor: noise at rest, differences of repeats, steps of the encoder."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from adxl_ros.diagnose.comparison import BaselineComparison, Reference
from adxl_ros.model import noise
from adxl_ros.model.kinematics import specific_force
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.runs import true_runs
import numpy as np

_REST_S = 1.0
"""Length of a rest whose mean is subtracted, s. Chosen: slower changes are part of the gap."""
_PARTS_OF_REST = 4
"""Parts into which a rest is divided for the interval of the noise. Chosen: a part is longer than
the correlation of its samples."""
_MOST_PARTS = 100
"""Parts from which an interval is drawn at most. Chosen: 100 parts show their spread to 7 %."""
_FEWEST_PARTS = 20
"""Fewest parts of an interval. Chosen: 20 parts show their spread to 16 %."""
FEWEST_SAMPLES = 200
"""Fewest samples of an estimate. Chosen: 5 % of the standard deviation."""
_REPEAT_SHORTEST_S = 20.0
"""Shortest repeat of a trajectory, s. Chosen: a few moves."""
_REPEAT_DELAY_S = 10.0
"""Smallest delay of a repeat in the same recording, s. Chosen: beyond the correlation of a move
with itself."""
_REPEAT_STEPS = 5.0
"""Largest rms angle between the directions of two repeats, in steps of the encoder. Chosen:
several times the rounding of both."""
_RATE_TOLERANCE = 1e-3
"""Largest relative difference of the sample rates of two repeats. Chosen: 20 ms in 20 s."""
_SMALLEST_RESOLUTION_RAD = 1e-5
"""Smallest step of the encoder that is assumed for repeats, rad. Chosen: rounding errors of
stated angles."""
_REPEAT_MOTION = 0.05
"""Smallest standard deviation of the direction of gravity in a repeat, rad. Chosen: above the
changes of a rest."""


@dataclass(frozen=True)
class NoiseFloor:
    """Rms of what no model can predict, over samples and measured axes."""

    noise_v: np.ndarray  # Standard deviation of the samples about their mean, V, (m,)
    rms_mps2: float  # Noise and the steps of the stage's encoder, m/s²
    # 'still' for rests, 'repeats' of a trajectory, or 'assumed' from the parameter file
    source: str
    # Sum of the squares of noise and steps, mean over axes, (m/s²)², and number of samples, by
    # part of the recordings, (2, k). Without columns where the floor is assumed.
    parts: np.ndarray

    def draws_mps2(self, seed: int, draws: int) -> np.ndarray | None:
        """
        Return the floor from parts drawn with replacement.

        returns: rms, m/s², (n,); None where the floor is assumed, or from a few parts.
        """
        count = self.parts.shape[1]
        if count < _FEWEST_PARTS:
            return None
        edges = np.linspace(0, count, min(count, _MOST_PARTS) + 1).astype(int)[:-1]
        squares, samples = np.add.reduceat(self.parts, edges, axis=1)
        drawn = np.random.default_rng(seed).integers(0, len(edges), (draws, len(edges)))
        return np.sqrt(squares[drawn].sum(axis=1) / samples[drawn].sum(axis=1))


@dataclass(frozen=True)
class SquareSum:
    """A sum of squares and its number of samples."""

    squares_v2: np.ndarray  # Sum over samples by axis, V², (m,)
    count: int  # Number of samples


def estimate(comparisons: Sequence[BaselineComparison]) -> NoiseFloor:
    """
    Estimate the noise floor from rests, else from repeats, else from the parameter file.

    The noise at rest is that about the mean of each second. The mean square of the encoder's steps
    is added.
    """
    baseline = comparisons[0].sensor
    sums = [part for c in comparisons for part in squares_at_rest(
        c.volts, c.at_rest & c.used, c.sensor)]
    source = 'still'
    if sum(part.count for part in sums) < FEWEST_SAMPLES:
        sums, source = _repeat_squares(comparisons), 'repeats'
    count = sum(part.count for part in sums)
    if count < FEWEST_SAMPLES:
        sums, noise_v, source = [], noise.sample_std_v(baseline), 'assumed'
    else:
        noise_v = np.sqrt(np.sum([part.squares_v2 for part in sums], axis=0) / count)
    encoder = float(np.mean([_encoder_mean_square(c) for c in comparisons]))
    scale_v_per_mps2 = comparisons[0].scale_v_per_mps2
    parts = np.array([(np.mean(part.squares_v2 / scale_v_per_mps2 ** 2) + part.count * encoder,
                       part.count) for part in sums]).reshape(-1, 2).T
    noise_mps2 = noise_v / scale_v_per_mps2
    return NoiseFloor(noise_v, float(np.sqrt(np.mean(noise_mps2 ** 2) + encoder)), source, parts)


def _repeat_squares(comparisons: Sequence[BaselineComparison]) -> list[SquareSum]:
    """Return the squares of the differences between repeats of a trajectory on the stage."""
    staged = [c for c in comparisons if c.reference is Reference.STAGE]
    oriented = [directions(c.motion.alpha(c.time_s), c.motion.beta(c.time_s)) for c in staged]
    out: list[SquareSum] = []
    for i, first in enumerate(staged):
        for j, second in enumerate(staged[i:], i):
            rate_hz = first.sensor.rate_hz
            if abs(rate_hz / second.sensor.rate_hz - 1) > _RATE_TOLERANCE:
                continue
            repeat = find_repeat(oriented[i], oriented[j], rate_hz,
                                 first.sensor.stage_resolution_rad, i == j)
            if repeat is not None:
                used = first.used[repeat[0]] & second.used[repeat[1]]
                out += squares_of_difference(
                    first.residual_v(first.sensor)[repeat[0]][used],
                    second.residual_v(second.sensor)[repeat[1]][used], rate_hz)
    return out


def _encoder_mean_square(comparison: BaselineComparison) -> float:
    """Return the mean square that the steps of the encoder make in a recording, (m/s²)²."""
    if comparison.reference is not Reference.STAGE or not comparison.sensor.stage_resolution_rad:
        return 0.0
    motion, time_s, used = comparison.motion, comparison.time_s, comparison.used
    return encoder_mean_square(motion.alpha(time_s)[used], motion.beta(time_s)[used],
                               comparison.sensor)


def squares_at_rest(volts: np.ndarray, at_rest: np.ndarray, sensor: Sensor) -> list[SquareSum]:
    """
    Sum the squares about the mean of each second at rest.

    volts: output, V, (n, m); at_rest: samples that rest and are used, (n,) bool.
    """
    length = max(round(_REST_S * sensor.rate_hz), 4)
    # The mean of correlated samples takes more out of their variance than one sample.
    independent = length / float(noise.effective_samples(length, 1 / sensor.rate_hz,
                                                         sensor.rc_s))
    squares = []
    for begin, end in true_runs(at_rest):
        for first in range(begin, end - length + 1, length):
            part = volts[first:first + length]
            squares_v2 = (part - part.mean(axis=0)) ** 2 * length / (length - independent)
            squares += [SquareSum(piece.sum(axis=0), len(piece))
                        for piece in np.array_split(squares_v2, _PARTS_OF_REST)]
    return squares


def squares_of_difference(first_v: np.ndarray, second_v: np.ndarray, rate_hz: float
                          ) -> list[SquareSum]:
    """
    Sum half of the squares of the difference between two repeats.

    first_v, second_v: residuals of the same trajectory, V, (n, m).
    """
    difference_v = second_v - first_v
    squares_v2 = (difference_v - difference_v.mean(axis=0)) ** 2 / 2
    length = max(round(_REST_S * rate_hz), 1)
    return [SquareSum(part.sum(axis=0), len(part))
            for part in np.split(squares_v2, range(length, len(squares_v2), length))]


def find_repeat(first: np.ndarray, second: np.ndarray, rate_hz: float, resolution_rad: float,
                same_recording: bool) -> tuple[slice, slice] | None:
    """
    Find the shift by which the directions of gravity in two recordings agree best.

    first, second: direction of gravity in the sensor's frame, unit vectors, (3, n) and (3, n').
    """
    shortest = round(_REPEAT_SHORTEST_S * rate_hz)
    smallest_lag = round(_REPEAT_DELAY_S * rate_hz) if same_recording else 0
    size = 2 ** int(np.ceil(np.log2(first.shape[1] + second.shape[1])))
    products = np.fft.irfft((np.conj(np.fft.rfft(first, size))
                             * np.fft.rfft(second, size)).sum(axis=0), size)
    lags = np.arange(smallest_lag, max(second.shape[1] - shortest, smallest_lag))
    overlap = np.minimum(first.shape[1], second.shape[1] - lags)
    lags, overlap = lags[overlap >= shortest], overlap[overlap >= shortest]
    if not len(lags):
        return None
    # |a − b|² of unit vectors is 2 − 2·a·b.
    mean_square = 2 - 2 * products[lags] / overlap
    best = int(np.argmin(mean_square))
    lag, count = int(lags[best]), int(overlap[best])
    moved = first[:, :count].std(axis=1).max()
    if mean_square[best] > (_REPEAT_STEPS * max(resolution_rad, _SMALLEST_RESOLUTION_RAD)) ** 2 \
            or moved < _REPEAT_MOTION:
        return None
    return slice(0, count), slice(lag, lag + count)


def directions(alpha_rad: np.ndarray, beta_rad: np.ndarray) -> np.ndarray:
    """
    Return the direction of gravity in the sensor's frame.

    alpha_rad, beta_rad: angles of the stage, rad, (n,); returns: unit vectors, (3, n).
    """
    return np.array(specific_force(alpha_rad, beta_rad, 1.0))


def encoder_mean_square(alpha_rad: np.ndarray, beta_rad: np.ndarray, sensor: Sensor) -> float:
    """
    Return the mean square that the steps of the encoder make, over samples and axes.

    alpha_rad, beta_rad: angles of the stage, rad, (n,); returns: step²/12 times the squared slope
    of gravity, (m/s²)².
    """
    slopes = gravity_slopes(alpha_rad, beta_rad)[:, :len(sensor.axes)]
    return float(sensor.local_gravity_mps2 ** 2 * sensor.stage_std_rad ** 2
                 * np.mean((slopes ** 2).sum(axis=0)))


def gravity_slopes(alpha_rad: np.ndarray, beta_rad: np.ndarray) -> np.ndarray:
    """
    Return the derivatives of the direction of gravity by the angles of the stage.

    alpha_rad, beta_rad: angles of the stage, rad, (n,); returns: by angle and component in the
    sensor's frame, 1/rad, (2, 3, n).
    """
    sin_alpha, cos_alpha = np.sin(alpha_rad), np.cos(alpha_rad)
    sin_beta, cos_beta = np.sin(beta_rad), np.cos(beta_rad)
    return np.array([[cos_alpha * cos_beta, -cos_alpha * sin_beta, -sin_alpha],
                     [-sin_alpha * sin_beta, -sin_alpha * cos_beta, 0 * sin_alpha]])
