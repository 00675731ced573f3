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
A random forest on features of the residual: the baseline of the blind check that learns.

It is trained on recordings of the package's own simulator. Nothing in it knows the world of the
blind check. It names one effect, or a group of effects where several are nearly as probable.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import replace
from functools import partial
from hashlib import sha256
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import Any

from adxl_ros.blind.grading import Answer, UNKNOWN
from adxl_ros.errors import install_hint, UserError
from adxl_ros.files import parameter_file, recording
from adxl_ros.files.recording_columns import Recording
from adxl_ros.jobs.run import for_each
from adxl_ros.jobs.whole_files import write
from adxl_ros.model import coefficients
from adxl_ros.model.constants import G0_MPS2, NOMINAL_SUPPLY_V, NOMINAL_TEMPERATURE_C
from adxl_ros.model.effects import effect_named, library
from adxl_ros.model.effects.base import ActsOn, Coefficient, Role
from adxl_ros.model.sensor import Sensor
from adxl_ros.simulate import simulator
from adxl_ros.simulate.from_recording import motion_from_references
from adxl_ros.simulate.motion import Held, Motion, Path as JointPath
from adxl_ros.simulate.response import Response
from adxl_ros.simulate.trajectories import Script, Sine, Steps
import numpy as np
import scipy

TRAINING_RECORDINGS = 1200
"""Number of recordings to train on; chosen: 25 of each effect take five minutes on two cores."""
_NULL_SHARE = 0.25
"""Share of them without an effect; chosen: that of the blind check."""
_TREES = 300
"""Number of trees; chosen: each recording is out of bag for a hundred of them."""
_FEATURES_OF_A_SPLIT = 0.2
"""Share of the features that a split chooses from. Tuned by the out-of-bag error of the training
recordings: it is 0.30, and 0.32 with the root of their number."""
_STRENGTH_G = (0.3e-3, 15e-3)
"""Smallest and largest rms of an effect on the mean, g; chosen: from below the noise on. The
logarithm is uniform."""
_TIMES_TYPICAL = (0.3, 10.0)
"""Smallest and largest size of an effect on the noise, in its typical size; chosen."""
_SHAPE_FACTOR = 2.0
"""Largest factor between a shape, or a limit, and its typical value; chosen."""
_CALIBRATION_STD = 150e-6
"""Standard deviation of zero-g, g, and scale factor, a share, since the calibration; chosen."""
_CAPACITANCE_F = (0.047e-6, 0.33e-6)
"""Smallest and largest filter capacitor, F; the datasheet's for 100 and 15 Hz."""
_WALK_G_PER_RTS = (1e-6, 1e-5)
"""Random walk of a healthy unit, g/√s; chosen: up to half of the typical effect."""
_GROUP_RATIO = 0.5
"""Smallest probability of an effect in a group, as a share of the most probable one; chosen."""
_UNKNOWN_QUANTILE = 0.1
"""Share of the library's effects that the forest may call unknown in training; chosen."""
_BAND_EDGES_HZ = (0.0, 0.05, 0.2, 0.5, 1.0, 2.0, 4.0, 7.0, 10.0, 15.0, 20.0, 30.0, 40.0, 49.0,
                  51.0, 59.0, 61.0, 125.0)
"""Edges of the bands of the spectrum, Hz; chosen: octaves, and both mains frequencies."""
_AXES = 'xyz'


def answers(recordings: Path, pool: Executor, show: Callable[[float], None]) -> dict[str, Answer]:
    """
    Train a forest, and answer every recording of a folder.

    Parameters
    ----------
    recordings
        Folder of recordings (CSV) and their parameter files (YAML) of the same names.
    pool
        Simulates in parallel.
    show
        Receives the fraction that is finished.

    Returns
    -------
    dict
        Answers by name.

    Raises
    ------
    UserError
        Scikit-learn is not installed.

    """
    forest = forest_class()(_TREES, max_features=_FEATURES_OF_A_SPLIT, oob_score=True, n_jobs=-1,
                            class_weight='balanced_subsample', random_state=0)
    effects, rows = train(recordings.parent, pool, lambda done: show(0.9 * done))
    forest.fit(rows, effects)
    lowest = _lowest_probability(forest, effects)
    features_by_name: dict[str, np.ndarray] = {}

    def keep(name: str, effect: str, row: np.ndarray) -> None:
        features_by_name[name] = row

    jobs = [partial(tuple, [path]) for path in sorted(recordings.glob('*.csv'))]
    for_each(pool, recorded_row, jobs, keep, lambda done: show(0.9 + 0.1 * done))
    return {name: _answer(forest.classes_, forest.predict_proba(row[None])[0], lowest)
            for name, row in features_by_name.items()}


