# SPDX-License-Identifier: Apache-2.0
"""
A recording beside the simulation of its baseline, on the recording's own reference motion.

Samples are left out where the reference is not known: its cells are empty, or it moves faster
than its readings show. Others are left out because the sensor did not measure: they stand alone,
repeat, or are no numbers. Each kind is counted, with its reason and its size.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cached_property, partial
from typing import Any, NamedTuple

from adxl_ros.files.recording_columns import JOINTS, Recording
from adxl_ros.files.reference_track import LONGEST_MOVE_NS, USUAL_GAPS
from adxl_ros.files.stamps import mean_period_s, stamped_rate_hz
from adxl_ros.model import noise, signal_chain
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import ActsOn
from adxl_ros.model.error_sizes import rms
from adxl_ros.model.kinematics import specific_force
from adxl_ros.model.sensor import Sensor
from adxl_ros.report.quantities import acceleration_text
from adxl_ros.signals.block_statistics import held_values, true_runs
from adxl_ros.signals.stage_angles import SMALLEST_MOTION_G
from adxl_ros.simulate.motion import ForcePath, INTERNAL_RATE_HZ, Motion, Path
from adxl_ros.simulate.recorded_motion import environment_paths, motion_from_references
from adxl_ros.simulate.response import ChainMemo, whole_response
from adxl_ros.simulate.smoothed_path import BAND_LIMITED_DEGREE, visible_step
import numpy as np
import scipy

SEARCH_RATE_HZ = 125.0
"""Rate of the samples in the search, Hz. Chosen: motion up to 60 Hz. Samples are left out, never
averaged, so that aliases remain."""
SEARCH_SAMPLES = 25_000  # Largest number of samples of a recording in the search. Chosen: run time
_LOWEST_INTERNAL_RATE_HZ = 250.0
"""Lowest internal rate of the simulator where something moves, Hz. Chosen: twice the rate of the
search."""
_MOST_STEPS = 1_000_000
"""Largest number of steps of the simulator beyond the samples. Chosen: an hour at that rate."""
_SMALLEST_MOVES = {'alpha': 2e-3, 'beta': 2e-3, 'shift': 1e-6}
"""Ranges of the joints, rad and m, from which they move. Chosen: above the step of an encoder."""
_REST_RATE = 1e-3
"""A joint rests below this rate, rad/s, and the shift below this acceleration, m/s². Chosen: the
specific force then changes by less than the noise within a second."""
SETTLING_S = 0.3
"""A sample rests if no joint moves within this time before it, s. Chosen: an RC filter of 15 Hz
has settled."""
_MOVED_SHARE = 0.5
"""Share of the scatter within a rest that its reference leaves, below which it is motion. Chosen:
noise leaves all of it, and a reference that is in phase less than half."""
_LONGEST_S = 1e3  # Time since the last move where there was none, s. Chosen: beyond any creep
_LONGEST_BRIDGE_S = LONGEST_MOVE_NS / 1e9
"""Longest time without a reading of a joint that is bridged, s: that of a move."""
_SLOWEST_S = 1.0
"""Longest time without a reading of a slow encoder that is bridged, s: a move at most."""
_BEFORE_S = 0.1  # Time left out before a gap, s. Chosen: the spline is uncertain there
_AFTER_S = 0.3  # Time left out after a gap, s. Chosen: an RC filter of 15 Hz has settled
_FEWEST_CHANGES = 100
"""Fewest changes of a reading that show the step of its encoder. Chosen: two turns by hand."""
_LARGEST_STEP_RAD = 0.02  # Largest step of an encoder, rad. Chosen: 1°
_COARSER_STEP_RATIO = 1.05
"""Ratio to the stated step from which one counts. Chosen: 1/12° may be stated as 0.083°."""
_WHOLE_STEPS_TOLERANCE = 0.2
"""Deviation of a change from whole steps, in steps, up to which it is one. Chosen: above the
rounding of written angles, and exact readings stay distinct."""
_FEWEST_WHOLE_SHARE = 0.9
"""Share of such changes by encoders. Chosen: 40 % of the changes of exact readings are such."""
_SAME_POSE = 1e-4  # Change of a joint over a gap without a move, rad or m. Chosen: 0.1 mg
_SAME_STEPS = 2.0
"""Change of a joint over such a gap, steps of its encoder. Chosen: two readings that scatter by
one step."""
_LAG_S = 0.02
"""Lag of differences that show the noise, s. Chosen: an RC filter has forgotten it."""
_STILL_STD_RATIO = 3.0
"""Standard deviation of the output, divided by that noise, up to which it rests. Chosen: motion
below 2 Hz exceeds it."""
_WINDOW_S = 1.0  # Length of a window whose spectrum is taken, s. Chosen: shorter than a move
_SHORTEST_WINDOW = 64  # Its fewest readings. Chosen: some periods of a shaker
_LARGEST_ERROR = 0.3
"""Error of the force by the spline, divided by the noise, up to which a window is used. Chosen: it
adds 4 % to the noise."""
_USUAL_STEP = 1.5  # Largest step between two readings, in medians of all: halfway to two steps
_SAME_MOTION = 2.0
"""Ratio of recorded and simulated motion from which one is an alias. Chosen: an alias below 0.2 of
the rate has a ratio of 4."""
_NAMED_PARTS = 4  # Parts that a note names. Chosen: it stays one or two lines
_FEWEST_WINDOWS = 20
"""Fewest windows by which fading is judged. Chosen: noise then has a coherence of 0.05."""
_BAND_HZ = 2.0  # Width of its bands, Hz. Chosen: a line of the mains is one value
_MOTION_POWER_RATIO = 10.0
"""Power over that of the noise from which motion shows. Chosen: a single ordinate of noise exceeds
it once in e¹⁰, 22 000."""
_FADED_POWER_RATIO = 0.5
"""Power of the reference, even without the filter of the sensor, divided by the recorded one,
below which it has faded. Chosen: −3 dB, the usual corner of a filter."""
_JERK_S = 0.1
"""Time around a jerk of a robot that is left out, s. Chosen: that of the splines' knots."""
_LARGEST_JERK = 4.0
"""Error of the force, divided by the noise, from which it is a jerk. Chosen: the error of what
stays is below the noise, rms, and the filter for errors weighs it."""


