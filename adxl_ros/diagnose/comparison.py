# SPDX-License-Identifier: Apache-2.0
"""
A recording beside the simulation of its baseline, on the recording's own reference motion.

Samples are left out where the reference is not known: its cells are empty, or it moves faster
than its readings show. Others are left out because the sensor did not measure: they stand alone,
repeat, or are no numbers. Each kind is counted, with its reason and its size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cached_property, partial
from typing import Any

from adxl_ros.files.recording_columns import JOINTS, Recording
from adxl_ros.files.stamps import mean_period_s, stamped_rate_hz
from adxl_ros.model import noise, signal_chain
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.error_sizes import rms
from adxl_ros.model.filters import stop
from adxl_ros.model.kinematics import specific_force
from adxl_ros.model.sensor import noiseless, Sensor
from adxl_ros.report.quantities import acceleration_text
from adxl_ros.signals.block_statistics import true_runs
from adxl_ros.simulate.motion import ForcePath, INTERNAL_RATE_HZ, Motion, Path
from adxl_ros.simulate.recorded_motion import environment_paths, motion_from_references
from adxl_ros.simulate.response import ChainMemo, whole_response
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
_MORE_OUTPUTS = 13  # Kept by the search. Chosen: many sets start at the same values; 1 MB each
_SMALLEST_MOVES = {'alpha': 2e-3, 'beta': 2e-3, 'shift': 1e-6}
"""Ranges of the joints, rad and m, from which they move. Chosen: above the step of an encoder."""
_REST_RATE = 1e-3
"""A joint rests below this rate, rad/s, and the shift below this acceleration, m/s². Chosen: the
specific force then changes by less than the noise within a second."""
SMALLEST_TURN_RAD = 1e-3
"""Turn of a joint that is a move, rad. Chosen: the force changes by 1 mg, and a spline that rings
at a stop turns by less."""
SETTLING_S = 0.3
"""A sample rests if no joint moves within this time before it, s. Chosen: an RC filter of 15 Hz
has settled."""
_MOVED_SHARE = 0.5
"""Share of the scatter within a rest that its reference leaves, below which it is motion. Chosen:
noise leaves all of it, and a reference that is in phase less than half."""
_LONGEST_S = 1e3  # Time since the last move where there was none, s. Chosen: beyond any creep
_NAMED_PARTS = 4  # Parts that a note names. Chosen: it stays one or two lines


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
        at_rate = noiseless(self.at_rate(sensor))
        return whole_response(at_rate, self.motion, 0, self.time_s, self.memo)

    def at_rate(self, sensor: Sensor) -> Sensor:
        """Return a sensor at the rate of these samples, which passed the recording's filter."""
        own = self.sensor
        return replace(sensor, rate_hz=own.rate_hz, filter_rate_hz=own.filter_rate_hz)

    def residual_v(self, sensor: Sensor) -> np.ndarray:
        """
        Return the recording minus the mean output of a sensor, V, (n, m).

        Without a reference the pose is unknown, and the mean of the residual is subtracted.
        """
        residual_v = self.volts - self.simulated_v(sensor)
        return residual_v if self.pose_known else residual_v - np.nanmean(residual_v, axis=0)

    def simulated_noise_v(self, sensor: Sensor, seed: int) -> np.ndarray:
        """Draw a sensor's output about its own mean, V, (n, m)."""
        return self.drawn_v(sensor, seed) - self.simulated_v(sensor)

    def drawn_v(self, sensor: Sensor, seed: int) -> np.ndarray:
        """Draw the output of a sensor, V, (n, m)."""
        return whole_response(self.at_rate(sensor), self.motion, seed, self.time_s, self.memo)

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
        name=recording.path,
        time_s=time_s,
        volts=volts,
        motion=motion,
        sensor=sensor,
        reference=reference,
        at_rest=at_rest,
        used=used,
        disturbed=np.zeros(len(time_s), bool),
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
        memo=ChainMemo(more_volts=_MORE_OUTPUTS),
        sensor=comparison.sensor.computed_at(rate_hz / every),
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


def direction_of_last_move(angle_rad: np.ndarray) -> np.ndarray:
    """Return the direction of the last move of a joint, −1 or 1, and 0 in turns, (n,)."""
    return np.rint(stop(angle_rad, SMALLEST_TURN_RAD, {}))


def time_since_move_s(time_s: np.ndarray, rates: Sequence[np.ndarray]) -> np.ndarray:
    """Return the time since any joint moved."""
    moving = np.any(np.abs(np.array(rates)) > _REST_RATE, axis=0)
    last_s = np.maximum.accumulate(np.where(moving, time_s, -np.inf))
    return np.minimum(time_s - last_s, _LONGEST_S)


def leave_out(
    comparison: BaselineComparison,
    rows: np.ndarray,
    reason: str,
    effect: str | None = None,
    details: str = '',
) -> BaselineComparison:
    """
    Return a comparison that does not use some samples, and notes why, when and how many.

    Samples that are left out for another reason already keep that one. `details` follow the reason
    in the note alone.
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
    size = f'{left_out.samples} samples, {left_out.duration_s:.3g} s'
    note = f'left out: {size} ({parts}): {reason}{details}'
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