def train(folder: Path, pool: Executor, show: Callable[[float], None]
          ) -> tuple[np.ndarray, np.ndarray]:
    """
    Simulate the recordings to train on, unless the folder has their features.

    Parameters
    ----------
    folder
        Folder of a check; gets `forest.npz`, which is the same for every check.
    pool
        Simulates in parallel.
    show
        Receives the fraction that is finished.

    Returns
    -------
    tuple
        The effect of each recording, (n,), empty without one, and its features, (n, k).

    """
    path = folder / 'forest.npz'
    version = f'{TRAINING_RECORDINGS} {sha256(Path(__file__).read_bytes()).hexdigest()}'
    if path.exists():
        with np.load(path) as stored:
            if str(stored['version']) == version:
                return stored['effects'], stored['features']
    rows: dict[str, tuple[str, np.ndarray]] = {}

    def keep(name: str, effect: str, row: np.ndarray) -> None:
        rows[name] = effect, row

    jobs = [partial(tuple, [number]) for number in range(TRAINING_RECORDINGS)]
    for_each(pool, training_row, jobs, keep, show)
    training = [rows[name] for name in sorted(rows)]
    effects = np.array([effect for effect, _ in training])
    matrix = np.stack([row for _, row in training])
    content = BytesIO()
    np.savez_compressed(content, version=version, effects=effects, features=matrix)
    write(path, content.getvalue())
    return effects, matrix


def forest_class() -> Any:
    """
    Return scikit-learn's random forest.

    Raises
    ------
    UserError
        Scikit-learn is not installed.

    """
    try:
        from sklearn.ensemble import RandomForestClassifier
    except ImportError:
        raise UserError('the random forest of the blind check needs scikit-learn; '
                        + install_hint('scikit-learn')) from None
    return RandomForestClassifier


def _lowest_probability(forest: Any, effects: np.ndarray) -> float:
    """Return the probability below which the best effect is unknown; from out-of-bag votes."""
    votes = forest.oob_decision_function_
    best = forest.classes_[np.argmax(votes, axis=1)]
    right = (best == effects) & (best != '')
    return float(np.quantile(votes.max(axis=1)[right], _UNKNOWN_QUANTILE)) if right.any() else 0.0


def _answer(classes: np.ndarray, probability: np.ndarray, lowest: float) -> Answer:
    """Turn the votes of the forest into an answer; the class without a name has no effect."""
    by_effect = {str(name): float(p) for name, p in zip(classes, probability)}
    hypotheses = tuple((frozenset({name} if name else ()), p) for name, p in by_effect.items())
    none = by_effect.pop('', 0.0)
    best = max(by_effect.values())
    if none >= best:
        return Answer('no_gap', frozenset(), (), none, hypotheses, {}, 0.0)
    if best < lowest:
        unknown = frozenset({UNKNOWN})
        return Answer('unknown', unknown, (), 1 - none, ((unknown, 1 - none),), {}, 0.0)
    group = frozenset(name for name, p in by_effect.items() if p >= _GROUP_RATIO * best)
    total = sum(by_effect[name] for name in group)
    if len(group) == 1:
        return Answer('explained', group, (), total, hypotheses, {}, 0.0)
    return Answer('inseparable', frozenset(), (group,), total, hypotheses, {}, 0.0)


def training_row(number: int) -> tuple[str, str, np.ndarray]:
    """Simulate a recording; return its name, its effect (empty without one) and its features."""
    rng = np.random.default_rng([18, number])
    stated, motion = _stated(rng), _motion(rng)
    names = sorted(library())
    effect = '' if rng.random() < _NULL_SHARE else names[number % len(names)]
    sensor = _aged(stated, rng)
    if effect:
        sensor = _with_effect(sensor, motion, effect, rng)
    columns = simulator.simulate(sensor, motion, int(rng.integers(2 ** 31)))
    time_s = columns.pop('time_s')
    return f'{number:05d}', effect, features(Recording('', time_s, columns), stated)


