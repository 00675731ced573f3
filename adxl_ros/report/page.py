# SPDX-License-Identifier: Apache-2.0
"""
HTML pages of one file that open offline and can be printed.

A page is a jinja2 template that extends `page_templates/base.html`. Its plots are figures of
plotly.js, which the package plotly brings. The page holds plotly.js compressed.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Mapping
from datetime import datetime
import gzip
from pathlib import Path
import shlex
import sys
from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.process import package_version
from adxl_ros.report.addresses import as_utf_8, without_secrets
from adxl_ros.report.figures import png

_DPI = 100
"""Resolution of pictures, dots per inch (chosen: sharp at the page's width)."""
_GZIP_LEVEL = 6
"""Level of compression (chosen: 0.3 s for plotly.js; level 9 takes three times as long)."""


def check_libraries() -> None:
    """Import what pages need."""
    try:
        import jinja2  # noqa: F401
        from plotly.offline import get_plotlyjs  # noqa: F401
    except ImportError as error:
        raise UserError(f'pages need {error.name}; apt install python3-plotly python3-jinja2'
                        ) from None


def render(package: str, template: str, values: Mapping[str, Any]) -> str:
    """Return a whole page."""
    check_libraries()
    from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined
    from plotly.offline import get_plotlyjs
    loader = ChoiceLoader([PackageLoader(package, ''),
                           PackageLoader('adxl_ros.report', 'page_templates')])
    environment = Environment(loader=loader, autoescape=True, undefined=StrictUndefined,
                              trim_blocks=True, lstrip_blocks=True)
    plotly_js = gzip.compress(get_plotlyjs().encode(), _GZIP_LEVEL, mtime=0)
    made = f'made {datetime.now().astimezone():%Y-%m-%d %H:%M} by adxl_ros {package_version()}'
    return environment.get_template(template).render(
        {'made': made, 'command': command_of_this_process(), **values},
        plotly_js=b64encode(plotly_js).decode())


def command_of_this_process() -> str:
    """Return the command line that started this executable, without the secrets of URLs."""
    words = [without_secrets(as_utf_8(word)) for word in sys.argv[1:]]
    return shlex.join(['ros2', 'run', 'adxl_ros', Path(sys.argv[0]).name, *words])


def picture_url(figure: Any) -> str:
    """Close a matplotlib figure and return it as the URL of an image that is part of the page."""
    return f'data:image/png;base64,{b64encode(png(figure, _DPI)).decode()}'


def download_url(text: str) -> str:
    """Return a text as the URL of a file that the page offers for download."""
    return f'data:application/yaml;base64,{b64encode(text.encode()).decode()}'
