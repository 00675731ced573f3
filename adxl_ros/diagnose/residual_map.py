# SPDX-License-Identifier: Apache-2.0
"""
Where the gap lies, and what shows each effect.

The map has the mean residual over axis and dimension. Each mean is compared with the largest of
all under random signs of whole blocks (max-T; Westfall and Young 1993), because separate tests at
5 % would report ten of 200 cells by chance. The power in bands of frequency is compared with that
of the stated noise. The proof of an effect is the recording minus a simulation with all other
effects, over the effect's own variable, or spectra and histograms with and without it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

from adxl_ros.diagnose.comparison import (
    BaselineComparison,
    direction_of_last_move,
    Reference,
    time_since_move_s,
)
from adxl_ros.diagnose.evidence import bridged
from adxl_ros.model import noise
from adxl_ros.model.coefficients import with_neutral
from adxl_ros.model.constants import AXES, G0_MPS2, Z_90
from adxl_ros.model.diagnosis_hints import ProofVariable
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import ActsOn
from adxl_ros.model.filters import low_pass
from adxl_ros.model.kinematics import specific_force
from adxl_ros.model.sensor import Sensor
import numpy as np
import scipy

RANGES = 8
"""Number of ranges of a dimension, with equally many samples. Chosen: a row of the page."""
_DRAWS = 500
"""Number of draws of random signs. Chosen: probabilities down to 0.002."""
_BLOCK_S = 2.0
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


_BINS = 10
"""Ranges of equal width, and of equal counts, of a proof. Chosen: a curve is visible."""
_RATE_S = 20.0
"""Time over which a temperature changes, s. Chosen: beyond the noise of a thermometer."""
_FEWEST_SAMPLES = 20
"""Fewest samples of a range. Chosen: their mean is worth a point."""
_SMALLEST_SHARE = 0.5
"""Share of the effect's variance that the variable must show. Chosen: half of it."""
_CONTRIBUTION = 'what the model of the effect predicts, mg'
"""Variable of an effect that none of its own variables shows."""
_SEGMENT = 4096
"""Samples in a segment of a spectrum. Chosen: 0.06 Hz at 250 Hz."""
_POINTS_PER_OCTAVE = 12
"""Points of a plotted spectrum in an octave. Chosen: lines stay visible."""
_HISTOGRAM_BINS, _HISTOGRAM_QUANTILE = 81, 0.9999
"""Bins, and share of the samples within. Chosen: a bin at 0, and spikes of 0.1 %."""


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


class BinnedAxis(NamedTuple):
    """One axis of a proof over a variable: means of the ranges, with half of 90 % intervals."""

    axis: str
    variable: np.ndarray
    residual_mg: np.ndarray
    half_width_mg: np.ndarray
    model_mg: np.ndarray


class Curve(NamedTuple):
    """A spectrum or a histogram of one axis."""

    axis: str
    label: str
    x: np.ndarray
    y: np.ndarray


@dataclass(frozen=True)
class EffectProof:
    """What shows an effect: means over a variable, or spectra, mg/√Hz, or histograms."""

    effect: str
    variable: str
    is_spectrum: bool = False
    binned: tuple[BinnedAxis, ...] = ()
    curves: tuple[Curve, ...] = ()


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
    number = np.arange(len(residual)) // max(round(_BLOCK_S * comparison.sensor.rate_hz), 2)
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


def prove(effect: str, comparison: BaselineComparison, full_rate: BaselineComparison,
          sensor: Sensor) -> EffectProof:
    """Show an effect of a sensor, which has all effects of the verdict, in a recording."""
    library_effect = effect_named(effect)
    variables = library_effect.diagnosis.proof
    without = replace(sensor, values={**sensor.values, effect: with_neutral(
        comparison.sensor, [effect]).values[effect]})
    if ProofVariable.STEP in variables:
        return EffectProof(effect, ProofVariable.STEP.value,
                           curves=_histograms(full_rate, sensor, without))
    if library_effect.acts_on is ActsOn.NOISE or ProofVariable.FREQUENCY in variables:
        is_noise = library_effect.acts_on is ActsOn.NOISE
        curves = _noise_spectra if is_noise else _mean_spectra
        return EffectProof(effect, ProofVariable.FREQUENCY.value, True,
                           curves=curves(full_rate, sensor, without))
    return _binned(effect, variables, comparison, sensor, without)