def recorded_row(path: Path) -> tuple[str, str, np.ndarray]:
    """Return name, no effect, and features of a recording with its parameter file."""
    stated = parameter_file.load(path.with_suffix('.yaml'))
    return path.stem, '', features(recording.read(path), stated)


def _stated(rng: np.random.Generator) -> Sensor:
    """Draw a unit as its parameter file states it."""
    axes = _AXES if rng.random() < 0.7 else 'xy'
    m = len(axes)
    return replace(
        parameter_file.load(parameter_file.nominal_path()), axes=axes,
        nominal_zero_g_v=2.5 + 0.04 * rng.uniform(-1, 1, m),
        nominal_scale_v_per_g=1.0 + 0.04 * rng.uniform(-1, 1, m),
        noise_density_g_per_rthz=110e-6 * np.exp(rng.normal(0, 0.1, m)),
        rc_capacitance_f=float(_log_uniform(rng, _CAPACITANCE_F, 1)[0]),
        rate_hz=float(rng.choice([100.0, 125.0, 200.0, 250.0])),
        stage_resolution_rad=float(np.radians(10 ** rng.uniform(-2.7, -1.0))),
        datasheet_name='', datasheet={})


def _aged(sensor: Sensor, rng: np.random.Generator) -> Sensor:
    """Return the unit as it is some days after its calibration."""
    m = len(sensor.axes)
    values = {'bias': {'offset_v': _CALIBRATION_STD * rng.normal(size=m)},
              'scale_factor': {'offset_v_per_g': _CALIBRATION_STD * rng.normal(size=m)},
              'bias_walk': {'density_g_per_rts': _log_uniform(rng, _WALK_G_PER_RTS, m)}}
    return replace(sensor, effects=tuple(values), values=values)


def _log_uniform(rng: np.random.Generator, limits: tuple[float, float], count: int) -> np.ndarray:
    return np.exp(rng.uniform(np.log(limits[0]), np.log(limits[1]), count))


def _motion(rng: np.random.Generator) -> Motion:
    """Draw a manoeuvre of planes, tilts and poses, with or without a shaker, heat and supply."""
    script = Script(rng.uniform(0.5, 2.6), rng.uniform(-np.pi, np.pi))
    length_s = rng.uniform(90, 200)
    script.rest(2.0)
    while script.now < length_s:
        speed = np.radians(rng.uniform(10, 90))
        move = rng.integers(3)
        if move == 0:
            script.run('beta', script.beta + rng.choice([-1, 1]) * rng.uniform(3, 6.3), speed)
        elif move == 1:
            to = rng.uniform(0, 1) if script.alpha > np.pi / 2 else rng.uniform(2.1, 3.1)
            script.run('alpha', to, speed)
        else:
            script.go(rng.uniform(0, np.pi), rng.uniform(-np.pi, np.pi))
        script.rest(rng.uniform(0.5, 3.0))
    alpha, beta = script.joints()
    hertz = rng.uniform(3, 10)
    shift: JointPath = Sine(rng.uniform(0.2, 2) / (2 * np.pi * hertz) ** 2, hertz) \
        if rng.random() < 0.5 else Held()
    starts = np.sort(rng.uniform(0, script.now, 4))
    temperature_c = Steps(NOMINAL_TEMPERATURE_C, tuple(
        (start, NOMINAL_TEMPERATURE_C + rng.uniform(-10, 15)) for start in starts[::2]), 30.0)
    supply_v = Steps(NOMINAL_SUPPLY_V, tuple(
        (start, NOMINAL_SUPPLY_V + rng.uniform(-0.2, 0.2)) for start in starts[1::2]), 0.5)
    return Motion(script.now, alpha, beta, shift, temperature_c, supply_v, internal_rate_hz=250.0)


