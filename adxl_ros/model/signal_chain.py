# SPDX-License-Identifier: Apache-2.0

"""
The signal chain: the effects of a sensor, place by place, and the exact inverse at rest.

`Chain` is the one runner of effects. It serves one live sample (floats), a block (arrays, (n,)),
and a batch of sensors (arrays, (1, n)).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from copy import copy
from dataclasses import dataclass
import itertools
from typing import Any
import zlib

from adxl_ros.model.constants import AXES, FINEST_V, G0_MPS2
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import (
    ARRAYS,
    Coefficient,
    Components,
    Environment,
    Maths,
    NOMINAL_ENVIRONMENT,
    Place,
    Role,
    Signals,
    Value,
)
from adxl_ros.model.sensor import Sensor
import numpy as np

ANALOG = (Place.MOUNTING, Place.ELEMENT, Place.ELECTRONICS)  # From force to filter
_TOLERANCE_MPS2 = 1e-10  # Newton step of a converged inverse, m/s²; chosen: near rounding
_UNSOLVED_MPS2 = 1e-6
"""Last Newton step from which a sample has no solution, m/s²; chosen: near alpha = ±90°, the z of
equation 5 is a root of 0, and rounding moves it by up to this."""
_MAX_ITERATIONS = 60  # Most iterations of an inverse; chosen: far more than needed
_CHORD_STEPS = 8
"""Steps with the tangent at rest without gravity before Newton's method; chosen: each leaves a few
percent of the error of a real sensor, and takes a seventh of the time of a Newton step."""
_CLEAR_Z_MPS2 = 1.0  # |z| that |f| = g determines well, m/s²; chosen: 6° from ±90°
_SETTLED_V = 1e-13  # Change of a converged ADC inverse, V; chosen: near rounding
_DIFFERENCE_MPS2 = 1e-3  # Half step by force, m/s²; chosen: the chain is nearly linear


class RunningEffect:
    """An effect of a sensor with its parameters, its memory and its random generator."""

    def __init__(self, sensor: Sensor, name: str, seed: int) -> None:
        """Prepare the effect before its first sample."""
        effect = effect_named(name)
        self.parameters = sensor.parameters(name)
        sizes = [p for p in effect.parameters if p.role is not Role.SHAPE]
        # At the neutral values of its sizes and limits an effect does nothing.
        self.is_neutral = bool(sizes) and all(
            self.parameters.get(p.name) in (None, p.neutral, (p.neutral,) * len(sensor.axes))
            for p in sizes
        )
        self.name = name
        self.place = effect.place
        self.apply = effect.apply
        self.key = (name, *sorted(self.parameters.items()))
        self.memory: dict[str, Any] = {}
        # An invertible effect is a function of one sample, and draws nothing.
        self.rng = None if effect.invertible else _generator(seed, name)

    def __getstate__(self) -> dict[str, Any]:
        """Return what a pickle holds: the function of an effect has no name of its own there."""
        return {key: value for key, value in vars(self).items() if key != 'apply'}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take the content of a pickle."""
        vars(self).update(state)
        self.apply = effect_named(self.name).apply

    def seed(self, seed: int) -> None:
        """Begin the random numbers of the effect anew."""
        if self.rng is not None:
            self.rng = _generator(seed, self.name)


def _generator(seed: int, name: str) -> np.random.Generator:
    return np.random.default_rng([seed, zlib.crc32(name.encode())])


