# SPDX-License-Identifier: Apache-2.0
"""
What a residual follows: a map over dimensions, and flexible functions of them.

The map has the mean residual over axis and dimension. Each mean is compared with the largest of
all under random signs of whole blocks (max-T; Westfall and Young 1993), because separate tests at
5 % would report ten of 200 cells by chance.

The functions stand for what no effect of the library describes, and for the difference between
the form of an effect and that of a real sensor (Kennedy and O'Hagan 2001, J. R. Stat. Soc. B 63).
Each axis has functions of its own, by dimension.

The gap is stated in the unit of a user, too: an angle, a velocity, or any function.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from importlib import import_module
from itertools import pairwise
from math import prod
from typing import NamedTuple

from adxl_ros.diagnose import comparison as beside
from adxl_ros.diagnose.comparison import BaselineComparison, direction_of_last_move
from adxl_ros.errors import one_line, UserError
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.effects.base import FormDimension as Form
from adxl_ros.model.filters import loop, low_pass
from adxl_ros.model.sensor import Sensor
import numpy as np
import scipy

RANGES = 8  # Number of ranges of a dimension, with equally many samples. Chosen: a row of the page
_DRAWS, _FEWEST_BLOCKS = 500, 3
"""Draws of random signs, and fewest blocks of a cell. Chosen: probabilities down to 0.002."""
BLOCK_S = 2.0
"""Length of the blocks that change sign together, s. Chosen: beyond the correlation of noise."""
_SIGNIFICANT_P, _MOST_CELLS = 0.05, 40
"""Family-wise probability below which a cell is reported, and their largest number. Chosen: the
usual level; cells of small share say little."""
_SMALLEST_RANGE, _SMALLEST_WARMING_C, _LONGEST_SINCE_MOVE_S = 1e-3, 1.0, 60.0
"""Range of a dimension, in its unit, below which it is constant; that of a temperature that is
covered, °C; and longest time since a move, s. Chosen: an encoder, 0.1 mg, and the end of creep."""
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
_LAG_S, _RELAXATION_S, _CREEP_S = (0.05, 0.5), (1, 4, 16), (2.0, 10.0, 50.0)
"""Time constants of fast lags of the force, of relaxation after a move, and of creep, s. Chosen: a
factor of four to ten apart, slower than the filter of the sensor."""
_THERMAL_LAG_S, _THERMAL_REACH = (20.0, 100.0, 500.0), (0.05, 0.25)
"""Time constants of lags of the temperature, s, and reach of loops over it, divided by its range.
Chosen: a factor of five apart."""
_MODES = {Form.FORCE: 12, Form.ALPHA: 8, Form.CROSS_FORCE: 6, Form.TEMPERATURE: 4, Form.SUPPLY: 4,
          Form.TIME: 16, Form.AGEING: 4}
"""Number of cosines over a quantity. Chosen: smooth laws; a third of the blocks for time."""
_HARMONICS, _CODE_HARMONICS, _BITS, _PRODUCT_DEGREE = 6, 8, 6, 3
"""Harmonics of beta and over the codes, heaviest bits with a wrong weight, and highest degree of
the products of force. Chosen: those of the library."""
_SMALLEST_RATE = 1e-3
"""Largest rate of a joint below which it has no functions, rad/s, and share of the largest change
of the force, below which it keeps its direction. Chosen: it rests."""
_SMALLEST_CHANGE = {'temperature_c': 0.5, 'supply_v': 0.01}
"""Range of temperature, °C, and supply, V, below which they have no functions. Chosen: noise."""
_SMALLEST_SPREAD, _SMALLEST_RMS = 1e-6, 1e-9
"""Range of a point, and rms of a constant function. Chosen: above rounding errors."""

Basis = dict[Form, np.ndarray]
"""Functions of one axis of one recording by dimension, (n, k) each, about their mean. A random
combination with coefficients of standard deviation 1 has an rms of 1."""


def flexible_bases(comparison: BaselineComparison, baseline_v: np.ndarray) -> list[Basis]:
    """
    Compute the flexible functions of a recording.

    Those of temperature and supply also multiply the force, because they change the scale factor,
    and those of the angles its slope over the angle, because they are errors of the angle.
    baseline_v: simulated output of its baseline, V, (n, m).
    """
    force_g = ((baseline_v - comparison.sensor.zero_g_v) / comparison.sensor.scale_v_per_g).T
    common, slopes = _common(comparison), np.zeros((2, len(AXES), 0))
    if comparison.joints:
        slopes = beside.gravity_slopes(*(joint(comparison.time_s) for joint in comparison.joints))
    bases = []
    for axis, along_g in enumerate(force_g):
        factors = {Form.TEMPERATURE: along_g, Form.SUPPLY: along_g,
                   Form.ALPHA: slopes[0, axis], Form.BETA: slopes[1, axis]}
        functions = common | {d: np.concatenate([common[d], common[d] * factor])
                              for d, factor in factors.items() if d in common} \
            | _of_axis(comparison, force_g, axis, baseline_v[:, axis])
        basis = {d: _normalised(values, comparison.used) for d, values in functions.items()}
        bases.append({d: values for d, values in basis.items() if values.shape[1]})
    return bases


def _normalised(functions: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Return functions, (k, n), about their mean, so that a random combination has an rms of 1."""
    count = max(int(used.sum()), 1)
    centred = functions - (functions @ used / count)[:, None]
    squares = np.einsum('kn,kn,n->k', centred, centred, used.astype(float)) / count
    varying = squares > _SMALLEST_RMS ** 2
    size = np.sqrt(max(squares[varying].sum(), _SMALLEST_RMS ** 2))
    return (centred[varying] / size).T


