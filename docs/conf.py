# SPDX-License-Identifier: Apache-2.0

"""The documentation as a site: `make site`. Sphinx reads the pages as they are on GitHub."""

from pathlib import Path

from sphinx.application import Sphinx

ROOT = Path(__file__).resolve().parents[1]

project = 'adxl_ros'
author = 'the adxl_ros authors'
extensions = ['myst_nb']  # with the parser of Markdown
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
    'docs/examples/*.py',
]
# The examples are programs and notebooks at once; each site shows what they print today.
nb_custom_formats = {'.py': ['jupytext.reads', {'fmt': 'py:percent'}]}
nb_execution_mode = 'force'
nb_execution_excludepatterns = ['mujoco_arm.py', 'swing.py']  # They write files that are named.
nb_execution_timeout = 300
nb_execution_raise_on_error = True
nb_execution_in_temp = True
source_suffix = {'.md': 'myst-nb', '.py': 'myst-nb'}
myst_heading_anchors = 4
highlight_language = 'text'
suppress_warnings = [
    'myst.header',  # a log begins its tables one level too deep
    'myst-nb.lexer',  # of a program that is not run
]

FIRST = {
    'docs/index': [
        'README',
        'start/tilt',
        'start/compare',
        'start/stage',
        'examples/index',
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
    folder = Path(name).parent
    pages = FIRST.get(name) or sorted(
        Path(found).name
        for found in app.env.found_docs
        if Path(found).parent == folder and found != name
    )
    entries = [f'/{page}' if (ROOT / f'{page}.md').exists() else page for page in pages]
    source[0] += '\n'.join(['', '```{toctree}', ':hidden:', '', *entries, '```', ''])


def setup(app: Sphinx) -> None:
    """Connect the hook."""
    app.connect('source-read', add_contents)
