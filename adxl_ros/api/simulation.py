# SPDX-License-Identifier: Apache-2.0

"""Simulation of the front door: a recording of a manoeuvre by a sensor with effects."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
import os
from pathlib import Path

from adxl_ros.api.recordings import one_recording, read_ideal, RecordingInput
from adxl_ros.api.result import no_progress, Progress
from adxl_ros.api.sensors import (
    AddedEffects,
    as_input,
    effect_inputs,
    EffectInput,
    SensorInput,
    with_effects,
)
from adxl_ros.errors import UserError
from adxl_ros.files import parameter_file
from adxl_ros.files.recording_columns import concatenate, Recording, TIME
from adxl_ros.files.stream_info import sensor_info
from adxl_ros.files.surroundings import assumed
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Concern
from adxl_ros.model.sensor import Sensor
from adxl_ros.report.arguments import require_number, require_whole
from adxl_ros.simulate.motion import INTERNAL_RATE_HZ, Motion
from adxl_ros.simulate.recorded_motion import motion_from_force, motion_from_references
from adxl_ros.simulate.response import simulate_blocks
from adxl_ros.simulate.trajectories import TRAJECTORIES
from adxl_ros.wording import option, usage
import numpy as np

IMU = 'imu'  # Trajectory of the specific force of another simulator


@dataclass(frozen=True)
class Simulation:
    """What is simulated."""

    name: str  # The trajectory, or the recording that is followed
    sensor: Sensor  # The sensor, at its rate
    motion: Motion
    begin_s: float = 0.0  # Begin of the motion, s
    like: Recording | None = None  # A recording that has the stamps of the samples
    # What was assumed of the surroundings, one line each
    assumed: Sequence[str] = ()
    left_out: Sequence[str] = ()  # Effects of the sensor that cannot act here, one line each

    def blocks(self, seed: int) -> Iterator[Recording]:
        """Yield the samples in blocks."""
        samples = simulate_blocks(self.sensor, self.motion, seed, self.begin_s, self.like)
        duration_s = self.motion.duration_s
        for columns in samples:
            time_s = columns.pop(TIME)
            done = 1.0
            if duration_s:
                done = min((time_s[-1] - self.begin_s) / duration_s, 1.0)
            yield Recording(self.name, time_s, columns, sensor_info(self.sensor), done=done)

    @property
    def screen(self) -> list[str]:
        """Return the lines of the tool's screen."""
        sensor = self.sensor
        return [
            f'Simulated {self.name}: {self.motion.duration_s:.4g} s at '
            f'{sensor.rate_hz:.4g} Hz, axes {sensor.axes}. Sensor {sensor.serial}, effects: '
            f'{", ".join(sensor.effects) or "none"}.',
            *self.assumed,
        ]


def prepare(
    trajectory: RecordingInput,
    sensor: SensorInput | None = None,
    *,
    effects: Sequence[EffectInput] = (),
    force: RecordingInput | None = None,
    rate: float | None = None,
    seed: int = 0,
) -> Simulation:
    """Check what is to be simulated, and return it; see `simulate`."""
    require_whole('seed', seed)
    require_number(usage('simulate', rate=rate), rate)
    bounds = parameter_file.SENSOR_FIELDS['sensor.rate_hz'].metadata
    if rate is not None and not bounds['lower'] <= rate <= bounds['upper']:
        raise UserError(
            f'{usage("simulate", rate=f"{rate:g}")}: outside {bounds["lower"]:g} to '
            f'{bounds["upper"]:g} Hz'
        )
    name = trajectory if isinstance(trajectory, str) else ''
    if (name == IMU) != (force is not None):
        raise UserError(
            f'{option(force="RECORDING")} and the trajectory imu need each other: '
            + usage('simulate', IMU, force='RECORDING')
        )
    unit = _stated(sensor)
    if rate is not None:
        unit = replace(unit, rate_hz=rate)
    unit = with_effects(unit, effects)
    if force is not None:
        return _by_force(read_ideal(force, 0), unit, rate)
    left_out = _left_out(unit, {effect for effect, _ in effects})
    if name in TRAJECTORIES:
        motion = TRAJECTORIES[name](np.random.default_rng(seed))
        made = Simulation(name, unit, motion)
    else:
        made = _by_references(one_recording(_existing(trajectory)), unit, rate)
    return replace(made, left_out=left_out)


