# SPDX-License-Identifier: Apache-2.0

"""What is known before the first rest: the calibration in use, its age, and its temperature."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

from adxl_ros.errors import UserError
from adxl_ros.model import signal_chain
from adxl_ros.model.constants import AXES, G0_MPS2, NOMINAL_TEMPERATURE_C
from adxl_ros.model.covariance import coefficient_tangent
from adxl_ros.model.effects.base import Coefficient, NOMINAL_ENVIRONMENT
from adxl_ros.model.sensor import get, parameter_of, Sensor, with_neutral
import numpy as np

EFFECTS = ('bias', 'scale_factor', 'temperature_bias')
"""Effects that every kept calibration has."""
DAYS_A_YEAR = 365.25
_SCALE_DRIFT_PER_YEAR = 1e-3
"""Drift of a scale factor in a year, relative; chosen: datasheets state it seldom, as 0.1 %."""
_CURVATURE_PER_K = 0.01
"""Change of the zero-g's slope over temperature by a kelvin, share of the slope; chosen: as the
typical curvature of the effect `temperature_bias`."""


def _named(effect: str, parameter: str, axes: str) -> tuple[Coefficient, ...]:
    return tuple(Coefficient(effect, parameter, axis) for axis in axes)


class KeptPrior(NamedTuple):
    """Covariances and drift of the coefficients of a kept calibration."""

    known: np.ndarray  # Covariance of the calibration, (p, p)
    drifting: np.ndarray  # What temperature may add to it in a unit of the stated drift, (p, p)
    per_day: np.ndarray  # Variance that a day adds in such a unit, (p,)


@dataclass(frozen=True)
class KeptSensor:
    """A calibration with all coefficients that rests may change, and its derivatives."""

    sensor: Sensor  # Its covariance names the coefficients: p of them

    @classmethod
    def of(cls, sensor: Sensor) -> KeptSensor:
        """Add what may change to a calibration; refuse a sensor that is not calibrated."""
        zero_g = set(_named('bias', 'offset_v', sensor.axes))
        if not zero_g <= set(sensor.covariance_names):
            raise UserError(
                f'{sensor.serial}: the calibration has no uncertainty of its zero-g, which says '
                'how far rests may change it; calibrate the sensor, and give its parameter file'
            )
        if not np.all(sensor.noise_density_g_per_rthz > 0):
            raise UserError(
                f'{sensor.serial}: sensor.noise_density_g_per_rthz is missing or 0; it tells a '
                'rest from a vibration, and `noise` measures it'
            )
        base = with_neutral(sensor, EFFECTS)
        wanted = [
            *_named('bias', 'offset_v', base.axes),
            *_named('scale_factor', 'offset_v_per_g', base.axes),
            *_named('temperature_bias', 'per_k', base.axes),
            *_named('temperature_bias', 'per_k2', base.axes),
        ]
        names = tuple(dict.fromkeys([*wanted, *base.covariance_names]))
        rows = [names.index(name) for name in base.covariance_names]
        covariance = np.zeros((len(names), len(names)))
        covariance[np.ix_(rows, rows)] = base.covariance
        return cls(replace(base, covariance=covariance, covariance_names=names))

    @property
    def names(self) -> tuple[Coefficient, ...]:
        """Return the names of the coefficients, (p,)."""
        return self.sensor.covariance_names

    @property
    def values(self) -> np.ndarray:
        """Return the coefficients, (p,)."""
        return get(self.sensor, self.names)

    def rows(self, effect: str, parameter: str) -> list[int]:
        """Return where the coefficients of a parameter stand, by axis."""
        return [self.names.index(name) for name in _named(effect, parameter, self.sensor.axes)]

    @property
    def calibrated_at_c(self) -> float:
        """Return the temperature of the calibration, °C: the nominal one where it is unknown."""
        stated = self.sensor.envelope.temperature_c
        return NOMINAL_TEMPERATURE_C if stated is None else sum(stated) / 2

    def prior(self, drift_g_per_year: float) -> KeptPrior:
        """Return what is known at the date of the calibration."""
        sensor = self.sensor
        known = self.sensor.covariance
        count = len(sensor.axes)
        drifting = np.zeros_like(known)
        slopes = self.rows('temperature_bias', 'per_k')
        curvatures = self.rows('temperature_bias', 'per_k2')
        if not known[slopes, slopes].any():
            # The zero-g is known at the temperature of the calibration, and not at 25 °C.
            std_per_k = self.typical_slope_g_per_k
            warmer_k = self.calibrated_at_c - NOMINAL_TEMPERATURE_C
            for rows, std, factor in (
                (slopes, std_per_k, warmer_k),
                (curvatures, std_per_k * _CURVATURE_PER_K, warmer_k**2),
            ):
                spread = np.zeros((len(known), count))
                spread[rows, range(count)] = std
                spread[self.rows('bias', 'offset_v'), range(count)] = (
                    -std * factor * sensor.scale_v_per_g
                )
                drifting += spread @ spread.T
        per_day = np.zeros(len(known))
        per_day[self.rows('bias', 'offset_v')] = (
            drift_g_per_year * sensor.scale_v_per_g
        ) ** 2 / DAYS_A_YEAR
        per_day[self.rows('scale_factor', 'offset_v_per_g')] = (
            _SCALE_DRIFT_PER_YEAR * sensor.scale_v_per_g
        ) ** 2 / DAYS_A_YEAR
        return KeptPrior(known, drifting, per_day)

    @property
    def typical_slope_g_per_k(self) -> float:
        """Return the slope of the zero-g over temperature by the datasheet, or a typical one."""
        name = Coefficient('temperature_bias', 'per_k', 'x')
        typical, largest = self.sensor.datasheet.get(name.without_axis, (0.0, 0.0))
        return typical or largest / 2 or parameter_of(name).scale


class Errors(NamedTuple):
    """Derivatives of the measured force, g."""

    by_coefficients: np.ndarray  # By the coefficients, each in its unit, (m, p)
    by_volts: np.ndarray  # By the volts, g/V, (m, m)


class Linear:
    """The inverse of a kept calibration, and its derivatives by the coefficients."""

    def __init__(self, kept: KeptSensor) -> None:
        self._axes = kept.sensor.axes
        self._measured = kept.sensor.axis_indices
        self._respond = signal_chain.analog_response(kept.sensor)
        self._invert = signal_chain.inverse(kept.sensor)
        self._by_coefficient = coefficient_tangent(kept.sensor)

    def force_g(self, volts: np.ndarray, temperature_c: float) -> np.ndarray:
        """Return the force of volts, (m,), g, (3,); NaN where none explains them."""
        environment = NOMINAL_ENVIRONMENT._replace(temperature_c=temperature_c)
        force = self._invert([np.array([v]) for v in volts], environment)
        return np.array([np.ravel(component)[0] for component in force]) / G0_MPS2

    def errors(self, force_g: np.ndarray, temperature_c: float) -> Errors:
        """Return how the measured force errs, near a force, g, (3,)."""
        environment = NOMINAL_ENVIRONMENT._replace(temperature_c=temperature_c)
        force = [float(value) * G0_MPS2 for value in force_g]
        tangent = signal_chain.tangent(self._respond, self._axes, force, environment)
        back = np.array(tangent.back, float).reshape(len(self._axes), -1) / G0_MPS2
        return Errors(back @ self._by_coefficient(force, environment)[:, :, 0], back)

    def zero_g(self, temperature_c: float) -> np.ndarray:
        """Return the error of each zero-g by those of the coefficients, g, (m, p)."""
        return self.errors(np.zeros(len(AXES)), temperature_c).by_coefficients

    def measured(self, force_g: np.ndarray) -> np.ndarray:
        """Return the components of a force along the measured axes, (m,)."""
        return force_g[self._measured]
