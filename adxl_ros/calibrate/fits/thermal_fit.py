# SPDX-License-Identifier: Apache-2.0

"""Zero-g over temperature, fitted to blocks of a sensor that rests while it warms and cools."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import chain, pairwise
from typing import NamedTuple

from adxl_ros.calibrate.fits.extrapolation import next_degree, NextDegree
from adxl_ros.calibrate.poses import Poses
from adxl_ros.errors import UserError
from adxl_ros.files.recording_columns import Recording
from adxl_ros.files.stamps import mean_period_s
from adxl_ros.model.constants import G0_MPS2, NOMINAL_TEMPERATURE_C, TINY
from adxl_ros.model.effects.base import Coefficient
from adxl_ros.model.filters import loop, play, stop
from adxl_ros.model.sensor import get, parameter_of, put, Sensor, with_neutral
from adxl_ros.report.quantities import mg
import numpy as np
import scipy

EFFECTS = ('temperature_bias', 'temperature_scale', 'thermal_lag', 'thermal_hysteresis')
"""Effects that the fit knows."""
_TURN_G = 0.1
"""Change of the output, g, from which the sensor was turned. Chosen: 6°, and above any zero-g over
temperature between two neighbouring blocks."""
_SCALE_FORCES_G = 0.5
"""Range of the force along an axis, g, from which the slope of its scale factor is fitted. Chosen:
the error of that slope is then at most twice that of the zero-g's."""
_SMALLEST_SPAN_K = 5.0
"""Smallest range of temperature, K, that is fitted. Chosen: 0.5 mg of a typical sensor."""
_FEWEST_BLOCKS = 12  # Fewest blocks of an orientation. Chosen: twice the coefficients of one axis
PRIOR_WIDTH = 5.0
"""Prior standard deviation of a coefficient divided by its typical size, as in the diagnosis."""
_LAGS_S = np.geomspace(10.0, 1000.0, 7)
"""Time constants of `thermal_lag` that are tried, s. Chosen: each is twice the one before."""
_REACHES = np.geomspace(0.02, 0.5, 6)
"""Reaches of `thermal_hysteresis` that are tried, divided by the range of temperature. Chosen: a
loop whose reach is larger has no corner in the range."""
_STEP = 0.02  # Step of the derivative by a shape, divided by its value. Chosen: smooth
_SMALLEST_GAIN = 5.0
"""Gain in half of the BIC from which a dependence on the history counts. Chosen: odds of 150."""
_LARGEST_CORRELATION = 0.95
"""Largest correlation of neighbouring blocks. Chosen: beyond it the drift is a random walk."""
_ITERATIONS = 4  # Iterations over coefficients and correlation. Chosen: they no longer change then


@dataclass(frozen=True)
class ThermalFit:
    """Zero-g over temperature with its covariance."""

    names: tuple[Coefficient, ...]  # (p,)
    values: np.ndarray  # (p,), each in the unit of its parameter
    covariance: np.ndarray  # (p, p)
    history: str  # `thermal_lag` or `thermal_hysteresis`, where the blocks support one, else ''
    shape: float  # Its time constant, s, or its reach, K
    residual_g: np.ndarray  # Residuals by axis, (k, m)
    further: NextDegree  # What the fit lacks
    span_c: tuple[float, float]  # Lowest and highest temperature

    @property
    def rms_g(self) -> np.ndarray:
        """Rms residual of each axis, g, (m,)."""
        return np.asarray(self.residual_g.std(axis=0))

    def error_g(self, temperatures_c: np.ndarray, calibrated_c: float) -> np.ndarray:
        """Return the standard deviation of the zero-g of the worst axis, g, (n,)."""
        warmer_k = temperatures_c - NOMINAL_TEMPERATURE_C
        base_k = calibrated_c - NOMINAL_TEMPERATURE_C
        slopes = np.column_stack([warmer_k - base_k, warmer_k**2 - base_k**2])
        variances = []
        axes = dict.fromkeys(name.axis for name in self.names if name.axis)
        for axis, residual_g in zip(axes, self.rms_g):
            places = [
                self.names.index(Coefficient('temperature_bias', parameter, axis))
                for parameter in ('per_k', 'per_k2')
            ]
            part = self.covariance[np.ix_(places, places)]
            variances.append(np.einsum('ni,ij,nj->n', slopes, part, slopes) + residual_g**2)
        variances_g2 = (
            np.array(variances) + self.further.error_g(temperatures_c, calibrated_c) ** 2
        )
        return np.asarray(np.sqrt(variances_g2.max(axis=0)))


