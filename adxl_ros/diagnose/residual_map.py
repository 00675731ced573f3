# SPDX-License-Identifier: Apache-2.0

"""
What a residual follows: a map over dimensions, and flexible functions of them.

The map has the mean residual over axis and dimension. Each mean is compared with the largest of
all under random signs of whole blocks (max-T; Westfall and Young 1993), because separate tests at
5 % would report ten of 200 cells by chance. The power in bands of frequency is compared with that
of the stated noise.

The functions stand for what no effect of the library describes, and for the difference between
the form of an effect and that of a real sensor (Kennedy and O'Hagan 2001, J. R. Stat. Soc. B 63).
Each axis has functions of its own, by dimension.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from math import prod
from typing import NamedTuple

from adxl_ros.diagnose.comparison import (
    BaselineComparison,
    direction_of_last_move,
    Reference,
    time_since_move_s,
)
from adxl_ros.diagnose.noise_model import gravity_slopes
from adxl_ros.model import noise
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.diagnosis_hints import FormDimension
from adxl_ros.model.filters import loop, low_pass
from adxl_ros.model.kinematics import specific_force
from adxl_ros.model.sensor import Sensor
import numpy as np
import scipy

RANGES = 8
"""Number of ranges of a dimension, with equally many samples. Chosen: a row of the page."""
_DRAWS = 500
"""Number of draws of random signs. Chosen: probabilities down to 0.002."""
BLOCK_S = 2.0
"""Length of the blocks that change sign together, s. Chosen: beyond the correlation of noise."""
_FEWEST_BLOCKS = 3
"""Fewest blocks of a cell that is tested. Chosen: the signs of two blocks have four patterns."""
SIGNIFICANT_P = 0.05
"""Family-wise probability below which a cell is reported. Chosen: the usual level."""
_BANDS_HZ = (0.0, 0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 500.0)
"""Edges of the bands of frequency, Hz. Chosen: half a decade each."""
_SMALLEST_RANGE = 1e-3
"""Range of a dimension, in its unit, below which it is constant. Chosen: steps of an encoder."""
_SMALLEST_WARMING_C = 1.0
"""The same of the temperature, °C. Chosen: 0.1 mg of a typical sensor."""
_LONGEST_SINCE_MOVE_S = 60.0
"""Longest time since the last move that is mapped, s. Chosen: creep has ended."""
_COVERAGE = {
    'alpha_rad': 'planes of another alpha',
    'beta_rad': 'turns of beta',
    'rate_rad_s': 'motion',
    'temperature_c': 'other temperatures',
    'supply_v': 'other supplies',
    'direction_beta': 'reversals',
}
"""Dimensions that recordings should cover, and how the report names them."""
_STAGE_ONLY = {'alpha_rad', 'beta_rad', 'rate_rad_s', 'direction_beta'}
"""Dimensions of a stage, which another simulator does not have."""
_CREEP_S = (2.0, 10.0, 50.0)
"""Time constants of low-pass filtered force (creep), s. Chosen: a factor of five apart."""
_RELAXATION_S = (1, 4, 16)
"""Time constants of relaxation after a move, s. Chosen: a factor of four apart."""
_LAG_S = (0.05, 0.5)
"""Time constants of fast lags of the force, s. Chosen: slower than the filter of the sensor,
faster than creep."""
_THERMAL_LAG_S = (20.0, 100.0, 500.0)
"""Time constants of lags of the temperature, s. Chosen: a factor of five apart."""
_THERMAL_REACH = (0.05, 0.25)
"""Reach of loops over temperature, divided by its range. Chosen: a factor of five apart."""
_FORCE_MODES = 12
"""Number of cosines over the force along the axis. Chosen: a tenth of the range each."""
_MODES = 8
"""Number of cosines over an angle. Chosen: smooth laws."""
_CROSS_MODES = 6
"""Number of cosines over a force across the axis. Chosen: smooth laws."""
_SURROUNDING_MODES = 4
"""Number of cosines over temperature or supply. Chosen: smooth laws."""
_HARMONICS = 6
"""Number of harmonics of beta. Chosen: periods of 60° and more."""
_CODE_HARMONICS = 8
"""Number of harmonics over the range of codes. Chosen: the library's curve has eight periods."""
_BITS = 6
"""Number of heaviest bits of the ADC that have a wrong weight. Chosen: that of the library."""
_TIME_MODES = 16
"""Number of cosines over time. Chosen: a third of the blocks."""
_AGEING_MODES = 4
"""Number of cosines over time that multiply the force. Chosen: a scale factor changes slowly."""
_PRODUCT_DEGREE = 3
"""Highest degree of the products of force. Chosen: that of the library."""
_SMALLEST_RATE_RAD_S = 1e-3
"""Largest rate of a joint below which it has no functions, rad/s. Chosen: it rests."""
_SMALLEST_CHANGE = {FormDimension.TEMPERATURE: 0.5, FormDimension.SUPPLY: 0.01}
"""Range of temperature, °C, and supply, V, below which they have no functions. Chosen: less is
noise."""
_SMALLEST_SPREAD = 1e-6
"""Range of a quantity below which it is a point. Chosen: above rounding errors."""
_SMALLEST_RMS = 1e-9
"""Rms of a function about its mean below which it is constant. Chosen: above rounding errors."""

