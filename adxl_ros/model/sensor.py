# SPDX-License-Identifier: Apache-2.0

"""A sensor: its nominal values, effects and provenance, and where its calibration is valid."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, MISSING, replace
from itertools import chain, compress
from typing import Any

from adxl_ros.errors import UserError
from adxl_ros.model.constants import AXES, G0_MPS2, MEASURED_AXES
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import ActsOn, Coefficient, Effect, Parameter, Parameters
from adxl_ros.model.gyroscope import Gyroscope
import numpy as np

MODELS = ('nominal', 'linear', 'physical', 'full', 'gravity')
"""Names of the models that can be fitted."""
MARGIN_K = 2.0
"""Distance from the temperatures of the poses that counts as inside, K; chosen: by the datasheet
it is 0.2 mg, below the noise of a sample. No thermometer is at the element."""
MARGIN_MPS2 = 2.0
"""Distance from the forces of the poses that counts as inside, m/s²; chosen: planes from 30° on
leave 1.3 m/s² to level, and nearby forces share one result."""


def departure_k(temperature_c: Any, nodes_c: Iterable[float]) -> Any:
    """Return (T − T_1)···(T − T_n), K^n, for temperatures T and nodes T_i, °C."""
    product: Any = 1.0
    for node_c in nodes_c:
        product = product * (temperature_c - node_c)
    return product


@dataclass(frozen=True)
class Envelope:
    """
    Validity range of a calibration, and how its covariance grows outside.

    Temperature. A model that ignores temperature drifts outside of the temperatures of its poses,
    as the datasheet states. By ΔT more than `MARGIN_K` outside, an axis with specific force f gets
    the variance (g·k_zero·ΔT)² + (f·k_scale·ΔT)², with the typical slopes k of zero-g and scale
    factor, one standard deviation each. A model that follows temperature has slopes of its own,
    whose covariance grows by itself. What it lacks is of the next degree of the polynomial. Fitted
    to a sensor that has this term c·T^n, the model agrees with it at n temperatures T_i, departing
    elsewhere by p(T) = c·(T − T_1)···(T − T_n), less p at the temperature of the zero-g. The size
    of c, one standard deviation, is what the poses leave open, and what they show of it.

    Pose. The extrapolation ρ of a force is the square of its distance from the middle of the
    poses' forces, divided by half of their range plus `MARGIN_MPS2`, in the component where it is
    largest. A force is outside where ρ > 1. The squares of the model's terms grow as ρ, and the
    covariance by the coefficients does, too. What the model lacks is of higher order: its square
    grows at least as ρ². With the misfit u of held-out poses, an axis gets the variance
    u²·(ρ² − 1), where ρ > 1.
    """

    # Lowest and highest temperature of the poses, °C; None if it was not measured
    temperature_c: tuple[float, float] | None = None
    # Typical slope of the zero-g, g/K, by the datasheet; 0 if the model follows temperature
    zero_g_per_k: float = 0.0
    # Typical slope of the scale factor, 1/K, by the datasheet; 0 if the model follows it
    scale_per_k: float = 0.0
    # Temperatures T_i, °C, (n,); empty if the model does not follow temperature
    zero_g_nodes_c: tuple[float, ...] = ()
    zero_g_next: tuple[float, ...] = ()  # Size of c by axis, g/K^n, (m,)
    zero_g_at_c: float = 0.0  # Temperature at which the zero-g is known, °C
    # Misfit of held-out poses beyond noise and stage error, by axis, m/s²
    misfit_mps2: float = 0.0
    # Lowest specific force of the poses by component, m/s²; empty if unknown
    force_low_mps2: tuple[float, ...] = ()
    force_high_mps2: tuple[float, ...] = ()  # Highest one

    def beyond_k(self, temperature_c: Any) -> Any:
        """Return the distance of temperatures, °C, outside of range and margin, K; 0 inside."""
        if self.temperature_c is None:
            return np.zeros(np.shape(temperature_c))
        low, high = self.temperature_c
        return np.maximum(
            0.0, np.maximum(low - MARGIN_K - temperature_c, temperature_c - high - MARGIN_K)
        )

    def extrapolation(self, force: Sequence[Any]) -> Any:
        """Return the extrapolation ρ of forces, m/s²; 1 inside."""
        rho: Any = 1.0
        for value, low, high in zip(force, self.force_low_mps2, self.force_high_mps2):
            distance = np.abs(value - (low + high) / 2) / ((high - low) / 2 + MARGIN_MPS2)
            rho = np.maximum(rho, distance**2)
        return rho

    def zero_g_std_g(self, temperature_c: Any) -> list[Any]:
        """Return what the next degree over temperature may add, g, by axis; none if unknown."""
        if self.temperature_c is None:
            return []
        departure = departure_k(temperature_c, self.zero_g_nodes_c) - departure_k(
            self.zero_g_at_c, self.zero_g_nodes_c
        )
        return [size * departure for size in self.zero_g_next]

    def added_variance(self, axis_mps2: Any, temperature_c: Any, extrapolation: Any) -> Any:
        """Return the variance, (m/s²)², that each axis gets outside; see above."""
        beyond_k = self.beyond_k(temperature_c)
        return (
            (G0_MPS2 * self.zero_g_per_k * beyond_k) ** 2
            + (axis_mps2 * self.scale_per_k * beyond_k) ** 2
            + self.misfit_mps2**2 * (extrapolation**2 - 1)
        )

    def is_outside(self, temperature_c: Any, force: Sequence[Any]) -> np.ndarray:
        """Return which samples lie outside of the validity range, (n,)."""
        return (self.beyond_k(temperature_c) > 0) | (self.extrapolation(force) > 1)

    def describe_outside(self, temperature_c: float, force: Sequence[float]) -> tuple[str, ...]:
        """Describe in words how one sample lies outside of the validity range."""
        texts = []
        if self.temperature_c is not None and self.beyond_k(temperature_c) > 0:
            low, high = self.temperature_c
            texts.append(
                f'temperature {temperature_c:.1f} degC, calibrated at {low:.1f} to {high:.1f}'
            )
        rho = float(self.extrapolation(force))
        if rho > 1:
            texts.append(
                f'force near {", ".join(f"{f:.1f}" for f in force)} m/s^2, '
                f'{rho**0.5:.2g} times as far out as the calibrated poses'
            )
        return tuple(texts)


def _nominal(
    key: str,
    doc: str,
    unit: str = '',
    lower: float | None = None,
    upper: float | None = None,
    choices: tuple[str, ...] = (),
    placeholder: float | None = None,
    default: Any = MISSING,
) -> Any:
    """
    Declare a nominal value: its key in the parameter file, meaning, unit and bounds.

    A file may leave a value with a `placeholder` out; the value is then in `Sensor.unstated`. One
    with a `default` has that value where a file leaves it out.
    """
    return field(
        default=default,
        metadata={
            'key': key,
            'doc': doc,
            'unit': unit,
            'lower': lower,
            'upper': upper,
            'choices': choices,
            'placeholder': placeholder,
        },
    )


@dataclass(frozen=True, eq=False, repr=False)
class Sensor:
    """
    One sensor: the nominal chain by its nominal values, and the effects that depart from it.

    The metadata of the fields are the only description of the nominal values. Parameter files,
    the nodes' parameters and error messages use them. Arrays have one entry for each measured
    axis, (m,).
    """

    serial: str = _nominal('sensor.serial', 'serial number; nominal is no unit in particular')
    axes: str = _nominal('sensor.axes', 'measured axes', choices=MEASURED_AXES)
    nominal_zero_g_v: np.ndarray = _nominal(
        'sensor.nominal_zero_g_v', 'zero-g output by the datasheet, by axis', 'V', -10.0, 10.0
    )
    nominal_scale_v_per_g: np.ndarray = _nominal(
        'sensor.nominal_scale_v_per_g', 'scale factor by the datasheet, by axis', 'V/g', 1e-3, 10.0
    )
    noise_density_g_per_rthz: np.ndarray = _nominal(
        'sensor.noise_density_g_per_rthz',
        'white noise density, by axis',
        'g/sqrt(Hz)',
        0.0,
        0.1,
        placeholder=0.0,
    )
    rc_resistance_ohm: float = _nominal(
        'sensor.rc_resistance_ohm',
        'output resistance that the filter capacitor sees',
        'Ohm',
        0.0,
        1e9,
        placeholder=0.0,
    )
    rc_capacitance_f: float = _nominal(
        'sensor.rc_capacitance_f',
        'filter capacitor; 0 is no filter',
        'F',
        0.0,
        1.0,
        placeholder=0.0,
    )
    adc_bits: int = _nominal(
        'sensor.adc_bits',
        'resolution of the ADC; 0 does not quantise',
        'bit',
        0,
        32,
        placeholder=0,
    )
    adc_vref_v: float = _nominal(
        'sensor.adc_vref_v', 'full scale of the ADC', 'V', 0.1, 100.0, placeholder=100.0
    )
    rate_hz: float = _nominal('sensor.rate_hz', 'sample rate', 'Hz', 0.01, 100000.0)
    range_g: float = _nominal(
        'sensor.range_g', 'measuring range by the datasheet', 'g', 0.1, 1000.0, placeholder=1000.0
    )
    local_gravity_mps2: float = _nominal(
        'sensor.local_gravity_mps2', 'gravity where the sensor is', 'm/s^2', 9.7, 9.9
    )
    z_sign: int = _nominal(
        'sensor.z_sign',
        'which way up, for the z of equation 5: 1, -1, or 0 where not known',
        '',
        -1,
        1,
    )
    stage_resolution_rad: float = _nominal(
        'stage.resolution_rad',
        "step of the stage's encoder, or of the scale read by hand",
        'rad',
        0.0,
        1.0,
    )
    model: str = _nominal('model', 'what was fitted', choices=MODELS)
    filter_rate_hz: float = _nominal(
        'sensor.filter_rate_hz',
        'sample rate at which the filter is the stated one, because it '
        'is digital and its bandwidth is a fixed share of the rate; 0 is an analog filter',
        'Hz',
        0.0,
        100000.0,
        default=0.0,
    )
    self_test_g: tuple[float, ...] = _nominal(
        'sensor.self_test_g',
        'typical change of the output by the self-test, by axis; empty where not stated',
        'g',
        -100.0,
        100.0,
        default=(),
    )
    self_test_lower_g: tuple[float, ...] = _nominal(
        'sensor.self_test_lower_g',
        'lowest change by the self-test, with its sign, by axis',
        'g',
        -100.0,
        100.0,
        default=(),
    )
    self_test_upper_g: tuple[float, ...] = _nominal(
        'sensor.self_test_upper_g',
        'highest change by the self-test, with its sign, by axis',
        'g',
        -100.0,
        100.0,
        default=(),
    )
    effects: tuple[str, ...] = ()  # Names of the effects
    # Values by effect and parameter, (m,) or (), each in the unit of its parameter
    values: dict[str, dict[str, np.ndarray]] = field(default_factory=dict)
    # Covariance of the coefficients in `covariance_names`, (k, k)
    covariance: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    # Coefficients with a covariance, (k,). The others count as exact.
    covariance_names: tuple[Coefficient, ...] = ()
    # Texts by key: when, from what and by which version the coefficients were fitted
    provenance: dict[str, str] = field(default_factory=dict)
    envelope: Envelope = Envelope()  # Validity range of the calibration
    datasheet_name: str = ''  # Name of the datasheet of `datasheet`
    # Typical and largest departure by parameter, as the datasheet states them, each in the unit of
    # the parameter; 0 where it does not
    datasheet: dict[Coefficient, tuple[float, float]] = field(default_factory=dict)
    # How the driver reaches the sensor: values of `link.*` by name. Its file carries them.
    link: dict[str, Any] = field(default_factory=dict)
    # How the case sits on the robot: values of `mounting.*` by name, which its file carries, too
    mounting: dict[str, Any] = field(default_factory=dict)
    gyro: Gyroscope = Gyroscope()  # The gyroscope beside it
    # Names of the nominal values that the parameter file leaves out. Their fields hold
    # placeholders until `signals.recorded_sensor` measures them.
    unstated: tuple[str, ...] = ()
    # Names of the nominal values that were measured from samples in their place
    measured: tuple[str, ...] = ()

    @property
    def axis_indices(self) -> list[int]:
        """Places of the measured axes among x, y and z."""
        return [AXES.index(axis) for axis in self.axes]

    @property
    def zero_g_v(self) -> np.ndarray:
        """Zero-g output of this sensor, V, (m,)."""
        return self.nominal_zero_g_v + self._value('bias', 'offset_v')

    @property
    def scale_v_per_g(self) -> np.ndarray:
        """Scale factor of this sensor, V/g, (m,)."""
        return self.nominal_scale_v_per_g + self._value('scale_factor', 'offset_v_per_g')

    @property
    def up(self) -> int:
        """Sign of a derived z, 1 or −1: upright where it is not known."""
        return self.z_sign or 1

    @property
    def stage_std_rad(self) -> float:
        """Stated standard deviation of a joint's error, rad: uniform within a step, step/√12."""
        return self.stage_resolution_rad / np.sqrt(12)

    @property
    def rc_s(self) -> float:
        """
        Time constant of the output filter at the sample rate, s.

        An analog filter is the same at each rate, so that its noise aliases where the ADC is slow.
        A digital one decimates: its bandwidth is a fixed share of the rate.
        """
        stated_s = self.rc_resistance_ohm * self.rc_capacitance_f
        return stated_s * self.filter_rate_hz / self.rate_hz if self.filter_rate_hz else stated_s

    def __repr__(self) -> str:
        effects = ', '.join(self.effects) or 'none'
        return f'<Sensor {self.serial}: axes {" ".join(self.axes)}, effects: {effects}>'

    @property
    def lsb_v(self) -> float:
        """Step of the ADC, V; 0 where it does not quantise."""
        return self.adc_vref_v / 2**self.adc_bits if self.adc_bits else 0.0

    def parameters(self, effect: str) -> Parameters:
        """Return the values of one of its effects in the form that its `apply` takes."""
        arrays = {name: np.asarray(value, float) for name, value in self.values[effect].items()}
        return {
            name: tuple(value.tolist()) if value.ndim else float(value)
            for name, value in arrays.items()
        }

    def saturated(self, volts: np.ndarray) -> np.ndarray:
        """Return where volts, (n, m), are at a rail of the ADC or beyond the range, (n, m)."""
        beyond = np.abs(volts - self.nominal_zero_g_v) > self.range_g * self.nominal_scale_v_per_g
        if self.adc_bits:
            beyond |= (volts <= 0) | (volts >= self.adc_vref_v - self.lsb_v)
        return beyond

    def computed_at(self, rate_hz: float) -> Sensor:
        """Return the sensor for a computation at another rate, Hz; its filter stays as it is."""
        return replace(
            self, rate_hz=rate_hz, filter_rate_hz=self.filter_rate_hz * rate_hz / self.rate_hz
        )

    def without_covariance(self) -> Sensor:
        """Return the sensor with coefficients that count as exact."""
        return replace(self, covariance=np.zeros((0, 0)), covariance_names=())

    def with_covariance_of(self, kept: Sequence[bool]) -> Sensor:
        """Return the sensor with the covariance of marked coefficients; others count as exact."""
        return replace(
            self,
            covariance=self.covariance[np.ix_(kept, kept)],
            covariance_names=tuple(compress(self.covariance_names, kept)),
        )

    def without_temperature_range(self) -> Sensor:
        """Return the sensor for samples whose temperature is not known: none is outside."""
        return replace(self, envelope=replace(self.envelope, temperature_c=None))

    def _value(self, effect: str, parameter: str) -> np.ndarray:
        """Return a coefficient by axis, (m,); 0 without the effect."""
        return self.values.get(effect, {}).get(parameter, np.zeros(len(self.axes)))