class Chain:
    """The effects of a sensor, applied place by place to samples of any shape."""

    def __init__(self, sensor: Sensor, names: Iterable[str] | None = None, seed: int = 0) -> None:
        """Prepare effects of the sensor, all unless some are named, before the first sample."""
        self.sensor = sensor
        running = [
            RunningEffect(sensor, name, seed)
            for name in (sensor.effects if names is None else names)
        ]
        self.effects = {
            place: [
                effect for effect in running if effect.place is place and not effect.is_neutral
            ]
            for place in Place
        }
        self._zero_g_v = sensor.nominal_zero_g_v.tolist()
        self._scale_v_per_g = sensor.nominal_scale_v_per_g.tolist()

    def signals(self, environment: Environment, **given: Any) -> Signals:
        """Return signals before the chain: those that are given, and what the sensor states."""
        return Signals(
            environment,
            gravity_mps2=self.sensor.local_gravity_mps2,
            nominal_scale_v_per_g=self._scale_v_per_g,
            vref_v=self.sensor.adc_vref_v,
            **given,
        )

    def __call__(self, place: Place, signals: Signals) -> None:
        """Set the signals that begin at a place, and apply its effects."""
        count = len(self._zero_g_v)
        if place is Place.MOUNTING:
            signals.sensed = [f / G0_MPS2 for f in signals.force]
        elif place is Place.ELEMENT:
            signals.output = list(signals.sensed)
        elif place is Place.ELECTRONICS:
            sensor = self.sensor
            signals.output = list(signals.output)
            signals.zero_g_v = self._zero_g_v[:]
            signals.scale_v_per_g = self._scale_v_per_g[:]
            signals.rc_s = [sensor.rc_s] * count
            signals.noise_ratio = [1.0] * count
            signals.lsb_v = [sensor.lsb_v] * count
        elif place is Place.ADC:
            signals.volts = list(signals.input_v)
        for effect in self.effects[place]:
            signals.memory = effect.memory
            signals.rng = effect.rng
            effect.apply(signals, effect.parameters)

    def volts(self, signals: Signals, first: Place = Place.MOUNTING) -> Components:
        """Run the chain from a place to the filter; return volts by measured axis."""
        for place in ANALOG:
            if place >= first:
                self(place, signals)
        return [
            zero + scale * out
            for zero, scale, out in zip(signals.zero_g_v, signals.scale_v_per_g, signals.output)
        ]

    def put_units(self, names: Sequence[Coefficient], values: np.ndarray) -> None:
        """Give each of n sensors coefficients of its own, (n, k); the others are shared."""
        effects = {effect.name: effect for effect in self._running()}
        for name, of_sensors in zip(names, values.T):
            effect = effects.get(name.effect)
            if effect is None:
                continue
            own = of_sensors.copy()
            if name.axis:
                by_axis = list(effect.parameters[name.parameter])
                by_axis[self.sensor.axes.index(name.axis)] = own
                effect.parameters[name.parameter] = tuple(by_axis)
            else:
                effect.parameters[name.parameter] = own

    def anew(self) -> Chain:
        """Return the chain as after power-on; random generators are shared."""
        new = copy(self)
        new.effects = {
            place: [copy(effect) for effect in effects] for place, effects in self.effects.items()
        }
        for effect in new._running():
            effect.memory = {}
            effect.parameters = dict(effect.parameters)
        return new

    def seed(self, seed: int) -> None:
        """Begin all random numbers anew."""
        for effect in self._running():
            effect.seed(seed)

    def memories(self) -> list[dict[Any, Any]]:
        """Return what each effect remembers."""
        return [effect.memory for effect in self._running()]

    def _running(self) -> list[RunningEffect]:
        return list(itertools.chain.from_iterable(self.effects.values()))

    def through_adc(self, input_v: Components) -> Components:
        """Return volts behind the ADC's effects, by measured axis, without its steps."""
        if not self.effects[Place.ADC]:
            return input_v
        signals = self.signals(NOMINAL_ENVIRONMENT, input_v=input_v)
        self(Place.ADC, signals)
        return signals.volts

    def convert(self, signals: Signals) -> np.ndarray:
        """Run the ADC on `input_v`; return volts, (..., m)."""
        self(Place.ADC, signals)
        coded = quantise(
            np.moveaxis(np.array(signals.volts), 0, -1),
            self.sensor,
            np.array(signals.lsb_v),
        )
        if not self.effects[Place.CODE]:
            return coded
        signals.volts = [coded[..., d] for d in range(coded.shape[-1])]
        self(Place.CODE, signals)
        return np.moveaxis(np.array(signals.volts), 0, -1)


