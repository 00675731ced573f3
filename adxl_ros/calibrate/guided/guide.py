# SPDX-License-Identifier: Apache-2.0

"""What all guides share; a guide leads through the poses of one calibration."""

from __future__ import annotations

from bisect import bisect
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
import math
from typing import NamedTuple

from adxl_ros.calibrate.guided.screen_contents import ScreenRow
from adxl_ros.files.stamps import halves, late_by, stamped_rate_hz
from adxl_ros.files.sweep_journal import JournalEntry, PoseDropped, PoseRecord
from adxl_ros.model.sensor import Sensor, to_nominal_mps2
from adxl_ros.report.quantities import duration
from adxl_ros.signals.rest_detection import RestFinder, Stillness
from adxl_ros.signals.rest_limits import datasheet_noise
from adxl_ros.signals.rest_means import rest_means
from adxl_ros.signals.rest_search import Rest, RestRule
import numpy as np

_REST_WINDOW_S = 1.2
"""Newest samples that stay in memory, s: the rest detection looks at both halves of 1 s."""
_RATE_WINDOW_S = 4.0
"""Newest stamps that stay in memory, s; chosen: halves of it are long against a host's stalls."""
_RATE_ERROR = 0.05
"""Largest relative error of the sample rate; chosen: above the error of any oscillator."""
_SHOWN_S = 0.5  # Newest samples whose mean is shown, s; chosen: steady to read and still quick
_FEWEST_SAMPLES = 20  # Samples that stay at the lowest rates; chosen: they give the rate
_BACK_NS = 1_000_000_000
"""A stamp that is earlier than the one before by more is of another clock, ns; chosen: messages
in wrong order differ by less."""
_KEPT_READINGS = 100_000  # Readings that stay in memory; chosen: 1000 s at 100 Hz
STALE_NS = 60_000_000_000
"""A reading counts for samples up to this far from its stamp, ns; chosen: temperature and supply
hardly change in a minute."""
_CLOCK_OFFSET_S = 2.0
"""Largest offset of the clocks of stage and sensor, s; chosen: above any delay of messages."""
_KEPT_OFFSETS = 20
"""Offsets of the two clocks that stay in memory; chosen: a second of messages at 20 Hz."""
_FEWEST_OFFSETS = 4
"""Offsets of the two clocks that a comparison needs; chosen: one message alone may be late."""
SILENT_S = 3.0
"""The encoder counts as silent after this, s; chosen: several of its longest usual periods."""


def went_back(newest_ns: int | None, stamp_ns: int) -> bool:
    """Return whether stamps go back, since the driver was restarted or a clock was set."""
    return newest_ns is not None and stamp_ns < newest_ns - _BACK_NS


class NewestSamples:
    """The newest 1.2 s of a stream and the stamps of 4 s, and at least twenty of both."""

    def __init__(self, sensor: Sensor) -> None:
        self._sensor = sensor
        self.stamps_ns = np.zeros(0, np.int64)  # (k,)
        self.volts = np.zeros((0, len(sensor.axes)))  # (n, m)

    def feed(self, stamps_ns: np.ndarray, volts: np.ndarray) -> None:
        """Take samples."""
        self.stamps_ns = np.concatenate([self.stamps_ns, stamps_ns])[
            -self._count(_RATE_WINDOW_S) :
        ]
        self.volts = np.concatenate([self.volts, volts])[-self._count(_REST_WINDOW_S) :]

    def stillness(self) -> Stillness | None:
        """Return whether the samples are at rest, by the datasheet's noise; None if too few."""
        stamps_ns = self.stamps_ns[len(self.stamps_ns) - len(self.volts) :]
        dwell = Dwell(self._sensor, int(stamps_ns[0]) if len(stamps_ns) else 0)
        dwell.feed(stamps_ns, self.volts)
        return dwell.stillness()

    def rate_hz(self) -> float:
        """Return the rate of the stamps, Hz; NaN while there are too few of them."""
        if len(self.stamps_ns) < _FEWEST_SAMPLES:
            return math.nan
        return stamped_rate_hz((self.stamps_ns - self.stamps_ns[0]) * 1e-9)

    def rate_fault(self) -> str:
        """Return that the rate is not that of the sensor, for people; '' if it is."""
        if len(self.stamps_ns) < _FEWEST_SAMPLES:
            return ''
        stated_hz = self._sensor.rate_hz
        rates = halves((self.stamps_ns - self.stamps_ns[0]) * 1e-9)
        # Samples that wait while the host stalls come late in one half or the other.
        if not rates.contradict(stated_hz, _RATE_ERROR):
            return ''
        return (
            f'samples are {self.rate_hz():.4g} a second by their stamps, but rate_hz is '
            f'{stated_hz:.4g}; correct the rate of the driver'
        )

    def rows(self, stillness: Stillness | None) -> list[ScreenRow]:
        """Return what the sensor reads at present, for the screen."""
        if not len(self.volts):
            return []
        shown = to_nominal_mps2(self.volts[-self._count(_SHOWN_S) :], self._sensor)
        axes = '  '.join(
            f'{axis} {mean:+.3f} ± {rms:.3f}'
            for axis, mean, rms in zip(self._sensor.axes, shown.mean(axis=0), shown.std(axis=0))
        )
        rate = f'  {self.rate_hz():.0f} Hz' if math.isfinite(self.rate_hz()) else ''
        rows = [ScreenRow('reads', f'{axes} m/s²{rate}')]
        if stillness is not None:
            share = stillness.value / stillness.limit if stillness.limit else 1.0
            rows.append(
                ScreenRow(
                    'rest',
                    stillness.describe_mps2(self._sensor),
                    share,
                    'green' if stillness.at_rest else 'yellow',
                )
            )
        return rows

    def _count(self, seconds: float) -> int:
        return max(round(seconds * self._sensor.rate_hz), _FEWEST_SAMPLES)