@dataclass(frozen=True)
class LeftOut:
    """Samples of a recording that are not compared, for one reason."""

    reason: str  # For people
    samples: int
    duration_s: float
    rms_mps2: float  # Recording minus baseline over them, m/s²; NaN where it is not known
    # Effect of the sensor that they may show, '' where the library has none; None where the sensor
    # measured, and the reference is not known
    effect: str | None = None

    @property
    def squares_mps2(self) -> float:
        """Sum of their squares, mean over axes, (m/s²)²."""
        return float(np.nan_to_num(self.samples * self.rms_mps2**2))

    @property
    def why(self) -> str:
        """Return the reason without its figures."""
        return self.reason.partition(' (')[0]


class Reference(Enum):
    """What determines the motion of a recording; without any the sensor never moves."""

    STAGE = 'stage'
    SIMULATOR = 'sim'
    NONE = 'rest'


@dataclass(frozen=True)
class BaselineComparison:
    """Samples of one recording, n of m axes, and what the simulator needs to follow it."""

    name: str  # Path of the recording, for people
    time_s: np.ndarray  # Stamps, s, (n,)
    volts: np.ndarray  # Output of the sensor, V, (n, m)
    motion: Motion  # Motion of the reference
    # The baseline: datasheet values and effects of the parameter file, at this sample rate
    sensor: Sensor
    reference: Reference  # What determines the motion
    at_rest: np.ndarray  # Samples at which nothing moves, (n,) bool
    # Samples that are used, (n,) bool; the others are missing, repeated or outliers, or their
    # reference is not known
    used: np.ndarray
    # Samples of the sensor that stand alone or repeat, (n,) bool: no motion shows in them
    disturbed: np.ndarray
    notes: tuple[str, ...] = ()  # What was corrected or left out, one line each, for people
    left_out: tuple[LeftOut, ...] = ()  # What is not among `used`, by reason
    # Frequency above which the reference lacks half of the motion's power, Hz; None for none
    fading_hz: float | None = None
    # Signals that simulations of this recording share
    memo: ChainMemo = field(default_factory=ChainMemo, compare=False, repr=False)

    def __len__(self) -> int:
        """Return the number of samples."""
        return len(self.time_s)

    @cached_property
    def dt_s(self) -> float:
        """Mean time between samples, s, without gaps."""
        return mean_period_s(self.time_s)

    @property
    def span_s(self) -> float:
        """Time from the first sample to the last, s."""
        return float(self.time_s[-1] - self.time_s[0])

    @property
    def scale_v_per_mps2(self) -> np.ndarray:
        """Scale factor of the baseline by axis, V/(m/s²), (m,)."""
        return self.sensor.scale_v_per_g / G0_MPS2

    @property
    def pose_known(self) -> bool:
        """Whether a reference determines the motion."""
        return self.reference is not Reference.NONE

    @property
    def stated_force(self) -> ForcePath | None:
        """Force that another simulator or a robot states; None without one."""
        return self.motion.force if isinstance(self.motion.force, ForcePath) else None

    @property
    def simulated_force(self) -> ForcePath | None:
        """Force that another simulator states; None without one."""
        force = self.stated_force
        return None if force is None or force.is_robot else force

    @property
    def robot_force(self) -> ForcePath | None:
        """Force that a robot states by its encoders; None without one."""
        force = self.stated_force
        return force if force is not None and force.is_robot else None

    @property
    def joints(self) -> tuple[Path, Path] | None:
        """Paths of alpha and beta; None without a stage."""
        return (self.motion.alpha, self.motion.beta) if self.reference is Reference.STAGE else None

    def joint_values(self, order: int = 0) -> list[np.ndarray]:
        """Return derivatives of alpha and beta, rad/s^order, (n,) each; none without a stage."""
        return [joint(self.time_s, order) for joint in self.joints or ()]

    @property
    def measured(self) -> np.ndarray:
        """Return which samples are numbers and do not stand alone or repeat, (n,) bool."""
        return np.isfinite(self.volts).all(axis=1) & ~self.disturbed

    @property
    def out_of_range(self) -> np.ndarray:
        """Where measured samples are at a rail or beyond the stated range, (n, m) bool."""
        return self.sensor.saturated(
            np.where(self.measured[:, None], self.volts, self.sensor.nominal_zero_g_v)
        )

    @property
    def surroundings(self) -> dict[str, np.ndarray]:
        """Temperature, °C, and supply, V, at the samples, (n,) each, where they are known."""
        paths = {name: getattr(self.motion, name) for name in ('temperature_c', 'supply_v')}
        return {name: path(self.time_s) for name, path in paths.items() if path is not None}

    def reference_force_g(self) -> np.ndarray | None:
        """Return the specific force of the reference, g, (3, n); None without a reference."""
        if self.reference is Reference.SIMULATOR and self.motion.force is not None:
            return np.array(self.motion.force(self.time_s)) / G0_MPS2
        if self.joints is None:
            return None
        alpha_rad, beta_rad = self.joint_values()
        return np.array(specific_force(alpha_rad, beta_rad, 1.0))

    def simulated_v(self, sensor: Sensor) -> np.ndarray:
        """Return the mean output of a sensor in this recording, V, (n, m)."""
        return whole_response(noiseless(sensor), self.motion, 0, self.time_s, self.memo)

    def residual_v(self, sensor: Sensor) -> np.ndarray:
        """
        Return the recording minus the mean output of a sensor, V, (n, m).

        Without a reference the pose is unknown, and the mean of the residual is subtracted.
        """
        residual_v = self.volts - self.simulated_v(replace(sensor, rate_hz=self.sensor.rate_hz))
        return residual_v if self.pose_known else residual_v - np.nanmean(residual_v, axis=0)

    def simulated_noise_v(self, sensor: Sensor, seed: int) -> np.ndarray:
        """Draw a sensor's output about its own mean, V, (n, m)."""
        at_rate = replace(sensor, rate_hz=self.sensor.rate_hz)
        return self.drawn_v(at_rate, seed) - self.simulated_v(at_rate)

    def drawn_v(self, sensor: Sensor, seed: int) -> np.ndarray:
        """Draw the output of a sensor at this sample rate, V, (n, m)."""
        return whole_response(sensor, self.motion, seed, self.time_s, self.memo)

    @cached_property
    def robot_error_mps2(self) -> float:
        """Rms over used samples and axes that the encoders of a robot leave open, m/s²."""
        force = self.stated_force
        if force is None:
            return 0.0
        errors = [force.errors(self.time_s, AXES.index(axis)) for axis in self.sensor.axes]
        return rms(np.array([e.std[self.used] for e in errors]))

    def lost_motion_mps2(self) -> float:
        """Return the rms of the fast motion that a smooth reference lacks, m/s²."""
        if self.fading_hz is None:
            return 0.0
        residual_v = np.where(self.used[:, None], self.residual_v(self.sensor), 0.0)
        frequency_hz, power = scipy.signal.periodogram(residual_v, self.sensor.rate_hz, axis=0)
        lost = (power - noise.density_v2_per_hz(self.sensor, frequency_hz))[
            frequency_hz > self.fading_hz / 2
        ] / self.scale_v_per_mps2**2
        return float(np.sqrt(max(lost.mean(axis=1).sum() * frequency_hz[1], 0.0)))


