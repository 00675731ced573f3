# SPDX-License-Identifier: Apache-2.0

"""
Flexible functions of force, angles, temperature, time and codes, which a residual may follow.

They stand for what no effect of the library describes, and for the difference between the form
of an effect and that of a real sensor (Kennedy and O'Hagan 2001, J. R. Stat. Soc. B 63). Each axis
has functions of its own, by dimension.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from math import prod

from adxl_ros.diagnose import comparison as beside
from adxl_ros.diagnose.comparison import BaselineComparison
from adxl_ros.model.constants import AXES
from adxl_ros.model.effects.base import FormDimension as Form
from adxl_ros.model.filters import loop, low_pass, stop
from adxl_ros.model.kinematics import gravity_slopes
import numpy as np

_MODES = {
    Form.FORCE: 12,
    Form.ALPHA: 8,
    Form.CROSS_FORCE: 6,
    Form.TEMPERATURE: 4,
    Form.SUPPLY: 4,
    Form.TIME: 16,
    Form.AGEING: 4,
}
"""Number of cosines over a quantity. Chosen: smooth laws; a third of the blocks for time."""
_BETA_HARMONICS = 6  # Harmonics of beta. Chosen: those of the library
_CODE_HARMONICS = 8  # Harmonics over the range of the codes. Chosen: those of the library
_HEAVY_BITS = 6  # Heaviest bits that may have a wrong weight. Chosen: those of the library
_PRODUCT_DEGREE = 3  # Highest degree of products of force. Chosen: that of the library
_LAG_S = (0.05, 0.5)
"""Time constants of fast lags of the force, s. Chosen: slower than the filter of the sensor."""
_RELAXATION_S = (1, 4, 16)
"""Time constants of relaxation after a move, s. Chosen: a factor of four apart."""
_LOOP_REACH = (0.001, 0.004, 0.016, 0.064)
"""Reach of loops, divided by the range, of half a turn at most. Chosen: a factor of four apart;
0.001 is the play of a worm gear, 0.1°."""
_CREEP_S = (2.0, 10.0, 50.0)  # Time constants of creep, s. Chosen: a factor of five apart
_THERMAL_LAG_S = (20.0, 100.0, 500.0)
"""Time constants of lags of the temperature, s. Chosen: a factor of five apart."""
_THERMAL_REACH = (0.05, 0.25)
"""Reach of loops over the temperature, divided by its range. Chosen: a factor of five apart."""
_SMALLEST_RATE_RAD_S = 1e-3
"""Largest rate of a joint below which it has no functions, rad/s. Chosen: it rests."""
_SMALLEST_CHANGE = {'temperature_c': 0.5, 'supply_v': 0.01}
"""Range of temperature, °C, and supply, V, below which they have no functions. Chosen: noise."""
_SMALLEST_SPREAD = 1e-6  # Range of a point. Chosen: above rounding errors
_SMALLEST_RMS = 1e-9  # Rms of a constant function. Chosen: above rounding errors

Basis = dict[Form, np.ndarray]
"""Functions of one axis of one recording by dimension, (n, k) each, about their mean. A random
combination with coefficients of standard deviation 1 has an rms of 1."""


def flexible_bases(
    comparison: BaselineComparison, baseline_v: np.ndarray, chosen: Collection[Form] = tuple(Form)
) -> Iterator[Basis]:
    """
    Yield the flexible functions of a recording over chosen quantities, one basis for each axis.

    Those of temperature and supply also multiply the force, because they change the scale factor,
    and those of the angles its slope over the angle, because they are errors of the angle.
    baseline_v: simulated output of its baseline, V, (n, m).
    """
    sensor = comparison.sensor
    force_g = ((baseline_v - sensor.zero_g_v) / sensor.scale_v_per_g).T
    common = _made(_common(comparison), chosen)
    moves = _Moves.of(comparison)
    for axis, along_g in enumerate(force_g):
        factors = {
            Form.TEMPERATURE: along_g,
            Form.SUPPLY: along_g,
            Form.ALPHA: moves.slopes[0, axis],
            Form.BETA: moves.slopes[1, axis],
        }
        functions = dict(common)
        for dimension, factor in factors.items():
            if dimension in common:
                plain = common[dimension]
                functions[dimension] = np.concatenate([plain, plain * factor])
        of_axis = _of_axis(comparison, moves, force_g, axis, baseline_v[:, axis])
        functions |= _made(of_axis, chosen)
        basis = {d: _normalised(values, comparison.used) for d, values in functions.items()}
        yield {d: values for d, values in basis.items() if values.shape[1]}


_Makers = dict[Form, Callable[[], np.ndarray]]
"""What makes functions, (k, n), by dimension."""


def _made(makers: _Makers, chosen: Collection[Form]) -> Basis:
    """Make the functions of chosen dimensions."""
    return {dimension: make() for dimension, make in makers.items() if dimension in chosen}


def _normalised(functions: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Return functions, (k, n), about their mean, so that a random combination has an rms of 1."""
    count = max(int(used.sum()), 1)
    centred = functions - (functions @ used / count)[:, None]
    squares = np.einsum('kn,kn,n->k', centred, centred, used.astype(float)) / count
    varying = squares > _SMALLEST_RMS**2
    size = np.sqrt(max(squares[varying].sum(), _SMALLEST_RMS**2))
    return (centred[varying] / size).T


