# SPDX-License-Identifier: Apache-2.0

"""The gyroscope as a call for simulators: angular velocity of one step in, readings out."""

from __future__ import annotations

from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.model.constants import NOMINAL_TEMPERATURE_C
from adxl_ros.model.effects.adc import flicker_filter
from adxl_ros.model.gyroscope import Gyroscope, NO_TURN
from adxl_ros.simulate.host_arrays import chosen, like, of_each, on_host
import numpy as np

_SEED_PART = 2  # Part of a seed that is the gyroscope's. Chosen: others are its accelerometer's


class GyroscopeModel:
    """
    A gyroscope in a simulator: bias over temperature, white noise, 1/f noise and random walk.

    A value that the parameters do not state is 0. Scale factor, misalignment, range and filter
    are ideal.
    """

    def __init__(self, gyro: Gyroscope, seed: int = 0) -> None:
        """
        Put the sensors at the time of power-on.

        Parameters
        ----------
        gyro
            The gyroscope of a `Sensor`.
        seed
            Seed of the noise.

        """
        self._gyro = gyro
        self._rng = np.random.default_rng([seed, _SEED_PART])
        self._white = np.array(gyro.noise_density_radps_per_rthz or NO_TURN)
        self._flicker = np.array(gyro.flicker_radps_per_rthz or NO_TURN)
        self._walk = np.array(gyro.walk_radps_per_rts or NO_TURN)
        self._wandered = np.zeros((0, 3))  # Random walk of each sensor, rad/s, (n, 3)
        self._sections = np.zeros((0, 6))
        self._state = np.zeros((0, 2, 0, 3))  # Memory of the 1/f noise, (k, 2, n, 3)

    def reset(self, env_ids: Any = None, seed: int | None = None) -> None:
        """Begin anew; see `SensorModel.reset`."""
        if seed is not None:
            self._rng = np.random.default_rng([seed, _SEED_PART])
        if len(self._wandered):
            rows = chosen(env_ids, len(self._wandered))
            self._wandered[rows] = 0.0
            self._state[:, :, rows] = 0.0

    def __call__(
        self, angular_velocity: Any, dt: float, temperature: Any = NOMINAL_TEMPERATURE_C
    ) -> Any:
        """
        Advance by one time step.

        Parameters
        ----------
        angular_velocity
            Angular velocity in the frame of the sensor, rad/s: (3,), or (n, 3) for n sensors; an
            array of numpy, torch or jax.
        dt
            Time step, s; the same in each call.
        temperature
            Temperature, °C: a number, or (n,).

        Returns
        -------
        array
            Readings, rad/s, as an array of the same library and shape.

        Raises
        ------
        UserError
            The shape or the time step is wrong, or a value is not finite.

        """
        rates = np.asarray(on_host(angular_velocity), float)
        if not rates.ndim or rates.ndim > 2 or rates.shape[-1] != 3:
            raise UserError(
                f'angular velocity has the shape {rates.shape}; expected (3,) or (n, 3)'
            )
        if not dt > 0 or not np.isfinite(rates).all():
            raise UserError(f'dt is {dt} s, or the angular velocity is not finite')
        rows = rates.reshape(-1, 3)
        if not len(self._wandered):
            self._wandered = np.zeros(rows.shape)
            self._sections = flicker_filter(1 / dt)
            self._state = np.zeros((len(self._sections), 2, *rows.shape))
        if rows.shape != self._wandered.shape:
            raise UserError(
                f'angular velocity of {len(rows)} sensors, but of {len(self._wandered)} before; '
                'make a new SensorModel'
            )
        temperature_c = of_each('temperature', temperature, len(rows))[0]
        readings = rows + self._gyro.bias_at(temperature_c) + self._noise(dt)
        return like(readings.reshape(rates.shape), angular_velocity)

    def _noise(self, dt_s: float) -> np.ndarray:
        """Return the noise of the next step, rad/s, (n, 3)."""
        white, slow, steps = self._rng.standard_normal((3, *self._wandered.shape))
        self._wandered = self._wandered + self._walk * np.sqrt(dt_s) * steps
        # The density over positive frequencies ends at half of the rate.
        noise = self._white * np.sqrt(0.5 / dt_s) * white + self._wandered
        if not self._flicker.any():
            return noise
        # scipy.signal takes 0.5 s to import.
        from scipy.signal import sosfilt

        drawn, self._state = sosfilt(self._sections, slow[None], axis=0, zi=self._state)
        return noise + self._flicker * drawn[0]
