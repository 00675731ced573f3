# Copyright 2026 the adxl_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Manoeuvres of the stage and of what surrounds it: what `simulate` can be asked for."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from adxl_ros.model.constants import NOMINAL_SUPPLY_V, NOMINAL_TEMPERATURE_C
from adxl_ros.simulate.motion import Held, Knots, Motion, Path
import numpy as np

SLEW_RAD_S = np.pi / 4
"""Fastest turn of the stage from pose to pose; a 30° step then takes 1.25 s."""
DWELL_S = 5.0
"""The paper averages 5 s a pose."""
SETTLE_S = 0.2
_RUN_UP_S = 1.0
"""Time in which a joint reaches a constant speed."""
_SHAKE_HZ = (2.0, 40.0)
_SHAKE_MPS2 = 1.0
_SHAKE_S = 40.0
_EDGE_S = 2.0


@dataclass(frozen=True)
class Sine:
    """A sine from time 0 on: amplitude in m, frequency in Hz."""

    amplitude_m: float
    frequency_hz: float

    def __call__(self, time_s: np.ndarray, order: int = 0) -> np.ndarray:
        """See `motion.Path`."""
        omega = 2 * np.pi * self.frequency_hz
        return self.amplitude_m * omega ** order * np.sin(omega * time_s + order * np.pi / 2)


class SweptSine:
    """
    A sine of constant acceleration whose frequency grows exponentially, faded in and out.

    x = −E·sin φ with φ̇ = ω = ω₀·exp(k·t) and E = a·w/ω², w from 0 to 1 and back.
    """

    def __init__(self, begin_s: float, duration_s: float) -> None:
        """Begin at a time, s, and last so long."""
        low, high = _SHAKE_HZ
        self._begin_s, self._end_s = begin_s, begin_s + duration_s
        self._omega, self._k = 2 * np.pi * low, np.log(high / low) / duration_s
        self._window = Knots([0, _EDGE_S, duration_s - _EDGE_S, duration_s], [0, 1, 1, 0])

    def __call__(self, time_s: np.ndarray, order: int = 0) -> np.ndarray:
        """See `motion.Path`."""
        out = np.zeros(len(time_s))
        on = (time_s > self._begin_s) & (time_s < self._end_s)
        if not on.any():
            return out
        t, k = time_s[on] - self._begin_s, self._k
        omega = self._omega * np.exp(k * t)
        phase = (omega - self._omega) / k
        sine, cosine = np.sin(phase), np.cos(phase)
        size = _SHAKE_MPS2 / omega ** 2
        w0, w1, w2 = (self._window(t, i) for i in range(3))
        e0, e1 = size * w0, size * (w1 - 2 * k * w0)
        if order == 0:
            out[on] = -e0 * sine
        elif order == 1:
            out[on] = -e1 * sine - e0 * omega * cosine
        else:
            e2 = size * (w2 - 4 * k * w1 + 4 * k * k * w0)
            out[on] = ((e0 * omega ** 2 - e2) * sine - (2 * e1 + k * e0) * omega * cosine)
        return out


@dataclass(frozen=True)
class Sum:
    """Several paths, one upon the other."""

    parts: tuple[Path, ...]

    def __call__(self, time_s: np.ndarray, order: int = 0) -> np.ndarray:
        """See `motion.Path`."""
        return np.sum([part(time_s, order) for part in self.parts], axis=0)


@dataclass(frozen=True)
class Steps:
    """Steps to levels at times, s, each approached with a time constant, s."""

    begin: float
    steps: tuple[tuple[float, float], ...]
    tau_s: float

    def __call__(self, time_s: np.ndarray, order: int = 0) -> np.ndarray:
        """See `motion.Path`; only of order 0."""
        value, before = np.full(len(time_s), self.begin), self.begin
        for at_s, level in self.steps:
            passed = np.maximum(time_s - at_s, 0.0)
            value += (level - before) * -np.expm1(-passed / self.tau_s)
            before = level
        return value


@dataclass
class Script:
    """Writes down what both angles do, one move after the other; rad and s."""

    alpha: float
    beta: float
    now: float = 0.0
    rows: list[tuple[float, ...]] = field(default_factory=list)

    def rest(self, seconds: float) -> None:
        """Stay."""
        self._knot(0.0, 0.0)
        self.now += seconds
        self._knot(0.0, 0.0)

    def go(self, alpha: float, beta: float) -> None:
        """Move by least jerk, whose speed peaks at 1.875 times the mean, at the slew rate."""
        far = max(abs(alpha - self.alpha), abs(beta - self.beta))
        self._knot(0.0, 0.0)
        self.now += 1.875 * far / SLEW_RAD_S
        self.alpha, self.beta = alpha, beta
        self._knot(0.0, 0.0)

    def run(self, joint: str, to: float, speed: float) -> None:
        """Turn one joint at a constant speed, rad/s, between a run-up and a stop."""
        way = to - getattr(self, joint)
        rate = np.copysign(speed, way)
        rates = {'alpha': 0.0, 'beta': 0.0, joint: rate}
        up = rate * _RUN_UP_S / 2
        self._knot(0.0, 0.0)
        for part, seconds, moving in ((up, _RUN_UP_S, 1),
                                      (way - 2 * up, abs(way - 2 * up) / speed, 1),
                                      (up, _RUN_UP_S, 0)):
            setattr(self, joint, getattr(self, joint) + part)
            self.now += seconds
            self._knot(rates['alpha'] * moving, rates['beta'] * moving)

    def joints(self) -> tuple[Knots, Knots]:
        """Return alpha and beta over time."""
        time_s, alpha, beta, alpha_rate, beta_rate = np.array(self.rows).T
        return Knots(time_s, alpha, alpha_rate), Knots(time_s, beta, beta_rate)

    def _knot(self, alpha_rate: float, beta_rate: float) -> None:
        row = (self.now, self.alpha, self.beta, alpha_rate, beta_rate)
        if not self.rows or self.now - self.rows[-1][0] > 1e-9:
            self.rows.append(row)


