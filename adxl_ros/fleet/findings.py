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

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

from adxl_ros.fleet.populations import by_prefix, CHANCE, MIN_GROUP
from adxl_ros.fleet.table import FarOut, FleetTable, MG, QuantityResult, TOLERANCE_MG
from adxl_ros.model.effects import library
from adxl_ros.model.effects.base import Place
from adxl_ros.report.quantities import number
import numpy as np
import pandas as pd
import scipy

_VERDICTS = ('no_gap', 'explained', 'partly', 'inseparable', 'unknown')
"""Statuses of recordings whose effects are judged."""
_MOST = 0.5
"""Share from which most have an effect: recordings of a unit, units of a group or of the fleet."""
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
    share: np.ndarray  # Share of the recordings of each unit in which each effect is named, (k, e)
    findings: tuple[str, ...]  # What rows and columns have in common, one sentence each


def effect_matrix(table: FleetTable) -> EffectMatrix:
    """Count the named effects by unit, and look for what units with an effect have in common."""
    used = np.isin(table['status'].astype(str), _VERDICTS) & (table.unit >= 0) & table.first
    frame, unit = table.frame[used], table.unit[used]
    counts = Counter(name for names in frame['effects'] for name in names)
    effects = tuple(sorted(counts, key=lambda name: (-counts[name], name)))
    has = pd.DataFrame([[name in names for name in effects] for names in frame['effects']],
                       columns=effects, dtype=float)
    share = has.groupby(unit).mean()
    by_unit = share.to_numpy() > _MOST
    by_place = has.groupby([unit, [url.rpartition('/')[0] for url in frame['url']]]).mean()
    serials = [table.serials[i] for i in share.index]
    below: dict[str, np.ndarray] = {}
    for row, (_, folder) in enumerate(by_place.index):
        for end in (i for i, letter in enumerate(f'{folder}/') if letter == '/' and i):
            below.setdefault(folder[:end], np.zeros(len(by_place), bool))[row] = True
    is_common = (by_unit.sum(axis=0) > _MOST * len(serials)) & (len(serials) >= MIN_GROUP)
    findings = [
        *(f'{by_unit[:, i].sum()} of {len(by_unit)} units have {effects[i]}. ' + (
            'It is an effect of the stage: check the stage.' if _of_stage(effects[i]) else
            'Look for what they share: stage, mounting, parameter file, batch.')
          for i in np.flatnonzero(is_common)),
        *(f'{inside} of {size} units with a serial number {prefix}… have {name}, and '
          f'{outside} of the {rest} others: a bad batch.'
          for prefix, name, inside, size, outside, rest in _frequent(
              by_prefix(serials), effects, by_unit)),
        *(f'{inside} of {size} units that are recorded in {folder} have {name}, and {outside} '
          f'of {rest} elsewhere: {"a bad stage" if _of_stage(name) else "a bad place"}.'
          for folder, name, inside, size, outside, rest in _frequent(
              below, effects,
              by_place.to_numpy() > _MOST)),
        # The unit or its mounting is at fault.
        *(f'{serials[i]} has {names.sum()} effects ({", ".join(np.array(effects)[names])}): '
          'check the unit and its mounting.'
          for i, names in sorted(enumerate(by_unit & ~is_common), key=lambda row: -row[1].sum())
          if names.sum() >= _MANY_EFFECTS)]
    return EffectMatrix(effects, share.index.to_numpy(), share.to_numpy(), tuple(findings))


def _of_stage(name: str) -> bool:
    effect = library().get(name)
    return effect is not None and effect.place is Place.STAGE


def _frequent(groups: dict[str, np.ndarray], effects: Sequence[str], has: np.ndarray
              ) -> list[tuple[str, str, int, int, int, int]]:
    """
    Return the group in which each effect is more frequent than elsewhere, if there is one.

    groups: members by name, (k,) bool each; effects: names of the effects, (e,); has: whether each
    member has each effect, (k, e) bool.
    """
    groups = {name: members for name, members in groups.items()
              if MIN_GROUP <= members.sum() <= len(members) - 1}
    if not groups:
        return []
    names, members, total, result = list(groups), np.array(list(groups.values())), len(has), []
    size = members.sum(axis=1)
    for column, effect in enumerate(effects):
        named = int(has[:, column].sum())
        inside = (members & has[:, column]).sum(axis=1)
        log_chance = scipy.stats.hypergeom.logsf(inside - 1, total, named, size)
        i = min(range(len(names)), key=lambda g: (log_chance[g], -size[g], names[g]))
        if log_chance[i] < np.log(CHANCE / (len(names) * len(effects))) \
                and inside[i] > _MOST * size[i]:
            result.append((names[i], effect, int(inside[i]), int(size[i]),
                           named - int(inside[i]), total - int(size[i])))
    return result


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

    @property
    def colour(self) -> str:
        """Return the colour of the badge of a unit."""
        return ('red', 'amber', 'amber', 'amber', 'grey', 'green')[self - 1]


class Drift(NamedTuple):
    """A claimed slope of a unit."""

    result: QuantityResult  # Its quantity
    text: str  # The slope with its interval, for people
    days: float  # Days until the unit is out of its tolerance; infinite for a quantity without one
    # Gap now, or the drift since the calibration where there is no gap; NaN for a quantity without
    # a tolerance
    reached_mg: float


