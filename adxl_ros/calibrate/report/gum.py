# SPDX-License-Identifier: Apache-2.0

"""
The uncertainty of the acceleration at a stated pose (GUM, JCGM 100), and a certificate of it.

Squares of contributions add. Those of noise, coefficients, stage and model are the parts of
`error_budget.ErrorBudget`, here pose by pose.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from adxl_ros.calibrate.pose_model import reference_force
from adxl_ros.calibrate.poses import Poses
from adxl_ros.calibrate.report import acceptance, certificate_data, held_out
from adxl_ros.calibrate.report.acceptance import Assessment, FAIL, NOT_SHOWN, PASS
from adxl_ros.calibrate.report.error_budget import ErrorBudget
from adxl_ros.calibrate.report.error_causes import covariances
from adxl_ros.calibrate.result import CalibrationResult, compare
from adxl_ros.errors import UserError
from adxl_ros.files.atomic_write import AnyPath, write_text
from adxl_ros.model import signal_chain
from adxl_ros.model.constants import G0_MPS2, Z_90
from adxl_ros.model.sensor import MARGIN_K, Sensor
from adxl_ros.report import templates
from adxl_ros.report.quantities import mg, number
from adxl_ros.signals.rest_means import MOST_BATCHES
from adxl_ros.wording import option
import numpy as np
import scipy

K = 2  # Coverage factor of an expanded uncertainty; about 95 % for a normal distribution
_EARTH_HALF_RANGE_MPS2 = 0.027
"""Half of the range of gravity at sea level, 9.780 to 9.832 m/s², about the standard gravity."""
_LOCAL_STD_MPS2 = 5e-4
"""Uncertainty of a stated local gravity, m/s². Chosen: 50 mGal, the size of gravity anomalies."""
_NOT_LOCAL_MPS2 = (G0_MPS2, 9.8, 9.81)
"""Values of gravity that are those of no place in particular, m/s²."""
_MANY = 1000  # Degrees of freedom beyond which nothing changes. Chosen: k is 1.96
_UNIFORM = np.sqrt(3)  # Half-width of a uniform distribution divided by its standard deviation
_SURROUNDINGS = {
    'temperature': ('temperature_c', 'K', MARGIN_K, 0.1),
    'supply': ('supply_v', 'V', 0.0, 1e-3),
}
"""Field of a pose, unit, margin of the range, and step of central differences."""
MODEL = (
    'a = F(V; θ, T, U)·(1 + δg/g) − g·(∂u/∂α·δα + ∂u/∂β·δβ) + δm. The measurand a is the '
    'acceleration along an axis of the case at the stated pose α, β. F inverts the calibrated '
    'sensor. V is the mean output of a rest, θ the coefficients, T the temperature, U the supply, '
    'g the local gravity, u the component of the vertical. The corrections δ are 0 and uncertain.'
)
"""The measurement model."""
MEANING = (
    f'The expanded uncertainty is the standard uncertainty times k = {K}: about 95 % for a normal '
    'distribution, more where a uniform one has the largest part. It holds for rests as long as '
    'those of the calibration and a supply that is constant or in the model, without ageing.'
)
"""What an expanded uncertainty means."""
RULE = (
    f'{PASS} if error + guard band is at most the limit; {FAIL} if the error exceeds it; '
    f'{NOT_SHOWN} in between, and where stage and model are inseparable. The guard band reaches '
    'to the upper end of the 90 % interval, so that the risk of a false '
    f'{PASS} is at most 5 %. The error is that of coefficients and model; the other inputs belong '
    'to each use.'
)
"""The decision rule (ISO/IEC 17025, 7.8.6)."""
SCHEMA_VERSION = '3.2.0'


@dataclass(frozen=True)
class Input:
    """An input quantity, and what it contributes to the acceleration at k poses of m axes."""

    name: str
    kind: str  # Evaluation, A or B, and distribution or source
    std: Any  # Standard uncertainty, (k, m) or one for all
    unit: str  # Unit of `std`
    contribution_mps2: np.ndarray  # To the standard uncertainty of the acceleration, (k, m)
    freedom: float = np.inf  # Degrees of freedom of `std`; infinite for type B


class Decision(NamedTuple):
    """A comparison of the rms error of a calibration with its limit."""

    quantity: str  # acceleration or tilt
    unit: str  # mg or °
    error: float
    guard_band: float  # From the error to the upper end of its 90 % interval
    limit: float
    outcome: str


@dataclass(frozen=True)
class Uncertainty:
    """The uncertainty at k held-out poses of a calibration of m axes."""

    axes: str
    alpha_rad: np.ndarray  # (k,)
    beta_rad: np.ndarray  # (k,)
    reference_mps2: np.ndarray  # Acceleration by stage and gravity, (k, m)
    error_mps2: np.ndarray  # Measured acceleration minus that, (k, m)
    inputs: tuple[Input, ...]
    limit_name: str  # Where the limits of the decisions come from
    decisions: tuple[Decision, ...]

    @property
    def combined_mps2(self) -> np.ndarray:
        """Return the combined standard uncertainty, m/s², (k, m)."""
        return np.asarray(np.sqrt(sum(row.contribution_mps2**2 for row in self.inputs)))

    @property
    def freedom(self) -> np.ndarray:
        """Return the effective degrees of freedom, (k, m) (Welch-Satterthwaite, GUM G.4.1)."""
        shares = sum(row.contribution_mps2**4 / row.freedom for row in self.inputs)
        return np.asarray(self.combined_mps2**4 / np.maximum(shares, np.finfo(float).tiny))

    @property
    def worst(self) -> tuple[int, int]:
        """Return pose and axis of the largest combined uncertainty."""
        return divmod(int(np.argmax(self.combined_mps2)), self.error_mps2.shape[1])


def uncertainty(result: CalibrationResult) -> Uncertainty | None:
    """Return the uncertainty at the held-out poses that determine alpha; None without any."""
    fitted = result.fitted
    if not result.held_out or not np.isfinite(result.assessments[-1].accel.measured):
        return None
    errors = result.held_out[-1]
    assessment = result.assessments[-1]
    gravity = fitted.local_gravity_mps2
    axes = fitted.axis_indices
    poses = result.poses.subset(result.inliers)
    held = poses.subset(errors.pose_index)
    used = held_out.determining_alpha(errors.pose_errors)
    force = np.column_stack(reference_force(held, gravity))

    def stds_mps2(covariance: np.ndarray) -> np.ndarray:
        return np.sqrt(np.maximum([covariance[d, d][used] for d in axes], 0.0)).T

    by_cause = covariances(errors, held, force)
    by_noise = stds_mps2(by_cause.by_noise)
    by_coefficients = stds_mps2(by_cause.by_coefficients)
    by_stage = stds_mps2(by_cause.by_stage)
    held = held.subset(used)
    reference = force[used][:, axes]
    error = errors.pose_errors.accel_mps2[used]
    model = np.full(error.shape, np.sqrt(assessment.accel.model))
    inputs = (
        Input(
            name='noise of the mean',
            kind='A, normal',
            std=1e3 * np.mean(held.std_v, axis=0),
            unit='mV',
            contribution_mps2=by_noise,
            freedom=MOST_BATCHES - 1,
        ),
        Input(
            name='coefficients',
            kind='A, covariance of the fit',
            std=mg(by_coefficients),
            unit='mg',
            contribution_mps2=by_coefficients,
            freedom=max(int((~poses.check).sum()) * len(axes) - len(fitted.covariance_names), 1),
        ),
        _stage_angles(by_stage, assessment.accel.stage, fitted),
        Input(
            name='model',
            kind='A, held-out errors',
            std=mg(model),
            unit='mg',
            contribution_mps2=model,
            freedom=error.size,
        ),
        _local_gravity(gravity, reference),
        *(_surroundings(name, fitted, held, reference) for name in _SURROUNDINGS),
        *_next_degree(fitted, held),
    )
    return Uncertainty(
        axes=fitted.axes,
        alpha_rad=held.alpha_rad,
        beta_rad=held.beta_rad,
        reference_mps2=reference,
        error_mps2=error,
        inputs=inputs,
        limit_name=acceptance.limit(fitted).origin,
        decisions=_decisions(fitted, assessment),
    )


def _stage_angles(by_step_mps2: np.ndarray, scatter: float, fitted: Sensor) -> Input:
    """
    Return the contribution of the stage, with that of a step of its encoders, m/s², (k, m).

    The poses may scatter more than the step permits; scatter: their mean square, (m/s²)².
    """
    name = 'stage angles'
    step_rad = fitted.stage_std_rad
    excess = (scatter / max(np.mean(by_step_mps2**2), 1e-30)) ** 0.5
    if excess <= 1:
        kind = 'B, uniform within a step'
        return Input(name, kind, np.degrees(step_rad), '°', by_step_mps2)
    scatter_mps2 = np.full(by_step_mps2.shape, scatter**0.5)
    std_rad = step_rad * excess or scatter**0.5 / fitted.local_gravity_mps2
    part_mps2 = by_step_mps2 * excess if step_rad else scatter_mps2
    return Input(
        name=name,
        kind='A, scatter of the poses',
        std=np.degrees(std_rad),
        unit='°',
        contribution_mps2=part_mps2,
        freedom=part_mps2.size,
    )


def _local_gravity(gravity_mps2: float, reference_mps2: np.ndarray) -> Input:
    """Return the contribution of local gravity to accelerations, m/s², (k, m)."""
    std_mps2 = _LOCAL_STD_MPS2
    kind = 'B, anomalies of gravity'
    if gravity_mps2 in _NOT_LOCAL_MPS2:
        std_mps2 = _EARTH_HALF_RANGE_MPS2 / _UNIFORM
        kind = 'B, not local: anywhere'
    part_mps2 = np.abs(reference_mps2) / gravity_mps2 * std_mps2
    return Input('local gravity', kind, std_mps2, 'm/s²', part_mps2)


def _decisions(fitted: Sensor, assessment: Assessment) -> tuple[Decision, ...]:
    """Return the comparisons with limits; none of a quantity without a limit."""
    limit_mps2 = acceptance.limit(fitted).mps2

    def decision(
        quantity: str, unit: str, scale: float, budget: ErrorBudget, limit: float, outcome: str
    ) -> Decision:
        """Return a comparison; `scale` turns the SI unit of error and limit into `unit`."""
        error, high = budget.calibration**0.5, budget.calibration_high**0.5
        return Decision(
            quantity=quantity,
            unit=unit,
            error=scale * error,
            guard_band=scale * (high - error),
            limit=scale * limit,
            outcome=outcome,
        )

    accel, tilt = assessment.accel, assessment.tilt
    tilt_limit_rad = limit_mps2 * tilt.tilt_per_axis**0.5
    degrees = float(np.degrees(1.0))
    both = (
        decision('acceleration', 'mg', mg(1.0), accel, limit_mps2, assessment.accel_outcome),
        decision('tilt', '°', degrees, tilt, tilt_limit_rad, assessment.tilt_outcome),
    )
    return tuple(row for row in both if row.outcome)


def _surroundings(name: str, fitted: Sensor, held: Poses, reference: np.ndarray) -> Input:
    """Return the contribution of temperature or supply, uniform over those of the poses."""
    field, unit, margin, step = _SURROUNDINGS[name]
    values = getattr(held, field)
    environment = held.environment
    seen = values[np.isfinite(values)]
    half_range = margin + (np.ptp(seen) / 2 if seen.size else 0.0)
    if seen.size:
        kind = 'B, range of the poses'
    elif margin:
        kind = f'B, ±{margin:g} {unit}, not measured'
    else:
        kind = 'not measured, taken as constant'
    std = half_range / _UNIFORM
    inverse = signal_chain.inverse(fitted, np.where(np.cos(held.alpha_rad) < 0, -1, 1))
    shifted = [
        np.column_stack(
            inverse(
                list(held.volts.T),
                environment._replace(**{field: getattr(environment, field) + sign * step}),
            )
        )
        for sign in (1, -1)
    ]
    slope = (shifted[0] - shifted[1])[:, fitted.axis_indices] / (2 * step)
    if name == 'temperature':
        # What the model does not follow drifts as the datasheet states.
        slope = np.sqrt(
            slope**2
            + (G0_MPS2 * fitted.envelope.zero_g_per_k) ** 2
            + (reference * fitted.envelope.scale_per_k) ** 2
        )
    return Input(name, kind, std, unit, np.abs(np.nan_to_num(slope)) * std)


def _next_degree(fitted: Sensor, held: Poses) -> list[Input]:
    """Return what a polynomial over temperature lacks, as `Envelope` has it; none without one."""
    std_g = fitted.envelope.zero_g_std_g(held.environment.temperature_c)
    if not std_g:
        return []
    contribution_mps2 = G0_MPS2 * np.abs(np.broadcast_to(np.transpose(std_g), held.volts.shape))
    return [
        Input(
            'zero-g over temperature',
            'A, next degree of its polynomial',
            mg(contribution_mps2),
            'mg',
            contribution_mps2,
        )
    ]


def section(found: Uncertainty | None) -> dict[str, Any] | None:
    """Return the uncertainty, at the pose where it is largest, as the page shows it."""
    if found is None:
        return None
    rows = []
    for row in found.inputs:
        std = float(np.broadcast_to(row.std, found.error_mps2.shape)[found.worst])
        part_mg = float(mg(row.contribution_mps2[found.worst]))
        ratio = part_mg / std if std else 0.0
        sensitivity = '1' if row.unit == 'mg' else f'{number(ratio, digits=2)} mg per {row.unit}'
        rows.append(
            [
                row.name,
                f'{number(std, digits=2)} {row.unit} ({row.kind})',
                sensitivity,
                f'{part_mg:.3f}',
                f'{row.freedom:.0f}' if np.isfinite(row.freedom) else '∞',
            ]
        )
    expanded_mg = mg(K * found.combined_mps2)
    pose, axis = found.worst
    freedom = float(found.freedom[pose, axis])
    alpha, beta = np.degrees([found.alpha_rad[pose], found.beta_rad[pose]])
    inside = np.abs(found.error_mps2) <= K * found.combined_mps2
    decisions = [
        [
            row.quantity,
            f'{row.error:.3f} + {row.guard_band:.3f} = '
            f'{row.error + row.guard_band:.3f} {row.unit}',
            f'{number(row.limit, digits=2)} {row.unit}',
            row.outcome,
        ]
        for row in found.decisions
    ]
    return {
        'model': MODEL,
        'meaning': MEANING,
        'rule': RULE,
        'limit_name': found.limit_name,
        'pose': f'alpha {alpha:.1f}°, beta {beta:.1f}°, axis {found.axes[axis]}',
        'budget': rows,
        'decisions': decisions,
        'combined': f'{expanded_mg[pose, axis] / K:.3f} mg',
        'expanded': f'{expanded_mg[pose, axis]:.2f} mg',
        'freedom': f'{freedom:.0f}' if freedom < _MANY else f'more than {_MANY}',
        'factor': f'{scipy.stats.t.ppf(0.975, max(freedom, 1.0)):.2f}',
        'range': f'{expanded_mg.min():.2f} to {expanded_mg.max():.2f} mg',
        'inside': f'{int(inside.sum())} of {inside.size}',
    }


def _digits(values: Any) -> str:
    """Return a number, or several ones, (n,), as a certificate has them."""
    return ' '.join(f'{value:.7g}' for value in np.ravel(values))


def write(
    path: AnyPath, result: CalibrationResult, data: Mapping[str, str] = certificate_data.DEFAULTS
) -> None:
    """
    Write the certificate of a calibration against a stage, by the template of its elements.

    data: what no recording shows, by the keys of `certificate_data`.
    """
    found = uncertainty(result)
    if found is None:
        raise UserError(
            f'{path}: a certificate states errors at stage angles, and no pose with '
            f'angles was kept out of the fit; leave {option("certificate")} out'
        )
    elements = templates.environment('a certificate', ('adxl_ros.calibrate.report', ''))
    elements.filters |= {'degrees': np.degrees, 'digits': _digits}
    write_text(
        path,
        elements.get_template('certificate.xml').render(
            schema_version=SCHEMA_VERSION,
            k=K,
            z_90=Z_90,
            g0_mps2=G0_MPS2,
            rule=RULE,
            method=f'{MEANING} {MODEL}',
            data=data,
            found=found,
            fitted=result.fitted,
            provenance=result.fitted.provenance,
            coefficients=compare(result.fitted, result.fitted),
        ),
    )