class LateStamps:
    """Samples of a stream that are left out, because their stamp steps back."""

    def __init__(self) -> None:
        self._number = 0
        self._newest_ns = 0
        self._largest_ns = 0

    def count(self, stamps_ns: np.ndarray, late_ns: np.ndarray) -> None:
        """Count further stamps, ns, (n,), and by how much they step back, ns, (n,)."""
        if late_ns.any():
            self._number += int(np.count_nonzero(late_ns))
            self._newest_ns = int(stamps_ns[late_ns > 0].max())
            self._largest_ns = max(self._largest_ns, int(late_ns.max()))

    def fault(self, now_ns: int) -> str:
        """Return what was left out, for people, while it is recent; else ''."""
        if not self._number or now_ns - self._newest_ns > _RATE_WINDOW_S * 1e9:
            return ''
        return (
            f'imu/data_raw: left out, samples whose stamp steps back: {self._number} so far, '
            f'by up to {self._largest_ns * 1e-6:.3g} ms; one driver must stamp them in order'
        )


class Readings:
    """Readings of one quantity over time."""

    def __init__(self) -> None:
        self._kept: deque[tuple[int, float]] = deque(maxlen=_KEPT_READINGS)

    def add(self, stamp_ns: int, value: float) -> None:
        """Take a reading; one that is not finite is left out."""
        if math.isfinite(value):
            if self._kept and stamp_ns < self._kept[-1][0]:
                self._kept.clear()
            self._kept.append((stamp_ns, value))

    def mean(self, first_ns: int, last_ns: int) -> float:
        """Average the readings between two stamps, or return the last reading before."""
        begin, end = bisect(self._kept, (first_ns,)), bisect(self._kept, (last_ns, math.inf))
        between = [self._kept[i][1] for i in range(begin, end)]
        if between:
            return float(np.mean(between))
        if end:
            stamp_ns, value = self._kept[end - 1]
            if first_ns - stamp_ns < STALE_NS:
                return value
        return math.nan


