# SPDX-License-Identifier: Apache-2.0

"""The live comparison without ROS: residual, floor, changes, and faults of the streams."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from adxl_ros.model.sensor import Sensor, to_nominal_mps2
from adxl_ros.monitor.changes import GapChange
from adxl_ros.monitor.live_gap import GapSettings, LiveGap
from adxl_ros.monitor.reference_stream import ReferenceKind, RobotForce
from adxl_ros.simulate.motion import ForcePath, Held, Motion
from adxl_ros.simulate.response import Response
from adxl_ros.simulate.robot import Robot
import numpy as np
import pytest
from robots import encoded, urdf
from units import nominal, with_effects

RATE_HZ = 200.0
UNIT = nominal('xyz', rate_hz=RATE_HZ, stage_resolution_rad=0.0)
ORIGIN_NS = 1_700_000_000 * 10**9
EFFECTS = ('misalignment', 'temperature_bias', 'hysteresis')


class Swing:
    """A joint that swings; or rests where the amplitude is 0."""

    def __init__(self, amplitude: float, rate: float) -> None:
        self._amplitude, self._rate = amplitude, rate

    def __call__(self, time_s: np.ndarray, order: int = 0) -> np.ndarray:
        phase = self._rate * time_s + order * np.pi / 2
        return (0.7 if not order else 0.0) + self._amplitude * self._rate**order * np.sin(phase)


class World:
    """A sensor on a stage, or beside a simulator, whose samples a comparison gets."""

    def __init__(
        self,
        truth: Sensor,
        params: Sensor,
        kind: ReferenceKind = ReferenceKind.STAGE,
        amplitude: float = 0.5,
        step_rad: float = 0.0,
    ) -> None:
        self._truth, self._kind, self._step_rad = truth, kind, step_rad
        self._joints = Swing(amplitude, 0.6), Swing(2 * amplitude, 0.37)
        self._respond = self._response(truth)
        self.live = LiveGap(params, kind, GapSettings(window_s=20.0))
        self.step = 0
        self.offset_ns = 0
        self.reference_until = np.inf

    def _response(self, sensor: Sensor) -> Response:
        motion = (
            Motion(np.inf, *self._joints, Held(), force=self._force)
            if self._kind is ReferenceKind.IMU
            else Motion(np.inf, *self._joints, Held())
        )
        return Response(sensor, motion, 3)

    @staticmethod
    def _force(time_s: np.ndarray) -> list[np.ndarray]:
        return [3 * np.sin(time_s), 2 * np.cos(0.7 * time_s), 9 + np.sin(0.3 * time_s)]

    def run(
        self, seconds: int, change: Callable[[np.ndarray], np.ndarray] = lambda a: a
    ) -> list[GapChange]:
        changes = []
        for _ in range(seconds * 10):
            time_s = (self.step + np.arange(20)) / RATE_HZ
            stamps = ORIGIN_NS + self.offset_ns + np.rint(time_s * 1e9).astype(np.int64)
            accel = change(to_nominal_mps2(self._respond(time_s), self._truth))
            self.live.add_samples(stamps, accel)
            if self.step / RATE_HZ < self.reference_until:
                self._refer(time_s[::2], stamps[::2])
            changes += self.live.advance()
            self.step += 20
        return changes

    def _refer(self, time_s: np.ndarray, stamps: np.ndarray) -> None:
        reference = self.live.reference
        if self._kind is ReferenceKind.IMU:
            reference.add_readings(stamps, np.column_stack(self._force(time_s)))
            return
        for i, stamp in enumerate(stamps.tolist()):
            angles = [float(joint(time_s[i : i + 1])[0]) for joint in self._joints]
            if self._step_rad:
                angles = [round(angle / self._step_rad) * self._step_rad for angle in angles]
            reference.add_joints([stamp], [dict(zip(('alpha', 'beta'), angles))])


def gaps(world: World) -> list[float]:
    """Return the gaps by axis, mg."""
    return [axis.gap.value for axis in world.live.report()]


@pytest.mark.parametrize('kind', [ReferenceKind.STAGE, ReferenceKind.IMU])
@pytest.mark.parametrize('amplitude', [0.0, 0.5])
def test_the_gap_of_the_right_parameters_is_the_floor(
    kind: ReferenceKind, amplitude: float
) -> None:
    sensor = with_effects(UNIT, EFFECTS)
    world = World(sensor, sensor, kind, amplitude)
    assert not world.run(40)
    for axis in world.live.report():
        assert axis.gap.value == pytest.approx(axis.floor.value, rel=0.1)
        assert axis.gap.low <= axis.gap.value <= axis.gap.high
        assert not axis.is_open
    assert world.live.obstacle == ''


@pytest.mark.long
def test_a_robot_is_a_reference(tmp_path: Path) -> None:
    """Readings of its coarse encoders come in pieces, between those of another device."""
    pytest.importorskip('pinocchio')
    (tmp_path / 'robot.urdf').write_text(urdf([('0 0 1', '0 0 0.3'), ('0 1 0', '0.2 0 0.1')]))
    robot, joints = Robot(tmp_path / 'robot.urdf', 'imu_link'), (Swing(0.8, 0.9), Swing(0.6, 1.3))
    time_s = np.arange(0, 46, 0.002)
    swung = np.array([[joint(time_s, order) for joint in joints] for order in range(3)])
    force = ForcePath(time_s, robot.motion(swung.transpose(0, 2, 1), None, 9.80665).force_mps2)
    sensor = Response(UNIT, Motion(np.inf, force=force), 3)
    live = LiveGap(UNIT, ReferenceKind.ROBOT, GapSettings(window_s=20.0))
    stream = RobotForce(robot, 9.80665)
    for part in np.arange(9000).reshape(-1, 40):
        time_s, stamps = part / RATE_HZ, ORIGIN_NS + part * 5_000_000
        live.add_samples(stamps, to_nominal_mps2(sensor(time_s), UNIT))
        angles = encoded(np.array([joint(time_s) for joint in joints]), 5e-5)
        stream.add([*stamps, stamps[0]], [*({'j1': q, 'j2': p} for q, p in angles.T), {'grip': 1}])
        stream.send(live.reference)
        assert not live.advance()
    for axis in live.report():
        assert axis.gap.value == pytest.approx(axis.floor.value, rel=0.15)


def test_a_change_of_the_mean_and_of_the_noise() -> None:
    world = World(UNIT, UNIT)
    rng = np.random.default_rng(1)
    assert not world.run(80)
    (step,) = world.run(20, lambda a: a + [0.0, 0.05, 0.0])
    assert (step.axis, step.quantity) == ('y', 'mean')
    assert step.size == pytest.approx(0.05 / 9.80665e-3, rel=0.1)
    assert (step.since_ns - ORIGIN_NS) * 1e-9 == pytest.approx(80, abs=1)
    noise = world.run(60, lambda a: a + [0.0, 0.05, 0.0] + 0.03 * rng.standard_normal(a.shape))
    assert {(change.axis, change.quantity) for change in noise} >= {('z', 'noise')}
    assert all(change.size > 2 for change in noise if change.quantity == 'noise')


@pytest.mark.long
@pytest.mark.parametrize('mg_per_min', [0.02, 10.0])
def test_a_ramp_from_the_first_second_is_a_change_if_no_healthy_unit_drifts_so(
    mg_per_min: float,
) -> None:
    world = World(UNIT, UNIT, amplitude=0.0)
    changes = world.run(
        150, lambda a: a + [0.0, mg_per_min * world.step / RATE_HZ / 60 * 9.80665e-3, 0.0]
    )
    assert {change.axis for change in changes} == ({'y'} if mg_per_min > 1 else set())


def test_faults_of_the_samples_are_counted() -> None:
    world = World(UNIT, UNIT)
    world.run(20)

    def broken(accel: np.ndarray) -> np.ndarray:
        accel[3] = np.nan
        return accel

    world.run(1, broken)
    assert world.live.counts['dropped'] == 10
    world.step += 7
    world.run(2)
    assert world.live.counts['missing'] == 10 + 7
    world.offset_ns -= 300 * 10**9
    world.run(30)
    assert world.live.counts['jumps'] == 1
    assert np.isfinite(gaps(world)).all() and len(gaps(world)) == 3
    world.offset_ns += 300 * 10**9
    world.run(30)
    assert world.live.counts['jumps'] == 2
    assert not any(axis.is_open for axis in world.live.report())


def test_memory_is_bounded_and_the_recording_has_the_newest_samples() -> None:
    world = World(UNIT, UNIT)
    world.live = LiveGap(UNIT, ReferenceKind.STAGE, GapSettings(history_s=60.0))
    world.run(100)
    recording = world.live.diagnosis_input().recording
    assert recording.time_s[-1] == pytest.approx(60, abs=0.1)
    assert {'ax_mps2', 'alpha_rad', 'beta_rad'} <= set(recording.columns)
    assert np.isfinite(recording.columns['alpha_rad'][100:-100]).all()
    stamps_ns, _ = world.live._samples.between(0, world.live.newest_ns + 1)
    assert len(stamps_ns) < 5 * 60 * RATE_HZ
