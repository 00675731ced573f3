# SPDX-License-Identifier: Apache-2.0

"""Simulated units and sweeps that the tests share."""

from dataclasses import replace

from adxl_ros.api import simulation
from adxl_ros.calibrate.fits.linear import EFFECTS
from adxl_ros.calibrate.pose_model import stage_force
from adxl_ros.calibrate.poses import Poses
from adxl_ros.files import parameter_file
from adxl_ros.files.sweep_journal import PoseRecord
from adxl_ros.model import noise, signal_chain
from adxl_ros.model.effects import effect_named
from adxl_ros.model.kinematics import specific_force
from adxl_ros.simulate.motion import Motion
from adxl_ros.simulate.response import Response
from adxl_ros.tools.command_line import effect_inputs
from adxl_ros_validation.experiments import sweep
import numpy as np
from processes import REPO

NOMINAL = REPO / 'params' / 'adxl203.yaml'
PLANES_RAD = np.radians([30, 60, 90, 120, 150])
IN_GAUGE = {('cross_axis', 'linear'), ('cross_axis_z', 'linear')}
"""Parameters that the fits leave at 0, as a misalignment does the same."""


def nominal(axes='xy', **changes):
    sensor = parameter_file.load(NOMINAL)
    count = len(axes)
    arrays = {
        name: np.full(count, getattr(sensor, name)[0])
        for name in ('nominal_zero_g_v', 'nominal_scale_v_per_g', 'noise_density_g_per_rthz')
    }
    arrays['self_test_g'] = sensor.self_test_g[:1] * count
    return replace(sensor, axes=axes, **{'z_sign': 1, **arrays, **changes})


def with_effects(sensor, texts):
    """Add effects to a sensor as the option --effect of simulate does."""
    return simulation.with_effects(sensor, effect_inputs(texts))


def drawn(rng, sensor, effects=EFFECTS):
    """Draw a unit at datasheet spread, in the gauge of the fits."""
    values = {}
    for name in effects:
        values[name] = {}
        for parameter in effect_named(name).parameters:
            if not parameter.axes:
                drawn_values = np.array(rng.normal() * parameter.scale)
            else:
                drawn_values = 0.5 * parameter.scale * rng.normal(size=len(sensor.axes))
                acts = np.array([axis in parameter.axes for axis in sensor.axes])
                drawn_values *= acts & ((name, parameter.name) not in IN_GAUGE)
            values[name][parameter.name] = drawn_values
    return replace(sensor, effects=tuple(effects), values=values)


def swept(
    rng, truth, planes_rad=PLANES_RAD, check_poses=16, noisy=True, per_setting=False, targets=None
):
    """
    Sweep a unit: poses with the noise of 5 s means, on a stage with an error within a step.

    A joint draws its error in each pose, or with `per_setting` only after each move.
    """
    targets = targets or sweep(planes_rad, np.radians(30), check_poses)
    alpha = np.array([target.alpha_rad for target in targets])
    beta = np.array([target.beta_rad for target in targets])
    slack = truth.stage_resolution_rad * noisy

    def error(angle):
        drawn = slack * rng.uniform(-0.5, 0.5, len(angle))
        setting = np.cumsum(np.abs(np.diff(angle, prepend=angle[0])) > 1e-9)
        return drawn[setting] if per_setting else drawn

    joint_error = error(alpha), error(beta)
    force = stage_force(truth, alpha + joint_error[0], beta + joint_error[1])
    volts = np.column_stack(signal_chain.static_response(truth)(force))
    count = noise.effective_samples(5000, 1e-3, truth.rc_s)
    std = np.broadcast_to(noise.sample_std_v(truth) / np.sqrt(count), volts.shape)
    volts = volts + noisy * std * rng.normal(size=volts.shape)
    return Poses(
        volts=volts,
        std_v=std,
        alpha_rad=alpha,
        beta_rad=beta,
        time_s=np.zeros((len(alpha), 2)),
        check=np.array([target.check for target in targets]),
    )


class Fed:
    """A simulated sensor: specific force sample by sample in, volts out."""

    def __init__(self, sensor, seed=0):
        self.rate_hz, self.count = sensor.rate_hz, 0
        self.respond = Response(
            sensor,
            Motion(np.inf, force=lambda at_s: self.force, internal_rate_hz=sensor.rate_hz),
            seed,
        )

    def __call__(self, force):
        """Return the volts at a specific force of three components, m/s², each (n,)."""
        count = max(np.size(f) for f in force)
        self.force = [np.broadcast_to(np.asarray(f, float), count) for f in force]
        stamps_s = (self.count + np.arange(count)) / self.rate_hz
        self.count += count
        return self.respond(stamps_s)


def pose_record(pose, **changes):
    """Return a pose record of a journal; by default the sensor is level."""
    return PoseRecord(
        **{
            'pose': pose,
            'alpha_rad': 0.0,
            'beta_rad': 0.0,
            'start_ns': pose,
            'stop_ns': pose,
            'samples': 1000,
            'mean_v': (2.5, 2.5),
            'std_v': (1e-4, 1e-4),
            **changes,
        }
    )


class Bench:
    """A sensor on a stage, sampled at 1 kHz; time begins at a wall clock's nanoseconds."""

    def __init__(self, sweep, sensor, seed=1):
        self.sweep = sweep
        self.sensor = sensor
        self.now_ns = 1_700_000_000_000_000_000
        self.fed = Fed(sensor, seed)

    def run(self, seconds, alpha, beta, encoder=True, shake_mps2=0.0):
        """Hold the angles, rad, for some seconds; return the first accepted pose."""
        for _ in range(round(seconds / 0.05)):
            time = np.arange(50) / 1000
            force = specific_force(
                np.full(50, alpha),
                np.full(50, beta),
                9.80665,
                shake_mps2 * np.sin(2 * np.pi * 7 * (self.now_ns % 10**9 * 1e-9 + time)),
            )
            volts = self.fed(force)
            stamps = self.now_ns + np.arange(50) * 1_000_000
            if encoder:
                self.sweep.read_encoder(self.now_ns, alpha, beta)
            self.sweep.feed(stamps, volts)
            self.now_ns += 50_000_000
            entry = self.sweep.accept()
            if entry is not None:
                return entry
        return None
