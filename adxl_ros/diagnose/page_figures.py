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
"""Figures of the page of a diagnosis, as plotly.js draws them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from adxl_ros.diagnose.baseline_comparison import BaselineComparison
from adxl_ros.diagnose.diagnosis import Diagnosis
from adxl_ros.diagnose.effect_proof import Curve, EffectProof, spectra
from adxl_ros.diagnose.report_json import shares_of_gap
from adxl_ros.diagnose.report_wording import mg, mg_text, percent, range_text
from adxl_ros.diagnose.residual_map import RANGES, ResidualCell, SIGNIFICANT_P
from adxl_ros.files.plotly_figures import (
    AFTER_COLOUR,
    AXIS_COLOURS,
    axis_number,
    BEFORE_COLOUR,
    extremes,
    Figure,
    figure,
    line,
    log_axis,
    points,
    QUIET_COLOUR,
    rounded,
)
from adxl_ros.model import noise
from adxl_ros.model.constants import G0_MPS2
from adxl_ros.model.sensor import Sensor
import numpy as np

_ROW = 38
"""Height of a row of the waterfall, pixels."""
_EFFECT_COLOUR = '#5b8fd6'
"""Colour of an effect in the waterfall."""
_PLOTTED_POINTS = 3000
"""Largest number of points of a line. Chosen: more than a wide screen has columns."""
_CURVE_COLOURS = {'recorded': '#1f2933', 'without the effect': BEFORE_COLOUR,
                  'with the effect': AFTER_COLOUR}
"""Colours of the curves of a proof."""
_IN_DEGREES = ('alpha_rad', 'beta_rad', 'rate_rad_s')
"""Dimensions of the map that people read in degrees."""
_DIMENSIONS = {
    'time_s': 'time, s', 'alpha_rad': 'alpha, °', 'beta_rad': 'beta, °', 'rate_rad_s': 'rate, °/s',
    'force_x_g': 'force along x, g', 'force_y_g': 'force along y, g',
    'force_z_g': 'force along z, g', 'direction_alpha': 'direction of alpha',
    'direction_beta': 'direction of beta', 'since_move_s': 'time since move, s',
    'temperature_c': 'temperature, °C', 'supply_v': 'supply, V'}
"""Dimensions of the map in words."""


def waterfall(diagnosis: Diagnosis) -> Figure:
    """Draw the gap, what each effect takes off it, what stays, and the noise floor."""
    assert diagnosis.gap_closure is not None
    closure, noisy = diagnosis.gap_closure, bool(diagnosis.noise_remainders)
    before, after, floor = (mg(v) for v in (closure.before_mps2, closure.after_mps2,
                                            closure.floor_mps2))
    shares = sorted(shares_of_gap(diagnosis).items(), key=lambda item: -item[1])
    steps = [(name, share) for name, share in shares if share > 0]
    labels, base, width, text = ['gap'], [0.0], [before], [mg_text(closure.before_mps2)]
    level = before
    for name, share in steps:
        lower = float(np.sqrt(max(level ** 2 - share * (before ** 2 - floor ** 2), 0.0)))
        labels.append(name)
        base.append(lower)
        width.append(level - lower)
        text.append(f'{percent(share, noisy)} %')
        level = lower
    if steps:
        labels.append('what is left')
        base.append(0.0)
        width.append(after)
        text.append(mg_text(closure.after_mps2))
    labels.append('noise floor')
    base.append(0.0)
    width.append(floor)
    text.append(mg_text(closure.floor_mps2))
    colours = [BEFORE_COLOUR, *[_EFFECT_COLOUR] * len(steps),
               *[AFTER_COLOUR] * bool(steps), QUIET_COLOUR]
    bars = {'type': 'bar', 'width': 0.62, 'orientation': 'h', 'y': labels, 'x': rounded(width),
            'base': rounded(base), 'text': text, 'textposition': 'outside', 'cliponaxis': False,
            'marker': {'color': colours}, 'hovertemplate': '%{y}: %{text}<extra></extra>',
            'showlegend': False}
    return figure([bars], 60 + _ROW * len(labels),
                  xaxis={'title': {'text': 'rms, mg'},
                         'range': [0, 1.2 * max(before, after, floor)]},
                  yaxis={'autorange': 'reversed', 'ticks': '', 'type': 'category'})


def proof(evidence: EffectProof) -> Figure:
    """Draw the proof of one effect."""
    return _binned_proof(evidence) if evidence.binned else _curve_proof(evidence)


def _binned_proof(evidence: EffectProof) -> Figure:
    """Draw the means over ranges of the variable, and the line of the model."""
    traces = []
    for binned in evidence.binned:
        colour = AXIS_COLOURS[binned.axis]
        order = np.argsort(binned.variable)
        traces += [points(binned.variable, binned.residual_mg, binned.half_width_mg,
                          f'{binned.axis} recorded', colour),
                   line(binned.variable[order], binned.model_mg[order],
                        f'{binned.axis} model', colour)]
    return figure(traces, 300, xaxis={'title': {'text': evidence.variable}},
                  yaxis={'title': {'text': 'recording minus simulation, mg'}},
                  margin={'l': 8, 'r': 12, 't': 36, 'b': 8})


def _curve_proof(evidence: EffectProof) -> Figure:
    """Draw spectra or histograms, one panel for each axis."""
    axes = list(dict.fromkeys(curve.axis for curve in evidence.curves))
    unit = 'mg/√Hz' if evidence.is_spectrum else 'samples'
    return _panels(evidence.curves, axes, evidence.variable, unit, evidence.is_spectrum)


def _panels(curves: Sequence[Curve], axes: Sequence[str], title: str, unit: str, is_log: bool,
            colours: Mapping[str, str] = _CURVE_COLOURS) -> Figure:
    """Draw curves in one panel for each axis, below each other."""
    traces, layout = [], {}
    for number, axis in enumerate(axes, 1):
        for curve in curves:
            if curve.axis == axis:
                positive = curve.y > 0
                traces.append(line(
                    curve.x[positive], curve.y[positive], curve.label, colours[curve.label],
                    xaxis='x', yaxis=axis_number('y', number), legendgroup=curve.label,
                    showlegend=number == 1))
        layout[axis_number('yaxis', number)] = {
            'title': {'text': f'{axis}, {unit}'}, 'domain': _domain(number, len(axes)),
            **log_axis(np.concatenate([c.y for c in curves if c.axis == axis]))}
    return figure(traces, 60 + 190 * len(axes), hovermode='closest',
                  margin={'l': 8, 'r': 12, 't': 36, 'b': 8},
                  xaxis={'title': {'text': title}, 'anchor': axis_number('y', len(axes)),
                         **(log_axis(curves[0].x) if is_log else {})}, **layout)


def _domain(number: int, count: int) -> list[float]:
    """Return the vertical range of a panel, from the top; there is a gap between panels."""
    height = (1 + 0.08) / count - 0.08
    top = 1 - (number - 1) * (height + 0.08)
    return [max(top - height, 0.0), top]


def signals(comparison: BaselineComparison, after: Sensor) -> Figure:
    """
    Draw recording and simulation, and their difference, before and after, with linked zoom.

    Parameters
    ----------
    comparison
        The recording beside the baseline.
    after
        The baseline with the effects of the verdict.

    Returns
    -------
    dict
        The figure: two panels for each axis.

    """
    time_s = comparison.time_s - comparison.time_s[0]
    scale = comparison.scale_v_per_mps2
    before_mg = mg(comparison.residual_v(comparison.sensor) / scale)
    after_mg = mg(comparison.residual_v(after) / scale)
    recorded_g = (comparison.volts - comparison.sensor.zero_g_v) / scale / G0_MPS2
    axes, traces, layout = comparison.sensor.axes, [], {}
    for d, axis in enumerate(axes):
        panels = (
            (f'{axis}, g', {'recording': (recorded_g[:, d], '#1f2933'),
                            'simulation before': (recorded_g[:, d] - before_mg[:, d] / 1e3,
                                                  BEFORE_COLOUR),
                            'simulation after': (recorded_g[:, d] - after_mg[:, d] / 1e3,
                                                 AFTER_COLOUR)}),
            (f'difference {axis}, mg', {'difference before': (before_mg[:, d], BEFORE_COLOUR),
                                        'difference after': (after_mg[:, d], AFTER_COLOUR)}))
        for part, (label, lines) in enumerate(panels):
            number = 2 * d + part + 1
            for name, (values, colour) in lines.items():
                chosen = extremes(values, _PLOTTED_POINTS)
                traces.append(line(time_s[chosen], values[chosen], name, colour, xaxis='x',
                                   yaxis=axis_number('y', number), legendgroup=name,
                                   showlegend=d == 0, opacity=0.8))
            layout[axis_number('yaxis', number)] = {
                'title': {'text': label}, 'domain': _domain(number, 2 * len(axes)), 'nticks': 5}
    return figure(traces, 80 + 150 * 2 * len(axes), margin={'l': 8, 'r': 12, 't': 60, 'b': 8},
                  xaxis={'title': {'text': 'time, s'},
                         'anchor': axis_number('y', 2 * len(axes))}, **layout)


def gap_spectrum(comparison: BaselineComparison, after: Sensor) -> Figure:
    """
    Draw the spectrum of the gap before and after, and the stated noise.

    Parameters
    ----------
    comparison
        The recording beside the baseline, at its full rate.
    after
        The baseline with the effects of the verdict.

    Returns
    -------
    dict
        The figure: one panel for each axis.

    """
    curves = [*spectra(comparison, comparison.residual_v(comparison.sensor), 'before'),
              *spectra(comparison, comparison.residual_v(after), 'after')]
    frequency_hz = curves[0].x
    scale = comparison.scale_v_per_mps2
    stated = mg(np.sqrt(noise.density_v2_per_hz(comparison.sensor, frequency_hz)) / scale)
    curves += [Curve(axis, 'stated noise', frequency_hz, stated[:, d])
               for d, axis in enumerate(comparison.sensor.axes)]
    return _panels(curves, comparison.sensor.axes, 'frequency, Hz', 'mg/√Hz', True,
                   {'before': BEFORE_COLOUR, 'after': AFTER_COLOUR, 'stated noise': QUIET_COLOUR})


def residual_map(cells: Sequence[ResidualCell]) -> Figure:
    """Draw the mean residual over ranges of all dimensions; significant cells have a dot."""
    means = [cell for cell in cells if cell.statistic == 'mean']
    rows = sorted({(cell.dimension, cell.axis) for cell in means})
    labels = [f'{_DIMENSIONS.get(name, name)}: {axis}' for name, axis in rows]
    values: list[list[float | None]] = []
    words: list[list[str]] = []
    marks: list[tuple[int, str]] = []
    for label, row in zip(labels, rows):
        in_row = sorted((c for c in means if (c.dimension, c.axis) == row), key=lambda c: c.low)
        empty = RANGES - len(in_row)
        values.append([*rounded([mg(c.mean_mps2) for c in in_row]), *[None] * empty])
        words.append([*(_range_words(c) for c in in_row), *[''] * empty])
        marks += [(i, label) for i, c in enumerate(in_row) if c.p < SIGNIFICANT_P]
    largest = float(max((abs(mg(c.mean_mps2)) for c in means), default=1.0))
    heat = {'type': 'heatmap', 'y': labels, 'x': list(range(RANGES)), 'z': values, 'text': words,
            'hovertemplate': '%{y}: %{text}<br>mean %{z:.3~g} mg<extra></extra>',
            'colorscale': 'RdBu', 'reversescale': False, 'zmin': -largest, 'zmax': largest,
            'xgap': 2, 'ygap': 2, 'colorbar': {'title': {'text': 'mg'}, 'thickness': 12}}
    dots = {'type': 'scatter', 'mode': 'markers', 'x': [i for i, _ in marks],
            'y': [label for _, label in marks], 'hoverinfo': 'skip', 'showlegend': False,
            'marker': {'color': '#1f2933', 'size': 5}}
    return figure([heat, dots], 80 + 22 * len(rows),
                  xaxis={'showticklabels': False, 'showgrid': False, 'zeroline': False,
                         'title': {'text': 'parts of the range, ascending'}},
                  yaxis={'type': 'category', 'showgrid': False, 'dtick': 1})


def _range_words(cell: ResidualCell) -> str:
    """Return the range of a cell in the unit that people read."""
    factor = float(np.degrees(1.0)) if cell.dimension in _IN_DEGREES else 1.0
    return range_text(factor * cell.low, factor * cell.high)
