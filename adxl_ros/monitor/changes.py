# SPDX-License-Identifier: Apache-2.0

"""
Changes of a running sensor: how they are found, recorded and diagnosed.

`ChangeTest` tests sequentially whether the mean of a series has changed, with a stated rate of
false alarms. The mean of the newest blocks is compared with the mean of the blocks before, at many
lengths. Such a difference is stationary for white noise, for flicker and for a random walk, as the
Allan deviation is. So each length learns the usual size of its difference from the series itself,
and correlated samples need no model. At rest, this size is at most that of a healthy walk, which
has bounds: a ramp from the beginning would else be learnt as usual, and one that takes hours would
be less than an endless walk. The difference over its usual size follows
Student's t. Its limit divides the permitted false alarms among all comparisons of a day
(Bonferroni), so the rate is at most the stated one.

A change is recorded as one line of JSON, synced before it is reported. A diagnosis runs in a
process of its own, with a budget of time; its files appear whole, and a killed run leaves those
before.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timezone
import json
import os
from pathlib import Path
import time
from typing import NamedTuple

from adxl_ros.errors import one_line, UserError
from adxl_ros.files import parameter_file, recording
from adxl_ros.files.atomic_write import append_line
from adxl_ros.files.recording_columns import ACCEL, Recording
from adxl_ros.model.sensor import Sensor
from adxl_ros.workers import in_background
import numpy as np
import scipy

_DAY_S = 86400.0  # One day, s
_LENGTHS = 14
"""Number of lengths, each twice the one before. Chosen: of blocks of 1 s, 1 s to 2.3 hours: a
drift is then seen that takes half a day."""
_BEFORE = 4
"""Length of the mean before, divided by that of the newest mean. Chosen: white noise of a longer
one adds less than an eighth; flicker grows with it."""
LONGEST_BLOCKS = (1 + _BEFORE) * 2 ** (_LENGTHS - 1)  # Blocks of the longest comparison
_PER_LENGTH = 4
"""Comparisons within a length of the newest mean. Chosen: more find a change a few percent
earlier, and share the false alarms."""
_INDEPENDENT = 2.0
"""Distance of independent differences, in lengths of the newest mean. Chosen: their correlation
ends at one length for white noise; twice that covers flicker."""
_FEWEST = 4
"""Fewest independent differences that give a usual size. Chosen: Student's t has a variance from
three on."""
_MOST = 400
"""Largest number of independent differences in memory. Chosen: 5 % of the limit, and a slow change
of the noise is followed."""
_SMALLEST = 1e-6
"""Smallest usual size of a difference, in the unit of the series; a series without noise has none
of its own."""
_NEVER = 1e300  # Limit that no difference reaches
_RESERVE = 0.5
"""Share of the permitted false alarms that the limits use. Chosen: usual sizes are estimates, and
noise is not quite normal."""
_KINDS = 2  # Kinds of windows: at rest throughout, and with motion. Like is compared with like


class Change(NamedTuple):
    """A change of the mean."""

    channel: int  # Number of the series
    blocks: int  # Number of blocks since the change
    size: float  # Mean after the change minus mean before


def _stride(length: int) -> int:
    """Return the number of blocks from one comparison of a length to the next."""
    return max(1, length // _PER_LENGTH)


class ChangeTest:
    """
    Tests several series, block by block.

    false_alarms_per_day: largest permitted rate, of all series together; block_s: length of a
    block, s; walks: random walk of a healthy series, in its unit a root of a second, by series;
    drifts: standard deviation that such a walk does not exceed, in the unit of the series. Both
    are infinite where every drift is usual.
    """

    def __init__(
        self,
        channels: int,
        false_alarms_per_day: float,
        block_s: float = 1.0,
        walks: Sequence[float] = (np.inf,),
        drifts: Sequence[float] = (np.inf,),
    ) -> None:
        self._channels = channels
        self._block_s = block_s
        self._walks = np.array(walks)
        self._drifts = np.array(drifts)
        comparisons = sum(_DAY_S / block_s / _stride(2**j) for j in range(_LENGTHS))
        # Permitted probability of a false alarm in one comparison
        self._p = min(_RESERVE * false_alarms_per_day / (comparisons * channels), 0.5)
        self._size = LONGEST_BLOCKS + 1
        # Sums up to each block; the place of a block is its number modulo the size.
        self._sums = np.zeros((self._size, channels))
        self._moves = np.zeros(self._size, int)
        self._count = 0
        self._since = np.zeros(channels, int)
        self._squares, self._weights = np.zeros((2, _KINDS, _LENGTHS, channels))
        # Differences that are not learnt yet, in the order of their blocks.
        self._waiting: list[list[tuple[int, int, np.ndarray, np.ndarray]]] = [
            [] for _ in range(_LENGTHS)
        ]

    def add(self, values: np.ndarray, moves: bool) -> list[Change]:
        """Test the next block by its means, (channels,)."""
        last = self._count % self._size
        self._count += 1
        place = self._count % self._size
        self._sums[place] = self._sums[last] + values
        self._moves[place] = self._moves[last] + moves
        alarms: dict[int, int] = {}
        for j in range(_LENGTHS):
            length = 2**j
            if self._count % _stride(length) == 0 and self._count >= (1 + _BEFORE) * length:
                for channel in self._compare(j, length):
                    alarms.setdefault(channel, length)
        return [self._located(channel, length) for channel, length in alarms.items()]

    def restart(self) -> None:
        """Compare no block to come with a block before, but keep the usual sizes."""
        self._begin_again(np.arange(self._channels), self._count)

    def _compare(self, j: int, length: int) -> list[int]:
        """Compare one length, and learn; return the channels that have changed."""
        begin = self._count - (1 + _BEFORE) * length
        now = self._count % self._size
        middle = (self._count - length) % self._size
        first = begin % self._size
        difference = (self._sums[now] - self._sums[middle]) / length - (
            self._sums[middle] - self._sums[first]
        ) / (_BEFORE * length)
        kind = int(self._moves[now] > self._moves[first])
        valid = self._since <= begin
        self._learn(j, length)
        std, factor = self._usual(kind, j)
        limit = factor * std
        if not kind:
            # The variance of the difference of a walk's means is L/3 + 4·L/3 steps.
            walk = self._walks * np.sqrt((1 + _BEFORE) / 3 * length * self._block_s)
            shortest_std, shortest_factor = self._usual(kind, 0)
            drift = np.minimum(walk, self._drifts)
            limit = np.minimum(limit, shortest_factor * np.hypot(shortest_std, drift))
        changed = valid & (np.abs(difference) > limit)
        self._waiting[j].append((self._count, kind, difference, valid & ~changed))
        return np.flatnonzero(changed).tolist()

    def _usual(self, kind: int, j: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the usual size of a difference by series, and the limit of Student's t."""
        weights = self._weights[kind, j]
        freedom = (weights * _stride(2**j) / (_INDEPENDENT * 2**j)).astype(int)
        std = np.sqrt(self._squares[kind, j] / np.maximum(weights, 1.0))
        limit = -scipy.special.stdtrit(freedom.clip(_FEWEST, _MOST), self._p / 2)
        return np.maximum(std, _SMALLEST), np.where(freedom < _FEWEST, _NEVER, limit)

    def _learn(self, j: int, length: int) -> None:
        """Add the differences that are so old that no change can be in them unseen."""
        memory = _MOST * _INDEPENDENT * length / _stride(length)
        waiting = self._waiting[j]
        while waiting and waiting[0][0] <= self._count - (1 + _BEFORE) * length:
            _, kind, difference, usable = waiting.pop(0)
            kept = np.where(usable, 1 - 1 / memory, 1.0)
            self._squares[kind, j] = self._squares[kind, j] * kept + usable * difference**2
            self._weights[kind, j] = self._weights[kind, j] * kept + usable

    def _located(self, channel: int, length: int) -> Change:
        """Find where a mean has changed in the compared blocks; the series begins again there."""
        begin = max(int(self._since[channel]), self._count - (1 + _BEFORE) * length)
        places = np.arange(begin, self._count + 1) % self._size
        sums = self._sums[places, channel] - self._sums[places[0], channel]
        total = len(sums) - 1
        before = np.arange(1, total)
        change = (sums[-1] - sums[1:-1]) / (total - before) - sums[1:-1] / before
        best = int(np.argmax(change**2 * before * (total - before)))
        self._begin_again(np.array([channel]), begin + int(before[best]))
        # After a change of the gain, the residual of motion has another usual size.
        self._squares[:, :, channel] = self._weights[:, :, channel] = 0.0
        return Change(channel, total - int(before[best]), float(change[best]))

    def _begin_again(self, channels: np.ndarray, block: int) -> None:
        """Let series begin at a block; no waiting difference of them is learnt."""
        self._since[channels] = block
        for waiting in self._waiting:
            for _, _, _, usable in waiting:
                usable[channels] = False


