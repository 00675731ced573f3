# SPDX-License-Identifier: Apache-2.0

"""
The table of a fleet in the order of sensors and time, and what it says.

Each quantity has trends, a population and outliers.

The order of sensors by urgency is that of the table in docs/howto/fleet.md. A sensor has the first
state that fits:

1. Out of tolerance: its gap exceeds the tolerance now, or without a gap its drift since the
   calibration. The largest comes first.
2. Drifts: a claimed slope takes it out of the tolerance. The nearest date comes first, and units
   whose noise rises last.
3. Not judged: its last recordings are refused. The longest series comes first.
4. In order.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from itertools import chain, product
from typing import NamedTuple

from adxl_ros.errors import UserError
from adxl_ros.files.atomic_write import AnyPath
from adxl_ros.fleet import populations
from adxl_ros.fleet.row import NOISE
from adxl_ros.fleet.trends import claims, fit_trends, interval_factor, outliers, Recordings, Trends
from adxl_ros.model.constants import AXES, Z_90
from adxl_ros.model.population import PooledCoefficient
from adxl_ros.report.quantities import counted, mg, number
import numpy as np
import pandas as pd

_TEXTS = [
    'url',
    'hash',
    'serial',
    'outcome',
    'refusal',
    'refused_by',
    'calibration_id',
    'status',
    'report',
]
"""Columns of texts that the page uses."""
_OTHERS = ['date', 'effects', 'calibration_age_days', 'gap_floor_mps2']
"""Columns that the page uses, beside those of the quantities."""
_YEAR = np.timedelta64(31_557_600_000_000, 'us')  # A year of 365.25 days
TOLERANCE_MG = 3.5
"""Largest gap of a sensor that is in order, mg. Chosen: an error of 0.2° in tilt."""
MG = mg(1.0)  # Milli-g in 1 m/s²
_VERDICTS = ('no_gap', 'explained', 'partly', 'inseparable', 'unknown')
"""Statuses of recordings whose effects are judged."""
RECENT = 5
"""Number of recordings whose median is the gap of a sensor now. Chosen: one odd one is no gap."""
DAYS_PER_YEAR = 365.25
_FARTHEST_DAYS = 10 * DAYS_PER_YEAR
"""A drift that needs longer is no matter of urgency. Chosen: the life of a robot."""


@dataclass(frozen=True)
class FleetQuantity:
    """A quantity of the table."""

    column: str  # Column of its value; the quantity is named by it
    label: str  # Its name for people
    shown_unit: str  # Unit on the page
    factor: float  # Factor from the column's unit to that of the page
    # Column of its standard deviation, or columns of both ends of its 90 % interval
    error_columns: tuple[str, ...]
    is_coefficient: bool = True  # Whether the units of a fleet have a population of it
    is_noise: bool = False  # Whether it is a term of the noise, which has no tolerance in mg

    def text(self, value: float, low: float, high: float) -> str:
        """Return a difference with its interval, in the unit of the page."""

        def shown(difference: float) -> str:
            return number(self.factor * difference, True)

        return f'{shown(value)} ({shown(low)} to {shown(high)}) {self.shown_unit}'


@dataclass(frozen=True)
class FleetTable:
    """The recordings of n rows, in the order of serial numbers and dates."""

    frame: pd.DataFrame  # The columns that the page uses; a text is '' where there is none
    serials: tuple[str, ...]  # Serial numbers of the sensors, (m,)
    sensor: np.ndarray  # Number of the sensor of each row, (n,); −1 without a serial number
    years: np.ndarray  # Dates in years since 1970, (n,); NaN without a date
    # Number of the period between calibrations, (n,), which rises along the rows
    period: np.ndarray
    first: np.ndarray  # Rows whose content the sensor has not had before, (n,) bool

    def __len__(self) -> int:
        return len(self.sensor)

    def __getitem__(self, column: str) -> np.ndarray:
        return self.frame[column].to_numpy()

    def rows_of(self, sensor: int) -> np.ndarray:
        """Return the numbers of the rows of a sensor, in the order of time."""
        begin, end = np.searchsorted(self.sensor, [sensor, sensor + 1])
        return np.arange(begin, end)

    def recordings(self, quantity: FleetQuantity) -> Measured:
        """Return a quantity in the recordings that have it."""
        value = self[quantity.column]
        errors = [self[name] for name in quantity.error_columns]
        std = errors[0]
        if len(errors) == 2:
            low, high = errors
            std = (high - low) / (2 * Z_90)
        used = np.isfinite(value) & np.isfinite(self.years) & (self.sensor >= 0) & self.first
        rows = np.flatnonzero(used & np.isfinite(std) & (std >= 0))
        whole = Recordings(self.sensor, self.period, self.years, value, std)
        return Measured(quantity, rows, whole[rows])


class Measured(NamedTuple):
    """A quantity in the n recordings that have it."""

    quantity: FleetQuantity
    rows: np.ndarray  # Of the recordings in the table, (n,)
    recordings: Recordings  # Its values in the unit of its column


def read(path: AnyPath) -> FleetTable:
    """Read the columns of a table that the page uses."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    numbers = []
    for quantity in quantities(None):
        numbers += [quantity.column, *quantity.error_columns]
    try:
        frame = pq.read_table(path, columns=[*_TEXTS, *_OTHERS, *numbers]).to_pandas()
    except (OSError, KeyError, pa.ArrowException) as error:
        reason = str(error).splitlines()[0]
        raise UserError(f'{path}: not a table of `fleet`: {reason}') from None
    frame[_TEXTS] = frame[_TEXTS].astype(object).fillna('')
    frame['effects'] = [[] if names is None else list(names) for names in frame['effects']]
    frame = frame.sort_values(['serial', 'date'], kind='stable', ignore_index=True)
    serials, sensor = np.unique(frame['serial'].to_numpy(str), return_inverse=True)
    if len(serials) and not serials[0]:
        serials = serials[1:]
        sensor = sensor - 1
    date = frame['date'].dt.tz_localize(None).to_numpy('datetime64[us]')
    # A period ends where the sensor is calibrated again, and lasts where none is stated.
    named = frame['calibration_id'].mask(frame['calibration_id'] == '').groupby(sensor).ffill()
    last = named.shift()
    begins = (np.diff(sensor, prepend=-2) != 0) | (
        named.notna() & last.notna() & (named != last)
    ).to_numpy(bool)
    # A copy says nothing twice.
    first = ~frame.assign(unit=sensor).duplicated(['unit', 'hash']) | (frame['hash'] == '')
    return FleetTable(
        frame=frame,
        serials=tuple(map(str, serials)),
        sensor=sensor,
        years=(date - np.datetime64(0, 'us')) / _YEAR,
        period=np.cumsum(begins) - 1,
        first=first.to_numpy(bool),
    )