def noiseless(sensor: Sensor) -> Sensor:
    """Return the sensor without noise and without the steps of its ADC."""
    mean = tuple(e for e in sensor.effects if effect_named(e).acts_on is ActsOn.MEAN)
    # Without an ADC there are no rails, and pseudo-volts may be negative.
    bits = 48 if sensor.adc_bits else 0
    return replace(
        sensor,
        noise_density_g_per_rthz=np.zeros(len(sensor.axes)),
        adc_bits=bits,
        effects=mean,
        values={e: sensor.values[e] for e in mean},
    )


def with_values(sensor: Sensor, effect: str, values: Mapping[str, Any]) -> Sensor:
    """Return a sensor with changed parameters of an effect; one number stands for all axes."""
    before = sensor.values[effect]
    changed = {name: np.full_like(before[name], value, float) for name, value in values.items()}
    return replace(sensor, values={**sensor.values, effect: {**before, **changed}})


def compare(recording: Recording, sensor: Sensor, sim: Motion | None = None) -> BaselineComparison:
    """Put a recording beside the simulator, at the full rate of the recording."""
    sensor = replace(sensor, rate_hz=recording.rate_hz)
    volts = recording.volts(sensor)
    time_s = recording.time_s
    motion, reference = _motion(recording, sensor, volts, sim)
    if reference is not Reference.NONE:
        motion = replace(
            motion,
            internal_rate_hz=min(
                max(_LOWEST_INTERNAL_RATE_HZ, sensor.rate_hz),
                INTERNAL_RATE_HZ,
                _MOST_STEPS / max(float(np.ptp(time_s)), 1.0),
            ),
        )
    at_rest = _at_rest(motion, time_s, reference, volts / sensor.scale_v_per_g * G0_MPS2)
    # Where another simulator moves from its first sample on, the filter has not settled.
    used = at_rest | (time_s > time_s[0] + SETTLING_S) | (reference is not Reference.SIMULATOR)
    return BaselineComparison(
        recording.path,
        time_s,
        volts,
        motion,
        sensor,
        reference,
        at_rest,
        used,
        np.zeros(len(time_s), bool),
    )