def fit(sensor: Sensor, blocks: Poses, with_history: bool = True) -> ThermalFit:
    """
    Fit slope and curvature of the zero-g over temperature; refuse blocks that do not show them.

    The zero-g of each orientation is free, because the pose is unknown. Neighbouring residuals
    are correlated (AR(1), by Cochrane and Orcutt). An effect of the history, `thermal_lag` or
    `thermal_hysteresis`, is kept where it gains enough, and only after a reversal.
    """
    temperature_c = blocks.temperature_c
    if len(temperature_c) < _FEWEST_BLOCKS:
        raise UserError(
            f'thermal: {len(temperature_c)} blocks at rest with a temperature, at '
            f'least {_FEWEST_BLOCKS} are needed; record for longer'
        )
    if np.ptp(temperature_c) < _SMALLEST_SPAN_K:
        raise UserError(
            f'thermal: the temperature changes by {np.ptp(temperature_c):.1f} K, at '
            f'least {_SMALLEST_SPAN_K:g} K are needed; warm or cool the sensor'
        )
    outputs_g = (blocks.volts - sensor.zero_g_v) / sensor.scale_v_per_g
    turned = np.abs(np.diff(outputs_g, axis=0)).max(axis=1) > _TURN_G
    orientation = np.concatenate([[0], np.cumsum(turned)])
    span_k = float(np.ptp(temperature_c))
    solver = _Solver(sensor.axes, blocks, outputs_g, orientation)
    history = ''
    shape = 0.0
    # Above and below in turn: the temperature has reversed.
    branch = stop(temperature_c, span_k * _REACHES[1], {})
    if with_history and branch.max() > 0.5 and branch.min() < -0.5:
        history, shape = solver.likeliest(
            {'thermal_lag': _LAGS_S, 'thermal_hysteresis': _REACHES * span_k}
        )
    solved = solver(history, shape)
    residual_g = np.column_stack([axis.residual_g for axis in solved])
    names = tuple(chain.from_iterable(axis.names for axis in solved))
    values = np.concatenate([axis.values for axis in solved])
    curvature_k2 = values[[name.parameter == 'per_k2' for name in names]]
    return ThermalFit(
        names=names,
        values=values,
        covariance=scipy.linalg.block_diag(*(axis.covariance for axis in solved)),
        history=history,
        shape=shape,
        residual_g=residual_g,
        further=next_degree(temperature_c, residual_g, curvature_k2),
        span_c=(float(temperature_c.min()), float(temperature_c.max())),
    )


@dataclass(frozen=True)
class _Solver:
    """Fits k blocks for an effect of the history and its shape; '' and 0 for none."""

    axes: str
    blocks: Poses
    outputs_g: np.ndarray  # (k, m)
    orientation: np.ndarray  # Number of the orientation of each block, (k,)

    def __call__(self, history: str, shape: float) -> list[_Axis]:
        """Return the fit of each axis."""
        of_history = _History(self.blocks, history, shape) if history else None
        return [
            _fit_axis(axis, self.blocks.temperature_c, output_g, self.orientation, of_history)
            for axis, output_g in zip(self.axes, self.outputs_g.T)
        ]

    def score(self, history: str, shape: float) -> float:
        """Return half of the BIC, as a gain."""
        count = len(self.axes) + 1 if history else 0
        penalty = 0.5 * float(np.log(self.outputs_g.size)) * count
        return sum(axis.log_likelihood for axis in self(history, shape)) - penalty

    def likeliest(self, shapes_of: Mapping[str, np.ndarray]) -> tuple[str, float]:
        """Return the effect that gains enough, and its shape; the shapes are those to try."""
        best = ('', 0.0)
        highest = self.score('', 0.0) + _SMALLEST_GAIN
        for history, shapes in shapes_of.items():
            place = int(np.argmax([self.score(history, shape) for shape in shapes]))
            bounds = np.log(shapes[[max(place - 1, 0), min(place + 1, len(shapes) - 1)]])
            search = scipy.optimize.minimize_scalar(
                lambda logarithm, history=history: -self.score(history, float(np.exp(logarithm))),
                bounds=bounds,
                method='bounded',
                options={'xatol': 0.01},
            )
            if -search.fun > highest:
                best = (history, float(np.exp(search.x)))
                highest = -search.fun
        return best


