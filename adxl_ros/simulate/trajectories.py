# SPDX-License-Identifier: Apache-2.0

"""Manoeuvres of the stage and its surroundings, by name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import product
from typing import NamedTuple

from adxl_ros.model.constants import NOMINAL_SUPPLY_V, NOMINAL_TEMPERATURE_C
from adxl_ros.simulate.motion import Held, Knots, Motion, Pieces
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
_SAME_TIME_S = 1e-9  # Knots that are nearer are one, s; chosen: above rounding
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
        values = np.full(len(time_s), self.begin)
        previous = self.begin
        for step_s, level in self.steps:
            elapsed_s = np.maximum(time_s - step_s, 0.0)
            values += (level - previous) * -np.expm1(-elapsed_s / self.tau_s)
            previous = level
        return values


class _Knot(NamedTuple):
    """A point of the paths of both angles."""

    time_s: float
    # Angles, rad, and their derivatives, rad/s
    alpha_rad: float
    beta_rad: float
    alpha_rad_s: float
    beta_rad_s: float


@dataclass
class Script:
    """Builds the paths of both angles, move by move."""

    # Angles at present, rad
    alpha_rad: float
    beta_rad: float
    now_s: float = 0.0  # Time at present, s
    slew_rad_s: float = SLEW_RAD_S  # Largest velocity of a move to a pose, rad/s
    knots: list[_Knot] = field(default_factory=list)

    def rest(self, seconds: float) -> None:
        """Rest for a time, s."""
        self._knot()
        self.now_s += seconds
        self._knot()

    def go(self, alpha: float, beta: float) -> None:
        """Move to a pose by minimum jerk, whose velocity peaks at the slew rate."""
        distance = max(abs(alpha - self.alpha_rad), abs(beta - self.beta_rad))
        self._knot()
        self.now_s += _JERK_PEAK * distance / self.slew_rad_s
        self.alpha_rad = alpha
        self.beta_rad = beta
        self._knot()

    def run(self, joint: str, to: float, speed: float) -> None:
        """Turn one joint to an angle at a constant speed, between a run-up and a stop."""
        distance = to - (self.alpha_rad if joint == 'alpha' else self.beta_rad)
        rate = np.copysign(speed, distance)
        run_up = rate * RUN_UP_S / 2
        constant = distance - 2 * run_up
        self._knot()
        self._turn(joint, run_up, RUN_UP_S, rate)
        self._turn(joint, constant, abs(constant) / speed, rate)
        self._turn(joint, run_up, RUN_UP_S, 0.0)

    def joints(self) -> tuple[Knots, Knots]:
        """Return the paths of alpha and beta."""
        time_s, alpha_rad, beta_rad, alpha_rad_s, beta_rad_s = np.transpose(self.knots)
        return Knots(time_s, alpha_rad, alpha_rad_s), Knots(time_s, beta_rad, beta_rad_s)

    def _turn(self, joint: str, angle_rad: float, seconds: float, end_rad_s: float) -> None:
        """Turn one joint by an angle, with a rate at the end."""
        self.now_s += seconds
        if joint == 'alpha':
            self.alpha_rad += angle_rad
            self._knot(alpha_rad_s=end_rad_s)
        else:
            self.beta_rad += angle_rad
            self._knot(beta_rad_s=end_rad_s)

    def _knot(self, alpha_rad_s: float = 0.0, beta_rad_s: float = 0.0) -> None:
        """Add a knot at the present pose, unless there is one at this time."""
        if not self.knots or self.now_s - self.knots[-1].time_s > _SAME_TIME_S:
            self.knots.append(
                _Knot(self.now_s, self.alpha_rad, self.beta_rad, alpha_rad_s, beta_rad_s)
            )


def _visit(poses_deg: Sequence[tuple[float, float]]) -> Motion:
    """Rest in poses and move between them."""
    poses_rad = np.radians(poses_deg).tolist()
    script = Script(*poses_rad[0])
    for pose in poses_rad:
        script.go(*pose)
        script.rest(DWELL_S + SETTLE_S)
    return Motion(script.now_s, *script.joints())


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
    amplitude_m = 30e-6
    omega = 2 * np.pi * 10.0

    def shift(time_s: np.ndarray, order: int = 0) -> np.ndarray:
        """Return a derivative: each multiplies a sine by ω and turns its phase by π/2."""
        return amplitude_m * omega**order * np.sin(omega * time_s + order * np.pi / 2)

    return Motion(20.0, Held(np.pi / 4), Held(np.pi / 2), shift)


def shaker(_: np.random.Generator) -> Motion:
    """Shake along x by 1 m/s², 2 to 40 Hz, stroke 13 mm p-p, with x level, up and down."""
    script = Script(np.pi / 2, np.pi / 2)
    shakes = []
    for beta in (np.pi / 2, 0.0, np.pi):
        script.go(np.pi / 2, beta)
        shakes.append(_shake(script))
    return Motion(
        script.now_s,
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
            middle = script.alpha_rad if joint == 'alpha' else script.beta_rad
            for to in (middle + amplitude, middle - amplitude, middle):
                script.run(joint, to, amplitude / 2)
            script.rest(1.0)
    script.go(np.pi / 4, np.pi / 2)
    shift = _shake(script)
    for alpha, beta in np.radians([(0, 0), (90, 90), (180, 90), (90, 270), (90, 180), (30, 30)]):
        script.go(alpha, beta)
        script.rest(DWELL_S)
    end = script.now_s
    temperature_c = Steps(
        NOMINAL_TEMPERATURE_C, ((0.25 * end, 35.0), (0.6 * end, NOMINAL_TEMPERATURE_C)), 30.0
    )
    supply_v = Steps(NOMINAL_SUPPLY_V, ((0.4 * end, 4.85), (0.8 * end, NOMINAL_SUPPLY_V)), 0.5)
    return Motion(end, *script.joints(), shift, temperature_c, supply_v)


def _shake(script: Script) -> Pieces:
    """Rest while the shaker runs, and return its path."""
    script.rest(2.0)
    begin_s = script.now_s
    script.rest(_SHAKE_S + 2.0)
    return swept_sine(begin_s)


TRAJECTORIES: dict[str, Callable[[np.random.Generator], Motion]] = {
    f.__name__: f
    for f in (sweep, tilt_alpha, tilt_beta, tilt_both, motion, shaker, soak, tumble, rich)
}
"""Manoeuvres by name; each takes a random generator."""
