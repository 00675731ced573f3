# SPDX-License-Identifier: Apache-2.0
"""A check in words and tables: for a terminal, for the documentation, and for a page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import zip_longest
from pathlib import Path
import re
import textwrap
from typing import Any, NamedTuple

from adxl_ros.report import page
from adxl_ros.report.screen import COLUMNS
from adxl_ros_validation.blind.scores import FEWEST_TRIALS, in_words, WITHOUT_BAR
from adxl_ros_validation.blind.simulator import G0

Table = tuple[Sequence[str], Sequence[Sequence[str]]]
"""Head and rows."""


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table, Markdown."""
    return '\n'.join(
        f'| {" | ".join(row)} |' if row else '|' + '---|' * len(head) for row in (head, (), *rows)
    )


def terminal_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Return a table as lines of a terminal; its head and the names of its rows are wrapped."""
    widths = [max(map(len, [*title.split(), *cells])) for title, *cells in zip(head, *rows)]
    widths[0] = COLUMNS - sum(widths[1:]) - len(widths)
    lines = []
    for row in (head, *rows):
        cells = [textwrap.wrap(cell, width) for cell, width in zip(row, widths)]
        lines += [
            ''.join(f' {part:{width}}' for part, width in zip(parts, widths)).rstrip()
            for parts in zip_longest(*cells, fillvalue='')
        ]
    return lines


def filled(name: str, values: Mapping[str, Any]) -> str:
    """Return a Markdown page with values in it, from the text of its name, its prose wrapped."""
    text = Path(__file__).parents[1].joinpath('pages', name).read_text(encoding='utf-8')
    parts = re.split(r'\n{2,}', text.format(**values).strip())
    return (
        '\n\n'.join(
            part
            if part.startswith(('|', '#', '!'))
            else textwrap.fill(part, 99, break_on_hyphens=False, break_long_words=False)
            for part in parts
        )
        + '\n'
    )


class Report(NamedTuple):
    """A check in words and tables, the first of which is its result."""

    title: str
    said: list[str]
    tables: dict[str, Table]

    def screen(self) -> list[str]:
        """Return words and result as lines of a terminal."""
        return [*self.said, '', *terminal_table(*next(iter(self.tables.values())))]

    def markdown(self, titles: Sequence[str] = ()) -> str:
        """Return words and tables for the documentation, all of them or those of some titles."""
        return (
            '\n\n'.join(
                [
                    *(textwrap.fill(text, 99, break_on_hyphens=False) for text in self.said),
                    *(
                        f'### {title}\n\n{markdown_table(*table)}'
                        for title, table in self.tables.items()
                        if table[1] and title in (titles or self.tables)
                    ),
                ]
            )
            + '\n'
        )

    def html(self, picture: Any = None) -> str:
        """Return words and tables as a page, below the first table a picture of matplotlib."""
        return page.render(
            'adxl_ros_validation',
            'pages/tables.html',
            {**self._asdict(), 'picture': page.picture_url(picture) if picture else ''},
        )


def of_simulated(made: dict[str, Any]) -> Report:
    """Return the report of a check on simulated recordings."""
    scores, names = made['scores'], ('trials', 'detected', 'named', 'top')
    bad = ', '.join(
        name.replace('_', ' ') for name, control in made['controls'].items() if control['leaks']
    )
    result = [[bar['words'], _score_text(bar), bar['bar'], bar['met']] for bar in made['bars']]
    result += [
        [row.words, _score_text(scores[name]), '-', '-']
        for name, row in WITHOUT_BAR.items()
        if row.result
    ]
    return Report(
        'Blind check of diagnose',
        [
            f'{made["trials"]} trials and {made["cases"] - made["trials"]} at strength zero, seed '
            f'{made["seed"]}, {made["date"]}; SHA-256 of salt and labels {made["hash"]}; code of '
            f'the diagnosis {made["version"]}, {made["diagnose_code"][:16]}.',
            f'THE CHECK ITSELF LEAKS: not at chance: {bad}. Its scores mean nothing.'
            if bad
            else 'The controls came out at chance.',
            f'Too few: fewer than {FEWEST_TRIALS} trials. '
            'Not refuted: the interval or the value reaches the bar.',
        ],
        {
            'Result': (['score', 'diagnose (90 % interval)', 'bar', 'met'], result),
            'Scores': _score_table(scores),
            'Strength that is detected': (
                ['effects', 'mg rms', 'detected', 'oracle'],
                [
                    [
                        name,
                        f'{1e3 * row["strength"] / G0:.2g}',
                        in_words(row),
                        f'{100 * row["oracle"]:.0f} %',
                    ]
                    for name, rows in scores['detection'].items()
                    for row in rows
                ],
            ),
            'How often verdicts of a probability are right': reliability(scores['reliability']),
            'Controls': _control_table(made['controls']),
            'Effect by effect, where the oracle sees it': (
                ['effect', *names],
                [
                    [effect, *(str(row[name]) for name in names)]
                    for effect, row in scores['by_effect'].items()
                ],
            ),
            'Answers by true effect': (
                ['true', 'answers'],
                [
                    [
                        effect,
                        ', '.join(
                            f'{name} {count}'
                            for name, count in sorted(row.items(), key=lambda item: -item[1])
                        ),
                    ]
                    for effect, row in scores['confusion'].items()
                ],
            ),
            'Runs that failed': (
                ['trial', 'error'],
                [[name, str(error)] for name, error in made['failed'].items()],
            ),
        },
    )


def _score_table(scores: dict[str, Any]) -> Table:
    """Return the scores that have neither a bar nor a place among the results."""
    others = [
        [row.words, _score_text(scores[name])]
        for name, row in WITHOUT_BAR.items()
        if not row.result
    ]
    pairs = [
        [f'pairs: {name.replace("_", " ")}', _score_text(score)]
        for name, score in scores['pairs'].items()
    ]
    return ['score', 'value (90 % interval)'], [
        *others,
        *pairs,
        ['run time, longest, s', f'{scores["longest_s"]:.0f}'],
        ['verdicts', ', '.join(f'{name} {n}' for name, n in scores['status'].items())],
    ]


def _control_table(controls: dict[str, Any]) -> Table:
    """Return the scores of the controls beside those of chance."""
    rows = []
    for name, control in controls.items():
        stated = [control.get(key) for key in ('score', 'chance', 'p')]
        figures = ['-' if figure is None else f'{figure:.3f}' for figure in stated]
        rows.append([name.replace('_', ' '), *figures, 'YES' if control['leaks'] else 'no'])
    return ['control', 'score', 'at chance', 'p', 'leaks'], rows


def reliability(rows: list[dict[str, Any]]) -> Table:
    """Return how often verdicts are right, by bins of the probability that they state."""
    return ['probability of the verdict', 'mean', 'right (90 % interval)'], [
        [
            f'{row["bin"][0]:g} to {row["bin"][1]:g}',
            f'{row["confidence"]:.3f}',
            in_words({**row, 'value': row['right']}),
        ]
        for row in rows
    ]


def _score_text(score: dict[str, Any]) -> str:
    if score['value'] is None:
        return '-'
    low, high = score['ci']
    return f'{score["value"]:.3g} ({low:.3g} to {high:.3g}), n = {score["count"]}'
