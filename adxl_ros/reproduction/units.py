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

"""All experiments on several units."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
import os

from adxl_ros.calibrate.fits import full_model
from adxl_ros.calibrate.stage_error import StageError
from adxl_ros.model.coefficients import get
from adxl_ros.model.sensor import Sensor
from adxl_ros.reproduction import error_statistics, experiments, misalignment
import numpy as np

RUNS = {
    'alpha': np.array([(a, 0) for a in range(-180, 181, 30)]),
    'beta': np.array([(90, a) for a in range(-180, 181, 30)]),
    'both': np.array([(a, a) for a in range(-180, 181, 30)]),
}
"""Alpha and beta of figure 10, deg; (b) at alpha = 90°, as beta has no effect at 0."""
RANDOM_POSES = 40
"""Number of poses in random directions; chosen."""
STAGES = {'perfect': experiments.PERFECT, 'paper': experiments.PAPER}


@dataclass(frozen=True)
class ModelErrors:
    """
    Errors of one model of one unit.

    Attributes
    ----------
    random, runs
        Angle errors in random poses, and in each of the paper's tilt experiments.
    force_z
        Errors of the measured axes over their standard deviation in the random poses, (k, m).
    coefficient_z
        Errors of the coefficients over their standard deviation, (p,). Empty where the truth is
        not in the gauge of the fit.
    motion
        Errors of the motion experiment.

    """

    random: error_statistics.AngleErrors
    runs: dict[str, error_statistics.AngleErrors]
    force_z: np.ndarray
    coefficient_z: np.ndarray
    motion: error_statistics.MotionErrors


@dataclass(frozen=True)
class Unit:
    """
    One unit on one stage.

    Attributes
    ----------
    models
        Errors by model.
    directions
        The search for its misalignment.

    """

    models: dict[str, ModelErrors]
    directions: misalignment.DirectionSearch


def evaluate(nominal: Sensor, stage: experiments.Stage, seed: int) -> Unit:
    """
    Draw, sweep and calibrate one unit, and run the experiments.

    Parameters
    ----------
    nominal
        The nominal sensor, or one unit with its effects.
    stage
        The stage.
    seed
        Seed of all random numbers.

    Returns
    -------
    Unit
        The errors.

    """
    rng = np.random.default_rng([seed, 0])
    truth = experiments.draw(nominal, stage, rng)
    run = experiments.calibrated(truth, seed)
    bound = error_statistics.sweep_bound(
        truth, run.poses, run.true_rad, StageError(truth.stage_std_rad),
        (*full_model.default_terms(truth.axes), *full_model.GAUGE))
    random_rad = np.column_stack([np.arccos(rng.uniform(-1, 1, RANDOM_POSES)),
                                 rng.uniform(0, 2 * np.pi, RANDOM_POSES)])
    angles_rad = {'random': random_rad, **{name: np.radians(deg) for name, deg in RUNS.items()}}
    poses_of = {name: experiments.poses_at(truth, rad, seed + (i + 1) * 1_000_003)[:2]
                for i, (name, rad) in enumerate(angles_rad.items())}
    shaken = experiments.shaken(truth, seed)
    models = {}
    for name, fitted in run.fitted.items():
        angles = {key: error_statistics.angle_errors(fitted, bound, *poses)
                  for key, poses in poses_of.items()}
        error, std = error_statistics.force_errors(fitted, truth, *poses_of['random'])
        models[name] = ModelErrors(angles.pop('random'), angles, error / std,
                                   _coefficients(fitted, truth),
                                   error_statistics.motion_errors(fitted, *shaken)[0])
    return Unit(models, misalignment.search(truth, seed))


def _coefficients(fitted: Sensor, truth: Sensor) -> np.ndarray:
    if not all(name.effect in truth.effects for name in fitted.covariance_names):
        return np.zeros(0)
    error = get(fitted, fitted.covariance_names) - get(truth, fitted.covariance_names)
    return error / np.sqrt(np.diag(fitted.covariance))


def evaluate_all(nominal: Sensor, units: int, seed: int, show: Callable[[float], None]
                 ) -> dict[str, list[Unit]]:
    """
    Evaluate several units on each stage, in parallel.

    Parameters
    ----------
    nominal
        The nominal sensor, or one unit with its effects.
    units
        Number of units on each stage.
    seed
        Seed of all random numbers.
    show
        Receives the fraction that is finished.

    Returns
    -------
    dict
        Units by stage.

    """
    results: dict[str, list[Unit]] = {}
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        for i, (name, stage) in enumerate(STAGES.items()):
            seeds: Sequence[int] = [1000 * seed + k for k in range(units)]
            results[name] = []
            for unit in pool.map(partial(evaluate, nominal, stage), seeds):
                results[name].append(unit)
                show((i + len(results[name]) / units) / len(STAGES))
    return results
