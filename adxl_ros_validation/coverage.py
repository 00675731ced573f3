# SPDX-License-Identifier: Apache-2.0
"""
Simulation-based calibration: whether intervals contain the truth as often as they state.

Units and stages are drawn, swept and fitted. The rank of the truth in its posterior must be
uniform (Talts et al. 2018, arXiv:1804.06788). 90 % intervals must contain it in 90 % of the draws.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import product

from adxl_ros.calibrate.fits import full_model, term_selection
from adxl_ros.calibrate.fits.pose_covariance import StageError
from adxl_ros.calibrate.guided import pose_plan, running_estimate
from adxl_ros.calibrate.pose_model import predicted_volts
from adxl_ros.calibrate.poses import Poses
from adxl_ros.model import noise
from adxl_ros.model.constants import Z_90
from adxl_ros.model.error_sizes import stds
from adxl_ros.model.sensor import get, parameter_of, put, Sensor, with_axes, with_neutral
from adxl_ros_validation import experiments
from adxl_ros_validation.blind.report import filled, markdown_table, terminal_table
import numpy as np
import pandas as pd
import scipy

STAGES = ('errors per pose', 'errors per setting', 'eccentric', 'tilted base')
"""Errors of a joint are new with each pose, or with each move; the last two are per setting."""
AXES = ('xy', 'xyz')
_DWELL_S = 5.0
"""Duration of each dwell, s; the paper's."""
_HELD_OUT = 8
"""Number of held-out poses of each draw; chosen."""
BINS = 10
"""Number of bins of the ranks; chosen."""


def draw_all(
    nominal: Sensor, draws: int, seed: int, show: Callable[[float], None]
) -> pd.DataFrame:
    """Draw and fit units on all kinds of stage, over the cores; see `draw`."""
    kinds = list(product(STAGES, AXES, pose_plan.KINDS))
    return pd.concat(
        experiments.in_parallel(partial(draw, nominal, kinds=kinds, seed=seed), show, range(draws))
    )


def draw(
    nominal: Sensor, number: int, kinds: Sequence[tuple[str, str, str]], seed: int
) -> pd.DataFrame:
    """
    Draw one unit and one stage, sweep, and fit; return a row for each error.

    The encoder has steps of 0.01° to 0.1°, and the true error of the stage is 0.5 to 2 times the
    stated one, both log-uniform.

    `z` is an error over its stated standard deviation: of the fitted coefficients, and, over
    held-out poses, of the tilt and of the measured axes. `by_bound` is the error of a coefficient
    over the Cramér-Rao bound of the true error model, where the fit has the terms of the unit.
    """
    stage, axes, kind = kinds[number % len(kinds)]
    rng = np.random.default_rng([seed, number])
    stated = np.radians(np.exp(rng.uniform(*np.log((0.01, 0.1)))))
    sensor = replace(with_axes(nominal, axes), stage_resolution_rad=float(stated))
    terms = (*full_model.default_terms(axes), *['stage_eccentricity'] * (stage == 'eccentric'))
    truth = _unit(sensor, terms, stage, rng)
    step = float(stated * np.exp(rng.uniform(*np.log((0.5, 2.0)))))
    poses, true_rad = _swept(truth, _targets(sensor, kind), stage == STAGES[0], step, rng)
    fit, _ = term_selection.fit_selected(sensor, poses)
    names = fit.fitted.covariance_names
    truth_of_fit = with_neutral(truth, {name.effect for name in names})
    error = get(fit.fitted, names) - get(truth_of_fit, names)
    sigma = step / np.sqrt(12)
    levels = StageError(0.0, sigma) if stage == STAGES[0] else StageError(sigma)
    bound = experiments.sweep_bound(truth, poses, true_rad, levels, terms)
    angles = _held_out_angles(rng)
    held_out = _measured(truth, angles, angles, rng), angles
    tilt = experiments.angle_errors(fit.fitted, bound, *held_out)
    force, force_std = experiments.force_errors(fit.fitted, truth, *held_out)
    bound_std = dict(zip(bound.covariance_names, stds(bound.covariance)))
    by_bound = [bound_std[name] for name in names] if set(names) == set(bound_std) else np.nan
    return pd.concat(
        [
            pd.DataFrame(
                {
                    'of': 'coefficients',
                    'name': list(map(str, names)),
                    'by_bound': error / by_bound,
                    'z': error / stds(fit.fitted.covariance),
                }
            ),
            pd.DataFrame({'of': 'tilt', 'z': (tilt.error / tilt['std'])[tilt.counts]}),
            pd.DataFrame({'of': 'acceleration', 'z': (force / force_std).ravel()}),
        ]
    ).assign(draw=number, stage=stage, axes=axes, plan=kind, converged=fit.converged)


def _targets(sensor: Sensor, kind: str) -> list[pose_plan.Target]:
    """Return the poses of a plan, without check poses."""
    if kind == 'full':
        planes_rad = pose_plan.default_planes_rad(sensor.axes)
        return pose_plan.guided(planes_rad, pose_plan.STEP_RAD, 0)
    return running_estimate.quick(sensor, _DWELL_S, float(np.radians(0.1)), 0)


def _held_out_angles(rng: np.random.Generator) -> np.ndarray:
    """Draw alpha and beta, rad, (n, 2), evenly over the sphere."""
    alpha_rad = np.arccos(rng.uniform(-1, 1, _HELD_OUT))
    return np.column_stack([alpha_rad, rng.uniform(0, 2 * np.pi, _HELD_OUT)])


