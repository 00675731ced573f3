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

"""The diagnosis as one page that opens offline."""

from __future__ import annotations

from base64 import b64encode
from html import escape
from io import BytesIO
from itertools import pairwise
from typing import Any

from adxl_ros.diagnose.diagnosis import Diagnosis
from adxl_ros.diagnose.report_json import as_json, sentence, shares
from adxl_ros.diagnose.residual_map import SHOWS_P
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
_SHOWN = 20_000
_COLUMNS = 8


def page(found: Diagnosis, title: str) -> str:
    """
    Lay the page out.

    Parameters
    ----------
    found
        The diagnosis.
    title
        Names of the recordings.

    """
    parts = [f'<h1>{escape(title)}</h1>', f'<p class="verdict">{escape(sentence(found))}</p>']
    if found.fault is None and found.verdict is not None:
        report = as_json(found)
        parts += ['<h2>How far it shrinks</h2>', _picture(_bar(found)),
                  '<h2>Before and after</h2>', _picture(_overlay(found)),
                  '<h2>Noise, recorded by simulated</h2>', _noise(report),
                  '<h2>Where</h2>', _picture(_map(found)), _where(report),
                  _list('Not covered by this recording', report['not_covered']),
                  '<h2>Which</h2>', _hypotheses(report), _candidates(report),
                  '<h2>What cannot be told apart, and what to do next</h2>', _next(report)]
    return (f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}'
            f'</title><style>{_STYLE}</style></head><body>{"".join(parts)}</body></html>\n')


def _picture(figure: Any) -> str:
    out = BytesIO()
    figure.savefig(out, dpi=100, format='png', metadata={'Software': None})
    pyplot().close(figure)
    return f'<img alt="" src="data:image/png;base64,{b64encode(out.getvalue()).decode()}">'


def _bar(found: Diagnosis) -> Any:
    """Draw the squares of the gap: the floor, each effect's part, what is left."""
    assert found.shrunk is not None
    far = found.shrunk
    squares = [(1e3 * v / G0_MPS2) ** 2 for v in (far.floor_mps2, far.after_mps2,
                                                  far.before_mps2)]
    floor, after, before = squares[0], max(squares[0], squares[1]), max(squares)
    parts = {'floor': floor, 'left': after - floor} | {
        effect: share * (before - floor) for effect, share in shares(found).items()}
    if sum(parts.values()) < before:
        parts['not explained'] = before - sum(parts.values())
    figure, axis = pyplot().subplots(figsize=(10, 1.8), layout='constrained')
    begin = 0.0
    for i, (label, width) in enumerate(parts.items()):
        axis.barh(0, width, left=begin, color='#999' if label == 'floor' else f'C{i + 1}',
                  label=f'{label}: {width:.3g} mg²')
        begin += width
    for label, square in zip(('after', 'before'), (after, before)):
        axis.axvline(square, color='k', lw=0.8)
        axis.annotate(f'{label} {np.sqrt(square):.3g} mg', (square, 0.45), rotation=30,
                      fontsize=8, annotation_clip=False)
    axis.set(yticks=[], ylim=(-0.4, 1.0), xlabel='mean square, held out, mg²')
    axis.legend(fontsize=8, ncols=len(parts), loc='upper right', frameon=False)
    axis.spines[['top', 'right', 'left']].set_visible(False)
    return figure


