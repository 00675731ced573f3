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
The model discrepancy: a flexible term beside the best hypothesis, for what the library lacks.

The term has splines and products over force, rate, direction, temperature, supply and time, by
axis, with a prior of their own. The coefficients of the hypothesis are fitted together with them,
so that the term only explains what the hypothesis cannot. The term is never fitted before the
search, because it would also explain what an effect explains.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from adxl_ros.diagnose import evidence
from adxl_ros.diagnose.baseline_comparison import BaselineComparison, Reference
from adxl_ros.diagnose.evidence import LinearFit
from adxl_ros.diagnose.hypothesis_fit import Hypothesis, linearise
from adxl_ros.diagnose.linear_model import LinearModel
from adxl_ros.diagnose.motion_history import direction_of_last_move, time_since_move_s
from adxl_ros.diagnose.noise_whitening import drifts_among
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.filters import low_pass
from adxl_ros.model.kinematics import specific_force
import numpy as np
from scipy.interpolate import BSpline

_CREEP_S = (2.0, 10.0, 50.0)
"""Time constants of low-pass filtered force (creep), s. Chosen: a factor of five apart."""
_RELAXATION_S = (1, 4, 16)
"""Time constants of relaxation after a move, s. Chosen: a factor of four apart."""
_SPLINES = 12
"""Number of splines over an angle or a component of the force. Chosen: a tenth of the range
each."""
_SURROUNDING_SPLINES = 5
"""Number of splines over temperature or supply. Chosen: smooth laws."""
_HARMONICS = 8
"""Number of harmonics of beta. Chosen: periods of 45° and more."""
_TIME_STEPS = 24
"""Number of steps over time. Chosen: half of the blocks."""
_PRODUCT_DEGREE = 4
"""Highest degree of the products of force. Chosen: the library ends at the third."""
_SMALLEST_RATE_RAD_S = 1e-3
"""Largest rate of a joint below which it has no basis, rad/s. Chosen: it rests."""
_SMALLEST_WARMING_C = 0.5
"""Range of the temperature below which it has no basis, °C. Chosen: less is noise."""
_SMALLEST_SUPPLY_V = 0.01
"""Range of the supply below which it has no basis, V. Chosen: less is noise."""
PRIOR_STD_G = 2e-3
"""Largest standard deviation of one basis function, g. Chosen: some times the noise floor."""
UNKNOWN_LOG_BAYES_FACTOR = 15.0
"""Log Bayes factor from which a flexible term shows something unknown. Tuned by hand on simulated
recordings of the working seeds of the blind check."""
_SHIFT_SHARE = 0.382
"""Share of the recording by which a term is shifted in time, so that it follows nothing there
(circular-shift null).
Chosen: the golden section, far from any period of the manoeuvre."""
_SHIFTED_GAIN_FACTOR = 2.0
"""Gain of a term by chance beside a drift, divided by the gain of the shifted term. Tuned as the
limit above."""

Basis = dict[str, np.ndarray]
"""Basis functions of one recording by dimension, of size about 1, (n, k) each."""


@dataclass(frozen=True)
class Discrepancy:
    """
    What a flexible term shows beside a hypothesis.

    Attributes
    ----------
    log_bayes_factor
        Gain of the log evidence by the term.
    rms_mps2
        Rms of the term over samples and axes, m/s².
    by_dimension
        Gain of the log evidence by the part of each dimension alone.

    """

    log_bayes_factor: float
    rms_mps2: float
    by_dimension: dict[str, float]


def discrepancy(linear_model: LinearModel, hypothesis: Hypothesis) -> Discrepancy:
    """
    Fit the flexible term beside a hypothesis.

    The spectrum of a strong drift is not exactly that of its model, and slow basis functions gain
    by chance. The gain of the same term, shifted in time so that it follows nothing, estimates
    this chance; a multiple of it is subtracted.

    Parameters
    ----------
    linear_model
        The recordings.
    hypothesis
        A fitted hypothesis.

    Returns
    -------
    Discrepancy
        The fitted term.

    """
    bases = [flexible_basis(c) for c in linear_model.comparisons]
    term = _fitted(linear_model, hypothesis, bases)
    if not drifts_among(hypothesis.effects) \
            or term.log_bayes_factor < UNKNOWN_LOG_BAYES_FACTOR:
        return term
    shifted = _fitted(linear_model, hypothesis, [_shifted(basis) for basis in bases])
    return replace(term, log_bayes_factor=term.log_bayes_factor - _SHIFTED_GAIN_FACTOR
                   * max(shifted.log_bayes_factor, 0.0))


