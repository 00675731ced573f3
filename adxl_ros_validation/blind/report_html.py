# SPDX-License-Identifier: Apache-2.0
"""A check as a page in one file that opens offline, and as tables for the documentation."""

from __future__ import annotations

from base64 import b64encode
from html import escape
from io import BytesIO
from itertools import chain
import textwrap
from typing import Any

from adxl_ros_validation.blind.grading import UNKNOWN
from adxl_ros_validation.blind.scores import (
    detection,
    FEWEST_TRIALS,
    in_words,
    outcome,
    RANK_BINS,
)
from adxl_ros_validation.blind.world.simulator import G0
import numpy as np

_STYLE = """
body{font:15px/1.45 system-ui,sans-serif;max-width:60em;margin:2em auto;padding:0 1em;color:#222}
h1{font-size:1.3em}h2{font-size:1.1em;margin-top:2em;border-bottom:1px solid #ccc}
table{border-collapse:collapse;font-size:13px}td,th{padding:.25em .6em;text-align:left;
border-bottom:1px solid #ddd;vertical-align:top}img{max-width:100%}
.said{background:#eef4fb;padding:.8em 1em;border-left:5px solid #36c}
.leak{background:#fbeeee;border-color:#c33}@media print{body{margin:0}}
"""
_COLUMNS = 79
"""Columns of a terminal."""
_NAME_COLUMNS = 20
"""Columns of the name of a score in a terminal."""
_TOO_FEW = (f'Too few: fewer than {FEWEST_TRIALS} trials. '
            'Not refuted: the interval or the value reaches the bar.')
"""Meanings of outcomes."""
Table = tuple[list[str], list[list[str]]]
"""Head and rows."""


def summary(made: dict[str, Any]) -> str:
    """Return the result of the check in a few lines."""
    rows = [line for row in _result(made)[1] for line in _row_lines(row)]
    head = f'{"score":{_NAME_COLUMNS}} {"value (90 % interval)":28}{"n":>4} {"bar":14}met'
    before, *after = (textwrap.wrap(text, _COLUMNS)
                      for text in (_drawn(made), _TOO_FEW, _leaks(made)))
    return '\n'.join([*before, '', head, *rows, '', *chain(*after)])


def _row_lines(row: list[str]) -> list[str]:
    """Lay out name, score, bar and outcome of a row in lines of a terminal."""
    name, *rest = textwrap.wrap(row[0], _NAME_COLUMNS)
    value, _, count = row[1].partition(', n = ')
    cells = f'{name:{_NAME_COLUMNS}} {value:28}{count:>4} {row[2]:14}{row[3]}'
    return [cells.rstrip(), *rest]


def terminal_table(table: Table) -> list[str]:
    """Return a narrow table as lines of a terminal: each row's name, then its cells."""
    head, rows = table
    return [line for row in rows for line in (
        row[0], *(f'    {name:30} {cell}' for name, cell in zip(head[1:], row[1:])))]


def markdown_result(made: dict[str, Any]) -> str:
    """Return the table of the result for the documentation."""
    drawn = textwrap.fill(_drawn(made), 99, break_on_hyphens=False)
    return '\n'.join([drawn, '', _leaks(made), '', *_markdown_table(_result(made)), '', _TOO_FEW])


def markdown(made: dict[str, Any]) -> str:
    """Return all tables for the documentation."""
    return tables_as_markdown([_drawn(made), _leaks(made)], _tables(made))


def tables_as_markdown(said: list[str], tables: dict[str, Table]) -> str:
    """Return paragraphs and tables as Markdown."""
    out = [line for text in said for line in (
        textwrap.fill(text, 99, break_on_hyphens=False), '')]
    for title, (head, rows) in tables.items():
        if rows:
            out += [f'### {title}', '', *_markdown_table((head, rows)), '']
    return '\n'.join(out)


