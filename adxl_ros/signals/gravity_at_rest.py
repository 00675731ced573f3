# SPDX-License-Identifier: Apache-2.0

"""
The length of gravity over the rests of a sensor, and what explains it where it is not gravity's.

A sensor at rest reads r = (1 + s)·f + b, where f has the length of gravity g, and zero-g error b
and scale error s are within the tolerance of the sensor. Readings are sound if some b and s within
the tolerance give all rests the length g. Where none do, the errors that change the length are
tried: another unit on all axes or on some, and gravity that was taken away. Two axes show less
than g in most poses, so that they have an upper limit only.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from enum import Enum
from itertools import product
from typing import Any, NamedTuple

from adxl_ros.errors import UserError
from adxl_ros.model import signal_chain
from adxl_ros.model.constants import AXES, G0_MPS2, TINY
from adxl_ros.model.effects.base import NOMINAL_ENVIRONMENT
from adxl_ros.model.sensor import Sensor, to_nominal_mps2
from adxl_ros.report.quantities import counted, number
from adxl_ros.signals.reading_units import AXIS_UNITS, READING_UNITS, ReadingUnit
from adxl_ros.signals.tolerances import calibrated_tolerance, nominal_tolerance, Tolerance
from adxl_ros.wording import option
import numpy as np

_NOISE_STDS = 5.0  # Largest error of a mean by noise, in its standard deviations
_LOCAL_MPS2 = 0.03  # Half of the range of gravity on Earth, 9.78 to 9.83 m/s², rounded up
_LARGEST_FALSE_SHARE = 0.25
"""Share of the rests that may be none, as a vehicle in a steady curve is: that of the outliers
which a fit against gravity may leave out."""
_CORRECTABLE = 2.0
"""Zero-g and scale errors, in tolerances, that rests may have in common. Chosen: a sensor beyond
its datasheet has a large error, and its rests still do not contradict each other."""
_LEAST_MPS2 = 1e-6  # Least zero-g error and length, m/s², so that they can be divisors
_STEPS = 20  # Most steps of that search. Chosen: it has converged after some
_PRIOR = 1.0  # Information about each share of a tolerance: its standard deviation is all of it
_LARGEST_ERROR = 0.2
"""Error of a length, by gravity, with which it tells no unit: counts of 1 g differ by factors of
two, so that errors of up to 0.41 would still tell them apart; half of it leaves room for the
scatter of the rests."""
_MOST_RESTS = 300  # Rests that are compared at most, evenly spread. Chosen: some milliseconds
TURNED_COS = 0.9  # Cosine between the directions of two rests of different poses: 26°
_ALIKE = 0.04  # Logarithm of the ratio of two units that a usual zero-g makes alike: 40 mg


class GravityFaultKind(Enum):
    """What is wrong with the length of gravity; the value names the fault of the data."""

    UNIT = 'unit'  # All axes are in another unit
    MIXED_UNITS = 'mixed_units'  # Some axes are in another unit
    REMOVED = 'gravity'  # Gravity was taken away: linear acceleration
    SCALE = 'scale'  # The length is wrong by less than a unit explains
    SPREAD = 'spread'  # The length differs from rest to rest


@dataclass(frozen=True)
class RestReadings:
    """The means of k rests on m axes."""

    mean_mps2: np.ndarray  # Readings, m/s², (k, m)
    std_mps2: np.ndarray  # Their standard deviations by noise, m/s², (k, m)

    @property
    def length_mps2(self) -> np.ndarray:
        """Length of the readings, m/s², (k,)."""
        return np.linalg.norm(self.mean_mps2, axis=1)

    @property
    def has_several_poses(self) -> bool:
        """Whether one of the rests has another direction than the first."""
        directions = self.mean_mps2 / np.maximum(self.length_mps2, TINY)[:, None]
        return bool((directions @ directions[0] < TURNED_COS).any())

    def divided(self, factors: np.ndarray | float) -> RestReadings:
        """Return the readings divided by a factor, or by one for each axis."""
        return RestReadings(self.mean_mps2 / factors, self.std_mps2 / factors)


@dataclass(frozen=True)
class GravityFault:
    """Why the rests do not read gravity."""

    kind: GravityFaultKind  # What is wrong
    reason: str  # The figure, and what explains it
    remedy: str  # What to do
    unit: str = ''  # The likely unit, for people; '' where none explains the readings
    symbol: str = ''  # The name of that unit in parameters; '' where they do not have it
    factor: float = np.nan  # What the readings are to be multiplied by; NaN if it is not known

    @property
    def is_unit(self) -> bool:
        """Whether readings are in another unit, so that every figure from them is wrong."""
        return self.kind in (GravityFaultKind.UNIT, GravityFaultKind.MIXED_UNITS)

    @property
    def is_clear(self) -> bool:
        """Whether the readings are no specific force in m/s²."""
        return self.is_unit or self.kind is GravityFaultKind.REMOVED

    @property
    def data_fault(self) -> str:
        """Name of the fault in reports."""
        return (GravityFaultKind.UNIT if self.is_unit else self.kind).value

    @property
    def conversion(self) -> str:
        """Return what to do with a file whose unit no option states."""
        if self.kind is GravityFaultKind.MIXED_UNITS:
            return 'convert each axis to m/s²'
        return (
            self.remedy if np.isnan(self.factor) else f'multiply its readings by {self.factor:.6g}'
        )

    @property
    def live_text(self) -> str:
        """Return figure, explanation and remedy for a stream as one line."""
        return self.stated_by(f'samples.unit:={self.symbol}')

    def stated_by(self, statement: str) -> str:
        """Return figure, explanation and remedy as one line, where a statement has the unit."""
        remedy = f'state it by {statement}' if self.symbol else self.conversion
        return f'{self.reason}; {remedy}'

    @property
    def text(self) -> str:
        """Return figure, explanation and remedy as one line."""
        return f'{self.reason}; {self.remedy}'


@dataclass(frozen=True)
class GravityAtRest:
    """The length of gravity over the rests of a recording or stream."""

    rests: int  # Number of rests
    axes: int  # Number of measured axes; with less than three, lengths are lower limits
    gravity_mps2: float  # Local gravity, m/s²
    # Median length of the readings, m/s². This and the next ones are NaN without rests
    length_mps2: float = np.nan
    spread_mps2: float = np.nan  # Range of the lengths that holds half of the rests, m/s²
    std_mps2: float = np.nan  # Standard deviation of a length by noise, m/s²
    # Lowest and highest median of the lengths that the tolerance allows a sound sensor, m/s²
    allowed_mps2: tuple[float, float] = (np.nan, np.nan)
    fault: GravityFault | None = None  # Why the rests do not read gravity; None where they may

    def as_json(self) -> dict[str, Any]:
        """Return the figures by name, in SI units, without what is not known."""
        figures = {name: value for name, value in asdict(self).items() if name != 'fault'}
        figures['allowed_mps2'] = list(self.allowed_mps2)
        if self.fault is not None:
            figures |= {'fault': self.fault.kind.value, 'unit': self.fault.unit}
        return {
            name: value
            for name, value in figures.items()
            if not isinstance(value, float) or np.isfinite(value)
        }

    @property
    def text(self) -> str:
        """Return the figure with its uncertainty, or why there is none, for people."""
        if not self.rests:
            return 'length of gravity: not checked, nothing rests'
        low, high = self.allowed_mps2
        limits = (
            f'{number(low)} to {number(high)}'
            if self.axes == len(AXES)
            else f'at most {number(high)}, a lower limit is not checked'
        )
        spread = (
            f', half of them within {number(self.spread_mps2, digits=2)}' if self.rests > 1 else ''
        )
        return (
            f'length of gravity: {number(self.length_mps2)} m/s² over '
            f'{counted(self.rests, "rest")}{spread} (the sensor allows {limits})'
        )


def look(
    readings: RestReadings, tolerance: Tolerance, gravity_mps2: float = G0_MPS2
) -> GravityAtRest:
    """
    Compare the readings of rests with gravity.

    Parameters
    ----------
    readings
        Means of k rests on m axes, m/s², by what is known of the sensor.
    tolerance
        By how much they may be off.
    gravity_mps2
        Local gravity, m/s².

    Returns
    -------
    GravityAtRest
        The length with its spread, and the fault that explains it where no sound sensor does.

    """
    every = max(-(-len(readings.mean_mps2) // _MOST_RESTS), 1)
    readings = RestReadings(readings.mean_mps2[::every], readings.std_mps2[::every])
    count, axes = readings.mean_mps2.shape
    if not count:
        return GravityAtRest(0, axes, gravity_mps2)
    length = readings.length_mps2
    case = _Case(readings, tolerance, gravity_mps2)
    # Readings of the length g in these directions are those of forces from `low` to `high`. By
    # proportion, a force of the length g gives readings from g·g/high to g·g/low.
    of_length_g = readings.divided(np.maximum(length, _LEAST_MPS2)[:, None] / gravity_mps2)
    low, high = np.median(replace(case, readings=of_length_g).force_limits(), axis=1)
    return GravityAtRest(
        rests=count * every,
        axes=axes,
        gravity_mps2=gravity_mps2,
        length_mps2=float(np.median(length)),
        spread_mps2=float(np.subtract(*np.quantile(length, [0.75, 0.25]))),
        std_mps2=float(np.median(np.linalg.norm(readings.std_mps2, axis=1))),
        allowed_mps2=(
            float(gravity_mps2**2 / high),
            float(gravity_mps2**2 / low) if low > 0 else np.inf,
        ),
        fault=case.fault(),
    )


class _ForceLimits(NamedTuple):
    """Smallest and largest length of the force of each rest, m/s², (k,)."""

    low: np.ndarray
    high: np.ndarray


@dataclass(frozen=True)
class _Case:
    """Readings of rests, and what a sound sensor allows."""

    readings: RestReadings
    tolerance: Tolerance
    gravity_mps2: float

    @property
    def error_mps2(self) -> np.ndarray:
        """Error of a length that neither zero-g nor scale explain, m/s², (k,)."""
        noise_mps2 = np.linalg.norm(self.readings.std_mps2, axis=1)
        return self.tolerance.across * self.gravity_mps2 + _LOCAL_MPS2 + _NOISE_STDS * noise_mps2

    def force_limits(self) -> _ForceLimits:
        """Return between which lengths the force of each rest is."""
        size = np.abs(self.readings.mean_mps2)
        zero_g = self.tolerance.zero_g_mps2
        scale = self.tolerance.scale
        low = np.linalg.norm(np.maximum(size - zero_g, 0) / (1 + scale), axis=1)
        high = np.linalg.norm((size + zero_g) / (1 - scale), axis=1)
        return _ForceLimits(low - self.error_mps2, high + self.error_mps2)

    def too_long(self) -> np.ndarray:
        """Return which rests, taken alone, are longer than a sound sensor reads, (k,)."""
        return self.force_limits().low > self.gravity_mps2

    def too_short(self) -> np.ndarray:
        """Return which rests, taken alone, are shorter; none with less than three axes, (k,)."""
        is_whole = self.readings.mean_mps2.shape[1] == len(AXES)
        return is_whole & (self.force_limits().high < self.gravity_mps2)

    def is_allowed(self) -> bool:
        """Return whether most rests, each taken alone, may be those of a sound sensor."""
        wrong = self.too_long() | self.too_short()
        # Readings that are far larger in another unit may be noise.
        is_noise = np.median(self.error_mps2) > _LARGEST_ERROR * self.gravity_mps2
        return bool(wrong.mean() <= _LARGEST_FALSE_SHARE and not is_noise)

    def is_explained(self) -> bool:
        """Return whether one zero-g and scale factor of a sound sensor explain most rests."""
        return self.is_allowed() and self.contradicting().mean() <= _LARGEST_FALSE_SHARE

    def contradicting(self) -> np.ndarray:
        """Return which rests contradict the others: no zero-g and scale fit both, (k,)."""
        wrong = self._unexplained(np.zeros(self.readings.mean_mps2.shape[1]))
        if not wrong.any():
            return wrong
        # A zero-g near the length of gravity is far from the first guess.
        return min(wrong, self._unexplained(self._sphere_middle_mps2(prior=1.0)), key=np.sum)

    def _sphere_middle_mps2(self, prior: float) -> np.ndarray:
        """Return the middle of the sphere nearest to the readings, near 0 by a prior, (m,)."""
        mean = self.readings.mean_mps2
        axes = mean.shape[1]
        # |r|² = 2·r·b + (|f|² − |b|²) is linear in b and in the bracket.
        scale_mps2 = prior * 2 * self.gravity_mps2 * self.error_mps2.mean()
        near_0 = np.diag(scale_mps2 / self.tolerance.zero_g_mps2.clip(min=_LEAST_MPS2))
        by_zero_g = np.vstack([2 * mean, near_0])
        by_bracket = np.append(np.ones(len(mean)), np.zeros(axes))
        rows = np.column_stack([by_zero_g, by_bracket])
        squares = np.append((mean**2).sum(axis=1), np.zeros(axes))
        return np.linalg.lstsq(rows, squares)[0][:axes]

    def _unexplained(self, zero_g_mps2: np.ndarray) -> np.ndarray:
        """Return which rests no zero-g near a first guess, m/s², (m,), and scale explain, (k,)."""
        mean = self.readings.mean_mps2
        axes = len(zero_g_mps2)
        error_mps2 = self.error_mps2
        allowed = _CORRECTABLE * np.concatenate([self.tolerance.zero_g_mps2, self.tolerance.scale])
        shares = np.append(zero_g_mps2, np.zeros(axes)) / allowed.clip(min=TINY)
        shares = shares.clip(-1.0, 1.0)
        for _ in range(_STEPS):
            zero_g, scale = np.split(shares * allowed, 2)
            force = (mean - zero_g) / (1 + scale)
            length = np.maximum(np.linalg.norm(force, axis=1), TINY)
            beyond = (length - self.gravity_mps2) / error_mps2
            if axes < len(AXES):
                beyond = np.maximum(beyond, 0.0)
            if (np.abs(beyond) <= 1).all():
                break
            # A step of Gauss and Newton, by weights in which false rests count less
            by_zero_g = -force / length[:, None] / (1 + scale)
            rows = np.hstack([by_zero_g, by_zero_g * force]) * allowed / error_mps2[:, None]
            weighted = rows.T / np.sqrt(1 + beyond**2)
            step = np.linalg.solve(
                weighted @ rows + _PRIOR * np.eye(2 * axes), weighted @ beyond + _PRIOR * shares
            )
            shares = np.clip(shares - step, -1.0, 1.0)
        return np.abs(beyond) > 1

    def divided(self, factors: np.ndarray | float) -> _Case:
        """Return the case of readings that are divided by factors."""
        return replace(self, readings=self.readings.divided(factors))

    def fault(self) -> GravityFault | None:
        """Return what is wrong; None where a sound sensor may read all this."""
        wrong = self.contradicting()
        longer = self.too_long().mean()
        shorter = self.too_short().mean()
        is_off = max(longer, shorter) > 0.5
        contradict = wrong.sum() > 1
        if is_off and (unit_fault := self._unit()):
            return unit_fault
        if is_off and self._is_removed():
            return GravityFault(
                GravityFaultKind.REMOVED,
                f'at rest {self._read()}: gravity is missing, as in linear acceleration',
                'record the specific force, which includes gravity',
            )
        mixed = self._mixed_units() if is_off or contradict else None
        if mixed is not None:
            return mixed
        if is_off:
            return GravityFault(
                GravityFaultKind.SCALE,
                f'at rest {self._read()}{self._range() or self._offset()}',
                'check unit, zero-g and scale factor',
            )
        if contradict and wrong.mean() > _LARGEST_FALSE_SHARE:
            return self._spread(wrong)
        return None

    def _read(self) -> str:
        length = float(np.median(self.readings.length_mps2))
        return (
            f'the readings are {number(length)} m/s² long '
            f'({counted(len(self.readings.mean_mps2), "rest")}), expected '
            f'{number(self.gravity_mps2)}'
        )

    def _read_over_poses(self) -> str:
        lengths = self.readings.length_mps2
        return (
            f'at rest the readings are {number(lengths.min())} to {number(lengths.max())} '
            f'm/s² long ({counted(len(lengths), "rest")}), expected '
            f'{number(self.gravity_mps2)} in each pose'
        )

    def _unit(self) -> GravityFault | None:
        """Return the unit of all axes in which the readings are gravity."""
        length = float(np.median(self.readings.length_mps2))
        distances = {
            unit: abs(float(np.log(length / unit.gravity)))
            for unit in READING_UNITS
            if self._fits(unit)
        }
        if not distances:
            return None
        # A sensor within the usual tolerance may be nearer to another unit than to its own.
        farthest = min(distances.values()) + _ALIKE
        nearest = sorted(distances, key=distances.__getitem__)[:2]
        likely = [unit for unit in nearest if distances[unit] < farthest]
        names = ' or '.join(unit.name for unit in likely)
        remedies = ', or '.join(unit.remedy for unit in likely)
        return GravityFault(
            kind=GravityFaultKind.UNIT,
            reason=f'at rest {self._read()}, as values in {names} are',
            remedy=remedies,
            unit=names,
            symbol=likely[0].symbol,
            factor=self.gravity_mps2 / likely[0].gravity,
        )

    def _fits(self, unit: ReadingUnit) -> bool:
        """Return whether the readings are those of a sound sensor in a unit."""
        case = self.divided(unit.gravity / self.gravity_mps2)
        if not case.is_explained():
            return False
        if self.readings.mean_mps2.shape[1] == len(AXES):
            return True
        # An upper limit fits all larger units: that of the longest rest counts.
        longest = case.readings.length_mps2.max() / self.gravity_mps2
        return bool(longest > 1 - case.tolerance.scale.max())

    def _is_removed(self) -> bool:
        """Return whether most rests may read a sound sensor without any force."""
        beyond = (
            np.abs(self.readings.mean_mps2) > self.tolerance.zero_g_mps2 + self.error_mps2[:, None]
        )
        return bool(beyond.any(axis=1).mean() <= _LARGEST_FALSE_SHARE)

    def _mixed_units(self) -> GravityFault | None:
        """Return the units of single axes in which the rests of several poses are gravity."""
        axes = self.readings.mean_mps2.shape[1]
        is_told = self.tolerance.zero_g_mps2.max() < self.gravity_mps2 / 2
        has_length = self.readings.has_several_poses and axes == len(AXES)
        if not (is_told and has_length):
            return None
        length = max(float(np.median(self.readings.length_mps2)), _LEAST_MPS2)
        if not self.divided(length / self.gravity_mps2).contradicting().any():
            return None  # One factor of all axes explains them.
        factors = {'m/s²': 1.0} | {
            unit.name: unit.gravity / self.gravity_mps2 for unit in AXIS_UNITS
        }
        departures_mps2: dict[tuple[str, ...], float] = {}
        for names in product(factors, repeat=axes):
            if len(set(names)) == 1:
                continue
            case = self.divided(np.array([factors[name] for name in names]))
            if not case.is_allowed() or case.contradicting().any():
                continue
            departure_mps2 = np.abs(case.readings.length_mps2 - self.gravity_mps2)
            departures_mps2[names] = float(departure_mps2.max())
        if not departures_mps2:
            return None
        best = min(departures_mps2, key=departures_mps2.__getitem__)
        stated = ', '.join(f'{axis} in {name}' for axis, name in zip(AXES, best))
        return GravityFault(
            GravityFaultKind.MIXED_UNITS,
            f'{self._read_over_poses()}: the axes are in different units ({stated})',
            f'state the unit of each axis by {option("columns")}',
            stated,
        )

    def _range(self) -> str:
        """Return the range of a digital sensor that explains a scale factor, or ''."""
        for power in (1, -1, 2, -2, 3, -3):
            if self.divided(2.0**power).is_explained():
                return f', {2.0**power:g} times, as with the scale factor of another range'
        return ''

    def _offset(self) -> str:
        """Return the zero-g beyond the tolerance that explains rests in several poses, or ''."""
        zero_g_mps2 = self._sphere_middle_mps2(prior=0.0)
        about_mps2 = np.linalg.norm(self.readings.mean_mps2 - zero_g_mps2, axis=1)
        is_sphere = len(about_mps2) > len(zero_g_mps2) + 1 and np.allclose(
            about_mps2, self.gravity_mps2, rtol=self.tolerance.scale.max()
        )
        if not is_sphere:
            return ''
        stated = ', '.join(
            f'{axis} {value:.3g}' for axis, value in zip(AXES, zero_g_mps2 / G0_MPS2)
        )
        return f', as with a zero-g of {stated} g'

    def _spread(self, wrong: np.ndarray) -> GravityFault:
        return GravityFault(
            GravityFaultKind.SPREAD,
            f'{self._read_over_poses()}: no zero-g and scale factor '
            f'within the tolerance of the sensor explain {wrong.sum()} of them',
            'look for axes in different units, several sensors in one file, or a sensor that was '
            'exchanged',
        )


def of_volts(mean_v: np.ndarray, std_v: np.ndarray, sensor: Sensor) -> GravityAtRest:
    """
    Compare the volts of rests, V, (k, m), and their standard deviations with gravity.

    A calibrated sensor undoes its effects first. Where its readings then are no gravity, those by
    the nominal values tell the unit.
    """
    nominal = RestReadings(
        to_nominal_mps2(mean_v, sensor), std_v / sensor.nominal_scale_v_per_g * G0_MPS2
    )
    gravity_mps2 = sensor.local_gravity_mps2
    by_nominal = look(nominal, nominal_tolerance(sensor), gravity_mps2)
    if 'scale_factor' not in sensor.effects and 'bias' not in sensor.effects:
        return by_nominal
    corrected = look(
        RestReadings(_corrected_mps2(mean_v, sensor), nominal.std_mps2),
        calibrated_tolerance(sensor),
        gravity_mps2,
    )
    is_of_unit = corrected.fault and by_nominal.fault and by_nominal.fault.is_clear
    return by_nominal if is_of_unit else corrected


def _corrected_mps2(mean_v: np.ndarray, sensor: Sensor) -> np.ndarray:
    """Return the specific force by the calibration on the measured axes, m/s², (k, m)."""
    straight = (mean_v - sensor.zero_g_v) / sensor.scale_v_per_g * G0_MPS2
    if sensor.axes != AXES or not len(mean_v):
        return straight  # The third component would be derived from gravity itself.
    with np.errstate(all='ignore'):
        force = np.column_stack(signal_chain.inverse(sensor)(list(mean_v.T), NOMINAL_ENVIRONMENT))
    # No force explains what is far beyond the range.
    return np.where(np.isfinite(force), force, straight)


def require_unit(gravity: GravityAtRest, path: str, needs_gravity: bool = False) -> list[str]:
    """
    Refuse readings in another unit; return what else is wrong with gravity, one line at most.

    needs_gravity: whether readings without gravity are refused as well.
    """
    fault = gravity.fault
    if fault is None:
        return []
    is_refused = fault.is_clear if needs_gravity else fault.is_unit
    if is_refused:
        raise UserError(f'{path}: {fault.text}')
    return [fault.text]
