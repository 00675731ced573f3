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

"""The rules of language: docstrings, names of values, and the documentation."""

from collections.abc import Callable
from pathlib import Path
import re

import language
from processes import REPO
import pytest

MODULES = sorted((REPO / 'adxl_ros').rglob('*.py'))
TESTS = sorted((REPO / 'test').rglob('*.py'))
PAGES = [REPO / 'README.md', *sorted((REPO / 'docs').glob('*.md'))]


@pytest.mark.parametrize(('rule', 'paths'), [
    (language.undocumented, MODULES),
    (language.banned_names, [*MODULES, *TESTS]),
    (language.long_sentences, PAGES),
    (language.long_lines, PAGES),
])
def test_rule(rule: Callable[[Path], list[str]], paths: list[Path]) -> None:
    broken = [line for path in paths for line in rule(path)]
    assert not broken, '\n'.join(broken)


@pytest.mark.parametrize(('rule', 'name', 'text', 'fault'), [
    (language.undocumented, 'a.py', 'def f(a, b):\n    """Add."""\n', 'no description of a, b'),
    (language.undocumented, 'a.py', 'class A:\n    def f(self, a, b) -> int:\n        """Add.\n\n'
     '        Parameters\n        ----------\n        a, b\n            Numbers.\n\n        """\n',
     'no section Returns'),
    (language.banned_names, 'a.py', 'for one in range(3):\n    pass\n', 'one: a banned name'),
    (language.long_sentences, 'a.md', 'word ' * 26 + '.\n', '26 words'),
    (language.long_lines, 'a.md', 'word ' * 30 + '\n', '150 columns'),
])
def test_rules_find_what_breaks_them(rule, name, text, fault, tmp_path) -> None:
    (tmp_path / name).write_text(text)
    assert fault in rule(tmp_path / name)[0]


@pytest.mark.parametrize('page', PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    """Links to files and to headings of pages."""
    for target, anchor in re.findall(r'\]\((?!https?:)([^)#\s]*)(#[^)\s]*)?\)',
                                     page.read_text('utf-8')):
        linked = page.parent / target if target else page
        assert linked.exists(), f'{page.name} links to {target}'
        if anchor and linked.suffix == '.md':
            headings = re.findall(r'^#+ (.*)$', linked.read_text('utf-8'), re.MULTILINE)
            assert anchor in {'#' + re.sub(r'[^\w\- ]', '', heading).lower().replace(' ', '-')
                              for heading in headings}, f'{page.name} links to {target}{anchor}'