NAME = 'changes.jsonl'  # Name of the file
_FIRST_UTC_NS = 10**18
"""Earliest stamp that is UTC, ns: September 2001. Chosen: a simulator begins at 0."""
_NICENESS = 15  # Niceness of the process; chosen: every node of the robot has priority
_BUDGET_S = 300.0  # Longest time of a diagnosis, s; chosen: ten times that of ten minutes at 1 kHz
_REASON_LENGTH = 300  # Most characters of a reason; chosen: one line of diagnostics


@dataclass(frozen=True)
class GapChange:
    """A change of the residual."""

    axis: str  # x, y or z
    quantity: str  # `mean`, or `noise` for the standard deviation within a second
    since_ns: int  # Stamp of the change, ns
    detected_ns: int  # Stamp of its detection, ns
    size: float  # Change of the mean, mg; ratio of the standard deviations

    def text(self) -> str:
        """Return the change in words."""
        if self.quantity == 'mean':
            return f'{self.axis} by {self.size:+.3g} mg'
        return f'noise of {self.axis} by a factor of {self.size:.3g}'


@dataclass(frozen=True)
class DiagnosisInput:
    """What a diagnosis compares."""

    recording: Recording  # Samples, with the references of a stage
    sensor: Sensor  # The baseline
    # Times, s, (k,), and force of a simulator, m/s², (k, 3); None with a stage
    force: tuple[np.ndarray, np.ndarray] | None = None


