# SPDX-License-Identifier: Apache-2.0

"""
What a reader takes in: content, large functions and import depth.

Content is counted in nodes of the syntax tree without docstrings, so that blank lines, names,
types and comments cost nothing. pyproject.toml has the limits.
"""

import ast
from functools import cache
from pathlib import Path

from needs import lack
import pytest

tomllib = pytest.importorskip('tomllib', reason=lack('Python 3.11'))
# The modules are read once.
pytestmark = pytest.mark.xdist_group('budget')
ROOT = Path(__file__).parents[2]
BUDGET = tomllib.loads((ROOT / 'pyproject.toml').read_text())['tool']['adxl_ros']['budget']
BRANCHES = (
    ast.If,
    ast.For,
    ast.While,
    ast.ExceptHandler,
    ast.IfExp,
    ast.comprehension,
    ast.Assert,
    ast.match_case,
)


def parse_without_docstrings(text):
    tree = ast.parse(text)
    for node in ast.walk(tree):
        body = getattr(node, 'body', None)
        if isinstance(body, list):
            node.body = [s for s in body if not is_docstring(s)] or [ast.Pass()]
    return tree


def is_docstring(statement):
    return (
        isinstance(statement, ast.Expr)
        and isinstance(statement.value, ast.Constant)
        and isinstance(statement.value.value, str)
    )


@cache
def modules():
    """Return the syntax trees of all modules by name."""
    return {
        '.'.join(path.relative_to(ROOT).with_suffix('').parts).removesuffix(
            '.__init__'
        ): parse_without_docstrings(path.read_text())
        for package in BUDGET['content']
        for path in (ROOT / package).rglob('*.py')
    }


def content(tree):
    return sum(1 for _ in ast.walk(tree))


def branches(tree):
    """Count the branches of a function, with comprehensions and conditional expressions."""
    operators = sum(
        len(node.values) - 1 for node in ast.walk(tree) if isinstance(node, ast.BoolOp)
    )
    return 1 + operators + sum(isinstance(node, BRANCHES) for node in ast.walk(tree))


def imported(tree):
    """Return the names that a module imports when it is loaded."""
    for node in tree.body:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                whole = f'{node.module}.{alias.name}'
                yield whole if whole in modules() else node.module


@pytest.mark.parametrize('package', BUDGET['content'])
def test_content(package):
    used = sum(content(tree) for name, tree in modules().items() if name.split('.')[0] == package)
    print(f'{package}: {used} of {BUDGET["content"][package]} nodes')
    assert used <= BUDGET['content'][package], 'a change must say what it removes'


def test_large_functions():
    """A function has a size that one reading takes in; those that do not yet are counted."""
    large = [
        f'{name}.{node.name}: {content(node)} nodes, {branches(node)} branches'
        for name, tree in modules().items()
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef)
        and (
            content(node) > BUDGET['function']['nodes']
            or branches(node) > BUDGET['function']['branches']
        )
    ]
    print('\n'.join(large))
    assert len(large) <= BUDGET['function']['above'], large


def test_import_depth():
    """The longest chain of modules that must be opened, one from the other, to follow a name."""
    known = modules()

    @cache
    def chain(name):
        inner = [
            chain(other)
            for other in set(imported(known[name]))
            if other in known and other != name and not name.startswith(other + '.')
        ]
        return (name, *max(inner, key=len, default=()))

    longest = max((chain(name) for name in known), key=len)
    print(' > '.join(longest))
    assert len(longest) <= BUDGET['import_depth']
