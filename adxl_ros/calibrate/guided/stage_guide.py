# SPDX-License-Identifier: Apache-2.0

"""
The guide of a sweep on a stage: samples and encoder angles go in, accepted poses come out.

The stage arrives, or the operator captures. The sensor comes to rest, and a full dwell at rest is
averaged. Motion begins the dwell again. `pose_checks` can refuse the pose.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import auto, Enum

from adxl_ros.calibrate.guided import pose_checks, pose_plan, running_estimate
from adxl_ros.calibrate.guided.guide import NewestSamples, NextPose, Surroundings, went_back
from adxl_ros.calibrate.guided.pose_checks import Dwell, EncoderTrack, RestMean, SILENT_S
from adxl_ros.calibrate.guided.pose_plan import MOVE_S, Target
from adxl_ros.calibrate.guided.screen_contents import (
    CaptureSettings,
    Estimate,
    Phase,
    Progress,
    StageMode,
    Status,
)
from adxl_ros.calibrate.pose_extraction import angle_tolerance_rad, SettingTracker
from adxl_ros.calibrate.poses import Poses
from adxl_ros.errors import UserError
from adxl_ros.files.sweep_journal import JournalEntry, MountingUnchecked, PoseRecord, PoseSkipped
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.rest_detection import Rest, Stillness
import numpy as np

_LONGEST_DWELL_S = 60.0
"""Time beyond two dwells after which a moving sensor's samples are dropped, s.

