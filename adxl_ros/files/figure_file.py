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

"""Figures as PNG files, drawn without a display."""

from __future__ import annotations

import os
from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.files.atomic_write import atomic_path


def pyplot() -> Any:
    """Return matplotlib's drawing functions, without a display."""
    try:
        import matplotlib
    except ImportError:
        raise UserError('plots need matplotlib; pip install matplotlib') from None
    matplotlib.use('Agg')
    import matplotlib.pyplot
    return matplotlib.pyplot


def write(figure: Any, path: str | os.PathLike) -> None:
    """Write a figure as PNG, whole or not at all."""
    with atomic_path(path) as fresh:
        figure.savefig(fresh, dpi=80, format='png')
    pyplot().close(figure)
