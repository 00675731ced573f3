# SPDX-License-Identifier: Apache-2.0

"""Check of the front door: whether recordings are sound, and what the verbs can do with them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
import os
from pathlib import Path
import textwrap
from typing import Any

from adxl_ros.api.recordings import is_several, one_recording, RecordingInput, RobotInput
from adxl_ros.api.result import as_json, FirstScreen, no_progress, Progress, Result
from adxl_ros.api.sensors import as_input, sensor_of, SensorInput
from adxl_ros.diagnose.data_checks import DataFault
from adxl_ros.diagnose.diagnosis import what_shows
from adxl_ros.diagnose.report import shows_row
from adxl_ros.errors import one_line, UserError
from adxl_ros.files import recording as recording_files
from adxl_ros.files.atomic_write import make_folder, require_own, write_text
from adxl_ros.files.column_mapping import AS_IT_IS, ReadingOptions
from adxl_ros.files.recording_columns import Recording
from adxl_ros.report import page as html_page
from adxl_ros.report.quantities import column_unit, counted, duration, short_time
from adxl_ros.report.screen import COLUMNS, row, wrapped
from adxl_ros.signals.findings import Ability, check_recording, Findings, RecordingContents
from adxl_ros.signals.gyroscope_turns import GyroFindings
import numpy as np

_NAME_COLUMNS = 20  # Columns of the name of a recording
_HEAD = ('recording', 'length', 'rate', 'missing', 'rest', 'axes', 'verdict')
_COLUMNS = (_NAME_COLUMNS, '>13', '>10', '>9', '>8', '>6', 11)
_SHOWS_HEAD = ('effect', 'from', 'typical', '')
_SHOWS_COLUMNS = (24, 16, 14)
_MOST_SHOWN = 1_000_000
"""Samples up to which it is listed what `diagnose` could show. Chosen: a minute, and 1 GB."""
PAGE = 'check.html'  # Name of the page in the folder of the report
_LABEL_COLUMNS = 12  # Columns of the label of a line below a recording


def _lines(results: Sequence[Findings]) -> list[str]:
    """Return a line for each recording, then the details of one, or of those with a fault."""
    rows = []
    for name, *cells, verdict in (_HEAD, *map(_cells, results)):
        short = name if len(name) < _NAME_COLUMNS else f'{name[: _NAME_COLUMNS - 2]}…'
        rows.append(' ' + row((short, *cells, f'  {verdict}'), _COLUMNS))
    for result in results:
        if len(results) == 1 or not result.is_sound:
            rows += ['', result.path, *_details(result)]
    return [*rows, '']


def _sentence(results: Sequence[Findings]) -> str:
    if len(results) == 1:
        return f'The recording is {"" if results[0].is_sound else "not "}sound.'
    count = sum(result.is_sound for result in results)
    return f'{count} of {len(results)} recordings ' + ('is sound.' if count == 1 else 'are sound.')


def _cells(result: Findings) -> list[str]:
    name, contents = Path(result.path).name, result.contents
    if contents is None:
        return [name, *['–'] * 5, 'unreadable']
    return [
        name,
        duration(contents.span_s),
        f'{contents.rate_hz:.4g} Hz',
        str(contents.missing),
        f'{100 * contents.rest_share:.0f} %',
        'xyz'[: len(contents.axes)],
        'sound' if result.is_sound else 'NOT SOUND',
    ]


def _entries(result: Findings) -> list[tuple[str, str]]:
    """Return faults, values, remarks and abilities of a recording, each with its label."""
    entries = [
        ('NOT SOUND' if result.contents else 'unreadable', fault) for fault in result.faults
    ]
    if result.contents is not None:
        entries += [('values', text) for text in _value_lines(result.contents)]
    entries += [('remark', remark) for remark in result.remarks]
    return entries + [
        (ability.tool, f'{"yes" if ability.is_able else "no"}: {ability.reason}')
        for ability in result.abilities
    ]


def _details(result: Findings) -> list[str]:
    """Return the lines below the name of a recording; options to paste are one line."""
    rows = []
    for label, text in _entries(result):
        paste = result.paste if result.paste and text.endswith(result.paste) else ''
        rows += textwrap.wrap(
            f'  {label:{_LABEL_COLUMNS - 3}} {text.removesuffix(paste).rstrip()}',
            COLUMNS,
            subsequent_indent=_LABEL_COLUMNS * ' ',
            break_on_hyphens=False,
        )
        rows += [_LABEL_COLUMNS * ' ' + paste] if paste else []
    shown = [cells for cells in result.shows if not cells[3]]
    if result.shows:
        rows += [
            '',
            f'  {len(shown)} of {len(result.shows)} effects could show to diagnose',
            *('  ' + row(cells, _SHOWS_COLUMNS) for cells in (_SHOWS_HEAD, *shown)),
            '',
            '  the others cannot show',
        ]
    for missing in dict.fromkeys(cells[3] for cells in result.shows if cells[3]):
        effects = ', '.join(cells[0] for cells in result.shows if cells[3] == missing)
        rows += wrapped(f'  {missing}: {effects}', 4)
    return rows


def _value_lines(contents: RecordingContents) -> list[str]:
    texts = [
        f'{contents.samples} samples, jitter {short_time(contents.jitter_s)} rms',
        ', '.join(
            f'{axis.name} {axis.lowest_mps2:.3g} to {axis.highest_mps2:.3g} m/s²'
            for axis in contents.axes
        ),
        *(
            f'{name} {low:.4g} to {high:.4g} {column_unit(name)}'
            for name, (low, high) in contents.reference_ranges.items()
        ),
        contents.gravity.text,
        *[_gyro_text(contents.gyro)] * bool(contents.gyro),
    ]
    if contents.log_delay_s is not None:
        texts.append(f'log time minus header time {short_time(contents.log_delay_s)}')
    return texts


def _gyro_text(gyro: GyroFindings | None) -> str:
    """Return what a gyroscope reads at rest, and whether it follows the turns, for people."""
    if gyro is None or not gyro.bias_radps:
        return 'gyroscope: not checked, nothing rests'
    bias = ', '.join(f'{np.degrees(bias):.3g}' for bias in gyro.bias_radps)
    turns = (
        f'it misses gravity by {np.degrees(gyro.error_rad):.3g}° rms after '
        f'{counted(gyro.turns, "turn")}'
        if gyro.turns
        else 'no turn between two rests shows its axes'
    )
    return f'gyroscope at rest {bias} °/s; {turns}'


def _page(results: Sequence[Findings]) -> str:
    is_sound = all(result.is_sound for result in results)
    badge = {
        'colour': 'green' if is_sound else 'red',
        'sentence': _sentence(results),
        'word': 'Sound.' if is_sound else 'Not sound.',
    }
    recordings = [
        {'path': result.path, 'entries': _entries(result), 'shows': result.shows}
        for result in results
    ]
    return html_page.render(
        'adxl_ros.api',
        PAGE,
        {
            'title': 'Check of recordings',
            'about': [],
            'badge': badge,
            'figures': {},
            'columns': _HEAD,
            'rows': list(map(_cells, results)),
            'recordings': recordings,
            'shows_head': _SHOWS_HEAD,
        },
    )


@dataclass(frozen=True, repr=False)
class Check(Result):
    """
    Whether recordings are sound.

    `print` shows the screen of the tool `check`.
    """

    recordings: tuple[Findings, ...]
    """By recording: `faults`, `remarks`, `contents` (samples, rate, gaps, rests, ranges),
    `abilities` of the verbs, and for a single one what `diagnose` could show, `shows`."""

    @property
    def is_sound(self) -> bool:
        """Return whether no recording has a fault."""
        return all(result.is_sound for result in self.recordings)

    @property
    def faults(self) -> tuple[str, ...]:
        """Return why recordings are not sound, one line each."""
        return tuple(fault for result in self.recordings for fault in result.faults)

    @property
    def screen(self) -> list[str]:
        """Return the lines of the tool's screen."""
        return [*_lines(self.recordings), _sentence(self.recordings)]

    @property
    def first_screen(self) -> FirstScreen:
        """Return the top of the page."""
        tiles = [tuple(_cells(result)) for result in self.recordings]
        colour, word = ('green', 'Sound.') if self.is_sound else ('red', 'Not sound.')
        return FirstScreen(colour, word, _sentence(self.recordings), tiles)

    def __str__(self) -> str:
        return '\n'.join(self.screen)

    def to_dict(self) -> dict[str, Any]:
        """Return what the tool prints with --json, below `recordings`."""
        recordings = [_as_json(result) for result in self.recordings]
        return as_json({'schema': 1, 'recordings': recordings})

    def to_pandas(self) -> Any:
        """Return a DataFrame with a row for each recording, as the screen has them."""
        from pandas import DataFrame

        return DataFrame(map(_cells, self.recordings), columns=_HEAD)

    def save(self, folder: str | os.PathLike, *, overwrite: bool = False) -> Path:
        """
        Write the page check.html into a folder, and return its path.

        overwrite: whether a page is replaced that this package did not write, or that was
        changed since.
        """
        require_own(Path(folder) / PAGE, overwrite)
        path = make_folder(folder) / PAGE
        write_text(path, _page(self.recordings))
        return path


