# SPDX-License-Identifier: Apache-2.0
"""
A check: labels to which a published hash commits, and scores with negative controls.

Its folder has the recordings, the labels, and reports as they are made.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from datetime import date
from functools import partial
import hashlib
import json
import os
from pathlib import Path
import secrets
import shutil
from typing import Any, NamedTuple

from adxl_ros.errors import UserError
from adxl_ros.process import package_version
from adxl_ros.workers import for_each, make_folder, Pool, write
from adxl_ros_validation.blind import diagnosis_runs, grading, scores
from adxl_ros_validation.blind.diagnosis_runs import Show
from adxl_ros_validation.blind.scores import Trial
from adxl_ros_validation.blind.trials import Drawn, Label, Plan
import numpy as np
import scipy


class Setup(NamedTuple):
    """What determines the trials of a check."""

    seed: int  # seed of all random numbers
    trials: int  # number of trials, without those at strength zero


def seal(folder: Path, seed: int | None, count: int, plan_all: Callable[[int, int], list[Plan]],
         make: Callable[[Plan], Drawn], pool: Pool, show: Callable[[float], None]) -> str:
    """
    Draw trials into a folder and publish the hash of their labels.

    A call on a folder that has them returns the hash; an interrupted one continues.
    """
    digest, drawn = published_hash(folder), folder / 'labels' / 'drawn'
    existing = None
    if digest is not None:
        existing = committed_labels(folder)[0]
    elif (drawn / 'setup').exists():
        existing = Setup(*json.loads((drawn / 'setup').read_bytes()))
    elif any(folder.glob('*')):
        raise UserError(f'{folder}: is not empty and has no check; choose another folder')
    if seed is None:
        seed = existing.seed if existing else secrets.randbelow(2 ** 31)
    setup = Setup(seed, count)
    if existing not in (None, setup):
        raise UserError(f'{folder}: has a check of another seed or number of trials; repeat the '
                        'same options to continue it, or choose another folder')
    if digest is None:
        write(make_folder(drawn) / 'setup', json.dumps(setup).encode())
        plans, recordings = plan_all(*setup), make_folder(folder / 'recordings')

        def keep(label: Label, *texts: str | None) -> None:
            for suffix, text in zip(('csv', 'yaml', 'sim'), texts):
                if text is not None:
                    path = recordings / f'{label.name}.{suffix}'
                    write(path, text.encode())
                    # The time of writing would show how long the label took to draw.
                    os.utime(path, (0, 0))
            write(drawn / f'{label.name}.json', json.dumps(asdict(label)).encode())

        todo = [plan for plan in plans if not (drawn / f'{plan.name}.json').exists()]
        for_each(pool, make, [partial(tuple, (plan,)) for plan in todo], keep, show,
                 len(plans) - len(todo))
        rows = [json.loads(path.read_bytes()) for path in sorted(drawn.glob('*.json'))]
        text = json.dumps({'salt': secrets.token_hex(16), **setup._asdict(), 'labels': rows},
                          indent=1).encode()
        digest = hashlib.sha256(text).hexdigest()
        write(folder / 'labels' / 'labels.json', text)
        write(folder / 'seal.json', json.dumps({
            'sha256_of_salt_and_labels': digest, 'cases': len(rows), 'date': str(date.today()),
        }, indent=1).encode())
    shutil.rmtree(drawn, ignore_errors=True)
    return digest


def published_hash(folder: Path) -> str | None:
    """Return the published hash of a folder's labels; None before it is published."""
    path = folder / 'seal.json'
    try:
        return str(json.loads(path.read_bytes())['sha256_of_salt_and_labels'])
    except FileNotFoundError:
        return None
    except (ValueError, KeyError, TypeError):
        raise UserError(f'{path}: has no hash; draw a new check into another folder') from None


def committed_labels(folder: Path) -> tuple[Setup, list[Label]]:
    """Read the labels and compare them with the published hash."""
    digest, path = published_hash(folder), folder / 'labels' / 'labels.json'
    if digest is None:
        raise UserError(f'{folder}: no labels are committed there; use --seal {folder} first')
    try:
        text = path.read_bytes()
    except FileNotFoundError:
        raise UserError(f'{path}: no such file; copy it from where the check was drawn') from None
    if hashlib.sha256(text).hexdigest() != digest:
        raise UserError(f'{path}: these are not the labels whose hash {digest} was published; '
                        'they were changed since')
    try:
        content: dict[str, Any] = json.loads(text)
        return Setup(content['seed'], content['trials']), [Label(**row | {
            name: tuple(row[name]) for name in ('effects', 'seed', 'seconds')})
            for row in content['labels']]
    except (ValueError, KeyError, TypeError):
        raise UserError(f'{path}: is of another version; draw a new check into another folder'
                        ) from None


