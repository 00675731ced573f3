# SPDX-License-Identifier: Apache-2.0

"""Check of the front door: whether recordings are sound, and what the verbs can do with them."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
import os
from pathlib import Path
from typing import Any, NamedTuple

from adxl_ros.api.recordings import (
    as_series,
    one_recording,
    reading_options,
    RecordingInput,
    RobotInput,
)
from adxl_ros.api.result import (
    as_json,
    FirstScreen,
    no_progress,
    Progress,
    Result,
)
from adxl_ros.api.sensors import as_input, sensor_of, SensorInput
from adxl_ros.diagnose.data_faults import DataFault
from adxl_ros.diagnose.diagnosis import what_shows
from adxl_ros.diagnose.screen import as_shown
from adxl_ros.errors import one_line, UserError
from adxl_ros.files import recording as recording_files
from adxl_ros.files.atomic_write import own_folder, require_own, write_text
from adxl_ros.files.column_mapping import ReadingOptions
from adxl_ros.files.recording_columns import Recording
from adxl_ros.model.sensor import Sensor
from adxl_ros.report.arguments import require_number
from adxl_ros.report.screen import Tile
from adxl_ros.signals import findings_report as words
from adxl_ros.signals.findings import Ability, check_recording, Findings, Shown
from adxl_ros.signals.gate import (
    Earlier,
    KINDS,
    MINIMA,
    Outcome,
    outcomes_of,
    require_kinds,
    write_junit,
)
from adxl_ros.simulate.motion import Motion

_FIGURES = ['samples', 'span_s', 'rate_hz', 'missing', 'rest_share', 'rests', 'poses']
"""Numbers of a recording in the table of a check."""
_MOST_SHOWN = 1_000_000
"""Samples up to which it is listed what `diagnose` could show. Chosen: a minute, and 1 GB."""


@dataclass(frozen=True, repr=False, eq=False)
class Check(Result):
    """
    Whether recordings are sound.

    `print` shows the screen of the tool `check`.

    Attributes
    ----------
    recordings
        By recording: `faults`, `remarks`, `contents` (samples, rate, gaps, rests, ranges),
        `abilities` of the verbs, and for a single one what `diagnose` could show, `shows`.
    outcomes
        By recording: whether it is sound, what became worse since `against`, and the `minima`.
    against
        Name of the recording that all are compared with; '' for none.

    """

    recordings: tuple[Findings, ...]
    outcomes: tuple[tuple[Outcome, ...], ...]
    against: str

    @property
    def is_sound(self) -> bool:
        """Return whether no recording has a fault."""
        return all(result.is_sound for result in self.recordings)

    @property
    def faults(self) -> tuple[str, ...]:
        """Return why recordings are not sound, one line each."""
        return tuple(chain.from_iterable(result.faults for result in self.recordings))

    @property
    def screen(self) -> list[str]:
        """Return the lines of the tool's screen."""
        return [
            *words.screen_lines(self.recordings),
            *words.gate_lines(self.outcomes, self.against),
            words.sentence(self.recordings),
        ]

    @property
    def first_screen(self) -> FirstScreen:
        """Return the top of the page."""
        tiles = []
        for result in self.recordings:
            name, *figures, verdict = words.table_row(result)
            tiles.append(Tile(name, ', '.join(figures), verdict))
        colour, word = ('green', 'Sound.') if self.is_sound else ('red', 'Not sound.')
        return FirstScreen(colour, word, words.sentence(self.recordings), tiles)

    def __str__(self) -> str:
        return '\n'.join(self.screen)

    def to_dict(self) -> dict[str, Any]:
        """Return what the tool prints with --json, below `recordings`."""
        recordings = list(map(words.as_json, self.recordings, self.outcomes))
        return as_json({'schema': 1, 'recordings': recordings})

    def to_pandas(self) -> Any:
        """Return a DataFrame with a row for each recording: its figures, s and Hz, and `sound`."""
        from pandas import DataFrame

        table = DataFrame([found.contents for found in self.recordings], columns=_FIGURES)
        table.insert(0, 'recording', [found.path for found in self.recordings])
        return table.assign(sound=[found.is_sound for found in self.recordings])

    def failures(self, fail_on: Collection[str] = KINDS) -> list[Outcome]:
        """Return the outcomes that fail: of these kinds, and all limits that are missed."""
        require_kinds(fail_on)
        outcomes = chain.from_iterable(self.outcomes)
        return [outcome for outcome in outcomes if outcome.fails(fail_on)]

    def junit(
        self,
        path: str | os.PathLike,
        fail_on: Collection[str] = KINDS,
        *,
        overwrite: bool = False,
    ) -> None:
        """
        Write the outcomes as a report of JUnit, for a server of tests.

        fail_on: as in `failures`; overwrite: as in `save`.
        """
        require_kinds(fail_on)
        require_own(path, overwrite)
        write_junit(path, list(zip(self.recordings, self.outcomes)), fail_on)

    def save(self, folder: str | os.PathLike, *, overwrite: bool = False) -> Path:
        """
        Write the page check.html into a folder, and return its path.

        overwrite: whether a page is replaced that this package did not write, or that was
        changed since.
        """
        path = own_folder(folder, [words.PAGE], overwrite) / words.PAGE
        write_text(path, words.page(self.recordings, self.first_screen._asdict()))
        return path


