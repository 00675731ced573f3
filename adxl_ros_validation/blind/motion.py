# SPDX-License-Identifier: Apache-2.0
"""Manoeuvres of this world: sequences of moves, rich or poor, with temperature and supply."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import numpy as np
import scipy

POOR = ('one_way', 'crawl', 'few_poses', 'together', 'one_plane')
"""Kinds of manoeuvres that cannot separate all effects."""


Curve = Callable[[np.ndarray], np.ndarray]


def low_pass(values: np.ndarray, lag: float, dt: float) -> np.ndarray:
    """Filter by one slow pole that is at rest before the first value."""
    keep = np.exp(-dt / lag)
    first = values[..., :1]
    return first + scipy.signal.lfilter([1 - keep], [1, -keep], values - first)


def smooth(x: np.ndarray) -> np.ndarray:
    """Return the share of a move without a jump of velocity or acceleration at either end."""
    return x**3 * (10 - 15 * x + 6 * x * x)


def still_air(t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return 25 °C and 5 V."""
    return np.full_like(t, 25.0), np.full_like(t, 5.0)


def _fade(u: np.ndarray) -> np.ndarray:
    """Fade in and out over a fifth of the duration, with three derivatives."""
    edge = np.clip(np.minimum(u, 1 - u) / 0.2, 0, 1)
    return edge**4 * (35 - 84 * edge + 70 * edge**2 - 20 * edge**3)


@dataclass
class Manoeuvre:
    """Knots of the joints, with swings and bursts of the shaker added, and the environment."""

    kind: str = ''
    time: list[float] = field(default_factory=lambda: [0.0])  # instants of the knots, s
    # joint angles at the knots, rad
    alpha: list[float] = field(default_factory=lambda: [np.pi / 2])
    beta: list[float] = field(default_factory=lambda: [0.0])
    # joint, amplitude (rad or m), first and last frequency (Hz), start and end (s) of each swing
    swings: list[tuple[str, float, float, float, float, float]] = field(default_factory=list)
    share: Curve = smooth  # share of a move that is done at a share of its time
    fade: Curve = _fade  # amplitude of a swing at a share of its time
    # temperature, °C, and supply, V, at instants, s
    climate: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]] = still_air

    @property
    def seconds(self) -> float:
        """Return the duration so far, s."""
        return self.time[-1]

    def rest(self, seconds: float) -> None:
        """Stay for some seconds."""
        self.go(seconds=seconds)

    def go(
        self, alpha: float | None = None, beta: float | None = None, seconds: float = 0.0
    ) -> None:
        """Move joints to where they should be, rad, at once."""
        self.time.append(self.seconds + seconds)
        self.alpha.append(self.alpha[-1] if alpha is None else alpha)
        self.beta.append(self.beta[-1] if beta is None else beta)

    def swing(
        self, joint: str, size: float, hertz: float, seconds: float, to_hertz: float | None = None
    ) -> None:
        """Swing a joint about its position; a frequency that changes keeps the acceleration."""
        self.swings.append(
            (joint, size, hertz, to_hertz or hertz, self.seconds, self.seconds + seconds)
        )
        self.rest(seconds)

    def joints(self, t: np.ndarray) -> dict[str, np.ndarray]:
        """Return alpha and beta (rad) and shift (m) at instants t (s)."""
        knots = np.asarray(self.time)
        i = np.clip(np.searchsorted(knots, t, 'right') - 1, 0, len(knots) - 2)
        share = self.share(np.clip((t - knots[i]) / (knots[i + 1] - knots[i]), 0, 1))
        joints = {'shift': np.zeros_like(t)}
        for name in ('alpha', 'beta'):
            angles = np.asarray(getattr(self, name))
            joints[name] = angles[i] + (angles[i + 1] - angles[i]) * share
        for joint, size, first, last, start, stop in self.swings:
            a, b = np.searchsorted(t, [start, stop])
            since = t[a:b] - start
            u = since / (stop - start)
            cycles = since * (first + (last - first) * u / 2)
            joints[joint][a:b] += (
                size
                * (first / (first + (last - first) * u)) ** 2
                * self.fade(u)
                * np.sin(2 * np.pi * cycles)
            )
        return joints


def draw(
    rng: np.random.Generator, seconds: tuple[float, float], rate_hz: float, kind: str | None = None
) -> Manoeuvre:
    """Draw a manoeuvre; a quarter of them are poor."""
    length = rng.uniform(*seconds)
    if kind is None:
        kind = str(rng.choice(POOR)) if rng.random() < 0.25 else 'rich'
    script = Manoeuvre(kind)
    script.beta[0] = rng.uniform(-np.pi, np.pi)
    script.rest(rng.uniform(1.5, 3.0))
    # The shaker stays below the 50 Hz of the filter.
    moves: dict[str, Callable[[Manoeuvre, float, np.random.Generator], None]] = {
        'rich': partial(_rich, min(22.0, rate_hz / 10)),
        'one_way': _one_way,
        'crawl': _crawl,
        'few_poses': _few_poses,
        'together': _few_poses,
        'one_plane': _one_plane,
    }
    moves[kind](script, length, rng)
    script.rest(rng.uniform(1.0, 2.0))
    temperature, supply = (law(kind, script.seconds, rng) for law in (_temperature, _supply))
    script.climate = lambda t: (np.interp(t, *temperature), np.interp(t, *supply))
    return script


def _rich(fastest_hz: float, script: Manoeuvre, length: float, rng: np.random.Generator) -> None:
    moves = [_plane, _tilts, _swing_beta, partial(_shake, fastest_hz), _plane, _swing_alpha, _dash]
    while True:
        for i in rng.permutation(len(moves)):
            if script.seconds > length:
                return
            moves[i](script, rng)


