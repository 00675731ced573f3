# SPDX-License-Identifier: Apache-2.0

"""
How often verdicts are right, by their status and by the share of draws that repeat them.

    ./run --exec python docs/measurements/verdict_probabilities.py DIR... -o FILE

DIR: files of `adxl_ros working -o`, `blind -o` or `blind --real -o`. The table that it prints is
`_RIGHT` of the diagnosis. Shares rise with the draws (isotonic regression; Zadrozny and Elkan
2002), and begin with two further cases that have the share of the whole status.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace
import json
from pathlib import Path
from typing import Any, NamedTuple

from adxl_ros.files.atomic_write import write_text
from adxl_ros_validation.blind import grading
from adxl_ros_validation.blind.trials import Label
import numpy as np
from scipy.optimize import isotonic_regression

REPEATED = (0.5, 0.8, 0.95, 1.0)
"""Shares of the draws at which the table is known."""
EDGES = (0.65, 0.9, 0.9999)
"""Shares between them."""
PRIOR_CASES = 2.0  # Chosen: a few cases alone decide no share


class Case(NamedTuple):
    """A verdict, and whether it was right."""

    name: str
    status: str
    repeated: float
    right: bool


def blind_cases(folder: Path) -> Iterator[Case]:
    """Yield the verdicts of a blind check, sealed or on real recordings."""
    for row in json.loads((folder / 'blind.json').read_text())['rows']:
        report = json.loads((folder / 'reports' / f'{row["name"]}.json').read_text())['report']
        if not report or row.get('group') == 'zero':
            continue
        if 'stated' in row:
            right = row['stated'][1]
        else:
            right = row['in_set' if row['status'] == 'inseparable' else 'exact']
        yield case(f'{folder.name}/{row["name"]}', report, right)


def working_cases(folder: Path) -> Iterator[Case]:
    """Yield the verdicts of working cases; noise above the stated one may be named, too."""
    for path in sorted(folder.glob('*/result.json')):
        result = json.loads(path.read_text())
        name = path.parent.name
        label = Label(**json.loads((path.parent / f'{name}.json').read_text()))
        answer = grading.answer(result)
        noise = {'noise_excess'} - {*label.effects}
        if answer.certain - noise:
            answer = replace(answer, certain=answer.certain - noise)
        if result['report']:
            yield case(name, result['report'], grading.verdict_right(answer, label))


def case(name: str, report: dict[str, Any], right: bool) -> Case:
    """Return a verdict of a report."""
    verdict = report['verdict']
    return Case(name, verdict['status'], float(verdict['repeated']), bool(right))


def table(cases: Sequence[Case]) -> dict[str, list[float]]:
    """Return how often verdicts are right by status, at the shares `REPEATED`."""
    out = {}
    for status in sorted({c.status for c in cases}):
        chosen = [c for c in cases if c.status == status]
        overall = np.mean([c.right for c in chosen])
        place = np.searchsorted(EDGES, [c.repeated for c in chosen])
        hits = np.bincount(place, [c.right for c in chosen], minlength=len(REPEATED))
        counts = np.bincount(place, minlength=len(REPEATED)).astype(float)
        shares = (hits + PRIOR_CASES * overall) / (counts + PRIOR_CASES)
        rising = isotonic_regression(shares, weights=counts + PRIOR_CASES).x
        out[status] = [round(float(share), 2) for share in rising]
    return out


def main() -> None:
    """Run on the command line."""
    parse = argparse.ArgumentParser(description=__doc__)
    parse.add_argument('folders', nargs='+', type=Path, metavar='DIR')
    parse.add_argument('-o', dest='output', type=Path, required=True, metavar='FILE')
    options = parse.parse_args()
    cases: list[Case] = []
    for folder in options.folders:
        is_blind = (folder / 'blind.json').exists()
        cases += blind_cases(folder) if is_blind else working_cases(folder)
    rows = [f'{c.name} {c.status} {c.repeated:.3f} {int(c.right)}' for c in cases]
    shares = [f'{status}: {values}' for status, values in table(cases).items()]
    head = [f'{len(cases)} verdicts, right at {REPEATED} of the draws:', *shares]
    print('\n'.join(head))
    write_text(options.output, '\n'.join([*head, '', *rows, '']))


if __name__ == '__main__':
    main()
