# Copyright 2026 the adxl_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Descriptions of effects, and the signals of the chain that they change."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import auto, Enum, IntEnum
from typing import Any, NamedTuple, Protocol

from adxl_ros.model.constants import AXES, NOMINAL_SUPPLY_V, NOMINAL_TEMPERATURE_C
from adxl_ros.model.diagnosis_hints import DiagnosisHints
import numpy as np

Value = Any
"""One component of a signal: an array over samples, (n,), or a float for one sample.

Effects compute component by component with plain arithmetic. One description then serves
recordings (arrays) and live samples (floats, which avoid the cost of small arrays)."""

Components = list[Value]
"""Components of a vector: those of the case frame, or one for each measured axis."""

Parameters = dict[str, Any]
"""Values by name: a tuple of floats, one for each measured axis, or a float without axes."""


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
    """
    Surroundings of the sensor.

    Attributes
    ----------
    time_s
        Time since power-on, s.
    temperature_c
        Temperature of the sensor, °C.
    supply_v
        Supply voltage of the sensor, V.

    """

    time_s: Value
    temperature_c: Value = NOMINAL_TEMPERATURE_C
    supply_v: Value = NOMINAL_SUPPLY_V


NOMINAL_ENVIRONMENT = Environment(time_s=float('inf'))
"""Temperature and supply of the datasheet values, so long after power-on that drifts are 0."""


class Joint(NamedTuple):
    """
    Motion of one joint of the stage.

    Attributes
    ----------
    position
        Angle, rad, or shift, m.
    velocity, acceleration
        First and second derivative of the position by time.

    """

    position: Value = 0.0
    velocity: Value = 0.0
    acceleration: Value = 0.0


@dataclass
class Signals:
    """
    Signals of the chain, component by component. Effects change the signals of their place.

    Attributes
    ----------
    environment
        Surroundings at the instants of the samples.
    time_s
        CLOCK: stamps, s, which effects turn into the instants of the samples. REFERENCE: the same
        of all samples of the reference.
    alpha, beta, shift
        STAGE: joints as the encoders read them, which effects turn into the true ones.
    up
        STAGE: the vertical in the frame of the stage's base, a unit vector.
    gravity_mps2
        STAGE: local gravity, m/s².
    force
        FORCE: specific force in the case frame, m/s², three components. REFERENCE: the force that
        the reference states, all of it, which effects turn into the one that acts on the sensor.
    sensed
        MOUNTING: specific force along the sensing axes, g, always three components. Axes that
        are not measured keep the component along the axis of the case.
    output
        ELEMENT: output of the sensing element, g; it begins as `sensed`. Effects read `sensed`
        and add to `output`, so that their order does not matter.
    zero_g_v, scale_v_per_g
        ELECTRONICS: zero-g, V, and scale factor, V/g, by measured axis.
    rc_s
        ELECTRONICS: time constant of the RC filter by measured axis, s.
    noise_ratio
        ELECTRONICS: density of the white noise divided by the nominal one, by measured axis.
    lsb_v
        ELECTRONICS: step of the ADC, V.
    lsb_ratio
        ELECTRONICS: step of the ADC by measured axis divided by `lsb_v`.
    input_v
        ADC: volts at the input of the ADC by measured axis. Effects only read them.
    volts
        ADC: `input_v` with the contributions of effects. CODE: volts that the ADC outputs.
    nominal_scale_v_per_g
        Nominal scale factor by measured axis, V/g, which turns g into volts at the ADC.
    vref_v
        Full scale of the ADC, V.
    dt_s
        Time between the samples of the arrays, s.
    memory
        What the current effect keeps from one block to the next; empty before the first.
    rng
        Random generator of the current effect, seeded for it alone.

    """

    environment: Environment
    time_s: Value = 0.0
    alpha: Joint = Joint()
    beta: Joint = Joint()
    shift: Joint = Joint()
    up: Components = field(default_factory=list)
    gravity_mps2: float = 0.0
    force: Components = field(default_factory=list)
    sensed: Components = field(default_factory=list)
    output: Components = field(default_factory=list)
    zero_g_v: Components = field(default_factory=list)
    scale_v_per_g: Components = field(default_factory=list)
    rc_s: list[float] = field(default_factory=list)
    noise_ratio: list[float] = field(default_factory=list)
    lsb_v: float = 0.0
    lsb_ratio: list[float] = field(default_factory=list)
    input_v: Components = field(default_factory=list)
    volts: Components = field(default_factory=list)
    nominal_scale_v_per_g: list[float] = field(default_factory=list)
    vref_v: float = 0.0
    dt_s: float = 0.0
    memory: dict[Any, Any] = field(default_factory=dict)
    rng: np.random.Generator | None = None