def static_chain(sensor: Sensor) -> Chain:
    """Return the chain of the effects that the inverse undoes."""
    return Chain(sensor, [name for name in sensor.effects if effect_named(name).invertible])


def analog_response(sensor: Sensor) -> Callable[..., Components]:
    """Prepare `static_response` up to the input of the ADC."""
    chain = static_chain(sensor)
    return lambda force, environment=NOMINAL_ENVIRONMENT: chain.volts(
        chain.signals(environment, force=force)
    )


def static_response(sensor: Sensor) -> Callable[..., Components]:
    """
    Prepare the chain from specific force to volts at rest, by its invertible effects.

    `simulate.response` adds filter, noise, quantisation, stage, and effects with a memory. It maps
    specific force and an `Environment` (nominal unless given) to volts by measured axis.
    """
    chain = static_chain(sensor)
    return lambda force, environment=NOMINAL_ENVIRONMENT: chain.through_adc(
        chain.volts(chain.signals(environment, force=force))
    )


def adc_inverse(sensor: Sensor) -> Callable[[Components], Components]:
    """
    Prepare the inverse of the ADC's effects: volts of the ADC to volts at its input, by axis.

    A bit of a wrong weight makes steps, in which Newton's method has no slope. The ADC is
    therefore inverted apart from the rest of the chain. Where two inputs near a step give the
    same volts, one of them is returned; where none does, the middle of the gap.
    """
    chain = static_chain(sensor)
    if not chain.effects[Place.ADC]:
        return list

    def undo(volts: Components) -> Components:
        previous, current = list(volts), list(volts)
        with np.errstate(all='ignore'):
            for _ in range(_MAX_ITERATIONS):
                changes = [v - c for v, c in zip(volts, chain.through_adc(current))]
                # A converged sample stays, so that it does not depend on its neighbours.
                changes = [change * (abs(change) >= _SETTLED_V) for change in changes]
                previous = current
                current = [v + change for v, change in zip(current, changes)]
                if not any(np.any(change) for change in changes):
                    break
        return [(a + b) / 2 for a, b in zip(current, previous)]

    return undo


def gravity_mps2(sensor: Sensor) -> float:
    """Return local gravity with the effects on it, m/s²."""
    chain = static_chain(sensor)
    signals = chain.signals(NOMINAL_ENVIRONMENT)
    chain(Place.STAGE, signals)
    return signals.gravity_mps2


def jacobian(
    respond: Callable[..., Components],
    force: Components,
    environment: Environment = NOMINAL_ENVIRONMENT,
) -> np.ndarray:
    """Differentiate the volts of `analog_response` by force: (m, 3), or (m, 3, n) for arrays."""
    columns = []
    for c in range(3):
        above, below = list(force), list(force)
        above[c], below[c] = above[c] + _DIFFERENCE_MPS2, below[c] - _DIFFERENCE_MPS2
        columns.append(
            [
                (a - b) / (2 * _DIFFERENCE_MPS2)
                for a, b in zip(respond(above, environment), respond(below, environment))
            ]
        )
    return np.swapaxes(np.array(columns), 0, 1)


@dataclass(frozen=True)
class Tangent:
    """The inverse of the chain to first order, around one or many forces."""

    # Derivatives of the force along the measured axes by the volts, (m/s²)/V, m rows of m
    # components
    back: list[Components]
    # Derivatives of the estimates of x and y by z; empty unless z is derived (equation 5)
    slope: Components


def tangent(
    respond: Callable[..., Components],
    axes: str,
    force: Components,
    environment: Environment = NOMINAL_ENVIRONMENT,
) -> Tangent:
    """Linearise the inverse of `respond` around forces; see `jacobian` for the parameters."""
    by_force: Any = jacobian(respond, force, environment)
    if isinstance(force[0], float):
        by_force = by_force.tolist()
    measured = [AXES.index(a) for a in axes]
    back = _inverse_matrix([[row[c] for c in measured] for row in by_force])
    slope = (
        []
        if axes != 'xy'
        else [-sum(b * row[2] for b, row in zip(line, by_force)) for line in back]
    )
    return Tangent(back, slope)