def check(
    recordings: RecordingInput | Iterable[RecordingInput],
    sensor: SensorInput | None = None,
    *,
    against: RecordingInput | None = None,
    minima: Mapping[str, float] | None = None,
    urdf: str | os.PathLike | None = None,
    frame: str = 'imu_link',
    joints: str = '',
    progress: Progress = no_progress,
    **reading: Any,
) -> Check:
    """
    Check whether recordings are sound, and what the verbs can do with them.

    Parameters
    ----------
    recordings
        One or more recordings, DataFrames or paths. One that cannot be read is not sound.
    sensor
        The sensor, for recordings in volts: a Sensor, a datasheet's name or the path of a
        parameter file. None for the nominal sensor, or any IMU.
    against
        An earlier recording of the same task; `outcomes` then say what became worse.
    minima
        Smallest values by name: samples, span_s, rate_hz, rest_share, longest_rest_s, rests,
        poses.
    urdf, frame, joints
        Path of a robot as the stage, its frame that carries the sensor, topic of its joints.
    progress
        Called with the share of the work that is done, 0 to 1, and the name of the recording.
    **reading
        Arguments of `read` for recordings that are named by their path, such as `unit='g'`;
        samples whose stamp does not increase are counted in any case.

    Returns
    -------
    Check
        Faults, contents and abilities by recording; for one, what `diagnose` could show.

    Raises
    ------
    UserError
        The parameter file of the sensor cannot be read.

    """
    minima = minima or {}
    if unknown := sorted(set(minima) - set(MINIMA)):
        raise UserError(f'minima: {unknown[0]!r} is none of {", ".join(MINIMA)}')
    for name, smallest in minima.items():
        require_number(f'minima, {name}', smallest)
    options = reading_options(**{**reading, 'drop_bad_stamps': True})
    robot = RobotInput(urdf, frame, joints) if urdf else None
    several = list(map(_stored, as_series(recordings)))
    earlier = None if against is None else _earlier(_stored(against), sensor, robot, options)
    results = []
    outcomes = []
    for number, each in enumerate(several):
        name = Path(_path(each)).name

        def step(done: float, number: int = number, name: str = name) -> None:
            progress((number + done) / len(several), name)

        result = check_recording(each, as_input(sensor), options, step)
        if len(several) == 1:
            result = _with_what_shows(result, each, sensor, robot, options)
        read = partial(_samples, each, options)
        results.append(result)
        outcomes.append(outcomes_of(result, minima, earlier and earlier.recording, read))
    return Check(tuple(results), tuple(outcomes), earlier.name if earlier else '')


class _Against(NamedTuple):
    """What recordings are compared with."""

    recording: Earlier
    name: str  # Its name, with its first fault if it has one


def _earlier(
    given: Recording | str,
    sensor: SensorInput | None,
    robot: RobotInput | None,
    reading: ReadingOptions,
) -> _Against:
    """Look at an earlier recording, which others are compared with."""
    found = check_recording(given, as_input(sensor), reading)
    read = _samples(given, reading)
    recording = Earlier(found, read, as_input(sensor))
    faults = [*found.faults]
    if robot:
        try:
            robot.path(read, sensor_of(sensor, read).sensor)
        except UserError as error:
            faults.append(one_line(error))
    unsound = f', not sound: {faults[0]}' if faults else ''
    return _Against(recording, _path(given) + unsound)


def _stored(given: RecordingInput) -> Recording | str:
    """Return a path, which is read in blocks, or a recording."""
    return os.fspath(given) if isinstance(given, (str, os.PathLike)) else one_recording(given)


def _samples(recording: Recording | str, reading: ReadingOptions) -> Recording:
    """Return the samples of a recording."""
    if isinstance(recording, Recording):
        return recording
    return recording_files.read(recording, reading)


def _path(recording: Recording | str) -> str:
    """Return the path of a recording."""
    return recording.path if isinstance(recording, Recording) else recording


def _with_what_shows(
    result: Findings,
    given: Recording | str,
    sensor: SensorInput | None,
    robot: RobotInput | None,
    reading: ReadingOptions,
) -> Findings:
    """Add which effects `diagnose` could show in a recording, and from which size."""
    can_diagnose = any(each.tool == 'diagnose' and each.is_able for each in result.abilities)
    has_reference = can_diagnose or robot is not None
    if not result.is_sound or not has_reference:
        return result
    remarks = [*result.remarks]
    if result.contents is None or result.contents.samples > _MOST_SHOWN:
        remarks.append(
            'what diagnose could show is listed for recordings of '
            f'{_MOST_SHOWN} samples at most; check a part'
        )
        return replace(result, remarks=tuple(remarks))
    faults = []
    shows: list[Shown] = []
    reason = 'against the joints of the robot'
    try:
        read = _samples(given, reading)
        unit = sensor_of(sensor, read).sensor
        sim = None
        if robot:
            path = robot.path(read, unit)
            remarks.append(path.text())
            sim = path.as_motion()
        shows = _shows(read, unit, sim)
    except DataFault as fault:
        reason = fault.message
    except UserError as error:
        reason = one_line(error)
        if robot:
            faults.append(reason)
    abilities = {each.tool: each for each in result.abilities}
    if robot or not shows:
        abilities['diagnose'] = Ability('diagnose', bool(shows), reason)
    return replace(
        result,
        faults=tuple(faults),
        remarks=tuple(remarks),
        abilities=tuple(abilities.values()),
        shows=tuple(shows),
    )


def _shows(read: Recording, unit: Sensor, sim: Motion | None) -> list[Shown]:
    """Return by effect what `diagnose` could show, those that it could first; or raise a fault."""
    could_show = what_shows([read], unit, sim)
    scale_v_per_g = float(unit.scale_v_per_g.mean())
    shown_first = sorted(could_show, key=lambda effect: not effect.shows)
    return [as_shown(effect, scale_v_per_g) for effect in shown_first]