class Dwell:
    """Samples from an arrival on, and the rests among them."""

    def __init__(self, sensor: Sensor, arrived_ns: int) -> None:
        self.arrived_ns = arrived_ns
        self._sensor = sensor
        rule = RestRule(datasheet_noise(sensor), learns=False)
        self._finder = RestFinder(sensor.rate_hz, len(sensor.axes), rule)
        self._stamps: list[np.ndarray] = []
        self._volts: list[np.ndarray] = []

    def __len__(self) -> int:
        return sum(map(len, self._stamps))

    def feed(self, stamps_ns: np.ndarray, volts: np.ndarray) -> None:
        """Take samples."""
        new = stamps_ns >= self.arrived_ns
        self._stamps.append(stamps_ns[new])
        self._volts.append(volts[new])
        # From the arrival: float64 seconds since 1970 resolve only 0.2 µs.
        self._finder.feed((stamps_ns[new] - self.arrived_ns) * 1e-9, volts[new])

    def rests(self) -> list[Rest]:
        """Return the rests so far; the last one may still go on."""
        return self._finder.rests() if self._stamps else []

    def full_rest(self, samples: int) -> Rest | None:
        """Return the first rest of at least a number of samples."""
        return next((r for r in self.rests() if r.stop - r.start >= samples), None)

    def stillness(self) -> Stillness | None:
        """Return whether the newest samples are at rest; None while they are too few."""
        return self._finder.stillness()

    def at_rest(self) -> bool:
        """Return whether the newest samples are known to be at rest."""
        stillness = self.stillness()
        return stillness is not None and stillness.at_rest

    def volts(self, rest: Rest) -> np.ndarray:
        """Return the samples of a rest, V, (n, m)."""
        return np.concatenate(self._volts)[rest.start : rest.stop]

    def after(self, stop_ns: int) -> Dwell:
        """Return a dwell with the samples after a stamp, ns."""
        dwell = Dwell(self._sensor, stop_ns + 1)
        dwell.feed(np.concatenate(self._stamps), np.concatenate(self._volts))
        return dwell

    def record(self, pose: int, rest: Rest, samples: int) -> PoseRecord:
        """Average the first samples of a rest."""
        stamps = np.concatenate(self._stamps)
        start = rest.start
        stop = rest.start + samples
        times = (stamps - self.arrived_ns) * 1e-9
        mean, std = rest_means(
            times,
            np.concatenate(self._volts),
            [Rest(start, stop, times[start], times[stop - 1])],
            self._sensor.rate_hz,
            datasheet_noise(self._sensor),
        )
        return PoseRecord(
            pose=pose,
            start_ns=int(stamps[start]),
            stop_ns=int(stamps[stop - 1]),
            samples=samples,
            mean_v=tuple(mean[0].tolist()),
            std_v=tuple(std[0].tolist()),
        )


class EncoderTrack:
    """The newest readings of the encoder, against the stamps of the samples."""

    def __init__(self) -> None:
        self.newest_ns: int | None = None  # Stamp of the newest reading, ns
        self.angles_rad: tuple[float, float] | None = None  # Newest alpha and beta, rad
        # Stamps of the readings minus those of the newest samples, s
        self.offsets_s: deque[float] = deque(maxlen=_KEPT_OFFSETS)

    def read(
        self, stamp_ns: int, alpha_rad: float, beta_rad: float, sample_ns: int | None
    ) -> bool:
        """Take a reading, and the newest stamp of the samples; return whether time went back."""
        if sample_ns is not None:
            self.offsets_s.append((stamp_ns - sample_ns) * 1e-9)
        restarted = went_back(self.newest_ns, stamp_ns)
        self.newest_ns = stamp_ns
        self.angles_rad = (alpha_rad, beta_rad)
        return restarted

    def clock_fault(self) -> str:
        """Return what is wrong with the clock of the encoder, or ''."""
        # The smallest offset is that of the message with the least delay.
        ahead_s = min(self.offsets_s, key=abs) if len(self.offsets_s) >= _FEWEST_OFFSETS else 0.0
        if abs(ahead_s) <= _CLOCK_OFFSET_S:
            return ''
        order = 'ahead of' if ahead_s > 0 else 'behind'
        return (
            f'stage/joint_states is stamped {duration(abs(ahead_s))} {order} imu/data_raw: '
            'stage and sensor must share one clock (use_sim_time for both or for none, or '
            'synchronise their computers)'
        )

    def silence(self, sample_ns: int) -> str:
        """Return one line on the time without readings up to a stamp, ns; '' if it is short."""
        if self.newest_ns is None:
            return 'nothing on stage/joint_states'
        silent_s = (sample_ns - self.newest_ns) * 1e-9
        return f'nothing on stage/joint_states for {silent_s:.0f} s' if silent_s > SILENT_S else ''


class NextPose(NamedTuple):
    """The pose to go to, as it is announced."""

    text: str  # One line for people
    values: Mapping[str, str | float]  # Values for programs, by key
    command_rad: tuple[float, float] | None  # For a stage that turns itself
    newest_ns: int = 0  # Stamp of the newest sample, ns: a command is given after it


