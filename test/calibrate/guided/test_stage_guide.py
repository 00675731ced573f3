# SPDX-License-Identifier: Apache-2.0

"""The guided sweep without ROS: its waits, its messages and its accepted poses."""

from adxl_ros.calibrate.guided.pose_plan import guided, Target
from adxl_ros.calibrate.guided.screen_contents import CaptureSettings, Phase, StageMode
from adxl_ros.calibrate.guided.stage_guide import StageGuide
from adxl_ros.errors import UserError
from adxl_ros_validation.experiments import sweep as paper_sweep
import numpy as np
import pytest
from units import Bench, nominal

TARGETS = [Target(np.pi / 2, 0.0), Target(np.pi / 2, np.pi / 6)]


def _bench(mode='commanded', **changes):
    sensor = nominal(**changes)
    settings = CaptureSettings(
        dwell_s=5.0, tolerance_rad=0.0035, timeout_s=20.0, stage_mode=StageMode(mode)
    )
    return Bench(StageGuide(sensor, TARGETS, settings), sensor)


def test_a_pose_keeps_its_full_dwell():
    """A pose is 5000 samples at rest after arrival, with the deviation of 237 samples."""
    bench = _bench()
    entry = bench.run(10, np.pi / 2, 0.0)
    assert entry.samples == 5000
    assert entry.stop_ns - entry.start_ns == 4_999_000_000
    assert entry.std_v[0] == pytest.approx(0.535e-3 / np.sqrt(237), rel=0.8)
    assert entry.mean_v[0] == pytest.approx(3.5, abs=3e-4)


def test_no_pose_is_accepted_before_arrival_and_the_distance_is_stated():
    bench = _bench()
    assert bench.run(3, np.pi / 2, np.radians(3)) is None
    state = bench.sweep.status()
    assert (state.phase, state.late) == (Phase.STAGE, False)
    assert 'beta is 3.0° from the target 0°' in state.text
    bench.run(20, np.pi / 2, np.radians(3))
    state = bench.sweep.status()
    assert state.late
    assert 'for 23 s' in state.text


@pytest.mark.parametrize('mode, beta', [('encoder', 0.02), ('manual', 0.0)])
def test_a_pose_is_taken_after_the_capture_of_the_operator(mode, beta):
    bench = _bench(mode)
    assert bench.run(7, np.pi / 2, 0.02, encoder=mode == 'encoder') is None
    assert bench.sweep.status().phase is Phase.OPERATOR
    captured_ns = bench.now_ns
    bench.sweep.capture()
    entry = bench.run(7, np.pi / 2, 0.02, encoder=mode == 'encoder')
    assert entry.start_ns >= captured_ns - 1_000_000
    assert entry.beta_rad == pytest.approx(beta)


def test_the_plan_of_the_paper_and_refused_settings():
    """Planes have steps of 30° in both directions, and check poses are beside the grid."""
    targets = paper_sweep([np.pi / 2, 0.5], np.radians(30), 8)
    assert len(targets) == 2 * 26 + 8
    beta = np.degrees([t.beta_rad for t in targets[:26]])
    np.testing.assert_allclose(beta, [*range(0, 361, 30), *range(360, -1, -30)])
    assert [t.check for t in targets].count(True) == 8
    with pytest.raises(UserError, match='names no plane'):
        guided([], 0.5, 0)
    with pytest.raises(UserError, match='sweep.step_deg: 0 is'):
        guided([1.0], 0.0, 0)


def test_the_guided_order_saves_travel_and_reaches_angles_from_both_sides():
    planes = np.radians([90, 30, 150, 60, 120])
    targets = guided(planes, np.radians(30), 16)
    paper = paper_sweep(sorted(planes), np.radians(30), 16)

    def poses(plan):
        return sorted((t.check, t.alpha_rad, t.beta_rad) for t in plan)

    # Check poses are in whole degrees, because an operator without an encoder sets them.
    difference_deg = np.abs(np.degrees(np.array(poses(targets)) - poses(paper)))
    assert difference_deg[:130].max() < 1e-9 and 0.1 < difference_deg[130:].max() <= 0.5
    checks = np.degrees([(t.alpha_rad, t.beta_rad) for t in targets if t.check])
    np.testing.assert_allclose(checks, np.round(checks), atol=1e-9)
    travel, paper_travel = (
        np.abs(np.diff([(t.alpha_rad, t.beta_rad) for t in plan], axis=0)).max(axis=1).sum()
        for plan in (targets, paper)
    )
    assert travel < 0.75 * paper_travel
    grid = [t for t in targets if not t.check]
    for joint, count in (('alpha_rad', 5), ('beta_rad', 13)):
        sides = {}
        now, side = getattr(grid[0], joint), 0.0
        for target in grid[1:]:
            side = np.sign(getattr(target, joint) - now) or side
            now = getattr(target, joint)
            sides.setdefault(round(now, 6), set()).add(side)
        assert len(sides) == count
        inner = sorted(sides)[1:-1]
        assert all(sides[angle] == {1.0, -1.0} for angle in inner), joint
    assert {round(t.alpha_rad, 6) for t in grid[:65]} == set(np.round(planes, 6))
