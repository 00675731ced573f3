# SPDX-License-Identifier: Apache-2.0
"""
Figures of plotly.js as plain objects, which `page` puts into pages, and plots of matplotlib.

Plain objects serve every version of plotly. Its Python classes would cost a second at start-up.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from io import BytesIO
from math import ceil
from typing import Any, NamedTuple

from adxl_ros.errors import install_hint, UserError
import numpy as np

Figure = dict[str, Any]
"""A figure of plotly.js: `data` is the list of its traces, `layout` its layout."""
AXIS_COLOURS = {'x': '#1f5fbf', 'y': '#c8641b', 'z': '#2a8a43'}
"""Colours of the axes of the sensor (chosen: colour-blind people can distinguish them)."""
BEFORE_COLOUR = '#c0392b'  # Colour of what the simulator lacks at first
AFTER_COLOUR = '#2a8a43'  # Colour of the state after a correction
QUIET_COLOUR = '#7b8794'  # Colour of what is only there for comparison
_DIGITS = 5  # Significant digits of plotted values (chosen: below a pixel of a zoomed plot)
_FONT = {'family': 'system-ui, "DejaVu Sans", sans-serif', 'size': 12, 'color': '#1f2933'}
_GRID = {
    'gridcolor': '#e4e7eb',
    'zerolinecolor': '#9aa5b1',
    'linecolor': '#9aa5b1',
    'automargin': True,
    'exponentformat': 'none',
    'hoverformat': '.4~g',
}
"""Properties of all axes of a plot."""
_FILE_DPI = 80
"""Resolution of PNG files, dots per inch (chosen: a plot of 12 inches fits a screen)."""


def figure(traces: Iterable[Figure], height: int, **layout: Any) -> Figure:
    """Make a figure."""
    axes = {
        name: _GRID | value
        for name, value in layout.items()
        if name.startswith(('xaxis', 'yaxis'))
    }
    return {
        'data': list(traces),
        'layout': {
            'height': height,
            'autosize': True,
            'font': _FONT,
            'paper_bgcolor': '#fff',
            'plot_bgcolor': '#fff',
            'margin': {'l': 8, 'r': 12, 't': 10, 'b': 8},
            'bargap': 0.3,
            'legend': {'orientation': 'h', 'x': 0, 'y': 1, 'yanchor': 'bottom'},
            'hovermode': 'closest',
            'dragmode': 'zoom',
            **layout,
            **axes,
        },
    }


def line(
    x: Iterable[float], y: Iterable[float], name: str, colour: str, **properties: Any
) -> Figure:
    """Make a line."""
    return {
        'type': 'scatter',
        'mode': 'lines',
        'x': rounded(x),
        'y': rounded(y),
        'name': name,
        'line': {'color': colour, 'width': 1.2},
    } | properties


def points(
    x: Iterable[float], y: Iterable[float], half_width: Iterable[float], name: str, colour: str
) -> Figure:
    """Make points with error bars."""
    return {
        'type': 'scatter',
        'mode': 'markers',
        'x': rounded(x),
        'y': rounded(y),
        'name': name,
        'error_y': {'type': 'data', 'array': rounded(half_width), 'thickness': 1.2, 'width': 3},
        'marker': {'color': colour, 'size': 6},
    }


def axis_number(name: str, number: int) -> str:
    """Return plotly's name of the i-th axis of a figure."""
    return name if number == 1 else f'{name}{number}'


def rounded(values: Iterable[float]) -> list[float | None]:
    """Return values with the digits of a plot; None where they are not finite."""
    numbers = np.asarray(values, float)
    return [
        float(f'{v:.{_DIGITS}g}') if is_finite else None
        for v, is_finite in zip(numbers.tolist(), np.isfinite(numbers).tolist())
    ]


def extremes(values: np.ndarray, count: int) -> np.ndarray:
    """
    Choose samples of a signal so that its plot looks as that of all samples.

    values: the signal, (n,).
    """
    if len(values) <= count:
        return np.arange(len(values))
    size = ceil(len(values) / (count // 2))
    number = ceil(len(values) / size)
    padded = np.pad(np.nan_to_num(values), (0, number * size - len(values)), 'edge')
    blocks = padded.reshape(number, size)
    begins = np.arange(0, len(values), size)
    return np.unique([begins + blocks.argmin(axis=1), begins + blocks.argmax(axis=1)])


class Span(NamedTuple):
    """A part of a line, in percent of its length."""

    begin: float
    width: float


class Whisker(NamedTuple):
    """A value with its interval on a line, in percent of its length."""

    text: str
    zero: float  # Place of 0
    dot: float  # Place of the value
    typical: Span | None  # Typical values; None where none are stated
    line: Span  # The interval
    beyond: bool  # Whether the value is beyond its limit


def whisker(
    value: float,
    low: float,
    high: float,
    bounds: tuple[float, float],
    text: str,
    typical: float = 0.0,
    beyond: bool = False,
) -> Whisker:
    """Place a value with its interval between bounds, in percent of their distance."""
    begin, end = bounds

    def place(position: float) -> float:
        share = (position - begin) / (end - begin) if end > begin else 0.5
        return round(100 * float(np.clip(share, 0.0, 1.0)), 2)

    def span(first: float, last: float) -> Span:
        return Span(place(first), place(last) - place(first))

    return Whisker(
        text=text,
        zero=place(0.0),
        dot=place(value),
        typical=span(-typical, typical) if typical else None,
        line=span(low, high),
        beyond=beyond,
    )


def new_figure(**options: Any) -> Any:
    """Return a figure of matplotlib for a file; no display shows it."""
    with _matplotlib():
        from matplotlib.figure import Figure
    return Figure(layout='constrained', **options)


def axes_for(ax: Any) -> Any:
    """Return axes of matplotlib to draw into: those given, or new ones that a display shows."""
    if ax is not None:
        return ax
    with _matplotlib():
        from matplotlib import pyplot
    return pyplot.subplots(layout='constrained')[1]


@contextmanager
def _matplotlib() -> Iterator[None]:
    """Name the package that is missing."""
    try:
        yield
    except ImportError:
        raise UserError(f'plots need matplotlib; {install_hint("matplotlib")}') from None


def png(figure: Any, dpi: int = _FILE_DPI) -> bytes:
    """Return a matplotlib figure as a PNG picture."""
    out = BytesIO()
    figure.savefig(out, dpi=dpi, format='png', metadata={'Software': None})
    return out.getvalue()
