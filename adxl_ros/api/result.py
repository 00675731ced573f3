# SPDX-License-Identifier: Apache-2.0

"""What all results share: they print as the screen of their tool, and show in a notebook."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from html import escape
import math
from typing import Any, NamedTuple

from adxl_ros.report.screen import end_lines, Tile
import numpy as np

Progress = Callable[[float, str], None]
"""Called with the share of the work that is done, 0 to 1, and the name of the stage."""

_COLOURS = {'green': '#2a8a43', 'grey': '#7b8794', 'amber': '#d9930d', 'red': '#c0392b'}
"""Colours of the badge, as on the pages."""


def no_progress(done: float, stage: str) -> None:
    """Show nothing."""


class FirstScreen(NamedTuple):
    """The top of a page."""

    colour: str  # green, grey, amber or red
    word: str  # The outcome
    sentence: str  # The outcome with its figures
    tiles: Sequence[Tile] = ()  # Its figures


def as_json(value: Any) -> Any:
    """Return objects of JSON: arrays and tuples as lists, what is not finite as None."""
    if isinstance(value, Mapping):
        return {key: as_json(each) for key, each in value.items()}
    if isinstance(value, np.ndarray):
        plain = value.astype(object)
        plain[~np.isfinite(value)] = None
        return plain.tolist()
    if isinstance(value, (list, tuple)):
        return [as_json(each) for each in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


class Result:
    """A result that prints as its tool does."""

    @property
    def screen(self) -> list[str]:
        """Return the lines of the tool's screen."""
        raise NotImplementedError

    @property
    def first_screen(self) -> FirstScreen:
        """Return the top of the page."""
        raise NotImplementedError

    def __str__(self) -> str:
        return '\n'.join(end_lines(self.screen, []))

    def __repr__(self) -> str:
        return f'<{type(self).__name__}: {self.first_screen.word}>'

    def _repr_html_(self) -> str:
        """Return the top of the page for a notebook."""
        top = self.first_screen
        tiles = ''.join(
            '<td style="text-align:left">' + '<br>'.join(map(escape, filter(None, tile))) + '</td>'
            for tile in top.tiles
        )
        return (
            f'<div style="border-left:7px solid {_COLOURS[top.colour]};padding:.5em .9em">'
            f'<b>{escape(top.word)}</b> {escape(top.sentence)}</div>'
            f'<table><tr>{tiles}</tr></table>'
        )
