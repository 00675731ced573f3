# SPDX-License-Identifier: Apache-2.0
"""
HTML pages of one file that open offline and can be printed, and addresses without secrets.

A page is a jinja2 template that extends `page_templates/base.html`. Its plots are figures of
plotly.js, which the package plotly brings. The page holds plotly.js compressed.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Mapping
from datetime import datetime
import gzip
from pathlib import Path
import re
import shlex
import sys
from typing import Any
from urllib.parse import unquote_plus

from adxl_ros.errors import install_hint, UserError
from adxl_ros.process import command, package_version
from adxl_ros.report import templates
from adxl_ros.report.figures import png
from adxl_ros.wording import names_options

_DPI = 100  # Resolution of pictures, dots per inch (chosen: sharp at the page's width)
_GZIP_LEVEL = 4
"""Level of compression (chosen: level 6 takes twice as long for plotly.js, and saves 4 %)."""
_PASSWORD = re.compile(r'(?<=://)([^/@:\s]*):[^/@\s]*@')  # User and password of an address
_QUERY = re.compile(r'(?<=://)([^\s?#\'"]*)\?([^\s#\'"]*)')  # Place and query of an address
_SECRET = re.compile(
    r'x-(amz|goog)-|token|[-_]key|key-pair|(api|access)key|secret|signature|passw|pwd|credential'
    r'|jwt|auth(?!ors?$)|googleaccessid'
    r'|^(sig|expires|policy|s([evsprt]|pr|rt|ip|k[tesv]|dd|es)|s[ak]oid|suoid|sktid|scid)$',
    re.IGNORECASE,
)
"""Part of a parameter's name that is secret, or belongs to a signature of S3, Google or Azure."""


def check_libraries() -> None:
    """Import what pages need."""
    try:
        import jinja2  # noqa: F401
        from plotly.offline import get_plotlyjs  # noqa: F401
    except ImportError as error:
        raise UserError(f'pages need {error.name}; {install_hint("plotly", "jinja2")}') from None


def render(package: str, template: str, values: Mapping[str, Any]) -> str:
    """Return a whole page."""
    check_libraries()
    from plotly.offline import get_plotlyjs

    layouts = templates.environment('a page', (package, ''), ('adxl_ros.report', 'page_templates'))
    plotly_js = gzip.compress(get_plotlyjs().encode(), _GZIP_LEVEL, mtime=0)
    made = f'made {datetime.now().astimezone():%Y-%m-%d %H:%M} by adxl_ros {package_version()}'
    return layouts.get_template(template).render(
        {
            'made': made,
            'command': command_of_this_process() if names_options() else '',
            'about': [],
            'badge': None,
            'figures': {},
            **values,
        },
        plotly_js=b64encode(plotly_js).decode(),
    )


def command_of_this_process() -> str:
    """Return the command line that started this executable, without the secrets of URLs."""
    words = [without_secrets(as_utf_8(word)) for word in sys.argv[1:]]
    return command(Path(sys.argv[0]).name, shlex.join(words))


def picture_url(figure: Any) -> str:
    """Return a matplotlib figure as the URL of an image that is part of the page."""
    return f'data:image/png;base64,{b64encode(png(figure, _DPI)).decode()}'


def download_url(text: str) -> str:
    """Return a text as the URL of a file that the page offers for download."""
    return f'data:application/yaml;base64,{b64encode(text.encode()).decode()}'


def without_secrets(text: str) -> str:
    """
    Return a text without the passwords, tokens and signatures of its addresses.

    Parameters of a query are left out by their names, as `access_token` and `AWSAccessKeyId`. The
    others tell apart what the address names: so does a plain `key`, which object stores use.
    """
    return _QUERY.sub(_plain_query, _PASSWORD.sub(r'\1@', text))


def as_utf_8(name: str) -> str:
    """Return the name of a file with escapes in place of what is not UTF-8."""
    return name.encode('utf-8', 'backslashreplace').decode('utf-8')


def _plain_query(match: re.Match[str]) -> str:
    """Return the place of an address with the parameters that are not secret."""
    place, query = match.groups()
    kept = '&'.join(
        part
        for part in query.split('&')
        if not _SECRET.search(unquote_plus(part.partition('=')[0]))
    )
    return f'{place}?{kept}' if kept else place