class Guide:
    """What all guides share; by itself one without a plan: no pose is open or repeated."""

    moves_itself = False  # Whether a stage turns itself, so that nobody captures

    def __init__(self, sensor: Sensor, accepted: Sequence[PoseRecord]) -> None:
        self.sensor = sensor
        self.accepted = {record.pose: record for record in accepted}  # By number
        self.to_verify: list[PoseRecord] = []  # Poses to take again, to check the mounting
        self.readings = {'temperature': Readings(), 'supply': Readings()}  # °C and V
        self.newest = NewestSamples(sensor)
        self.newest_ns: int | None = None  # Stamp of the newest sample, ns
        self._late = LateStamps()
        self.refusal = self._new_refusal = ''  # Why the newest pose was refused; '' if not

    @property
    def now_ns(self) -> int:
        """Return the stamp of the newest sample, ns; 0 before the first."""
        return self.newest_ns or 0

    @property
    def pose_number(self) -> int:
        """Return the number of the next pose, from 1."""
        return len(self.accepted) + 1

    @property
    def open_poses(self) -> int:
        """Return the number of open poses; 0 where the number of poses is not fixed."""
        return 0

    @property
    def previous(self) -> int | None:
        """Return the number of the previous pose, from 0; None where there is none."""
        return max(self.accepted, default=None)

    def feed(self, stamps_ns: np.ndarray, volts: np.ndarray) -> str:
        """Take samples, ns, (n,), and V, (n, m); return why they are of no use, or ''."""
        if not len(stamps_ns):
            return ''
        if went_back(self.newest_ns, stamps_ns[0]):
            self.newest = NewestSamples(self.sensor)
            self.begin_stream((self.now_ns - int(stamps_ns[0])) * 1e-9)
            self.newest_ns = None
            self._late = LateStamps()
        before_ns = stamps_ns[0] if self.newest_ns is None else self.newest_ns
        late_ns = late_by(np.append(before_ns, stamps_ns))[1:]
        self._late.count(stamps_ns, late_ns)
        # As steps of the time they would end each rest.
        stamps_ns, volts = stamps_ns[late_ns == 0], volts[late_ns == 0]
        if not len(stamps_ns):
            return self._late.fault(self.now_ns)
        self.newest_ns = int(stamps_ns[-1])
        self.newest.feed(stamps_ns, volts)
        if fault := self.newest.rate_fault():
            return fault
        self.take_samples(stamps_ns, volts)
        return self._late.fault(self.newest_ns)

    def begin_stream(self, back_s: float) -> None:
        """Begin again, as the stamps went back by a time."""
        raise NotImplementedError

    def take_samples(self, stamps_ns: np.ndarray, volts: np.ndarray) -> None:
        """Take samples whose stamps go on."""
        raise NotImplementedError

    def redo(self, append: Callable[[JournalEntry], None]) -> str:
        """Forget the previous pose, in the journal first; return a line for people, or ''."""
        number = self.previous
        if number is None:
            return ''
        # The fit must not use the pose, even if it is not taken again.
        append(PoseDropped(number))
        return self.forget(number)

    def skip(self, append: Callable[[JournalEntry], None]) -> str:
        """Leave out the open pose, in the journal first; return a line for people, or ''."""
        raise NotImplementedError

    def forget(self, number: int) -> str:
        """Forget a pose; return a line for people."""
        raise NotImplementedError

    def poses_to_fit(self) -> list[PoseRecord]:
        """Return the poses for the fit: the accepted ones, by number."""
        return [self.accepted[number] for number in sorted(self.accepted)]

    def stillness(self) -> Stillness | None:
        """Return whether the newest samples are at rest; None while they are too few."""
        return self.newest.stillness()

    def refuse(self, reason: str) -> None:
        """Refuse a pose; a new reason is kept for `new_refusal`."""
        if reason != self.refusal:
            self._new_refusal = reason
        self.refusal = reason

    def new_refusal(self) -> str:
        """Return why a pose was refused since the last call, or ''."""
        text = self._new_refusal
        self._new_refusal = ''
        return text

    def tilt_error_rad(self) -> float:
        """Return the expected rms error of alpha and beta, rad; NaN where none shows."""
        return math.nan


def with_ambient(record: PoseRecord, readings: Mapping[str, Readings]) -> PoseRecord:
    """Add temperature and supply to a record."""
    span_ns = record.start_ns, record.stop_ns
    return replace(
        record,
        temperature_c=readings['temperature'].mean(*span_ns),
        supply_v=readings['supply'].mean(*span_ns),
    )


def temperature_fault(accepted: Mapping[int, PoseRecord], now_c: float, span_c: float) -> str:
    """Refuse a pose whose temperature differs from that of the first pose."""
    first_c = next(
        (
            record.temperature_c
            for _, record in sorted(accepted.items())
            if math.isfinite(record.temperature_c)
        ),
        math.nan,
    )
    if not abs(now_c - first_c) > span_c:
        return ''
    return (
        f'temperature moved {abs(now_c - first_c):.1f} °C since the first pose '
        f'({first_c:.1f} to {now_c:.1f} °C), must stay within {span_c:g} °C; wait until '
        'it is back, or finish with the poses so far'
    )
