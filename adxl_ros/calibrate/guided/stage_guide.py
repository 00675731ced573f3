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

"""
The guided sweep, free of ROS: samples and encoder angles in, accepted poses out.

A pose goes through: the stage arrives (or the operator captures), the sensor comes to rest, a
full dwell at rest is averaged, and nothing speaks against it (`pose_checks`). Motion during the
dwell begins it anew.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence

from adxl_ros.calibrate.guided import mounting_check, pose_checks, running_estimate
from adxl_ros.calibrate.guided.capture_settings import Settings, State
from adxl_ros.calibrate.guided.dwell import Dwell, RestMean
from adxl_ros.calibrate.guided.live_window import Surroundings, went_back
from adxl_ros.calibrate.guided.pose_plan import Target
from adxl_ros.calibrate.joint_settings import angle_tolerance_rad, SettingTracker
from adxl_ros.calibrate.poses import Poses
from adxl_ros.errors import UserError
from adxl_ros.files.sweep_journal import PoseRecord
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals.rest_detection import Rest
import numpy as np

_KEPT_ANGLES = 100000
_OFFSETS, _FEWEST_OFFSETS = 20, 4
_OLD_S, _SILENT_S = 60.0, 3.0


class MountingError(UserError):
    """The sensor is not mounted as it was before an interruption."""


class Sweep:
    """
    Walks the targets that are left.

    Parameters
    ----------
    sensor
        The nominal sensor of the stream; its noise decides what is at rest.
    targets
        The whole plan.
    settings
        How poses are taken.
    accepted, skipped
        What an interrupted sweep has left; see `verify`. Its stage may have lost power: the next
        pose has new settings of both joints, numbered on from the highest of `accepted`.

    """

    def __init__(self, sensor: Sensor, targets: Sequence[Target], settings: Settings,
                 accepted: Sequence[PoseRecord] = (), skipped: Iterable[int] = ()):
        self.settings, self.targets, self.sensor = settings, targets, sensor
        self.accepted = {record.pose: record for record in accepted}
        self.skipped = set(skipped) - set(self.accepted)
        self.surroundings = Surroundings()
        self._verify: list[PoseRecord] = []
        self.newest_ns: int | None = None
        self._angles: deque[tuple[int, float, float]] = deque(maxlen=_KEPT_ANGLES)
        self._ahead_s: deque[float] = deque(maxlen=_OFFSETS)
        self._since_ns: int | None = None
        self._refusal = self._unsaid = ''
        self._fresh = False
        self._tracker = SettingTracker(angle_tolerance_rad(sensor), (
            self._highest('alpha_setting'), self._highest('beta_setting')))
        self.known = self._learned(None)
        self.index = self._next()
        self._begin()
        self._command_target()
        self.verify()

    def verify(self) -> None:
        """Take poses again before others, to see that the sensor is mounted as it was."""
        if self.target is not None and self.accepted:
            self._verify = mounting_check.to_take_again(list(self.accepted.values()))
            self._go(self._verify[0].pose)

    @property
    def target(self) -> Target | None:
        """Return the pose to go to; None at the end."""
        return self.targets[self.index] if self.index < len(self.targets) else None

    @property
    def verifying(self) -> bool:
        """Tell whether a pose is taken again to see that the mounting is as it was."""
        return bool(self._verify)

    @property
    def to_verify(self) -> int:
        """Count the poses that are still to be taken again for that."""
        return len(self._verify)

    @property
    def angles(self) -> tuple[float, float] | None:
        """Return where the stage is, alpha and beta, rad; None while it is silent."""
        return self._angles[-1][1:] if self._angles else None

    def capture(self) -> str:
        """Take the pose in which the operator has put the sensor; return why not, or ''."""
        target = self.target
        if target is not None and self.settings.stage_mode == 'encoder':
            if self.angles is None or self._silent():
                return f'{self._silent()}: in stage.mode encoder its angle counts'
            off = self._clocks() or pose_checks.angles(target, *self.angles,
                                                       self.settings.near_rad)
            if off:
                return f'{off}; turn the stage there and capture again'
        self._refusal = ''
        self._dwell = Dwell(self.sensor, (self.newest_ns or 0) + 1)
        self._captured = True
        return ''

    def skip(self) -> str:
        """Leave the pose out; return what is done, for people."""
        number = self.index + 1
        if self._verify:
            self._verify = []
            self._go(self._next())
            return f'pose {number} is not taken again: the mounting is not checked'
        self.skipped.add(self.index)
        self.accepted.pop(self.index, None)
        self._go(self._next())
        return f'pose {number} is left out'

    @property
    def before(self) -> int | None:
        """Return the number of the pose before, taken or left out; None where there is none."""
        if self._verify:
            return None
        return max((i for i in self.accepted.keys() | self.skipped if i < self.index),
                   default=None)

    def redo(self) -> str:
        """Forget the pose before and go back; return what is done, or '' if there is none."""
        number = self.before
        if number is None:
            return ''
        self.accepted.pop(number, None)
        self.skipped.discard(number)
        # Its earlier reading must not speak against the new one.
        self.known = self._learned(None)
        self._go(number)
        return f'pose {number + 1} will be taken again'

    def stage(self, stamp_ns: int, alpha_rad: float, beta_rad: float) -> None:
        """Take an encoder reading."""
        if self._angles and went_back(self._angles[-1][0], stamp_ns):
            # A stage that was started anew may have moved unseen.
            self._angles.clear()
            self._tracker.lose_track()
        if self.settings.stage_mode != 'manual':
            self._tracker.read(stamp_ns, alpha_rad, beta_rad)
        self._angles.append((stamp_ns, alpha_rad, beta_rad))
        self._fresh = True
        target = self.target
        if self.settings.stage_mode != 'commanded' or target is None:
            return
        off_rad = max(abs(alpha_rad - target.alpha_rad), abs(beta_rad - target.beta_rad))
        arrived = off_rad <= self.settings.tolerance_rad
        if arrived and not self._captured:
            self._dwell = Dwell(self.sensor, stamp_ns)
        self._captured = arrived

    def command(self, alpha_rad: float, beta_rad: float) -> None:
        """
        Take a command that somebody gave the stage; NaN for a joint that it does not name.

        Only in stage mode 'encoder': elsewhere the targets are the commands.
        """
        if self.settings.stage_mode == 'encoder':
            self._tracker.command(self.newest_ns or 0, alpha_rad, beta_rad)

    def feed(self, stamps_ns: np.ndarray, volts: np.ndarray) -> None:
        """Take samples: stamps, ns, (n,), and volts, (n, m)."""
        if not len(stamps_ns):
            return
        if self.newest_ns is not None and went_back(self.newest_ns, stamps_ns[0]):
            self._unsaid = f'imu/data_raw went back in time by ' \
                f'{(self.newest_ns - int(stamps_ns[0])) * 1e-9:.0f} s: the pose begins anew'
            self.verify()
            self._tracker.lose_track()
            self._since_ns, self._ahead_s = None, deque(maxlen=_OFFSETS)
            self._captured, self._dwell = False, Dwell(self.sensor, 0)
        self.newest_ns = int(stamps_ns[-1])
        if self._fresh:
            self._ahead_s.append((self._angles[-1][0] - self.newest_ns) * 1e-9)
            self._fresh = False
        if self._since_ns is None:
            self._since_ns = int(stamps_ns[0])
        if self._captured:
            self._dwell.feed(stamps_ns, volts)

    def accept(self) -> PoseRecord | None:
        """
        Return the pose for the journal when a full dwell at rest is there, else None.

        Raises
        ------
        MountingError
            The pose before the interruption reads something else now: the mounting changed.

        """
        target = self.target
        if target is None or not self._captured or (
                self.settings.stage_mode != 'manual' and self._clocks()):
            return None
        wanted = round(self.settings.dwell_s * self.sensor.rate_hz)
        rest = next((r for r in self._dwell.rests() if r.stop - r.start >= wanted), None)
        if rest is None:
            # What moves for a long time is judged as a whole again and again: forget it.
            if self._dwell.age_s() > _OLD_S + 2 * self.settings.dwell_s and \
                    not self._dwell.at_rest():
                self._dwell = Dwell(self.sensor, (self.newest_ns or 0) + 1)
            return None
        mean = self._dwell.mean(rest, wanted)
        if self.settings.stage_mode != 'manual' and self._angles[-1][0] < mean.stop_ns:
            # What the stage did to the end of the dwell is still to come, or never will.
            if self.settings.stage_mode == 'encoder' and (silent := self._silent()):
                self._refuse(f'{silent}; capture again when it is back')
            return None
        entry = self._entry(mean, target)
        why = self._moved_away(rest, entry) or self._wrong(entry, self._dwell.volts(rest))
        if why:
            self._refuse(why)
            return None
        if self._verify:
            self._check_mounting(entry)
            return None
        return entry

    def take(self, entry: PoseRecord) -> None:
        """Count a pose that is on disk, and go on to the next that is open."""
        self.accepted[entry.pose] = entry
        self.skipped.discard(entry.pose)
        self._tracker.take(entry.start_ns, entry.stop_ns, entry.alpha_rad, entry.beta_rad)
        self.known = self._learned(self.known)
        self._go(self._next())

    def retry(self) -> None:
        """Take the same pose anew."""
        self._go(self.index)

    def results(self) -> list[PoseRecord]:
        """Return the poses to fit: all that were accepted."""
        return [self.accepted[number] for number in sorted(self.accepted)]

    def tilt_error_rad(self) -> float:
        """Return the rms error of alpha and beta to expect after the poses so far, rad."""
        return self.known.tilt_error_rad()

    def refused(self) -> str:
        """Return why a pose was refused since the last call, or ''."""
        text, self._unsaid = self._unsaid, ''
        return text

    def dwelt_s(self) -> float:
        """Return for how long the sensor has been at rest in the pose, s."""
        return min(self._dwell.at_rest_s(), self.settings.dwell_s) if self._captured else 0.0

    def where(self) -> str:
        """Name the pose to reach."""
        target = self.target
        if target is None:
            return ''
        again = ' once more, to see that the mounting is as it was' if self._verify else ''
        return f'alpha {np.degrees(target.alpha_rad):.1f}°, ' \
               f'beta {np.degrees(target.beta_rad):.1f}°{again}'

    def state(self) -> State:
        """Say what is waited for, and by how much it is off."""
        target = self.target
        if target is None:
            return State('done', 'all poses are taken', False)
        waited_s = ((self.newest_ns or 0) - (self._since_ns or 0)) * 1e-9
        late = waited_s > self.settings.timeout_s
        since = f' for {waited_s:.0f} s' if late else ''
        if self.settings.stage_mode != 'manual' and (apart := self._clocks()):
            return State('stage', apart, True)
        silent = '' if self.settings.stage_mode == 'manual' else self._silent()
        if silent and (self._captured or self.settings.stage_mode == 'encoder'):
            return State('stage', silent, waited_s > _SILENT_S)
        if self._refusal:
            return State('refused', self._refusal, True)
        if not self._captured:
            if self.settings.stage_mode != 'commanded':
                waited = f' (waited {waited_s:.0f} s)' if late else ''
                return State('operator', f'turn the stage to {self.where()}, then capture{waited}',
                             False)
            return State('stage', f'the stage has not arrived at {self.where()}{since}: '
                                  f'{self._off_text(target)}', late)
        still = self._dwell.stillness()
        if still is None:
            return State('rest', f'at {self.where()}: waiting for samples{since}', late)
        if still.still:
            return State('dwell', f'at {self.where()}: averaging', late)
        steady = '; if nothing touches it, sensor.noise_density_g_per_rthz is too low for this ' \
            'unit' if late and still.statistic == 'rms' else ''
        return State(
            'rest', f'at {self.where()}: {still.describe_mps2(self.sensor)}{since}{steady}', late)

    def _next(self) -> int:
        return next((i for i in range(len(self.targets))
                     if i not in self.accepted and i not in self.skipped), len(self.targets))

    def _go(self, index: int) -> None:
        self.index = index
        self._since_ns = self.newest_ns
        self._refusal = ''
        self._begin()
        self._command_target()

    def _command_target(self) -> None:
        """Note the target as a command, where it is one for the stage or for the operator."""
        if self.target is not None and self.settings.stage_mode != 'encoder':
            self._tracker.command(self.newest_ns or 0, self.target.alpha_rad,
                                  self.target.beta_rad)

    def _highest(self, name: str) -> int:
        return max((getattr(record, name) for record in self.accepted.values()
                    if getattr(record, name) is not None), default=-1)

    def _begin(self) -> None:
        self._captured = False
        self._dwell = Dwell(self.sensor, self._angles[-1][0] if self._angles else 0)

    def _learned(self, before: running_estimate.Known | None) -> running_estimate.Known:
        stage_rad = self.sensor.stage_resolution_rad / np.sqrt(12)
        records = [record for record in self.results() if not record.check]
        poses = Poses.from_records(records) if records else Poses.without_volts(
            np.zeros(0), np.zeros(0), np.zeros(len(self.sensor.axes)))
        return running_estimate.from_poses(
            self.sensor, poses, self.settings.dwell_s, stage_rad, before)

    def _entry(self, mean: RestMean, target: Target) -> PoseRecord:
        span = mean.start_ns, mean.stop_ns
        alpha, beta = self._angle_between(*span, target)
        alpha_setting, beta_setting = self._tracker.settings(*span, alpha, beta)
        return PoseRecord(
            pose=self.index, alpha_rad=alpha, beta_rad=beta, alpha_setting=alpha_setting,
            beta_setting=beta_setting, check=target.check, **mean._asdict(),
            temperature_c=self.surroundings.temperature_c.mean(*span),
            supply_v=self.surroundings.supply_v.mean(*span))

    def _moved_away(self, rest: Rest, entry: PoseRecord) -> str:
        """Refuse a rest in another pose than the one in which the operator captured."""
        if self.settings.stage_mode == 'commanded':
            return ''
        if self.settings.stage_mode == 'encoder':
            seen = np.array([(a, b) for stamp, a, b in self._angles
                             if entry.start_ns <= stamp <= entry.stop_ns]).reshape(-1, 2)
            alpha, beta = self.angles or (entry.alpha_rad, entry.beta_rad)
            return (pose_checks.angles(self.targets[self.index], alpha, beta,
                                       self.settings.near_rad)
                    or pose_checks.moved('alpha', seen[:, 0], self.settings.tolerance_rad)
                    or pose_checks.moved('beta', seen[:, 1], self.settings.tolerance_rad))
        before = self._dwell.volts(self._dwell.rests()[0]).mean(axis=0)
        off_g = np.abs(np.array(entry.mean_v) - before) / self.sensor.nominal_scale_v_per_g
        axis = int(off_g.argmax())
        return '' if off_g[axis] < np.sin(self.settings.near_rad) else (
            f'the pose changed after the capture: {self.sensor.axes[axis]} moved by '
            f'{off_g[axis]:.2f} g; hold the stage still until the pose is taken')

    def _wrong(self, entry: PoseRecord, volts: np.ndarray) -> str:
        """Say what speaks against a pose with these samples, or ''."""
        first = next((record.temperature_c for record in self.results()
                      if np.isfinite(record.temperature_c)), np.nan)
        why = (pose_checks.saturated(self.sensor, volts)
               or pose_checks.temperature(first, entry.temperature_c,
                                          self.settings.temperature_span_c))
        if why or self.verifying:
            return why
        return pose_checks.reading(self.known, Target(entry.alpha_rad, entry.beta_rad),
                                   np.array(entry.mean_v), self.settings.tolerance_rad)

    def _refuse(self, why: str) -> None:
        """Say why, once; what turns itself is looked at again, an operator captures again."""
        if why != self._refusal:
            self._unsaid = why
        self._refusal = why
        self._dwell = Dwell(self.sensor, (self.newest_ns or 0) + 1)
        if self.settings.stage_mode != 'commanded':
            self._captured = False

    def _check_mounting(self, entry: PoseRecord) -> None:
        before, stage_rad = self._verify[0], self.sensor.stage_resolution_rad
        if self.settings.stage_mode == 'manual':
            stage_rad = max(stage_rad, self.settings.tolerance_rad)
        else:
            # The stage is elsewhere within its tolerance: what the encoder knows is allowed for.
            stage_rad += max(abs(getattr(entry, name) - getattr(before, name))
                             for name in ('alpha_rad', 'beta_rad'))
        why = mounting_check.changed(self.sensor, before, entry, stage_rad)
        if why and self.settings.stage_mode == 'manual':
            self._refuse(f'{why}; or turn the stage to where it was, and capture again')
            return
        if why:
            raise MountingError(why)
        del self._verify[0]
        self._go(self._verify[0].pose if self._verify else self._next())

    def _clocks(self) -> str:
        if len(self._ahead_s) < _FEWEST_OFFSETS:
            return ''
        return pose_checks.clocks(min(self._ahead_s, key=abs))

    def _silent(self) -> str:
        """Say that the encoder is silent, and for how long by the samples' time; '' if not."""
        if self.angles is None:
            return 'nothing on stage/joint_states'
        silent_s = ((self.newest_ns or 0) - self._angles[-1][0]) * 1e-9
        return f'nothing on stage/joint_states for {silent_s:.0f} s' if silent_s > _SILENT_S \
            else ''

    def _off_text(self, target: Target) -> str:
        silent = self._silent()
        if silent or self.angles is None:
            return silent
        return pose_checks.angles(target, *self.angles, self.settings.tolerance_rad) or 'arrived'

    def _angle_between(self, first_ns: int, last_ns: int, target: Target) -> tuple[float, float]:
        if self.settings.stage_mode == 'manual':
            return target.alpha_rad, target.beta_rad
        inside = [(a, b) for stamp, a, b in self._angles if first_ns <= stamp <= last_ns]
        alpha, beta = np.mean(inside or [self._angles[-1][1:]], axis=0)
        return float(alpha), float(beta)
