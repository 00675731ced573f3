# SPDX-License-Identifier: Apache-2.0

"""
Effects by unit, and what units with an effect have in common: a batch, a stage, a place.

A group is all units whose serial numbers begin alike, or all units that are recorded below one
folder. An effect belongs to a group if it is more frequent there than elsewhere by Fisher's exact
test, whose chance all groups and effects share (Bonferroni).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from adxl_ros.fleet.report.batches import by_prefix, CHANCE, MIN_GROUP
from adxl_ros.fleet.report.fleet_table import FleetTable
from adxl_ros.model.effects import library
from adxl_ros.model.effects.base import Place
import numpy as np
import scipy

_VERDICTS = ('no_gap', 'explained', 'partly', 'inseparable', 'unknown')
"""Statuses of recordings whose effects are judged."""
_COMMON_SHARE = 0.5
"""Share of all units with an effect that is common to the fleet. Chosen: the majority."""
_MANY_EFFECTS = 3
"""Count of effects of one unit from which the unit itself is suspected. Chosen."""


@dataclass(frozen=True)
class EffectMatrix:
    """How often each effect is named in each unit."""

    effects: tuple[str, ...]  # Effects that are named anywhere, the most frequent first, (e,)
    units: np.ndarray  # Numbers of the units with a verdict, (k,)
    judged: np.ndarray  # Number of recordings with a verdict, (k,)
    named: np.ndarray  # Number of recordings in which each effect is named for certain, (k, e)
    findings: tuple[str, ...]  # What rows and columns have in common, one sentence each

    @property
    def share(self) -> np.ndarray:
        """Share of the recordings of each unit in which each effect is named, (k, e)."""
        return self.named / self.judged[:, None]


def effect_matrix(table: FleetTable) -> EffectMatrix:
    """Count the named effects by unit, and look for what units with an effect have in common."""
    rows = np.flatnonzero(np.isin(table['status'].astype(str), _VERDICTS) & (table.unit >= 0)
                          & table.first)
    counts: dict[str, int] = {}
    for names in table['effects'][rows]:
        for name in names:
            counts[name] = counts.get(name, 0) + 1
    effects = tuple(sorted(counts, key=lambda name: (-counts[name], name)))
    units, place, judged = np.unique(table.unit[rows], return_inverse=True, return_counts=True)
    has = _has_effect(list(table['effects'][rows]), effects)
    named = np.zeros((len(units), len(effects)))
    np.add.at(named, place, has)
    by_unit = named > judged[:, None] / 2
    serials = [table.serials[unit] for unit in units]
    is_common = (by_unit.sum(axis=0) > _COMMON_SHARE * len(units)) & (len(units) >= MIN_GROUP)
    folders = [_folder(url) for url in table['url'][rows]]
    findings = [*_common(effects, by_unit, is_common), *_batches(effects, by_unit, serials),
                *_places(effects, has, place, folders),
                *_units_with_many(effects, by_unit & ~is_common, serials)]
    return EffectMatrix(effects, units, judged, named, tuple(findings))


def _has_effect(lists: Sequence[Sequence[str]], effects: Sequence[str]) -> np.ndarray:
    """Return whether each list has each effect, (n, e)."""
    return np.array([[name in names for name in effects] for names in lists],
                    bool).reshape(len(lists), len(effects))


def _folder(url: str) -> str:
    """Return the folder of a recording."""
    return str(url).rpartition('/')[0]


def _common(effects: Sequence[str], by_unit: np.ndarray, is_common: np.ndarray) -> list[str]:
    """Name the effects that most units have: what all units share is at fault."""
    findings = []
    for number in np.flatnonzero(is_common).tolist():
        cause = 'It is an effect of the stage: check the stage.' if _of_stage(effects[number]) \
            else 'Look for what they share: stage, mounting, parameter file, batch.'
        findings.append(f'{by_unit[:, number].sum()} of {len(by_unit)} units have '
                        f'{effects[number]}. {cause}')
    return findings


def _of_stage(name: str) -> bool:
    effect = library().get(name)
    return effect is not None and effect.place is Place.STAGE


def _batches(effects: Sequence[str], by_unit: np.ndarray, serials: Sequence[str]) -> list[str]:
    """Name the effects of units whose serial numbers begin alike."""
    return [f'{inside} of {size} units with a serial number {prefix}… have {name}, and '
            f'{outside} of the {rest} others: a bad batch.'
            for prefix, name, inside, size, outside, rest in _frequent(
                by_prefix(serials), effects, by_unit)]


def _places(effects: Sequence[str], has: np.ndarray, unit: np.ndarray, folders: Sequence[str]
            ) -> list[str]:
    """Name the effects of units that are recorded below one folder."""
    pairs = sorted(set(zip(unit.tolist(), folders)))
    numbers = {pair: i for i, pair in enumerate(pairs)}
    place = np.array([numbers[pair] for pair in zip(unit.tolist(), folders)], int)
    named = np.zeros((len(pairs), len(effects)))
    np.add.at(named, place, has)
    by_pair = named > np.bincount(place, minlength=len(pairs))[:, None] / 2
    groups: dict[str, np.ndarray] = {}
    for i, (_, folder) in enumerate(pairs):
        for end in (j for j, letter in enumerate(f'{folder}/') if letter == '/' and j):
            groups.setdefault(folder[:end], np.zeros(len(pairs), bool))[i] = True
    return [f'{inside} of {size} units that are recorded in {folder} have {name}, and {outside} '
            f'of {rest} elsewhere: {"a bad stage" if _of_stage(name) else "a bad place"}.'
            for folder, name, inside, size, outside, rest in _frequent(groups, effects, by_pair)]


def _frequent(groups: dict[str, np.ndarray], effects: Sequence[str], has: np.ndarray
              ) -> list[tuple[str, str, int, int, int, int]]:
    """
    Return the group in which each effect is more frequent than elsewhere, if there is one.

    groups: members by name, (k,) bool each; effects: names of the effects, (e,); has: whether each
    member has each effect, (k, e) bool.
    """
    groups = {name: members for name, members in groups.items()
              if MIN_GROUP <= members.sum() <= len(members) - 1}
    result = []
    for number, effect in enumerate(effects):
        tested = []
        for name, members in groups.items():
            inside, size = int(has[members, number].sum()), int(members.sum())
            outside, rest = int(has[~members, number].sum()), len(members) - size
            log_chance = _log_fisher(inside, size, outside, rest)
            tested.append((log_chance, -size, (name, effect, inside, size, outside, rest)))
        if tested and min(tested)[0] < np.log(CHANCE / (len(groups) * len(effects))):
            best = min(tested)[2]
            if best[2] > _COMMON_SHARE * best[3]:
                result.append(best)
    return result


def _log_fisher(inside: int, size: int, outside: int, rest: int) -> float:
    """Return the logarithm of the chance of so many members or more with an effect."""
    named, count = inside + outside, size + rest
    k = np.arange(inside, min(size, named) + 1)
    terms = (_log_choose(size, k) + _log_choose(rest, named - k) - _log_choose(count, named))
    return float(np.logaddexp.reduce(terms))


def _log_choose(n: int, k: np.ndarray | int) -> np.ndarray:
    inside = (k >= 0) & (k <= np.asarray(n))
    chosen = np.where(inside, k, 0)
    log_factorial = scipy.special.gammaln
    return np.where(inside, log_factorial(n + 1) - log_factorial(chosen + 1)
                    - log_factorial(n - chosen + 1), -np.inf)


def _units_with_many(effects: Sequence[str], by_unit: np.ndarray, serials: Sequence[str]
                     ) -> list[str]:
    """Name the units that have many effects: the unit or its mounting is at fault."""
    return [f'{serials[i]} has {count} effects ({", ".join(np.array(effects)[by_unit[i]])}): '
            'check the unit and its mounting.'
            for i in np.argsort(-by_unit.sum(axis=1), kind='stable')
            if (count := int(by_unit[i].sum())) >= _MANY_EFFECTS]