_TIMES_FORCE = (FormDimension.TEMPERATURE, FormDimension.SUPPLY)
"""Dimensions whose functions also multiply the force, because they change the scale factor."""
_TIMES_SLOPE = (FormDimension.ALPHA, FormDimension.BETA)
"""Dimensions whose functions also multiply the slope of the force over the angle, because they are
errors of the angle."""

Basis = dict[FormDimension, np.ndarray]
"""Functions of one axis of one recording by dimension, (n, k) each, about their mean. A random
combination with coefficients of standard deviation 1 has an rms of 1."""


def flexible_bases(comparison: BaselineComparison, baseline_v: np.ndarray) -> list[Basis]:
    """
    Compute the flexible functions of a recording.

    baseline_v: simulated output of its baseline, V, (n, m).
    """
    force_g = ((baseline_v - comparison.sensor.zero_g_v) / comparison.sensor.scale_v_per_g).T
    common, used = _common(comparison), comparison.used
    fixed = {dimension: _normalised(values, used) for dimension, values in common.items()
             if dimension not in (*_TIMES_FORCE, *_TIMES_SLOPE)}
    slopes = _slopes(comparison)
    bases = []
    for axis, along_g in enumerate(force_g):
        of_axis = _of_axis(comparison, force_g, axis, baseline_v[:, axis])
        factors = dict.fromkeys(_TIMES_FORCE, along_g) | {
            dimension: slope[axis] for dimension, slope in slopes.items()}
        of_axis |= {dimension: np.concatenate([common[dimension], common[dimension] * factor])
                    for dimension, factor in factors.items() if dimension in common}
        basis = fixed | {dimension: _normalised(values, used)
                         for dimension, values in of_axis.items()}
        bases.append({dimension: basis[dimension] for dimension in (*common, *of_axis)
                      if basis[dimension].shape[1]})
    return bases


def _slopes(comparison: BaselineComparison) -> Basis:
    """Return by angle how gravity along each axis changes with it, (3, n) each."""
    if comparison.reference is not Reference.STAGE:
        return {}
    joints = (comparison.motion.alpha, comparison.motion.beta)
    return dict(zip(_TIMES_SLOPE, gravity_slopes(*(q(comparison.time_s) for q in joints))))


def _normalised(functions: np.ndarray, used: np.ndarray) -> np.ndarray:
    """
    Return functions about their mean, so that a random combination has an rms of 1.

    `functions` are (k, n), the result (n, k).
    """
    count = max(int(used.sum()), 1)
    centred = functions - (functions @ used / count)[:, None]
    squares = np.einsum('kn,kn,n->k', centred, centred, used.astype(float)) / count
    varying = squares > _SMALLEST_RMS ** 2
    size = np.sqrt(max(squares[varying].sum(), _SMALLEST_RMS ** 2))
    return (centred[varying] / size).T