def _common(comparison: BaselineComparison) -> _Makers:
    """Return what makes functions that are the same for all axes, not yet normalised."""
    makers: _Makers = {Form.TIME: partial(_modes, comparison.time_s, Form.TIME, 1.0)}
    for name, values in comparison.surroundings.items():
        if np.ptp(values) > _SMALLEST_CHANGE[name]:
            makers[Form(name)] = partial(_modes, values, Form(name))
            if Form(name) is Form.TEMPERATURE:
                makers[Form.WARMING] = partial(_thermal_history, values, comparison.dt_s)
    if comparison.joints:
        alpha_rad, beta_rad = comparison.joint_values()
        makers[Form.ALPHA] = partial(_modes, alpha_rad, Form.ALPHA)
        makers[Form.BETA] = partial(_harmonics, beta_rad, _BETA_HARMONICS)
    return makers


def _of_axis(
    comparison: BaselineComparison,
    moves: _Moves,
    force_g: np.ndarray,
    axis: int,
    volts: np.ndarray,
) -> _Makers:
    """Return what makes functions of the force along and across one axis and of its history."""
    along_g = force_g[axis]
    if np.ptp(along_g) < _SMALLEST_SPREAD:
        return {}
    makers: _Makers = {
        Form.FORCE: partial(_modes, along_g, Form.FORCE),
        Form.CROSS_FORCE: partial(_cross_force, force_g, axis),
        Form.AGEING: lambda: along_g * _modes(comparison.time_s, Form.AGEING),
        Form.CODE: partial(_codes, volts, comparison.sensor.adc_vref_v),
        Form.LAG: partial(_force_history, along_g, comparison.dt_s),
    }
    if moves.moving:
        makers |= {
            Form.RATE: partial(_by_rate, moves, along_g),
            Form.DIRECTION: partial(_by_direction, moves, along_g, axis),
            Form.SINCE_MOVE: partial(_since_move, moves, along_g, comparison),
        }
    return makers


def _cross_force(force_g: np.ndarray, axis: int) -> np.ndarray:
    """Return products of the components of force, and functions of those across an axis."""
    powers = [
        p
        for p in np.ndindex(*[_PRODUCT_DEGREE + 1] * len(force_g))
        if 2 <= sum(p) <= _PRODUCT_DEGREE
    ]
    products = [prod(f**k for f, k in zip(force_g, p)) for p in powers]
    across = [_modes(f, Form.CROSS_FORCE) for f in np.delete(force_g, axis, axis=0)]
    return np.concatenate([np.array(products), *across])


def _codes(volts: np.ndarray, reference_v: float) -> np.ndarray:
    """Return harmonics over the codes of the ADC, and its heaviest bits."""
    turn_rad = 2 * np.pi * (volts - volts.min()) / np.ptp(volts)
    bits = [np.floor(volts / reference_v * 2**bit) % 2 for bit in range(1, _HEAVY_BITS + 1)]
    return np.array([*_harmonics(turn_rad, _CODE_HARMONICS, 0), *bits])


def _force_history(along_g: np.ndarray, dt_s: float) -> np.ndarray:
    """Return slopes and lags of the force, and the level of its vibration, each of equal size."""
    slope = np.gradient(along_g, dt_s)
    lagging = _lags(along_g, _LAG_S, dt_s)
    # The level of a vibration: squares of the slope and of the fast force, smoothed.
    levels = []
    for fast in (slope, lagging[-1]):
        levels += [low_pass(fast**2, tau_s, dt_s, {}) for tau_s in _LAG_S]
    amplitudes = [np.sqrt(np.abs(level)) for level in levels]
    return _same_size(
        [
            slope,
            np.gradient(slope, dt_s),
            slope * along_g,
            slope**2,
            *lagging,
            *levels,
            *amplitudes,
        ]
    )


