# SPDX-License-Identifier: Apache-2.0
"""The files of a diagnosis, and its HTML page that opens offline, with its figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from adxl_ros.diagnose import report as words
from adxl_ros.diagnose.comparison import BaselineComparison
from adxl_ros.diagnose.diagnosis import Diagnosis, Report
from adxl_ros.diagnose.proofs import INK, Proof, proofs_of, spectra, stacked, WIDE
from adxl_ros.diagnose.report_json import as_text, named_effects
from adxl_ros.diagnose.residual_map import ResidualCell
from adxl_ros.diagnose.screen import as_shown, size_lines
from adxl_ros.files import parameter_file
from adxl_ros.model.sensor import Sensor
from adxl_ros.report import figures as plots, page as html_page
from adxl_ros.report.figures import Figure, figure, line, rounded
from adxl_ros.report.quantities import decimals, mg, mg_text, percent
import numpy as np

COLOURS = {
    'explained': 'green',
    'partly': 'amber',
    'no_gap': 'grey',
    'inseparable': 'amber',
    'insufficient': 'amber',
    'unknown': 'red',
    'bad_data': 'red',
}
"""Colour of the badge for each status."""
TILES = 4  # Figures at the top of the page
_PLOTTED_POINTS = 3000
"""Largest number of points of a line. Chosen: more than a wide screen has columns."""
_EFFECT_COLOUR = '#5b8fd6'


@dataclass(frozen=True)
class Run:
    """
    What the page says about the run that made it.

    `steps` are what to do next, purpose and command; `command` makes the page, and is empty for
    that of this process.
    """

    subject: str
    parameter_file: str
    steps: Sequence[tuple[str, str]]
    command: str = ''


def documents(
    diagnosis: Diagnosis, report: dict[str, Any], comments: Sequence[str], run: Run | None
) -> dict[str, str]:
    """
    Return the files of a diagnosis by name.

    report: its JSON; comments: head of the parameters, which a fault leaves out; run: what the
    page says of the run, None without a page.
    """
    texts = {'report.json': as_text(report)}
    if diagnosis.report is not None:
        texts['params.yaml'] = parameter_file.as_text(diagnosis.report.sensor, comments)
    if run is not None:
        texts['report.html'] = _page(diagnosis, report, run, texts.get('params.yaml', ''))
    return texts


def _page(diagnosis: Diagnosis, objects: dict[str, Any], run: Run, parameters: str) -> str:
    """Lay out the page; raise UserError where Plotly or jinja2 is not installed."""
    values: dict[str, Any] = {
        'title': run.subject,
        'about': [f'parameter file {run.parameter_file}'],
        'badge': {
            'colour': COLOURS[objects['verdict']['status']],
            'word': words.badge(diagnosis),
            'sentence': words.headline(diagnosis),
        },
        'notes': words.notes(diagnosis),
        'figures': {},
        'has_verdict': False,
        'download': parameters and html_page.download_url(parameters),
    }
    if run.command:
        values['command'] = run.command
    if diagnosis.report is not None:
        values |= _contents(diagnosis, diagnosis.report, objects) | {'steps': run.steps}
    return html_page.render('adxl_ros.diagnose', 'diagnosis.html', values)


def _contents(diagnosis: Diagnosis, report: Report, objects: dict[str, Any]) -> dict[str, Any]:
    """Return what the template shows of a diagnosis with a verdict."""
    candidates = {c['effect']: c for c in objects['candidates']}
    named = named_effects(report)
    probable = [name for name, c in candidates.items() if c['probability'] >= words.PROBABLE]
    # The named effects come first, then those that are probable.
    shown = list(dict.fromkeys([*named, *probable]))
    proofs = proofs_of(diagnosis, report, shown)
    rows = words.figure_rows(diagnosis)
    scale = float(report.baseline.scale_v_per_g.mean())
    proposal = objects['next_experiment'] or {'menu': []}
    return {
        'has_verdict': True,
        'figures': _figures(diagnosis, report, proofs),
        'tiles': rows[:TILES],
        'effects': [_effect(report, candidates[name]) for name in shown],
        'proofs': proofs,
        'figure_rows': rows,
        'remainders': [(row.label, row.text) for row in words.remainder_rows(report)],
        'hypotheses': [
            [', '.join(h['effects']) or 'no gap', percent(h['probability'])]
            for h in objects['hypotheses']
        ],
        'not_covered': objects['not_covered'],
        'where': [_cell(c) for c in report.residual_cells],
        'menu': [
            [m['manoeuvre'], f'{m["minutes"]:.1f}', f'{m["nats_per_minute"]:.2g}']
            for m in proposal['menu']
        ],
        'could_show': [(row.shows, *as_shown(row, scale)) for row in report.could_show],
    }


def _effect(report: Report, candidate: dict[str, Any]) -> dict[str, Any]:
    """Return what the template shows of an effect."""
    share = candidate['share']
    return {
        'name': candidate['effect'],
        'sure': percent(candidate['probability']),
        'cause': candidate['cause'],
        'share': '' if share is None else f'{percent(share)} of the gap',
        'rivals': candidate['inseparable_from'],
        'sizes': size_lines(report, candidate),
    }


def _figures(diagnosis: Diagnosis, report: Report, proofs: Sequence[Proof]) -> dict[str, Figure]:
    """Return all figures by the names of their places in the template."""
    best = report.hypotheses[0].sensor
    full_rate = diagnosis.full_rate[0]
    before_v = full_rate.residual_v(full_rate.sensor)
    residuals_v = {'before': before_v, 'after': full_rate.residual_v(best)}
    return {
        'waterfall': waterfall(report),
        'signals': signals(diagnosis.comparisons[0], best),
        'spectrum': spectra(full_rate, residuals_v),
        **{f'proof-{proof.effect}': proof.figure for proof in proofs},
    }


def _cell(cell: ResidualCell) -> list[str]:
    """Return quantity, range, axis, mean and share of a part of the map."""
    name = cell.dimension
    unit = name.rpartition('_')[2]
    factor = 1.0
    if 'rad' in name:
        unit = '°/s' if 'rate' in name else '°'
        factor = float(np.degrees(1.0))
    places = decimals(factor * (cell.high - cell.low))
    return [
        name.split('_rad')[0].replace('_', ' '),
        f'{factor * cell.low:.{places}f} to {factor * cell.high:.{places}f} {unit}',
        cell.axis,
        mg_text(cell.mean_mps2),
        percent(cell.share),
    ]


class _Bar(NamedTuple):
    """A bar of the waterfall."""

    label: str
    begin_mg: float
    width_mg: float
    text: str  # Behind the bar
    colour: str


def waterfall(report: Report) -> Figure:
    """Draw the gap, what each effect takes off it, what stays, and the noise floor."""
    closure = report.closure
    level = float(mg(closure.before.value))
    after = float(mg(closure.after.value))
    floor = float(mg(closure.floor.value))
    highest = max(level, after, floor)
    above = level**2 - floor**2
    bars = [_Bar('gap', 0.0, level, mg_text(closure.before.value), plots.BEFORE_COLOUR)]
    for name, share in sorted(words.shares_of_gap(report).items(), key=lambda item: -item[1]):
        if share > 0:
            lower = max(level**2 - share * above, 0.0) ** 0.5
            bars.append(_Bar(name, lower, level - lower, percent(share), _EFFECT_COLOUR))
            level = lower
    if len(bars) > 1:
        left = mg_text(closure.after.value)
        bars.append(_Bar('what is left', 0.0, after, left, plots.AFTER_COLOUR))
    lowest = mg_text(closure.floor.value)
    bars.append(_Bar('noise floor', 0.0, floor, lowest, plots.QUIET_COLOUR))
    trace = {
        'type': 'bar',
        'width': 0.62,
        'orientation': 'h',
        'y': [bar.label for bar in bars],
        'x': rounded([bar.width_mg for bar in bars]),
        'base': rounded([bar.begin_mg for bar in bars]),
        'text': [bar.text for bar in bars],
        'textposition': 'outside',
        'cliponaxis': False,
        'marker': {'color': [bar.colour for bar in bars]},
        'hovertemplate': '%{y}: %{text}<extra></extra>',
        'showlegend': False,
    }
    return figure(
        [trace],
        60 + 38 * len(bars),
        xaxis={'title': {'text': 'rms, mg'}, 'range': [0, 1.2 * highest]},
        yaxis={'autorange': 'reversed', 'ticks': '', 'type': 'category'},
    )


def signals(comparison: BaselineComparison, after: Sensor) -> Figure:
    """Draw recording, simulation and difference, before and after, with linked zoom."""
    time_s = comparison.time_s - comparison.time_s[0]
    scale = comparison.scale_v_per_mps2
    before_mg = mg(comparison.residual_v(comparison.sensor) / scale)
    after_mg = mg(comparison.residual_v(after) / scale)
    recorded_g = mg((comparison.volts - comparison.sensor.zero_g_v) / scale) / 1e3
    contents = {
        '{}, g': [
            ('recording', recorded_g, INK),
            ('simulation before', recorded_g - before_mg / 1e3, plots.BEFORE_COLOUR),
            ('simulation after', recorded_g - after_mg / 1e3, plots.AFTER_COLOUR),
        ],
        'difference {}, mg': [
            ('difference before', before_mg, plots.BEFORE_COLOUR),
            ('difference after', after_mg, plots.AFTER_COLOUR),
        ],
    }
    panels = []
    for d, axis in enumerate(comparison.sensor.axes):
        for label, series in contents.items():
            lines = []
            for name, values, colour in series:
                chosen = plots.extremes(values[:, d], _PLOTTED_POINTS)
                lines.append(line(time_s[chosen], values[chosen, d], name, colour, opacity=0.8))
            panels.append(({'title': {'text': label.format(axis)}, 'nticks': 5}, lines))
    return stacked(
        panels, 80 + 150 * len(panels), {**WIDE, 't': 60}, {'title': {'text': 'time, s'}}
    )