def at_search_rate(comparison: BaselineComparison) -> BaselineComparison:
    """Return every k-th sample of a recording, for the search."""
    span_s = max(comparison.span_s, 1.0)
    rate_hz = comparison.sensor.rate_hz
    motion = comparison.motion
    every = max(1, round(rate_hz / min(SEARCH_RATE_HZ, SEARCH_SAMPLES / span_s)))
    if comparison.pose_known:
        motion = replace(
            motion, internal_rate_hz=min(_LOWEST_INTERNAL_RATE_HZ, _MOST_STEPS / span_s)
        )
    return replace(
        comparison,
        motion=motion,
        memo=ChainMemo(),
        sensor=replace(comparison.sensor, rate_hz=rate_hz / every),
        **{
            name: getattr(comparison, name)[::every]
            for name in ('time_s', 'volts', 'at_rest', 'used', 'disturbed')
        },
    )


def _motion(
    recording: Recording, sensor: Sensor, volts: np.ndarray, sim: Motion | None
) -> tuple[Motion, Reference]:
    """Return the motion of a recording and what determines it."""
    paths: dict[str, Any] = {
        'temperature_c': None,
        'supply_v': None,
        **environment_paths(recording),
    }
    if sim is not None:
        return replace(sim, **paths), Reference.SIMULATOR
    read = {
        joint: values[np.isfinite(values)]
        for joint, name in JOINTS.items()
        if np.isfinite(values := recording.columns.get(name, np.zeros(0))).any()
    }
    if {'alpha', 'beta'} <= {*read} and any(
        np.ptp(values) > _SMALLEST_MOVES[joint] for joint, values in read.items()
    ):
        return motion_from_references(recording, sensor), Reference.STAGE
    # The median output stands for the unknown pose, and the simulator runs at the samples' rate.
    force = signal_chain.inverse(sensor)([float(v) for v in np.nanmedian(volts, axis=0)])
    return Motion(
        float(recording.time_s[-1] - recording.time_s[0]),
        internal_rate_hz=1e-3,
        force=partial(_constant, force),
        **paths,
    ), Reference.NONE


def _constant(force: Sequence[float], time_s: np.ndarray) -> list[np.ndarray]:
    """Return components that stay, at times, (n,)."""
    return [np.full(len(time_s), component) for component in force]


def _at_rest(
    motion: Motion, time_s: np.ndarray, reference: Reference, output_mps2: np.ndarray
) -> np.ndarray:
    """Return which samples rest, (n,) bool."""
    if reference is Reference.NONE:
        return np.ones(len(time_s), bool)
    if reference is Reference.SIMULATOR:
        from adxl_ros.signals.rest_detection import find_rests

        assert motion.force is not None, 'the reference states it'
        # The force of another simulator may be noisy, so that the sensor itself shows its rests.
        finite = np.isfinite(output_mps2).all(axis=1)
        at_rest = np.zeros(len(time_s), bool)
        for rest in find_rests(time_s[finite], output_mps2[finite], stamped_rate_hz(time_s)):
            rows = (time_s >= rest.time_start_s) & (time_s <= rest.time_stop_s)
            output = output_mps2[rows & finite]
            stated = np.array(motion.force(time_s[rows & finite])[: output.shape[1]]).T
            scatter = output.var(axis=0).mean()
            left = (output - stated).var(axis=0).mean()
            # A sensor that always moves has no quiet part that would show what moves.
            at_rest |= rows & (left > _MOVED_SHARE * scatter)
        return at_rest
    rates = [motion.alpha(time_s, 1), motion.beta(time_s, 1), motion.shift(time_s, 2)]
    return time_since_move_s(time_s, rates) > SETTLING_S