def _common(comparison: BaselineComparison) -> Basis:
    """Return functions that are the same for all axes, (k, n) each, not yet normalised."""
    basis: Basis = {Form.TIME: _modes(comparison.time_s, Form.TIME, 1.0)}
    for name, values in comparison.surroundings.items():
        if np.ptp(values) > _SMALLEST_CHANGE[name]:
            basis[Form(name)] = _modes(values, Form(name))
            if Form(name) is Form.TEMPERATURE:
                basis[Form.WARMING] = _history(values, comparison.dt_s)
    if comparison.joints:
        alpha_rad, beta_rad = (joint(comparison.time_s) for joint in comparison.joints)
        basis[Form.ALPHA] = _modes(alpha_rad, Form.ALPHA)
        basis[Form.BETA] = _harmonics(beta_rad, _HARMONICS)
    return basis


def _of_axis(comparison: BaselineComparison, force_g: np.ndarray, axis: int, volts: np.ndarray
             ) -> Basis:
    """Return functions of the force along and across one axis and of its history, (k, n) each."""
    along_g, across_g = force_g[axis], np.delete(force_g, axis, axis=0)
    if np.ptp(along_g) < _SMALLEST_SPREAD:
        return {}
    time_s, dt_s = comparison.time_s, comparison.dt_s
    slope = np.gradient(along_g, dt_s)
    lagging = _lags(along_g, _LAG_S, dt_s)
    # The level of a vibration: squares of the slope and of the fast force, smoothed.
    levels = [low_pass(fast ** 2, tau_s, dt_s, {}) for fast in (slope, lagging[-1])
              for tau_s in _LAG_S]
    powers = [p for p in np.ndindex(*[_PRODUCT_DEGREE + 1] * len(force_g))
              if 2 <= sum(p) <= _PRODUCT_DEGREE]
    turn = 2 * np.pi * (volts - volts.min()) / np.ptp(volts)
    bits = [np.floor(volts / comparison.sensor.adc_vref_v * 2 ** bit) % 2
            for bit in range(1, _BITS + 1)]
    basis = {
        Form.FORCE: _modes(along_g, Form.FORCE),
        Form.CROSS_FORCE: np.concatenate([
            np.array([prod(f ** k for f, k in zip(force_g, p)) for p in powers]),
            *(_modes(f, Form.CROSS_FORCE) for f in across_g)]),
        Form.AGEING: along_g * _modes(time_s, Form.AGEING),
        Form.CODE: np.array([*_harmonics(turn, _CODE_HARMONICS, 0), *bits]),
        Form.LAG: _same_size([
            slope, np.gradient(slope, dt_s), slope * along_g, slope ** 2, *lagging, *levels,
            *(np.sqrt(np.abs(level)) for level in levels)])}
    rates = [joint(time_s, 1) for joint in comparison.joints or ()]
    moving = [r / np.abs(r).max() for r in rates if np.abs(r).max() > _SMALLEST_RATE]
    if not moving:
        return basis
    basis[Form.RATE] = np.array([
        column for r in moving for column in (r, r * r, r * along_g, np.abs(r))])
    change_g = np.diff(along_g, prepend=along_g[0])
    directions = [*map(direction_of_last_move, rates), direction_of_last_move(
        change_g, np.abs(change_g).max() * _SMALLEST_RATE)]
    basis[Form.DIRECTION] = np.array([d * factor for d in directions
                                      for factor in (np.ones_like(along_g), along_g)])
    since_s = beside.time_since_move_s(time_s, rates)
    turning = np.sum([np.abs(r) * (np.abs(r) > _SMALLEST_RATE) for r in moving], axis=0)
    basis[Form.SINCE_MOVE] = _same_size([
        *(np.exp(-since_s / tau_s) for tau_s in _RELAXATION_S),
        *(low_pass(past, tau_s, dt_s, {}) for tau_s in _RELAXATION_S
          for past in (turning, np.sign(turning))), *_lags(along_g, _CREEP_S, dt_s)])
    return basis


