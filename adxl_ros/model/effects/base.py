# SPDX-License-Identifier: Apache-2.0

"""Descriptions of effects with hints for the diagnosis, and the signals that they change."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, KW_ONLY
from enum import auto, Enum, IntEnum
import math
from typing import Any, NamedTuple

from adxl_ros.model.constants import AXES, NOMINAL_SUPPLY_V, NOMINAL_TEMPERATURE_C
import numpy as np

Value = Any
"""One component of a signal: an array over samples, (n,), or a float for one sample.

Effects compute component by component with plain arithmetic. One description then serves
recordings (arrays) and live samples (floats, which avoid the cost of small arrays)."""
Components = list[Value]
"""Components of a vector: those of the case frame, or one for each measured axis."""
Parameters = dict[str, Any]
"""Values by name: a tuple of floats, one for each measured axis, or a float without axes."""
Apply = Callable[['Signals', Parameters], None]
"""Function of an effect: changes the signals of its place by the values of its parameters."""


class StraightLine(Enum):
    """Coefficient of the straight line from specific force to volts that an effect changes."""

    ZERO_G = auto()
    SCALE_FACTOR = auto()


class DriftSpectrum(Enum):
    """
    Spectrum of a zero-g that drifts; it decides which filter makes the drift white.

    The first parameter of such an effect is its density: g/√s of a random walk, g/√Hz at 1 Hz of
    1/f noise.
    """

    RANDOM_WALK = auto()
    FLICKER = auto()


class Detector(Enum):
    """Statistic of the noise that shows an effect, which has all parameters that it estimates."""

    REPEATED_SAMPLES = auto()  # Estimates rate_hz and duration_s
    ISOLATED_SAMPLES = auto()  # Estimates rate_hz and amplitude_v
    COARSE_CODES = auto()  # Estimates lost_bits and axis_lost_bits
    MAINS_LINE = auto()  # Estimates amplitude_v, frequency_hz and phase_rad
    NOISE_LEVEL = auto()  # Estimates ratio
    HELD_AT_END = auto()  # Estimates limit_g and offset_g


class Manoeuvre(Enum):
    """A manoeuvre that the diagnosis can propose; `next_experiment` describes each."""

    SHAKE = auto()
    SPEEDS = auto()
    PLANES = auto()
    REMOUNT = auto()
    HEAT = auto()
    SUPPLY = auto()


class FormDimension(Enum):
    """
    Quantity over which the form of an effect differs between sensors of one type.

    A real sensor has a curve of its own over the quantity, near that of the effect's function.
    The values are the names of the flexible dimensions of the diagnosis.
    """

    FORCE = 'force'  # Specific force along the axis
    CROSS_FORCE = 'cross_force'  # Specific force across the axis
    DIRECTION = 'direction'  # Of the last change of joints and force: the branch of a loop
    RATE = 'rate'  # Rates of the joints
    ALPHA = 'alpha_rad'
    BETA = 'beta_rad'
    TEMPERATURE = 'temperature_c'
    WARMING = 'warming'  # Recent history of the temperature: the branch of a loop
    SUPPLY = 'supply_v'
    TIME = 'time_s'
    AGEING = 'ageing'  # Force times a slow function of time: a scale factor that changes
    SINCE_MOVE = 'since_move_s'  # Time since the last move
    CODE = 'code'  # Code of the ADC
    LAG = 'lag'  # Recent history of the specific force along the axis


class ProofVariable(Enum):
    """Variable over which a plot shows that an effect is there, with its unit, for people."""

    OWN_FORCE = 'specific force along the axis, g'
    CROSS_FORCE = 'specific force along the other axis, g'
    FORCE_Z = 'specific force along z, g'
    FORCE_RATE = 'change of the specific force along the axis, g/s'
    ALPHA = 'alpha, °'
    BETA = 'beta, °'
    ALPHA_RATE = 'rate of alpha, °/s'
    BETA_RATE = 'rate of beta, °/s'
    ALPHA_ACCELERATION = 'angular acceleration of alpha, °/s²'
    BETA_ACCELERATION = 'angular acceleration of beta, °/s²'
    TEMPERATURE = 'temperature, °C'
    TEMPERATURE_RATE = 'change of the temperature, K/min'
    SUPPLY = 'supply, V'
    TIME = 'time, s'
    OUTPUT = 'output, V'
    FREQUENCY = 'frequency, Hz'  # The plot shows spectra
    STEP = 'change from one sample to the next, mg'  # No plot, but counts and sizes


@dataclass(frozen=True)
class DiagnosisHints:
    """Properties of an effect that only the diagnosis uses."""

    # Coefficient of the straight line that the effect is; None for all other effects
    straight_line: StraightLine | None = None
    # Day-to-day standard deviation of a healthy unit's coefficients, in addition to the covariance
    # of the parameter file. The unit is that of the parameter, but g for the zero-g and 1 for the
    # scale factor. An effect with this value is a nuisance parameter of every hypothesis.
    healthy_std: float | None = None
    # Nominal values of `Sensor` that state the effect's. Where a file leaves one out, a healthy
    # unit may have any, and the nuisance parameter is free.
    stated_by: tuple[str, ...] = ()
    # Whether zero-g and scale factor together imitate the effect completely
    imitated: bool = False
    # Name of the parameter that is a time constant, s. Recordings that are not much longer do not
    # show it: the effect would imitate what drives it.
    time_constant: str = ''
    drift: DriftSpectrum | None = None  # Spectrum, if the effect lets the zero-g drift
    # Largest density of a healthy unit's drift, in the unit of the parameter
    healthy_density: float = 0.0
    detector: Detector | None = None  # Statistic of the noise that shows the effect
    revealed_by: Manoeuvre | None = None  # Manoeuvre that shows the effect best
    # Name of the parameter, rad, that changes by π when the sensor is remounted by half a turn
    # about its z axis; empty for other effects
    half_turn: str = ''
    # Dimensions along which the form differs between real sensors. Empty where the form is exact,
    # as of geometry, of a clock and of a straight line, and for effects of the noise.
    form: tuple[FormDimension, ...] = ()
    # Variables over which the effect shows; the report takes the one that shows it best
    proof: tuple[ProofVariable, ...] = ()

    @property
    def nuisance(self) -> bool:
        """Whether the coefficients are free in every hypothesis, within their tolerance."""
        return self.healthy_std is not None

    @property
    def absorbed(self) -> bool:
        """Whether nuisance parameters can imitate the effect in a hypothesis without it."""
        return self.nuisance or self.imitated


class Maths(NamedTuple):
    """Elementary functions of values; a formula that takes them serves arrays and floats alike."""

    sqrt: Callable[[Value], Value]
    sin: Callable[[Value], Value]
    cos: Callable[[Value], Value]
    atan2: Callable[[Value, Value], Value]
    maximum: Callable[[Value, Value], Value]
    where: Callable[[Value, Value, Value], Value]


ARRAYS = Maths(np.sqrt, np.sin, np.cos, np.arctan2, np.maximum, np.where)
"""Functions for arrays, (n,)."""
FLOATS = Maths(
    math.sqrt,
    math.sin,
    math.cos,
    math.atan2,
    max,
    lambda condition, value, otherwise: value if condition else otherwise,
)
"""Functions for single samples: ten times faster than those of numpy."""


class Place(IntEnum):
    """
    Place of an effect in the chain; the chain runs in this order.

    The clock is last because it decides which stamp a sample gets. It is evaluated first: samples
    are taken at their instants, and nothing is resampled. Effects of the reference change the
    specific force that another instrument or simulator states, before the sensor follows it.
    """

    REFERENCE = 0
    STAGE = 1
    FORCE = 2
    MOUNTING = 3
    ELEMENT = 4
    ELECTRONICS = 5
    ADC = 6
    CODE = 7
    CLOCK = 8


class Environment(NamedTuple):
    """Surroundings of the sensor."""

    time_s: Value  # Time since power-on, s
    temperature_c: Value = NOMINAL_TEMPERATURE_C  # Temperature of the sensor, °C
    supply_v: Value = NOMINAL_SUPPLY_V  # Supply voltage of the sensor, V


NOMINAL_ENVIRONMENT = Environment(time_s=float('inf'))
"""Temperature and supply of the datasheet values, so long after power-on that drifts are 0."""


class Joint(NamedTuple):
    """Motion of one joint of the stage."""

    position: Value = 0.0  # Angle, rad, or shift, m
    velocity: Value = 0.0
    acceleration: Value = 0.0


@dataclass
class Signals:
    """Signals of the chain, component by component. Effects change the signals of their place."""

    environment: Environment  # Surroundings at the instants of the samples
    # CLOCK: stamps, s, which effects turn into the instants of the samples. REFERENCE: the same of
    # all samples of the reference.
    time_s: Value = 0.0
    # STAGE: joints as the encoders read them, which effects turn into the true ones
    alpha: Joint = Joint()
    beta: Joint = Joint()
    shift: Joint = Joint()
    # STAGE: the vertical in the frame of the stage's base, a unit vector; at first it is level
    up: Components = field(default_factory=lambda: [0.0, 0.0, 1.0])
    gravity_mps2: float = 0.0  # STAGE: local gravity, m/s²
    # FORCE: specific force in the case frame, m/s², three components. REFERENCE: the force that
    # the reference states, all of it, which effects turn into the one that acts on the sensor.
    force: Components = field(default_factory=list)
    # FORCE: angular rate, rad/s, and acceleration, rad/s², of the case by a robot; None for a
    # stage, whose joints have them
    rotation: tuple[Components, Components] | None = None
    # REFERENCE: force per unit of each error of a robot, m/s²; see `simulate.robot`
    modes: dict[str, Components] = field(default_factory=dict)
    # MOUNTING: specific force along the sensing axes, g, always three components. Axes that are
    # not measured keep the component along the axis of the case.
    sensed: Components = field(default_factory=list)
    # ELEMENT: output of the sensing element, g; it begins as `sensed`. Effects read `sensed` and
    # add to `output`, so that their order does not matter.
    output: Components = field(default_factory=list)
    # ELECTRONICS: zero-g, V, and scale factor, V/g, by measured axis
    zero_g_v: Components = field(default_factory=list)
    scale_v_per_g: Components = field(default_factory=list)
    # ELECTRONICS: time constant of the RC filter by measured axis, s
    rc_s: list[float] = field(default_factory=list)
    # ELECTRONICS: density of the white noise divided by the nominal one, by measured axis
    noise_ratio: list[float] = field(default_factory=list)
    # ELECTRONICS: step of the ADC by measured axis, V; 0 where it does not quantise
    lsb_v: list[float] = field(default_factory=list)
    # ADC: volts at the input of the ADC by measured axis. Effects only read them.
    input_v: Components = field(default_factory=list)
    # ADC: `input_v` with the contributions of effects. CODE: volts that the ADC outputs.
    volts: Components = field(default_factory=list)
    # Nominal scale factor by measured axis, V/g, which turns g into volts at the ADC
    nominal_scale_v_per_g: list[float] = field(default_factory=list)
    vref_v: float = 0.0  # Full scale of the ADC, V
    dt_s: float = 0.0  # Time between the samples of the arrays, s
    # What the current effect keeps from one block to the next; empty before the first
    memory: dict[Any, Any] = field(default_factory=dict)
    # Random generator of the current effect, seeded for it alone
    rng: np.random.Generator | None = None


@dataclass(frozen=True, order=True)
class Coefficient:
    """A parameter of an effect, for one axis; as text it is `effect.parameter.axis`."""

    effect: str  # Name of the effect
    parameter: str  # Name of its parameter, whose unit it has
    axis: str = ''  # Empty for a parameter without axes, and for all axes of a parameter

    @classmethod
    def parse(cls, text: str) -> Coefficient:
        """Read `effect.parameter.axis` or `effect.parameter`."""
        return cls(*text.split('.'))

    def __str__(self) -> str:
        return '.'.join(part for part in (self.effect, self.parameter, self.axis) if part)

    @property
    def without_axis(self) -> Coefficient:
        """Return the name of the parameter, for all of its axes."""
        return Coefficient(self.effect, self.parameter)


class Role(Enum):
    """Role of a parameter in its effect; fits and the diagnosis treat each role differently."""

    SIZE = auto()  # Strength of the effect, which does nothing at the neutral value
    OPTIONAL = auto()  # A size that is usually neutral: fits leave it out, and files may do so
    SHAPE = auto()  # A frequency, time or the like, without influence where sizes are neutral
    LIMIT = auto()  # A bound of the signal, without influence where no sample reaches it


class ActsOn(Enum):
    """Property of the output in which an effect shows."""

    MEAN = 'mean'
    NOISE = 'noise'  # The statistics of the noise only


class Concern(Enum):
    """What an effect is an error of: a verdict names it."""

    REFERENCE = 'reference'  # The other instrument or simulator that states the specific force
    STAGE = 'stage'  # The stage, its encoders and its site
    SENSOR = 'sensor'  # The sensor with its mount, its link and its stamps


class Need(Enum):
    """Part of the chain without which an effect has nothing to act on."""

    STAGE = 'stage'
    ROTATION = 'rotation'  # Of a stage, or of the frame of a robot
    ROBOT = 'robot'
    FILTER = 'filter'
    ADC = 'adc'
    NOISE = 'noise'


@dataclass(frozen=True)
class Parameter:
    """One parameter of an effect, a departure from the nominal chain."""

    name: str  # It ends in its unit where it has one
    _: KW_ONLY
    unit: str  # As messages show it
    scale: float  # Typical magnitude
    source: str  # Source of the typical magnitude: datasheet, paper or physics
    doc: str  # Meaning, in words that continue "it is the ..."
    # Bounds of a value, which files and fits keep to. Most are ten to a hundred times the typical
    # magnitude: what is beyond them is no departure but another sensor, or a wrong unit. A lower
    # bound of 0 is that of a quantity without a sign.
    upper: float
    lower: float = math.nan  # −upper unless given
    # Axes that it applies to, with one value for each measured axis; values of other axes are
    # neutral. Empty for one value without axes. At ELEMENT and ELECTRONICS, the value of an axis
    # changes the output of that axis only.
    axes: str = AXES
    # Value at which the effect does nothing. A parameter of shape has its typical value there.
    neutral: float = 0.0
    # Value of an effect that is stated by name only; `scale` unless given
    typical: float | None = None
    # Whether fits leave it as it is, because zero-g and scale factor can take its place
    held: bool = False
    role: Role = Role.SIZE  # Role in its effect
    # Values from which a fit starts, in rising order: of a shape, or of a size in which the effect
    # is far from linear. Empty for multiples of the typical magnitude.
    starts: tuple[float, ...] = ()
    # Only for a size: whether the shape parameters of its effect change what it does
    shaped: bool = True

    def __post_init__(self) -> None:
        """Fill in the lower bound."""
        if math.isnan(self.lower):
            object.__setattr__(self, 'lower', -self.upper)

    @property
    def is_size(self) -> bool:
        """Whether it is a strength of the effect, and not a shape or a limit."""
        return self.role in (Role.SIZE, Role.OPTIONAL)


@dataclass(frozen=True)
class Shape(Parameter):
    """A parameter of shape: it has no axes, and its neutral value is the typical one."""

    axes: str = ''
    role: Role = Role.SHAPE

    def __post_init__(self) -> None:
        """Fill in the neutral value."""
        super().__post_init__()
        object.__setattr__(self, 'neutral', self.scale)


@dataclass(frozen=True)
class OptionalSize(Parameter):
    """A size that is usually neutral."""

    typical: float | None = 0.0
    role: Role = Role.OPTIONAL


@dataclass(frozen=True)
class Effect:
    """One effect of a real sensor, as the simulator, the inverse and the fits use it."""

    name: str  # It is unique in the library
    place: Place
    parameters: tuple[Parameter, ...]
    # The function of the effect. It takes arrays, and floats too if the effect is invertible.
    apply: Apply
    cause: str  # Sentence for a report: the cause, and what to do about it
    smooth: bool = True  # Whether the output is differentiable by the parameters
    # Whether the form of the effect is certain, as that of geometry or of a clock
    exact: bool = False
    # Property of the output in which the effect shows
    acts_on: ActsOn = ActsOn.MEAN
    # Whether the inverse undoes the effect. The effect then is a smooth function of force and
    # environment of one sample. Effects of the stage, with a memory or with noise are not.
    invertible: bool = False
    # Parts of the chain that the effect acts on
    needs: tuple[Need, ...] = ()
    # Names of the fields of `Environment` that the effect depends on
    follows: tuple[str, ...] = ()
    diagnosis: DiagnosisHints = DiagnosisHints()  # Properties that only the diagnosis uses

    @property
    def limits(self) -> list[Parameter]:
        """Return the parameters that do nothing until the signal reaches them."""
        return [p for p in self.parameters if p.role is Role.LIMIT]

    @property
    def concern(self) -> Concern:
        """Return what it is an error of."""
        if self.place is Place.REFERENCE:
            return Concern.REFERENCE
        return (
            Concern.STAGE
            if self.place is Place.STAGE or {Need.STAGE, Need.ROTATION} & set(self.needs)
            else Concern.SENSOR
        )


def add(components: Components, values: Iterable[Value]) -> None:
    """Add a value to each of the first components; arrays that others hold stay as they are."""
    for d, value in enumerate(values):
        components[d] = components[d] + value


def effect(
    place: Place,
    *parameters: Parameter,
    cause: str,
    smooth: bool = True,
    exact: bool = False,
    acts_on: ActsOn = ActsOn.MEAN,
    invertible: bool = False,
    needs: tuple[Need, ...] = (),
    follows: tuple[str, ...] = (),
    diagnosis: DiagnosisHints = DiagnosisHints(),
) -> Callable[[Apply], Effect]:
    """Turn a function into the effect of its name, with the properties of `Effect`."""
    return lambda apply: Effect(
        name=apply.__name__,
        place=place,
        parameters=parameters,
        apply=apply,
        cause=cause,
        smooth=smooth,
        exact=exact,
        acts_on=acts_on,
        invertible=invertible,
        needs=needs,
        follows=follows,
        diagnosis=diagnosis,
    )
