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

"""HTML pages of one file that open offline and can be printed."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Sequence
from html import escape
from io import BytesIO
import json
from typing import Any

_STYLE = """
body{font:15px/1.45 system-ui,sans-serif;max-width:1000px;margin:2em auto;padding:0 1em;color:#222;
background:#fff}h1{font-size:1.4em}h2{font-size:1.1em;margin-top:2em;border-bottom:1px solid #ccc}
table{border-collapse:collapse;width:100%;font-size:13px}td,th{padding:.25em .6em;
border-bottom:1px solid #ddd;text-align:left;vertical-align:top}img{max-width:100%}
.summary{background:#eef4fb;border-left:5px solid #36c;padding:.8em 1em}
.good{background:#eef8ee;border-color:#393}.bad{background:#fbeeee;border-color:#c33}.open{background:#fdf6e3;border-color:#b80}
pre{background:#f6f6f6;padding:.8em 1em;font-size:12px;white-space:pre-wrap}
figure{margin:1em 0}figcaption{font-size:13px;color:#555}canvas{max-width:100%}
@page{margin:12mm}@media print{body{margin:0;max-width:none;font-size:12px}
table,pre{font-size:9px}td,th{padding:.15em .4em}
h2{break-after:avoid}tr,figure,img,.summary{break-inside:avoid}
*{-webkit-print-color-adjust:exact;print-color-adjust:exact}.screen{display:none}}
"""
"""Style sheet of all pages, on screen and on paper."""

_DPI = 100
"""Resolution of plots, dots per inch (chosen: sharp at the page's width)."""


def document(title: str, parts: Sequence[str]) -> str:
    """
    Return a whole page.

    Parameters
    ----------
    title
        Plain text.
    parts
        HTML of the body, in order.

    Returns
    -------
    str
        HTML.

    """
    return ('<!doctype html><html lang="en"><head><meta charset="utf-8"><meta name="viewport" '
            f'content="width=device-width, initial-scale=1"><title>{escape(title)}</title>'
            f'<style>{_STYLE}</style></head><body>\n{"".join(parts)}\n</body></html>\n')


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """
    Return a table.

    Parameters
    ----------
    head
        Plain text of the header's cells, (columns,).
    rows
        Plain text of the other cells, (rows, columns).

    Returns
    -------
    str
        HTML.

    """
    top = ''.join(f'<th>{escape(cell)}</th>' for cell in head)
    body = ''.join('<tr>' + ''.join(f'<td>{escape(cell)}</td>' for cell in row) + '</tr>\n'
                   for row in rows)
    return f'<table><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table>'


def picture(figure: Any, about: str) -> str:
    """
    Return a plot that is part of the page.

    Parameters
    ----------
    figure
        A matplotlib figure.
    about
        What the plot shows, for readers who cannot see it.

    Returns
    -------
    str
        HTML.

    """
    out = BytesIO()
    figure.savefig(out, dpi=_DPI, format='png', metadata={'Software': None})
    return (f'<figure><img alt="{escape(about)}" '
            f'src="data:image/png;base64,{b64encode(out.getvalue()).decode()}"></figure>')


def data(name: str, values: Any) -> str:
    """
    Return an element with data for a script of the page.

    Parameters
    ----------
    name
        The element's id, by which the script finds it.
    values
        The data, anything that JSON can hold. No text in it can end the element.

    Returns
    -------
    str
        HTML.

    """
    text = json.dumps(values, allow_nan=False).replace('<', '\\u003c')
    return f'<script type="application/json" id="{name}">{text}</script>'


def script(text: str) -> str:
    """Return an element with a script, JavaScript."""
    return f'<script>\n{text}</script>'