def _stated(given: SensorInput | None) -> Sensor:
    """Return a sensor that states all that a simulation needs."""
    sensor = as_input(given)
    if not isinstance(sensor, Sensor):
        return parameter_file.load(sensor or parameter_file.nominal_path())
    if sensor.unstated:
        raise UserError(
            f'{sensor.serial}: states no {", ".join(sensor.unstated)}, which a '
            'simulation needs; name a sensor that does'
        )
    return sensor


def _left_out(sensor: Sensor, asked: set[str]) -> list[str]:
    """Name the effects of the reference, which is exact; refuse those that are asked for."""
    lines = []
    for name in sensor.effects:
        if effect_named(name).concern is Concern.REFERENCE:
            if name in asked:
                raise UserError(
                    f'effect {name}: acts on the specific force of a recording; say '
                    f'{usage("simulate", IMU, force="RECORDING")}, or leave the effect out'
                )
            lines.append(f'{name} is an error of the reference, and is left out')
    return lines


def _existing(trajectory: RecordingInput) -> RecordingInput:
    """Refuse a text that is neither a recording nor a trajectory."""
    if isinstance(trajectory, (str, os.PathLike)) and not Path(trajectory).exists():
        raise UserError(
            f'{trajectory}: neither a recording nor one of the trajectories '
            f'{", ".join((*TRAJECTORIES, IMU))}'
        )
    return trajectory


def _by_force(ideal: Recording, sensor: Sensor, rate_hz: float | None) -> Simulation:
    """Follow the specific force of another simulator, at its rate or another."""
    motion = motion_from_force(ideal, rate_hz is None)
    if rate_hz is None:
        sensor = replace(sensor, rate_hz=motion.internal_rate_hz)
        motion = replace(motion, internal_rate_hz=max(sensor.rate_hz, INTERNAL_RATE_HZ))
    return Simulation(
        name=IMU,
        sensor=sensor,
        motion=motion,
        begin_s=float(ideal.time_s[0]),
        assumed=assumed(ideal, sensor.effects),
    )


def _by_references(read: Recording, sensor: Sensor, rate_hz: float | None) -> Simulation:
    """Follow the references of a recording, at its stamps or at another rate."""
    motion = motion_from_references(read, sensor)
    like = None
    if rate_hz is None:
        sensor = replace(sensor, rate_hz=read.rate_hz)
        like = read
    return Simulation(
        name=read.path,
        sensor=sensor,
        motion=motion,
        begin_s=float(read.time_s[0]),
        like=like,
        assumed=assumed(read, sensor.effects),
    )


def simulate(
    trajectory: RecordingInput,
    sensor: SensorInput | None = None,
    *,
    effects: AddedEffects = (),
    force: RecordingInput | None = None,
    rate: float | None = None,
    seed: int = 0,
    progress: Progress = no_progress,
) -> Recording:
    """
    Simulate a recording of a manoeuvre by a sensor with effects.

    Parameters
    ----------
    trajectory
        sweep, tilt_alpha, tilt_beta, tilt_both, motion, shaker, soak, tumble or rich; 'imu' for
        the specific force of `force`; or a recording whose stage angles are followed.
    sensor
        The sensor: a Sensor, a `Fit` or a `Gap`, a datasheet's name or the path of a parameter
        file. None for the nominal sensor.
    effects
        Effects that are added: a list of names for typical values, or a dict of values
        by parameter for each name, None for typical ones, as
        `{'lever_arm': {'z_m': 0.03}, 'bias': {'offset_v.x': 1e-3}, 'hysteresis': None}`. A
        parameter is for all axes, with `.x` for one; those without a value are neutral.
    force
        Ideal specific force of another simulator for 'imu', with `ax_mps2, ay_mps2, az_mps2`,
        m/s², in the frame of the sensor: a Recording, a DataFrame or a path.
    rate
        Sample rate, Hz; None for that of the sensor, or of what is followed.
    seed
        Seed of noise and manoeuvre.
    progress
        Called with the share of the work that is done, 0 to 1, and the name of the stage.

    Returns
    -------
    Recording
        Volts `x_v, ...`, V, and what encoders, thermometer and supply read; `notes` say what
        was assumed, and which effects of the sensor cannot act.

    Raises
    ------
    UserError
        An effect, a parameter or a trajectory is unknown, or a value is out of bounds.

    """
    made = prepare(
        trajectory,
        sensor,
        effects=effect_inputs(effects),
        force=force,
        rate=rate,
        seed=seed,
    )
    blocks = []
    for block in made.blocks(seed):
        blocks.append(block)
        progress(block.done, 'simulate')
    return replace(concatenate(blocks), remarks=(*made.screen, *made.left_out))
