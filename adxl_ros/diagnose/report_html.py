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
from itertools import compress, pairwise
from typing import Any

from adxl_ros.diagnose.diagnosis import Diagnosis
from adxl_ros.diagnose.hypothesis_fit import Hypothesis
from adxl_ros.diagnose.report_json import as_json, notes, PROBABLE, shares_of_gap
from adxl_ros.diagnose.report_wording import (
    gap_rows,
    headline,
    mg,
    mg_text,
    p_text,
    parameter_text,
    percent,
    range_text,
    remainder_rows,
    Row,
    tiles,
)
from adxl_ros.diagnose.residual_map import RANGES, SIGNIFICANT_P
from adxl_ros.files.plot_file import pyplot
from adxl_ros.model.constants import G0_MPS2
import numpy as np
from scipy.signal import welch

_STYLE = """
*{box-sizing:border-box}
body{font:15px/1.45 system-ui,sans-serif;max-width:1080px;margin:1.2em auto;padding:0 1em;
color:#222;overflow-wrap:break-word}
h1{font-size:1.15em;margin:.2em 0 .6em}h2{font-size:1.1em;margin-top:2em;
border-bottom:1px solid #ccc}
table{border-collapse:collapse;width:100%;font-size:13px}td,th{padding:.25em .6em;
border-bottom:1px solid #ddd;text-align:left;vertical-align:top}
.scroll{overflow-x:auto}img{width:100%;min-width:640px;display:block}
.verdict{border-left:6px solid;background:#f6f6f6;padding:.7em 1em;font-size:1.15em;margin:0}
.explained{border-color:#2a8a43}.no_gap,.insufficient{border-color:#888}
.inseparable{border-color:#d9930d}.unknown,.bad_data{border-color:#c33}
.tiles{display:flex;flex-wrap:wrap;gap:.7em;margin:.9em 0}
.tile{flex:1 1 10em;border:1px solid #ddd;border-radius:6px;padding:.5em .8em}
.tile b{display:block;font-size:1.5em}.tile span{color:#555;font-size:13px}
td:not(:last-child){white-space:nowrap}.scroll td:last-child{min-width:14em}
.rows td{white-space:normal}.rows th{width:11em;font-weight:600}
code{background:#f3f3f3;padding:.1em .3em}summary{cursor:pointer;color:#36c;margin:.5em 0}
@media print{body{margin:0}h2{break-after:avoid}}
"""
_PLOTTED_SAMPLES = 20_000
"""Largest number of samples in a plot. Chosen: the page stays small."""
_SPECTRUM_SAMPLES = 2048
"""Samples in a segment of a spectrum. Chosen: 0.06 Hz at 125 Hz."""
_LEGEND_COLUMNS = 4
"""Columns of a legend below a plot. Chosen: four names of effects fit beside each other."""
_BAR_COLOURS = {'noise floor': '#999', 'not closed': '#c44', 'not explained': '#e9b'}
"""Colours of the parts of the bar that no effect explains."""
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
    fault, verdict = diagnosis.data_fault, diagnosis.verdict
    status = fault.status if fault is not None else verdict.status if verdict else 'bad_data'
    parts = [f'<h1>{escape(title)} minus its simulation</h1>',
             f'<p class="verdict {status}">{escape(headline(diagnosis))}</p>',
             *(f'<p>{escape(note)}</p>' for note in notes(diagnosis))]
    if fault is None and verdict is not None:
        report = as_json(diagnosis)
        parts += [_tiles(tiles(diagnosis)), _row_table(gap_rows(diagnosis)),
                  _remainders(remainder_rows(diagnosis)),
                  '<h2>Which effects cause the gap</h2>', _candidate_table(report),
                  _convergence(verdict.best),
                  '<h2>What to record next</h2>', _next_experiment(report),
                  '<h2>How far the gap closes</h2>', _image(_bar_plot(diagnosis)),
                  '<h2>Recording minus simulation, before and after</h2>',
                  _image(_residual_plot(diagnosis)),
                  '<h2>Where the gap lies</h2>', _image(_map_plot(diagnosis)),
                  _folded('The cells with the largest shares', _cell_table(report)),
                  _not_covered(report['not_covered']),
                  '<h2>All hypotheses</h2>', _hypothesis_table(report),
                  '<h2>Noise</h2>',
                  _folded('Recorded noise divided by simulated noise', _noise_table(report))]
    return (f'<!doctype html><html lang="en"><head><meta charset="utf-8"><meta name="viewport" '
            f'content="width=device-width,initial-scale=1"><title>{escape(title)}</title>'
            f'<style>{_STYLE}</style></head><body>{"".join(parts)}</body></html>\n')


