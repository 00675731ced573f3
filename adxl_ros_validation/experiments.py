# SPDX-License-Identifier: Apache-2.0
"""The experiments of the paper on drawn units, and their error statistics."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

from adxl_ros.calibrate.fits import full_model, linear, term_selection
from adxl_ros.calibrate.fits.pose_covariance import StageError
from adxl_ros.calibrate.guided.pose_plan import spread, Target
from adxl_ros.calibrate.pose_model import stage_force
from adxl_ros.calibrate.poses import Poses
from adxl_ros.calibrate.recorded_poses import estimate_filters, extract_poses
from adxl_ros.compensate import inversions
from adxl_ros.files.recording_columns import Recording
from adxl_ros.files.stream_info import sensor_info
from adxl_ros.files.sweep_journal import PoseRecord
from adxl_ros.model import noise, signal_chain
from adxl_ros.model.constants import AXES, G0_MPS2
from adxl_ros.model.covariance import force_covariance
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import Components
from adxl_ros.model.kinematics import tilt
from adxl_ros.model.sensor import get, Sensor, typical, with_neutral
from adxl_ros.signals import filter_noise
from adxl_ros.simulate import trajectories
from adxl_ros.simulate.motion import Held, Motion
from adxl_ros.simulate.response import simulate
from adxl_ros.workers import open_pool
import numpy as np
import pandas as pd
import scipy

SEARCH_RAD = np.radians(np.arange(-5.0, 5.01, 0.5))
"""Angles about the case's axis, rad; chosen."""


def sweep(planes_rad: Sequence[float], step_rad: float, check_poses: int) -> list[Target]:
    """Plan the paper's experiments 1 and 2: in each plane alpha, beta turns forth and back."""
    forth = np.arange(round(2 * np.pi / step_rad) + 1) * step_rad
    grid = [
        Target(float(alpha), float(beta))
        for alpha in planes_rad
        for beta in (*forth, *forth[::-1])
    ]
    return grid + spread(check_poses)


def search(truth: Sensor, seed: int) -> tuple[dict[str, float], np.ndarray]:
    """
    Turn beta about 0 at alpha = 90° (maximum), and about ±90° (null), 5 s in each pose.

    The beta of the largest output is minus that of (18): x_ref has to turn back by it. Between
    the null crossings at +90° and −90° the zero-g cancels. Return the beta of the direction of
    the x axis, true and by three methods, rad, and the outputs at `SEARCH_RAD`, g.
    """
    around = {'top': 0.0, 'left': np.pi / 2, 'right': -np.pi / 2}
    volts = {}
    for i, (name, middle) in enumerate(around.items()):
        read = np.column_stack([np.full(len(SEARCH_RAD), np.pi / 2), middle + SEARCH_RAD])
        poses: Poses = poses_at(truth, read, seed + (10 + i) * 1_000_003)[0]
        volts[name] = (poses.volts[:, 0] - truth.nominal_zero_g_v[0]) / (
            truth.nominal_scale_v_per_g[0] * truth.local_gravity_mps2 / G0_MPS2
        )
    top = volts['top']
    curve = np.polyfit(SEARCH_RAD, top, 2)
    # The output near ±90° is ∓s·(turn − u) + zero-g, so that the difference is 0 at u.
    slope, level = np.polyfit(SEARCH_RAD, (volts['left'] - volts['right']) / 2, 1)
    # β_x of (18) with the linear cross-axis term, which equals it to first order.
    direction = sum(
        float(truth.values.get(effect, {}).get(name, [0.0])[0])
        for effect, name in (('misalignment', 'beta_rad'), ('cross_axis', 'linear'))
    )
    return {
        'truth': direction,
        'largest output': -float(SEARCH_RAD[np.argmax(top)]),
        'parabola through the outputs': float(curve[1] / (2 * curve[0])),
        'null crossings at ±90°': float(level / slope),
    }, top


