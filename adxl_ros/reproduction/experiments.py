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
The experiments of the paper: a simulated unit is drawn, swept, calibrated and tested.

Stage, filter, ADC and averaging are those of the paper's section III: an encoder of 5 arcmin, a
base level to 0.1°, 32 kΩ ± 25 % and 0.33 µF, 16 bits at 1 kHz, means of 5 s. The true angle of a
joint is uniform within a step of the encoder, and new after each move.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from adxl_ros.calibrate import pose_extraction
from adxl_ros.calibrate.fits import full_model, linear, paper_regression, term_selection
from adxl_ros.calibrate.guided.pose_plan import sweep
from adxl_ros.calibrate.poses import Poses
from adxl_ros.files.recording_columns import Recording
from adxl_ros.files.stream_info import sensor_info
from adxl_ros.files.sweep_journal import PoseRecord
from adxl_ros.model.coefficients import typical, with_neutral
from adxl_ros.model.effects import effect_named
from adxl_ros.model.sensor import Sensor
from adxl_ros.signals import filter_time_constant
from adxl_ros.simulate import trajectories
from adxl_ros.simulate.motion import Held, Motion
from adxl_ros.simulate.simulator import simulate
import numpy as np

MODELS = {'linear': linear.fit, 'physical': paper_regression.fit, 'full': term_selection.fit}
DRAWN = full_model.TERMS
"""Effects of a unit. Each coefficient is normal; its typical size is the standard deviation."""
PLANES_RAD = tuple(np.radians([90.0, 60.0, 30.0, 0.0, 120.0, 150.0, 180.0]).tolist())
"""Planes alpha of the sweep, rad; the paper's."""
STEP_RAD = float(np.radians(30.0))
"""Step of beta, rad; the paper's."""
RESISTANCE = 0.25
"""Largest departure of the filter's resistor from the stated one, a share; the paper's."""
GRAVITY_MPS2 = 9.80131
"""Local gravity of the paper's experiments, m/s²."""
SETTLED_S = 1.0
"""Time from the stop of the stage to the start of a pose's mean, s; chosen."""


@dataclass(frozen=True)
class Stage:
    """
    Errors of a stage.

    Attributes
    ----------
    resolution_rad
        Step of the encoder, rad.
    level_rad
        Standard deviation of the base's tilt, rad.

    """

    resolution_rad: float
    level_rad: float


PERFECT = Stage(0.0, 0.0)
PAPER = Stage(np.radians(5 / 60), full_model.LEVEL_STD_RAD)


@dataclass(frozen=True)
class Run:
    """
    One unit after its sweep.

    Attributes
    ----------
    truth
        The true unit, with the tilt of the base.
    fitted
        The calibrated unit by model.
    poses
        Poses of the sweep.
    true_rad
        True alpha and beta of these poses, rad, (k, 2).

    """

    truth: Sensor
    fitted: dict[str, Sensor]
    poses: Poses
    true_rad: np.ndarray


def draw(nominal: Sensor, stage: Stage, rng: np.random.Generator) -> Sensor:
    """
    Draw a unit at datasheet spread, or take the given one, on a base that is not level.

    Parameters
    ----------
    nominal
        The nominal sensor, or one unit with its effects.
    stage
        The stage.
    rng
        The random generator.

    Returns
    -------
    Sensor
        The unit.

    """
    unit = replace(nominal, stage_resolution_rad=stage.resolution_rad,
                   local_gravity_mps2=GRAVITY_MPS2)
    if not nominal.effects:
        values = {name: {p: rng.normal(size=np.shape(v)) * v for p, v in typical(
            effect_named(name), unit.axes).items()} for name in DRAWN}
        ratio = rng.uniform(-RESISTANCE, RESISTANCE, len(unit.axes))
        values['bandwidth'] = {'resistance_ratio': ratio}
        unit = replace(unit, effects=tuple(values), values=values)
    level = {f'{axis}_rad': np.array(stage.level_rad * rng.normal()) for axis in 'xy'}
    unit = with_neutral(unit, ['base_tilt'])
    return replace(unit, values={**unit.values, 'base_tilt': level})


def bare(truth: Sensor) -> Sensor:
    """Return the unit as it is stated before its calibration."""
    return replace(truth.without_covariance(), effects=(), values={}, model='nominal')