def _markdown_table(table: Table) -> list[str]:
    head, rows = table
    return [f'| {" | ".join(head)} |', '|' + '---|' * len(head),
            *(f'| {" | ".join(row)} |' for row in rows)]


def page(made: dict[str, Any], pyplot: Any) -> str:
    """Return the page."""
    pictures = {'Detection against strength': _curves, 'Calibration': _calibration,
                'Ranks of the truth': _ranks_plot, 'Answers by true effect': _confusion}
    parts = []
    for title, draw in pictures.items():
        figure, out = draw(made, pyplot), BytesIO()
        figure.savefig(out, dpi=90, format='png', metadata={'Software': None})
        pyplot.close(figure)
        parts += [f'<h2>{escape(title)}</h2>', '<img alt="" src="data:image/png;base64,'
                  f'{b64encode(out.getvalue()).decode()}">']
    return tables_as_page('Blind check of diagnose', {_drawn(made): '', _leaks(
        made): ' leak' if made['leaks'] else ''}, ''.join(parts), _tables(made))


def tables_as_page(title: str, said: dict[str, str], middle: str, tables: dict[str, Table]) -> str:
    """Return a page of paragraphs, each with its class, of HTML between, and of tables."""
    parts = [f'<h1>{escape(title)}</h1>', *(
        f'<p class="said{name}">{escape(text)}</p>' for text, name in said.items()), middle]
    for name, table in tables.items():
        if table[1]:
            parts += [f'<h2>{escape(name)}</h2>', _html(table)]
    return (f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}'
            f'</title><style>{_STYLE}</style></head><body>{"".join(parts)}</body></html>\n')


def _drawn(made: dict[str, Any]) -> str:
    return (f'{made["trials"]} trials and {made["cases"] - made["trials"]} at strength zero, seed '
            f'{made["seed"]}, {made["date"]}; SHA-256 of salt and labels {made["hash"]}; code of '
            f'the diagnosis {made["version"]}, {made["diagnose_code"][:16]}.')


def _leaks(made: dict[str, Any]) -> str:
    bad = [name.replace('_', ' ') for name, control in made['controls'].items()
           if control['leaks']]
    if bad:
        return f'THE CHECK ITSELF LEAKS: not at chance: {", ".join(bad)}. Its scores mean nothing.'
    return 'The controls came out at chance.'


def _tables(made: dict[str, Any]) -> dict[str, Table]:
    scores = made['scores']
    return {'Result': _result(made), 'Scores': _scores(scores), 'Strength that is detected':
            _strengths(scores), 'Ranks of the truth in the posterior': _ranks(scores),
            'How often verdicts of a probability are right': reliability_table(
                scores['reliability']),
            'Controls': _controls(made),
            'Effect by effect, where the oracle sees it': _by_effect(scores),
            'Runs that failed': (['trial', 'error'], [
                [name, str(error)] for name, error in made['failed'].items()])}


def _score_text(score: dict[str, Any] | None, scale: float = 1.0, unit: str = '') -> str:
    if score is None or score['value'] is None:
        return '-'
    text = f'{scale * score["value"]:.3g}{unit}'
    if score.get('ci'):
        interval = ('∞' if end is None else f'{scale * end:.3g}' for end in score['ci'])
        text += f' ({" to ".join(interval)})'
    return text + (f', n = {score["count"]}' if 'count' in score else '')


def _result(made: dict[str, Any]) -> Table:
    """Return the scores beside their bars and those of the other methods."""
    others = made['scores']['comparison']
    head = ['score', 'diagnose (90 % interval)', 'bar', 'met', *others]
    sign = {-1: 'at most ', 1: 'at least ', 0: ''}
    rows = [[row['words'], _score_text(row),
             sign[row['way']] + ' to '.join(f'{bar:g}' for bar in row['bar']),
             outcome(row), *_other_scores(others, row['name'])] for row in made['bars']]
    for name, words in _WITHOUT_BAR.items():
        rows.append([words, _score_text(made['scores'][name]), '-', '-',
                     *_other_scores(others, name)])
    return head, rows