@dataclass(frozen=True)
class UnitState:
    """One unit; its texts are for people."""

    unit: int  # Its number
    serial: str  # Its serial number
    state: State  # Its state
    reason: str  # Why it has this state, in one sentence; empty for none
    drifts: tuple[Drift, ...]  # Its claimed slopes, the most urgent first
    gap: str  # Median of its last gaps and of their noise floors, mg
    recordings: str  # Number of its recordings, and of those that are refused or crashed
    age: str  # Age of its calibration at the last recording, days
    last_year: float  # Date of its last recording, years since 1970; NaN without a date
    report: str  # Folder of the single reports of its last recording; empty for none

    @property
    def is_drifting(self) -> bool:
        """Return whether a claimed slope takes the unit out of its tolerance soon enough."""
        return bool(self.drifts) and self.drifts[0].days < _FARTHEST_DAYS


def rank(table: FleetTable, results: Sequence[QuantityResult],
         distant: Sequence[FarOut]) -> list[UnitState]:
    """Return all units, the most urgent first."""
    farthest = {item.serial: item for item in reversed(distant)}
    ranked = [_state_of(unit, table, results, farthest.get(serial))
              for unit, serial in enumerate(table.serials)]
    return [state for _, state in sorted(ranked, key=lambda item: (
        item[1].state, item[0], item[1].serial))]


def _state_of(unit: int, table: FleetTable, results: Sequence[QuantityResult],
              distant: FarOut | None) -> tuple[float, UnitState]:
    """Return a unit and its rank among those of its state, the most urgent least."""
    rows = table.rows_of(unit)
    gap_mg, floor_mg, over_mg = _gap_now(table, rows)
    ages = table['calibration_age_days'][rows]
    age_days = float(next((age for age in ages[::-1] if np.isfinite(age)), np.nan))
    drifts = _drifts(unit, results, over_mg, age_days)
    refused = table['outcome'][rows] != 'done'
    series = len(refused) if refused.all() else int(np.argmin(refused[::-1]))
    tolerance = f'the tolerance is {number(TOLERANCE_MG)} mg.'
    state, urgency, reason = State.IN_ORDER, 0.0, ''
    if over_mg > TOLERANCE_MG:
        state, urgency = State.OUT_OF_TOLERANCE, -over_mg
        reason = f'Gap {number(gap_mg)} mg, noise {number(floor_mg)} mg; {tolerance}' + (
            f' It drifts: {drifts[0].text}.' if drifts else '')
    elif drifts and drifts[0].days == 0:
        state, urgency = State.OUT_OF_TOLERANCE, -drifts[0].reached_mg
        reason = f'{drifts[0].text}, or {number(drifts[0].reached_mg, digits=2)} mg since its ' \
            f'calibration; {tolerance}'
    elif drifts and drifts[0].days < _FARTHEST_DAYS:
        state, urgency = State.DRIFTS, drifts[0].days
        reason = f'{drifts[0].text}: out of tolerance in {number(drifts[0].days, digits=2)} days.'
    elif series:
        state, urgency = State.NOT_JUDGED, -series
        reason = (f'The last {series} recordings are refused: ' if series > 1 else
                  'The last recording is refused: '
                  ) + str(table['refusal'][rows[-1]] or table['outcome'][rows[-1]])
    elif distant is not None:
        state, urgency = State.FAR_OUT, -abs(distant.distance)
        reason = f'{distant.quantity.label} is {-urgency:.1f} standard deviations from the mean ' \
            'of the fleet.'
    elif not age_days <= MAX_AGE_DAYS:
        state, urgency = State.OLD_CALIBRATION, -age_days if age_days > 0 else -np.inf
        reason = f'Its calibration is {age_days:.0f} days old.' if age_days > 0 else \
            'It has no calibration with a date.'
    return urgency, UnitState(
        unit, table.serials[unit], state, reason[:1].upper() + reason[1:], drifts,
        f'{number(gap_mg)} / {number(floor_mg)}' if np.isfinite(gap_mg) else '-',
        f'{len(rows)} ({refused.sum()})', f'{age_days:.0f}' if np.isfinite(age_days) else '-',
        float(table.years[rows[-1]]),
        next((text for text in table['report'][rows[::-1]] if text), ''))


def _gap_now(table: FleetTable, rows: np.ndarray) -> tuple[float, float, float]:
    """Return the last gap, its noise floor and the gap beyond the floor, mg; NaN without any."""
    rows = rows[table.period[rows] == table.period[rows[-1]]]
    rows = rows[np.isfinite(table['gap_before_mps2'][rows])][-RECENT:]
    if not len(rows):
        return np.nan, np.nan, np.nan
    gap = float(np.median(table['gap_before_mps2'][rows])) * MG
    floors = table['gap_floor_mps2'][rows]
    floor = float(np.nanmedian(floors)) * MG if np.isfinite(floors).any() else 0.0
    return gap, floor, float(np.sqrt(max(gap ** 2 - floor ** 2, 0.0)))


def _drifts(unit: int, results: Sequence[QuantityResult], over_mg: float, age_days: float
            ) -> tuple[Drift, ...]:
    """Return the claimed slopes of a unit, the most urgent first."""
    drifts = []
    for result in results:
        place, quantity = result.place_of(unit), result.quantity
        if place is None or not result.is_claimed[place]:
            continue
        slope, half = float(result.trends.slope[place]), float(result.half_width[place])
        text = f'{quantity.label} ' \
            f'{quantity.text(slope, slope - half, slope + half)} per year'
        days, reached_mg = np.inf, np.nan
        if quantity.is_force and (quantity.is_coefficient or slope > 0):
            # A coefficient is right at its calibration, and the gap shows what it is now.
            mg_per_day = abs(quantity.factor * slope) / _DAYS_PER_YEAR
            reached_mg = over_mg if np.isfinite(over_mg) else mg_per_day * np.nan_to_num(age_days)
            days = max(TOLERANCE_MG - reached_mg, 0.0) / mg_per_day
        drifts.append(Drift(result, text, days, reached_mg))
    return tuple(sorted(drifts, key=lambda drift: drift.days))
