# SPDX-License-Identifier: Apache-2.0

"""The documentation as a site: `make site`. Sphinx reads the pages as they are on GitHub."""

from pathlib import Path

from sphinx.application import Sphinx

ROOT = Path(__file__).resolve().parents[1]

project = 'adxl_ros'
author = 'the adxl_ros authors'
extensions = ['myst_parser']
html_theme = 'furo'
html_title = 'adxl_ros'
html_show_copyright = False
root_doc = 'docs/index'
include_patterns = [
    'README.md',
    'CONTRIBUTING.md',
    'QUALITY_DECLARATION.md',
    'firmware/README.md',
    'docs/*.md',
    'docs/**/*.md',
]
source_suffix = {'.md': 'markdown'}
myst_heading_anchors = 4
highlight_language = 'text'
suppress_warnings = ['myst.header']  # a log begins its tables one level too deep

FIRST = {
    'docs/index': [
        'README',
        'start/tilt',
        'start/compare',
        'start/stage',
        'howto/index',
        'explain/index',
        'reference/index',
        'maintain/index',
        'measurements/index',
        'CONTRIBUTING',
        'QUALITY_DECLARATION',
        'firmware/README',
    ]
}
"""Pages in the order of the side bar; other index pages list those of their folder."""


def add_contents(app: Sphinx, name: str, source: list[str]) -> None:
    """Give the index pages a table of contents, which GitHub would show as code."""
    if not name.endswith('/index'):
        return
    folder = ROOT / Path(name).parent
    pages = FIRST.get(name) or sorted(
        page.stem for page in folder.glob('*.md') if page.stem != 'index'
    )
    entries = [f'/{page}' if (ROOT / f'{page}.md').exists() else page for page in pages]
    source[0] += '\n'.join(['', '```{toctree}', ':hidden:', '', *entries, '```', ''])


def setup(app: Sphinx) -> None:
    """Connect the hook."""
    app.connect('source-read', add_contents)
