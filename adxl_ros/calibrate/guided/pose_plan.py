# SPDX-License-Identifier: Apache-2.0

"""The pose plan, and checks of a pose: one line on what is wrong and what to do, or empty."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass

from adxl_ros.errors import UserError
from adxl_ros.files.sweep_journal import PoseRecord
from adxl_ros.model.sensor import Sensor
from adxl_ros.report.quantities import signed
import numpy as np

ORDER = 3  # Version of the order of `guided`; an interrupted sweep resumes only in the same order
KINDS = ('full', 'quick')
"""Kinds of plans: planes as in the paper, or the fewest poses that reach a tilt error."""
STEP_RAD = float(np.radians(30.0))  # Step of beta, rad, as in the paper
MOVE_S = 5.0  # Time of a move with settling, s; chosen: it is used until poses show the real time
_FLAT = 0.2
"""Lower bound of |sin α| of the planes that show beta well, as in equation (15) of the paper."""
_ROUNDING = 1e-6  # Largest rounding error of the sine of a multiple of a quarter turn
_GOLDEN_RAD = np.pi * (3 - np.sqrt(5))  # The golden angle, rad
_HIGHEST_COSINE = 0.97
"""Cosine of alpha at the ends of the spiral of `spread`; chosen: inclined poses show beta."""
_CHANGE_G = 0.003
"""Largest change of a repeated pose beyond noise and stage error, g; chosen: a turn of 0.17°."""
_NOISE_STDS = 3.0  # Stds of the noise in the limit of a change; chosen: exceeded once in 400


@dataclass(frozen=True)
class Target:
    """One pose to visit."""

    alpha_rad: float
    beta_rad: float
    check: bool = False  # Whether the pose is kept out of the fit, to show how good the fit is


def default_planes_rad(axes: str) -> tuple[float, ...]:
    """Return the planes alpha of a sweep, rad; without level ones z is calibrated to 0.87 g."""
    first_deg, last_deg = (0.0, 180.0) if 'z' in axes else (30.0, 150.0)
    return tuple(np.radians(np.arange(first_deg, last_deg + 1, 30.0)).tolist())


def guided(planes_rad: Sequence[float], step_rad: float, check_poses: int) -> list[Target]:
    """
    Plan the planes of the paper for a real stage, whose joints keep their error until they move.

    Beta turns forth and then back. At each angle beta, alpha goes through all planes, up and down
    in turn: with one setting for a plane, the error of that setting would not average out. Each
    pose is reached in both directions of both joints. Where |sin alpha| < 0.2 beta hardly shows,
    and quarter turns of beta are enough. Check poses follow in whole degrees, as on a scale.
    """
    forth = _turn(planes_rad, step_rad)
    planes = np.array(sorted({float(alpha) for alpha in planes_rad}))
    inclined = np.abs(np.sin(planes)) >= _FLAT
    grid = []
    for i, beta in enumerate((*forth, *forth[::-1])):
        is_quarter_turn = abs(np.sin(2 * beta)) < _ROUNDING
        visited = planes if is_quarter_turn or not inclined.any() else planes[inclined]
        grid += [Target(float(alpha), float(beta)) for alpha in visited[:: -1 if i % 2 else 1]]
    return with_checks(grid, check_poses)


def with_checks(targets: list[Target], check_poses: int) -> list[Target]:
    """Add check poses in whole degrees, each the nearest to the pose before."""
    angles_deg = np.degrees([(t.alpha_rad, t.beta_rad) for t in spread(check_poses)])
    checks = [
        Target(alpha_rad, beta_rad, True)
        for alpha_rad, beta_rad in np.radians(np.round(angles_deg)).tolist()
    ]
    return targets + nearest(targets[-1], checks)


class Course:
    """The poses of a plan: which are taken or left out, and which is to be taken next."""

    def __init__(
        self, targets: Sequence[Target], accepted: Collection[int], skipped: Iterable[int]
    ) -> None:
        self.targets = targets
        self.accepted = accepted  # Numbers of the taken ones
        self.skipped = set(skipped) - set(accepted)  # Numbers of those that are left out
        self.index = self.next_open()  # Number of the pose to go to, from 0

    @property
    def target(self) -> Target | None:
        """Return the pose to go to; None at the end."""
        return self.targets[self.index] if self.index < len(self.targets) else None

    @property
    def closed(self) -> set[int]:
        """Return the numbers of the poses that are taken or left out."""
        return self.skipped.union(self.accepted)

    def next_open(self) -> int:
        """Return the number of the first open pose; the number of poses if none is."""
        return min({*range(len(self.targets))} - self.closed, default=len(self.targets))


def _turn(planes_rad: Sequence[float], step_rad: float) -> np.ndarray:
    """Return the angles beta of a turn, rad; refuse a plan without planes or with a wrong step."""
    if not len(planes_rad) or not np.all(np.isfinite(planes_rad)):
        raise UserError('sweep.planes_deg: names no plane; give at least one angle alpha')
    if not 2 * np.pi / 720 <= step_rad <= np.pi / 2 + 1e-9:
        raise UserError(f'sweep.step_deg: {np.degrees(step_rad):g} is not between 0.5 and 90')
    return np.arange(round(2 * np.pi / step_rad) + 1) * step_rad


def nearest(start: Target, targets: list[Target]) -> list[Target]:
    """Order poses so that each one is the nearest to the pose before."""
    remaining = list(targets)
    path = [start]
    while remaining:
        path.append(
            min(
                remaining,
                key=lambda target: max(
                    abs(path[-1].alpha_rad - target.alpha_rad),
                    abs(path[-1].beta_rad - target.beta_rad),
                ),
            )
        )
        remaining.remove(path[-1])
    return path[1:]


def spread(count: int) -> list[Target]:
    """Spread check poses evenly over the sphere by a golden spiral."""
    index = np.arange(count)
    alpha = np.arccos(_HIGHEST_COSINE - 2 * _HIGHEST_COSINE * (index + 0.5) / max(count, 1))
    beta = (index * _GOLDEN_RAD) % (2 * np.pi)
    return [
        Target(alpha_rad, beta_rad, True)
        for alpha_rad, beta_rad in zip(alpha.tolist(), beta.tolist())
    ]


def by_plane(targets: Sequence[Target], accepted: Collection[int]) -> str:
    """Count the poses of a plan by plane and by direction of travel, and the check poses."""
    planes = np.round(np.degrees([target.alpha_rad for target in targets]))
    grid = np.array([not target.check for target in targets])
    turn = np.diff([target.beta_rad for target in targets], prepend=0)
    turn[:1] = 0
    groups = {f'{plane:.0f}°': grid & (planes == plane) for plane in dict.fromkeys(planes[grid])}
    groups |= {
        'beta forth': grid & (turn > 0),
        'beta back': grid & (turn < 0),
        'check poses': ~grid,
    }
    taken = np.isin(np.arange(len(targets)), list(accepted))
    return ', '.join(
        f'{name} {(taken & group).sum()}/{group.sum()}'
        for name, group in groups.items()
        if group.any()
    )


def angle_fault(target: Target, alpha_rad: float, beta_rad: float, tolerance_rad: float) -> str:
    """Refuse a stage that is not at the pose."""
    return ', '.join(
        f'{name} is {np.degrees(abs(now - wanted)):.1f}° from the target {np.degrees(wanted):.4g}°'
        for name, now, wanted in (
            ('alpha', alpha_rad, target.alpha_rad),
            ('beta', beta_rad, target.beta_rad),
        )
        if abs(now - wanted) > tolerance_rad
    )


def turn_fault(sensor: Sensor, change_v: np.ndarray, near_rad: float) -> str:
    """Refuse a mean that differs from that of the capture by a change, V, (m,)."""
    change_g = np.abs(change_v) / sensor.nominal_scale_v_per_g
    axis = int(change_g.argmax())
    if change_g[axis] < np.sin(near_rad):
        return ''
    return (
        f'the pose changed after the capture: {sensor.axes[axis]} moved by '
        f'{change_g[axis]:.2f} g; hold the stage still until the pose is taken'
    )


def saturation_fault(sensor: Sensor, volts: np.ndarray) -> str:
    """Refuse samples, V, (n, m), at a rail of the ADC or beyond the range of the sensor."""
    rows, columns = np.nonzero(sensor.saturated(volts))
    if not len(rows):
        return ''
    axis = int(columns[0])
    reading_v = volts[rows[0], axis]
    reading_g = (reading_v - sensor.nominal_zero_g_v[axis]) / sensor.nominal_scale_v_per_g[axis]
    return (
        f'saturated: {sensor.axes[axis]} reads {signed(reading_g)} g '
        f'({reading_v:.3f} V), beyond its range of ±{sensor.range_g:g} g or at a rail of the '
        'ADC; check supply and wiring'
    )


def changed(sensor: Sensor, before: PoseRecord, now: PoseRecord, tolerance_rad: float) -> str:
    """Compare two readings of the same pose, before and after an interruption."""
    before_v, now_v = np.array(before.mean_v), np.array(now.mean_v)
    change_g = np.abs(now_v - before_v) / sensor.nominal_scale_v_per_g
    noise_g = np.hypot(before.std_v, now.std_v) / sensor.nominal_scale_v_per_g
    # The stage may be off by its tolerance both times.
    limit_g = _CHANGE_G + _NOISE_STDS * noise_g + 2 * tolerance_rad
    axis = int((change_g - limit_g).argmax())
    if change_g[axis] <= limit_g[axis]:
        return ''
    return (
        f'mounting changed: in pose {before.pose + 1} {sensor.axes[axis]} reads '
        f'{now_v[axis]:.4f} V, but read {before_v[axis]:.4f} V before the interruption '
        f'({change_g[axis] * 1e3:.1f} mg apart, {limit_g[axis] * 1e3:.1f} mg are allowed); '
        'put the sensor back as it was, or begin again with resume:=anew'
    )