def check(
    recordings: RecordingInput | Iterable[RecordingInput],
    sensor: SensorInput | None = None,
    *,
    urdf: str | os.PathLike | None = None,
    frame: str = 'imu_link',
    joints: str = '',
    reading: ReadingOptions = AS_IT_IS,
    progress: Progress = no_progress,
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
    urdf, frame, joints
        Path of a robot as the stage, its frame that carries the sensor, topic of its joints.
    reading
        How the recordings of paths are read; samples whose stamp does not increase are counted.
    progress
        Called with the share of the work that is done, 0 to 1, and the name of the recording.

    Returns
    -------
    Check
        Faults, contents and abilities by recording; for one, what `diagnose` could show.

    Raises
    ------
    UserError
        The parameter file of the sensor cannot be read.

    """
    several = [
        each if isinstance(each, (str, os.PathLike)) else one_recording(each)
        for each in (recordings if is_several(recordings) else [recordings])
    ]
    reading = replace(reading, drop_bad_stamps=True)
    results = []
    for number, each in enumerate(several):
        name = Path(_path(each)).name

        def step(done: float, number: int = number, name: str = name) -> None:
            progress((number + done) / len(several), name)

        results.append(check_recording(each, as_input(sensor), reading, step))
    if len(results) == 1:
        robot = RobotInput(urdf, frame, joints) if urdf else None
        results = [_with_what_shows(results[0], several[0], sensor, robot, reading)]
    return Check(tuple(results))


def _path(recording: RecordingInput) -> str:
    """Return the path of a recording."""
    return recording.path if isinstance(recording, Recording) else os.fspath(recording)


def _with_what_shows(
    result: Findings,
    given: RecordingInput,
    sensor: SensorInput | None,
    robot: RobotInput | None,
    reading: ReadingOptions,
) -> Findings:
    """Add which effects `diagnose` could show in a recording, and from which size."""
    if not result.is_sound or not (
        robot or any(a.tool == 'diagnose' and a.is_able for a in result.abilities)
    ):
        return result
    if result.contents is None or result.contents.samples > _MOST_SHOWN:
        return replace(
            result,
            remarks=(
                *result.remarks,
                'what diagnose could show is listed for recordings of '
                f'{_MOST_SHOWN} samples at most; check a part',
            ),
        )
    reason, sim = 'against the joints of the robot', None
    try:
        read = given if isinstance(given, Recording) else recording_files.read(given, reading)
        unit = sensor_of(sensor, read).sensor
        if robot:
            path = robot.path(read, unit)
            result = replace(result, remarks=(*result.remarks, path.text()))
            sim = path.as_motion()
        shown = what_shows([read], unit, sim)
        if isinstance(shown, DataFault):
            reason = shown.message
        else:
            result = replace(
                result,
                shows=tuple(
                    shows_row(effect, float(unit.scale_v_per_g.mean()))
                    for effect in sorted(shown, key=lambda effect: not effect.shows)
                ),
            )
    except UserError as error:
        reason = one_line(error)
        if robot:
            result = replace(result, faults=(*result.faults, reason))
    if robot or not result.shows:
        ability = Ability('diagnose', bool(result.shows), reason)
        result = replace(
            result,
            abilities=tuple(ability if a.tool == ability.tool else a for a in result.abilities),
        )
    return result


def _as_json(result: Findings) -> dict[str, Any]:
    values: dict[str, Any] = {}
    if result.contents is not None:
        values = {
            name: value
            for name, value in asdict(result.contents).items()
            if name not in ('path', 'remarks', 'cut', 'gravity', 'neighbour_faults')
        }
        values['gravity'] = result.contents.gravity.as_json()
        values['bad_stamps'] = result.contents.bad_stamps._asdict()
    return {
        'schema': 1,
        'recording': result.path,
        'sound': result.is_sound,
        'faults': list(result.faults),
        'remarks': list(result.remarks),
        'contents': values,
        'can': {
            ability.tool: {'able': ability.is_able, 'reason': ability.reason}
            for ability in result.abilities
        },
        'could_show': [
            dict(zip(('effect', 'from', 'typical', 'missing'), row)) for row in result.shows
        ],
    }
