# SPDX-License-Identifier: Apache-2.0
"""A check as a page in one file that opens offline, and as tables for the documentation."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from itertools import chain
import textwrap
from typing import Any

from adxl_ros_validation.blind.scores import FEWEST_TRIALS, in_words
from adxl_ros_validation.blind.simulator import G0

_STYLE = """
body{font:15px/1.45 system-ui,sans-serif;max-width:60em;margin:2em auto;padding:0 1em;color:#222}
h1{font-size:1.3em}h2{font-size:1.1em;margin-top:2em;border-bottom:1px solid #ccc}
table{border-collapse:collapse;font-size:13px}td,th{padding:.25em .6em;text-align:left;
border-bottom:1px solid #ddd;vertical-align:top}
.said{background:#eef4fb;padding:.8em 1em;border-left:5px solid #36c}@media print{body{margin:0}}
"""
_COLUMNS = 79
"""Columns of a terminal."""
_NAME_COLUMNS = 20
"""Columns of the name of a score in a terminal."""
_TOO_FEW = (f'Too few: fewer than {FEWEST_TRIALS} trials. '
            'Not refuted: the interval or the value reaches the bar.')
"""Meanings of outcomes."""
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
"""The other scores in words."""
Table = tuple[list[str], list[list[str]]]
"""Head and rows."""


def summary(made: dict[str, Any]) -> str:
    """Return the result of the check in a few lines."""
    lines = [f'{"score":{_NAME_COLUMNS}} {"value (90 % interval)":28}{"n":>4} {"bar":14}met']
    for words, score, bar, met in _result(made)[1]:
        name, *rest = textwrap.wrap(words, _NAME_COLUMNS)
        value, _, count = score.partition(', n = ')
        lines += [f'{name:{_NAME_COLUMNS}} {value:28}{count:>4} {bar:14}{met}'.rstrip(), *rest]
    before, *after = (textwrap.wrap(text, _COLUMNS)
                      for text in (_drawn(made), _TOO_FEW, _leaks(made)))
    return '\n'.join([*before, '', *lines, '', *chain(*after)])


def terminal_table(table: Table) -> list[str]:
    """Return a narrow table as lines of a terminal: each row's name, then its cells."""
    head, rows = table
    return [line for row in rows for line in (
        row[0], *(f'    {name:30} {cell}' for name, cell in zip(head[1:], row[1:])))]


def markdown_result(made: dict[str, Any]) -> str:
    """Return the table of the result for the documentation."""
    return '\n'.join([_filled(_drawn(made)), '', _leaks(made), '',
                      markdown_table(*_result(made)), '', _TOO_FEW])


def markdown(made: dict[str, Any]) -> str:
    """Return all tables for the documentation."""
    return tables_as_markdown([_drawn(made), _leaks(made)], _tables(made))


def tables_as_markdown(said: list[str], tables: dict[str, Table]) -> str:
    """Return paragraphs and tables as Markdown."""
    return '\n'.join([*(f'{_filled(text)}\n' for text in said),
                      *(f'### {title}\n\n{markdown_table(*table)}\n'
                        for title, table in tables.items() if table[1])])


def _filled(text: str) -> str:
    return textwrap.fill(text, 99, break_on_hyphens=False)


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table, Markdown."""
    return '\n'.join([f'| {" | ".join(head)} |', '|' + '---|' * len(head),
                      *(f'| {" | ".join(row)} |' for row in rows)])


def page(made: dict[str, Any]) -> str:
    """Return the page."""
    return tables_as_page('Blind check of diagnose', [_drawn(made), _leaks(made)], _tables(made))


def tables_as_page(title: str, said: list[str], tables: dict[str, Table]) -> str:
    """Return a page of paragraphs and tables."""
    parts = [f'<h1>{escape(title)}</h1>',
             *(f'<p class="said">{escape(text)}</p>' for text in said)]
    for name, (head, rows) in tables.items():
        if rows:
            lines = [f'<tr>{"".join(f"<{tag}>{escape(cell)}</{tag}>" for cell in row)}</tr>'
                     for tag, row in (('th', head), *(('td', row) for row in rows))]
            parts += [f'<h2>{escape(name)}</h2><table>{"".join(lines)}</table>']
    return (f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}'
            f'</title><style>{_STYLE}</style></head><body>{"".join(parts)}</body></html>\n')


def _drawn(made: dict[str, Any]) -> str:
    return (f'{made["trials"]} trials and {made["cases"] - made["trials"]} at strength zero, seed '
            f'{made["seed"]}, {made["date"]}; SHA-256 of salt and labels {made["hash"]}; code of '
            f'the diagnosis {made["version"]}, {made["diagnose_code"][:16]}.')


def _leaks(made: dict[str, Any]) -> str:
    bad = ', '.join(name.replace('_', ' ') for name, control in made['controls'].items()
                    if control['leaks'])
    return f'THE CHECK ITSELF LEAKS: not at chance: {bad}. Its scores mean nothing.' if bad \
        else 'The controls came out at chance.'


def _tables(made: dict[str, Any]) -> dict[str, Table]:
    scores = made['scores']
    names = ('trials', 'detected', 'named', 'top')
    return {
        'Result': _result(made),
        'Scores': (['score', 'value (90 % interval)'], [
            *([words, _score_text(scores[name])] for name, words in _WORDS.items()),
            *([f'pairs: {name.replace("_", " ")}', _score_text(score)]
              for name, score in scores['pairs'].items()),
            ['run time, longest, s', f'{scores["longest_s"]:.0f}'],
            ['verdicts', ', '.join(f'{name} {n}' for name, n in scores['status'].items())]]),
        'Strength that is detected': (['effects', 'mg rms', 'detected', 'oracle'], [
            [name, f'{1e3 * row["strength"] / G0:.2g}', in_words(row),
             f'{100 * row["oracle"]:.0f} %']
            for name, rows in scores['detection'].items() for row in rows]),
        'How often verdicts of a probability are right': reliability_table(
            scores['reliability']),
        'Controls': (['control', 'score', 'at chance', 'p', 'leaks'], [
            [name.replace('_', ' '), *(
                '-' if control.get(key) is None else f'{control[key]:.3f}'
                for key in ('score', 'chance', 'p')), 'YES' if control['leaks'] else 'no']
            for name, control in made['controls'].items()]),
        'Effect by effect, where the oracle sees it': (['effect', *names], [
            [effect, *(str(row[name]) for name in names)]
            for effect, row in scores['by_effect'].items()]),
        'Answers by true effect': (['true', 'answers'], [
            [effect, ', '.join(f'{name} {count}' for name, count in sorted(
                row.items(), key=lambda item: -item[1]))]
            for effect, row in scores['confusion'].items()]),
        'Runs that failed': (['trial', 'error'], [
            [name, str(error)] for name, error in made['failed'].items()])}


def _score_text(score: dict[str, Any]) -> str:
    if score['value'] is None:
        return '-'
    low, high = score['ci']
    return f'{score["value"]:.3g} ({low:.3g} to {high:.3g}), n = {score["count"]}'


def _result(made: dict[str, Any]) -> Table:
    """Return the scores beside their bars."""
    rows = [[bar['words'], _score_text(bar), bar['bar'], bar['met']] for bar in made['bars']]
    rows += [[words, _score_text(made['scores'][name]), '-', '-']
             for name, words in _WITHOUT_BAR.items()]
    return ['score', 'diagnose (90 % interval)', 'bar', 'met'], rows


def reliability_table(rows: list[dict[str, Any]]) -> Table:
    """Return how often verdicts are right, by bins of the probability that they state."""
    return ['probability of the verdict', 'mean', 'right (90 % interval)'], [
        [f'{row["bin"][0]:g} to {row["bin"][1]:g}', f'{row["confidence"]:.3f}',
         in_words({**row, 'value': row['right']})] for row in rows]
