# SPDX-License-Identifier: Apache-2.0

"""The signal chain as a call for simulators: one sample of one or many sensors at a time."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from os import PathLike
from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file
from adxl_ros.model import noise
from adxl_ros.model.constants import AXES, NOMINAL_SUPPLY_V, NOMINAL_TEMPERATURE_C
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Effect, Environment, Need, Place, Signals
from adxl_ros.model.filters import low_pass
from adxl_ros.model.sensor import Sensor, to_nominal_mps2
from adxl_ros.model.signal_chain import Chain
from adxl_ros.simulate.motion import check_needs, lagrange_weights, Motion, POINTS
import numpy as np

_SAME_STEP = 1e-6
"""Largest relative change of the time step; chosen: far above rounding of a simulator's clock."""


class SensorModel:
    """
    A sensor in a simulator: specific force of each time step in, readings out.

    All sensors of a batch are copies of one unit with noise of their own. The chain runs at the
    time steps of the simulator. Otherwise it is that of `simulate`, and one sensor gives the same
    readings with the same seed.
    """

    def __init__(self, params: Sensor | str | PathLike, seed: int = 0) -> None:
        """Put the sensors at the time of power-on."""
        # The unit
        self.sensor = params if isinstance(params, Sensor) else parameter_file.load(params)
        check_needs(self.sensor, Motion(0.0))
        self._delay_s = float(self.sensor.values.get('time_offset', {}).get('offset_s', 0.0))
        reasons = {name: _reason_to_leave_out(effect_named(name), self._delay_s)
                   for name in self.sensor.effects}
        # Reason by name of an effect of the unit that is not simulated
        self.left_out = {name: reason for name, reason in reasons.items() if reason}
        self._chain = Chain(
            self.sensor, [name for name in self.sensor.effects if name not in self.left_out], seed)
        self._filters: list[dict[str, Any]] = [{} for _ in self.sensor.axes]
        self._white = np.random.default_rng([seed, 0])
        self._noise: np.ndarray | None = None
        self._past: deque[np.ndarray] = deque()
        self._past_weights = np.zeros(0)
        self._shape: tuple[int, ...] = ()
        self._dt_s = 0.0
        self._std_v = np.zeros(0)
        self._steps = 0

    def __call__(self, specific_force: np.ndarray, dt: float,
                 temperature: float | np.ndarray = NOMINAL_TEMPERATURE_C,
                 supply: float | np.ndarray = NOMINAL_SUPPLY_V) -> np.ndarray:
        """
        Advance by one time step.

        Parameters
        ----------
        specific_force
            Specific force in the frame of the sensor at this step, m/s²: (3,), or (n, 3) for n
            sensors. At rest, an axis that points up has +g.
        dt
            Time step, s; the same in each call.
        temperature
            Temperature, °C: a number, or (n,).
        supply
            Supply voltage, V: a number, or (n,).

        Returns
        -------
        ndarray
            Readings by the nominal conversion, m/s², in the shape of the force, as in
            `imu/data_raw`; 0 for an axis that the sensor does not have.

        Raises
        ------
        UserError
            The shape or the time step is wrong, or changes, or a value is not finite.

        """
        force = np.asarray(specific_force, float)
        self._check(force, dt)
        count = force.size // 3
        # Time is the first axis of the components, as in a recording; sensors are the second.
        now = Environment(*(_of_each(name, values, count) for name, values in (
            ('time', self._steps * self._dt_s), ('temperature', temperature),
            ('supply', supply))))
        rows = self._delayed(force.reshape(-1, 3))
        volts = self._digital_v(self._analog(now, [rows[None, :, c] for c in range(3)]))
        self._steps += 1
        readings = np.zeros((count, 3))
        readings[:, [AXES.index(axis) for axis in self.sensor.axes]] = to_nominal_mps2(
            volts, self.sensor)
        return readings.reshape(force.shape)

    def _check(self, force: np.ndarray, dt_s: float) -> None:
        """Refuse a call that does not continue the last one."""
        if not force.ndim or force.ndim > 2 or force.shape[-1] != 3:
            raise UserError(f'specific force has the shape {force.shape}; expected (3,) or (n, 3)')
        if not dt_s > 0:
            raise UserError(f'dt is {dt_s} s; it must be positive')
        if not np.isfinite(force).all():
            raise UserError('the specific force is not finite; check the simulation')
        if not self._steps:
            self._shape, self._dt_s = force.shape, float(dt_s)
        if force.shape != self._shape:
            raise UserError(f'specific force has the shape {force.shape}, but {self._shape} '
                            'before; make a new SensorModel')
        if abs(dt_s - self._dt_s) > _SAME_STEP * self._dt_s:
            raise UserError(f'dt is {dt_s} s, but {self._dt_s} s before; call it at equal time '
                            'steps, or make a new SensorModel')

    def _delayed(self, rows: np.ndarray) -> np.ndarray:
        """Return the force of the instant that `time_offset` sets, from the past samples."""
        if self._delay_s <= 0:
            return rows
        if not self._steps:
            steps = self._delay_s / self._dt_s
            newest = max(int(steps) + 1 - POINTS // 2, 0)
            self._past_weights = lagrange_weights(np.array([steps - newest]))[0]
            self._past = deque([rows.copy()] * (newest + POINTS), maxlen=newest + POINTS)
        self._past.append(rows.copy())
        # The oldest samples of the queue, whose newest one has the first weight.
        oldest = [self._past[i] for i in range(POINTS)]
        return sum(weight * past for weight, past in zip(self._past_weights, reversed(oldest)))

    def _analog(self, now: Environment, force: list[np.ndarray]) -> Signals:
        """Run the chain up to the filter; its volts are in `input_v`, (1, n) each."""
        signals = self._chain.signals(now, time_s=now.time_s, dt_s=self._dt_s, force=force)
        self._chain(Place.FORCE, signals)
        analog_v = self._chain.volts(signals)
        signals.input_v = [low_pass(np.asarray(volts), rc_s, self._dt_s, memory)
                           for volts, rc_s, memory in zip(analog_v, signals.rc_s, self._filters)]
        return signals

    def _digital_v(self, signals: Signals) -> np.ndarray:
        """Add noise, and run the chain through the ADC: volts, (n, m)."""
        drawn_v = self._draw_noise(signals)
        if drawn_v is not None:
            signals.input_v = [volts + drawn_v[:, d] for d, volts in enumerate(signals.input_v)]
        return self._chain.convert(signals)[0]

    def _draw_noise(self, signals: Signals) -> np.ndarray | None:
        """Draw the noise behind the filter, V, (n, m), as `Response` does; None without any."""
        if not self._steps:
            self._std_v = noise.analog_std_v(replace(self.sensor, rate_hz=1 / self._dt_s))
        if not self._std_v.any():
            return None
        decay = np.array([np.exp(-self._dt_s / rc_s) if rc_s else 0.0 for rc_s in signals.rc_s])
        drawn = self._white.standard_normal((signals.force[0].shape[-1], len(decay)))
        # The first sample is stationary.
        self._noise = drawn if self._noise is None else \
            decay * self._noise + np.sqrt(1 - decay ** 2) * drawn
        return self._noise * self._std_v


def _of_each(name: str, values: float | np.ndarray, count: int) -> np.ndarray:
    """Return a number, or a number for each sensor, as (1, n)."""
    numbers = np.asarray(values, float)
    if numbers.shape not in ((), (count,)):
        raise UserError(f'{name} has the shape {numbers.shape}; expected a number or ({count},)')
    if not np.isfinite(numbers).all():
        raise UserError(f'{name} is not finite; check the simulation')
    return np.broadcast_to(numbers, (1, count))


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
    if effect.place is Place.STAGE or Need.STAGE in effect.needs:
        return 'is a property of stage and site: set it in the simulator'
    return ''