def _binned(effect: str, variables: Sequence[ProofVariable], comparison: BaselineComparison,
            sensor: Sensor, without: Sensor) -> EffectProof:
    """Average the residual without the effect over the variable that shows the effect best."""
    to_mg = 1e3 / (G0_MPS2 * comparison.scale_v_per_mps2)
    used = comparison.used
    residual_mg = (comparison.residual_v(without) * to_mg)[used]
    model_mg = residual_mg - (comparison.residual_v(sensor) * to_mg)[used]
    best, values, largest = _CONTRIBUTION, model_mg, _SMALLEST_SHARE
    for variable in variables:
        candidate = _values(comparison, variable)
        if candidate is None:
            continue
        share = _share(candidate[used], model_mg)
        if share > largest:
            best, values, largest = variable.value, candidate[used], share
    block = np.flatnonzero(used) // max(round(_BLOCK_S * comparison.sensor.rate_hz), 1)
    axes = tuple(_bin(axis, values[:, d], residual_mg[:, d], model_mg[:, d], block)
                 for d, axis in enumerate(comparison.sensor.axes))
    return EffectProof(effect, best, binned=axes)


def _places(values: np.ndarray) -> np.ndarray:
    """Return the range of each value, (n,); quantiles and equal widths divide the ranges."""
    shares = np.linspace(0, 1, _BINS + 1)
    low, high = float(values.min()), float(values.max())
    edges = np.unique([*np.quantile(values, shares), *(low + (high - low) * shares)])
    return np.clip(np.searchsorted(edges, values, 'right') - 1, 0, max(len(edges) - 2, 0))


def _share(values: np.ndarray, model_mg: np.ndarray) -> float:
    """Return the share of the variance of the model that lies between the ranges of a variable."""
    between = total = 0.0
    for d in range(model_mg.shape[1]):
        place = _places(values[:, d])
        count = np.maximum(np.bincount(place), 1)
        mean = np.bincount(place, model_mg[:, d]) / count
        between += float(np.sum(count * mean ** 2))
        total += float(np.sum(model_mg[:, d] ** 2))
    return between / total if total else 0.0


def _bin(axis: str, values: np.ndarray, residual_mg: np.ndarray, model_mg: np.ndarray,
         block: np.ndarray) -> BinnedAxis:
    """Average one axis over the ranges of the variable."""
    place = _places(values)
    count = np.bincount(place)
    filled = count >= min(_FEWEST_SAMPLES, int(count.max()))
    count = np.maximum(count, 1)
    means = [np.bincount(place, v) / count for v in (values, residual_mg, model_mg)]
    # The noise is correlated, so that the sums of whole blocks give the error of a mean.
    noise_mg = residual_mg - model_mg - (means[1] - means[2])[place]
    cell = place * (int(block.max()) + 1) + block
    sums = np.bincount(cell, noise_mg)
    owner = np.arange(len(sums)) // (int(block.max()) + 1)
    std = np.sqrt(np.bincount(owner, sums ** 2, minlength=len(count))) / count
    return BinnedAxis(axis, *(v[filled] for v in (means[0], means[1], Z_90 * std, means[2])))


def _values(comparison: BaselineComparison, variable: ProofVariable) -> np.ndarray | None:
    """Return a variable at the samples of each axis, (n, m); None where it is not known."""
    time_s, motion, axes = comparison.time_s, comparison.motion, comparison.sensor.axes
    if variable is ProofVariable.OUTPUT:
        return comparison.volts
    by_time = {ProofVariable.TIME: time_s - time_s[0]}
    if motion.temperature_c is not None:
        temperature_c = motion.temperature_c(time_s)
        late_k = temperature_c - low_pass(temperature_c, _RATE_S, comparison.dt_s, {})
        by_time |= {ProofVariable.TEMPERATURE: temperature_c,
                    ProofVariable.TEMPERATURE_RATE: late_k * 60 / _RATE_S}
    if motion.supply_v is not None:
        by_time[ProofVariable.SUPPLY] = motion.supply_v(time_s)
    if comparison.reference is Reference.STAGE:
        by_time |= {
            ProofVariable.ALPHA: np.degrees(motion.alpha(time_s)),
            ProofVariable.BETA: np.degrees(motion.beta(time_s)) % 360,
            ProofVariable.ALPHA_RATE: np.degrees(motion.alpha(time_s, 1)),
            ProofVariable.BETA_RATE: np.degrees(motion.beta(time_s, 1)),
            ProofVariable.ALPHA_ACCELERATION: np.degrees(motion.alpha(time_s, 2)),
            ProofVariable.BETA_ACCELERATION: np.degrees(motion.beta(time_s, 2))}
    if variable in by_time:
        return np.repeat(by_time[variable][:, None], len(axes), axis=1)
    force_g = _force_g(comparison)
    if force_g is None:
        return None
    places = [AXES.index(axis) for axis in axes]
    if variable is ProofVariable.OWN_FORCE:
        return force_g[:, places]
    if variable is ProofVariable.CROSS_FORCE:
        return force_g[:, [1 if d == 0 else 0 for d in places]]
    if variable is ProofVariable.FORCE_Z:
        return force_g[:, [2] * len(axes)]
    if variable is ProofVariable.FORCE_RATE:
        return np.gradient(force_g, time_s, axis=0)[:, places]
    return None