def quantities(table: FleetTable | None) -> tuple[FleetQuantity, ...]:
    """Return all quantities of a table."""
    listed = [
        FleetQuantity(
            'gap_before_mps2',
            'gap',
            'mg',
            MG,
            ('gap_before_low_mps2', 'gap_before_high_mps2'),
            is_coefficient=False,
        )
    ]
    for axis in AXES:
        scales = np.zeros(0) if table is None else table[f'scale_{axis}_v_per_g']
        scales = scales[scales > 0]
        mg_per_v = 1e3 / float(np.median(scales)) if len(scales) else 1e3
        listed += [
            FleetQuantity(
                f'zero_g_{axis}_v', f'zero-g {axis}', 'mg', mg_per_v, (f'zero_g_std_{axis}_v',)
            ),
            FleetQuantity(
                f'scale_{axis}_v_per_g',
                f'scale factor {axis}',
                'mg/g',
                mg_per_v,
                (f'scale_std_{axis}_v_per_g',),
            ),
        ]
    for (letter, label, unit, shown), axis in product(NOISE, AXES):
        of_axis = f'{axis}_{unit}'
        # The unit of the files begins with that of an acceleration.
        listed.append(
            FleetQuantity(
                f'noise_{letter}_{of_axis}',
                f'{label}, {axis}',
                shown.replace('m/s²', 'µg', 1),
                1e3 * MG,
                (f'noise_{letter}_low_{of_axis}', f'noise_{letter}_high_{of_axis}'),
                is_coefficient=False,
                is_noise=True,
            )
        )
    return tuple(listed)


