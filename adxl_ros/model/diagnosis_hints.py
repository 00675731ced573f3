# SPDX-License-Identifier: Apache-2.0

"""What the diagnosis needs to know about an effect, declared beside the effect."""

from __future__ import annotations

from dataclasses import dataclass
from enum import auto, Enum


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
    """
    Statistic of the noise that shows an effect.

    An effect with a detector has all parameters that the detector estimates. REPEATED_SAMPLES
    estimates `rate_hz` and `duration_s`, ISOLATED_SAMPLES `rate_hz` and `amplitude_v`,
    COARSE_CODES `lost_bits` and `axis_lost_bits`, MAINS_LINE `amplitude_v`, `frequency_hz` and
    `phase_rad`, NOISE_LEVEL `ratio`.
    """

    REPEATED_SAMPLES = auto()
    ISOLATED_SAMPLES = auto()
    COARSE_CODES = auto()
    MAINS_LINE = auto()
    NOISE_LEVEL = auto()


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

    FORCE = 'force'
    """Specific force along the axis."""
    CROSS_FORCE = 'cross_force'
    """Specific force across the axis."""
    DIRECTION = 'direction'
    """Direction of the last change of joints and force: the branch of a loop."""
    RATE = 'rate'
    """Rates of the joints."""
    ALPHA = 'alpha_rad'
    """Angle alpha."""
    BETA = 'beta_rad'
    """Angle beta."""
    TEMPERATURE = 'temperature_c'
    """Temperature of the sensor."""
    WARMING = 'warming'
    """Recent history of the temperature: the branch of a loop."""
    SUPPLY = 'supply_v'
    """Supply voltage."""
    TIME = 'time_s'
    """Time."""
    AGEING = 'ageing'
    """Force times a slow function of time: a scale factor that changes."""
    SINCE_MOVE = 'since_move_s'
    """Time since the last move."""
    CODE = 'code'
    """Code of the ADC."""
    LAG = 'lag'
    """Recent history of the specific force along the axis."""


class ProofVariable(Enum):
    """
    Variable over which a plot shows that an effect is there.

    The values name the variable and its unit for people.
    """

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
    FREQUENCY = 'frequency, Hz'
    """The plot shows spectra."""
    STEP = 'change from one sample to the next, mg'
    """No plot: the report compares counts and sizes, recorded and simulated."""


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