def _inverse_matrix(a: list[Components]) -> list[Components]:
    """Invert 1×1 to 3×3 matrices by their minors, component by component."""
    count = len(a)
    # The axes that are missing are those of a unit matrix.
    whole = np.eye(3).tolist()
    for row, given in zip(whole, a):
        row[:count] = given
    next_two = ((1, 2), (2, 0), (0, 1))
    minors = [
        [whole[i][p] * whole[j][q] - whole[i][q] * whole[j][p] for p, q in next_two]
        for i, j in next_two
    ]
    determinant = sum(v * m for v, m in zip(whole[0], minors[0]))
    return [[minors[d][c] / determinant for d in range(count)] for c in range(count)]


def newton_step(axes: str, gravity_mps2: float, maths: Maths) -> Callable[..., Components]:
    """
    Prepare one Newton step of the inverse for measured axes, with |f| at rest for equation 5.

    It maps volts minus the response to a force, that force, a `Tangent` near it, and the sign of
    a derived z to the next force.
    """
    measured = [AXES.index(a) for a in axes]

    def next_force(
        residual_v: Components, force: Components, tangent: Tangent, up: Value
    ) -> Components:
        force = list(force)
        for d, row in zip(measured, tangent.back):
            for by_volt, r in zip(row, residual_v):
                force[d] = force[d] + by_volt * r
        if not tangent.slope:
            return force
        # z by |f| = g, its contribution removed from x and y (equation 5).
        slope = tangent.slope
        x, y = force[0] - slope[0] * force[2], force[1] - slope[1] * force[2]
        a = 1 + slope[0] * slope[0] + slope[1] * slope[1]
        half_b = x * slope[0] + y * slope[1]
        discriminant = half_b * half_b - a * (x * x + y * y - gravity_mps2 * gravity_mps2)
        z = (up * maths.sqrt(maths.maximum(discriminant, 0.0)) - half_b) / a
        return [x + slope[0] * z, y + slope[1] * z, z]

    return next_force


def inverse(sensor: Sensor, z_sign: np.ndarray | None = None) -> Callable[..., Components]:
    """
    Prepare the exact inverse of `static_response`: volts to specific force, by Newton's method.

    The z of an x/y sensor is derived from |f| = g (equation 5), which holds at rest only. The
    in-plane force is linear in z near the solution, so that |f|² = g² is quadratic in z. Where
    noise puts the in-plane force beyond g, the z of the smallest |f| is taken: there is no jump
    and no NaN at alpha = ±90°. A sensor of one axis gets 0 for the others.

    z_sign: sign of z by sample, (n,), where it is known better than by `sensor.up`; returns:
    maps the volts of each axis, arrays (n,) or floats, and an `Environment` (nominal unless given)
    to three components, m/s². Samples without a solution are NaN.
    """
    search = _Search(sensor)
    undo_adc = adc_inverse(sensor)
    up = np.asarray(sensor.up if z_sign is None else z_sign)

    def invert(volts: Components, environment: Environment = NOMINAL_ENVIRONMENT) -> Components:
        input_v = np.array(undo_adc(list(np.array(volts, float).reshape(len(volts), -1))))
        count = input_v.shape[1]
        finite = np.flatnonzero(np.isfinite(input_v).all(axis=0))
        force = np.full((3, count), np.nan)
        around = Environment(*(np.broadcast_to(np.asarray(e, float), count) for e in environment))
        with np.errstate(all='ignore'):
            force[:, finite] = search(
                input_v[:, finite], _select(around, finite), np.broadcast_to(up, count)[finite]
            )
        return list(force) if np.ndim(volts[0]) else force[:, 0].tolist()

    return invert


