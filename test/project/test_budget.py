# SPDX-License-Identifier: Apache-2.0

"""
What a reader pays: code lines, files, lines, import depth and methods.

pyproject.toml has the limit of each, above which a change must say what it removes, and the goal.
"""

import ast
from collections import Counter
from functools import cache
import io
from pathlib import Path
import tokenize

import pytest

tomllib = pytest.importorskip('tomllib', reason='Python 3.10 has none')
ROOT = Path(__file__).parents[2]
BUDGET = tomllib.loads((ROOT / 'pyproject.toml').read_text())['tool']['adxl_ros']['budget']
SKIPPED = (tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT,
           tokenize.ENDMARKER)
PACKAGES = ('adxl_ros', 'adxl_ros_validation')


def code_lines(text):
    """Return the number of lines that are no blank, comment or string of their own."""
    lines = {line for token in tokenize.generate_tokens(io.StringIO(text).readline)
             if token.type not in SKIPPED for line in range(token.start[0], token.end[0] + 1)}
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) \
                and isinstance(node.value.value, str):
            lines -= set(range(node.lineno, node.end_lineno + 1))
    return len(lines)


@cache
def modules():
    """Return the text of all modules by name."""
    return {'.'.join(path.relative_to(ROOT).with_suffix('').parts).removesuffix('.__init__'):
            path.read_text() for package in PACKAGES for path in (ROOT / package).rglob('*.py')}


def folder_of(name):
    parts = name.split('.')
    if name.startswith('adxl_ros.model.effects'):
        return 'model/effects'
    if parts[0] != 'adxl_ros':
        return parts[0]
    is_folder = len(parts) > 1 and (ROOT / 'adxl_ros' / parts[1]).is_dir()
    return parts[1] if is_folder else 'top'


def imported(text):
    """Return the names that a module imports when it is loaded."""
    for node in ast.parse(text).body:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                whole = f'{node.module}.{alias.name}'
                yield whole if whole in modules() else node.module


def check(used, budget):
    """Print what is used beside limit and goal; fail above a limit."""
    rows = {name: f'{name:22} {used.get(name, 0):6} of {limit:6}, goal {goal:6}'
            for name, (limit, goal) in budget.items()}
    print('\n'.join(rows.values()))
    assert not [row for name, row in rows.items() if used.get(name, 0) > budget[name][0]]


def test_code_lines_by_folder():
    used = Counter()
    for name, text in modules().items():
        used[folder_of(name)] += code_lines(text)
    assert {*used, 'all'} == set(BUDGET['code_lines'])
    check(used | {'all': sum(used.values())}, BUDGET['code_lines'])


def test_files():
    check(Counter(name.split('.')[0] for name in modules()), BUDGET['files'])


def test_lines():
    check({folder: sum(path.read_text().count('\n') for path in (ROOT / folder).rglob('*.py'))
           for folder in BUDGET['lines']}, BUDGET['lines'])


def test_import_depth():
    """The longest chain of modules that must be opened, one from the other, to follow a name."""
    known = modules()

    @cache
    def chain(name):
        inner = [chain(other) for other in set(imported(known[name])) if other in known
                 and other != name and not name.startswith(other + '.')]
        return (name, *max(inner, key=len, default=()))

    longest = max((chain(name) for name in known), key=len)
    print(' > '.join(longest))
    check({'import_depth': len(longest)}, BUDGET['largest'])


def test_methods():
    methods = {f'{name}.{node.name}': sum(isinstance(m, ast.FunctionDef) for m in node.body)
               for name, text in modules().items() for node in ast.walk(ast.parse(text))
               if isinstance(node, ast.ClassDef)}
    print([name for name, count in methods.items() if count > BUDGET['largest']['methods'][1]])
    check({'methods': max(methods.values())}, BUDGET['largest'])