def _unit(sensor: Sensor, terms: Sequence[str], stage: str, rng: np.random.Generator) -> Sensor:
    """Draw a unit: each coefficient is normal with its typical size, in the gauge of the fit."""
    effects = (*terms, 'base_tilt')
    unit = with_neutral(replace(sensor, effects=(), values={}), effects)
    names = [
        name
        for name in full_model.fitted_coefficients(sensor.axes, effects)
        if full_model.term_of(name) not in full_model.GAUGE
        and (stage == 'tilted base' or name.effect != 'base_tilt')
    ]
    sizes = np.array(
        [
            full_model.LEVEL_STD_RAD if name.effect == 'base_tilt' else parameter_of(name).scale
            for name in names
        ]
    )
    return put(unit, names, sizes * rng.normal(size=len(names)))


def _swept(
    truth: Sensor,
    targets: Sequence[pose_plan.Target],
    per_pose: bool,
    step_rad: float,
    rng: np.random.Generator,
) -> tuple[Poses, np.ndarray]:
    """Return the poses of a sweep, and where the stage really stood, rad, (k, 2)."""
    read = np.array([[t.alpha_rad, t.beta_rad] for t in targets])
    poses = Poses.without_volts(read[:, 0], read[:, 1], noise.sample_std_v(truth))
    error = np.empty_like(read)
    for joint, setting in enumerate((poses.alpha_setting, poses.beta_setting)):
        number = np.arange(len(read)) if per_pose else setting
        error[:, joint] = step_rad * rng.uniform(-0.5, 0.5, len(read))[number]
    return _measured(truth, read, read + error, rng), read + error


def _measured(
    truth: Sensor, read_rad: np.ndarray, true_rad: np.ndarray, rng: np.random.Generator
) -> Poses:
    """Return the poses that the stage reads, with the voltages of where it really stands."""
    samples = round(_DWELL_S * truth.rate_hz)
    count = noise.effective_samples(samples, 1 / truth.rate_hz, truth.rc_s)
    poses = Poses.without_volts(
        read_rad[:, 0], read_rad[:, 1], noise.sample_std_v(truth) / np.sqrt(count)
    )
    volts = predicted_volts(
        truth, replace(poses, alpha_rad=true_rad[:, 0], beta_rad=true_rad[:, 1])
    )
    return replace(poses, volts=volts + poses.std_v * rng.normal(size=volts.shape))


def page(errors: pd.DataFrame, made: str) -> str:
    """Return the section about coverage."""
    fitted = errors[errors.of == 'coefficients']
    compared, draws = fitted.dropna(subset='by_bound'), fitted.groupby('draw')
    rows = _rows(errors) + [
        _row(f'{key} {value}: coefficients', part)
        for key in ('stage', 'axes', 'plan')
        for value, part in fitted.groupby(key, sort=False)
    ]
    single = []
    for name, part in fitted.groupby('name', sort=False):
        inside = scipy.stats.binomtest(int(np.sum(part.z.abs() < Z_90)), len(part))
        single.append(
            _row(
                f'{name} ({len(part)})',
                part,
                (inside.statistic, *inside.proportion_ci(0.9, 'exact')),
            )
        )
    head = ['coverage, %', 'rms of error / stated', 'ranks', 'p']
    return filled(
        'coverage.md',
        {
            'made': made,
            'draws': len(draws),
            'converged': draws.converged.all().sum(),
            'compared': len(compared),
            'fits': compared.draw.nunique(),
            'by_bound': np.sqrt(np.mean(compared.by_bound**2)),
            'groups': markdown_table(['', *head], rows),
            'coefficients': markdown_table(['coefficient', *head], single),
        },
    )


def screen_lines(errors: pd.DataFrame) -> list[str]:
    """Return the coverage of all intervals as lines for a terminal."""
    return terminal_table(
        [f'Coverage of 90 % intervals over {errors.draw.nunique()} drawn units and stages', '%'],
        [row[:2] for row in _rows(errors)],
    )


def _rows(errors: pd.DataFrame) -> list[list[str]]:
    """Return the rows of all draws."""
    return [
        _row(f'all {what}' if what == 'coefficients' else str(what), part)
        for what, part in errors.groupby('of', sort=False)
    ]


def mean_with_interval(values: pd.Series, groups: pd.Series) -> tuple[float, float, float]:
    """Return a mean and its 90 % interval by bootstrap over groups of values."""
    sums = values.groupby(groups.to_numpy(), sort=False).agg(['sum', 'count']).to_numpy(float)
    drawn = sums[np.random.default_rng(0).integers(0, len(sums), (1000, len(sums)))].sum(axis=1)
    total = sums.sum(axis=0)
    low, high = np.quantile(drawn[:, 0] / drawn[:, 1], [0.05, 0.95])
    return float(total[0] / total[1]), float(low), float(high)


def _row(label: str, errors: pd.DataFrame, covered: Sequence[float] = ()) -> list[str]:
    """Return a row; `covered` has the share and its interval, else they are over draws."""
    share, low, high = covered or mean_with_interval(errors.z.abs() < Z_90, errors.draw)
    counts = np.histogram(scipy.special.ndtr(errors.z), BINS, (0, 1))[0]
    return [
        label,
        f'{100 * share:.1f} ({100 * low:.1f} to {100 * high:.1f})',
        f'{np.sqrt(np.mean(errors.z**2)):.2f}',
        ' '.join(map(str, counts)),
        f'{scipy.stats.chisquare(counts).pvalue:.2f}',
    ]
