# SPDX-License-Identifier: Apache-2.0
"""
The proof of an effect: how it shows in a recording.

It is the recording minus a simulation with all other effects, over the effect's own variable, or
spectra with and without it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, TYPE_CHECKING

from adxl_ros.diagnose.comparison import BaselineComparison
from adxl_ros.diagnose.residual_map import BLOCK_S
from adxl_ros.model import noise
from adxl_ros.model.constants import AXES, Z_90
from adxl_ros.model.effects import effect_named
from adxl_ros.model.effects.base import ActsOn, ProofVariable as Over
from adxl_ros.model.filters import low_pass
from adxl_ros.model.sensor import Sensor, with_neutral
from adxl_ros.report import figures as plots
from adxl_ros.report.figures import Figure, figure, line
from adxl_ros.report.quantities import mg
from adxl_ros.signals.block_statistics import bridged
import numpy as np
import scipy

if TYPE_CHECKING:
    from adxl_ros.diagnose.diagnosis import Diagnosis, Report

_BINS = 10
"""Ranges of equal width, and of equal counts, of a proof. Chosen: a curve is visible."""
_FEWEST_SAMPLES = 20  # Fewest samples of a range. Chosen: a mean is worth a point
_RATE_S = 20.0
"""Time over which a temperature changes, s. Chosen: beyond the noise of a thermometer."""
_SMALLEST_SHARE = 0.5
"""Share of the effect's variance that the variable must show. Chosen: half of it."""
_CONTRIBUTION = 'what the model of the effect predicts, mg'
"""Variable of an effect that none of its own variables shows."""
_SEGMENT = 4096  # Samples in a segment of a spectrum. Chosen: 0.06 Hz at 250 Hz
_POINTS_PER_OCTAVE = 12  # Points of its plot in an octave. Chosen: lines stay visible
INK = '#1f2933'
_CURVE_COLOURS = (
    {'recorded': INK, 'stated noise': plots.QUIET_COLOUR}
    | dict.fromkeys(('before', 'without the effect'), plots.BEFORE_COLOUR)
    | dict.fromkeys(('after', 'with the effect'), plots.AFTER_COLOUR)
)
_OVER_JOINTS = (
    (Over.ALPHA, Over.BETA),
    (Over.ALPHA_RATE, Over.BETA_RATE),
    (Over.ALPHA_ACCELERATION, Over.BETA_ACCELERATION),
)
"""Angles of both joints, and their derivatives by order."""
WIDE = {'l': 8, 'r': 12, 't': 36, 'b': 8}  # Margins of a plot with a legend, pixels


class Proof(NamedTuple):
    """How an effect shows in a recording."""

    effect: str  # Its name
    figure: Figure
    text: str  # What the figure shows, in a sentence


def proofs_of(diagnosis: Diagnosis, report: Report, effects: Sequence[str]) -> list[Proof]:
    """Return the proof of each effect that has one."""
    in_noise = {d.effect for d in report.detections} & {*report.sensor.effects}
    proofs = []
    for name in effects:
        sensors = [h.sensor for h in report.hypotheses if name in h.effects]
        if name in in_noise:
            sensors = [report.sensor]
        is_step = Over.STEP in effect_named(name).diagnosis.proof
        if sensors and not is_step:
            proofs.append(_proof(name, diagnosis, sensors[0]))
    return proofs


def _proof(effect: str, diagnosis: Diagnosis, sensor: Sensor) -> Proof:
    """Show an effect of a sensor, which has all effects of the verdict, in the first recording."""
    comparison = diagnosis.comparisons[0]
    full_rate = diagnosis.full_rate[0]
    described = effect_named(effect)
    variables = described.diagnosis.proof
    neutral = with_neutral(comparison.sensor, [effect]).values[effect]
    without = replace(sensor, values={**sensor.values, effect: neutral})
    labelled = {'without the effect': without, 'with the effect': sensor}
    if described.acts_on is ActsOn.NOISE:
        noise_v = {label: full_rate.simulated_noise_v(s, 0) for label, s in labelled.items()}
        drawn = spectra(full_rate, {'recorded': full_rate.residual_v(sensor), **noise_v})
        text = (
            'The effect is there if the recorded spectrum follows the green line, not the red one.'
        )
    elif Over.FREQUENCY in variables:
        drawn = spectra(
            full_rate, {label: full_rate.residual_v(s) for label, s in labelled.items()}
        )
        text = 'The effect is there if the spectrum of the difference falls from red to green.'
    else:
        drawn = _binned(variables, comparison, sensor, without)
        text = (
            'Points: recording minus a simulation with all other effects, with 90 % bars. '
            'Line: the model of this effect.'
        )
    return Proof(effect, drawn, text)


