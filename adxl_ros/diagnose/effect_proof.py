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
"""
Proof of each effect: what its absence makes visible, over the effect's own variable.

The proof of an effect on the mean is the recording minus a simulation with all other effects. Its
means over ranges of the variable lie on the line of the effect's model. The proof of an effect on
the noise compares spectra or histograms with and without the effect.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from adxl_ros.diagnose.baseline_comparison import BaselineComparison, Reference
from adxl_ros.diagnose.effect_sizes import without_effects
from adxl_ros.diagnose.evidence import bridged
from adxl_ros.model.constants import AXES, G0_MPS2, Z_90
from adxl_ros.model.diagnosis_hints import ProofVariable
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import ActsOn
from adxl_ros.model.filters import low_pass
from adxl_ros.model.kinematics import specific_force
from adxl_ros.model.sensor import Sensor
import numpy as np
import scipy

_BINS = 10
"""Number of ranges of equal width, and of ranges of equal counts. Chosen: a curve is visible."""
_RATE_S = 20.0
"""Time over which a temperature changes, s. Chosen: beyond the noise of a thermometer."""
_FEWEST_SAMPLES = 20
"""Fewest samples of a range. Chosen: their mean is worth a point."""
_BLOCK_S = 2.0
"""Length of the blocks whose scatter gives the error bars, s. Chosen: beyond the correlation of
the noise."""
_SMALLEST_SHARE = 0.5
"""Share of the effect's variance that the variable must show. Chosen: half of it."""
_CONTRIBUTION = 'what the model of the effect predicts, mg'
"""Variable of an effect that none of its own variables shows."""
_SEGMENT = 4096
"""Samples in a segment of a spectrum. Chosen: 0.06 Hz at 250 Hz."""
_POINTS_PER_OCTAVE = 12
"""Points of a plotted spectrum in an octave. Chosen: lines stay visible."""
_HISTOGRAM_BINS = 81
"""Bins of a histogram. Chosen: an odd number has a bin at 0."""
_HISTOGRAM_QUANTILE = 0.9999
"""Share of the samples within a histogram. Chosen: spikes of 0.1 % are within."""


@dataclass(frozen=True)
class BinnedAxis:
    """
    One axis of a proof over a variable, (b,) each.

    Attributes
    ----------
    axis
        Name of the axis.
    variable
        Mean of the variable in each range.
    residual_mg
        Mean of recording minus simulation without the effect.
    half_width_mg
        Half of its 90 % interval.
    model_mg
        Mean of what the model of the effect predicts.

    """

    axis: str
    variable: np.ndarray
    residual_mg: np.ndarray
    half_width_mg: np.ndarray
    model_mg: np.ndarray


@dataclass(frozen=True)
class Curve:
    """
    A spectrum or a histogram of one axis.

    Attributes
    ----------
    axis
        Name of the axis.
    label
        'recorded', 'without the effect' or 'with the effect'.
    x, y
        Points of the curve, (k,).

    """

    axis: str
    label: str
    x: np.ndarray
    y: np.ndarray


@dataclass(frozen=True)
class EffectProof:
    """
    What shows that an effect is there.

    Attributes
    ----------
    effect
        Name of the effect.
    variable
        Variable with its unit, for people.
    is_spectrum
        Whether `curves` are spectra, in mg/√Hz; otherwise they are histograms.
    binned
        Means over ranges of the variable, axis by axis; empty for curves.
    curves
        Spectra or histograms, axis by axis.

    """

    effect: str
    variable: str
    is_spectrum: bool = False
    binned: tuple[BinnedAxis, ...] = ()
    curves: tuple[Curve, ...] = ()


def prove(effect: str, comparison: BaselineComparison, full_rate: BaselineComparison,
          sensor: Sensor) -> EffectProof:
    """
    Show an effect in a recording.

    Parameters
    ----------
    effect
        Name of an effect of `sensor`.
    comparison, full_rate
        The recording beside the baseline, at the rate of the search and at its full rate.
    sensor
        The baseline with all effects of the verdict.

    Returns
    -------
    EffectProof
        Its plot.

    """
    library_effect = effect_named(effect)
    variables = library_effect.diagnosis.proof
    without = without_effects(sensor, comparison.sensor, [effect])
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
    """
    Estimate the amplitude spectral density of a signal, with equally dense points per octave.

    Parameters
    ----------
    comparison
        The recording, whose unused samples are bridged.
    signal_v
        The signal, V, (n, m).
    label
        Label of the curves.

    Returns
    -------
    list of Curve
        Spectra by axis, mg/√Hz.

    """
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
