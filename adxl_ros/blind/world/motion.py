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

"""Manoeuvres of this world: acts strung together, rich or poor, with temperature and supply."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

POOR = ('one_way', 'crawl', 'few_poses', 'together', 'one_plane')


@dataclass
class Script:
    """Knots of the joints, swings laid over them, and bursts of the shaker."""

    time: list[float] = field(default_factory=lambda: [0.0])
    alpha: list[float] = field(default_factory=lambda: [np.pi / 2])
    beta: list[float] = field(default_factory=lambda: [0.0])
    swings: list[tuple[str, float, float, float, float]] = field(default_factory=list)
    fastest_hz: float = 22.0

    @property
    def end(self) -> float:
        """When the last knot is."""
        return self.time[-1]

    def rest(self, seconds: float) -> None:
        """Stay."""
        self.go(self.alpha[-1], self.beta[-1], seconds)

    def go(self, alpha: float, beta: float, seconds: float) -> None:
        """Move within so many seconds, without a jerk at either end."""
        self.time.append(self.end + seconds)
        self.alpha.append(alpha)
        self.beta.append(beta)

    def swing(self, joint: str, size: float, hertz: float, seconds: float) -> None:
        """Swing a joint about where it is (rad, or m of the shaker)."""
        self.swings.append((joint, size, hertz, self.end, self.end + seconds))
        self.rest(seconds)


@dataclass(frozen=True)
class Manoeuvre:
    """What was done and what it was like; `seconds` long, laws of time as knots."""

    kind: str
    script: Script
    temperature: tuple[np.ndarray, np.ndarray]
    supply: tuple[np.ndarray, np.ndarray]

    @property
    def seconds(self) -> float:
        """How long it takes."""
        return self.script.end

    def joints(self, t: np.ndarray) -> dict[str, np.ndarray]:
        """Give alpha, beta (rad) and shift (m) at times t (s)."""
        knots = np.asarray(self.script.time)
        i = np.clip(np.searchsorted(knots, t, 'right') - 1, 0, len(knots) - 2)
        x = np.clip((t - knots[i]) / (knots[i + 1] - knots[i]), 0, 1)
        blend = x ** 3 * (10 - 15 * x + 6 * x * x)
        out = {'shift': np.zeros_like(t)}
        for name in ('alpha', 'beta'):
            at = np.asarray(getattr(self.script, name))
            out[name] = at[i] + (at[i + 1] - at[i]) * blend
        for joint, size, hertz, start, stop in self.script.swings:
            a, b = np.searchsorted(t, [start, stop])
            u = (t[a:b] - start) / (stop - start)
            # Fades in and out over a fifth of its length each, three times differentiable.
            edge = np.clip(np.minimum(u, 1 - u) / 0.2, 0, 1)
            fade = edge ** 4 * (35 - 84 * edge + 70 * edge ** 2 - 20 * edge ** 3)
            out[joint][a:b] += size * fade * np.sin(2 * np.pi * hertz * (t[a:b] - start))
        return out

    def climate(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Give temperature (degC) and supply (V) at times t (s)."""
        return np.interp(t, *self.temperature), np.interp(t, *self.supply)


def draw(rng: np.random.Generator, seconds: tuple[float, float], rate_hz: float,
         kind: str | None = None) -> Manoeuvre:
    """
    Draw a manoeuvre; a quarter are poor.

    Parameters
    ----------
    rng
        Draws.
    seconds
        Shortest and longest.
    rate_hz
        Of the recording: nothing moves so fast that a period has less than ten samples.
    kind
        One of `POOR`, or rich; drawn if None.

    """
    length = rng.uniform(*seconds)
    if kind is None:
        kind = str(rng.choice(POOR)) if rng.random() < 0.25 else 'rich'
    script = Script(fastest_hz=min(22.0, rate_hz / 10))
    script.beta[0] = rng.uniform(-np.pi, np.pi)
    script.rest(rng.uniform(1.5, 3.0))
    {'rich': _rich, 'one_way': _one_way, 'crawl': _crawl, 'few_poses': _few_poses,
     'together': _few_poses, 'one_plane': _one_plane}[kind](script, length, rng)
    script.rest(rng.uniform(1.0, 2.0))
    return Manoeuvre(kind, script, _temperature(kind, script.end, rng),
                     _supply(kind, script.end, rng))


def _rich(script: Script, length: float, rng: np.random.Generator) -> None:
    acts = [_plane, _tilts, _swing_beta, _shake, _plane, _swing_alpha, _dash]
    while True:
        for i in rng.permutation(len(acts)):
            if script.end > length:
                return
            acts[i](script, rng)


