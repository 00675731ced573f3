# SPDX-License-Identifier: Apache-2.0

"""Update of the front door: a calibration, and the recordings of a robot at work since then."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
import os
from pathlib import Path
from typing import Any

from adxl_ros.api.recordings import each_recording, RecordingInput
from adxl_ros.api.result import (
    as_json,
    FirstScreen,
    no_progress,
    Progress,
    Result,
)
from adxl_ros.api.sensors import as_input, load, SensorInput
from adxl_ros.calibrate.keep import update_report as words
from adxl_ros.calibrate.keep.keeper import Keeper, KeepSettings, KeptState
from adxl_ros.calibrate.keep.stays import RestStream
from adxl_ros.calibrate.keep.update_report import UpdatedDay
from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file
from adxl_ros.files.atomic_write import own_folder, require_own, write_text
from adxl_ros.files.recording_columns import Recording
from adxl_ros.files.stream_info import check_same_sensor
from adxl_ros.model.sensor import Sensor
from adxl_ros.report.arguments import require_number
from adxl_ros.report.figures import axes_for, AXIS_COLOURS
from adxl_ros.report.quantities import counted, number, utc
from adxl_ros.report.screen import Tile
from adxl_ros.wording import option


@dataclass(frozen=True, repr=False, eq=False)
class Update(Result):
    """
    A calibration after the rests of recordings.

    `print` shows the screen of the tool `fit --update`.

    Attributes
    ----------
    before
        The calibration that was given.
    sensor
        The calibration in use at the end, with the covariance of its error then.
    outcome
        ADOPTED, CHANGED (beyond what age and temperature explain) or KEPT.
    days
        What was known on each day with rests.
    state
        What is known at the end.
    counts
        Rests that were used, and rests without a temperature, which were not.
    adoptions
        Number of adoptions.

    """

    before: Sensor
    sensor: Sensor
    outcome: str
    days: tuple[UpdatedDay, ...]
    state: KeptState
    counts: Mapping[str, int]
    adoptions: int

    @property
    def screen(self) -> list[str]:
        """Return the lines of the tool's screen."""
        lines = [
            f'{self.outcome}: {self._sentence}',
            f'{counted(self.counts["rests"], "rest")} on {counted(len(self.days), "day")}, '
            f'{counted(self.adoptions, "adoption")}, age {number(self.state.age_days)} days',
        ]
        if lost := self.counts['without_temperature']:
            lines.append(f'{lost} rests without a temperature were not used')
        lines.append('')
        zero_g = zip(self.sensor.axes, self.state.total_mg, self.state.zero_g_90_mg)
        for axis, value, half in zero_g:
            lines.append(
                f'zero-g {axis}  {words.with_interval(value, half)} mg since the calibration, '
                f'at {self.state.temperature_c:.1f} °C'
            )
        return [*lines, *self.state.determined, '']

    @property
    def _sentence(self) -> str:
        if self.state.changed:
            what = self.state.changed.removeprefix('changed: ')
            return f'{what} Nothing is adopted; calibrate again.'
        if self.adoptions:
            return 'held-out rests fit the new calibration better.'
        return 'the rests show no sure improvement, and the calibration stays as it is.'

    @property
    def first_screen(self) -> FirstScreen:
        """Return the top of the page."""
        colour = {'ADOPTED': 'green', 'KEPT': 'grey', 'CHANGED': 'red'}[self.outcome]
        return FirstScreen(
            colour,
            self.outcome,
            self._sentence,
            [
                Tile('rests', str(self.counts['rests']), counted(len(self.days), 'day')),
                Tile('adoptions', str(self.adoptions)),
                Tile('tilt error now, 90 %', f'{number(self.state.tilt_90_deg)}°'),
            ],
        )

    def save(self, path: str | os.PathLike, *, overwrite: bool = False) -> None:
        """
        Write the parameter file; the covariance holds what age and temperature add.

        overwrite: whether a file is replaced that this package did not write.
        """
        require_own(path, overwrite)
        parameter_file.save(path, self.sensor, self.screen[:2])

    def report(self, folder: str | os.PathLike, *, overwrite: bool = False) -> Path:
        """Write the page report.html into a folder, and return its path."""
        path = own_folder(folder, [words.PAGE], overwrite) / words.PAGE
        top = self.first_screen._asdict()
        write_text(path, words.page(self.sensor, self.days, self.state, top))
        return path

    def to_dict(self) -> dict[str, Any]:
        """Return the days and the state; what is not finite is None."""
        return as_json(
            {
                'schema': 1,
                'serial': self.sensor.serial,
                'outcome': self.outcome,
                'adoptions': self.adoptions,
                'counts': dict(self.counts),
                'days': [{'date': day.date, **day._asdict()} for day in self.days],
                'state': vars(self.state),
            }
        )

    def to_pandas(self) -> Any:
        """Return a DataFrame with a row for each day and axis."""
        from pandas import DataFrame

        rows = []
        for day in self.days:
            for axis, value, half in zip(self.sensor.axes, day.zero_g_mg, day.zero_g_90_mg):
                rows.append((day.date, day.temperature_c, axis, value, half, day.adopted))
        head = ['date', 'temperature_c', 'axis', 'zero_g_mg', 'zero_g_90_mg', 'adopted']
        return DataFrame(rows, columns=head)

    def plot(self, ax: Any = None) -> Any:
        """Draw the zero-g by day, mg, into axes of matplotlib."""
        ax = axes_for(ax)
        for place, axis in enumerate(self.sensor.axes):
            ax.errorbar(
                [utc(day.stamp_ns) for day in self.days],
                [day.zero_g_mg[place] for day in self.days],
                yerr=[day.zero_g_90_mg[place] for day in self.days],
                fmt='o',
                label=axis,
                color=AXIS_COLOURS[axis],
            )
        ax.set(xlabel='day, UTC', ylabel='zero-g since the calibration, mg')
        ax.legend()
        return ax