@dataclass(frozen=True)
class QuantityResult:
    """A quantity over the k sensors that have it, in n recordings."""

    quantity: FleetQuantity  # The quantity
    rows: np.ndarray  # Rows of the recordings in the table, (n,)
    recordings: Recordings  # Its values in the unit of its column
    # Distance of each recording from those of its sensor, robust standard deviations, (n,)
    distance: np.ndarray
    # Recordings that are too far from the others of their sensor, (n,) bool. They do not count.
    is_outlier: np.ndarray
    sensors: np.ndarray  # Numbers of the sensors, (k,)
    trends: Trends  # Levels and slopes of the sensors
    # Slopes that survive the control of the false discovery rate over all sensors and quantities,
    # (k,) bool
    is_claimed: np.ndarray
    half_width: np.ndarray  # Half of the interval of each slope, (k,)
    # Mean and spread over the sensors, None where they are too few; those of one batch that are
    # not of this population
    population: PooledCoefficient | None
    batch: populations.BadBatch | None

    def place_of(self, sensor: int) -> int | None:
        """Return where a sensor stands among those of the quantity; None if it is not there."""
        place = int(np.searchsorted(self.sensors, sensor))
        return place if place < len(self.sensors) and self.sensors[place] == sensor else None


def analyse(table: FleetTable) -> list[QuantityResult]:
    """Return the results of all quantities that the table has."""
    measured = [table.recordings(quantity) for quantity in quantities(table)]
    measured = [each for each in measured if len(each.rows)]
    values = sum(len(each.rows) for each in measured)
    # Each sensor has each coefficient: the chance of a false outlier is shared by them all.
    coefficients = sum(each.quantity.is_coefficient for each in measured) * len(table.serials)
    results = []
    for quantity, rows, recordings in measured:
        distance, is_outlier = outliers(recordings, values)
        trends = fit_trends(recordings[~is_outlier])
        sensors = np.unique(table.sensor[rows[~is_outlier]])
        population = None
        batch = None
        if quantity.is_coefficient and len(sensors) >= populations.MIN_SENSORS:
            batch = populations.bad_batch(
                [table.serials[sensor] for sensor in sensors],
                trends.level,
                TOLERANCE_MG / quantity.factor,
                len(measured),
            )
            usual = slice(None) if batch is None else ~batch.members
            population = populations.random_effects(
                trends.level[usual], trends.level_std[usual], coefficients
            )
        none = np.zeros(len(sensors), bool)
        results.append(
            QuantityResult(
                quantity=quantity,
                rows=rows,
                recordings=recordings,
                distance=distance,
                is_outlier=is_outlier,
                sensors=sensors,
                trends=trends,
                is_claimed=none,
                half_width=np.zeros(len(sensors)),
                population=population,
                batch=batch,
            )
        )
    if not results:
        return []
    # The false discovery rate is controlled over all slopes together.
    is_claimed = claims(np.concatenate([r.trends.p_values for r in results]))
    factor = interval_factor(np.concatenate([r.trends.freedom for r in results]), is_claimed)
    splits = np.cumsum([len(result.sensors) for result in results])[:-1]
    return [
        replace(result, is_claimed=claimed, half_width=factors * result.trends.slope_std)
        for result, claimed, factors in zip(
            results, np.split(is_claimed, splits), np.split(factor, splits)
        )
    ]