def _plane(script: Script, rng: np.random.Generator) -> None:
    alpha = np.deg2rad(rng.uniform(25, 155))
    script.go(alpha, script.beta[-1], rng.uniform(1.0, 2.5))
    step, start = rng.uniform(0.7, 1.5), script.beta[-1]
    count = int(rng.integers(3, 6))
    for way in [1] * count + [-1] * count:
        script.go(alpha, script.beta[-1] + way * step, step / rng.uniform(0.6, 2.0))
        script.rest(rng.uniform(0.6, 1.4))
    script.go(alpha, start + rng.normal(0, 0.3), 1.0)


def _tilts(script: Script, rng: np.random.Generator) -> None:
    beta = script.beta[-1]
    for _ in range(int(rng.integers(4, 7))):
        script.go(np.deg2rad(rng.uniform(5, 175)), beta, rng.uniform(0.8, 2.5))
        script.rest(rng.uniform(0.5, 1.3))


def _swing_beta(script: Script, rng: np.random.Generator) -> None:
    script.go(np.deg2rad(rng.uniform(50, 130)), script.beta[-1], 1.5)
    script.swing('beta', rng.uniform(0.4, 0.9), rng.uniform(0.25, 0.9), rng.uniform(9, 15))


def _swing_alpha(script: Script, rng: np.random.Generator) -> None:
    script.go(np.deg2rad(rng.uniform(60, 120)), script.beta[-1] + rng.uniform(-1, 1), 1.5)
    script.swing('alpha', rng.uniform(0.2, 0.5), rng.uniform(0.25, 0.8), rng.uniform(8, 12))


def _shake(script: Script, rng: np.random.Generator) -> None:
    for _ in range(2):
        hertz = np.exp(rng.uniform(np.log(3), np.log(script.fastest_hz)))
        size = rng.uniform(0.8, 3.5) / (2 * np.pi * hertz) ** 2
        script.swing('shift', size, hertz, rng.uniform(4, 7))


def _dash(script: Script, rng: np.random.Generator) -> None:
    for _ in range(5):
        turn = rng.uniform(0.8, 2.2) * rng.choice([-1, 1])
        script.go(float(np.clip(script.alpha[-1] + rng.normal(0, 0.4), 0.1, 3.0)),
                  script.beta[-1] + turn, abs(turn) / rng.uniform(2.0, 3.5))
        script.rest(rng.uniform(0.3, 0.9))


def _one_way(script: Script, length: float, rng: np.random.Generator) -> None:
    """One plane, one direction, one speed."""
    alpha, step = np.deg2rad(rng.uniform(70, 110)), rng.uniform(0.35, 0.6)
    script.alpha[:] = [alpha] * len(script.alpha)
    while script.end < 0.6 * length:
        script.go(alpha, script.beta[-1] + step, step / 0.5)
        script.rest(1.2)


def _crawl(script: Script, length: float, rng: np.random.Generator) -> None:
    """Slow turns, and back."""
    while script.end < 0.8 * length:
        script.go(np.deg2rad(rng.uniform(30, 150)), script.beta[-1] + rng.uniform(-2, 2),
                  rng.uniform(12, 20))
        script.rest(2.0)


def _few_poses(script: Script, length: float, rng: np.random.Generator) -> None:
    """Five or six poses, each once."""
    count = int(rng.integers(5, 7))
    for _ in range(count):
        script.go(np.deg2rad(rng.uniform(20, 160)), rng.uniform(-np.pi, np.pi), 3.0)
        script.rest(0.7 * length / count - 3.0)


def _one_plane(script: Script, length: float, rng: np.random.Generator) -> None:
    """Vertical plane only, forth and back, at one speed."""
    script.alpha[:] = [np.pi / 2] * len(script.alpha)
    step = rng.uniform(0.5, 0.9)
    while script.end < 0.7 * length:
        for way in [1] * 7 + [-1] * 7:
            script.go(np.pi / 2, script.beta[-1] + way * step, step / 0.7)
            script.rest(1.0)


def _temperature(kind: str, end: float,
                 rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    t = np.arange(0.0, end + 1.0, 0.5)
    start = rng.uniform(22, 28)
    if kind == 'together':
        return t, start + rng.uniform(4, 10) * t / end
    if kind != 'rich':
        return t, start + 0.15 * np.sin(2 * np.pi * t / rng.uniform(60, 200))
    # A heater goes on and off; the plate follows by two lags.
    heat = np.zeros_like(t)
    for _ in range(2):
        on = rng.uniform(0, 0.75) * end
        heat[(t > on) & (t < on + rng.uniform(0.15, 0.4) * end)] += rng.uniform(5, 16)
    for lag in (rng.uniform(8, 18), rng.uniform(3, 8)):
        heat = _lag(heat, 0.5, lag)
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
                0.02, 0.07)
        volts += _lag(steps, 0.25, 0.7)
    return t, volts


def _lag(values: np.ndarray, dt: float, lag: float) -> np.ndarray:
    out, keep = np.empty_like(values), np.exp(-dt / lag)
    level = values[0]
    for i, value in enumerate(values):
        level = value + (level - value) * keep
        out[i] = level
    return out
