# Copyright 2026 the adxl_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Plots as PNG files, drawn without a display."""

from __future__ import annotations

import os
from typing import Any

from adxl_ros.errors import install_hint, UserError
from adxl_ros.files.atomic_write import atomic_path

_DPI = 80
"""Resolution of the PNG files, dots per inch (chosen: a plot of 12 inches fits a screen)."""


def pyplot() -> Any:
    """
    Return matplotlib's drawing functions, without a display.

    Raises
    ------
    UserError
        Matplotlib is not installed.

    """
    try:
        import matplotlib
    except ImportError:
        raise UserError(f'plots need matplotlib; {install_hint("matplotlib")}') from None
    matplotlib.use('Agg')
    import matplotlib.pyplot
    return matplotlib.pyplot


def write_plot(figure: Any, path: str | os.PathLike) -> None:
    """
    Write a matplotlib figure as a PNG file, whole or not at all, and close it.

    Parameters
    ----------
    figure
        The figure.
    path
        The file, replaced if it exists.

    Raises
    ------
    UserError
        The file cannot be written.

    """
    with atomic_path(path) as fresh:
        figure.savefig(fresh, dpi=_DPI, format='png')
    pyplot().close(figure)
