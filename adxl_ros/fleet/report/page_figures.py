# SPDX-License-Identifier: Apache-2.0

"""Figures of the page of a fleet: the trend of a unit, and the matrix of effects."""

from __future__ import annotations

from datetime import datetime, timedelta, timezone

from adxl_ros.files import plotly_figures as plotly
from adxl_ros.fleet.report.effect_matrix import EffectMatrix
from adxl_ros.fleet.report.fleet_table import FleetTable
from adxl_ros.fleet.report.unit_results import QuantityResult
from adxl_ros.model.constants import Z_90
import numpy as np
import scipy

_TREND_HEIGHT = 190
"""Height of the plot of a trend, pixels."""
_LINE_POINTS = 9
"""Points of a line with its band, between two calibrations. Chosen: a band is hardly curved."""
_BAND = 0.05
"""Probability on each side of a band."""
_MOST_EFFECTS = 20
"""Largest count of effects in the matrix. Chosen: their names fit beside each other."""
_MOST_NAMES = 40
"""Largest count of units whose serial numbers stand beside the matrix."""
_ROW_PIXELS = 16
_MOST_PIXELS = 640
_MATRIX_HEAD_PIXELS = 150
"""Heights of the matrix: of a unit with a name, of all units, and of the names of effects."""
_EPOCH = datetime(1970, 1, 1, tzinfo=timezone.utc)
_DAYS_PER_YEAR = 365.25


def date_text(year: float) -> str:
    """Return the day of a date in years since 1970; '-' for NaN."""
    return f'{_date(year):%Y-%m-%d}' if np.isfinite(year) else '-'


def _date(year: float) -> datetime:
    return _EPOCH + timedelta(days=float(year) * _DAYS_PER_YEAR)


def _stamps(years: np.ndarray) -> list[str]:
    return [f'{_date(year):%Y-%m-%d %H:%M}' for year in years]


def trend(table: FleetTable, result: QuantityResult, unit: int) -> plotly.Figure:
    """Plot a quantity of a unit over time."""
    part = table.unit[result.rows] == unit
    factor, years = result.quantity.factor, result.recordings.time[part]
    value = factor * (result.recordings.value[part] - _origin(result, unit))
    std = factor * result.recordings.std[part]
    is_outlier, dates = result.is_outlier[part], np.array(_stamps(years), object)
    recorded = plotly.points([], value[~is_outlier], Z_90 * std[~is_outlier], 'recording',
                             plotly.AXIS_COLOURS['x'])
    recorded |= {'x': list(dates[~is_outlier]), 'marker': {
        'color': plotly.AXIS_COLOURS['x'], 'size': 4}}
    recorded['error_y'] |= {'width': 0, 'thickness': 0.8}
    kept = result.recordings[~result.is_outlier]
    traces = [*_lines(result, unit, years[~is_outlier], kept.period[part[~result.is_outlier]]),
              recorded]
    if is_outlier.any():
        traces.append({'type': 'scatter', 'mode': 'markers', 'name': 'outlier',
                       'x': list(dates[is_outlier]), 'y': plotly.rounded(value[is_outlier]),
                       'marker': {'color': plotly.BEFORE_COLOUR, 'size': 7,
                                  'symbol': 'x-thin', 'line': {
                                      'width': 1.6, 'color': plotly.BEFORE_COLOUR}}})
    marks = [{'type': 'line', 'x0': stamp, 'x1': stamp, 'yref': 'paper', 'y0': 0, 'y1': 1,
              'line': {'color': plotly.QUIET_COLOUR, 'width': 1.2, 'dash': 'dash'}}
             for stamp in _stamps(calibration_years(table, unit))]
    return plotly.figure(traces, _TREND_HEIGHT, showlegend=False, shapes=marks,
                         xaxis={'type': 'date', 'nticks': 3, 'tickangle': 0,
                                'tickformat': '%b %Y'},
                         yaxis={'title': {'text': _axis_title(result)}, 'nticks': 5})


def _origin(result: QuantityResult, unit: int) -> float:
    """Return the value that a plot has at 0: the mean of a unit where units differ by far more."""
    place = result.place_of(unit)
    return float(result.trends.level[place]) \
        if _is_relative(result) and place is not None else 0.0