def _binned(
    variables: Sequence[Over], comparison: BaselineComparison, sensor: Sensor, without: Sensor
) -> Figure:
    """Draw means of the residual without an effect over the variable that shows it best."""
    used = comparison.used
    to_mg = mg(1 / comparison.scale_v_per_mps2)
    residual_mg = (comparison.residual_v(without) * to_mg)[used]
    model_mg = residual_mg - (comparison.residual_v(sensor) * to_mg)[used]
    label = _CONTRIBUTION
    values = model_mg
    largest = _SMALLEST_SHARE
    for variable, of_axes in _variables(comparison).items():
        if variable in variables:
            share = _shown_share(of_axes[used], model_mg)
            if share > largest:
                label = variable.value
                values = of_axes[used]
                largest = share
    block = np.flatnonzero(used) // max(round(BLOCK_S * comparison.sensor.rate_hz), 1)
    traces = []
    for d, axis in enumerate(comparison.sensor.axes):
        means = _means_by_range(values[:, d], residual_mg[:, d], model_mg[:, d], block)
        colour = plots.AXIS_COLOURS[axis]
        traces += [
            plots.points(means.x, means.recorded, means.half, f'{axis} recorded', colour),
            line(means.x, means.model, f'{axis} model', colour),
        ]
    return figure(
        traces,
        300,
        xaxis={'title': {'text': label}},
        margin=WIDE,
        yaxis={'title': {'text': 'recording minus simulation, mg'}},
    )


def _shown_share(values: np.ndarray, model_mg: np.ndarray) -> float:
    """Return the share of a model's squares between the ranges of a variable, (n, m) each."""
    import pandas as pd

    between = [
        (pd.Series(m).groupby(_places(v)).transform('mean') ** 2).sum()
        for v, m in zip(values.T, model_mg.T)
    ]
    return float(sum(between) / max(np.sum(model_mg**2), 1e-300))


def _means_by_range(
    values: np.ndarray, residual_mg: np.ndarray, model_mg: np.ndarray, block: np.ndarray
) -> Any:
    """
    Return a table of the means of one axis by range of a variable, (n,) each.

    Its columns are `x`, `recorded`, `model` and `half`, half of the 90 % interval, mg.
    """
    import pandas as pd

    place = _places(values)
    groups = pd.DataFrame({'x': values, 'recorded': residual_mg, 'model': model_mg}).groupby(place)
    means = groups.mean()
    count = groups.size()
    # The noise is correlated, so that the sums of whole blocks give the error of a mean.
    noise_mg = residual_mg - model_mg - (means.recorded - means.model)[place].to_numpy()
    squares = pd.Series(noise_mg).groupby([place, block]).sum() ** 2
    means['half'] = Z_90 * np.sqrt(squares.groupby(level=0).sum()) / count
    return means[count >= min(_FEWEST_SAMPLES, count.max())].sort_values('x')


def _places(values: np.ndarray) -> np.ndarray:
    """Return the range of each value, (n,); quantiles and equal widths divide the ranges."""
    shares = np.linspace(0, 1, _BINS + 1)
    low, high = float(values.min()), float(values.max())
    edges = np.unique([*np.quantile(values, shares), *(low + (high - low) * shares)])
    return np.clip(np.searchsorted(edges, values, 'right') - 1, 0, max(len(edges) - 2, 0))