@dataclass(frozen=True, order=True)
class Coefficient:
    """
    Name of one coefficient: a parameter of an effect, for one axis.

    Files, messages and reports show it as text: `effect.parameter.axis`.

    Attributes
    ----------
    effect
        Name of the effect.
    parameter
        Name of the parameter.
    axis
        x, y or z; empty for a parameter without axes, and for all axes of a parameter.

    """

    effect: str
    parameter: str
    axis: str = ''

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

    SIZE = auto()
    """Strength of the effect, which does nothing at the neutral value."""
    OPTIONAL = auto()
    """A size that is usually neutral: fits leave it out, and files may do so."""
    SHAPE = auto()
    """A frequency, time constant or the like, without influence where the sizes are neutral."""
    LIMIT = auto()
    """A bound of the signal, without influence where no sample reaches it."""


class ActsOn(Enum):
    """Property of the output in which an effect shows."""

    MEAN = 'mean'
    """The mean of the output."""
    NOISE = 'noise'
    """The statistics of the noise only."""


class Concern(Enum):
    """What an effect is an error of: a verdict names it."""

    REFERENCE = 'reference'
    """The other instrument or simulator that states the specific force."""
    STAGE = 'stage'
    """The stage, its encoders and its site."""
    SENSOR = 'sensor'
    """The sensor with its mount, its link and its stamps."""


class Need(Enum):
    """Part of the chain without which an effect has nothing to act on."""

    STAGE = 'stage'
    FILTER = 'filter'
    ADC = 'adc'
    NOISE = 'noise'


@dataclass(frozen=True)
class Parameter:
    """
    One parameter of an effect, a departure from the nominal chain.

    Attributes
    ----------
    name
        Name, which ends in its unit where it has one.
    unit
        Unit, as messages show it.
    lower, upper
        Bounds.
    scale
        Typical magnitude.
    source
        Source of the typical magnitude: datasheet, paper or physics.
    doc
        Meaning, in words that continue "it is the ...".
    axes
        Axes that it applies to, with one value for each measured axis; values of other axes are
        neutral. Empty for one value without axes.
    neutral
        Value at which the effect does nothing. A parameter of shape has its typical value there.
    typical
        Value of an effect that is stated by name only; `scale` unless given.
    held
        Whether fits leave it as it is, because zero-g and scale factor can take its place.
    role
        Role in its effect.
    starts : tuple of float
        Values from which a fit starts, in rising order: of a shape, or of a size in which the
        effect is far from linear. Empty for multiples of the typical magnitude.
    shaped
        Only for a size: whether the shape parameters of its effect change what it does.

    """

    name: str
    unit: str
    lower: float
    upper: float
    scale: float
    source: str
    doc: str
    axes: str = AXES
    neutral: float = 0.0
    typical: float | None = None
    held: bool = False
    role: Role = Role.SIZE
    starts: tuple[float, ...] = ()
    shaped: bool = True

    @property
    def is_size(self) -> bool:
        """Whether it is a strength of the effect, and not a shape or a limit."""
        return self.role in (Role.SIZE, Role.OPTIONAL)


class Apply(Protocol):
    """Function of an effect, which changes the signals of its place."""

    def __call__(self, signals: Signals, p: Parameters, /) -> None:
        """
        Apply the effect.

        Parameters
        ----------
        signals
            Signals of the chain, which it changes in place.
        p
            Values of the parameters of the effect.

        """


@dataclass(frozen=True)
class Effect:
    """
    One effect of a real sensor, as the simulator, the inverse and the fits use it.

    Attributes
    ----------
    name
        Name, which is unique in the library.
    place
        Place in the chain.
    parameters : tuple of Parameter
        Its parameters.
    apply
        The function of the effect. It takes arrays, and floats too if the effect is invertible.
    cause
        Sentence for a report: the cause, and what to do about it.
    smooth
        Whether the output is differentiable by the parameters.
    exact
        Whether the form of the effect is certain, as that of geometry or of a clock.
    acts_on
        Property of the output in which the effect shows; the texts 'mean' and 'noise' are
        accepted, too.
    invertible
        Whether the inverse undoes the effect. The effect then is a smooth function of force and
        environment of one sample. Effects of the stage, with a memory or with noise are not.
    needs
        Parts of the chain that the effect acts on; their names as text are accepted, too.
    follows
        Names of the fields of `Environment` that the effect depends on.
    diagnosis
        Properties that only the diagnosis uses.

    """

    name: str
    place: Place
    parameters: tuple[Parameter, ...]
    apply: Apply
    cause: str
    smooth: bool = True
    exact: bool = False
    acts_on: ActsOn = ActsOn.MEAN
    invertible: bool = False
    needs: tuple[Need, ...] = ()
    follows: tuple[str, ...] = ()
    diagnosis: DiagnosisHints = DiagnosisHints()

    def __post_init__(self) -> None:
        object.__setattr__(self, 'acts_on', ActsOn(self.acts_on))
        object.__setattr__(self, 'needs', tuple(map(Need, self.needs)))

    @property
    def concern(self) -> Concern:
        """Return what it is an error of."""
        if self.place is Place.REFERENCE:
            return Concern.REFERENCE
        return Concern.STAGE if Need.STAGE in self.needs or self.place is Place.STAGE \
            else Concern.SENSOR