def _common(comparison: BaselineComparison) -> Basis:
    """Return functions that are the same for all axes, (k, n) each, not yet normalised."""
    time_s, motion = comparison.time_s, comparison.motion
    basis: Basis = {FormDimension.TIME: _modes(time_s, _TIME_MODES, 1.0)}
    surroundings = {FormDimension.TEMPERATURE: motion.temperature_c,
                    FormDimension.SUPPLY: motion.supply_v}
    for dimension, path in surroundings.items():
        values = None if path is None else path(time_s)
        if values is not None and np.ptp(values) > _SMALLEST_CHANGE[dimension]:
            basis[dimension] = _modes(values, _SURROUNDING_MODES)
            if dimension is FormDimension.TEMPERATURE:
                basis[FormDimension.WARMING] = _history(values, comparison.dt_s)
    if comparison.reference is not Reference.STAGE:
        return basis
    beta_rad = motion.beta(time_s)
    basis[FormDimension.ALPHA] = _modes(motion.alpha(time_s), _MODES)
    basis[FormDimension.BETA] = np.array([
        function(k * beta_rad) / k for k in range(1, _HARMONICS + 1)
        for function in (np.sin, np.cos)])
    return basis


def _of_axis(comparison: BaselineComparison, force_g: np.ndarray, axis: int, volts: np.ndarray
             ) -> Basis:
    """Return functions of the force along and across one axis and of its history, (k, n) each."""
    along_g, across_g = force_g[axis], np.delete(force_g, axis, axis=0)
    if np.ptp(along_g) < _SMALLEST_SPREAD:
        return {}
    time_s, dt_s = comparison.time_s, comparison.dt_s
    slope = np.gradient(along_g, dt_s)
    lagging = [low_pass(along_g, tau_s, dt_s, {}) - along_g for tau_s in _LAG_S]
    # The level of a vibration: squares of the slope and of the fast force, smoothed.
    levels = [low_pass(fast ** 2, tau_s, dt_s, {}) for fast in (slope, lagging[-1])
              for tau_s in _LAG_S]
    basis = {
        FormDimension.FORCE: _modes(along_g, _FORCE_MODES),
        FormDimension.CROSS_FORCE: np.concatenate([
            _products(force_g), *(_modes(f, _CROSS_MODES) for f in across_g)]),
        FormDimension.AGEING: along_g * _modes(time_s, _AGEING_MODES),
        FormDimension.CODE: _code_functions(volts, comparison.sensor.adc_vref_v),
        FormDimension.LAG: _same_size([
            slope, np.gradient(slope, dt_s), slope * along_g, slope ** 2, *lagging, *levels,
            *(np.sqrt(np.abs(level)) for level in levels)])}
    if comparison.reference is not Reference.STAGE:
        return basis
    rates = [joint(time_s, 1) for joint in (comparison.motion.alpha, comparison.motion.beta)]
    moving = [r / np.abs(r).max() for r in rates if np.abs(r).max() > _SMALLEST_RATE_RAD_S]
    if not moving:
        return basis
    factors = (np.ones_like(along_g), along_g)
    basis[FormDimension.RATE] = np.array([
        column for r in moving for column in (r, r * r, r * along_g, np.abs(r))])
    directions = [*map(direction_of_last_move, rates), _direction(along_g)]
    basis[FormDimension.DIRECTION] = np.array([
        direction * factor for direction in directions for factor in factors])
    since_s = time_since_move_s(time_s, rates)
    turning = np.sum([np.abs(r) * (np.abs(r) > _SMALLEST_RATE_RAD_S) for r in moving], axis=0)
    basis[FormDimension.SINCE_MOVE] = _same_size([
        *(np.exp(-since_s / tau_s) for tau_s in _RELAXATION_S),
        *(low_pass(past, tau_s, dt_s, {}) for tau_s in _RELAXATION_S
          for past in (turning, np.sign(turning))),
        *(low_pass(along_g, tau_s, dt_s, {}) - along_g for tau_s in _CREEP_S)])
    return basis


def _history(temperature_c: np.ndarray, dt_s: float) -> np.ndarray:
    """Return lags of the temperature and branches of loops, plain and times it, (k, n)."""
    lags = [low_pass(temperature_c, tau_s, dt_s, {}) - temperature_c for tau_s in _THERMAL_LAG_S]
    branches = [loop(temperature_c, share * np.ptp(temperature_c), {})
                for share in _THERMAL_REACH]
    history = _same_size([*lags, *branches])
    middle_c = (temperature_c.min() + temperature_c.max()) / 2
    return np.concatenate([history, _same_size(list(history * (temperature_c - middle_c)))])


def _same_size(columns: Sequence[np.ndarray]) -> np.ndarray:
    """Return functions of different units, each divided by its rms about its mean, (k, n)."""
    return np.array([c / max(float(np.std(c)), _SMALLEST_RMS) for c in columns])


