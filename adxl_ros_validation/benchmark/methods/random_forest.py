# SPDX-License-Identifier: Apache-2.0
"""
A random forest on features of the residual, trained on simulations of the same motion.

It learns one effect, or none, of the library; so it cannot name a pair or an unknown cause, and it
finds no sizes.
"""

from __future__ import annotations

from adxl_ros.errors import UserError
from adxl_ros.model.effects import library
from adxl_ros.model.sensor import fitted_of, get, parameter_of, put, Sensor, with_neutral
from adxl_ros_validation.benchmark.case import Case, Finding
import numpy as np
from sklearn.ensemble import RandomForestClassifier

_EXAMPLES = 16
"""Training examples of each effect; chosen: run time."""
_TREES = 200
_BANDS = 6
"""Bands of frequency, and blocks of time."""
_LARGEST = 3.0
"""Largest drawn value of a parameter, in its typical sizes; chosen."""
_NONE = 'none'


def _regressors(case: Case) -> list[np.ndarray]:
    """Return what a residual may follow, of length 1 or 0, by axis, (k, n) each."""
    force = case.force_mps2[case.known].T
    along = [values[case.known] for values in (case.time_s, *case.surroundings.values())]
    found = []
    for own in force:
        rows = np.nan_to_num(np.array([own, own**2, own**3, *force, *along]))
        rows -= rows.mean(axis=1, keepdims=True)
        lengths = np.linalg.norm(rows, axis=1, keepdims=True)
        found.append(rows / np.where(lengths > 1e-9, lengths, np.inf))
    return found


def _features(rest: np.ndarray, regressors: list[np.ndarray]) -> np.ndarray:
    """Return numbers that describe a residual where its reference is known, m/s², (n, m)."""
    rows = []
    for values, along in zip(rest.T, regressors):
        mean = values.mean()
        row = values - mean
        spread = float(np.std(row)) or 1e-12
        power = np.array_split(np.abs(np.fft.rfft(row))[1:] ** 2, _BANDS)
        bands = [float(np.log(part.mean() + 1e-12)) for part in power]
        blocks = [part.mean() for part in np.array_split(values, _BANDS)]
        ratios = row / spread
        shape = [np.mean(ratios**4), np.max(np.abs(ratios)), np.mean(np.diff(row) == 0)]
        related = along @ ratios / np.sqrt(len(row))
        rows += [mean, np.log(spread), *shape, *bands, *blocks, *related]
    return np.nan_to_num(np.array(rows, float), posinf=0.0, neginf=0.0)


def _drawn(case: Case, effect: str, rng: np.random.Generator) -> Sensor:
    """Return the parameters with an effect of a random size."""
    sensor = with_neutral(case.parameters, [effect])
    names = fitted_of(library()[effect], sensor.axes)
    sizes = rng.uniform(-_LARGEST, _LARGEST, len(names))
    values = get(sensor, names) + sizes * [parameter_of(name).scale for name in names]
    bounds = np.array([(parameter_of(name).lower, parameter_of(name).upper) for name in names])
    return put(sensor, names, np.clip(values, *bounds.reshape(-1, 2).T))


def method(case: Case) -> Finding:
    """Train on simulations of this motion, and classify the residual."""
    rng = np.random.default_rng(0)
    base, known, regressors = case.simulated_mps2(), case.known, _regressors(case)
    features, labels = [], []
    for effect in [_NONE] * 3 + list(library()):
        for _ in range(_EXAMPLES):
            sensor = case.parameters if effect == _NONE else _drawn(case, effect, rng)
            try:
                output = case.simulated_mps2(sensor, seed=1 + int(rng.integers(2**31)))
            except UserError:
                break  # This reference cannot show the effect.
            features.append(_features((output - base)[known], regressors))
            labels.append(effect)
    forest = RandomForestClassifier(_TREES, random_state=0)
    forest.fit(np.array(features), labels)
    measured = _features((case.measured_mps2 - base)[known], regressors)
    chances = forest.predict_proba(measured[None])[0]
    best = int(np.argmax(chances))
    name = str(forest.classes_[best])
    return Finding(frozenset({name} - {_NONE}), float(chances[best]))
