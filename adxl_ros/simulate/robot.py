# SPDX-License-Identifier: Apache-2.0

"""
A robot as the reference: the specific force in a frame of its URDF, by its joint encoders.

Pinocchio has the kinematics. Joints are smoothed as those of a stage, so that their derivatives
are known; what the steps of the encoders leave open is simulated, and is the error of the force.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
import os
from typing import Any, NamedTuple

from adxl_ros.errors import install_hint, one_line, UserError
from adxl_ros.files import robot_readings
from adxl_ros.files.atomic_write import AnyPath
from adxl_ros.files.recording_columns import Recording
from adxl_ros.files.robot_readings import JointTrack, RobotReadings
from adxl_ros.files.stamps import mean_period_s, stamped_rate_hz
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.effects.base import Components
from adxl_ros.model.error_sizes import rms
from adxl_ros.report.quantities import mg
from adxl_ros.simulate.motion import ForcePath, Held, INTERNAL_RATE_HZ, Motion, Path
from adxl_ros.simulate.smoothed_path import KNOT_S, noise_step, PathErrors, SmoothedPath
from adxl_ros.wording import option
import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import uniform_filter1d
from scipy.spatial.transform import Rotation

_HIGHEST_RATE_HZ = 1000.0  # Highest rate of the kinematics, Hz. Chosen: that of the simulator
_PER_READING = 2  # Evaluations of the kinematics a reading. Chosen: splines join them
_KNOT_READINGS = 4
"""Largest distance of the knots of a joint's spline, in readings. Chosen: jerks of a move then
show, and the penalty still averages over the steps of an encoder."""
_SMALLEST_STEP = 1e-9  # Step of an exact encoder, rad or m. Chosen: rounding in a log
_LONGEST_GAP_S = 0.1  # Longest time without a reading of a joint, s. Chosen: a robot moves within
_USUAL_GAPS = 5.0  # The same in usual gaps. Chosen: a message may be late
_AROUND_S = 0.3  # Time around which the error of the force is taken, s. Chosen: a part of a move
_OFFSET_RAD = 1e-4  # Offset of a joint whose effect is taken, rad. Chosen: linear to 1e-4
_COMPLIANCE_S2 = 1e-5  # Compliance whose effect is taken, s². Chosen: a resonance of 50 Hz


class FrameMotion(NamedTuple):
    """Motion of a frame over time, in the frame, (n, 3) each."""

    force_mps2: np.ndarray  # Specific force
    rate_radps: np.ndarray  # Angular rate
    acceleration_radps2: np.ndarray  # Angular acceleration
    up: np.ndarray  # Unit vector


class _JointMotion(NamedTuple):
    """Motion of joints as pinocchio has it, (n, k) each."""

    position: np.ndarray
    rate: np.ndarray
    acceleration: np.ndarray


class Robot:
    """The kinematics of a robot, from its joints to one frame."""

    def __init__(self, urdf: AnyPath, frame: str, moves: bool = False) -> None:
        """Read a URDF; `frame` is a link or frame, and a base that moves is a free joint."""
        try:
            import pinocchio
        except ImportError:
            raise UserError(
                f'{option("urdf")} needs pinocchio: apt install ros-jazzy-pinocchio, or '
                f'{install_hint("pin")}'
            ) from None
        self._pin: Any = pinocchio
        if not os.path.isfile(urdf):
            raise UserError(
                f'{urdf or "urdf"}: no such file; give the URDF (xacro FILE > robot.urdf)'
            )
        with open(urdf, encoding='utf-8', errors='replace') as file:
            if '<xacro:' in file.read():
                raise UserError(f'{urdf}: is a xacro; expand it by xacro FILE > robot.urdf')
        try:
            free = (pinocchio.JointModelFreeFlyer(),) if moves else ()
            model = pinocchio.buildModelFromUrdf(str(urdf), *free)
        except Exception as error:
            raise UserError(f'{urdf}: no URDF that pinocchio reads: {one_line(error)}') from None
        if not model.existFrame(frame):
            raise UserError(
                f'{urdf}: no frame {frame}; it has {", ".join(f.name for f in model.frames)}'
            )
        chain = [
            model.names[i]
            for i in model.supports[model.frames[model.getFrameId(frame)].parentJoint]
            if i
        ]
        self.joints = tuple(chain[moves:])  # Names of the joints between base and frame
        fixed = [i for i in range(1, model.njoints) if model.names[i] not in chain]
        self._model = pinocchio.buildReducedModel(model, fixed, pinocchio.neutral(model))
        self._data = self._model.createData()
        self._frame = self._model.getFrameId(frame)
        self.frame = frame
        self.urdf = str(urdf)
        # Name of the link that the base is
        self.root = model.frames[1 + moves].name if model.nframes > 1 else ''

    def motion(
        self, joints: np.ndarray, base: np.ndarray | None, gravity_mps2: float
    ) -> FrameMotion:
        """
        Return the motion of the frame.

        joints: position, rate and acceleration, (3, n, j); base: the same of its x, y, z and
        quaternion x, y, z, w, (3, n, 7).
        """
        pin = self._pin
        model = self._model
        data = self._data
        count = joints.shape[1]
        q = np.zeros((count, model.nq))
        v, a = np.zeros((2, count, model.nv))
        if base is not None:
            free = _free_flyer(base)
            q[:, :7] = free.position
            v[:, :6] = free.rate
            a[:, :6] = free.acceleration
        for number, name in enumerate(self.joints):
            joint = model.joints[model.getJointId(name)]
            angle, v[:, joint.idx_v], a[:, joint.idx_v] = joints[:, :, number]
            # Pinocchio has cosine and sine of a joint without limits.
            q[:, joint.idx_q : joint.idx_q + joint.nq] = np.column_stack(
                [angle] if joint.nq == 1 else [np.cos(angle), np.sin(angle)]
            )
        moved = FrameMotion(*np.empty((4, len(q), 3)))
        up = np.array([0.0, 0.0, 1.0])
        for i in range(len(q)):
            pin.forwardKinematics(model, data, q[i], v[i], a[i])
            turn = pin.updateFramePlacement(model, data, self._frame).rotation.T
            vertical = turn @ up
            acceleration = pin.getFrameClassicalAcceleration(model, data, self._frame, pin.LOCAL)
            rate = pin.getFrameVelocity(model, data, self._frame, pin.LOCAL)
            moved.force_mps2[i] = acceleration.linear + gravity_mps2 * vertical
            moved.rate_radps[i] = rate.angular
            moved.acceleration_radps2[i] = acceleration.angular
            moved.up[i] = vertical
        return moved


def _free_flyer(base: np.ndarray) -> _JointMotion:
    """Return the motion of a free joint."""
    x, dx, ddx = base[:, :, :3]
    norm = np.linalg.norm(base[0, :, 3:], axis=1, keepdims=True)
    q, dq, ddq = base[:, :, 3:] / norm
    v, w = q[:, :3], q[:, 3:]

    def turning(derivative: np.ndarray) -> np.ndarray:
        """Return twice the vector part of the inverse quaternion times a derivative, (n, 3)."""
        vector, scalar = derivative[:, :3], derivative[:, 3:]
        return 2 * (w * vector - v * scalar - np.cross(v, vector))

    omega, alpha = turning(dq), turning(ddq)
    to_body = Rotation.from_quat(q).inv()
    velocity, acceleration = to_body.apply(dx), to_body.apply(ddx)
    return _JointMotion(
        np.hstack([x, q]),
        np.hstack([velocity, omega]),
        np.hstack([acceleration - np.cross(omega, velocity), alpha]),
    )


class RobotPath(ForcePath):
    """Specific force in a frame of a robot, and what errors of the robot would add to it."""

    name = 'the robot'
    is_robot = True

    def __init__(
        self,
        robot: Robot,
        readings: RobotReadings,
        gravity_mps2: float = G0_MPS2,
        since_s: float = -np.inf,
    ) -> None:
        """Smooth the readings, and run the kinematics from a time on, s."""
        self._robot = robot
        self._gravity_mps2 = gravity_mps2
        self._tracks = _tracks(robot, readings)
        self._steps = [noise_step(t.values, _SMALLEST_STEP, t.time_s) for t in self._tracks]
        times_s = [track.time_s for track in self._tracks]
        begin_s = max(each_s[0] for each_s in times_s)
        end_s = min(each_s[-1] for each_s in times_s)
        rate_hz = min(_PER_READING * max(map(stamped_rate_hz, times_s)), _HIGHEST_RATE_HZ)
        grid_s = np.linspace(begin_s, end_s, max(int((end_s - begin_s) * rate_hz), 8))
        for each_s in times_s:
            # Nothing is known in a gap, however smoothly the spline bridges it.
            gaps_s = np.append(np.diff(each_s), 0.0)
            longest_s = max(_LONGEST_GAP_S, _USUAL_GAPS * float(np.median(gaps_s)))
            grid_s = grid_s[gaps_s[np.searchsorted(each_s, grid_s, 'right') - 1] <= longest_s]
        grid_s = grid_s[grid_s >= since_s]
        self._splines = self._smooth(self._tracks)
        self._smoothed = _derivatives(self._splines, grid_s)
        self.motion = self._moved(self._smoothed)
        super().__init__(grid_s, np.hstack(list(self.motion)))
        self.joints = robot.joints
        self.wanders = readings.base is not None

    def _smooth(self, tracks: Sequence[JointTrack]) -> list[Path]:
        """Return smooth paths through tracks with the steps of the encoders."""
        paths: list[Path] = []
        for (time_s, values), step in zip(tracks, self._steps):
            if np.ptp(values):
                knot_s = min(KNOT_S, _KNOT_READINGS * mean_period_s(time_s))
                paths.append(SmoothedPath(time_s, values, step, is_seen=True, knot_s=knot_s))
            else:
                paths.append(Held(float(values[0])))
        return paths

    def _moved(self, tracks: np.ndarray) -> FrameMotion:
        count = len(self._robot.joints)
        base = tracks[:, :, count:] if tracks.shape[2] > count else None
        return self._robot.motion(tracks[:, :, :count], base, self._gravity_mps2)

    def rotation(self, time_s: np.ndarray) -> tuple[Components, Components]:
        """Return angular rate, rad/s, and acceleration, rad/s², in the frame, by component."""
        moved = self._motion_at(time_s)
        return list(moved.rate_radps.T), list(moved.acceleration_radps2.T)

    def _motion_at(self, time_s: np.ndarray) -> FrameMotion:
        """Return the motion of the frame at times, s, (n,)."""
        return FrameMotion(*np.split(np.column_stack(self.at(time_s)), 4, axis=1))

    def as_motion(self) -> Motion:
        """Return the motion that a sensor in the frame follows."""
        rate_hz = stamped_rate_hz(self.time_s)
        return Motion(
            float(np.ptp(self.time_s)), force=self, internal_rate_hz=max(rate_hz, INTERNAL_RATE_HZ)
        )

    def text(self) -> str:
        """Return what is known of the robot, for people."""
        error_mg = mg(rms(self.error_mps2))
        return (
            f'{self._robot.frame} moves by {", ".join(self.joints) or "its base"}, from '
            f'{self.time_s[0]:.3g} to {self.time_s[-1]:.3g} s; the encoders leave an error of '
            f'{error_mg:.2g} mg rms'
        )

    @property
    def step_rad(self) -> float:
        """Step of one encoder whose error is that of all joints together, rad."""
        return float(np.sqrt(np.sum(np.square(self._steps[: len(self.joints)]))))

    def with_angles(self, read: Recording) -> Recording:
        """Add the angles of a stage that turns the sensor as the robot does; see `angles`."""
        known = (read.time_s >= self.time_s[0]) & (read.time_s <= self.time_s[-1])
        alpha_rad, beta_rad = np.where(known, self.angles(read.time_s), np.nan)
        return replace(
            read, columns={**read.columns, 'alpha_rad': alpha_rad, 'beta_rad': beta_rad}
        )

    def angles(self, time_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """
        Return alpha and beta of a stage that turns the frame as the robot does, rad, (n,) each.

        Gravity at rest is g·[sin α·cos β, −sin α·sin β, cos α].
        """
        x, y, z = self._motion_at(time_s).up.T
        return np.arctan2(np.hypot(x, y), z), np.unwrap(np.arctan2(-y, x))

    @cached_property
    def modes(self) -> dict[str, np.ndarray]:  # type: ignore[override]
        """
        Force per unit of each error of the robot, at `time_s`, (n, 3).

        `joint1` ... per rad, or m, of an offset of a joint. `flexible` per s²: all joints follow
        their encoders by q − c·d²q/dt², as links that yield to their inertia. `late_acceleration`
        per s of the time by which the acceleration is later than the attitude.
        """
        smoothed = self._smoothed
        force_mps2 = self.motion.force_mps2
        modes = {}
        for number in range(len(self._robot.joints)):
            moved = smoothed.copy()
            moved[0, :, number] += _OFFSET_RAD
            change_mps2 = self._moved(moved).force_mps2 - force_mps2
            modes[f'joint{number + 1}'] = change_mps2 / _OFFSET_RAD
        lag = CubicSpline(self.time_s, smoothed[2])
        yielded = smoothed.copy()
        count = len(self._robot.joints)
        yielded[:, :, :count] -= _COMPLIANCE_S2 * np.array(
            [lag(self.time_s, order)[:, :count] for order in range(3)]
        )
        modes['flexible'] = (self._moved(yielded).force_mps2 - force_mps2) / _COMPLIANCE_S2
        modes['late_acceleration'] = -self._acceleration_rate()
        return modes

    def _acceleration_rate(self) -> np.ndarray:
        """Return how fast the acceleration changes in the world, in the frame, m/s³, (n, 3)."""
        force_mps2, rate_radps, _, up = self.motion
        acceleration_mps2 = force_mps2 - self._gravity_mps2 * up
        in_frame = CubicSpline(self.time_s, acceleration_mps2)(self.time_s, 1)
        return in_frame + np.cross(rate_radps, acceleration_mps2)

    def errors(self, time_s: np.ndarray, component: int) -> PathErrors:
        """
        Return what is to be expected of the error of one component, m/s², at times, s, (n,).

        Standard deviation and memory are those of rounding and smoothing around each time. The
        error forgets its past at the rate by which it changes, divided by its size: the
        correlation of neighbours on a grid that is finer than the changes would say far less.
        """
        error = self.error_mps2[:, component]
        around = max(round(_AROUND_S / (self.time_s[1] - self.time_s[0])), 3)

        def rms_around(values: np.ndarray) -> np.ndarray:
            return np.sqrt(np.maximum(uniform_filter1d(values**2, around), 0.0))

        size = rms_around(error)
        rate = rms_around(np.gradient(error, self.time_s))
        return PathErrors(
            np.interp(time_s, self.time_s, size),
            np.interp(time_s, self.time_s, rate / np.maximum(size, _SMALLEST_STEP)),
        )

    @cached_property
    def smoothing_mps2(self) -> np.ndarray:
        """
        Return what half of the readings would change, m/s², at `time_s`, (n, 3).

        A spline through every second reading of the smoothed motion lacks what jerks within a
        few readings, as the motion itself does.
        """
        halved = [
            JointTrack(track.time_s[::2], path(track.time_s[::2]))
            for track, path in zip(self._tracks, self._splines)
        ]
        return self._change_mps2(halved)

    @cached_property
    def error_mps2(self) -> np.ndarray:
        """
        Draw the error by the steps of the encoders and by smoothing, m/s², at `time_s`, (n, 3).

        The smoothed motion is read by encoders whose steps lie elsewhere, and smoothed again.
        """
        rng = np.random.default_rng(0)
        encoded = []
        for (time_s, values), step, path in zip(self._tracks, self._steps, self._splines):
            read = path(time_s)
            offset = step * rng.random()
            if step and np.ptp(values):
                read = np.rint((read + offset) / step) * step - offset
            encoded.append(JointTrack(time_s, read))
        return self._change_mps2(encoded) + self.smoothing_mps2

    def _change_mps2(self, tracks: Sequence[JointTrack]) -> np.ndarray:
        """Return by how much the force of other readings differs, m/s², at `time_s`, (n, 3)."""
        moved = self._moved(_derivatives(self._smooth(tracks), self.time_s))
        return moved.force_mps2 - self.motion.force_mps2


def _derivatives(paths: Sequence[Path], time_s: np.ndarray) -> np.ndarray:
    """Return derivatives 0 to 2 of paths at times, s, (3, n, k)."""
    return np.array([[path(time_s, order) for path in paths] for order in range(3)]).transpose(
        0, 2, 1
    )


def _tracks(robot: Robot, readings: RobotReadings) -> list[JointTrack]:
    """Return the readings of the chain's joints, and then of the base's coordinates."""
    missing = [name for name in robot.joints if name not in readings.joints]
    if missing:
        raise UserError(
            f'{readings.path}: no position of {", ".join(missing)}, which '
            f'{"move" if len(missing) > 1 else "moves"} {robot.frame} in {robot.urdf}; recorded '
            f'are {", ".join(readings.joints) or "no joints"}'
        )
    tracks = {}
    for name in robot.joints:
        read = readings.joints[name]
        tracks[name] = read._replace(values=np.unwrap(read.values))
    if readings.base is not None:
        time_s, pose = readings.base
        # A quaternion and its negative are the same turn: neighbours get the same sign.
        is_turned = np.sum(pose[1:, 3:] * pose[:-1, 3:], axis=1) < 0
        signs = np.cumprod(np.append(1.0, np.where(is_turned, -1.0, 1.0)))
        steady = np.hstack([pose[:, :3], pose[:, 3:] * signs[:, None]])
        for axis, values in zip(('x', 'y', 'z', 'qx', 'qy', 'qz', 'qw'), steady.T):
            tracks[f'base {axis}'] = JointTrack(time_s, values)
    if not tracks:
        raise UserError(
            f'{robot.urdf}: no joint moves {robot.frame}, and {readings.path} has no '
            'pose of a moving base; record odom, or tf'
        )
    for name, track in tracks.items():
        if len(track.time_s) < 8:
            raise UserError(
                f'{readings.path}: {name} has {len(track.time_s)} finite readings whose '
                'stamps differ; at least 8 are needed'
            )
    return list(tracks.values())


def robot_path(
    urdf: AnyPath,
    frame: str,
    path: str,
    epoch_ns: int,
    gravity_mps2: float = G0_MPS2,
    topic: str = '',
    columns: Mapping[str, np.ndarray] | None = None,
) -> RobotPath:
    """
    Return the specific force in a frame of a robot, by `robot_readings.read` of a recording.

    columns: those of a recording that is no file.
    """
    robot = Robot(urdf, frame)
    readings = (
        robot_readings.read(path, epoch_ns, topic, robot.root, bool(robot.joints))
        if columns is None
        else robot_readings.of_columns(path, columns)
    )
    if readings.base is not None:
        robot = Robot(urdf, frame, moves=True)
    return RobotPath(robot, readings, gravity_mps2)