def _variables(comparison: BaselineComparison) -> dict[Over, np.ndarray]:
    """Return the variables that are known at the samples of each axis, (n, m) each."""
    time_s = comparison.time_s
    axes = comparison.sensor.axes
    of_all = {Over.TIME: time_s - time_s[0]}
    surroundings = comparison.surroundings
    if 'temperature_c' in surroundings:
        temperature_c = surroundings['temperature_c']
        late_k = temperature_c - low_pass(temperature_c, _RATE_S, comparison.dt_s, {})
        of_all[Over.TEMPERATURE] = temperature_c
        of_all[Over.TEMPERATURE_RATE] = late_k * 60 / _RATE_S
    if 'supply_v' in surroundings:
        of_all[Over.SUPPLY] = surroundings['supply_v']
    if comparison.joints:
        for order, names in enumerate(_OVER_JOINTS):
            of_all |= dict(zip(names, np.degrees(comparison.joint_values(order))))
        of_all[Over.BETA] %= 360
    of_axes = {Over.OUTPUT: comparison.volts}
    force_g = comparison.reference_force_g()
    if force_g is not None:
        own = force_g[comparison.sensor.axis_indices].T
        # Across x is y; across y and z it is x.
        across = [1 if axis == AXES[0] else 0 for axis in axes]
        of_axes[Over.OWN_FORCE] = own
        of_axes[Over.FORCE_RATE] = np.gradient(own, time_s, axis=0)
        of_axes[Over.CROSS_FORCE] = force_g[across].T
        of_all[Over.FORCE_Z] = force_g[2]
    return of_axes | {name: np.repeat(v[:, None], len(axes), axis=1) for name, v in of_all.items()}


def spectra(comparison: BaselineComparison, signals_v: Mapping[str, np.ndarray]) -> Figure:
    """
    Draw spectra of signals, V, (n, m), and the stated noise, in one panel for each axis.

    Points are equally dense per octave.
    """
    import pandas as pd

    sensor = comparison.sensor
    scale = comparison.scale_v_per_mps2
    densities = {}
    for label, signal_v in signals_v.items():
        signal_mg = np.nan_to_num(mg(bridged(signal_v, comparison.used) / scale))
        all_hz, power = scipy.signal.welch(
            signal_mg, sensor.rate_hz, axis=0, nperseg=min(_SEGMENT, len(signal_mg))
        )
        octave = np.floor(np.log2(all_hz[1:] / all_hz[1]) * _POINTS_PER_OCTAVE)
        hz = pd.Series(all_hz[1:]).groupby(octave).mean().to_numpy()
        densities[label] = np.sqrt(pd.DataFrame(power[1:]).groupby(octave).mean().to_numpy())
    densities['stated noise'] = mg(np.sqrt(noise.density_v2_per_hz(sensor, hz)) / scale)
    panels = []
    for d, axis in enumerate(sensor.axes):
        curves = {label: np.where(v[:, d] > 0, v[:, d], np.nan) for label, v in densities.items()}
        panels.append(
            (
                {'title': {'text': f'{axis}, mg/√Hz'}, 'type': 'log'},
                [line(hz, v, label, _CURVE_COLOURS[label]) for label, v in curves.items()],
            )
        )
    return stacked(
        panels,
        60 + 190 * len(panels),
        WIDE,
        {'title': {'text': Over.FREQUENCY.value}, 'type': 'log'},
    )


def stacked(
    panels: Sequence[tuple[dict[str, Any], Sequence[Figure]]],
    height: int,
    margin: dict[str, int],
    xaxis: dict[str, Any],
) -> Figure:
    """Put panels, an axis with its lines each, below each other; all zoom together."""
    traces: list[Figure] = []
    layout = {'xaxis': {'anchor': plots.axis_number('y', len(panels)), **xaxis}}
    part = 1.08 / len(panels)
    for i, (axis, lines) in enumerate(panels):
        layout[plots.axis_number('yaxis', i + 1)] = {
            'domain': [max(1.08 - (i + 1) * part, 0.0), 1 - i * part],
            **axis,
        }
        traces += [
            {
                **drawn,
                'xaxis': 'x',
                'yaxis': plots.axis_number('y', i + 1),
                'legendgroup': drawn['name'],
                'showlegend': not any(t['name'] == drawn['name'] for t in traces),
            }
            for drawn in lines
        ]
    return figure(traces, height, margin=margin, **layout)