class _Search:
    """Newton's method on many samples, each until it has converged."""

    def __init__(self, sensor: Sensor) -> None:
        self._axes = sensor.axes
        self._gravity = gravity_mps2(sensor)
        self._respond = analog_response(sensor)
        self._step = newton_step(sensor.axes, self._gravity, ARRAYS)

    def __call__(
        self, input_v: np.ndarray, environment: Environment, signs: np.ndarray
    ) -> np.ndarray:
        """Return the forces, (3, n), of volts, (m, n); NaN where there is none."""
        # Steps with the tangent at rest cost one response each, and mostly suffice.
        at_rest = tangent(self._respond, self._axes, [np.zeros(1)] * 3)
        force, change = self._steps(input_v, environment, signs, _CHORD_STEPS, at_rest)
        is_solved = change < _TOLERANCE_MPS2
        if self._axes == 'xy':
            # Where |f| = g clearly has a z, every tangent leads to the same one.
            x, y, z = force
            excess = x * x + y * y + z * z - self._gravity * self._gravity
            is_solved &= (np.abs(z) > _CLEAR_Z_MPS2) & (
                np.abs(excess) < _TOLERANCE_MPS2 * self._gravity
            )
        further = np.flatnonzero(~is_solved)
        if len(further):
            force[:, further], change = self._steps(
                input_v[:, further], _select(environment, further), signs[further], _MAX_ITERATIONS
            )
            force[:, further[~(change < _UNSOLVED_MPS2)]] = np.nan
        return force

    def _steps(
        self,
        input_v: np.ndarray,
        environment: Environment,
        signs: np.ndarray,
        limit: int,
        common: Tangent | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Take steps from no force; return the last forces, (3, n), and steps, (n,)."""
        count = input_v.shape[1]
        force = np.zeros((3, count))
        last_change = np.full(count, np.inf)
        active = np.arange(count)
        for _ in range(limit):
            # Most samples need equally many steps, and a slice costs less than their numbers.
            samples = slice(None) if len(active) == count else active
            current = list(force[:, samples])
            around = _select(environment, samples)
            residual_v = [
                v - r for v, r in zip(input_v[:, samples], self._respond(current, around))
            ]
            following = np.array(
                self._step(
                    residual_v,
                    current,
                    common or tangent(self._respond, self._axes, current, around),
                    signs[samples],
                )
            )
            change = np.abs(following - current).max(axis=0)
            force[:, samples], last_change[samples] = following, change
            # A converged sample stays, so that it does not depend on its neighbours; NaN and
            # infinity fail the comparison, too.
            active = active[(change >= _TOLERANCE_MPS2) & (change < np.inf)]
            if not len(active):
                break
        return force, last_change


def _select(environment: Environment, samples: np.ndarray | slice) -> Environment:
    """Return the surroundings of some samples, given by number, (k,), or of a slice."""
    return Environment(*(values[samples] for values in environment))


def quantise(volts: np.ndarray, sensor: Sensor, lsb_v: np.ndarray) -> np.ndarray:
    """Round volts, (..., m), to steps by axis, V, (m,), within the rails; 0 does not quantise."""
    if not np.any(lsb_v):
        return volts
    lsb_v = np.maximum(lsb_v, FINEST_V)
    coded = volts / lsb_v
    np.rint(coded, out=coded)
    coded *= lsb_v
    if not sensor.adc_bits:
        return coded
    highest = sensor.adc_vref_v - sensor.lsb_v
    return np.clip(coded, 0.0, np.floor(highest / lsb_v) * lsb_v, out=coded)


def at_a_rail(volts: np.ndarray, sensor: Sensor) -> np.ndarray:
    """
    Return the samples, (n,), of which an axis reads the lowest or highest code of the ADC.

    Volts, (n, m), beyond the rails come from another ADC, or from none, and do not indicate
    saturation.
    """
    rails_v = 0.0, sensor.adc_vref_v - sensor.lsb_v
    return np.logical_or.reduce(
        [
            np.abs(axis_v - rail_v) < sensor.lsb_v / 2
            for axis_v, rail_v in itertools.product(volts.T, rails_v)
        ]
    )
