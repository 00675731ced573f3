# SPDX-License-Identifier: Apache-2.0

"""Update of the front door: a calibration, and the recordings of a robot at work since then."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
import os
from pathlib import Path
from typing import Any, NamedTuple

from adxl_ros.api.recordings import each_recording, RecordingInput
from adxl_ros.api.result import as_json, FirstScreen, no_progress, Progress, Result
from adxl_ros.api.sensors import as_input, load, SensorInput
from adxl_ros.calibrate.keep.keeper import Keeper, KeepSettings, KeptState
from adxl_ros.calibrate.keep.stays import RestStream
from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file
from adxl_ros.files.atomic_write import make_folder, require_own, write_text
from adxl_ros.files.recording_columns import check_same_sensor, Recording
from adxl_ros.model.sensor import Sensor
from adxl_ros.report import page
from adxl_ros.report.figures import axes_for, AXIS_COLOURS, figure, line, points, QUIET_COLOUR
from adxl_ros.report.quantities import counted, number, utc, with_half_width
import numpy as np

PAGE = 'report.html'
_CURVE_POINTS = 30  # Points of a curve over temperature
_HEIGHT = 320  # Of a plot, pixels


def _interval(value: float, half: float) -> str:
    """Write a value and half of its interval with the digits that this allows."""
    return with_half_width(value, half).replace('+-', '±')


class UpdatedDay(NamedTuple):
    """What is known at the last rest of a day."""

    stamp_ns: int  # Stamp of that rest, ns
    temperature_c: float  # Its temperature, °C
    zero_g_mg: tuple[float, ...]  # Zero-g beyond the calibration given, by axis, mg
    zero_g_90_mg: tuple[float, ...]  # Halves of the 90 % intervals, mg
    tilt_90_deg: float  # Tilt error that nine of ten are below, degrees; NaN without three axes
    rests: int  # Rests of the last 24 hours
    adopted: bool  # Whether a calibration was adopted on this day
    changed: str  # What changed beyond age and temperature, ''

    @property
    def date(self) -> str:
        """Return the date, UTC."""
        return f'{utc(self.stamp_ns):%Y-%m-%d}'


@dataclass(frozen=True, repr=False)
class Update(Result):
    """
    A calibration after the rests of recordings.

    `print` shows the screen of the tool `fit --update`.
    """

    before: Sensor
    """The calibration that was given."""
    sensor: Sensor
    """The calibration in use at the end, with the covariance of its error then."""
    outcome: str
    """ADOPTED, CHANGED (beyond what age and temperature explain) or KEPT."""
    days: tuple[UpdatedDay, ...]
    """What was known on each day with rests."""
    state: KeptState
    """What is known at the end."""
    counts: Mapping[str, int]
    """Rests that were used, and rests without a temperature, which were not."""
    adoptions: int
    """Number of adoptions."""

    @property
    def screen(self) -> list[str]:
        """Return the lines of the tool's screen."""
        lost = self.counts['without_temperature']
        return [
            f'{self.outcome}: {self._sentence}',
            f'{counted(self.counts["rests"], "rest")} on {counted(len(self.days), "day")}, '
            f'{counted(self.adoptions, "adoption")}, age {number(self.state.age_days)} days',
            *[f'{lost} rests without a temperature were not used'] * bool(lost),
            '',
            *(
                f'zero-g {axis}  {_interval(value, half)} mg since the calibration, '
                f'at {self.state.temperature_c:.1f} °C'
                for axis, value, half in zip(
                    self.sensor.axes, self.state.total_mg, self.state.zero_g_90_mg
                )
            ),
            *self.state.determined,
            '',
        ]

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
                ('rests', str(self.counts['rests']), counted(len(self.days), 'day')),
                ('adoptions', str(self.adoptions), ''),
                ('tilt error now, 90 %', f'{number(self.state.tilt_90_deg)}°', ''),
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
        require_own(Path(folder) / PAGE, overwrite)
        path, top = make_folder(folder) / PAGE, self.first_screen
        values = {
            'title': f'Calibration of {self.sensor.serial} over {counted(len(self.days), "day")}',
            'about': [],
            'badge': {'colour': top.colour, 'word': top.word, 'sentence': top.sentence},
            'tiles': [dict(zip(('label', 'text', 'note'), tile)) for tile in top.tiles],
            'figures': {'days': self._by_day(), 'temperature': self._by_temperature()},
            'determined': self.state.determined,
            'head': ['day', 'temperature', 'zero-g since the calibration, mg', 'rests', ''],
            'rows': [self._row(day) for day in self.days],
        }
        write_text(path, page.render('adxl_ros.api', 'update.html', values))
        return path

    def _row(self, day: UpdatedDay) -> list[str]:
        zero_g = ', '.join(
            f'{axis} {_interval(value, half)}'
            for axis, value, half in zip(self.sensor.axes, day.zero_g_mg, day.zero_g_90_mg)
        )
        event = day.changed or 'adopted' * day.adopted
        return [day.date, f'{day.temperature_c:.1f} °C', zero_g, str(day.rests), event]

    def _by_day(self) -> dict[str, Any]:
        """Return the plot of the zero-g by day; dotted lines are adoptions."""
        since = [(day.stamp_ns - self.days[0].stamp_ns) / 86_400e9 for day in self.days]
        traces = [
            points(
                since,
                [day.zero_g_mg[place] for day in self.days],
                [day.zero_g_90_mg[place] for day in self.days],
                axis,
                AXIS_COLOURS[axis],
            )
            for place, axis in enumerate(self.sensor.axes)
        ]
        adopted = [
            {
                'type': 'line',
                'yref': 'paper',
                'x0': x,
                'x1': x,
                'y0': 0,
                'y1': 1,
                'line': {'color': QUIET_COLOUR, 'dash': 'dot', 'width': 1},
            }
            for x, day in zip(since, self.days)
            if day.adopted
        ]
        return figure(
            traces,
            _HEIGHT,
            shapes=adopted,
            xaxis={'title': {'text': f'days since {self.days[0].date}' if self.days else 'days'}},
            yaxis={'title': {'text': 'zero-g since the calibration, mg'}},
        )

    def _by_temperature(self) -> dict[str, Any]:
        """Return the plot of the zero-g of the last calibration, with its 90 % interval."""
        seen_c = [day.temperature_c for day in self.days] or [self.state.temperature_c]
        celsius = np.linspace(min(seen_c) - 5, max(seen_c) + 5, _CURVE_POINTS)
        keeper = Keeper(self.sensor)
        traces = []
        for place, axis in enumerate(self.sensor.axes):
            curve = [keeper.zero_g_mg(temperature_c)[place] for temperature_c in celsius]
            start = keeper.zero_g_mg(float(np.mean(seen_c)))[place].value
            colour = AXIS_COLOURS[axis]
            middle = [estimate.value - start for estimate in curve]
            half = [estimate.half_width for estimate in curve]
            traces.append(line(celsius, middle, axis, colour))
            for sign in (-1, 1):
                edge = np.add(middle, np.multiply(half, sign))
                dashed = {'color': colour, 'width': 0.8, 'dash': 'dash'}
                traces.append(
                    line(celsius, edge, f'{axis}, 90 %', colour, line=dashed, showlegend=False)
                )
        return figure(
            traces,
            _HEIGHT,
            xaxis={'title': {'text': 'temperature, °C'}},
            yaxis={'title': {'text': 'zero-g from the mean temperature, mg'}},
        )

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
        ax.set_ylabel('zero-g since the calibration, mg')
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
    given = as_input(sensor)
    before = given if isinstance(given, Sensor) else load(given or '')
    keeper = Keeper(before, KeepSettings(drift_mg_per_year))
    stream = RestStream(before)
    days: dict[str, UpdatedDay] = {}
    newest_ns, name = 0, ''
    for place, read in enumerate(each_recording(recordings)):
        check_same_sensor(read.stream_info, read.axes, before)
        if read.stamp_ns[0] < newest_ns:
            raise UserError(
                f'{read.path}: begins before {name} ends; give recordings in the order of time'
            )
        newest_ns, name = int(read.stamp_ns[-1]), read.path
        progress((place + 1) / (place + 2), 'rests')
        _take(read, before, stream, keeper, days)
    if not days:
        lost = stream.counts['without_temperature']
        reason = (
            f'{counted(lost, "rest")} without temperature_c, which tells age from temperature'
            if lost
            else 'no rest of 5 s by the noise of the sensor'
        )
        raise UserError(f'{name or "no recording"}: {reason}; nothing can be updated')
    state = keeper.state(keeper.newest_ns)
    outcome = 'CHANGED' if state.changed else 'ADOPTED' if keeper.adoptions else 'KEPT'
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
                rest.stop_ns,
                rest.temperature_c,
                state.total_mg,
                state.zero_g_90_mg,
                state.tilt_90_deg,
                sum(state.rests_a_day.values()),
                adopted is not None,
                state.changed,
            )
            earlier = days.get(day.date)
            was_adopted = earlier is not None and earlier.adopted
            days[day.date] = day._replace(adopted=day.adopted or was_adopted)
