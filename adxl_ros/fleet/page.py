# SPDX-License-Identifier: Apache-2.0

"""The page of a fleet, and the file of its population."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from datetime import datetime, timedelta, timezone
from functools import partial
from pathlib import Path
from typing import NamedTuple

from adxl_ros.files import calibration_store
from adxl_ros.files.atomic_write import write_text
from adxl_ros.fleet.row import PAGE, POPULATION, reason_kind, TABLE
from adxl_ros.fleet.table import (
    analyse,
    Condition,
    DAYS_PER_YEAR,
    Drift,
    effect_matrix,
    FleetTable,
    QuantityResult,
    rank,
    read,
    SensorState,
    TOLERANCE_MG,
)
from adxl_ros.fleet.trends import FALSE_DISCOVERY_RATE
from adxl_ros.model.constants import AXES, Z_90
from adxl_ros.model.population import Population
from adxl_ros.report import figures as plotly, page as html_page
from adxl_ros.report.quantities import number
from adxl_ros.report.screen import Tile
import numpy as np
import pandas as pd

_TREND_HEIGHT = 190  # Height of the plot of a trend, pixels
_MOST_EFFECTS = 20
"""Largest count of effects in the matrix. Chosen: their names fit beside each other."""
_ROW_PIXELS = 16
_MOST_PIXELS = 640
_MATRIX_HEAD_PIXELS = 150
"""Heights of the matrix: of a sensor with a name, of all sensors, and of the names of effects."""
_EPOCH = datetime(1970, 1, 1, tzinfo=timezone.utc)
_SHOWN = 12  # Number of sensors in the first table and with a plot. Chosen: they fit on one screen
_NAMED = 3  # Number of drifting sensors that a screen names. Chosen: some lines
_MOST_ROWS = 50  # Largest count of outliers and of reasons on the page; the table holds them all
_MEASURES = ('gap_before_mps2', *(f'zero_g_{axis}_v' for axis in AXES))
"""Columns that tell whether a sensor is within the tolerance."""
_SENTENCES = {
    Condition.OUT_OF_TOLERANCE: 'Recalibrate what is at the head of the list.',
    Condition.IN_ORDER: 'All units are within the tolerance.',
}
"""What the most urgent state means for the user; the others mean the same."""


def date_text(year: float) -> str:
    """Return the day of a date in years since 1970; '-' for NaN."""
    return _stamps([year])[0][:10] if np.isfinite(year) else '-'


def _stamps(years: Iterable[float]) -> list[str]:
    return [
        f'{_EPOCH + timedelta(days=float(year) * DAYS_PER_YEAR):%Y-%m-%d %H:%M}' for year in years
    ]


def _trend_figure(table: FleetTable, result: QuantityResult, sensor: int) -> plotly.Figure:
    """Plot a quantity of a sensor over time, about its mean where sensors differ by far more."""
    quantity = result.quantity
    place = result.place_of(sensor)
    origin = result.trends.level[place] if quantity.is_coefficient and place is not None else 0.0
    part = table.sensor[result.rows] == sensor
    years = result.recordings.time[part]
    is_outlier = result.is_outlier[part]
    value = quantity.factor * (result.recordings.value[part] - origin)
    half = Z_90 * quantity.factor * result.recordings.std[part]
    traces = []
    if place is not None and (~is_outlier).sum() > 1:
        is_claimed = bool(result.is_claimed[place])
        slope = quantity.factor * result.trends.slope[place] if is_claimed else 0.0
        colour = plotly.BEFORE_COLOUR if is_claimed else plotly.QUIET_COLOUR
        periods = np.where(is_outlier, -1, result.recordings.period[part])
        for period in set(periods.tolist()) - {-1}:
            within = years[periods == period]
            level = value[periods == period].mean()
            ends = np.array([within.min(), within.max()])
            traces.append(
                plotly.line([], level + slope * (ends - within.mean()), 'line', colour)
                | {'x': _stamps(ends)}
            )
    for name, shown, colour in (
        ('recording', ~is_outlier, plotly.AXIS_COLOURS['x']),
        ('outlier', is_outlier, plotly.BEFORE_COLOUR),
    ):
        if shown.any():
            traces.append(
                plotly.points([], value[shown], half[shown], name, colour)
                | {'x': _stamps(years[shown])}
            )
    origin = ' from the mean' if quantity.is_coefficient else ''
    return plotly.figure(
        traces,
        _TREND_HEIGHT,
        showlegend=False,
        shapes=_calibration_marks(table, sensor),
        xaxis={'type': 'date', 'nticks': 3, 'tickangle': 0, 'tickformat': '%b %Y'},
        yaxis={'title': {'text': quantity.shown_unit + origin}, 'nticks': 5},
    )


def _calibration_marks(table: FleetTable, sensor: int) -> list[plotly.Figure]:
    """Return a line at each calibration between recordings of a sensor, where a period ends."""
    rows = table.rows_of(sensor)
    made = table.years[rows] - table['calibration_age_days'][rows] / DAYS_PER_YEAR
    begins = made[1:][np.diff(table.period[rows]) > 0]
    style = {'color': plotly.QUIET_COLOUR, 'width': 1.2, 'dash': 'dash'}
    return [
        {'type': 'line', 'x0': x, 'x1': x, 'yref': 'paper', 'y0': 0, 'y1': 1, 'line': style}
        for x in _stamps(begins[np.isfinite(begins)])
    ]


def _matrix_figure(table: FleetTable, share: pd.DataFrame) -> plotly.Figure:
    """Plot how often each effect is named in each sensor."""
    share = share.iloc[:, :_MOST_EFFECTS]
    columns = list(share)
    trace = {
        'type': 'heatmap',
        'x': columns,
        'y': [table.serials[sensor] for sensor in share.index],
        'z': (100 * share.to_numpy()).round(1).tolist(),
        'zmin': 0,
        'zmax': 100,
        'colorscale': [[0, '#f0f3f6'], [1, '#b03224']],
        'xgap': 2,
        'hovertemplate': '%{y}: %{x} in %{z} % of the recordings<extra></extra>',
        'colorbar': {'title': {'text': '%'}, 'thickness': 10, 'len': 0.6},
    }
    height = _MATRIX_HEAD_PIXELS + min(_ROW_PIXELS * len(share), _MOST_PIXELS)
    return plotly.figure(
        [trace],
        height,
        xaxis={'side': 'top', 'tickangle': -90, 'type': 'category', 'tickvals': columns},
        yaxis={'autorange': 'reversed', 'type': 'category', 'title': {'text': 'unit'}},
    )


class Written(NamedTuple):
    """What a page is made of, for the end of a run."""

    files: list[Path]  # The page, and the population
    findings: list[str]  # Bad batches and drifts, the most urgent first, for people


def write(folder: Path) -> Written:
    """Write page and population of a fleet beside its table."""
    html_page.check_libraries()
    table = read(folder / TABLE)
    results = analyse(table)
    calibration_store.write_population(
        folder / POPULATION,
        Population(
            POPULATION,
            {
                result.quantity.column: result.population
                for result in results
                if result.population is not None and result.population.prediction_std > 0
            },
        ),
    )
    write_text(folder / PAGE, page(table, results, folder))
    return Written(
        [folder / name for name in (PAGE, POPULATION)],
        [*_batches(results), *_drifting(rank(table, results))],
    )


def _batches(results: Sequence[QuantityResult]) -> list[str]:
    """Return a sentence for each bad batch."""
    return [
        f'{batch.members.sum()} units with a serial number {batch.prefix}… have a '
        f'{result.quantity.label} that differs by '
        + result.quantity.text(batch.difference, batch.low, batch.high)
        + f' from that of the {(~batch.members).sum()} others: a bad batch.'
        for result in results
        if (batch := result.batch) is not None
    ]


def _drifting(sensors: Sequence[SensorState]) -> list[str]:
    """Return a sentence for the most urgent sensors that drift, and the number of all."""
    drifting = [sensor for sensor in sensors if sensor.drifts]
    lines = [f'{sensor.serial} drifts: {sensor.drifts[0].text}.' for sensor in drifting[:_NAMED]]
    if len(drifting) > _NAMED:
        lines.append(f'{len(drifting) - _NAMED} more units drift; the page has them.')
    return lines


def page(table: FleetTable, results: Sequence[QuantityResult], folder: Path) -> str:
    """Return the page of a fleet."""
    sensors = rank(table, results)
    share = effect_matrix(table)
    figures: dict[str, plotly.Figure] = {}
    trends: dict[str, list[dict[str, str]]] = {'trend': [], 'noise': []}
    for name, shown in trends.items():
        for count, plot in enumerate(_plots(sensors, results, name == 'noise')):
            figure = f'{name}-{count}'
            figures[figure] = _trend_figure(table, plot.result, plot.sensor.number)
            title = f'{plot.sensor.serial}: {plot.result.quantity.label}'
            text = f'{plot.drifts[0].text}.' if plot.drifts else 'No slope is claimed.'
            shown.append({'figure': figure, 'title': title, 'text': text})
    if len(share.columns):
        figures['matrix'] = _matrix_figure(table, share)
    counts = Counter(sensor.state for sensor in sensors)
    years = table.years[np.isfinite(table.years)]
    about = [
        f'{len(table)} recordings',
        f'{len(table.serials)} units',
        *([f'{date_text(years.min())} to {date_text(years.max())}'] if len(years) else []),
    ]
    return html_page.render(
        'adxl_ros.fleet',
        'fleet.html',
        {
            'title': 'Fleet',
            'about': about,
            'badge': _badge(table, sensors, counts),
            'tiles': _tiles(table, counts),
            'shown': _SHOWN,
            'figures': figures,
            'units': sensors,
            'date': date_text,
            'link': partial(_link, folder),
            'without_unit': int((table.sensor < 0).sum()),
            'trends': trends,
            'batches': _batches(results),
            'has_effects': 'matrix' in figures,
            'judged': len(share),
            'outliers': _outlier_rows(table, results),
            'outlier_count': sum(int(result.is_outlier.sum()) for result in results),
            'refusals': _refusal_rows(table),
            'most_rows': _MOST_ROWS,
            'tolerance': number(TOLERANCE_MG),
            'false_discovery': f'{FALSE_DISCOVERY_RATE:.0%}',
            'drifts': sum(int(result.is_claimed.sum()) for result in results),
        },
    )


class _Plot(NamedTuple):
    """A quantity that is plotted of a sensor."""

    sensor: SensorState
    result: QuantityResult
    drifts: Sequence[Drift]  # Its claimed slopes of this kind, the most urgent first


def _plots(
    sensors: Sequence[SensorState], results: Sequence[QuantityResult], is_noise: bool
) -> list[_Plot]:
    """Return the most urgent drift of each sensor, or its first quantity; drifts come first."""
    kind = [result for result in results if result.quantity.is_noise == is_noise]
    plots = []
    for sensor in sensors:
        drifts = [drift for drift in sensor.drifts if drift.result.quantity.is_noise == is_noise]
        measured = [result for result in kind if result.place_of(sensor.number) is not None]
        shown = [drift.result for drift in drifts] or measured
        if shown:
            plots.append(_Plot(sensor, shown[0], drifts))
    return sorted(plots, key=lambda plot: not plot.drifts)[:_SHOWN]


def _badge(
    table: FleetTable, sensors: Sequence[SensorState], counts: Counter[Condition]
) -> dict[str, str]:
    if not sensors:
        return {
            'colour': 'grey',
            'word': 'NO UNITS',
            'sentence': 'No recording states a serial number.',
        }
    worst = sensors[0].state
    if worst is Condition.IN_ORDER and table.frame[[*_MEASURES]].isna().all(axis=None):
        # What was not measured is not within the tolerance.
        return {
            'colour': 'grey',
            'word': 'NOT MEASURED',
            'sentence': 'No gap and no zero-g were measured; they need diagnose and fit.',
        }
    return {
        'colour': worst.colour,
        'word': 'IN ORDER'
        if worst is Condition.IN_ORDER
        else f'{counts[worst]} of {len(sensors)} {worst.words}'.upper(),
        'sentence': _SENTENCES.get(
            worst, 'No unit is out of tolerance. Look at the head of the list.'
        ),
    }


def _tiles(table: FleetTable, counts: Counter[Condition]) -> list[Tile]:
    outcomes = Counter(table['outcome'].tolist())
    return [
        Tile(
            'recordings',
            str(len(table)),
            f'{outcomes["refused"]} refused, {outcomes["crashed"]} crashed',
        ),
        *(Tile(f'units: {state.words}', str(counts[state])) for state in Condition),
    ]


def _link(folder: Path, report: str) -> str:
    """Return the address of a single report: its page where there is one; empty for none."""
    return next(
        (
            name
            for name in (f'{report}/report.html', report)
            if report and (folder / name).exists()
        ),
        '',
    )


def _outlier_rows(table: FleetTable, results: Sequence[QuantityResult]) -> list[dict[str, str]]:
    """Return the recordings that are far from others of their sensor, the farthest first."""
    shown = []
    distances = []
    for result in results:
        quantity = result.quantity
        for i in np.flatnonzero(result.is_outlier):
            row = result.rows[i]
            value = quantity.factor * result.recordings.value[i]
            distances.append(float(result.distance[i]))
            shown.append(
                {
                    'serial': table.serials[table.sensor[row]],
                    'date': date_text(table.years[row]),
                    'quantity': quantity.label,
                    'distance': number(distances[-1]),
                    'value': f'{number(value)} {quantity.shown_unit}',
                    'url': table['url'][row],
                    'report': table['report'][row],
                }
            )
    farthest = np.argsort(-np.array(distances), kind='stable')[:_MOST_ROWS]
    return [shown[i] for i in farthest]


def _refusal_rows(table: FleetTable) -> list[list[str]]:
    """Return the reasons of refusals: how often, in how many sensors, and an example."""
    failed = table.frame.assign(unit=table.sensor)[table['outcome'] != 'done']
    kinds = np.array([reason_kind(row) for row in failed.to_dict('records')], object)
    # A recording without a serial number is of no sensor.
    rows = [
        [
            str(len(group)),
            str(len({*group['unit']} - {-1})),
            kind,
            group['refused_by'].iloc[0] or '-',
            group['url'].iloc[0],
        ]
        for kind, group in failed.groupby(kinds)
    ]
    return sorted(rows, key=lambda row: (-int(row[0]), row[2]))[:_MOST_ROWS]