def _lags(values: np.ndarray, times_s: Iterable[float], dt_s: float) -> list[np.ndarray]:
    """Return by how much low-pass filtered values lag, (n,) by time constant."""
    return [low_pass(values, tau_s, dt_s, {}) - values for tau_s in times_s]


def _history(temperature_c: np.ndarray, dt_s: float) -> np.ndarray:
    """Return lags of the temperature and branches of loops, plain and times it, (k, n)."""
    branches = [loop(temperature_c, share * np.ptp(temperature_c), {})
                for share in _THERMAL_REACH]
    history = _same_size([*_lags(temperature_c, _THERMAL_LAG_S, dt_s), *branches])
    middle_c = (temperature_c.min() + temperature_c.max()) / 2
    return np.concatenate([history, _same_size(list(history * (temperature_c - middle_c)))])


def _same_size(columns: Sequence[np.ndarray]) -> np.ndarray:
    """Return functions of different units, each divided by its rms about its mean, (k, n)."""
    return np.array([c / max(float(np.std(c)), _SMALLEST_RMS) for c in columns])


def _harmonics(phase_rad: np.ndarray, count: int, decay: int = 1) -> np.ndarray:
    """Return sines and cosines of harmonics of a phase, the k-th of size k^(−decay), (k, n)."""
    return np.array([function(k * phase_rad) / k ** decay for k in range(1, count + 1)
                     for function in (np.sin, np.cos)])


def _modes(values: np.ndarray, dimension: Form, decay: float = 1.5) -> np.ndarray:
    """
    Return cosines over the range of a quantity, (k, n); the j-th has the size j^(−decay).

    A random combination is a smooth curve; with a decay of 1 it is rough like a random walk.
    """
    low, high = float(values.min()), float(values.max())
    if high - low < _SMALLEST_SPREAD:
        return np.zeros((0, len(values)))
    order = np.arange(1, _MODES[dimension] + 1)[:, None]
    return np.cos(np.pi * order * (values - low) / (high - low)) * order ** -decay