def _other_scores(others: dict[str, Any], name: str) -> list[str]:
    """Return a score of each method; '-' where the method has no such score."""
    return ['-' if scores.get(name, {}).get('value') is None else f'{scores[name]["value"]:.3g}'
            for scores in others.values()]


_WITHOUT_BAR = {'verdict_right': 'verdict right, all trials',
                'utility_of_effects': 'utility of the named set where an effect is visible',
                'utility': 'utility of the named set, all trials'}
"""Scores of the result that have no bar, in words."""


_WORDS = {
    'top_1_all_singles': 'top-1, all single effects, visible or not',
    'leading': 'true effect within the top hypothesis, where the oracle sees it',
    'set_size': 'effects in the named set', 'inseparable_size':
    'effects that are inseparable by the recording (fixed by the generator)',
    'brier': 'Brier score, all hypotheses',
    'closed': 'gap closed on a held-out recording, median',
    'unknown_recall_all': 'recall of unknown, visible or not',
    'unknown_wrongly': 'unknown where the library has the effect, or there is none',
    'seconds': 'run time, median, s',
}


def _scores(scores: dict[str, Any]) -> Table:
    rows = [[words, _score_text(scores[name])] for name, words in _WORDS.items()]
    rows += [[f'pairs: {name.replace("_", " ")}', _score_text(score)]
             for name, score in scores['pairs'].items()]
    rows += [['run time, longest, s', f'{scores["longest_s"]:.0f}'],
             ['verdicts', ', '.join(f'{name} {n}' for name, n in scores['status'].items())]]
    return ['score', 'value (90 % interval)'], rows


def _strengths(scores: dict[str, Any]) -> Table:
    return ['effects', '50 %, mg rms', '90 %, mg rms'], [
        [name.replace('_', ' '), *(
            _score_text(curve.get(level), 1e3 / G0) if curve.get(level) else 'not reached'
            for level in ('at_50', 'at_90'))] for name, curve in scores['detection'].items()]


def _ranks(scores: dict[str, Any]) -> Table:
    edges = [f'{k / RANK_BINS:g}' for k in range(RANK_BINS + 1)]
    head = ['parameters of', 'trials', *map('{} to {}'.format, edges, edges[1:]), 'p if uniform']
    return head, [[name, str(row['trials']), *map(str, row['bins']), f'{row["p"]:.3f}']
                  for name, row in scores['ranks'].items() if row['p'] is not None]


def reliability_table(rows: list[dict[str, Any]]) -> Table:
    """Return how often verdicts are right, by bins of the probability that they state."""
    return ['probability of the verdict', 'mean', 'right (90 % interval)'], [
        [f'{row["bin"][0]:g} to {row["bin"][1]:g}', f'{row["confidence"]:.3f}',
         in_words({**row, 'value': row['right']})] for row in rows]


def _controls(made: dict[str, Any]) -> Table:
    def number(value: float | None) -> str:
        return '-' if value is None else f'{value:.3f}'

    return ['control', 'score', 'at chance', 'p', 'leaks'], [
        [name.replace('_', ' '), number(control['score']), number(control['chance']),
         number(control.get('p')), 'YES' if control['leaks'] else 'no']
        for name, control in made['controls'].items()]


def _by_effect(scores: dict[str, Any]) -> Table:
    names = ('trials', 'detected', 'named', 'top')
    return ['effect', *names], [[effect, *(str(row[name]) for name in names)]
                                for effect, row in scores['by_effect'].items()]


def _html(table: Table) -> str:
    head, rows = table
    top = ''.join(f'<th>{escape(cell)}</th>' for cell in head)
    body = ''.join('<tr>' + ''.join(f'<td>{escape(cell)}</td>' for cell in row) + '</tr>'
                   for row in rows)
    return f'<table><tr>{top}</tr>{body}</table>'