def _with_effect(sensor: Sensor, motion: Motion, name: str, rng: np.random.Generator) -> Sensor:
    """Add an effect of a random size on random axes, beside what the unit has of it."""
    effect = effect_named(name)
    typical = coefficients.typical(effect, sensor.axes)
    sizes = [p.name for p in effect.parameters if p.role is Role.SIZE]
    for parameter in effect.parameters:
        values = typical[parameter.name]
        if parameter.name in sizes:
            signs = rng.normal(size=values.shape)
            values = parameter.neutral + (values - parameter.neutral) * (
                signs if parameter.lower < parameter.neutral else np.abs(signs))
        elif parameter.role in (Role.SHAPE, Role.LIMIT):
            values = values * _SHAPE_FACTOR ** rng.uniform(-1, 1)
        typical[parameter.name] = np.clip(values, parameter.lower, parameter.upper)
    affected = replace(sensor, effects=tuple(dict.fromkeys((*sensor.effects, name))),
                       values={**sensor.values, name: typical})
    factor = float(_log_uniform(rng, _TIMES_TYPICAL, 1)[0])
    if effect.acts_on is ActsOn.MEAN:
        quiet = replace(noiseless(sensor), rate_hz=100.0)
        changed = replace(noiseless(affected), rate_hz=100.0)
        time_s = np.arange(0, motion.duration_s, 0.01)
        change_g = (Response(changed, motion, 0)(time_s) - Response(quiet, motion, 0)(time_s)) \
            / sensor.nominal_scale_v_per_g
        factor = float(_log_uniform(rng, _STRENGTH_G, 1)[0]) / max(
            float(np.sqrt(np.mean(change_g ** 2))), 1e-9)
    names = [Coefficient(name, p.name, a) for p in effect.parameters if p.name in sizes
             for a in ([a for a in sensor.axes if a in p.axes] if p.axes else [''])]
    bounds = [coefficients.parameter_of(coefficient) for coefficient in names]
    sized = [float(np.clip(p.neutral + factor * (value - p.neutral), p.lower, p.upper))
             for p, value in zip(bounds, coefficients.get(affected, names))]
    return coefficients.put(affected, names, sized)


def noiseless(sensor: Sensor) -> Sensor:
    """Return the sensor without noise and without the steps of its ADC."""
    mean = tuple(e for e in sensor.effects if effect_named(e).acts_on is ActsOn.MEAN)
    return replace(sensor, noise_density_g_per_rthz=np.zeros(len(sensor.axes)), adc_bits=48,
                   effects=mean, values={e: sensor.values[e] for e in mean})


def features(read: Recording, stated: Sensor) -> np.ndarray:
    """
    Return the features of a recording.

    Parameters
    ----------
    read
        The recording, with stage angles.
    stated
        The unit as its parameter file states it.

    Returns
    -------
    numpy.ndarray
        Features axis by axis, (k,); NaN for an axis that the sensor does not have.

    """
    sensor = replace(stated, rate_hz=read.rate_hz)
    motion = motion_from_references(read, sensor)
    motion = replace(motion, internal_rate_hz=max(250.0, sensor.rate_hz))
    time_s = read.time_s
    simulated_v = Response(noiseless(sensor), motion, 0, float(time_s[0]))(time_s)
    force = (simulated_v - sensor.zero_g_v) / sensor.scale_v_per_g
    gap = (read.volts(sensor) - simulated_v) / sensor.scale_v_per_g
    drives = _drives(motion, time_s - time_s[0], force, sensor.rate_hz)
    bandwidth_hz = min(sensor.rate_hz / 2, 0.25 / sensor.rc_s if sensor.rc_s else np.inf)
    rows: list[np.ndarray] = []
    for d in range(len(_AXES)):
        if d >= len(sensor.axes):
            rows.append(np.full_like(rows[0], np.nan))
            continue
        floor_g = sensor.noise_density_g_per_rthz[d] * np.sqrt(bandwidth_hz)
        codes = np.rint(read.volts(sensor)[:, d] / stated.lsb_v)
        rows.append(np.concatenate([
            _statistics(gap[:, d] / floor_g, codes), _bands(gap[:, d] / floor_g, sensor.rate_hz),
            _regressions(gap[:, d] / floor_g, force[:, d], drives, sensor.rate_hz)]))
    return np.concatenate(rows)