def _direction(values: np.ndarray) -> np.ndarray:
    """Return the direction of the last change of a quantity, −1 or 1, 0 before the first, (n,)."""
    change = np.diff(values, prepend=values[0])
    changing = np.abs(change) > np.abs(change).max() * _SMALLEST_RATE_RAD_S
    last = np.maximum.accumulate(np.where(changing, np.arange(len(values)), -1))
    return np.where(last >= 0, np.sign(change[np.maximum(last, 0)]), 0.0)


def _code_functions(volts: np.ndarray, vref_v: float) -> np.ndarray:
    """Return harmonics over the range of the volts, and square waves of the heaviest bits."""
    turn = 2 * np.pi * (volts - volts.min()) / np.ptp(volts)
    waves = [function(k * turn) for k in range(1, _CODE_HARMONICS + 1)
             for function in (np.sin, np.cos)]
    bits = [np.floor(volts / vref_v * 2 ** bit) % 2 for bit in range(1, _BITS + 1)]
    return np.array(waves + bits)


def _products(force_g: np.ndarray) -> np.ndarray:
    """Return the products of the components of force from degree two on, (k, n)."""
    count, degrees = len(force_g), range(_PRODUCT_DEGREE + 1)
    powers = [p for p in np.ndindex(*[_PRODUCT_DEGREE + 1] * count)
              if 2 <= sum(p) <= degrees[-1]]
    return np.array([prod(f for f, power in zip(force_g, p) for _ in range(power))
                     for p in powers])


def _modes(values: np.ndarray, count: int, decay: float = 1.5) -> np.ndarray:
    """
    Return cosines over the range of a quantity, (count, n); the j-th has the size j^(−decay).

    A random combination is a smooth curve; with a decay of 1 it is rough like a random walk.
    """
    low, high = float(values.min()), float(values.max())
    if high - low < _SMALLEST_SPREAD:
        return np.zeros((0, len(values)))
    order = np.arange(1, count + 1)
    phase = np.pi * (values - low) / (high - low)
    return np.cos(order[:, None] * phase) * order[:, None] ** -decay


class ResidualCell(NamedTuple):
    """
    Mean residual of one axis in one range of one dimension, m/s²; of a band, root of the excess.

    `share` is of the squares of the residual, `p` the family-wise probability without a gap.
    """

    axis: str
    dimension: str
    low: float
    high: float
    mean_mps2: float
    share: float
    p: float


def dimensions(comparison: BaselineComparison) -> dict[str, np.ndarray]:
    """Return the dimensions of the map by name, (n,) each, without constant ones."""
    time_s, motion = comparison.time_s, comparison.motion
    values = {'time_s': time_s - time_s[0]}
    if comparison.reference is Reference.STAGE:
        alpha_rad, beta_rad = motion.alpha(time_s), motion.beta(time_s)
        values |= {'alpha_rad': alpha_rad, 'beta_rad': beta_rad % (2 * np.pi)}
        force = specific_force(alpha_rad, beta_rad, 1.0)
        values |= {f'force_{axis}_g': f for axis, f in zip(AXES, force)}
        rates = [motion.alpha(time_s, 1), motion.beta(time_s, 1)]
        values['rate_rad_s'] = np.hypot(*rates)
        values['direction_alpha'], values['direction_beta'] = map(direction_of_last_move, rates)
        values['since_move_s'] = np.minimum(time_since_move_s(time_s, rates),
                                            _LONGEST_SINCE_MOVE_S)
    elif comparison.reference is Reference.SIMULATOR and motion.force is not None:
        values |= {f'force_{axis}_g': f / G0_MPS2
                   for axis, f in zip(AXES, motion.force(time_s))}
    if motion.temperature_c is not None:
        values['temperature_c'] = motion.temperature_c(time_s)
    if motion.supply_v is not None:
        values['supply_v'] = motion.supply_v(time_s)
    return {name: v for name, v in values.items() if np.ptp(v) > _SMALLEST_RANGE}


def not_covered(comparisons: Sequence[BaselineComparison]) -> list[str]:
    """Name, for people, the dimensions that no recording covers."""
    covered: set[str] = set()
    for comparison in comparisons:
        covered |= set(dimensions(comparison))
        temperature = comparison.motion.temperature_c
        if temperature is not None \
                and np.ptp(temperature(comparison.time_s)) < _SMALLEST_WARMING_C:
            covered -= {'temperature_c'}
    if all(c.reference is Reference.SIMULATOR for c in comparisons):
        covered |= _STAGE_ONLY
    return [text for name, text in _COVERAGE.items() if name not in covered]