def _tiles(rows: Sequence[Row]) -> str:
    """Return the first figures beside each other."""
    cells = ''.join(f'<div class="tile"><span>{escape(row.label)}</span><b>{escape(row.text)}</b>'
                    '</div>' for row in rows)
    return f'<div class="tiles">{cells}</div>'


def _row_table(rows: Sequence[Row]) -> str:
    """Return rows of figures as a table with the labels on the left."""
    cells = ''.join(f'<tr><th>{escape(row.label)}</th><td>{escape(row.text)}</td></tr>'
                    for row in rows)
    return f'<table class="rows">{cells}</table>'


def _remainders(rows: Sequence[Row]) -> str:
    """Return what remains of the noise-like effects, if there are any."""
    if not rows:
        return ''
    return f'<p>Noise-like effects, after they are added to the simulation:</p>{_row_table(rows)}'


def _folded(title: str, content: str) -> str:
    """Return a part of the page that is folded at first."""
    return f'<details><summary>{escape(title)}</summary>{content}</details>'


def _image(plot: Any) -> str:
    """Return a plot as an image within the page."""
    out = BytesIO()
    plot.savefig(out, dpi=100, format='png', metadata={'Software': None})
    pyplot().close(plot)
    data = b64encode(out.getvalue()).decode()
    return f'<div class="scroll"><img alt="" src="data:image/png;base64,{data}"></div>'


def _bar_plot(diagnosis: Diagnosis) -> Any:
    """Draw the mean square of the gap: noise floor, share of each effect, and the rest."""
    assert diagnosis.gap_closure is not None
    closure = diagnosis.gap_closure
    floor = mg(closure.floor_mps2) ** 2
    after = max(floor, mg(closure.after_mps2) ** 2)
    before = max(after, mg(closure.before_mps2) ** 2)
    widths = {'noise floor': floor, 'not closed': after - floor} | {
        effect: share * (before - floor) for effect, share in shares_of_gap(diagnosis).items()}
    if sum(widths.values()) < before:
        widths['not explained'] = before - sum(widths.values())
    plot, axis = pyplot().subplots(figsize=(10, 2.4), layout='constrained')
    begin = 0.0
    for i, (label, width) in enumerate(widths.items()):
        axis.barh(0, width, left=begin, color=_BAR_COLOURS.get(label, f'C{i}'),
                  label=f'{label}: {width:.3g} mg²')
        begin += width
    labels = ((f'after {mg_text(closure.after_mps2)}', after, 'right', -3),
              (f'before {mg_text(closure.before_mps2)}', before, 'left', 3))
    for label, square, side, offset in labels:
        axis.axvline(square, color='k', lw=0.8)
        axis.annotate(label, (square, 0.6), ha=side, fontsize=8, xytext=(offset, 0),
                      textcoords='offset points')
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
            values = mg(residual_v[:, d] / comparison.scale_v_per_mps2[d])
            over_time.plot(comparison.time_s[::every], values[::every], lw=0.5, color=colour,
                           label=label)
            frequency_hz, power = welch(np.nan_to_num(values), comparison.sensor.rate_hz,
                                        nperseg=min(_SPECTRUM_SAMPLES, len(values)))
            spectrum.loglog(frequency_hz[1:], np.sqrt(power[1:]), lw=1, color=colour)
        over_time.set(ylabel=f'{axes[d]}, mg')
        spectrum.set(ylabel='mg/√Hz')
    for line in plot.legend(*grid[0, 0].get_legend_handles_labels(), loc='outside upper left',
                            ncols=2, fontsize=9, frameon=False).get_lines():
        line.set_linewidth(2)
    grid[-1, 0].set(xlabel='time, s')
    grid[-1, 1].set(xlabel='frequency, Hz')
    return plot