def without_self_test(sensor: Sensor) -> Sensor:
    """Return a sensor of which nothing states the self-test, as that of a part with other axes."""
    return replace(sensor, self_test_g=(), self_test_lower_g=(), self_test_upper_g=())


def with_axes(sensor: Sensor, axes: str) -> Sensor:
    """
    Give a nominal sensor the axes of a stream.

    Axes are removed from the end, or added with the values that all axes share.
    """
    if axes == sensor.axes:
        return sensor
    if sensor.effects:
        raise UserError(
            f'the parameters of {sensor.serial} are calibrated for the axes '
            f'{sensor.axes}, not {axes}; name the parameter file of this sensor'
        )
    changed: dict[str, Any] = {}
    for name in ('nominal_zero_g_v', 'nominal_scale_v_per_g', 'noise_density_g_per_rthz'):
        values = getattr(sensor, name)
        if len(axes) > len(values) and np.ptp(values) > 0:
            raise UserError(
                f'sensor.{name}: {values.tolist()} for {sensor.axes} does not '
                f'determine the value of the other axes of {axes}; name a parameter '
                f'file for {axes}'
            )
        changed[name] = np.array([*values, *[values[0]] * 3])[: len(axes)]
    if len(axes) > len(sensor.axes):
        # A part with more axes has another datasheet.
        changed |= {'datasheet_name': '', 'datasheet': {}}
    return replace(without_self_test(sensor), axes=axes, **changed)


