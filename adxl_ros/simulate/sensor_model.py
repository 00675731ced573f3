# SPDX-License-Identifier: Apache-2.0

"""
The signal chain as a call for simulators: one sample of one or many sensors at a time.

Many sensors may be other units each, drawn from a population or around a calibrated unit.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, replace
from os import PathLike
from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.files import calibration_store, parameter_file
from adxl_ros.model import noise
from adxl_ros.model.constants import NOMINAL_SUPPLY_V, NOMINAL_TEMPERATURE_C
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Coefficient, Concern, Effect, Environment, Place
from adxl_ros.model.filters import low_pass
from adxl_ros.model.population import Population
from adxl_ros.model.sensor import (
    get,
    names_of,
    parameter_of,
    put,
    Sensor,
    to_nominal_mps2,
    with_neutral,
)
from adxl_ros.model.signal_chain import Chain
from adxl_ros.report.arguments import require_number, require_whole
from adxl_ros.simulate.gyroscope_model import GyroscopeModel
from adxl_ros.simulate.host_arrays import chosen, like, of_each, on_host
from adxl_ros.simulate.motion import lagrange_weights, Motion, POINTS
from adxl_ros.simulate.response import check_needs
import numpy as np
from scipy.special import ndtr, ndtri

_STDS_OF_MAXIMUM = 3.0  # Stds in a maximum without typical value. Chosen: 1 part in 370 beyond
_SAME_STEP = 1e-6  # Relative change of equal time steps; chosen: above rounding


@dataclass(frozen=True)
class UnitDraws:
    """The distribution of the coefficients of a unit: normal, cut off where there is a limit."""

    names: tuple[Coefficient, ...]  # Coefficients that differ from unit to unit, (k,)
    mean: np.ndarray  # (k,), each in the unit of its parameter
    root: np.ndarray  # Square root of the covariance by independent numbers, (k, l)
    limit_stds: np.ndarray  # Largest absolute value of each of these numbers, (l,); inf for none

    def draw(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Return the coefficients of further units, (count, k)."""
        low = ndtr(-self.limit_stds)
        normal = ndtri(low + (1 - 2 * low) * rng.random((count, self.root.shape[1])))
        values = self.mean + normal @ self.root.T
        bounds = [(p.lower, p.upper) for p in map(parameter_of, self.names)]
        return np.clip(values, *np.array(bounds).reshape(-1, 2).T)


def unit_draws(sensor: Sensor, units: str | PathLike | Population) -> UnitDraws:
    """
    Return how units differ.

    sensor: the unit, or the nominal sensor; units: 'datasheet' for the tolerances of the parameter
    file, 'calibration' for the covariance of the unit's own coefficients, else the population.yaml
    of a fleet; returns: the distribution. Only effects that are functions of one sample are in it.
    """
    limit: float | np.ndarray = np.inf
    if units == 'datasheet':
        names = []
        stds = []
        limits = []
        for parameter, (typical, maximum) in sensor.datasheet.items():
            std = typical or maximum / _STDS_OF_MAXIMUM
            for name in names_of(effect_named(parameter.effect), sensor.axes):
                if name.without_axis == parameter:
                    names.append(name)
                    stds.append(std)
                    limits.append((maximum or np.inf) / std)
        mean = np.array([parameter_of(name).neutral for name in names])
        root = np.diag(np.array(stds))
        limit = np.array(limits)
    elif units == 'calibration':
        names = list(sensor.covariance_names)
        size, vectors = np.linalg.eigh(sensor.covariance)
        mean = get(sensor, names)
        root = vectors * np.sqrt(np.maximum(size, 0.0))
    else:
        population = (
            units if isinstance(units, Population) else calibration_store.read_population(units)
        )
        prior = population.prior(sensor)
        names = list(prior.names)
        mean = prior.mean
        root = np.diag(prior.std)
    if not names:
        raise UserError(
            f'units {str(units)!r}: {sensor.serial} has no coefficients to draw from '
            'it; give datasheet tolerances, a calibration with a covariance, or the '
            'population.yaml of a fleet'
        )
    drawn = [effect_named(name.effect).invertible for name in names]
    return UnitDraws(
        tuple(name for name, is_drawn in zip(names, drawn) if is_drawn),
        mean[drawn],
        root[drawn],
        np.broadcast_to(limit, len(names)),
    )