def _shifted(basis: Basis) -> Basis:
    """Return basis functions shifted in time; what leaves at the end comes in at the beginning."""
    return {dimension: np.roll(values, round(_SHIFT_SHARE * len(values)), axis=0)
            for dimension, values in basis.items()}


def _fitted(linear_model: LinearModel, hypothesis: Hypothesis, bases: Sequence[Basis]
            ) -> Discrepancy:
    """Fit each dimension alone; then fit those that gain together, with their best amplitudes."""
    linearised = linearise(linear_model, hypothesis.effects, hypothesis.sensor,
                           [np.column_stack(list(basis.values())) for basis in bases],
                           hypothesis.fit.filter_indices)
    count = len(linearised.names)
    ids_by_dimension, basis_std = _numbered(linear_model, bases, count)
    prior_std = np.concatenate([linearised.prior_std, basis_std])
    bounds = np.concatenate([linearised.bounds, np.full(len(basis_std), np.inf)])
    own_ids = list(range(count))

    def fit(ids: Sequence[int], start: LinearFit | None = None) -> LinearFit:
        return evidence.fit_columns(linearised.channels, ids, prior_std, bounds, None, start,
                                    drifts_among(hypothesis.sensor.effects))

    without = fit(own_ids)
    gains, amplitude_cost = {}, float(np.log(len(evidence.AMPLITUDES)))
    for dimension, ids in ids_by_dimension.items():
        with_term = fit([*own_ids, *ids], without)
        places = np.searchsorted(with_term.column_ids, ids)
        by_amplitude = evidence.log_bayes_factor_by_amplitude(
            with_term.values[places], with_term.covariance[np.ix_(places, places)], prior_std[ids])
        gains[dimension] = with_term.log_evidence + float(by_amplitude.max()) \
            - without.log_evidence - amplitude_cost
        prior_std[ids] *= evidence.AMPLITUDES[np.argmax(by_amplitude)]
    kept = [dimension for dimension, gain in gains.items() if gain > 0]
    if not kept:
        return Discrepancy(0.0, 0.0, gains)
    together = fit([*own_ids, *(i for dimension in kept for i in ids_by_dimension[dimension])],
                   without)
    values = np.zeros(len(prior_std))
    values[together.column_ids] = together.values
    return Discrepancy(
        together.log_evidence - without.log_evidence - amplitude_cost * len(kept),
        _rms_mps2(linear_model, bases, values[count:]), gains)


def _numbered(linear_model: LinearModel, bases: Sequence[Basis], first: int
              ) -> tuple[dict[str, list[int]], list[float]]:
    """Return the numbers of the basis functions by dimension, and their prior deviations."""
    ids: dict[str, list[int]] = {}
    std: list[float] = []
    for comparison, basis in zip(linear_model.comparisons, bases):
        for scale in comparison.sensor.scale_v_per_g:
            for dimension, columns in basis.items():
                begin = first + len(std)
                ids.setdefault(dimension, []).extend(range(begin, begin + columns.shape[1]))
                std += [PRIOR_STD_G * float(scale)] * columns.shape[1]
    return ids, std


def discrepancy_instead_of_drift(linear_model: LinearModel, hypotheses: Sequence[Hypothesis]
                                 ) -> Discrepancy | None:
    """
    Return the flexible term in place of a drift, where the term is more probable.

    By the evidence, an unknown law of force or direction may look like a drift. A drift, however,
    follows neither.

    Parameters
    ----------
    linear_model
        The recordings.
    hypotheses
        Hypotheses, the most probable first.

    Returns
    -------
    Discrepancy or None
        The term, with its gain over the drift. None where the term is less probable, or where the
        most probable hypothesis has no drift.

    """
    best = hypotheses[0]
    if not drifts_among(best.effects):
        return None
    without_drift = next(h for h in hypotheses if not drifts_among(h.effects))
    term = discrepancy(linear_model, without_drift)
    gain = without_drift.log_evidence + term.log_bayes_factor - best.log_evidence
    return replace(term, log_bayes_factor=gain) if gain > 0 else None


def _rms_mps2(linear_model: LinearModel, bases: Sequence[Basis], values: np.ndarray) -> float:
    """Return the rms of the flexible term over samples and axes, m/s²."""
    squares, count, first = 0.0, 0, 0
    for comparison, basis in zip(linear_model.comparisons, bases):
        columns, used = np.column_stack(list(basis.values())), comparison.used
        for scale in comparison.scale_v_per_mps2:
            term = columns @ values[first:first + columns.shape[1]] / scale
            first += columns.shape[1]
            squares += float(np.sum((term[used] - term[used].mean()) ** 2))
            count += int(used.sum())
    return float(np.sqrt(squares / max(count, 1)))