def effect_matrix(table: FleetTable) -> pd.DataFrame:
    """
    Return the share of the recordings of each sensor in which each effect is named.

    The rows are the numbers of the sensors with a verdict, the columns the effects, the most
    frequent first.
    """
    used = np.isin(table['status'].astype(str), _VERDICTS) & (table.sensor >= 0) & table.first
    frame = table.frame[used]
    sensor = table.sensor[used]
    counts = Counter(chain.from_iterable(frame['effects']))
    effects = sorted(counts, key=lambda name: (-counts[name], name))
    has = pd.DataFrame(
        [[name in names for name in effects] for names in frame['effects']],
        columns=effects,
        dtype=float,
    )
    return has.groupby(sensor).mean()


class Condition(IntEnum):
    """State of a sensor; the most urgent is the least."""

    OUT_OF_TOLERANCE = 1
    DRIFTS = 2
    NOT_JUDGED = 3
    IN_ORDER = 4

    @property
    def words(self) -> str:
        """Return the state for people."""
        return self.name.replace('_', ' ').lower()

    @property
    def colour(self) -> str:
        """Return the colour of the badge of a sensor."""
        return ('red', 'amber', 'amber', 'green')[self - 1]


class Drift(NamedTuple):
    """A claimed slope of a sensor."""

    result: QuantityResult  # Its quantity
    text: str  # The slope with its interval, for people
    days: float  # Days until the sensor is out of its tolerance; infinite if it never is
    # Gap now, or the drift since the calibration where there is no gap; NaN if days are infinite
    reached_mg: float
    is_rising_noise: bool  # Whether it is of a noise that grows, for which there is no tolerance


@dataclass(frozen=True)
class SensorState:
    """One sensor; its texts are for people."""

    urgency: float  # Its rank among the units of its state; the least is the most urgent
    number: int  # Its number
    serial: str  # Its serial number
    state: Condition  # Its state
    reason: str  # Why it has this state, in one sentence; empty for none
    drifts: tuple[Drift, ...]  # Its claimed slopes, the most urgent first
    gap: str  # Median of its last gaps and of their noise floors, mg
    recordings: str  # Number of its recordings, and of those that are refused or crashed
    age: str  # Age of its calibration at the last recording, days
    last_year: float  # Date of its last recording, years since 1970; NaN without a date
    report: str  # Folder of the single reports of its last recording; empty for none


def rank(table: FleetTable, results: Sequence[QuantityResult]) -> list[SensorState]:
    """Return all sensors, the most urgent first."""
    states = [_state_of(sensor, table, results) for sensor in range(len(table.serials))]
    return sorted(states, key=lambda sensor: (sensor.state, sensor.urgency, sensor.serial))


def _state_of(sensor: int, table: FleetTable, results: Sequence[QuantityResult]) -> SensorState:
    """Return a sensor with the first state that fits."""
    rows = table.rows_of(sensor)
    gap = _gap_now(table, rows)
    ages = table['calibration_age_days'][rows]
    age_days = float(next((age for age in ages[::-1] if np.isfinite(age)), np.nan))
    drifts = _drifts(sensor, results, gap.over_mg, age_days)
    refused = table['outcome'][rows] != 'done'
    judged = _by_gap(gap) or _by_drifts(drifts) or _by_refusals(table, rows, refused)
    return SensorState(
        urgency=judged.urgency,
        number=sensor,
        serial=table.serials[sensor],
        state=judged.state,
        reason=judged.reason[:1].upper() + judged.reason[1:],
        drifts=drifts,
        gap=f'{number(gap.gap_mg)} / {number(gap.floor_mg)}' if np.isfinite(gap.gap_mg) else '-',
        recordings=f'{len(rows)} ({refused.sum()})',
        age=f'{age_days:.0f}' if np.isfinite(age_days) else '-',
        last_year=float(table.years[rows[-1]]),
        report=next((text for text in table['report'][rows[::-1]] if text), ''),
    )


class _Judged(NamedTuple):
    """The state of a sensor, and why."""

    state: Condition
    urgency: float  # Sensors of a state with smaller ones come first
    reason: str


