# SPDX-License-Identifier: Apache-2.0
"""The page of a benchmark: tables, a picture of where each method fails, the card of the data."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import date
from itertools import pairwise
import math
from typing import Any

from adxl_ros.process import code_version, package_version
from adxl_ros.report.figures import new_figure
from adxl_ros_validation.benchmark.defects import GROUPS
from adxl_ros_validation.benchmark.manifest import Loaded
from adxl_ros_validation.benchmark.results import (
    Drawn,
    exact_share,
    limit_of,
    median_closed,
    Physical,
    Row,
)
from adxl_ros_validation.blind.report import Report, Table, terminal_table
from adxl_ros_validation.blind.scores import in_words, share
import numpy as np

_STRENGTHS = (0.0, 3.0, 8.0, math.inf)
"""Edges of the bins of strength, in the noise of one sample; those of the blind check."""


@dataclass(frozen=True)
class Made:
    """A whole benchmark."""

    seed: int
    trials: int
    sealed: str  # SHA-256 of salt and labels
    loaded: Sequence[Loaded]
    left_out: Sequence[str]
    facts: Sequence[Drawn]
    rows: Sequence[Row]
    physical: Sequence[Physical]

    @property
    def methods(self) -> list[str]:
        """Return the methods in their order."""
        names = [row.method for row in self.rows] + [row.method for row in self.physical]
        return list(dict.fromkeys(names))

    @property
    def graded(self) -> list[str]:
        """Return the methods that answered some of level A."""
        return [method for method in self.methods if self.of(method)]

    def of(self, method: str) -> list[Row]:
        """Return the answers of a method to level A."""
        return [row for row in self.rows if row.method == method]


def report(made: Made) -> Report:
    """Return the benchmark in words and tables."""
    names = ', '.join(sorted({fact.recording for fact in made.facts})) or 'none'
    return Report(
        'Benchmark on recordings of real sensors',
        [
            f'{date.today()}, adxl_ros {package_version()}, code {code_version()[:16]}, seed '
            f'{made.seed}. Level A: {made.trials} trials on {names}; SHA-256 of salt and labels '
            f'{made.sealed or "none"}. Intervals hold 90 %.',
            'Level A puts one defect, two or none, of 1 to 20 times the noise of one sample, '
            'into the later part of a recording. An answer is right if it names what was put in; '
            'what a method names of the untouched part, too, is no error, but the same answer '
            'with a defect as without it is wrong.',
            'The ideal observer knows the forms of all defects, and what the untouched part '
            'leaves; its two figures are bounds of what is possible.',
        ],
        {
            'Level A: exactly right': _naming(made),
            'Level A: what else counts': _further(made),
            'Level A: one defect, by its strength': _single(made, _strength),
            'Level A: one defect, by recording': _single(made, lambda row: row.fact.recording),
            'Level B: a documented defect': _physical(
                made, 'B', lambda row: f'{row.right}: {_said(row)}'
            ),
            'Level C: share of the squared gap that is closed on a later part': _physical(
                made, 'C', lambda row: in_words(row.closed)
            ),
            'Level C: what is named': _physical(made, 'C', _said),
            'Answers without a verdict': _failed(made),
            'Recordings': _card(made),
            'Left out': (['what, and why'], [[text] for text in made.left_out]),
        },
    )


def screen(made: Made) -> list[str]:
    """Return the first table as lines of a terminal: right answers of all, without intervals."""
    groups = {row.group for row in made.rows}
    shown = {group: words for group, words in GROUPS.items() if group in groups}
    rows = []
    for method in made.graded:
        scores = [exact_share(made.of(method), group) for group in shown]
        cells = [f'{s["value"]:.2f} of {s["count"]}' if s['count'] else '-' for s in scores]
        rows.append([method, *cells])
    first = ['Level A, exactly right:', '']
    return [*first, *terminal_table(['method', *shown.values()], rows)] if made.rows else []


def _naming(made: Made) -> Table:
    """Return how often each method is exactly right."""
    rows = []
    for method in made.graded:
        own = made.of(method)
        rows.append([method, *(in_words(exact_share(own, group)) for group in GROUPS)])
    bounds = ['ideal observer', '-']
    for group in list(GROUPS)[1:]:
        limit = limit_of(made.facts, group)
        bounds.append(f'{100 * limit.low:.0f} to {100 * limit.high:.0f} %' if limit else '-')
    return ['method', *GROUPS.values()], [*rows, bounds] if made.rows else []


def _further(made: Made) -> Table:
    """Return what a user of the answers gains and loses."""
    rows = []
    for method in made.graded:
        own = made.of(method)
        defect = [row for row in own if row.group != 'none']
        rows.append(
            [
                method,
                in_words(share([row.in_set for row in defect])),
                in_words(median_closed(own)),
                in_words(share([row.harm for row in own])),
                f'{np.mean([row.by_chance for row in own]):.2f}',
                f'{np.median([row.answered.cpu_s for row in own]):.1f}',
            ]
        )
    head = [
        'method',
        'defects in the named set',
        'closed on the later part, median',
        'later part made worse',
        'right by labels of other trials',
        'processor time, s',
    ]
    return head, rows if made.rows else []


def _single(made: Made, name_of: Callable[[Row], str]) -> Table:
    """Return how often one defect is named, by what a name of each trial says."""
    single = [row for row in made.rows if row.group == 'single']
    names = sorted({name_of(row) for row in single})
    rows = []
    for method in made.graded:
        own = [(name_of(row), row.exact) for row in single if row.method == method]
        rows.append(
            [method, *(in_words(share([hit for part, hit in own if part == n])) for n in names)]
        )
    return ['method', *names], rows if single else []


def _strength(row: Row) -> str:
    """Return the strength of a defect in words."""
    low, high = next(edges for edges in pairwise(_STRENGTHS) if row.fact.noises < edges[1])
    if math.isinf(high):
        return f'above {low:g} times the noise'
    return f'{low:g} to {high:g} times the noise'


def _physical(made: Made, level: str, cell_of: Callable[[Physical], str]) -> Table:
    """Return a cell of each answer to a level, by recording and method."""
    chosen = [row for row in made.physical if level in row.source.levels]
    cells = {(row.source.name, row.method): cell_of(row) for row in chosen}
    expected = {row.source.name: row.source.expected for row in chosen}
    rows = []
    for name, sets in expected.items():
        documented = ' or '.join(' and '.join(each) for each in sets) if level == 'B' else ''
        about = f'{name}: {documented}' if documented else name
        rows.append([about, *(cells.get((name, method), '-') for method in made.methods)])
    return ['recording', *made.methods], rows


def _said(row: Physical) -> str:
    """Return what an answer names."""
    groups = [f'({" or ".join(sorted(group))})' for group in row.answered.one_of]
    return ', '.join([*sorted(row.answered.causes), *groups]) or row.answered.status


def _failed(made: Made) -> Table:
    """Return the answers that are no verdict."""
    cases = [(row.method, row.fact.label.name, row.answered.error) for row in made.rows]
    cases += [(row.method, row.source.name, row.answered.error) for row in made.physical]
    rows = [list(case) for case in cases if case[-1]]
    return ['method', 'case', 'why'], rows


def _card(made: Made) -> Table:
    """Return the card of the data: what is known of each recording, and what is not."""
    rows = []
    for source, recording, _ in made.loaded:
        about = f'{source.known}; {recording.span_s:.0f} s, {recording.rate_hz:.4g} Hz'
        rows.append(
            [
                f'{source.name} ({source.levels})',
                about,
                source.not_known or '-',
                source.licence,
                f'{source.address or source.file} {source.sha256[:16]}',
            ]
        )
    return ['recording', 'known', 'not known', 'licence', 'where, SHA-256'], rows


def picture(made: Made) -> Any:
    """Draw where each method fails: the share of right answers by defect."""
    kinds = sorted({name for fact in made.facts for name in fact.label.effects}) + ['no defect']
    methods = made.graded
    shares = np.full((len(methods), len(kinds)), np.nan)
    texts: dict[tuple[int, int], str] = {}
    for i, method in enumerate(methods):
        for j, kind in enumerate(kinds):
            hits = [
                row.exact
                for row in made.of(method)
                if kind in (row.fact.label.effects or ('no defect',))
            ]
            if hits:
                shares[i, j] = np.mean(hits)
                texts[i, j] = f'{sum(hits)}/{len(hits)}'
    size = 3.0 + 0.42 * len(kinds), 2.6 + 0.4 * len(methods)
    figure = new_figure(figsize=size)
    ax = figure.add_subplot()
    ax.imshow(shares, cmap='RdYlGn', vmin=0, vmax=1, aspect='auto')
    ax.set_xticks(range(len(kinds)), kinds, rotation=90)
    ax.set_yticks(range(len(methods)), methods)
    for (i, j), text in texts.items():
        ax.text(j, i, text, ha='center', va='center', fontsize=7)
    ax.set_title('Right answers of all trials in which the defect acts')
    return figure