class ResidualCell(NamedTuple):
    """
    Mean residual of one axis in one range of one dimension, m/s².

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
    time_s, force_g = comparison.time_s, comparison.reference_force_g()
    values = {'time_s': time_s - time_s[0], **comparison.surroundings}
    if force_g is not None:
        values |= {f'force_{axis}_g': f for axis, f in zip(AXES, force_g)}
    if comparison.joints:
        alpha_rad, beta_rad = (joint(time_s) for joint in comparison.joints)
        rates = [joint(time_s, 1) for joint in comparison.joints]
        values |= {'alpha_rad': alpha_rad, 'beta_rad': beta_rad % (2 * np.pi),
                   'rate_rad_s': np.hypot(*rates),
                   'direction_alpha': direction_of_last_move(rates[0]),
                   'direction_beta': direction_of_last_move(rates[1]),
                   'since_move_s': np.minimum(beside.time_since_move_s(time_s, rates),
                                              _LONGEST_SINCE_MOVE_S)}
    return {name: v for name, v in values.items() if np.ptp(v) > _SMALLEST_RANGE}


def not_covered(comparisons: Sequence[BaselineComparison]) -> list[str]:
    """Name, for people, the dimensions that no recording covers."""
    covered: set[str] = set()
    for comparison in comparisons:
        covered |= {name for name, values in dimensions(comparison).items()
                    if name != 'temperature_c' or np.ptp(values) >= _SMALLEST_WARMING_C}
    if all(c.reference is beside.Reference.SIMULATOR for c in comparisons):
        covered |= _STAGE_ONLY
    return [text for name, text in _COVERAGE.items() if name not in covered]


def residual_map(comparison: BaselineComparison, seed: int) -> list[ResidualCell]:
    """Return the significant means of the residual over all dimensions, by falling share."""
    used = comparison.used
    residual = comparison.residual_v(comparison.sensor) / comparison.scale_v_per_mps2
    residual = np.where(used[:, None], residual - residual[used].mean(axis=0), 0.0)
    number = np.arange(len(residual)) // max(round(BLOCK_S * comparison.sensor.rate_hz), 2)
    blocks, total = int(number[-1]) + 1, float(np.sum(residual ** 2))
    places, sums, counts = [], [], []
    for name, values in dimensions(comparison).items():
        edges = np.unique(np.quantile(values[used], np.linspace(0, 1, RANGES + 1)))
        place = np.clip(np.searchsorted(edges, values, 'right') - 1, 0, len(edges) - 2)
        for i, (low, high) in enumerate(pairwise(edges)):
            chosen = used & (place == i)
            count = np.bincount(number[chosen], minlength=blocks)
            for d, axis in enumerate(comparison.sensor.axes):
                if np.count_nonzero(count) >= _FEWEST_BLOCKS:
                    places.append((axis, name, float(low), float(high)))
                    sums.append(np.bincount(number[chosen], residual[chosen, d], blocks))
                    counts.append(float(count.sum()))
    if not places:
        return []
    by_block, count = np.array(sums), np.array(counts)
    spread = np.maximum(np.sqrt((by_block ** 2).sum(axis=1)), 1e-300)
    signs = np.random.default_rng(seed).choice([-1.0, 1.0], (blocks, _DRAWS))
    largest = np.max(np.abs(by_block @ signs) / spread[:, None], axis=0)
    statistic, mean = np.abs(by_block.sum(axis=1)) / spread, by_block.sum(axis=1) / count
    p = (1 + (largest[None] >= statistic[:, None]).sum(axis=1)) / (_DRAWS + 1)
    share = np.minimum(mean ** 2 * count / max(total, 1e-300), 1.0)
    cells = [ResidualCell(*place, *map(float, figures))
             for place, *figures in zip(places, mean, share, p) if figures[-1] < _SIGNIFICANT_P]
    return sorted(cells, key=lambda cell: -cell.share)[:_MOST_CELLS]


INTEGRATED_S = 10.0
"""Time over which the acceleration is integrated, s. Chosen: a short loss of other sensors."""

Figure = Callable[[np.ndarray, np.ndarray, np.ndarray], float]
"""Size of a gap by times, s, (n,), and recorded and simulated acceleration, m/s², (n, 3)."""


class Quantity(NamedTuple):
    """A quantity in which a gap is stated."""

    name: str
    unit: str
    figure: Figure


class GapInUnit(NamedTuple):
    """The gap in the unit of a quantity, root mean square over recordings."""

    quantity: str
    unit: str
    before: float  # Recording and simulation by --params
    after: float  # Recording and simulation by params.yaml
    floor: float  # Two simulations, one with noise

    @property
    def text(self) -> str:
        """Return it for people."""
        return (f'{self.quantity} {self.before:.3g} -> {self.after:.3g} {self.unit}; noise alone '
                f'{self.floor:.3g}')


def tilt_deg(time_s: np.ndarray, recorded: np.ndarray, simulated: np.ndarray) -> float:
    """Return the rms angle between the recorded and the simulated vector, deg."""
    cross = np.linalg.norm(np.cross(recorded, simulated), axis=1)
    angle = np.arctan2(cross, np.sum(recorded * simulated, axis=1))
    return float(np.degrees(np.sqrt(np.mean(angle ** 2))))


def velocity_mps(time_s: np.ndarray, recorded: np.ndarray, simulated: np.ndarray) -> float:
    """Return the rms velocity, m/s, that the difference has become after `INTEGRATED_S`."""
    # Over a gap the difference counts as the mean of both sides.
    velocity = scipy.integrate.cumulative_trapezoid(recorded - simulated, time_s, axis=0,
                                                    initial=0)
    later = np.searchsorted(time_s, time_s + INTEGRATED_S)
    within = later < len(time_s)
    if not within.any():
        raise UserError(f'--in velocity: integrates for {INTEGRATED_S:g} s, but the recording '
                        f'has {np.ptp(time_s):.3g} s')
    gained = velocity[later[within]] - velocity[:len(time_s)][within]
    return float(np.sqrt(np.mean(np.sum(gained ** 2, axis=1))))


_QUANTITIES = {'tilt': Quantity('tilt', 'deg', tilt_deg),
               'velocity': Quantity('velocity', f'm/s after {INTEGRATED_S:g} s', velocity_mps)}


def quantity(text: str) -> Quantity:
    """Return tilt, velocity, or that of MODULE:FUNCTION, whose attribute `unit` is shown."""
    if text in _QUANTITIES:
        return _QUANTITIES[text]
    module, _, name = text.partition(':')
    try:
        figure = getattr(import_module(module), name)
        return Quantity(name, getattr(figure, 'unit', ''), figure)
    except (ImportError, AttributeError, ValueError) as error:
        raise UserError(f'--in {text}: {one_line(error)}; give {", ".join(_QUANTITIES)}, or '
                        'MODULE:FUNCTION of a module that Python can import') from None


def gap_in(chosen: Quantity, comparisons: Sequence[BaselineComparison], baseline: Sensor,
           found: Sensor, seed: int) -> GapInUnit:
    """Return the gap before and after what was found, and the same figure of noise alone."""
    def figure(comparison: BaselineComparison, recorded_v: np.ndarray, sensor: Sensor) -> float:
        used = comparison.used & np.isfinite(recorded_v).all(axis=1)
        recorded, simulated = (_acceleration(v[used], baseline) for v in (
            recorded_v, comparison.simulated_v(sensor)))
        try:
            return float(chosen.figure(comparison.time_s[used], recorded, simulated))
        except UserError:
            raise
        except Exception as error:
            raise UserError(f'--in {chosen.name}: {type(error).__name__}: {one_line(error)}'
                            ) from None

    rows = [(figure(c, c.volts, baseline), figure(c, c.volts, found), figure(
        c, c.simulated_v(found) + c.simulated_noise_v(found, seed), found)) for c in comparisons]
    return GapInUnit(chosen.name, chosen.unit, *(
        float(v) for v in np.sqrt(np.mean(np.square(rows), axis=0))))


def _acceleration(volts: np.ndarray, sensor: Sensor) -> np.ndarray:
    """
    Convert volts by zero-g and scale factor of the baseline, m/s², (n, 3).

    Of two axes, gravity gives the third; of one, the others are 0.
    """
    out = np.zeros((len(volts), 3))
    for d, axis in enumerate(sensor.axes):
        out[:, AXES.index(axis)] = (volts[:, d] - sensor.zero_g_v[d]) / sensor.scale_v_per_g[d]
    if len(sensor.axes) == 2:
        out[:, 2] = np.sqrt(np.maximum(1 - out[:, 0] ** 2 - out[:, 1] ** 2, 0.0))
    return out * G0_MPS2
