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

"""What an effect is, and the signals that run through the chain."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import auto, Enum, IntEnum
from typing import Any, NamedTuple

from adxl_ros.model.constants import NOMINAL_SUPPLY_V, NOMINAL_TEMPERATURE_C
from adxl_ros.model.diagnosis_hints import DiagnosisHints
import numpy as np

Value = Any
"""One component of a signal: an array over samples, or a float for one sample.

Effects compute component by component with plain arithmetic, so that one description serves
recordings (arrays) and a live sample (floats, without the cost of small arrays)."""

Components = list[Value]
Parameters = dict[str, Any]
"""By name: a tuple of floats, one an axis, or a float where a parameter has no axes."""


class Place(IntEnum):
    """
    Where in the chain an effect acts; the chain runs in this order.

    The clock comes last, for it says which instant a sample is stamped with; it is evaluated
    first, so that a sample is taken at its instant and nothing is resampled.
    """

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
    """Motion of one joint of the stage: rad or m, and its first two derivatives by time."""

    position: Value = 0.0
    velocity: Value = 0.0
    acceleration: Value = 0.0


@dataclass
class Signals:
    """
    What runs through the chain, component by component; a place reads and writes its own.

    Attributes
    ----------
    environment
        At the instants of the samples.
    time_s
        CLOCK: stamps, to be turned into the instants at which the samples are taken, s.
    alpha, beta, shift
        STAGE: joints as the encoder has them, to be turned into true ones.
    up
        STAGE: the vertical in the frame of the stage's base, a unit vector.
    gravity_mps2
        STAGE: true local gravity.
    force
        FORCE: specific force in the case frame, m/s², three.
    sensed
        MOUNTING: specific force along the sensing axes, g, always three: axes that are not
        measured keep the component along the case's axis.
    output
        ELEMENT: what the element makes of it, g; starts as `sensed`. Effects read `sensed` and
        add to `output`, so that their order does not matter.
    zero_g_v, scale_v_per_g
        ELECTRONICS: figures of the conversion to volts, by measured axis.
    rc_s, noise_ratio, lsb_v
        ELECTRONICS: time constant of the output filter, s, and white noise by its stated
        density, by measured axis; step of the ADC, V.
    input_v, volts
        ADC: volts by measured axis at the input of the ADC, and with what effects add to them;
        effects read the first and add to the second. CODE: `volts` are what the ADC gives.
    nominal_scale_v_per_g
        The stated scale factor by measured axis, which turns g into volts at the ADC.
    vref_v
        Full scale of the ADC, V.
    dt_s
        Time between the samples of the arrays, s.
    memory
        What the effect that is being applied keeps from one block to the next; empty at the
        beginning.
    rng
        Source of randomness of the effect that is being applied, its own by the seed.

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

    Files, messages and reports have it as text: `effect.parameter.axis`.

    Attributes
    ----------
    effect, parameter
        Their names.
    axis
        x, y or z; empty for a parameter without axes, or for all of its axes.

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
    """What a parameter is to its effect; fits and the diagnosis treat each role differently."""

    SIZE = auto()
    """How strong the effect is: at its neutral value the effect does nothing."""
    OPTIONAL = auto()
    """A size that an effect usually lacks: fits leave it out, and so may files."""
    SHAPE = auto()
    """A frequency, a time constant and the like: it means nothing where the sizes are neutral."""
    LIMIT = auto()
    """A bound of the signal: it does nothing where no sample reaches it."""


class ActsOn(Enum):
    """Where the effect shows in the output."""

    MEAN = 'mean'
    """In the mean of the output."""
    NOISE = 'noise'
    """In the statistics of the noise only."""


class Need(Enum):
    """A part of the simulated chain without which an effect has nothing to act on."""

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
    scale
        A typical magnitude, with its source (datasheet, paper or physics).
    axes
        The axes that it means something for, an entry an axis, those of others 0; empty for one
        figure without axes.
    neutral
        The value that leaves the chain as it is; a figure of shape (a frequency, a time
        constant), which means nothing while its amplitude is neutral, has its typical value.
    typical
        The value that the effect takes where only its name is given; `scale` unless stated.
    held
        Whether fits leave it as it is: what it does, zero-g and scale factor do as well.
    role
        What it is to its effect; the size unless stated.

    """

    name: str
    unit: str
    lower: float
    upper: float
    scale: float
    source: str
    doc: str
    axes: str = 'xyz'
    neutral: float = 0.0
    typical: float | None = None
    held: bool = False
    role: Role = Role.SIZE

    @property
    def is_size(self) -> bool:
        """Whether it says how strong the effect is; at its neutral value it does nothing."""
        return self.role in (Role.SIZE, Role.OPTIONAL)


@dataclass(frozen=True)
class Effect:
    """
    One effect of a real sensor: what the simulator, the inverse and the fits know of it.

    Attributes
    ----------
    apply
        Changes the signals of its place, given the parameters; vectorised.
    cause
        One sentence for a report: what causes it and what to do about it.
    smooth
        Whether the output is differentiable in the parameters.
    exact
        Whether its form, geometry or a clock, is beyond doubt: what it leaves looks like no other.
    acts_on
        Where it shows in the output. The text 'mean' or 'noise' is accepted, too.
    invertible
        Whether it is a smooth function of the sample's own force and environment, which the
        inverse undoes; an effect of the stage, of memory or of noise is not.
    needs
        Parts of the chain that it acts on. Their names as text are accepted, too.
    follows
        The fields of `Environment` that it follows.
    diagnosis
        What only the diagnosis needs to know of it.

    """

    name: str
    place: Place
    parameters: tuple[Parameter, ...]
    apply: Callable[[Signals, Parameters], None]
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
