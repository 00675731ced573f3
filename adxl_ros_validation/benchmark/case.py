# SPDX-License-Identifier: Apache-2.0
"""
The interface for methods: what one gets (`Case`), and what it answers (`Finding`).

A method is a function `method(case: Case) -> Finding`; docs/howto/benchmark.md has an example.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

from adxl_ros.api.recordings import read_ideal
from adxl_ros.api.sensors import sensor_of
from adxl_ros.errors import UserError
from adxl_ros.files.recording_columns import Recording
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.sensor import (
    fitted_of,
    get,
    noiseless,
    parameter_of,
    put,
    Sensor,
    to_nominal_mps2,
    with_neutral,
)
from adxl_ros.simulate.motion import Motion
from adxl_ros.simulate.recorded_motion import motion_from_force, motion_from_references
from adxl_ros.simulate.response import Response
import numpy as np

UNKNOWN = 'unknown'
"""Cause that stands for one that the library of effects does not hold."""
_GRID_HZ = 200.0
"""Lowest rate of the grid of simulations, Hz; chosen: twice the bandwidth of hand and stage."""


@dataclass(frozen=True)
class Case:
    """A recording of a real sensor, its reference, and the parameters that it should have."""

    recording: Recording  # What is to be diagnosed
    reference: (
        Recording | None
    )  # Ideal specific force, m/s²; None: stage angles are in `recording`
    stated: Sensor  # Parameters from an earlier part, or of the datasheet

    @cached_property
    def parameters(self) -> Sensor:
        """Return the parameters with the rate of the recording, and measured noise."""
        return sensor_of(self.stated, self.recording).sensor

    @property
    def time_s(self) -> np.ndarray:
        """Return the stamps of the samples, s, (n,)."""
        return self.recording.time_s

    @property
    def v_per_mps2(self) -> np.ndarray:
        """Return the nominal scale factors, V/(m/s²), (m,)."""
        return self.parameters.nominal_scale_v_per_g / G0_MPS2

    @cached_property
    def measured_mps2(self) -> np.ndarray:
        """Return the output by the datasheet, m/s², (n, m)."""
        sensor = self.parameters
        return to_nominal_mps2(self.recording.volts(sensor), sensor)

    @cached_property
    def known(self) -> np.ndarray:
        """Return where the reference is known, (n,); that of a rest is unknown in motion."""
        alpha = self.recording.columns.get('alpha_rad')
        if alpha is None or self.reference is not None:
            return np.ones(len(self.recording), bool)
        return np.isfinite(alpha)

    @cached_property
    def force_mps2(self) -> np.ndarray:
        """Return the specific force along the axes by the reference, m/s², (n, m)."""
        sensor = self.parameters
        return self.simulated_mps2(replace(sensor, effects=(), values={}))

    def simulated_mps2(self, sensor: Sensor | None = None, seed: int | None = None) -> np.ndarray:
        """Return what a sensor (None: the stated one) would give, m/s²; with a seed also noise."""
        unit = self.parameters if sensor is None else sensor
        if seed is None:
            unit = noiseless(unit)
        respond = Response(unit, self.motion, seed or 0, float(self.time_s[0]))
        return to_nominal_mps2(respond(self.time_s), self.parameters)

    def residual_mps2(self, sensor: Sensor | None = None) -> np.ndarray:
        """Return recording minus simulation, m/s², (n, m); NaN where the reference is unknown."""
        rest = self.measured_mps2 - self.simulated_mps2(sensor)
        return np.where(self.known[:, None], rest, np.nan)

    @cached_property
    def motion(self) -> Motion:
        """Return the motion by the reference."""
        if self.reference is None:
            motion = motion_from_references(self.recording, self.parameters)
        else:
            ideal = read_ideal(self.reference, self.recording.epoch_ns)
            motion = motion_from_force(ideal, False)
        return replace(motion, internal_rate_hz=max(self.recording.rate_hz, _GRID_HZ))

    @property
    def surroundings(self) -> Mapping[str, np.ndarray]:
        """Return temperature, °C, and supply, V, (n,) each, as far as they were recorded."""
        columns = self.recording.columns
        return {name: columns[name] for name in ('temperature_c', 'supply_v') if name in columns}

    def tangents(self, effects: Collection[str]) -> dict[Coefficient, np.ndarray]:
        """
        Return what each parameter of some effects changes, m/s² per unit, (n, m) each.

        Effects that this reference cannot show are left out.
        """
        base, found = self.simulated_mps2(), {}
        for effect in effects:
            sensor = with_neutral(self.parameters, [effect])
            for name in fitted_of(effect_named(effect), sensor.axes):
                step = parameter_of(name).scale
                stepped = put(sensor, [name], get(sensor, [name]) + step)
                # A reference without a stage, an ADC or a rotation cannot show some effects.
                with suppress(UserError):
                    found[name] = (self.simulated_mps2(stepped) - base) / step
        return found

    def with_changes(self, changes: Mapping[Coefficient, float]) -> Sensor:
        """Return the parameters with changes of some coefficients, within their bounds."""
        names = list(changes)
        sensor = with_neutral(self.parameters, {name.effect for name in names})
        bounds = np.array([(parameter_of(n).lower, parameter_of(n).upper) for n in names])
        values = get(sensor, names) + np.array([changes[name] for name in names])
        return put(sensor, names, np.clip(values, *bounds.T))

    def rows(self, start: int, stop: int) -> Case:
        """Return a part of the samples."""
        return Case(self.recording.rows(start, stop), self.reference, self.stated)


class Finding(NamedTuple):
    """What a method answers."""

    causes: frozenset[str]  # Effects that it names, `UNKNOWN` for another one; empty: no gap
    probability: float  # How probably that is right, by the method itself, 0 to 1
    parameters: Sensor | None = None  # Corrected parameters; None leaves them as they are
    # Sets of effects of each of which one is a cause, though it does not say which
    one_of: Sequence[frozenset[str]] = ()
    status: str = ''  # partly, insufficient or bad_data; '' follows from the causes


Method = Callable[[Case], Finding]


class LinearFit(NamedTuple):
    """Least squares of the residual over tangents, with errors that are independent."""

    changes: dict[Coefficient, float]
    z: dict[Coefficient, float]  # Change over its standard error
    squares: float  # Sum of squares that is left, (m/s²)²
    samples: int  # Number of samples


def linear_fit(case: Case, tangents: Mapping[Coefficient, np.ndarray]) -> LinearFit:
    """Fit coefficients to the residual, all axes together."""
    rest = case.residual_mps2()[case.known].ravel()
    columns = [change[case.known].ravel() for change in tangents.values()]
    sizes = [float(np.linalg.norm(column)) or 1.0 for column in columns]
    matrix = np.column_stack([column / size for column, size in zip(columns, sizes)])
    values, *_ = np.linalg.lstsq(matrix, rest, rcond=1e-8)
    squares = float(np.sum((rest - matrix @ values) ** 2))
    variance = squares / max(len(rest) - len(columns), 1)
    errors = np.sqrt(np.maximum(variance * np.diag(np.linalg.pinv(matrix.T @ matrix)), 1e-300))
    return LinearFit(
        {name: float(v / size) for name, v, size in zip(tangents, values, sizes)},
        dict(zip(tangents, (values / errors).tolist())),
        squares,
        len(rest),
    )
