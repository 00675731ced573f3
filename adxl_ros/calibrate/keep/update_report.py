# SPDX-License-Identifier: Apache-2.0

"""The page of a calibration that recordings of a robot at work keep up to date."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from adxl_ros.calibrate.keep.keeper import Keeper, KeptState
from adxl_ros.model.sensor import Sensor
from adxl_ros.report import page as html_page
from adxl_ros.report.figures import AXIS_COLOURS, figure, line, points, QUIET_COLOUR
from adxl_ros.report.quantities import counted, utc, with_half_width
import numpy as np

PAGE = 'report.html'
_CURVE_POINTS = 30  # Points of a curve over temperature
_HEIGHT = 320  # Of a plot, pixels


def with_interval(value: float, half: float) -> str:
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


def page(
    sensor: Sensor, days: Sequence[UpdatedDay], state: KeptState, top: Mapping[str, Any]
) -> str:
    """Return the page; `top` has badge and tiles."""
    values = {
        'title': f'Calibration of {sensor.serial} over {counted(len(days), "day")}',
        'badge': top,
        'tiles': top['tiles'],
        'figures': {
            'days': _by_day(sensor, days),
            'temperature': _by_temperature(sensor, days),
        },
        'determined': state.determined,
        'head': ['day', 'temperature', 'zero-g since the calibration, mg', 'rests', ''],
        'rows': [_row(sensor, day) for day in days],
    }
    return html_page.render('adxl_ros.calibrate.keep', 'update.html', values)


def _row(sensor: Sensor, day: UpdatedDay) -> list[str]:
    zero_g = ', '.join(
        f'{axis} {with_interval(value, half)}'
        for axis, value, half in zip(sensor.axes, day.zero_g_mg, day.zero_g_90_mg)
    )
    event = day.changed or ('adopted' if day.adopted else '')
    return [day.date, f'{day.temperature_c:.1f} °C', zero_g, str(day.rests), event]


def _by_day(sensor: Sensor, days: Sequence[UpdatedDay]) -> dict[str, Any]:
    """Return the plot of the zero-g by day; dotted lines are adoptions."""
    since = [(day.stamp_ns - days[0].stamp_ns) / 86_400e9 for day in days]
    traces = [
        points(
            since,
            [day.zero_g_mg[place] for day in days],
            [day.zero_g_90_mg[place] for day in days],
            axis,
            AXIS_COLOURS[axis],
        )
        for place, axis in enumerate(sensor.axes)
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
        for x, day in zip(since, days)
        if day.adopted
    ]
    return figure(
        traces,
        _HEIGHT,
        shapes=adopted,
        xaxis={'title': {'text': f'days since {days[0].date}'}},
        yaxis={'title': {'text': 'zero-g since the calibration, mg'}},
    )


def _by_temperature(sensor: Sensor, days: Sequence[UpdatedDay]) -> dict[str, Any]:
    """Return the plot of the zero-g of the last calibration, with its 90 % interval."""
    seen_c = [day.temperature_c for day in days]
    celsius = np.linspace(min(seen_c) - 5, max(seen_c) + 5, _CURVE_POINTS)
    keeper = Keeper(sensor)
    traces = []
    for place, axis in enumerate(sensor.axes):
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
