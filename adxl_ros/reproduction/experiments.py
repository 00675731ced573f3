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
The experiments: a unit is drawn, swept, calibrated and tried, all through the simulator.

Stage, filter, ADC and averaging are the paper's (its section III): an encoder of 5 arcmin within
whose steps a joint stands anywhere, anew after each move, a base level to 0.1°, 32 kΩ ± 25 % and
0.33 µF, 16 bits at 1 kHz, means of 5 s.
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
"""Effects of a unit, each coefficient normal with its typical size for standard deviation."""
PLANES_RAD = tuple(np.radians([90.0, 60.0, 30.0, 0.0, 120.0, 150.0, 180.0]).tolist())
STEP_RAD = float(np.radians(30.0))
RESISTANCE = 0.25
"""The filter's resistor is anywhere within ± this of the stated one."""
GRAVITY_MPS2 = 9.80131
"""Where the paper's experiments were done."""
SETTLED_S = 1.0
"""A pose's mean begins so long after the stage has stopped."""


@dataclass(frozen=True)
class Stage:
    """How well the stage is known: resolution of the encoder, rad, and of the level, rad."""

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
        What the simulator has, the base's tilt among it.
    fitted
        By model.
    poses
        Of the sweep.
    true_rad
        Where the stage really stood in them, alpha and beta, (k, 2).

    """

    truth: Sensor
    fitted: dict[str, Sensor]
    poses: Poses
    true_rad: np.ndarray


def draw(nominal: Sensor, stage: Stage, rng: np.random.Generator) -> Sensor:
    """Draw a unit at datasheet spread on a base out of level, or take the one that is given."""
    unit = replace(nominal, stage_resolution_rad=stage.resolution_rad,
                   local_gravity_mps2=GRAVITY_MPS2)
    if not nominal.effects:
        values = {name: {p: rng.normal(size=np.shape(v)) * v for p, v in typical(
            effect_named(name), unit.axes).items()} for name in DRAWN}
        ratio = rng.uniform(-RESISTANCE, RESISTANCE, len(unit.axes))
        values['bandwidth'] = {'resistance_ratio': ratio}
        unit = replace(unit, effects=tuple(values), values=values)
    level = {f'{way}_rad': np.array(stage.level_rad * rng.normal()) for way in 'xy'}
    unit = with_neutral(unit, ['base_tilt'])
    return replace(unit, values={**unit.values, 'base_tilt': level})


def bare(truth: Sensor) -> Sensor:
    """Return what is known of a unit before its calibration."""
    return replace(truth.without_covariance(), effects=(), values={}, model='nominal')


def poses_at(truth: Sensor, read_rad: np.ndarray, seed: int
             ) -> tuple[Poses, np.ndarray, Recording]:
    """
    Rest where the encoder reads given angles, 5 s each, and average.

    Parameters
    ----------
    truth
        The unit on its stage.
    read_rad
        Alpha and beta, (k, 2).
    seed
        Of where the stage stands within its steps, and of the noise.

    Returns
    -------
    tuple
        Poses with the encoder's angles; the true ones, rad, (k, 2); what was recorded.

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
    """Return the motion through poses, and when the dwell in each ends, s."""
    script = trajectories.Script(*true_rad[0])
    ends = []
    for pose in true_rad:
        script.go(*pose)
        script.rest(SETTLED_S + trajectories.DWELL_S)
        ends.append(script.now)
    alpha, beta = script.joints()
    return Motion(script.now, alpha, beta), ends


def calibrated(truth: Sensor, seed: int, models: Sequence[str] = tuple(MODELS)) -> Run:
    """Sweep a unit (the paper's experiments 1 and 2) and fit the models to it."""
    targets = sweep(PLANES_RAD, STEP_RAD, 0)
    poses, true, recording = poses_at(
        truth, np.array([[t.alpha_rad, t.beta_rad] for t in targets]), seed)
    nominal = bare(truth)
    fitted = {name: MODELS[name](nominal, poses) for name in models}
    if 'full' in fitted:
        found = pose_extraction.estimate_filters(recording, nominal, poses)
        fitted['full'], _ = filter_time_constant.with_filter(fitted['full'], [found])
    return Run(truth, fitted, poses, true)


def shaken(truth: Sensor, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """
    Shake a unit as in the paper's motion experiment.

    Returns
    -------
    tuple
        Stamps, s, (n,); volts, (n, m); acceleration by the interferometer along x, m/s², (n,).

    """
    rng = np.random.default_rng([seed, 2])
    asked = trajectories.motion(rng)
    off = truth.stage_resolution_rad * rng.uniform(-0.5, 0.5, 2)
    at_rest = np.zeros(1)
    motion = replace(asked, alpha=Held(float(asked.alpha(at_rest)[0] + off[0])),
                     beta=Held(float(asked.beta(at_rest)[0] + off[1])))
    columns = simulate(truth, motion, seed)
    volts = np.column_stack([columns[f'{axis}_v'] for axis in truth.axes])
    return columns['time_s'], volts, motion.shift(columns['time_s'], 2)