def _map_plot(diagnosis: Diagnosis) -> Any:
    """Draw the mean residual of all cells; significant cells have a frame."""
    cells = [c for c in diagnosis.residual_cells if c.statistic == 'mean']
    rows = sorted({(c.dimension, c.axis) for c in cells})
    largest_mg = mg(max((abs(c.mean_mps2) for c in cells), default=G0_MPS2 / 1e3))
    plot, axis = pyplot().subplots(figsize=(10, 0.8 + 0.24 * len(rows)), layout='constrained')
    drawn = None
    for i, row in enumerate(rows):
        in_row = sorted((c for c in cells if (c.dimension, c.axis) == row), key=lambda c: c.low)
        drawn = axis.scatter(
            np.arange(len(in_row)), np.full(len(in_row), i), marker='s', s=180,
            c=[mg(c.mean_mps2) for c in in_row], cmap='RdBu_r', vmin=-largest_mg,
            vmax=largest_mg, edgecolors=['k' if c.p < SIGNIFICANT_P else 'none' for c in in_row])
        axis.text(RANGES, i, range_text(in_row[0].low, in_row[-1].high), fontsize=8,
                  va='center')
    axis.set(yticks=range(len(rows)), xticks=[], xlim=(-0.5, RANGES + 2),
             xlabel=f'parts of the range, ascending; frame: family-wise p < {SIGNIFICANT_P:g}')
    axis.set_yticklabels([f'{dimension}  {name}' for dimension, name in rows], fontsize=8)
    if drawn is not None:
        plot.colorbar(drawn, label='mean residual, mg', shrink=0.6)
    return plot


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table without empty columns, or "None." where it has no rows."""
    if not rows:
        return '<p>None.</p>'
    filled = [any(column) for column in zip(*rows)]
    head, *rows = (list(compress(row, filled)) for row in (head, *rows))
    top = ''.join(f'<th>{escape(h)}</th>' for h in head)
    return (f'<div class="scroll"><table><tr>{top}</tr>{"".join(map(_row, rows))}</table>'
            '</div>')


def _row(cells: Sequence[str]) -> str:
    """Return a row of a table; a line of a cell ends with a line break."""
    texts = (escape(c).replace('\n', '<br>') for c in cells)
    return f'<tr>{"".join(f"<td>{text}</td>" for text in texts)}</tr>'


def _cell_table(report: dict[str, Any]) -> str:
    """Return the significant cells with the largest shares."""
    rows = []
    for c in report['where'][:_CELL_ROWS]:
        low, high = c['range']
        rows.append([c['axis'], c['dimension'], c['statistic'], range_text(low, high),
                     f'{mg(c["mean"]):+.2f}', f'{c["floor_units"]:+.1f}',
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
    """Return the most probable hypotheses; improbable ones are folded."""
    def table(hypotheses: Sequence[dict[str, Any]]) -> str:
        """Return some hypotheses with their probabilities."""
        return _table(['hypothesis', 'probability'], [
            [', '.join(h['effects']) or 'no gap', p_text(h['probability'])] for h in hypotheses])

    first_rows = report['hypotheses'][:_TABLE_ROWS]
    probable = [h for h in first_rows if h['probability'] >= PROBABLE]
    improbable = [h for h in first_rows if h['probability'] < PROBABLE]
    return table(probable) + (_folded('Improbable hypotheses', table(improbable))
                              if improbable else '')


def _convergence(best: Hypothesis) -> str:
    """Return a warning where the fit of the best hypothesis has not converged."""
    if best.converged:
        return ''
    return ('<p>The fit of the most probable hypothesis has not converged. Its parameters may be '
            'less accurate than their intervals.</p>')


def _candidate_table(report: dict[str, Any]) -> str:
    """Return the most probable effects with their parameters; improbable ones are folded."""
    noisy = bool(report['noise_remainders'])

    def table(candidates: Sequence[dict[str, Any]]) -> str:
        """Return some effects, with one line for each parameter."""
        rows = [[c['effect'], p_text(c['probability'] or 0.0),
                 '\n'.join(f'{name}: {parameter_text(p)}' for name, p in c['parameters'].items()),
                 '' if c['share'] is None else f'{percent(c["share"], noisy)} %',
                 ', '.join(c['inseparable_from']), c['cause']] for c in candidates]
        return _table(['effect', 'probability', 'parameters (90 % interval)', 'share of gap',
                       'not separated from', 'cause'], rows)

    first_rows = report['candidates'][:_TABLE_ROWS]
    probable = [c for c in first_rows if (c['probability'] or 0.0) >= PROBABLE]
    improbable = [c for c in first_rows if (c['probability'] or 0.0) < PROBABLE]
    return table(probable) + (_folded('Improbable effects', table(improbable))
                              if improbable else '')


def _not_covered(names: Sequence[str]) -> str:
    """Return what the recordings do not cover."""
    return f'<p>Not covered by these recordings: {escape(", ".join(names))}.</p>' if names else ''


def _next_experiment(report: dict[str, Any]) -> str:
    """Return the inseparable groups, and the manoeuvre that is proposed."""
    groups = ''.join(f'<p>{escape(", ".join(group))}: these recordings do not separate them.</p>'
                     for group in report['verdict']['groups'])
    proposal = report['next_experiment']
    if proposal is None:
        return f'{groups}<p>No further recording is needed.</p>'
    menu = '' if not proposal['menu'] else _table(
        ['manoeuvre', 'minutes', 'log Bayes factor per minute'], [
            [m['manoeuvre'], f'{m["minutes"]:.1f}', f'{m["nats_per_minute"]:.1f}']
            for m in proposal['menu']])
    manoeuvre = proposal['manoeuvre'][:1].upper() + proposal['manoeuvre'][1:]
    return (f'{groups}<p>{escape(manoeuvre)}, {escape(proposal["why"])}.</p>'
            f'<p><code>{escape(proposal["command"])}</code></p>{menu}')