class SensorModel:
    """
    A sensor in a simulator: specific force of each time step in, readings out.

    All sensors of a batch are copies of one unit with noise of their own, or units of their own.
    The chain runs at the time steps of the simulator. Otherwise it is that of `simulate`, and one
    sensor gives the same readings with the same seed. It runs in numpy on the host: arrays of a
    device are copied.
    """

    def __init__(
        self,
        params: Sensor | str | PathLike,
        seed: int = 0,
        units: str | PathLike | Population | None = None,
    ) -> None:
        """
        Put the sensors at the time of power-on.

        Parameters
        ----------
        params
            The unit, a result that has one (`Fit`, `Gap`), or its parameter file.
        seed
            Seed of units and noise.
        units
            Which unit each sensor is: None for copies of the one of `params`, 'datasheet' for
            parts within its tolerances, 'calibration' for parts within the covariance of its
            coefficients, or the population.yaml of a fleet.

        Raises
        ------
        UserError
            A file cannot be read, or states no distribution of units.

        """
        params = getattr(params, 'sensor', params)
        # The unit
        self.sensor = params if isinstance(params, Sensor) else parameter_file.load(params)
        self.draws = unit_draws(self.sensor, units) if units is not None else None
        self._delay_s = float(self.sensor.values.get('time_offset', {}).get('offset_s', 0.0))
        # Reason by name of an effect of the unit that is not simulated
        self.left_out = {
            name: reason
            for name in self.sensor.effects
            if (reason := _reason_to_leave_out(effect_named(name), self._delay_s))
        }
        kept = tuple(name for name in self.sensor.effects if name not in self.left_out)
        check_needs(replace(self.sensor, effects=kept), Motion(0.0))
        # Drawn coefficients of the sensors, (n, k); None before the first step, or without draws
        self.coefficients: np.ndarray | None = None
        self._units_rng, self._white = _generators(seed)
        simulated = self.sensor
        if self.draws:
            # An effect with neutral values is skipped, and here they are replaced.
            simulated = with_neutral(simulated, [name.effect for name in self.draws.names])
            simulated = put(simulated, self.draws.names, [1e-9] * len(self.draws.names))
        self._chain = Chain(
            simulated, [name for name in simulated.effects if name not in self.left_out], seed
        )
        # The gyroscope beside it: angular velocity of each step in, readings out
        self.gyro = GyroscopeModel(self.sensor.gyro, seed)
        self._past_weights = np.zeros(0)
        self._shape: tuple[int, ...] = ()
        self._dt_s = 0.0
        self._std_v = np.zeros(0)
        self._switch_on(0)

    def __repr__(self) -> str:
        return repr(self.sensor).replace('Sensor', 'SensorModel', 1)

    def _switch_on(self, count: int) -> None:
        """Forget all that sensors remember: steps since power-on, filters, noise, past forces."""
        self._memory: dict[str, Any] = {
            'steps': np.zeros(count),
            'filters': [{} for _ in self.sensor.axes],
        }
        self._reset = np.zeros(0, int)  # Sensors that begin anew in the next step

    def reset(self, env_ids: Any = None, seed: int | None = None) -> None:
        """
        Begin anew: the sensors are other units, and their noise and filters have no past.

        Parameters
        ----------
        env_ids
            Numbers of the sensors, a mask or a slice; None for all. Before the first step no
            sensor has a past.
        seed
            Seed from which all random numbers begin anew, as those of a new `SensorModel`; None
            lets them go on.

        """
        if seed is not None:
            self._units_rng, self._white = _generators(seed)
            self._chain.seed(seed)
        self.gyro.reset(env_ids, seed)
        if count := len(self._memory['steps']):
            rows = chosen(env_ids, count)
            self._reset = np.union1d(self._reset, rows)
            self._draw(rows)

    def _draw(self, rows: np.ndarray) -> None:
        """Draw the units of some sensors."""
        if self.draws is None:
            return
        if self.coefficients is None:
            self.coefficients = np.empty((len(self._memory['steps']), len(self.draws.names)))
        self.coefficients[rows] = self.draws.draw(len(rows), self._units_rng)
        self._chain.put_units(self.draws.names, self.coefficients)

    def __call__(
        self,
        specific_force: Any,
        dt: float,
        temperature: Any = NOMINAL_TEMPERATURE_C,
        supply: Any = NOMINAL_SUPPLY_V,
    ) -> Any:
        """
        Advance by one time step.

        Parameters
        ----------
        specific_force
            Specific force in the frame of the sensor at this step, m/s²: (3,), or (n, 3) for n
            sensors; an array of numpy, torch or jax. At rest, an axis that points up has +g.
        dt
            Time step, s; the same in each call.
        temperature
            Temperature, °C: a number, or (n,).
        supply
            Supply voltage, V: a number, or (n,).

        Returns
        -------
        array
            Readings by the nominal conversion, m/s², as in `imu/data_raw`: an array of the same
            library, shape, device and floating type as the force; 0 for an axis that the sensor
            does not have. For whole numbers it is float64 of numpy, and float32 of others.

        Raises
        ------
        UserError
            The shape or the time step is wrong, or changes, or a value is not finite.

        """
        force = np.asarray(on_host(specific_force), float)
        count = force.size // 3
        self._check(force, dt)
        environment = [
            of_each(name, values, count)
            for name, values in (('temperature', temperature), ('supply', supply))
        ]
        rows = force.reshape(-1, 3)
        begun = self._reset
        if len(begun) == count:
            self._switch_on(count)
            self._chain = self._chain.anew()
            begun = self._reset
        readings = self._advance(rows, environment)
        if len(begun):
            new = copy(self)
            new._switch_on(len(begun))
            new._chain = self._chain.anew()
            if self.draws is not None and self.coefficients is not None:
                new._chain.put_units(self.draws.names, self.coefficients[begun])
            readings[begun] = new._advance(rows[begun], [v[:, begun] for v in environment])
            _put_rows(
                [*self._chain.memories(), self._memory],
                [*new._chain.memories(), new._memory],
                begun,
            )
            self._reset = np.zeros(0, int)
        return like(readings.reshape(force.shape), specific_force)

    def _advance(self, rows: np.ndarray, environment: list[np.ndarray]) -> np.ndarray:
        """Return the readings of all sensors at the next step, m/s², (n, 3)."""
        # Time is the first axis of the components, as in a recording; sensors are the second.
        now = Environment(self._memory['steps'][None] * self._dt_s, *environment)
        delayed = self._delayed(rows)
        volts = self._volts(now, [delayed[None, :, c] for c in range(3)])
        self._memory['steps'] = self._memory['steps'] + 1
        readings = np.zeros((len(rows), 3))
        readings[:, self.sensor.axis_indices] = to_nominal_mps2(volts, self.sensor)
        return readings

    def _check(self, force: np.ndarray, dt_s: float) -> None:
        """Refuse a call that does not continue the last one."""
        if not force.ndim or force.ndim > 2 or force.shape[-1] != 3:
            raise UserError(f'specific force has the shape {force.shape}; expected (3,) or (n, 3)')
        require_number(f'dt is {dt_s!r}', dt_s)
        if not dt_s > 0:
            raise UserError(f'dt is {dt_s} s; it must be positive')
        if not np.isfinite(force).all():
            raise UserError('the specific force is not finite; check the simulation')
        if not len(self._memory['steps']):
            self._shape = force.shape
            self._dt_s = float(dt_s)
            # A digital filter follows the rate, which here is that of the time steps.
            self._std_v = noise.analog_std_v(replace(self.sensor, rate_hz=1 / self._dt_s))
            self._chain.sensor = replace(self._chain.sensor, rate_hz=1 / self._dt_s)
            self._switch_on(force.size // 3)
            self._draw(np.arange(force.size // 3))
        if force.shape != self._shape:
            raise UserError(
                f'specific force has the shape {force.shape}, but {self._shape} '
                'before; make a new SensorModel'
            )
        if abs(dt_s - self._dt_s) > _SAME_STEP * self._dt_s:
            raise UserError(
                f'dt is {dt_s} s, but {self._dt_s} s before; call it at equal time '
                'steps, or make a new SensorModel'
            )

    def _delayed(self, rows: np.ndarray) -> np.ndarray:
        """Return the force of the instant that `time_offset` sets, from the past samples."""
        if self._delay_s <= 0:
            return rows
        if 'past' not in self._memory:
            steps = self._delay_s / self._dt_s
            newest = max(int(steps) + 1 - POINTS // 2, 0)
            self._past_weights = lagrange_weights(np.array([steps - newest]))[0]
            self._memory['past'] = [rows.copy()] * (newest + POINTS)
        self._memory['past'] = [*self._memory['past'][1:], rows.copy()]
        # The oldest samples, whose newest one has the first weight.
        return sum(
            weight * past
            for weight, past in zip(self._past_weights, reversed(self._memory['past'][:POINTS]))
        )

    def _volts(self, now: Environment, force: list[np.ndarray]) -> np.ndarray:
        """Run the chain, and add the noise behind the filter as `Response` does: V, (n, m)."""
        signals = self._chain.signals(now, time_s=now.time_s, dt_s=self._dt_s, force=force)
        self._chain(Place.FORCE, signals)
        analog_v = self._chain.volts(signals)
        signals.input_v = [
            low_pass(np.asarray(volts), rc_s, self._dt_s, memory, may_step=True)
            for volts, rc_s, memory in zip(analog_v, signals.rc_s, self._memory['filters'])
        ]
        if self._std_v.any():
            decay = np.array([np.exp(-self._dt_s / rc) if rc else 0.0 for rc in signals.rc_s])
            drawn = self._white.standard_normal((force[0].shape[-1], len(decay)))
            if 'noise' in self._memory:  # else it is the first sample, which is stationary
                drawn = decay * self._memory['noise'] + np.sqrt(1 - decay**2) * drawn
            self._memory['noise'] = drawn
            signals.input_v = [v + n for v, n in zip(signals.input_v, (drawn * self._std_v).T)]
        return self._chain.convert(signals)[0]


class SensorNoise:
    """
    A `SensorModel` with the interface of `NoiseModel` in Isaac Lab and mjlab.

    The configuration has `params` and `dt`, and may have `units` and `seed`; see `SensorModel`.
    Both simulators ask for a subclass of their own `NoiseModel`: `export` writes it.
    """

    def __init__(self, noise_model_cfg: Any, num_envs: int, device: str) -> None:
        """Take the configuration; the device is that of the data."""
        self._model = SensorModel(
            noise_model_cfg.params,
            getattr(noise_model_cfg, 'seed', 0),
            getattr(noise_model_cfg, 'units', None),
        )
        self._dt_s = noise_model_cfg.dt

    def reset(self, env_ids: Any = None) -> None:
        """Draw some units again, and clear their memory; all of them for None."""
        self._model.reset(env_ids)

    def __call__(self, data: Any) -> Any:
        """Return the readings of the specific force of one step, m/s², (num_envs, 3)."""
        return self._model(data, self._dt_s)


def _generators(seed: int) -> list[np.random.Generator]:
    """Return the random generators of the units and of the white noise."""
    require_whole('seed', seed)
    return [np.random.default_rng([seed, part]) for part in (1, 0)]


def _put_rows(whole: Any, part: Any, rows: np.ndarray) -> None:
    """Put the memory of some sensors into that of all; sensors are the axis of other length."""
    for key in part if isinstance(part, dict) else range(len(part)):
        old = whole.get(key) if isinstance(whole, dict) else whole[key]
        new = part[key]
        if isinstance(new, dict | list) and old is not None:
            _put_rows(old, new, rows)
        elif isinstance(new, np.ndarray) and old is not None and old.shape != new.shape:
            axis = next(i for i, (m, n) in enumerate(zip(old.shape, new.shape)) if m != n)
            whole[key] = np.array(old)
            np.moveaxis(whole[key], axis, 0)[rows] = np.moveaxis(new, axis, 0)


def _reason_to_leave_out(effect: Effect, delay_s: float) -> str:
    """Return why a simulator cannot call an effect sample by sample; empty if it can."""
    if effect.name == 'time_offset':
        return '' if delay_s >= 0 else 'needs future samples: shift the stamps instead'
    if effect.place is Place.CLOCK:
        return 'needs samples of any distance in time: change the stamps instead'
    if effect.place is Place.REFERENCE:
        return 'is an error of the reference that the sensor was compared with'
    if effect.name == 'lever_arm':
        return 'needs the rotation: set the position of the sensor in the simulator'
    if effect.concern is Concern.STAGE:
        return 'is a property of stage and site: set it in the simulator'
    return ''
