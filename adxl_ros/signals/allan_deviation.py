# SPDX-License-Identifier: Apache-2.0

"""Overlapping Allan deviation and cell means of a stream of any length, in bounded memory."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
import os
import tempfile
from typing import IO, NamedTuple

from adxl_ros.errors import UserError
from adxl_ros.files.recording_columns import GYRO, Recording
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.block_statistics import gap_s, smallest_change
from adxl_ros.signals.recorded_gravity import RecordingLook
from adxl_ros.signals.recorded_sensor import BeyondRange
from adxl_ros.signals.rest_search import Rest
import numpy as np

_MOST_CELLS = 1 << 17
"""A stream has fewer cells. 24 h at 1 kHz then have cells of 1 s, in which white noise shows; each
halving of the number hides an octave of it, and each doubling takes twice the time."""
_AT_ONCE = 1 << 14
"""Samples that are read at a time: with three axes 400 kB, which stay in the cache of a core."""
_FEWEST_AVERAGES = 3
"""Averages side by side at the longest time: with two there is one difference and no scatter."""
_WINDOW_S = 2.0
"""Shortest window of the standard deviation of a sample, s. It holds the slowest usual filters,
0.3 s, several times; drift of longer windows would count as noise of a sample."""
_LARGEST_END_S = 0.2
"""Longest time beside a rest that is no motion, s: four blocks, which a rest may lose there."""
_FEWEST_SAMPLES = 512
"""Fewest samples at rest: white noise is then known within 10 % at 90 %, with half within 15 %."""
SHORTEST_S = 10.0
"""Shortest rest, s. Bias instability shows from averages of one second on, of which ten are few;
half of it would leave no octave above one second with three averages."""


@dataclass(frozen=True)
class AllanDeviation:
    """The overlapping Allan deviation of a stream; u is its unit."""

    tau_s: np.ndarray  # Averaging times, s, (k,)
    deviation: np.ndarray  # Allan deviation by time and axis, u, (k, m)
    # Number of averages side by side, (k,): the time of the stream divided by `tau_s`
    averages: np.ndarray

    @property
    def relative_error(self) -> np.ndarray:
        """Return the relative standard deviation of a point, (k,) (IEEE Std 952, C.1.6)."""
        return 1 / np.sqrt(2 * (self.averages - 1))


class RunningSums:
    """
    The running sums of a stream, from which its Allan deviation and the means of cells follow.

    They are kept in a temporary file, 8 bytes a sample and axis, so that the memory is bounded.
    """

    def __init__(self, axes: int, file: IO[bytes]) -> None:
        self.count = 0  # Samples so far
        self._file = file
        self._offset = self._sum = np.zeros(axes)
        self._file.write(self._sum.tobytes())

    def feed(self, samples: np.ndarray) -> None:
        """Add the next samples of the stream, (n, m)."""
        if not self.count:
            self._offset = samples[0].copy()
        sums = self._sum + np.cumsum(samples - self._offset, axis=0)
        self._sum = sums[-1]
        self.count += len(samples)
        try:
            self._file.seek(0, os.SEEK_END)
            self._file.write(sums.tobytes())
        except OSError as error:
            raise UserError(
                f'{tempfile.gettempdir()}: cannot be written: {error.strerror}; set '
                'TMPDIR to a larger disk'
            ) from None

    def _sums(self, begin: int, stop: int) -> np.ndarray:
        """Return the sums of the first `begin` to `stop` − 1 samples, (stop − begin, m)."""
        self._file.seek(begin * self._sum.nbytes)
        data = self._file.read((stop - begin) * self._sum.nbytes)
        return np.frombuffer(data).reshape(stop - begin, -1)

    def allan_deviation(self, rate_hz: float) -> AllanDeviation:
        """Return the overlapping Allan deviation at octaves of time, with all overlaps."""
        sizes = 1 << np.arange((self.count // _FEWEST_AVERAGES).bit_length())
        squares = np.zeros((len(sizes), len(self._sum)))
        for octave, size in enumerate(sizes.tolist()):
            number = self.count + 1 - 2 * size
            for begin in range(0, number, _AT_ONCE):
                stop = min(begin + _AT_ONCE, number)
                early = self._sums(begin, stop)
                middle = self._sums(begin + size, stop + size)
                late = self._sums(begin + 2 * size, stop + 2 * size)
                # The sum of `size` samples minus that of the `size` samples before
                difference = late - middle - (middle - early)
                squares[octave] += np.einsum('ij,ij->j', difference, difference) / number
        return AllanDeviation(
            tau_s=sizes / rate_hz,
            deviation=np.sqrt(squares / 2) / sizes[:, None],
            averages=self.count / sizes,
        )

    def cells(self) -> Cells:
        """Return the means of cells whose length is a power of two."""
        size = 1
        while self.count // size >= _MOST_CELLS:
            size *= 2
        # Each part that is read begins at an edge of a cell.
        step = max(_AT_ONCE // size, 1) * size
        parts = []
        for begin in range(0, self.count + 1, step):
            stop = min(begin + step - size + 1, self.count + 1)
            parts.append(self._sums(begin, stop)[::size].copy())
        sums = np.concatenate(parts)
        return Cells(size, self._offset + np.diff(sums, axis=0) / size)


class Cells(NamedTuple):
    """Means of cells of equally many neighbouring samples."""

    size: int  # Samples of a cell
    means: np.ndarray  # Mean of each cell by axis, (k, m)


@dataclass(frozen=True)
class StillStretch:
    """
    The samples of the longest rest; u is their unit.

    It is m/s² for an accelerometer, and rad/s for a gyroscope.
    """

    start_s: float  # Its first stamp, s
    stop_s: float  # Its last stamp, s
    rate_hz: float  # Sample rate by its stamps, Hz
    count: int  # Number of its samples
    allan: AllanDeviation  # Their Allan deviation, u
    step_s: float  # Length of a cell, s
    means: np.ndarray  # Means of the cells by axis, u, (k, m)
    # Standard deviation of a sample within some seconds by axis, u, (m,)
    sample_std: np.ndarray
    resolution: np.ndarray  # Smallest change of a sample by axis, u, (m,)
    recorded_s: float  # Time of the whole recording, s
    motion_s: list[tuple[float, float]]  # Times at which it moves or has long gaps, s, (j, 2)
    beyond_range: str  # Readings of the whole recording beyond the stated range, for people, or ''

    @property
    def span_s(self) -> float:
        """Time of the rest, s."""
        return self.count / self.rate_hz

    @property
    def window_octaves(self) -> int:
        """Return the number of octaves of the Allan deviation that `sample_std` is of."""
        return min(_window_octaves(self.rate_hz), len(self.allan.tau_s))


def _window_octaves(rate_hz: float) -> int:
    return max(int(np.ceil(np.log2(_WINDOW_S * rate_hz))), 1)


def shortest_rest_s(rate_hz: float) -> float:
    """Return the shortest rest that shows noise, from its first to its last sample, s."""
    # Stamps may be rounded by up to half a period.
    return max(SHORTEST_S, _FEWEST_SAMPLES / rate_hz) - 1.5 / rate_hz


@dataclass(frozen=True)
class StillSensors:
    """The longest rest of a recording, of accelerometer and gyroscope."""

    accelerometer: StillStretch
    gyroscope: StillStretch | None  # None where there is none
    gyro_doubt: str = ''  # Why the gyroscope of the recording is left out, for people


def longest_rest(
    read: Callable[[], Iterable[Recording]], nominal: Sensor, first: Recording, look: RecordingLook
) -> StillSensors:
    """
    Find the longest rest of a recording, which is read twice; `look` is fed meanwhile.

    The gyroscope rests where the accelerometer does.
    """
    if len(first) < 2:
        raise UserError(f'{first.path}: {len(first)} samples; record longer')
    first_s = float(first.time_s[0])
    beyond = BeyondRange()
    for block in read():
        look.feed(block)
        beyond.add(block.volts(nominal), nominal)
        last_s = float(block.time_s[-1])
    look.rests.take()
    rest, motion_s = longest_of([found.rest for found in look.rests.detected], first_s, last_s)
    shortest_s = shortest_rest_s(first.rate_hz)
    if rest.span_s < shortest_s:
        raise UserError(
            f'{first.path}: rests for {rest.span_s:.4g} s at most, expected '
            f'{shortest_s:.3g} s at least; record longer, and do not touch the sensor'
        )
    with tempfile.TemporaryFile() as file, tempfile.TemporaryFile() as gyro_file:
        samples = _Samples(first, first.sensor_columns, file)
        turns = _Samples(first, GYRO, gyro_file)
        for block in read():
            samples.feed(block.time_s, block.accel_mps2(nominal), rest)
            gyro_radps = block.gyro_radps
            if gyro_radps is not None:
                is_taken = np.isfinite(gyro_radps).all(axis=1)
                turns.feed(block.time_s[is_taken], gyro_radps[is_taken], rest)
        span_s = last_s - first_s
        accelerometer = samples.stretch(span_s, motion_s, beyond.describe(nominal))
        if not turns.count:
            return StillSensors(accelerometer, None)
        if turns.count < accelerometer.count:
            doubt = (
                f'the gyroscope has {turns.count} readings at rest, and the accelerometer '
                f'{accelerometer.count}: it is left out'
            )
            return StillSensors(accelerometer, None, doubt)
        try:
            return StillSensors(accelerometer, turns.stretch(span_s, motion_s, ''))
        except UserError as error:
            return StillSensors(accelerometer, None, f'the gyroscope is left out: {error}')


def longest_of(
    rests: Sequence[Rest], first_s: float, last_s: float
) -> tuple[Rest, list[tuple[float, float]]]:
    """
    Return the longest rest, and the times between rests that are long enough to be motion, s.

    Without motion it is as long as the recording, from its first to its last stamp, s.
    """
    rest = max(rests, key=lambda rest: rest.span_s, default=Rest(0, 0, 0.0, 0.0))
    starts_s = [first_s, *(rest.time_stop_s for rest in rests)]
    stops_s = [*(rest.time_start_s for rest in rests), last_s]
    motion_s = [
        (start_s, stop_s)
        for start_s, stop_s in zip(starts_s, stops_s)
        if stop_s - start_s > _LARGEST_END_S
    ]
    if not motion_s and rests:
        rest = replace(rest, time_start_s=first_s, time_stop_s=last_s)
    return rest, motion_s


class _Samples:
    """The undisturbed samples of a rest; those after a gap follow those before it."""

    def __init__(self, first: Recording, names: Sequence[str], file: IO[bytes]) -> None:
        self._path = first.path
        self._rate_hz = first.rate_hz
        self._names = names
        self._phase = RunningSums(len(names), file)
        self._resolution = np.full(len(names), np.inf)
        self._start_s = self._stop_s = 0.0  # Stamps of the first and the newest sample
        self._gaps, self._gaps_s = 0, 0.0  # Number and time of the gaps

    @property
    def count(self) -> int:
        """Return the number of samples so far."""
        return self._phase.count

    def feed(self, time_s: np.ndarray, samples: np.ndarray, rest: Rest) -> None:
        """Add those of samples at stamps, (n, m), that are part of the rest."""
        inside = rest.includes(time_s)
        if not inside.any():
            return
        rows = samples[inside]
        time_s = time_s[inside]
        if not self._phase.count:
            self._start_s = self._stop_s = float(time_s[0])
        steps_s = np.diff(time_s, prepend=self._stop_s)
        gaps_s = steps_s[steps_s > gap_s(self._rate_hz)]
        self._gaps += len(gaps_s)
        self._gaps_s += float(gaps_s.sum())
        self._stop_s = float(time_s[-1])
        changes = np.abs(np.diff(rows, axis=0))
        self._resolution = np.minimum(self._resolution, smallest_change(changes))
        self._phase.feed(rows)

    def stretch(
        self, recorded_s: float, motion_s: list[tuple[float, float]], beyond_range: str
    ) -> StillStretch:
        """Return the samples as a rest; refuse an axis that never changes."""
        for name, resolution in zip(self._names, self._resolution):
            if not np.isfinite(resolution):
                raise UserError(
                    f'{self._path}: {name} never changes from '
                    f'{self._start_s:.4g} s to {self._stop_s:.4g} s; the axis is '
                    'stuck, or not connected'
                )
        count = self._phase.count
        steps_s = self._stop_s - self._start_s - self._gaps_s
        rate_hz = (count - 1 - self._gaps) / steps_s
        allan = self._phase.allan_deviation(rate_hz)
        cells = self._phase.cells()
        # The variance within 2^k samples is that of the octaves of Haar's wavelets in it.
        octaves = _window_octaves(rate_hz)
        variance = (allan.deviation[:octaves] ** 2).sum(axis=0) / 2 / (1 - 0.5**octaves)
        return StillStretch(
            start_s=self._start_s,
            stop_s=self._stop_s,
            rate_hz=rate_hz,
            count=count,
            allan=allan,
            step_s=cells.size / rate_hz,
            means=cells.means,
            sample_std=np.sqrt(variance),
            resolution=self._resolution,
            recorded_s=recorded_s,
            motion_s=motion_s,
            beyond_range=beyond_range,
        )
