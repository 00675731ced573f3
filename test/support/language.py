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

"""
Rules of language that a program can check: docstrings, names of values, sentences in docs.

Each function returns the violations of a rule, as lines `file:line: violation`.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path
import re
import sys
import warnings

from markdown_it import MarkdownIt
from markdown_it.token import Token
from numpydoc.docscrape import NumpyDocString

BANNED_NAMES = frozenset((
    'found', 'one', 'of', 'at', 'here', 'own', 'known', 'told', 'asked', 'said', 'left', 'most',
    'less', 'beside', 'off', 'fewer', 'least', 'taken', 'whole', 'thin', 'good', 'loud', 'alone',
    'far', 'ends', 'came', 'gone', 'mine', 'theirs', 'this', 'that', 'what', 'who', 'shown',
    'alike', 'so', 'much', 'more'))
"""Words that do not describe a quantity."""

SENTENCE_WORDS = 25
"""Largest number of words of a sentence in the documentation."""

LINE_COLUMNS = 120
"""Largest number of columns of a line of prose; tables and code may be wider."""

Function = ast.FunctionDef | ast.AsyncFunctionDef


def undocumented(path: Path) -> list[str]:
    """
    Find public functions of two or more arguments whose docstring does not describe them.

    A docstring in the numpydoc format describes every parameter and the returned or yielded
    value. `model.effects.base.Apply` describes the function `apply` of all effects.
    """
    return [f'{path}:{function.lineno}: {function.name}: {fault}'
            for function, in_class in _public_functions(ast.parse(path.read_text('utf-8')))
            if not (function.name == 'apply' and path.parent.name == 'effects')
            for fault in _docstring_faults(function, in_class)]


def _public_functions(tree: ast.Module | ast.ClassDef) -> Iterator[tuple[Function, bool]]:
    for node in tree.body:
        if isinstance(node, ast.ClassDef) and not node.name.startswith('_'):
            yield from _public_functions(node)
        elif isinstance(node, Function) and not node.name.startswith('_'):
            yield node, isinstance(tree, ast.ClassDef)


def _docstring_faults(function: Function, in_class: bool) -> Iterator[str]:
    decorators = {ast.unparse(decorator) for decorator in function.decorator_list}
    arguments = function.args
    names = [argument.arg for argument in (
        *arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs)]
    if in_class and 'staticmethod' not in decorators:
        names = names[1:]
    if len(names) < 2 or decorators & {'override', 'overload'}:
        return
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter('always')
        docstring = NumpyDocString(ast.get_docstring(function) or '')
    yield from (str(warning.message).split(' in ')[0] for warning in caught)
    described = {name.strip(' *') for entry in docstring['Parameters']
                 for name in entry.name.split(',')}
    if missing := [name for name in names if name not in described]:
        yield f'no description of {", ".join(missing)}'
    if wrong := sorted(described - set(names) - _star_names(arguments)):
        yield f'describes {", ".join(wrong)}, which it does not take'
    if _returns(function) and not docstring['Returns'] and not docstring['Yields']:
        yield 'no section Returns'


def _star_names(arguments: ast.arguments) -> set[str]:
    return {star.arg for star in (arguments.vararg, arguments.kwarg) if star is not None}


def _returns(function: Function) -> bool:
    """Return whether the annotation of a function states a returned value."""
    return function.returns is not None and ast.unparse(function.returns) not in (
        'None', "'None'", 'NoReturn')


def banned_names(path: Path) -> list[str]:
    """Find variables, parameters and attributes that have a banned name."""
    return [f'{path}:{line}: {name}: a banned name'
            for name, line in _named(ast.parse(path.read_text('utf-8')))
            if name.strip('_') in BANNED_NAMES]


def _named(tree: ast.AST) -> Iterator[tuple[str, int]]:
    for node in ast.walk(tree):
        if isinstance(node, ast.arg):
            yield node.arg, node.lineno
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id, node.lineno
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.attr, node.lineno


def long_sentences(path: Path) -> list[str]:
    """Find sentences of a Markdown page that have too many words."""
    return [f'{path}:{line}: {len(words)} words: {sentence[:60]} ...'
            for line, text in _prose(MarkdownIt().enable('table').parse(path.read_text('utf-8')))
            for sentence in re.split(r'(?<=[.!?])\s+(?=[^a-z\s])|:\s*$', text)
            if len(words := re.findall(r'\w[\w\'’.,-]*', sentence)) > SENTENCE_WORDS]


def _prose(tokens: list[Token]) -> Iterator[tuple[int, str]]:
    """Yield the text of paragraphs and list items with their lines, without tables and code."""
    in_table = False
    for token in tokens:
        in_table = (in_table or token.type == 'table_open') and token.type != 'table_close'
        if token.type == 'inline' and not in_table and token.map and token.children:
            yield token.map[0] + 1, ''.join(
                'Code' if part.type == 'code_inline' else ' ' if part.type == 'softbreak'
                else part.content for part in token.children)


def long_lines(path: Path) -> list[str]:
    """Find lines of prose in a Markdown page that have too many columns."""
    lines = path.read_text('utf-8').splitlines()
    prose = [token.map for token in MarkdownIt().enable('table').parse('\n'.join(lines))
             if token.map and token.type in ('paragraph_open', 'heading_open')]
    return [f'{path}:{number + 1}: {len(lines[number])} columns'
            for first, stop in prose for number in range(first, stop)
            if len(lines[number]) > LINE_COLUMNS and ' ' in lines[number].strip()
            and not re.search(r'\]\(\S{60,}', lines[number])]


if __name__ == '__main__':
    for given in map(Path, sys.argv[1:]):
        for file in sorted(given.rglob('*.py')) if given.is_dir() else [given]:
            for rule in ((long_sentences, long_lines) if file.suffix == '.md'
                         else (undocumented, banned_names)):
                for line in rule(file):
                    print(line)