def poses_at(truth: Sensor, read_rad: np.ndarray, seed: int
             ) -> tuple[Poses, np.ndarray, Recording]:
    """
    Simulate rests of 5 s at given angles of the encoder, and average.

    Parameters
    ----------
    truth
        The unit on its stage.
    read_rad
        Alpha and beta, (k, 2).
    seed
        Seed of the stage errors and of the noise.

    Returns
    -------
    tuple
        Poses with the encoder's angles; true angles, rad, (k, 2); the recording.

    """
    rng = np.random.default_rng([seed, 1])
    step = truth.stage_resolution_rad
    on_grid = np.rint(read_rad / step) * step if step else read_rad
    # A joint that does not move keeps its error.
    moved = np.diff(on_grid, axis=0, prepend=np.nan) != 0
    errors = step * rng.uniform(-0.5, 0.5, read_rad.shape)
    held = np.maximum.accumulate(np.where(moved, np.arange(len(moved))[:, None], 0), axis=0)
    true = on_grid + np.take_along_axis(errors, held, axis=0)
    motion, ends_s = visited(true)
    columns = simulate(truth, motion, seed)
    time_s = columns.pop('time_s')
    recording = Recording('simulated', time_s, columns, sensor_info(truth))
    samples = round(trajectories.DWELL_S * truth.rate_hz)
    records = [
        PoseRecord(pose=number, start_ns=round((end_s - trajectories.DWELL_S) * 1e9),
                   stop_ns=round(end_s * 1e9), samples=samples, mean_v=(), std_v=(),
                   alpha_rad=alpha_rad, beta_rad=beta_rad)
        for number, (end_s, (alpha_rad, beta_rad)) in enumerate(zip(ends_s, on_grid))]
    return pose_extraction.extract_poses(recording, bare(truth), records), true, recording


def visited(true_rad: np.ndarray) -> tuple[Motion, list[float]]:
    """Return the motion through poses, (k, 2), rad, and the end of each dwell, s."""
    script = trajectories.Script(*true_rad[0])
    dwell_ends_s = []
    for pose in true_rad:
        script.go(*pose)
        script.rest(SETTLED_S + trajectories.DWELL_S)
        dwell_ends_s.append(script.now)
    alpha, beta = script.joints()
    return Motion(script.now, alpha, beta), dwell_ends_s


def calibrated(truth: Sensor, seed: int, models: Sequence[str] = tuple(MODELS)) -> Run:
    """
    Sweep a unit (the paper's experiments 1 and 2) and fit the models.

    Parameters
    ----------
    truth
        The unit.
    seed
        Seed of all random numbers.
    models
        Names of the models.

    Returns
    -------
    Run
        The unit after its sweep.

    """
    targets = sweep(PLANES_RAD, STEP_RAD, 0)
    poses, true, recording = poses_at(
        truth, np.array([[t.alpha_rad, t.beta_rad] for t in targets]), seed)
    nominal = bare(truth)
    fitted = {name: MODELS[name](nominal, poses) for name in models}
    if 'full' in fitted:
        noise = pose_extraction.estimate_filters(recording, nominal, poses)
        fitted['full'], _ = filter_time_constant.with_filter(fitted['full'], [noise])
    return Run(truth, fitted, poses, true)


def shaken(truth: Sensor, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    Shake a unit as in the paper's motion experiment.

    Parameters
    ----------
    truth
        The unit.
    seed
        Seed of all random numbers.

    Returns
    -------
    tuple
        Stamps, s, (n,); volts, (n, m); acceleration by the interferometer along x, m/s², (n,).

    """
    rng = np.random.default_rng([seed, 2])
    nominal_motion = trajectories.motion(rng)
    joint_error_rad = truth.stage_resolution_rad * rng.uniform(-0.5, 0.5, 2)
    at_rest = np.zeros(1)
    alpha_rad, beta_rad = (
        float(joint(at_rest)[0] + error) for joint, error in zip(
            (nominal_motion.alpha, nominal_motion.beta), joint_error_rad))
    motion = replace(nominal_motion, alpha=Held(alpha_rad), beta=Held(beta_rad))
    columns = simulate(truth, motion, seed)
    volts = np.column_stack([columns[f'{axis}_v'] for axis in truth.axes])
    return columns['time_s'], volts, motion.shift(columns['time_s'], 2)
