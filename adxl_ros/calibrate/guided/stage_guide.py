# SPDX-License-Identifier: Apache-2.0

"""The guide of a sweep on a stage: samples and encoder angles go in, accepted poses come out."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

from adxl_ros.calibrate.guided import guide, pose_plan, running_estimate
from adxl_ros.calibrate.guided.guide import Dwell, EncoderTrack, Guide, NextPose, temperature_fault
from adxl_ros.calibrate.guided.pose_plan import Course, MOVE_S, Target
from adxl_ros.calibrate.guided.screen_contents import (
    CaptureSettings,
    EstimateRows,
    GuideStatus,
    Phase,
    ScreenRow,
    StageMode,
    tilt_row,
)
from adxl_ros.calibrate.joint_settings import angle_tolerance_rad, SettingTracker
from adxl_ros.errors import UserError
from adxl_ros.files.sweep_journal import JournalEntry, MountingUnchecked, PoseRecord, PoseSkipped
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.rest_search import Rest
import numpy as np

_LONGEST_DWELL_S = 60.0
"""Time beyond two dwells after which a moving sensor's samples are dropped, s; chosen: it bounds
the memory and the time of the rest detection."""
_FEWEST_INTERVALS = 2
"""Times between poses whose median predicts those of the open ones: the first alone has the time
in it in which an operator learns what to do."""


class MountingError(UserError):
    """The sensor is not mounted as it was before an interruption."""


class StageSweep(Guide):
    """Takes the poses of a plan: after arrival or capture a full dwell at rest is averaged."""

    def __init__(
        self,
        sensor: Sensor,
        targets: Sequence[Target],
        settings: CaptureSettings,
        accepted: Sequence[PoseRecord] = (),
        skipped: Iterable[int] = (),
    ) -> None:
        super().__init__(sensor, accepted)
        self.settings = settings
        self.moves_itself = settings.stage_mode is StageMode.COMMANDED
        self.uses_encoder = settings.stage_mode is not StageMode.MANUAL
        self.course = Course(targets, self.accepted, skipped)
        self.encoder = EncoderTrack()
        self.tracker = SettingTracker(angle_tolerance_rad(sensor), accepted)
        self.estimate = running_estimate.from_records(
            sensor, self.poses_to_fit(), settings.dwell_s
        )
        self.go(self.course.index)
        self.verify()

    @property
    def previous(self) -> int | None:
        """Return the previous pose, taken or left out, from 0; None where there is none."""
        before = {number for number in self.course.closed if number < self.course.index}
        return None if self.to_verify else max(before, default=None)

    def go(self, index: int) -> None:
        """Begin the attempt to take a pose, given by its number from 0."""
        self.course.index = index
        self.dwell: Dwell | None = None  # Samples since the arrival; None before it
        self.since_ns = self.newest_ns  # Newest stamp when the attempt began, ns
        self.refusal = ''
        target = self.course.target
        # In stage mode encoder an operator or a program gives the commands.
        if target is not None and self.settings.stage_mode is not StageMode.ENCODER:
            self.tracker.command(self.now_ns, target.alpha_rad, target.beta_rad)

    def restart_dwell(self) -> None:
        """Average from the next sample on."""
        self.dwell = Dwell(self.sensor, self.now_ns + 1)

    def verify(self) -> None:
        """Take the newest pose again before others, to check the mounting."""
        if self.course.target is not None and self.accepted:
            self.to_verify = [max(self.accepted.values(), key=lambda record: record.stop_ns)]
            self.go(self.to_verify[0].pose)

    def capture(self) -> str:
        """Take the pose in which the operator has put the sensor; return an obstacle or ''."""
        target = self.course.target
        if target is not None and self.settings.stage_mode is StageMode.ENCODER:
            silence = self.encoder.silence(self.now_ns)
            if self.encoder.angles_rad is None or silence:
                return f'{silence}: in stage.mode encoder its angle counts'
            fault = self.encoder.clock_fault() or pose_plan.angle_fault(
                target, *self.encoder.angles_rad, self.settings.near_rad
            )
            if fault:
                return f'{fault}; turn the stage there and capture again'
        self.refusal = ''
        self.restart_dwell()
        return ''

    def skip(self, append: Callable[[JournalEntry], None]) -> str:
        """Leave out the open pose, in the journal first; return a line for people, or ''."""
        number = self.pose_number
        if self.to_verify:
            append(MountingUnchecked())
            self.to_verify = []
            text = f'pose {number} is not taken again: the mounting is not checked'
        elif self.course.target is None:
            return ''
        else:
            append(PoseSkipped(self.course.index))
            self.course.skipped.add(self.course.index)
            self.accepted.pop(self.course.index, None)
            text = f'pose {number} is left out'
        self.go(self.course.next_open())
        return text

    def forget(self, number: int) -> str:
        """Forget a pose and go back to it; return a line for people."""
        self.accepted.pop(number, None)
        self.course.skipped.discard(number)
        # The rejected reading must not influence the prediction for the new one.
        self.estimate = running_estimate.from_records(
            self.sensor, self.poses_to_fit(), self.settings.dwell_s
        )
        self.go(number)
        return f'pose {number + 1} will be taken again'

    def read_encoder(self, stamp_ns: int, alpha_rad: float, beta_rad: float) -> None:
        """Take the angles of the stage."""
        if self.encoder.read(stamp_ns, alpha_rad, beta_rad, self.newest_ns):
            # A stage that has restarted may have moved in between.
            self.tracker.lose_track()
        if self.uses_encoder:
            self.tracker.read(stamp_ns, alpha_rad, beta_rad)
        target = self.course.target
        if not self.moves_itself or target is None:
            return
        distance_rad = max(abs(alpha_rad - target.alpha_rad), abs(beta_rad - target.beta_rad))
        if distance_rad > self.settings.tolerance_rad:
            self.dwell = None
        elif self.dwell is None:
            self.dwell = Dwell(self.sensor, stamp_ns)

    def read_command(self, alpha_rad: float, beta_rad: float) -> None:
        """Take a command that somebody gave the stage; in other modes the targets are these."""
        if self.settings.stage_mode is StageMode.ENCODER:
            self.tracker.command(self.now_ns, alpha_rad, beta_rad)

    def begin_stream(self, back_s: float) -> None:
        """Begin the pose again; the stage may have moved, and the sensor, too."""
        self._new_refusal = (
            f'imu/data_raw went back in time by {back_s:.0f} s: the pose begins again'
        )
        self.verify()
        self.tracker.lose_track()
        self.encoder.offsets_s.clear()
        self.since_ns = self.dwell = None

    def take_samples(self, stamps_ns: np.ndarray, volts: np.ndarray) -> None:
        """Add samples to the dwell of a stage that has arrived."""
        if self.since_ns is None:
            self.since_ns = int(stamps_ns[0])
        if self.dwell is not None:
            self.dwell.feed(stamps_ns, volts)

    def accept(self) -> PoseRecord | None:
        """Return the pose for the journal when a full dwell at rest is complete, else None."""
        target = self.course.target
        dwell = self.dwell
        if target is None or dwell is None or not self._is_complete(dwell):
            return None
        rest = dwell.full_rest(self._dwell_samples)
        if rest is None:
            self._restart_if_long(dwell)
            return None
        record = dwell.record(self.course.index, rest, self._dwell_samples)
        if self.uses_encoder and (self.encoder.newest_ns or 0) < record.stop_ns:
            self._refuse_silence()
            return None
        record = self._with_stage(record, target)
        if refusal := _fault(self, record, dwell, rest):
            self.refuse(refusal)
            return None
        if self.to_verify:
            _verify_mounting(self, record)
            return None
        return record

    @property
    def _dwell_samples(self) -> int:
        """Return the number of samples of a dwell."""
        return round(self.settings.dwell_s * self.sensor.rate_hz)

    def _is_complete(self, dwell: Dwell) -> bool:
        """Return whether a dwell has its samples, and angles are of the same clock."""
        has_fault = self.uses_encoder and self.encoder.clock_fault()
        return len(dwell) >= self._dwell_samples and not has_fault

    def _restart_if_long(self, dwell: Dwell) -> None:
        """Drop the samples of a sensor that has moved for too long."""
        age_s = len(dwell) / self.sensor.rate_hz
        is_long = age_s > _LONGEST_DWELL_S + 2 * self.settings.dwell_s
        if is_long and not dwell.at_rest():
            self.restart_dwell()

    def _refuse_silence(self) -> None:
        """Refuse a capture whose encoder has fallen silent; other stages are waited for."""
        silence = self.encoder.silence(self.now_ns)
        if silence and self.settings.stage_mode is StageMode.ENCODER:
            self.refuse(f'{silence}; capture again when it is back')

    def _with_stage(self, record: PoseRecord, target: Target) -> PoseRecord:
        """Return the record of a rest with its surroundings, and the angles of the stage."""
        span = record.start_ns, record.stop_ns
        angles_rad = target.alpha_rad, target.beta_rad
        if self.uses_encoder:
            readings_rad = self.tracker.between(*span)
            angles_rad = self.encoder.angles_rad or angles_rad
            if len(readings_rad):
                angles_rad = readings_rad.mean(axis=0).tolist()
        alpha_rad, beta_rad = angles_rad
        alpha, beta = self.tracker.settings(*span, alpha_rad, beta_rad)
        return replace(
            guide.with_ambient(record, self.readings),
            alpha_rad=alpha_rad,
            beta_rad=beta_rad,
            check=target.check,
            alpha_setting=alpha,
            beta_setting=beta,
        )

    def take(self, record: PoseRecord) -> None:
        """Count a pose that is on disk, and go on to the next open one."""
        self.accepted[record.pose] = record
        self.course.skipped.discard(record.pose)
        self.tracker.take(record.start_ns, record.stop_ns, record.alpha_rad, record.beta_rad)
        self.estimate = running_estimate.from_records(
            self.sensor, self.poses_to_fit(), self.settings.dwell_s, self.estimate
        )
        self.go(self.course.next_open())

    def refuse(self, reason: str) -> None:
        """Report a refusal once. A commanded stage averages again, an operator captures again."""
        super().refuse(reason)
        self.restart_dwell()
        if not self.moves_itself:
            self.dwell = None


def _fault(sweep: StageSweep, record: PoseRecord, dwell: Dwell, rest: Rest) -> str:
    """Return why a pose is refused, or ''."""
    settings = sweep.settings
    fault = ''
    if settings.stage_mode is StageMode.ENCODER:
        now_rad = sweep.encoder.angles_rad or (record.alpha_rad, record.beta_rad)
        fault = pose_plan.angle_fault(
            sweep.course.targets[record.pose], *now_rad, settings.near_rad
        )
    elif settings.stage_mode is StageMode.MANUAL:
        # Without an encoder the first rest shows where the operator captured.
        first_v = dwell.volts(dwell.rests()[0]).mean(axis=0)
        fault = pose_plan.turn_fault(
            sweep.sensor, np.array(record.mean_v) - first_v, settings.near_rad
        )
    fault = (
        fault
        or pose_plan.saturation_fault(sweep.sensor, dwell.volts(rest))
        or temperature_fault(sweep.accepted, record.temperature_c, settings.temperature_span_c)
    )
    if fault or sweep.to_verify:
        return fault
    return sweep.estimate.reading_fault(
        Target(record.alpha_rad, record.beta_rad), np.array(record.mean_v), settings.tolerance_rad
    )


def _verify_mounting(sweep: StageSweep, record: PoseRecord) -> None:
    """Compare a pose that is taken again with its first record, and go to the next pose."""
    before = sweep.to_verify[0]
    tolerance_rad = sweep.sensor.stage_resolution_rad
    if sweep.uses_encoder:
        # The encoder shows how far the stage is from the earlier angles.
        tolerance_rad += max(
            abs(record.alpha_rad - before.alpha_rad), abs(record.beta_rad - before.beta_rad)
        )
    else:
        tolerance_rad = max(tolerance_rad, sweep.settings.tolerance_rad)
    change = pose_plan.changed(sweep.sensor, before, record, tolerance_rad)
    if change and sweep.settings.stage_mode is not StageMode.MANUAL:
        raise MountingError(change)
    if change:
        sweep.refuse(f'{change}; or turn the stage to where it was, and capture again')
        return
    sweep.to_verify = []
    sweep.go(sweep.course.next_open())


class StageGuide(StageSweep):
    """Leads a stage, or the operator who turns it, through a sweep: it says what comes next."""

    @property
    def pose_number(self) -> int:
        """Return the number of the pose to go to, from 1."""
        return self.course.index + 1

    @property
    def open_poses(self) -> int:
        """Return the number of poses that are neither taken nor left out."""
        return len(self.course.targets) - len(self.course.closed)

    def tilt_error_rad(self) -> float:
        """Return the expected rms error of alpha and beta by the poses so far, rad."""
        return self.estimate.tilt_error_rad()

    def destination(self) -> str:
        """Name the pose to reach, for people."""
        target = self.course.target
        if target is None:
            return ''
        purpose = ' once more, to see that the mounting is as it was' if self.to_verify else ''
        return (
            f'alpha {np.degrees(target.alpha_rad):.1f}°, '
            f'beta {np.degrees(target.beta_rad):.1f}°{purpose}'
        )

    def next_pose(self) -> NextPose | None:
        """Return the pose to announce; None where no pose is open."""
        target = self.course.target
        count = len(self.course.targets)
        if target is None:
            return None
        values: dict[str, str | float] = {
            'pose': str(self.pose_number),
            'poses': str(count),
            'stage_mode': self.settings.stage_mode.value,
            'alpha_rad': target.alpha_rad,
            'beta_rad': target.beta_rad,
            'check': 'true' if target.check else 'false',
        }
        task = f'turn the stage to {self.destination()}, then capture'
        command_rad = None
        if self.moves_itself:
            task = self.destination()
            command_rad = (target.alpha_rad, target.beta_rad)
        return NextPose(
            f'pose {self.pose_number} of {count}: {task}', values, command_rad, self.now_ns
        )

    def status(self) -> GuideStatus:
        """Return what the guide waits for, with the values that matter."""
        target = self.course.target
        by_encoder = self.settings.stage_mode is StageMode.ENCODER
        if target is None:
            return GuideStatus(Phase.DONE, 'all poses are taken')
        waited_s = (self.now_ns - (self.since_ns or 0)) * 1e-9
        if self.uses_encoder and (fault := self.encoder.clock_fault()):
            return GuideStatus(Phase.STAGE, fault, late=True)
        silence = self.encoder.silence(self.now_ns) if self.uses_encoder else ''
        if silence and (self.dwell is not None or by_encoder):
            return GuideStatus(Phase.STAGE, silence, waited_s > guide.SILENT_S)
        if self.refusal:
            return GuideStatus(Phase.REFUSED, self.refusal, late=True)
        late = waited_s > self.settings.timeout_s
        since = f' for {waited_s:.0f} s' if late else ''
        place = self.destination()
        if self.dwell is not None:
            if self.dwell.at_rest():
                return GuideStatus(Phase.DWELL, f'at {place}: averaging', late)
            stillness = self.dwell.stillness()
            motion = stillness.describe_mps2(self.sensor) if stillness else 'waiting for samples'
            return GuideStatus(Phase.REST, f'at {place}: {motion}{since}', late)
        if not self.moves_itself:
            return GuideStatus(Phase.OPERATOR, f'turn the stage to {place}, then capture')
        distance = silence
        if not silence and self.encoder.angles_rad is not None:
            distance = pose_plan.angle_fault(
                target, *self.encoder.angles_rad, self.settings.tolerance_rad
            )
            distance = distance or 'arrived'
        return GuideStatus(
            Phase.STAGE, f'the stage has not arrived at {place}{since}: {distance}', late
        )

    def progress(self) -> list[ScreenRow]:
        """Return pose, readings and progress of the sweep, for the screen."""
        target = self.course.target
        angles_rad = self.encoder.angles_rad
        total = len(self.course.targets)
        rows = [ScreenRow('pose', f'{self.pose_number} of {total}: {self.destination()}')]
        if target is not None and angles_rad is not None:
            rows.append(
                ScreenRow(
                    'now',
                    ', '.join(
                        f'{joint} {np.degrees(now):.2f}° ({np.degrees(now - wanted):+.2f}°)'
                        for joint, now, wanted in zip(
                            ('alpha', 'beta'), angles_rad, (target.alpha_rad, target.beta_rad)
                        )
                    ),
                )
            )
        rests = [] if self.dwell is None else self.dwell.rests()
        samples = rests[-1].stop - rests[-1].start if rests else 0
        dwell_s = self.settings.dwell_s
        at_rest_s = min(samples / self.sensor.rate_hz, dwell_s)
        intervals_ns = np.abs(np.diff([record.stop_ns for record in self.accepted.values()]))
        pose_s = (
            dwell_s + MOVE_S
            if len(intervals_ns) < _FEWEST_INTERVALS
            else float(np.median(intervals_ns)) * 1e-9
        )
        skipped = f'{len(self.course.skipped)} left out, ' if self.course.skipped else ''
        return [
            *rows,
            *self.newest.rows(self.stillness()),
            ScreenRow('dwell', f'{at_rest_s:.1f} of {dwell_s:g} s', at_rest_s / dwell_s),
            ScreenRow(
                'poses',
                f'{len(self.accepted)} done, {skipped}{self.open_poses} left, about '
                f'{self.open_poses * pose_s / 60:.0f} min',
                1 - self.open_poses / total,
            ),
        ]

    def estimated(self) -> EstimateRows:
        """Return what the poses so far show, for the screen."""
        targets = self.course.targets
        closed = self.course.closed
        final_rad = self.estimate.with_poses(
            [
                target
                for number, target in enumerate(targets)
                if number not in closed and not target.check
            ]
        ).tilt_error_rad()
        expected = [
            ScreenRow('coverage', pose_plan.by_plane(targets, self.accepted)),
            tilt_row(self.tilt_error_rad(), final_rad),
        ]
        return EstimateRows(expected, self.estimate.rows())