def score(folder: Path, pool: Pool, show: Show) -> dict[str, Any]:
    """Diagnose all recordings that have no report yet, read the labels and score."""
    digest = published_hash(folder)
    if digest is None:
        raise UserError(f'{folder}: no labels are committed there; use --seal {folder} first')
    # Labels may be on another machine: the diagnosis does not need them.
    with show('diagnose') as advance:
        results = diagnosis_runs.diagnose_all(folder, pool, advance)
    setup, labels = committed_labels(folder)
    missing = [label.name for label in labels if label.name not in results]
    if missing:
        raise UserError(f'{folder / "recordings"}: {missing[0]}.csv is missing, {len(missing)} '
                        'of the committed recordings in all; a check needs all of them')
    by_name = {label.name: label for label in labels}

    def job(name: str) -> tuple:
        stated = (folder / 'recordings' / f'{name}.yaml').read_text()
        return by_name[name], stated, results[name]['parameters']

    with show('held out') as advance:
        held_out = diagnosis_runs.kept(make_folder(folder / 'labels' / 'held'), list(by_name),
                                       diagnosis_runs.evaluate, job, pool, advance)
    graded = [Trial(label, grading.answer(results[label.name]), held_out[label.name])
              for label in labels]
    made = scores.scores(graded)
    negative = {'labels_permuted': permuted(graded),
                'metadata_only': metadata(folder / 'recordings', labels),
                'strength_zero': strength_zero(graded)}
    return {
        'schema': 1, 'hash': digest, **setup._asdict(), 'cases': len(labels),
        'date': str(date.today()), 'version': package_version(),
        'diagnose_code': (folder / 'reports' / 'version.txt').read_text(),
        'failed': {trial.label.name: results[trial.label.name]['error'] for trial in graded
                   if trial.answer.status == 'failed'},
        'bars': scores.bars(made), 'controls': negative,
        'leaks': any(control['leaks'] for control in negative.values()),
        'scores': made, 'rows': [{
            **{name: [fault[name] for fault in label.faults]
               for name in ('strength_mps2', 'power', 'told', 'inseparable')},
            'name': label.name, 'group': label.group, 'effects': list(label.effects),
            'flexible': label.flexible, 'manoeuvre': label.manoeuvre, 'axes': label.axes,
            'status': answer.status, 'top': sorted(answer.top), 'named': sorted(answer.named),
            'probability': answer.probability, 'right': grading.verdict_right(answer, label),
            'seconds': answer.seconds, 'held': held} for label, answer, held in graded]}


_CHANCE = 0.002
"""Chance that one control reports a leak of a check that has none; chosen."""
_SHUFFLES = 2000
"""Number of permutations of the labels; chosen."""


def permuted(trials: Sequence[Trial]) -> dict[str, Any]:
    """
    Score the answers against the labels of other trials.

    The score by chance follows from the frequencies of answers and labels. A higher score uses
    something besides the answers.
    """
    real = [trial for trial in trials if trial.label.group != 'zero']
    accepted = [grading.right(trial.label) for trial in real]
    right = np.array([[trial.answer.top in effects for effects in accepted]
                      for trial in real], float)
    rng, n = np.random.default_rng(0), len(real)
    shuffled = np.array([right[np.arange(n), rng.permutation(n)].mean()
                         for _ in range(_SHUFFLES)])
    chance = float(right.mean())
    low, high = (float(q) for q in np.quantile(shuffled, (_CHANCE / 2, 1 - _CHANCE / 2)))
    return {'score': float(shuffled.mean()), 'chance': chance,
            'labels_in_place': float(np.trace(right)) / n,
            'by_chance_between': [low, high], 'leaks': not low <= chance <= high}


def metadata(recordings: Path, labels: Sequence[Label]) -> dict[str, Any]:
    """
    Guess labels from sizes, lengths, times and names of files only.

    The score is the share of the variance of a quantity's ranks that the labels explain (Kruskal
    and Wallis), for the quantity that they explain best. At chance is the same with permuted
    labels. Labels count in three ways: by group, by effect, and as some effect or none.
    """
    def facts_of(name: str) -> tuple[float, ...]:
        csv, yaml = (recordings / f'{name}.{suffix}' for suffix in ('csv', 'yaml'))
        data, size, about = csv.read_bytes(), csv.stat().st_size, yaml.stat()
        rows, last = data.count(b'\n'), data.rstrip().rsplit(b'\n', 1)[-1]
        return (size, rows, size - rows * len(last), csv.stat().st_mtime, about.st_size,
                about.st_mtime, float(last.split(b',')[0]))

    def explained_by(members: np.ndarray) -> float:
        sums = members.T @ ranks
        between = np.sum(sums ** 2 / members.sum(axis=0)[:, None], axis=0)
        return float(np.max(between / np.maximum(np.sum(ranks ** 2, axis=0), 1e-12)))

    facts = np.array([facts_of(label.name) for label in labels], float)
    ranks = scipy.stats.rankdata(np.column_stack([facts, np.arange(len(labels))]), axis=0)
    ranks -= ranks.mean(axis=0)
    groupings = [[label.group for label in labels],
                 ['+'.join(label.effects) for label in labels],
                 ['something' if label.effects else 'nothing' for label in labels]]
    rng, count = np.random.default_rng(0), len(labels)
    explained, chance = [], []
    for grouping in groupings:
        index = np.unique(grouping, return_inverse=True)[1]
        members = np.eye(index.max() + 1)[index]
        explained.append(explained_by(members))
        chance.append([explained_by(members[rng.permutation(count)]) for _ in range(_SHUFFLES)])
    above = np.sum(np.array(chance) >= np.array(explained)[:, None] - 1e-12, axis=1)
    p = float((1 + above.min()) / (1 + _SHUFFLES))
    return {'score': explained[0], 'chance': float(np.mean(chance[0])), 'p': p,
            'leaks': p < _CHANCE}


def strength_zero(trials: Sequence[Trial]) -> dict[str, Any]:
    """Compare trials whose effect has strength zero with trials without an effect."""
    zero, none = ([trial.answer.gap for trial in trials if trial.label.group == group]
                  for group in ('zero', 'none'))
    named = sum(trial.label.effects[0] in trial.answer.named for trial in trials
                if trial.label.group == 'zero')
    if not zero or not none:
        return {'score': None, 'chance': None, 'p': 1.0, 'leaks': False, 'named': named}
    p = float(scipy.stats.fisher_exact([[sum(zero), len(zero) - sum(zero)],
                                       [sum(none), len(none) - sum(none)]]).pvalue)
    return {'score': sum(zero) / len(zero), 'chance': sum(none) / len(none), 'p': p,
            'named': named, 'leaks': p < _CHANCE}