class _History:
    """The output of an effect of the history of size 1, and its derivative by the shape."""

    def __init__(self, blocks: Poses, effect: str, shape: float) -> None:
        self.effect = effect
        low = _history_output(blocks, effect, shape * (1 - _STEP))
        high = _history_output(blocks, effect, shape * (1 + _STEP))
        self.output_g = _history_output(blocks, effect, shape)  # (k,)
        self.by_shape = (high - low) / (2 * _STEP * shape)  # (k,)


def _history_output(blocks: Poses, effect: str, shape: float) -> np.ndarray:
    """Return the output of an effect of the history of size 1, g, (k,)."""
    temperature_c = blocks.temperature_c
    time_s = blocks.time_s.mean(axis=1)
    if effect == 'thermal_hysteresis':
        return -loop(temperature_c, shape, {})
    # The filter 1/(1 + τ·s), exact for straight lines between the samples.
    steps_s = np.diff(time_s)
    decay = np.exp(-steps_s / shape)
    ramp = (1 - decay) * shape / np.maximum(steps_s, TINY)
    lagging_c = [temperature_c[0]]
    for d, r, before, now in zip(decay, ramp, temperature_c, temperature_c[1:]):
        lagging_c.append(d * lagging_c[-1] + (r - d) * before + (1 - r) * now)
    return np.array(lagging_c) - temperature_c


class _Axis(NamedTuple):
    """Coefficients of one axis with their covariance, and the residuals."""

    names: list[Coefficient]
    values: np.ndarray
    covariance: np.ndarray
    residual_g: np.ndarray  # (k,)
    log_likelihood: float


def _fit_axis(
    axis: str,
    temperature_c: np.ndarray,
    output_g: np.ndarray,
    orientation: np.ndarray,
    history: _History | None,
) -> _Axis:
    """Fit one axis, the correlation of neighbouring blocks included."""
    columns = _columns(temperature_c - NOMINAL_TEMPERATURE_C, output_g, orientation)
    if history is not None:
        columns[history.effect, _SIZES[history.effect]] = history.output_g
    names = [Coefficient(*name, axis) for name in columns]
    # The zero-g of each orientation has the last columns.
    design = np.column_stack([*columns.values(), _are_of(orientation)])
    begins = np.diff(orientation, prepend=-1) > 0
    correlation = 0.0
    for _ in range(_ITERATIONS):
        white = _whitened(design, correlation, begins)
        target = _whitened(output_g, correlation, begins)
        size = np.sqrt((white**2).sum(axis=0))
        values = np.linalg.lstsq(white / size, target, rcond=None)[0] / size
        residual_g = output_g - design @ values
        rest = target - white @ values
        neighbours = residual_g[1:] @ residual_g[:-1] / max(residual_g @ residual_g, TINY)
        correlation = float(np.clip(neighbours, 0.0, _LARGEST_CORRELATION))
    degrees = max(len(output_g) - design.shape[1], 1)
    variance_g2 = max(float(rest @ rest) / degrees, TINY)
    if history is not None:
        # The shape is uncertain, too.
        size_of_history = values[len(names) - 1]
        design = np.column_stack([design, size_of_history * history.by_shape])
    white, white_free = np.hsplit(_whitened(design, correlation, begins), [len(names)])
    white = white - white_free @ np.linalg.lstsq(white_free, white, rcond=None)[0]
    precision = white.T @ white / variance_g2 + np.diag(
        [(PRIOR_WIDTH * parameter_of(name).scale) ** -2.0 for name in names]
    )
    likelihood = -0.5 * len(output_g) * np.log(variance_g2) + 0.5 * np.log(1 - correlation**2)
    return _Axis(
        names, values[: len(names)], np.linalg.inv(precision), residual_g, float(likelihood)
    )


def _are_of(orientation: np.ndarray) -> np.ndarray:
    """Return which blocks are of each of j orientations, (k, j), 1 or 0."""
    return (orientation[:, None] == np.arange(orientation[-1] + 1)).astype(float)


def _columns(
    warmer_k: np.ndarray, output_g: np.ndarray, orientation: np.ndarray
) -> dict[tuple[str, str], np.ndarray]:
    """Return the derivatives of an output by effect and parameter, (k,)."""
    columns = {
        ('temperature_bias', 'per_k'): warmer_k,
        ('temperature_bias', 'per_k2'): warmer_k**2,
    }
    is_of = _are_of(orientation)
    forces_g = output_g @ is_of / is_of.sum(axis=0)
    # The orientations must separate the scale factor of an axis from its zero-g.
    if np.ptp(forces_g) > _SCALE_FORCES_G:
        columns['temperature_scale', 'per_k'] = forces_g[orientation] * warmer_k
    return columns


