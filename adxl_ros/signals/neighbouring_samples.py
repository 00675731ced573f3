# SPDX-License-Identifier: Apache-2.0

"""
Faults between neighbouring samples, which means over a rest do not show.

They are readings that stand for several samples each, the rows of several sensors in turn, counts
that wrap at the end of their range, readings that jump from one rest to another at once, single
wrong samples, and rows that are means of rests.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from adxl_ros.model.constants import G0_MPS2, MAD_TO_STD, TINY
from adxl_ros.wording import usage
import numpy as np
from scipy.special import erfc

_FEWEST_RUNS = 20
"""Fewest runs of equal samples that are judged. Chosen: at most half of the runs of a reading that
repeats by chance have an even length, so that twenty of them never do."""
_REGULAR_SHARE = 0.9  # Share of the runs that have the common length. Chosen: some are cut
_MOST_REPEATS = 64  # Most samples that one reading stands for. Chosen: 1 kHz of a sensor at 16 Hz
_EVEN_RUNS = 0.4
"""Scatter of the lengths of runs by their mean, up to which a slower clock makes them: lengths of
one and two in turn have 0.33, and chance has at least 0.58 about the same mean."""
_ONE_CODE = 1.5  # Change by more than one code, in codes: halfway to two
_FEWEST_EVEN = 1.45  # Mean length of such runs: below, single readings are repeated

_PHASES = (2, 3, 4)  # Numbers of sensors whose rows alternate
_WINDOW = 96  # Samples in which rows are compared: a multiple of all these numbers. Chosen: quick
_TWO_VALUES = 2.0
"""Distance of the means of two rows, by the scatter within each, from which both are seen as two
values: two normal distributions in equal parts have two maxima from there on."""
_MEAN_STDS = 6.0  # Distance of two means, in their standard deviations, that is no chance

_RANGES_G = (4.0, 8.0, 16.0, 32.0, 64.0)  # Whole ranges of digital sensors: ±2 g to ±32 g
_FEWEST_BITS = 6  # Fewest bits of a digital sensor: noise that fills fewer codes is at rest
_FEWEST_WRAPS = 3  # Fewest jumps across the range. Chosen: a single one may be a shock
_CLIPPED = 3  # Most samples at the end of a range that does not clip. Chosen: by chance one is
_FILLED = 0.005  # Largest distance of the samples from both ends of a range that they fill, by it
_ROUNDING = 1e-3  # Relative error of a resolution that is found among rounded values
_BIN_G = 0.05  # Width of the bins of steps, g. Chosen: fine enough
_LARGEST_STEP_G = 70.0  # End of the bins of steps, g. Chosen: above twice the range of ±32 g

_TURN_RAD_PER_S = np.radians(2000.0)
"""Fastest turn of a sensor, rad/s: the range of common gyroscopes, and above any hand or robot."""
_MOST_TURNS = 2  # Most jumps of a sensor that was turned over: there, and back
_SIDE = 8  # Samples on either side of a jump that must be steady. Chosen: a knock rings longer
_NEAREST = 3  # Samples on either side whose mean is compared
_STEADY = 0.2  # Largest step among them, by the jump. Chosen: noise and slow motion are smaller
_SMALLEST_JUMP_G = 0.3  # Smallest jump, g. Chosen: 17° of tilt, above any offset of the sensor

_FEWEST_MEANS = 4  # Fewest rows that are means of rests. Chosen: zero-g needs as many
_OFF_LENGTH_G = 0.15  # Largest deviation of a mean from 1 g, g. Chosen: above most zero-g
_SMALLEST_TURN_COS = np.cos(np.radians(10.0))
"""Cosine of the turn from one mean to the next. Chosen: far above that between two samples."""
_SHARE_OF_MEANS = 0.8  # Share of the rows for which both hold. Chosen: poses may come twice

_FEWEST_SPIKES = 3  # Fewest single wrong samples. Chosen: as with counts that wrap
_ALIKE_SIZE = 0.75
"""Size from which another sample deviates as much as a spike, by the spike. The neighbours of a
spike deviate by half of it, and it itself by all of it: the middle."""
_SPIKE_STDS = 6.0
"""Deviation of a spike, in standard deviations of the others. Chosen: normal noise exceeds it on
one of three axes once in 2·10⁸ samples."""
_NOISE_STDS = 4.0
"""Largest deviation of steady samples, in the same. Chosen: of 15 samples on three axes one in 400
is beyond."""
_CODE_STD = 0.5
"""The least that noise counts, in codes: a change by one or two codes is then no spike."""
_BINS_PER_OCTAVE = 8  # Bins of the sizes of deviations. Chosen: a width of 9 %
_SMALLEST_BIN_MPS2 = 1e-6  # Deviations below this are rounding, m/s²: that of six decimals
_SIZE_BINS = 40 * _BINS_PER_OCTAVE  # Number of these bins: up to 1e6 m/s²


class _Jump(NamedTuple):
    """A step from one steady part to another."""

    time_s: float
    size_mps2: float
    is_held: bool  # Whether one side alone repeats a reading exactly


class NeighbouringSamples:
    """Looks at neighbouring samples of a stream, in blocks of any length."""

    def __init__(self, axes: str, rate_hz: float) -> None:
        self._axes = axes
        self._rate_hz = rate_hz
        self._left = np.zeros((0, len(axes)))  # Newest samples, which later ones are compared with
        self._left_s = np.zeros(0)
        self._run = 1  # Length of the newest run of equal samples
        self._runs = np.zeros(4 * _MOST_REPEATS, int)  # Number of runs by their length
        self._wide = 0  # Changes by more than one code, as slow motion of coarse codes has none
        self._windows = 0  # Windows that were compared
        self._alternating = dict.fromkeys(_PHASES, 0)  # Those in which rows alternate
        self._distance_mps2 = dict.fromkeys(_PHASES, 0.0)  # Largest distance of their means
        self._ends = [_Ends() for _ in axes]
        self._rows = 0  # Rows with one before
        self._like_means = 0  # Those as long as gravity, and turned away from the one before
        self._jumps: list[_Jump] = []
        self._spike_s: list[float] = []  # Times of single samples away from steady ones, s
        self._spike_mps2: list[float] = []  # Their largest deviation of an axis, m/s²
        self._beside_mps2: list[float] = []  # What deviates most beside each, m/s²
        # Number of samples by axis and how much they deviate from the mean of their neighbours
        self._deviations = np.zeros((len(axes), _SIZE_BINS), int)

    def feed(self, time_s: np.ndarray, samples: np.ndarray) -> None:
        """Add samples, m/s², (n, m), with their stamps, s, (n,)."""
        finite = np.isfinite(samples).all(axis=1)
        time_s = time_s[finite]
        samples = samples[finite]
        if not len(samples):
            return
        joined = np.concatenate([self._left, samples])
        joined_s = np.concatenate([self._left_s, time_s])
        with_last = joined[max(len(self._left) - 1, 0) :]
        for ends, values in zip(self._ends, with_last.T):
            ends.feed(values)
        self._count_runs(with_last)
        self._count_means(with_last)
        self._compare_rows(samples)
        # The sides of the last samples come with the next block.
        self._find_jumps(joined_s, joined)
        self._find_spikes(joined_s, joined)
        self._left = joined[1 - 2 * _SIDE :]
        self._left_s = joined_s[1 - 2 * _SIDE :]

    def faults(self) -> list[str]:
        """Return what is wrong, one line each."""
        if self.are_means:
            return [
                f'{self._like_means} of {self._rows} rows are as long as gravity and turned by '
                'more than 10° from the row before: each is the mean of a rest; '
                f'{usage("fit", means=True)} reads them'
            ]
        # A value that wraps for one sample stands alone as well.
        found = (
            # Of readings that stand for two samples, every other row is nearer to the one before.
            self._repeats() or self._alternates(),
            self._wraps() or self._spikes(),
            self._jumped(),
        )
        return [text for text in found if text]

    def _count_runs(self, samples: np.ndarray) -> None:
        """Count runs of samples that are equal on all axes; the first sample is counted before."""
        changes = np.abs(np.diff(samples, axis=0))
        begins = 1 + np.flatnonzero((changes != 0).any(axis=1))
        codes = np.array([ends.step_mps2 for ends in self._ends])
        self._wide += int((changes > _ONE_CODE * codes).any(axis=1).sum())
        if not len(begins):
            self._run += len(samples) - 1
            return
        lengths = np.append(self._run + begins[0] - 1, np.diff(begins))
        self._run = len(samples) - int(begins[-1])
        self._runs += np.bincount(lengths.clip(max=len(self._runs) - 1), minlength=len(self._runs))

    def _count_means(self, samples: np.ndarray) -> None:
        """Count rows as long as gravity whose direction is not that of the one before."""
        length_mps2 = np.maximum(np.linalg.norm(samples, axis=1), TINY)
        directions = samples / length_mps2[:, None]
        turned = np.sum(directions[1:] * directions[:-1], axis=1) < _SMALLEST_TURN_COS
        is_gravity = np.abs(length_mps2[1:] / G0_MPS2 - 1) < _OFF_LENGTH_G
        self._rows += len(turned)
        self._like_means += int(np.sum(turned & is_gravity))

    @property
    def are_means(self) -> bool:
        """Whether each row is the mean of a rest."""
        fewest = max(_FEWEST_MEANS, _SHARE_OF_MEANS * self._rows)
        return len(self._axes) == 3 and self._like_means >= fewest and not self._alternates()

    def _repeats(self) -> str:
        """Return how often each reading stands, where that is no chance."""
        count = int(self._runs.sum())
        lengths = np.arange(len(self._runs))
        if count < _FEWEST_RUNS:
            return ''
        mean = float((lengths * self._runs).sum() / count)
        scatter = float(np.sqrt((self._runs * (lengths - mean) ** 2).sum() / count))
        regular = [
            n
            for n in range(2, _MOST_REPEATS + 1)
            if self._runs[n::n].sum() >= _REGULAR_SHARE * count
        ]
        is_even = mean >= _FEWEST_EVEN and scatter <= _EVEN_RUNS * mean
        if regular:
            mean = float(regular[-1])
        elif not is_even or 2 * self._wide < count:
            return ''
        return (
            f'each reading stands for {mean:.3g} samples: the sensor has '
            f'{self._rate_hz / mean:.4g} readings a second, and the file {self._rate_hz:.4g}; '
            'record each reading once'
        )

    def _compare_rows(self, samples: np.ndarray) -> None:
        """Compare every second, third and fourth row within windows of some rows."""
        count = len(samples) // _WINDOW
        windows = samples[: count * _WINDOW].reshape(count, _WINDOW, samples.shape[1])
        self._windows += count
        # Beside the mean of its neighbours a row shows its sensor, and no slow motion.
        beside = windows - (np.roll(windows, 1, axis=1) + np.roll(windows, -1, axis=1)) / 2
        for phases in _PHASES if count else ():
            shape = (count, _WINDOW // phases, phases, samples.shape[1])
            parts = beside.reshape(shape)[:, 1:-1]  # The first row of a window has none before it
            means = parts.mean(axis=1)  # (count, phases, m)
            within = np.sqrt(((parts - means[:, None]) ** 2).mean(axis=(1, 2)))
            distance = np.ptp(means, axis=1)
            smallest = np.maximum(_TWO_VALUES, _MEAN_STDS * np.sqrt(2 * phases / _WINDOW)) * within
            apart = ((distance > smallest) & (distance > 0)).any(axis=1)
            self._alternating[phases] += int(apart.sum())
            between = np.ptp(windows.reshape(shape).mean(axis=1), axis=1)
            self._distance_mps2[phases] = max(
                self._distance_mps2[phases], float(between[apart].max(initial=0.0))
            )

    def _alternates(self) -> str:
        """Return after how many rows the readings come back, where they alternate."""
        for phases in _PHASES:
            if 2 * self._alternating[phases] > self._windows > 0:
                return (
                    f'rows alternate between {phases} values up to '
                    f'{self._distance_mps2[phases]:.3g} m/s² apart: {phases} sensors in one '
                    f'file, or a disturbance at 1/{phases} of the sample rate; separate them'
                )
        return ''

    def _wraps(self) -> str:
        """Return on which axis counts wrap at the end of their range."""
        return next(
            (
                f'{name} {text}'
                for name, ends in zip(self._axes, self._ends)
                if (text := ends.wraps())
            ),
            '',
        )

    def _find_jumps(self, time_s: np.ndarray, samples: np.ndarray) -> None:
        """Find steps from one steady part to another that no turn explains."""
        size = np.linalg.norm(np.diff(samples, axis=0), axis=1)
        # Steps whose both sides are known; those before were found in the block before.
        both = size[_SIDE - 1 : len(size) - _SIDE + 1]
        places = _SIDE - 1 + np.flatnonzero(both > _SMALLEST_JUMP_G * G0_MPS2)
        for i in places.tolist():
            left = size[i - _SIDE + 1 : i].max()
            right = size[i + 1 : i + _SIDE].max()
            if max(left, right) > _STEADY * size[i]:
                continue
            before = samples[i - _NEAREST + 1 : i + 1].mean(axis=0)
            after = samples[i + 1 : i + 1 + _NEAREST].mean(axis=0)
            step_s = max(float(time_s[i + 1] - time_s[i]), 1 / self._rate_hz)
            if _turn_rad(before, after) > _TURN_RAD_PER_S * step_s:
                is_held = bool((left == 0) != (right == 0))
                self._jumps.append(_Jump(float(time_s[i]), float(size[i]), is_held))

    def _jumped(self) -> str:
        """Return where the readings jump from one rest to another."""
        # Rests that were cut out of a recording and joined jump at each of their ends.
        if not 0 < len(self._jumps) <= _MOST_TURNS:
            return ''
        jump = self._jumps[0]
        what = (
            'one steady value to another, faster than a sensor turns: it was turned over, '
            'exchanged or read in another way'
        )
        if jump.is_held:
            what = 'or to a reading that is repeated: the driver or the bus stood still'
        return (
            f'the readings jump by {jump.size_mps2 / G0_MPS2:.3g} g at {jump.time_s:.6g} s from '
            f'{what}; use the parts'
        )

    def _find_spikes(self, time_s: np.ndarray, samples: np.ndarray) -> None:
        """
        Find single samples that differ from steady ones on both sides by the same step.

        No force does that: it would leave a change of velocity behind, which motion afterwards
        takes back.
        """
        if len(samples) < 2 * _SIDE:
            return
        between = (samples[:-2] + samples[2:]) / 2
        deviation = np.abs(samples[1:-1] - between)
        # Samples whose both sides are known; those before were judged in the block before.
        known = slice(_SIDE - 1, len(deviation) - _SIDE + 2)
        for counts, sizes in zip(self._deviations, deviation[known].T):
            counts += np.bincount(_bin_of(sizes), minlength=_SIZE_BINS)
        noise_mps2 = self._noise_mps2()
        size_mps2 = deviation.max(axis=1)
        across = (np.abs(samples[2:] - samples[:-2]) - _NOISE_STDS * noise_mps2).max(axis=1)
        is_large = (deviation > _SPIKE_STDS * noise_mps2).any(axis=1)
        stands_out = is_large & (across < _STEADY * size_mps2)
        # Spikes nearby are no unsteadiness of the samples around one.
        others = samples.copy()
        others[1:-1][stands_out] = between[stands_out]
        left = (np.abs(np.diff(others, 2, axis=0)) / 2 - _NOISE_STDS * noise_mps2).max(axis=1)
        for i in (_SIDE + np.flatnonzero(stands_out[known])).tolist():
            beside_mps2 = float(left[i - _SIDE : i + _SIDE - 1].max())
            if beside_mps2 < _STEADY * size_mps2[i - 1]:
                self._spike_s.append(float(time_s[i]))
                self._spike_mps2.append(float(size_mps2[i - 1]))
                self._beside_mps2.append(beside_mps2)

    def _noise_mps2(self) -> np.ndarray:
        """Return the standard deviation of the deviations so far, but for few, m/s², (m,)."""
        below = self._deviations.cumsum(axis=1)
        middle = 1 + np.argmax(2 * below >= below[:, -1:], axis=1)
        noise = MAD_TO_STD * _SMALLEST_BIN_MPS2 * 2 ** (middle / _BINS_PER_OCTAVE)
        codes = np.array([ends.step_mps2 for ends in self._ends])
        return np.maximum(noise, _CODE_STD * np.where(np.isfinite(codes), codes, 0.0))

    def _spikes(self) -> str:
        """Return how many single samples are wrong; shocks deviate for more than one sample."""
        count = len(self._spike_s)
        if count < _FEWEST_SPIKES:
            return ''
        size_mps2 = float(np.median(self._spike_mps2))
        alike_mps2 = _ALIKE_SIZE * size_mps2
        noise_mps2 = self._noise_mps2()
        alike = self._deviations[:, _bin_of(alike_mps2) :].sum(axis=1)
        by_noise = self._deviations.sum(axis=1) * erfc(alike_mps2 / noise_mps2 / np.sqrt(2))
        if (alike - by_noise).max() > 2 * count:
            return ''
        beside_mps2 = float(np.median(self._beside_mps2))
        shown_g = max(_SPIKE_STDS * noise_mps2.max(), beside_mps2 / _STEADY) / G0_MPS2
        return (
            f'{count} single samples stand {size_mps2 / G0_MPS2:.3g} g away from those around '
            f'them, the first at {self._spike_s[0]:.6g} s: error values of the bus, a loose '
            f'contact, or shocks shorter than a sample; below about {shown_g:.2g} g not all of '
            'them stand out'
        )


def _bin_of(size_mps2: Any) -> Any:
    """Return the bins of sizes of deviations, m/s²."""
    ratio = np.maximum(size_mps2, _SMALLEST_BIN_MPS2) / _SMALLEST_BIN_MPS2
    return np.minimum(_BINS_PER_OCTAVE * np.log2(ratio), _SIZE_BINS - 1).astype(int)


def _turn_rad(first: np.ndarray, second: np.ndarray) -> float:
    """Return the angle between two forces, (m,), rad; 0 where their lengths differ: no turn."""
    lengths = np.linalg.norm([first, second], axis=1)
    if lengths.min() < (1 - _STEADY) * lengths.max():
        return 0.0
    return float(np.arccos(np.clip(first @ second / lengths.prod(), -1.0, 1.0)))


class _Ends:
    """The ends of the range of one axis, and the steps between its neighbouring samples."""

    def __init__(self) -> None:
        # Largest value of minus the samples and of the samples, m/s², and number of samples there
        self._largest_mps2 = [-np.inf, -np.inf]
        self._at_end = [0, 0]
        self.step_mps2 = np.inf  # Smallest change
        self._sizes = np.zeros(int(_LARGEST_STEP_G / _BIN_G) + 1, int)  # Number of steps by size

    def feed(self, values: np.ndarray) -> None:
        """Add values, m/s², (n,); the first one ends those before."""
        steps = np.abs(np.diff(values))
        self.step_mps2 = min(self.step_mps2, float(steps[steps > 0].min(initial=np.inf)))
        bins = (steps / (_BIN_G * G0_MPS2)).astype(int).clip(max=len(self._sizes) - 1)
        self._sizes += np.bincount(bins, minlength=len(self._sizes))
        for side, signed in enumerate((-values, values)):
            largest = float(signed.max())
            if largest > self._largest_mps2[side]:
                self._largest_mps2[side] = largest
                self._at_end[side] = 0
            self._at_end[side] += int((signed == self._largest_mps2[side]).sum())

    def wraps(self) -> str:
        """
        Return how counts wrap at the end of a range, after the name of the axis; '' if not.

        Steps within a range get rarer the larger they are. Those of counts that wrap get more
        frequent, because a small step across the end reads as one of nearly the whole range. In
        rough motion only the ends show it: a sensor that reaches both of them clips there.
        """
        low_g = -self._largest_mps2[0] / G0_MPS2
        high_g = self._largest_mps2[1] / G0_MPS2
        if max(self._at_end) > _CLIPPED or not high_g > low_g:
            return ''
        step_g = self.step_mps2 / G0_MPS2
        sizes_g = _BIN_G * np.arange(len(self._sizes))
        bits = max(np.ceil(np.log2((high_g - low_g) / step_g)), _FEWEST_BITS)
        by_counts_g = step_g * 2.0**bits
        for range_g in (by_counts_g, *_RANGES_G):
            is_full = sizes_g > 0.75 * range_g
            is_half = sizes_g > 0.5 * range_g
            full = int(self._sizes[is_full].sum())
            half = int(self._sizes[is_half & ~is_full].sum())
            fills = max(abs(low_g + range_g / 2), abs(high_g - range_g / 2)) < _FILLED * range_g
            is_range = high_g - low_g < (1 + _ROUNDING) * range_g
            is_frequent = full >= _FEWEST_WRAPS and (full > half or fills)
            if is_range and is_frequent:
                advice = 'record with a larger range'
                if low_g > -_FILLED * range_g:
                    advice = 'read them as signed numbers'
                return (
                    f'jumps by nearly {range_g:.3g} g between neighbouring samples {full} '
                    f'times: its counts wrap at the end of the range, {low_g:.3g} to '
                    f'{high_g:.3g} g; {advice}'
                )
        return ''
