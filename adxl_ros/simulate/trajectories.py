# SPDX-License-Identifier: Apache-2.0

"""Manoeuvres of the stage and its surroundings: by name, of a recording, or by commands."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from math import exp
from types import MappingProxyType
from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.files.recording_columns import ACCEL, JOINTS, Recording
from adxl_ros.files.stamps import stamped_rate_hz
from adxl_ros.model import noise
from adxl_ros.model.constants import G0_MPS2, NOMINAL_SUPPLY_V, NOMINAL_TEMPERATURE_C
from adxl_ros.model.sensor import Sensor
from adxl_ros.process import usage
from adxl_ros.simulate.motion import (
    BAND_LIMITED_DEGREE,
    encoder_reading,
    ForcePath,
    Held,
    INTERNAL_RATE_HZ,
    Knots,
    Motion,
    Path,
    Pieces,
    rounding_step,
    SmoothedPath,
)
import numpy as np
import scipy

SLEW_RAD_S = np.pi / 4  # Largest rate between poses, rad/s; chosen: 30° take 1.25 s
DWELL_S = 5.0  # Dwell of a pose, s: the time over which the paper averages
SETTLE_S = 0.2  # Time to settle before a dwell, s; chosen: 20 time constants of the RC filter
_JERK_PEAK = 1.875  # Peak velocity of the motion of minimum jerk, divided by its mean: 15/8
RUN_UP_S = 1.0  # Time to a constant velocity, s; chosen: 60°/s² at most
_SHAKE_LOW_HZ = 2.0  # Lowest frequency of the shaker, Hz; chosen: its stroke is 13 mm
_SHAKE_HIGH_HZ = 40.0  # Highest frequency, Hz; chosen: near the bandwidth
_SHAKE_MPS2 = 1.0  # Amplitude of the shaker, m/s²; chosen: a tenth of gravity
_SHAKE_S = 40.0  # Duration of the shaker, s; chosen: some 9 s for each octave
_FADE_S = 2.0  # Fade in and out, s; chosen: four of the longest periods
_ROUNDING_OF_NOISE = 0.1
"""Force by the rounding of the shift, divided by the noise, from which it is smoothed. Chosen: it
adds half a per cent to the rms."""
_SHAKE_KNOTS_HZ = 1000.0  # Knots of its spline a second; chosen: the force is exact to 0.4 µg


def swept_sine(begin_s: float) -> Pieces:
    """Return a sine of constant acceleration whose frequency grows exponentially, with fades."""
    time_s = np.linspace(0.0, _SHAKE_S, round(_SHAKE_S * _SHAKE_KNOTS_HZ) + 1)
    growth_per_s = np.log(_SHAKE_HIGH_HZ / _SHAKE_LOW_HZ) / _SHAKE_S
    omega = 2 * np.pi * _SHAKE_LOW_HZ * np.exp(growth_per_s * time_s)
    amplitude_m = (
        _SHAKE_MPS2
        / omega**2
        * Knots([0, _FADE_S, _SHAKE_S - _FADE_S, _SHAKE_S], [0, 1, 1, 0])(time_s)
    )
    position_m = -amplitude_m * np.sin((omega - omega[0]) / growth_per_s)
    return Pieces(
        scipy.interpolate.PPoly.from_spline(
            scipy.interpolate.make_interp_spline(begin_s + time_s, position_m, k=5)
        )
    )


@dataclass(frozen=True)
class Steps:
    """Steps to levels, each approached exponentially."""

    begin: float  # Level at the beginning
    steps: tuple[tuple[float, float], ...]  # Time, s, and level of each step
    tau_s: float  # Time constant of each step, s

    def __call__(self, time_s: np.ndarray, order: int = 0) -> np.ndarray:
        """Return the value; see `motion.Path`. It has no derivatives."""
        values, previous = np.full(len(time_s), self.begin), self.begin
        for step_s, level in self.steps:
            elapsed_s = np.maximum(time_s - step_s, 0.0)
            values += (level - previous) * -np.expm1(-elapsed_s / self.tau_s)
            previous = level
        return values


@dataclass
class Script:
    """Builds the paths of both angles, move by move."""

    # alpha, beta: Angles at present, rad
    alpha: float
    beta: float
    now: float = 0.0  # Time at present, s
    slew_rad_s: float = SLEW_RAD_S  # Largest velocity of a move to a pose, rad/s
    # Knots: time, s, alpha and beta, rad, and their derivatives, rad/s
    rows: list[tuple[float, ...]] = field(default_factory=list)

    def rest(self, seconds: float) -> None:
        """Rest for a time, s."""
        self._knot(0.0, 0.0)
        self.now += seconds
        self._knot(0.0, 0.0)

    def go(self, alpha: float, beta: float) -> None:
        """Move to a pose by minimum jerk, whose velocity peaks at the slew rate."""
        distance = max(abs(alpha - self.alpha), abs(beta - self.beta))
        self._knot(0.0, 0.0)
        self.now += _JERK_PEAK * distance / self.slew_rad_s
        self.alpha, self.beta = alpha, beta
        self._knot(0.0, 0.0)

    def run(self, joint: str, to: float, speed: float) -> None:
        """Turn one joint to an angle at a constant speed, between a run-up and a stop."""
        distance = to - getattr(self, joint)
        rate = np.copysign(speed, distance)
        run_up = rate * RUN_UP_S / 2
        constant = distance - 2 * run_up
        self._knot(0.0, 0.0)
        for angle, seconds, end_rate in (
            (run_up, RUN_UP_S, rate),
            (constant, abs(constant) / speed, rate),
            (run_up, RUN_UP_S, 0.0),
        ):
            setattr(self, joint, getattr(self, joint) + angle)
            self.now += seconds
            self._knot(**{'alpha_rate': 0.0, 'beta_rate': 0.0, f'{joint}_rate': end_rate})

    def joints(self) -> tuple[Knots, Knots]:
        """Return the paths of alpha and beta."""
        time_s, alpha, beta, alpha_rate, beta_rate = np.array(self.rows).T
        return Knots(time_s, alpha, alpha_rate), Knots(time_s, beta, beta_rate)

    def _knot(self, alpha_rate: float, beta_rate: float) -> None:
        row = (self.now, self.alpha, self.beta, alpha_rate, beta_rate)
        if not self.rows or self.now - self.rows[-1][0] > 1e-9:
            self.rows.append(row)


def _visit(poses_deg: Sequence[tuple[float, float]]) -> Motion:
    """Rest in poses and move between them."""
    poses_rad = np.radians(poses_deg).tolist()
    script = Script(*poses_rad[0])
    for pose in poses_rad:
        script.go(*pose)
        script.rest(DWELL_S + SETTLE_S)
    return Motion(script.now, *script.joints())


def sweep(_: np.random.Generator) -> Motion:
    """Visit planes alpha 90, 60, 30, 120, 150° forth and back (experiments 1 and 2)."""
    forth = list(range(0, 361, 30))
    return _visit(list(product((90, 60, 30, 120, 150), forth + forth[::-1])))


def tilt_alpha(_: np.random.Generator) -> Motion:
    """Turn alpha from −180 to 180° by 30° at beta 0 (figure 10a)."""
    return _visit([(angle, 0) for angle in range(-180, 181, 30)])


def tilt_beta(_: np.random.Generator) -> Motion:
    """Turn beta at alpha 90° (figure 10b); at 0, as printed, beta would not show."""
    return _visit([(90, angle) for angle in range(-180, 181, 30)])


def tilt_both(_: np.random.Generator) -> Motion:
    """Turn both together from −180 to 180° by 30° (figure 10c)."""
    return _visit([(angle, angle) for angle in range(-180, 181, 30)])


def motion(_: np.random.Generator) -> Motion:
    """Shake 60 µm p-p at 10 Hz along x at alpha 45°, beta 90° for 20 s (figures 11 and 12)."""
    amplitude_m, omega = 30e-6, 2 * np.pi * 10.0
    return Motion(
        20.0,
        Held(np.pi / 4),
        Held(np.pi / 2),
        lambda time_s, order=0: (
            amplitude_m * omega**order * np.sin(omega * time_s + order * np.pi / 2)
        ),
    )


def shaker(_: np.random.Generator) -> Motion:
    """Shake along x by 1 m/s², 2 to 40 Hz, stroke 13 mm p-p, with x level, up and down."""
    script, shakes = Script(np.pi / 2, np.pi / 2), []
    for beta in (np.pi / 2, 0.0, np.pi):
        script.go(np.pi / 2, beta)
        shakes.append(_shake(script))
    return Motion(
        script.now,
        *script.joints(),
        lambda time_s, order=0: np.sum([shake(time_s, order) for shake in shakes], axis=0),
    )


def soak(_: np.random.Generator) -> Motion:
    """Rest for 30 min while temperature (25, 40, 10, 25 °C) and supply step."""
    temperature_c = Steps(
        NOMINAL_TEMPERATURE_C, ((300, 40), (750, 10), (1200, NOMINAL_TEMPERATURE_C)), 60.0
    )
    supply_v = Steps(
        NOMINAL_SUPPLY_V,
        ((150, 4.8), (225, NOMINAL_SUPPLY_V), (1575, 5.2), (1690, NOMINAL_SUPPLY_V)),
        0.5,
    )
    return Motion(
        1800.0,
        Held(np.radians(60)),
        Held(np.radians(30)),
        temperature_c=temperature_c,
        supply_v=supply_v,
        internal_rate_hz=10.0,
    )


def tumble(rng: np.random.Generator) -> Motion:
    """Rest in 40 directions drawn evenly over the sphere."""
    alpha = np.degrees(np.arccos(rng.uniform(-1, 1, 40)))
    return _visit(list(zip(alpha, rng.uniform(0, 360, 40))))


def rich(_: np.random.Generator) -> Motion:
    """Combine planes at two speeds, reversals, shaker, warming and a supply step in 7 min."""
    script = Script(np.pi / 2, 0.0)
    script.rest(8.0)
    for alpha in np.radians([90, 45, 120]):
        script.go(alpha, 0.0)
        for speed in np.radians([20, 60]):
            for to in (2 * np.pi, 0.0):
                script.rest(2.0)
                script.run('beta', to, speed)
    for speed in np.radians([20, 60]):
        for to in np.radians([-120, 120]):
            script.rest(2.0)
            script.run('alpha', to, speed)
    script.go(np.radians(60), np.radians(45))
    for amplitude in np.radians([20, 10, 5]):
        for joint in ('beta', 'alpha'):
            middle = getattr(script, joint)
            for to in (middle + amplitude, middle - amplitude, middle):
                script.run(joint, to, amplitude / 2)
            script.rest(1.0)
    script.go(np.pi / 4, np.pi / 2)
    shift = _shake(script)
    for alpha, beta in np.radians([(0, 0), (90, 90), (180, 90), (90, 270), (90, 180), (30, 30)]):
        script.go(alpha, beta)
        script.rest(DWELL_S)
    end = script.now
    temperature_c = Steps(
        NOMINAL_TEMPERATURE_C, ((0.25 * end, 35.0), (0.6 * end, NOMINAL_TEMPERATURE_C)), 30.0
    )
    supply_v = Steps(NOMINAL_SUPPLY_V, ((0.4 * end, 4.85), (0.8 * end, NOMINAL_SUPPLY_V)), 0.5)
    return Motion(end, *script.joints(), shift, temperature_c, supply_v)


def _shake(script: Script) -> Pieces:
    """Rest while the shaker runs, and return its path."""
    script.rest(2.0)
    begin_s = script.now
    script.rest(_SHAKE_S + 2.0)
    return swept_sine(begin_s)


TRAJECTORIES: dict[str, Callable[[np.random.Generator], Motion]] = {
    f.__name__: f
    for f in (sweep, tilt_alpha, tilt_beta, tilt_both, motion, shaker, soak, tumble, rich)
}
"""Manoeuvres by name; each takes a random generator."""


_MAX_SPEED_RAD_S = 100.0  # Largest rate of a stage, rad/s; chosen: faster is a jump
_MIN_FORCE_SAMPLES = 4  # Fewest samples of specific force; a cubic spline needs them


def motion_from_force(ideal: Recording, resampled: bool) -> tuple[Motion, float]:
    """Make a motion from the specific force of another simulator; return its begin, s, too."""
    time_s = ideal.time_s
    force_mps2 = np.column_stack([ideal.columns[name] for name in ACCEL])
    if len(time_s) < _MIN_FORCE_SAMPLES:
        raise UserError(
            f'{ideal.path}: {len(time_s)} samples of specific force; at least '
            f'{_MIN_FORCE_SAMPLES} are needed'
        )
    begin_s = float(time_s[0])
    rate_hz = stamped_rate_hz(time_s)
    return Motion(
        float(time_s[-1] - begin_s) + 1 / rate_hz,
        force=ForcePath(time_s, force_mps2),
        internal_rate_hz=rate_hz if resampled else max(rate_hz, INTERNAL_RATE_HZ),
        **environment_paths(ideal),
    ), begin_s


def motion_from_references(read: Recording, sensor: Sensor) -> Motion:
    """Make a motion from the stage angles, temperature and supply of a recording."""
    for name in ('alpha_rad', 'beta_rad'):
        if name not in read.columns or np.isnan(read.columns[name]).all():
            raise UserError(
                f'{read.path}: no stage angle {name} to follow; for specific force '
                f'say {usage("simulate", "imu", force=read.path)}'
            )
    paths: dict[str, Any] = environment_paths(read)
    for joint, name in JOINTS.items():
        if joint != 'shift':
            _check_speed(read, name, sensor.stage_resolution_rad)
        if not np.isfinite(read.columns.get(name, np.nan)).any():
            continue
        if joint == 'shift':
            paths[joint] = _shift_path(read, sensor)
        else:
            paths[joint] = SmoothedPath(
                read.time_s, read.columns[name], sensor.stage_resolution_rad, BAND_LIMITED_DEGREE
            )
    return Motion(read.span_s, **paths)


def _shift_path(read: Recording, sensor: Sensor) -> SmoothedPath:
    """
    Return the path of the shift, whose second derivative is a force.

    Its readings are exact but for their digits. Where fast readings make the rounding, twice
    differentiated, a force that shows beside the noise, the path is smoothed by as much as they
    are rounded.
    """
    readings = read.columns['shift_m']
    sampled = np.isfinite(readings)
    exact = SmoothedPath(read.time_s, readings, 0.0, BAND_LIMITED_DEGREE)
    step_m = rounding_step(readings[sampled])
    if not step_m:
        return exact
    rate_hz = stamped_rate_hz(read.time_s[sampled])
    # The rounding of a reading is step/√12 rms, and weighs 1, −2 and 1 in a second difference.
    rounding_mps2 = step_m * np.sqrt(6 / 12) * rate_hz**2
    noise_mps2 = np.min(noise.analog_std_v(sensor) / sensor.scale_v_per_g) * G0_MPS2
    if rounding_mps2 < _ROUNDING_OF_NOISE * noise_mps2:
        return exact
    return SmoothedPath(read.time_s, readings, step_m, is_seen=True, knot_s=2 / rate_hz)


def environment_paths(read: Recording) -> dict[str, Path]:
    """Return the recorded temperature, °C, and supply, V, as paths by column."""
    return {
        name: SmoothedPath(read.time_s, read.columns[name], 0.0)
        for name in ('temperature_c', 'supply_v')
        if name in read.columns and np.isfinite(read.columns[name]).any()
    }


def _check_speed(read: Recording, name: str, resolution_rad: float) -> None:
    """Refuse an angle that changes faster than a stage turns."""
    sampled = np.flatnonzero(np.isfinite(read.columns[name]))
    change_rad = np.abs(np.diff(read.columns[name][sampled]))
    interval_s = np.diff(read.time_s[sampled])
    jumps = np.flatnonzero(change_rad - 2 * resolution_rad > _MAX_SPEED_RAD_S * interval_s)
    if len(jumps):
        i = jumps[0]
        raise UserError(
            f'{read.path}: {name} jumps by {change_rad[i]:.3g} rad within '
            f'{interval_s[i]:.3g} s at {read.time_s[sampled[i]]:.6g} s, which no '
            'stage does; unwrap the angle, or cut the recording there'
        )


_NAMES = tuple(JOINTS)  # Names of the joints, in the order of all arrays
_REACH = {'alpha': 100.0, 'beta': 100.0, 'shift': 10.0}  # Largest positions. Chosen: 16 turns
_SETTLED = 6.638  # Root of (1 + x)·exp(−x) = 0.01: a critically damped step is within 1 %
_MIN_MOVE = 1e-9  # Distance at rest without encoder step, rad or m


class SimulatedStage:
    """
    True motion and encoders of the stage.

    All arrays are (3,): alpha, rad; beta, rad; shift, m. A reference moves to the goal at the slew
    rate, and the joint follows it as a critically damped system of second order. A time step is
    exact for a reference that is linear within it. A joint comes to rest within the encoder step
    of the command; its place in that step is random for each command.
    """

    def __init__(
        self,
        pose: np.ndarray,
        slew: np.ndarray,
        settling_s: float,
        resolution: np.ndarray,
        seed: int,
    ) -> None:
        """Rest at a pose; `slew` is the largest velocity, and a resolution of 0 is exact."""
        self._slew, self._speed = slew, np.array(slew, float)
        self._omega, self._resolution = _SETTLED / settling_s, resolution
        self._rng = np.random.default_rng(seed)
        self._commanded = np.array(pose, float)
        self._goal = self._reachable(self._commanded)
        self._reference = self._goal.copy()
        self.position = self._goal.copy()  # True position, (3,)
        self.velocity = np.zeros(3)  # True velocity, (3,)

    def command(
        self, positions: Mapping[str, float], speeds: Mapping[str, float] = MappingProxyType({})
    ) -> None:
        """Command joints to positions; a joint whose command does not change goes on."""
        target = self._commanded.copy()
        for name, position in positions.items():
            if name not in _NAMES:
                raise UserError(f'no joint {name!r}; the joints are {", ".join(_NAMES)}')
            if not abs(position) <= _REACH[name]:
                raise UserError(
                    f'{name} = {position:g} is out of reach; the stage goes to +-{_REACH[name]:g}'
                )
            target[_NAMES.index(name)] = position
        is_new = target != self._commanded
        if is_new.any():
            self._goal = np.where(is_new, self._reachable(target), self._goal)
            self._commanded = target
        for name in positions:
            joint = _NAMES.index(name)
            self._speed[joint] = min(self._slew[joint], abs(speeds.get(name, 0.0)) or np.inf)

    def step(self, dt_s: float) -> None:
        """Advance by a time step, s."""
        max_move = self._speed * dt_s
        reference = self._reference + np.clip(self._goal - self._reference, -max_move, max_move)
        rate = (reference - self._reference) / dt_s
        # x'' = w² (r - x) - 2 w x' behind a ramp r: x = r - 2 r'/w + (c + d t) exp(-w t).
        w, decay = self._omega, exp(-self._omega * dt_s)
        lag = self.position - (self._reference - 2 * rate / w)
        slope = self.velocity - rate + w * lag
        self.position = reference - 2 * rate / w + (lag + slope * dt_s) * decay
        self.velocity = rate + (slope - w * (lag + slope * dt_s)) * decay
        self._reference = reference

    def encoder(self) -> np.ndarray:
        """Return the readings of the encoders, rad, rad, m, (3,)."""
        # + 0.0 turns -0.0 into 0.0.
        return encoder_reading(self.position, self._resolution) + 0.0

    def moving(self) -> bool:
        """Return whether a joint is more than an encoder step from its goal."""
        distance = np.abs(self.position - self._goal)
        return bool((distance > np.maximum(self._resolution, _MIN_MOVE)).any())

    def _reachable(self, target: np.ndarray) -> np.ndarray:
        """Return where the joints come to rest for a target, (3,)."""
        return encoder_reading(target, self._resolution) + self._resolution * self._rng.uniform(
            -0.5, 0.5, 3
        )