def _whitened(values: np.ndarray, correlation: float, begins: np.ndarray) -> np.ndarray:
    """Return what neighbouring blocks do not predict; an orientation begins anew."""
    white = values - correlation * np.roll(values, 1, axis=0)
    white[begins] = values[begins] * np.sqrt(1 - correlation**2)
    return white


_SIZES = {'thermal_lag': 'per_k', 'thermal_hysteresis': 'half_width_g'}
_SHAPES = {'thermal_lag': 'tau_s', 'thermal_hysteresis': 'reach_k'}
"""Size and shape of each effect of the history."""


def applied(base: Sensor, fitted: ThermalFit, calibrated_c: float) -> Sensor:
    """Put a fit into a calibrated sensor, whose zero-g stays right at `calibrated_c`."""
    names = fitted.names
    effects = dict.fromkeys(name.effect for name in fitted.names)
    kept = [i for i, name in enumerate(base.covariance_names) if name.effect not in EFFECTS]
    kept_names = tuple(base.covariance_names[i] for i in kept)
    dropped = set(EFFECTS) - set(effects)
    before = replace(
        base,
        effects=tuple(e for e in base.effects if e not in dropped),
        values={e: v for e, v in base.values.items() if e not in dropped},
    )
    sensor = put(with_neutral(before, [*effects, 'bias']), names, fitted.values)
    if fitted.history:
        sensor = put(
            sensor,
            [Coefficient(fitted.history, _SHAPES[fitted.history])],
            np.array([fitted.shape]),
        )
    joint = np.eye(len(kept) + len(names))
    biases = [Coefficient('bias', 'offset_v', axis) for axis in base.axes]
    shifts_v = [
        _zero_g_v(base, d, calibrated_c) - _zero_g_v(sensor, d, calibrated_c)
        for d in range(len(base.axes))
    ]
    for d, (axis, bias) in enumerate(zip(base.axes, biases)):
        if bias not in kept_names:
            continue
        for power, parameter in enumerate(('per_k', 'per_k2'), 1):
            column = len(kept) + names.index(Coefficient('temperature_bias', parameter, axis))
            joint[kept_names.index(bias), column] = (
                -base.scale_v_per_g[d] * (calibrated_c - NOMINAL_TEMPERATURE_C) ** power
            )
    sensor = put(sensor, biases, get(sensor, biases) + shifts_v)
    blocks = scipy.linalg.block_diag(base.covariance[np.ix_(kept, kept)], fitted.covariance)
    covariance = joint @ blocks @ joint.T
    return replace(sensor, covariance=covariance, covariance_names=(*kept_names, *names))


def _zero_g_v(sensor: Sensor, d: int, temperature_c: float) -> float:
    """Return what temperature adds to the zero-g of an axis, V."""
    values = sensor.values.get('temperature_bias')
    if values is None:
        return 0.0
    warmer_k = temperature_c - NOMINAL_TEMPERATURE_C
    return float(
        sensor.scale_v_per_g[d] * warmer_k * (values['per_k'][d] + warmer_k * values['per_k2'][d])
    )


PARTS = 10
"""Parts of the wanted range that are to be passed in each direction. Chosen: a curve of degree two
is certain between them."""
_STEADY_K = 0.25
"""Change of temperature, K, that is no change of direction. Chosen: above the noise of a
thermometer."""


@dataclass(frozen=True)
class Passed:
    """Parts of the wanted range that the temperature has passed."""

    middles_c: np.ndarray  # Middle of each part, (parts,)
    warming: np.ndarray  # Whether the temperature has passed it upwards, (parts,) bool
    cooling: np.ndarray  # The same downwards
    rises: bool  # Whether the temperature rose last

    @property
    def complete(self) -> bool:
        """Return whether all parts are passed in both directions."""
        return bool(self.warming.all() and self.cooling.all())

    def advice(self) -> str:
        """Return what to do next, for people."""
        if self.complete:
            return 'both directions are covered'
        half_c = (self.middles_c[1] - self.middles_c[0]) / 2
        warms = not self.warming.all() and (self.rises or self.cooling.all())
        parts = self.middles_c[~(self.warming if warms else self.cooling)]
        low, high = f'{parts[0] - half_c:.0f}', f'{parts[-1] + half_c:.0f}'
        return f'warm it from {low} to {high} °C' if warms else f'cool it from {high} to {low} °C'


