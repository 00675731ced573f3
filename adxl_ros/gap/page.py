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
from typing import Any

from adxl_ros.calibrate.figures import pyplot
from adxl_ros.gap.diagnose import Diagnosis
from adxl_ros.gap.report import as_json, sentence
from adxl_ros.gap.verdict import contribution_mps2
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
                  '<h2>Where</h2>', _where(report), _list('Not covered by this recording',
                                                          report['not_covered']),
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
    assert found.verdict is not None and found.shrunk is not None and found.study is not None
    far = found.shrunk
    figure, axis = pyplot().subplots(figsize=(10, 1.9), layout='constrained')
    mg = {'before': far.before_mps2, 'after': far.after_mps2, 'floor': far.floor_mps2}
    for i, (label, value) in enumerate(mg.items()):
        axis.barh(2 - i, 1e3 * value / G0_MPS2, color=('#c44', '#484', '#999')[i])
        axis.text(1e3 * value / G0_MPS2, 2 - i, f' {label}: {1e3 * value / G0_MPS2:.3f} mg rms',
                  va='center', fontsize=9)
    best = found.verdict.best
    parts = {effect: contribution_mps2(found.study, best, effect) for effect in best.effects}
    axis.set(yticks=[], xlabel='mg rms, held out', title=', '.join(
        f'{effect} {1e3 * part / G0_MPS2:.2f} mg' for effect, part in parts.items()))
    axis.margins(x=0.25)
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


def _table(head: list[str], rows: list[list[str]]) -> str:
    if not rows:
        return '<p>Nothing.</p>'
    top = ''.join(f'<th>{escape(h)}</th>' for h in head)
    body = ''.join('<tr>' + ''.join(f'<td>{escape(c)}</td>' for c in row) + '</tr>'
                   for row in rows)
    return f'<table><tr>{top}</tr>{body}</table>'


def _where(report: dict[str, Any]) -> str:
    return _table(['axis', 'dimension', 'range', 'mean, mg', 'in floors', 'share', 'p (family)'], [
        [c['axis'], c['dimension'], f'{c["range"][0]:.4g} to {c["range"][1]:.4g}',
         f'{1e3 * c["mean"] / G0_MPS2:+.2f}', f'{c["floor_units"]:+.1f}',
         f'{100 * c["share"]:.1f} %', f'{c["p"]:.3f}'] for c in report['where'][:12]])


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
    return ''.join(groups) + (f'<p>{escape(step["manoeuvre"])}: {escape(step["why"])}.</p>'
                              f'<p><code>{escape(step["command"])}</code></p>')