def to_volts(accel_mps2: np.ndarray, sensor: Sensor) -> np.ndarray:
    """Undo the nominal conversion, which is affine and exact: volts, (n, m)."""
    return sensor.nominal_zero_g_v + accel_mps2 / G0_MPS2 * sensor.nominal_scale_v_per_g


def to_nominal_mps2(volts: np.ndarray, sensor: Sensor) -> np.ndarray:
    """Convert volts, (n, m), by the nominal zero-g and scale factor (equation 3)."""
    return (volts - sensor.nominal_zero_g_v) / sensor.nominal_scale_v_per_g * G0_MPS2


def coefficients_of(effects: Iterable[str], axes: str) -> list[Coefficient]:
    """Name the coefficients of effects, effect by effect."""
    return list(chain.from_iterable(names_of(effect_named(name), axes) for name in effects))


def names_of(effect: Effect, axes: str) -> tuple[Coefficient, ...]:
    """Name the coefficients of an effect: by parameter, for those measured axes that it has."""
    names = []
    for p in effect.parameters:
        owners = axes if p.axes else ('',)
        names += [Coefficient(effect.name, p.name, axis) for axis in owners if axis in p.axes]
    return tuple(names)


def fitted_of(effect: Effect, axes: str) -> tuple[Coefficient, ...]:
    """Name the coefficients as `names_of`, without those of parameters that fits hold."""
    held = {p.name for p in effect.parameters if p.held}
    return tuple(name for name in names_of(effect, axes) if name.parameter not in held)