def _is_relative(result: QuantityResult) -> bool:
    return result.quantity.is_coefficient and result.quantity.is_force


def _axis_title(result: QuantityResult) -> str:
    unit = result.quantity.shown_unit
    return f'{unit} from the mean' if _is_relative(result) else unit


def calibration_years(table: FleetTable, unit: int) -> np.ndarray:
    """Return when the calibrations of a unit changed."""
    rows = table.rows_of(unit)
    rows = rows[np.isfinite(table.years[rows])]
    if not len(rows):
        return np.zeros(0)
    begins = np.flatnonzero(np.diff(table.period[rows], prepend=-1))
    age = table['calibration_age_days'][rows]
    years = []
    for number, begin in enumerate(begins):
        end = begins[number + 1] if number + 1 < len(begins) else len(rows)
        dated = begin + np.flatnonzero(np.isfinite(age[begin:end]))
        if len(dated):
            years.append(table.years[rows[dated[0]]] - age[dated[0]] / _DAYS_PER_YEAR)
        elif number:
            years.append(table.years[rows[begin]])
    first = table.years[rows[0]]
    # A calibration long before the first recording would compress the plot.
    return np.array([year for year in years
                     if year > first - 0.1 * max(table.years[rows[-1]] - first, 0.01)])


def _lines(result: QuantityResult, unit: int, times: np.ndarray, periods: np.ndarray
           ) -> list[plotly.Figure]:
    """Return the lines of a unit between calibrations with their bands."""
    place = result.place_of(unit)
    if place is None or len(times) < 2:
        return []
    trends, factor = result.trends, result.quantity.factor
    is_claimed = bool(result.is_claimed[place])
    slope, slope_std = (trends.slope[place], trends.slope_std[place]) if is_claimed else (0, 0)
    width = -float(scipy.special.stdtrit(trends.freedom[place], _BAND)) if is_claimed else Z_90
    colour = plotly.BEFORE_COLOUR if is_claimed else plotly.QUIET_COLOUR
    traces = []
    for period in np.unique(periods):
        part = times[periods == period]
        x = np.linspace(part.min(), part.max(), _LINE_POINTS)
        distance = x - trends.period_time[period]
        middle = factor * (trends.period_value[period] + slope * distance - _origin(result, unit))
        half = factor * width * np.hypot(trends.period_std[period], slope_std * distance)
        dates = _stamps(x)
        traces += [
            {'x': [*dates, *dates[::-1]], 'mode': 'lines', 'line': {'width': 0},
             'fill': 'toself', 'type': 'scatter', 'fillcolor': colour, 'opacity': 0.25,
             'hoverinfo': 'skip',
             'y': plotly.rounded(np.concatenate([middle + half, (middle - half)[::-1]]))},
            plotly.line([], middle, 'line', colour) | {'x': dates}]
    return traces


def matrix(table: FleetTable, effects: EffectMatrix) -> plotly.Figure:
    """Plot how often each effect is named in each unit."""
    columns = effects.effects[:_MOST_EFFECTS]
    share = 100 * effects.share[:, :len(columns)]
    serials = [table.serials[unit] for unit in effects.units]
    named = len(serials) <= _MOST_NAMES
    height = _MATRIX_HEAD_PIXELS + min(_ROW_PIXELS * len(serials), _MOST_PIXELS)
    trace = {'type': 'heatmap', 'x': list(columns), 'y': serials,
             'z': [[float(f'{value:.3g}') for value in row] for row in share],
             'zmin': 0, 'zmax': 100, 'colorscale': [[0, '#f0f3f6'], [1, '#b03224']],
             'xgap': 2, 'ygap': 1 if named else 0,
             'hovertemplate': '%{y}: %{x} in %{z} % of the recordings<extra></extra>',
             'colorbar': {'title': {'text': '%'}, 'thickness': 10, 'len': 0.6}}
    return plotly.figure([trace], height,
                         xaxis={'side': 'top', 'tickangle': -90, 'type': 'category',
                                'tickvals': list(columns)},
                         yaxis={'autorange': 'reversed', 'type': 'category',
                                'showticklabels': named, 'tickvals': serials if named else [],
                                'title': {'text': 'unit' if named else
                                          'units by serial number'}})