def visit(poses_rad: Sequence[tuple[float, float]], dwell_s: float = DWELL_S) -> Motion:
    """
    Rest in each pose (alpha, beta), rad, and move between them.

    Parameters
    ----------
    poses_rad
        In this order.
    dwell_s
        Rest in each, beside the time to settle.

    """
    script = Script(*poses_rad[0])
    for pose in poses_rad:
        script.go(*pose)
        script.rest(dwell_s + SETTLE_S)
    alpha, beta = script.joints()
    return Motion(script.now, alpha, beta)


def sweep(_: np.random.Generator) -> Motion:
    """Visit planes alpha 90, 60, 30, 120, 150°, forth and back (experiments 1 and 2)."""
    forth = list(range(0, 361, 30))
    return _visit_deg([(alpha, beta) for alpha in (90, 60, 30, 120, 150)
                       for beta in forth + forth[::-1]])


def tilt_alpha(_: np.random.Generator) -> Motion:
    """Turn alpha from −180 to 180° by 30° at beta 0 (figure 10a)."""
    return _visit_deg([(angle, 0) for angle in range(-180, 181, 30)])


def tilt_beta(_: np.random.Generator) -> Motion:
    """Turn beta at alpha 90°: the paper says 0, where beta does not show (figure 10b)."""
    return _visit_deg([(90, angle) for angle in range(-180, 181, 30)])


def tilt_both(_: np.random.Generator) -> Motion:
    """Turn both together from −180 to 180° by 30° (figure 10c)."""
    return _visit_deg([(angle, angle) for angle in range(-180, 181, 30)])


def motion(_: np.random.Generator) -> Motion:
    """Shake 60 µm p-p at 10 Hz along x at alpha 45°, beta 90° for 20 s (figures 11 and 12)."""
    return Motion(20.0, Held(np.pi / 4), Held(np.pi / 2), Sine(30e-6, 10.0))


def shaker(_: np.random.Generator) -> Motion:
    """Shake along x by 1 m/s², 2 to 40 Hz, stroke 13 mm p-p, with x level, up and down."""
    script, shakes = Script(np.pi / 2, np.pi / 2), []
    for beta in (np.pi / 2, 0.0, np.pi):
        script.go(np.pi / 2, beta)
        shakes.append(_shake(script))
    alpha, beta_path = script.joints()
    return Motion(script.now, alpha, beta_path, Sum(tuple(shakes)))


def soak(_: np.random.Generator) -> Motion:
    """Rest for 30 min while temperature (25, 40, 10, 25 °C) and supply step."""
    temperature_c = Steps(NOMINAL_TEMPERATURE_C,
                          ((300, 40), (750, 10), (1200, NOMINAL_TEMPERATURE_C)), 60.0)
    supply_v = Steps(NOMINAL_SUPPLY_V, ((150, 4.8), (225, NOMINAL_SUPPLY_V), (1575, 5.2),
                                        (1690, NOMINAL_SUPPLY_V)), 0.5)
    return Motion(1800.0, Held(np.radians(60)), Held(np.radians(30)),
                  temperature_c=temperature_c, supply_v=supply_v, internal_rate_hz=10.0)


def tumble(rng: np.random.Generator) -> Motion:
    """Rest in 40 directions drawn evenly over the sphere."""
    alpha = np.degrees(np.arccos(rng.uniform(-1, 1, 40)))
    return _visit_deg(list(zip(alpha, rng.uniform(0, 360, 40))))


def rich(_: np.random.Generator) -> Motion:
    """Do all of it in 7 min: planes at two speeds, reversals, shaker, warm spell, supply step."""
    script, shakes = Script(np.pi / 2, 0.0), []
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
    for size in np.radians([20, 10, 5]):
        for joint in ('beta', 'alpha'):
            middle = getattr(script, joint)
            for to in (middle + size, middle - size, middle):
                script.run(joint, to, size / 2)
            script.rest(1.0)
    script.go(np.pi / 4, np.pi / 2)
    shakes.append(_shake(script))
    for alpha, beta in np.radians([(0, 0), (90, 90), (180, 90), (90, 270), (90, 180), (30, 30)]):
        script.go(alpha, beta)
        script.rest(DWELL_S)
    end = script.now
    temperature_c = Steps(NOMINAL_TEMPERATURE_C,
                          ((0.25 * end, 35.0), (0.6 * end, NOMINAL_TEMPERATURE_C)), 30.0)
    supply_v = Steps(NOMINAL_SUPPLY_V, ((0.4 * end, 4.85), (0.8 * end, NOMINAL_SUPPLY_V)), 0.5)
    return Motion(end, *script.joints(), Sum(tuple(shakes)), temperature_c=temperature_c,
                  supply_v=supply_v)


def _shake(script: Script) -> SweptSine:
    script.rest(2.0)
    begin = script.now
    script.rest(_SHAKE_S + 2.0)
    return SweptSine(begin, _SHAKE_S)


def _visit_deg(poses: Sequence[tuple[float, float]]) -> Motion:
    return visit([(np.radians(a), np.radians(b)) for a, b in poses])


TRAJECTORIES: dict[str, Callable[[np.random.Generator], Motion]] = {
    f.__name__: f for f in (sweep, tilt_alpha, tilt_beta, tilt_both, motion, shaker, soak,
                            tumble, rich)}