def parameter_of(name: Coefficient) -> Parameter:
    """Return the description of a coefficient's parameter."""
    return next(p for p in effect_named(name.effect).parameters if p.name == name.parameter)


def neutral(effect: Effect, axes: str) -> dict[str, np.ndarray]:
    """Return the neutral values of an effect by parameter, (m,) or (), each in its unit."""
    return {
        p.name: np.full(len(axes), p.neutral) if p.axes else np.array(p.neutral)
        for p in effect.parameters
    }


def typical(effect: Effect, axes: str) -> dict[str, np.ndarray]:
    """Return the typical values of an effect as `neutral` does; other axes stay neutral."""
    values = neutral(effect, axes)
    for p in effect.parameters:
        has_axis = [a in p.axes for a in axes] if p.axes else ()
        values[p.name][has_axis] = p.scale if p.typical is None else p.typical
    return values


def with_neutral(sensor: Sensor, effects: Iterable[str]) -> Sensor:
    """Add effects to a sensor at their neutral values; those that it has stay as they are."""
    added = [name for name in dict.fromkeys(effects) if name not in sensor.effects]
    values = {name: neutral(effect_named(name), sensor.axes) for name in added}
    return replace(sensor, effects=(*sensor.effects, *added), values={**sensor.values, **values})


def without_effect(sensor: Sensor, effect: str) -> Sensor:
    """Return the sensor without an effect and its covariance; it may not have it."""
    return replace(
        sensor.with_covariance_of([name.effect != effect for name in sensor.covariance_names]),
        effects=tuple(name for name in sensor.effects if name != effect),
        values={name: value for name, value in sensor.values.items() if name != effect},
    )


