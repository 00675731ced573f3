# SPDX-License-Identifier: Apache-2.0

"""Plots as PNG files, drawn without a display."""

from __future__ import annotations

import os
from typing import Any

from adxl_ros.errors import install_hint, UserError
from adxl_ros.files.atomic_write import atomic_path

_DPI = 80
"""Resolution of the PNG files, dots per inch (chosen: a plot of 12 inches fits a screen)."""


def pyplot() -> Any:
    """Return matplotlib's drawing functions, without a display."""
    try:
        import matplotlib
    except ImportError:
        raise UserError(f'plots need matplotlib; {install_hint("matplotlib")}') from None
    matplotlib.use('Agg')
    import matplotlib.pyplot
    return matplotlib.pyplot


def write_plot(figure: Any, path: str | os.PathLike) -> None:
    """Write a matplotlib figure as a PNG file, whole or not at all, and close it."""
    with atomic_path(path) as fresh:
        figure.savefig(fresh, dpi=_DPI, format='png')
    pyplot().close(figure)