def passed(temperatures_c: np.ndarray, range_c: tuple[float, float]) -> Passed:
    """Return which parts of a range the temperatures, in the order of time, have passed."""
    low_c, high_c = range_c
    middles_c = low_c + (high_c - low_c) * (np.arange(PARTS) + 0.5) / PARTS
    steady_c = play(np.asarray(temperatures_c, float), _STEADY_K, {})
    before_c, after_c = steady_c[:-1, None], steady_c[1:, None]
    warming = ((before_c < middles_c) & (middles_c <= after_c)).any(axis=0)
    cooling = ((after_c <= middles_c) & (middles_c < before_c)).any(axis=0)
    changes = np.diff(steady_c)
    changes = changes[changes != 0]
    rises = bool(not len(changes) or changes[-1] > 0)
    return Passed(middles_c, np.asarray(warming), np.asarray(cooling), rises)


def expected_error_mg(fit: ThermalFit, covered: Passed, calibrated_c: float) -> float:
    """
    Return the expected error of the zero-g of the worst axis at the worst part of a range.

    A part that is not passed in both directions may have a loop of typical width.
    """
    typical_g = parameter_of(Coefficient('thermal_hysteresis', 'half_width_g', 'x')).scale
    unseen_g = np.where(covered.warming & covered.cooling, 0.0, typical_g)
    error_g = np.hypot(fit.error_g(covered.middles_c, calibrated_c), unseen_g)
    return float(mg(G0_MPS2 * error_g.max()))


BLOCK_S = 10.0  # Length of a block, s. Chosen: short beside the lag of a thermometer
_FEWEST_SAMPLES = 10
"""Fewest samples of a block. Chosen: their scatter shows whether the sensor rests."""
_MOST_BLOCKS = 2000  # Largest number of blocks. Chosen: a fit of less than a second
_MOVING = 3.0
"""Scatter of a block, divided by the median of all blocks, above which the sensor moves. Chosen:
far above the scatter of a standard deviation of ten samples."""
_SAME_ORIENTATION_G = 0.1
"""Range of the block means, g, up to which a recording has one orientation. Chosen: above any
zero-g over temperature."""


def rest_blocks(recording: Recording, sensor: Sensor) -> Poses | None:
    """Cut a recording of a resting sensor into blocks with a temperature."""
    temperature_c = recording.columns.get('temperature_c')
    if temperature_c is None or not np.isfinite(temperature_c).any():
        return None
    volts = recording.volts(sensor)
    time_s = recording.time_s
    span_s = recording.span_s
    block_s = max(BLOCK_S, span_s / _MOST_BLOCKS, _FEWEST_SAMPLES * mean_period_s(time_s))
    starts_s = time_s[0] + block_s * np.arange(int(span_s / block_s) + 1)
    parts = []
    for begin, end in pairwise(np.unique(np.searchsorted(time_s, starts_s))):
        part = slice(begin, end)
        has_temperature = np.isfinite(temperature_c[part]).any()
        is_whole = end - begin >= _FEWEST_SAMPLES and np.isfinite(volts[part]).all()
        if has_temperature and is_whole:
            parts.append(part)
    if not parts:
        return None
    scatter_v = np.array([volts[p].std(axis=0) for p in parts])
    at_rest = (scatter_v <= _MOVING * np.median(scatter_v, axis=0) + sensor.lsb_v).all(axis=1)
    counts = np.array([p.stop - p.start for p in parts])[:, None]
    missing = np.full(len(parts), np.nan)
    poses = Poses(
        volts=np.array([volts[p].mean(axis=0) for p in parts]),
        std_v=scatter_v / np.sqrt(counts),
        alpha_rad=missing,
        beta_rad=missing,
        time_s=np.array([[time_s[p.start], time_s[p.stop - 1]] for p in parts]),
        check=np.zeros(len(parts), bool),
        temperature_c=np.array([np.nanmean(temperature_c[p]) for p in parts]),
    ).subset(at_rest)
    if not len(poses):
        return None
    range_g = np.ptp(poses.volts, axis=0) / sensor.nominal_scale_v_per_g
    return poses if np.max(range_g) < _SAME_ORIENTATION_G else None


def calibrated_temperature_c(base: Sensor) -> float:
    """Return the temperature at which a sensor was calibrated, °C; else that of the datasheet."""
    range_c = base.envelope.temperature_c
    return float(np.mean(range_c)) if range_c else NOMINAL_TEMPERATURE_C
