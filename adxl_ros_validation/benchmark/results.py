# SPDX-License-Identifier: Apache-2.0
"""Score the answers of all methods, with intervals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

from adxl_ros_validation.benchmark import defects, run
from adxl_ros_validation.benchmark.manifest import Loaded, Source
from adxl_ros_validation.benchmark.run import Answered
from adxl_ros_validation.blind import real_sensors
from adxl_ros_validation.blind.faults import KINDS
from adxl_ros_validation.blind.grading import Answer
from adxl_ros_validation.blind.ideal_observer import Bracket
from adxl_ros_validation.blind.real_sensors import Half
from adxl_ros_validation.blind.scores import resampled, Score, share
from adxl_ros_validation.blind.trials import Label
import numpy as np

_SEEN = 0.1
"""Smallest defect whose closing counts, as a share of the untouched mean square; chosen."""
_HARM = 0.01
"""Smallest harm, as a share of the mean square before; that of the blind check."""

Answers = Mapping[str, Mapping[str, Answered]]
"""Answers by method and name of the case."""


class Drawn(NamedTuple):
    """What is known of a trial of level A, besides its label."""

    label: Label
    recording: str
    noises: float  # Strength of the largest defect, in the noise of one sample
    clean: float  # Mean square on the later part without the defect, (m/s²)²
    limit: Bracket | None  # What an ideal observer could name; None without a defect


class Row(NamedTuple):
    """A graded answer of level A."""

    method: str
    fact: Drawn
    answered: Answered
    exact: bool
    in_set: bool
    by_chance: float  # How often it is exact by labels of other trials of the recording

    @property
    def group(self) -> str:
        """Return the group of the trial."""
        return self.fact.label.group

    @property
    def closed(self) -> float | None:
        """Return the closed share of what a defect added; None where it adds too little."""
        label, clean = self.fact.label, self.fact.clean
        like_noise = any(KINDS[name].random for name in label.effects)
        if not label.effects or like_noise or not self.answered.before:
            return None
        before, after = np.mean(self.answered.before), np.mean(self.answered.after)
        added = before - clean
        return float((before - after) / added) if added > _SEEN * clean else None

    @property
    def harm(self) -> bool:
        """Return whether the later part is simulated worse than with the stated parameters."""
        if not self.answered.before:
            return False
        return bool(np.mean(self.answered.after) > (1 + _HARM) * np.mean(self.answered.before))


def draw_facts(folder: Path, parts: Sequence[Half], labels: Sequence[Label]) -> list[Drawn]:
    """Find what is known of each trial: its untouched later part, and the limit."""
    facts = []
    for label in labels:
        rng = np.random.default_rng([*label.seed, 0])
        part = real_sensors.trial_part(parts[label.seed[-1]], rng)
        case = run.untouched_case(folder / 'labels' / 'clean', replace(part, name=label.name))
        later = run.later_part(case)
        clean = run.later_squares(case) if later.known.any() else np.nan
        limit = None
        if label.faults:
            untouched = np.nan_to_num(case.residual_mps2().T)
            limit = defects.limit(part, label, untouched)
        noises = [row['strength_mps2'] / label.floor_mps2 for row in label.faults]
        facts.append(Drawn(label, part.name, max(noises, default=0.0), clean, limit))
    return facts


def grade(facts: Sequence[Drawn], answers: Answers) -> list[Row]:
    """Grade all answers of level A."""
    rows = []
    for method, by_name in answers.items():
        for fact in facts:
            if not {fact.label.name, fact.recording} <= by_name.keys():
                continue  # It was interrupted.
            answered, base = by_name[fact.label.name], by_name[fact.recording].answer
            exact, in_set = _right(answered.answer, base, fact.label)
            others = [
                _right(answered.answer, base, other.label)[0]
                for other in facts
                if other.recording == fact.recording and other is not fact
            ]
            chance = float(np.mean(others or [False]))
            rows.append(Row(method, fact, answered, exact, in_set, chance))
    return rows


def _right(answer: Answer, base: Answer, label: Label) -> tuple[bool, bool]:
    """
    Return whether an answer is exactly right, and whether its named set has the truth.

    What is named of the untouched part, too, is no error. But who says of a defect what is said
    without it has not seen it.
    """
    same = (answer.status, answer.certain, answer.groups) == (
        base.status,
        base.certain,
        base.groups,
    )
    if label.faults and same:
        return False, False
    return real_sensors.right(answer, base, label)


def exact_share(rows: Sequence[Row], group: str) -> Score:
    """Return the share of the trials of a group that are exactly right."""
    return share([row.exact for row in rows if row.group == group])


def limit_of(facts: Sequence[Drawn], group: str) -> Bracket | None:
    """Return the mean bracket of an ideal observer over the trials of a group."""
    found = [fact.limit for fact in facts if fact.limit and fact.label.group == group]
    return Bracket(*np.mean(found, axis=0).tolist()) if found else None


def median_closed(rows: Sequence[Row]) -> Score:
    """Return the median share that is closed, with its interval over resampled trials."""
    return resampled([row.closed for row in rows if row.closed is not None], np.median)


class Physical(NamedTuple):
    """An answer to a case of level B or C."""

    source: Source
    method: str
    answered: Answered
    # Whether it names a documented set: yes, among others, or NO; '' where none is documented
    right: str
    closed: Score  # Share of the squared gap that is closed on the later part, by blocks


def grade_physical(chosen: Mapping[str, Loaded], answers: Answers) -> list[Physical]:
    """Grade the answers of levels B and C."""
    rows = []
    for name, (source, *_) in chosen.items():
        expected = [frozenset(each) for each in source.expected]
        for method, by_name in answers.items():
            if name not in by_name:
                continue  # It was interrupted.
            answered = by_name[name]
            right = _documented(answered, expected) if 'B' in source.levels else ''
            rows.append(Physical(source, method, answered, right, _share_closed(answered)))
    return rows


def _documented(answered: Answered, expected: Sequence[frozenset[str]]) -> str:
    """Return whether an answer names one of the documented sets, in words."""
    if answered.causes in expected and not answered.one_of:
        return 'yes'
    return 'among others' if any(each <= answered.causes for each in expected) else 'NO'


def _share_closed(answered: Answered) -> Score:
    """Return the share of the squared gap that is closed, with an interval over blocks."""
    pairs = list(zip(answered.before, answered.after))

    def closed(blocks: Sequence[tuple[float, float]]) -> float:
        before, after = np.sum(blocks, axis=0)
        return float(1 - after / before)

    return resampled(pairs, closed)


def as_json(facts: Sequence[Drawn], rows: Sequence[Row], physical: Sequence[Physical]) -> Any:
    """Return all figures as objects of JSON."""
    keys = ('exact', 'in_set', 'by_chance', 'closed', 'harm')
    return {
        'trials': [
            asdict(fact.label) | {'recording': fact.recording, 'limit': fact.limit}
            for fact in facts
        ],
        'answers': [
            {'method': row.method, 'trial': row.fact.label.name}
            | row.answered.as_json()
            | {key: getattr(row, key) for key in keys}
            for row in rows
        ],
        'physical': [
            {'method': row.method, 'source': row.source.name}
            | row.answered.as_json()
            | {'right': row.right, 'closed': row.closed}
            for row in physical
        ],
    }