def direction_of_last_move(rate: np.ndarray, smallest: float = _REST_RATE) -> np.ndarray:
    """Return the direction of the last move, −1 or 1, 0 before the first, (n,)."""
    return held_values(np.sign(rate), np.abs(rate) > smallest, 0.0)


def time_since_move_s(time_s: np.ndarray, rates: Sequence[np.ndarray]) -> np.ndarray:
    """Return the time since any joint moved."""
    moving = np.any(np.abs(np.array(rates)) > _REST_RATE, axis=0)
    last_s = np.maximum.accumulate(np.where(moving, time_s, -np.inf))
    return np.minimum(time_s - last_s, _LONGEST_S)


def code_step_v(volts: np.ndarray) -> np.ndarray:
    """Return the smallest change of an output on each axis, V; 0 where it never changes."""
    changes_v = np.abs(np.diff(volts, axis=0))
    smallest = np.min(changes_v, axis=0, initial=np.inf, where=changes_v > 0)
    return np.nan_to_num(smallest, posinf=0.0)


def _in_gaps(
    time_s: np.ndarray, read_s: np.ndarray, longest_s: float
) -> Iterable[tuple[int, int]]:
    """
    Yield the samples, begin and end, in gaps between readings that are not bridged.

    Before the first reading and after the last, the ends of the recording count.
    """
    ends_s = np.concatenate([[min(time_s[0], read_s[0])], read_s, [max(time_s[-1], read_s[-1])]])
    for i in np.flatnonzero(np.diff(ends_s) > longest_s):
        yield (
            int(np.searchsorted(time_s, ends_s[i], 'right' if i else 'left')),
            int(
                np.searchsorted(time_s, ends_s[i + 1], 'right' if i > len(read_s) - 1 else 'left')
            ),
        )


def leave_out(
    comparison: BaselineComparison, rows: np.ndarray, reason: str, effect: str | None = None
) -> BaselineComparison:
    """
    Return a comparison that does not use some samples, and notes why, when and how many.

    Samples that are left out for another reason already keep that one.
    """
    rows = rows & comparison.used
    if not rows.any():
        return comparison
    time_s = comparison.time_s
    runs = true_runs(rows)
    residual_v = comparison.residual_v(comparison.sensor)[rows]
    squares = (residual_v / comparison.scale_v_per_mps2)[np.isfinite(residual_v)] ** 2
    left_out = LeftOut(
        reason,
        int(rows.sum()),
        float(comparison.dt_s * rows.sum()),
        float(np.sqrt(squares.mean())) if len(squares) else np.nan,
        effect,
    )
    parts = ', '.join(_span_text(time_s[a], time_s[b - 1]) for a, b in runs[:_NAMED_PARTS])
    if len(runs) > _NAMED_PARTS:
        parts += ', ...'
    note = f'left out: {left_out.samples} samples, {left_out.duration_s:.3g} s ({parts}): {reason}'
    if len(squares):
        note += f'; they differ by {acceleration_text(left_out.rms_mps2)} rms'
    return replace(
        comparison,
        used=comparison.used & ~rows,
        notes=(*comparison.notes, note),
        left_out=(*comparison.left_out, left_out),
    )


def _span_text(begin_s: float, end_s: float) -> str:
    """Return a span of time, or the instant of one sample, for people."""
    return f'{begin_s:.5g} to {end_s:.5g} s' if end_s > begin_s else f'{begin_s:.5g} s'