def _by_gap(gap: _GapNow) -> _Judged | None:
    """Judge a sensor by its last gap; None where that is within the tolerance."""
    if not gap.over_mg > TOLERANCE_MG:
        return None
    return _Judged(
        Condition.OUT_OF_TOLERANCE,
        -gap.over_mg,
        f'Gap {number(gap.gap_mg)} mg, noise {number(gap.floor_mg)} mg; the tolerance is '
        f'{number(TOLERANCE_MG)} mg.',
    )


def _by_drifts(drifts: Sequence[Drift]) -> _Judged | None:
    """Judge a sensor by its drifts, the most urgent first; None where none matters."""
    if drifts and drifts[0].days < _FARTHEST_DAYS:
        days = drifts[0].days
        text = f'{drifts[0].text}: out of tolerance '
        if days:
            return _Judged(Condition.DRIFTS, days, f'{text}in {number(days, digits=2)} days.')
        return _Judged(Condition.OUT_OF_TOLERANCE, -drifts[0].reached_mg, f'{text}now.')
    rising = [drift.text for drift in drifts if drift.is_rising_noise]
    return _Judged(Condition.DRIFTS, _FARTHEST_DAYS, f'{rising[0]}.') if rising else None


def _by_refusals(table: FleetTable, rows: np.ndarray, refused: np.ndarray) -> _Judged:
    """Judge a sensor whose recordings show nothing wrong by those that were refused, (n,) bool."""
    series = len(refused) if refused.all() else int(np.argmin(refused[::-1]))
    if not series:
        return _Judged(Condition.IN_ORDER, 0.0, '')
    why = table['refusal'][rows[-1]] or table['outcome'][rows[-1]]
    reason = f'Refused, {counted(series, "recording")} in a row: {why}'
    return _Judged(Condition.NOT_JUDGED, -series, reason)


class _GapNow(NamedTuple):
    """The last gap of a sensor, mg; NaN without any."""

    gap_mg: float  # The gap
    floor_mg: float  # Its noise floor
    over_mg: float  # The gap beyond the floor


def _gap_now(table: FleetTable, rows: np.ndarray) -> _GapNow:
    """Return the gap over the last recordings since a calibration."""
    rows = rows[table.period[rows] == table.period[rows[-1]]]
    rows = rows[np.isfinite(table['gap_before_mps2'][rows])][-RECENT:]
    if not len(rows):
        return _GapNow(np.nan, np.nan, np.nan)
    gap = float(np.median(table['gap_before_mps2'][rows])) * MG
    floors = table['gap_floor_mps2'][rows]
    floor = float(np.nanmedian(floors)) * MG if np.isfinite(floors).any() else 0.0
    return _GapNow(gap, floor, float(np.sqrt(max(gap**2 - floor**2, 0.0))))


def _drifts(
    sensor: int, results: Sequence[QuantityResult], over_mg: float, age_days: float
) -> tuple[Drift, ...]:
    """Return the claimed slopes of a sensor, the most urgent first."""
    drifts = []
    for result in results:
        place = result.place_of(sensor)
        quantity = result.quantity
        if place is None or not result.is_claimed[place]:
            continue
        slope = float(result.trends.slope[place])
        half = float(result.half_width[place])
        text = f'{quantity.label} {quantity.text(slope, slope - half, slope + half)} per year'
        days = np.inf
        reached_mg = np.nan
        if quantity.is_coefficient or (slope > 0 and not quantity.is_noise):
            # A coefficient is right at its calibration, and the gap shows what it is now.
            mg_per_day = abs(quantity.factor * slope) / DAYS_PER_YEAR
            reached_mg = over_mg if np.isfinite(over_mg) else mg_per_day * np.nan_to_num(age_days)
            days = max(TOLERANCE_MG - reached_mg, 0.0) / mg_per_day
        drifts.append(Drift(result, text, days, reached_mg, quantity.is_noise and slope > 0))
    return tuple(sorted(drifts, key=lambda drift: drift.days))
