# SPDX-License-Identifier: Apache-2.0

"""
Simulated robots whose calibration is kept: intervals, tilt with and without, and knocks.

A robot works for 8 hours a day in 15 to 40 °C. It rests at ten places a day and charges for an
hour. The zero-g drifts as a random walk, and follows the temperature by a slope and a curvature
that the calibration does not know. Its rests scatter by 0.15 mg. The ground slopes.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from adxl_ros.calibrate.keep.keeper import DAY_NS, Keeper
from adxl_ros.files import parameter_file
from adxl_ros.files.sweep_journal import NaturalRest
from adxl_ros.model.constants import AXES
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.sensor import Sensor, with_axes, with_neutral
import numpy as np

BEGIN_NS = 1_767_225_600 * 10**9  # 2026-01-01, the date of the calibration
_REST_NS = 30 * 10**9
_CALIBRATION_STD = 3e-4  # Error of zero-g, g, and of the scale factor, of the calibration
_SLOPE_PER_K = 1e-4  # Typical slope of the zero-g over temperature, g/K: the datasheet's
_CURVATURE_PER_K2 = 1e-6
_DRIFT_PER_YEAR = np.array([5e-3] * 3 + [1e-3] * 3)  # Of zero-g, g, and scale factor
_SCATTER_G = 1.5e-4
_NOISE_G = 3e-5  # Noise of the mean of a rest
_PLACES = 10  # Rests a day at places of their own
_CHARGING = 5  # Rests in the stay at the charger, one in 12 minutes
_LYING = 0.3  # Share of the places at which a robot that lies down lies on a side


def calibrated(axes: str = AXES) -> Sensor:
    """Return an upright sensor with the covariance of a good calibration."""
    nominal = with_axes(parameter_file.load(parameter_file.nominal_path()), axes)
    names = []
    for effect, parameter in (('bias', 'offset_v'), ('scale_factor', 'offset_v_per_g')):
        names += [Coefficient(effect, parameter, axis) for axis in axes]
    return replace(
        with_neutral(nominal, ('bias', 'scale_factor')),
        serial='K1',
        model='gravity',
        covariance=np.eye(len(names)) * _CALIBRATION_STD**2,
        covariance_names=tuple(names),
        z_sign=1,
        provenance={'date': '2026-01-01T00:00:00+00:00'},
    )


@dataclass(frozen=True)
class Kind:
    """What a simulated robot does."""

    lies_down: bool = False
    is_turned: bool = False  # Whether somebody turns it by hand on a bench, in any direction
    # Slope of the ground, degrees: its standard deviation by place, and what holds for three weeks
    place_deg: float = 0.5
    weeks_deg: float = 0.0
    drift: float = 1.0  # Multiple of the usual drift with time
    slope: float = 1.0  # Multiple of the datasheet's drift with temperature
    axes: str = AXES  # Of its sensor: all, or the first two
    knock_axis: int = 0
    knock_mg: float = 0.0  # Size of a knock on the 31st day


@dataclass
class Robot:
    """A robot and its true errors."""

    kind: Kind
    rng: np.random.Generator
    days: float = 0.0
    error: np.ndarray = field(default_factory=lambda: np.zeros(6))  # Of zero-g, g, and scale
    shape: np.ndarray = field(default_factory=lambda: np.zeros((2, 3)))  # By temperature

    def __post_init__(self) -> None:
        """Draw the errors of the calibration, and how the zero-g follows the temperature."""
        self.error = self.rng.normal(size=6) * _CALIBRATION_STD
        sizes = np.array([[_SLOPE_PER_K], [_CURVATURE_PER_K2]])
        self.shape = self.rng.normal(size=(2, 3)) * sizes * self.kind.slope
        self.season_c = float(self.rng.uniform(-4, 4))

    def age(self, days: float) -> None:
        """Let the sensor drift up to a day, counted from the calibration."""
        elapsed = np.sqrt((days - self.days) / 365.25)
        self.error += self.rng.normal(size=6) * _DRIFT_PER_YEAR * self.kind.drift * elapsed
        self.days = days

    def temperature_c(self, day_and_hour: float) -> float:
        """Return the temperature of the sensor, °C."""
        daily_c = 6 * np.sin(2 * np.pi * (day_and_hour % 1 - 0.3))
        slow_c = 4 * np.sin(2 * np.pi * day_and_hour / 45) + self.season_c
        return float(np.clip(27.5 + daily_c + slow_c + self.rng.normal(0, 0.5), 15, 40))

    def zero_g(self, temperature_c: float) -> np.ndarray:
        """Return the true errors of the zero-g, g, (3,)."""
        warmer_k = temperature_c - 25.0
        return self.error[:3] + warmer_k * (self.shape[0] + warmer_k * self.shape[1])

    def reading_g(self, up: np.ndarray, temperature_c: float) -> np.ndarray:
        """Return what the sensor reads at rest by the calibration, g, (3,)."""
        return up * (1 + self.error[3:]) + self.zero_g(temperature_c)

    def up(self, day: int) -> np.ndarray:
        """Return what points up at the next place, (3,)."""
        if self.kind.is_turned:
            up = self.rng.normal(size=3)
            return up / np.linalg.norm(up)
        slope = np.radians(self.rng.normal(size=2) * self.kind.place_deg)
        if 15 <= day < 36:
            slope[0] += np.radians(self.kind.weeks_deg)
        up = np.array([*slope, 1.0])
        if self.kind.lies_down and self.rng.random() < _LYING:
            up = np.roll(up, self.rng.integers(1, 3)) * self.rng.choice([-1.0, 1.0])
        return up / np.linalg.norm(up)

    def rests(self, day: int) -> list[tuple[NaturalRest, np.ndarray]]:
        """Return the rests of a day, and what points up in each."""
        found = []
        up = np.array([0.0, 0.0, 1.0])
        places = [*range(_PLACES), *[_PLACES] * _CHARGING]
        for number, place in enumerate(places):
            moved = number <= _PLACES
            when = day + 0.3 + (0.028 * number if moved else 0.28 + (number - _PLACES) / 120)
            self.age(when)
            up = self.up(day) if moved else up
            temperature_c = self.temperature_c(when) - 1.5 * max(number - _PLACES, 0)
            noise = self.rng.normal(size=3) * np.hypot(_SCATTER_G, _NOISE_G)
            volts = (2.5 + self.reading_g(up, temperature_c) + noise)[: len(self.kind.axes)]
            stamp_ns = BEGIN_NS + int(when * DAY_NS)
            rest = NaturalRest(
                stay=day * 100 + place,
                start_ns=stamp_ns,
                stop_ns=stamp_ns + _REST_NS,
                mean_v=tuple(volts.tolist()),
                std_v=(_NOISE_G,) * len(volts),
                temperature_c=temperature_c,
            )
            found.append((rest, up))
        return found


@dataclass(frozen=True)
class Outcome:
    """What a robot shows."""

    tilt_without_deg: float  # rms tilt error at level over the days, by the calibration
    tilt_with_deg: float  # The same by the calibration that is kept
    inside: tuple[int, ...]  # Days on which the 90 % interval has the zero-g, by axis
    days: int
    adoptions: int
    worse: int  # Adoptions after which the next day's rests err more than without it
    false_changes: int  # Days with a reported change and without a knock
    could_show: bool  # Whether the robot rests on the knocked side within a day of the knock
    reported_days: float  # Days from a knock to its report; NaN where it was not reported
    adoptions_after: int  # Adoptions after a knock
    is_learnt: bool  # Whether they hold more than half of it


@dataclass
class _Knock:
    """A knock, and what becomes of it."""

    axis: int
    size_g: float
    could_show: bool = False
    reported_days: float = np.nan
    adoptions: int = 0  # Before it
    zero_g: float = 0.0  # Of the calibration in use before it, g

    def hit(self, robot: Robot, keeper: Keeper) -> None:
        """Knock a sensor."""
        self.adoptions, self.zero_g = len(keeper.adoptions), self._zero_g(keeper)
        robot.error[self.axis] += self.size_g

    def look(self, days: float, up: np.ndarray, keeper: Keeper) -> None:
        """Note what a rest has shown, days after the knock."""
        self.could_show |= bool(days < 1 and abs(up[self.axis]) > 0.5)
        if np.isnan(self.reported_days) and keeper.changed:
            self.reported_days = days

    def is_learnt(self, keeper: Keeper) -> bool:
        """Return whether the calibration in use has more than half of it."""
        return bool(self.size_g and (self._zero_g(keeper) - self.zero_g) / self.size_g > 0.5)

    def _zero_g(self, keeper: Keeper) -> float:
        return float(_zero_g(keeper.sensor, 25.0)[self.axis])


def run(kind: Kind, seed: int, days: int = 60) -> Outcome:
    """Simulate a robot."""
    robot, keeper = Robot(kind, np.random.default_rng(seed)), Keeper(calibrated(kind.axes))
    count = len(kind.axes)
    inside, without, kept = np.zeros(count, int), [], []
    worse = false_changes = 0
    knock_day = 30 if kind.knock_mg else days
    knock = _Knock(kind.knock_axis, kind.knock_mg * 1e-3)
    pending: Sensor | None = None
    for day in range(days):
        if day == knock_day:
            knock.hit(robot, keeper)
        squares = np.zeros(2)  # Of the errors before and after an adoption
        for rest, up in robot.rests(day):
            if pending is not None:
                reading = robot.reading_g(up, rest.temperature_c)[:count]
                for number, sensor in enumerate((pending, keeper.sensor)):
                    squares[number] += _error2(sensor, reading, up[:count], rest.temperature_c)
            if keeper.add(rest) is not None:
                pending, squares = keeper.before[-1], np.zeros(2)
            if day >= knock_day:
                knock.look((rest.stop_ns - BEGIN_NS) / DAY_NS - knock_day - 0.3, up, keeper)
        if pending is not None and squares[0] > 0:
            worse += bool(squares[1] > squares[0])
            pending = None
        false_changes += bool(keeper.changed) and day < knock_day
        state = keeper.state(rest.stop_ns)
        zero_g = robot.zero_g(rest.temperature_c)[:count]
        true = zero_g - _zero_g(keeper.sensor, rest.temperature_c)
        departure = np.abs(true * 1e3 - state.zero_g_mg)
        if day < knock_day:
            inside += departure <= state.zero_g_90_mg
            without.append(zero_g[:2])
            kept.append(true[:2])
    return Outcome(
        tilt_without_deg=_rms_deg(without),
        tilt_with_deg=_rms_deg(kept),
        inside=tuple(inside.tolist()),
        days=min(days, knock_day),
        adoptions=len(keeper.adoptions),
        worse=worse,
        false_changes=false_changes,
        could_show=knock.could_show,
        reported_days=knock.reported_days,
        adoptions_after=len(keeper.adoptions) - knock.adoptions if kind.knock_mg else 0,
        is_learnt=knock.is_learnt(keeper),
    )


def _zero_g(sensor: Sensor, temperature_c: float) -> np.ndarray:
    """Return the zero-g of a calibration beyond the nominal one, g, (3,)."""
    warmer_k = temperature_c - 25.0
    followed = sensor.values['temperature_bias']
    return np.asarray(
        sensor.values['bias']['offset_v']
        + warmer_k * (followed['per_k'] + warmer_k * followed['per_k2'])
    )


def _error2(sensor: Sensor, reading: np.ndarray, up: np.ndarray, temperature_c: float) -> float:
    """Return the squared error of the force that a calibration makes of a reading, g²."""
    scale = sensor.values['scale_factor']['offset_v_per_g']
    force = (reading - _zero_g(sensor, temperature_c)) / (1 + scale)
    return float(((force - up) ** 2).sum())


def _rms_deg(errors: list[np.ndarray]) -> float:
    return float(np.degrees(np.sqrt(np.mean(np.sum(np.square(errors), axis=1)))))
