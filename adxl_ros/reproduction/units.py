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

"""All experiments over several units: what the page and the figures are made of."""

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
from adxl_ros.reproduction import experiments, misalignment, scoring
import numpy as np

RUNS = {
    'alpha': np.array([(a, 0) for a in range(-180, 181, 30)]),
    'beta': np.array([(90, a) for a in range(-180, 181, 30)]),
    'both': np.array([(a, a) for a in range(-180, 181, 30)]),
}
"""Alpha and beta of figure 10, deg; (b) at alpha 90°, as at 0 beta does not show."""
RANDOM_POSES = 40
STAGES = {'perfect': experiments.PERFECT, 'paper': experiments.PAPER}


@dataclass(frozen=True)
class Judged:
    """
    One model of one unit against the truth.

    Attributes
    ----------
    random, runs
        Angles in random poses, and in each of the paper's tilt experiments.
    force_z
        Errors of the measured axes by their promised deviation in the random poses, (k, m).
    coefficient_z
        Errors of the coefficients by their promised deviation, (p,), where the truth is in the
        gauge of the fit.
    shaken
        The motion experiment.

    """

    random: scoring.Angles
    runs: dict[str, scoring.Angles]
    force_z: np.ndarray
    coefficient_z: np.ndarray
    shaken: scoring.Shaken


@dataclass(frozen=True)
class Unit:
    """One unit on one stage: by model, and the search for its misalignment."""

    models: dict[str, Judged]
    directions: misalignment.Found


def judge(nominal: Sensor, stage: experiments.Stage, seed: int) -> Unit:
    """Draw, sweep, calibrate and try one unit."""
    rng = np.random.default_rng([seed, 0])
    truth = experiments.draw(nominal, stage, rng)
    run = experiments.calibrated(truth, seed)
    bound = scoring.known_bound(
        truth, run.poses, run.true_rad, StageError(truth.stage_resolution_rad / np.sqrt(12)),
        (*full_model.default_terms(truth.axes), *full_model.GAUGE))
    anywhere = np.column_stack([np.arccos(rng.uniform(-1, 1, RANDOM_POSES)),
                                rng.uniform(0, 2 * np.pi, RANDOM_POSES)])
    asked = {'random': anywhere, **{name: np.radians(deg) for name, deg in RUNS.items()}}
    seen = {name: experiments.poses_at(truth, rad, seed + (i + 1) * 1_000_003)[:2]
            for i, (name, rad) in enumerate(asked.items())}
    motion = experiments.shaken(truth, seed)
    models = {}
    for name, fitted in run.fitted.items():
        angles = {key: scoring.angles(fitted, bound, *poses) for key, poses in seen.items()}
        error, std = scoring.forces(fitted, truth, *seen['random'])
        models[name] = Judged(angles.pop('random'), angles, error / std,
                              _coefficients(fitted, truth),
                              scoring.motion(fitted, *motion)[0])
    return Unit(models, misalignment.search(truth, seed))


def _coefficients(fitted: Sensor, truth: Sensor) -> np.ndarray:
    if not all(name.effect in truth.effects for name in fitted.covariance_names):
        return np.zeros(0)
    off = get(fitted, fitted.covariance_names) - get(truth, fitted.covariance_names)
    return off / np.sqrt(np.diag(fitted.covariance))


def judge_all(nominal: Sensor, units: int, seed: int, show: Callable[[float], None]
              ) -> dict[str, list[Unit]]:
    """
    Judge several units on each stage, over the cores.

    Parameters
    ----------
    nominal
        Figures that units are drawn about, or one unit with its effects.
    units
        How many on each stage.
    seed
        Of all randomness.
    show
        Takes the fraction that is done.

    """
    found: dict[str, list[Unit]] = {}
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        for i, (name, stage) in enumerate(STAGES.items()):
            seeds: Sequence[int] = [1000 * seed + k for k in range(units)]
            found[name] = []
            for unit in pool.map(partial(judge, nominal, stage), seeds):
                found[name].append(unit)
                show((i + len(found[name]) / units) / len(STAGES))
    return found
