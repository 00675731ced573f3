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

"""The diagnosis as one HTML page that opens offline."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Sequence
from html import escape
from io import BytesIO
from itertools import pairwise
from typing import Any

from adxl_ros.diagnose.diagnosis import Diagnosis
from adxl_ros.diagnose.hypothesis_fit import Hypothesis
from adxl_ros.diagnose.report_json import (
    as_json,
    not_determined_text,
    notes,
    p_text,
    shares_of_gap,
    summary,
    unit_text,
)
from adxl_ros.diagnose.residual_map import RANGES, SIGNIFICANT_P
from adxl_ros.files.plot_file import pyplot
from adxl_ros.model.constants import G0_MPS2
import numpy as np
from scipy.signal import welch

_STYLE = """
body{font:15px/1.45 system-ui,sans-serif;max-width:1000px;margin:2em auto;padding:0 1em;color:#222}
h1{font-size:1.3em}h2{font-size:1.1em;margin-top:2em;border-bottom:1px solid #ccc}
table{border-collapse:collapse;width:100%;font-size:13px}td,th{padding:.25em .6em;
border-bottom:1px solid #ddd;text-align:left;vertical-align:top}img{width:100%}
.verdict{background:#eef4fb;border-left:5px solid #36c;padding:.8em 1em;font-size:1.1em}
code{background:#f3f3f3;padding:.1em .3em}@media print{body{margin:0}h2{break-after:avoid}}
"""
_PLOTTED_SAMPLES = 20_000
"""Largest number of samples in a plot. Chosen: the page stays small."""
_SPECTRUM_SAMPLES = 2048
"""Samples in a segment of a spectrum. Chosen: 0.06 Hz at 125 Hz."""
_LEGEND_COLUMNS = 4
"""Columns of a legend below a plot. Chosen: four names of effects fit beside each other."""
_TABLE_ROWS = 10
"""Rows of the tables of hypotheses and candidates. Chosen: others are improbable."""
_CELL_ROWS = 12
"""Rows of the table of cells. Chosen: the map above it shows all."""


def page(diagnosis: Diagnosis, title: str) -> str:
    """
    Lay out the page.

    Parameters
    ----------
    diagnosis
        The diagnosis.
    title
        Names of the recordings.

    Returns
    -------
    str
        The page, HTML.

    """
    parts = [f'<h1>{escape(title)}</h1>', f'<p class="verdict">{escape(summary(diagnosis))}</p>',
             *(f'<p>{escape(note)}</p>' for note in notes(diagnosis))]
    if diagnosis.data_fault is None and diagnosis.verdict is not None:
        report = as_json(diagnosis)
        parts += ['<h2>How far the gap closes</h2>', _image(_bar_plot(diagnosis)),
                  '<h2>Recording minus simulation, before and after</h2>',
                  _image(_residual_plot(diagnosis)),
                  '<h2>Recorded noise divided by simulated noise</h2>', _noise_table(report),
                  '<h2>Where the gap lies</h2>', _image(_map_plot(diagnosis)),
                  _cell_table(report), _not_covered(report['not_covered']),
                  '<h2>Which effects cause it</h2>', _hypothesis_table(report),
                  _convergence(diagnosis.verdict.best), _candidate_table(report),
                  '<h2>What to record next</h2>',
                  _next_experiment(report)]
    return (f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}'
            f'</title><style>{_STYLE}</style></head><body>{"".join(parts)}</body></html>\n')


def _image(plot: Any) -> str:
    """Return a plot as an image within the page."""
    out = BytesIO()
    plot.savefig(out, dpi=100, format='png', metadata={'Software': None})
    pyplot().close(plot)
    return f'<img alt="" src="data:image/png;base64,{b64encode(out.getvalue()).decode()}">'


def _mg(value_mps2: Any) -> Any:
    """Convert m/s² to mg."""
    return 1e3 * value_mps2 / G0_MPS2


def _bar_plot(diagnosis: Diagnosis) -> Any:
    """Draw the mean square of the gap: noise floor, share of each effect, and the rest."""
    assert diagnosis.gap_closure is not None
    closure = diagnosis.gap_closure
    floor = _mg(closure.floor_mps2) ** 2
    after = max(floor, _mg(closure.after_mps2) ** 2)
    before = max(after, _mg(closure.before_mps2) ** 2)
    widths = {'noise floor': floor, 'not closed': after - floor} | {
        effect: share * (before - floor) for effect, share in shares_of_gap(diagnosis).items()}
    if sum(widths.values()) < before:
        widths['not explained'] = before - sum(widths.values())
    plot, axis = pyplot().subplots(figsize=(10, 2.4), layout='constrained')
    begin = 0.0
    for i, (label, width) in enumerate(widths.items()):
        axis.barh(0, width, left=begin, color='#999' if label == 'noise floor' else f'C{i + 1}',
                  label=f'{label}: {width:.3g} mg²')
        begin += width
    for label, square, side, offset in (('after', after, 'right', -3),
                                        ('before', before, 'left', 3)):
        axis.axvline(square, color='k', lw=0.8)
        axis.annotate(f'{label} {np.sqrt(square):.3g} mg', (square, 0.6), ha=side, fontsize=8,
                      xytext=(offset, 0), textcoords='offset points')
    axis.set(yticks=[], ylim=(-0.4, 1.0), xlabel='mean square on held-out blocks, mg²')
    plot.legend(fontsize=8, ncols=_LEGEND_COLUMNS, loc='outside lower center', frameon=False)
    axis.spines[['top', 'right', 'left']].set_visible(False)
    return plot


def _residual_plot(diagnosis: Diagnosis) -> Any:
    """Draw the residual of the first recording over time, and its spectrum, before and after."""
    assert diagnosis.verdict is not None
    comparison = diagnosis.comparisons[0]
    residuals = (('before', '#c44', comparison.residual_v(comparison.sensor)),
                 ('after', '#484', comparison.residual_v(diagnosis.verdict.best.sensor)))
    axes = comparison.sensor.axes
    plot, grid = pyplot().subplots(len(axes), 2, figsize=(12, 2.6 * len(axes)),
                                   layout='constrained', squeeze=False, width_ratios=(2, 1))
    every = max(len(comparison) // _PLOTTED_SAMPLES, 1)
    for d, (over_time, spectrum) in enumerate(grid):
        for label, colour, residual_v in residuals:
            mg = _mg(residual_v[:, d] / comparison.scale_v_per_mps2[d])
            over_time.plot(comparison.time_s[::every], mg[::every], lw=0.5, color=colour,
                           label=label)
            frequency_hz, power = welch(np.nan_to_num(mg), comparison.sensor.rate_hz,
                                        nperseg=min(_SPECTRUM_SAMPLES, len(mg)))
            spectrum.loglog(frequency_hz[1:], np.sqrt(power[1:]), lw=1, color=colour)
        over_time.set(ylabel=f'{axes[d]}, mg')
        spectrum.set(ylabel='mg/√Hz')
    grid[0, 0].legend(loc='upper right', fontsize=8)
    grid[-1, 0].set(xlabel='time, s')
    grid[-1, 1].set(xlabel='frequency, Hz')
    return plot


def _map_plot(diagnosis: Diagnosis) -> Any:
    """Draw the mean residual of all cells; significant cells have a frame."""
    cells = [c for c in diagnosis.residual_cells if c.statistic == 'mean']
    rows = sorted({(c.dimension, c.axis) for c in cells})
    largest_mg = _mg(max((abs(c.mean_mps2) for c in cells), default=G0_MPS2 / 1e3))
    plot, axis = pyplot().subplots(figsize=(10, 0.8 + 0.24 * len(rows)), layout='constrained')
    drawn = None
    for i, row in enumerate(rows):
        in_row = sorted((c for c in cells if (c.dimension, c.axis) == row), key=lambda c: c.low)
        drawn = axis.scatter(
            np.arange(len(in_row)), np.full(len(in_row), i), marker='s', s=180,
            c=[_mg(c.mean_mps2) for c in in_row], cmap='RdBu_r', vmin=-largest_mg,
            vmax=largest_mg, edgecolors=['k' if c.p < SIGNIFICANT_P else 'none' for c in in_row])
        axis.text(RANGES, i, f'{in_row[0].low:.4g} to {in_row[-1].high:.4g}', fontsize=8,
                  va='center')
    axis.set(yticks=range(len(rows)), xticks=[], xlim=(-0.5, RANGES + 2),
             xlabel=f'parts of the range, ascending; frame: family-wise p < {SIGNIFICANT_P:g}')
    axis.set_yticklabels([f'{dimension}  {name}' for dimension, name in rows], fontsize=8)
    if drawn is not None:
        plot.colorbar(drawn, label='mean residual, mg', shrink=0.6)
    return plot


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table, or "None." where it has no rows."""
    if not rows:
        return '<p>None.</p>'
    top = ''.join(f'<th>{escape(h)}</th>' for h in head)
    return f'<table><tr>{top}</tr>{"".join(map(_row, rows))}</table>'


def _row(cells: Sequence[str]) -> str:
    """Return a row of a table."""
    return f'<tr>{"".join(f"<td>{escape(c)}</td>" for c in cells)}</tr>'


def _cell_table(report: dict[str, Any]) -> str:
    """Return the significant cells with the largest shares."""
    rows = []
    for c in report['where'][:_CELL_ROWS]:
        low, high = c['range']
        rows.append([c['axis'], c['dimension'], c['statistic'], f'{low:.4g} to {high:.4g}',
                     f'{_mg(c["mean"]):+.2f}', f'{c["floor_units"]:+.1f}',
                     f'{100 * c["share"]:.1f} %', p_text(c['p'])])
    return _table(['axis', 'dimension', 'statistic', 'range', 'size, mg', 'size / noise floor',
                   'share of the squares', 'family-wise p'], rows)


def _noise_table(report: dict[str, Any]) -> str:
    """Return ratios of recorded and simulated noise, before and after."""
    rows = []
    for noise in report['gap']['noise']:
        names = [f'{low:.3g} to {high:.3g} Hz' for low, high in pairwise(noise['bands_hz'])]
        names += [f'Allan deviation at {t:g} s' for t in noise['allan_s']]
        before, after = ([*noise[f'power_ratio_{when}'], *noise[f'allan_ratio_{when}']]
                         for when in ('before', 'after'))
        rows += [[name, f'{b:.2f}', f'{a:.2f}'] for name, b, a in zip(names, before, after)]
        rows.append(['gain of log likelihood', '', f'{noise["log_likelihood_gain"]:.0f}'])
    return _table(['quantity, recorded divided by simulated', 'before', 'after'], rows)


def _hypothesis_table(report: dict[str, Any]) -> str:
    """Return the most probable hypotheses."""
    return _table(['hypothesis', 'probability'], [
        [', '.join(h['effects']) or 'no gap', p_text(h['probability'])]
        for h in report['hypotheses'][:_TABLE_ROWS]])


def _convergence(best: Hypothesis) -> str:
    """Return a warning where the fit of the best hypothesis has not converged."""
    if best.converged:
        return ''
    return ('<p>The fit of the most probable hypothesis has not converged. Its parameters may be '
            'less accurate than their intervals.</p>')


def _candidate_table(report: dict[str, Any]) -> str:
    """Return the most probable effects with their parameters."""
    rows = []
    for c in report['candidates'][:_TABLE_ROWS]:
        parameters = '; '.join(_parameter_text(name, p) for name, p in c['parameters'].items())
        rows.append([c['effect'], p_text(c['probability']), parameters,
                     ', '.join(c['inseparable_from']), c['cause']])
    return _table(['effect', 'probability', 'parameters (90 % interval)', 'inseparable from',
                   'cause'], rows)


def _parameter_text(name: str, parameter: dict[str, Any]) -> str:
    """Return a parameter with its interval, if it has one, as text."""
    if not parameter.get('determined', True):
        return f'{name}: {not_determined_text(parameter)}'
    if 'ci' not in parameter:
        return f'{name} = {parameter["value"]}'
    low, high = parameter['ci']
    return f'{name} = {parameter["value"]:.4g} ({low:.3g} to {high:.3g}) {unit_text(parameter)}'


def _not_covered(names: Sequence[str]) -> str:
    """Return what the recordings do not cover."""
    return f'<p>Not covered by these recordings: {escape(", ".join(names))}.</p>' if names else ''


def _next_experiment(report: dict[str, Any]) -> str:
    """Return the inseparable groups, and the manoeuvre that is proposed."""
    groups = ''.join(f'<p>These recordings cannot separate {escape(" from ".join(group))}.</p>'
                     for group in report['verdict']['groups'])
    proposal = report['next_experiment']
    if proposal is None:
        return f'{groups}<p>No further recording is needed.</p>'
    menu = '' if not proposal['menu'] else _table(
        ['manoeuvre', 'minutes', 'log Bayes factor per minute'], [
            [m['manoeuvre'], f'{m["minutes"]:.1f}', f'{m["nats_per_minute"]:.1f}']
            for m in proposal['menu']])
    return (f'{groups}<p>{escape(proposal["manoeuvre"])}, {escape(proposal["why"])}.</p>'
            f'<p><code>{escape(proposal["command"])}</code></p>{menu}')