def _statistics(gap: np.ndarray, codes: np.ndarray) -> np.ndarray:
    """Return moments, repeated and isolated samples, and how the codes are divisible."""
    std = np.std(gap) + 1e-9
    step = np.diff(gap)
    isolated = np.abs(gap[1:-1] - (gap[:-2] + gap[2:]) / 2) > 6 * np.std(step)
    return np.array([
        np.log(std), np.mean(gap), scipy.stats.skew(gap), scipy.stats.kurtosis(gap),
        np.log(np.max(np.abs(gap)) / std),
        np.log(np.std(step) + 1e-9), np.mean(np.diff(codes) == 0), np.sum(isolated),
        *(np.mean(codes % 2 ** k == 0) for k in (1, 2, 3, 4))])


def _bands(gap: np.ndarray, rate_hz: float) -> np.ndarray:
    """Return the logarithms of power in bands, and frequency and height of the largest line."""
    hertz, power = scipy.signal.welch(gap, rate_hz, nperseg=min(len(gap), int(40 * rate_hz)))
    parts = [(hertz >= low) & (hertz < high) for low, high in pairwise(_BAND_EDGES_HZ)]
    levels = [np.mean(power[part]) if part.any() else np.nan for part in parts]
    ratio = power / np.median(power)
    return np.array([*np.log(np.array(levels) + 1e-12), hertz[np.argmax(ratio[hertz > 5])],
                     np.log(np.max(ratio[hertz > 5]))])


def _drives(motion: Motion, time_s: np.ndarray, force: np.ndarray, rate_hz: float
            ) -> list[np.ndarray]:
    """Return the quantities that effects may follow, (n,) each, whatever the axis."""
    alpha, beta = (path(time_s) for path in (motion.alpha, motion.beta))
    alpha_rate, beta_rate = (path(time_s, 1) for path in (motion.alpha, motion.beta))
    drives = [np.cos(alpha), np.sin(alpha) * np.cos(beta), np.sin(alpha) * np.sin(beta)]
    drives += [a * b for i, a in enumerate(drives) for b in drives[i:]]
    drives += [np.sin(beta), np.cos(beta), np.sin(2 * beta), np.cos(2 * beta)]
    drives += [alpha_rate, beta_rate, np.tanh(50 * alpha_rate), np.tanh(50 * beta_rate),
               alpha_rate ** 2, beta_rate ** 2, np.gradient(beta_rate) * rate_hz,
               np.gradient(alpha_rate) * rate_hz, motion.shift(time_s, 2) / G0_MPS2]
    drives += [time_s, np.exp(-time_s / 30), motion.shift(time_s, 2) ** 2]
    temperature_c = motion.temperature_c(time_s) if motion.temperature_c else 0 * time_s
    supply_v = motion.supply_v(time_s) if motion.supply_v else 0 * time_s
    return drives + [temperature_c, np.gradient(temperature_c), supply_v]


def _regressions(gap: np.ndarray, force: np.ndarray, drives: list[np.ndarray], rate_hz: float
                 ) -> np.ndarray:
    """Return correlation and explained size of each drive, beyond zero-g and scale factor."""
    slope = np.gradient(force) * rate_hz
    time_s = np.arange(len(force)) / rate_hz
    along = [force ** 2, force ** 3, force ** 4, np.abs(force), np.abs(force) * force, slope,
             np.gradient(slope) * rate_hz, time_s * slope, np.tanh(10 * slope), time_s * force,
             drives[-3] * force, drives[-1] * force]
    line = np.linalg.qr(np.stack([np.ones_like(force), force], axis=1))[0]

    def beyond(values: np.ndarray) -> np.ndarray:
        """Subtract the straight line over the force."""
        return values - line @ (line.T @ values)

    rest = beyond(gap)
    size = np.linalg.norm(rest) + 1e-12
    out = [line.T @ gap / np.sqrt(len(gap)), [np.log(size / np.sqrt(len(gap)))]]
    for drive in [*along, *drives]:
        other = beyond(drive)
        norm = np.linalg.norm(other)
        correlation = float(other @ rest / (norm * size)) if norm > 1e-9 * (
            np.linalg.norm(drive) + 1e-9) else 0.0
        out.append([correlation, np.log(abs(correlation) * size / np.sqrt(len(gap)) + 1e-3)])
    return np.concatenate(out)