def residual_map(comparison: BaselineComparison, at_full_rate: BaselineComparison,
                 floor_mps2: float, seed: int) -> list[ResidualCell]:
    """Map the residual; frequencies need all samples. The cell of the largest share is first."""
    cells = [*_cells_over_dimensions(comparison, _levelled(comparison), seed),
             *_cells_over_frequency(at_full_rate.sensor, _levelled(at_full_rate))]
    return sorted(cells, key=lambda cell: -cell.share)


def _levelled(comparison: BaselineComparison) -> np.ndarray:
    """Return the residual about its mean, m/s², (n, m); 0 where samples are not used."""
    used = comparison.used
    residual = comparison.residual_v(comparison.sensor) / comparison.scale_v_per_mps2
    return np.where(used[:, None], residual - residual[used].mean(axis=0), 0.0)


def _cells_over_dimensions(comparison: BaselineComparison, residual: np.ndarray, seed: int
                           ) -> Iterator[ResidualCell]:
    """Test the means over all dimensions together."""
    number = np.arange(len(residual)) // max(round(BLOCK_S * comparison.sensor.rate_hz), 2)
    blocks, used, total = int(number[-1]) + 1, comparison.used, float(np.sum(residual ** 2))
    places, sums, counts = [], [], []
    for name, values in dimensions(comparison).items():
        edges = np.unique(np.quantile(values[used], np.linspace(0, 1, RANGES + 1)))
        place = np.clip(np.searchsorted(edges, values, 'right') - 1, 0, len(edges) - 2)
        for i, (low, high) in enumerate(pairwise(edges)):
            chosen = used & (place == i)
            count = np.bincount(number[chosen], minlength=blocks)
            if np.count_nonzero(count) < _FEWEST_BLOCKS:
                continue
            for d, axis in enumerate(comparison.sensor.axes):
                places.append((axis, name, float(low), float(high)))
                sums.append(np.bincount(number[chosen], residual[chosen, d], minlength=blocks))
                counts.append(float(count.sum()))
    if not places:
        return
    by_block, count = np.array(sums), np.array(counts)
    spread = np.maximum(np.sqrt((by_block ** 2).sum(axis=1)), 1e-300)
    signs = np.random.default_rng(seed).choice([-1.0, 1.0], (blocks, _DRAWS))
    largest = np.max(np.abs(by_block @ signs) / spread[:, None], axis=0)
    statistic, mean = np.abs(by_block.sum(axis=1)) / spread, by_block.sum(axis=1) / count
    p = (1 + (largest[None] >= statistic[:, None]).sum(axis=1)) / (_DRAWS + 1)
    for (axis, dimension, low, high), m, n, probability in zip(places, mean, count, p):
        share = min(m ** 2 * n / max(total, 1e-300), 1.0)
        yield ResidualCell(axis, dimension, low, high, float(m), float(share), float(probability))


def _cells_over_frequency(sensor: Sensor, residual: np.ndarray) -> Iterator[ResidualCell]:
    """Compare the power in bands with that of the stated noise (gamma, Bonferroni)."""
    rate_hz = sensor.rate_hz
    frequency_hz, power = scipy.signal.periodogram(residual, rate_hz, axis=0)
    stated = noise.density_v2_per_hz(sensor, frequency_hz) / (sensor.scale_v_per_g / G0_MPS2) ** 2
    total = float(np.sum(np.mean(residual ** 2, axis=0)))
    bands = [(low, min(high, rate_hz / 2)) for low, high in pairwise(_BANDS_HZ)
             if low < rate_hz / 2]
    for low, high in bands:
        inside = (frequency_hz > low) & (frequency_hz <= high)
        count = int(inside.sum())
        for d, axis in enumerate(sensor.axes if count else ''):
            measured, expected = power[inside, d].sum(), stated[inside, d].sum()
            p = float(scipy.stats.gamma.sf(measured / expected * count, count)) * len(bands) \
                * residual.shape[1]
            excess = float(max(measured - expected, 0.0) * frequency_hz[1])
            yield ResidualCell(axis, 'frequency_hz', low, high, excess ** 0.5,
                               min(excess / max(total, 1e-300), 1.0),
                               float(np.clip(p, 1e-12, 1.0)))
