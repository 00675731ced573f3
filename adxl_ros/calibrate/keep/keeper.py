# SPDX-License-Identifier: Apache-2.0

"""
The keeper: takes rests of a sensor at work, and decides when a changed calibration is adopted.

At rest the force has the length of gravity. Its direction is not used, because the ground may
slope; only changes within a stay, in which the robot does not move, are. So a level robot shows
zero-g and scale factor of its vertical axis as one sum, and how the zero-g of each axis follows
the temperature. A robot that also rests on its sides shows more.

A calibration is adopted when stays that were held out of the estimate fit it better than the one
in use, and if age and temperature explain the change. A rest that neither explains is not learnt.
Several of them with the same side up, or one that is as improbable, are a change of the sensor.
It is reported, and nothing is learnt any more. Of an axis that no rest has up or down, which would
not show it, the slope over temperature alone is adopted.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import NamedTuple

from adxl_ros.calibrate.keep.belief import Belief, LARGEST_DRIFT, SeenRest
from adxl_ros.calibrate.keep.prior import EFFECTS, KeptSensor, Linear
from adxl_ros.errors import UserError
from adxl_ros.files.calibration_store import calibration_id, date_of
from adxl_ros.files.sweep_journal import Adopted, JournalEntry, NaturalRest, Undone
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.error_sizes import stds, variances_of
from adxl_ros.model.sensor import get, put, Sensor
from adxl_ros.report.quantities import utc
import numpy as np
import scipy

DAY_NS = 86_400 * 10**9
NORMAL_90 = 1.645  # Half of a 90 % interval, standard deviations
_HELD_OUT = 4  # One stay of so many is held out; chosen: a fifth to a third is usual
_FEWEST_HELD_OUT = 8  # Fewest stays that may decide; chosen: their scatter is known to a quarter
_MOST_HELD_OUT = 400  # Most stays that are kept for that; chosen: some weeks
_SURE = 0.99  # Confidence with which held-out stays must improve
_IMPLAUSIBLE = 3e-4
"""Probability below which a rest is not learnt; chosen: one false rest in months."""
_REJECTED = 2
"""Rests in succession along one axis that are a change, or one that is as improbable as so many.
Chosen: no single accident."""
_UNEXPLAINED = 1e-3  # Probability below which age and temperature do not explain a change
KEPT = 'kept'
"""Key of the provenance that says how a calibration was adopted."""


@dataclass(frozen=True)
class KeepSettings:
    """What a user states of the sensor."""

    drift_mg_per_year: float = 5.0  # Usual drift of the zero-g in a year, mg


@dataclass
class _Rejection:
    """Rests along one axis that were not learnt, since the last one that was."""

    since_ns: int  # Stamp of the first
    departures_g: list[float] = field(default_factory=list)  # Along the axis
    chance: float = 1.0  # Product of their probabilities
    returned: int = 0  # Rests in succession that read again as before a change

    @property
    def is_change(self) -> bool:
        """Return whether no single accident explains them."""
        return self.chance < _IMPLAUSIBLE**_REJECTED

    @property
    def size_g(self) -> float:
        """Return their median departure, g."""
        return float(np.median(self.departures_g))


class _Departure(NamedTuple):
    """How far a rest is from the prediction."""

    axis: str  # The axis that it is of
    along_g: float  # Along this axis, g


@dataclass
class _Stay:
    """The present stay."""

    number: int  # As the stream counts it
    up_g: np.ndarray  # Force of its first rest, which gives the direction, (m,)
    basis: np.ndarray  # Directions in which it may turn, (m, q)
    is_held_out: bool
    belief: Belief  # With the direction of this stay; of a stay that is held out, with its rests
    rests: list[SeenRest] = field(default_factory=list)


@dataclass(frozen=True)
class KeptState:
    """What is known now."""

    age_days: float  # Since the date of the calibration in use; NaN without a date
    temperature_c: float  # Temperature of the figures, °C
    zero_g_mg: tuple[float, ...]  # Departure of each zero-g from the one in use, mg, (m,)
    total_mg: tuple[float, ...]  # The same from the first calibration, mg, (m,)
    zero_g_90_mg: tuple[float, ...]  # Half of its 90 % interval, mg, (m,)
    error_90_mg: float  # Error of the acceleration that nine of ten are below, worst axis, mg
    tilt_90_deg: float  # The same of the tilt, degrees; NaN for less than three axes
    determined: tuple[str, ...]  # What the rests determine, for people
    rests_a_day: dict[str, int]  # Rests of the last day by the side that is up
    held_out: int  # Stays that are held out since the last adoption
    adopted_ns: int  # Stamp of the last adoption, ns; 0 without one
    changed: str  # What has changed beyond age and temperature, '' if nothing has
    proposal: str  # What would be adopted, and is not in a dry run; '' if nothing


class ZeroG(NamedTuple):
    """A zero-g."""

    value: float  # Beyond the nominal one, mg
    half_width: float  # Half of its 90 % interval, mg


class Keeper:
    """Keeps one calibration."""

    def __init__(
        self,
        sensor: Sensor,
        settings: KeepSettings = KeepSettings(),
        entries: Sequence[JournalEntry] = (),
        write: Callable[[JournalEntry], None] = lambda _: None,
        may_adopt: bool = True,
    ) -> None:
        """
        Begin with a calibration, or go on after the entries of its journal.

        write: puts an entry on disk before it counts; may_adopt: False for a dry run.
        """
        self.settings = settings
        self._write = write
        self._may_adopt = may_adopt
        self.adoptions: list[Adopted] = []
        self.before: list[Sensor] = []  # Calibrations before each adoption
        self._newest: deque[tuple[int, str]] = deque()  # Stamps and sides of the last day's rests
        self._temperatures_c = [np.inf, -np.inf]
        self.newest_ns = 0
        self.last_temperature_c = np.nan
        self._decides = False  # Whether to decide now, after the last rest
        self._begin(sensor)
        for entry in entries:
            self._take(entry)

    def add(self, rest: NaturalRest) -> Adopted | None:
        """Take a rest; return what is adopted because of it."""
        if not np.isfinite([*rest.mean_v, *rest.std_v, rest.temperature_c]).all():
            return None
        self._write(rest)
        self._take(rest)
        adopted = self._adoption() if self._decides else None
        if adopted is None:
            return None
        self._proposal = self._describe(np.array(adopted.values))
        if not self._may_adopt:
            return None
        self._write(adopted)
        self._take(adopted)
        return adopted

    def undo(self, now_ns: int) -> None:
        """Go back to the calibration before the last adoption."""
        if not self.before:
            raise UserError('nothing to undo: no calibration was adopted')
        entry = Undone(now_ns)
        self._write(entry)
        self._take(entry)

    @property
    def sensor(self) -> Sensor:
        """Return the calibration in use, with what is known of its error now."""
        mean, covariance = self._stay_free.moments
        return replace(self._kept.sensor, covariance=covariance + np.outer(mean, mean))

    def _begin(self, sensor: Sensor) -> None:
        """Begin from a calibration alone."""
        self._use(KeptSensor.of(sensor))
        prior = self._kept.prior(self.settings.drift_mg_per_year * 1e-3)
        self._per_day = prior.per_day
        directions = 2 if sensor.axes == AXES else len(sensor.axes)
        self._belief = Belief.prior(prior.known, prior.drifting, directions)
        self._original = self._kept.values
        self._allowed = prior.known + LARGEST_DRIFT**2 * prior.drifting
        self._calibrated_at_c = self._kept.calibrated_at_c
        self._unlearnt = self._belief.moments[1]
        date = date_of(sensor)
        self._time_ns = 0 if date is None else int(date.timestamp() * 1e9)
        self._forget_tests()

    def _use(self, kept: KeptSensor) -> None:
        self._kept = kept
        self._linear = Linear(kept)

    def _forget_tests(self) -> None:
        """Begin anew with what tests the calibration in use."""
        self._stay: _Stay | None = None
        self._held: deque[_Stay] = deque(maxlen=_MOST_HELD_OUT)
        self._stays = 0
        self._rejections: dict[str, _Rejection] = {}
        self._unexplained = ''
        self._proposal = ''
        self._decided_ns = 0

    @property
    def _stay_free(self) -> Belief:
        """Return what is known, without the rests of a stay that is held out."""
        stay = self._stay
        return self._belief if stay is None or stay.is_held_out else stay.belief

    def _take(self, entry: JournalEntry) -> None:
        """Count an entry, new or from the journal."""
        if isinstance(entry, NaturalRest):
            self._take_rest(entry)
            self._decides = self._is_due(entry.stop_ns)
        elif isinstance(entry, Adopted):
            self._exchange(entry)
        elif isinstance(entry, Undone):
            self._begin(self.before.pop())
            self.adoptions.pop()
            self._time_ns = entry.undone_ns

    def _take_rest(self, rest: NaturalRest) -> None:
        temperature_c = rest.temperature_c
        force_g = self._linear.force_g(np.array(rest.mean_v), temperature_c)
        if not np.isfinite(force_g).all():
            return
        self._age(rest.start_ns)
        self.newest_ns = rest.stop_ns
        self.last_temperature_c = temperature_c
        self._newest.append((rest.stop_ns, _side(force_g)))
        measured_g = self._linear.measured(force_g)
        stay = self._stay
        if stay is None or stay.number != rest.stay:
            stay = self._arrive(rest.stay, measured_g)
        errors = self._linear.errors(force_g, temperature_c)
        noise_g2 = errors.by_volts**2 @ np.array(rest.std_v) ** 2
        seen = SeenRest(measured_g - stay.up_g, errors.by_coefficients, stay.basis, noise_g2)
        first_freedom = len(measured_g) - self._belief.directions
        found = stay.belief.innovation(seen, len(measured_g) if stay.rests else first_freedom)
        if found.plausibility < _IMPLAUSIBLE and stay.rests:
            # The robot has moved without a motion that was seen: a new stay.
            stay = self._arrive(rest.stay, measured_g)
            seen = seen._replace(residual_g=measured_g - stay.up_g, basis=stay.basis)
            found = stay.belief.innovation(seen, first_freedom)
        departure = self._departure(stay.belief.weight @ found.departure_g, force_g)
        is_rejected = self._is_rejected(departure, found.plausibility, rest.start_ns)
        if is_rejected or self._knocked:
            # After a knock, rests in other directions would show it as a drift.
            self._stay = None
            return
        low, high = self._temperatures_c
        self._temperatures_c = [min(low, temperature_c), max(high, temperature_c)]
        stay.rests.append(seen)
        stay.belief = stay.belief.learnt(found)
        if not stay.is_held_out:
            self._belief = stay.belief

    def _departure(self, departure_g: np.ndarray, force_g: np.ndarray) -> _Departure:
        """Return the departure of a force, g, (3,), along the axis that it is of."""
        if len(departure_g) == len(AXES):
            upright = int(np.abs(force_g).argmax())
            sign = 1 if force_g[upright] > 0 else -1
            return _Departure(AXES[upright], sign * float(departure_g @ force_g))
        # Less axes do not show which side is up: the one that departs most.
        largest = int(np.abs(departure_g).argmax())
        return _Departure(self._kept.sensor.axes[largest], float(departure_g[largest]))

    def _is_rejected(self, departure: _Departure, plausibility: float, stamp_ns: int) -> bool:
        """Return whether a rest is not learnt, by its departure from the prediction."""
        axis, along_g = departure
        earlier = self._rejections.get(axis)
        if earlier is not None and earlier.is_change:
            # It stays until rests read again as before.
            has_returned = abs(along_g) < abs(earlier.size_g) / 4
            earlier.returned = earlier.returned + 1 if has_returned else 0
            if earlier.returned < _REJECTED:
                return True
        elif plausibility < _IMPLAUSIBLE:
            if earlier is None or earlier.departures_g[-1] * along_g < 0:
                earlier = self._rejections[axis] = _Rejection(stamp_ns)
            earlier.departures_g.append(along_g)
            earlier.chance *= plausibility
            return True
        self._rejections.pop(axis, None)
        return False

    def _age(self, stamp_ns: int) -> None:
        """Let time pass until a stamp."""
        days = max(stamp_ns - self._time_ns, 0) / DAY_NS if self._time_ns else 0.0
        self._time_ns = stamp_ns
        self._belief = self._belief.aged(self._per_day, days)
        if self._stay is not None:
            self._stay.belief = self._stay.belief.aged(self._per_day, days)
        growth = np.diag(self._per_day * days)
        self._allowed += LARGEST_DRIFT**2 * growth
        self._unlearnt += growth
        while self._newest and self._newest[0][0] < stamp_ns - DAY_NS:
            self._newest.popleft()

    def _arrive(self, number: int, measured_g: np.ndarray) -> _Stay:
        """Begin a stay with the force of its first rest."""
        if self._stay is not None and self._stay.is_held_out and self._stay.rests:
            self._held.append(self._stay)
        is_held_out = self._stays % _HELD_OUT == _HELD_OUT - 1
        self._stays += 1
        up_g = measured_g
        basis = np.eye(len(measured_g))
        if len(measured_g) == len(AXES):
            up = measured_g / np.linalg.norm(measured_g)
            up_g = up * self._gravity_g
            basis = _across(up).T
        stay = _Stay(number, up_g, basis, is_held_out, self._belief.moved())
        self._stay = stay
        return stay

    @property
    def _gravity_g(self) -> float:
        return self._kept.sensor.local_gravity_mps2 / G0_MPS2

    def _is_due(self, stamp_ns: int) -> bool:
        """Return whether to decide now: once a day, and never after a change."""
        if self.changed or len(self._held) < _FEWEST_HELD_OUT:
            return False
        is_due = stamp_ns - self._decided_ns >= DAY_NS
        self._decided_ns = stamp_ns if is_due else self._decided_ns
        return is_due

    def _adoption(self) -> Adopted | None:
        """Decide whether held-out stays want another calibration."""
        change = self._sure_change()
        if not change.any():
            return None
        gains_g2 = np.array(
            [_misfit_g2(stay, 0 * change) - _misfit_g2(stay, change) for stay in self._held]
        )
        count = len(gains_g2)
        error_g2 = gains_g2.std(ddof=1) / np.sqrt(count)
        if gains_g2.mean() <= scipy.special.stdtrit(count - 1, _SURE) * error_g2:
            return None
        if not self._is_explained(change):
            self._unexplained = (
                f'changed: {self._describe(self._kept.values + change)}, which age and '
                'temperature do not explain: knocked, or broken?'
            )
            return None
        return Adopted(
            stamp_ns=self.newest_ns, values=tuple((self._kept.values + change).tolist())
        )

    def _is_explained(self, change: np.ndarray) -> bool:
        """Return whether age and temperature explain all that changed since the calibration."""
        total = self._kept.values + change - self._original
        designs = self._held_designs()
        square_g2 = ((designs @ total) ** 2).mean(axis=0)
        spread = np.einsum('kij,jl,kil->ki', designs, self._allowed, designs)
        quantile = scipy.special.ndtri(1 - _UNEXPLAINED / 2)
        return bool((square_g2 <= quantile**2 * spread.mean(axis=0)).all())

    def _sure_change(self) -> np.ndarray:
        """
        Return the change of the coefficients of those axes that it surely improves, (p,).

        With δ ~ N(m, P), a change c takes 2·cᵀHᵀHδ − |Hc|² from the squared error of the rests H.
        That is positive with the confidence `_SURE`, or the axis stays as it is. Of an axis that
        no rest has had up or down, a knock would not be noticed. So its zero-g stays as calibrated
        at the temperature of the calibration, and changes with temperature alone.
        """
        mean, covariance = self._belief.moments
        designs = self._held_designs()
        upright = set()
        if self._kept.sensor.axes == AXES:
            upright = {int(np.abs(stay.up_g).argmax()) for stay in self._held}
        zero_g = self._kept.rows('bias', 'offset_v')
        scale = self._kept.rows('scale_factor', 'offset_v_per_g')
        at_calibration = self._linear.zero_g(self._calibrated_at_c)
        sure = np.zeros_like(mean)
        for number, axis in enumerate(self._kept.sensor.axes):
            rows = [row for row, name in enumerate(self._kept.names) if _is_kept(name, axis)]
            change = np.zeros_like(mean)
            change[rows] = mean[rows]
            if number not in upright:
                change[[zero_g[number], scale[number]]] = 0.0
                left_g = at_calibration[number] @ change
                change[zero_g[number]] = -left_g / at_calibration[number, zero_g[number]]
            design = designs[:, number]
            errors_g = design @ change
            slope = 2 * errors_g @ design
            gain_g2 = slope @ mean - errors_g @ errors_g
            if gain_g2 > scipy.special.ndtri(_SURE) * np.sqrt(slope @ covariance @ slope):
                sure += change
        return sure

    def _held_designs(self) -> np.ndarray:
        """Return what the coefficients do to each rest that is held out, (k, m, p)."""
        rests = chain.from_iterable(stay.rests for stay in self._held)
        return np.array([rest.design for rest in rests])

    def _describe(self, values: np.ndarray) -> str:
        """Return the change of each zero-g at the last temperature, for people."""
        change = values - self._kept.values
        rows = self._linear.zero_g(self.last_temperature_c)
        return by_axis(self._kept.sensor.axes, 1e3 * rows @ change)

    def _exchange(self, adopted: Adopted) -> None:
        """Use adopted coefficients from here on."""
        before = self._kept
        _, covariance = self._belief.moments
        self.before.append(self.sensor)
        self.adoptions.append(adopted)
        sensor = put(before.sensor, before.names, adopted.values)
        low, high = sensor.envelope.temperature_c or self._temperatures_c
        kept_from = before.sensor.provenance.get(KEPT) or calibration_id(before.sensor)
        provenance = {key: text for key, text in before.sensor.provenance.items() if key != 'id'}
        self._use(
            KeptSensor(
                replace(
                    sensor,
                    covariance=covariance,
                    # The slope over temperature has an uncertainty of its own now.
                    envelope=replace(
                        sensor.envelope,
                        temperature_c=(
                            min(low, self._temperatures_c[0]),
                            max(high, self._temperatures_c[1]),
                        ),
                        zero_g_per_k=0.0,
                    ),
                    provenance={
                        **provenance,
                        'date': utc(adopted.stamp_ns).isoformat(timespec='seconds'),
                        KEPT: kept_from,
                    },
                )
            )
        )
        self._belief = self._belief.shifted(get(sensor, before.names) - before.values)
        self._unlearnt = covariance.copy()
        self._forget_tests()
        self._decided_ns = adopted.stamp_ns

    @property
    def changed(self) -> str:
        """Return what has changed beyond age and temperature, '' if nothing has."""
        for axis in self._knocked:
            rejection = self._rejections[axis]
            return (
                f'changed: {1e3 * rejection.size_g:+.2g} mg on {axis} since '
                f'{utc(rejection.since_ns):%A %Y-%m-%dT%H:%MZ}: knocked, or broken?'
            )
        return self._unexplained

    @property
    def _knocked(self) -> list[str]:
        """Return the axes with a change of the sensor."""
        return [axis for axis, found in self._rejections.items() if found.is_change]

    def state(self, now_ns: int, temperature_c: float | None = None) -> KeptState:
        """Return what is known at a time and a temperature; by default, that of the last rest."""
        if temperature_c is None or not np.isfinite(temperature_c):
            temperature_c = self.last_temperature_c
        if not np.isfinite(temperature_c):
            temperature_c = self._kept.calibrated_at_c
        days = max(now_ns - self._time_ns, 0) / DAY_NS if self._time_ns else 0.0
        belief = self._stay_free.aged(self._per_day, days)
        mean, covariance = belief.moments
        rows = self._linear.zero_g(temperature_c)
        zero_g = rows @ mean
        std = np.sqrt(variances_of(rows, covariance))
        total = rows @ (self._kept.values + mean - self._original)
        up = self._upright()
        error = self._linear.errors(up, temperature_c).by_coefficients
        spread = error @ (covariance + np.outer(mean, mean)) @ error.T
        tilt_rad = np.nan
        if len(spread) == len(AXES):
            across = _across(up)
            tilt_rad = np.sqrt(np.linalg.eigvalsh(across @ spread @ across.T).max())
        date = date_of(self._kept.sensor)
        unlearnt = variances_of(rows, self._unlearnt)
        return KeptState(
            age_days=np.nan if date is None else (now_ns * 1e-9 - date.timestamp()) / 86_400,
            temperature_c=temperature_c,
            zero_g_mg=tuple((1e3 * zero_g).tolist()),
            total_mg=tuple((1e3 * total).tolist()),
            zero_g_90_mg=tuple((1e3 * NORMAL_90 * std).tolist()),
            error_90_mg=float(1e3 * NORMAL_90 * stds(spread).max()),
            tilt_90_deg=float(np.degrees(NORMAL_90 * tilt_rad)),
            determined=self._determined(std**2, unlearnt),
            rests_a_day=dict(Counter(side for _, side in self._newest)),
            held_out=len(self._held),
            adopted_ns=self.adoptions[-1].stamp_ns if self.adoptions else 0,
            changed=self.changed,
            proposal=self._proposal,
        )

    def zero_g_mg(self, temperature_c: float) -> list[ZeroG]:
        """Return the zero-g of the calibration in use at a temperature, by axis, as known now."""
        mean, covariance = self._stay_free.moments
        rows = self._linear.zero_g(temperature_c)
        values = rows @ (self._kept.values + mean)
        std = np.sqrt(variances_of(rows, covariance))
        return [ZeroG(*pair) for pair in zip(1e3 * values, 1e3 * NORMAL_90 * std)]

    def _upright(self) -> np.ndarray:
        """Return the direction of the present stay, (3,); up without one or with less axes."""
        stay = self._stay
        if stay is None or len(stay.up_g) < len(AXES):
            return np.array([0.0, 0.0, 1.0])
        return stay.up_g / np.linalg.norm(stay.up_g)

    def _determined(self, variance: np.ndarray, unlearnt: np.ndarray) -> tuple[str, ...]:
        """Say of each axis whether rests determine its zero-g, and which sum they show."""
        texts = [
            f'zero-g {axis}: {"by rests" if now < before / 4 else "as calibrated, and ageing"}'
            for axis, now, before in zip(self._kept.sensor.axes, variance, unlearnt)
        ]
        sides = {side for _, side in self._newest}
        for axis in AXES if len(self._kept.sensor.axes) == len(AXES) else ():
            if len(sides & {f'+{axis}', f'−{axis}'}) == 1:
                texts.append(f'only the sum of zero-g and scale factor of {axis} is seen')
        return tuple(texts)


def by_axis(axes: str, values_mg: Iterable[float]) -> str:
    """Return values by axis, mg, as text."""
    return ', '.join(f'{axis} {value:+.2g} mg' for axis, value in zip(axes, values_mg))


def _side(force_g: np.ndarray) -> str:
    """Return which side is up: +x, −z."""
    axis = int(np.abs(force_g).argmax())
    return ('+' if force_g[axis] > 0 else '−') + AXES[axis]


def _across(up: np.ndarray) -> np.ndarray:
    """Return two unit vectors across a direction, (2, 3)."""
    _, _, directions = np.linalg.svd(up[None])
    return np.asarray(directions[1:])


def _is_kept(name: Coefficient, axis: str) -> bool:
    """Return whether a coefficient is one that adoptions change, and of an axis."""
    return name.effect in EFFECTS and name.axis == axis


def _misfit_g2(stay: _Stay, change: np.ndarray) -> float:
    """Return the mean square of what a change of the coefficients leaves of a stay, g²."""
    left = np.array([rest.residual_g - rest.design @ change for rest in stay.rests])
    turned = (left @ stay.basis).mean(axis=0) @ stay.basis.T
    return float(((left - turned) ** 2).sum(axis=1).mean())