def _force_g(comparison: BaselineComparison) -> np.ndarray | None:
    """Return the specific force of the reference, g, (n, 3); None without a reference."""
    time_s, motion = comparison.time_s, comparison.motion
    if comparison.reference is Reference.STAGE:
        return np.column_stack(specific_force(motion.alpha(time_s), motion.beta(time_s), 1.0))
    if comparison.reference is Reference.SIMULATOR and motion.force is not None:
        return np.column_stack(motion.force(time_s)) / G0_MPS2
    return None


def _mean_spectra(comparison: BaselineComparison, sensor: Sensor, without: Sensor
                  ) -> tuple[Curve, ...]:
    """Return spectra of recording minus simulation, without and with an effect on the mean."""
    residuals = {'without the effect': without, 'with the effect': sensor}
    return tuple(curve for label, simulated in residuals.items()
                 for curve in spectra(comparison, comparison.residual_v(simulated), label))


def _noise_spectra(comparison: BaselineComparison, sensor: Sensor, without: Sensor
                   ) -> tuple[Curve, ...]:
    """Return the spectrum of the recorded noise, and of simulated noise with and without."""
    signals_v = {'recorded': comparison.residual_v(sensor),
                 'without the effect': comparison.simulated_noise_v(without, 0),
                 'with the effect': comparison.simulated_noise_v(sensor, 0)}
    return tuple(curve for label, signal_v in signals_v.items()
                 for curve in spectra(comparison, signal_v, label))


def spectra(comparison: BaselineComparison, signal_v: np.ndarray, label: str) -> list[Curve]:
    """Estimate spectra, mg/√Hz, by axis, with equally dense points per octave."""
    signal_mg = bridged(signal_v, comparison.used) * 1e3 / (G0_MPS2 * comparison.scale_v_per_mps2)
    frequency_hz, power = scipy.signal.welch(
        np.nan_to_num(signal_mg), comparison.sensor.rate_hz, axis=0,
        nperseg=min(_SEGMENT, len(signal_mg)))
    frequency_hz, power = frequency_hz[1:], power[1:]
    place = np.floor(np.log2(frequency_hz / frequency_hz[0]) * _POINTS_PER_OCTAVE).astype(int)
    _, place = np.unique(place, return_inverse=True)
    count = np.bincount(place)
    mean_hz = np.bincount(place, frequency_hz) / count
    return [Curve(axis, label, mean_hz, np.sqrt(np.bincount(place, power[:, d]) / count))
            for d, axis in enumerate(comparison.sensor.axes)]


def _histograms(comparison: BaselineComparison, sensor: Sensor, without: Sensor
                ) -> tuple[Curve, ...]:
    """Return histograms of the changes from one sample to the next, recorded and simulated."""
    to_mg = 1e3 / (G0_MPS2 * comparison.scale_v_per_mps2)
    at_rate = replace(without, rate_hz=comparison.sensor.rate_hz)
    mean_v = comparison.simulated_v(at_rate)
    signals_v = {'recorded': comparison.volts,
                 'without the effect': mean_v + comparison.simulated_noise_v(without, 0),
                 'with the effect': mean_v + comparison.simulated_noise_v(sensor, 0)}
    steps = {label: np.diff(v * to_mg, axis=0) for label, v in signals_v.items()}
    curves = []
    for d, axis in enumerate(comparison.sensor.axes):
        finite = steps['recorded'][:, d][np.isfinite(steps['recorded'][:, d])]
        reach = float(np.quantile(np.abs(finite), _HISTOGRAM_QUANTILE))
        edges = np.linspace(-reach, reach, _HISTOGRAM_BINS + 1)
        for label, values in steps.items():
            count, _ = np.histogram(values[:, d], edges)
            curves.append(Curve(axis, label, (edges[1:] + edges[:-1]) / 2, count))
    return tuple(curves)