Chosen: it bounds the memory and the time of the rest detection.
"""
_FEWEST_INTERVALS = 3
"""Poses of this session whose times predict those of the open ones; chosen: a median of two."""


class MountingError(UserError):
    """The sensor is not mounted as it was before an interruption."""


class PoseState(Enum):
    """State of the attempt to take one pose."""

    APPROACHING = auto()
    """The stage, or the operator, has not reached the pose."""
    AVERAGING = auto()
    """The pose is reached; a dwell at rest is averaged."""
    DONE = auto()
    """No pose is open."""


@dataclass
class _Attempt:
    """The attempt to take the open pose."""

    state: PoseState  # State of the attempt
    dwell: Dwell  # The samples since the pose was reached
    # Newest stamp of the samples when the attempt began, ns; None before the first sample
    since_ns: int | None
    refusal: str = ''  # Why the pose was refused; '' if it was not


class StageGuide:
    """Leads a stage, or the operator who turns it, through the poses of a plan; a `Guide`."""

    def __init__(self, sensor: Sensor, targets: Sequence[Target], settings: CaptureSettings,
                 accepted: Sequence[PoseRecord] = (), skipped: Iterable[int] = ()) -> None:
        self.sensor, self.targets, self.settings = sensor, targets, settings
        self.accepted = {record.pose: record for record in accepted}
        self.skipped = set(skipped) - set(self.accepted)
        self.surroundings = Surroundings()
        self.newest_ns: int | None = None
        self.encoder = EncoderTrack()
        self._resumed = len(self.accepted)
        self._to_verify: list[PoseRecord] = []
        self._new_refusal = ''
        self._tracker = SettingTracker(angle_tolerance_rad(sensor), (
            self._highest_setting('alpha'), self._highest_setting('beta')))
        self.estimate = self._estimated(None)
        self._go(self._next_open())
        self.verify()

    @property
    def target(self) -> Target | None:
        """Return the pose to go to; None at the end."""
        return self.targets[self.index] if self.index < len(self.targets) else None

    @property
    def moves_itself(self) -> bool:
        """Return whether the stage turns itself, so that nobody captures."""
        return self.settings.stage_mode is StageMode.COMMANDED

    @property
    def is_over(self) -> bool:
        """Return whether all poses are taken or left out."""
        return self.target is None

    @property
    def open_poses(self) -> int:
        """Return the number of poses that are neither taken nor left out."""
        return len(self.targets) - len(self.accepted.keys() | self.skipped)

    @property
    def poses_to_verify(self) -> int:
        """Return how many poses are still to be taken again for the check of the mounting."""
        return len(self._to_verify)

    @property
    def pose_number(self) -> int:
        """Return the number of the pose to go to, from 1."""
        return self.index + 1

    @property
    def previous(self) -> int | None:
        """Return the previous pose, taken or left out, from 0; None where there is none."""
        if self._to_verify:
            return None
        return max((number for number in self.accepted.keys() | self.skipped
                    if number < self.index), default=None)

    def verify(self) -> None:
        """Take earlier poses again before others, to check the mounting."""
        if self.target is not None and self.accepted:
            self._to_verify = pose_checks.to_take_again(list(self.accepted.values()))
            self._go(self._to_verify[0].pose)

    def capture(self) -> str:
        """Take the pose in which the operator has put the sensor; return an obstacle or ''."""
        target = self.target
        if target is not None and self.settings.stage_mode is StageMode.ENCODER:
            angles_rad, silence = self.encoder.angles_rad, self._silence()
            if angles_rad is None or silence:
                return f'{silence}: in stage.mode encoder its angle counts'
            fault = self.encoder.clock_fault() or pose_checks.angle_fault(
                target, *angles_rad, self.settings.near_rad)
            if fault:
                return f'{fault}; turn the stage there and capture again'
        self._attempt.refusal = ''
        self._restart_dwell(PoseState.AVERAGING)
        return ''

    def skip_entry(self) -> JournalEntry | None:
        """Return the entry that the journal needs before `skip`; None for none."""
        if self._to_verify:
            return MountingUnchecked()
        return None if self.is_over else PoseSkipped(self.index)

    def skip(self) -> str:
        """Leave out the open pose; return a line for people."""
        number = self.pose_number
        if self._to_verify:
            self._to_verify = []
            self._go(self._next_open())
            return f'pose {number} is not taken again: the mounting is not checked'
        self.skipped.add(self.index)
        self.accepted.pop(self.index, None)
        self._go(self._next_open())
        return f'pose {number} is left out'

    def redo(self) -> str:
        """Forget the previous pose and go back; return a line for people, or '' for none."""
        number = self.previous
        if number is None:
            return ''
        self.accepted.pop(number, None)
        self.skipped.discard(number)
        # The rejected reading must not influence the prediction for the new one.
        self.estimate = self._estimated(None)
        self._go(number)
        return f'pose {number + 1} will be taken again'

    def read_encoder(self, stamp_ns: int, alpha_rad: float, beta_rad: float) -> None:
        """Take the angles of the stage."""
        if self.encoder.read(stamp_ns, alpha_rad, beta_rad):
            # A stage that has restarted may have moved in between.
            self._tracker.lose_track()
        if self._uses_encoder:
            self._tracker.read(stamp_ns, alpha_rad, beta_rad)
        target = self.target
        if not self.moves_itself or target is None:
            return
        distance_rad = max(abs(alpha_rad - target.alpha_rad), abs(beta_rad - target.beta_rad))
        if distance_rad > self.settings.tolerance_rad:
            self._attempt.state = PoseState.APPROACHING
        elif self._attempt.state is PoseState.APPROACHING:
            self._attempt.dwell = Dwell(self.sensor, stamp_ns)
            self._attempt.state = PoseState.AVERAGING

    def read_command(self, alpha_rad: float, beta_rad: float) -> None:
        """
        Take a command that somebody gave the stage.

        It counts in stage mode `encoder`. In the other modes the targets are the commands.
        """
        if self.settings.stage_mode is StageMode.ENCODER:
            self._tracker.command(self.newest_ns or 0, alpha_rad, beta_rad)

    def feed(self, stamps_ns: np.ndarray, volts: np.ndarray) -> None:
        """
        Take samples.

        stamps_ns: their stamps, ns, (n,); volts: the samples, V, (n, m).
        """
        if not len(stamps_ns):
            return
        if self.newest_ns is not None and went_back(self.newest_ns, stamps_ns[0]):
            self._restart_after_clock_change((self.newest_ns - int(stamps_ns[0])) * 1e-9)
        self.newest_ns = int(stamps_ns[-1])
        self.encoder.compare_clock(self.newest_ns)
        if self._attempt.since_ns is None:
            self._attempt.since_ns = int(stamps_ns[0])
        if self._attempt.state is PoseState.AVERAGING:
            self._attempt.dwell.feed(stamps_ns, volts)

    def accept(self) -> PoseRecord | None:
        """Return the pose for the journal when a full dwell at rest is complete, else None."""
        target = self.target
        if target is None or self._attempt.state is not PoseState.AVERAGING or (
                self._uses_encoder and self.encoder.clock_fault()):
            return None
        dwell = self._attempt.dwell
        samples = round(self.settings.dwell_s * self.sensor.rate_hz)
        if len(dwell) < samples:
            return None
        rest = next((r for r in dwell.rests() if r.stop - r.start >= samples), None)
        if rest is None:
            self._forget_long_motion()
            return None
        mean = dwell.mean(rest, samples)
        if not self._encoder_covers(mean):
            return None
        record = self._record(mean, target)
        refusal = self._moved_away(rest, record) or self._fault(record, dwell.volts(rest))
        if refusal:
            self._refuse(refusal)
            return None
        if self._to_verify:
            self._check_mounting(record)
            return None
        return record

    def take(self, record: PoseRecord) -> None:
        """Count a pose that is on disk, and go on to the next open one."""
        self.accepted[record.pose] = record
        self.skipped.discard(record.pose)
        self._tracker.take(record.start_ns, record.stop_ns, record.alpha_rad, record.beta_rad)
        self.estimate = self._estimated(self.estimate)
        self._go(self._next_open())

    def retry(self) -> None:
        """Take the same pose again, since its record is not on disk."""
        self._go(self.index)

    def poses_to_fit(self) -> list[PoseRecord]:
        """Return the accepted poses, by number."""
        return [self.accepted[number] for number in sorted(self.accepted)]

    def values(self) -> dict[str, str | float]:
        """Return no further values for programs."""
        return {}

    def tilt_error_rad(self) -> float:
        """Return the expected rms error of alpha and beta by the poses so far, rad."""
        return self.estimate.tilt_error_rad()

    def new_refusal(self) -> str:
        """Return why a pose was refused since the last call, or ''."""
        text, self._new_refusal = self._new_refusal, ''
        return text

    def stillness(self, newest: NewestSamples) -> Stillness | None:
        """Return whether the newest samples are at rest; None while they are too few."""
        return newest.stillness()

    def destination(self) -> str:
        """Name the pose to reach, for people."""
        target = self.target
        if target is None:
            return ''
        purpose = ' once more, to see that the mounting is as it was' if self._to_verify else ''
        return (f'alpha {np.degrees(target.alpha_rad):.1f}°, '
                f'beta {np.degrees(target.beta_rad):.1f}°{purpose}')

    def next_pose(self) -> NextPose | None:
        """Return the pose to announce; None where no pose is open."""
        target = self.target
        if target is None:
            return None
        values: dict[str, str | float] = {
            'pose': str(self.pose_number), 'poses': str(len(self.targets)),
            'stage_mode': self.settings.stage_mode.value, 'alpha_rad': target.alpha_rad,
            'beta_rad': target.beta_rad, 'check': 'true' if target.check else 'false'}
        number = f'pose {self.pose_number} of {len(self.targets)}'
        if self.moves_itself:
            return NextPose(f'{number}: {self.destination()}', values,
                            (target.alpha_rad, target.beta_rad), self.newest_ns or 0)
        return NextPose(f'{number}: turn the stage to {self.destination()}, then capture', values,
                        None)

    def status(self) -> Status:
        """Return what the guide waits for, with the values that matter."""
        target, attempt = self.target, self._attempt
        if target is None:
            return Status(Phase.DONE, 'all poses are taken', False)
        waited_s = ((self.newest_ns or 0) - (attempt.since_ns or 0)) * 1e-9
        if self._uses_encoder and (fault := self.encoder.clock_fault()):
            return Status(Phase.STAGE, fault, True)
        silence = self._silence() if self._uses_encoder else ''
        if silence and (attempt.state is PoseState.AVERAGING
                        or self.settings.stage_mode is StageMode.ENCODER):
            return Status(Phase.STAGE, silence, waited_s > SILENT_S)
        if attempt.refusal:
            return Status(Phase.REFUSED, attempt.refusal, True)
        if attempt.state is PoseState.AVERAGING:
            return self._status_at_pose(waited_s)
        return self._status_on_the_way(target, waited_s)

    def progress(self) -> Progress:
        """Return the progress of the sweep, for the screen."""
        target, angles_rad, position = self.target, self.encoder.angles_rad, ''
        if target is not None and angles_rad is not None:
            alpha_rad, beta_rad = angles_rad
            position = (f'{_position("alpha", alpha_rad, target.alpha_rad)}, '
                        f'{_position("beta", beta_rad, target.beta_rad)}')
        averaging = self._attempt.state is PoseState.AVERAGING
        dwelt_s = min(self._attempt.dwell.at_rest_s(), self.settings.dwell_s) if averaging else 0.0
        return Progress(
            number=self.pose_number, destination=self.destination(), position=position,
            accepted=len(self.accepted), total=len(self.targets), skipped=len(self.skipped),
            open_poses=self.open_poses,
            remaining_s=self.open_poses * self._seconds_per_pose(), dwelt_s=dwelt_s,
            dwell_s=self.settings.dwell_s)

    def estimate_contents(self) -> Estimate:
        """Return what the poses determine so far, for the screen."""
        open_targets = [target for number, target in enumerate(self.targets)
                        if number not in self.accepted and number not in self.skipped
                        and not target.check]
        final = self.estimate.with_poses(open_targets)
        return Estimate(
            coverage=pose_plan.by_plane(self.targets, self.accepted), covered_faces='',
            coefficients=self.estimate.rows(),
            tilt_error_deg=running_estimate.degrees_or_none(self.tilt_error_rad()),
            final_tilt_error_deg=running_estimate.degrees_or_none(final.tilt_error_rad()))

    @property
    def _uses_encoder(self) -> bool:
        return self.settings.stage_mode is not StageMode.MANUAL

    def _status_on_the_way(self, target: Target, waited_s: float) -> Status:
        late = waited_s > self.settings.timeout_s
        if not self.moves_itself:
            waited = f' (waited {waited_s:.0f} s)' if late else ''
            return Status(Phase.OPERATOR,
                          f'turn the stage to {self.destination()}, then capture{waited}', False)
        return Status(Phase.STAGE, f'the stage has not arrived at {self.destination()}'
                      f'{self._since(waited_s)}: {self._distance_text(target)}', late)

    def _status_at_pose(self, waited_s: float) -> Status:
        late = waited_s > self.settings.timeout_s
        stillness = self._attempt.dwell.stillness()
        since = self._since(waited_s)
        if stillness is None:
            return Status(Phase.REST, f'at {self.destination()}: waiting for samples{since}', late)
        if stillness.at_rest:
            return Status(Phase.DWELL, f'at {self.destination()}: averaging', late)
        advice = '; if nothing touches it, sensor.noise_density_g_per_rthz is too low for this ' \
            'unit' if late and stillness.statistic == 'rms' else ''
        motion = stillness.describe_mps2(self.sensor)
        return Status(Phase.REST, f'at {self.destination()}: {motion}{since}{advice}', late)

    def _since(self, waited_s: float) -> str:
        return f' for {waited_s:.0f} s' if waited_s > self.settings.timeout_s else ''

    def _distance_text(self, target: Target) -> str:
        silence, angles_rad = self._silence(), self.encoder.angles_rad
        if silence or angles_rad is None:
            return silence
        fault = pose_checks.angle_fault(target, *angles_rad, self.settings.tolerance_rad)
        return fault or 'arrived'

    def _silence(self) -> str:
        return self.encoder.silence(self.newest_ns or 0)

    def _seconds_per_pose(self) -> float:
        """Return the time that a pose takes, by those of this session, s."""
        ends_ns = [record.stop_ns for record in list(self.accepted.values())[self._resumed:]]
        if len(ends_ns) < _FEWEST_INTERVALS:
            return self.settings.dwell_s + MOVE_S
        return float(np.median(np.abs(np.diff(ends_ns)))) * 1e-9

    def _next_open(self) -> int:
        """Return the number of the first open pose, from 0; the number of poses if none is."""
        return next((number for number in range(len(self.targets))
                     if number not in self.accepted and number not in self.skipped),
                    len(self.targets))

    def _go(self, index: int) -> None:
        self.index = index
        state = PoseState.DONE if self.target is None else PoseState.APPROACHING
        self._attempt = _Attempt(state, Dwell(self.sensor, self.encoder.newest_ns or 0),
                                 self.newest_ns)
        # In stage mode encoder an operator or a program gives the commands.
        if self.target is not None and self.settings.stage_mode is not StageMode.ENCODER:
            self._tracker.command(self.newest_ns or 0, self.target.alpha_rad,
                                  self.target.beta_rad)

    def _restart_dwell(self, state: PoseState) -> None:
        """Average from the next sample on."""
        self._attempt.dwell = Dwell(self.sensor, (self.newest_ns or 0) + 1)
        self._attempt.state = state

    def _restart_after_clock_change(self, back_s: float) -> None:
        """Begin the pose again after stamps that went back: the driver may have restarted."""
        self._new_refusal = f'imu/data_raw went back in time by {back_s:.0f} s: the pose begins ' \
            'again'
        self.verify()
        self._tracker.lose_track()
        self.encoder.forget_clock()
        self._attempt.since_ns = None
        self._attempt.dwell = Dwell(self.sensor, 0)
        if self._attempt.state is PoseState.AVERAGING:
            self._attempt.state = PoseState.APPROACHING

    def _forget_long_motion(self) -> None:
        """Forget the samples of a long motion, so that the rest detection stays quick."""
        dwell = self._attempt.dwell
        if dwell.age_s() > _LONGEST_DWELL_S + 2 * self.settings.dwell_s and not dwell.at_rest():
            self._restart_dwell(self._attempt.state)

    def _highest_setting(self, joint: str) -> int:
        numbers = [getattr(record, f'{joint}_setting') for record in self.accepted.values()]
        return max((number for number in numbers if number is not None), default=-1)

    def _estimated(self, previous: running_estimate.RunningEstimate | None
                   ) -> running_estimate.RunningEstimate:
        """Estimate the unit from the accepted poses, starting from the previous estimate."""
        records = [record for record in self.poses_to_fit() if not record.check]
        poses = Poses.from_records(records) if records else \
            running_estimate.no_poses(len(self.sensor.axes))
        return running_estimate.from_poses(
            self.sensor, poses, self.settings.dwell_s,
            self.sensor.stage_std_rad, previous)

    def _encoder_covers(self, mean: RestMean) -> bool:
        """Return whether the readings of the encoder reach to the end of a dwell."""
        newest_ns = self.encoder.newest_ns
        if not self._uses_encoder or (newest_ns is not None and newest_ns >= mean.stop_ns):
            return True
        silence = self._silence()
        if self.settings.stage_mode is StageMode.ENCODER and silence:
            self._refuse(f'{silence}; capture again when it is back')
        return False

    def _record(self, mean: RestMean, target: Target) -> PoseRecord:
        """Return the record of a dwell, with the angles that count in this stage mode."""
        span = mean.start_ns, mean.stop_ns
        alpha_rad, beta_rad = self.encoder.mean_between(*span) if self._uses_encoder else \
            (target.alpha_rad, target.beta_rad)
        alpha_setting, beta_setting = self._tracker.settings(*span, alpha_rad, beta_rad)
        return PoseRecord(
            pose=self.index, alpha_rad=alpha_rad, beta_rad=beta_rad,
            alpha_setting=alpha_setting, beta_setting=beta_setting, check=target.check,
            **mean._asdict(), temperature_c=self.surroundings.temperature_c.mean(*span),
            supply_v=self.surroundings.supply_v.mean(*span))

    def _moved_away(self, rest: Rest, record: PoseRecord) -> str:
        """Refuse a rest in another pose than that in which the operator captured."""
        if self.settings.stage_mode is StageMode.COMMANDED:
            return ''
        if self.settings.stage_mode is StageMode.ENCODER:
            return self._moved_by_encoder(record)
        dwell = self._attempt.dwell
        captured_v = dwell.volts(dwell.rests()[0]).mean(axis=0)
        change_g = np.abs(np.array(record.mean_v) - captured_v) / self.sensor.nominal_scale_v_per_g
        axis = int(change_g.argmax())
        if change_g[axis] < np.sin(self.settings.near_rad):
            return ''
        return (f'the pose changed after the capture: {self.sensor.axes[axis]} moved by '
                f'{change_g[axis]:.2f} g; hold the stage still until the pose is taken')

    def _moved_by_encoder(self, record: PoseRecord) -> str:
        readings_rad = self.encoder.between(record.start_ns, record.stop_ns)
        now_rad = self.encoder.angles_rad or (record.alpha_rad, record.beta_rad)
        tolerance_rad = self.settings.tolerance_rad
        return (pose_checks.angle_fault(self.targets[self.index], *now_rad, self.settings.near_rad)
                or pose_checks.motion_fault('alpha', readings_rad[:, 0], tolerance_rad)
                or pose_checks.motion_fault('beta', readings_rad[:, 1], tolerance_rad))

    def _fault(self, record: PoseRecord, volts: np.ndarray) -> str:
        """Return why a pose with these samples is refused, or ''."""
        first_c = next((accepted.temperature_c for accepted in self.poses_to_fit()
                        if np.isfinite(accepted.temperature_c)), np.nan)
        fault = pose_checks.saturation_fault(self.sensor, volts) or pose_checks.temperature_fault(
            first_c, record.temperature_c, self.settings.temperature_span_c)
        if fault or self._to_verify:
            return fault
        return pose_checks.reading_fault(
            self.estimate, Target(record.alpha_rad, record.beta_rad), np.array(record.mean_v),
            self.settings.tolerance_rad)

    def _refuse(self, refusal: str) -> None:
        """Report a refusal once. A commanded stage averages again, an operator captures again."""
        if refusal != self._attempt.refusal:
            self._new_refusal = refusal
        self._attempt.refusal = refusal
        self._restart_dwell(PoseState.AVERAGING if self.moves_itself else PoseState.APPROACHING)

    def _check_mounting(self, record: PoseRecord) -> None:
        """Compare a pose that is taken again with its first record, and go to the next pose."""
        before, tolerance_rad = self._to_verify[0], self.sensor.stage_resolution_rad
        if self._uses_encoder:
            # The encoder shows how far the stage is from the earlier angles.
            tolerance_rad += max(abs(record.alpha_rad - before.alpha_rad),
                                 abs(record.beta_rad - before.beta_rad))
        else:
            tolerance_rad = max(tolerance_rad, self.settings.tolerance_rad)
        change = pose_checks.changed(self.sensor, before, record, tolerance_rad)
        if change and self.settings.stage_mode is StageMode.MANUAL:
            self._refuse(f'{change}; or turn the stage to where it was, and capture again')
            return
        if change:
            raise MountingError(change)
        del self._to_verify[0]
        self._go(self._to_verify[0].pose if self._to_verify else self._next_open())


def _position(joint: str, now_rad: float, target_rad: float) -> str:
    return f'{joint} {np.degrees(now_rad):.2f}° ({np.degrees(now_rad - target_rad):+.2f}°)'
