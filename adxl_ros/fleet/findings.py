# SPDX-License-Identifier: Apache-2.0

"""
Effects by unit, and what units with an effect have in common: a batch, a stage, a place.

A group is all units whose serial numbers begin alike, or all units that are recorded below one
folder. An effect belongs to a group if it is more frequent there than elsewhere by Fisher's exact
test, whose chance all groups and effects share (Bonferroni).

The order of units by urgency.

The rule is that of the table in docs/howto/fleet.md. A unit has the first state that fits:

1. Out of tolerance: its gap exceeds the tolerance now, or without a gap its drift since the
   calibration. The largest comes first.
2. Drifts: a claimed slope takes it out of the tolerance. The nearest date comes first.
3. Not judged: its last recordings are refused. The longest series comes first.
4. Far out: a coefficient is not that of the population. The farthest comes first.
5. Old calibration: its calibration is older than a year, or it has none.
6. In order.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

from adxl_ros.fleet.table import FleetTable, MG, QuantityResult, TOLERANCE_MG
from adxl_ros.fleet.populations import by_prefix, CHANCE, MIN_GROUP
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
RECENT = 5
"""Number of recordings whose median is the gap of a unit now. Chosen: one odd one is no gap."""
MAX_AGE_DAYS = 365.0
"""Largest age of a calibration, days. Chosen: a year."""
_DAYS_PER_YEAR = 365.25
_FARTHEST_DAYS = 10 * _DAYS_PER_YEAR
"""A drift that needs longer is no matter of urgency. Chosen: the life of a robot."""


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
    findings = [*_of_most(effects, by_unit, is_common), *_of_batches(effects, by_unit, serials),
                *_of_places(effects, has, place, folders),
                *_units_with_many(effects, by_unit & ~is_common, serials)]
    return EffectMatrix(effects, units, judged, named, tuple(findings))


def _has_effect(lists: Sequence[Sequence[str]], effects: Sequence[str]) -> np.ndarray:
    """Return whether each list has each effect, (n, e)."""
    return np.array([[name in names for name in effects] for names in lists],
                    bool).reshape(len(lists), len(effects))


def _folder(url: str) -> str:
    """Return the folder of a recording."""
    return str(url).rpartition('/')[0]


def _of_most(effects: Sequence[str], by_unit: np.ndarray, is_common: np.ndarray) -> list[str]:
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


def _of_batches(effects: Sequence[str], by_unit: np.ndarray, serials: Sequence[str]) -> list[str]:
    """Name the effects of units whose serial numbers begin alike."""
    return [f'{inside} of {size} units with a serial number {prefix}… have {name}, and '
            f'{outside} of the {rest} others: a bad batch.'
            for prefix, name, inside, size, outside, rest in _frequent(
                by_prefix(serials), effects, by_unit)]


def _of_places(effects: Sequence[str], has: np.ndarray, unit: np.ndarray, folders: Sequence[str]
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


class State(IntEnum):
    """State of a unit; the most urgent is the least."""

    OUT_OF_TOLERANCE = 1
    DRIFTS = 2
    NOT_JUDGED = 3
    FAR_OUT = 4
    OLD_CALIBRATION = 5
    IN_ORDER = 6

    @property
    def words(self) -> str:
        """Return the state for people."""
        return self.name.replace('_', ' ').lower()


@dataclass(frozen=True)
class Drift:
    """A claimed slope of a unit."""

    result: QuantityResult  # Its quantity
    place: int  # Where the unit stands among those of the quantity
    days: float  # Days until the unit is out of its tolerance; infinite for a quantity without one
    # Gap now, or the drift since the calibration where there is no gap; NaN for a quantity without
    # a tolerance
    reached_mg: float

    @property
    def text(self) -> str:
        """Return the slope with its interval, for people."""
        factor, unit = self.result.quantity.factor, self.result.quantity.shown_unit
        slope, half = (factor * float(values[self.place]) for values in (
            self.result.trends.slope, self.result.half_width))
        return (f'{self.result.quantity.label} {number(slope, True)} '
                f'({number(slope - half, True)} to {number(slope + half, True)}) {unit} per year')


@dataclass(frozen=True)
class UnitState:
    """One unit."""

    unit: int  # Its number
    serial: str  # Its serial number
    state: State  # Its state
    reason: str  # Why it has this state, in one sentence
    # gap_mg, floor_mg: Median of its last gaps and of their noise floors; NaN without any
    gap_mg: float
    floor_mg: float
    drifts: tuple[Drift, ...]  # Its claimed slopes, the most urgent first
    # recordings, refused: Number of its recordings, and of those that are refused or crashed
    recordings: int
    refused: int
    calibration_age_days: float  # Age of its calibration at the last recording; NaN without one
    last_year: float  # Date of its last recording, years since 1970; NaN without a date
    report: str  # Folder of the single reports of its last recording; empty for none

    @property
    def is_drifting(self) -> bool:
        """Return whether a claimed slope takes the unit out of its tolerance soon enough."""
        return bool(self.drifts) and self.drifts[0].days < _FARTHEST_DAYS


def number(value: float, signed: bool = False, digits: int = 3) -> str:
    """Return a number with a few digits and no exponent."""
    if not np.isfinite(value):
        return '-'
    rounded = float(f'{value:.{digits}g}')
    text = f'{abs(rounded):.0f}' if abs(rounded) >= 100 else \
        np.format_float_positional(abs(rounded), trim='-')
    sign = '\N{MINUS SIGN}' if rounded < 0 else '+' if signed and rounded > 0 else ''
    return sign + text


def rank(table: FleetTable, results: Sequence[QuantityResult],
         far_out: Sequence[dict[str, str | float]], tolerance_mg: float = TOLERANCE_MG
         ) -> list[UnitState]:
    """Return all units, the most urgent first."""
    labels = {result.quantity.column: result.quantity.label for result in results}
    distant: dict[str, tuple[float, str]] = {}
    for item in far_out:
        distance = abs(float(item['distance']))
        distant.setdefault(str(item['serial']), (
            distance, f'{labels[str(item["coefficient"])]} is {distance:.1f} standard deviations '
            'from the mean of the fleet.'))
    ranked = [_state_of(unit, table, results, distant.get(serial), tolerance_mg)
              for unit, serial in enumerate(table.serials)]
    return [state for _, state in sorted(ranked, key=lambda item: (
        item[1].state, item[0], item[1].serial))]


def _state_of(unit: int, table: FleetTable, results: Sequence[QuantityResult],
              distant: tuple[float, str] | None, tolerance_mg: float
              ) -> tuple[float, UnitState]:
    """Return a unit and its rank among those of its state, the most urgent least."""
    rows = table.rows_of(unit)
    gap_mg, floor_mg, over_mg = _gap_now(table, rows)
    age_days = _age_now(table, rows)
    drifts = _drifts(unit, results, tolerance_mg, over_mg, age_days)
    refused = table['outcome'][rows] != 'done'
    series = len(refused) if refused.all() else int(np.argmin(refused[::-1]))
    state, urgency, reason = State.IN_ORDER, 0.0, ''
    if over_mg > tolerance_mg:
        state, urgency = State.OUT_OF_TOLERANCE, -over_mg
        reason = f'Gap {number(gap_mg)} mg, noise {number(floor_mg)} mg; the tolerance is ' \
            f'{number(tolerance_mg)} mg.' + (f' It drifts: {drifts[0].text}.' if drifts else '')
    elif drifts and drifts[0].days == 0:
        state, urgency = State.OUT_OF_TOLERANCE, -drifts[0].reached_mg
        reason = f'{_capital(drifts[0].text)}, or {number(drifts[0].reached_mg, digits=2)} mg ' \
            f'since its calibration; the tolerance is {number(tolerance_mg)} mg.'
    elif drifts and drifts[0].days < _FARTHEST_DAYS:
        state, urgency = State.DRIFTS, drifts[0].days
        reason = f'{_capital(drifts[0].text)}: out of tolerance in ' \
            f'{number(drifts[0].days, digits=2)} days.'
    elif series:
        state, urgency = State.NOT_JUDGED, -series
        last = table['refusal'][rows[-1]] or table['outcome'][rows[-1]]
        reason = f'The last {series} recordings are refused: {last}' if series > 1 else \
            f'The last recording is refused: {last}'
    elif distant is not None:
        state, urgency, reason = State.FAR_OUT, -distant[0], _capital(distant[1])
    elif not age_days <= MAX_AGE_DAYS:
        state, urgency = State.OLD_CALIBRATION, -age_days if age_days > 0 else -np.inf
        reason = f'Its calibration is {age_days:.0f} days old.' if age_days > 0 else \
            'It has no calibration with a date.'
    return urgency, UnitState(
        unit, table.serials[unit], state, reason, gap_mg, floor_mg, drifts, len(rows),
        int(refused.sum()), age_days, float(table.years[rows[-1]]),
        next((str(text) for text in table['report'][rows[::-1]] if text), ''))


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]


def _gap_now(table: FleetTable, rows: np.ndarray) -> tuple[float, float, float]:
    """Return the last gap, its noise floor and the gap beyond the floor, mg; NaN without any."""
    rows = rows[table.period[rows] == table.period[rows[-1]]]
    rows = rows[np.isfinite(table['gap_before_mps2'][rows])][-RECENT:]
    if not len(rows):
        return np.nan, np.nan, np.nan
    gap = float(np.median(table['gap_before_mps2'][rows])) * MG
    floors = table['gap_floor_mps2'][rows]
    floor = float(np.median(floors[np.isfinite(floors)])) * MG if np.isfinite(floors).any() \
        else 0.0
    return gap, floor, float(np.sqrt(max(gap ** 2 - floor ** 2, 0.0)))


def _age_now(table: FleetTable, rows: np.ndarray) -> float:
    """Return the age of the calibration at the last recording that has one, days."""
    ages = table['calibration_age_days'][rows]
    dated = np.flatnonzero(np.isfinite(ages))
    return float(ages[dated[-1]]) if len(dated) else np.nan


def _drifts(unit: int, results: Sequence[QuantityResult], tolerance_mg: float, over_mg: float,
            age_days: float) -> tuple[Drift, ...]:
    """Return the claimed slopes of a unit, the most urgent first."""
    drifts = []
    for result in results:
        place = result.place_of(unit)
        if place is None or not result.is_claimed[place]:
            continue
        days, reached_mg, quantity = np.inf, np.nan, result.quantity
        slope_mg = float(result.trends.slope[place]) * quantity.factor
        if quantity.is_force and (quantity.is_coefficient or slope_mg > 0):
            # A coefficient is right at its calibration, and the gap shows what it is now.
            since_mg = abs(slope_mg) * np.nan_to_num(age_days) / _DAYS_PER_YEAR
            reached_mg = over_mg if np.isfinite(over_mg) else since_mg
            days = max(tolerance_mg - reached_mg, 0.0) / abs(slope_mg) * _DAYS_PER_YEAR
        drifts.append(Drift(result, place, days, reached_mg))
    return tuple(sorted(drifts, key=lambda drift: drift.days))
