# SPDX-License-Identifier: Apache-2.0

"""Manoeuvres and their commands keep the limits of the stage."""

from adxl_ros.investigate.manoeuvres import (
    CATALOGUE,
    CommandStream,
    LONGEST_STEP_S,
    plan,
    Pose,
    StageLimits,
)
from adxl_ros.simulate.simulated_stage import SimulatedStage
from adxl_ros.simulate.trajectories import RUN_UP_S
import numpy as np
import pytest

FULL = StageLimits((0.0, np.pi), (0.0, 2 * np.pi), 0.3)
NARROW = StageLimits((0.2, 0.3), (-0.1, 0.05), 0.02)
ODD = StageLimits((-2.0, 0.4), (3.0, 3.5), 2.0)


def times_of(manoeuvre, step_s=0.02):
    return manoeuvre.begin_s + np.arange(0, manoeuvre.motion.duration_s + step_s, step_s)


@pytest.mark.parametrize('name', CATALOGUE)
@pytest.mark.parametrize('limits', [FULL, NARROW, ODD])
def test_a_manoeuvre_keeps_angle_and_rate_and_begins_and_ends_at_rest(name, limits):
    pose = limits.nearest(0.1, 0.2)
    manoeuvre = plan(name, limits, pose, 100.0)
    time_s = times_of(manoeuvre)
    for path, (low, high), start, end in zip(
        (manoeuvre.motion.alpha, manoeuvre.motion.beta),
        (limits.alpha_rad, limits.beta_rad),
        pose,
        manoeuvre.end,
    ):
        angle = path(time_s)
        assert low - 1e-9 <= angle.min() <= angle.max() <= high + 1e-9
        assert np.abs(path(time_s, 1)).max() <= limits.rate_rad_s * (1 + 1e-9)
        assert (angle[0], angle[-1]) == pytest.approx((start, end))
        assert path(time_s[[0, -1]], 1) == pytest.approx(0)
    assert manoeuvre.minutes == pytest.approx((time_s[-1] - 100) / 60, abs=0.001)


@pytest.mark.parametrize('name', CATALOGUE)
@pytest.mark.parametrize('limits', [FULL, NARROW, ODD])
def test_commands_keep_the_limits_however_late_the_calls_are(name, limits):
    rng = np.random.default_rng(3)
    pose = limits.nearest(0.1, 0.2)
    stream = CommandStream(limits, plan(name, limits, pose), pose)
    last = pose
    while not stream.is_done:
        elapsed_s = rng.choice([0.001, 0.02, 0.1, 3.0])
        command = stream.advance(elapsed_s, last)
        assert limits.nearest(*command) == command
        largest = limits.rate_rad_s * min(elapsed_s, LONGEST_STEP_S) + 1e-12
        assert max(abs(c - p) for c, p in zip(command, last)) <= largest
        last = command
    assert last == pytest.approx(plan(name, limits, pose).end, abs=1e-6)


def test_a_stage_moves_evenly_although_commands_come_late():
    """The speed is what the manoeuvre has, not what the distance of two commands suggests."""
    rng = np.random.default_rng(1)
    stage = SimulatedStage(np.zeros(3), np.full(3, 3.0), 0.3, np.zeros(3), 0)
    manoeuvre = plan('fast_turn_of_beta', FULL, Pose(0.0, 0.0))
    stream, pose, rates = CommandStream(FULL, manoeuvre, Pose(0.0, 0.0)), Pose(0.0, 0.0), []
    while not stream.is_done:
        steps = int(rng.integers(1, 15))
        command = stream.advance(0.01 * steps, pose)
        stage.command(
            dict(zip(('alpha', 'beta'), command)), dict(zip(('alpha', 'beta'), stream.speed))
        )
        for _ in range(steps):
            stage.step(0.01)
            rates.append(stage.velocity[1])
        pose = Pose(*stage.position[:2])
    turning = np.abs(rates)[100:1000]
    assert turning.max() < 1.01 * FULL.rate_rad_s
    assert np.abs(np.diff(rates)).max() / 0.01 < 4 * FULL.rate_rad_s / RUN_UP_S