def update(
    recordings: RecordingInput | Iterable[RecordingInput],
    sensor: SensorInput,
    *,
    drift_mg_per_year: float = KeepSettings.drift_mg_per_year,
    progress: Progress = no_progress,
) -> Update:
    """
    Keep a calibration up to date by the rests of a robot at work.

    It is what the node `keep_calibrated` does, on recordings. A rest shows the length of gravity
    only, because the ground may slope. So a robot that always stands level shows one sum of zero-g
    and scale factor, and how its zero-g follows the temperature while it does not move.

    Parameters
    ----------
    recordings
        Recordings of one unit in the order of time, with `temperature_c`: a Recording, a DataFrame
        or a path each.
    sensor
        The calibration: a Fit, a Sensor, or the path of its parameter file.
    drift_mg_per_year
        Usual drift of the zero-g in a year, mg. Units that drift up to six times as much are
        recognised by their rests.
    progress
        Called with the share of the work that is done, 0 to 1, and the name of the stage.

    Returns
    -------
    Update
        The calibration at the end, and what was known on each day.

    Raises
    ------
    UserError
        The calibration has no uncertainty, or a recording is of another unit or out of order.

    """
    require_number(option(drift_mg_per_year=drift_mg_per_year), drift_mg_per_year)
    given = as_input(sensor)
    before = given if isinstance(given, Sensor) else load(given or '')
    keeper = Keeper(before, KeepSettings(drift_mg_per_year))
    stream = RestStream(before)
    days: dict[str, UpdatedDay] = {}
    newest_ns = 0
    name = ''
    for place, read in enumerate(each_recording(recordings)):
        check_same_sensor(read.stream_info, read.axes, before)
        if read.stamp_ns[0] < newest_ns:
            raise UserError(
                f'{read.path}: begins before {name} ends; give recordings in the order of time'
            )
        newest_ns = int(read.stamp_ns[-1])
        name = read.path
        progress((place + 1) / (place + 2), 'rests')
        _take(read, before, stream, keeper, days)
    if not days:
        lost = stream.counts['without_temperature']
        reason = (
            f'{counted(lost, "rest")} without temperature_c, which tells age from temperature'
            if lost
            else 'no rest of 5 s by the noise of the sensor'
        )
        raise UserError(f'{name}: {reason}; nothing can be updated')
    state = keeper.state(keeper.newest_ns)
    outcome = 'ADOPTED' if keeper.adoptions else 'KEPT'
    if state.changed:
        outcome = 'CHANGED'
    return Update(
        before=before,
        sensor=keeper.sensor,
        outcome=outcome,
        days=tuple(days.values()),
        state=state,
        counts=dict(stream.counts),
        adoptions=len(keeper.adoptions),
    )


def _take(
    read: Recording,
    sensor: Sensor,
    stream: RestStream,
    keeper: Keeper,
    days: dict[str, UpdatedDay],
) -> None:
    """Take the rests of a recording."""
    stamps_ns = read.stamp_ns
    celsius = read.columns.get('temperature_c')
    if celsius is not None:
        stream.add_temperature(stamps_ns, celsius)
    for found in (stream.add(stamps_ns, read.volts(sensor)), stream.finish()):
        for rest in found:
            adopted = keeper.add(rest)
            state = keeper.state(rest.stop_ns)
            day = UpdatedDay(
                stamp_ns=rest.stop_ns,
                temperature_c=rest.temperature_c,
                zero_g_mg=state.total_mg,
                zero_g_90_mg=state.zero_g_90_mg,
                tilt_90_deg=state.tilt_90_deg,
                rests=sum(state.rests_a_day.values()),
                adopted=adopted is not None,
                changed=state.changed,
            )
            was_adopted = day.date in days and days[day.date].adopted
            days[day.date] = day._replace(adopted=day.adopted or was_adopted)