def iso_time(stamp_ns: int) -> str:
    """Return a stamp, ns, as UTC to the second, such as 2026-11-23T05:00:00Z; else in seconds."""
    if stamp_ns < _FIRST_UTC_NS:
        return f'{stamp_ns * 1e-9:.0f} s'
    return datetime.fromtimestamp(stamp_ns // 10**9, timezone.utc).strftime('%Y-%m-%dT%H:%M:%SZ')


def append(folder: Path, change: GapChange, serial: str) -> None:
    """Append a change to the record of a folder."""
    unit = 'mg' if change.quantity == 'mean' else 'ratio'
    line = json.dumps(
        {
            'serial': serial,
            'axis': change.axis,
            'quantity': change.quantity,
            'size': round(change.size, 6),
            'unit': unit,
            'since': iso_time(change.since_ns),
            'since_ns': change.since_ns,
            'detected_ns': change.detected_ns,
        }
    )
    path = folder / NAME
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with open(path, 'a+b', buffering=0) as file:
            append_line(file, line)
    except OSError as error:
        raise UserError(
            f'{path}: cannot write: {error.strerror}; set output to a folder that can be written'
        ) from None


@dataclass(frozen=True)
class DiagnosisResult:
    """The end of a diagnosis."""

    is_done: bool  # Whether there is a report
    text: str  # The verdict in words, or why there is none
    report: str = ''  # Path of the page; empty without one
    effects: tuple[str, ...] = ()  # Likely effects
    probability: float = 0.0  # Probability of the verdict; 0 without one


class DiagnosisRun:
    """Diagnoses some samples in a process of its own."""

    def __init__(self, folder: Path, given: DiagnosisInput) -> None:
        self._end_s = time.monotonic() + _BUDGET_S
        self._end, self.close = in_background(_diagnose, folder, given)

    @property
    def result(self) -> DiagnosisResult | None:
        """Return the end; None while it runs."""
        if self._end.done():
            error = self._end.exception()
            if error is None:
                return self._end.result()
            reason = one_line(error)[:_REASON_LENGTH]
        elif time.monotonic() < self._end_s:
            return None
        else:
            self.close()
            reason = f'it takes longer than {_BUDGET_S:.0f} s; lower history_s'
        return DiagnosisResult(False, f'no diagnosis: {reason}')


def _diagnose(folder: Path, given: DiagnosisInput) -> DiagnosisResult:
    """Diagnose; write the samples, the baseline, and the files of the diagnosis."""
    from adxl_ros.api.gap import diagnose  # the node itself needs none

    os.nice(_NICENESS)
    folder.mkdir(parents=True, exist_ok=True)
    samples = replace(given.recording, path=str(folder / 'recording.csv'))
    recording.write(samples.path, samples, given.sensor)
    baseline = folder / 'baseline.yaml'
    parameter_file.save(baseline, given.sensor)
    ideal = None
    if given.force is not None:
        time_s, force_mps2 = given.force
        ideal = Recording(
            str(folder / 'reference.csv'),
            time_s,
            dict(zip(ACCEL, force_mps2.T)),
            epoch_ns=samples.epoch_ns,
        )
        recording.write(ideal.path, ideal, given.sensor)
    gap = diagnose(samples, given.sensor, sim=ideal)
    compared = gap.compared.with_params(str(baseline))
    gap = replace(gap, compared=compared)
    page, *_ = gap.save(folder, compared.command(folder / 'again'))
    certain = tuple(effect.name for effect in gap.effects if not effect.rivals)
    likely = tuple(effect.name for effect in gap.effects)
    return DiagnosisResult(True, gap.summary, str(page), certain or likely, gap.probability)