def with_values(sensor: Sensor, effect: str, values: Mapping[str, Any]) -> Sensor:
    """Return a sensor with changed parameters of an effect; one number stands for all axes."""
    before = sensor.values[effect]
    changed = {name: np.full_like(before[name], value, float) for name, value in values.items()}
    return replace(sensor, values={**sensor.values, effect: {**before, **changed}})


def noiseless(sensor: Sensor) -> Sensor:
    """Return the sensor without noise and without the steps of its ADC."""
    mean = tuple(e for e in sensor.effects if effect_named(e).acts_on is ActsOn.MEAN)
    # Without an ADC there are no rails, and pseudo-volts may be negative.
    bits = 48 if sensor.adc_bits else 0
    return replace(
        sensor,
        noise_density_g_per_rthz=np.zeros(len(sensor.axes)),
        adc_bits=bits,
        effects=mean,
        values={e: sensor.values[e] for e in mean},
    )


def get(sensor: Sensor, names: Sequence[Coefficient]) -> np.ndarray:
    """Return the values of coefficients, (k,), each in the unit of its parameter."""
    return np.array(
        [sensor.values[name.effect][name.parameter][_index(sensor, name)] for name in names], float
    )


def put(
    sensor: Sensor, names: Sequence[Coefficient], coefficients: Sequence[float] | np.ndarray
) -> Sensor:
    """Return a copy of the sensor with other values of some coefficients, (k,)."""
    values = dict(sensor.values)
    for effect in {name.effect for name in names}:
        values[effect] = {p: np.array(value, float) for p, value in values[effect].items()}
    for name, value in zip(names, coefficients):
        values[name.effect][name.parameter][_index(sensor, name)] = value
    return replace(sensor, values=values)


def _index(sensor: Sensor, name: Coefficient) -> int | tuple[()]:
    """Return where a coefficient stands in the array of its parameter."""
    return sensor.axes.index(name.axis) if name.axis else ()
