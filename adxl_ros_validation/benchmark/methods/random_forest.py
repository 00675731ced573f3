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
import scipy
from sklearn.ensemble import RandomForestClassifier

_EXAMPLES = 24
"""Training examples of each effect; chosen: run time."""
_TREES = 200
_BANDS = 6
"""Bands of frequency, and blocks of time."""
_LARGEST = 3.0
"""Largest drawn value of a parameter, in its typical sizes; chosen."""
_NONE = 'none'


def _features(case: Case, rest: np.ndarray) -> np.ndarray:
    """Return numbers that describe a residual, m/s², (n, m)."""
    rows = []
    along = {'time': case.time_s, **case.surroundings}
    force = case.force_mps2[case.known]
    for row, own in zip(rest[case.known].T, force.T):
        spread = float(np.std(row)) or 1e-12
        power = np.array_split(np.abs(np.fft.rfft(row - row.mean()))[1:] ** 2, _BANDS)
        blocks = [part.mean() for part in np.array_split(row, _BANDS)]
        repeated = float(np.mean(np.diff(row) == 0))
        regressors = [own, own**2, own**3, *force.T, *(v[case.known] for v in along.values())]
        related = [_correlation(row, regressor) for regressor in regressors]
        shape = [float(scipy.stats.kurtosis(row)), float(np.max(np.abs(row)) / spread), repeated]
        bands = [float(np.log(part.mean() + 1e-12)) for part in power]
        rows += [row.mean(), np.log(spread), *shape, *bands, *blocks, *related]
    return np.nan_to_num(np.array(rows, float), posinf=0.0, neginf=0.0)


def _correlation(first: np.ndarray, second: np.ndarray) -> float:
    """Return the correlation of two arrays; 0 where one is constant."""
    if np.std(first) == 0 or not np.std(second) > 0:
        return 0.0
    return float(np.corrcoef(first, second)[0, 1])


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
    base = case.simulated_mps2()
    features, labels = [], []
    for effect in [_NONE] * 3 + list(library()):
        for _ in range(_EXAMPLES):
            sensor = case.parameters if effect == _NONE else _drawn(case, effect, rng)
            try:
                output = case.simulated_mps2(sensor, seed=1 + int(rng.integers(2**31)))
            except UserError:
                break  # This reference cannot show the effect.
            features.append(_features(case, output - base))
            labels.append(effect)
    forest = RandomForestClassifier(_TREES, random_state=0)
    forest.fit(np.array(features), labels)
    chances = forest.predict_proba(_features(case, case.measured_mps2 - base)[None])[0]
    best = int(np.argmax(chances))
    name = str(forest.classes_[best])
    return Finding(frozenset({name} - {_NONE}), float(chances[best]))