MAX_BOUND_RAD = np.radians(1.0)
"""Largest bound of an angle, rad, at which a pose counts; chosen."""
NEAR_VERTICAL_RAD = np.radians(15.0)
"""Distance from ±90°, rad, below which a pose does not count for the alpha error; chosen."""
_BUTTERWORTH = 2, 20.0
"""Order and corner, Hz, of the low-pass of the motion experiment; the paper's."""


def sweep_bound(
    truth: Sensor, swept: Poses, true_rad: np.ndarray, stage: StageError, terms: Sequence[str]
) -> Sensor:
    """Return the true unit with the Cramér-Rao bound of a sweep as its covariance."""
    names = full_model.fitted_coefficients(truth.axes, terms)
    unit = with_neutral(truth, (*map(full_model.effect_of, terms), 'base_tilt'))
    level = full_model.LEVEL_STD_RAD if stage.total_rad else 1e-9
    at_truth = replace(swept, alpha_rad=true_rad[:, 0], beta_rad=true_rad[:, 1])
    information = full_model.fisher_information(unit, at_truth, names, stage)
    base = [i for i, name in enumerate(names) if name.effect == 'base_tilt']
    information[base, base] += 1 / level**2 - 1 / full_model.LEVEL_STD_RAD**2
    covariance = np.linalg.inv(information)
    of_sensor = [i for i, name in enumerate(names) if not full_model.belongs_to_stage(name)]
    return replace(
        truth,
        covariance=covariance[np.ix_(of_sensor, of_sensor)],
        covariance_names=tuple(names[i] for i in of_sensor),
    )


def angle_errors(
    fitted: Sensor, bound: Sensor, poses: Poses, true_rad: np.ndarray
) -> pd.DataFrame:
    """
    Compare the tilt by a calibrated unit with the truth; a row for alpha and beta of each pose.

    It has the error, the standard deviation by the calibration, and the Cramér-Rao bound by the
    noise of one pose, and by pose and calibration, rad. A bound is inf where |f| = g has two
    upright solutions, and for beta within 1° of level; an error counts where it is below 1°.
    """
    force = stage_force(bound, *true_rad.T)
    up = np.where(np.asarray(force[2]) < 0, -1, 1)
    variance_v2 = np.mean(poses.std_v, axis=0) ** 2
    true = _angles(bound, force, up, variance_v2)
    pose_only = _angles(bound.without_covariance(), force, up, variance_v2)
    measured_force = signal_chain.inverse(fitted, up)(list(poses.volts.T))
    measured = _angles(fitted, measured_force, up, variance_v2)
    solution = signal_chain.inverse(bound, up)(list(signal_chain.static_response(bound)(force)))
    twofold = np.abs(np.subtract(solution, force)).max(axis=0) > 1e-3
    true[1][twofold] = pose_only[1][twofold] = np.inf
    level = np.hypot(force[0], force[1]) < np.sin(MAX_BOUND_RAD) * np.abs(force[2])
    true[1][level, 1] = pose_only[1][level, 1] = np.inf
    error = measured[0] - true[0]
    error[:, 1] = (error[:, 1] + np.pi) % (2 * np.pi) - np.pi
    error[:, 1] = np.where(np.isfinite(error[:, 1]), error[:, 1], 0.0)
    inclined = np.arctan2(np.hypot(force[0], force[1]), np.abs(force[2]))
    found = pd.DataFrame(
        {
            name: values.ravel()
            for name, values in (
                ('error', error),
                ('std', measured[1]),
                ('pose_bound', pose_only[1]),
                ('bound', true[1]),
            )
        }
    )
    return found.assign(
        angle=np.tile(['alpha', 'beta'], len(error)),
        counts=found.bound < MAX_BOUND_RAD,
        near_vertical=np.repeat(np.pi / 2 - inclined < NEAR_VERTICAL_RAD, 2),
    )


