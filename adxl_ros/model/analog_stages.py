# SPDX-License-Identifier: Apache-2.0

"""The analog stages of the chain: mounting, sensing element and electronics."""

from __future__ import annotations

from collections.abc import Callable

from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import (
    Apply,
    Components,
    Environment,
    NOMINAL_ENVIRONMENT,
    Parameters,
    Place,
    Signals,
)
from adxl_ros.model.sensor import Sensor
import numpy as np


class AnalogStages:
    """The stages of the chain from specific force to the input of the ADC, one after the other."""

    def __init__(self, sensor: Sensor) -> None:
        """Take the invertible effects of a sensor."""
        self._effects = {place: effects_at(sensor, place, True)
                         for place in (Place.MOUNTING, Place.ELEMENT, Place.ELECTRONICS)}
        self._zero_g_v = sensor.nominal_zero_g_v.tolist()
        self._scale_v_per_g = sensor.nominal_scale_v_per_g.tolist()

    def sense(self, force: Components, environment: Environment) -> Signals:
        """
        Begin the chain with the effects of the mounting.

        force: specific force in the case frame, m/s², three components (n,) or floats.
        """
        signals = Signals(environment, sensed=[f / G0_MPS2 for f in force],
                          nominal_scale_v_per_g=self._scale_v_per_g)
        for apply, values in self._effects[Place.MOUNTING]:
            apply(signals, values)
        return signals

    def respond(self, signals: Signals) -> None:
        """Set the output of the sensing element."""
        signals.output = list(signals.sensed)
        for apply, values in self._effects[Place.ELEMENT]:
            apply(signals, values)

    def amplify(self, signals: Signals) -> None:
        """Set zero-g and scale factor."""
        signals.zero_g_v, signals.scale_v_per_g = list(self._zero_g_v), list(self._scale_v_per_g)
        for apply, values in self._effects[Place.ELECTRONICS]:
            apply(signals, values)

    def volts(self, force: Components, environment: Environment = NOMINAL_ENVIRONMENT
              ) -> Components:
        """
        Return the volts at the input of the ADC.

        force: specific force in the case frame, m/s², three components (n,) or floats; returns:
        volts by measured axis, V.
        """
        signals = self.sense(force, environment)
        self.respond(signals)
        self.amplify(signals)
        return output_volts(signals)


def analog_response(sensor: Sensor) -> Callable[..., Components]:
    """Prepare `signal_chain.static_response` up to the input of the ADC."""
    return AnalogStages(sensor).volts


def output_volts(signals: Signals) -> Components:
    """Turn the output of the element into volts, by measured axis."""
    return [zero + scale * out for zero, scale, out in
            zip(signals.zero_g_v, signals.scale_v_per_g, signals.output)]


def effects_at(sensor: Sensor, place: Place, invertible: bool | None = None
               ) -> list[tuple[Apply, Parameters]]:
    """
    Return the effects of a sensor at a place of the chain.

    Parameters
    ----------
    sensor
        The unit.
    place
        Place of the chain.
    invertible
        Whether to return only effects that the inverse undoes.

    Returns
    -------
    list
        The function `apply` and the parameters of each effect, in the sensor's order.

    """
    return [(e.apply, parameters(sensor, e.name)) for e in map(effect_named, sensor.effects)
            if e.place is place and (e.invertible or not invertible)]


def parameters(sensor: Sensor, effect: str) -> Parameters:
    """
    Return the parameters of one effect in the form that its `apply` takes.

    Parameters
    ----------
    sensor
        A sensor with the effect.
    effect
        Name of the effect.

    Returns
    -------
    dict
        By name: a tuple of floats, one for each measured axis, or a float.

    """
    values = {name: np.asarray(value, float).tolist()
              for name, value in sensor.values[effect].items()}
    return {name: tuple(v) if isinstance(v, list) else v for name, v in values.items()}