def _curves(made: dict[str, Any], pyplot: Any) -> Any:
    figure, axis = pyplot.subplots(figsize=(10, 4), layout='constrained')
    for i, (name, curve) in enumerate(made['scores']['detection'].items()):
        if not curve['bins']:
            continue
        x = np.array([row['strength'] for row in curve['bins']])
        y = np.array([row['value'] for row in curve['bins']])
        errors = np.abs(np.array([row['ci'] for row in curve['bins']]).T - y)
        axis.errorbar(1e3 * x / G0, y, yerr=errors, fmt='o', ms=4, lw=0.8, color=f'C{i}',
                      label=name.replace('_', ' '))
        if 'middle' in curve:
            fine = np.linspace(np.log(x.min()), np.log(x.max()), 100)
            axis.plot(1e3 * np.exp(fine) / G0, detection(
                fine, curve['middle'], curve['width'], curve['missed'], curve['by_chance']),
                color=f'C{i}')
        if name == 'every':
            axis.plot(1e3 * x / G0, [row['value'] for row in curve['oracle']], 'k--', lw=0.8,
                      label='oracle')
    axis.set(xscale='log', xlabel='strength, mg rms beyond zero-g and scale',
             ylabel='share detected', ylim=(-0.03, 1.03))
    axis.legend(fontsize=8)
    return figure


def _calibration(made: dict[str, Any], pyplot: Any) -> Any:
    figure, axis = pyplot.subplots(figsize=(5, 4), layout='constrained')
    rows = made['scores']['reliability']
    axis.plot([0, 1], [0, 1], 'k:', lw=0.8)
    axis.scatter([row['confidence'] for row in rows], [row['right'] for row in rows],
                 [8 + row['count'] for row in rows])
    axis.set(xlabel='probability that the verdict gives itself', ylabel='share right',
             xlim=(-0.03, 1.03), ylim=(-0.03, 1.03))
    return figure


def _ranks_plot(made: dict[str, Any], pyplot: Any) -> Any:
    """Draw the rank histogram of all parameters beside its expectation."""
    row = made['scores']['ranks']['all']
    figure, axis = pyplot.subplots(figsize=(5, 3), layout='constrained')
    axis.bar((np.arange(RANK_BINS) + 0.5) / RANK_BINS, row['bins'], 0.95 / RANK_BINS)
    axis.axhline(row['count'] / RANK_BINS, color='k', ls=':', lw=0.8)
    axis.set(xlabel='rank of the truth in the posterior of a parameter', ylabel='parameters',
             xlim=(0, 1))
    return figure


def _confusion(made: dict[str, Any], pyplot: Any) -> Any:
    table = made['scores']['confusion']
    rows = [name for name in ('none', UNKNOWN) if name in table] + [
        name for name in table if name not in ('none', UNKNOWN)]
    answers = {name for row in table.values() for name in row}
    columns = [name for name in rows if name in answers] + sorted(answers - set(rows))
    shares = np.array([[table[row].get(column, 0) / sum(table[row].values())
                        for column in columns] for row in rows]).reshape(len(rows), -1)
    figure, axis = pyplot.subplots(figsize=(11, 10), layout='constrained')
    axis.imshow(shares, cmap='Blues', vmin=0, vmax=1, aspect='auto')
    axis.set_xticks(range(len(columns)), columns, rotation=90, fontsize=7)
    axis.set_yticks(range(len(rows)), [f'{row} ({sum(table[row].values())})' for row in rows],
                    fontsize=7)
    for i, row in enumerate(rows):
        for j, column in enumerate(columns):
            if table[row].get(column):
                axis.text(j, i, table[row][column], ha='center', va='center', fontsize=6,
                          color='white' if shares[i, j] > 0.6 else 'black')
    axis.set(xlabel='answer', ylabel='true (trials)')
    return figure