def flexible_basis(comparison: BaselineComparison) -> Basis:
    """Return the basis functions of a recording by dimension, (n, k) each, about their mean."""
    time_s, motion = comparison.time_s, comparison.motion
    basis: Basis = {}
    if comparison.reference is Reference.STAGE:
        basis = _stage_basis(time_s, motion.alpha(time_s), motion.beta(time_s),
                             [motion.alpha(time_s, 1), motion.beta(time_s, 1)])
    elif comparison.reference is Reference.SIMULATOR and motion.force is not None:
        basis['force'] = _products(np.array([v / G0_MPS2 for v in motion.force(time_s)]))
    if motion.temperature_c is not None:
        temperature_c = motion.temperature_c(time_s)
        if np.ptp(temperature_c) > _SMALLEST_WARMING_C:
            basis['temperature_c'] = _splines(temperature_c, _SURROUNDING_SPLINES)
    if motion.supply_v is not None:
        supply_v = motion.supply_v(time_s)
        if np.ptp(supply_v) > _SMALLEST_SUPPLY_V:
            basis['supply_v'] = _splines(supply_v, _SURROUNDING_SPLINES)
    steps_s = np.arange(1, _TIME_STEPS + 1)[None] * (time_s[-1] - time_s[0]) \
        / (_TIME_STEPS + 1) + time_s[0]
    basis['time_s'] = (steps_s < time_s[:, None]).astype(float)
    return {dimension: values - values.mean(axis=0) for dimension, values in basis.items()}


def _stage_basis(time_s: np.ndarray, alpha_rad: np.ndarray, beta_rad: np.ndarray,
                 rates_rad_s: Sequence[np.ndarray]) -> Basis:
    """Return basis functions of force, angles, rates and motion history."""
    f = np.array(specific_force(alpha_rad, beta_rad, 1.0))
    basis = {
        'force': np.column_stack([_products(f), *(_splines(component, _SPLINES)
                                                  for component in f)]),
        'alpha_rad': _splines(alpha_rad, _SPLINES),
        'beta_rad': np.column_stack([function(k * beta_rad) for k in range(1, _HARMONICS + 1)
                                     for function in (np.sin, np.cos)])}
    largest = [max(float(np.abs(r).max()), 1e-9) for r in rates_rad_s]
    scaled = [r / s for r, s in zip(rates_rad_s, largest) if s > _SMALLEST_RATE_RAD_S]
    if not scaled:
        return basis
    basis['rate'] = np.column_stack([column for r in scaled for column in (
        r, r * r, r * f[0], r * f[1], r * f[2], np.abs(r))])
    directions = [direction_of_last_move(r) for r in scaled]
    basis['direction'] = np.column_stack([direction * factor for direction in directions
                                          for factor in (np.ones_like(direction), *f)])
    since_s = time_since_move_s(time_s, rates_rad_s)
    dt_s = float(np.median(np.diff(time_s)))
    # Creep follows the force with a delay, by one of several time constants.
    late = [low_pass(component, tau_s, dt_s, {}) - component
            for tau_s in _CREEP_S for component in f]
    basis['since_move_s'] = np.column_stack([
        *(np.exp(-since_s / tau_s) for tau_s in _RELAXATION_S), *late])
    return basis


def _products(f: np.ndarray) -> np.ndarray:
    """Return the products of the components of force of degree two to four, (n, k)."""
    x, y, z = f
    degrees = range(_PRODUCT_DEGREE + 1)
    powers = [(i, j, k) for i in degrees for j in degrees for k in degrees
              if 2 <= i + j + k <= _PRODUCT_DEGREE]
    return np.column_stack([x ** i * y ** j * z ** k for i, j, k in powers])


def _splines(values: np.ndarray, count: int) -> np.ndarray:
    """Return cubic splines over the range of values, (n, k); none where it is a point."""
    low, high = float(values.min()), float(values.max())
    if high - low < 1e-6:
        return np.zeros((len(values), 0))
    inner = np.linspace(low, high, count - 2)
    knots = np.concatenate([[low] * 3, inner, [high] * 3])
    return BSpline.design_matrix(np.clip(values, low, high), knots, 3).toarray()[:, 1:]