@dataclass(frozen=True)
class _Moves:
    """The moves of the joints of a recording."""

    angles_rad: list[np.ndarray]  # Angles of all joints, (n,)
    slopes: np.ndarray  # Derivatives of gravity's direction by both angles, (2, 3, n)
    rates: list[np.ndarray]  # Rates of all joints, rad/s, (n,)
    moving: list[np.ndarray]  # Rates of the joints that move, divided by the largest, (n,)

    @classmethod
    def of(cls, comparison: BaselineComparison) -> _Moves:
        """Return the moves of a recording; no joint moves where it has none."""
        rates = comparison.joint_values(1)
        moving = [rate for rate in rates if np.abs(rate).max() > _SMALLEST_RATE_RAD_S]
        angles_rad = comparison.joint_values()
        slopes = np.zeros((2, len(AXES), 0))
        if angles_rad:
            slopes = gravity_slopes(*angles_rad)
        relative = [rate / np.abs(rate).max() for rate in moving]
        return cls(angles_rad, slopes, rates, relative)

    @cached_property
    def branches(self) -> list[np.ndarray]:
        """Return the branches of loops over each joint, of several reaches, (k, n) by joint."""
        return [_branches(angle_rad, _LOOP_REACH) for angle_rad in self.angles_rad]


def _by_rate(moves: _Moves, along_g: np.ndarray) -> np.ndarray:
    """Return functions of the rates of the joints, (k, n)."""
    functions = []
    for rate in moves.moving:
        functions += [rate, rate * rate, rate * along_g, np.abs(rate)]
    return np.array(functions)


def _by_direction(moves: _Moves, along_g: np.ndarray, axis: int) -> np.ndarray:
    """
    Return functions of the directions of the last changes of joints and force, (k, n).

    Play of the gears is an error of the angle: it counts by the slope of the force over the joint.
    """
    of_force = _branches(along_g, _LOOP_REACH[:1])
    of_joints = [
        branches * slope for branches, slope in zip(moves.branches, moves.slopes[:, axis])
    ]
    return np.concatenate([of_force, of_force * along_g, *of_joints])


def _branches(values: np.ndarray, reaches: Iterable[float]) -> np.ndarray:
    """Return the branches of loops whose reach is a share of the range, (k, n), rad or g."""
    span = min(float(np.ptp(values)), np.pi)
    return np.array(
        [stop(values, max(share * span, beside.SMALLEST_TURN_RAD), {}) for share in reaches]
    )


def _since_move(moves: _Moves, along_g: np.ndarray, comparison: BaselineComparison) -> np.ndarray:
    """Return functions of the time since a move, and of recent turning and force, (k, n)."""
    since_s = beside.time_since_move_s(comparison.time_s, moves.rates)
    turning = np.sum(
        [np.abs(rate) * (np.abs(rate) > _SMALLEST_RATE_RAD_S) for rate in moves.moving], axis=0
    )
    functions = [np.exp(-since_s / tau_s) for tau_s in _RELAXATION_S]
    for tau_s in _RELAXATION_S:
        functions += [
            low_pass(past, tau_s, comparison.dt_s, {}) for past in (turning, np.sign(turning))
        ]
    return _same_size(functions + _lags(along_g, _CREEP_S, comparison.dt_s))


def _lags(values: np.ndarray, times_s: Iterable[float], dt_s: float) -> list[np.ndarray]:
    """Return by how much low-pass filtered values lag, (n,) by time constant."""
    return [low_pass(values, tau_s, dt_s, {}) - values for tau_s in times_s]


def _thermal_history(temperature_c: np.ndarray, dt_s: float) -> np.ndarray:
    """Return lags of the temperature and branches of loops, plain and times it, (k, n)."""
    branches = [loop(temperature_c, share * np.ptp(temperature_c), {}) for share in _THERMAL_REACH]
    history = _same_size([*_lags(temperature_c, _THERMAL_LAG_S, dt_s), *branches])
    middle_c = (temperature_c.min() + temperature_c.max()) / 2
    return np.concatenate([history, _same_size(list(history * (temperature_c - middle_c)))])


def _same_size(columns: Sequence[np.ndarray]) -> np.ndarray:
    """Return functions of different units, each divided by its rms about its mean, (k, n)."""
    return np.array([c / max(float(np.std(c)), _SMALLEST_RMS) for c in columns])


def _harmonics(phase_rad: np.ndarray, count: int, decay: int = 1) -> np.ndarray:
    """Return sines and cosines of harmonics of a phase, the k-th of size k^(−decay), (2k, n)."""
    functions = []
    for k in range(1, count + 1):
        functions += [np.sin(k * phase_rad) / k**decay, np.cos(k * phase_rad) / k**decay]
    return np.array(functions)


def _modes(values: np.ndarray, dimension: Form, decay: float = 1.5) -> np.ndarray:
    """
    Return cosines over the range of a quantity, (k, n); the j-th has the size j^(−decay).

    A random combination is a smooth curve; with a decay of 1 it is rough like a random walk.
    """
    low, high = float(values.min()), float(values.max())
    if high - low < _SMALLEST_SPREAD:
        return np.zeros((0, len(values)))
    order = np.arange(1, _MODES[dimension] + 1)[:, None]
    return np.cos(np.pi * order * (values - low) / (high - low)) * order**-decay