def bridged(data: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Replace rows, (n, k), that are not used by straight lines between those that are."""
    if used.all() or not used.any():
        return data
    number, kept = np.arange(len(used)), np.flatnonzero(used)
    return np.array([np.interp(number, kept, column[kept]) for column in data.T]).T


def without_gaps(comparison: BaselineComparison) -> BaselineComparison:
    """Leave out samples in gaps of another simulator."""
    time_s, force = comparison.time_s, comparison.stated_force
    if force is None:
        return comparison
    limit_s = max(_LONGEST_BRIDGE_S, USUAL_GAPS * float(np.median(np.diff(force.time_s))))
    unknown = np.zeros(len(time_s), bool)
    for begin, end in _in_gaps(time_s, force.time_s, limit_s):
        if end > begin:
            begin_s, end_s = time_s[begin] - _BEFORE_S, time_s[end - 1] + _AFTER_S
            unknown |= (time_s >= begin_s) & (time_s <= end_s)
    return leave_out(
        comparison, unknown, f'no reading of {force.name} for more than {limit_s:.3g} s'
    )


def stated_poses(
    recording: Recording, sensor: Sensor
) -> tuple[Recording, list[tuple[np.ndarray, str]]]:
    """
    Fill the gaps of the stage's joints, and return the samples at which one is not known, and why.

    A pose that is stated before and after a gap, while the output rests, holds in between. Other
    gaps are left out; exact readings go on in a line, so that their spline stays even.
    """
    output_g = recording.volts(sensor) / sensor.scale_v_per_g
    columns = dict(recording.columns)
    left_out = []
    for joint, name in JOINTS.items():
        readings = columns.get(name, np.zeros(0))
        if np.isfinite(readings).sum() < 2:
            continue
        step = 0.0 if joint == 'shift' else sensor.stage_resolution_rad
        bridges = _Bridges.over(recording, output_g, readings, step)
        columns[name] = bridges.values
        reason = f'no reading of {name} for more than {bridges.limit_s:.3g} s'
        left_out.append((bridges.unknown, reason))
    return replace(recording, columns=columns), left_out


class _Bridges(NamedTuple):
    """The values of one joint over the gaps between its readings."""

    values: np.ndarray  # Readings, and values in the gaps that are bridged, (n,)
    unknown: np.ndarray  # Samples at which the joint is not known, (n,) bool
    limit_s: float  # Longest gap without an effect, s

    @classmethod
    def over(
        cls, recording: Recording, output_g: np.ndarray, readings: np.ndarray, step: float
    ) -> _Bridges:
        """Bridge the gaps of readings, (n,), of an encoder with this step; NaN is none."""
        time_s = recording.time_s
        read = np.isfinite(readings)
        read_s = time_s[read]
        line = np.interp(time_s, read_s, readings[read])
        is_exact = not step or visible_step(readings[read], step) < step
        usual_s = USUAL_GAPS * float(np.median(np.diff(read_s)))
        limit_s = max(_LONGEST_BRIDGE_S, min(usual_s, _SLOWEST_S))
        lag = max(1, round(_LAG_S * recording.rate_hz))
        values = readings.copy()
        unknown = np.zeros(len(time_s), bool)
        for begin, end in _in_gaps(time_s, read_s, _LONGEST_BRIDGE_S):
            is_inner = 0 < begin < end < len(time_s)
            gap_s = time_s[min(end, len(time_s) - 1)] - time_s[max(begin - 1, 0)]
            is_long = gap_s > limit_s
            holds = (
                is_inner
                and _is_still(output_g[begin:end], lag)
                and abs(line[end] - line[begin - 1]) <= _SAME_STEPS * step + _SAME_POSE
            )
            if is_inner and (holds or (is_exact and is_long)):
                values[begin:end] = line[begin:end]
            if is_long and not holds:
                unknown |= (time_s > time_s[begin] - _BEFORE_S) & (
                    time_s < time_s[end - 1] + _AFTER_S
                )
        return cls(values, unknown, limit_s)


def _is_still(output_g: np.ndarray, lag: int) -> bool:
    """Determine whether an output, g, (n, m), neither moves far nor slowly; with NaN as gaps."""
    output_g = output_g[np.isfinite(output_g).all(axis=1)]
    if len(output_g) <= 2 * lag:
        return True
    noise_g = np.sqrt(np.mean((output_g[lag:] - output_g[:-lag]) ** 2, axis=0) / 2)
    return bool(
        np.all(
            output_g.std(axis=0)
            < np.minimum(SMALLEST_MOTION_G, _STILL_STD_RATIO * noise_g) + _SAME_POSE
        )
    )


def seen_step_rad(recording: Recording, sensor: Sensor) -> float:
    """Return the step that the encoders show, where it exceeds the stated one, rad."""
    largest_rad = sensor.stage_resolution_rad
    for name in ('alpha_rad', 'beta_rad'):
        changes = np.abs(np.diff(recording.columns.get(name, np.zeros(0))))
        changes = changes[changes > 1e-9]
        if len(changes) < _FEWEST_CHANGES:
            continue
        step_rad = float(np.median(changes[changes < 1.5 * changes.min()]))
        few = changes[changes < 4.5 * step_rad]
        # Readings with decimals differ by one step more or less exactly.
        step_rad = float(few.sum() / np.rint(few / step_rad).sum())
        whole = np.abs(few / step_rad - np.rint(few / step_rad)) < _WHOLE_STEPS_TOLERANCE
        has_steps = whole.sum() >= _FEWEST_CHANGES and whole.mean() > _FEWEST_WHOLE_SHARE
        if has_steps and _COARSER_STEP_RATIO * largest_rad < step_rad < _LARGEST_STEP_RAD:
            largest_rad = step_rad
    return largest_rad


def _without_jerks(
    comparison: BaselineComparison, force: Any, noise_g: float
) -> BaselineComparison:
    """Leave out samples at which a robot jerks: its encoders do not show its acceleration."""
    error_g = np.abs(force.smoothing_mps2[:, : len(comparison.sensor.axes)]).max(axis=1) / G0_MPS2
    time_s = comparison.time_s
    rows = np.interp(time_s, force.time_s, error_g) > _LARGEST_JERK * noise_g
    rows |= (time_s < force.time_s[0] + _JERK_S) | (time_s > force.time_s[-1] - _JERK_S)
    margin = round(_JERK_S * comparison.sensor.rate_hz)
    return leave_out(
        comparison,
        np.convolve(rows, np.ones(2 * margin + 1), 'same') > 0.5,
        f'the robot jerks, which its encoders do not show (error up to {1e3 * error_g.max():.2g} '
        'mg); move more smoothly, or record the joints at a higher rate',
    )


@dataclass(frozen=True)
class _Readings:
    """The readings of a reference, and the splines that follow them."""

    name: str  # For people
    time_s: np.ndarray  # Times of the readings, s, (k,)
    values: np.ndarray  # Readings, (k, components)
    degrees: tuple[int, int]  # Degrees of two splines: where they agree, they show the motion
    order: int  # Derivative of the splines that is the force, g
    step_g: float  # Step of the readings

    def error_g(self, time_s: np.ndarray) -> np.ndarray:
        """Return the difference between the splines, g, (n,), by that between readings."""
        middle_s = (self.time_s[1:] + self.time_s[:-1]) / 2

        def force_g(degree: int) -> np.ndarray:
            spline = scipy.interpolate.make_interp_spline(self.time_s, self.values, degree)
            return spline(middle_s, self.order)

        low, high = self.degrees
        return np.interp(time_s, middle_s, np.abs(force_g(low) - force_g(high)).max(axis=1))

    def lacks(self, time_s: np.ndarray) -> np.ndarray:
        """Return where readings are missing between their neighbours, (n,) bool."""
        steps_s = np.diff(self.time_s)
        after = np.clip(np.searchsorted(self.time_s, time_s, 'right') - 1, 0, len(steps_s) - 1)
        return (steps_s > _USUAL_STEP * np.median(steps_s))[after]


def _readings(comparison: BaselineComparison, columns: dict[str, np.ndarray]) -> list[_Readings]:
    """Return the readings of another simulator, or of the joints that move."""
    sensor = comparison.sensor
    force = comparison.stated_force
    if force is not None:
        force_g = np.array(force(force.time_s))[: len(sensor.axes)].T / G0_MPS2
        return [_Readings(force.name, force.time_s, force_g, (3, 5), 0, 0.0)]
    if not comparison.joints:
        return []
    found = []
    for joint, name in JOINTS.items():
        values = columns.get(name, np.zeros(0))
        read = np.isfinite(values)
        if read.sum() <= BAND_LIMITED_DEGREE or not np.ptp(values[read]):
            continue
        readings = values[read, None]
        time_s = comparison.time_s[read]
        if joint == 'shift':
            degrees = (BAND_LIMITED_DEGREE - 2, BAND_LIMITED_DEGREE)
            found.append(_Readings(name, time_s, readings / G0_MPS2, degrees, 2, 0.0))
        else:
            step_g = sensor.stage_resolution_rad
            found.append(_Readings(name, time_s, readings, (3, 5), 0, step_g))
    return found


def without_fast_motion(
    comparison: BaselineComparison, columns: dict[str, np.ndarray]
) -> BaselineComparison:
    """
    Leave out samples at which the reference moves faster than its readings show.

    Rests that the sensor shows stay; a stage may move at an alias of its readings where it seems
    to rest. Where readings are missing, or the output is beyond the range, that is the reason.
    """
    sensor = comparison.sensor
    robot = comparison.robot_force
    noise_g = float(np.min(noise.analog_std_v(sensor) / sensor.scale_v_per_g))
    if robot is not None:
        return _without_jerks(comparison, robot, noise_g)
    limit_g = _LARGEST_ERROR * max(noise_g, float(np.min(sensor.lsb_v / sensor.scale_v_per_g)))
    margin = np.ones(2 * round(_WINDOW_S / 2 * sensor.rate_hz) + 1)

    def near(rows: Any) -> np.ndarray:
        return np.convolve(rows, margin, 'same') > 0.5

    beyond = near(comparison.out_of_range.any(axis=1))
    rests = (
        comparison.at_rest
        if comparison.reference is Reference.SIMULATOR
        else np.zeros(len(comparison), bool)
    )
    for readings in _readings(comparison, columns):
        error_g = readings.error_g(comparison.time_s)
        coarse = comparison.used & ~rests & (error_g > np.hypot(limit_g, readings.step_g))
        if not coarse.any():
            continue
        rows = near(_with_aliases(comparison, coarse, noise_g)) & ~rests
        lacks = near(readings.lacks(comparison.time_s))
        error = f'(error up to {1e3 * error_g[rows].max():.2g} mg)'
        rate_hz = stamped_rate_hz(readings.time_s)
        reasons = [
            (
                beyond,
                f'the output is beyond the range of {sensor.range_g:g} g that the parameter file '
                f'states, in motion that {readings.name} does not follow {error}',
            ),
            (lacks, f'{readings.name} lacks readings there {error}'),
            (
                rows,
                f'{readings.name} moves too fast for its {rate_hz:.4g} readings a second {error}; '
                'read it at a higher rate',
            ),
        ]
        for explained, reason in reasons:
            comparison = leave_out(comparison, rows & explained, reason)
    return comparison


def _with_aliases(
    comparison: BaselineComparison, coarse: np.ndarray, noise_g: float
) -> np.ndarray:
    """Extend samples to the seconds beside them that move otherwise than simulated, (n,) bool."""
    sensor = comparison.sensor
    measured = comparison.measured
    length = max(round(_WINDOW_S * sensor.rate_hz), _SHORTEST_WINDOW)
    part = np.minimum(np.arange(len(coarse)) // length, max(len(coarse) // length - 1, 0))

    def motion_g(volts: np.ndarray) -> np.ndarray:
        """Return the rms of the changes from sample to sample with noise, by part and axis."""
        changes_g = np.diff(bridged(volts, measured) / sensor.scale_v_per_g, axis=0, prepend=0.0)
        squares_g2 = [np.bincount(part, c**2) / np.bincount(part) for c in changes_g.T]
        return np.sqrt(noise_g**2 + np.array(squares_g2))

    recorded = motion_g(comparison.volts)
    simulated = motion_g(comparison.simulated_v(sensor))
    differs = np.any(np.abs(np.log(recorded / simulated)) > np.log(_SAME_MOTION), axis=0)
    touched = np.bincount(part, coarse) > 0
    extended = coarse.copy()
    for begin, end in true_runs(differs | touched):
        if touched[begin:end].any():
            extended |= (part >= begin) & (part < end) & differs[part]
    return extended


def fading_frequency_hz(comparison: BaselineComparison) -> float | None:
    """Find the frequency above which the reference has less motion than the sensor."""
    if comparison.reference is not Reference.SIMULATOR:
        return None
    sensor = comparison.sensor
    size = max(round(_WINDOW_S * sensor.rate_hz), _SHORTEST_WINDOW)
    if len(comparison) < _FEWEST_WINDOWS * size // 2:
        return None
    within = comparison.measured & ~comparison.out_of_range.any(axis=1)
    frequency_hz = np.arange(size // 2 + 1) * sensor.rate_hz / size
    width = max(round(_BAND_HZ * size / sensor.rate_hz), 1)

    def power(volts: np.ndarray) -> np.ndarray:
        """Return the power density of all axes, g²/Hz, at frequencies above 0."""
        output_g = bridged(volts, within) / sensor.scale_v_per_g
        density = scipy.signal.welch(
            output_g, sensor.rate_hz, nperseg=size, detrend='linear', axis=0
        )[1]
        return density[1:].sum(axis=1)

    def by_band(density: np.ndarray) -> np.ndarray:
        return density[: (size // 2) // width * width].reshape(-1, width).mean(axis=1)

    # Without its RC filter the sensor has this gain over its simulation.
    rc_s = float(np.max(noise.electronics(sensor).rc_s))
    unfiltered = 1 + (2 * np.pi * frequency_hz[1:] * rc_s) ** 2
    recorded = by_band(power(comparison.volts))
    simulated = by_band(power(comparison.simulated_v(sensor)) * unfiltered)
    noise_g2 = noise.density_v2_per_hz(sensor, frequency_hz[1:]) / sensor.scale_v_per_g**2
    moves = recorded > _MOTION_POWER_RATIO * by_band(noise_g2.sum(1))
    followed = np.flatnonzero(moves & (simulated >= _FADED_POWER_RATIO * recorded))
    first = followed[-1] + 1 if len(followed) else 0
    return float(frequency_hz[1 + first * width]) if moves[first:].any() else None
