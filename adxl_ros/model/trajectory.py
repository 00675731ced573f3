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

"""Manoeuvres of the stage: what `simulate` can be asked for."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

SLEW_RAD_S = np.pi / 4
"""Fastest turn of the stage; a 30° step then takes 1.25 s."""
DWELL_S = 5.0
"""The paper averages 5 s a pose."""
SETTLE_S = 0.2


@dataclass(frozen=True)
class Motion:
    """True joint motion at a constant rate: angles in rad, m and m/s², each (n,)."""

    time_s: np.ndarray
    alpha_rad: np.ndarray
    beta_rad: np.ndarray
    shift_m: np.ndarray
    shift_acceleration_mps2: np.ndarray


def visit(poses_rad: Sequence[tuple[float, float]], rate_hz: float,
          dwell_s: float = DWELL_S) -> Motion:
    """
    Rest in each pose (alpha, beta) and move between them by the least jerk at the slew rate.

    Minimum jerk is 10·u³ − 15·u⁴ + 6·u⁵, whose speed peaks at 1.875 times the mean.
    """
    poses = np.asarray(poses_rad, float)
    times, angles, now = [], [], 0.0
    for before, pose in zip(np.vstack([poses[:1], poses[:-1]]), poses):
        duration = 1.875 * np.abs(pose - before).max() / SLEW_RAD_S
        u = np.linspace(0, 1, max(int(duration * rate_hz), 1), endpoint=False)[:, None]
        times.append(now + u[:, 0] * duration)
        angles.append(before + (pose - before) * u ** 3 * (10 - 15 * u + 6 * u * u))
        rest = np.linspace(0, 1, max(int((dwell_s + SETTLE_S) * rate_hz), 1), endpoint=False)
        times.append(now + duration + rest * (dwell_s + SETTLE_S))
        angles.append(np.broadcast_to(pose, (len(rest), 2)))
        now += duration + dwell_s + SETTLE_S
    time_s = np.arange(int(now * rate_hz)) / rate_hz
    at = np.concatenate(times)
    alpha, beta = (np.interp(time_s, at, np.concatenate(angles)[:, joint]) for joint in range(2))
    still = np.zeros_like(time_s)
    return Motion(time_s, alpha, beta, still, still)


def sweep(rate_hz: float, _: np.random.Generator) -> Motion:
    """Visit planes alpha 90, 60, 30, 120, 150°, forth and back (experiments 1 and 2)."""
    forth = list(range(0, 361, 30))
    return _visit_deg([(alpha, beta) for alpha in (90, 60, 30, 120, 150)
                       for beta in forth + forth[::-1]], rate_hz)


def tilt_alpha(rate_hz: float, _: np.random.Generator) -> Motion:
    """Turn alpha from −180 to 180° by 30° at beta 0 (figure 10a)."""
    return _visit_deg([(angle, 0) for angle in range(-180, 181, 30)], rate_hz)


def tilt_beta(rate_hz: float, _: np.random.Generator) -> Motion:
    """Turn beta at alpha 90°: the paper says 0, where beta does not show (figure 10b)."""
    return _visit_deg([(90, angle) for angle in range(-180, 181, 30)], rate_hz)


def tilt_both(rate_hz: float, _: np.random.Generator) -> Motion:
    """Turn both together from −180 to 180° by 30° (figure 10c)."""
    return _visit_deg([(angle, angle) for angle in range(-180, 181, 30)], rate_hz)


def motion(rate_hz: float, _: np.random.Generator) -> Motion:
    """Shake 60 µm p-p at 10 Hz along x at alpha 45°, beta 90° for 20 s (figures 11 and 12)."""
    time_s = np.arange(int(20 * rate_hz)) / rate_hz
    omega, amplitude_m = 2 * np.pi * 10, 30e-6
    shift = amplitude_m * np.sin(omega * time_s)
    return Motion(time_s, np.full_like(time_s, np.pi / 4), np.full_like(time_s, np.pi / 2),
                  shift, -omega ** 2 * shift)


def tumble(rate_hz: float, rng: np.random.Generator) -> Motion:
    """Rest in 40 directions drawn evenly over the sphere."""
    alpha = np.degrees(np.arccos(rng.uniform(-1, 1, 40)))
    return _visit_deg(list(zip(alpha, rng.uniform(0, 360, 40))), rate_hz)


def _visit_deg(poses: Sequence[tuple[float, float]], rate_hz: float) -> Motion:
    return visit([(np.radians(a), np.radians(b)) for a, b in poses], rate_hz)


TRAJECTORIES: dict[str, Callable[[float, np.random.Generator], Motion]] = {
    f.__name__: f for f in (sweep, tilt_alpha, tilt_beta, tilt_both, motion, tumble)}