def _plane(script: Manoeuvre, rng: np.random.Generator) -> None:
    alpha = np.deg2rad(rng.uniform(25, 155))
    script.go(alpha, script.beta[-1], rng.uniform(1.0, 2.5))
    step, start = rng.uniform(0.7, 1.5), script.beta[-1]
    count = int(rng.integers(3, 6))
    for direction in [1] * count + [-1] * count:
        script.go(alpha, script.beta[-1] + direction * step, step / rng.uniform(0.6, 2.0))
        script.rest(rng.uniform(0.6, 1.4))
    script.go(alpha, start + rng.normal(0, 0.3), 1.0)


def _tilts(script: Manoeuvre, rng: np.random.Generator) -> None:
    beta = script.beta[-1]
    for _ in range(int(rng.integers(4, 7))):
        script.go(np.deg2rad(rng.uniform(5, 175)), beta, rng.uniform(0.8, 2.5))
        script.rest(rng.uniform(0.5, 1.3))


def _swing_beta(script: Manoeuvre, rng: np.random.Generator) -> None:
    script.go(np.deg2rad(rng.uniform(50, 130)), script.beta[-1], 1.5)
    script.swing('beta', rng.uniform(0.4, 0.9), rng.uniform(0.25, 0.9), rng.uniform(9, 15))


def _swing_alpha(script: Manoeuvre, rng: np.random.Generator) -> None:
    script.go(np.deg2rad(rng.uniform(60, 120)), script.beta[-1] + rng.uniform(-1, 1), 1.5)
    script.swing('alpha', rng.uniform(0.2, 0.5), rng.uniform(0.25, 0.8), rng.uniform(8, 12))


def _shake(fastest_hz: float, script: Manoeuvre, rng: np.random.Generator) -> None:
    for _ in range(2):
        hertz = np.exp(rng.uniform(np.log(3), np.log(fastest_hz)))
        size = rng.uniform(0.8, 3.5) / (2 * np.pi * hertz) ** 2
        script.swing('shift', size, hertz, rng.uniform(4, 7))


def _dash(script: Manoeuvre, rng: np.random.Generator) -> None:
    for _ in range(5):
        turn = rng.uniform(0.8, 2.2) * rng.choice([-1, 1])
        script.go(
            float(np.clip(script.alpha[-1] + rng.normal(0, 0.4), 0.1, 3.0)),
            script.beta[-1] + turn,
            abs(turn) / rng.uniform(2.0, 3.5),
        )
        script.rest(rng.uniform(0.3, 0.9))


def _one_way(script: Manoeuvre, length: float, rng: np.random.Generator) -> None:
    """Turn in one plane, in one direction, at one speed."""
    alpha, step = np.deg2rad(rng.uniform(70, 110)), rng.uniform(0.35, 0.6)
    script.alpha[:] = [alpha] * len(script.alpha)
    while script.seconds < 0.6 * length:
        script.go(alpha, script.beta[-1] + step, step / 0.5)
        script.rest(1.2)


def _crawl(script: Manoeuvre, length: float, rng: np.random.Generator) -> None:
    """Turn slowly between random poses."""
    while script.seconds < 0.8 * length:
        script.go(
            np.deg2rad(rng.uniform(30, 150)),
            script.beta[-1] + rng.uniform(-2, 2),
            rng.uniform(12, 20),
        )
        script.rest(2.0)


def _few_poses(script: Manoeuvre, length: float, rng: np.random.Generator) -> None:
    """Visit five or six poses, each once."""
    count = int(rng.integers(5, 7))
    for _ in range(count):
        script.go(np.deg2rad(rng.uniform(20, 160)), rng.uniform(-np.pi, np.pi), 3.0)
        script.rest(0.7 * length / count - 3.0)


def _one_plane(script: Manoeuvre, length: float, rng: np.random.Generator) -> None:
    """Turn in the vertical plane only, forward and backward, at one speed."""
    script.alpha[:] = [np.pi / 2] * len(script.alpha)
    step = rng.uniform(0.5, 0.9)
    while script.seconds < 0.7 * length:
        for direction in [1] * 7 + [-1] * 7:
            script.go(np.pi / 2, script.beta[-1] + direction * step, step / 0.7)
            script.rest(1.0)


def _temperature(kind: str, end: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    t = np.arange(0.0, end + 1.0, 0.5)
    start = rng.uniform(22, 28)
    if kind == 'together':
        return t, start + rng.uniform(4, 10) * t / end
    if kind != 'rich':
        return t, start + 0.15 * np.sin(2 * np.pi * t / rng.uniform(60, 200))
    # A heater switches on and off; the plate follows with two time constants.
    heat = np.zeros_like(t)
    for _ in range(2):
        on = rng.uniform(0, 0.75) * end
        heat[(t > on) & (t < on + rng.uniform(0.15, 0.4) * end)] += rng.uniform(5, 16)
    for lag in (rng.uniform(8, 18), rng.uniform(3, 8)):
        heat = low_pass(heat, lag, 0.5)
    return t, start + heat


def _supply(kind: str, end: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    t = np.arange(0.0, end + 1.0, 0.25)
    volts = np.full_like(t, 5.0 + rng.normal(0, 0.002))
    if kind == 'together':
        volts -= rng.uniform(0.02, 0.06) * t / end
    elif kind == 'rich':
        steps = np.zeros_like(t)
        for _ in range(int(rng.integers(3, 6))):
            on = rng.uniform(0, 0.9) * end
            steps[(t > on) & (t < on + rng.uniform(6, 30))] += rng.choice([-1, 1]) * rng.uniform(
                0.02, 0.07
            )
        volts += low_pass(steps, 0.7, 0.25)
    return t, volts