def _angles(
    sensor: Sensor, force: Components, up: np.ndarray, variance_v2: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return alpha and beta, and their standard deviations, rad, (k, 2) each."""
    covariance = force_covariance(sensor, force, variance_v2)
    measured = tilt(force, covariance, 'z' in sensor.axes)
    return (
        np.column_stack([measured.alpha, measured.beta]),
        np.column_stack([measured.alpha_std, measured.beta_std]),
    )


def force_errors(
    fitted: Sensor, truth: Sensor, poses: Poses, true_rad: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the errors of the measured axes and their standard deviations by the calibration."""
    true = stage_force(truth, *true_rad.T)
    up = np.where(np.asarray(true[2]) < 0, -1, 1)
    measured = signal_chain.inverse(fitted, up)(list(poses.volts.T))
    covariance = force_covariance(fitted, measured, np.mean(poses.std_v, axis=0) ** 2)
    axes = [AXES.index(axis) for axis in fitted.axes]
    return (
        np.column_stack([measured[d] - true[d] for d in axes]),
        np.sqrt(np.column_stack([covariance[d, d] for d in axes])),
    )


def motion_errors(
    fitted: Sensor, time_s: np.ndarray, volts: np.ndarray, reference_mps2: np.ndarray
) -> tuple[tuple[float, float], np.ndarray, np.ndarray]:
    """
    Compare the acceleration of a calibrated unit in motion with the reference.

    The RC filter is inverted. Estimate and reference then pass the same Butterworth filter. Return
    the rms of the residual about its mean and this mean, mm/s², the estimate and the reference.
    """
    unfiltered = inversions.undo_filter(
        volts, time_s, noise.electronics(fitted).rc_s, fitted.rate_hz
    )
    estimate = signal_chain.inverse(fitted)(list(unfiltered.T))[0]
    b, a = scipy.signal.butter(*_BUTTERWORTH, fs=fitted.rate_hz)
    smooth, expected = (scipy.signal.lfilter(b, a, v) for v in (estimate, reference_mps2))
    # The start of both filters has decayed after 1 s.
    residual = 1e3 * (smooth - expected)[time_s > 1.0]
    return (float(residual.std()), float(residual.mean())), smooth, expected


def motion_bound_mmps2(nominal: Sensor) -> float:
    """Return the floor of the motion experiment, mm/s²: white noise after the Butterworth."""
    b, a = scipy.signal.butter(*_BUTTERWORTH, fs=nominal.rate_hz)
    impulse = scipy.signal.lfilter(b, a, np.eye(1, round(nominal.rate_hz))[0])
    density = nominal.noise_density_g_per_rthz[0] * G0_MPS2
    return float(1e3 * density * np.sqrt(nominal.rate_hz / 2 * np.sum(impulse**2)))


MODELS = {'linear': linear.fit, 'physical': linear.fit_physical, 'full': term_selection.fit}
PLANES_RAD = tuple(np.radians([90.0, 60.0, 30.0, 0.0, 120.0, 150.0, 180.0]).tolist())
"""Planes alpha of the sweep, rad; the paper's, as its step of beta, 30°."""
GRAVITY_MPS2 = 9.80131
"""Local gravity of the paper's experiments, m/s²."""
SETTLED_S = 1.0
"""Time from the stop of the stage to the start of a pose's mean, s; chosen."""


STAGES = {'perfect': (0.0, 0.0), 'paper': (np.radians(5 / 60), full_model.LEVEL_STD_RAD)}
"""Step of the encoder and standard deviation of the base's tilt, rad, by stage."""


class Run(NamedTuple):
    """One unit after its sweep."""

    truth: Sensor  # the true unit, with the tilt of the base
    fitted: dict[str, Sensor]  # the calibrated unit by model
    poses: Poses  # poses of the sweep
    true_rad: np.ndarray  # true alpha and beta of these poses, rad, (k, 2)


def draw(nominal: Sensor, stage: tuple[float, float], rng: np.random.Generator) -> Sensor:
    """
    Draw a unit at datasheet spread, or take the given one, on a base that is not level.

    Each coefficient is normal; its typical size is the standard deviation. The filter's resistor
    departs from the stated one by a quarter at most, as in the paper.
    """
    step_rad, level_rad = stage
    unit = replace(nominal, stage_resolution_rad=step_rad, local_gravity_mps2=GRAVITY_MPS2)
    if not nominal.effects:
        values = {
            name: {
                p: rng.normal(size=np.shape(v)) * v
                for p, v in typical(effect_named(name), unit.axes).items()
            }
            for name in full_model.TERMS
        }
        ratio = rng.uniform(-0.25, 0.25, len(unit.axes))
        values['bandwidth'] = {'resistance_ratio': ratio}
        unit = replace(unit, effects=tuple(values), values=values)
    level = {f'{axis}_rad': np.array(level_rad * rng.normal()) for axis in 'xy'}
    unit = with_neutral(unit, ['base_tilt'])
    return replace(unit, values={**unit.values, 'base_tilt': level})


def bare(truth: Sensor) -> Sensor:
    """Return the unit as it is stated before its calibration."""
    return replace(truth.without_covariance(), effects=(), values={}, model='nominal')


def poses_at(
    truth: Sensor, read_rad: np.ndarray, seed: int
) -> tuple[Poses, np.ndarray, Recording]:
    """Simulate rests of 5 s at given angles of the encoder, and average."""
    rng = np.random.default_rng([seed, 1])
    step = truth.stage_resolution_rad
    on_grid = np.rint(read_rad / step) * step if step else read_rad
    # A joint that does not move keeps its error.
    moved = np.diff(on_grid, axis=0, prepend=np.nan) != 0
    errors = step * rng.uniform(-0.5, 0.5, read_rad.shape)
    held = np.maximum.accumulate(np.where(moved, np.arange(len(moved))[:, None], 0), axis=0)
    true = on_grid + np.take_along_axis(errors, held, axis=0)
    script, ends_s = trajectories.Script(*true[0]), []
    for pose in true:
        script.go(*pose)
        script.rest(SETTLED_S + trajectories.DWELL_S)
        ends_s.append(script.now_s)
    columns = simulate(truth, Motion(script.now_s, *script.joints()), seed)
    time_s = columns.pop('time_s')
    recording = Recording('simulated', time_s, columns, sensor_info(truth))
    samples = round(trajectories.DWELL_S * truth.rate_hz)
    records = [
        PoseRecord(
            pose=number,
            start_ns=round((end_s - trajectories.DWELL_S) * 1e9),
            stop_ns=round(end_s * 1e9),
            samples=samples,
            mean_v=(),
            std_v=(),
            alpha_rad=alpha_rad,
            beta_rad=beta_rad,
        )
        for number, (end_s, (alpha_rad, beta_rad)) in enumerate(zip(ends_s, on_grid))
    ]
    return extract_poses(recording, bare(truth), records), true, recording


def calibrated(truth: Sensor, seed: int, models: Sequence[str] = tuple(MODELS)) -> Run:
    """Sweep a unit (the paper's experiments 1 and 2) and fit the models."""
    targets = sweep(PLANES_RAD, float(np.radians(30.0)), 0)
    poses, true, recording = poses_at(
        truth, np.array([[t.alpha_rad, t.beta_rad] for t in targets]), seed
    )
    nominal = bare(truth)
    fitted = {name: MODELS[name](nominal, poses) for name in models}
    if 'full' in fitted:
        noise = estimate_filters(recording, nominal, poses)
        fitted['full'], _ = filter_noise.with_filter(fitted['full'], [noise])
    return Run(truth, fitted, poses, true)


def shaken(truth: Sensor, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Shake a unit as in the paper's motion experiment."""
    rng = np.random.default_rng([seed, 2])
    nominal_motion = trajectories.motion(rng)
    joint_error_rad = truth.stage_resolution_rad * rng.uniform(-0.5, 0.5, 2)
    at_rest = np.zeros(1)
    alpha, beta = (
        Held(float(joint(at_rest)[0] + error))
        for joint, error in zip((nominal_motion.alpha, nominal_motion.beta), joint_error_rad)
    )
    motion = replace(nominal_motion, alpha=alpha, beta=beta)
    columns = simulate(truth, motion, seed)
    volts = np.column_stack([columns[f'{axis}_v'] for axis in truth.axes])
    return columns['time_s'], volts, motion.shift(columns['time_s'], 2)


RUNS = {
    'alpha': np.array([(a, 0) for a in range(-180, 181, 30)]),
    'beta': np.array([(90, a) for a in range(-180, 181, 30)]),
    'both': np.array([(a, a) for a in range(-180, 181, 30)]),
}
"""Alpha and beta of figure 10, deg; (b) at alpha = 90°, as beta has no effect at 0."""


class Unit(NamedTuple):
    """Errors of one unit on one stage; each has values by model."""

    # of `angle_errors`, by `model` and by `run`: random poses and the paper's tilt experiments
    angles: pd.DataFrame
    # errors over their standard deviation: of the measured axes in the random poses, and of the
    # coefficients; empty where the truth is not in the gauge of the fit
    acceleration: dict[str, np.ndarray]
    coefficients: dict[str, np.ndarray]
    # rms about the mean, and mean, of the residual in motion, mm/s²
    motion: dict[str, tuple[float, float]]
    directions: tuple[dict[str, float], np.ndarray]  # of `search`


def evaluate(nominal: Sensor, stage: tuple[float, float], seed: int) -> Unit:
    """Draw, sweep and calibrate one unit, and run the experiments."""
    rng = np.random.default_rng([seed, 0])
    truth = draw(nominal, stage, rng)
    run = calibrated(truth, seed)
    bound = sweep_bound(
        truth,
        run.poses,
        run.true_rad,
        StageError(truth.stage_std_rad),
        (*full_model.default_terms(truth.axes), *full_model.GAUGE),
    )
    random_rad = np.column_stack(
        [np.arccos(rng.uniform(-1, 1, 40)), rng.uniform(0, 2 * np.pi, 40)]
    )
    angles_rad = {'random': random_rad, **{name: np.radians(deg) for name, deg in RUNS.items()}}
    poses_of = {
        name: poses_at(truth, rad, seed + (i + 1) * 1_000_003)[:2]
        for i, (name, rad) in enumerate(angles_rad.items())
    }
    moved, angles, acceleration, coefficients = shaken(truth, seed), [], {}, {}
    for model, fitted in run.fitted.items():
        angles += [
            angle_errors(fitted, bound, *poses).assign(model=model, run=name)
            for name, poses in poses_of.items()
        ]
        acceleration[model] = np.divide(*force_errors(fitted, truth, *poses_of['random']))
        names, coefficients[model] = fitted.covariance_names, np.zeros(0)
        if all(name.effect in truth.effects for name in names):
            coefficients[model] = (get(fitted, names) - get(truth, names)) / np.sqrt(
                np.diag(fitted.covariance)
            )
    return Unit(
        pd.concat(angles),
        acceleration,
        coefficients,
        {model: motion_errors(fitted, *moved)[0] for model, fitted in run.fitted.items()},
        search(truth, seed),
    )


def evaluate_all(
    nominal: Sensor, units: int, seed: int, show: Callable[[float], None]
) -> dict[str, list[Unit]]:
    """Evaluate several units on each stage, in parallel."""
    seeds = [*range(1000 * seed, 1000 * seed + units)]
    stages = [stage for stage in STAGES.values() for _ in seeds]
    found = in_parallel(partial(evaluate, nominal), show, stages, seeds * len(STAGES))
    return {name: found[i * units : (i + 1) * units] for i, name in enumerate(STAGES)}


def in_parallel(
    work: Callable[..., Any], show: Callable[[float], None], *arguments: Sequence[Any]
) -> list[Any]:
    """Return the results of a function for sequences of its arguments, over the cores."""
    results = []
    with open_pool(None) as pool:
        for result in pool.map(work, *arguments):
            results.append(result)
            show(len(results) / len(arguments[0]))
    return results