def _overlay(found: Diagnosis) -> Any:
    assert found.verdict is not None
    one = found.series[0]
    before, after = one.residual(one.sensor), one.residual(found.verdict.best.sensor)
    count = len(one.sensor.axes)
    figure, grid = pyplot().subplots(count, 2, figsize=(12, 2.6 * count), layout='constrained',
                                     squeeze=False, width_ratios=(2, 1))
    every = max(len(one) // _SHOWN, 1)
    for d, row in enumerate(grid):
        for off, colour, label in ((before, '#c44', 'before'), (after, '#484', 'after')):
            mg = 1e3 * off[:, d] / one.scale_v_per_mps2[d] / G0_MPS2
            row[0].plot(one.time_s[::every], mg[::every], lw=0.5, color=colour, label=label)
            f, power = welch(np.nan_to_num(mg), one.sensor.rate_hz,
                             nperseg=min(2048, len(mg)))
            row[1].loglog(f[1:], np.sqrt(power[1:]), lw=1, color=colour)
        row[0].set(ylabel=f'{one.sensor.axes[d]}: recording less simulator, mg')
        row[1].set(ylabel='mg/√Hz')
    grid[0, 0].legend(loc='upper right', fontsize=8)
    grid[-1, 0].set(xlabel='time, s')
    grid[-1, 1].set(xlabel='frequency, Hz')
    return figure


def _map(found: Diagnosis) -> Any:
    """Draw all cells of the map: mean residual by range, ringed where it shows."""
    cells = [c for c in found.cells if c.statistic == 'mean']
    rows = sorted({(c.dimension, c.axis) for c in cells})
    limit = max((abs(c.mean_mps2) for c in cells), default=1.0) * 1e3 / G0_MPS2
    figure, axis = pyplot().subplots(figsize=(10, 0.8 + 0.24 * len(rows)), layout='constrained')
    drawn = None
    for i, row in enumerate(rows):
        own = sorted((c for c in cells if (c.dimension, c.axis) == row), key=lambda c: c.low)
        shows = ['k' if c.p < SHOWS_P else 'none' for c in own]
        drawn = axis.scatter(np.arange(len(own)), np.full(len(own), i), marker='s', s=180,
                             c=[1e3 * c.mean_mps2 / G0_MPS2 for c in own], cmap='RdBu_r',
                             vmin=-limit, vmax=limit, edgecolors=shows)
        axis.text(_COLUMNS, i, f'{own[0].low:.4g} to {own[-1].high:.4g}', fontsize=8, va='center')
    axis.set(yticks=range(len(rows)), xticks=[], xlim=(-0.5, _COLUMNS + 2),
             xlabel='from the lowest range to the highest; ringed: p < 0.05, family-wise')
    axis.set_yticklabels([f'{dimension}  {name}' for dimension, name in rows], fontsize=8)
    if drawn is not None:
        figure.colorbar(drawn, label='mean residual, mg', shrink=0.6)
    return figure


def _table(head: list[str], rows: list[list[str]]) -> str:
    if not rows:
        return '<p>Nothing.</p>'
    top = ''.join(f'<th>{escape(h)}</th>' for h in head)
    body = ''.join('<tr>' + ''.join(f'<td>{escape(c)}</td>' for c in row) + '</tr>'
                   for row in rows)
    return f'<table><tr>{top}</tr>{body}</table>'


def _where(report: dict[str, Any]) -> str:
    return _table(['axis', 'dimension', 'of', 'range', 'mg', 'in floors', 'share', 'p (family)'], [
        [c['axis'], c['dimension'], c['statistic'], f'{c["range"][0]:.4g} to {c["range"][1]:.4g}',
         f'{1e3 * c["mean"] / G0_MPS2:+.2f}', f'{c["floor_units"]:+.1f}',
         f'{100 * c["share"]:.1f} %', f'{c["p"]:.3f}'] for c in report['where'][:12]])


def _noise(report: dict[str, Any]) -> str:
    rows = []
    for one in report['gap']['noise']:
        bands = one['bands_hz']
        names = [f'{low:.3g} to {high:.3g} Hz' for low, high in pairwise(bands)]
        names += [f'Allan deviation at {t:g} s' for t in one['allan_s']]
        rows += [[name, f'{before:.2f}', f'{after:.2f}'] for name, before, after in zip(
            names, *([*one[f'power_ratio_{when}'], *one[f'allan_ratio_{when}']]
                     for when in ('before', 'after')))]
        rows.append(['log-likelihood gained, nats', '', f'{one["log_likelihood_gain"]:.0f}'])
    return _table(['power or deviation, recorded by simulated', 'before', 'after'], rows)


def _hypotheses(report: dict[str, Any]) -> str:
    return _table(['hypothesis', 'probability'], [
        [', '.join(h['effects']) or 'no gap', f'{h["probability"]:.4f}']
        for h in report['hypotheses'][:10]])


def _candidates(report: dict[str, Any]) -> str:
    rows = []
    for one in report['candidates'][:10]:
        parameters = '; '.join(
            f'{name} = {p["value"]:.4g} ({p["ci"][0]:.3g} to {p["ci"][1]:.3g}) {p["unit"]}'
            if 'ci' in p else f'{name} = {p["value"]}' for name, p in one['parameters'].items())
        rows.append([one['effect'], f'{one["probability"]:.3f}', parameters,
                     ', '.join(one['inseparable_from']), one['cause']])
    return _table(['effect', 'probability', 'parameters (90 %)', 'not told from', 'cause'], rows)


def _list(title: str, words: list[str]) -> str:
    return f'<p>{escape(title)}: {escape(", ".join(words))}.</p>' if words else ''


def _next(report: dict[str, Any]) -> str:
    groups = [f'<p>This recording cannot tell {escape(" from ".join(group))}.</p>'
              for group in report['verdict']['groups']]
    step = report['next_experiment']
    if step is None:
        return ''.join(groups) + '<p>Nothing more is asked for.</p>'
    menu = '' if not step['menu'] else _table(['manoeuvre', 'minutes', 'nats a minute'], [
        [one['manoeuvre'], f'{one["minutes"]:.1f}', f'{one["nats_per_minute"]:.1f}']
        for one in step['menu']])
    return ''.join(groups) + (f'<p>{escape(step["manoeuvre"])}: {escape(step["why"])}.</p>'
                              f'<p><code>{escape(step["command"])}</code></p>{menu}')
